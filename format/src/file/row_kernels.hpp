// row_kernels.hpp - loops over stored rows, compiled for several instruction sets: what they hold, and whether it is legal.
// SPDX-License-Identifier: Apache-2.0
//
// Rows need no alignment, and no byte beyond them is read.
#pragma once

#include <cstddef>
#include <cstdint>

#include "rgs/layout.hpp"
#include "rgs/stored_values.hpp"

namespace rgs::detail {

/// What some rows of MEAN and GEOM hold.
struct RowSummary {
  Box means;                                             ///< without -0
  std::uint16_t largest_scale = 0, largest_opacity = 0;  ///< FP16 bits, compared as integers
  ValueCounts counts;
};

/// Which bits each byte of SH rows may have, of as many rows as are a multiple of every vector.
struct ShRowMask {
  static constexpr std::size_t kMostBytes = 448;  // 16 rows of 28

  std::uint8_t bits[kMostBytes];
  std::size_t bytes = 0;  ///< a multiple of 64

  ShRowMask(const ShStepSet& steps, int sh_degree);
};

/// A page's box, and scales as they are stored.
struct BoxInFp32 {
  float min[3], max[3];
  float unit, units;  ///< 2^-scale_exponent and its inverse
};

struct RowKernels {
  /// Of n > 0 rows, all but the counts. False, with `summary` undefined, where a mean is not finite. Rows of GEOM may hold any bits.
  bool (*summarize)(const std::byte* means, const std::byte* geometry, std::size_t n, RowSummary& summary);
  /// Of n > 0 rows. True only if all are legal; may be false, too, where a rotation's norm is all but at the end of what is legal. Then
  /// `summary` is undefined.
  bool (*check)(const std::byte* means, const std::byte* geometry, std::size_t n, RowSummary& summary);
  /// Whether SH rows of `bytes` bytes have no bits but the mask's, and no code is -128.
  bool (*check_sh)(const std::byte* rows, std::size_t bytes, const ShRowMask& mask);
  /// Bit i, of `count` <= 64 legal rows: kExtentShare of Gaussian i's extent is in the box, however extent_of() is rounded. A bit
  /// that is not set says nothing.
  std::uint64_t (*in_box)(const BoxInFp32& box, const std::byte* means, const std::byte* geometry, std::size_t count);
};

/// For the machine that this runs on. All give the same but for what `check` and `in_box` leave open.
const RowKernels& row_kernels();

}  // namespace rgs::detail
