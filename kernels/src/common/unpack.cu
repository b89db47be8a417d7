// unpack.cu - decodes contents of coded frames to rows of MEAN, GEOM and SHI8; docs/format/FORMAT.md "Coded sections".
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/planes.hpp, shared with the host's decoder
// In/Out  means: planes [12, n] -> [n, 3]; geometry: planes [16, n] -> [n, 8]; SH: weights, planes [codes, n] -> [n, codes]
// Cost    each byte is read and written once. SH: 24 and 1,128 products a Gaussian at degree 1 and 3, one after the other
//         within it, and Gaussians of a lane one after the other: a frame takes as long as its longest lane, whatever the
//         device, so frames are launched on streams side by side
// Launch  means: a block of 1,024 threads a coordinate. Geometry: 256 threads, one a Gaussian. SH: one block of 64 threads,
//         a lane each
// Shared  means: two sums a warp, 256 B. SH: ShPredictor, 9.4 KB at degree 3; all lanes read the same word
// Order   deterministic; no atomics
#include <cstddef>
#include <cstdint>

#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "common/unpack.hpp"

namespace rgs::cuda {
namespace {

constexpr int kMeanThreads = 1024;
constexpr int kGeometryThreads = 256;

// Differences are summed 1,024 rows at a time. Sums of warps alternate between two arrays, so that a warp one round
// ahead does not overwrite what others still read.
__global__ void __launch_bounds__(kMeanThreads)
    unpack_means_kernel(const std::uint8_t* content, std::uint32_t n_rows, std::uint32_t* rows) {
  constexpr int kWarps = kMeanThreads / 32;
  __shared__ std::uint32_t warp_sums[2][kWarps];
  const std::uint8_t* const plane = content + std::size_t{4} * blockIdx.x * n_rows;
  std::uint32_t key = 0;  // of the row before the round
  int place = 0;
  for (std::uint32_t first = 0; first < n_rows; first += kMeanThreads, place ^= 1) {
    const std::uint32_t i = first + threadIdx.x;
    std::uint32_t folded = 0;
    if (i < n_rows) {
      for (std::uint32_t k = 0; k < 4; ++k) {
        folded |= static_cast<std::uint32_t>(plane[i + std::size_t{k} * n_rows]) << (8 * k);
      }
    }
    const std::uint32_t sum = inclusive_block_sum<kMeanThreads>(unfold(folded), warp_sums[place]);
    if (i < n_rows) rows[std::size_t{3} * i + blockIdx.x] = bits_of_key(key + sum);
    for (int warp = 0; warp < kWarps; ++warp) key += warp_sums[place][warp];
  }
}

__global__ void __launch_bounds__(kGeometryThreads)
    unpack_geometry_kernel(const std::uint8_t* content, std::uint32_t n_rows, uint4* rows) {
  const std::uint32_t i = blockIdx.x * kGeometryThreads + threadIdx.x;
  if (i >= n_rows) return;
  std::uint16_t row[8];
#pragma unroll
  for (int k = 0; k < 8; ++k) {
    const std::uint8_t* const plane = content + std::size_t{2} * k * n_rows + i;
    row[k] = static_cast<std::uint16_t>(plane[0] | plane[n_rows] << 8);
  }
  row[0] = static_cast<std::uint16_t>(unfold16(row[0]) + unit_w(row[1], row[2], row[3]));
  const auto pair = [&row](int k) { return static_cast<std::uint32_t>(row[k] | row[k + 1] << 16); };
  rows[i] = make_uint4(pair(0), pair(2), pair(4), pair(6));
}

template <int kDegree>
__global__ void __launch_bounds__(kShLanes) unpack_sh_kernel(UnpackShArguments a) {
  using Predictor = ShPredictor<kDegree>;
  constexpr int kSlots = static_cast<int>(Predictor::kSlots);
  __shared__ Predictor predictor;
  for (int at = static_cast<int>(threadIdx.x); at < kSlots * kSlots; at += kShLanes) {
    predictor.weight[at / kSlots][at % kSlots] = Predictor::weight_at(a.content, at / kSlots, at % kSlots);
  }
  if (threadIdx.x < kSlots) {
    predictor.carry[threadIdx.x] = Predictor::carry_at(a.content, static_cast<int>(threadIdx.x));
  }
  __syncthreads();
  const ShPlanes frame{a.content + sh_weight_bytes(Predictor::kCodes), a.steps, a.n_rows, a.chunk_size};
  decode_sh_lane<kDegree>(predictor, frame, threadIdx.x, a.rows);
}

}  // namespace

Status launch_unpack_means(const std::uint8_t* content, std::uint32_t n_rows, float* rows, Stream stream) {
  unpack_means_kernel<<<3, kMeanThreads, 0, stream>>>(content, n_rows, reinterpret_cast<std::uint32_t*>(rows));
  return launched("means could not be unpacked");
}

Status launch_unpack_geometry(const std::uint8_t* content, std::uint32_t n_rows, std::uint16_t* rows, Stream stream) {
  unpack_geometry_kernel<<<blocks_for(n_rows, kGeometryThreads), kGeometryThreads, 0, stream>>>(
      content, n_rows, reinterpret_cast<uint4*>(rows));
  return launched("geometry could not be unpacked");
}

Status launch_unpack_sh(const UnpackShArguments& a, Stream stream) {
  switch (a.sh_degree) {
    case 0: unpack_sh_kernel<0><<<1, kShLanes, 0, stream>>>(a); break;
    case 1: unpack_sh_kernel<1><<<1, kShLanes, 0, stream>>>(a); break;
    case 2: unpack_sh_kernel<2><<<1, kShLanes, 0, stream>>>(a); break;
    default: unpack_sh_kernel<3><<<1, kShLanes, 0, stream>>>(a); break;
  }
  return launched("SH could not be unpacked");
}

}  // namespace rgs::cuda
