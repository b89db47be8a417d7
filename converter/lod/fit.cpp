// fit.cpp - local splatting: gradients of small pictures (Kerbl et al. 2023), one group at a time (V3DG, 2025).
// SPDX-License-Identifier: Apache-2.0
//
// Each picture shows the group alone in front of every background at once: what it hides counts as much as what it
// shows. One picture a step, all pictures equally often; means move in units of a pixel.
#include "fit.hpp"

#include <algorithm>
#include <cmath>
#include <span>
#include <vector>

#include "rgs/math/sh.hpp"
#include "views.hpp"

namespace rgs::lod {
namespace {

constexpr int kMostPixels = 288;  // sides of a picture

// Step sizes of the first picture; they fall to a tenth until the last.
constexpr float kMeanStep = 0.03F;  // pixels
constexpr float kTurnStep = 0.03F;  // radians
constexpr float kLogScaleStep = 0.03F;
constexpr float kLogitStep = 0.06F;
constexpr float kDcStep = 0.03F;
constexpr float kShStep = 0.008F;
constexpr float kDecay1 = 0.9F, kDecay2 = 0.99F;
constexpr float kLeastLogit = -9.2F, kMostLogit = 4.6F;  // opacities of 0.0001 and 0.99
// For fit_colors(). Steps as large as those of fit() would spoil the many Gaussians that are right already.
constexpr int kColorDirections = 32;
constexpr float kColorRate = 0.1F;

// Squared difference, averaged over all backgrounds b in [0, 1]: the mean of (dc + dt b)^2 is dc^2 + dc dt + dt^2 / 3.
void differentiate(const Picture& truth, const Picture& drawn, Picture& by) {
  by.reset(truth.width(), truth.height());
  const float* const transmitted[2] = {drawn.plane(3), truth.plane(3)};
  for (int y = 0; y < truth.height(); ++y) {
    const std::size_t row = static_cast<std::size_t>(y) * truth.stride();
    for (std::size_t i = row; i < row + static_cast<std::size_t>(truth.width()); ++i) {
      const float dt = transmitted[0][i] - transmitted[1][i];
      float by_covered = 0;
      for (int k = 0; k < 3; ++k) {
        const float dc = drawn.plane(k)[i] - truth.plane(k)[i];
        by.plane(k)[i] = 2 * dc + dt;
        by_covered -= dc + 2.F / 3 * dt;
      }
      by.plane(3)[i] = by_covered;
    }
  }
}

// Adam's moments (Kingma and Ba 2015) of each parameter of each Gaussian.
class Adam {
 public:
  Adam(std::size_t n_values, std::size_t n) : n_(n), mean_(n_values * n), square_(n_values * n) {}
  void begin_step(float rate) {
    power1_ *= kDecay1;
    power2_ *= kDecay2;
    rate_ = rate;
  }
  /// Calls move(i, by) for each Gaussian; its gradient is factor * gradient[i].
  template <class Move>
  void step(std::size_t value, const float* gradient, float factor, float size, const Move& move) {
    float* const mean = &mean_[value * n_];
    float* const square = &square_[value * n_];
    const float unbias = 1 / (1 - power1_), unbias_square = 1 / (1 - power2_);
    for (std::size_t i = 0; i < n_; ++i) {
      const float g = factor * gradient[i];
      mean[i] = kDecay1 * mean[i] + (1 - kDecay1) * g;
      square[i] = kDecay2 * square[i] + (1 - kDecay2) * g * g;
      move(i, -rate_ * size * mean[i] * unbias / (std::sqrt(square[i] * unbias_square) + 1e-12F));
    }
  }

 private:
  std::size_t n_;
  std::vector<float> mean_, square_;
  float power1_ = 1, power2_ = 1, rate_ = 0;
};

void turn(Gaussians& gaussians, std::size_t i, const float by[3]) {
  float q[4], r[4];
  for (int k = 0; k < 4; ++k) q[k] = gaussians.of(kRotation + k)[i];
  const float x = by[0] / 2, y = by[1] / 2, z = by[2] / 2;
  r[0] = q[0] - x * q[1] - y * q[2] - z * q[3];
  r[1] = q[1] + x * q[0] + y * q[3] - z * q[2];
  r[2] = q[2] + y * q[0] + z * q[1] - x * q[3];
  r[3] = q[3] + z * q[0] + x * q[2] - y * q[1];
  const float factor = 1 / std::sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3]);
  for (int k = 0; k < 4; ++k) gaussians.of(kRotation + k)[i] = r[k] * factor;
}

