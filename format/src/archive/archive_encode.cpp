// archive_encode.cpp - encodes Gaussians as a file of Codec::archive, frames side by side on all threads.
//
// Order: Draco decides the order of each frame's means; everything else follows it.
// Fit:   classes, steps, transforms from the whole scene.
// Codes: each frame's attributes on the grids of their classes.
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
  ArchiveOptions o;
  o.mean_cells = 13;
  o.sh_step = 0.24f;
  o.dc_step = 0.30f;
  o.rotation_step = 1.f / 28;
  o.scale_step = 0.35f;
  o.opacity_levels = 32;
  return o;
}

namespace {

using namespace detail;

// Finer classes cost more than their finer steps save: docs/records/EXPERIMENTS.md.
constexpr float kClassOctaves = 2;
constexpr float kLargestSh = 0x1p30f;  // one beyond it would shift the centre of all

// Consecutive Gaussians that are coded together; with levels, a page.
struct Frame {
  std::uint64_t first = 0, count = 0;
  std::uint32_t level = 0;
  std::int16_t scale_exponent = 0;
  GridPoint corner{};                          // of a page
  Box extent;                                  // of a page
  std::vector<std::byte> means, geometry, sh;  // streams
  FrameCodes codes;
  std::int32_t min_octaves = std::numeric_limits<std::int32_t>::max();
  std::int32_t max_octaves = std::numeric_limits<std::int32_t>::min();
};

// One thread's sums over chunks.
struct Totals {
  ValueCounts counts;
  ShMagnitudes magnitudes;
};

// Cell of a mean on one axis, from the centre: the inverse of grid_mean().
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

class Encoder {
 public:
  /// `pages`: of a file with levels, else null.
  Encoder(const EncodePlan& plan, const SplatView& splats, const PageTable* pages)
      : plan_(plan),
        pages_(pages),
        splats_(splats),
        first_leaf_(splats.n - plan.header.n_gaussians),
        degree_(plan.header.sh_degree),
        order_(splats.n),
        means_(3 * splats.n) {
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

  Result<WrittenScene> run(Sink sink, std::span<const std::uint32_t> source_index) {
    // Leaves first: pages above take over their values, and have no position in the source.
    const std::size_t stride = 3 + tables_.n_sh;
    const auto is_huge = [](float x) { return !(std::abs(x) <= kLargestSh); };
    for (const auto& sh : {splats_.sh.subspan(stride * first_leaf_), splats_.sh.first(stride * first_leaf_)}) {
      if (const auto huge = std::ranges::find_if(sh, is_huge); huge != sh.end()) {
        const auto value = static_cast<std::size_t>(&*huge - splats_.sh.data());
        return too_large(name_in_source(source_index, value / stride));
      }
    }
    fit();
    if (Status s = each_frame([this](Frame& f) { return order_frame(f); }); !s) return tl::unexpected(s.error());
    if (Status s = each_frame([this](Frame& f) { return quantise(f); }); !s) {
      s.error().found = name_in_source(source_index, s.error().found);
      return tl::unexpected(s.error());
    }
    fit_tables();
    if (Status s = reconstruct(); !s) return tl::unexpected(s.error());
    std::vector<std::byte> bytes;
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
    if (Status s = sink.write_at(0, bytes); !s) return tl::unexpected(s.error());
    if (Status s = sink.truncate(bytes.size()); !s) return tl::unexpected(s.error());
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

  template <class Job>
  Status each_frame(const Job& job) {
    return run_jobs(frames_.size(), n_threads(), [&](unsigned, std::uint64_t i) { return job(frames_[i]); });
  }

  void fit() {
    ArchiveParameters& p = tables_.parameters;
    Box full = plan_.declarations.full;  // of all levels
    std::vector<float> farther;
    if (pages_ != nullptr) {
      for (std::size_t i = 0; i < splats_.mean.size(); ++i) {
        full.min[i % 3] = std::min(full.min[i % 3], splats_.mean[i]);
        full.max[i % 3] = std::max(full.max[i % 3], splats_.mean[i]);
      }
      // A level has a quarter of the Gaussians with four times the area, and is drawn where that area looks a quarter
      // as large; another half octave, since they only approximate the scene.
      farther.resize(splats_.n);
      for (const Frame& f : frames_) {
        std::fill_n(farther.begin() + static_cast<std::ptrdiff_t>(f.first), f.count,
                    2.5f * static_cast<float>(f.level));
      }
    }
    fit_grid(plan_.declarations.robust, full, p);
    const std::vector<float> seen = importance(splats_, p, farther, first_leaf_);
    classes_ = fit_classes(seen, kClassOctaves);
    fit_steps(plan_.options.archive, splats_, classes_, kClassOctaves, p);
    fit_transforms(leaves(), std::span(seen).subspan(first_leaf_), tables_);
    std::uint64_t largest = 0;
    for (std::size_t i = 0; i < splats_.mean.size(); ++i) {
      const std::int64_t cell = grid_cell(p, i % 3, splats_.mean[i]);
      largest = std::max(largest, static_cast<std::uint64_t>(cell < 0 ? -1 - cell : cell));
    }
    p.mean_bits = static_cast<std::uint32_t>(std::bit_width(largest)) + 1;
  }

  // Draco's stream of the frame's means, and its order. Points in one cell keep the source's order.
  Status order_frame(Frame& f) {
    const ArchiveParameters& p = tables_.parameters;
    std::vector<GridPoint> points(f.count), decoded(f.count);
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
      for (GridPoint& point : points) {
        for (std::size_t k = 0; k < 3; ++k) point[k] -= f.corner[k];
      }
    }
    auto stream = encode_points(points);
    if (!stream) return tl::unexpected(stream.error());
    f.means = std::move(*stream);
    if (Status s = decode_points(f.means, 0, p.mean_bits, decoded); !s) {
      return make_error(Errc::internal, Error::kNone, "Draco does not decode what it has encoded");
    }
    const auto sorted = [](const std::vector<GridPoint>& values) {
      std::vector<std::uint32_t> index(values.size());
      std::iota(index.begin(), index.end(), 0u);
      std::ranges::sort(index, [&values](std::uint32_t a, std::uint32_t b) {
        return values[a] != values[b] ? values[a] < values[b] : a < b;
      });
      return index;
    };
    const std::vector<std::uint32_t> from = sorted(points), to = sorted(decoded);
    for (std::size_t i = 0; i < f.count; ++i) {
      if (points[from[i]] != decoded[to[i]]) {
        return make_error(Errc::internal, Error::kNone, "Draco decodes other points than it encoded");
      }
      order_[f.first + to[i]] = static_cast<std::uint32_t>(f.first + from[i]);
    }
    return {};
  }

  // ---- codes -------------------------------------------------------------------------------------------------------

  static tl::unexpected<Error> too_large(std::uint64_t index) {
    return make_error(
        Errc::bad_value, Error::kNone,
        "a Gaussian's scale or SH is too large for archive: use larger steps, --profile packed, or drop it",
        Error::kNone, index);
  }

  // The nearest code, if it is in range.
  static bool code_of(double value, std::int16_t& code) {
    const double rounded = std::nearbyint(value);
    if (!(std::abs(rounded) <= 32767)) return false;
    code = static_cast<std::int16_t>(rounded);
    return true;
  }

  Status quantise(Frame& f) {
    FrameCodes& codes = f.codes;
    codes.resize(f.count, tables_.n_sh);
    std::int64_t dc_before[3][2] = {};
    for (std::size_t i = 0; i < f.count; ++i) {
      const std::uint32_t source = order_[f.first + i];
      const Splat s = splats_.splat(source);
      const std::size_t index = codes.classes[i] = classes_.of[source];
      const ArchiveClass& c = tables_.parameters.classes[index];
      if (!quantise_geometry(s, c, i, f) || !quantise_dc(s, c, i, dc_before, codes) || !quantise_sh(s, c, i, codes)) {
        return too_large(source);
      }
    }
    return {};
  }

  bool quantise_geometry(const Splat& s, const ArchiveClass& c, std::size_t i, Frame& f) {
    FrameCodes& codes = f.codes;
    const double opacity = 1 / (1 + std::exp(-static_cast<double>(s.opacity_logit)));
    codes.opacity[i] = static_cast<std::uint16_t>(std::nearbyint(opacity * tables_.parameters.opacity_levels));
    double q[4], squared = 0;
    for (int k = 0; k < 4; ++k) squared += static_cast<double>(s.rotation[k]) * static_cast<double>(s.rotation[k]);
    std::size_t largest = 0;
    for (std::size_t k = 0; k < 4; ++k) {
      q[k] = static_cast<double>(s.rotation[k]) / std::sqrt(squared);
      if (std::abs(q[k]) > std::abs(q[largest])) largest = k;
    }
    codes.largest[i] = static_cast<std::uint8_t>(largest);
    const double step = static_cast<double>(c.rotation_step) * (q[largest] < 0 ? -1 : 1);
    for (std::size_t k = 0, j = 0; k < 4; ++k) {
      if (k != largest && !code_of(q[k] / step, codes.rotation[j++ * f.count + i])) return false;
    }
    for (std::size_t k = 0; k < 3; ++k) {
      const double octaves = static_cast<double>(s.log_scale[k]) / std::log(2.0) * 65536;
      std::int16_t& code = codes.scale[k * f.count + i];
      if (!code_of((octaves - c.scale_base) / c.scale_step, code)) return false;
      f.min_octaves = std::min(f.min_octaves, scale_octaves(c, code));
      f.max_octaves = std::max(f.max_octaves, scale_octaves(c, code));
    }
    return true;
  }

  bool quantise_dc(const Splat& s, const ArchiveClass& c, std::size_t i, std::int64_t before[3][2], FrameCodes& codes) {
    for (std::size_t m = 0; m < 3; ++m) {
      double y = 0;
      for (std::size_t j = 0; j < 3; ++j) {
        y += tables_.dc_matrix[3 * j + m] * static_cast<double>(s.sh[j] - tables_.dc_centre[j]);
      }
      const double level = std::nearbyint(y * (65536 >> kMatrixBits) / c.dc_step);
      if (!(std::abs(level) * c.dc_step < 0x1p30)) return false;
      const std::int64_t expected = expected_dc(&tables_.dc_weights[2 * m], before[m][0], before[m][1], c.dc_step);
      if (!code_of(level - static_cast<double>(expected), codes.dc[m * codes.n + i])) return false;
      before[m][1] = before[m][0];
      before[m][0] = static_cast<std::int64_t>(level) * c.dc_step;
    }
    return true;
  }

  bool quantise_sh(const Splat& s, const ArchiveClass& c, std::size_t i, FrameCodes& codes) {
    const std::size_t n = tables_.n_sh;
    float y[45] = {};
    for (std::size_t q = 0; q < n; ++q) {
      const float x = s.sh[3 + q] - tables_.sh_centre[q];
      const std::int16_t* row = &tables_.sh_matrix[q * n];
      for (std::size_t k = 0; k < n; ++k) y[k] += x * static_cast<float>(row[k]);
    }
    const float per_step = 0x1p-14f / c.sh_step;
    double size = 0;
    for (std::size_t k = 0; k < n; ++k) {
      // No dead zone: it costs more than it saves compared with a larger step (docs/records/EXPERIMENTS.md).
      const float level = std::floor(std::abs(y[k]) * per_step + 0.5f);
      if (!(level <= 32767)) return false;
      codes.sh[k * codes.n + i] = static_cast<std::int16_t>(y[k] < 0 ? -level : level);
      size += static_cast<double>(level) * static_cast<double>(level);
    }
    // Rows of the matrix are nearly unit vectors, so no sum of the inverse exceeds 32 bits.
    return size < 0x1p32;
  }

  // ---- tables and streams --------------------------------------------------------------------------------------------

  void fit_tables() {
    const unsigned n_workers = worker_count(frames_.size(), n_threads());
    std::vector<RansCounter> counters(n_workers, RansCounter(tables_.contexts().count));
    std::vector<CodeSizes> sizes(n_workers);
    static_cast<void>(run_jobs(frames_.size(), n_workers, [&](unsigned worker, std::uint64_t i) -> Status {
      walk_geometry(frames_[i].codes, tables_, counters[worker]);
      walk_sh(frames_[i].codes, tables_, sizes[worker], counters[worker]);
      return {};
    }));
    std::vector<std::uint32_t>& counts = counters[0].counts();
    for (unsigned w = 1; w < n_workers; ++w) {
      std::ranges::transform(counts, counters[w].counts(), counts.begin(), std::plus<>());
    }
    fit_distributions(counts, tables_);
    static_cast<void>(run_jobs(frames_.size(), n_workers, [&](unsigned worker, std::uint64_t i) -> Status {
      RansWriter writer(tables_.frequencies, tables_.map);
      walk_geometry(frames_[i].codes, tables_, writer);
      frames_[i].geometry = writer.finish();
      walk_sh(frames_[i].codes, tables_, sizes[worker], writer);
      frames_[i].sh = writer.finish();
      return {};
    }));
  }

  // ---- rows --------------------------------------------------------------------------------------------------------

  void choose_exponents() {
    const auto scale = [](std::int32_t octaves) {
      const OctaveScale s = scale_of_octaves(octaves);
      return static_cast<float>(std::ldexp(static_cast<double>(s.significand), s.exponent));
    };
    const auto exponent = [&scale](std::int32_t low, std::int32_t high) {
      return static_cast<std::int16_t>(choose_scale_exponent(scale(low), scale(high)));
    };
    std::int32_t low = std::numeric_limits<std::int32_t>::max(), high = std::numeric_limits<std::int32_t>::min();
    for (const Frame& f : frames_) {
      if (f.level != 0) continue;
      low = std::min(low, f.min_octaves);
      high = std::max(high, f.max_octaves);
    }
    plan_.header.scale_exponent = exponent(low, high);
    for (Frame& f : frames_) {
      f.scale_exponent = f.level == 0 ? plan_.header.scale_exponent : exponent(f.min_octaves, f.max_octaves);
    }
  }

  Status reconstruct() {
    choose_exponents();
    const std::size_t n_classes = tables_.parameters.classes.size();
    if (pages_ == nullptr) {
      scene_.chunks.resize(plan_.header.n_chunks);
      scene_.steps.resize(plan_.header.n_chunks);
    }
    const unsigned n_workers = worker_count(frames_.size(), n_threads());
    std::vector<ErrorMaxima> errors(n_workers, ErrorMaxima(n_classes));
    std::vector<Totals> totals(n_workers);
    const std::vector<std::int16_t> matrix = paired_matrix(tables_);
    const Status done = run_jobs(frames_.size(), n_workers, [&](unsigned worker, std::uint64_t i) {
      return reconstruct_frame(frames_[i], matrix, errors[worker], totals[worker]);
    });
    if (!done) return done;
    for (unsigned w = 1; w < n_workers; ++w) {
      errors[0].merge(errors[w]);
      totals[0].counts.add(totals[w].counts);
      totals[0].magnitudes.merge(totals[w].magnitudes);
    }
    errors[0].state(tables_.parameters);
    scene_.counts = totals[0].counts;
    plan_.file_steps = totals[0].magnitudes.steps();
    if (!steps_explain_bounds()) {
      return make_error(Errc::internal, Error::kNone, "an archive's errors are larger than its steps explain");
    }
    return {};
  }

  // The stated bounds are measured; checking them against half a step catches mistakes in what is measured.
  bool steps_explain_bounds() const {
    const ArchiveParameters& p = tables_.parameters;
    float largest_sh = 1;
    for (const float x : splats_.sh) largest_sh = std::max(largest_sh, std::abs(x));
    const double rounding = static_cast<double>(largest_sh) * 0x1p-11;  // matrices have 14 bits
    // Half a cell, plus rounding to FP32 far from the origin or very near to it. Twice that at most: the source's mean
    // is an FP32 number, and none is nearer to the rounded value than the one it became.
    const double half_cell = std::ldexp(0.501, -static_cast<int>(p.mean_cells));
    double rounding_mean = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      const double relative = 1 + std::abs(p.centre[k]) / p.half_width[k];
      rounding_mean = std::max(rounding_mean, relative * 0x1p-23 + 0x1p-149 / p.half_width[k]);
    }
    bool explained = p.bound_mean <= half_cell + std::min(half_cell, rounding_mean) &&
                     p.bound_opacity <= 0.5 / p.opacity_levels + 0x1p-11;
    for (const ArchiveClass& c : p.classes) {
      const double side = std::sqrt(0.75), reached = side * (1 + static_cast<double>(c.rotation_step));
      // The smaller components of a unit quaternion have at most the length `side`, where its angle changes fastest.
      const double turned = reached < 1 ? 2 * (std::asin(reached) - std::asin(side)) : std::numbers::pi;
      explained =
          explained && c.bound_rotation <= turned + 0x1p-8 &&
          c.bound_scale <= c.scale_step / 65536.0 * std::numbers::ln2 / 2 + 0x1p-10 &&
          c.bound_dc <= c.dc_step / 65536.0 * side + rounding &&
          c.bound_sh <= static_cast<double>(c.sh_step) / 2 * std::sqrt(static_cast<double>(tables_.n_sh)) + rounding;
    }
    return explained;
  }

