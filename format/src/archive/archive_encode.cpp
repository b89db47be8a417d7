// archive_encode.cpp - encodes Gaussians as a file of Codec::archive, frames side by side on all threads.
//
// Fit:   steps and transforms from a sample of the scene.
// Order: the cells of means decide the order of each frame.
// Codes: each frame's attributes, in the order in which a reader learns what they mean. They are found twice, since
//        those of a whole scene take more memory than its Gaussians: first to count them, then to write them.
// Tables and streams: distributions of all frames together, then each frame's bytes.
// Rows:  what a reader will decode; they give the step sets, the chunk table and the stated bounds.
// Finally the file is decoded and compared with its source.
// SPDX-License-Identifier: Apache-2.0
#include "archive/archive_encode.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstring>
#include <limits>
#include <numbers>
#include <numeric>

#include "archive/archive_codec.hpp"
#include "archive/archive_errors.hpp"
#include "archive/archive_fit.hpp"
#include "file/byte_writer.hpp"
#include "file/chunk_summary.hpp"
#include "file/encode_plan.hpp"
#include "file/section_writer.hpp"
#include "file/workers.hpp"
#include "levels/levels_file.hpp"
#include "packed/packed.hpp"
#include "rgs/checksum.hpp"
#include "rgs/quantize.hpp"

