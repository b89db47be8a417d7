// views.cpp - directions, frames and pieces.
// SPDX-License-Identifier: Apache-2.0
#include "views.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

namespace rgs::lod {

Axes3 direction(int i, int n) {
  const double turn = std::numbers::pi * (3 - std::sqrt(5.0));  // golden angle
  const double y = 1 - (2 * i + 1.0) / n, r = std::sqrt(std::max(0.0, 1 - y * y));
  const double f[3] = {r * std::cos(turn * i), y, r * std::sin(turn * i)};
  // Any vector not along f: the axis farthest from it.
  int axis = 0;
  for (int k = 1; k < 3; ++k) {
    if (std::abs(f[k]) < std::abs(f[axis])) axis = k;
  }
  double a[3] = {0, 0, 0};
  a[axis] = 1;
  double right[3] = {a[1] * f[2] - a[2] * f[1], a[2] * f[0] - a[0] * f[2], a[0] * f[1] - a[1] * f[0]};
  const double norm = std::sqrt(right[0] * right[0] + right[1] * right[1] + right[2] * right[2]);
  for (double& x : right) x /= norm;
  const double down[3] = {f[1] * right[2] - f[2] * right[1], f[2] * right[0] - f[0] * right[2],
                          f[0] * right[1] - f[1] * right[0]};
  const double roll = 7 * turn * i, cosine = std::cos(roll), sine = std::sin(roll);
  Axes3 out;
  for (int k = 0; k < 3; ++k) {
    out.right[k] = static_cast<float>(cosine * right[k] + sine * down[k]);
    out.down[k] = static_cast<float>(cosine * down[k] - sine * right[k]);
    out.forward[k] = static_cast<float>(f[k]);
  }
  return out;
}

Frame frame_around(const Gaussians& gaussians, const Axes3& axes, float pixel, int most) {
  constexpr float kMargin = 4;  // pixels on each side
  Frame frame;
  frame.axes = axes;
  frame.pixel = pixel;
  int sides[2];
  float firsts[2];
  for (int side = 0; side < 2; ++side) {
    const float* const d = side == 0 ? axes.right : axes.down;
    float low = std::numeric_limits<float>::max(), high = -low;
    for (std::size_t i = 0; i < gaussians.size(); ++i) {
      const float x =
          d[0] * gaussians.of(kMean)[i] + d[1] * gaussians.of(kMean + 1)[i] + d[2] * gaussians.of(kMean + 2)[i];
      low = std::min(low, x);
      high = std::max(high, x);
    }
    const float wanted = std::ceil((high - low) / pixel + 2 * kMargin);
    sides[side] = wanted < static_cast<float>(most) ? static_cast<int>(std::max(wanted, 1.F)) : most;
    firsts[side] = (low + high) / 2 - static_cast<float>(sides[side]) * pixel / 2;
  }
  frame.left = firsts[0];
  frame.top = firsts[1];
  frame.width = sides[0];
  frame.height = sides[1];
  return frame;
}

Frame finer(Frame frame, int factor) {
  frame.pixel /= static_cast<float>(factor);
  frame.width *= factor;
  frame.height *= factor;
  return frame;
}

std::vector<std::vector<std::uint32_t>> cut_by_place(const Gaussians& gaussians, std::vector<std::uint32_t> items,
                                                     float most) {
  std::vector<std::vector<std::uint32_t>> out, left;
  left.push_back(std::move(items));
  while (!left.empty()) {
    std::vector<std::uint32_t> piece = std::move(left.back());
    left.pop_back();
    if (piece.empty()) continue;
    float low[3], high[3];
    int axis = 0;
    for (int k = 0; k < 3; ++k) {
      low[k] = std::numeric_limits<float>::max(), high[k] = -low[k];
      for (const std::uint32_t i : piece) {
        low[k] = std::min(low[k], gaussians.of(kMean + k)[i]);
        high[k] = std::max(high[k], gaussians.of(kMean + k)[i]);
      }
      if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    }
    const float middle = low[axis] + (high[axis] - low[axis]) / 2;
    const auto second = std::stable_partition(piece.begin(), piece.end(),
                                              [&](std::uint32_t i) { return gaussians.of(kMean + axis)[i] < middle; });
    if (high[axis] - low[axis] <= most || second == piece.begin() || second == piece.end()) {
      out.push_back(std::move(piece));
      continue;
    }
    left.emplace_back(second, piece.end());
    left.emplace_back(piece.begin(), second);
  }
  return out;
}

}  // namespace rgs::lod
