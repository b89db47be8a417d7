// tileset.cpp - reads explicit tilesets of 3D Tiles (github.com/CesiumGS/3d-tiles, specification 1.1).
//
// tileset.json has a tree of tiles. A tile may have contents, named by URIs relative to its tileset, and children; by
// "refine" these replace it or add to it. A content is a glTF, whose y axis is up and which is turned so that z is, or
// another tileset. Transforms of tiles, matrices by columns, apply from the innermost outwards.
// SPDX-License-Identifier: Apache-2.0
#include "tileset.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <deque>
#include <filesystem>
#include <glm/gtc/type_ptr.hpp>
#include <glm/mat4x4.hpp>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "gltf_document.hpp"
#include "gltf_splats.hpp"
#include "json_member.hpp"
#include "level_choice.hpp"
#include "matrix_similarity.hpp"
#include "rgs/file.hpp"
#include "rgs/splat_edit.hpp"
#include "signature.hpp"
#include "stated_scene.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;

constexpr std::uint64_t kMaxJsonBytes = std::uint64_t{1} << 25;  // 300 bytes a tile; parsed many times as large
constexpr std::size_t kMaxTiles = std::size_t{1} << 20;
constexpr std::array kKnownExtensions{"3DTILES_content_gltf", "3DTILES_metadata", "3DTILES_bounding_volume_S2",
                                      "3DTILES_bounding_volume_cylinder"};
constexpr std::array kOtherContents{"b3dm", "i3dm", "pnts", "cmpt", "vctr", "geom"};

struct Tile {
  std::size_t parent = 0;             // of the root itself
  Similarity similarity;              // to the coordinates of the scene
  bool adds = false;                  // otherwise children replace it
  std::vector<std::string> contents;  // paths below the folder, without those of tilesets
  std::uint64_t level = 0;
  bool below = false;  // a descendant has contents
};

tl::unexpected<Error> bad(const char* what, Errc code = Errc::bad_syntax) {
  return make_error(code, 0, what);
}

bool is_other_content(std::span<const std::byte> bytes) {
  return std::ranges::any_of(kOtherContents, [&](const char* magic) { return begins_with(bytes, magic); });
}

// Collects the tiles of a tileset and of the external ones: parents before children.
class Tree {
 public:
  explicit Tree(const std::string& folder) : folder_(folder) {}

  Status add_tileset(std::span<const std::byte> text) {
    if (Status s = add(text, "", 0); !s) return s;
    // Not by recursion: depth is the file's. External tilesets go on where their tiles are.
    while (!pending_.empty()) {
      const Pending next = pending_.back();
      pending_.pop_back();
      if (Status s = visit(next); !s) return s;
    }
    // Levels from the leaves up.
    for (std::size_t i = tiles.size(); i-- > 1;) {
      Tile& parent = tiles[tiles[i].parent];
      const bool is_step = !tiles[i].contents.empty() || tiles[i].below;
      parent.below = parent.below || is_step;
      const bool replaced = !parent.contents.empty() && !parent.adds && is_step;
      parent.level = std::max(parent.level, tiles[i].level + (replaced ? 1 : 0));
    }
    return {};
  }

  std::vector<Tile> tiles;
  Status read_extras(StatedScene& scene) const {
    const json* asset = json_member(documents_.front(), "asset");
    const json* extras = json_member(*asset, "extras");
    if (extras != nullptr && !detail::read_extras(*extras, scene))
      return bad("an invalid value in asset.extras.rgs of the tileset", Errc::bad_value);
    return {};
  }
  std::uint64_t bytes = 0;    // of all tilesets
  std::uint64_t n_other = 0;  // contents without splats

 private:
  struct Pending {
    const json* tile = nullptr;
    std::string base;  // folder of its tileset, relative; "" or ending with a slash
    std::size_t parent = 0;
    bool is_root = false;
  };

  Status add(std::span<const std::byte> text, const std::string& base, std::size_t parent) {
    bytes += text.size();
    if (bytes > kMaxJsonBytes) return bad("tilesets of more than 32 MiB", Errc::limit_exceeded);
    const json& root = documents_.emplace_back(json::parse(text_of(text), nullptr, false));
    if (!root.is_object()) return bad("the tileset is not a JSON object");
    const json* asset = json_member(root, "asset");
    const json* version = asset != nullptr ? json_member(*asset, "version") : nullptr;
    if (version == nullptr) return bad("the tileset states no version (asset.version)");
    if (*version != "1.0" && *version != "1.1")
      return bad("a version of 3D Tiles other than 1.0 and 1.1", Errc::unsupported_version);
    if (const json* up = json_member(*asset, "gltfUpAxis"); up != nullptr && *up != "Y")
      return bad("contents whose up axis is not y (asset.gltfUpAxis)", Errc::unsupported_feature);
    if (const json* required = json_member(root, "extensionsRequired")) {
      for (const json& name : *required) {
        if (std::ranges::find(kKnownExtensions, name) == kKnownExtensions.end())
          return bad("the tileset requires an extension that is not read", Errc::unsupported_feature);
      }
    }
    pending_.push_back({json_member(root, "root"), base, parent, tiles.empty()});
    return {};
  }

