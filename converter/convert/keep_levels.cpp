// keep_levels.cpp - cuts the nodes of a file's own levels into pages.
// SPDX-License-Identifier: Apache-2.0
#include "keep_levels.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numeric>
#include <span>
#include <utility>

#include "check_error.hpp"
#include "convert_steps.hpp"
#include "core_box.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/spatial_order.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs {
namespace {

constexpr std::uint32_t kMostLevels = 32;   // of a file; what is built above them has fewer
constexpr std::uint64_t kMostRepeats = 4;   // of all Gaussians, where levels are lacking
constexpr std::uint64_t kMeasuring = 1024;  // bytes a Gaussian

// What becomes pages of one level that are drawn together.
struct Region {
  std::vector<std::uint32_t> nodes;
  std::uint64_t n = 0, first = 0;                 // Gaussians, among those of the level
  std::uint32_t first_child = 0, n_children = 0;  // regions of the level below
  std::uint64_t most_pages = 0;                   // so that each has a page below
  std::vector<std::uint64_t> cuts;                // where its pages begin, and their end
  std::vector<std::uint32_t> n_below;             // of each page, how many of the level below are its children
  std::uint32_t first_page = 0;
  Box core = {};
  float error = 0;

  std::uint64_t end() const { return first + n; }
  std::uint64_t n_pages() const { return cuts.size() - 1; }
};
using RegionLevels = std::vector<std::vector<Region>>;  // finest first

tl::unexpected<Error> unsupported(const char* what) {
  return make_error(Errc::unsupported_feature, Error::kNone, what);
}

std::uint64_t up_to(std::uint64_t n, std::uint64_t each) {
  return (n + each - 1) / each;
}

// Keeps sound Gaussians, and repairs others if asked to. `positions`: of those kept.
std::vector<Splat> clean(const SplatCloud& cloud, int sh_degree, BadPolicy on_bad,
                         std::vector<std::uint32_t>* positions = nullptr) {
  std::vector<Splat> kept;
  kept.reserve(cloud.size());
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    Splat s = cloud.view().splat(i);
    const std::uint32_t defects = find_defects(s, sh_degree);
    if (defects != 0 && (on_bad != BadPolicy::repair || !repair(s, defects))) continue;
    kept.push_back(s);
    if (positions != nullptr) positions->push_back(static_cast<std::uint32_t>(i));
  }
  return kept;
}

// Positions along the Morton curve to the last bit, so that levels can be cut alike; but the `n_first` that show least
// come first.
std::vector<std::uint32_t> order_of(std::span<const Splat> rows, const MortonKey& key, std::uint64_t n_first) {
  std::vector<std::uint32_t> order(rows.size());
  std::iota(order.begin(), order.end(), 0U);
  const std::vector<std::uint64_t> keys = lod::keys_of(rows, key);
  std::ranges::stable_sort(order, {}, [&](std::uint32_t i) { return keys[i]; });
  if (n_first == 0 || n_first >= rows.size()) return order;
  std::vector<std::pair<double, std::uint32_t>> shows(rows.size());
  for (std::uint32_t i = 0; i < rows.size(); ++i) {
    double side[3];
    for (std::size_t k = 0; k < 3; ++k) side[k] = std::exp(static_cast<double>(rows[i].log_scale[k]));
    shows[i] = {(side[0] * side[1] + side[1] * side[2] + side[2] * side[0]) /
                    (1 + std::exp(-static_cast<double>(rows[i].opacity_logit))),
                i};
  }
  auto sorted = shows;
  std::ranges::nth_element(sorted, sorted.begin() + static_cast<std::ptrdiff_t>(n_first));
  const auto threshold = sorted[n_first];
  std::stable_partition(order.begin(), order.end(), [&](std::uint32_t i) { return shows[i] < threshold; });
  return order;
}

// Whether each node has Gaussians and leaves.
std::vector<bool> find_living(const LevelTree& tree, std::span<const std::uint64_t> n_kept,
                              const std::vector<bool>& is_leaf) {
  std::vector<bool> lives(tree.nodes.size());
  for (std::size_t i = lives.size(); i-- > 0;) {
    if (is_leaf[i]) lives[i] = n_kept[i] != 0;
    if (lives[i] && tree.nodes[i].parent != LevelTree::kNoParent) lives[tree.nodes[i].parent] = true;
    lives[i] = lives[i] && n_kept[i] != 0;
  }
  return lives;
}

