// tie_order.cu - a scene's Gaussians in tie order: one sort when it comes to the device.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/tie_order.hpp
// In/Out  attributes [n] -> order [n], rank [n]
// Cost    n log2 n comparisons of 4 B each and gathered, mostly from L1 and L2; more where values are equal, at most all of
//         both Gaussians. 8 B written a Gaussian
// Launch  CUB's merge sort of indices; 256 threads, one an index, for the inverse. launch_chosen_ties() sorts what one frame of a streamed
//         scene draws, in that frame
// Order   deterministic: the order is total. Compiled without contraction to FMA, so that rotations are those of the CPU to
//         the bit
//
// A radix sort by each value in turn, the last one first, would take a pass of all Gaussians for values that hardly ever
// decide: 59 of them in SH degree 3. Comparisons look at what they need, and are the CPU's.
#include <thrust/iterator/counting_iterator.h>
#include <cub/device/device_merge_sort.cuh>

#include "common/launch.cuh"
#include "common/load_splat.cuh"
#include "common/tie_order.hpp"
#include "rgs/math/tie_order.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;

__device__ inline float load_sh(const Fp32Attributes& a, std::uint32_t i, int k) {
  const int n_sh = 3 * (a.sh_degree + 1) * (a.sh_degree + 1);
  return __ldg(a.sh + static_cast<std::uint64_t>(i) * static_cast<std::uint32_t>(n_sh) + k);
}

__device__ inline float load_sh(const CompactAttributes& a, std::uint32_t i, int k) {
  const int n_words = (3 * (a.sh_degree + 1) * (a.sh_degree + 1) + 3) / 4;
  const std::uint32_t word = __ldg(a.sh + static_cast<std::uint64_t>(i) * static_cast<std::uint32_t>(n_words) + k / 4);
  const int coefficient = k / 3, degree = coefficient < 1 ? 0 : coefficient < 4 ? 1 : coefficient < 9 ? 2 : 3;
  // Entry of CHNK: its index of a step set lies at byte 32.
  const std::uint32_t set = __ldg(a.chunks + 12 * (i / a.chunk_size) + 8);
  return dequantize_sh(static_cast<std::int8_t>(word >> 8 * (k % 4)),
                       __ldg(a.sh_steps + 12 * set + static_cast<std::uint32_t>(3 * degree + k % 3)));
}

// Attributes as the tie order reads them.
template <class A>
struct TieValues {
  A attributes;

  __device__ float mean(std::uint32_t i, int axis) const {
    return __ldg(attributes.mean + 3 * static_cast<std::uint64_t>(i) + axis);
  }
  __device__ float opacity(std::uint32_t i) const { return load_geometry(attributes, i).opacity; }
  __device__ math::Vec3<float> scale(std::uint32_t i) const { return load_geometry(attributes, i).scale; }
  __device__ math::Quaternion<float> rotation(std::uint32_t i) const { return load_geometry(attributes, i).rotation; }
  __device__ int n_sh() const { return 3 * (attributes.sh_degree + 1) * (attributes.sh_degree + 1); }
  __device__ float sh(std::uint32_t i, int k) const { return load_sh(attributes, i, k); }
};

// Not inlined: the sort unrolls hundreds of comparisons.
template <class A>
struct TiesBefore {
  TieValues<A> values;

  __device__ __noinline__ bool operator()(std::uint32_t a, std::uint32_t b) const {
    return math::ties_before(values, a, b);
  }
};

// The same of drawn rows, by the rows that they are.
struct ChosenTiesBefore {
  TieValues<PagedAttributes> values;
  const std::uint32_t* chunks;

  __device__ __noinline__ bool operator()(std::uint32_t a, std::uint32_t b) const {
    const int c = math::compare_ties(values, row(a), row(b));
    return c != 0 ? c < 0 : a < b;
  }
  __device__ std::uint32_t row(std::uint32_t i) const {
    const std::uint32_t size = values.attributes.chunk_size, k = i / size;
    return __ldg(chunks + k) * size + (i - k * size);
  }
};

template <class Before>
cudaError_t sort_by(const Before& before, std::uint32_t n, std::uint32_t* order, void* temporary, std::size_t& bytes,
                    Stream stream) {
  return cub::DeviceMergeSort::SortKeysCopy(temporary, bytes, thrust::counting_iterator<std::uint32_t>(0), order, n,
                                            before, stream);
}
template <class A>
cudaError_t sort(const A& attributes, std::uint32_t n, std::uint32_t* order, void* temporary, std::size_t& bytes,
                 Stream stream) {
  return sort_by(TiesBefore<A>{{attributes}}, n, order, temporary, bytes, stream);
}

__global__ void __launch_bounds__(kThreads)
    rows_kernel(ChosenTiesBefore chosen, std::uint32_t n, std::uint32_t* order) {
  const std::uint32_t k = blockIdx.x * kThreads + threadIdx.x;
  if (k < n) order[k] = chosen.row(order[k]);
}

__global__ void __launch_bounds__(kThreads)
    inverse_kernel(const std::uint32_t* permutation, std::uint32_t n, std::uint32_t* inverse) {
  const std::uint32_t k = blockIdx.x * kThreads + threadIdx.x;
  if (k < n) inverse[permutation[k]] = k;
}

}  // namespace

Result<std::uint64_t> tie_order_bytes(std::uint32_t n) {
  std::size_t fp32 = 0, compact = 0, chosen = 0;
  auto ok = checked(sort(Fp32Attributes{}, n, nullptr, nullptr, fp32, nullptr),
                    "the size of the tie order's temporary memory is unknown");
  if (ok) {
    ok = checked(sort(CompactAttributes{}, n, nullptr, nullptr, compact, nullptr),
                 "the size of the tie order's temporary memory is unknown");
  }
  if (ok) {
    ok = checked(sort_by(ChosenTiesBefore{}, n, nullptr, nullptr, chosen, nullptr),
                 "the size of the tie order's temporary memory is unknown");
  }
  if (!ok) return tl::unexpected(ok.error());
  return math::max(math::max(fp32, compact), chosen);
}

Status launch_tie_order(const TieOrderArguments& a, Stream stream) {
  if (a.n == 0) return {};
  std::size_t bytes = a.temporary_bytes;
  const auto ok = checked(
      std::visit([&](const auto& attributes) { return sort(attributes, a.n, a.order, a.temporary, bytes, stream); },
                 a.attributes),
      "the tie order's sort could not be launched");
  if (!ok) return ok;
  inverse_kernel<<<blocks_for(a.n, kThreads), kThreads, 0, stream>>>(a.order, a.n, a.rank);
  return launched("the inverse of the tie order could not be launched");
}

Status launch_chosen_ties(const ChosenTiesArguments& a, Stream stream) {
  const std::uint32_t n = a.n_chunks * a.attributes.chunk_size;
  if (n == 0) return {};
  const ChosenTiesBefore chosen{{a.attributes}, a.chunks};
  std::size_t bytes = a.temporary_bytes;
  const auto ok = checked(sort_by(chosen, n, a.order, a.temporary, bytes, stream),
                          "the sort of drawn rows by tie order could not be launched");
  if (!ok) return ok;
  if (a.rank == nullptr) {
    rows_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(chosen, n, a.order);
  } else {
    inverse_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(a.order, n, a.rank);
  }
  return launched("the tie order of drawn rows could not be completed");
}

}  // namespace rgs::cuda
