// tileset.cpp - reads tilesets of 3D Tiles (github.com/CesiumGS/3d-tiles, specification 1.1).
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
#include <functional>
#include <glm/gtc/type_ptr.hpp>
#include <glm/mat4x4.hpp>
#include <limits>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "gltf_document.hpp"
#include "gltf_splats.hpp"
#include "implicit_tiling.hpp"
#include "json_member.hpp"
#include "level_choice.hpp"
#include "matrix_similarity.hpp"
#include "pieces.hpp"
#include "rgs/file.hpp"
#include "rgs/splat_edit.hpp"
#include "rgs/utf8_path.hpp"
#include "signature.hpp"
#include "stated_scene.hpp"

namespace rgs::detail {
namespace {

using nlohmann::json;

constexpr std::uint64_t kMaxJsonBytes = std::uint64_t{1} << 25;    // 300 bytes a tile; parsed many times as large
constexpr std::uint64_t kMaxStreamBytes = std::uint64_t{1} << 28;  // of subtrees, which may share their buffers
constexpr std::size_t kMaxUriBytes = 4096;                         // of a path; each tile of a tiling has its own
constexpr std::size_t kMaxTiles = std::size_t{1} << 20;
constexpr std::uint64_t kMaxAsked = std::uint64_t{1} << 26;  // contents of implicit tiles that may be there
constexpr double kLeastScale = 1e-30, kMostScale = 1e30;     // whose logarithm and inverse FP32 holds with room
constexpr std::array kKnownExtensions{"3DTILES_content_gltf", "3DTILES_metadata", "3DTILES_bounding_volume_S2",
                                      "3DTILES_bounding_volume_cylinder"};
constexpr std::array kOtherContents{"b3dm", "i3dm", "pnts", "cmpt", "vctr", "geom"};

struct Tile {
  std::size_t parent = 0;             // of the root itself
  Similarity similarity;              // to the coordinates of the scene
  bool adds = false;                  // otherwise children replace it
  std::vector<std::string> contents;  // paths below the folder, without those of tilesets
  double error = 0;                   // geometricError, in units of the scene; 0: none
  std::uint64_t level = 0;
  bool below = false;  // a descendant has contents
};

tl::unexpected<Error> bad(const char* what, Errc code = Errc::bad_syntax) {
  return make_error(code, 0, what);
}

bool is_other_content(std::span<const std::byte> bytes) {
  return std::ranges::any_of(kOtherContents, [&](const char* magic) { return begins_with(bytes, magic); });
}

// Whether a glTF states no splats: one that names their extension may have them, and others are soon decoded.
bool is_mesh(std::span<const std::byte> bytes, const std::string& folder) {
  if (!is_gltf(bytes)) return false;
  std::string_view text = text_of(bytes);
  if (!is_gltf_text(bytes) && bytes.size() >= kGlbHeaderBytes + kChunkHeaderBytes)
    text = text.substr(0, kGlbHeaderBytes + kChunkHeaderBytes + load<std::uint32_t>(bytes, kGlbHeaderBytes));
  if (text.find("KHR_gaussian_splatting") != text.npos) return false;
  const auto splats = is_gltf_text(bytes) ? decode_gltf_folder(bytes, folder, {}) : decode_gltf(bytes, {});
  return !splats && splats.error().code == Errc::not_gaussian_splats;
}

struct Tileset {
  std::vector<Tile> tiles;    // parents before children
  json extras;                // of asset
  std::uint64_t bytes = 0;    // of all tilesets
  std::uint64_t n_other = 0;  // contents without splats
};

// Collects the tiles of a tileset and of the external ones.
class Tree {
 public:
  explicit Tree(const std::string& folder) : folder_(folder) {}