  Status reconstruct_frame(Frame& f, std::span<const std::int16_t> matrix, ErrorMaxima& errors, Totals& totals) {
    std::vector<GridPoint> points(f.count);
    if (Status s = decode_points(f.means, 0, tables_.parameters.mean_bits, points); !s) return s;
    std::vector<std::int32_t> dc;
    dc_values(tables_, f.codes, dc);
    const auto block = std::make_unique<ShBlock>();
    std::vector<StoredSplat> stored(plan_.header.chunk_size);
    ExtentBox extent;
    for (std::uint64_t at = 0; at < f.count; at += plan_.header.chunk_size) {
      const std::uint64_t count = std::min<std::uint64_t>(plan_.header.chunk_size, f.count - at);
      for (std::size_t first = 0; first < count; first += kShLanes) {
        const std::size_t lanes = std::min<std::size_t>(kShLanes, count - first);
        sh_block(tables_, matrix, f.codes, dc, at + first, lanes, *block);
        for (std::size_t i = 0; i < lanes; ++i) {
          for (std::size_t k = 0; k < 3 + tables_.n_sh; ++k) stored[first + i].sh[k] = block->value[k][i];
        }
      }
      for (std::size_t i = 0; i < count; ++i) {
        for (std::size_t k = 0; k < 3; ++k) {
          stored[i].mean[k] = grid_mean(tables_.parameters, k, points[at + i][k] + f.corner[k]);
          means_[3 * (f.first + at + i) + k] = stored[i].mean[k];
        }
        geometry_row(tables_.parameters, f.codes, at + i, f.scale_exponent, stored[i].geometry);
        errors.add(f.codes.classes[at + i], splat_errors(tables_.parameters, f.scale_exponent, degree_,
                                                         splats_.splat(order_[f.first + at + i]), stored[i]));
        if (pages_ == nullptr) continue;
        extent.add(extent_of(reinterpret_cast<const std::byte*>(stored[i].mean),
                             reinterpret_cast<const std::byte*>(stored[i].geometry), f.scale_exponent));
        if (f.level == 0) totals.counts.add(stored[i].geometry);
      }
      if (pages_ == nullptr) {
        describe_chunk((f.first + at) / plan_.header.chunk_size, std::span(stored).first(count), totals);
      }
    }
    if (pages_ != nullptr) f.extent = extent.box();
    return {};
  }

