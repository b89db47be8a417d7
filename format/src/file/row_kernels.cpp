// row_kernels.cpp - the loops of row_kernels.hpp, compiled for each instruction set and dispatched at run time.
// SPDX-License-Identifier: Apache-2.0
//
// The functions of stored_values.hpp process the rows that vectors leave over, or all rows without vectors.

// Arrays hold sums of vectors, so vectors need a size at compile time.
#define HWY_DISABLED_TARGETS (HWY_SSE4 | HWY_SVE | HWY_SVE2 | HWY_SVE_256 | HWY_SVE2_128 | HWY_RVV)

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "file/row_kernels.cpp"  // NOLINT
#include <hwy/foreach_target.h>
//
#include <hwy/highway.h>

#include <algorithm>
#include <cstring>

#include "file/row_kernels.hpp"

HWY_BEFORE_NAMESPACE();
namespace rgs::detail {
namespace HWY_NAMESPACE {
namespace {

constexpr std::size_t kCodes = kGeometryBytes / sizeof(std::uint16_t);

// Results by position of an FP16 code in a row of GEOM.
struct CodeScan {
  std::uint16_t most[kCodes] = {};
  bool are_rotations = true;  ///< surely legal
  ValueCounts counts;
};

#if HWY_TARGET != HWY_SCALAR && HWY_TARGET != HWY_EMU128
namespace hn = hwy::HWY_NAMESPACE;

using DF = hn::ScalableTag<float>;
using D32 = hn::RebindToUnsigned<DF>;
using DI = hn::RebindToSigned<DF>;
using D16 = hn::Repartition<std::uint16_t, DF>;
using DI16 = hn::RebindToSigned<D16>;
using D8 = hn::Repartition<std::uint8_t, DF>;
using DI8 = hn::RebindToSigned<D8>;
using Floats = hn::Vec<DF>;
using Words = hn::Vec<D32>;
constexpr DF df;
constexpr D32 d32;
constexpr DI di;
constexpr D16 d16;
constexpr DI16 di16;
constexpr D8 d8;
constexpr DI8 di8;

constexpr std::size_t kBytes = hn::MaxLanes(d8), kFloats = hn::MaxLanes(df), kWords = hn::MaxLanes(d16);
static_assert(64 % kBytes == 0 && kBytes % kGeometryBytes == 0);

HWY_INLINE hn::Vec<D8> load(const std::byte* p) {
  return hn::LoadU(d8, reinterpret_cast<const std::uint8_t*>(p));
}

// FP16 in the lower and in the upper half of a word, exact as float_from_half(), except that infinity and NaN, 0x7C00
// and above, become finite numbers from 65,536 to 131,008. scan_codes() relies on that: Max could lose a NaN.
HWY_INLINE Floats magnitude_below(Words w) {
  const Words bits = hn::ShiftLeft<13>(hn::And(w, hn::Set(d32, 0x7FFFu)));
  return hn::Mul(hn::BitCast(df, bits), hn::Set(df, 0x1p112f));
}
HWY_INLINE Floats magnitude_above(Words w) {
  const Words bits = hn::And(hn::ShiftRight<3>(w), hn::Set(d32, 0x7FFFu << 13));
  return hn::Mul(hn::BitCast(df, bits), hn::Set(df, 0x1p112f));
}
HWY_INLINE Floats half_below(Words w) {
  return hn::CopySign(magnitude_below(w), hn::BitCast(df, hn::ShiftLeft<16>(w)));
}
HWY_INLINE Floats half_above(Words w) {
  return hn::CopySign(magnitude_above(w), hn::BitCast(df, w));
}

// Extends the box by as many rows as fill vectors, and returns their number. Three vectors repeat the order of
// components.
HWY_INLINE std::size_t scan_means(const std::byte* rows, std::size_t n, Box& box, bool& are_finite) {
  const std::size_t whole = n / kFloats * kFloats;
  if (whole == 0) return 0;
  const auto at = [rows](std::size_t i) HWY_ATTR { return hn::BitCast(df, load(rows + i * kBytes)); };
  Floats low0 = at(0), low1 = at(1), low2 = at(2), high0 = low0, high1 = low1, high2 = low2;
  auto magnitude = hn::Zero(di);  // infinity and NaN are above every number
  for (std::size_t i = 0; i < 3 * (whole / kFloats); i += 3) {
    const Floats a = at(i), b = at(i + 1), c = at(i + 2);
    low0 = hn::Min(low0, a), low1 = hn::Min(low1, b), low2 = hn::Min(low2, c);
    high0 = hn::Max(high0, a), high1 = hn::Max(high1, b), high2 = hn::Max(high2, c);
    const auto of = [](Floats v) HWY_ATTR { return hn::BitCast(di, hn::Abs(v)); };
    magnitude = hn::Max(hn::Max(magnitude, of(a)), hn::Max(of(b), of(c)));
  }
  are_finite = hn::AllTrue(di, hn::Lt(magnitude, hn::Set(di, 0x7F800000)));
  float low[3 * kFloats], high[3 * kFloats];
  hn::StoreU(low0, df, low), hn::StoreU(low1, df, low + kFloats), hn::StoreU(low2, df, low + 2 * kFloats);
  hn::StoreU(high0, df, high), hn::StoreU(high1, df, high + kFloats), hn::StoreU(high2, df, high + 2 * kFloats);
  for (std::size_t k = 0; k < 3; ++k) box.min[k] = low[k], box.max[k] = high[k];
  for (std::size_t i = 3; i < 3 * kFloats; i += 3) {
    for (std::size_t k = 0; k < 3; ++k) {
      box.min[k] = std::min(box.min[k], low[i + k]);
      box.max[k] = std::max(box.max[k], high[i + k]);
    }
  }
  return whole;
}

// A row is 128 bits, so lanes of a code are kCodes apart. Counts are valid if all codes are legal.
template <bool kAll>
HWY_INLINE std::size_t scan_codes(const std::byte* rows, std::size_t n, CodeScan& scan) {
  constexpr std::size_t kRows = kWords / kCodes;
  const std::size_t whole = n / kRows * kRows;
  // Counts smaller ones: scales below the normal range, opacities other than 1.
  constexpr std::uint16_t kLimits[kCodes] = {0, 0, 0, 0, 0x0400, 0x0400, 0x0400, 0x3C00};
  const auto limits = hn::BitCast(di16, hn::LoadDup128(d16, kLimits));
  auto most = hn::Zero(d16), zeros = most, small = most;
  Floats deviation = hn::Zero(df);
  for (std::size_t i = 0; i < whole; i += kRows) {
    const auto v = hn::BitCast(d16, load(rows + i * kGeometryBytes));
    most = hn::Max(most, v);
    if constexpr (kAll) {
      zeros = hn::Sub(zeros, hn::VecFromMask(d16, hn::Eq(v, hn::Zero(d16))));
      small = hn::Sub(small, hn::BitCast(d16, hn::VecFromMask(di16, hn::Lt(hn::BitCast(di16, v), limits))));
      const Words w = hn::BitCast(d32, v);
      const Floats a = magnitude_below(w), b = magnitude_above(w), pair = hn::Add(hn::Mul(a, a), hn::Mul(b, b));
      const Floats squared = hn::Add(pair, hn::Shuffle2301(pair));  // in the first two lanes of a row
      deviation = hn::Max(deviation, hn::Abs(hn::Sub(squared, hn::Set(df, 1.f))));
    }
  }
  const auto each = [](auto v, const auto& take) HWY_ATTR {
    std::uint16_t lanes[kWords];
    hn::StoreU(v, d16, lanes);
    for (std::size_t i = 0; i < kWords; i += kCodes) {
      for (std::size_t k = 0; k < kCodes; ++k) take(k, lanes[i + k]);
    }
  };
  each(most, [&scan](std::size_t k, std::uint16_t code) { scan.most[k] = std::max(scan.most[k], code); });
  if constexpr (kAll) {
    std::uint64_t n_zero[kCodes] = {}, n_small[kCodes] = {};
    each(zeros, [&n_zero](std::size_t k, std::uint16_t count) { n_zero[k] += count; });
    each(small, [&n_small](std::size_t k, std::uint16_t count) { n_small[k] += count; });
    const std::uint64_t scale_zero = n_zero[4] + n_zero[5] + n_zero[6];
    scan.counts.scale_zero += scale_zero;
    scan.counts.scale_subnormal += n_small[4] + n_small[5] + n_small[6] - scale_zero;
    scan.counts.opacity_zero += n_zero[7];
    scan.counts.opacity_one += whole - n_small[7];
    // Squares are exact and two rounded sums follow, so the norm's error is below 2^-22.
    float deviations[kFloats];
    hn::StoreU(deviation, df, deviations);
    for (std::size_t i = 0; i < kFloats; i += 4) {
      scan.are_rotations = scan.are_rotations && deviations[i] <= static_cast<float>(kStoredNormTolerance) - 0x1p-22f;
    }
  }
  return whole;
}

HWY_INLINE bool scan_sh(const std::byte* rows, std::size_t bytes, const ShRowMask& mask, std::size_t& whole) {
  auto least = hn::Zero(di8);
  auto foreign = hn::Zero(d8);
  std::size_t of_mask = 0;
  for (whole = 0; whole + kBytes <= bytes; whole += kBytes) {
    const auto codes = load(rows + whole);
    least = hn::Min(least, hn::BitCast(di8, codes));
    foreign = hn::Or(foreign, hn::AndNot(hn::LoadU(d8, mask.bits + of_mask), codes));
    of_mask = of_mask + kBytes == mask.bytes ? 0 : of_mask + kBytes;
  }
  return hn::AllTrue(di8, hn::Gt(least, hn::Set(di8, std::int8_t{-128}))) &&
         hn::AllTrue(d8, hn::Eq(foreign, hn::Zero(d8)));
}

// RoomInBox::is_enough() in binary32, for stored scales s without their exponent E. To first order, with u = 2^-24 and
// s the largest scale:
//
//   |q|^2    squares are exact, sums of 4 numbers that are not negative: 3 u of it
//   f        2 / |q|^2: 4 u of it
//   r        1 - f (yy + zz), the product at most 2 and wrong by 6 u of it, the difference at most 1: 13 u; f (xy - wz), of exact products
//            and at most 1: 6 u
//   r s      14 u of s
//   |r s|    three of them: sqrt(3) * 14 u = 25 u of s, and 2 u of itself for squares and sums
//   reach    3 |r s|: 75 u of s
//   room     a difference times 2^E, a power of two: u of it
//
// So the true reach is at most the computed one plus 128 u of s, plus the margin of kShare. That leaves enough for
// extent_of(), which rounds in binary64. Numbers so small that they lose bits are less than u of the least nonzero
// scale; on overflow there is room for any scale. 3 s 2^-E is exact; a smaller room may be rounded up to it by u of it,
// which is within the margin of kExtentShare.
HWY_INLINE hn::Mask<DF> have_room(const BoxInFp32& box, const std::byte* means, const std::byte* geometry) {
  constexpr float kShare = 1 - 0x1p-11f, kSlack = 128 * 0x1p-24f;
  Floats room[3];
  hn::LoadInterleaved3(df, reinterpret_cast<const float*>(means), room[0], room[1], room[2]);
  for (int k = 0; k < 3; ++k) {
    room[k] = hn::Min(hn::Sub(room[k], hn::Set(df, box.min[k])), hn::Sub(hn::Set(df, box.max[k]), room[k]));
  }
  Words wx, yz, s01, s2;
  hn::LoadInterleaved4(d32, reinterpret_cast<const std::uint32_t*>(geometry), wx, yz, s01, s2);
  const Floats s[3] = {magnitude_below(s01), magnitude_above(s01), magnitude_below(s2)};
  const Floats largest = hn::Max(hn::Max(s[0], s[1]), s[2]);
  const Floats farthest = hn::Mul(hn::Mul(hn::Set(df, 3.f), largest), hn::Set(df, box.unit));
  const auto is_far_inside = hn::Le(farthest, hn::Min(hn::Min(room[0], room[1]), room[2]));
  if (hn::AllTrue(df, is_far_inside)) return is_far_inside;
  const Floats w = magnitude_below(wx), x = half_above(wx), y = half_below(yz), z = half_above(yz);
  const Floats ww = hn::Mul(w, w), xx = hn::Mul(x, x), yy = hn::Mul(y, y), zz = hn::Mul(z, z);
  const Floats one = hn::Set(df, 1.f);
  const Floats f = hn::Div(hn::Set(df, 2.f), hn::Add(hn::Add(ww, xx), hn::Add(yy, zz)));
  const auto diagonal = [&](Floats a, Floats b) HWY_ATTR { return hn::Sub(one, hn::Mul(f, hn::Add(a, b))); };
  const auto sum = [&](Floats a, Floats b, Floats c, Floats d)
                       HWY_ATTR { return hn::Mul(f, hn::Add(hn::Mul(a, b), hn::Mul(c, d))); };
  const auto difference = [&](Floats a, Floats b, Floats c, Floats d)
                              HWY_ATTR { return hn::Mul(f, hn::Sub(hn::Mul(a, b), hn::Mul(c, d))); };
  const Floats r[3][3] = {{diagonal(yy, zz), difference(x, y, w, z), sum(x, z, w, y)},
                          {sum(x, y, w, z), diagonal(xx, zz), difference(y, z, w, x)},
                          {difference(x, z, w, y), sum(y, z, w, x), diagonal(xx, yy)}};
  const Floats slack = hn::Mul(largest, hn::Set(df, kSlack));
  auto has_room = hn::Eq(one, one);
  for (int k = 0; k < 3; ++k) {
    const Floats left = hn::Sub(hn::Mul(room[k], hn::Set(df, box.units)), slack);
    const Floats a = hn::Mul(r[k][0], s[0]), b = hn::Mul(r[k][1], s[1]), c = hn::Mul(r[k][2], s[2]);
    const Floats variance = hn::Add(hn::Add(hn::Mul(a, a), hn::Mul(b, b)), hn::Mul(c, c));
    const auto is_enough = hn::Le(hn::Mul(hn::Set(df, 9 * kShare * kShare), variance), hn::Mul(left, left));
    has_room = hn::And(has_room, hn::And(is_enough, hn::Gt(left, hn::Zero(df))));
  }
  return hn::Or(has_room, is_far_inside);
}

std::uint64_t in_box(const BoxInFp32& box, const std::byte* means, const std::byte* geometry, std::size_t count) {
  std::uint64_t found = 0;
  if (count < kFloats) return found;
  for (std::size_t i = 0; i < count; i += kFloats) {
    const std::size_t at = std::min(i, count - kFloats);  // the last ones, some of them again
    std::uint8_t bits[8] = {};
    hn::StoreMaskBits(df, have_room(box, means + at * kMeanBytes, geometry + at * kGeometryBytes), bits);
    found |= static_cast<std::uint64_t>(bits[0] | bits[1] << 8) << at;
  }
  return found;
}
static_assert(kFloats <= 16);
#else
HWY_INLINE std::size_t scan_means(const std::byte*, std::size_t, Box&, bool&) {
  return 0;
}
template <bool kAll>
HWY_INLINE std::size_t scan_codes(const std::byte*, std::size_t, CodeScan&) {
  return 0;
}
HWY_INLINE bool scan_sh(const std::byte*, std::size_t, const ShRowMask&, std::size_t& whole) {
  whole = 0;
  return true;
}
std::uint64_t in_box(const BoxInFp32&, const std::byte*, const std::byte*, std::size_t) {
  return 0;
}
#endif

template <bool kAll>
HWY_INLINE bool scan(const std::byte* means, const std::byte* geometry, std::size_t n, RowSummary& summary) {
  Box box;
  bool are_finite = true;
  const std::size_t whole = scan_means(means, n, box, are_finite);
  for (std::size_t i = whole; i < n; ++i) {
    float mean[3];
    std::memcpy(mean, means + i * kMeanBytes, sizeof mean);
    for (std::size_t k = 0; k < 3; ++k) {
      are_finite = are_finite && is_finite(mean[k]);
      box.min[k] = i == 0 ? mean[k] : std::min(box.min[k], mean[k]);
      box.max[k] = i == 0 ? mean[k] : std::max(box.max[k], mean[k]);
    }
  }
  if (!are_finite) return false;
  for (std::size_t k = 0; k < 3; ++k) {
    summary.means.min[k] = box.min[k] + 0.f;
    summary.means.max[k] = box.max[k] + 0.f;
  }
  CodeScan codes;
  // Lanes that count rows have 16 bits.
  constexpr std::size_t kMost = 0x8000;
  for (std::size_t from = 0; from < n; from += kMost) {
    const std::byte* rows = geometry + from * kGeometryBytes;
    const std::size_t count = std::min(kMost, n - from);
    for (std::size_t i = scan_codes<kAll>(rows, count, codes); i < count; ++i) {
      std::uint16_t row[kCodes];
      std::memcpy(row, rows + i * kGeometryBytes, sizeof row);
      for (std::size_t k = 0; k < kCodes; ++k) codes.most[k] = std::max(codes.most[k], row[k]);
      if constexpr (kAll) {
        codes.are_rotations = codes.are_rotations && is_unit_quaternion(row);
        codes.counts.add(row);
      }
    }
  }
  // FP16 bits of non-negative numbers order as the numbers do, below infinity, NaN and negative numbers.
  const std::uint16_t* most = codes.most;
  summary.largest_scale = std::max({most[4], most[5], most[6]});
  summary.largest_opacity = most[7];
  if constexpr (!kAll) return true;
  summary.counts = codes.counts;
  return codes.are_rotations && !has_sign_bit(most[0]) && is_stored_scale(summary.largest_scale) &&
         is_stored_opacity(most[7]);
}

bool summarize(const std::byte* means, const std::byte* geometry, std::size_t n, RowSummary& summary) {
  return scan<false>(means, geometry, n, summary);
}

bool check(const std::byte* means, const std::byte* geometry, std::size_t n, RowSummary& summary) {
  return scan<true>(means, geometry, n, summary);
}

bool check_sh(const std::byte* rows, std::size_t bytes, const ShRowMask& mask) {
  std::size_t whole = 0;
  if (!scan_sh(rows, bytes, mask, whole)) return false;
  unsigned bad = 0;  // no branch, so that it vectorises
  for (std::size_t of_mask = whole % mask.bytes; whole < bytes; of_mask = 0) {
    const std::size_t n = std::min(bytes - whole, mask.bytes - of_mask);
    for (std::size_t i = 0; i < n; ++i) {
      const auto code = std::to_integer<std::uint8_t>(rows[whole + i]);
      bad |= static_cast<std::uint8_t>((code & ~mask.bits[of_mask + i]) | (code == 0x80 ? 1 : 0));
    }
    whole += n;
  }
  return bad == 0;
}

}  // namespace

const RowKernels& row_loops() {
  static constexpr RowKernels kKernels = {summarize, check, check_sh, in_box};
  return kKernels;
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::detail
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::detail {
HWY_EXPORT(row_loops);

const RowKernels& row_kernels() {
  return HWY_DYNAMIC_DISPATCH(row_loops)();
}

// All bits if the step is not 0; none otherwise and in padding.
ShRowMask::ShRowMask(const ShStepSet& steps, int sh_degree) {
  const std::size_t row = sh_bytes(sh_degree);
  std::size_t whole = 0;
  for (; whole < 3 * static_cast<std::size_t>(sh_coefficients(sh_degree)); ++whole) {
    bits[whole] = steps.of_value(static_cast<int>(whole)) != 0 ? 0xFF : 0;
  }
  for (; whole < row; ++whole) bits[whole] = 0;
  bytes = row * (row % 64 == 0 ? 1 : row % 16 == 0 ? 4 : 16);
  for (; whole < bytes; whole *= 2) std::memcpy(bits + whole, bits, std::min(whole, bytes - whole));
}

}  // namespace rgs::detail
#endif  // HWY_ONCE
