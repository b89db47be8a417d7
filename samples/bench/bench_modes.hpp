// bench_modes.hpp - the configurations that rgs-bench compares: modes by name, and the steps from baseline to paper.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/math/pixel_format.hpp"
#include "rgs/renderer.hpp"

namespace rgs::bench {

/// One row of a table: options of frames and the form of the scene they read.
struct Configuration {
  std::string name;
  RenderOptions options;
  bool compact = true;  ///< the file's attributes; false: FP32
  bool step = false;    ///< on the way between two modes
  /// Output of timed frames: packed pixels, or FP32 RGB.
  std::optional<math::PixelFormat> packed = std::nullopt;
};
/// "rgb32f", "rgba16f", "rgba8".
const char* pixel_format_name(const std::optional<math::PixelFormat>& packed);
/// Of one pixel.
std::uint64_t pixel_bytes(const std::optional<math::PixelFormat>& packed);

/// Inputs of modes: the file's declarations, and choices that replace parts of the paper's.
struct ModeInput {
  std::optional<Declarations> declared;
  std::optional<math::Exp> exp;
  std::optional<DepthMapping> depth_mapping;
  std::optional<float> detail_px =
      std::nullopt;  ///< of a file with levels of detail; baseline draws the leaves all the same
};

/// Names for --mode, the baseline first.
std::vector<std::string> mode_names();
/// Modes that are compared when `asked` are asked for: the baseline first, whether asked for or not; for stress views paper
/// and turbo, whether asked for or not, after the baseline if that is asked for, and then the others. Of levels of detail
/// that are not the leaves (`all_gaussians` is false) there is no baseline, and paper takes its place.
std::vector<std::string> compared_modes(std::span<const std::string> asked, bool is_stress, bool all_gaussians = true);
/// `name` is one of mode_names().
Configuration make_mode(std::string_view name, const ModeInput& input);
/// Whether any of them draws FP32 attributes.
bool reads_fp32(std::span<const Configuration> rows);
/// The paper's steps, one after the other: from baseline, the first, to paper, the last.
std::vector<Configuration> ablation(const ModeInput& input);

}  // namespace rgs::bench
