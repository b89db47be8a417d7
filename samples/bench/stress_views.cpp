// stress_views.cpp - the fixed list of stress views, and the place where a scene is densest.
// SPDX-License-Identifier: Apache-2.0
#include "stress_views.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <glm/geometric.hpp>
#include <glm/gtc/type_ptr.hpp>
#include <limits>
#include <numbers>
#include <utility>

#include "rgs/math/constants.hpp"

namespace rgs::bench {
namespace {

constexpr std::size_t kMostCameras = 8;

struct Size {
  int width, height;
};
constexpr Size k720p{1280, 720}, k1080p{1920, 1080}, k4K{3840, 2160}, k8K{7680, 4320};

glm::dvec3 corner(const SceneBounds& box, int k) {
  return {k & 1 ? box.high.x : box.low.x, k & 2 ? box.high.y : box.low.y, k & 4 ? box.high.z : box.low.z};
}

// Without moving, by `distance` away from what it looks at.
Camera moved_back(Camera camera, double distance) {
  camera.world_to_camera[3].z += distance;
  return camera;
}

// Looking as before, with `point` straight ahead.
Camera placed_before(Camera camera, const glm::dvec3& point, double ahead) {
  glm::dmat4& m = camera.world_to_camera;
  m[3] = {0, 0, 0, 1};
  const glm::dvec4 turned = m * glm::dvec4(point, 1);
  m[3] = {-turned.x, -turned.y, ahead - turned.z, 1};
  return camera;
}

// Turned about its vertical axis, and moved until everything is behind it by the scene's size.
Camera turned_away(Camera camera, const StressScene& scene) {
  for (int column = 0; column < 4; ++column) {
    camera.world_to_camera[column].x *= -1;
    camera.world_to_camera[column].z *= -1;
  }
  double nearest = -std::numeric_limits<double>::infinity();
  for (int k = 0; k < 8; ++k) {
    nearest = std::max(nearest, (camera.world_to_camera * glm::dvec4(corner(scene.all, k), 1)).z);
  }
  return moved_back(camera, -(std::max(nearest, 0.0) + scene.size()));
}

Camera with_field(Camera camera, double degrees) {
  camera.fx = camera.fy = 0.5 * camera.width / std::tan(0.5 * degrees * std::numbers::pi / 180);
  return camera;
}

}  // namespace

double StressScene::size() const {
  return std::max(glm::distance(bulk.low, bulk.high), 1e-6);
}

StressScene stress_scene(const Declarations& declared, std::span<const float> mean, const Origin& origin) {
  StressScene scene;
  scene.bulk = declared_bounds(declared);
  Declarations whole = declared;
  whole.robust = declared.full;
  scene.all = declared_bounds(whole);
  scene.dense = densest_point(mean, origin, scene.bulk);
  scene.up = declared_up(declared);
  return scene;
}

glm::dvec3 densest_point(std::span<const float> mean, const Origin& origin, const SceneBounds& box) {
  constexpr int kParts = 64;
  const auto points = as_points(mean);
  const glm::dvec3 from(origin[0], origin[1], origin[2]), extent = box.high - box.low;
  const auto part_of = [&](const glm::dvec3& p) -> std::size_t {
    std::size_t part = 0;
    for (int axis = 2; axis >= 0; --axis) {
      const double at = extent[axis] > 0 ? (p[axis] - box.low[axis]) / extent[axis] : p[axis] == box.low[axis] ? 0 : -1;
      if (!(at >= 0 && at <= 1)) return std::numeric_limits<std::size_t>::max();
      part = part * kParts + static_cast<std::size_t>(std::min(static_cast<int>(at * kParts), kParts - 1));
    }
    return part;
  };
  std::vector<std::uint32_t> counts(std::size_t{kParts} * kParts * kParts, 0);
  for (const glm::vec3& point : points) {
    const std::size_t part = part_of(from + glm::dvec3(point));
    if (part < counts.size()) ++counts[part];
  }
  const auto fullest = static_cast<std::size_t>(std::max_element(counts.begin(), counts.end()) - counts.begin());
  if (counts[fullest] == 0) return 0.5 * (box.low + box.high);
  glm::dvec3 sum(0, 0, 0);
  for (const glm::vec3& point : points) {
    const glm::dvec3 p = from + glm::dvec3(point);
    if (part_of(p) == fullest) sum += p - box.low;
  }
  return box.low + sum / static_cast<double>(counts[fullest]);
}

std::vector<StressView> stress_views(std::span<const Camera> cameras, const StressScene& scene) {
  std::vector<Camera> from;
  const std::size_t n = std::min(cameras.size(), kMostCameras);
  for (std::size_t k = 0; k < n; ++k) from.push_back(cameras[k * cameras.size() / n]);
  if (from.empty()) from.push_back(default_view(scene.bulk, {.width = 1920, .height = 1080}, scene.up));

  std::vector<StressView> views;
  using Change = std::function<Camera(const Camera&)>;
  const auto add = [&](std::string name, Size size, const Change& change) {
    StressView view{std::move(name), size.width, size.height, {}};
    for (const Camera& camera : from) view.cameras.push_back(change(resized(camera, size.width, size.height)));
    views.push_back(std::move(view));
  };
  const Change as_it_is = [](const Camera& c) { return c; };
  for (const Size size : {k720p, k1080p, k4K, k8K}) add("ordinary", size, as_it_is);
  for (const int units : {30, 300, 3000}) {
    add(fmt::format("back {} units", units), k1080p, [&](const Camera& c) { return moved_back(c, units); });
  }
  for (const int sizes : {1, 10, 100}) {
    add(fmt::format("back {}x its size", sizes), k1080p,
        [&](const Camera& c) { return moved_back(c, sizes * scene.size()); });
  }
  for (const Size size : {Size{33, 31}, Size{1, 1}, Size{16, 16384}, Size{16384, 16}}) add("ordinary", size, as_it_is);
  add("field of 170 degrees", k1080p, [](const Camera& c) { return with_field(c, 170); });
  for (const Size size : {k1080p, k4K}) {
    add("empty", size, [&](const Camera& c) { return turned_away(c, scene); });
  }
  for (const Size size : {k1080p, k4K}) {
    add("in the densest part", size, [&](const Camera& c) { return placed_before(c, scene.dense, 0); });
  }
  // Not so near that nothing of it is drawn.
  const double near = std::max(0.02 * scene.size(), 2.0 * static_cast<double>(math::kNearPlane));
  add("before the densest part", k1080p, [&](const Camera& c) { return placed_before(c, scene.dense, near); });
  return views;
}

int frames_within(double seconds, double ms, int most) {
  if (!(ms > 0)) return most;
  return static_cast<int>(std::clamp(1e3 * seconds / ms, 1.0, static_cast<double>(most)));
}

}  // namespace rgs::bench
