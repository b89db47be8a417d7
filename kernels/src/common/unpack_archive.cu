// unpack_archive.cu - decodes frames of Codec::archive to rows of MEAN, GEOM and SHI8; docs/format/ARCHIVE.md.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/archive_formulas.hpp and rgs/shape_formulas.hpp, shared with the host's decoder
// In/Out  streams of a frame -> codes in `memory` -> rows
// Cost    a number of a stream needs the one eight before it, some 80 instructions, and a frame has about 80 a Gaussian, so
//         a frame takes tens of milliseconds on any device, and as many are decoded side by side as `memory` holds
// Launch  codes: a warp a frame, whose first eight lanes have the stream's eight states; all lanes do what is between
//         planes. Smoothing: 64 threads a frame, a plane each. SH: 128 threads, one a Gaussian
// Shared  SH: the matrix, 4 KB at degree 3; all lanes read the same word
// Order   deterministic; no atomics but for the count of damaged frames
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "common/launch.cuh"
#include "common/unpack_archive.hpp"
#include "rgs/shape_formulas.hpp"

namespace rgs::cuda {
namespace {

using namespace rgs::detail;

constexpr std::uint32_t kWarp = 32;
constexpr int kPlaneThreads = 64, kRowThreads = 128;

struct Cell {
  std::uint32_t first, n, low;
  std::uint32_t corner[3];
};

// Codes of a frame: planes of `stride` rows, one after the other.
struct Codes {
  std::uint32_t stride;
  Cell* cells[2];  // [stride / 2] each: a cell has two points or more
  std::uint32_t* point;
  std::int32_t* dc_value;
  std::int16_t *coarse, *fine, *turn, *dc, *sh;
  std::uint16_t *part, *opacity, *history;
  std::uint8_t *left, *part_bits, *turn_step, *fine_step, *classes;
};

// Returns the bytes that `codes` takes at `memory`. Planes start at multiples of 16 bytes.
__host__ __device__ std::uint64_t place_codes(std::byte* memory, std::uint32_t frame_rows, std::uint32_t n_sh,
                                              Codes& codes) {
  codes.stride = (frame_rows + 63) / 64 * 64;
  std::uint64_t at = 0;
  const auto place = [&](auto*& plane, std::uint64_t bytes_a_row) {
    plane = reinterpret_cast<std::decay_t<decltype(plane)>>(memory + at);
    at += bytes_a_row * codes.stride;
  };
  for (Cell*& cells : codes.cells) place(cells, sizeof(Cell) / 2);
  place(codes.point, 12), place(codes.dc_value, 12);
  place(codes.coarse, 6), place(codes.fine, 6), place(codes.turn, 6), place(codes.dc, 6);
  place(codes.sh, std::uint64_t{2} * n_sh);
  place(codes.part, 6), place(codes.opacity, 2), place(codes.history, 2);
  place(codes.left, 3), place(codes.part_bits, 3), place(codes.turn_step, 3);
  place(codes.fine_step, 1), place(codes.classes, 1);
  return at;
}

template <class T>
__device__ const T* array_of(const UnpackArchiveArguments& a, std::uint32_t offset) {
  return reinterpret_cast<const T*>(a.block + offset);
}

// A stream and, in the first eight lanes, its states.
class StreamReader {
 public:
  __device__ explicit StreamReader(const UnpackArchiveArguments& a)
      : distributions_(array_of<ArchiveRules::Distribution>(a, a.rules.distributions)),
        map_(array_of<std::uint8_t>(a, a.rules.map)) {}

  __device__ void begin(const std::byte* bytes, std::uint32_t n_bytes) {
    const bool whole = n_bytes >= kRansStates * sizeof(std::uint32_t) && n_bytes % 2 == 0;
    bad |= !whole;
    const auto* const states = reinterpret_cast<const std::uint32_t*>(bytes);
    x_ = whole && lane < kRansStates ? states[lane] : kRansLow;
    words_ = reinterpret_cast<const std::uint16_t*>(states + kRansStates);
    n_words_ = whole ? n_bytes / 2 - 2 * kRansStates : 0;
    at_ = 0;
  }
  __device__ void end() { bad |= lane < kRansStates && (at_ != n_words_ || x_ != kRansLow); }

