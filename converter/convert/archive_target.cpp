// archive_target.cpp - first the step of a model, then the secant through the last two passes.
// SPDX-License-Identifier: Apache-2.0
#include "archive_target.hpp"

#include <algorithm>
#include <cmath>

namespace rgs {
namespace {

// Over the logarithm of the step, PSNR and the logarithm of the size are nearly lines. These are of scanned scenes; from
// step 1 to 5 each is within a few dB, or a third of the size, of the line.
struct Line {
  double at_step_1, slope;
  double margin;  // how far beyond the target a pass aims, so that it rather reaches it
  double near;    // how far beyond it a pass is good enough
};
constexpr Line kPsnr{45.2, -7.5, 0.1, 0.25};
constexpr Line kLogBytes{2.35, -0.51, -0.01, -0.03};  // of a Gaussian
// When only one pass is left and none has reached the target, it aims this many margins beyond.
constexpr double kSafe = 5;
// The last pass aims further by this part of its distance to the target, because the curve bends.
constexpr double kBend = 0.05;

}  // namespace

const ArchivePass* kept_pass(const ArchiveTarget& target, std::span<const ArchivePass> passes) {
  const ArchivePass* kept = nullptr;
  for (const ArchivePass& p : passes) {
    if (target.psnr ? !(p.psnr >= target.psnr) : p.bytes > *target.bytes) continue;
    if (kept == nullptr || (target.psnr ? p.bytes < kept->bytes : p.step < kept->step)) kept = &p;
  }
  return kept;
}

std::optional<float> next_step(const ArchiveTarget& target, std::span<const ArchivePass> passes,
                               std::uint64_t n_gaussians) {
  const Line& line = target.psnr ? kPsnr : kLogBytes;
  const auto value = [&](const ArchivePass& p) {
    return target.psnr ? *p.psnr : std::log(static_cast<double>(p.bytes));
  };
  const double wanted = target.psnr ? *target.psnr : std::log(static_cast<double>(*target.bytes));
  const ArchivePass* kept = kept_pass(target, passes);
  if (passes.size() >= kMaxArchivePasses) return std::nullopt;
  if (kept != nullptr && std::abs(value(*kept) - wanted) <= std::abs(line.near)) return std::nullopt;
  const bool last = passes.size() + 1 == kMaxArchivePasses;
  double goal = wanted + (last && kept == nullptr ? kSafe : 1) * line.margin;
  if (last) goal += std::copysign(kBend * std::min(std::abs(value(passes.back()) - wanted), 10.0), line.margin);

  double log_step = 0;
  if (passes.empty()) {
    const double scene = target.psnr ? 0 : std::log(static_cast<double>(std::max<std::uint64_t>(n_gaussians, 1)));
    if (target.psnr || n_gaussians != 0) log_step = (goal - scene - line.at_step_1) / line.slope;
  } else {
    const ArchivePass& latest = passes.back();
    double slope = line.slope;
    if (passes.size() > 1) {
      const ArchivePass& before = passes[passes.size() - 2];
      const double secant = (value(latest) - value(before)) / std::log(double{latest.step} / before.step);
      // Other slopes are noise, or a quality that the step hardly affects.
      if (secant < 0 && std::isfinite(secant)) slope = std::clamp(secant, 4 * line.slope, line.slope / 4);
    }
    log_step = std::log(double{latest.step}) + (goal - value(latest)) / slope;
  }
  const auto step = static_cast<float>(std::clamp(std::exp(log_step), 0x1p-4, 0x1p6));
  if (std::ranges::any_of(passes, [&](const ArchivePass& p) { return std::abs(p.step / step - 1) < 1e-3F; }))
    return std::nullopt;
  return step;
}

}  // namespace rgs
