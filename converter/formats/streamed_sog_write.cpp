// streamed_sog_write.cpp - writes the levels of an .rgs as a streamed SOG, which streamed_sog.cpp describes.
//
// Regions are the pages of one level of the tree; their levels are those of the pages below. Levels above are left out:
// a reader draws nothing of a region that has no level as coarse as it wants, so all have the same ones.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "rgs/guard_memory.hpp"
#include "rgs/interchange.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/splat_edit.hpp"
#include "tree_pages.hpp"
#include "write_report.hpp"
#include "zip_archive.hpp"

namespace rgs {
namespace {

using Json = nlohmann::ordered_json;

// As splat-transform has them (--lod-chunk-count, --lod-chunk-extent): most Gaussians of a region with all its levels,
// and of a SOG; and the width of most regions, world units, unless they are small.
constexpr std::uint64_t kMostGaussians = std::uint64_t{512} << 10, kFewGaussians = kMostGaussians / 4;
constexpr double kMostWidth = 16;

double width(const Box& box) {
  double most = 0;
  for (std::size_t k = 0; k < 3; ++k)
    most = std::max(most, static_cast<double>(box.max[k]) - static_cast<double>(box.min[k]));
  return most;
}

std::uint32_t choose_region_level(const std::vector<lod::Page>& pages) {
  std::vector<std::uint64_t> below(pages.size());  // Gaussians of each page and its descendants, which come later
  for (std::size_t i = pages.size(); i-- > 0;) {
    below[i] += pages[i].count;
    if (pages[i].parent != lod::kNoPage) below[pages[i].parent] += below[i];
  }
  for (std::uint32_t level = pages.front().level; level > 0; --level) {
    const std::vector<std::uint32_t> regions = lod::pages_of_level(pages, level);
    std::uint64_t most = 0, total = 0, in_wide = 0;
    for (const std::uint32_t i : regions) {
      most = std::max(most, below[i]);
      total += below[i];
      in_wide += width(pages[i].core) > kMostWidth ? below[i] : 0;
    }
    const bool is_wide = 2 * in_wide > total && total > kFewGaussians * regions.size();
    if (most <= kMostGaussians && !is_wide) return level;
  }
  return 0;
}

struct Region {
  std::uint32_t page = 0;
  Json lods = Json::object();
};

class Writer {
 public:
  Writer(const PagedFile& file, const WriteOptions& options, int sh_degree, const PutFile& put)
      : file_(file), pages_(file.pages()), axes_(options.axes), options_(options), sh_degree_(sh_degree), put_(put) {
    convert_axes(options_.origin, axes_, kAxes3dgs);
    options_.axes = kAxes3dgs;
    options_.keep_order = true;
  }

  Result<LevelsReport> write() {
    const std::uint32_t coarsest = choose_region_level(pages_);
    for (const std::uint32_t page : lod::pages_of_level(pages_, coarsest)) regions_.push_back({page});
    report_.n_levels = coarsest + 1;
    report_.n_regions = static_cast<std::uint32_t>(regions_.size());
    for (std::uint32_t level = 0; level <= coarsest; ++level) {
      if (Status s = write_level(level); !s) return tl::unexpected(s.error());
    }
    Json meta;
    meta["version"] = 1;
    meta["asset"] = {{"generator", "RoofGS"}};
    meta["count"] = report_.n_stored;
    meta["counts"] = counts_;
    meta["lodLevels"] = report_.n_levels;
    meta["lodErrors"] = false;  // theirs are of pictures; ours are footprints
    meta["filenames"] = filenames_;
    std::size_t next = 0;
    meta["tree"] = node(0, next);
    const std::string text = meta.dump();
    if (Status s = put_("lod-meta.json", std::as_bytes(std::span(text))); !s) return tl::unexpected(s.error());
    return report_;
  }

 private:
  Status write_level(std::uint32_t level) {
    std::vector<std::uint32_t> pages;  // of the SOG to be written
    std::uint64_t n = 0, n_level = 0, n_sogs = 0;
    const auto flush = [&]() -> Status {
      Status s = write_sog(std::to_string(level) + "_" + std::to_string(n_sogs++), pages);
      pages.clear();
      n = 0;
      return s;
    };
    for (Region& region : regions_) {
      const detail::PageRun run = detail::pages_below(pages_, region.page, level);
      if (n != 0 && n + run.count > kMostGaussians) {
        if (Status s = flush(); !s) return s;
      }
      region.lods[std::to_string(level)] = {{"file", filenames_.size()}, {"offset", n}, {"count", run.count}};
      pages.insert(pages.end(), run.pages.begin(), run.pages.end());
      n += run.count;
      n_level += run.count;
    }
    counts_.push_back(n_level);
    report_.n_stored += n_level;
    return flush();
  }

  Status write_sog(const std::string& name, std::span<const std::uint32_t> pages) {
    auto cloud = read_pages(file_, pages);
    if (!cloud) return tl::unexpected(cloud.error());
    strip_sh(*cloud, sh_degree_);
    convert_axes(*cloud, axes_, kAxes3dgs);
    const auto rounding = position_rounding(cloud->view(), SplatFormat::sog, options_);
    if (!rounding) return tl::unexpected(rounding.error());
    report_.position_rounding = std::max(report_.position_rounding, *rounding);
    WriteReport clamped;
    const auto zipped = encode_splats(cloud->view(), SplatFormat::sog, options_, &clamped);
    if (!zipped) return tl::unexpected(zipped.error());
    detail::add_report(report_.clamped, clamped);
    const auto archive = detail::ZipArchive::open(*zipped);
    if (!archive) return tl::unexpected(archive.error());
    const std::string folder = name + "/";
    for (const std::string& file : archive->names()) {
      const auto bytes = archive->read(file, {}, "");
      if (!bytes) return tl::unexpected(bytes.error());
      if (Status s = put_(folder + file, *bytes); !s) return s;
    }
    filenames_.push_back(folder + "meta.json");
    return {};
  }

  Json bound(const Box& box) const {
    const WorldBox turned = detail::turned_box(box, axes_, kAxes3dgs, options_.origin);
    return {{"min", turned.min}, {"max", turned.max}};
  }

  // In the order of regions.
  Json node(std::uint32_t page, std::size_t& next) {
    Json json{{"bound", bound(pages_[page].bounds)}};
    if (pages_[page].level + 1 == report_.n_levels) {
      json["lods"] = std::move(regions_[next++].lods);
      return json;
    }
    for (std::uint32_t k = 0; k < pages_[page].n_children; ++k)
      json["children"].push_back(node(pages_[page].first_child + k, next));
    return json;
  }

  const PagedFile& file_;
  const std::vector<lod::Page>& pages_;
  Axes axes_;  // of the file
  WriteOptions options_;
  int sh_degree_;
  const PutFile& put_;
  std::vector<Region> regions_;
  std::vector<std::uint64_t> counts_;
  std::vector<std::string> filenames_;
  LevelsReport report_;
};

}  // namespace

Result<LevelsReport> write_streamed_sog(const PagedFile& file, const WriteOptions& options, int sh_degree,
                                        const PutFile& put) {
  return detail::guard_memory([&]() -> Result<LevelsReport> {
    if (!file.complete())
      return make_error(Errc::pages_missing, Error::kNone, "the end of the file is missing, and pages with it");
    return Writer(file, options, sh_degree, put).write();
  });
}

}  // namespace rgs