  // Entry and SH steps of a chunk, from its decoded Gaussians.
  void describe_chunk(std::uint64_t index, std::span<const StoredSplat> splats, Totals& totals) {
    ChunkSummary summary;
    ShMagnitudes magnitudes;
    for (const StoredSplat& s : splats) {
      summary.add(s.mean, s.geometry, totals.counts);
      magnitudes.add(s.sh, degree_);
    }
    scene_.chunks[index] = summary.entry(plan_.header.scale_exponent);
    scene_.steps[index] = magnitudes.steps();
    totals.magnitudes.merge(magnitudes);
  }

  // Boxes of the decoded means.
  void describe_scene() {
    SceneScan scan(0);
    for (std::uint64_t i = first_leaf_; i < splats_.n; ++i) {
      Splat splat;
      std::copy_n(&means_[3 * i], 3, splat.mean);
      scan.add(splat);
    }
    plan_.declarations.full = scan.full();
    plan_.declarations.robust = scan.robust();
  }

  Result<WrittenScene> assemble(std::vector<std::byte>& bytes, std::span<const std::uint32_t> source_index) {
    describe_scene();
    const std::vector<std::byte> parameters = write_archive_tables(tables_);
    std::vector<std::uint32_t> permutation(order_.size());
    std::ranges::transform(order_, permutation.begin(), [&](std::uint32_t i) { return source_index[i]; });
    scene_.archive = parameters;
    scene_.source_index = permutation;

    const auto stream = [](const Frame& f, SectionType type) -> std::span<const std::byte> {
      return type == SectionType::means ? f.means : type == SectionType::geometry ? f.geometry : f.sh;
    };
    for (SectionEntry& entry : plan_.sections) {
      const auto type = static_cast<SectionType>(entry.type);
      if (type == SectionType::archive) entry.stored_bytes = entry.decoded_bytes = parameters.size();
      if (!archive_type(type)) continue;
      entry.stored_bytes = frame_table_bytes(frames_.size());
      for (const Frame& f : frames_) entry.stored_bytes += stream(f, type).size();
    }
    SectionWriter file(bytes, plan_.sections, frames_.size());
    for (const SectionType type : {SectionType::means, SectionType::geometry, SectionType::sh}) {
      for (const Frame& f : frames_) {
        if (Status s = file.grow(type, stream(f, type), xxh3(stream(f, type))); !s) return tl::unexpected(s.error());
      }
    }
    return finish_file(file, plan_, scene_);
  }

