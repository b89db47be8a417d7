// key_sort.hpp - sorts many small items by a float.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstring>
#include <vector>

namespace rgs::lod {

/// Sorts by the upper 32 bits; stable. `spare` is scratch memory.
inline void sort_by_key(std::vector<std::uint64_t>& keys, std::vector<std::uint64_t>& spare) {
  spare.resize(keys.size());
  std::uint32_t counts[3][2048] = {};
  for (const std::uint64_t key : keys) {
    for (int pass = 0; pass < 3; ++pass) ++counts[pass][key >> (32 + 11 * pass) & 2047];
  }
  for (int pass = 0; pass < 3; ++pass) {
    std::uint32_t first = 0;
    for (std::uint32_t& count : counts[pass]) {
      const std::uint32_t n = count;
      count = first;
      first += n;
    }
    for (const std::uint64_t key : keys) spare[counts[pass][key >> (32 + 11 * pass) & 2047]++] = key;
    keys.swap(spare);
  }
}

/// Bits that sort like the float; not for NaN.
inline std::uint32_t ordered_bits(float value) {
  std::uint32_t bits;
  value += 0.F;  // -0 becomes 0
  std::memcpy(&bits, &value, sizeof bits);
  return (bits >> 31) != 0 ? ~bits : bits | 0x80000000U;
}

}  // namespace rgs::lod
