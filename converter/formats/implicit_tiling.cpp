// implicit_tiling.cpp - reads subtrees (github.com/CesiumGS/3d-tiles, specification 1.1, "Implicit Tiling").
//
// A subtree is a JSON, or a .subtree: "subt", version 1 (u32), the lengths of JSON and buffer (u64 each), then both. An
// availability is a constant, or a stream of bits in a view of that buffer or of a file: for tiles and contents one for
// each tile, level after level; for child subtrees one for each tile of the level below the last.
// SPDX-License-Identifier: Apache-2.0
#include "implicit_tiling.hpp"

#include <bit>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "gltf_document.hpp"
#include "json_member.hpp"
#include "quantised.hpp"
#include "signature.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;

constexpr std::uint64_t kHeaderBytes = 24, kMostLevels = 60, kMostSubtreeBits = 48;

class SubtreeReader {
 public:
  SubtreeReader(const json& root, std::uint64_t json_offset, std::optional<std::span<const std::byte>> internal,
                std::uint64_t internal_offset, const Subtree::Fetch& fetch)
      : root_(root), json_offset_(json_offset), internal_(internal), internal_offset_(internal_offset), fetch_(fetch) {}

  tl::unexpected<Error> bad(const char* what, Errc code = Errc::bad_syntax) const {
    return make_error(code, json_offset_, what);
  }

  // Of `n` bits.
  Result<Availability> availability(const json* stated, std::uint64_t n) {
    if (stated == nullptr || !stated->is_object())
      return bad("a subtree does not say which tiles, contents or subtrees there are");
    Availability out;
    out.offset = json_offset_;
    if (const json* constant = json_member(*stated, "constant")) {
      if (*constant != 0 && *constant != 1) return bad("a constant availability is neither 0 nor 1");
      out.constant = *constant == 1;
      return out;
    }
    const json* bitstream = json_member(*stated, "bitstream");
    if (bitstream == nullptr) bitstream = json_member(*stated, "bufferView");  // of drafts
    const json* view = element("bufferViews", bitstream);
    if (view == nullptr) return bad("an availability has neither a constant nor a bitstream");
    const json* buffer = element("buffers", json_member(*view, "buffer"));
    const auto offset = gltf_whole(*view, "byteOffset", 0), length = gltf_whole(*view, "byteLength", std::nullopt);
    if (buffer == nullptr || !offset || !length) return bad("a buffer view of a subtree is not valid");
    const auto stated_bytes = gltf_whole(*buffer, "byteLength", std::nullopt);
    if (!stated_bytes) return bad("a buffer of a subtree has no length");
    const json* uri = json_member(*buffer, "uri");
    if (uri != nullptr ? !uri->is_string() : !internal_) return bad("a buffer of a subtree is nowhere (uri)");
    std::span<const std::byte> bytes = internal_.value_or(std::span<const std::byte>());
    if (uri != nullptr) {
      const auto fetched = fetch_(uri->get_ref<const std::string&>());
      if (!fetched) return tl::unexpected(fetched.error());
      bytes = *fetched;
    }
    out.offset = *offset + (uri != nullptr ? 0 : internal_offset_);
    if (bytes.size() < *stated_bytes)
      return make_error(Errc::truncated, bytes.size() + (uri != nullptr ? 0 : internal_offset_),
                        "a buffer of a subtree is shorter than it states", *stated_bytes, bytes.size());
    if (*offset > *stated_bytes || *length > *stated_bytes - *offset)
      return bad("a buffer view of a subtree is beyond its buffer", Errc::bad_value);
    const std::uint64_t needed = (n + 7) / 8;
    if (*length < needed)
      return make_error(Errc::truncated, out.offset, "a bitstream of a subtree has fewer bits than the subtree tiles",
                        needed, *length);
    out.bits = bytes.subspan(*offset, needed);
    return out;
  }

 private:
  const json* element(const char* name, const json* index) const {
    const json* array = json_member(root_, name);
    if (array == nullptr || !array->is_array() || index == nullptr || !index->is_number_unsigned() ||
        index->get<std::uint64_t>() >= array->size())
      return nullptr;
    return &(*array)[index->get<std::size_t>()];
  }

  const json& root_;
  std::uint64_t json_offset_;
  std::optional<std::span<const std::byte>> internal_;
  std::uint64_t internal_offset_;
  const Subtree::Fetch& fetch_;
};

}  // namespace

std::string TilePlace::uri(std::string_view pattern) const {
  std::string out;
  for (std::size_t at = 0; at < pattern.size();) {
    const std::size_t before = at;
    for (const auto& [name, value] :
         {std::pair<std::string_view, std::uint64_t>("{level}", level), {"{x}", x}, {"{y}", y}, {"{z}", z}}) {
      if (!pattern.substr(at).starts_with(name)) continue;
      out += std::to_string(value);
      at += name.size();
      break;
    }
    if (at == before) out += pattern[at++];
  }
  return out;
}

