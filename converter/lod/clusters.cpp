// clusters.cpp - greedy merging of near Gaussians by what it does to a picture.
// SPDX-License-Identifier: Apache-2.0
//
// Merging a pair keeps its moments, so that a picture whose pixels are larger than the pair hardly changes. What does change
// is the integral of a squared difference of Gaussians, which has a closed form; pixel and low-pass are one more Gaussian.
// It knows place, extent, colour and opacity at once: two Gaussians of different colours cost more the better they can be
// told apart, a leaf and the wall behind it more than two bricks, and big ones more than small ones.
#include "clusters.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>
#include <utility>

#include "rgs/math/covariance.hpp"

namespace rgs::lod {
namespace {

constexpr float kPixelVariance = 0.3F;                 // of a pixel's square and the low-pass, px^2
constexpr std::size_t kNeighbours = 7;                 // looked at for each cluster and round
constexpr std::size_t kLeastLeftOfRound[] = {13, 20};  // a round leaves 13 of 20: costs are found anew often enough
constexpr float kShConstant = 0.28209479F;

// Axes that a picture along z, y, x shows, and where their variances lie in a covariance.
struct Plane {
  int u, v, uu, uv, vv;
};
constexpr Plane kPlanes[3] = {{0, 1, 0, 1, 3}, {0, 2, 0, 2, 5}, {1, 2, 3, 4, 5}};

// Integral of the product of two Gaussians of mass 1, but for 1 / 2 pi; the variances are sums of both.
float product(float du, float dv, float uu, float uv, float vv) {
  const float det = uu * vv - uv * uv;
  const float q = (vv * du * du - 2 * uv * du * dv + uu * dv * dv) / det;
  return q > 40 ? 0 : std::exp(-0.5F * q) / std::sqrt(det);
}

float products(const Cluster& a, const Cluster& b, float blur) {
  float total = 0;
  for (const Plane& p : kPlanes) {
    const auto& x = a.covariance.of;
    const auto& y = b.covariance.of;
    total += product(a.mean[p.u] - b.mean[p.u], a.mean[p.v] - b.mean[p.v], x[p.uu] + y[p.uu] + 2 * blur,
                     x[p.uv] + y[p.uv], x[p.vv] + y[p.vv] + 2 * blur);
  }
  float colors = 0;
  for (int k = 0; k < 4; ++k) colors += a.color[k] * b.color[k];
  return a.weight * b.weight * colors * total;
}

Cluster merged(const Cluster& a, const Cluster& b) {
  Cluster m;
  m.weight = a.weight + b.weight;
  const float p = a.weight / m.weight, q = 1 - p;
  float apart[3];
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
  m.first = m.last = 0;
  return m;
}

float merge_cost(const Cluster& a, const Cluster& b, float blur) {
  const Cluster m = merged(a, b);
  const float cost =
      a.self + b.self + products(m, m, blur) + 2 * (products(a, b, blur) - products(a, m, blur) - products(b, m, blur));
  return std::isfinite(cost) ? cost : std::numeric_limits<float>::max();  // beyond the range of FP32: last of all
}

// Nearest clusters by their means: a tree of halves.
class Tree {
 public:
  using Found = std::pair<float, std::uint32_t>;  // squared distance, cluster

  explicit Tree(const std::vector<Cluster>& clusters)
      : clusters_(clusters), order_(clusters.size()), axis_(clusters.size()) {
    std::iota(order_.begin(), order_.end(), 0U);
    build(0, order_.size());
  }
  void nearest(std::uint32_t to, std::vector<Found>& found) const {
    found.clear();
    search(0, order_.size(), to, found);
  }

 private:
  static constexpr std::size_t kLeaf = 8;

  void build(std::size_t begin, std::size_t end) {
    if (end - begin <= kLeaf) return;
    float low[3], high[3];
    for (int k = 0; k < 3; ++k) low[k] = std::numeric_limits<float>::max(), high[k] = -low[k];
    for (std::size_t i = begin; i < end; ++i) {
      for (int k = 0; k < 3; ++k) {
        low[k] = std::min(low[k], clusters_[order_[i]].mean[k]);
        high[k] = std::max(high[k], clusters_[order_[i]].mean[k]);
      }
    }
    int axis = 0;
    for (int k = 1; k < 3; ++k) {
      if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    }
    const std::size_t middle = (begin + end) / 2;
    const auto at = [this](std::size_t i) { return order_.begin() + static_cast<std::ptrdiff_t>(i); };
    std::nth_element(at(begin), at(middle), at(end), [&](std::uint32_t a, std::uint32_t b) {
      const float x = clusters_[a].mean[axis], y = clusters_[b].mean[axis];
      return x != y ? x < y : a < b;
    });
    axis_[middle] = static_cast<std::uint8_t>(axis);
    build(begin, middle);
    build(middle, end);
  }

