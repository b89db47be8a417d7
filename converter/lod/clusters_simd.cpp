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
#include <cstring>
#include <limits>

#include "lanes_inl.hpp"
#include "rgs/math/constants.hpp"

#ifndef RGS_LOD_POINT_TREE
#define RGS_LOD_POINT_TREE
namespace rgs::lod {
// Points in the order of a tree of halves with eight points a leaf; the block in the middle of a range stores its axis.
// Padding of the last leaf is infinitely far away.
struct PointTree {
  struct Point {
    float at[3];
    std::uint32_t index;
  };
  std::vector<Point> points;
  std::vector<float> at[3];  // of the points, padded
  std::vector<std::uint8_t> axis;
  std::vector<float> cut;  // along the axis: where the second half begins
};
}  // namespace rgs::lod
#endif

HWY_BEFORE_NAMESPACE();
namespace rgs::lod {
namespace HWY_NAMESPACE {

RGS_LOD_INLINE bool any(I mask) {
  std::uint64_t words[4];
  std::memcpy(words, &mask, sizeof words);
  return ((words[0] | words[1]) | (words[2] | words[3])) != 0;
}

// The nearest neighbours of the points of a leaf, a point a lane.
class Search {
 public:
  Search(const PointTree& tree, std::size_t leaf) : tree_(tree), leaf_(leaf) {
    for (int k = 0; k < 3; ++k) to_[k] = load(&tree.at[k][leaf * kLanes]), apart_[k] = set(0);
    for (V& d : distance_) d = set(std::numeric_limits<float>::infinity());
    for (I& at : found_) at = I{} - 1;
  }
  // `squared`: distances to the box between the cuts around the leaves begin .. end - 1. The own leaf comes first, so
  // that of many points that coincide each finds others.
  void descend(std::size_t begin, std::size_t end, V squared) {
    if (end - begin == 1) return scan(begin);
    const std::size_t middle = (begin + end) / 2;
    const auto both = [&](auto first_half) __attribute__((always_inline)) {
      const int axis = tree_.axis[middle];
      const V behind = first_half ? to_[axis] - set(tree_.cut[middle]) : set(tree_.cut[middle]) - to_[axis];
      const V before = apart_[axis], after = select(behind > before, behind, before);
      const V farther = squared - before * before + after * after;
      if (!any(farther < distance_[kNeighbours - 1])) return;
      apart_[axis] = after;
      first_half ? descend(begin, middle, farther) : descend(middle, end, farther);
      apart_[axis] = before;
    };
    both(leaf_ < middle);
    both(leaf_ >= middle);
  }
  void write(Neighbours* out) const {
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      const std::size_t i = leaf_ * kLanes + lane;
      if (i >= tree_.points.size()) return;
      for (std::size_t k = 0; k < kNeighbours; ++k) {
        const auto at = static_cast<std::uint32_t>(found_[k][lane]);
        out[tree_.points[i].index][k] = at == kNoNeighbour ? at : tree_.points[at].index;
      }
    }
  }

 private:
  RGS_LOD_INLINE void scan(std::size_t leaf) {
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      const std::size_t i = leaf * kLanes + lane;
      V squared = set(0);
      for (int k = 0; k < 3; ++k) {
        const V d = to_[k] - set(tree_.at[k][i]);
        squared += d * d;
      }
      if (leaf == leaf_) squared[lane] = std::numeric_limits<float>::infinity();
      if (!any(squared < distance_[kNeighbours - 1])) continue;
      I at = I{} + static_cast<std::int32_t>(i);
      for (std::size_t k = 0; k < kNeighbours; ++k) {
        const I nearer = squared < distance_[k];
        const V d = distance_[k];
        const I found = found_[k];
        distance_[k] = nearer ? squared : d;
        found_[k] = nearer ? at : found;
        squared = nearer ? d : squared;
        at = nearer ? found : at;
      }
    }
  }

  const PointTree& tree_;
  const std::size_t leaf_;
  V to_[3], apart_[3], distance_[kNeighbours];
  I found_[kNeighbours];
};

void search_all(const PointTree& tree, std::size_t every, Neighbours* out) {
  const std::size_t n_leaves = tree.at[0].size() / kLanes;
  for (std::size_t leaf = 0; leaf < n_leaves; leaf += every) {
    Search search(tree, leaf);
    search.descend(0, n_leaves, set(0));
    search.write(out);
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

void build(PointTree& tree, std::size_t begin, std::size_t end) {
  const auto at = [&tree](std::size_t i) { return tree.points.begin() + static_cast<std::ptrdiff_t>(i); };
  if (end - begin <= kLeaf) {
    // Of neighbours at one distance the first is taken, and libraries leave them in different orders.
    return std::sort(at(begin), at(end), [](const auto& a, const auto& b) { return a.index < b.index; });
  }
  float low[3], high[3];
  for (int k = 0; k < 3; ++k) low[k] = std::numeric_limits<float>::max(), high[k] = -low[k];
  for (std::size_t i = begin; i < end; ++i) {
    for (int k = 0; k < 3; ++k) {
      low[k] = std::min(low[k], tree.points[i].at[k]);
      high[k] = std::max(high[k], tree.points[i].at[k]);
    }
  }
  int axis = 0;
  for (int k = 1; k < 3; ++k) {
    if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
  }
  const std::size_t middle_block = (begin / kLeaf + (end + kLeaf - 1) / kLeaf) / 2, middle = middle_block * kLeaf;
  std::nth_element(at(begin), at(middle), at(end), [axis](const PointTree::Point& a, const PointTree::Point& b) {
    return a.at[axis] != b.at[axis] ? a.at[axis] < b.at[axis] : a.index < b.index;
  });
  tree.axis[middle_block] = static_cast<std::uint8_t>(axis);
  tree.cut[middle_block] = tree.points[middle].at[axis];
  build(tree, begin, middle);
  build(tree, middle, end);
}

}  // namespace

void nearest_clusters(std::span<const Cluster> clusters, std::size_t every, std::vector<Neighbours>& out) {
  constexpr float kFar = std::numeric_limits<float>::infinity();
  const std::size_t n_leaves = (clusters.size() + kLeaf - 1) / kLeaf;
  PointTree tree;
  tree.points.resize(clusters.size());
  for (std::uint32_t i = 0; i < clusters.size(); ++i) {
    const float* const mean = clusters[i].mean;
    tree.points[i] = {{mean[0], mean[1], mean[2]}, i};
  }
  tree.axis.resize(n_leaves);
  tree.cut.resize(n_leaves);
  build(tree, 0, clusters.size());
  for (int k = 0; k < 3; ++k) {
    tree.at[k].assign(n_leaves * kLeaf, kFar);
    for (std::size_t i = 0; i < clusters.size(); ++i) tree.at[k][i] = tree.points[i].at[k];
  }
  Neighbours none;
  none.fill(kNoNeighbour);
  out.assign(clusters.size(), none);
  HWY_DYNAMIC_DISPATCH(search_all)(tree, every, out.data());
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
