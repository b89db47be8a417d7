// random_views.hpp - seeded views, rotations and Gaussians for tests of the math and of the renderer.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cmath>
#include <random>

#include "rgs/math/camera.hpp"
#include "rgs/math/covariance.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::test {

using Matrix4 = double[16];

class Random {
 public:
  explicit Random(unsigned seed) : engine_(seed) {}
  double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(engine_); }
  double log_uniform(double low, double high) { return std::exp(uniform(std::log(low), std::log(high))); }
  math::Quaternion<double> rotation() {
    std::normal_distribution<double> normal;
    math::Quaternion<double> q{normal(engine_), normal(engine_), normal(engine_), normal(engine_)};
    const double s = 1 / std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    return {q.w * s, q.x * s, q.y * s, q.z * s};
  }
  math::Vec3<double> vector(double low, double high) {
    return {uniform(low, high), uniform(low, high), uniform(low, high)};
  }

 private:
  std::mt19937 engine_;
};

template <class T, class U>
math::Vec3<T> cast(const math::Vec3<U>& v) {
  return {static_cast<T>(v.x), static_cast<T>(v.y), static_cast<T>(v.z)};
}
template <class T, class U>
math::Quaternion<T> cast(const math::Quaternion<U>& q) {
  return {static_cast<T>(q.w), static_cast<T>(q.x), static_cast<T>(q.y), static_cast<T>(q.z)};
}

/// World-to-camera matrix of a rigid motion.
inline std::array<double, 16> rigid(const math::Quaternion<double>& rotation, const math::Vec3<double>& t) {
  double r[9];
  math::rotation_matrix(rotation, r);
  return {r[0], r[1], r[2], t.x, r[3], r[4], r[5], t.y, r[6], r[7], r[8], t.z, 0, 0, 0, 1};
}

template <class T>
math::View<T> view_of(const std::array<double, 16>& world_to_camera, int width, int height, double fx, double fy,
                      double cx, double cy) {
  Matrix4 m;
  for (std::size_t i = 0; i < 16; ++i) m[i] = world_to_camera[i];
  return math::make_view<T>(m, width, height, fx, fy, cx, cy, T(0.2), T(0));
}

/// R p + t.
inline math::Vec3<double> transform(const std::array<double, 16>& m, const math::Vec3<double>& p) {
  return {m[0] * p.x + m[1] * p.y + m[2] * p.z + m[3], m[4] * p.x + m[5] * p.y + m[6] * p.z + m[7],
          m[8] * p.x + m[9] * p.y + m[10] * p.z + m[11]};
}

inline math::Quaternion<double> multiply(const math::Quaternion<double>& a, const math::Quaternion<double>& b) {
  return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
          a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}

/// a * b of rigid motions.
inline std::array<double, 16> compose(const std::array<double, 16>& a, const std::array<double, 16>& b) {
  std::array<double, 16> c{};
  for (std::size_t i = 0; i < 4; ++i) {
    for (std::size_t j = 0; j < 4; ++j) {
      for (std::size_t k = 0; k < 4; ++k) c[4 * i + j] += a[4 * i + k] * b[4 * k + j];
    }
  }
  return c;
}

}  // namespace rgs::test
