// encode_plan.hpp - what is known of a file before its Gaussians are encoded.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "rgs/encode.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_scan.hpp"

namespace rgs::detail {

struct EncodePlan {
  EncodeOptions options;  ///< profile: packed instead of archive if there is nothing to fit steps to
  Header header;          ///< file_bytes still 0
  Declarations declarations;
  ShStepSet file_steps;                ///< the only set, unless chunks have their own
  std::vector<SectionEntry> sections;  ///< in file order; stored_bytes: the most that it can take; hashes and offsets 0

  /// Gaussians a frame of MEAN, GEOM and SHI8 where they are coded: whole chunks, at least one.
  std::uint32_t frame_rows() const;
  std::uint64_t n_frames() const { return (header.n_gaussians + frame_rows() - 1) / frame_rows(); }
};

/// Errors: check_encodable()'s.
Result<EncodePlan> make_plan(const SceneScan& scan, const EncodeOptions& options);

}  // namespace rgs::detail
