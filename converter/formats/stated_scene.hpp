// stated_scene.hpp - what files other than .rgs say of their scene in words: comments of a PLY, extras of a glTF
// primitive. docs/user/INTERCHANGE.md "Declarations" lists them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <string_view>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// The part of Declarations that words state; the defaults are what a file means that says nothing.
struct StatedScene {
  Axes axes = kAxes3dgs;
  ColourSpace colour_space = ColourSpace::srgb_display;
  AaMode aa_mode = AaMode::classic;
  std::optional<float> low_pass_px2 = std::nullopt;  ///< absent: default_low_pass_px2(aa_mode)
  float metres_per_unit = 0;                         ///< 0: unknown
  Origin origin = kNoOrigin;                         ///< in numbers, not in words: double coordinates, a translation

  Declarations declarations() const;
  void copy_to(SplatFile& file) const;
};
StatedScene stated_scene(const Declarations& declarations);
StatedScene stated_scene(const WriteOptions& options);

/// Reads a PLY's comment, its text without the keyword: "SplatRenderMode: mip|default" (Brush and others), "antialiased
/// 1|0" (Postshot), and "rgs_KEY: VALUE" of ours. The last one holds. Others mean nothing here. False: a key of ours with
/// a value that it cannot have.
bool read_comment(std::string_view text, StatedScene& scene);
/// The comment lines of a PLY header, "comment ...\n" each, for what is not the default.
std::string comment_lines(const StatedScene& scene);

/// Reads a glTF primitive's extras. False: a member of ours with a value that it cannot have.
bool read_extras(const nlohmann::json& extras, StatedScene& scene);
/// Its extras for what is not the default and has no place in KHR_gaussian_splatting; null if there is nothing to say.
nlohmann::ordered_json extras_of(const StatedScene& scene);

}  // namespace rgs::detail
