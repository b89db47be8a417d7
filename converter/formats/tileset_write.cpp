// tileset_write.cpp - writes a scene, or the levels of an .rgs, as an explicit tileset of 3D Tiles 1.1, which tileset.cpp
// describes. Tiles replace their parents; the root's transform holds the origin, and a tile far from it has one of its
// own, relative to the tile above.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <utility>
#include <vector>

#include "parallel_jobs.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/interchange.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/splat_edit.hpp"
#include "stated_scene.hpp"
#include "tree_pages.hpp"
#include "write_report.hpp"

namespace rgs {
namespace {

using Json = nlohmann::ordered_json;

// About half a megabyte of harmonics of degree 3: neither many requests nor long ones.
constexpr std::uint64_t kMostGaussians = std::uint64_t{32} << 10;
// A viewer draws a tile whose geometricError is at most this many pixels, unless told otherwise (CesiumJS,
// maximumScreenSpaceError). A page may be drawn where a pixel covers at least its error.
constexpr double kScreenErrorPx = 16;
constexpr std::size_t kEncodedPerThread = 8;
constexpr double kSigmas = 3;          // of bounds, as those of pages
constexpr float kLargestLogScale = 6;  // of an SPZ

Axis opposite(Axis axis) {
  return static_cast<Axis>(((static_cast<unsigned>(axis) - 1) ^ 1U) + 1);
}

// The axes of tiles: those of the CRS if there is one, so that coordinates are its; else z is up.
Axes tile_axes(const WriteOptions& options) {
  if (options.axes[0] == Axis::undeclared || options.crs.text.empty()) return kAxes3dTiles;
  return options.crs.axes[0] == Axis::undeclared ? options.axes : options.crs.axes;
}

// As a reference of a JSON: all but unreserved characters are escaped (RFC 3986).
std::string escaped(const std::string& name) {
  constexpr std::string_view kUnreserved = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-._~";
  constexpr std::string_view kDigits = "0123456789ABCDEF";
  std::string uri;
  for (const char c : name) {
    const auto code = static_cast<unsigned char>(c);
    if (kUnreserved.find(c) != kUnreserved.npos) {
      uri += c;
    } else {
      uri += {'%', kDigits[code >> 4], kDigits[code & 15]};
    }
  }
  return uri;
}

class Writer {
 public:
  Writer(const WriteOptions& options, const std::string& folder, const PutFile& put)
      : from_(options.axes), tile_(tile_axes(options)), content_options_(options), folder_(folder), put_(put) {
    const bool is_declared = from_[0] != Axis::undeclared;
    if (!is_declared) from_ = tile_;  // coordinates stay as they are
    // A viewer turns the y-up contents: x, -z, y of these are x, y, z of tiles.
    content_ = {tile_[0], tile_[2], opposite(tile_[1])};
    origin_ = options.origin;
    convert_axes(origin_, from_, tile_);
    detail::StatedScene stated;
    if (!is_declared) stated.axes = options.axes;
    stated.crs.text = options.crs.text;
    extras_ = detail::extras_of(stated);
    if (is_declared && tile_ != kAxes3dTiles) extras_["rgs"]["axes"] = axes_text(tile_);
    content_options_.axes = is_declared ? kAxesGltf : options.axes;
    content_options_.origin = kNoOrigin;
    content_options_.crs = {};
  }

  struct Content {
    std::vector<std::byte> glb;
    std::uint64_t n = 0;
    double rounding = 0;
    WriteReport clamped;
  };
  // The content of a tile; its coordinates are relative to its centre. On any thread.
  Result<Content> encode(SplatCloud cloud, const Origin& centre) const {
    cloud.mean_rest.resize(cloud.mean.size());
    rebase_exactly(cloud.mean, cloud.mean_rest, kNoOrigin, centre);
    convert_axes(cloud, from_, content_);
    const auto rounding = position_rounding(cloud.view(), SplatFormat::spz_glb);
    if (!rounding) return tl::unexpected(rounding.error());
    Content content;
    auto glb = encode_splats(cloud.view(), SplatFormat::spz_glb, content_options_, &content.clamped);
    if (!glb) return tl::unexpected(glb.error());
    content.glb = std::move(*glb);
    content.n = cloud.size();
    content.rounding = *rounding;
    return content;
  }

