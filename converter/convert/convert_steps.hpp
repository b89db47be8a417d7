// convert_steps.hpp - steps common to all conversions to .rgs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "convert.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/scene_writer.hpp"
#include "stage_clock.hpp"

namespace rgs {

/// How many means determine a depth range: an even sample of the kept ones.
inline constexpr std::uint64_t kDepthSample = 65536;  // the limit of depth_range_from_cameras()

/// Sets encode.depth from cameras and explicit ends, and encode.first_view from cameras or, if it is none, the scene;
/// then drops the scan's sample.
/// Errors: depth_range_from_cameras()'s.
Status find_views(EncodeOptions& encode, const ConvertOptions& options, SceneScan& scan, std::span<const float> sample);
/// bad_value: BadPolicy::refuse, and a Gaussian at this byte is damaged.
tl::unexpected<Error> damaged_gaussian(std::uint64_t offset, const SceneScan& scan);
/// bad_argument: a scene without Gaussians has no levels.
tl::unexpected<Error> nothing_for_levels();
/// limit_exceeded: an archive with levels of so many leaves takes more memory than this.
Status check_archive_memory(const EncodeOptions& encode, std::uint64_t n_leaves, std::uint64_t memory_bytes);
/// An error of writing levels: if it is about one Gaussian, with that leaf's position in the source, if it is known.
Error of_source(Error error, std::span<const std::uint32_t> positions);
/// Final checks, then renames the file. Returns the seconds spent in fsync.
Result<double> commit_scene(AtomicFile& file, const WrittenScene& written, const ConvertOptions& options,
                            StageClock& clock);
/// Fills in what scan and writer know.
void summarise(ConvertSummary& summary, const SceneScan& scan, WrittenScene&& written);

}  // namespace rgs
