// lcc.hpp - LCC and LCC2 of XGRIDS: levels of detail in a folder.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <string>

#include "rgs/interchange.hpp"
#include "rgs/level_tree.hpp"

namespace rgs::detail {

/// Returns the bytes of a file in the scene's folder, by its path from there; of an .lcc2 only until the next call.
using FetchBeside = std::function<Result<std::span<const std::byte>>(const std::string&)>;

/// A meta.lcc, or a .lcc2, by its first keys.
bool is_lcc(std::span<const std::byte> bytes);
bool is_lcc2(std::span<const std::byte> bytes);

/// Refuses bytes without a folder.
Result<SplatFile> decode_lone_lcc(std::span<const std::byte> bytes, const DecodeLimits& limits);

/// The JSON (`bytes`) with the files that `fetch` returns: of each cell or node that has the finest level that of
/// ReadOptions::level_of_detail, or the next finer one. SplatFile::unused names coarser levels, the environment, the
/// collision mesh and a georeference. Error offsets are in the file that the text names.
Result<SplatFile> decode_lcc(std::span<const std::byte> bytes, const FetchBeside& fetch, const ReadOptions& options);
/// Cells with a finest level as chains of the levels that they have. What `fetch` returns must outlive the result.
Result<LevelTree> open_lcc_levels(std::span<const std::byte> bytes, const FetchBeside& fetch,
                                  const DecodeLimits& limits);
/// Chunks are .sog or .spz.
Result<SplatFile> decode_lcc2(std::span<const std::byte> bytes, const FetchBeside& fetch, const ReadOptions& options);
/// Nodes with a finest level as those of the tree; none where nodes do not say which Gaussians of a chunk are theirs.
Result<LevelTree> open_lcc2_levels(std::span<const std::byte> bytes, const FetchBeside& fetch,
                                   const DecodeLimits& limits);

}  // namespace rgs::detail
