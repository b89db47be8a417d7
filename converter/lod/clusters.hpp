// clusters.hpp - which Gaussians of a group become one.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "gaussians.hpp"

namespace rgs::lod {

/// Symmetric 3x3: xx xy xz yy yz zz.
struct Covariance {
  float of[6];
};
Covariance covariance(const Gaussians& gaussians, std::size_t i);
/// Of what a Gaussian covers, seen along the three axes, the mean: 2 pi times the root of the projected determinant.
float mean_cross_section(const Covariance& covariance);
/// Standard deviations and a unit quaternion w, x, y, z of a covariance; none below `least`.
void principal_axes(const Covariance& covariance, float least, float scale[3], float rotation[4]);

/// Axes that a picture along z, y, x shows, and where their variances lie in a covariance.
struct Plane {
  int u, v, uu, uv, vv;
};
inline constexpr Plane kPlanes[3] = {{0, 1, 0, 1, 3}, {0, 2, 0, 2, 5}, {1, 2, 3, 4, 5}};

/// Gaussians that become one, with their moments.
struct Cluster {
  float weight = 0;  ///< what is seen of its members, world units squared
  float mean[3];
  Covariance covariance;
  float color[4];             ///< r, g, b and 1: mean of the members by weight
  float self = 0;             ///< what merge_cost() needs of the cluster alone
  std::uint32_t first, last;  ///< members, as a list through Clusters::next
};

struct Clusters {
  std::vector<Cluster> all;
  std::vector<std::uint32_t> next;  ///< [Gaussians] member that follows; of the last, itself

  template <class F>
  void each_member(const Cluster& cluster, const F& f) const {
    for (std::uint32_t i = cluster.first;; i = next[i]) {
      f(i);
      if (i == cluster.last) return;
    }
  }
  bool is_single(const Cluster& cluster) const { return cluster.first == cluster.last; }
};

/// Merges neighbours, the pair that changes the picture least first, until `n` clusters are left. `weight` [gaussians]: what
/// is seen of each; `kept` [gaussians]: not 0 for those that stay alone, fewer than n. `pixel`: side of a pixel of the
/// picture that counts, world units. Deterministic.
Clusters merge_neighbours(const Gaussians& gaussians, std::span<const float> weight, std::span<const char> kept,
                          std::size_t n, float pixel);

}  // namespace rgs::lod