// Numbers levels anew, without those that no living node has.
void close_gaps(std::span<LevelTree::Node> nodes, const std::vector<bool>& lives) {
  std::array<bool, kMostLevels> is_used{};
  for (std::size_t i = 0; i < nodes.size(); ++i) is_used[nodes[i].level] = is_used[nodes[i].level] || lives[i];
  for (LevelTree::Node& node : nodes)
    node.level = static_cast<std::uint32_t>(std::count(is_used.begin(), is_used.begin() + node.level, true));
}

// Regions of all levels: nodes, and repeated ones where a level is lacking. Errors: limit_exceeded.
Result<RegionLevels> regions_of(const LevelTree& tree, std::span<const std::uint64_t> n_kept,
                                const std::vector<bool>& lives) {
  const std::size_t n = tree.nodes.size();
  std::vector<std::vector<std::uint32_t>> children(n);
  std::vector<std::uint32_t> roots;
  const auto region = [&](std::uint32_t node) {
    Region r;
    r.nodes = {node};
    r.n = n_kept[node];
    return r;
  };
  std::uint32_t highest = 0;
  for (std::uint32_t i = 0; i < n; ++i) {
    if (!lives[i]) continue;
    std::uint32_t parent = tree.nodes[i].parent;
    while (parent != LevelTree::kNoParent && n_kept[parent] == 0) parent = tree.nodes[parent].parent;
    (parent == LevelTree::kNoParent ? roots : children[parent]).push_back(i);
    highest = std::max(highest, tree.nodes[i].level);
  }
  // Each node is repeated down to its own level or, without children, to the leaves: count before there is memory.
  std::vector<std::uint32_t> above(n, highest + 1);  // the parent's level
  std::uint64_t n_all = 0, n_nodes = 0;
  for (std::uint32_t i = 0; i < n; ++i) {
    n_nodes += n_kept[i];
    if (!lives[i]) continue;
    for (const std::uint32_t child : children[i]) above[child] = tree.nodes[i].level;
    n_all += n_kept[i] * (above[i] - (children[i].empty() ? 0 : tree.nodes[i].level));
  }
  if (n_all > (1 + kMostRepeats) * n_nodes)
    return make_error(Errc::limit_exceeded, Error::kNone,
                      "so many regions lack levels of detail that their Gaussians would be repeated more than 4 "
                      "times; pass --lod, which builds new ones",
                      (1 + kMostRepeats) * n_nodes, n_all);
  RegionLevels levels(highest + 1);
  for (const std::uint32_t root : roots) levels[highest].push_back(region(root));
  for (std::uint32_t level = highest; level > 0; --level) {
    std::vector<Region>& below = levels[level - 1];
    for (Region& r : levels[level]) {
      const std::uint32_t node = r.nodes.front();
      r.first_child = static_cast<std::uint32_t>(below.size());
      if (tree.nodes[node].level < level || children[node].empty()) {
        below.push_back(region(node));
      } else {
        for (const std::uint32_t child : children[node]) below.push_back(region(child));
      }
      r.n_children = static_cast<std::uint32_t>(below.size()) - r.first_child;
    }
  }
  return levels;
}

// Joins regions without a chunk of leaves that begins in them, and what is then without children, to the one before.
void join_small(std::uint64_t chunk_size, RegionLevels& levels) {
  std::vector<std::uint32_t> below;  // regions left before each of the level below
  for (std::vector<Region>& level : levels) {
    std::vector<Region> left;
    std::vector<std::uint32_t> before{0};
    std::uint64_t first = 0;
    for (Region& r : level) {
      r.first = first;
      first += r.n;
      bool stays = up_to(r.end(), chunk_size) > up_to(r.first, chunk_size);
      if (!below.empty()) {
        const std::uint32_t end = below[r.first_child + r.n_children];
        r.first_child = below[r.first_child];
        r.n_children = end - r.first_child;
        stays = r.n_children != 0;
      }
      if (stays) {
        left.push_back(std::move(r));
      } else {
        left.back().nodes.insert(left.back().nodes.end(), r.nodes.begin(), r.nodes.end());
        left.back().n += r.n;
      }
      before.push_back(static_cast<std::uint32_t>(left.size()));
    }
    level = std::move(left);
    below = std::move(before);
  }
}

