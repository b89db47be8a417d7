// archive_rules.hpp - section ARCH of Codec::archive as decoders on a device read it; docs/format/ARCHIVE.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/hd.hpp"
#include "rgs/layout.hpp"

namespace RGS_API rgs {

namespace detail {

inline constexpr std::uint32_t kRansStates = 8;
inline constexpr std::uint32_t kRansLow = 1u << 16;  ///< lower bound of states between numbers
inline constexpr std::uint32_t kRansTokens = 76;
inline constexpr std::uint32_t kRansTotal = 4096;
inline constexpr std::uint8_t kMostRawBits = 12;  ///< of a number in a plane of bits of the tree

/// Numbers 0 1 2 3 4 to signed codes 0 -1 1 -2 2.
RGS_HD constexpr std::int16_t unfold_code(std::uint32_t z) {
  return static_cast<std::int16_t>(static_cast<std::uint16_t>(z >> 1 ^ (0u - (z & 1u))));
}

/// Context of the count of a cell of n points.
RGS_HD constexpr std::uint32_t tree_context(std::uint32_t n) {
  return n < 16 ? n : 11 + static_cast<std::uint32_t>(std::bit_width(n));
}

inline constexpr std::uint32_t kStepContexts = 32;  ///< of a plane whose context is a step

}  // namespace detail

/// What a file's section ARCH says, in its units (ShapeParameters: 1/65536 octaves). Arrays lie in a block; here are their
/// offsets in bytes, multiples of 16.
struct ArchiveRules {
  struct Smoothing {
    std::uint8_t recent, kept;
  };
  /// Small, so that those of a plane stay near the processor.
  struct Distribution {
    static constexpr std::uint32_t kSlots = 64;
    std::array<std::uint8_t, detail::kRansTotal / kSlots> first;  ///< token of every 64th slot
    std::array<std::uint32_t, detail::kRansTokens> frequency;  ///< of each token, and from bit 16 on the sum before it
  };
  struct Class {
    std::int32_t dc_step, sh_units;
  };
  ShapeParameters shape;
  double centre[3], half_width[3];
  std::uint32_t mean_cells, mean_bits, opacity_levels, n_classes, n_sh;
  float dc_centre[3], sh_unit;
  std::int16_t dc_matrix[9];
  Smoothing dc_smoothing, sh_smoothing;
  struct {
    std::uint32_t opacity, coarse, fine, turn, dc, sh;
  } context;                    ///< the first of each group of planes
  std::uint32_t distributions;  ///< Distribution [T]
  std::uint32_t map;            ///< u8 [contexts]
  std::uint32_t classes;        ///< Class [n_classes]
  std::uint32_t opacities;      ///< FP16 [opacity_levels + 1]
  std::uint32_t sh_matrix;      ///< i16 [n_sh, n_sh]
  std::uint32_t sh_centre;      ///< FP32 [n_sh]
};

/// Of an open file, checked, whose Gaussians have Codec::archive; `block` becomes what the offsets refer to. Throws
/// std::bad_alloc alone.
ArchiveRules archive_rules(const FileView& view, std::vector<std::byte>& block);

}  // namespace rgs
