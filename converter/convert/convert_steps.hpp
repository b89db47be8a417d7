// convert_steps.hpp - what every way to an .rgs does between reading Gaussians and the file's name.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "convert.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/scene_writer.hpp"
#include "stage_clock.hpp"

namespace rgs {

/// Means that a depth range is found from: an even sample of the kept ones.
inline constexpr std::uint64_t kDepthSample = 65536;  // depth_range_from_cameras would not look at more

/// Sets encode.depth as cameras and ends by hand ask for it. Errors: depth_range_from_cameras()'s.
Status find_depth_range(EncodeOptions& encode, const ConvertOptions& options, const SceneScan& scan,
                        std::span<const float> sample);
/// bad_value: BadPolicy::refuse, and a Gaussian at this byte is damaged.
tl::unexpected<Error> damaged_gaussian(std::uint64_t offset, const SceneScan& scan);
/// bad_argument: there is nothing that levels could be of.
tl::unexpected<Error> nothing_for_levels();
/// What is checked once all is written, and the file's name. Seconds spent in fsync are returned.
Result<double> commit_scene(AtomicFile& file, const WrittenScene& written, const ConvertOptions& options,
                            StageClock& clock);
/// What scan and writer know.
void summarise(ConvertSummary& summary, const SceneScan& scan, WrittenScene&& written);

}  // namespace rgs
