// motion.cpp - continues a camera's motion along straight lines: of its centre, and of its axes, made orthonormal again.
// SPDX-License-Identifier: Apache-2.0
#include "pages/motion.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

namespace rgs::pages {
namespace {

constexpr double kMostTurn = 1;  // tangent

using Vector = std::array<double, 3>;

Vector axis_of(const Look& look, std::size_t row) {
  Vector axis;
  for (std::size_t k = 0; k < 3; ++k) axis[k] = static_cast<double>(look.view.rotation[3 * row + k]);
  return axis;
}

double dot(const Vector& a, const Vector& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// b + share (b - a), but for `along` and of length 1.
Vector moved(const Vector& a, const Vector& b, double share, const Vector& along) {
  Vector c;
  for (std::size_t k = 0; k < 3; ++k) c[k] = b[k] + share * (b[k] - a[k]);
  const double part = dot(c, along);
  for (std::size_t k = 0; k < 3; ++k) c[k] -= part * along[k];
  const double length = std::sqrt(dot(c, c));
  for (double& x : c) x /= length;
  return c;
}

}  // namespace

Look moved_on(const Look& before, const Look& now, double ahead, double farthest) {
  Look look = now;
  const Vector& from = before.eye.position;
  Vector& to = look.eye.position;
  const Vector way{to[0] - from[0], to[1] - from[1], to[2] - from[2]};
  const double length = std::sqrt(dot(way, way));
  const double share = std::min(ahead, farthest / std::max(length, 1e-300));
  for (std::size_t k = 0; k < 3; ++k) {
    to[k] += share * way[k];
    (k == 0 ? look.view.position.x : k == 1 ? look.view.position.y : look.view.position.z) = static_cast<float>(to[k]);
  }
  const auto low = [&](std::size_t k, float high) { return static_cast<float>(to[k] - static_cast<double>(high)); };
  look.view.position_low = {low(0, look.view.position.x), low(1, look.view.position.y), low(2, look.view.position.z)};
  const Vector old_forward = axis_of(before, 2), old_right = axis_of(before, 0);
  const Vector f = axis_of(now, 2), r = axis_of(now, 0);
  const Vector turn{f[0] - old_forward[0], f[1] - old_forward[1], f[2] - old_forward[2]};
  const double turns = std::min(ahead, kMostTurn / std::max(std::sqrt(dot(turn, turn)), 1e-300));
  const Vector forward = moved(old_forward, f, turns, {}), right = moved(old_right, r, turns, forward);
  for (std::size_t k = 0; k < 3; ++k) {
    const std::size_t i = (k + 1) % 3, j = (k + 2) % 3;
    look.view.rotation[k] = static_cast<float>(right[k]);
    look.view.rotation[3 + k] = static_cast<float>(forward[i] * right[j] - forward[j] * right[i]);
    look.view.rotation[6 + k] = static_cast<float>(forward[k]);
  }
  return look;
}

}  // namespace rgs::pages
