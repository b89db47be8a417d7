// archive_kernels.cpp - the loops of archive_kernels.hpp, compiled for each instruction set and dispatched at run time.
// SPDX-License-Identifier: Apache-2.0
//
// The compiler vectorises formulas for single numbers: operations are rounded one by one, so every instruction set
// gives the same bits.

// As in codec_kernels.cpp.
#define HWY_DISABLED_TARGETS (HWY_SSE4 | HWY_SVE | HWY_SVE2 | HWY_SVE_256 | HWY_SVE2_128 | HWY_RVV)
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "archive/archive_kernels.cpp"  // NOLINT
#include <hwy/foreach_target.h>
//
#include <hwy/highway.h>

#include "archive/archive_kernels.hpp"
#include "rgs/archive_formulas.hpp"

HWY_BEFORE_NAMESPACE();
namespace rgs::detail {
namespace HWY_NAMESPACE {
namespace {

namespace hn = hwy::HWY_NAMESPACE;

void note(const std::int16_t* codes, std::size_t n, std::uint16_t* __restrict history,
          std::uint16_t* __restrict sizes) {
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint16_t h = next_history(history[i], codes[i]);
    history[i] = h;
    sizes[i] = size_of_history(h);
  }
}

void means(const MeanGrid& grid, const std::uint32_t* coordinates, std::size_t n, std::size_t stride,
           float* __restrict out) {
  const MeanGrid g = grid;
  for (std::size_t i = 0; i < n; ++i) {
    out[i * stride] = grid_mean(coordinates[i * stride], g.bits, g.cells, g.centre, g.half_width);
  }
}

void geometry(const GeometryLanes& in, std::uint32_t opacity_levels, int scale_exponent, std::uint16_t* rows) {
  alignas(64) float value[8][kShLanes];
  alignas(64) std::uint16_t half[8][kShLanes];
  for (int i = 0; i < kShLanes; ++i) {
    const auto step = static_cast<double>(in.rotation_step[i]);
    float q[4];
    unit_quaternion(in.rotation[0][i] * step, in.rotation[1][i] * step, in.rotation[2][i] * step, in.largest[i], q);
    value[0][i] = q[0], value[1][i] = q[1], value[2][i] = q[2], value[3][i] = q[3];
  }
  for (int j = 0; j < 3; ++j) {
    for (int i = 0; i < kShLanes; ++i) {
      value[4 + j][i] = stored_scale(scale_octaves(in.scale_base[i], in.scale_step[i], in.scale[j][i]), scale_exponent);
    }
  }
  for (int i = 0; i < kShLanes; ++i) value[7][i] = stored_opacity(in.opacity[i], opacity_levels);
  for (int k = 0; k < 8; ++k) {
    for (int i = 0; i < kShLanes; ++i) half[k][i] = geometry_half(k, value[k][i]);
  }
  for (int i = 0; i < kShLanes; ++i) {
    for (int k = 0; k < 8; ++k) rows[8 * i + k] = half[k][i];
  }
}

void pair(const std::int16_t* even, const std::int16_t* odd, int count, std::int16_t* __restrict pairs) {
  if (odd == nullptr) {
    for (int i = 0; i < count; ++i) pairs[2 * i] = even[i], pairs[2 * i + 1] = 0;
    return;
  }
  for (int i = 0; i < count; ++i) pairs[2 * i] = even[i], pairs[2 * i + 1] = odd[i];
}

// Integers below 2^53 throughout, so sums are exact in any order.
void dc(const std::int16_t* matrix, const std::int32_t* values, std::size_t stride, float centre, int count,
        float* __restrict out) {
  const double m0 = matrix[0], m1 = matrix[1], m2 = matrix[2], c = static_cast<double>(centre);
  for (int i = 0; i < count; ++i) {
    const std::int32_t* v = values + i;
    const double sum = m0 * v[0] + m1 * v[stride] + m2 * v[2 * stride];
    out[i] = static_cast<float>(sum * 0x1p-30 + c);
  }
}

// Eight rows of eight numbers become columns: each round of three interleaves rows i and i + 4. Those beyond n_in are 0,
// those beyond n_out are not written.
HWY_INLINE void transpose(const std::int16_t* in, std::size_t in_stride, int n_in, std::int16_t* out,
                          std::size_t out_stride, int n_out) {
#if HWY_TARGET == HWY_SCALAR
  for (int i = 0; i < n_out; ++i) {
    for (int j = 0; j < 8; ++j) {
      out[static_cast<std::size_t>(i) * out_stride + static_cast<std::size_t>(j)] =
          j < n_in ? in[static_cast<std::size_t>(j) * in_stride + static_cast<std::size_t>(i)] : std::int16_t{0};
    }
  }
#else
  constexpr hn::Full128<std::int16_t> d;
  hn::Vec<hn::Full128<std::int16_t> > a[8], b[8];
  for (int i = 0; i < 8; ++i) {
    a[i] = i < n_in ? hn::LoadU(d, in + static_cast<std::size_t>(i) * in_stride) : hn::Zero(d);
  }
  for (int round = 0; round < 3; ++round) {
    for (int i = 0; i < 4; ++i) {
      b[2 * i] = hn::InterleaveLower(d, a[i], a[i + 4]);
      b[2 * i + 1] = hn::InterleaveUpper(d, a[i], a[i + 4]);
    }
    for (int i = 0; i < 8; ++i) a[i] = b[i];
  }
  for (int i = 0; i < n_out; ++i) hn::StoreU(a[i], d, out + static_cast<std::size_t>(i) * out_stride);
#endif
}

void smooth(std::int16_t* planes, std::size_t stride, int n_planes, const std::int32_t* steps, int count,
            std::int32_t recent, std::int32_t kept, std::int32_t* state) {
  constexpr int kWidth = kShMaxCodes;
  alignas(64) std::int16_t rows[kShLanes][kWidth];
  alignas(64) std::int32_t s[kWidth];
  std::copy_n(state, kWidth, s);
  for (auto& row : rows) std::fill(row + n_planes, row + kWidth, std::int16_t{0});  // lanes that are not used
  const auto plane = [&](int k, int i) { return planes + static_cast<std::size_t>(k) * stride + i; };
  const auto eights = count / 8 * 8;
  for (int k = 0; k < n_planes; k += 8) {
    for (int i = 0; i < eights; i += 8) transpose(plane(k, i), stride, n_planes - k, &rows[i][k], kWidth, 8);
    for (int i = eights; i < count; ++i) {
      for (int j = k; j < std::min(k + 8, kWidth); ++j) rows[i][j] = j < n_planes ? *plane(j, i) : std::int16_t{0};
    }
  }
  for (int i = 0; i < count; ++i) {
    const std::int32_t step = steps[i];
    for (int k = 0; k < kWidth; ++k) {
      const std::int32_t value = smoothed_value(rows[i][k], step, s[k]);
      rows[i][k] = static_cast<std::int16_t>(value);
      s[k] = smoothed_state(value, s[k], recent, kept);
    }
  }
  for (int k = 0; k < n_planes; k += 8) {
    const int n = std::min(n_planes - k, 8);
    for (int i = 0; i < eights; i += 8) transpose(&rows[i][k], kWidth, 8, plane(k, i), stride, n);
    for (int i = eights; i < count; ++i) {
      for (int j = k; j < k + n; ++j) *plane(j, i) = rows[i][j];
    }
  }
  std::copy_n(s, kWidth, state);
}

void sh(const std::int32_t* sums, const float* factor, const float* centre, int n, float* __restrict value) {
  for (int q = 0; q < n; ++q, sums += kShLanes, value += kShLanes) {
    const float c = centre[q];
    for (int i = 0; i < kShLanes; ++i) value[i] = static_cast<float>(sums[i]) * factor[i] + c;
  }
}

// Of finite numbers, whose magnitudes order as their bits do.
void largest(const float* value, int n, int count, float* most) {
  for (int k = 0; k < n; ++k, value += kShLanes) {
    std::int32_t bits = 0;
    for (int i = 0; i < count; ++i) {
      const std::int32_t magnitude = std::bit_cast<std::int32_t>(value[i]) & 0x7FFFFFFF;
      bits = magnitude > bits ? magnitude : bits;
    }
    const auto found = std::bit_cast<float>(bits);
    most[k] = found > most[k] ? found : most[k];
  }
}

void quantize(const float* value, const float* step, int n, std::int8_t* __restrict codes) {
  for (int k = 0; k < n; ++k, value += kShLanes, codes += kShLanes) {
    const float s = step[k];
    for (int i = 0; i < kShLanes; ++i) codes[i] = quantize_sh(value[i], s);
  }
}

}  // namespace

const ArchiveKernels& archive_loops() {
  static constexpr ArchiveKernels kKernels = {note, means, geometry, pair, dc, smooth, sh, largest, quantize};
  return kKernels;
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::detail
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::detail {
HWY_EXPORT(archive_loops);

const ArchiveKernels& archive_kernels() {
  return HWY_DYNAMIC_DISPATCH(archive_loops)();
}

}  // namespace rgs::detail
#endif  // HWY_ONCE