void enlarge(Box& box, const Box& by) {
  for (std::size_t k = 0; k < 3; ++k) {
    box.min[k] = std::min(box.min[k], by.min[k]);
    box.max[k] = std::max(box.max[k], by.max[k]);
  }
}

// Cuts regions into pages.
class Cutter {
 public:
  Cutter(const MortonKey& key, const lod::BuildOptions& build, std::uint64_t most_rows, lod::StreamedLevels& out)
      : key_(key), build_(build), most_rows_(most_rows), out_(out) {}

  // Cuts the regions of all levels into pages, coarse to fine: finer pages where coarser ones begin.
  Status cut(const lod::StreamOptions& options, RegionLevels& levels) {
    for (std::size_t level = 0; level < levels.size(); ++level) {
      for (Region& r : levels[level]) {
        r.most_pages = level == 0 ? units(0, r) : 0;
        for (std::uint32_t k = 0; k < r.n_children; ++k) {
          const Region& child = levels[level - 1][r.first_child + k];
          r.most_pages += r.n_children == 1 ? child.most_pages : usual(child);
        }
        // Pages do not lie where several regions below them do: as few as may be.
        if (r.n_children > 1) r.most_pages = std::max(up_to(r.most_pages, lod::kMaxChildren), up_to(r.n, most_rows_));
        r.most_pages = std::min(r.most_pages, r.n);
      }
    }
    const std::size_t highest = levels.size() - 1;
    for (Region& r : levels[highest]) cut_evenly(highest, r);
    for (std::size_t level = highest; level > 0; --level) {
      std::uint64_t most = 1;
      for (const Region& r : levels[level - 1]) most = std::max(most, r.n);
      const Status status =
          lod::each_at_once(levels[level].size(), lod::most_at_once(options, kMeasuring * most),
                            [&](std::size_t i) { return cut_below(level, levels[level][i], levels[level - 1]); });
      if (!status) return status;
    }
    for (std::size_t level = 0; level < levels.size(); ++level) add_pages(level, levels);
    for (const std::vector<lod::Page>& pages : out_.pages) {
      for (const lod::Page& page : pages) {
        if (page.count > most_rows_ || page.n_children > lod::kMaxChildren)
          return unsupported(
              "levels of detail of a region differ too much in size for an .rgs; pass --lod, which builds new ones");
      }
    }
    return {};
  }

 private:
  // Leaves are cut by chunks, others by Gaussians.
  std::uint64_t unit(std::size_t level) const { return level == 0 ? build_.chunk_size : 1; }
  std::uint64_t begin(std::size_t level, const Region& r) const { return up_to(r.first, unit(level)); }
  std::uint64_t units(std::size_t level, const Region& r) const {
    return up_to(r.end(), unit(level)) - begin(level, r);
  }
  std::uint64_t usual(const Region& r) const {
    const std::uint64_t rows = std::uint64_t{build_.page_chunks} * build_.chunk_size;
    return std::clamp<std::uint64_t>(up_to(r.n, rows), 1, std::max<std::uint64_t>(r.most_pages, 1));
  }
  // `units` from unit `first` on become `n` pages.
  void add_cuts(std::size_t level, std::uint64_t first, std::uint64_t units, std::uint64_t n, Region& r) const {
    for (std::uint64_t k = 0; k < n; ++k) r.cuts.push_back((first + k * units / n) * unit(level));
  }
  void end_cuts(std::size_t level, Region& r) const {
    r.cuts.push_back(level == 0 ? std::min(out_.n_leaves, up_to(r.end(), unit(0)) * unit(0)) : r.end());
  }
  void cut_evenly(std::size_t level, Region& r) const {
    add_cuts(level, begin(level, r), units(level, r), usual(r), r);
    end_cuts(level, r);
  }

