// audit_gate.hpp - quality conditions that a pipeline sets, and the words for what an audit found.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
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
/// What conditions are about, by their names; what was not measured is absent. All that later conditions need.
using Measured = std::map<std::string, double>;
Measured measured(const Report& report);
/// The conditions with what was found. One on something that turned out not to exist (the attribution of a PLY, the PSNR of
/// views that do not show the scene) fails. Where pictures were made and none is rated, every gate fails.
std::vector<Condition> evaluate(std::vector<Condition> conditions, const Measured& measured);
/// Fills in report.gate.
void evaluate(std::vector<Condition> conditions, Report& report);
bool holds(std::span<const Condition> gate);
/// "psnr 48.20 < 50; ssim 0.9 < 0.99"; empty if all hold.
std::string failed_conditions(std::span<const Condition> gate);
/// Verdict::headline: the finding, after what failed.
std::string headline_of(const std::string& finding, std::span<const Condition> gate);
/// "psnr 48.20 < 50".
std::string describe(const Condition& condition);

}  // namespace rgs::audit
