// packed.hpp - what the encoder's profiles share.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/encode.hpp"

namespace rgs::detail {

/// Decoded bytes of DECL, SHSC, CHNK or PROV.
std::vector<std::byte> small_section(const EncodePlan& plan, SectionType type, std::span<const ChunkEntry> chunks,
                                     std::span<const ShStepSet> scales, const EncodeCounts& counts);

/// Frames of a large section, one behind the other.
struct FrameBytes {
  std::vector<CodedFrame> frames;
  std::vector<std::byte> bytes;
  void append(std::span<const std::byte> frame);
};

/// The whole file of a profile that codes frames. `tables`: content of ARCH, for Profile::archive.
struct FramedFile {
  FrameBytes means, geometry, sh;
  std::span<const std::byte> permutation, tables;
  std::span<const ChunkEntry> chunks;
  std::span<const ShStepSet> scales;
  EncodeCounts counts;
};
std::vector<std::byte> assemble_frames(const EncodePlan& plan, FramedFile file);

/// What a coded section of this size can take at most: noise is stored as it is, with Zstandard's and our own headers.
constexpr std::uint64_t coded_bound(std::uint64_t decoded_bytes, std::uint64_t n_frames) {
  return decoded_bytes + decoded_bytes / 128 + 4096 * n_frames + 64;
}

}  // namespace rgs::detail
