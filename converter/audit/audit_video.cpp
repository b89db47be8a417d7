// audit_video.cpp - curves over the frames of a video, and their worst seconds.
// SPDX-License-Identifier: Apache-2.0
#include "audit_video.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "rgs/image_metrics.hpp"

namespace rgs::audit {
namespace {

// Mean of the values that are not NaN; NaN without any.
double mean_of(std::span<const double> values) {
  double sum = 0;
  std::size_t n = 0;
  for (const double v : values)
    if (!std::isnan(v)) sum += v, ++n;
  return n == 0 ? std::numeric_limits<double>::quiet_NaN() : sum / static_cast<double>(n);
}

}  // namespace

std::string VideoReport::name_of(std::size_t frame) const {
  return frames[frame].empty() ? fmt::format("frame {}", frame) : frames[frame];
}

VideoReport video_report(std::span<const ViewResult> frames, int fps) {
  VideoReport out{fps};
  for (const ViewResult& v : frames) out.frames.push_back(v.name);
  const std::size_t length = std::min(frames.size(), static_cast<std::size_t>(fps));
  const auto add = [&](const char* key, const char* name, bool at_least, const auto& value) {
    Curve curve{key, name, at_least};
    for (const ViewResult& v : frames)
      curve.values.push_back(
          (v.rated() ? value(v.score) : std::nullopt).value_or(std::numeric_limits<double>::quiet_NaN()));
    // NaN, which is not rated, is never worse; any value is worse than NaN.
    const auto is_worse = [&](double a, double b) {
      return !std::isnan(a) && (std::isnan(b) || (at_least ? a < b : a > b));
    };
    curve.second_mean = std::numeric_limits<double>::quiet_NaN();
    for (std::size_t i = 0; i < curve.values.size(); ++i) {
      if (is_worse(curve.values[i], curve.values[curve.worst])) curve.worst = i;
      if (i + length > curve.values.size()) continue;
      const double mean = mean_of(std::span(curve.values).subspan(i, length));
      if (is_worse(mean, curve.second_mean)) curve.second = i, curve.second_mean = mean;
    }
    if (!std::isnan(curve.second_mean)) out.curves.push_back(std::move(curve));
  };
  add("psnr", "PSNR", false, [](const Score& s) { return std::optional(s.mse); });
  Curve& psnr = out.curves.front();
  psnr.at_least = true;
  for (double& v : psnr.values)
    if (!std::isnan(v)) v = psnr_of(v);
  psnr.second_mean = psnr_of(psnr.second_mean);
  add("ssim", "SSIM", true, [](const Score& s) { return std::optional(s.ssim); });
  for (std::size_t i = 0; i < kMeasures.size(); ++i)
    add(kMeasures[i].key, kMeasures[i].title, kMeasures[i].at_least, [i](const Score& s) { return s.measures[i]; });
  const std::size_t before = out.curves.size();
  add("flicker", "Flicker", false, [](const Score& s) { return s.flicker; });
  if (out.curves.size() > before) {
    const Curve& flicker = out.curves.back();
    out.flicker = mean_of(flicker.values);
    out.worst_flicker = flicker.values[flicker.worst];
  }
  return out;
}

}  // namespace rgs::audit
