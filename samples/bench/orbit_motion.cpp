// orbit_motion.cpp - an arc of cameras, and statistics of the differences between its pictures.
// SPDX-License-Identifier: Apache-2.0
#include "orbit_motion.hpp"

#include <algorithm>
#include <bit>
#include <cassert>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

namespace rgs::bench {
namespace {

// Bits of a float that is not negative order as it does: exponent and the mantissa's upper 10 bits are its bin.
constexpr int kDroppedBits = 13;
constexpr std::size_t kBins = std::size_t{1} << (31 - kDroppedBits);

double ratio(double value, double reference) {
  if (value == reference) return 1;
  return reference > 0 ? value / reference : std::numeric_limits<double>::infinity();
}

}  // namespace

double look_at_distance(std::span<const float> depth) {
  std::vector<float> shown;
  std::ranges::copy_if(depth, std::back_inserter(shown), [](float z) { return z > 0; });
  if (shown.empty()) return 1;
  const auto middle = shown.begin() + static_cast<std::ptrdiff_t>(shown.size() / 2);
  std::nth_element(shown.begin(), middle, shown.end());
  return *middle;
}

std::vector<Camera> turntable(const Camera& camera, double distance, double degrees, int frames) {
  std::vector<Camera> path;
  for (int frame = 0; frame < frames; ++frame) {
    // c' = Y (c - d) + d with d = (0, 0, distance) and Y the turn about the camera's y axis.
    const double angle = degrees * (frame - 0.5 * (frames - 1)) * std::numbers::pi / 180;
    const double s = std::sin(angle), c = std::cos(angle);
    Camera turned = camera;
    for (int column = 0; column < 4; ++column) {
      glm::dvec4& v = turned.world_to_camera[column];
      const double ahead = column == 3 ? distance : 0, x = v.x, z = v.z - ahead;
      v.x = c * x + s * z;
      v.z = c * z - s * x + ahead;
    }
    path.push_back(std::move(turned));
  }
  return path;
}

std::vector<Camera> dolly(const Camera& camera, double distance, double times, int frames) {
  std::vector<Camera> path;
  for (int frame = 0; frame < frames; ++frame) {
    const double far = std::pow(times, static_cast<double>(frame) / std::max(1, frames - 1));
    Camera back = camera;
    back.world_to_camera[3].z += distance * (far - 1);
    path.push_back(std::move(back));
  }
  return path;
}

Jump largest_jump(std::span<const Change> steps, std::span<const Change> truth) {
  assert(steps.size() == truth.size());
  Jump jump;
  for (std::size_t i = 0; i < steps.size(); ++i) {
    const double mean = ratio(steps[i].mean, truth[i].mean), p999 = ratio(steps[i].p999, truth[i].p999);
    if (mean > jump.mean) jump.mean = mean, jump.mean_frame = static_cast<int>(i) + 1;
    if (p999 > jump.p999) jump.p999 = p999, jump.p999_frame = static_cast<int>(i) + 1;
  }
  return jump;
}

template <class Value>
void MotionMeter::Statistic::add_frame(std::size_t n, const Value& value) {
  if (n == 0) return;
  bins_.assign(kBins, 0);
  double sum = 0;
  for (std::size_t i = 0; i < n; ++i) {
    const float v = std::abs(value(i));
    ++bins_[std::bit_cast<std::uint32_t>(v) >> kDroppedBits];
    sum += static_cast<double>(v);
    largest_ = std::max(largest_, v);
  }
  sum_ += sum;
  n_ += n;
  ++n_frames_;
  // As many values as the percentile leaves out lie above its bin.
  std::size_t above = n / 1000, bin = kBins - 1;
  while (bins_[bin] <= above) above -= bins_[bin--];
  const double p999 = std::bit_cast<float>(static_cast<std::uint32_t>(bin) << kDroppedBits);
  sum_p999_ += p999;
  worst_p999_ = std::max(worst_p999_, p999);
}

Change MotionMeter::Statistic::change() const {
  if (n_frames_ == 0) return {};
  return {sum_ / static_cast<double>(n_), sum_p999_ / static_cast<double>(n_frames_), worst_p999_, largest_};
}

void MotionMeter::add(std::span<const float> picture) {
  assert(last_.empty() || last_.size() == picture.size());
  if (!last_.empty()) step_.add_frame(picture.size(), [&](std::size_t i) { return picture[i] - last_[i]; });
  if (!before_last_.empty()) {
    second_.add_frame(picture.size(),
                      [&](std::size_t i) { return (picture[i] - last_[i]) - (last_[i] - before_last_[i]); });
  }
  std::swap(before_last_, last_);
  last_.assign(picture.begin(), picture.end());
}

Result<std::vector<OrbitRow>> follow(std::span<const Camera> path, std::span<const std::string> modes,
                                     const std::function<Result<Image>(std::size_t, const Camera&)>& render) {
  std::vector<MotionMeter> own(modes.size()), difference(modes.size());
  for (const Camera& camera : path) {
    std::vector<float> reference;
    for (std::size_t m = 0; m < modes.size(); ++m) {
      auto picture = render(m, camera);
      if (!picture) return tl::unexpected(picture.error());
      own[m].add(picture->pixels);
      if (m == 0) {
        reference = std::move(picture->pixels);
        continue;
      }
      std::ranges::transform(picture->pixels, reference, picture->pixels.begin(), std::minus<>());
      difference[m].add(picture->pixels);
    }
  }
  std::vector<OrbitRow> rows;
  for (std::size_t m = 0; m < modes.size(); ++m) {
    rows.push_back({modes[m], own[m].step(), own[m].second(), difference[m].step()});
  }
  return rows;
}

// The mean of the second difference is left out: where hardly anything moves it is the rounding of colours, far below an
// 8-bit level.
double unsteadiness(const OrbitRow& row, const OrbitRow& reference) {
  return std::max({ratio(row.step.mean, reference.step.mean), ratio(row.step.worst_p999, reference.step.worst_p999),
                   ratio(row.second.worst_p999, reference.second.worst_p999)});
}

}  // namespace rgs::bench
