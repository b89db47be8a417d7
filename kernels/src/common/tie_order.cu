// tie_order.cu - sorts a scene's Gaussians in tie order, once, at its upload.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/tie_order.hpp
// In/Out  attributes [n] -> order [n], rank [n]
// Cost    n log2 n comparisons of 4 B each, gathered, mostly from L1 and L2; more if values are equal, at most all values of both
//         Gaussians. 8 B written a Gaussian
// Launch  CUB's merge sort of indices; 256 threads, one an index, for the inverse. launch_chosen_ties() sorts, in every frame, what
//         it draws of a streamed scene
// Order   deterministic: the order is total. Compiled without contraction to FMA, so that rotations equal the CPU's to the bit
//
// A radix sort by each value in turn would take a pass over all Gaussians for values that hardly ever decide: 59 of
// them at SH degree 3. Comparisons read only what they need, and are the CPU's.
#include <thrust/iterator/counting_iterator.h>
#include <cub/device/device_merge_sort.cuh>

#include "common/launch.cuh"
#include "common/tie_order.hpp"
#include "common/tie_values.cuh"
#include "rgs/math/tie_order.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;

// Not inlined: the sort unrolls hundreds of comparisons.
template <class A>
struct TiesBefore {
  TieValues<A> values;

  __device__ __noinline__ bool operator()(std::uint32_t a, std::uint32_t b) const {
    return math::ties_before(values, a, b);
  }
};

// The same for drawn rows.
struct ChosenTiesBefore {
  ChosenRows rows;

  __device__ __noinline__ bool operator()(std::uint32_t a, std::uint32_t b) const {
    return chosen_ties_before(rows, a, b);
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

__global__ void __launch_bounds__(kThreads) rows_kernel(ChosenRows chosen, std::uint32_t n, std::uint32_t* order) {
  const std::uint32_t k = blockIdx.x * kThreads + threadIdx.x;
  if (k < n) order[k] = chosen_row(chosen, order[k]);
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
  const std::uint32_t n = a.n_chunks * a.rows.attributes.chunk_size;
  if (n == 0) return {};
  std::size_t bytes = a.temporary_bytes;
  const auto ok = checked(sort_by(ChosenTiesBefore{a.rows}, n, a.order, a.temporary, bytes, stream),
                          "the sort of drawn rows by tie order could not be launched");
  if (!ok) return ok;
  if (a.rank == nullptr) {
    rows_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(a.rows, n, a.order);
  } else {
    inverse_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(a.order, n, a.rank);
  }
  return launched("the tie order of drawn rows could not be completed");
}

}  // namespace rgs::cuda
