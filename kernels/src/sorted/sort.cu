// sort.cu - sorts (tile, Gaussian) pairs by tile and depth: CUB's radix sort and sum.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  keys, Gaussians [n] -> the same, sorted stably by the lowest `bits` bits; ranges [n_tiles]
// Cost    one-sweep radix sort (Adinolfi et al. 2022), 8 bits a pass: each pass reads and writes every pair once, and one more
//         read of the keys makes all histograms. 32-bit keys: 4 passes of 16 B a pair; 64-bit keys with 45 bits: 6 passes of
//         24 B. Constant bits are not sorted. Ranges: one read of the keys
// Order   deterministic
#include <thrust/iterator/transform_iterator.h>
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#include <cuda/std/functional>

#include "common/launch.cuh"
#include "sorted/sort.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;

struct Widen {
  __host__ __device__ std::uint64_t operator()(std::uint32_t value) const { return value; }
};

template <class Key>
cudaError_t sort(SortBuffers& b, void* temporary, std::size_t& bytes, std::uint64_t n, int bits, Stream stream) {
  cub::DoubleBuffer<Key> keys(static_cast<Key*>(b.keys), static_cast<Key*>(b.spare_keys));
  cub::DoubleBuffer<std::uint32_t> gaussians(b.gaussians, b.spare_gaussians);
  const cudaError_t error =
      cub::DeviceRadixSort::SortPairs(temporary, bytes, keys, gaussians, static_cast<std::int32_t>(n), 0, bits, stream);
  b.keys = keys.Current(), b.spare_keys = keys.Alternate();
  b.gaussians = gaussians.Current(), b.spare_gaussians = gaussians.Alternate();
  return error;
}

template <class Key>
__global__ void __launch_bounds__(kThreads)
    ranges_kernel(const Key* keys, std::uint32_t n, int depth_bits, TileRange* ranges) {
  const std::uint32_t i = blockIdx.x * kThreads + threadIdx.x;
  if (i >= n) return;
  // 64-bit shifts: with one tile a key has no tile bits, and its depth may fill all 32.
  const auto tile = static_cast<std::uint32_t>(static_cast<std::uint64_t>(keys[i]) >> depth_bits);
  const auto before = i == 0 ? ~0u : static_cast<std::uint32_t>(static_cast<std::uint64_t>(keys[i - 1]) >> depth_bits);
  if (tile != before) {
    ranges[tile].begin = i;
    if (i > 0) ranges[before].end = i;
  }
  if (i == n - 1) ranges[tile].end = n;
}

}  // namespace

Result<std::uint64_t> sum_bytes(std::uint32_t n) {
  std::size_t bytes = 0;
  const auto in = thrust::make_transform_iterator(static_cast<const std::uint32_t*>(nullptr), Widen{});
  const auto ok = checked(
      cub::DeviceScan::InclusiveSum(nullptr, bytes, in, static_cast<std::uint64_t*>(nullptr), static_cast<int>(n)),
      "the size of a sum's temporary memory is unknown");
  if (!ok) return tl::unexpected(ok.error());
  return bytes;
}

Status launch_sum(const std::uint32_t* tiles, std::uint64_t* sums, std::uint32_t n, void* temporary,
                  std::uint64_t temporary_bytes, Stream stream) {
  if (n == 0) return {};
  std::size_t bytes = temporary_bytes;
  return checked(cub::DeviceScan::InclusiveSum(temporary, bytes, thrust::make_transform_iterator(tiles, Widen{}), sums,
                                               static_cast<int>(n), stream),
                 "the sum over tile counts could not be launched");
}

Result<std::uint64_t> sort_bytes(std::uint64_t n, bool narrow_keys) {
  std::size_t bytes = 0;
  SortBuffers none{nullptr, nullptr, nullptr, nullptr, narrow_keys};
  const auto ok = checked(narrow_keys ? sort<std::uint32_t>(none, nullptr, bytes, n, 32, nullptr)
                                      : sort<std::uint64_t>(none, nullptr, bytes, n, 64, nullptr),
                          "the size of the sort's temporary memory is unknown");
  if (!ok) return tl::unexpected(ok.error());
  return bytes;
}

Status launch_sort(SortBuffers& buffers, std::uint64_t n, int bits, void* temporary, std::uint64_t temporary_bytes,
                   Stream stream) {
  if (n == 0 || bits == 0) return {};
  std::size_t bytes = temporary_bytes;
  return checked(buffers.narrow_keys ? sort<std::uint32_t>(buffers, temporary, bytes, n, bits, stream)
                                     : sort<std::uint64_t>(buffers, temporary, bytes, n, bits, stream),
                 "the sort could not be launched");
}

Status launch_ranges(const void* keys, bool narrow_keys, std::uint64_t n, int depth_bits, TileRange* ranges,
                     std::uint32_t n_tiles, Stream stream) {
  const auto cleared =
      checked(cudaMemsetAsync(ranges, 0, n_tiles * sizeof(TileRange), stream), "the tile ranges could not be cleared");
  if (!cleared || n == 0) return cleared;
  const auto count = static_cast<std::uint32_t>(n);
  if (narrow_keys) {
    ranges_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(static_cast<const std::uint32_t*>(keys), count,
                                                                    depth_bits, ranges);
  } else {
    ranges_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(static_cast<const std::uint64_t*>(keys), count,
                                                                    depth_bits, ranges);
  }
  return launched("the range kernel could not be launched");
}

}  // namespace rgs::cuda