  Result<Tileset> read(std::span<const std::byte> text) {
    if (Status s = add(text, "", 0); !s) return tl::unexpected(s.error());
    // Not by recursion: depth is the file's. External tilesets go on where their tiles are.
    while (!pending_.empty()) {
      const Pending next = pending_.back();
      pending_.pop_back();
      if (Status s = visit(next); !s) return tl::unexpected(s.error());
    }
    std::vector<Tile>& tiles = out_.tiles;
    // Levels from the leaves up.
    for (std::size_t i = tiles.size(); i-- > 1;) {
      Tile& parent = tiles[tiles[i].parent];
      const bool is_step = !tiles[i].contents.empty() || tiles[i].below;
      parent.below = parent.below || is_step;
      const bool replaced = !parent.contents.empty() && !parent.adds && is_step;
      parent.level = std::max(parent.level, tiles[i].level + (replaced ? 1 : 0));
    }
    if (const json* extras = json_member(documents_.front()["asset"], "extras")) out_.extras = *extras;
    return std::move(out_);
  }
  // Paths below the folder, also after an error.
  const std::set<std::string>& opened() const { return opened_; }

 private:
  struct Pending {
    const json* tile = nullptr;
    std::string base;  // folder of its tileset, relative; "" or ending with a slash
    std::size_t parent = 0;
    bool is_root = false;
  };

  Status add(std::span<const std::byte> text, const std::string& base, std::size_t parent) {
    out_.bytes += text.size();
    json_bytes_ += text.size();
    if (json_bytes_ > kMaxJsonBytes) return bad("tilesets and subtrees of more than 32 MiB", Errc::limit_exceeded);
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
    pending_.push_back({json_member(root, "root"), base, parent, out_.tiles.empty()});
    return {};
  }

  Status visit(const Pending& pending) {
    const json& stated = pending.tile != nullptr ? *pending.tile : documents_.front();
    std::vector<Tile>& tiles = out_.tiles;
    if (pending.tile == nullptr || !stated.is_object()) return bad("a tile is missing or no JSON object");
    if (tiles.size() == kMaxTiles) return bad("more than a million tiles", Errc::limit_exceeded);
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
      if (!(scale >= kLeastScale && scale <= kMostScale) || !std::isfinite(move.x + move.y + move.z))
        return bad("transforms of nested tiles overflow or vanish", Errc::bad_value);
    }
    if (const json* refine = json_member(stated, "refine")) {
      if (*refine != "ADD" && *refine != "REPLACE") return bad("refine of a tile is neither ADD nor REPLACE");
      tile.adds = *refine == "ADD";
    }
    if (const json* error = json_member(stated, "geometricError"); error != nullptr && error->is_number())
      tile.error = error->get<double>() * tile.similarity.scale;
    const std::size_t index = tiles.size();
    tiles.push_back(std::move(tile));
    if (const json* implicit = json_member(stated, "implicitTiling"))
      return add_implicit(stated, *implicit, pending.base, index);
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

  // The tiles of an implicit tiling, of which `root` is the first.
  Status add_implicit(const json& stated, const json& implicit, const std::string& base, std::size_t root) {
    const auto tiling = read_implicit_tiling(implicit);
    if (!tiling) return tl::unexpected(tiling.error());
    if (json_member(stated, "children") != nullptr) return bad("a tile has children beside its implicit tiling");
    const auto uris = content_uris(stated);
    if (!uris) return tl::unexpected(uris.error());
    std::vector<ImplicitTile> subtrees{{TilePlace(), root, 0}};
    while (!subtrees.empty()) {
      const ImplicitTile next = subtrees.back();
      subtrees.pop_back();
      if (Status s = add_subtree(*tiling, *uris, base, next, subtrees); !s) return s;
    }
    return {};
  }

