// implicit_tiling.hpp - implicit tiling of 3D Tiles 1.1: which tiles of a quadtree or octree there are.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <nlohmann/json_fwd.hpp>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::detail {

struct ImplicitTiling {
  std::uint64_t n_children = 0;                    ///< of a tile: 4, or 8 of an octree
  std::uint64_t n_levels = 0, subtree_levels = 0;  ///< that have tiles; of each subtree
  std::string subtrees;                            ///< template of their URIs
};
/// A tile's member implicitTiling. Errors: bad_syntax; limit_exceeded (more than 60 levels, or of a subtree 2^48 tiles).
Result<ImplicitTiling> read_implicit_tiling(const nlohmann::json& stated);

/// A tile's place in the tree; z is 0 in a quadtree.
struct TilePlace {
  std::uint64_t level = 0, x = 0, y = 0, z = 0;

  /// Number k along the Morton curve.
  TilePlace child(std::uint64_t k) const {
    return {level + 1, 2 * x + (k & 1), 2 * y + (k >> 1 & 1), 2 * z + (k >> 2)};
  }
  /// The template with this place.
  std::string uri(std::string_view pattern) const;
};

/// Whether tiles, contents or subtrees exist, by level and along the Morton curve.
struct Availability {
  bool constant = false;            ///< of all, without a stream
  std::span<const std::byte> bits;  ///< from the lowest of each byte
  std::uint64_t offset = 0;         ///< of the stream in its file, or of the JSON

  bool has(std::uint64_t i) const {
    return bits.empty() ? constant : (std::to_integer<unsigned>(bits[i / 8]) >> (i % 8) & 1) != 0;
  }
  /// Without looking at the stream.
  bool is_none() const { return bits.empty() && !constant; }
  /// Errors: bad_value (the stream has another number of ones than were found from the root).
  Status check_count(std::uint64_t found) const;
};

struct Subtree {
  Availability tiles, children;
  std::vector<Availability> contents;  ///< of each content; without any: none is there
  bool has_metadata = false;           ///< which may state other errors
  std::uint64_t json_bytes = 0, stream_bytes = 0;

  /// A .subtree, or the JSON of one; `bytes` and what `fetch` returns for a URI in its folder must outlive it. Errors:
  /// bad_syntax, truncated, unsupported_version, trailing_bytes, bad_value, limit_exceeded (a longer JSON than
  /// `max_json_bytes`), those of fetch.
  using Fetch = std::function<Result<std::span<const std::byte>>(const std::string& uri)>;
  static Result<Subtree> open(std::span<const std::byte> bytes, const ImplicitTiling& tiling, std::size_t n_contents,
                              std::uint64_t max_json_bytes, const Fetch& fetch);
};

}  // namespace rgs::detail
