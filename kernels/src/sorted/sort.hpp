// sort.hpp - launches that sort (tile, Gaussian) pairs and find each tile's range.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Inclusive sums of `tiles` [n] in 64 bits. `temporary` has sum_bytes(n). Errors: device_failed.
Status launch_sum(const std::uint32_t* tiles, std::uint64_t* sums, std::uint32_t n, void* temporary,
                  std::uint64_t temporary_bytes, Stream stream);
Result<std::uint64_t> sum_bytes(std::uint32_t n);

/// Pairs, and spare arrays of the same size; the sort swaps them as needed.
struct SortBuffers {
  void* keys;  ///< 32 or 64 bits each
  void* spare_keys;
  std::uint32_t* gaussians;
  std::uint32_t* spare_gaussians;
  bool narrow_keys;
};

/// Stable radix sort of n pairs by the lowest `bits` bits of their keys; afterwards `keys` and `gaussians` hold the
/// result. n < 2^31. Errors: device_failed.
Status launch_sort(SortBuffers& buffers, std::uint64_t n, int bits, void* temporary, std::uint64_t temporary_bytes,
                   Stream stream);
/// Temporary memory for sorts of up to n pairs.
Result<std::uint64_t> sort_bytes(std::uint64_t n, bool narrow_keys);

/// Ranges [n_tiles] of the tiles in n sorted keys; empty for tiles without a pair. Errors: device_failed.
Status launch_ranges(const void* keys, bool narrow_keys, std::uint64_t n, int depth_bits, TileRange* ranges,
                     std::uint32_t n_tiles, Stream stream);

}  // namespace rgs::cuda
