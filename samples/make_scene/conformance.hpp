// conformance.hpp - micro-scenes for renderers of any origin: each of a few Gaussians, about one rule of the image's
// definition (docs/format/RENDERING.md).
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/layout.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs {

/// The near plane of all micro-scenes, world units.
inline constexpr float kMicroNearPlane = 0.2F;
/// Largest difference that a channel of a pixel may have, after both pictures' values were clamped to 0..1: a Gaussian
/// on the other side of the threshold of 1/255, and rounding to 8 bits.
inline constexpr double kMicroTolerance = 1.5 / 255;
/// The nearest that a pixel comes to alpha = 1/255 and to a transmittance of 1e-4, relative to them: so far FP32 may
/// be off before it decides otherwise.
inline constexpr double kMicroMargin = 1e-4;

/// A pixel at which a wrong rule shows.
struct MicroProbe {
  std::size_t camera;  ///< index in MicroScene::cameras
  int x, y;
};

struct MicroScene {
  std::string name;  ///< also its folder's: "01-round-in-the-middle"
  std::string rule;  ///< one sentence
  int sh_degree = 0;
  Declarations declared;  ///< axes, colour space, anti-aliasing, low-pass, origin
  std::vector<Splat> gaussians;
  std::vector<Camera> cameras;  ///< in the world of axes right, down, forward; names are unique
  std::vector<MicroProbe> probes;
};

/// The 24 scenes.
std::vector<MicroScene> micro_scenes();

}  // namespace rgs
