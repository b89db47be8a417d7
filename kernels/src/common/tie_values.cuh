// tie_values.cuh - reads the values that the tie order compares: of all Gaussians of a scene, or of a frame's drawn
// rows.
// SPDX-License-Identifier: Apache-2.0
//
// Compile includers without contraction to FMA, so that rotations equal the CPU's to the bit.
#pragma once

#include <cstdint>

#include "common/load_splat.cuh"
#include "common/tie_order.hpp"
#include "rgs/math/tie_order.hpp"

namespace rgs::cuda {

__device__ inline float load_sh(const Fp32Attributes& a, std::uint32_t i, int k) {
  const int n_sh = 3 * (a.sh_degree + 1) * (a.sh_degree + 1);
  return __ldg(a.sh + static_cast<std::uint64_t>(i) * static_cast<std::uint32_t>(n_sh) + k);
}

__device__ inline float load_sh(const CompactAttributes& a, std::uint32_t i, int k) {
  const int n_words = (3 * (a.sh_degree + 1) * (a.sh_degree + 1) + 3) / 4;
  const std::uint32_t word = __ldg(a.sh + static_cast<std::uint64_t>(i) * static_cast<std::uint32_t>(n_words) + k / 4);
  const int coefficient = k / 3, degree = coefficient < 1 ? 0 : coefficient < 4 ? 1 : coefficient < 9 ? 2 : 3;
  // Byte 32 of a CHNK entry: its step set.
  const std::uint32_t set = __ldg(a.chunks + 12 * (i / a.chunk_size) + 8);
  return dequantize_sh(static_cast<std::int8_t>(word >> 8 * (k % 4)),
                       __ldg(a.sh_steps + 12 * set + static_cast<std::uint32_t>(3 * degree + k % 3)));
}

/// Attributes in the form that the tie order reads.
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

/// The scene's row of drawn row i.
__device__ inline std::uint32_t chosen_row(const ChosenRows& rows, std::uint32_t i) {
  const std::uint32_t size = rows.attributes.chunk_size, k = i / size;
  return __ldg(rows.chunks + k) * size + (i - k * size);
}

/// math::ties_before() of drawn rows.
__device__ inline bool chosen_ties_before(const ChosenRows& rows, std::uint32_t a, std::uint32_t b) {
  const int c =
      math::compare_ties(TieValues<PagedAttributes>{rows.attributes}, chosen_row(rows, a), chosen_row(rows, b));
  return c != 0 ? c < 0 : a < b;
}

}  // namespace rgs::cuda
