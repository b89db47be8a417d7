// clusters.hpp - chooses which Gaussians of a group to merge.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <numbers>
#include <span>
#include <vector>

#include "gaussians.hpp"

namespace rgs::lod {

/// Symmetric 3x3: xx xy xz yy yz zz.
struct Covariance {
  float of[6];
};
Covariance covariance(const Gaussians& gaussians, std::size_t i);
/// The cross-section of a Gaussian, averaged over the three axes: 2 pi times the root of the projected determinant.
float mean_cross_section(const Covariance& covariance);
/// What each Gaussian covers alone: opacity times mean_cross_section(), world units squared.
std::vector<float> areas(const Gaussians& gaussians);
/// Standard deviations, at least `least`, and a unit quaternion w, x, y, z of a covariance.
void principal_axes(const Covariance& covariance, float least, float scale[3], float rotation[4]);

/// The axes of a picture along z, y or x, and the indices of their variances in a covariance.
struct Plane {
  int u, v, uu, uv, vv;
};
inline constexpr Plane kPlanes[3] = {{0, 1, 0, 1, 3}, {0, 2, 0, 2, 5}, {1, 2, 3, 4, 5}};
/// mean_cross_section() is this times the sum of the roots of the three projected determinants.
inline constexpr float kSectionOfRoots = 2.F / 3 * std::numbers::pi_v<float>;

/// Gaussians merged into one, with their moments.
struct Cluster {
  float weight = 0;  ///< area that the members cover together, averaged over three axes, world units squared
  float mean[3];
  Covariance covariance;
  float color[4];             ///< r, g, b and 1: mean of the members by weight
  float opacity = 0;          ///< of one Gaussian with these moments that covers `weight`; may exceed 1
  float self = 0;             ///< the part of the cost of a merge that depends on this cluster alone
  std::uint32_t first, last;  ///< members, a list through Clusters::next
};

struct Clusters {
  std::vector<Cluster> all;
  std::vector<std::uint32_t> next;  ///< [Gaussians] next member; the last points to itself

  template <class F>
  void each_member(const Cluster& cluster, const F& f) const {
    for (std::uint32_t i = cluster.first;; i = next[i]) {
      f(i);
      if (i == cluster.last) return;
    }
  }
  bool is_single(const Cluster& cluster) const { return cluster.first == cluster.last; }
};

/// Merges neighbours, the pair that changes the picture least first, down to `n` clusters. `area`: of areas(). `pixel`:
/// side of a pixel of the picture by which the cost is measured, world units. Deterministic.
Clusters merge_neighbours(const Gaussians& gaussians, std::span<const float> area, std::size_t n, float pixel);
/// The cost of the cheapest merge of each Gaussian with a neighbour; FP32's largest number if it has none.
std::vector<float> cheapest_merges(const Gaussians& gaussians, std::span<const float> area, float pixel);
/// Added to areas, world units squared: an invisible Gaussian still has a position.
inline float least_area(float pixel) {
  return 1e-9F * pixel * pixel;
}

}  // namespace rgs::lod
