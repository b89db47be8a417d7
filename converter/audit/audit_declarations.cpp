// audit_declarations.cpp - one line a declaration.
// SPDX-License-Identifier: Apache-2.0
#include "audit_declarations.hpp"

#include <fmt/format.h>

#include "console.hpp"
#include "info_report.hpp"

namespace rgs::audit {
namespace {

std::string words(const Axes& axes) {
  return fmt::format("{}, {}, {}", tool::name_of(axes[0]).words, tool::name_of(axes[1]).words,
                     tool::name_of(axes[2]).words);
}
std::string words(const Origin& origin) {
  return fmt::format("{}, {}, {}", origin[0], origin[1], origin[2]);
}
std::string depths(const Declarations& d) {
  return fmt::format("{} to {}, {}", d.z_near, d.z_far, tool::name_of(d.depth_mapping).words);
}
std::string anti_aliasing(const Declarations& d) {
  return fmt::format("{}, low-pass {} px^2", tool::name_of(d.aa_mode).words, d.low_pass_px2);
}
std::string thresholds(const Declarations& d) {
  return fmt::format("{} sigma, alpha {} to {}, transmittance {}", d.cutoff_sigma, d.alpha_threshold, d.alpha_max,
                     d.transmittance_min);
}

}  // namespace

std::vector<DeclaredDifference> compare_declarations(const Source& source, const Declarations& b, bool rgs_asset) {
  const Declarations& a = source.declarations();
  std::vector<DeclaredDifference> out;
  const auto compare = [&](const char* key, const char* name, const std::string& of_source, const std::string& of_asset,
                           bool changes_picture) {
    if (of_source != of_asset) out.push_back({key, name, of_source, of_asset, changes_picture});
  };
  // Renderers take values as they are; a viewer that follows both declarations shows other colours.
  compare("colour_space", "colour space", tool::name_of(a.colour_space).words, tool::name_of(b.colour_space).words,
          a.colour_space != ColourSpace::undeclared && b.colour_space != ColourSpace::undeclared);
  // Conversions turn the Gaussians with their axes, and so does an audit. A PLY that says nothing may be in any.
  if (a.axes[0] != Axis::undeclared && b.axes[0] != Axis::undeclared)
    compare("axes", "axes", words(a.axes), words(b.axes), source.format() != SplatFormat::ply || a.axes != kAxes3dgs);
  // Each is drawn as it states, unless the source says nothing: pictures show what this changes.
  compare("anti_aliasing", "anti-aliasing", anti_aliasing(a), anti_aliasing(b), false);
  if (a.metres_per_unit != 0 && b.metres_per_unit != 0)
    compare("metres_per_unit", "metres per unit", fmt::format("{}", a.metres_per_unit),
            fmt::format("{}", b.metres_per_unit), false);
  compare("origin", "origin", words(a.origin), words(b.origin), false);
  if (a.crs != Crs() && b.crs != Crs())
    compare("crs", "coordinate reference system", tool::printable(a.crs.text), tool::printable(b.crs.text), false);
  compare("sh_basis", "SH basis", tool::name_of(a.sh_basis).words, tool::name_of(b.sh_basis).words, true);
  compare("kernel", "kernel", tool::name_of(a.kernel).words, tool::name_of(b.kernel).words, true);
  compare("sort_metric", "depth order", tool::name_of(a.sort_metric).words, tool::name_of(b.sort_metric).words, true);
  compare("thresholds", "thresholds", thresholds(a), thresholds(b), true);
  if (source.format() == SplatFormat::rgs && rgs_asset)
    compare("depth", "depth range of the sort key", depths(a), depths(b), false);
  return out;
}

}  // namespace rgs::audit
