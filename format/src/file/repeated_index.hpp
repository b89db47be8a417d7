// repeated_index.hpp - whether a list of positions in a source repeats one.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

namespace rgs::detail {

/// Whether two of index_at(0) .. index_at(n - 1), all below n_source, are equal. Marks a bit for each position of the
/// source; sorts the indices instead if that takes more than 64 bits an index, because a file has kept little of its
/// source or lies about it.
template <class IndexAt>
bool has_repeated_index(std::uint64_t n, std::uint64_t n_source, const IndexAt& index_at) {
  if (n_source / 64 <= n) {
    std::vector<std::uint64_t> seen(n_source / 64 + 1);
    for (std::uint64_t i = 0; i < n; ++i) {
      const std::uint64_t index = index_at(i), bit = std::uint64_t{1} << (index % 64);
      if ((seen[index / 64] & bit) != 0) return true;
      seen[index / 64] |= bit;
    }
    return false;
  }
  std::vector<std::uint64_t> indices(n);
  for (std::uint64_t i = 0; i < n; ++i) indices[i] = index_at(i);
  std::ranges::sort(indices);
  return std::ranges::adjacent_find(indices) != indices.end();
}

}  // namespace rgs::detail
