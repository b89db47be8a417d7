// build_levels.cpp - builds the tree of pages: cuts leaves in file order, then simplifies groups of neighbours, level
// by level.
// SPDX-License-Identifier: Apache-2.0
#include "build_levels.hpp"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/partitioner.h>

#include <algorithm>
#include <cassert>
#include <cmath>
#include <functional>
#include <limits>
#include <utility>

#include "clusters.hpp"
#include "core_box.hpp"
#include "gaussians.hpp"
#include "measure.hpp"
#include "rgs/math/covariance.hpp"

namespace rgs::lod {
namespace {

// Stored scales and rotations are rounded to FP16 afterwards; bounds must hold the rounded ones.
constexpr float kRoundingMargin = 1.004F;
constexpr float kBoundSigmas = 3;
constexpr double kLeastKept = 0.02, kMostKept = 0.75;  // of a group
// A run of boxes has a gap where the box around it is longer than kGap times the sum of their lengths.
constexpr float kGap = 2;
// Boxes whose lengths differ by more than this factor do not share a run: floaters.
constexpr float kUnlike = 12;

Box empty_box() {
  constexpr float kMost = std::numeric_limits<float>::max();
  return {{kMost, kMost, kMost}, {-kMost, -kMost, -kMost}};
}

void add(Box& box, const Box& other) {
  for (std::size_t k = 0; k < 3; ++k) {
    box.min[k] = std::min(box.min[k], other.min[k]);
    box.max[k] = std::max(box.max[k], other.max[k]);
  }
}

float length(const Box& box) {
  float total = 0;
  for (std::size_t k = 0; k < 3; ++k) total += (box.max[k] - box.min[k]) * (box.max[k] - box.min[k]);
  return std::sqrt(total);
}

Box bounds_of(const SplatView& splats, std::uint64_t first, std::uint64_t n, float sigmas) {
  Box box = empty_box();
  for (std::uint64_t i = first; i < first + n; ++i) {
    float scale[3] = {0, 0, 0}, r[9] = {};
    if (sigmas > 0) {
      const float* const q = &splats.rotation[4 * i];
      const float norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
      const float factor = norm > 0 ? 1 / norm : 0;
      math::rotation_matrix(
          math::Quaternion<float>{norm > 0 ? q[0] * factor : 1, q[1] * factor, q[2] * factor, q[3] * factor}, r);
      for (std::size_t k = 0; k < 3; ++k) scale[k] = sigmas * kRoundingMargin * std::exp(splats.log_scale[3 * i + k]);
    }
    for (std::size_t k = 0; k < 3; ++k) {
      double squared = 0;  // the squares of the smallest underflow in FP32
      for (std::size_t l = 0; l < 3; ++l) {
        const double along = static_cast<double>(r[3 * k + l]) * static_cast<double>(scale[l]);
        squared += along * along;
      }
      const auto reach = static_cast<float>(std::sqrt(squared));
      box.min[k] = std::min(box.min[k], splats.mean[3 * i + k] - reach);
      box.max[k] = std::max(box.max[k], splats.mean[3 * i + k] + reach);
    }
  }
  return box;
}

// Consecutive boxes, as long as they are neighbours of similar size.
class Run {
 public:
  bool takes(const Box& next) const {
    if (n_ == 0) return true;
    Box around = box_;
    add(around, next);
    const float size = length(next);
    if (size > kUnlike * longest_ || longest_ > kUnlike * size) return longest_ == 0 || size == 0;
    return length(around) <= kGap * (lengths_ + size);
  }
  void take(const Box& next) {
    n_ == 0 ? void(box_ = next) : add(box_, next);
    lengths_ += length(next);
    longest_ = std::max(longest_, length(next));
    ++n_;
  }