  // Pages, and the tables outside them that readers cannot compute from decoded rows.
  Result<WrittenScene> assemble_pages(std::vector<std::byte>& bytes, std::span<const std::uint32_t> source_index) {
    describe_scene();
    LevelsFile file(bytes, plan_, *pages_, write_archive_tables(tables_));
    for (const Frame& f : frames_) {
      ByteWriter head;
      head.u32(static_cast<std::uint32_t>(f.means.size()));
      head.u32(static_cast<std::uint32_t>(f.geometry.size()));
      std::vector<std::byte> page = head.take();
      for (const auto* stream : {&f.means, &f.geometry, &f.sh}) page.insert(page.end(), stream->begin(), stream->end());
      const auto n_sets = static_cast<std::uint32_t>(chunks_of(f.count, plan_.header.chunk_size));
      if (Status s = file.add({page, xxh3(page), n_sets, f.scale_exponent, f.corner, f.extent}); !s)
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
  Classes classes_;
  std::vector<Frame> frames_;
  std::vector<std::uint32_t> order_;  // position in splats_ of each Gaussian of the file
  std::vector<float> means_;          // [n, 3] decoded, in file order
  SceneTables scene_;
};

}  // namespace

namespace detail {

Result<WrittenScene> write_archive(Sink sink, const EncodePlan& plan, const SplatView& splats,
                                   std::span<const std::uint32_t> source_index) {
  assert(plan.options.profile == Profile::archive && splats.n == plan.header.n_gaussians && splats.n != 0);
  assert(source_index.size() == splats.n && splats.sh_degree == plan.header.sh_degree);
  // Equal Gaussians may compress so well that readers reject the file for its expansion; smaller frames make it larger.
  EncodePlan smaller = plan;
  for (;; smaller.archive_rows /= 8) {
    auto written = Encoder(smaller, splats, nullptr).run(sink, source_index);
    if (written || written.error().code != Errc::limit_exceeded) return written;
    if (smaller.frame_rows() == plan.header.chunk_size) {
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "the scene's Gaussians are so alike that readers would reject its archive for its expansion: "
                        "use smaller chunks or profile packed");
    }
  }
}

Result<WrittenScene> write_archive_levels(Sink sink, const EncodePlan& plan, const SplatView& splats,
                                          const PageTable& table, std::span<const std::uint32_t> source_index) {
  assert(plan.options.profile == Profile::archive && source_index.size() == plan.header.n_gaussians);
  return Encoder(plan, splats, &table).run(sink, source_index);
}

}  // namespace detail

std::array<float, 3> archive_mean(const ArchiveParameters& p, const float mean[3]) {
  std::array<float, 3> decoded;
  for (std::size_t k = 0; k < 3; ++k) {
    decoded[k] = std::isfinite(mean[k]) ? grid_mean(p, k, grid_coordinate(p, k, mean[k])) : mean[k];
  }
  return decoded;
}

}  // namespace rgs
