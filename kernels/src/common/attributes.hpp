// attributes.hpp - Gaussians in device memory. All pointers are device pointers.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <variant>

namespace rgs::cuda {

/// Activated FP32 attributes, 236 bytes a Gaussian at SH degree 3: the layout of the original rasteriser.
struct Fp32Attributes {
  const float* mean;      ///< [n, 3] world units
  const float* rotation;  ///< [n, 4] unit quaternions w, x, y, z; 16-byte aligned
  const float* scale;     ///< [n, 3] standard deviations, world units
  const float* opacity;   ///< [n] 0..1
  const float* sh;        ///< [n, (sh_degree + 1)^2, 3]; 16-byte aligned
  int sh_degree;
};

/// The sections of an .rgs file as on disk (docs/format/FORMAT.md), 76 bytes a Gaussian at SH degree 3. Every pointer
/// is 16-byte aligned.
struct CompactAttributes {
  const float* mean;              ///< MEAN [n, 3]
  const std::uint16_t* geometry;  ///< GEOM [n, 8] FP16 rotation w, x, y, z, scale * 2^E, opacity
  const std::uint32_t* sh;        ///< SHI8 [n, sh_words] INT8 codes, coefficient-major
  const float* sh_steps;          ///< SHSC [n_sets, 4, 3]
  const std::uint32_t* chunks;    ///< CHNK [n_chunks, 12]
  std::uint32_t chunk_size;       ///< multiple of 32
  float scale_unit;               ///< 2^-E
  int sh_degree;
};

/// Pages of a scene with levels of detail; each starts with a new chunk of chunk_size rows, and the last chunk of a
/// page may end with padding, whose means are NaN. Entries of CHNK count step sets over all pages and hold the page's
/// 2^-E in their last word; scale_unit is not used. common/cut.hpp chooses the chunks of a frame.
struct PagedAttributes : CompactAttributes {};

using Attributes = std::variant<Fp32Attributes, CompactAttributes, PagedAttributes>;

}  // namespace rgs::cuda
