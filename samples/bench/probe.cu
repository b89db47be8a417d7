// probe.cu - measures the device: copy and L2 bandwidth, FP32, special function and shared memory rates.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  nothing -> DeviceRates
// Launch  full occupancy: as many blocks of 256 threads as the device holds at once; the copy has one for 16 KiB
// Shared  Words of 4 KiB in the shared memory probe
// Order   the best of kRuns runs after one that warms caches and clocks
//
// A probe's result must be used, or the compiler removes the probe: every thread ends with a test against a value that
// it cannot have, and would store then. Loads that are to be issued each time are volatile assembly.
#include <algorithm>
#include <bit>
#include <cstdint>
#include <initializer_list>
#include <memory>

#include "common/launch.cuh"
#include "probe.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kRuns = 7;
constexpr int kUnroll = 4;       // 128-bit words in flight a thread: what it takes to fill the memory pipeline
constexpr int kChains = 8;       // independent FMAs or exponentials a thread
constexpr int kSteps = 2048;     // of all chains
constexpr int kSharedLoads = 4;  // a step of the shared memory probe
constexpr std::uint64_t kL2Reads = std::uint64_t{4} << 30;  // bytes that an L2 run reads

struct FreeDevice {
  void operator()(void* memory) const { cudaFree(memory); }
};
using DeviceMemory = std::unique_ptr<void, FreeDevice>;

struct DestroyEvent {
  void operator()(cudaEvent_t event) const { cudaEventDestroy(event); }
};
using Event = std::unique_ptr<CUevent_st, DestroyEvent>;

Result<Event> make_event() {
  cudaEvent_t event = nullptr;
  if (const auto ok = checked(cudaEventCreate(&event), "an event could not be made"); !ok) {
    return tl::unexpected(ok.error());
  }
  return Event(event);
}

DeviceMemory allocate(std::uint64_t bytes) {
  void* memory = nullptr;
  if (cudaMalloc(&memory, bytes) != cudaSuccess) cudaGetLastError();  // the caller tries a smaller size
  return DeviceMemory(memory);
}

// Seconds of the fastest run.
template <class Launch>
Result<double> fastest(const Launch& launch) {
  const auto begin = make_event(), end = make_event();
  if (!begin) return tl::unexpected(begin.error());
  if (!end) return tl::unexpected(end.error());
  float best = 0;
  for (int run = 0; run <= kRuns; ++run) {
    Status ok = checked(cudaEventRecord(begin->get()), "an event could not be recorded");
    if (ok) launch();
    if (ok) ok = launched("a probe could not be launched");
    if (ok) ok = checked(cudaEventRecord(end->get()), "an event could not be recorded");
    if (ok) ok = checked(cudaEventSynchronize(end->get()), "a probe failed");
    float ms = 0;
    if (ok) ok = checked(cudaEventElapsedTime(&ms, begin->get(), end->get()), "a probe has no time");
    if (!ok) return tl::unexpected(ok.error());
    if (run == 1 || (run > 1 && ms < best)) best = ms;
  }
  return 1e-3 * static_cast<double>(best);
}

// The block's threads copy kUnroll words each, side by side.
__global__ void __launch_bounds__(kThreads) copy_kernel(const uint4* from, uint4* to) {
  const std::uint64_t first = static_cast<std::uint64_t>(blockIdx.x) * kThreads * kUnroll + threadIdx.x;
  uint4 words[kUnroll];
#pragma unroll
  for (int k = 0; k < kUnroll; ++k) words[k] = from[first + static_cast<unsigned>(k * kThreads)];
#pragma unroll
  for (int k = 0; k < kUnroll; ++k) to[first + static_cast<unsigned>(k * kThreads)] = words[k];
}

__device__ inline uint4 load_past_l1(const uint4* from) {
  uint4 w;
  asm volatile("ld.global.cg.v4.u32 {%0, %1, %2, %3}, [%4];" : "=r"(w.x), "=r"(w.y), "=r"(w.z), "=r"(w.w) : "l"(from));
  return w;
}