  struct ImplicitTile {
    TilePlace place;
    std::size_t index = 0;
    std::uint64_t morton = 0;  // in its level of the subtree
  };
  // Level after level. Child subtrees, whose roots become tiles, go to `subtrees`, the last one first.
  Status add_subtree(const ImplicitTiling& tiling, const std::vector<std::string>& uris, const std::string& base,
                     const ImplicitTile& root, std::vector<ImplicitTile>& subtrees) {
    const auto name = name_of(base, root.place.uri(tiling.subtrees));
    if (!name) return tl::unexpected(name.error());
    if (!named_.insert(*name).second)
      return bad("a subtree is named twice: its template lacks {level}, {x}, {y} or {z}", Errc::unsupported_feature);
    std::map<std::string, MappedFile> files;
    const auto open = [&](const std::string& path) -> Result<std::span<const std::byte>> {
      auto found = files.find(path);
      if (found == files.end()) {
        auto file = open_named(path);
        if (!file) return tl::unexpected(file.error());
        opened_.insert(path);
        found = files.emplace(path, std::move(*file)).first;
      }
      return found->second.bytes();
    };
    const auto bytes = open(*name);
    if (!bytes) return tl::unexpected(bytes.error());
    out_.bytes += bytes->size();
    const auto fetch = [&](const std::string& uri) -> Result<std::span<const std::byte>> {
      const auto path = name_of(folder_of(*name), uri);
      if (!path) return tl::unexpected(path.error());
      const auto buffer = open(*path);
      if (buffer && buffers_.insert(*path).second) out_.bytes += buffer->size();
      return buffer;
    };
    const auto subtree = Subtree::open(*bytes, tiling, uris.size(), kMaxJsonBytes - json_bytes_, fetch);
    if (!subtree) return tl::unexpected(subtree.error());
    json_bytes_ += subtree->json_bytes;
    stream_bytes_ += subtree->stream_bytes;
    if (stream_bytes_ > kMaxStreamBytes) return bad("subtrees of more than 256 MiB of bits", Errc::limit_exceeded);
    if (!subtree->tiles.has(0)) return make_error(Errc::bad_value, subtree->tiles.offset, "a subtree without tiles");

    std::uint64_t n_tiles = 0, n_children = 0, first = 0, n_level = 1;  // first: of a level's bits
    std::vector<std::uint64_t> n_contents(subtree->contents.size());
    std::vector<std::size_t> asked;
    for (std::size_t k = 0; k < n_contents.size(); ++k)
      if (!subtree->contents[k].is_none()) asked.push_back(k);
    std::vector<ImplicitTile> level{{root.place, root.index, 0}};
    for (std::uint64_t depth = 0; !level.empty(); ++depth) {
      std::vector<ImplicitTile> below;
      const std::uint64_t next = first + n_level;
      const bool is_last = depth + 1 == tiling.subtree_levels;
      for (const ImplicitTile& tile : level) {
        ++n_tiles;
        n_asked_ += asked.size();
        if (n_asked_ > kMaxAsked)
          return bad("more than 64 million contents that implicit tiles may have", Errc::limit_exceeded);
        for (const std::size_t k : asked) {
          if (!subtree->contents[k].has(first + tile.morton)) continue;
          ++n_contents[k];
          if (Status s = add_content(tile.place.uri(uris[k]), base, tile.index); !s) return s;
        }
        for (std::uint64_t k = 0; k < tiling.n_children && tile.place.level + 1 < tiling.n_levels; ++k) {
          const std::uint64_t morton = tile.morton * tiling.n_children + k;
          if (!(is_last ? subtree->children.has(morton) : subtree->tiles.has(next + morton))) continue;
          if (out_.tiles.size() == kMaxTiles) return bad("more than a million tiles", Errc::limit_exceeded);
          const Tile& parent = out_.tiles[tile.index];
          Tile child;
          child.parent = tile.index;
          child.similarity = parent.similarity;
          child.adds = parent.adds;
          child.error = subtree->has_metadata ? 0 : parent.error / 2;
          below.push_back({tile.place.child(k), out_.tiles.size(), morton});
          out_.tiles.push_back(std::move(child));
        }
      }
      if (is_last) {
        n_children = below.size();
        subtrees.insert(subtrees.end(), below.rbegin(), below.rend());
        break;
      }
      level = std::move(below);
      first = next;
      n_level *= tiling.n_children;
    }
    Status s = subtree->tiles.check_count(n_tiles);
    for (std::size_t k = 0; s && k < n_contents.size(); ++k) s = subtree->contents[k].check_count(n_contents[k]);
    if (s) s = subtree->children.check_count(n_children);
    for (const auto& [path, file] : files)
      if (const Status unchanged = file.check_unchanged(); !unchanged) return unchanged;
    return s;
  }

  static Result<std::string> uri_of(const json& content) {
    const json* uri = json_member(content, "uri");
    if (uri == nullptr) uri = json_member(content, "url");  // of drafts before 1.0, as many files have
    if (uri == nullptr || !uri->is_string()) return bad("content of a tile names no file (uri)");
    return uri->get<std::string>();
  }

