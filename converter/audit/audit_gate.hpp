// audit_gate.hpp - quality conditions that a pipeline sets, and the words for what an audit found.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>
#include <vector>

#include "audit.hpp"

namespace rgs::audit {

/// A condition by name: psnr, worst-psnr, ssim, worst-ssim, together-psnr, rated-views, ratio and levels-psnr-1x to -8x must reach
/// their limit; largest (in 8-bit levels), loss (dB), bytes-per-gaussian, gpu-bytes-per-gaussian, dropped (Gaussians),
/// levels-loss (dB) and levels-drawn-1x to -8x (a share) must not exceed it.
struct ConditionKind {
  const char* name;
  const char* meaning;
  bool at_least;
  enum class Needs : std::uint8_t { nothing, pictures, photos, attribution, distances } needs;
};
std::span<const ConditionKind> condition_kinds();

/// Parses "psnr=50,ssim=0.995". A message for the user if a name is unknown or a limit is no finite number.
tl::expected<std::vector<Condition>, std::string> parse_conditions(const std::string& text);
/// A message if a condition asks for what `options` do not measure; else empty.
std::string unmeasurable(std::span<const Condition> conditions, const Options& options);
/// Fills in report.gate. A condition on something that turned out not to exist (the attribution of a PLY, the PSNR of
/// views that do not show the scene) fails. Where pictures were made and none is rated, every gate fails.
void evaluate(std::vector<Condition> conditions, Report& report);
/// "psnr 48.20 < 50".
std::string describe(const Condition& condition);

}  // namespace rgs::audit
