// check_values.cu - checks a file's values against the specification, as validate() does on the host; a warp a chunk.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/stored_values.hpp, shared with the host's check
// In/Out  MEAN [n, 3], GEOM [n, 8], SHI8 [n, words], SHSC, CHNK [n_chunks, 12] -> counts, number of damaged chunks
// Cost    76 B read a Gaussian at SH degree 3, once: expected bound, memory
// Launch  256 threads, eight chunks a block
// Shared  which bits the words of an SH row may have, 48 B a warp
// Order   deterministic: integer sums. The host then searches for the damaged value
#include <cstdint>

#include "common/block_scan.cuh"
#include "common/check_values.hpp"
#include "common/launch.cuh"
#include "rgs/layout.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;

__device__ void add_count(std::uint64_t* total, std::uint32_t count) {
  const std::uint32_t sum = warp_sum(count);
  if (threadIdx.x % 32 == 0 && sum != 0) {
    atomicAdd(reinterpret_cast<unsigned long long*>(total), static_cast<unsigned long long>(sum));
  }
}

template <int kDegree>
__global__ void __launch_bounds__(kThreads)
    check_values_kernel(CompactAttributes a, std::uint32_t n, std::uint32_t n_chunks, CheckedValues* out) {
  constexpr std::uint32_t kWords = sh_bytes(kDegree) / 4;
  constexpr int kValues = 3 * sh_coefficients(kDegree);
  __shared__ std::uint32_t masks[kWarps][kWords];
  const std::uint32_t warp = threadIdx.x / 32, lane = threadIdx.x % 32, chunk = blockIdx.x * kWarps + warp;
  if (chunk >= n_chunks) return;
  const std::uint32_t first = chunk * a.chunk_size, count = math::min(a.chunk_size, n - first);
  const std::uint32_t* const entry = a.chunks + std::size_t{12} * chunk;

  // All bits if the step is not 0; none otherwise and in padding.
  std::uint32_t* const mask = masks[warp];
  if (lane < kWords) {
    const float* const steps = a.sh_steps + std::size_t{12} * entry[8];
    std::uint32_t bits = 0;
    for (int k = 0; k < 4; ++k) {
      const int value = 4 * static_cast<int>(lane) + k;
      if (value < kValues && steps[3 * sh_degree_of(value / 3) + value % 3] != 0) bits |= 0xFFu << (8 * k);
    }
    mask[lane] = bits;
  }
  __syncwarp();
  bool is_sound = true;
  const std::uint32_t* const codes = a.sh + std::size_t{kWords} * first;
  for (std::uint32_t i = lane; i < kWords * count; i += 32) {
    is_sound = is_sound && are_stored_codes(codes[i], mask[i % kWords]);
  }

  const float infinity = detail::float_of(0x7F800000u);
  float low[3] = {infinity, infinity, infinity}, high[3] = {-infinity, -infinity, -infinity};
  std::uint32_t largest_scale = 0, largest_opacity = 0;
  ValueCounts counts;
  for (std::uint32_t i = lane; i < count; i += 32) {
    const float* const mean = a.mean + std::size_t{3} * (first + i);
    for (int k = 0; k < 3; ++k) {
      is_sound = is_sound && is_finite(mean[k]);
      low[k] = fminf(low[k], mean[k]), high[k] = fmaxf(high[k], mean[k]);
    }
    const uint4 words = reinterpret_cast<const uint4*>(a.geometry)[first + i];
    const auto half = [](std::uint32_t word, int k) { return static_cast<std::uint16_t>(word >> (16 * k)); };
    const std::uint16_t row[8] = {half(words.x, 0), half(words.x, 1), half(words.y, 0), half(words.y, 1),
                                  half(words.z, 0), half(words.z, 1), half(words.w, 0), half(words.w, 1)};
    is_sound = is_sound && is_unit_quaternion(row) && !has_sign_bit(row[0]) && is_stored_opacity(row[7]);
    for (int k = 4; k < 7; ++k) {
      is_sound = is_sound && is_stored_scale(row[k]);
      largest_scale = math::max(largest_scale, std::uint32_t{row[k]});
    }
    largest_opacity = math::max(largest_opacity, std::uint32_t{row[7]});
    counts.add(row);
  }
  for (int k = 0; k < 3; ++k) {
    low[k] = reduce_warp(low[k], [](float x, float y) { return fminf(x, y); });
    high[k] = reduce_warp(high[k], [](float x, float y) { return fmaxf(x, y); });
    is_sound = is_sound && low[k] == detail::float_of(entry[k]) && high[k] == detail::float_of(entry[4 + k]);
  }
  // All lanes of the warp take part, whatever they have found.
  const auto scale_code = static_cast<std::uint16_t>(warp_max(largest_scale));
  const auto opacity_code = static_cast<std::uint16_t>(warp_max(largest_opacity));
  is_sound = is_sound && 3.f * (float_from_half(scale_code) * a.scale_unit) == detail::float_of(entry[3]) &&  // exact
             float_from_half(opacity_code) == detail::float_of(entry[7]);

  add_count(&out->counts.scale_subnormal, static_cast<std::uint32_t>(counts.scale_subnormal));
  add_count(&out->counts.scale_zero, static_cast<std::uint32_t>(counts.scale_zero));
  add_count(&out->counts.opacity_zero, static_cast<std::uint32_t>(counts.opacity_zero));
  add_count(&out->counts.opacity_one, static_cast<std::uint32_t>(counts.opacity_one));
  const bool is_damaged = __any_sync(kFullWarp, !is_sound) != 0;
  if (lane == 0 && is_damaged) atomicAdd(reinterpret_cast<unsigned long long*>(&out->n_damaged), 1ull);
}

}  // namespace

Status launch_check_values(const CompactAttributes& a, std::uint32_t n, CheckedValues* out, Stream stream) {
  const std::uint32_t n_chunks = (n - 1) / a.chunk_size + 1, blocks = blocks_for(n_chunks, kWarps);
  switch (a.sh_degree) {
    case 0: check_values_kernel<0><<<blocks, kThreads, 0, stream>>>(a, n, n_chunks, out); break;
    case 1: check_values_kernel<1><<<blocks, kThreads, 0, stream>>>(a, n, n_chunks, out); break;
    case 2: check_values_kernel<2><<<blocks, kThreads, 0, stream>>>(a, n, n_chunks, out); break;
    default: check_values_kernel<3><<<blocks, kThreads, 0, stream>>>(a, n, n_chunks, out); break;
  }
  return launched("values could not be checked");
}

}  // namespace rgs::cuda
