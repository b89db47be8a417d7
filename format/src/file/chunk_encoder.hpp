// chunk_encoder.hpp - the Gaussians of one chunk to their rows and their entry in the chunk table.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>

#include "file/value_counts.hpp"
#include "rgs/layout.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

/// A chunk's entry, from its Gaussians as they are stored.
class ChunkSummary {
 public:
  void add(const float mean[3], const std::uint16_t geometry[8]) {
    for (std::size_t k = 0; k < 3; ++k) {
      const float x = mean[k] + 0.f;  // boxes hold no -0
      means_.min[k] = count_ == 0 ? x : std::min(means_.min[k], x);
      means_.max[k] = count_ == 0 ? x : std::max(means_.max[k], x);
      largest_scale_ = std::max(largest_scale_, geometry[4 + k]);
    }
    largest_opacity_ = std::max(largest_opacity_, geometry[7]);
    ++count_;
  }
  /// step_set stays 0.
  ChunkEntry entry(int scale_exponent) const {
    // The radius is exact: 11-bit times 2-bit significand.
    return {means_, 3.f * dequantize_scale(largest_scale_, scale_exponent), float_from_half(largest_opacity_), 0,
            count_};
  }

 private:
  Box means_;
  std::uint32_t count_ = 0;
  std::uint16_t largest_scale_ = 0, largest_opacity_ = 0;  // FP16 bits of non-negative numbers order as the numbers do
};

/// Steps for the SH of these Gaussians alone.
ShStepSet chunk_steps(std::span<const Splat> splats, int sh_degree);

/// `splats`: a chunk's, sound. Outputs: means [n * 12], geometry [n * 16], sh [n * sh_bytes(sh_degree)].
ChunkEntry encode_chunk(std::span<const Splat> splats, int sh_degree, int scale_exponent, const ShStepSet& steps,
                        std::byte* means, std::byte* geometry, std::byte* sh, ValueCounts& counts);

}  // namespace rgs::detail
