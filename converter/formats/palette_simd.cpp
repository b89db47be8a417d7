// palette_simd.cpp - sums, projections and nearest entries, compiled for each instruction set and chosen at run time.
// Lanes and their order are the same in all, so results are.
// SPDX-License-Identifier: Apache-2.0
#include "palette_simd.hpp"
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "palette_simd.cpp"  // NOLINT
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_SSE4)
#include <hwy/foreach_target.h>
//
#include <hwy/highway.h>

#include <algorithm>
#include <cstring>
#include <limits>

HWY_BEFORE_NAMESPACE();
namespace rgs::detail {
namespace HWY_NAMESPACE {

using V = float __attribute__((vector_size(32)));
using I = std::int32_t __attribute__((vector_size(32)));
constexpr std::size_t kLanes = 8;

#undef RGS_PALETTE_INLINE
#define RGS_PALETTE_INLINE inline __attribute__((always_inline))

RGS_PALETTE_INLINE V set(float x) {
  return V{x, x, x, x, x, x, x, x};
}
RGS_PALETTE_INLINE V load(const float* p) {
  V v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
RGS_PALETTE_INLINE void store(float* p, V v) {
  std::memcpy(p, &v, sizeof v);
}
RGS_PALETTE_INLINE float sum(V v) {
  return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

void sum_rows(const Rows& rows, const float* weights, const std::uint32_t* members, std::size_t n, float* out) {
  for (std::size_t i = 0; i < n; ++i) {
    const float* row = rows[members[i]];
    const V weight = set(weights[members[i]]);
    for (std::size_t k = 0; k < rows.width; k += kLanes) store(out + k, load(out + k) + weight * load(row + k));
  }
}

void sum_squares(const Rows& rows, const float* weights, const std::uint32_t* members, std::size_t n,
                 const float* centre, float* out) {
  for (std::size_t i = 0; i < n; ++i) {
    const float* row = rows[members[i]];
    const V weight = set(weights[members[i]]);
    for (std::size_t k = 0; k < rows.width; k += kLanes) {
      const V d = load(row + k) - load(centre + k);
      store(out + k, load(out + k) + weight * d * d);
    }
  }
}

void project_all(const Rows& rows, const std::uint32_t* members, std::size_t n, const float* direction, float* out) {
  for (std::size_t i = 0; i < n; ++i) {
    const float* row = rows[members[i]];
    V total = set(0);
    for (std::size_t k = 0; k < rows.width; k += kLanes) total += load(row + k) * load(direction + k);
    out[i] = sum(total);
  }
}

struct Best {
  V score;
  I entry;
};

RGS_PALETTE_INLINE void improve(Best& best, V score, std::int32_t entry) {
  const I lanes = I{0, 1, 2, 3, 4, 5, 6, 7} + entry, better = score < best.score;
  best.score = better ? score : best.score;
  best.entry = better ? lanes : best.entry;
}

RGS_PALETTE_INLINE std::uint32_t nearest_of(const Best& best) {
  std::size_t nearest = 0;
  for (std::size_t lane = 1; lane < kLanes; ++lane) nearest = best.score[lane] < best.score[nearest] ? lane : nearest;
  return static_cast<std::uint32_t>(best.entry[nearest]);
}

// Four rows against a panel: eight sums stay in registers.
RGS_PALETTE_INLINE void search_panel(const float* const (&row)[4], std::size_t width, const float* panel,
                                     const float* half_squares, std::int32_t entry, Best* best) {
  const V h0 = load(half_squares), h1 = load(half_squares + kLanes);
  V a0 = h0, a1 = h1, b0 = h0, b1 = h1, c0 = h0, c1 = h1, d0 = h0, d1 = h1;
  for (std::size_t k = 0; k < width; ++k) {
    const V e0 = load(panel + k * kPanel), e1 = load(panel + k * kPanel + kLanes);
    const V a = set(row[0][k]), b = set(row[1][k]), c = set(row[2][k]), d = set(row[3][k]);
    a0 -= a * e0, a1 -= a * e1;
    b0 -= b * e0, b1 -= b * e1;
    c0 -= c * e0, c1 -= c * e1;
    d0 -= d * e0, d1 -= d * e1;
  }
  improve(best[0], a0, entry), improve(best[0], a1, entry + 8);
  improve(best[1], b0, entry), improve(best[1], b1, entry + 8);
  improve(best[2], c0, entry), improve(best[2], c1, entry + 8);
  improve(best[3], d0, entry), improve(best[3], d1, entry + 8);
}

void search_all(const Rows& rows, const std::uint32_t* members, std::size_t n, const EntryGroups& entries,
                std::size_t group, std::uint32_t* labels) {
  constexpr std::size_t kBlock = 128;
  Best best[kBlock];
  for (std::size_t begin = 0; begin < n; begin += kBlock) {
    const std::size_t count = std::min(kBlock, n - begin);
    for (Best& b : best) b = {set(std::numeric_limits<float>::infinity()), I{}};
    for (const std::uint32_t g : entries.near_to(group)) {
      const std::size_t first = g * kGroup;
      for (std::size_t i = 0; i < count; i += 4) {
        const float* row[4];
        for (std::size_t j = 0; j < 4; ++j) row[j] = rows[members[begin + std::min(i + j, count - 1)]];
        for (std::size_t p = 0; p < kGroup; p += kPanel) {
          search_panel(row, rows.width, &entries.panels[(first + p) * rows.width], &entries.half_squares[first + p],
                       static_cast<std::int32_t>(first + p), &best[i]);
        }
      }
    }
    for (std::size_t i = 0; i < count; ++i) labels[members[begin + i]] = nearest_of(best[i]);
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::detail
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::detail {

HWY_EXPORT(sum_rows);
HWY_EXPORT(sum_squares);
HWY_EXPORT(project_all);
HWY_EXPORT(search_all);

void add_rows(const Rows& rows, std::span<const float> weights, std::span<const std::uint32_t> members, float* sum) {
  HWY_DYNAMIC_DISPATCH(sum_rows)(rows, weights.data(), members.data(), members.size(), sum);
}

void add_squares(const Rows& rows, std::span<const float> weights, std::span<const std::uint32_t> members,
                 const float* centre, float* sum) {
  HWY_DYNAMIC_DISPATCH(sum_squares)(rows, weights.data(), members.data(), members.size(), centre, sum);
}

void project_rows(const Rows& rows, std::span<const std::uint32_t> members, const float* direction, float* projected) {
  HWY_DYNAMIC_DISPATCH(project_all)(rows, members.data(), members.size(), direction, projected);
}

void search_groups(const Rows& rows, std::span<const std::uint32_t> members, const EntryGroups& entries,
                   std::size_t group, std::span<std::uint32_t> labels) {
  HWY_DYNAMIC_DISPATCH(search_all)(rows, members.data(), members.size(), entries, group, labels.data());
}

}  // namespace rgs::detail
#endif
