// archive_tables.hpp - section ARCH: parameters, transforms and distributions of Codec::archive; docs/format/ARCHIVE.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "archive/rans.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Where the contexts of each group of planes start.
struct ArchiveContexts {
  ArchiveContexts(Codec codec, std::size_t n_classes, std::size_t n_sh) {
    if (codec == Codec::archive) {
      opacity = kTreeContexts;
      coarse = opacity + 1;
      fine = coarse + 16 + 256 + 4096;
      turn = fine + 3 * kStepContexts;
      dc = turn + 3 * kStepContexts;
    } else {
      opacity = n_classes;
      largest = 2 * n_classes;
      rotation = largest + 1;
      scale0 = rotation + 12 * n_classes;
      scale1 = scale0 + 8 * n_classes;
      scale2 = scale1 + 128 * n_classes;
      dc = scale2 + 256 * n_classes;
    }
    sh = dc + 24 * n_classes;
    count = sh + 8 * n_sh * n_classes;
  }
  static constexpr std::size_t kTreeContexts = 28;
  std::size_t opacity = 0, dc = 0, sh = 0, count = 0;
  std::size_t coarse = 0, fine = 0, turn = 0;                                 // Codec::archive
  std::size_t largest = 0, rotation = 0, scale0 = 0, scale1 = 0, scale2 = 0;  // Codec::archive_draco
};

/// Bytes of ARCH before its classes, and of a class.
inline constexpr std::size_t kArchiveFixedBytes = 128;
constexpr std::size_t archive_class_bytes(Codec codec) {
  return codec == Codec::archive ? 24 : 36;
}
inline constexpr int kMatrixBits = 14;  ///< matrices are multiplied by 2^14

struct ArchiveTables {
  ArchiveParameters parameters;
  std::size_t n_sh = 0;  ///< coefficients above degree 0, all channels: 0, 9, 24, 45
  std::array<float, 3> dc_centre{};
  std::vector<float> sh_centre;              ///< [n_sh]
  std::array<std::int16_t, 9> dc_matrix{};   ///< [3, 3]
  std::array<std::int16_t, 6> dc_weights{};  ///< [3, 2], multiplied by 2^8; Codec::archive_draco
  float sh_unit = 1;                         ///< of values above degree 0; this and the next two: Codec::archive
  /// Of the prediction from the Gaussians before, multiplied by 2^8: the share of the last one, and of all before it.
  using Smoothing = ArchiveRules::Smoothing;
  Smoothing dc_smoothing{}, sh_smoothing{};
  std::vector<std::int16_t> sh_matrix;     ///< [n_sh, n_sh]
  std::vector<std::uint16_t> opacity;      ///< [opacity_levels + 1] FP16; Codec::archive
  std::vector<std::uint8_t> map;           ///< [contexts().count]
  std::vector<std::uint16_t> frequencies;  ///< [n_distributions, kRansTokens]
  RansTables rans;                         ///< of frequencies, once parsed

  std::size_t n_distributions() const { return frequencies.size() / kRansTokens; }
  ArchiveContexts contexts() const { return ArchiveContexts(parameters.codec, parameters.classes.size(), n_sh); }
};

/// SH coefficients above degree 0, all channels.
constexpr std::size_t archive_sh_count(int degree) {
  return static_cast<std::size_t>(3 * (sh_coefficients(degree) - 1));
}

std::uint64_t memory_bytes(const ArchiveTables& tables);

/// Of Codec::archive, the only one that is written.
std::vector<std::byte> write_archive_tables(const ArchiveTables& tables);
/// `offset`: of the section in the file. Safe on untrusted bytes. Errors: size_mismatch, reserved_bits, bad_value,
/// corrupt_data.
Result<ArchiveTables> parse_archive_tables(std::span<const std::byte> bytes, std::uint64_t offset, Codec codec,
                                           int sh_degree);

}  // namespace rgs::detail
