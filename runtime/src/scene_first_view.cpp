// scene_first_view.cpp - the first view of a scene, and orbits from it.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene_first_view.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <glm/geometric.hpp>
#include <numbers>

#include "each_gaussian.hpp"

namespace rgs {
namespace {

glm::dvec3 vector(const std::array<float, 3>& v) {
  return {v[0], v[1], v[2]};
}
std::array<float, 3> list(const glm::dvec3& v) {
  return {static_cast<float>(v.x), static_cast<float>(v.y), static_cast<float>(v.z)};
}
glm::dvec3 vector(const Origin& origin) {
  return {origin[0], origin[1], origin[2]};
}

}  // namespace

Result<FirstView> first_view(const Scene& scene, const glm::dvec3& up, bool exact_up) {
  if (const auto& declared = scene.declarations(); declared && declared->first_view != FirstView())
    return declared->first_view;
  if (!scene.is_streamed()) {
    FirstViewSample sample;
    if (scene.has_file()) {
      const auto add = [&sample](const ActivatedSplat& s) { sample.add(s.mean, s.scale, s.rotation, s.opacity); };
      if (const Status s = each_gaussian(*scene.file(), add); !s) return tl::unexpected(s.error());
    } else {
      const auto arrays = scene.view();
      if (!arrays) return tl::unexpected(arrays.error());
      for (std::uint64_t i = 0; i < arrays->n; ++i)
        sample.add(&arrays->mean[3 * i], &arrays->scale[3 * i], &arrays->rotation[4 * i], arrays->opacity[i]);
    }
    const FirstView view = choose_first_view(sample, {up.x, up.y, up.z}, !exact_up);
    if (view.kind != ViewKind::none) return view;
  }
  const auto bounds = subject_bounds(scene);
  if (!bounds) return tl::unexpected(bounds.error());
  const glm::dvec3 origin = vector(scene.origin());
  const ViewFormat format;
  return FirstView{ViewKind::outside, list(camera_centre(default_view(*bounds, format, up)) - origin),
                   list(0.5 * (bounds->low + bounds->high) - origin), list(up),
                   static_cast<float>(format.horizontal_fov)};
}

std::vector<Camera> orbit(const FirstView& view, const Origin& origin, int n, const ViewFormat& format) {
  const glm::dvec3 at = vector(origin), up = glm::normalize(vector(view.up));
  const glm::dvec3 eye = at + vector(view.position), pivot = at + vector(view.pivot), away = eye - pivot;
  const glm::dvec3 along = glm::dot(up, away) * up, beside = glm::cross(up, away);
  ViewFormat wide = format;
  wide.horizontal_fov = static_cast<double>(view.horizontal_fov);
  std::vector<Camera> cameras;
  for (int i = 0; i < n; ++i) {
    const double angle = 2 * std::numbers::pi * i / n;
    const glm::dvec3 turned = along + std::cos(angle) * (away - along) + std::sin(angle) * beside;
    const bool inside = view.kind == ViewKind::inside;
    cameras.push_back(look_at(inside ? eye : pivot + turned, inside ? eye - turned : pivot, up, wide));
  }
  return cameras;
}

Camera default_view(const FirstView& view, const Origin& origin, const ViewFormat& format) {
  return orbit(view, origin, 1, format).front();
}

}  // namespace rgs
