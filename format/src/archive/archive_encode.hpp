// archive_encode.hpp - files of Profile::archive, which look at the scene as a whole.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "file/encode_plan.hpp"
#include "levels/page_table.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_writer.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

/// Writes the whole file. `splats`: the plan's Gaussians, sound and in Morton order (frames are cut along it);
/// `source_index` [n]: their positions in the source. Draco's order becomes the file's. Takes about 300 bytes a Gaussian
/// beside them. What is written has been decoded again and compared with `splats`: see verify_archive().
/// Errors: bad_value (a value too large for the steps asked for; `found` is the Gaussian's source_index), those of
/// verify_archive() and the sink.
Result<WrittenScene> write_archive(Sink sink, const EncodePlan& plan, const SplatView& splats,
                                   std::span<const std::uint32_t> source_index);

/// The same for a file with levels: `splats` are those of all pages of `table` in their order, of which the leaves are the
/// plan's and `source_index` [n leaves] says where these were.
Result<WrittenScene> write_archive_levels(Sink sink, const EncodePlan& plan, const SplatView& splats,
                                          const PageTable& table, std::span<const std::uint32_t> source_index);

/// Opens and decodes `file`, a file of Profile::archive, and compares Gaussian i with Gaussian order[i] of `splats`
/// against the bounds that the file states. Errors: internal (a bound does not hold; the offset is the Gaussian's index
/// in the file), those of FileView::open() and load_direct().
Status verify_archive(std::span<const std::byte> file, const SplatView& splats, std::span<const std::uint32_t> order,
                      unsigned threads = 0);
/// The same for a file with levels.
Status verify_archive_levels(std::span<const std::byte> file, const SplatView& splats,
                             std::span<const std::uint32_t> order, unsigned threads = 0);

}  // namespace rgs::detail
