// clusters_simd.hpp - the two costly parts of merging clusters, eight at a time: nearest neighbours and merge costs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "clusters.hpp"

namespace rgs::lod {

inline constexpr std::size_t kNeighbours = 5;  // candidates for each cluster and round

/// Moments of two merged clusters that both cover `overlap`. Real: float, or a vector of what Clusters
/// holds.
template <class Real, class Clusters>
inline __attribute__((always_inline)) void merge_moments(const Clusters& a, const Clusters& b, const Real& overlap,
                                                         Clusters& m) {
  const Real both = a.weight + b.weight;
  m.weight = both - overlap;
  const Real p = a.weight / both, q = 1.F - p;
  Real apart[3];
  for (int k = 0; k < 3; ++k) {
    m.mean[k] = p * a.mean[k] + q * b.mean[k];
    apart[k] = a.mean[k] - b.mean[k];
  }
  for (int i = 0, at = 0; i < 3; ++i) {
    for (int j = i; j < 3; ++j, ++at) {
      m.covariance.of[at] = p * a.covariance.of[at] + q * b.covariance.of[at] + p * q * apart[i] * apart[j];
    }
  }
  for (int k = 0; k < 4; ++k) m.color[k] = p * a.color[k] + q * b.color[k];
}

/// Neighbours of a cluster, nearest first, padded with kNoNeighbour.
using Neighbours = std::array<std::uint32_t, kNeighbours>;
inline constexpr std::uint32_t kNoNeighbour = 0xffffffff;

/// The nearest neighbours, by their means, of the clusters in one of `every` leaves of eight; of others none.
void nearest_clusters(std::span<const Cluster> clusters, std::size_t every, std::vector<Neighbours>& out);

/// Cross-section that a merged cluster has at least, so that a point or a line of no width is drawn with a size.
inline float least_section(float blur) {
  return std::max(1e-3F * blur, 1e-30F);
}

struct ClusterPair {
  std::uint32_t a, b;
};
/// Sets Cluster::self of all clusters.
void set_selves(std::span<Cluster> clusters, float blur);
/// For each pair, the integral of the squared difference that merging makes in pictures along three axes (see
/// clusters.cpp), and the area that both cover, averaged over the axes. `blur`: variance by which pictures are blurred.
/// Costs saturate at FP32's largest number.
void merge_costs(std::span<const Cluster> clusters, std::span<const ClusterPair> pairs, float blur,
                 std::vector<float>& costs, std::vector<float>& overlaps);

}  // namespace rgs::lod