Result<ImplicitTiling> read_implicit_tiling(const json& stated) {
  const auto bad = [](const char* what, Errc code = Errc::bad_syntax) { return make_error(code, 0, what); };
  ImplicitTiling tiling;
  const json* scheme = json_member(stated, "subdivisionScheme");
  if (scheme == nullptr || (*scheme != "QUADTREE" && *scheme != "OCTREE"))
    return bad("implicit tiling is neither QUADTREE nor OCTREE (subdivisionScheme)");
  tiling.n_children = *scheme == "OCTREE" ? 8 : 4;
  const auto levels = gltf_whole(stated, "availableLevels", std::nullopt),
             of_subtree = gltf_whole(stated, "subtreeLevels", std::nullopt);
  if (!levels || *levels == 0 || !of_subtree || *of_subtree == 0)
    return bad("implicit tiling has no levels (availableLevels, subtreeLevels)");
  const std::uint64_t bits = tiling.n_children == 8 ? 3 : 2;
  if (*levels > kMostLevels || *of_subtree > kMostSubtreeBits / bits)
    return bad("implicit tiling of more than 60 levels, or subtrees of more than 2^48 tiles", Errc::limit_exceeded);
  const json* subtrees = json_member(stated, "subtrees");
  const json* uri = subtrees != nullptr ? json_member(*subtrees, "uri") : nullptr;
  if (uri == nullptr || !uri->is_string()) return bad("implicit tiling names no subtrees (subtrees.uri)");
  tiling.n_levels = *levels;
  tiling.subtree_levels = *of_subtree;
  tiling.subtrees = uri->get<std::string>();
  return tiling;
}

Status Availability::check_count(std::uint64_t found) const {
  if (bits.empty()) return {};
  std::uint64_t n = 0;
  for (const std::byte b : bits) n += static_cast<unsigned>(std::popcount(std::to_integer<unsigned>(b)));
  if (n == found) return {};
  return make_error(Errc::bad_value, offset,
                    "a subtree's bits are set for what is not there, or lacks a parent or a tile", found, n);
}

Result<Subtree> Subtree::open(std::span<const std::byte> bytes, const ImplicitTiling& tiling, std::size_t n_contents,
                              std::uint64_t max_json_bytes, const Fetch& fetch) {
  std::span<const std::byte> text = bytes;
  std::optional<std::span<const std::byte>> internal;
  std::uint64_t json_offset = 0, internal_offset = 0;
  if (begins_with(bytes, "subt")) {
    if (bytes.size() < kHeaderBytes)
      return make_error(Errc::truncated, bytes.size(), "a subtree ends within its header", kHeaderBytes, bytes.size());
    if (const auto version = load<std::uint32_t>(bytes, 4); version != 1)
      return make_error(Errc::unsupported_version, 4, "a subtree of another version than 1", 1, version);
    const auto json_bytes = load<std::uint64_t>(bytes, 8), buffer_bytes = load<std::uint64_t>(bytes, 16);
    const std::uint64_t rest = bytes.size() - kHeaderBytes;
    if (json_bytes > rest) return make_error(Errc::truncated, 8, "a subtree ends within its JSON", json_bytes, rest);
    if (buffer_bytes > rest - json_bytes)
      return make_error(Errc::truncated, 16, "a subtree ends within its buffer", buffer_bytes, rest - json_bytes);
    json_offset = kHeaderBytes;
    internal_offset = kHeaderBytes + json_bytes;
    if (buffer_bytes != rest - json_bytes)
      return make_error(Errc::trailing_bytes, internal_offset + buffer_bytes, "bytes after the end of a subtree");
    text = bytes.subspan(kHeaderBytes, json_bytes);
    internal = bytes.subspan(internal_offset);
  }
  if (text.size() > max_json_bytes)
    return make_error(Errc::limit_exceeded, json_offset, "tilesets and subtrees of more than 32 MiB");
  const json root = json::parse(text_of(text), nullptr, false);
  SubtreeReader reader(root, json_offset, internal, internal_offset, fetch);
  if (!root.is_object()) return reader.bad("a subtree is not a JSON object");
  std::uint64_t n_tiles = 0, n_level = 1;
  for (std::uint64_t level = 0; level < tiling.subtree_levels; ++level, n_level *= tiling.n_children)
    n_tiles += n_level;
  Subtree out;
  const auto read = [&](const json* stated, std::uint64_t n, Availability& to) -> Status {
    const auto availability = reader.availability(stated, n);
    if (!availability) return tl::unexpected(availability.error());
    to = *availability;
    out.stream_bytes += to.bits.size();
    return {};
  };
  if (Status s = read(json_member(root, "tileAvailability"), n_tiles, out.tiles); !s) return tl::unexpected(s.error());
  if (Status s = read(json_member(root, "childSubtreeAvailability"), n_level, out.children); !s)
    return tl::unexpected(s.error());
  if (const json* contents = json_member(root, "contentAvailability")) {
    const std::size_t n = contents->is_array() ? contents->size() : 1;  // an object: of drafts
    for (std::size_t k = 0; k < n; ++k) {
      const json& stated = contents->is_array() ? (*contents)[k] : *contents;
      if (Status s = read(&stated, n_tiles, out.contents.emplace_back()); !s) return tl::unexpected(s.error());
    }
    while (out.contents.size() > n_contents && out.contents.back().is_none()) out.contents.pop_back();
    if (out.contents.size() != n_contents)
      return reader.bad("contentAvailability of a subtree is not one for each content of the tile");
  }
  out.has_metadata = json_member(root, "tileMetadata") != nullptr;
  out.json_bytes = text.size();
  return out;
}

}  // namespace rgs::detail