  void search(std::size_t begin, std::size_t end, std::uint32_t to, std::vector<Found>& found) const {
    const float* const mean = clusters_[to].mean;
    if (end - begin <= kLeaf) {
      for (std::size_t i = begin; i < end; ++i) {
        const std::uint32_t other = order_[i];
        if (other == to) continue;
        const float* const m = clusters_[other].mean;
        const float x = mean[0] - m[0], y = mean[1] - m[1], z = mean[2] - m[2];
        const Found item{x * x + y * y + z * z, other};
        if (found.size() == kNeighbours && !(item < found.back())) continue;
        if (found.size() == kNeighbours) found.pop_back();
        found.insert(std::upper_bound(found.begin(), found.end(), item), item);
      }
      return;
    }
    const std::size_t middle = (begin + end) / 2;
    const int axis = axis_[middle];
    const float d = mean[axis] - clusters_[order_[middle]].mean[axis];
    d < 0 ? search(begin, middle, to, found) : search(middle, end, to, found);
    if (found.size() == kNeighbours && d * d > found.back().first) return;
    d < 0 ? search(middle, end, to, found) : search(begin, middle, to, found);
  }

  const std::vector<Cluster>& clusters_;
  std::vector<std::uint32_t> order_;
  std::vector<std::uint8_t> axis_;  // by the middle of a range
};

struct Pair {
  float cost;
  std::uint32_t a, b;
  bool operator<(const Pair& other) const {
    return cost != other.cost ? cost < other.cost : a != other.a ? a < other.a : b < other.b;
  }
};

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
  return total * (2.F / 3) * std::numbers::pi_v<float>;
}

// Jacobi's rotations in FP64; then the quaternion of the eigenvectors by its largest component.
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

Clusters merge_neighbours(const Gaussians& gaussians, std::span<const float> weight, std::span<const char> kept,
                          std::size_t n, float pixel) {
  const float blur = kPixelVariance * pixel * pixel;
  const float least = 1e-9F * pixel * pixel;  // what does not show still has a place
  Clusters out;
  out.next.resize(gaussians.size());
  std::vector<Cluster> current, alone;
  for (std::uint32_t i = 0; i < gaussians.size(); ++i) {
    Cluster c;
    c.weight = weight[i] + least;
    c.covariance = covariance(gaussians, i);
    for (int k = 0; k < 3; ++k) {
      c.mean[k] = gaussians.of(kMean + k)[i];
      c.color[k] = 0.5F + kShConstant * gaussians.of(kSh + k)[i];
    }
    c.color[3] = 1;
    c.first = c.last = out.next[i] = i;
    c.self = products(c, c, blur);
    (kept[i] != 0 ? alone : current).push_back(c);
  }
  n -= std::min(n, alone.size());
  std::vector<Tree::Found> found;
  std::vector<Pair> pairs;
  std::vector<Cluster> after;
  std::vector<char> used;
  while (current.size() > n) {
    const Tree tree(current);
    pairs.clear();
    for (std::uint32_t i = 0; i < current.size(); ++i) {
      tree.nearest(i, found);
      for (const auto& [distance, j] : found) pairs.push_back({merge_cost(current[i], current[j], blur), i, j});
    }
    std::sort(pairs.begin(), pairs.end());
    const std::size_t wanted = std::max(n, current.size() * kLeastLeftOfRound[0] / kLeastLeftOfRound[1]);
    std::size_t left = current.size();
    used.assign(current.size(), 0);
    after.clear();
    for (const Pair& pair : pairs) {
      if (left == wanted) break;
      if (used[pair.a] != 0 || used[pair.b] != 0) continue;
      used[pair.a] = used[pair.b] = 1;
      const Cluster &a = current[pair.a], &b = current[pair.b];
      Cluster m = merged(a, b);
      m.first = a.first;
      m.last = b.last;
      out.next[a.last] = b.first;
      m.self = products(m, m, blur);
      after.push_back(m);
      --left;
    }
    for (std::size_t i = 0; i < current.size(); ++i) {
      if (used[i] == 0) after.push_back(current[i]);
    }
    current.swap(after);
  }
  out.all = std::move(current);
  out.all.insert(out.all.end(), alone.begin(), alone.end());
  return out;
}

}  // namespace rgs::lod