 private:
  std::uint32_t n_ = 0;
  Box box_;
  float lengths_ = 0, longest_ = 0;
};

template <class F>
void each_in_parallel(std::size_t n, const F& f) {
  tbb::parallel_for(
      tbb::blocked_range<std::size_t>(0, n, 1),
      [&f](const tbb::blocked_range<std::size_t>& range) {
        for (std::size_t i = range.begin(); i < range.end(); ++i) f(i);
      },
      tbb::simple_partitioner());
}

void append(SplatCloud& to, const SplatCloud& from) {
  const auto insert = [](std::vector<float>& a, const std::vector<float>& b) { a.insert(a.end(), b.begin(), b.end()); };
  to.sh_degree = from.sh_degree;
  insert(to.mean, from.mean);
  insert(to.log_scale, from.log_scale);
  insert(to.rotation, from.rotation);
  insert(to.opacity_logit, from.opacity_logit);
  insert(to.sh, from.sh);
}

void append(SplatCloud& to, const SplatView& from) {
  const auto insert = [](std::vector<float>& a, std::span<const float> b) { a.insert(a.end(), b.begin(), b.end()); };
  to.sh_degree = from.sh_degree;
  insert(to.mean, from.mean);
  insert(to.log_scale, from.log_scale);
  insert(to.rotation, from.rotation);
  insert(to.opacity_logit, from.opacity_logit);
  insert(to.sh, from.sh);
}

float longest_log_scale(const SplatView& splats, std::uint64_t i) {
  return std::max({splats.log_scale[3 * i], splats.log_scale[3 * i + 1], splats.log_scale[3 * i + 2]});
}

// Appends at most `wanted` Gaussians that replace from .. from + n - 1. Returns their error.
float replace(const SplatView& splats, std::uint64_t from, std::uint64_t n, std::uint64_t wanted, const float centre[3],
              const BuildOptions& options, SplatCloud& out) {
  const Gaussians group = activate(splats, from, n, centre);
  if (wanted >= n) {
    append(group, centre, out);
    return 0;
  }
  const Simplified simple = simplify(group, wanted, options.quality, options.device.get());
  append(simple.gaussians, centre, out);
  return simple.error;
}

// The same where some are far: keeps the longest of these, up to their share, and drops the others.
float replace_without_far(const SplatView& splats, std::span<const std::uint64_t> near, std::vector<std::uint64_t> far,
                          std::uint64_t wanted, const float centre[3], const BuildOptions& options, SplatCloud& out) {
  constexpr float kNowhere[3] = {0, 0, 0};
  const std::uint64_t share = std::max<std::uint64_t>(1, wanted * far.size() / (near.size() + far.size()));
  const std::uint64_t n_kept = near.empty() ? std::min<std::uint64_t>(wanted, far.size()) : std::min(share, wanted - 1);
  std::ranges::stable_sort(far, std::ranges::greater(), [&](std::uint64_t i) { return longest_log_scale(splats, i); });
  float error = 0;
  if (!near.empty()) {
    SplatCloud some;
    some.resize(near.size(), splats.sh_degree);
    for (std::size_t i = 0; i < near.size(); ++i) some.set(i, splats.splat(near[i]));
    error = replace(some.view(), 0, near.size(), wanted - n_kept, centre, options, out);
  }
  for (std::uint64_t i = 0; i < n_kept; ++i) append(activate(splats, far[i], 1, kNowhere), kNowhere, out);
  // A dropped Gaussian must be smaller than a pixel.
  if (n_kept < far.size()) error = std::max(error, 2 * kBoundSigmas * std::exp(longest_log_scale(splats, far[n_kept])));
  return error;
}

std::vector<ChunkBoxes> boxes_of_chunks(const SplatView& leaves, const BuildOptions& options) {
  std::vector<ChunkBoxes> chunks((leaves.n + options.chunk_size - 1) / options.chunk_size);
  each_in_parallel(chunks.size(), [&](std::size_t i) {
    const std::uint64_t first = i * std::uint64_t{options.chunk_size};
    chunks[i] = chunk_boxes(leaves, first, std::min<std::uint64_t>(options.chunk_size, leaves.n - first));
  });
  return chunks;
}

void find_cores(const SplatView& leaves, std::span<Page> pages) {
  each_in_parallel(pages.size(),
                   [&](std::size_t i) { pages[i].core = core_of(leaves, pages[i].first, pages[i].count); });
}

}  // namespace

ChunkBoxes::ChunkBoxes() : means(empty_box()), bounds(empty_box()) {}

void ChunkBoxes::add(const ChunkBoxes& other) {
  lod::add(means, other.means);
  lod::add(bounds, other.bounds);
}

ChunkBoxes chunk_boxes(const SplatView& splats, std::uint64_t first, std::uint64_t n) {
  ChunkBoxes boxes;
  boxes.means = bounds_of(splats, first, n, 0);
  boxes.bounds = bounds_of(splats, first, n, kBoundSigmas);
  return boxes;
}

std::vector<Page> cut_chunks(std::span<const ChunkBoxes> chunks, std::uint64_t n, const BuildOptions& options) {
  const auto begin_of = [&](std::uint64_t chunk) { return std::min(n, chunk * options.chunk_size); };
  std::vector<Page> pages;
  for (std::uint64_t chunk = 0; chunk < chunks.size();) {
    Page page;
    page.first = begin_of(chunk);
    page.bounds = chunks[chunk].bounds;
    Run run;
    std::uint64_t end = chunk;
    while (end < chunks.size() && end < chunk + options.page_chunks && run.takes(chunks[end].means)) {
      run.take(chunks[end].means);
      add(page.bounds, chunks[end++].bounds);
    }
    page.count = static_cast<std::uint32_t>(begin_of(end) - page.first);
    pages.push_back(page);
    chunk = end;
  }
  return pages;
}

std::vector<Page> cut_leaves(const SplatView& leaves, const BuildOptions& options) {
  std::vector<Page> pages = cut_chunks(boxes_of_chunks(leaves, options), leaves.n, options);
  find_cores(leaves, pages);
  return pages;
}

std::vector<std::uint64_t> cut_stretches(std::uint64_t n, const BuildOptions& options) {
  assert(n > 0);
  const std::uint64_t rows = std::uint64_t{options.stretch_pages} * options.page_chunks * options.chunk_size;
  std::vector<std::uint64_t> begins;
  for (std::uint64_t first = 0; first == 0 || first + (rows + 1) / 2 <= n; first += rows) begins.push_back(first);
  begins.push_back(n);
  return begins;
}

std::vector<Page> cut_leaf_pages(std::span<const ChunkBoxes> chunks, std::uint64_t n, const BuildOptions& options,
                                 std::vector<std::uint32_t>& stretches) {
  const std::vector<std::uint64_t> begins = cut_stretches(n, options);
  std::vector<Page> pages;
  stretches.assign(1, 0);
  for (std::size_t i = 0; i + 1 < begins.size(); ++i) {
    const std::uint64_t first = begins[i] / options.chunk_size,
                        last = (begins[i + 1] + options.chunk_size - 1) / options.chunk_size;
    for (Page& page : cut_chunks(chunks.subspan(first, last - first), begins[i + 1] - begins[i], options)) {
      page.first += begins[i];
      pages.push_back(page);
    }
    stretches.push_back(static_cast<std::uint32_t>(pages.size()));
  }
  return pages;
}

MergeCosts merge_costs(const SplatView& splats, std::uint64_t first, std::uint64_t n) {
  constexpr float kLeast = 1e-20F;  // equal Gaussians cost nothing, and so do invisible ones
  MergeCosts out;
  out.fill(kLeast);
  float centre[3];
  find_middle(splats, first, n, centre);
  std::vector<std::uint32_t> near;
  for (std::uint64_t i = 0; i < n; ++i) {
    if (!is_far(splats, first + i, centre)) near.push_back(static_cast<std::uint32_t>(i));
  }
  const Gaussians page = subset(activate(splats, first, n, centre, 0), near);
  const std::vector<float> area = areas(page);
  if (std::ranges::none_of(area, [](float a) { return a > 0; })) return out;
  const auto kept = static_cast<std::size_t>(kKept * static_cast<double>(n));
  std::vector<float> costs = cheapest_merges(page, area, footprint_of(area, std::max<std::size_t>(kept, 1)));
  std::ranges::sort(costs);
  for (std::size_t k = 0; k < out.size(); ++k) {
    const float cost = costs[(2 * k + 1) * costs.size() / (2 * out.size())];
    out[k] = std::max(std::sqrt(std::sqrt(std::max(cost, 0.F))), kLeast);  // rounding makes some less than 0
  }
  return out;
}

std::vector<Group> group_pages(std::span<const Page> pages, std::span<const MergeCosts> costs,
                               const BuildOptions& options) {
  const auto n = static_cast<std::uint32_t>(pages.size());
  // The more a Gaussian's merge costs, the more of it is left: at `threshold` all of it.
  double threshold = 0;
  const auto wanted_of = [&](std::uint32_t page) {
    double left = 0;
    for (const float cost : costs[page]) left += std::min(1.0, static_cast<double>(cost) / threshold);
    return left * pages[page].count / static_cast<double>(MergeCosts().size());
  };
  double total = 0, low = 1e-30, high = 1e30;
  for (const Page& page : pages) total += page.count;
  for (int k = 0; k < 60; ++k) {
    threshold = std::sqrt(low * high);
    double left = 0;
    for (std::uint32_t i = 0; i < n; ++i) left += wanted_of(i);
    (left > kKept * total ? low : high) = threshold;
  }
  threshold = high;
  const auto most = static_cast<double>(options.chunk_size * options.page_chunks);
  const auto group = [&](bool by_place) {
    std::vector<Group> groups;
    for (std::uint32_t i = 0; i < n;) {
      Run run;
      double wanted = 0;
      std::uint64_t rows = 0;
      std::uint32_t end = i;
      while (end < n && end < i + options.children && (!by_place || run.takes(pages[end].bounds))) {
        const double more = wanted_of(end);
        if (end >= i + 2 && wanted + more > most) break;
        wanted += more;
        rows += pages[end].count;
        run.take(pages[end++].bounds);
      }
      // The tree must narrow.
      wanted = std::max(wanted, kLeastKept * static_cast<double>(rows));
      wanted = std::min({wanted, most, kMostKept * static_cast<double>(rows)});
      groups.push_back({i, end, std::max<std::uint64_t>(1, static_cast<std::uint64_t>(wanted))});
      i = end;
    }
    return groups;
  };
  std::vector<Group> groups = group(true);
  // If too few pages are alike, group them by order alone, which gives no more than pairs and one page.
  if (groups.size() > (n + 1) / 2) groups = group(false);
  return groups;
}

std::vector<Group> group_stretches(std::span<const Page> pages, std::span<const MergeCosts> costs,
                                   std::vector<std::uint32_t>& stretches, const BuildOptions& options) {
  if (pages.front().level >= options.stretch_levels) stretches = {0, static_cast<std::uint32_t>(pages.size())};
  std::vector<Group> groups;
  std::uint32_t first = 0;
  for (std::size_t i = 1; i < stretches.size(); ++i) {
    const std::uint32_t n = stretches[i] - first;
    for (const Group& group : group_pages(pages.subspan(first, n), costs.subspan(first, n), options)) {
      groups.push_back({first + group.first, first + group.last, group.wanted});
    }
    first = stretches[i];
    stretches[i] = static_cast<std::uint32_t>(groups.size());
  }
  return groups;
}

Page build_page(const SplatView& splats, std::span<const Page> below, const Group& group, const BuildOptions& options,
                SplatCloud& out) {
  const auto [first, last, wanted] = group;
  assert(first < last && last <= below.size() && wanted > 0);
  Page page;
  page.level = below[first].level + 1;
  page.first_child = first;
  page.n_children = last - first;
  page.bounds = page.core = empty_box();
  std::uint64_t n = 0;
  float child_error = 0;
  for (std::uint32_t i = first; i < last; ++i) {
    n += below[i].count;
    child_error = std::max(child_error, below[i].error);
    add(page.bounds, below[i].bounds);
    add(page.core, below[i].core);
  }
  const std::uint64_t from = below[first].first;
  float centre[3] = {splats.mean[3 * from], splats.mean[3 * from + 1], splats.mean[3 * from + 2]};
  std::vector<std::uint64_t> near, far;
  const auto divide = [&] {
    near.clear(), far.clear();
    for (std::uint64_t i = from; i < from + n; ++i) (is_far(splats, i, centre) ? far : near).push_back(i);
  };
  divide();
  if (!far.empty()) {  // perhaps only the first is far from all others
    find_middle(splats, from, n, centre);
    divide();
  }
  const std::size_t before = out.size();
  float error = far.empty() ? replace(splats, from, n, wanted, centre, options, out)
                            : replace_without_far(splats, near, std::move(far), wanted, centre, options, out);
  if (!(error < kMostError)) error = kMostError;
  page.error = std::max({error, kErrorGrowth * child_error, std::numeric_limits<float>::min()});
  page.count = static_cast<std::uint32_t>(out.size() - before);
  add(page.bounds, bounds_of(out.view(), before, page.count, kBoundSigmas));
  return page;
}

Level build_level(const SplatView& splats, std::span<const Page> below, std::span<const Group> groups,
                  const BuildOptions& options) {
  std::vector<SplatCloud> parts(groups.size());
  Level out;
  out.pages.resize(parts.size());
  each_in_parallel(parts.size(),
                   [&](std::size_t i) { out.pages[i] = build_page(splats, below, groups[i], options, parts[i]); });
  for (std::size_t i = 0; i < parts.size(); ++i) {
    out.pages[i].first = out.splats.size();
    append(out.splats, parts[i]);
    parts[i] = {};
  }
  return out;
}

std::vector<Page> join_levels(std::span<const std::vector<Page>> levels) {
  std::vector<Page> out;
  std::uint64_t first = 0;
  for (std::size_t i = levels.size(); i-- > 0;) {
    const auto next_page = static_cast<std::uint32_t>(out.size() + levels[i].size());
    for (const Page& page : levels[i]) {
      out.push_back(page);
      out.back().first = first;
      first += page.count;
      if (page.level > 0) out.back().first_child += next_page;
    }
  }
  for (std::uint32_t i = 0; i < out.size(); ++i) {
    const Page page = out[i];
    for (std::uint32_t k = 0; k < page.n_children; ++k) out[page.first_child + k].parent = i;
  }
  return out;
}

Levels build_levels(const SplatView& leaves, const BuildOptions& options) {
  assert(leaves.n > 0 && leaves.consistent());
  std::vector<Level> levels(1);
  std::vector<std::uint32_t> stretches;
  levels[0].pages = cut_leaf_pages(boxes_of_chunks(leaves, options), leaves.n, options, stretches);
  find_cores(leaves, levels[0].pages);
  while (levels.back().pages.size() > 1) {
    const Level& below = levels.back();
    const SplatView splats = levels.size() == 1 ? leaves : below.splats.view();
    std::vector<MergeCosts> costs(below.pages.size());
    each_in_parallel(costs.size(), [&](std::size_t i) {
      costs[i] = merge_costs(splats, below.pages[i].first, below.pages[i].count);
    });
    Level above = build_level(splats, below.pages, group_stretches(below.pages, costs, stretches, options), options);
    levels.push_back(std::move(above));
  }
  Levels out;
  out.splats.sh_degree = leaves.sh_degree;
  std::vector<std::vector<Page>> pages;
  pages.reserve(levels.size());
  for (Level& level : levels) pages.push_back(std::move(level.pages));
  out.pages = join_levels(pages);
  for (std::size_t i = levels.size(); i-- > 0;) {
    i == 0 ? append(out.splats, leaves) : append(out.splats, levels[i].splats);
    levels[i] = {};
  }
  return out;
}

}  // namespace rgs::lod
