// splat_edit.cpp - moving, turning, merging, filtering and stripping Gaussians in memory.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/splat_edit.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <numbers>
#include <numeric>
#include <utility>
#include <vector>

#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"
#include "sh_rotation.hpp"

namespace rgs {

using detail::Matrix3;

namespace {

constexpr Matrix3 kIdentity{1, 0, 0, 0, 1, 0, 0, 0, 1};

Matrix3 multiply(const Matrix3& a, const Matrix3& b) {
  Matrix3 product{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      for (std::size_t k = 0; k < 3; ++k) product[3 * i + j] += a[3 * i + k] * b[3 * k + j];
    }
  }
  return product;
}

std::array<double, 3> apply(const Matrix3& m, const std::array<double, 3>& v) {
  return {m[0] * v[0] + m[1] * v[1] + m[2] * v[2], m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
          m[6] * v[0] + m[7] * v[1] + m[8] * v[2]};
}

// Quaternion w, x, y, z of a rotation matrix; the branch with the largest square keeps the division well-conditioned
// (Shepperd 1978).
std::array<double, 4> quaternion_of(const Matrix3& m) {
  const double squares[4] = {1 + m[0] + m[4] + m[8], 1 + m[0] - m[4] - m[8], 1 - m[0] + m[4] - m[8],
                             1 - m[0] - m[4] + m[8]};
  const auto largest = static_cast<std::size_t>(std::max_element(squares, squares + 4) - squares);
  const double x = m[7] - m[5], y = m[2] - m[6], z = m[3] - m[1];
  const double xy = m[1] + m[3], xz = m[2] + m[6], yz = m[5] + m[7];
  const std::array<double, 4> rows[4] = {
      {squares[0], x, y, z}, {x, squares[1], xy, xz}, {y, xy, squares[2], yz}, {z, xz, yz, squares[3]}};
  std::array<double, 4> q = rows[largest];
  const double factor = 0.5 / std::sqrt(squares[largest]);
  for (double& component : q) component *= factor;
  return q;
}

// q <- turn * q.
void turn_quaternion(const std::array<double, 4>& turn, float* q) {
  const double a = turn[0], b = turn[1], c = turn[2], d = turn[3];
  const double w = static_cast<double>(q[0]), x = static_cast<double>(q[1]), y = static_cast<double>(q[2]),
               z = static_cast<double>(q[3]);
  q[0] = static_cast<float>(a * w - b * x - c * y - d * z);
  q[1] = static_cast<float>(a * x + b * w + c * z - d * y);
  q[2] = static_cast<float>(a * y - b * z + c * w + d * x);
  q[3] = static_cast<float>(a * z + b * y - c * x + d * w);
}

void turn_harmonics(SplatCloud& cloud, const Matrix3& rotation) {
  if (cloud.sh_degree == 0) return;
  const detail::ShRotation turn(rotation);
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree));
  for (std::uint64_t i = 0; i < cloud.size(); ++i) turn.apply(&cloud.sh[floats * i], cloud.sh_degree);
}

// Unit vector of a direction, in a basis of right, up and forward.
std::array<double, 3> direction(Axis axis) {
  switch (axis) {
    case Axis::undeclared: break;
    case Axis::right: return {1, 0, 0};
    case Axis::left: return {-1, 0, 0};
    case Axis::up: return {0, 1, 0};
    case Axis::down: return {0, -1, 0};
    case Axis::forward: return {0, 0, 1};
    case Axis::backward: return {0, 0, -1};
  }
  return {0, 0, 0};
}

// Coordinates in `to` of a point given in `from`: a signed permutation.
Matrix3 change_of_axes(const Axes& from, const Axes& to) {
  Matrix3 m{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      const auto a = direction(to[i]), b = direction(from[j]);
      m[3 * i + j] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    }
  }
  return m;
}

double determinant(const Matrix3& m) {
  return m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) + m[2] * (m[3] * m[7] - m[4] * m[6]);
}

bool is_declared(const Axes& axes) {
  return std::ranges::find(axes, Axis::undeclared) == axes.end();
}

bool inside(const Box& box, const float* mean) {
  for (std::size_t k = 0; k < 3; ++k) {
    if (!(mean[k] >= box.min[k] && mean[k] <= box.max[k])) return false;
  }
  return true;
}

