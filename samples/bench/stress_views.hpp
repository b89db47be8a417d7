// stress_views.hpp - views unlike those that a renderer is tuned for: from afar, from within, of odd shapes, of nothing.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <glm/vec3.hpp>
#include <span>
#include <string>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/layout.hpp"

namespace rgs::bench {

/// The facts behind the views, in the world frame.
struct StressScene {
  SceneBounds bulk;           ///< of nearly all means: its diagonal is the scene's size
  SceneBounds all;            ///< of all means
  glm::dvec3 dense{0, 0, 0};  ///< where most means lie close together
  glm::dvec3 up = kWorldUp;
  double size() const;  ///< of the scene, world units
};

/// From what a file declares, and means [n, 3] relative to `origin`.
StressScene stress_scene(const Declarations& declared, std::span<const float> mean, const Origin& origin);

/// Middle of the means in the fullest of 64 x 64 x 64 equal parts of `box`, the first if several are; the middle of the
/// box if it holds none.
glm::dvec3 densest_point(std::span<const float> mean, const Origin& origin, const SceneBounds& box);

struct StressView {
  std::string name;
  int width = 0, height = 0;
  std::vector<Camera> cameras;  ///< of that size
};

/// The fixed list, each view from each of `cameras`, of which no more than eight are taken, evenly; without any, from
/// default_view(). docs/user/BENCH_JSON.md, "Stress views", has it.
std::vector<StressView> stress_views(std::span<const Camera> cameras, const StressScene& scene);

/// How many frames that take `ms` each fit into `seconds`: 1 to `most`.
int frames_within(double seconds, double ms, int most);

}  // namespace rgs::bench
