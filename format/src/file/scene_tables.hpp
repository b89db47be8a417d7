// scene_tables.hpp - what a scene's file has beside the rows or frames of its Gaussians.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "file/encode_plan.hpp"
#include "file/section_writer.hpp"
#include "file/value_counts.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_writer.hpp"

namespace rgs::detail {

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