  // Passes numbers i < n to put(i, z), each in lane i modulo 32. context(i) may depend on what that stored before.
  template <class Context, class Put>
  __device__ void plane(std::uint32_t n, Context context, Put put) {
    read(
        n, [&](std::uint32_t i) { return std::uint32_t{map_[context(i)]}; },
        [&](std::uint32_t distribution, bool active) {
          const ArchiveRules::Distribution& d = distributions_[distribution];
          const std::uint32_t slot = x_ & (kRansTotal - 1);
          std::uint32_t token = d.first[slot / d.kSlots], frequency = d.frequency[token];
          while (slot - (frequency >> 16) >= (frequency & 0xFFFF)) frequency = d.frequency[++token];
          std::uint32_t x = (frequency & 0xFFFF) * (x_ >> 12) + slot - (frequency >> 16), z = token;
          const bool refills = active && x < kRansLow, has_bits = active && token >= 32;
          const std::uint32_t n_bits = has_bits ? (token - 32) / 4 + 3 : 0;
          const bool again = has_bits && x < (refills ? 1u : kRansLow) << n_bits;
          std::uint32_t at = take(refills, again);
          if (refills) x = x << 16 | word(at++);
          if (has_bits) {
            z = (4 + token % 4) << n_bits | (x & ((1u << n_bits) - 1));
            x >>= n_bits;
            if (again) x = x << 16 | word(at);
          }
          if (active) x_ = x;
          return z;
        },
        put);
  }

  // The same of width(i) bits each, at most 16.
  template <class Width, class Put>
  __device__ void bits(std::uint32_t n, Width width, Put put) {
    read(
        n, width,
        [&](std::uint32_t n_bits, bool active) {
          const std::uint32_t z = x_ & ((1u << n_bits) - 1), x = x_ >> n_bits;
          const bool refills = active && x < kRansLow;
          const std::uint32_t at = take(refills, false);
          if (active) x_ = refills ? x << 16 | word(at) : x;
          return z;
        },
        put);
  }

  const std::uint32_t lane = threadIdx.x;
  bool bad = false;

 private:
  // All lanes ask about 32 numbers, while the first eight find those before, eight at a time.
  template <class Ask, class Number, class Put>
  __device__ void read(std::uint32_t n, Ask ask, Number number, Put put) {
    std::uint32_t next = lane < n ? ask(lane) : 0;
    for (std::uint32_t first = 0; first < n; first += kWarp) {
      const std::uint32_t asked = next, i = first + lane;
      if (i + kWarp < n) next = ask(i + kWarp);  // does not wait for the states
      std::uint32_t mine = 0;
#pragma unroll
      for (std::uint32_t eight = 0; eight < kWarp; eight += kRansStates) {
        const std::uint32_t of_lane = __shfl_sync(~0u, asked, eight + lane % kRansStates);
        const std::uint32_t z = number(of_lane, lane < kRansStates && i + eight < n);
        const std::uint32_t found = __shfl_sync(~0u, z, lane % kRansStates);
        if (lane / kRansStates == eight / kRansStates) mine = found;
      }
      if (i < n) put(i, mine);
    }
    __syncwarp();
  }

  // Of one or two words for some lanes, in their order: the place of this lane's first.
  __device__ std::uint32_t take(bool one, bool another) {
    const std::uint32_t ones = __ballot_sync(~0u, one), others = __ballot_sync(~0u, another);
    const std::uint32_t before = (1u << lane) - 1;
    const std::uint32_t at = at_ + __popc(ones & before) + __popc(others & before);
    at_ += __popc(ones) + __popc(others);
    return at;
  }
  __device__ std::uint32_t word(std::uint32_t at) {
    if (at < n_words_) return words_[at];
    bad = true;
    return 0;
  }