  Status keys(std::size_t level, std::uint64_t first, std::uint64_t n, std::vector<std::uint64_t>& to) const {
    SplatCloud splats;
    if (Status s = out_.rows[level].read(first, n, splats); !s) return s;
    to.resize(n);
    for (std::uint64_t i = 0; i < n; ++i) to[i] = key_(&splats.mean[3 * i]);
    return {};
  }

  Status cut_below(std::size_t level, Region& r, std::vector<Region>& below) const {
    const std::uint64_t n = r.n_pages();
    if (r.n_children != 1) {
      std::uint64_t total = 0;
      for (std::uint32_t k = 0; k < r.n_children; ++k) {
        cut_evenly(level - 1, below[r.first_child + k]);
        total += below[r.first_child + k].n_pages();
      }
      for (std::uint64_t k = 0; k < n; ++k)
        r.n_below.push_back(static_cast<std::uint32_t>((k + 1) * total / n - k * total / n));
      return {};
    }
    Region& child = below[r.first_child];
    const std::uint64_t first = begin(level - 1, child), end = first + units(level - 1, child),
                        row = std::min(first * unit(level - 1), child.end());
    std::vector<std::uint64_t> borders{first}, of_child, of_page;
    if (n > 1) {
      if (Status s = keys(level - 1, row, child.end() - row, of_child); !s) return s;
    }
    for (std::uint64_t k = 1; k < n; ++k) {
      if (Status s = keys(level, r.cuts[k], 1, of_page); !s) return s;
      const auto at = static_cast<std::uint64_t>(std::ranges::lower_bound(of_child, of_page[0]) - of_child.begin());
      borders.push_back(
          std::clamp((row + at + unit(level - 1) / 2) / unit(level - 1), borders.back() + 1, end - (n - k)));
    }
    borders.push_back(end);
    const std::uint64_t rows = std::uint64_t{build_.page_chunks} * build_.chunk_size;
    std::uint64_t total = 0;
    for (std::uint64_t k = 0; k < n; ++k) {
      const std::uint64_t wanted = up_to((borders[k + 1] - borders[k]) * unit(level - 1), rows);
      r.n_below.push_back(static_cast<std::uint32_t>(std::min<std::uint64_t>(wanted, lod::kMaxChildren)));
      total += r.n_below.back();
    }
    if (total > child.most_pages) std::ranges::fill(r.n_below, 1U);
    for (std::uint64_t k = 0; k < n; ++k)
      add_cuts(level - 1, borders[k], borders[k + 1] - borders[k], r.n_below[k], child);
    end_cuts(level - 1, child);
    return {};
  }

  // Without cores and errors.
  void add_pages(std::size_t level, RegionLevels& levels) {
    std::vector<lod::Page>& pages = out_.pages.emplace_back();
    for (Region& r : levels[level]) {
      r.first_page = static_cast<std::uint32_t>(pages.size());
      std::uint32_t child = level == 0 ? 0 : levels[level - 1][r.first_child].first_page;
      for (std::size_t k = 0; k < r.n_pages(); ++k) {
        lod::Page page;
        page.level = static_cast<std::uint32_t>(level);
        page.first = r.cuts[k];
        page.count = static_cast<std::uint32_t>(r.cuts[k + 1] - r.cuts[k]);
        page.first_child = child;
        page.n_children = level == 0 ? 0 : r.n_below[k];
        child += page.n_children;
        pages.push_back(page);
      }
    }
  }

  const MortonKey& key_;
  const lod::BuildOptions& build_;
  std::uint64_t most_rows_;
  lod::StreamedLevels& out_;
};

