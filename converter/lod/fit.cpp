// fit.cpp - local splatting: gradients of small pictures (Kerbl et al. 2023), one group at a time (V3DG, 2025).
// SPDX-License-Identifier: Apache-2.0
//
// Each picture shows the group alone in front of every background at once: what it hides counts as much as what it
// shows. One picture a step, all pictures equally often.
#include "fit.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "rgs/math/sh.hpp"
#include "views.hpp"

namespace rgs::lod {
namespace {

constexpr int kMostPixels = 288;  // sides of a picture

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
    power1_ *= kFitDecay1;
    power2_ *= kFitDecay2;
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
      mean[i] = kFitDecay1 * mean[i] + (1 - kFitDecay1) * g;
      square[i] = kFitDecay2 * square[i] + (1 - kFitDecay2) * g * g;
      move(i, -rate_ * size * mean[i] * unbias / (std::sqrt(square[i] * unbias_square) + 1e-12F));
    }
  }

 private:
  std::size_t n_;
  std::vector<float> mean_, square_;
  float power1_ = 1, power2_ = 1, rate_ = 0;
};

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

std::vector<Frame> fit_frames(const Gaussians& group, float pixel) {
  std::vector<Frame> frames(kFitDirections);
  for (int i = 0; i < kFitDirections; ++i) {
    frames[static_cast<std::size_t>(i)] =
        frame_around(group, direction(i, kFitDirections), i % 2 == 0 ? pixel : 2 * pixel, kMostPixels);
  }
  return frames;
}

void fit_colors(const Gaussians& group, Gaussians& out, float pixel) {
  const std::vector<Frame> frames = fit_frames(group, pixel);
  std::vector<Picture> truths(kFitDirections);
  Projection projection;
  Picture fine, drawn, by, scratch;
  for (std::size_t i = 0; i < frames.size(); ++i) {
    true_picture(group, frames[i], kFitSupersampling, projection, fine, truths[i]);
  }
  const std::size_t n = out.padded();
  const int n_sh = 3 * sh_coefficients(out.sh_degree());
  Adam adam(static_cast<std::size_t>(1 + n_sh), n);
  std::vector<float> logit(n), by_logit(n), slopes;
  for (std::size_t i = 0; i < n; ++i) {
    const float opacity = std::clamp(out.of(kOpacity)[i], 1.02e-4F, 0.99F);
    logit[i] = std::log(opacity / (1 - opacity));
  }
  for (int step = 0; step < kFitSteps; ++step) {
    const auto view = static_cast<std::size_t>(step * kFitStride % kFitDirections);
    const Frame& frame = frames[view];
    project(out, frame, kDrawn, projection);
    drawn.resize(frame.width, frame.height);
    draw(projection.dots, drawn);
    differentiate(truths[view], drawn, by);
    gradients(frame, projection.dots, by, drawn, scratch, n, slopes);
    adam.begin_step(std::pow(0.1F, static_cast<float>(step) / kFitSteps));
    const auto slope = [&](int gradient) { return &slopes[static_cast<std::size_t>(gradient) * n]; };
    for (std::size_t i = 0; i < n; ++i) by_logit[i] = slope(kByLogOpacity)[i] * (1 - out.of(kOpacity)[i]);
    adam.step(0, by_logit.data(), 1, kFitLogitStep,
              [&](std::size_t i, float d) { logit[i] = std::clamp(logit[i] + d, kFitLeastLogit, kFitMostLogit); });
    const float* const d = frame.axes.forward;
    const auto basis = math::sh_basis(out.sh_degree(), math::Vec3<float>{d[0], d[1], d[2]});
    for (int k = 0; k < n_sh; ++k) {
      adam.step(static_cast<std::size_t>(1 + k), slope(kByColor + k % 3), basis.y[k / 3],
                k < 3 ? kFitDcStep : kFitShStep,
                [sh = out.of(kSh + k)](std::size_t i, float change) { sh[i] += change; });
    }
    for (std::size_t i = 0; i < out.size(); ++i) out.of(kOpacity)[i] = 1 / (1 + std::exp(-logit[i]));
  }
}

}  // namespace rgs::lod