  const ArchiveRules::Distribution* distributions_;
  const std::uint8_t* map_;
  const std::uint16_t* words_ = nullptr;
  std::uint32_t n_words_ = 0;
  std::uint32_t at_ = 0, x_ = kRansLow;
};

// ---- MEAN ----------------------------------------------------------------------------------------------------------

// Halves cells of several points until each point is alone or has all bits of its corner.
class Tree {
 public:
  __device__ Tree(StreamReader& reader, const Codes& codes, std::uint32_t n)
      : reader_(reader), codes_(codes), n_points_(n), lane_(threadIdx.x) {}

  __device__ void points(const std::uint8_t bits[3]) {
    for (int axis = 0; axis < 3; ++axis) left_[axis] = bits[axis];
    if (lane_ == 0) {
      codes_.cells[0][0] = {0, n_points_, 0, {0, 0, 0}};
      if (n_points_ == 1) put_point(0, codes_.cells[0][0].corner, left_);
    }
    n_cells_ = n_points_ > 1 ? 1 : 0;
    __syncwarp();
    for (std::uint32_t bit = max(left_[0], max(left_[1], left_[2])); bit-- > 0;) {
      for (int axis = 0; axis < 3; ++axis) {
        if (bit >= bits[axis]) continue;
        --left_[axis];
        halve(axis, bit);
      }
    }
    const std::uint8_t none[3] = {0, 0, 0};
    for (std::uint32_t c = lane_; c < n_cells_; c += kWarp) {
      const Cell& cell = codes_.cells[now_][c];
      for (std::uint32_t i = 0; i < cell.n; ++i) put_point(cell.first + i, cell.corner, none);
    }
    __syncwarp();
    for (int axis = 0; axis < 3; ++axis) lower_bits(axis);
  }

 private:
  __device__ void put_point(std::uint32_t i, const std::uint32_t corner[3], const std::uint8_t left[3]) {
    for (int axis = 0; axis < 3; ++axis) {
      codes_.point[axis * codes_.stride + i] = corner[axis];
      codes_.left[axis * codes_.stride + i] = left[axis];
    }
  }

  __device__ void halve(int axis, std::uint32_t bit) {
    Cell *const from = codes_.cells[now_], *const to = codes_.cells[now_ ^ 1];
    reader_.plane(
        n_cells_, [&](std::uint32_t c) { return tree_context(from[c].n); },
        [&](std::uint32_t c, std::uint32_t z) {
          const std::uint32_t n = from[c].n, low = n / 2 + static_cast<std::uint32_t>(std::int32_t{unfold_code(z)});
          reader_.bad |= low > n;
          from[c].low = low > n ? 0 : low;
        });
    std::uint32_t n_halves = 0;
    for (std::uint32_t first = 0; first < n_cells_; first += kWarp) {
      Cell low{}, high{};
      if (first + lane_ < n_cells_) {
        const Cell& cell = from[first + lane_];
        low = high = cell;
        low.n = cell.low;
        high.first += cell.low, high.n -= cell.low, high.corner[axis] += 1u << bit;
      }
      const std::uint32_t lows = __ballot_sync(~0u, low.n > 1), highs = __ballot_sync(~0u, high.n > 1);
      const std::uint32_t before = (1u << lane_) - 1;
      std::uint32_t at = n_halves + __popc(lows & before) + __popc(highs & before);
      if (low.n > 1) to[at++] = low;
      if (high.n > 1) to[at] = high;
      if (low.n == 1) put_point(low.first, low.corner, left_);
      if (high.n == 1) put_point(high.first, high.corner, left_);
      n_halves += __popc(lows) + __popc(highs);
    }
    n_cells_ = n_halves;
    now_ ^= 1;
    __syncwarp();
  }

