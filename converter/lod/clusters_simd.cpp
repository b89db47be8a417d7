// clusters_simd.cpp - neighbours and costs of clusters, compiled for each instruction set and chosen at run time.
// SPDX-License-Identifier: Apache-2.0
#include "clusters_simd.hpp"
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "clusters_simd.cpp"  // NOLINT
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_SSE4)
#include <hwy/foreach_target.h>
//
#include <hwy/highway.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "lanes_inl.hpp"
#include "rgs/math/constants.hpp"

#ifndef RGS_LOD_POINT_TREE
#define RGS_LOD_POINT_TREE
namespace rgs::lod {
// Points in the order of a tree of halves with eight points a leaf; the block in the middle of a range stores its axis.
// Padding of the last leaf is infinitely far away.
struct PointTree {
  std::vector<std::uint32_t> order;
  std::vector<float> at[3];
  std::vector<std::uint8_t> axis;
  std::vector<float> cut;  // along the axis: where the second half begins
};
}  // namespace rgs::lod
#endif

HWY_BEFORE_NAMESPACE();
namespace rgs::lod {
namespace HWY_NAMESPACE {

class Search {
 public:
  Search(const PointTree& tree, std::uint32_t at) : tree_(tree), self_(at) {
    for (int k = 0; k < 3; ++k) to_[k] = tree.at[k][at];
    for (float& d : distance_) d = std::numeric_limits<float>::infinity();
    found_.fill(kNoNeighbour);
  }
  void descend(std::size_t begin, std::size_t end) {
    if (end - begin == 1) return scan_leaf(begin * kLanes);
    const std::size_t middle = (begin + end) / 2;
    const int axis = tree_.axis[middle];
    const float d = to_[axis] - tree_.cut[middle];
    d < 0 ? descend(begin, middle) : descend(middle, end);
    if (d * d >= distance_[kNeighbours - 1]) return;  // stop at equality: many points may coincide
    d < 0 ? descend(middle, end) : descend(begin, middle);
  }
  void scan_own_leaf() { scan_leaf(self_ / kLanes * kLanes); }
  // Whether the point coincides with all its neighbours.
  bool is_crowded() const { return distance_[kNeighbours - 1] == 0; }
  const Neighbours& found() const { return found_; }

 private:
  RGS_LOD_INLINE void scan_leaf(std::size_t first) {
    V squared = set(0);
    for (int k = 0; k < 3; ++k) {
      const V d = load(&tree_.at[k][first]) - set(to_[k]);
      squared += d * d;
    }
    float lanes[kLanes];
    store(lanes, squared);
    for (std::size_t i = 0; i < kLanes; ++i) {
      if (!(lanes[i] < distance_[kNeighbours - 1]) || first + i == self_) continue;
      std::size_t at = kNeighbours - 1;
      for (; at > 0 && lanes[i] < distance_[at - 1]; --at) {
        distance_[at] = distance_[at - 1];
        found_[at] = found_[at - 1];
      }
      distance_[at] = lanes[i];
      found_[at] = tree_.order[first + i];
    }
  }