// The error of a region: that of its middle page, if none is stated. A page that half of what rgs-info allows would
// refute, as one of floaters, gets an error of its own.
Status measure_pages(const lod::StreamedLevels& levels, Region& region, std::span<lod::Page> pages,
                     std::span<const lod::Page> below, bool stated, bool lossy) {
  constexpr float kTrusted = lod::kErrorTolerance / 2;
  constexpr int kMostRounds = 16;
  const std::uint32_t level = pages.front().level;
  const auto measure = [&](const lod::Page& page) -> Result<float> {
    const lod::Page &first = below[page.first_child], &last = below[page.first_child + page.n_children - 1];
    SplatCloud finer, coarser;
    Status s = levels.rows[level - 1].read(first.first, last.first + last.count - first.first, finer);
    if (s) s = levels.rows[level].read(page.first, page.count, coarser);
    if (!s) return tl::unexpected(s.error());
    // Other Gaussians that look the same here, or lossy ones, may not do so in the file.
    const bool is_same = !lossy && coarser.mean == finer.mean;
    return lod::error_against(finer.view(), coarser.view(), page.error, is_same);
  };
  std::vector<float> errors;
  for (const lod::Page& page : pages) {
    if (stated) break;
    const auto measured = measure(page);
    if (!measured) return tl::unexpected(measured.error());
    errors.push_back(*measured);
  }
  if (!stated) {
    std::ranges::nth_element(errors, errors.begin() + static_cast<std::ptrdiff_t>(errors.size() / 2));
    region.error = std::max(region.error, errors[errors.size() / 2]);
  }
  for (lod::Page& page : pages) {
    page.error = region.error;
    for (int round = 0; round < kMostRounds; ++round) {  // coarser pictures show more errors of large Gaussians
      const auto measured = measure(page);
      if (!measured) return tl::unexpected(measured.error());
      if (!(*measured > kTrusted * page.error)) break;
      page.error = std::max(2 * page.error, *measured / kTrusted);
    }
  }
  return {};
}

}  // namespace

Result<KeptLevels> KeptLevels::open(LevelTree tree, const Axes& from, const EncodeOptions& encode) {
  return detail::guard_memory([&]() -> Result<KeptLevels> {
    KeptLevels kept;
    kept.from_ = from;
    kept.to_ = encode.axes;
    kept.is_leaf_.assign(tree.nodes.size(), true);
    for (const LevelTree::Node& node : tree.nodes) {
      if (node.parent != LevelTree::kNoParent) kept.is_leaf_[node.parent] = false;
      if (node.level >= kMostLevels)
        return unsupported("more than 32 levels of detail; pass --lod, which builds new ones");
    }
    kept.n_kept_.resize(tree.nodes.size());
    kept.coarser_ = SceneScan(encode.sh_degree, encode.on_bad);
    kept.tree_ = std::move(tree);
    bool first = true;
    const Status status = kept.read([&](std::uint32_t node, const SplatFile& piece) -> Status {
      if (first) kept.tree_.file.aa_mode = piece.aa_mode;
      first = false;
      kept.tree_.file.bytes += piece.bytes;
      kept.rounding_.add({piece.position_rounding, largest_rest(piece.cloud.mean_rest)});
      kept.sh_degree_ = std::max(kept.sh_degree_, piece.cloud.sh_degree);
      kept.n_kept_[node] = clean(piece.cloud, encode.sh_degree, encode.on_bad).size();
      for (std::uint64_t i = 0; i < piece.cloud.size() && !kept.is_leaf_[node]; ++i) {
        Splat s = piece.cloud.view().splat(i);
        kept.coarser_.add(s);
      }
      return {};
    });
    if (!status) return tl::unexpected(status.error());
    const SceneScan& coarser = kept.coarser_;
    if (encode.on_bad == BadPolicy::refuse && coarser.n_kept() != coarser.n_source())
      return damaged_gaussian(Error::kNone, coarser);
    if (const Status s = check_encodable(coarser, encode); !s) return tl::unexpected(s.error());
    close_gaps(kept.tree_.nodes, find_living(kept.tree_, kept.n_kept_, kept.is_leaf_));
    return kept;
  });
}

Status KeptLevels::read(const LevelTree::Visit& visit) const {
  return tree_.read([&](std::uint32_t node, SplatFile piece) {
    convert_axes(piece.cloud, from_, to_);
    return visit(node, std::move(piece));
  });
}