// Descends over pictures in `frames`, with step sizes scaled by `rate`; shapes move only if asked.
void descend(const Gaussians& group, Gaussians& out, float pixel, std::span<const Frame> frames, int n_steps,
             int supersampling, bool shapes, float rate) {
  const auto n_directions = static_cast<int>(frames.size());
  Projection projection;
  Picture fine, drawn, by, scratch;
  std::vector<Picture> truths(frames.size());
  for (std::size_t i = 0; i < frames.size(); ++i) {
    true_picture(group, frames[i], supersampling, projection, fine, truths[i]);
  }
  const std::size_t n = out.padded();
  const int n_sh = 3 * sh_coefficients(out.sh_degree());
  Adam adam(static_cast<std::size_t>(10 + n_sh), n);
  std::vector<float> log_scale(3 * n), logit(n), turns(3 * n), by_logit(n), slopes;
  for (std::size_t i = 0; i < n; ++i) {
    for (int k = 0; k < 3; ++k) log_scale[static_cast<std::size_t>(k) * n + i] = std::log(out.of(kScale + k)[i]);
    const float opacity = std::clamp(out.of(kOpacity)[i], 1.02e-4F, 0.99F);
    logit[i] = std::log(opacity / (1 - opacity));
  }
  // A stride that visits all directions, neighbours far apart in time.
  const int stride = n_directions % 29 == 0 ? 31 : 29;
  for (int step = 0; step < n_steps; ++step) {
    const auto view = static_cast<std::size_t>(step * stride % n_directions);
    const Frame& frame = frames[view];
    project(out, frame, kDrawn, projection);
    drawn.resize(frame.width, frame.height);
    draw(projection.dots, drawn);
    differentiate(truths[view], drawn, by);
    gradients(out, frame, kDrawn, projection.dots, by, drawn, scratch, slopes);
    adam.begin_step(rate * std::pow(0.1F, static_cast<float>(step) / static_cast<float>(n_steps)));
    const auto slope = [&](int gradient) { return &slopes[static_cast<std::size_t>(gradient) * n]; };
    for (int k = 0; k < 3 && shapes; ++k) {
      const auto row = static_cast<std::size_t>(k);
      adam.step(row, slope(kByMean + k), pixel, kMeanStep,
                [&, mean = out.of(kMean + k)](std::size_t i, float d) { mean[i] += d * pixel; });
      adam.step(3 + row, slope(kByLogScale + k), 1, kLogScaleStep,
                [at = &log_scale[row * n]](std::size_t i, float d) { at[i] += d; });
      adam.step(6 + row, slope(kByTurn + k), 1, kTurnStep,
                [at = &turns[row * n]](std::size_t i, float d) { at[i] = d; });
    }
    for (std::size_t i = 0; i < n; ++i) by_logit[i] = slope(kByLogOpacity)[i] * (1 - out.of(kOpacity)[i]);
    adam.step(9, by_logit.data(), 1, kLogitStep,
              [&](std::size_t i, float d) { logit[i] = std::clamp(logit[i] + d, kLeastLogit, kMostLogit); });
    const float* const d = frame.axes.forward;
    const auto basis = math::sh_basis(out.sh_degree(), math::Vec3<float>{d[0], d[1], d[2]});
    for (int k = 0; k < n_sh; ++k) {
      adam.step(static_cast<std::size_t>(10 + k), slope(kByColor + k % 3), basis.y[k / 3], k < 3 ? kDcStep : kShStep,
                [sh = out.of(kSh + k)](std::size_t i, float change) { sh[i] += change; });
    }
    for (std::size_t i = 0; i < out.size(); ++i) {
      out.of(kOpacity)[i] = 1 / (1 + std::exp(-logit[i]));
      if (!shapes) continue;
      for (int k = 0; k < 3; ++k) out.of(kScale + k)[i] = std::exp(log_scale[static_cast<std::size_t>(k) * n + i]);
      const float by_turn[3] = {turns[i], turns[n + i], turns[2 * n + i]};
      turn(out, i, by_turn);
    }
  }
}

}  // namespace

void true_picture(const Gaussians& gaussians, const Frame& frame, int supersampling, Projection& projection,
                  Picture& fine, Picture& out) {
  const Frame f = finer(frame, supersampling);
  project(gaussians, f, kDrawn, projection);
  fine.resize(f.width, f.height);
  draw(projection.dots, fine);
  box_filter(fine, supersampling, out);
}

Difference difference(const Picture& truth, const Picture& drawn) {
  Difference out;
  for (int y = 0; y < truth.height(); ++y) {
    const std::size_t row = static_cast<std::size_t>(y) * truth.stride();
    float squared = 0, covered = 0;
    for (std::size_t i = row; i < row + static_cast<std::size_t>(truth.width()); ++i) {
      const float dt = drawn.plane(3)[i] - truth.plane(3)[i];
      covered += 1 - truth.plane(3)[i];
      for (int k = 0; k < 3; ++k) {
        const float dc = drawn.plane(k)[i] - truth.plane(k)[i];
        squared += dc * dc + dc * dt + dt * dt / 3;
      }
    }
    out.squared += static_cast<double>(squared) / 3;
    out.covered += static_cast<double>(covered);
  }
  return out;
}

void fit(const Gaussians& group, Gaussians& out, float pixel, const FitOptions& options) {
  std::vector<Frame> frames;
  frames.reserve(static_cast<std::size_t>(options.n_directions));
  for (int i = 0; i < options.n_directions; ++i) {
    frames.push_back(frame_around(group, direction(i, options.n_directions), pixel, kMostPixels));
  }
  descend(group, out, pixel, frames, options.n_steps, options.supersampling, true, 1);
}

void fit_colors(const Gaussians& group, Gaussians& out, float pixel, const FitOptions& options) {
  const int n = std::min(options.n_directions, kColorDirections);
  std::vector<Frame> frames;
  frames.reserve(static_cast<std::size_t>(n));
  for (int i = 0; i < n; ++i) {
    frames.push_back(frame_around(group, direction(i, n), i % 2 == 0 ? pixel : 2 * pixel, kMostPixels));
  }
  descend(group, out, pixel, frames, options.n_color_steps, options.supersampling, false, kColorRate);
}

}  // namespace rgs::lod