  Status visit(const Pending& pending) {
    const json& stated = pending.tile != nullptr ? *pending.tile : documents_.front();
    if (pending.tile == nullptr || !stated.is_object()) return bad("a tile is missing or no JSON object");
    if (tiles.size() == kMaxTiles) return bad("more than a million tiles", Errc::limit_exceeded);
    if (json_member(stated, "implicitTiling") != nullptr)
      return bad("implicit tiling is not read: make the tileset explicit", Errc::unsupported_feature);
    Tile tile;
    tile.parent = pending.parent;
    if (!pending.is_root) {
      tile.similarity = tiles[pending.parent].similarity;
      tile.adds = tiles[pending.parent].adds;
    }
    if (const json* transform = json_member(stated, "transform")) {
      const auto own = similarity(*transform);
      if (!own) return tl::unexpected(own.error());
      tile.similarity = compose(tile.similarity, *own);
      const auto& [rotation, scale, move] = tile.similarity;
      if (!(scale > 0) || !std::isfinite(scale) || !std::isfinite(move.x + move.y + move.z))
        return bad("transforms of nested tiles overflow or vanish", Errc::bad_value);
    }
    if (const json* refine = json_member(stated, "refine")) {
      if (*refine != "ADD" && *refine != "REPLACE") return bad("refine of a tile is neither ADD nor REPLACE");
      tile.adds = *refine == "ADD";
    }
    const std::size_t index = tiles.size();
    tiles.push_back(std::move(tile));
    if (Status s = add_contents(stated, pending.base, index); !s) return s;
    if (const json* children = json_member(stated, "children")) {
      if (!children->is_array()) return bad("children of a tile is not an array");
      for (auto child = children->rbegin(); child != children->rend(); ++child)
        pending_.push_back({&*child, pending.base, index});
    }
    return {};
  }

  Result<Similarity> similarity(const json& transform) const {
    glm::dmat4 matrix(1.0);
    if (!transform.is_array() || transform.size() != 16)
      return bad("transform of a tile is not an array of 16 numbers");
    for (std::size_t i = 0; i < 16; ++i) {
      if (!transform[i].is_number()) return bad("transform of a tile is not an array of 16 numbers");
      glm::value_ptr(matrix)[i] = transform[i].get<double>();
    }
    const auto own = similarity_of(matrix);
    if (!own || matrix[0].w != 0 || matrix[1].w != 0 || matrix[2].w != 0 || matrix[3].w != 1)
      return bad("a tile shears, mirrors or scales unevenly, which Gaussians do not survive",
                 Errc::unsupported_feature);
    return *own;
  }

  Status add_contents(const json& stated, const std::string& base, std::size_t index) {
    if (const json* content = json_member(stated, "content")) {
      if (Status s = add_content(*content, base, index); !s) return s;
    }
    const json* contents = json_member(stated, "contents");
    if (contents != nullptr && !contents->is_array()) return bad("contents of a tile is not an array");
    for (std::size_t i = 0; contents != nullptr && i < contents->size(); ++i) {
      if (Status s = add_content((*contents)[i], base, index); !s) return s;
    }
    return {};
  }

  Status add_content(const json& content, const std::string& base, std::size_t index) {
    const json* uri = json_member(content, "uri");
    if (uri == nullptr) uri = json_member(content, "url");  // of drafts before 1.0, as many files have
    if (uri == nullptr || !uri->is_string()) return bad("content of a tile names no file (uri)");
    const auto path = file_within_folder(uri->get_ref<const std::string&>());
    if (!path)
      return bad("content of a tile is outside the tileset's folder: copy it there", Errc::unsupported_feature);
    const std::string name = base + *path;
    // Once, so that what is read is within the scene's size, and tilesets do not name each other.
    if (!named_.insert(name).second)
      return bad("a content or a tileset is named twice: give each tile a file of its own", Errc::unsupported_feature);
    const auto file = MappedFile::open(folder_ + "/" + name);
    if (!file) return tl::unexpected(file.error());
    if (is_tileset(file->bytes())) {
      const std::size_t slash = name.rfind('/');
      return add(file->bytes(), slash == name.npos ? "" : name.substr(0, slash + 1), index);
    }
    if (is_other_content(file->bytes())) {
      ++n_other;
    } else {
      tiles[index].contents.push_back(name);
    }
    return {};
  }

  const std::string& folder_;
  std::deque<json> documents_;
  std::vector<Pending> pending_;
  std::set<std::string> named_;
};