  static Result<std::vector<std::string>> content_uris(const json& stated) {
    std::vector<const json*> contents;
    if (const json* content = json_member(stated, "content")) contents.push_back(content);
    if (const json* several = json_member(stated, "contents")) {
      if (!several->is_array()) return bad("contents of a tile is not an array");
      for (const json& content : *several) contents.push_back(&content);
    }
    std::vector<std::string> uris;
    for (const json* content : contents) {
      auto uri = uri_of(*content);
      if (!uri) return tl::unexpected(uri.error());
      uris.push_back(std::move(*uri));
    }
    return uris;
  }

  Status add_contents(const json& stated, const std::string& base, std::size_t index) {
    const auto uris = content_uris(stated);
    if (!uris) return tl::unexpected(uris.error());
    for (const std::string& uri : *uris) {
      if (Status s = add_content(uri, base, index); !s) return s;
    }
    return {};
  }

  static std::string folder_of(const std::string& name) {
    const std::size_t slash = name.rfind('/');
    return slash == name.npos ? "" : name.substr(0, slash + 1);
  }

  // The path of a URI of a file in the folder `base`.
  static Result<std::string> name_of(const std::string& base, const std::string& uri) {
    if (uri.size() > kMaxUriBytes) return bad("a URI of more than 4096 bytes", Errc::limit_exceeded);
    const auto path = file_within_folder(uri);
    if (!path)
      return bad("a file of a tile is not below the folder of what names it: copy it there", Errc::unsupported_feature);
    return base + *path;
  }

  Result<MappedFile> open_named(const std::string& name) const {
    auto file = MappedFile::open(folder_ + "/" + name);
    if (!file) file.error().what = "cannot open a file that a tile or a subtree names";
    return file;
  }

  Status add_content(const std::string& uri, const std::string& base, std::size_t index) {
    const auto found = name_of(base, uri);
    if (!found) return tl::unexpected(found.error());
    const std::string& name = *found;
    // Once, so that what is read is within the scene's size, and tilesets do not name each other.
    if (!named_.insert(name).second)
      return bad("a content or a tileset is named twice: give each tile a file of its own", Errc::unsupported_feature);
    const auto file = open_named(name);
    if (!file) return tl::unexpected(file.error());
    opened_.insert(name);
    if (is_tileset(file->bytes())) return add(file->bytes(), folder_of(name), index);
    if (is_other_content(file->bytes()) || is_mesh(file->bytes(), folder_ + "/" + folder_of(name))) {
      ++out_.n_other;
    } else {
      out_.tiles[index].contents.push_back(name);
    }
    return {};
  }