lod::SplatStream KeptLevels::leaves() const {
  lod::SplatStream stream;
  for (std::size_t i = 0; i < tree_.nodes.size(); ++i) stream.n += is_leaf_[i] ? tree_.nodes[i].n : 0;
  stream.sh_degree = sh_degree_;
  stream.read = [this](const lod::SplatStream::Visit& visit) {
    std::uint64_t first = 0;
    return read([&](std::uint32_t node, const SplatFile& piece) -> Status {
      if (!is_leaf_[node]) return {};
      std::vector<Splat> rows(piece.cloud.size());
      for (std::uint64_t i = 0; i < rows.size(); ++i) rows[i] = piece.cloud.view().splat(i);
      first += rows.size();
      return visit(first - rows.size(), rows);
    });
  };
  return stream;
}

Status KeptLevels::arrange(const SceneScan& scan, const EncodeOptions& encode, const lod::StreamOptions& options,
                           lod::StreamedLevels& out) const {
  return detail::guard_memory([&]() -> Status {
    const lod::BuildOptions build = lod::build_options(encode, options);
    auto found_regions = regions_of(tree_, n_kept_, find_living(tree_, n_kept_, is_leaf_));
    if (!found_regions) return tl::unexpected(found_regions.error());
    RegionLevels& levels = *found_regions;
    join_small(build.chunk_size, levels);

    // The place of each node's Gaussians.
    struct Place {
      std::uint32_t level = 0;
      std::uint64_t first = 0;
    };
    std::vector<std::vector<Place>> places(tree_.nodes.size());
    using Kind = lod::LevelRows::Kind;
    const Kind of_leaves = Kind::of_leaves(encode);
    out = {};
    std::uint64_t bytes = 0, n_all = 0;
    std::vector<std::uint64_t> level_bytes;
    for (std::uint32_t level = 0; level < levels.size(); ++level) {
      std::uint64_t first = 0;
      for (const Region& r : levels[level]) {
        for (const std::uint32_t node : r.nodes) {
          places[node].push_back({level, first});
          first += n_kept_[node];
        }
      }
      const Kind kind = level == 0 ? of_leaves : Kind::of_upper();
      level_bytes.push_back(first * lod::LevelRows({}, scan.sh_degree(), kind).row_bytes());
      bytes += level_bytes.back();
      n_all += first;
    }
    out.n_leaves = levels.front().back().end();
    if (out.n_leaves != scan.n_kept())
      return make_error(Errc::read_failed, Error::kNone, "the source changed while it was read");
    out.on_disk = bytes > options.memory_bytes / 4;
    for (std::uint32_t level = 0; level < levels.size(); ++level) {
      auto file = lod::scratch_file(out.on_disk, options);
      if (!file) return tl::unexpected(file.error());
      if (!out.on_disk) {  // allocate at once, do not grow
        if (Status s = file->write(level_bytes[level] - 1, std::array<std::byte, 1>{}); !s) return s;
      }
      out.rows.emplace_back(std::move(*file), scan.sh_degree(), level == 0 ? of_leaves : Kind::of_upper());
    }
    if (encode.keep_permutation) out.positions.resize(out.n_leaves);
    options.begin("place", n_all, "Gaussians");
    const MortonKey key(scan.robust());
    std::uint64_t n_read = 0;  // leaves
    const Status placed = read([&](std::uint32_t node, const SplatFile& piece) -> Status {
      std::vector<std::uint32_t> positions;
      const std::vector<Splat> rows = clean(piece.cloud, encode.sh_degree, encode.on_bad, &positions);
      if (rows.size() != n_kept_[node])
        return make_error(Errc::read_failed, Error::kNone, "the source changed while it was read");
      for (const auto& [level, first] : places[node]) {
        const std::uint64_t short_of = up_to(first, build.chunk_size) * build.chunk_size - first;
        const std::vector<std::uint32_t> order = order_of(rows, key, level == 0 ? short_of : 0);
        lod::LevelRows& to = out.rows[level];
        std::vector<std::byte> packed(rows.size() * to.row_bytes());
        for (std::size_t i = 0; i < rows.size(); ++i) {
          const std::uint32_t at = positions[order[i]];
          const auto position =
              piece.source_index.empty() ? static_cast<std::uint32_t>(n_read + at) : piece.source_index[at];
          to.pack(rows[order[i]], position, &packed[i * to.row_bytes()]);
          if (level == 0 && encode.keep_permutation) out.positions[first + i] = position;
        }
        if (Status s = to.file().write(first * to.row_bytes(), packed); !s) return s;
        options.advance(rows.size());
      }
      n_read += is_leaf_[node] ? piece.cloud.size() : 0;
      return {};
    });
    if (!placed) return placed;

    options.begin("levels", n_all, "Gaussians");
    const bool lossy = encode.profile == Profile::archive;
    const std::uint64_t most_rows = lossy ? kMaxArchiveRows : lod::kMaxPageRows;
    if (Status s = Cutter(key, build, most_rows, out).cut(options, levels); !s) return s;
    std::vector<lod::Page>& leaves = out.pages.front();
    const std::uint64_t page_bytes = kMeasuring * build.page_chunks * build.chunk_size;
    const Status found =
        lod::each_at_once(leaves.size(), lod::most_at_once(options, page_bytes), [&](std::size_t i) -> Status {
          SplatCloud splats;
          if (Status s = out.rows.front().read(leaves[i].first, leaves[i].count, splats); !s) return s;
          leaves[i].bounds = leaves[i].core = lod::core_of(splats.view(), 0, splats.size());
          return {};
        });
    if (!found) return found;
    for (Region& r : levels.front()) {
      r.core = leaves[r.first_page].core;
      for (std::uint32_t k = 1; k < r.n_pages(); ++k) enlarge(r.core, leaves[r.first_page + k].core);
    }
    for (std::uint32_t level = 1; level < levels.size(); ++level) {
      std::vector<Region>& regions = levels[level];
      const std::vector<Region>& below = levels[level - 1];
      std::vector<lod::Page>& pages = out.pages[level];
      std::uint64_t most = 1;
      for (const lod::Page& page : pages) {
        const lod::Page &first = out.pages[level - 1][page.first_child],
                        &last = out.pages[level - 1][page.first_child + page.n_children - 1];
        most = std::max(most, page.count + last.first + last.count - first.first);
      }
      const auto measure = [&](std::size_t i) -> Status {
        Region& r = regions[i];
        const Region& first = below[r.first_child];
        r.core = first.core;
        bool stated = true;
        for (std::uint32_t k = 0; k < r.n_children; ++k) {
          enlarge(r.core, below[r.first_child + k].core);
          r.error = std::max(r.error, lod::kErrorGrowth * below[r.first_child + k].error);
        }
        for (const std::uint32_t node : r.nodes)
          stated = stated && tree_.nodes[node].level == level && tree_.nodes[node].error > 0;
        for (const std::uint32_t node : r.nodes)
          if (stated) r.error = std::max(r.error, tree_.nodes[node].error);
        const auto of_region = std::span(pages).subspan(r.first_page, r.n_pages());
        // Not stated also where the level below is repeated, which may be cut otherwise.
        if (Status s = measure_pages(out, r, of_region, out.pages[level - 1], stated, lossy); !s) return s;
        r.error = std::clamp(r.error, std::numeric_limits<float>::min(), lod::kMostError);
        for (lod::Page& page : of_region) {
          page.bounds = page.core = r.core;
          page.error = std::min(std::max(page.error, r.error), lod::kMostError);
          for (std::uint32_t k = 0; k < page.n_children; ++k)
            page.error = std::max(page.error, lod::kErrorGrowth * out.pages[level - 1][page.first_child + k].error);
        }
        options.advance(r.n);
        return {};
      };
      const Status measured = lod::each_at_once(regions.size(), lod::most_at_once(options, kMeasuring * most), measure);
      if (!measured) return measured;
    }
    // Pages of regions above several are larger than those that are built, and so are groups of them.
    const std::uint64_t usual = std::uint64_t{build.page_chunks} * build.chunk_size;
    std::uint64_t largest = usual;
    for (const lod::Page& page : out.pages.back()) largest = std::max<std::uint64_t>(largest, page.count);
    lod::StreamOptions above = options;
    above.memory_bytes = options.memory_bytes / largest * usual;
    return lod::build_above(encode, above, {0, static_cast<std::uint32_t>(out.pages.back().size())}, out);
  });
}

}  // namespace rgs