  // The bits below those of the cell in which a point was alone, highest first.
  __device__ void lower_bits(int axis) {
    std::uint8_t* const left = codes_.left + axis * codes_.stride;
    std::uint32_t* const point = codes_.point + axis * codes_.stride;
    for (bool more = true; more;) {
      more = false;
      reader_.bits(
          n_points_, [&](std::uint32_t i) { return min(left[i], kMostRawBits); },
          [&](std::uint32_t i, std::uint32_t z) {
            left[i] -= min(left[i], kMostRawBits);
            point[i] += z << left[i];
            more |= left[i] > 0;
          });
      more = __any_sync(~0u, more);
    }
  }

  StreamReader& reader_;
  const Codes& codes_;
  std::uint32_t n_points_, n_cells_ = 0, lane_;
  int now_ = 0;
  std::uint8_t left_[3];
};

// ---- GEOM ----------------------------------------------------------------------------------------------------------

// What the codes of a row imply, as far as they are known.
struct Shape {
  std::int32_t blurred[3], importance;
  double variance[3], quaternion[4], distance;
};

class Shapes {
 public:
  __device__ Shapes(const UnpackArchiveArguments& a, const Codes& codes)
      : rules_(a.rules),
        codes_(codes),
        opacities_(array_of<std::uint16_t>(a, a.rules.opacities)),
        blur_(power_of_octaves(2 * a.rules.shape.blur)) {}

  __device__ std::uint16_t opacity(std::uint32_t i) const { return opacities_[codes_.opacity[i]]; }
  __device__ std::uint32_t fine_step(std::uint32_t i) const {
    Shape shape;
    find_importance(i, false, shape);
    return index_of(rules_.shape.fine_step - finer(shape), kMostStep);
  }
  __device__ void find_turn_steps(std::uint32_t i) const {
    Shape shape;
    find_importance(i, true, shape);
    find_variance(shape);
    const auto n_classes = static_cast<std::int32_t>(rules_.n_classes);
    const std::int32_t nearest = ((shape.importance - rules_.shape.middle + kOctave / 2) >> 16) + n_classes / 2;
    codes_.classes[i] = static_cast<std::uint8_t>(max(0, min(nearest, n_classes - 1)));
    for (int k = 0; k < 3; ++k) {
      const std::int32_t shows = turn_octaves(shape.variance[(k + 1) % 3], shape.variance[(k + 2) % 3], blur_);
      codes_.turn_step[k * codes_.stride + i] =
          static_cast<std::uint8_t>(index_of(rules_.shape.turn_step - finer(shape) - (shows >> 1), kMostTurn));
    }
  }
  // Everything of a row but the parts of its cells.
  __device__ Shape whole(std::uint32_t i) const {
    Shape shape;
    find_importance(i, true, shape);
    find_variance(shape);
    double r[3];
    for (int k = 0; k < 3; ++k) {
      const std::uint32_t at = k * codes_.stride + i;
      r[k] = codes_.turn[at] * (step_of(codes_.turn_step[at] + kLeastStep) * 0x1p-16);
    }
    quaternion_of(r[0], r[1], r[2], shape.quaternion);
    double squared = 0;
    for (int k = 0; k < 3; ++k) {
      const double x = rules_.half_width[k] * grid_place(cell(k, i), rules_.mean_cells, 0.5);
      squared += x * x;
    }
    shape.distance = squared < rules_.shape.nearest ? rules_.shape.nearest : squared;
    return shape;
  }
  __device__ void find_part_bits(std::uint32_t i) const {
    const Shape shape = whole(i);
    double precision[3];
    world_precision(shape.quaternion, shape.variance, blur_, precision);
    const std::int32_t step = rules_.shape.mean_step - finer(shape) + (octaves_of(shape.distance) >> 1);
    for (int k = 0; k < 3; ++k) {
      const std::int32_t octave = cell(k, i).octave, cells = static_cast<std::int32_t>(rules_.mean_cells);
      const std::int32_t octaves = octaves_of(rules_.half_width[k]) + ((octave > 1 ? octave - 1 : 0) - cells) * kOctave;
      codes_.part_bits[k * codes_.stride + i] =
          static_cast<std::uint8_t>(refinement_bits(octaves, step - (octaves_of(precision[k]) >> 1)));
    }
  }
  __device__ void write_row(std::uint32_t i, int scale_exponent, float* mean, std::uint16_t* geometry) const {
    const Shape shape = whole(i);
    for (int k = 0; k < 3; ++k) {
      const std::uint32_t at = k * codes_.stride + i;
      const double part = (codes_.part[at] + 0.5) * power_of_two(-std::int32_t{codes_.part_bits[at]});
      mean[k] = limited_mean(rules_.centre[k] + rules_.half_width[k] * grid_place(cell(k, i), rules_.mean_cells, part));
    }
    std::uint16_t row[8];
    for (int k = 0; k < 4; ++k) row[k] = geometry_half(k, static_cast<float>(shape.quaternion[k]));
    for (int k = 0; k < 3; ++k) {
      const double scale = std::sqrt(shape.variance[k] * shape.distance) * power_of_two(scale_exponent);
      row[4 + k] = geometry_half(4 + k, static_cast<float>(scale));
    }
    row[7] = opacity(i);
    const auto pair = [&row](int k) { return static_cast<std::uint32_t>(row[k] | row[k + 1] << 16); };
    *reinterpret_cast<uint4*>(geometry) = make_uint4(pair(0), pair(2), pair(4), pair(6));
  }

