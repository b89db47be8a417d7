// audit_gate.hpp - quality conditions of pipelines, and the verdict in words.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <span>
#include <string>
#include <vector>

#include "audit.hpp"

namespace rgs::audit {

/// A condition by name: psnr, worst-psnr, ssim, worst-ssim, ms-ssim, worst-ms-ssim, together-psnr, rated-views, ratio
/// and levels-psnr-1x to -8x must reach their limit; largest (in 8-bit levels), loss (dB), depth (a share), flip,
/// worst-flip, gmsd, worst-gmsd, flicker, worst-flicker (in 8-bit levels), bytes-per-gaussian, gpu-bytes-per-gaussian,
/// dropped, added and unseen (Gaussians), contradictions, levels-loss (dB) and levels-drawn-1x to -8x (a share) must not
/// exceed it.
struct ConditionKind {
  const char* name;
  const char* meaning;
  bool at_least;
  enum class Needs : std::uint8_t { nothing, pictures, photos, attribution, depth, distances, video } needs;
};
std::span<const ConditionKind> condition_kinds();

/// Parses "psnr=50,ssim=0.995". The error is a message for the user: an unknown name, or a limit that is not a finite
/// number.
tl::expected<std::vector<Condition>, std::string> parse_conditions(const std::string& text);
/// Makes `options` measure what only conditions ask for, of kMeasures.
void imply(std::span<const Condition> conditions, Options& options);
/// A message if a condition asks for something that `options` do not measure; else empty.
std::string unmeasurable(std::span<const Condition> conditions, const Options& options);
/// Measured values by the names of conditions, without those not measured. All that later conditions need.
using Measured = std::map<std::string, double>;
Measured measured(const Report& report);
/// The conditions with their measured values. One on something that does not exist (the attribution of a PLY, the PSNR
/// of views that do not show the scene) fails. If pictures were made and none is rated, every gate fails, and so does
/// one without a limit of its own for contradictions, or for levels that lose more than kLevelsLossDb.
std::vector<Condition> evaluate(std::vector<Condition> conditions, const Measured& measured);
/// Fills in report.gate.
void evaluate(std::vector<Condition> conditions, Report& report);
bool holds(std::span<const Condition> gate);
/// "psnr 48.20 < 50; ssim 0.9 < 0.99"; empty if all hold.
std::string failed_conditions(std::span<const Condition> gate);
/// Verdict::headline: failed conditions, then the finding.
std::string headline_of(const std::string& finding, std::span<const Condition> gate);
/// "psnr 48.20 < 50".
std::string describe(const Condition& condition);

}  // namespace rgs::audit