  const std::string& folder_;
  Tileset out_;
  std::deque<json> documents_;
  std::vector<Pending> pending_;
  std::set<std::string> named_, buffers_, opened_;
  std::uint64_t json_bytes_ = 0, stream_bytes_ = 0, n_asked_ = 0;
};

// A viewer draws a tile whose geometricError covers at most so many pixels, unless told otherwise (CesiumJS,
// maximumScreenSpaceError). A page may be drawn where a pixel covers at least its error.
constexpr double kScreenErrorPx = 16;

// Nodes of a tree of levels, and the tiles that they are of.
struct TileNodes {
  static constexpr std::size_t kNone = ~std::size_t{0};
  std::vector<LevelTree::Node> nodes;
  std::vector<std::size_t> of_tile;  // kNone: the tile is none
  std::vector<bool> repeats;         // of each tile: the next node has its Gaussians too, beside those that are added
};

// `n`: Gaussians of each tile. Tiles without any are looked through.
TileNodes find_nodes(const std::vector<Tile>& tiles, std::span<const std::uint64_t> n) {
  std::vector<bool> leaves(tiles.size()), leaves_below(tiles.size());  // has Gaussians of the finest level
  for (std::size_t i = tiles.size(); i-- > 0;) {
    leaves[i] = leaves_below[i] || (n[i] != 0 && (tiles[i].adds || !tiles[i].below));
    if (i != 0 && leaves[i]) leaves_below[tiles[i].parent] = true;
  }
  TileNodes out;
  out.of_tile.assign(tiles.size(), TileNodes::kNone);
  out.repeats.resize(tiles.size());
  std::vector<std::uint32_t> node_above(tiles.size(), LevelTree::kNoParent);  // or the tile's own
  for (std::size_t i = 0; i < tiles.size(); ++i) {
    if (i != 0) node_above[i] = node_above[tiles[i].parent];
    if (n[i] == 0 || !leaves[i]) continue;
    out.of_tile[i] = out.nodes.size();
    out.nodes.push_back({0, node_above[i], n[i]});
    node_above[i] = static_cast<std::uint32_t>(out.of_tile[i]);
    out.repeats[i] = tiles[i].adds && leaves_below[i];
    const double error = tiles[i].error / kScreenErrorPx;
    if (leaves_below[i] && std::fabs(error) <= std::numeric_limits<float>::max())
      out.nodes.back().error = static_cast<float>(error);
    if (out.repeats[i]) out.nodes.push_back({0, node_above[i], n[i]});
  }
  // An error that is no number above those of children means something else.
  std::vector<float> most(out.nodes.size());
  for (std::size_t i = out.nodes.size(); i-- > 0;) {
    LevelTree::Node& node = out.nodes[i];
    if (!(node.error > most[i])) node.error = 0;
    if (node.parent == LevelTree::kNoParent) continue;
    most[node.parent] = std::max({most[node.parent], most[i], node.error});
    out.nodes[node.parent].level = std::max(out.nodes[node.parent].level, node.level + 1);
  }
  return out;
}

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
  own.visit = nullptr;
  auto splats = is_gltf_text(file->bytes()) ? decode_gltf_folder(file->bytes(), path.substr(0, path.rfind('/')), own)
                                            : decode_gltf(file->bytes(), own);
  if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
  if (!splats && splats.error().code == Errc::not_gaussian_splats) return std::nullopt;
  if (!splats) return tl::unexpected(splats.error());
  convert_axes(splats->cloud, kAxesGltf, kAxes3dTiles);
  convert_axes(splats->origin, kAxesGltf, kAxes3dTiles);
  const auto n_infinite = [&] {
    return std::ranges::count_if(splats->cloud.mean, [](float x) { return !std::isfinite(x); });
  };
  const auto before = n_infinite();
  if (similarity.translation != glm::dvec3(0)) splats->cloud.mean_rest.resize(splats->cloud.mean.size());
  transform_splats(splats->cloud, splats->origin, similarity);
  if (n_infinite() != before || std::ranges::any_of(splats->origin, [](double x) { return std::fabs(x) > kMaxOrigin; }))
    return bad("a transform moves Gaussians of a tile beyond FP32, or their origin beyond 1e12", Errc::bad_value);
  splats->position_rounding *= similarity.scale;
  splats->metres_per_unit = static_cast<float>(static_cast<double>(splats->metres_per_unit) / similarity.scale);
  return std::optional(std::move(*splats));
}

// Reads contents one at a time, and gathers what they state.
class Contents {
 public:
  Contents(const Tileset& tileset, const std::string& folder, const ReadOptions& options)
      : tileset_(tileset), folder_(folder), options_(options) {
    file.bytes = tileset.bytes;
    n_other_ = tileset.n_other;
  }

  // Each with an origin of its own. Hands over those that have Gaussians.
  Status read_tile(std::size_t tile, const std::function<Status(SplatFile& piece)>& visit) {
    for (const std::string& name : tileset_.tiles[tile].contents) {
      ReadOptions rest = options_;
      rest.limits.max_gaussians -= n_;
      auto read = read_content((detail::path_of(folder_) / detail::path_of(name)).string(), rest,
                               tileset_.tiles[tile].similarity);
      if (!read) return tl::unexpected(read.error());
      if (!*read) {
        ++n_other_;
        continue;
      }
      SplatFile& content = **read;
      if (Status s = add(content); !s) return s;
      SplatFile piece;
      stated_.copy_to(piece);
      piece.bytes = content.bytes;
      piece.cloud = std::move(content.cloud);
      piece.origin = content.origin;
      piece.position_rounding = content.position_rounding;
      piece.format = SplatFormat::tileset;
      if (Status s = visit(piece); !s) return s;
    }
    return {};
  }