  // `above`: the centre of the tile above, if there is one.
  Result<Json> put(const Content& content, const Box& bounds, double error, const std::string& name, Origin centre,
                   std::optional<Origin> above) {
    if (Status s = put_(folder_ + "/" + name, content.glb); !s) return tl::unexpected(s.error());
    if (error == 0) report.position_rounding = std::max(report.position_rounding, content.rounding);
    detail::add_report(report.clamped, content.clamped);
    report.n_stored += content.n;
    ++report.n_regions;
    const WorldBox box = detail::turned_box(bounds, from_, tile_, kNoOrigin);
    convert_axes(centre, from_, tile_);
    if (above) convert_axes(*above, from_, tile_);
    std::array<double, 12> volume{};  // the middle, then half of each side
    std::array<double, 16> moved{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    for (std::size_t k = 0; k < 3; ++k) {
      volume[k] = 0.5 * (box.min[k] + box.max[k]) - centre[k];
      moved[12 + k] = above ? centre[k] - (*above)[k] : centre[k] + origin_[k];
      volume[3 + 4 * k] = 0.5 * (box.max[k] - box.min[k]);
    }
    Json json;
    if (moved[12] != 0 || moved[13] != 0 || moved[14] != 0) json["transform"] = moved;
    json["boundingVolume"]["box"] = volume;
    json["geometricError"] = kScreenErrorPx * error;
    json["content"]["uri"] = escaped(folder_) + "/" + name;
    return json;
  }

  // `bounds`, `error`: of the whole scene.
  Status write_tree(Json root, const Box& bounds, double error) {
    root["refine"] = "REPLACE";
    double diagonal = 0;
    for (std::size_t k = 0; k < 3; ++k)
      diagonal = std::hypot(diagonal, static_cast<double>(bounds.max[k]) - static_cast<double>(bounds.min[k]));
    Json json;
    json["asset"]["version"] = "1.1";
    if (!extras_.is_null()) json["asset"]["extras"] = extras_;
    json["extensionsUsed"] = {"3DTILES_content_gltf"};
    // CesiumJS takes contents for splats because of these.
    const Json used = {"KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"};
    json["extensions"]["3DTILES_content_gltf"] = {{"extensionsUsed", used}, {"extensionsRequired", used}};
    json["geometricError"] = std::max(diagonal, kScreenErrorPx * error);  // a viewer draws nothing of a smaller scene
    json["root"] = std::move(root);
    const std::string text = json.dump();
    return put_("tileset.json", std::as_bytes(std::span(text)));
  }

  LevelsReport report;

 private:
  Axes from_, tile_, content_{};
  Origin origin_ = kNoOrigin;
  WriteOptions content_options_;
  Json extras_;
  const std::string& folder_;
  const PutFile& put_;
};

// What a tile's content is relative to: the middle of a tile far from the scene's origin, where FP32 is coarse.
Origin centre_of(const Box& bounds) {
  constexpr double kFar = 4096;
  Origin middle;
  for (std::size_t k = 0; k < 3; ++k)
    middle[k] = std::round(0.5 * (static_cast<double>(bounds.min[k]) + static_cast<double>(bounds.max[k]))) + 0.0;
  return std::ranges::any_of(middle, [](double x) { return std::fabs(x) > kFar; }) ? middle : kNoOrigin;
}

// Most levels between a tile's page and those that it holds.
std::uint32_t choose_depth(const std::vector<lod::Page>& pages) {
  std::vector<std::uint64_t> held(pages.size());  // by the tile of each page
  std::ranges::transform(pages, held.begin(), [](const lod::Page& page) { return page.count; });
  for (std::uint32_t depth = 0; depth < pages.front().level; ++depth) {
    std::vector<std::uint64_t> more(pages.size());
    for (std::size_t i = 1; i < pages.size(); ++i) more[pages[i].parent] += held[i];
    if (*std::ranges::max_element(more) > kMostGaussians) return depth;
    held = std::move(more);
  }
  return pages.front().level;
}

class LevelsWriter {
 public:
  LevelsWriter(const PagedFile& file, const WriteOptions& options, int sh_degree, const std::string& folder,
               const PutFile& put)
      : file_(file),
        pages_(file.pages()),
        sh_degree_(sh_degree),
        threads_(options.threads),
        depth_(choose_depth(pages_)),
        writer_(options, folder, put) {}

  Result<LevelsReport> write() {
    writer_.report.n_levels = pages_.front().level - depth_ + 1;
    add_tiles(0, kNoParent);
    // Encoded on all threads, put in order; some more wait, so that no thread does.
    const std::size_t n_at_once =
        kEncodedPerThread * (threads_ != 0 ? threads_ : std::max(1U, std::thread::hardware_concurrency()));
    for (std::size_t first = 0; first < tiles_.size(); first += n_at_once) {
      std::vector<std::optional<Result<Writer::Content>>> contents(std::min(n_at_once, tiles_.size() - first));
      detail::run_in_parallel(contents.size(), threads_,
                              [&](std::size_t i) { contents[i] = encode(tiles_[first + i]); });
      for (std::size_t i = 0; i < contents.size(); ++i) {
        const Result<Writer::Content>& content = *contents[i];
        if (!content) return tl::unexpected(content.error());
        Tile& tile = tiles_[first + i];
        std::optional<Origin> above;
        if (tile.parent != kNoParent) above = centre_of(pages_[tiles_[tile.parent].page].bounds);
        const Box& bounds = pages_[tile.page].bounds;
        auto json = writer_.put(*content, bounds, static_cast<double>(tile.error), tile.name, centre_of(bounds), above);
        if (!json) return tl::unexpected(json.error());
        tile.json = *std::move(json);
        contents[i].reset();
      }
    }
    for (std::size_t i = tiles_.size(); i-- > 1;) tiles_[tiles_[i].parent].children.push_back(i);
    const lod::Page& whole = pages_.front();
    if (Status s = writer_.write_tree(tree(0), whole.bounds, static_cast<double>(whole.error)); !s)
      return tl::unexpected(s.error());
    return writer_.report;
  }

