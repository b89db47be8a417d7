// clusters.cpp - greedily merges close Gaussians, the pair that changes a picture least first.
// SPDX-License-Identifier: Apache-2.0
//
// Merging a pair keeps its moments, so a picture whose pixels are larger than the pair hardly changes. The cost is the
// integral of a squared difference of Gaussians, which has a closed form. It combines position, extent, colour and
// opacity: different colours cost more the better they can be told apart, a leaf and the wall behind it more than two
// bricks, large Gaussians more than small ones. What two hide of each other is covered once: the merged one covers as
// much as both together.
#include "clusters.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "clusters_simd.hpp"
#include "key_sort.hpp"
#include "rgs/math/covariance.hpp"

namespace rgs::lod {
namespace {

// Much less than a pixel's own 0.3 px^2: a page is drawn from its error on, but nearer, its parts would show.
constexpr float kBlur = 0.01F;                  // px^2
constexpr std::size_t kLeftOfRound[] = {3, 4};  // rounds are short, so that costs are up to date
constexpr std::size_t kWeighed = 4;             // one of so many leaves of neighbours tells what merges cost
constexpr float kShConstant = 0.28209479F;

// A cluster for each Gaussian.
std::vector<Cluster> clusters_of(const Gaussians& gaussians, std::span<const float> area, float pixel) {
  std::vector<Cluster> out(gaussians.size());
  for (std::uint32_t i = 0; i < out.size(); ++i) {
    Cluster& c = out[i];
    c.covariance = covariance(gaussians, i);
    c.opacity = gaussians.of(kOpacity)[i];
    c.weight = area[i] + least_area(pixel);
    for (int k = 0; k < 3; ++k) {
      c.mean[k] = gaussians.of(kMean + k)[i];
      c.color[k] = 0.5F + kShConstant * gaussians.of(kSh + k)[i];
    }
    c.color[3] = 1;
    c.first = c.last = i;
  }
  set_selves(out, kBlur * pixel * pixel);
  return out;
}

// Clusters and their neighbours.
void pair_neighbours(std::span<const Cluster> clusters, std::size_t every, std::vector<Neighbours>& nearest,
                     std::vector<ClusterPair>& pairs) {
  nearest_clusters(clusters, every, nearest);
  pairs.clear();
  for (std::uint32_t i = 0; i < clusters.size(); ++i) {
    for (const std::uint32_t j : nearest[i]) {
      if (j == kNoNeighbour) break;
      // If both are neighbours of each other, the first has added the pair.
      if (j < i && std::find(nearest[j].begin(), nearest[j].end(), i) != nearest[j].end()) continue;
      pairs.push_back({i, j});
    }
  }
}

}  // namespace

Covariance covariance(const Gaussians& gaussians, std::size_t i) {
  float r[9], m[3][3];
  math::rotation_matrix(math::Quaternion<float>{gaussians.of(kRotation)[i], gaussians.of(kRotation + 1)[i],
                                                gaussians.of(kRotation + 2)[i], gaussians.of(kRotation + 3)[i]},
                        r);
  for (int a = 0; a < 3; ++a) {
    for (int k = 0; k < 3; ++k) m[a][k] = r[3 * a + k] * gaussians.of(kScale + k)[i];
  }
  Covariance out;
  for (int a = 0, at = 0; a < 3; ++a) {
    for (int b = a; b < 3; ++b, ++at) out.of[at] = m[a][0] * m[b][0] + m[a][1] * m[b][1] + m[a][2] * m[b][2];
  }
  return out;
}

float mean_cross_section(const Covariance& covariance) {
  float total = 0;
  for (const Plane& p : kPlanes) {
    const auto& c = covariance.of;
    total += std::sqrt(std::max(c[p.uu] * c[p.vv] - c[p.uv] * c[p.uv], 0.F));
  }
  return total * kSectionOfRoots;
}

// Jacobi rotations in FP64; then the quaternion of the eigenvectors by its largest component.
void principal_axes(const Covariance& covariance, float least, float scale[3], float rotation[4]) {
  const auto& c = covariance.of;
  double a[3][3] = {{c[0], c[1], c[2]}, {c[1], c[3], c[4]}, {c[2], c[4], c[5]}};
  double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (int sweep = 0; sweep < 12; ++sweep) {
    const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
    if (off <= 1e-22 * (a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2])) break;
    for (int p = 0; p < 2; ++p) {
      for (int q = p + 1; q < 3; ++q) {
        if (a[p][q] == 0) continue;
        const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const double t = (theta >= 0 ? 1 : -1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
        const double cosine = 1 / std::sqrt(t * t + 1), sine = t * cosine;
        const auto turn = [&](double& x, double& y) {
          const double before = x;
          x = cosine * before - sine * y;
          y = sine * before + cosine * y;
        };
        for (auto& row : a) turn(row[p], row[q]);
        for (int k = 0; k < 3; ++k) turn(a[p][k], a[q][k]);
        for (auto& row : v) turn(row[p], row[q]);
      }
    }
  }
  for (int k = 0; k < 3; ++k) scale[k] = std::max(least, static_cast<float>(std::sqrt(std::max(a[k][k], 0.0))));
  const double det = v[0][0] * (v[1][1] * v[2][2] - v[1][2] * v[2][1]) -
                     v[0][1] * (v[1][0] * v[2][2] - v[1][2] * v[2][0]) +
                     v[0][2] * (v[1][0] * v[2][1] - v[1][1] * v[2][0]);
  if (det < 0) {
    for (auto& row : v) row[0] = -row[0];
  }
  // Four times the square of each component.
  const double squares[4] = {1 + v[0][0] + v[1][1] + v[2][2], 1 + v[0][0] - v[1][1] - v[2][2],
                             1 - v[0][0] + v[1][1] - v[2][2], 1 - v[0][0] - v[1][1] + v[2][2]};
  const auto largest = std::max_element(squares, squares + 4) - squares;
  const double d[3] = {v[2][1] - v[1][2], v[0][2] - v[2][0], v[1][0] - v[0][1]};
  const double s[3] = {v[2][1] + v[1][2], v[0][2] + v[2][0], v[1][0] + v[0][1]};
  const double by_largest[4][4] = {{squares[0], d[0], d[1], d[2]},
                                   {d[0], squares[1], s[2], s[1]},
                                   {d[1], s[2], squares[2], s[0]},
                                   {d[2], s[1], s[0], squares[3]}};
  double norm = 0;
  for (const double x : by_largest[largest]) norm += x * x;
  norm = (by_largest[largest][0] < 0 ? -1 : 1) / std::sqrt(norm);
  for (int k = 0; k < 4; ++k) rotation[k] = static_cast<float>(by_largest[largest][k] * norm);
}

std::vector<float> areas(const Gaussians& gaussians) {
  std::vector<float> out(gaussians.size());
  for (std::size_t i = 0; i < out.size(); ++i) {
    out[i] = gaussians.of(kOpacity)[i] * mean_cross_section(covariance(gaussians, i));
  }
  return out;
}

Clusters merge_neighbours(const Gaussians& gaussians, std::span<const float> area, std::size_t n, float pixel) {
  const float blur = kBlur * pixel * pixel;
  Clusters out;
  out.next.resize(gaussians.size());
  std::iota(out.next.begin(), out.next.end(), 0U);
  std::vector<Cluster> current = clusters_of(gaussians, area, pixel);
  std::vector<Neighbours> nearest;
  std::vector<ClusterPair> pairs;
  std::vector<float> costs, overlaps;
  std::vector<std::uint64_t> order, spare;
  std::vector<Cluster> after;
  std::vector<char> used;
  while (current.size() > n) {
    pair_neighbours(current, 1, nearest, pairs);
    if (pairs.empty()) {  // squared distances overflow FP32
      for (std::uint32_t i = 1; i < current.size(); ++i) pairs.push_back({i - 1, i});
    }
    merge_costs(current, pairs, blur, costs, overlaps);
    order.clear();
    for (std::size_t i = 0; i < pairs.size(); ++i) order.push_back(std::uint64_t{ordered_bits(costs[i])} << 32 | i);
    sort_by_key(order, spare);
    const std::size_t wanted = std::max(n, current.size() * kLeftOfRound[0] / kLeftOfRound[1]);
    std::size_t left = current.size();
    used.assign(current.size(), 0);
    after.clear();
    for (const std::uint64_t key : order) {
      if (left == wanted) break;
      const ClusterPair pair = pairs[static_cast<std::uint32_t>(key)];
      if (used[pair.a] != 0 || used[pair.b] != 0) continue;
      used[pair.a] = used[pair.b] = 1;
      const Cluster &a = current[pair.a], &b = current[pair.b];
      Cluster m;
      merge_moments<float>(a, b, overlaps[static_cast<std::uint32_t>(key)], m);
      m.opacity = m.weight / std::max(mean_cross_section(m.covariance), least_section(blur));
      m.first = a.first;
      m.last = b.last;
      out.next[a.last] = b.first;
      after.push_back(m);
      --left;
    }
    set_selves(after, blur);
    for (std::size_t i = 0; i < current.size(); ++i) {
      if (used[i] == 0) after.push_back(current[i]);
    }
    current.swap(after);
  }
  out.all = std::move(current);
  return out;
}

std::vector<float> cheapest_merges(const Gaussians& gaussians, std::span<const float> area, float pixel) {
  const std::vector<Cluster> clusters = clusters_of(gaussians, area, pixel);
  std::vector<Neighbours> nearest;
  std::vector<ClusterPair> pairs;
  std::vector<float> costs, overlaps, least(clusters.size(), std::numeric_limits<float>::max()), out;
  pair_neighbours(clusters, kWeighed, nearest, pairs);
  merge_costs(clusters, pairs, kBlur * pixel * pixel, costs, overlaps);
  for (std::size_t k = 0; k < pairs.size(); ++k) {
    for (const std::uint32_t i : {pairs[k].a, pairs[k].b}) least[i] = std::min(least[i], costs[k]);
  }
  for (std::size_t i = 0; i < clusters.size(); ++i) {
    if (nearest[i][0] != kNoNeighbour) out.push_back(least[i]);
  }
  if (out.empty()) out.push_back(least[0]);
  return out;
}

}  // namespace rgs::lod