  // Errors: not_gaussian_splats.
  Status finish() {
    if (!is_stated_)
      return make_error(Errc::not_gaussian_splats, 0, "no tile holds a glTF with KHR_gaussian_splatting");
    stated_.copy_to(file);
    file.format = SplatFormat::tileset;
    file.n_levels = static_cast<std::uint32_t>(tileset_.tiles.front().level + 1);
    if (n_other_ != 0) file.unused.push_back("contents of tiles without splats: " + std::to_string(n_other_));
    return {};
  }

  SplatFile file;  // of all contents so far, without Gaussians

 private:
  // The first content speaks for all.
  Status add(SplatFile& content) {
    file.bytes += content.bytes;
    n_ += content.cloud.size();
    file.unused.insert(file.unused.end(), content.unused.begin(), content.unused.end());
    if (std::exchange(is_stated_, true)) {
      if (content.colour_space == colour_space_) return {};
      return bad("contents of the tileset differ in colour space: convert each by itself", Errc::unsupported_feature);
    }
    colour_space_ = content.colour_space;
    stated_.aa_mode = content.aa_mode;
    stated_.low_pass_px2 = content.low_pass_px2;
    stated_.colour_space = content.colour_space;
    stated_.metres_per_unit = content.metres_per_unit;
    if (!read_extras(tileset_.extras, stated_))
      return bad("an invalid value in asset.extras.rgs of the tileset", Errc::bad_value);
    return {};
  }

  const Tileset& tileset_;
  const std::string& folder_;
  const ReadOptions& options_;
  StatedScene stated_{.axes = kAxes3dTiles};
  bool is_stated_ = false;
  ColourSpace colour_space_ = ColourSpace::srgb_display;  // of the first content
  std::uint64_t n_ = 0, n_other_ = 0;
};

}  // namespace

bool is_tileset(std::span<const std::byte> bytes) {
  return is_json_with(bytes, "\"geometricError\"");
}

Result<SplatFile> decode_lone_tileset(std::span<const std::byte>, const ReadOptions&) {
  return make_error(Errc::unsupported_feature, 0, "a tileset of 3D Tiles without its contents: name the file");
}

Result<SplatFile> decode_tileset_folder(std::span<const std::byte> bytes, const std::string& folder,
                                        const ReadOptions& options) {
  const auto tileset = Tree(folder).read(bytes);
  if (!tileset) return tl::unexpected(tileset.error());
  const std::uint64_t n_levels = tileset->tiles.front().level + 1, level = options.level_of_detail.value_or(0);
  if (const Status s = check_level(n_levels, options); !s) return tl::unexpected(s.error());
  SplatCloud cloud;
  std::vector<ScenePart> parts;
  std::vector<Origin> origins;
  const std::vector<bool> chosen = choose(tileset->tiles, level);
  Contents contents(*tileset, folder, options);
  double rounding = 0;
  for (std::size_t i = 0; i < tileset->tiles.size(); ++i) {
    if (!chosen[i]) continue;
    const Status read = contents.read_tile(i, [&](SplatFile& piece) -> Status {
      rounding = std::max(rounding, piece.position_rounding);
      if (options.visit) {
        if (piece.cloud.size() != 0) origins.push_back(piece.origin);
        return hand_over(piece, options);
      }
      parts.push_back({piece.cloud.size(), piece.origin, piece.position_rounding});
      if (parts.size() == 1) {
        cloud = std::move(piece.cloud);
      } else {
        append_splats(cloud, piece.cloud);
      }
      return {};
    });
    if (!read) return tl::unexpected(read.error());
  }
  if (const Status s = contents.finish(); !s) return tl::unexpected(s.error());
  SplatFile file = std::move(contents.file);
  file.cloud = std::move(cloud);
  if (options.visit) {
    file.origin = merged_origin(origins);
  } else {
    const auto differs = [&](const ScenePart& part) { return part.origin != parts.front().origin; };
    if (rounding == 0 && std::ranges::any_of(parts, differs)) file.cloud.mean_rest.resize(file.cloud.mean.size());
    merge_parts(file.cloud, parts, file.origin);
    for (const ScenePart& part : parts) rounding = std::max(rounding, part.position_rounding);
    rounding = std::max(rounding, largest_rest(file.cloud.mean_rest));
  }
  file.position_rounding = rounding;
  file.finest = level == 0;
  if (n_levels > 1 && !options.level_of_detail) file.unused.emplace_back("levels of detail but the finest");
  return file;
}

