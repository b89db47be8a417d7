// drawn_rows.cuh - maps the Gaussians of a frame to their rows of the scene.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <type_traits>

#include "common/attributes.hpp"
#include "common/cut.hpp"

namespace rgs::cuda {

/// Number of drawn rows, in whole chunks; 0 if they did not fit.
__device__ inline std::uint32_t n_drawn_rows(const DrawnChunks& drawn, std::uint32_t chunk_size) {
  const std::uint32_t n = drawn.counts->chunks;
  return n <= drawn.capacity ? n * chunk_size : 0;
}

__device__ inline std::uint32_t drawn_row(const DrawnChunks& drawn, std::uint32_t chunk_size, std::uint32_t i) {
  const std::uint32_t chunk = i / chunk_size;
  return __ldg(drawn.chunks + chunk) * chunk_size + (i - chunk * chunk_size);
}

/// Row of the frame's Gaussian i: with levels its drawn row, else itself.
template <class A>
__device__ inline std::uint32_t row_of(const A& attributes, const DrawnChunks& drawn, std::uint32_t i) {
  if constexpr (std::is_same_v<A, PagedAttributes>) return drawn_row(drawn, attributes.chunk_size, i);
  return i;
}

}  // namespace rgs::cuda