 private:
  __device__ GridCell cell(int k, std::uint32_t i) const {
    return grid_cell_of(codes_.point[k * codes_.stride + i], rules_.mean_bits, rules_.mean_cells);
  }
  __device__ static std::uint32_t index_of(std::int32_t octaves, std::int32_t most) {
    return static_cast<std::uint32_t>(step_index(octaves, most) - kLeastStep);
  }
  __device__ std::int32_t finer(const Shape& shape) const {
    return finer_by(rules_.shape.slope, shape.importance, rules_.shape.middle);
  }
  __device__ void find_importance(std::uint32_t i, bool has_fine, Shape& shape) const {
    const std::int32_t step = has_fine ? step_of(codes_.fine_step[i] + kLeastStep) : 0;
    for (int k = 0; k < 3; ++k) {
      const std::uint32_t at = k * codes_.stride + i;
      shape.blurred[k] = blurred_octaves(rules_.shape.blur, rules_.shape.coarse_step, codes_.coarse[at], step,
                                         has_fine ? codes_.fine[at] : std::int16_t{0});
    }
    const std::int32_t octaves = octaves_of(static_cast<double>(float_from_half(opacity(i))));
    shape.importance = importance_of(octaves, shape.blurred, 0);
  }
  __device__ void find_variance(Shape& shape) const {
    for (int k = 0; k < 3; ++k) shape.variance[k] = variance_of(shape.blurred[k], blur_);
  }