namespace rgs {

ArchiveOptions archive_high() {
  return {};
}

ArchiveOptions archive_small() {
  return {.step = 2.2f};
}

ArchiveOptions archive_tiny() {
  return {.step = 5.25f};
}

namespace {

using namespace detail;

constexpr float kLargestSh = 0x1p30f;  // one beyond it would shift the centre of all

// Consecutive Gaussians that are coded together; with levels, a page.
struct Frame {
  std::uint64_t first = 0, count = 0;
  std::uint32_t level = 0;
  std::int16_t scale_exponent = 0;
  GridPoint corner{};                          // of a page
  Box extent;                                  // of a page
  std::vector<std::byte> means, geometry, sh;  // streams; of a page `means` alone
  float min_scale = std::numeric_limits<float>::max(), max_scale = 0;
};

// Codes of the frame that a thread works on.
struct FrameCodes {
  std::vector<GridPoint> cells;        // of means, from the corner
  std::array<std::uint8_t, 3> bits{};  // of their coordinates
  ShapeCodes shapes;
  ColourCodes colours;
  CodeSizes sizes;
  PointTree tree;
};

// One thread's sums over chunks.
struct Totals {
  SceneScan scan{0};  // of the leaves' means
  ValueCounts counts;
  ShMagnitudes magnitudes, sources;  // of decoded and of given SH
};

float largest_of(const ShStepSet& magnitudes) {
  return *std::max_element(magnitudes.step[0], std::end(magnitudes.step[3]));
}

// Cell of a mean on one axis, from the centre.
std::int64_t grid_cell(const ArchiveParameters& p, std::size_t axis, float mean) {
  const double t = (static_cast<double>(mean) - p.centre[axis]) / p.half_width[axis];
  const double u = std::min(std::abs(t), 0x1p255);  // beyond any grid, but finite
  const auto scaled = [&p](double x) {
    return static_cast<std::int64_t>(std::floor(std::ldexp(x, static_cast<int>(p.mean_cells))));
  };
  std::int64_t n = 0;
  if (u < 1) {
    n = scaled(u);
  } else {
    int exponent = 0;
    const double fraction = std::frexp(u, &exponent);
    n = (static_cast<std::int64_t>(exponent) << p.mean_cells) + scaled(2 * fraction - 1);
  }
  return t < 0 ? -1 - n : n;
}

// A cell as stored in the file.
std::uint32_t grid_coordinate(const ArchiveParameters& p, std::size_t axis, float mean) {
  return static_cast<std::uint32_t>(grid_cell(p, axis, mean) + (std::int64_t{1} << (p.mean_bits - 1)));
}

// Unit quaternions w x y z.
using Quaternion = std::array<double, 4>;

Quaternion product(const Quaternion& a, const Quaternion& b) {
  return {a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3], a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
          a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1], a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
}

// A rotation of a cube onto itself, and the axes onto which it takes x, y and z.
struct CubeRotation {
  Quaternion rotation;
  std::array<std::size_t, 3> axes;
};

// All 24: two quaternions of opposite sign stand for each.
std::vector<CubeRotation> cube_rotations() {
  std::vector<CubeRotation> out;
  const double half = std::sqrt(0.5);
  // All quaternions with components -1, 0, 1 in equal measure, of which the first that is not 0 is positive.
  for (int code = 0; code < 81; ++code) {
    std::array<int, 4> digits{code / 27 - 1, code / 9 % 3 - 1, code / 3 % 3 - 1, code % 3 - 1};
    const auto n = 4 - std::ranges::count(digits, 0);
    const auto first = std::ranges::find_if(digits, [](int d) { return d != 0; });
    if (n == 0 || n == 3 || *first < 0) continue;
    CubeRotation g{};
    for (std::size_t k = 0; k < 4; ++k) g.rotation[k] = digits[k] * (n == 1 ? 1 : n == 2 ? half : 0.5);
    const auto [w, x, y, z] = g.rotation;
    const double columns[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
                                  {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
                                  {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
    for (std::size_t j = 0; j < 3; ++j) {
      while (std::abs(columns[j][g.axes[j]]) < 0.5) ++g.axes[j];
    }
    out.push_back(g);
  }
  return out;
}

// Half the turn of a Gaussian around its own axes from rotation q to that with last components x, and its derivatives by
// each of them.
struct Turn {
  double half[3], by[3][3];  // by[k][a]: of half[k] by x[a]

  Turn(const Quaternion& q, const double x[3]) {
    const double w = std::sqrt(std::max(1 - x[0] * x[0] - x[1] * x[1] - x[2] * x[2], 0x1p-20));
    const double from[3] = {q[1], q[2], q[3]};
    for (std::size_t k = 0; k < 3; ++k) {
      const std::size_t i = (k + 1) % 3, j = (k + 2) % 3;
      half[k] = q[0] * x[k] - w * from[k] - (from[i] * x[j] - from[j] * x[i]);
      for (std::size_t a = 0; a < 3; ++a) by[k][a] = x[a] / w * from[k];
      by[k][k] += q[0];
      by[k][i] += from[j];
      by[k][j] -= from[i];
    }
  }
};

// Codes of a rotation whose turns around the Gaussian's own axes show by `shows`: coarse ones first, and the finer ones
// make up for what those have turned.
void turn_codes(const Quaternion& q, const double shows[3], const double step[3], const bool coded[3],
                std::int16_t codes[3]) {
  // What shows little may turn far, so that one step of Newton's method is not enough.
  constexpr int kSteps = 3;
  double x[3] = {q[1], q[2], q[3]};
  std::size_t order[3] = {0, 1, 2};
  std::stable_sort(order, order + 3, [&](std::size_t a, std::size_t b) { return step[a] > step[b]; });
  for (std::size_t t = 0; t < 3; ++t) {
    const std::size_t axis = order[t];
    const double code = coded[axis] ? std::nearbyint(x[axis] / step[axis]) : 0;
    codes[axis] = static_cast<std::int16_t>(std::clamp(code, -32767.0, 32767.0));
    x[axis] = codes[axis] * step[axis];
    // Least squares (Gauss-Newton) over the axes that are left, one or two.
    for (int n = 0; n < kSteps && t < 2; ++n) {
      const std::size_t a = order[t + 1], b = order[2];
      const Turn turn(q, x);
      double aa = 0, ab = 0, bb = 0, ra = 0, rb = 0;
      for (std::size_t k = 0; k < 3; ++k) {
        aa += shows[k] * turn.by[k][a] * turn.by[k][a];
        ab += shows[k] * turn.by[k][a] * turn.by[k][b];
        bb += shows[k] * turn.by[k][b] * turn.by[k][b];
        ra -= shows[k] * turn.by[k][a] * turn.half[k];
        rb -= shows[k] * turn.by[k][b] * turn.half[k];
      }
      // Where no turn shows, there is nothing to solve.
      const auto turn_by = [&x](std::size_t i, double numerator, double divisor) {
        if (divisor > 0) x[i] = std::clamp(x[i] + numerator / divisor, -1.0, 1.0);
      };
      if (t == 1) {
        turn_by(b, rb, bb);
      } else {
        const double determinant = aa * bb - ab * ab;
        turn_by(a, ra * bb - ab * rb, determinant);
        turn_by(b, aa * rb - ab * ra, determinant);
      }
    }
  }
}

class Encoder {
 public:
  /// `pages`: of a file with levels, else null.
  Encoder(const EncodePlan& plan, const SplatView& splats, const PageTable* pages)
      : plan_(plan),
        pages_(pages),
        splats_(splats),
        first_leaf_(splats.n - plan.header.n_gaussians),
        degree_(plan.header.sh_degree),
        order_(splats.n) {
    std::iota(order_.begin(), order_.end(), 0u);
    tables_.n_sh = archive_sh_count(degree_);
    if (pages_ != nullptr) {
      for (const lod::Page& page : pages_->pages) {
        Frame& f = frames_.emplace_back();
        f.first = page.first;
        f.count = page.count;
        f.level = page.level;
      }
      return;
    }
    for (std::uint64_t first = 0; first < splats.n; first += plan.frame_rows()) {
      Frame& f = frames_.emplace_back();
      f.first = first;
      f.count = std::min<std::uint64_t>(plan.frame_rows(), splats.n - first);
    }
  }

  Result<WrittenScene> run(std::vector<std::byte>& bytes, std::span<const std::uint32_t> source_index) {
    // The largest coefficient is to blame, even if the transforms that it bends fail for another Gaussian first.
    const auto with_largest_sh = [&] {
      const auto sh = leaves().sh;
      const auto largest = std::ranges::max_element(sh, {}, [](float x) { return std::abs(x); });
      return source_index[static_cast<std::size_t>(largest - sh.begin()) / (3 + tables_.n_sh)];
    };
    if (!(largest_of(plan_.largest_sh) <= kLargestSh)) return too_large(with_largest_sh());
    fit();
    if (Status s = count_codes(); !s) {
      std::uint64_t& found = s.error().found;
      found = name_in_source(source_index, found) == Error::kNone ? Error::kNone : with_largest_sh();
      return tl::unexpected(s.error());
    }
    choose_exponents();
    if (Status s = encode_frames(); !s) {
      if (s.error().code == Errc::bad_value) s.error().found = name_in_source(source_index, s.error().found);
      return tl::unexpected(s.error());
    }
    bytes.clear();
    auto written = pages_ != nullptr ? assemble_pages(bytes, source_index) : assemble(bytes, source_index);
    if (!written) return written;
    const Status verified = pages_ != nullptr ? verify_archive_levels(bytes, splats_, order_, n_threads())
                                              : verify_archive(bytes, splats_, order_, n_threads());
    if (const Status& s = verified; !s) {
      if (s.error().code == Errc::host_out_of_memory || s.error().code == Errc::limit_exceeded)
        return tl::unexpected(s.error());
      // An internal error has no position in the source.
      return make_error(Errc::internal, Error::kNone, s.error().what, Error::kNone, s.error().offset);
    }
    return written;
  }

 private:
  unsigned n_threads() const { return plan_.options.archive.threads; }

  // A Gaussian's number in errors; those above the leaves have no position in the source.
  std::uint64_t name_in_source(std::span<const std::uint32_t> source_index, std::uint64_t i) const {
    return i < first_leaf_ ? Error::kNone : source_index[i - first_leaf_];
  }

  // Rows of the leaves; without levels, all.
  SplatView leaves() const {
    SplatView view = splats_;
    view.n -= first_leaf_;
    view.mean = view.mean.subspan(3 * first_leaf_);
    view.log_scale = view.log_scale.subspan(3 * first_leaf_);
    view.rotation = view.rotation.subspan(4 * first_leaf_);
    view.opacity_logit = view.opacity_logit.subspan(first_leaf_);
    view.sh = view.sh.subspan((3 + tables_.n_sh) * first_leaf_);
    return view;
  }

  void fit() {
    ArchiveParameters& p = tables_.parameters;
    Box full = plan_.declarations.full;  // of all levels
    for (std::size_t i = 0; i < splats_.mean.size(); ++i) {
      full.min[i % 3] = std::min(full.min[i % 3], splats_.mean[i]);
      full.max[i % 3] = std::max(full.max[i % 3], splats_.mean[i]);
    }
    fit_grid(plan_.declarations.robust, full, p);
    fit_steps(plan_.options.archive, leaves(), plan_.largest_sh, tables_);
    fit_transforms(leaves(), sample_importance(leaves(), p), tables_);
    std::uint64_t largest = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      for (const float mean : {full.min[k], full.max[k]}) {
        const std::int64_t cell = grid_cell(p, k, mean);
        largest = std::max(largest, static_cast<std::uint64_t>(cell < 0 ? -1 - cell : cell));
      }
    }
    p.mean_bits = static_cast<std::uint32_t>(std::bit_width(largest)) + 1;
  }

  // The frame's cells of means, and its order. Points in one cell keep the source's order.
  void order_frame(Frame& f, FrameCodes& codes) {
    const ArchiveParameters& p = tables_.parameters;
    std::vector<GridPoint> points(f.count);
    for (std::size_t i = 0; i < f.count; ++i) {
      for (std::size_t k = 0; k < 3; ++k) {
        points[i][k] = grid_coordinate(p, k, splats_.mean[3 * (f.first + i) + k]);
      }
    }
    if (pages_ != nullptr) {
      f.corner = points[0];
      for (const GridPoint& point : points) {
        for (std::size_t k = 0; k < 3; ++k) f.corner[k] = std::min(f.corner[k], point[k]);
      }
    }
    codes.bits = {};
    for (GridPoint& point : points) {
      for (std::size_t k = 0; k < 3; ++k) {
        point[k] -= f.corner[k];
        codes.bits[k] = std::max(codes.bits[k], static_cast<std::uint8_t>(std::bit_width(point[k])));
      }
    }
    std::vector<std::uint32_t> order(f.count);
    std::iota(order.begin(), order.end(), 0u);
    std::ranges::stable_sort(order, [&](std::uint32_t a, std::uint32_t b) { return tree_less(points[a], points[b]); });
    codes.shapes.resize(f.count, static_cast<int>(f.level));
    codes.cells.resize(f.count);
    for (std::size_t i = 0; i < f.count; ++i) {
      order_[f.first + i] = static_cast<std::uint32_t>(f.first + order[i]);
      codes.cells[i] = points[order[i]];
      for (std::size_t k = 0; k < 3; ++k) codes.shapes.points[i][k] = codes.cells[i][k] + f.corner[k];
    }
    codes.shapes.find_distances(p);
  }

  // ---- codes -------------------------------------------------------------------------------------------------------

  static tl::unexpected<Error> too_large(std::uint64_t index) {
    return make_error(Errc::bad_value, Error::kNone,
                      "a Gaussian's SH is too large for archive, or it is too long and thin: raise --archive-step, use "
                      "--profile packed, or drop it",
                      Error::kNone, index);
  }

  // The nearest code, if it is in range.
  static bool code_of(double value, std::int16_t& code) {
    const double rounded = std::nearbyint(value);
    if (!(std::abs(rounded) <= 32767)) return false;
    code = static_cast<std::int16_t>(rounded);
    return true;
  }

  // All codes of a frame: the same whenever it is called.
  Status quantise(Frame& f, FrameCodes& codes) {
    order_frame(f, codes);
    quantise_shapes(f, codes.shapes);
    codes.colours.resize(f.count, tables_.n_sh);
    codes.colours.classes = codes.shapes.classes;
    ColourState state;
    for (std::size_t i = 0; i < f.count; ++i) {
      const std::uint32_t source = order_[f.first + i];
      const Splat s = splats_.splat(source);
      const ArchiveClass& c = tables_.parameters.classes[codes.colours.classes[i]];
      const float share = pass_on(state, codes.shapes, i);
      if (!quantise_dc(s, c, i, state, codes.colours) || !quantise_sh(s, c, i, share, state, codes.colours))
        return too_large(source);
    }
    return {};
  }

  // Of the 24 pairs of a rotation and an order of axes that are the same Gaussian, the one that turns least.
  void least_turn(const Splat& s, Quaternion& q, double log2_scale[3]) const {
    double squared = 0;
    for (const float x : s.rotation) squared += static_cast<double>(x) * static_cast<double>(x);
    Quaternion given;
    for (std::size_t k = 0; k < 4; ++k) given[k] = static_cast<double>(s.rotation[k]) / std::sqrt(squared);
    const CubeRotation* best = nullptr;
    double most = -1;
    for (const CubeRotation& g : cube_rotations_) {
      const auto& r = g.rotation;
      const double w = std::abs(given[0] * r[0] - given[1] * r[1] - given[2] * r[2] - given[3] * r[3]);
      if (w > most) most = w, best = &g;
    }
    q = product(given, best->rotation);
    if (q[0] < 0) {
      for (double& x : q) x = -x;
    }
    for (std::size_t k = 0; k < 3; ++k) {
      log2_scale[k] = static_cast<double>(s.log_scale[best->axes[k]]) * std::numbers::log2e;
    }
  }

  static std::int16_t limited_code(double value) {
    return static_cast<std::int16_t>(std::clamp(std::nearbyint(value), -32767.0, 32767.0));
  }

  void quantise_shapes(Frame& f, ShapeCodes& codes) {
    const ArchiveParameters& p = tables_.parameters;
    const ShapeParameters& shape = p.shape;
    const std::size_t n = f.count;
    std::vector<Quaternion> rotations(n);
    std::vector<double> blurred(3 * n);
    const double blur = codes.blur(shape), blurred_square = power_of_octaves(2 * codes.blur(shape));
    for (std::size_t i = 0; i < n; ++i) {
      const Splat s = splats_.splat(order_[f.first + i]);
      const double root = std::sqrt(1 / (1 + std::exp(-static_cast<double>(s.opacity_logit))));
      codes.opacity[i] = static_cast<std::uint16_t>(std::nearbyint(root * p.opacity_levels));
      double scale[3];
      least_turn(s, rotations[i], scale);
      for (std::size_t k = 0; k < 3; ++k) {
        const double square = std::exp2(2 * scale[k]) / codes.distance[i] + blurred_square;
        double& h = blurred[k * n + i] = kOctave * std::log2(square) / 2;
        codes.coarse[k * n + i] = limited_code((h - blur) / shape.coarse_step);
      }
    }
    codes.find_fine_steps(tables_);
    for (std::size_t i = 0; i < n; ++i) {
      const std::int32_t step = step_of(codes.fine_step[i] + kLeastStep);
      for (std::size_t k = 0; k < 3; ++k) {
        const double rest =
            blurred[k * n + i] - blur - static_cast<double>(shape.coarse_step) * codes.coarse[k * n + i];
        codes.fine[k * n + i] = step < shape.coarse_step ? limited_code(rest / step) : std::int16_t{0};
      }
    }
    codes.find_turn_steps(tables_);
    for (std::size_t i = 0; i < n; ++i) {
      double shows[3], step[3];
      bool coded[3];
      std::int16_t turn[3];
      for (std::size_t k = 0; k < 3; ++k) {
        const std::int32_t index = codes.turn_step[k * n + i] + kLeastStep;
        shows[k] = std::max(
            turn_sensitivity(codes.variance[(k + 1) % 3 * n + i], codes.variance[(k + 2) % 3 * n + i], blurred_square),
            1e-9);
        step[k] = step_of(index) / static_cast<double>(kOctave);
        coded[k] = index < kMostTurn;
      }
      turn_codes(rotations[i], shows, step, coded, turn);
      for (std::size_t k = 0; k < 3; ++k) codes.turn[k * n + i] = turn[k];
    }
    codes.find_refinement(p);
    for (std::size_t i = 0; i < n; ++i) {
      const std::uint32_t source = order_[f.first + i];
      for (std::size_t k = 0; k < 3; ++k) {
        const std::size_t at = k * n + i;
        const double place = (static_cast<double>(splats_.mean[3 * source + k]) - p.centre[k]) / p.half_width[k];
        const GridCell cell = grid_cell_of(codes.points[i][k], p.mean_bits, p.mean_cells);
        const double from = grid_place(cell, p.mean_cells, 0), to = grid_place(cell, p.mean_cells, 1);
        const int parts = 1 << codes.refinement_bits[at];
        const double part = std::floor((place - from) / (to - from) * parts);
        codes.refinement[at] = static_cast<std::uint16_t>(std::clamp(part, 0.0, parts - 1.0));
        f.min_scale = std::min(f.min_scale, codes.scale(k, i));
        f.max_scale = std::max(f.max_scale, codes.scale(k, i));
      }
    }
  }

  // What goes from a Gaussian to the next while a frame's SH becomes codes.
  struct ColourState {
    std::int64_t dc[3] = {};
    std::int32_t sh[kShMaxCodes] = {};
    float error[kShMaxCodes] = {};  // of SH above degree 0: what rounding has left, in units
    float seen = 0;                 // opacity times area
  };

  // Rounding errors of neighbours cancel where they are seen together: a part of each goes into the next. More would cost
  // more bytes than it saves (docs/records/EXPERIMENTS.md).
  static constexpr float kPassedOn = 0.3f;

  // The share of the last Gaussian's errors that the next makes up for.
  static float pass_on(ColourState& state, const ShapeCodes& shapes, std::size_t i) {
    const auto seen = static_cast<float>(power_of_octaves(shapes.importance[i] - shapes.opacity_octaves[i]));
    const float share = kPassedOn * std::min(1.f, state.seen / seen);
    state.seen = seen;
    return share;
  }

  bool quantise_dc(const Splat& s, const ArchiveClass& c, std::size_t i, ColourState& state, ColourCodes& codes) {
    for (std::size_t m = 0; m < 3; ++m) {
      double y = 0;
      for (std::size_t j = 0; j < 3; ++j) {
        y += tables_.dc_matrix[3 * j + m] * static_cast<double>(s.sh[j] - tables_.dc_centre[j]);
      }
      y *= 65536 >> kMatrixBits;
      if (!(std::abs(y) < 0x1p29)) return false;
      const std::int64_t expected = (state.dc[m] + 128) >> 8;
      std::int16_t& code = codes.dc[m * codes.n + i];
      if (!code_of((y - static_cast<double>(expected)) / c.dc_step, code)) return false;
      state.dc[m] = smoothed_dc_state(std::int64_t{code} * c.dc_step + expected, state.dc[m],
                                      tables_.dc_smoothing.recent, tables_.dc_smoothing.kept);
    }
    return true;
  }

  bool quantise_sh(const Splat& s, const ArchiveClass& c, std::size_t i, float share, ColourState& state,
                   ColourCodes& codes) {
    const std::size_t n = tables_.n_sh;
    float y[kShMaxCodes] = {};
    for (std::size_t q = 0; q < n; ++q) {
      const float x = s.sh[3 + q] - tables_.sh_centre[q];
      const std::int16_t* row = &tables_.sh_matrix[q * n];
      for (std::size_t k = 0; k < n; ++k) y[k] += x * static_cast<float>(row[k]);
    }
    const float per_unit = 0x1p-14f / tables_.sh_unit;
    const auto step = static_cast<std::int32_t>(c.sh_units);
    double size = 0;
    for (std::size_t k = 0; k < n; ++k) {
      const float wanted = y[k] * per_unit + share * state.error[k];
      if (!(std::abs(wanted) <= 32000)) return false;
      // No dead zone: it costs more than it saves compared with a larger step (docs/records/EXPERIMENTS.md).
      const auto expected = static_cast<float>((state.sh[k] + 128) >> 8);
      std::int16_t& code = codes.sh[k * codes.n + i];
      if (!code_of(static_cast<double>((wanted - expected) / static_cast<float>(step)), code)) return false;
      const std::int32_t value = smoothed_value(code, step, state.sh[k]);
      state.error[k] = wanted - static_cast<float>(value);
      state.sh[k] = smoothed_state(value, state.sh[k], tables_.sh_smoothing.recent, tables_.sh_smoothing.kept);
      size += static_cast<double>(value) * static_cast<double>(value);
    }
    // Rows of the matrix are nearly unit vectors, so no sum of the inverse exceeds 32 bits.
    return size < 0x1p32;
  }

  // ---- tables and streams --------------------------------------------------------------------------------------------

  // Distributions, from the codes of all frames.
  Status count_codes() {
    const unsigned n_workers = worker_count(frames_.size(), n_threads());
    std::vector<RansCounter> counters(n_workers, RansCounter(tables_.contexts().count));
    std::vector<FrameCodes> codes(n_workers);
    const Status done = run_jobs(frames_.size(), n_workers, [&](unsigned worker, std::uint64_t i) -> Status {
      FrameCodes& c = codes[worker];
      if (Status s = quantise(frames_[i], c); !s) return s;
      c.tree.walk(c.cells, c.bits, counters[worker]);
      walk_shapes(c.shapes, tables_, counters[worker]);
      walk_sh(c.colours, tables_, c.sizes, counters[worker]);
      return {};
    });
    if (!done) return done;
    std::vector<std::uint32_t>& counts = counters[0].counts();
    for (unsigned w = 1; w < n_workers; ++w) {
      std::ranges::transform(counts, counters[w].counts(), counts.begin(), std::plus<>());
    }
    fit_distributions(counts, tables_);
    return {};
  }

  void write_streams(Frame& f, FrameCodes& c) {
    RansWriter writer(tables_.frequencies, tables_.map);
    for (const std::uint8_t bits : c.bits) f.means.push_back(std::byte{bits});
    f.means.push_back(std::byte{0});
    const auto append = [](std::vector<std::byte>& to, const std::vector<std::byte>& stream) {
      to.reserve(to.size() + stream.size());
      to.insert(to.end(), stream.begin(), stream.end());
    };
    c.tree.walk(c.cells, c.bits, writer);
    if (pages_ == nullptr) append(f.means, writer.finish());
    walk_shapes(c.shapes, tables_, writer);
    if (pages_ == nullptr) f.geometry = writer.finish();
    walk_sh(c.colours, tables_, c.sizes, writer);
    append(pages_ == nullptr ? f.sh : f.means, writer.finish());
  }

  // ---- rows --------------------------------------------------------------------------------------------------------

  void choose_exponents() {
    const auto exponent = [](float low, float high) {
      return static_cast<std::int16_t>(choose_scale_exponent(low, high));
    };
    float low = std::numeric_limits<float>::max(), high = 0;
    for (const Frame& f : frames_) {
      if (f.level != 0) continue;
      low = std::min(low, f.min_scale);
      high = std::max(high, f.max_scale);
    }
    plan_.header.scale_exponent = exponent(low, high);
    for (Frame& f : frames_) {
      f.scale_exponent = f.level == 0 ? plan_.header.scale_exponent : exponent(f.min_scale, f.max_scale);
    }
  }

  // Streams and rows of all frames.
  Status encode_frames() {
    const std::size_t n_classes = tables_.parameters.classes.size();
    if (pages_ == nullptr) {
      scene_.chunks.resize(plan_.header.n_chunks);
      scene_.steps.resize(plan_.header.n_chunks);
    }
    const unsigned n_workers = worker_count(frames_.size(), n_threads());
    std::vector<ErrorMaxima> errors(n_workers, ErrorMaxima(n_classes));
    std::vector<Totals> totals(n_workers);
    std::vector<FrameCodes> codes(n_workers);
    const std::vector<std::int16_t> matrix = paired_matrix(tables_);
    const Status done = run_jobs(frames_.size(), n_workers, [&](unsigned worker, std::uint64_t i) {
      Frame& f = frames_[i];
      if (Status s = quantise(f, codes[worker]); !s) return s;
      write_streams(f, codes[worker]);
      return reconstruct_frame(f, codes[worker], matrix, errors[worker], totals[worker]);
    });
    if (!done) return done;
    for (unsigned w = 1; w < n_workers; ++w) {
      errors[0].merge(errors[w]);
      totals[0].scan.merge(totals[w].scan);
      totals[0].counts.add(totals[w].counts);
      totals[0].magnitudes.merge(totals[w].magnitudes);
      totals[0].sources.merge(totals[w].sources);
    }
    errors[0].state(tables_.parameters);
    scene_.counts = totals[0].counts;
    plan_.declarations.full = totals[0].scan.full();
    plan_.declarations.robust = totals[0].scan.robust();
    plan_.file_steps = totals[0].magnitudes.steps();
    if (!steps_explain_bounds(largest_of(totals[0].sources.max_abs()))) {
      return make_error(Errc::internal, Error::kNone, "an archive's errors are larger than its steps explain");
    }
    return {};
  }

  // The stated bounds are measured; checking them against half a step, and what a Gaussian of any class passes on, catches
  // mistakes in what is measured.
  bool steps_explain_bounds(float largest_sh) const {
    const ArchiveParameters& p = tables_.parameters;
    const auto coarsest = std::ranges::max(p.classes, {}, &ArchiveClass::sh_step).sh_step;
    const double passed_on = static_cast<double>(kPassedOn * coarsest) / 2;
    // Matrices have 14 bits.
    const double rounding = static_cast<double>(std::max(largest_sh, 1.f)) * 0x1p-11, side = std::sqrt(0.75);
    bool explained = p.bound_opacity <= 0.5 / p.opacity_levels + 0x1p-11;
    for (const ArchiveClass& c : p.classes) {
      explained = explained && c.bound_dc <= c.dc_step / 65536.0 * side + rounding &&
                  c.bound_sh <=
                      (static_cast<double>(c.sh_step) / 2 + passed_on) * std::sqrt(static_cast<double>(tables_.n_sh)) +
                          rounding;
    }
    return explained;
  }

  Status reconstruct_frame(Frame& f, FrameCodes& codes, std::span<const std::int16_t> matrix, ErrorMaxima& errors,
                           Totals& totals) {
    std::vector<std::int32_t> dc;
    dc_values(tables_, codes.colours, dc);
    smooth_sh(tables_, codes.colours);
    const auto block = std::make_unique<ShBlock>();
    std::vector<StoredSplat> stored(plan_.header.chunk_size);
    std::vector<float> means(3 * f.count);
    std::vector<std::uint16_t> geometry(8 * f.count);
    codes.shapes.write_rows(tables_, f.scale_exponent, means.data(), geometry.data());
    ExtentBox extent;
    ShMagnitudes of_frame;
    for (std::uint64_t at = 0; at < f.count; at += plan_.header.chunk_size) {
      const std::uint64_t count = std::min<std::uint64_t>(plan_.header.chunk_size, f.count - at);
      for (std::size_t first = 0; first < count; first += kShLanes) {
        const std::size_t lanes = std::min<std::size_t>(kShLanes, count - first);
        sh_block(tables_, matrix, codes.colours, dc, at + first, lanes, *block);
        for (std::size_t i = 0; i < lanes; ++i) {
          for (std::size_t k = 0; k < 3 + tables_.n_sh; ++k) stored[first + i].sh[k] = block->value[k][i];
        }
      }
      for (std::size_t i = 0; i < count; ++i) {
        std::copy_n(&means[3 * (at + i)], 3, stored[i].mean);
        std::copy_n(&geometry[8 * (at + i)], 8, stored[i].geometry);
        const std::uint32_t source = order_[f.first + at + i];
        const Splat splat = splats_.splat(source);
        totals.sources.add(splat.sh, degree_);
        const SplatErrors e =
            splat_errors(tables_.parameters, f.scale_exponent, codes.shapes.level, degree_, splat, stored[i]);
        // Turned by the least step, something that long and thin is nowhere near where it was.
        if (!(std::max(e.mean, e.covariance) <= std::numeric_limits<float>::max())) return too_large(source);
        errors.add(codes.colours.classes[at + i], e);
        if (f.level == 0) {
          Splat decoded;
          std::ranges::copy(stored[i].mean, decoded.mean);
          totals.scan.add(decoded);
        }
        if (pages_ == nullptr) continue;
        extent.add(extent_of(reinterpret_cast<const std::byte*>(stored[i].mean),
                             reinterpret_cast<const std::byte*>(stored[i].geometry), f.scale_exponent));
        if (f.level == 0) totals.counts.add(stored[i].geometry);
      }
      if (pages_ == nullptr) {
        describe_chunk((f.first + at) / plan_.header.chunk_size, std::span(stored).first(count), totals.counts,
                       of_frame);
      }
    }
    if (pages_ != nullptr) {
      f.extent = extent.box();
    } else {
      share_steps(f, of_frame.steps());
      totals.magnitudes.merge(of_frame);
    }
    return {};
  }

  // Entry and SH steps of a chunk, from its decoded Gaussians.
  void describe_chunk(std::uint64_t index, std::span<const StoredSplat> splats, ValueCounts& counts,
                      ShMagnitudes& of_frame) {
    ChunkSummary summary;
    ShMagnitudes magnitudes;
    for (const StoredSplat& s : splats) {
      summary.add(s.mean, s.geometry, counts);
      magnitudes.add(s.sh, degree_);
    }
    scene_.chunks[index] = summary.entry(plan_.header.scale_exponent);
    scene_.steps[index] = magnitudes.steps();
    of_frame.merge(magnitudes);
  }

  // Above degree 0 a frame's chunks share their steps, which are far below those of archives: sets of its own for each
  // would cost more bytes than they show.
  void share_steps(const Frame& f, const ShStepSet& steps) {
    const std::uint32_t chunk = plan_.header.chunk_size;
    for (std::uint64_t i = f.first / chunk; i < chunks_of(f.first + f.count, chunk); ++i) {
      std::copy(steps.step[1], std::end(steps.step[3]), scene_.steps[i].step[1]);
    }
  }

  Result<WrittenScene> assemble(std::vector<std::byte>& bytes, std::span<const std::uint32_t> source_index) {
    const std::vector<std::byte> parameters = write_archive_tables(tables_);
    std::vector<std::uint32_t> permutation(order_.size());
    std::ranges::transform(order_, permutation.begin(), [&](std::uint32_t i) { return source_index[i]; });
    scene_.archive = parameters;
    scene_.source_index = permutation;

    const auto stream = [](Frame& f, SectionType type) -> std::vector<std::byte>& {
      return type == SectionType::means ? f.means : type == SectionType::geometry ? f.geometry : f.sh;
    };
    for (SectionEntry& entry : plan_.sections) {
      const auto type = static_cast<SectionType>(entry.type);
      if (type == SectionType::archive) entry.stored_bytes = entry.decoded_bytes = parameters.size();
      if (!archive_type(type)) continue;
      entry.stored_bytes = frame_table_bytes(frames_.size());
      for (Frame& f : frames_) entry.stored_bytes += stream(f, type).size();
    }
    SectionWriter file(bytes, plan_.sections, frames_.size());
    bytes.reserve(file.largest_file_bytes());
    for (const SectionType type : {SectionType::means, SectionType::geometry, SectionType::sh}) {
      for (Frame& f : frames_) {
        const std::vector<std::byte> from = std::move(stream(f, type));  // not held twice
        if (Status s = file.grow(type, from, xxh3(from)); !s) return tl::unexpected(s.error());
      }
    }
    return finish_file(file, plan_, scene_);
  }

  // Pages, and the tables outside them that readers cannot compute from decoded rows.
  Result<WrittenScene> assemble_pages(std::vector<std::byte>& bytes, std::span<const std::uint32_t> source_index) {
    LevelsFile file(bytes, plan_, *pages_, write_archive_tables(tables_));
    for (Frame& f : frames_) {
      const auto n_sets = static_cast<std::uint32_t>(chunks_of(f.count, plan_.header.chunk_size));
      const std::vector<std::byte> from = std::move(f.means);  // not held twice
      if (Status s = file.add({from, xxh3(from), n_sets, f.scale_exponent, f.corner, f.extent}); !s)
        return tl::unexpected(s.error());
    }
    Declarations d = plan_.declarations;
    scene_.counts.declare(d);
    std::vector<std::uint32_t> permutation(order_.size() - first_leaf_);
    for (std::size_t i = 0; i < permutation.size(); ++i) {
      permutation[i] = source_index[order_[first_leaf_ + i] - first_leaf_];
    }
    return file.finish(d, positions_in_source(permutation, plan_.options));
  }

  EncodePlan plan_;
  const PageTable* pages_;
  const SplatView& splats_;
  std::uint64_t first_leaf_;
  int degree_;
  ArchiveTables tables_;
  const std::vector<CubeRotation> cube_rotations_ = cube_rotations();
  std::vector<Frame> frames_;
  std::vector<std::uint32_t> order_;  // position in splats_ of each Gaussian of the file
  SceneTables scene_;
};

}  // namespace

namespace detail {

Result<WrittenScene> write_archive(std::vector<std::byte>& file, const EncodePlan& plan, const SplatView& splats,
                                   std::span<const std::uint32_t> source_index) {
  assert(plan.options.profile == Profile::archive && splats.n == plan.header.n_gaussians && splats.n != 0);
  assert(source_index.size() == splats.n && splats.sh_degree == plan.header.sh_degree);
  // Equal Gaussians may compress so well that readers reject the file for its expansion; smaller frames make it larger.
  EncodePlan smaller = plan;
  for (;; smaller.archive_rows /= 8) {
    auto written = Encoder(smaller, splats, nullptr).run(file, source_index);
    if (written || written.error().code != Errc::limit_exceeded) return written;
    if (smaller.frame_rows() == plan.header.chunk_size) {
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "the scene's Gaussians are so alike that readers would reject its archive for its expansion: "
                        "use smaller chunks or profile packed");
    }
  }
}

Result<WrittenScene> write_archive_levels(std::vector<std::byte>& file, const EncodePlan& plan, const SplatView& splats,
                                          const PageTable& table, std::span<const std::uint32_t> source_index) {
  assert(plan.options.profile == Profile::archive && source_index.size() == plan.header.n_gaussians);
  return Encoder(plan, splats, &table).run(file, source_index);
}

}  // namespace detail

}  // namespace rgs