// The grid reads a buffer that fits L2 from its beginning to its end, again and again: mask + 1 words, a power of two.
__global__ void __launch_bounds__(kThreads)
    l2_kernel(const uint4* from, std::uint32_t mask, std::uint32_t steps, std::uint32_t* never) {
  const std::uint32_t stride = gridDim.x * kThreads;
  std::uint32_t at = blockIdx.x * kThreads + threadIdx.x, bits = 0;
  for (std::uint32_t step = 0; step < steps; ++step) {
    uint4 words[kUnroll];
#pragma unroll
    for (int k = 0; k < kUnroll; ++k, at += stride) words[k] = load_past_l1(from + (at & mask));
#pragma unroll
    for (int k = 0; k < kUnroll; ++k) bits |= words[k].x | words[k].y | words[k].z | words[k].w;
  }
  if (bits != 0) *never = bits;  // the buffer holds zeros
}

__global__ void __launch_bounds__(kThreads) fma_kernel(float factor, float term, float* never) {
  float x[kChains];
#pragma unroll
  for (int c = 0; c < kChains; ++c) x[c] = static_cast<float>(threadIdx.x + static_cast<unsigned>(c));
#pragma unroll 4
  for (int step = 0; step < 4 * kSteps; ++step) {
#pragma unroll
    for (int c = 0; c < kChains; ++c) x[c] = fmaf(x[c], factor, term);
  }
  float sum = 0;
#pragma unroll
  for (int c = 0; c < kChains; ++c) sum += x[c];
  if (sum < 0) *never = sum;  // factor and term are positive
}

