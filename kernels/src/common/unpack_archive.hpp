// unpack_archive.hpp - launches that decode frames of Codec::archive to rows on the device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "common/attributes.hpp"
#include "common/frame.hpp"
#include "rgs/archive_rules.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Streams of one frame; `at`: offsets in `coded`, multiples of 4.
struct ArchiveFrame {
  struct Stream {
    std::uint64_t at;
    std::uint32_t bytes;
  };
  Stream means, geometry, sh;
};

struct UnpackArchiveArguments {
  ArchiveRules rules;
  const std::byte* block;       ///< that of archive_rules()
  const std::byte* coded;       ///< streams
  const ArchiveFrame* frames;   ///< [n_frames]
  std::uint32_t n, frame_rows;  ///< rows of the scene, > 0, and of a frame
  int scale_exponent;
  float* mean;                  ///< MEAN [n, 3]
  std::uint16_t* geometry;      ///< GEOM [n, 8], 16-byte aligned
  std::uint32_t* sh;            ///< SHI8 [n, sh_bytes / 4]
  const float* sh_steps;        ///< SHSC
  const std::uint32_t* chunks;  ///< CHNK, valid sets
  std::uint32_t chunk_size;
  int sh_degree;
  std::byte* memory;  ///< for n_at_once frames, 16-byte aligned
  std::uint32_t n_at_once;
  std::uint32_t* n_damaged;  ///< counts frames that do not decode; their rows are any
};
/// Device memory to decode one frame.
std::uint64_t archive_frame_bytes(std::uint32_t frame_rows, int sh_degree);
/// Streams may hold anything. May fail with device_failed.
Status launch_unpack_archive(const UnpackArchiveArguments& arguments, Stream stream);

}  // namespace rgs::cuda
