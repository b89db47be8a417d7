// ablation.hpp - switches of the paper's method, for research that compares its steps.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "rgs/layout.hpp"
#include "rgs/math/options.hpp"
#include "rgs/result.hpp"

namespace RGS_API rgs {

enum class Backend;
struct RenderOptions;

/// Steps of the paper's method, which can be switched one by one; the defaults are the paper. Only Pipeline::paper
/// reads them. docs/format/RENDERING.md has the equations and the measured effects.
struct PaperSteps {
  enum class FrontEnd : std::uint8_t {
    separate,  ///< one kernel each for projection, sum and duplication: the original
    fused,     ///< one kernel: the paper
  };
  math::Extent extent = math::Extent::ellipse;
  math::DepthOrder depth_order = math::DepthOrder::quantized;
  std::optional<DepthMapping> depth_mapping = std::nullopt;  ///< of the quantised key; absent: as declared, else linear
  /// Of the quantised key: 1..32, or 0 = 32 - ceil(log2 tiles); if that is below math::kMinDepthBits, as at 7680x4320,
  /// the order is exact (FrameStats::depth_bits is 0).
  int depth_bits = 0;
  /// Of the quantised key; depths outside it share the end bins. Absent: as declared, else 0.2 to 100.
  std::optional<std::array<float, 2>> depth_range = std::nullopt;
  math::Exponent exponent = math::Exponent::folded;
  math::Exp exp = math::Exp::paper;
  FrontEnd front_end = FrontEnd::fused;  ///< CUDA
  int pixels_per_thread = 2;             ///< CUDA: 1 (the original) or 2 (the paper)
  /// CUDA: the same bytes on every run: Gaussians that share a depth bin are drawn in the order of the scene
  /// (docs/format/RENDERING.md), as in every other pipeline. Otherwise the fused front end lists them in the order in
  /// which its blocks run, as the paper does, which is a little faster.
  bool deterministic = true;
};

/// The settings of options.pipeline on a backend (not automatic), as steps: for ablations that start at baseline; for
/// turbo its arithmetic.
PaperSteps steps_of(const RenderOptions& options, Backend backend);

}  // namespace rgs
