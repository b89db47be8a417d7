// quantised.hpp - shared by the compact formats: little-endian access, unsigned codes, colours, smallest-three
// rotations, and the limit on expansion.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>

#include "rgs/decode.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

static_assert(std::endian::native == std::endian::little, "the formats are little-endian and read in place");

/// The value at `offset`, which must be in range.
template <class T>
T load(std::span<const std::byte> bytes, std::uint64_t offset) {
  T value;
  std::memcpy(&value, bytes.data() + offset, sizeof(T));
  return value;
}
template <class T>
void store(std::span<std::byte> bytes, std::uint64_t offset, T value) {
  std::memcpy(bytes.data() + offset, &value, sizeof(T));
}
inline std::uint8_t load_u8(std::span<const std::byte> bytes, std::uint64_t offset) {
  return std::to_integer<std::uint8_t>(bytes[offset]);
}

/// round(value * max_code), ties away from zero, clamped to 0..max_code; 0 for NaN.
inline std::uint32_t unit_code(double value, std::uint32_t max_code) {
  const double scaled = value * max_code;
  return scaled > 0 ? static_cast<std::uint32_t>(std::min(scaled + 0.5, static_cast<double>(max_code))) : 0;
}

/// Colour of the constant harmonic: 1/2 + kSh0 * coefficient (Kerbl et al. 2023).
inline constexpr double kSh0 = 0.28209479177387814;
inline float dc_from_colour(double colour) {
  return static_cast<float>((colour - 0.5) / kSh0);
}
inline double colour_from_dc(float dc) {
  return 0.5 + kSh0 * static_cast<double>(dc);
}

/// A unit quaternion without its largest component, which is positive: three components of at most sqrt(1/2).
struct SmallestThree {
  std::uint32_t largest = 0;   ///< 0..3
  double rest[3] = {0, 0, 0};  ///< the others in order
};
inline constexpr double kRootHalf = 0.70710678118654752;

/// `q`, in the format's component order, need not be normalised; zero gives the first axis.
inline SmallestThree smallest_three(const float (&q)[4]) {
  SmallestThree s;
  double squared = 0;
  for (std::uint32_t i = 0; i < 4; ++i) {
    squared += static_cast<double>(q[i]) * static_cast<double>(q[i]);
    if (std::abs(q[i]) > std::abs(q[s.largest])) s.largest = i;
  }
  const double factor = squared > 0 ? (q[s.largest] < 0 ? -1 : 1) / std::sqrt(squared) : 0;
  for (std::uint32_t i = 0, k = 0; i < 4; ++i) {
    if (i != s.largest) s.rest[k++] = static_cast<double>(q[i]) * factor;
  }
  return s;
}

inline void from_smallest_three(const SmallestThree& s, float (&q)[4]) {
  double squared = 0;
  for (std::uint32_t i = 0, k = 0; i < 4; ++i) {
    if (i == s.largest) continue;
    squared += s.rest[k] * s.rest[k];
    q[i] = static_cast<float>(s.rest[k++]);
  }
  q[s.largest] = static_cast<float>(std::sqrt(std::max(0.0, 1 - squared)));
}

/// Whether a file of `stored` bytes may expand to `decoded`. Check before allocating: a header can promise anything.
inline Status check_expansion(std::uint64_t decoded, std::uint64_t stored, std::uint64_t offset,
                              const DecodeLimits& limits) {
  const std::uint64_t limit = limits.decoded_bytes(stored);
  if (decoded <= limit) return {};
  return make_error(Errc::limit_exceeded, offset, "the file expands more than the caller allows (max_expansion)", limit,
                    decoded);
}

}  // namespace rgs::detail
