// row_kernels.hpp - loops over stored rows, compiled for several instruction sets: summarise and check them.
// SPDX-License-Identifier: Apache-2.0
//
// Rows need no alignment, and no byte beyond them is read.
#pragma once

#include <cstddef>
#include <cstdint>

#include "rgs/layout.hpp"
#include "rgs/stored_values.hpp"

namespace rgs::detail {

/// Summary of some rows of MEAN and GEOM.
struct RowSummary {
  Box means;                                             ///< without -0
  std::uint16_t largest_scale = 0, largest_opacity = 0;  ///< FP16 bits, compared as integers
  ValueCounts counts;
};

/// Bits that each byte of SH rows may have, for a number of rows that is a multiple of every vector.
struct ShRowMask {
  static constexpr std::size_t kMostBytes = 448;  // 16 rows of 28

  std::uint8_t bits[kMostBytes];
  std::size_t bytes = 0;  ///< a multiple of 64

  ShRowMask(const ShStepSet& steps, int sh_degree);
};

/// A page's box, in units of stored scales.
struct BoxInFp32 {
  float min[3], max[3];
  float unit, units;  ///< 2^-scale_exponent and its inverse
};

struct RowKernels {
  /// All but the counts, of n > 0 rows. False, with `summary` undefined, if a mean is not finite. Rows of GEOM may hold
  /// any bits.
  bool (*summarize)(const std::byte* means, const std::byte* geometry, std::size_t n, RowSummary& summary);
  /// Of n > 0 rows. True only if all are legal; may be false for a rotation whose norm is almost at its limit.
  /// `summary` is then undefined.
  bool (*check)(const std::byte* means, const std::byte* geometry, std::size_t n, RowSummary& summary);
  /// Whether SH rows of `bytes` bytes have only bits of the mask, and no code is -128.
  bool (*check_sh)(const std::byte* rows, std::size_t bytes, const ShRowMask& mask);
  /// Bit i, for `count` <= 64 legal rows: kExtentShare of Gaussian i's extent is in the box, however extent_of() is
  /// rounded. A clear bit means nothing.
  std::uint64_t (*in_box)(const BoxInFp32& box, const std::byte* means, const std::byte* geometry, std::size_t count);
};

/// For this machine. All give the same results, up to what `check` and `in_box` leave open.
const RowKernels& row_kernels();

}  // namespace rgs::detail