  const ArchiveRules& rules_;
  const Codes& codes_;
  const std::uint16_t* opacities_;
  double blur_;
};

__device__ void read_shapes(StreamReader& reader, const ArchiveRules& rules, const Codes& codes, const Shapes& shapes,
                            std::uint32_t n) {
  const std::uint32_t stride = codes.stride, levels = rules.opacity_levels;
  const auto seen = [&](std::uint32_t i) { return codes.opacity[i] * 16u / (levels + 1); };
  const auto bucket = [&](int k, std::uint32_t i) {
    return static_cast<std::uint32_t>(max(0, min(std::int32_t{codes.coarse[k * stride + i]}, 15)));
  };
  const auto put_to = [](std::int16_t* plane) {
    return [plane](std::uint32_t i, std::uint32_t z) { plane[i] = unfold_code(z); };
  };
  reader.plane(
      n, [&](std::uint32_t) { return rules.context.opacity; },
      [&](std::uint32_t i, std::uint32_t z) {
        reader.bad |= z > levels;
        codes.opacity[i] = static_cast<std::uint16_t>(z > levels ? 0 : z);
      });
  const std::uint32_t coarse = rules.context.coarse;
  reader.plane(
      n, [&](std::uint32_t i) { return coarse + seen(i); }, put_to(codes.coarse));
  reader.plane(
      n, [&](std::uint32_t i) { return coarse + 16 + seen(i) * 16 + bucket(0, i); }, put_to(codes.coarse + stride));
  reader.plane(
      n, [&](std::uint32_t i) { return coarse + 272 + (seen(i) * 16 + bucket(0, i)) * 16 + bucket(1, i); },
      put_to(codes.coarse + 2 * stride));
  const auto each_row = [&](auto&& what) {
    for (std::uint32_t i = threadIdx.x; i < n; i += kWarp) what(i);
    __syncwarp();
  };
  each_row([&](std::uint32_t i) { codes.fine_step[i] = static_cast<std::uint8_t>(shapes.fine_step(i)); });
  for (std::uint32_t k = 0; k < 3; ++k) {
    reader.plane(
        n, [&](std::uint32_t i) { return rules.context.fine + k * kStepContexts + codes.fine_step[i]; },
        put_to(codes.fine + k * stride));
  }
  each_row([&](std::uint32_t i) { shapes.find_turn_steps(i); });
  for (std::uint32_t k = 0; k < 3; ++k) {
    reader.plane(
        n, [&](std::uint32_t i) { return rules.context.turn + k * kStepContexts + codes.turn_step[k * stride + i]; },
        put_to(codes.turn + k * stride));
  }
  each_row([&](std::uint32_t i) { shapes.find_part_bits(i); });
  for (std::uint32_t k = 0; k < 3; ++k) {
    reader.bits(
        n, [&](std::uint32_t i) { return codes.part_bits[k * stride + i]; },
        [&](std::uint32_t i, std::uint32_t z) { codes.part[k * stride + i] = static_cast<std::uint16_t>(z); });
  }
}

// ---- SHI8 ----------------------------------------------------------------------------------------------------------

__device__ void read_colours(StreamReader& reader, const ArchiveRules& rules, const Codes& codes, std::uint32_t n) {
  const auto planes = [&](std::int16_t* to, std::uint32_t count, std::uint32_t first_context) {
    for (std::uint32_t k = 0; k < count; ++k) {
      const auto history = [&](std::uint32_t i) { return k == 0 ? std::uint16_t{0} : codes.history[i]; };
      reader.plane(
          n,
          [&](std::uint32_t i) {
            return first_context + (k * rules.n_classes + codes.classes[i]) * 8 + size_of_history(history(i));
          },
          [&](std::uint32_t i, std::uint32_t z) {
            const std::int16_t code = unfold_code(z);
            to[k * codes.stride + i] = code;
            codes.history[i] = next_history(history(i), code);
          });
    }
  };
  planes(codes.dc, 3, rules.context.dc);
  planes(codes.sh, rules.n_sh, rules.context.sh);
}

__device__ std::uint32_t rows_of(const UnpackArchiveArguments& a, std::uint32_t frame) {
  return min(a.frame_rows, a.n - frame * a.frame_rows);
}

__device__ Codes codes_of(const UnpackArchiveArguments& a) {
  Codes codes;
  const std::uint64_t bytes = place_codes(nullptr, a.frame_rows, a.rules.n_sh, codes);
  place_codes(a.memory + bytes * blockIdx.y, a.frame_rows, a.rules.n_sh, codes);
  return codes;
}

__global__ void __launch_bounds__(kWarp, resident_before_90(1))
    archive_codes_kernel(const __grid_constant__ UnpackArchiveArguments a, std::uint32_t first_frame) {
  const std::uint32_t frame = first_frame + blockIdx.y, n = rows_of(a, frame);
  const ArchiveFrame& streams = a.frames[frame];
  const Codes codes = codes_of(a);
  StreamReader reader(a);

  const std::byte* const means = a.coded + streams.means.at;
  std::uint8_t bits[3] = {0, 0, 0};
  const bool has_bits = streams.means.bytes >= 4;
  for (int axis = 0; has_bits && axis < 3; ++axis) bits[axis] = static_cast<std::uint8_t>(means[axis]);
  const bool legal = has_bits && max(bits[0], max(bits[1], bits[2])) <= a.rules.mean_bits && means[3] == std::byte{0};
  for (std::uint8_t& of_axis : bits) of_axis = legal ? of_axis : 0;
  reader.bad |= !legal;
  reader.begin(means + 4, has_bits ? streams.means.bytes - 4 : 0);
  Tree(reader, codes, n).points(bits);
  reader.end();

  reader.begin(a.coded + streams.geometry.at, streams.geometry.bytes);
  const Shapes shapes(a, codes);
  read_shapes(reader, a.rules, codes, shapes, n);
  reader.end();
  for (std::uint32_t i = threadIdx.x; i < n; i += kWarp) {
    const std::size_t row = std::size_t{frame} * a.frame_rows + i;
    shapes.write_row(i, a.scale_exponent, a.mean + 3 * row, a.geometry + 8 * row);
  }

  reader.begin(a.coded + streams.sh.at, streams.sh.bytes);
  read_colours(reader, a.rules, codes, n);
  reader.end();
  if (__any_sync(~0u, reader.bad) && threadIdx.x == 0) atomicAdd(a.n_damaged, 1u);
}

// Eight rows of a plane at a time; those behind the last are in the plane too.
__global__ void __launch_bounds__(kPlaneThreads)
    archive_smoothing_kernel(const __grid_constant__ UnpackArchiveArguments a, std::uint32_t first_frame) {
  constexpr std::uint32_t kAtOnce = 8;
  const std::uint32_t n = rows_of(a, first_frame + blockIdx.y), plane = threadIdx.x;
  if (plane >= a.rules.n_sh + 3) return;
  const Codes codes = codes_of(a);
  const auto* const of_class = array_of<ArchiveRules::Class>(a, a.rules.classes);
  const auto class_of = [&](uint2 eight, std::uint32_t i) -> const ArchiveRules::Class& {
    const std::uint32_t found = (i < 4 ? eight.x : eight.y) >> 8 * (i % 4) & 0xFF;
    return of_class[min(found, a.rules.n_classes - 1)];  // rows behind the last hold anything
  };
  union Eight {
    uint4 words;
    std::int16_t code[kAtOnce];
  };
  if (plane < a.rules.n_sh) {
    std::int16_t* const values = codes.sh + plane * codes.stride;
    std::int32_t state = 0;
    for (std::uint32_t first = 0; first < n; first += kAtOnce) {
      const uint2 classes = *reinterpret_cast<const uint2*>(codes.classes + first);
      Eight eight{*reinterpret_cast<const uint4*>(values + first)};
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        const std::int32_t value = smoothed_value(eight.code[i], class_of(classes, i).sh_units, state);
        state = smoothed_state(value, state, a.rules.sh_smoothing.recent, a.rules.sh_smoothing.kept);
        eight.code[i] = static_cast<std::int16_t>(value);
      }
      *reinterpret_cast<uint4*>(values + first) = eight.words;
    }
    return;
  }
  const std::int16_t* const dc = codes.dc + (plane - a.rules.n_sh) * codes.stride;
  std::int32_t* const values = codes.dc_value + (plane - a.rules.n_sh) * codes.stride;
  std::int64_t state = 0;
  for (std::uint32_t i = 0; i < n; ++i) {
    const std::int64_t value = smoothed_dc_value(dc[i], of_class[codes.classes[i]].dc_step, state);
    state = smoothed_dc_state(value, state, a.rules.dc_smoothing.recent, a.rules.dc_smoothing.kept);
    values[i] = static_cast<std::int32_t>(value);
  }
}

template <int kDegree>
__global__ void __launch_bounds__(kRowThreads)
    archive_sh_kernel(const __grid_constant__ UnpackArchiveArguments a, std::uint32_t first_frame) {
  constexpr int kSh = 3 * ((kDegree + 1) * (kDegree + 1) - 1), kWords = (kSh + 6) / 4, kSide = kSh > 0 ? kSh : 1;
  __shared__ std::int16_t matrix[kSide][kSide];
  for (int at = static_cast<int>(threadIdx.x); at < kSh * kSh; at += kRowThreads) {
    matrix[at / kSide][at % kSide] = array_of<std::int16_t>(a, a.rules.sh_matrix)[at];
  }
  __syncthreads();
  const std::uint32_t frame = first_frame + blockIdx.y, i = blockIdx.x * kRowThreads + threadIdx.x;
  if (i >= rows_of(a, frame)) return;
  const Codes codes = codes_of(a);
  const std::size_t row = std::size_t{frame} * a.frame_rows + i;
  const float* const steps = a.sh_steps + std::size_t{12} * a.chunks[12 * (row / a.chunk_size) + 8];
  double dc[3];
  std::int32_t value[kSide];
#pragma unroll
  for (int k = 0; k < 3; ++k) dc[k] = codes.dc_value[k * codes.stride + i];
#pragma unroll
  for (int k = 0; k < kSh; ++k) value[k] = codes.sh[k * codes.stride + i];
  const float* const centre = array_of<float>(a, a.rules.sh_centre);
  const float factor = a.rules.sh_unit * 0x1p-14f;
  for (int w = 0; w < kWords; ++w) {
    std::uint32_t word = 0;
    for (int k = 4 * w; k < 4 * w + 4 && k < 3 + kSh; ++k) {
      float sh;
      if (k < 3) {
        const std::int16_t* const m = a.rules.dc_matrix + 3 * k;
        const double sum = m[0] * dc[0] + m[1] * dc[1] + m[2] * dc[2];
        sh = static_cast<float>(sum * 0x1p-30 + static_cast<double>(a.rules.dc_centre[k]));
      } else {
        std::uint32_t sum = 0;
#pragma unroll
        for (int j = 0; j < kSh; ++j) sum += static_cast<std::uint32_t>(matrix[k - 3][j] * value[j]);
        sh = static_cast<float>(static_cast<std::int32_t>(sum)) * factor + centre[k - 3];
      }
      const auto code = static_cast<std::uint8_t>(quantize_sh(sh, steps[3 * sh_degree_of(k / 3) + k % 3]));
      word |= std::uint32_t{code} << 8 * (k % 4);
    }
    a.sh[row * kWords + static_cast<unsigned>(w)] = word;
  }
}

}  // namespace

