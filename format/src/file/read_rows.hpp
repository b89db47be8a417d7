// read_rows.hpp - decodes rows to Gaussians, one at a time.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "rgs/decode.hpp"
#include "rgs/layout.hpp"

namespace rgs::detail {

/// Arrays of MEAN, GEOM and SHI8.
struct RowArrays {
  std::span<const std::byte> means, geometry, sh;
};

/// Reads rows with the steps of their chunk.
class RowReader {
 public:
  RowReader(int sh_degree, int scale_exponent, const RowArrays& arrays);
  /// SH steps of the next rows.
  void use(const ShStepSet& steps);
  void read(std::uint64_t row, Splat& out);
  void read(std::uint64_t row, ActivatedSplat& out);

 private:
  void load(std::uint64_t row);
  void read_sh(float* sh) const;
  RowArrays arrays_;
  std::uint64_t stride_;  // of SH
  int floats_;            // SH values in use
  int scale_exponent_;
  // One row, aligned, with its chunk's steps by coefficient and channel.
  float mean_[3] = {};
  std::uint16_t geometry_[8] = {};
  std::int8_t sh_[48] = {};
  float step_[48] = {};
};

}  // namespace rgs::detail