 private:
  static constexpr std::size_t kNoParent = ~std::size_t{0};
  struct Tile {
    std::uint32_t page = 0, level = 0;
    std::size_t parent = kNoParent;
    std::string name;
    float error = 0;
    Json json;
    std::vector<std::size_t> children;  // the last one first
  };

  // With those below it: as deep as the tree.
  void add_tiles(std::uint32_t page, std::size_t parent) {
    Tile tile;
    tile.page = page;
    tile.level = pages_[page].level - depth_;
    tile.parent = parent;
    n_of_level_.resize(std::max<std::size_t>(n_of_level_.size(), tile.level + 1));
    tile.name = std::to_string(tile.level) + "_" + std::to_string(n_of_level_[tile.level]++) + ".glb";
    for (const std::uint32_t i : detail::pages_below(pages_, page, tile.level).pages)
      tile.error = std::max(tile.error, pages_[i].error);
    const std::size_t index = tiles_.size();
    tiles_.push_back(std::move(tile));
    if (tiles_[index].level == 0) return;
    for (std::uint32_t k = 0; k < pages_[page].n_children; ++k) add_tiles(pages_[page].first_child + k, index);
  }

  Result<Writer::Content> encode(const Tile& tile) const {
    auto cloud = read_pages(file_, detail::pages_below(pages_, tile.page, tile.level).pages);
    if (!cloud) return tl::unexpected(cloud.error());
    strip_sh(*cloud, sh_degree_);
    return writer_.encode(*std::move(cloud), centre_of(pages_[tile.page].bounds));
  }

  Json tree(std::size_t tile) {
    Json json = std::move(tiles_[tile].json);
    for (auto child = tiles_[tile].children.rbegin(); child != tiles_[tile].children.rend(); ++child)
      json["children"].push_back(tree(*child));
    return json;
  }

  const PagedFile& file_;
  const std::vector<lod::Page>& pages_;
  int sh_degree_;
  unsigned threads_;
  std::uint32_t depth_;
  Writer writer_;
  std::vector<Tile> tiles_;
  std::vector<std::uint64_t> n_of_level_;  // tiles until now
};

Box bounds_of(const SplatView& splats) {
  Box box;
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    const float* log_scale = &splats.log_scale[3 * i];
    const auto reach = static_cast<float>(
        kSigmas *
        std::exp(static_cast<double>(std::min(*std::max_element(log_scale, log_scale + 3), kLargestLogScale))));
    for (std::size_t k = 0; k < 3; ++k) {
      const float mean = splats.mean[3 * i + k];
      box.min[k] = i == 0 ? mean - reach : std::min(box.min[k], mean - reach);
      box.max[k] = i == 0 ? mean + reach : std::max(box.max[k], mean + reach);
    }
  }
  return box;
}

SplatCloud copy_of(const SplatView& splats) {
  SplatCloud cloud;
  cloud.resize(splats.n, splats.sh_degree);
  for (std::uint64_t i = 0; i < splats.n; ++i) cloud.set(i, splats.splat(i));
  return cloud;
}

}  // namespace

Result<LevelsReport> write_tileset(const PagedFile& file, const WriteOptions& options, int sh_degree,
                                   const std::string& folder, const PutFile& put) {
  return detail::guard_memory([&]() -> Result<LevelsReport> {
    if (!file.complete())
      return make_error(Errc::pages_missing, Error::kNone, "the end of the file is missing, and pages with it");
    return LevelsWriter(file, options, sh_degree, folder, put).write();
  });
}

Result<LevelsReport> write_tileset(const SplatView& splats, const WriteOptions& options, const std::string& folder,
                                   const PutFile& put) {
  return detail::guard_memory([&]() -> Result<LevelsReport> {
    Writer writer(options, folder, put);
    const Box bounds = bounds_of(splats);
    const auto content = writer.encode(copy_of(splats), kNoOrigin);
    if (!content) return tl::unexpected(content.error());
    auto root = writer.put(*content, bounds, 0, "0_0.glb", kNoOrigin, {});
    if (!root) return tl::unexpected(root.error());
    if (Status s = writer.write_tree(*std::move(root), bounds, 0); !s) return tl::unexpected(s.error());
    writer.report.n_levels = 1;
    return writer.report;
  });
}

}  // namespace rgs