__device__ inline float exp2_approximate(float x) {
  float y;
  asm volatile("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// x = 2^-x goes to 0.64, so that no chain leaves the range of numbers.
__global__ void __launch_bounds__(kThreads) exp2_kernel(float* never) {
  float x[kChains];
#pragma unroll
  for (int c = 0; c < kChains; ++c) x[c] = static_cast<float>(threadIdx.x + static_cast<unsigned>(c)) * 0x1p-9F;
#pragma unroll 4
  for (int step = 0; step < kSteps; ++step) {
#pragma unroll
    for (int c = 0; c < kChains; ++c) x[c] = exp2_approximate(-x[c]);
  }
  float sum = 0;
#pragma unroll
  for (int c = 0; c < kChains; ++c) sum += x[c];
  if (sum < 0) *never = sum;
}

__device__ inline uint4 load_shared(std::uint32_t address) {
  uint4 w;
  asm volatile("ld.volatile.shared.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(w.x), "=r"(w.y), "=r"(w.z), "=r"(w.w)
               : "r"(address));
  return w;
}

// All lanes of a warp load the same word, as the blending loops do. Of most words only the load happens.
__global__ void __launch_bounds__(kThreads) shared_kernel(std::uint32_t* never) {
  __shared__ uint4 words[kThreads];
  words[threadIdx.x] = {0, 0, 0, 0};
  __syncthreads();
  const auto first = static_cast<std::uint32_t>(__cvta_generic_to_shared(words));
  std::uint32_t bits = 0;
#pragma unroll 1
  for (int step = 0; step < 4 * kSteps; ++step) {
    const std::uint32_t address =
        first + static_cast<std::uint32_t>(step % (kThreads / kSharedLoads)) * kSharedLoads * 16;
    uint4 w{};
#pragma unroll
    for (int k = 0; k < kSharedLoads; ++k) w = load_shared(address + static_cast<unsigned>(16 * k));
    bits |= w.x | w.y | w.z | w.w;
  }
  if (bits != 0) *never = bits;
}

// Both ways of copying; whichever is faster counts.
Result<double> copy_rate() {
  double best = 0;
  for (const std::uint64_t mebibytes : {1024, 512, 256, 64}) {
    const std::uint64_t bytes = mebibytes << 20;
    const DeviceMemory from = allocate(bytes), to = allocate(bytes);
    if (from == nullptr || to == nullptr) continue;
    if (const auto ok = checked(cudaMemset(from.get(), 0, bytes), "the copy probe could not be filled"); !ok) {
      return tl::unexpected(ok.error());
    }
    const auto blocks = static_cast<unsigned>(bytes / (kThreads * kUnroll * sizeof(uint4)));
    const auto kernel = fastest([&] {
      copy_kernel<<<blocks, kThreads>>>(static_cast<const uint4*>(from.get()), static_cast<uint4*>(to.get()));
    });
    if (!kernel) return kernel;
    const auto copy = fastest([&] { cudaMemcpyAsync(to.get(), from.get(), bytes, cudaMemcpyDeviceToDevice, nullptr); });
    if (!copy) return copy;
    best = std::max(best, 2 * static_cast<double>(bytes) / std::min(*kernel, *copy));
    if (mebibytes == 256) break;  // smaller ones would stay in a large L2, and count only where nothing else fits
  }
  if (best == 0)
    return make_error(Errc::device_out_of_memory, Error::kNone, "the copy probe wants 64 MiB twice", 128u << 20);
  return best;
}

Result<double> l2_rate(unsigned blocks, std::uint64_t l2_bytes, std::uint32_t* never) {
  const std::uint64_t largest = std::bit_floor(std::max(l2_bytes / 2, std::uint64_t{1} << 20));
  const DeviceMemory memory = allocate(largest);
  if (memory == nullptr) {
    return make_error(Errc::device_out_of_memory, Error::kNone, "the L2 probe wants half the size of L2", largest);
  }
  if (const auto ok = checked(cudaMemset(memory.get(), 0, largest), "the L2 probe could not be filled"); !ok) {
    return tl::unexpected(ok.error());
  }
  const std::uint64_t step_bytes = static_cast<std::uint64_t>(blocks) * kThreads * kUnroll * sizeof(uint4);
  const auto steps = static_cast<std::uint32_t>(kL2Reads / step_bytes);
  double best = 0;
  for (std::uint64_t bytes = largest; bytes >= largest / 4; bytes /= 2) {
    const auto mask = static_cast<std::uint32_t>(bytes / sizeof(uint4) - 1);
    const auto seconds =
        fastest([&] { l2_kernel<<<blocks, kThreads>>>(static_cast<const uint4*>(memory.get()), mask, steps, never); });
    if (!seconds) return seconds;
    best = std::max(best, static_cast<double>(step_bytes) * steps / *seconds);
  }
  return best;
}

Result<int> attribute(cudaDeviceAttr name, int device) {
  int value = 0;
  const auto ok = checked(cudaDeviceGetAttribute(&value, name, device), "the device does not describe itself");
  if (!ok) return tl::unexpected(ok.error());
  return value;
}

}  // namespace

Result<DeviceRates> measure_rates() {
  int device = 0;
  if (const auto ok = checked(cudaGetDevice(&device), "no CUDA device answers"); !ok) return tl::unexpected(ok.error());
  const auto processors = attribute(cudaDevAttrMultiProcessorCount, device);
  const auto threads = attribute(cudaDevAttrMaxThreadsPerMultiProcessor, device);
  const auto l2_bytes = attribute(cudaDevAttrL2CacheSize, device);
  for (const Result<int>* value : {&processors, &threads, &l2_bytes}) {
    if (!*value) return tl::unexpected(value->error());
  }
  const auto blocks = static_cast<unsigned>(*processors * (*threads / kThreads));
  const double lanes = static_cast<double>(blocks) * kThreads;
  const DeviceMemory never = allocate(sizeof(float));
  if (never == nullptr) return make_error(Errc::device_out_of_memory, Error::kNone, "the probes want four bytes", 4);
  auto* const words = static_cast<std::uint32_t*>(never.get());
  auto* const floats = static_cast<float*>(never.get());

  const auto copy = copy_rate();
  if (!copy) return tl::unexpected(copy.error());
  const auto l2 = l2_rate(blocks, static_cast<std::uint64_t>(*l2_bytes), words);
  if (!l2) return tl::unexpected(l2.error());
  const auto fma = fastest([&] { fma_kernel<<<blocks, kThreads>>>(0.999F, 0.001F, floats); });
  if (!fma) return tl::unexpected(fma.error());
  const auto exp2 = fastest([&] { exp2_kernel<<<blocks, kThreads>>>(floats); });
  if (!exp2) return tl::unexpected(exp2.error());
  const auto shared = fastest([&] { shared_kernel<<<blocks, kThreads>>>(words); });
  if (!shared) return tl::unexpected(shared.error());
  return DeviceRates{*copy, *l2, lanes * kChains * 4 * kSteps / *fma, lanes * kChains * kSteps / *exp2,
                     lanes / 32 * kSharedLoads * 4 * kSteps / *shared};
}

}  // namespace rgs::cuda
