// encode_plan.hpp - a file's shape before its Gaussians are encoded, and its completion afterwards.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "file/chunk_summary.hpp"
#include "file/section_writer.hpp"
#include "rgs/encode.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_writer.hpp"

namespace rgs::detail {

struct EncodePlan {
  EncodeOptions options;  ///< profile: packed instead of archive if there is nothing to fit steps to
  Header header;          ///< file_bytes and n_sections still 0
  Declarations declarations;
  bool mends = false;                  ///< the scan has repaired Gaussians
  std::uint32_t archive_rows = 8192;   ///< preferred frame length of Profile::archive
  ShStepSet file_steps;                ///< the only set, unless chunks have their own
  ShStepSet largest_sh;                ///< magnitudes, by degree and channel
  std::vector<SectionEntry> sections;  ///< in file order; stored_bytes: upper bounds; hashes and offsets 0

  /// Gaussians a coded frame of MEAN, GEOM and SHI8: whole chunks, at least one.
  std::uint32_t frame_rows() const;
  std::uint64_t n_frames() const { return (header.n_gaussians + frame_rows() - 1) / frame_rows(); }
};

/// Errors: check_encodable()'s.
Result<EncodePlan> make_plan(const SceneScan& scan, const EncodeOptions& options);

/// Positions in the source of the given Gaussians; empty if they are not kept.
std::vector<std::uint32_t> positions_in_source(std::span<const std::uint32_t> given, const EncodeOptions& options);

/// A file's contents besides the rows or frames of its Gaussians.
struct SceneTables {
  std::vector<ChunkEntry> chunks;  ///< in file order
  std::vector<ShStepSet> steps;    ///< of each chunk
  ValueCounts counts;
  std::span<const std::uint32_t> source_index;  ///< of each Gaussian
  std::span<const std::byte> archive;           ///< content of ARCH
};

/// Places all sections and writes the head, once the Gaussians are in `file`.
Result<WrittenScene> finish_file(SectionWriter& file, const EncodePlan& plan, const SceneTables& tables);

}  // namespace rgs::detail