std::uint64_t archive_frame_bytes(std::uint32_t frame_rows, int sh_degree) {
  Codes codes;
  return place_codes(nullptr, frame_rows, static_cast<std::uint32_t>(3 * (sh_coefficients(sh_degree) - 1)), codes);
}

Status launch_unpack_archive(const UnpackArchiveArguments& a, Stream stream) {
  const std::uint32_t n_frames = blocks_for(a.n, a.frame_rows);
  for (std::uint32_t first = 0; first < n_frames; first += a.n_at_once) {
    const std::uint32_t count = std::min(a.n_at_once, n_frames - first);
    archive_codes_kernel<<<dim3(1, count), kWarp, 0, stream>>>(a, first);
    archive_smoothing_kernel<<<dim3(1, count), kPlaneThreads, 0, stream>>>(a, first);
    const dim3 grid(blocks_for(a.frame_rows, kRowThreads), count);
    switch (a.sh_degree) {
      case 0: archive_sh_kernel<0><<<grid, kRowThreads, 0, stream>>>(a, first); break;
      case 1: archive_sh_kernel<1><<<grid, kRowThreads, 0, stream>>>(a, first); break;
      case 2: archive_sh_kernel<2><<<grid, kRowThreads, 0, stream>>>(a, first); break;
      default: archive_sh_kernel<3><<<grid, kRowThreads, 0, stream>>>(a, first); break;
    }
  }
  return launched("an archive could not be unpacked");
}

}  // namespace rgs::cuda