// Whether each tile is read at a level.
std::vector<bool> choose(const std::vector<Tile>& tiles, std::uint64_t level) {
  std::vector<bool> chosen(tiles.size()), done(tiles.size());  // done: nothing below is read
  for (std::size_t i = 0; i < tiles.size(); ++i) {
    done[i] = i != 0 && done[tiles[i].parent];
    if (done[i] || tiles[i].contents.empty()) continue;
    chosen[i] = tiles[i].adds || tiles[i].level <= level;
    done[i] = chosen[i] && !tiles[i].adds;
  }
  return chosen;
}

// A content's Gaussians in the coordinates of tiles; nullopt: it has none.
Result<std::optional<SplatFile>> read_content(const std::string& path, const ReadOptions& options,
                                              const Similarity& similarity) {
  const auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  if (!is_gltf(file->bytes())) return make_error(Errc::bad_magic, 0, "content of a tile is neither glTF nor a tileset");
  ReadOptions own = options;
  own.level_of_detail.reset();
  auto splats = is_gltf_text(file->bytes()) ? decode_gltf_folder(file->bytes(), path.substr(0, path.rfind('/')), own)
                                            : decode_gltf(file->bytes(), own);
  if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
  if (!splats && splats.error().code == Errc::not_gaussian_splats) return std::nullopt;
  if (!splats) return tl::unexpected(splats.error());
  convert_axes(splats->cloud, kAxesGltf, kAxes3dTiles);
  convert_axes(splats->origin, kAxesGltf, kAxes3dTiles);
  transform_splats(splats->cloud, splats->origin, similarity);
  splats->position_rounding *= similarity.scale;
  splats->metres_per_unit = static_cast<float>(static_cast<double>(splats->metres_per_unit) / similarity.scale);
  return std::optional(std::move(*splats));
}

}  // namespace

bool is_tileset(std::span<const std::byte> bytes) {
  return is_json_with(bytes, "\"geometricError\"");
}

Result<SplatFile> decode_lone_tileset(std::span<const std::byte>, const ReadOptions&) {
  return make_error(Errc::unsupported_feature, 0, "a tileset of 3D Tiles without its contents: name the file");
}

Result<SplatFile> decode_tileset_folder(std::span<const std::byte> bytes, const std::string& folder,
                                        const ReadOptions& options) {
  Tree tree(folder);
  if (Status s = tree.add_tileset(bytes); !s) return tl::unexpected(s.error());
  const std::uint64_t n_levels = tree.tiles.front().level + 1, level = options.level_of_detail.value_or(0);
  if (const Status s = check_level(n_levels, options); !s) return tl::unexpected(s.error());
  StatedScene stated{.axes = kAxes3dTiles};
  SplatFile file;
  std::vector<ScenePart> parts;
  std::uint64_t stored = tree.bytes, n_other = tree.n_other;
  const std::vector<bool> chosen = choose(tree.tiles, level);
  for (std::size_t i = 0; i < tree.tiles.size(); ++i) {
    if (!chosen[i]) continue;
    for (const std::string& name : tree.tiles[i].contents) {
      ReadOptions rest = options;
      rest.limits.max_gaussians -= file.cloud.size();
      auto part = read_content((std::filesystem::path(folder) / name).string(), rest, tree.tiles[i].similarity);
      if (!part) return tl::unexpected(part.error());
      if (!*part) {
        ++n_other;
        continue;
      }
      SplatFile& splats = **part;
      stored += splats.bytes;
      if (parts.empty()) {
        stated.aa_mode = splats.aa_mode;
        stated.low_pass_px2 = splats.low_pass_px2;
        stated.colour_space = splats.colour_space;
        stated.metres_per_unit = splats.metres_per_unit;
      }
      parts.push_back({splats.cloud.size(), splats.origin, splats.position_rounding});
      file.unused.insert(file.unused.end(), splats.unused.begin(), splats.unused.end());
      if (parts.size() == 1) {
        file.cloud = std::move(splats.cloud);
      } else {
        append_splats(file.cloud, splats.cloud);
      }
    }
  }
  if (parts.empty())
    return make_error(Errc::not_gaussian_splats, 0, "no tile holds a glTF with KHR_gaussian_splatting");
  if (Status s = tree.read_extras(stated); !s) return tl::unexpected(s.error());
  stated.copy_to(file);
  merge_parts(file.cloud, parts, file.origin);
  for (const ScenePart& part : parts) file.position_rounding = std::max(file.position_rounding, part.position_rounding);
  file.bytes = stored;
  file.n_levels = static_cast<std::uint32_t>(n_levels);
  file.finest = level == 0;
  if (n_levels > 1 && !options.level_of_detail) file.unused.emplace_back("levels of detail but the finest");
  if (n_other != 0) file.unused.push_back("contents of tiles without splats: " + std::to_string(n_other));
  return file;
}

}  // namespace rgs::detail