// Logarithm of opacity times the two largest scales: about what a Gaussian covers.
double weight(const SplatCloud& cloud, std::uint64_t i) {
  const float* s = &cloud.log_scale[3 * i];
  const double sum = static_cast<double>(s[0]) + static_cast<double>(s[1]) + static_cast<double>(s[2]);
  const double value = sum - static_cast<double>(std::min({s[0], s[1], s[2]})) +
                       std::log(static_cast<double>(opacity_from_logit(cloud.opacity_logit[i])));
  return std::isnan(value) ? -HUGE_VAL : value;
}

}  // namespace

std::array<double, 9> rotation_from_euler(const std::array<double, 3>& degrees) {
  Matrix3 product = kIdentity;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const double angle = degrees[axis] * std::numbers::pi / 180;
    const std::size_t u = (axis + 1) % 3, v = (axis + 2) % 3;
    Matrix3 turn = kIdentity;
    turn[4 * u] = turn[4 * v] = std::cos(angle);
    turn[3 * v + u] = std::sin(angle);
    turn[3 * u + v] = -std::sin(angle);
    product = multiply(turn, product);
  }
  return product;
}

std::array<double, 9> rotation_from_quaternion(const std::array<double, 4>& q) {
  const double w = q[0], x = q[1], y = q[2], z = q[3], s = 2 / (w * w + x * x + y * y + z * z);
  return {1 - s * (y * y + z * z), s * (x * y - w * z),     s * (x * z + w * y),
          s * (x * y + w * z),     1 - s * (x * x + z * z), s * (y * z - w * x),
          s * (x * z - w * y),     s * (y * z + w * x),     1 - s * (x * x + y * y)};
}

Similarity compose(const Similarity& outer, const Similarity& inner) {
  Similarity both;
  both.rotation = multiply(outer.rotation, inner.rotation);
  both.scale = outer.scale * inner.scale;
  both.translation = apply(outer.rotation, inner.translation);
  for (std::size_t k = 0; k < 3; ++k) {
    both.translation[k] = both.translation[k] * outer.scale + outer.translation[k];
  }
  return both;
}

void transform_splats(SplatCloud& cloud, const Similarity& similarity) {
  const bool turns = similarity.rotation != kIdentity;
  const std::array<double, 4> turn = quaternion_of(similarity.rotation);
  const auto log_factor = static_cast<float>(std::log(similarity.scale));
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    float* mean = &cloud.mean[3 * i];
    const auto turned = apply(similarity.rotation, {static_cast<double>(mean[0]), static_cast<double>(mean[1]),
                                                    static_cast<double>(mean[2])});
    for (std::size_t k = 0; k < 3; ++k) {
      mean[k] = static_cast<float>(turned[k] * similarity.scale + similarity.translation[k]);
      cloud.log_scale[3 * i + k] += log_factor;
    }
    if (turns) turn_quaternion(turn, &cloud.rotation[4 * i]);
  }
  if (turns) turn_harmonics(cloud, similarity.rotation);
}

void convert_axes(SplatCloud& cloud, const Axes& from, const Axes& to) {
  if (from == to || !is_declared(from) || !is_declared(to)) return;
  const Matrix3 change = change_of_axes(from, to);
  const double handedness = determinant(change);
  std::array<std::size_t, 3> source{};  // of each new axis
  std::array<float, 3> sign{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      if (change[3 * i + j] == 0) continue;
      source[i] = j;
      sign[i] = static_cast<float>(change[3 * i + j]);
    }
  }
  const auto hand = static_cast<float>(handedness);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    const Splat old = cloud.view().splat(i);
    // C R C^T turns the rotation; the local axes are exchanged alike, and their scales with them. Its quaternion's
    // vector is an axial one: a mirror reverses it.
    for (std::size_t k = 0; k < 3; ++k) {
      cloud.mean[3 * i + k] = sign[k] * old.mean[source[k]];
      cloud.log_scale[3 * i + k] = old.log_scale[source[k]];
      cloud.rotation[4 * i + 1 + k] = hand * sign[k] * old.rotation[1 + source[k]];
    }
  }
  turn_harmonics(cloud, change);
}

