// chunk_summary.hpp - computes a chunk's entry from its stored rows.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "file/row_kernels.hpp"
#include "rgs/layout.hpp"
#include "rgs/quantize.hpp"
#include "rgs/stored_values.hpp"

namespace rgs::detail {

/// A chunk's entry, from the mean and the row of GEOM of each of its Gaussians.
class ChunkSummary {
 public:
  void add(const float mean[3], const std::uint16_t geometry[8], ValueCounts& counts) {
    for (std::size_t k = 0; k < 3; ++k) {
      const float x = mean[k] + 0.f;  // boxes hold no -0
      entry_.means.min[k] = entry_.count == 0 ? x : std::min(entry_.means.min[k], x);
      entry_.means.max[k] = entry_.count == 0 ? x : std::max(entry_.means.max[k], x);
      largest_scale_ = std::max(largest_scale_, geometry[4 + k]);
    }
    counts.add(geometry);
    largest_opacity_ = std::max(largest_opacity_, geometry[7]);
    ++entry_.count;
  }
  /// A whole chunk of n > 0 Gaussians, by their rows of MEAN and GEOM.
  void set(const std::byte* means, const std::byte* geometry, std::uint32_t n) {
    RowSummary rows;
    if (row_kernels().summarize(means, geometry, n, rows)) {
      entry_.means = rows.means;
      entry_.count = n;
      largest_scale_ = rows.largest_scale, largest_opacity_ = rows.largest_opacity;
      return;
    }
    ValueCounts counts;
    for (std::size_t i = 0; i < n; ++i) {
      float mean[3];
      std::uint16_t row[8];
      std::memcpy(mean, means + i * kMeanBytes, sizeof mean);
      std::memcpy(row, geometry + i * kGeometryBytes, sizeof row);
      add(mean, row, counts);
    }
  }
  /// The caller fills in step_set.
  ChunkEntry entry(int scale_exponent) {
    entry_.radius = 3.f * dequantize_scale(largest_scale_, scale_exponent);  // exact: 11-bit times 2-bit significand
    entry_.max_opacity = float_from_half(largest_opacity_);
    return entry_;
  }

 private:
  ChunkEntry entry_;
  std::uint16_t largest_scale_ = 0, largest_opacity_ = 0;  // FP16 bits of non-negative numbers order as the numbers do
};

}  // namespace rgs::detail
