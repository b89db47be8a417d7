// stated_scene.hpp - what files other than .rgs state of their scene: comments of a PLY, extras of a glTF primitive.
// docs/user/INTERCHANGE.md "Declarations" lists them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <string_view>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// The declarations that such files can state; the defaults hold for a file that states nothing.
struct StatedScene {
  Axes axes = kAxes3dgs;
  ColourSpace colour_space = ColourSpace::srgb_display;
  AaMode aa_mode = AaMode::classic;
  std::optional<float> low_pass_px2 = std::nullopt;  ///< absent: default_low_pass_px2(aa_mode)
  float metres_per_unit = 0;                         ///< 0: unknown
  Origin origin = kNoOrigin;                         ///< not stated in words: double coordinates, a translation
  Crs crs = {};

  Declarations declarations() const;
  void copy_to(SplatFile& file) const;
};
StatedScene stated_scene(const Declarations& declarations);
StatedScene stated_scene(const WriteOptions& options);

/// Reads the text of a PLY comment: "SplatRenderMode: mip|default" (Brush and others), "antialiased 1|0" (Postshot),
/// and our "rgs_KEY: VALUE". The last one holds; others are ignored. Returns false if one of our keys has an invalid
/// value.
bool read_comment(std::string_view text, StatedScene& scene);
/// Comment lines of a PLY header, "comment ...\n" each, for values that are not the default.
std::string comment_lines(const StatedScene& scene);

/// Reads a glTF primitive's extras. Returns false if one of our members has an invalid value.
bool read_extras(const nlohmann::json& extras, StatedScene& scene);
/// A primitive's extras: values that are not the default and have no field in KHR_gaussian_splatting; null if none.
nlohmann::ordered_json extras_of(const StatedScene& scene);

}  // namespace rgs::detail