void strip_sh(SplatCloud& cloud, int degree) {
  assert(degree >= 0);
  if (degree >= cloud.sh_degree) return;
  const auto from = static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree)),
             to = static_cast<std::uint64_t>(3 * sh_coefficients(degree));
  for (std::uint64_t i = 1; i < cloud.size(); ++i) std::copy_n(&cloud.sh[from * i], to, &cloud.sh[to * i]);
  cloud.sh.resize(to * cloud.size());
  cloud.sh_degree = degree;
}

void append_splats(SplatCloud& cloud, const SplatCloud& other) {
  const int degree = std::max(cloud.sh_degree, other.sh_degree);
  const auto wide = static_cast<std::uint64_t>(3 * sh_coefficients(degree));
  const std::uint64_t n = cloud.size();
  std::vector<float> sh(wide * (n + other.size()));
  const auto spread = [&](const SplatCloud& part, std::uint64_t first) {
    const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(part.sh_degree));
    for (std::uint64_t i = 0; i < part.size(); ++i) std::copy_n(&part.sh[floats * i], floats, &sh[wide * (first + i)]);
  };
  spread(cloud, 0);
  spread(other, n);
  cloud.sh = std::move(sh);
  cloud.sh_degree = degree;
  const auto add = [](std::vector<float>& to, const std::vector<float>& from) {
    to.insert(to.end(), from.begin(), from.end());
  };
  add(cloud.mean, other.mean);
  add(cloud.log_scale, other.log_scale);
  add(cloud.rotation, other.rotation);
  add(cloud.opacity_logit, other.opacity_logit);
}

void keep_splats(SplatCloud& cloud, std::span<const std::uint64_t> indices) {
  const auto pack = [&indices](std::vector<float>& values, std::uint64_t each) {
    for (std::uint64_t k = 0; k < indices.size(); ++k) {
      // k <= indices[k]: never over what is to come.
      if (indices[k] != k) std::copy_n(&values[each * indices[k]], each, &values[each * k]);
    }
    values.resize(each * indices.size());
  };
  if (indices.size() == cloud.size()) return;
  pack(cloud.mean, 3);
  pack(cloud.log_scale, 3);
  pack(cloud.rotation, 4);
  pack(cloud.opacity_logit, 1);
  pack(cloud.sh, static_cast<std::uint64_t>(3 * sh_coefficients(cloud.sh_degree)));
}

void filter_splats(SplatCloud& cloud, const SplatFilter& filter) {
  std::vector<std::uint64_t> kept;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    if (filter.crop && !inside(*filter.crop, &cloud.mean[3 * i])) continue;
    if (filter.min_opacity > 0 && !(opacity_from_logit(cloud.opacity_logit[i]) >= filter.min_opacity)) continue;
    kept.push_back(i);
  }
  if (kept.size() > filter.max_n) {
    std::vector<std::pair<double, std::uint64_t>> ranked;
    ranked.reserve(kept.size());
    for (const std::uint64_t i : kept) ranked.emplace_back(-weight(cloud, i), i);
    const auto end = ranked.begin() + static_cast<std::ptrdiff_t>(filter.max_n);
    std::nth_element(ranked.begin(), end, ranked.end());
    kept.clear();
    std::for_each(ranked.begin(), end, [&kept](const auto& entry) { kept.push_back(entry.second); });
    std::ranges::sort(kept);
  }
  keep_splats(cloud, kept);
}

Result<SceneScan> clean_splats(SplatCloud& cloud, const EncodeOptions& options) {
  return detail::guard_memory([&]() -> Result<SceneScan> {
    SceneScan scan(std::min(cloud.sh_degree, options.sh_degree), options.on_bad);
    std::vector<std::uint64_t> kept;
    for (std::uint64_t i = 0; i < cloud.size(); ++i) {
      Splat s = cloud.view().splat(i);
      const std::uint64_t sound = scan.n_kept() - scan.n_repaired();
      const bool keeps = scan.add(s);
      if (options.on_bad == BadPolicy::refuse && !keeps)
        return make_error(Errc::bad_value, i, "a damaged Gaussian", 0, 1);
      if (!keeps) continue;
      if (scan.n_kept() - scan.n_repaired() == sound) cloud.set(i, s);  // mended
      kept.push_back(i);
    }
    if (const Status s = check_encodable(scan, options); !s) return tl::unexpected(s.error());
    keep_splats(cloud, kept);
    return scan;
  });
}

}  // namespace rgs
