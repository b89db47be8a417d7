// archive_encode.hpp - writes files of Profile::archive, which goes through its Gaussians several times.
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

/// Makes the whole `file`. `splats`: the plan's Gaussians, sound and in Morton order (frames are cut along it);
/// `source_index` [n]: their positions in the source. Frames have an order of their own. Takes about 50 bytes a Gaussian.
/// The result has been decoded and compared with `splats`: see verify_archive(). Errors: bad_value (a value too large for
/// the requested steps; `found` is the Gaussian's source_index), those of verify_archive().
Result<WrittenScene> write_archive(std::vector<std::byte>& file, const EncodePlan& plan, const SplatView& splats,
                                   std::span<const std::uint32_t> source_index);

/// The same for a file with levels: `splats` are the Gaussians of all pages of `table` in order; its leaves are the
/// plan's Gaussians, and `source_index` [n leaves] holds their positions in the source.
Result<WrittenScene> write_archive_levels(std::vector<std::byte>& file, const EncodePlan& plan, const SplatView& splats,
                                          const PageTable& table, std::span<const std::uint32_t> source_index);

/// Opens and decodes `file`, of Profile::archive, and checks Gaussian i against Gaussian order[i] of `splats` by the
/// bounds that the file states. Errors: internal (a bound does not hold; the offset is the Gaussian's index in the
/// file), those of FileView::open() and validate().
Status verify_archive(std::span<const std::byte> file, const SplatView& splats, std::span<const std::uint32_t> order,
                      unsigned threads = 0);
/// The same for a file with levels.
Status verify_archive_levels(std::span<const std::byte> file, const SplatView& splats,
                             std::span<const std::uint32_t> order, unsigned threads = 0);

}  // namespace rgs::detail