Result<LevelTree> open_tileset_levels(std::span<const std::byte> bytes, const std::string& folder,
                                      const ReadOptions& options) {
  auto read = Tree(folder).read(bytes);
  if (!read) return tl::unexpected(read.error());
  const auto tileset = std::make_shared<const Tileset>(std::move(*read));
  const std::vector<Tile>& tiles = tileset->tiles;
  LevelTree tree;
  if (std::ranges::none_of(tiles, [](const Tile& tile) { return tile.below && !tile.contents.empty(); })) return tree;
  std::vector<std::uint64_t> n(tiles.size());
  std::vector<Origin> origins;
  Contents contents(*tileset, folder, options);
  for (std::size_t i = 0; i < tiles.size(); ++i) {
    const Status counted = contents.read_tile(i, [&](const SplatFile& piece) -> Status {
      n[i] += piece.cloud.size();
      if (piece.cloud.size() != 0) origins.push_back(piece.origin);
      return {};
    });
    if (!counted) return tl::unexpected(counted.error());
  }
  if (const Status s = contents.finish(); !s) return tl::unexpected(s.error());
  tree.file = std::move(contents.file);
  tree.file.bytes = tileset->bytes;
  tree.file.origin = merged_origin(origins);
  auto found = std::make_shared<TileNodes>(find_nodes(tiles, n));
  tree.nodes = std::move(found->nodes);
  tree.read = [tileset, folder, options, found, origin = tree.file.origin](const LevelTree::Visit& visit) -> Status {
    Contents again(*tileset, folder, options);
    for (std::size_t i = 0; i < tileset->tiles.size(); ++i) {
      if (found->of_tile[i] == TileNodes::kNone) continue;
      SplatFile node;
      bool is_first = true;
      const Status status = again.read_tile(i, [&](SplatFile& piece) -> Status {
        piece.cloud.mean_rest.resize(piece.cloud.mean.size());
        rebase_exactly(piece.cloud.mean, piece.cloud.mean_rest, piece.origin, origin);
        piece.origin = origin;
        if (std::exchange(is_first, false)) {
          node = std::move(piece);
          return {};
        }
        node.bytes += piece.bytes;
        node.position_rounding = std::max(node.position_rounding, piece.position_rounding);
        append_splats(node.cloud, piece.cloud);
        return {};
      });
      if (!status) return status;
      const auto at = static_cast<std::uint32_t>(found->of_tile[i]);
      if (found->repeats[i]) {
        if (Status s = visit(at, node); !s) return s;
        node.bytes = 0;
      }
      if (Status s = visit(at + (found->repeats[i] ? 1 : 0), std::move(node)); !s) return s;
    }
    return {};
  };
  return tree;
}

std::vector<std::string> opened_by_tileset(std::span<const std::byte> bytes, const std::string& folder) {
  Tree tree(folder);
  (void)tree.read(bytes);
  std::set<std::string> opened = tree.opened();
  for (const std::string& name : tree.opened()) {
    const auto file = MappedFile::open((detail::path_of(folder) / detail::path_of(name)).string());
    if (!file || is_tileset(file->bytes()) || !is_gltf_text(file->bytes())) continue;
    const json root = json::parse(text_of(file->bytes()), nullptr, false);
    const json* buffers = json_member(root, "buffers");
    if (buffers == nullptr || !buffers->is_array()) continue;
    for (const json& buffer : *buffers) {
      const json* uri = json_member(buffer, "uri");
      const auto path =
          uri != nullptr && uri->is_string() ? file_within_folder(uri->get_ref<const std::string&>()) : std::nullopt;
      if (path) opened.insert((detail::path_of(name).parent_path() / detail::path_of(*path)).generic_string());
    }
  }
  return {opened.begin(), opened.end()};
}

}  // namespace rgs::detail