  const PointTree& tree_;
  const std::size_t self_;
  float to_[3], distance_[kNeighbours];
  Neighbours found_;
};

void search_all(const PointTree& tree, Neighbours* out) {
  const std::size_t n_blocks = tree.at[0].size() / kLanes;
  for (std::uint32_t i = 0; i < tree.order.size(); ++i) {
    Search search(tree, i);
    search.descend(0, n_blocks);
    out[tree.order[i]] = search.found();
    if (!search.is_crowded()) continue;
    // Coincident points all find the same few, each of which can merge only once.
    Search nearby(tree, i);
    nearby.scan_own_leaf();
    if (nearby.is_crowded()) out[tree.order[i]] = nearby.found();
  }
}

struct Clusters8 {
  V weight, mean[3];
  struct {
    V of[6];
  } covariance;
  V color[4], opacity, self;
  V root[3];  // of the projected determinants
};

RGS_LOD_INLINE void set_roots(Clusters8& c) {
  for (int k = 0; k < 3; ++k) {
    const Plane& p = kPlanes[k];
    const V det = c.covariance.of[p.uu] * c.covariance.of[p.vv] - c.covariance.of[p.uv] * c.covariance.of[p.uv];
    c.root[k] = root(select(det > set(0), det, set(0)));
  }
}

RGS_LOD_INLINE Clusters8 take(const Cluster* clusters, const std::uint32_t (&items)[kLanes]) {
  float lanes[16][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const Cluster& c = clusters[items[lane]];
    lanes[0][lane] = c.weight;
    for (int k = 0; k < 3; ++k) lanes[1 + k][lane] = c.mean[k];
    for (int k = 0; k < 6; ++k) lanes[4 + k][lane] = c.covariance.of[k];
    for (int k = 0; k < 4; ++k) lanes[10 + k][lane] = c.color[k];
    lanes[14][lane] = c.opacity;
    lanes[15][lane] = c.self;
  }
  Clusters8 out;
  out.weight = load(lanes[0]);
  for (int k = 0; k < 3; ++k) out.mean[k] = load(lanes[1 + k]);
  for (int k = 0; k < 6; ++k) out.covariance.of[k] = load(lanes[4 + k]);
  for (int k = 0; k < 4; ++k) out.color[k] = load(lanes[10 + k]);
  out.opacity = load(lanes[14]);
  out.self = load(lanes[15]);
  set_roots(out);
  return out;
}

// Sum over the planes of the integral of the product of two Gaussians (variances add up), without the factor 2 pi.
RGS_LOD_INLINE V shapes_product(const Clusters8& a, const Clusters8& b, V blur) {
  V total = set(0);
  for (int k = 0; k < 3; ++k) {
    const Plane& p = kPlanes[k];
    const V du = a.mean[p.u] - b.mean[p.u], dv = a.mean[p.v] - b.mean[p.v];
    const V uu = a.covariance.of[p.uu] + b.covariance.of[p.uu] + blur,
            uv = a.covariance.of[p.uv] + b.covariance.of[p.uv],
            vv = a.covariance.of[p.vv] + b.covariance.of[p.vv] + blur;
    const V det = uu * vv - uv * uv;
    const V q = (vv * du * du - set(2) * uv * du * dv + uu * dv * dv) / det;
    // Rounding may make it negative or NaN where the two coincide.
    const V near = select(q > set(40), set(40), select(q > set(0), q, set(0)));
    total += select(q > set(40), set(0), a.root[k] * b.root[k] * exp2(set(-0.5F * math::kLog2E) * near) / root(det));
  }
  return total;
}

// The same of what both draw: opacity and colours included.
RGS_LOD_INLINE V product(const Clusters8& a, const Clusters8& b, V shapes) {
  V colors = set(0);
  for (int k = 0; k < 4; ++k) colors += a.color[k] * b.color[k];
  return a.opacity * b.opacity * colors * shapes;
}
RGS_LOD_INLINE V product(const Clusters8& a, const Clusters8& b, float blur) {
  return product(a, b, shapes_product(a, b, set(2 * blur)));
}

void costs_of(const Cluster* clusters, const ClusterPair* pairs, std::size_t n, float blur, float* costs,
              float* overlaps) {
  const V most = set(std::numeric_limits<float>::max()), one = set(1), thin = set(least_section(blur));
  const auto opaque = [&](V opacity) __attribute__((always_inline)) {
    return select(opacity < one, opacity, one);
  };
  for (std::size_t i = 0; i < n; i += kLanes) {
    std::uint32_t first[kLanes], second[kLanes];
    for (std::size_t k = 0; k < kLanes; ++k) {
      const ClusterPair& pair = pairs[std::min(i + k, n - 1)];
      first[k] = pair.a;
      second[k] = pair.b;
    }
    const Clusters8 a = take(clusters, first), b = take(clusters, second);
    const V shapes = shapes_product(a, b, set(2 * blur));
    // Not more than the smaller one, also where shapes overflow or have no area.
    const V smaller = select(a.weight < b.weight, a.weight, b.weight);
    V overlap = set(kSectionOfRoots) * opaque(a.opacity) * opaque(b.opacity) * shapes;
    overlap = select(overlap < smaller, overlap, smaller);
    Clusters8 m;
    merge_moments<V>(a, b, overlap, m);
    set_roots(m);
    const V section = set(kSectionOfRoots) * (m.root[0] + m.root[1] + m.root[2]);
    m.opacity = m.weight / select(section > thin, section, thin);
    // Both are dimmed evenly to what they cover together.
    const V share = m.weight / (a.weight + b.weight);
    const V cost = share * share * (a.self + b.self + set(2) * product(a, b, shapes)) + product(m, m, blur) -
                   set(2) * share * (product(a, m, blur) + product(b, m, blur));
    float lanes[kLanes];
    const std::size_t count = std::min<std::size_t>(kLanes, n - i);
    store(lanes, select(cost < most, cost, most));  // NaN sorts last
    std::copy_n(lanes, count, costs + i);
    store(lanes, overlap);
    std::copy_n(lanes, count, overlaps + i);
  }
}

void selves_of(Cluster* clusters, std::size_t n, float blur) {
  for (std::size_t i = 0; i < n; i += kLanes) {
    std::uint32_t items[kLanes];
    for (std::size_t k = 0; k < kLanes; ++k) items[k] = static_cast<std::uint32_t>(std::min(i + k, n - 1));
    const Clusters8 c = take(clusters, items);
    float lanes[kLanes];
    store(lanes, product(c, c, blur));
    for (std::size_t k = 0; k < kLanes; ++k) clusters[items[k]].self = lanes[k];
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::lod
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::lod {

HWY_EXPORT(search_all);
HWY_EXPORT(costs_of);
HWY_EXPORT(selves_of);

namespace {

constexpr std::size_t kLeaf = 8;

void build(PointTree& tree, std::span<const Cluster> clusters, std::size_t begin, std::size_t end) {
  if (end - begin <= kLeaf) return;
  float low[3], high[3];
  for (int k = 0; k < 3; ++k) low[k] = std::numeric_limits<float>::max(), high[k] = -low[k];
  for (std::size_t i = begin; i < end; ++i) {
    for (int k = 0; k < 3; ++k) {
      low[k] = std::min(low[k], clusters[tree.order[i]].mean[k]);
      high[k] = std::max(high[k], clusters[tree.order[i]].mean[k]);
    }
  }
  int axis = 0;
  for (int k = 1; k < 3; ++k) {
    if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
  }
  const std::size_t middle_block = (begin / kLeaf + (end + kLeaf - 1) / kLeaf) / 2, middle = middle_block * kLeaf;
  const auto at = [&tree](std::size_t i) { return tree.order.begin() + static_cast<std::ptrdiff_t>(i); };
  std::nth_element(at(begin), at(middle), at(end), [&](std::uint32_t a, std::uint32_t b) {
    const float x = clusters[a].mean[axis], y = clusters[b].mean[axis];
    return x != y ? x < y : a < b;
  });
  tree.axis[middle_block] = static_cast<std::uint8_t>(axis);
  tree.cut[middle_block] = clusters[tree.order[middle]].mean[axis];
  build(tree, clusters, begin, middle);
  build(tree, clusters, middle, end);
}

}  // namespace

void nearest_clusters(std::span<const Cluster> clusters, std::vector<Neighbours>& out) {
  constexpr float kFar = std::numeric_limits<float>::infinity();
  const std::size_t n_blocks = (clusters.size() + kLeaf - 1) / kLeaf;
  PointTree tree;
  tree.order.resize(clusters.size());
  std::iota(tree.order.begin(), tree.order.end(), 0U);
  tree.axis.resize(n_blocks);
  tree.cut.resize(n_blocks);
  build(tree, clusters, 0, clusters.size());
  for (int k = 0; k < 3; ++k) {
    tree.at[k].assign(n_blocks * kLeaf, kFar);
    for (std::size_t i = 0; i < clusters.size(); ++i) tree.at[k][i] = clusters[tree.order[i]].mean[k];
  }
  out.resize(clusters.size());
  if (!clusters.empty()) HWY_DYNAMIC_DISPATCH(search_all)(tree, out.data());
}

void set_selves(std::span<Cluster> clusters, float blur) {
  HWY_DYNAMIC_DISPATCH(selves_of)(clusters.data(), clusters.size(), blur);
}

void merge_costs(std::span<const Cluster> clusters, std::span<const ClusterPair> pairs, float blur,
                 std::vector<float>& costs, std::vector<float>& overlaps) {
  costs.resize(pairs.size());
  overlaps.resize(pairs.size());
  HWY_DYNAMIC_DISPATCH(costs_of)
  (clusters.data(), pairs.data(), pairs.size(), blur, costs.data(), overlaps.data());
}

}  // namespace rgs::lod
#endif
