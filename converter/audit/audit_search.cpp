// audit_search.cpp - candidates in the search for the worst views.
// SPDX-License-Identifier: Apache-2.0
#include "audit_search.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <glm/geometric.hpp>
#include <string>

namespace rgs::audit {
namespace {

// What turns a view away from the axes, along which walls and grids have equal depths: there the order of the file shows.
constexpr double kAskew[2] = {0.31, 0.17};

}  // namespace

std::vector<Camera> searched_views(const SceneBounds& bounds, const glm::dvec3& up, const ViewFormat& format,
                                   std::span<const lod::Page> pages) {
  constexpr int kAround = 8;
  std::vector<Camera> out;
  const glm::dvec3 centre = 0.5 * (bounds.low + bounds.high), half = 0.5 * (bounds.high - bounds.low);
  const auto look = [&](const glm::dvec3& eye, const glm::dvec3& target, const std::string& name) {
    out.push_back(look_at(eye, target, up, format));
    out.back().name = "found " + name;
  };
  const std::vector<Camera> around = orbit(bounds, kAround, format, up);
  const std::vector<Camera> below = orbit(bounds, kAround / 2, format, -up);
  for (std::size_t i = 0; i < around.size(); ++i) {
    const glm::dvec3 eye = camera_centre(around[i]);
    look(eye, 2.0 * eye - centre, fmt::format("behind, {} degrees", i * 360 / around.size()));
  }
  for (std::size_t i = 0; i < below.size(); ++i)
    look(camera_centre(below[i]), centre, fmt::format("below, {} degrees", i * 360 / below.size()));
  const glm::dvec3 beside = kAskew[0] * camera_axis(around[0], 0) + kAskew[1] * camera_axis(around[0], 2);
  look(centre + glm::length(camera_centre(around[0]) - centre) * glm::normalize(up + beside), centre, "above");
  // Inside: from the middle of the box and of its eight parts, to all sides and from the parts to the middle.
  for (int part = -1; part < 8; ++part) {
    glm::dvec3 eye = centre;
    for (int k = 0; k < 3 && part >= 0; ++k) eye[k] += (part >> k & 1 ? 0.5 : -0.5 - 0.1 * k) * half[k];
    for (int axis = 0; axis < 6; ++axis) {
      glm::dvec3 towards(0.0);
      towards[axis / 2] = 1, towards[(axis / 2 + 1) % 3] = kAskew[0], towards[(axis / 2 + 2) % 3] = kAskew[1];
      look(eye, axis % 2 == 0 ? eye + towards : eye - towards,
           fmt::format("inside {}, to {}{}", part + 1, axis % 2 == 0 ? '+' : '-', "xyz"[axis / 2]));
    }
    if (part >= 0) look(eye, centre, fmt::format("inside {}, to the middle", part + 1));
  }
  // From before and behind the scene, where half of a level's pages stand for their descendants.
  const std::uint32_t n_levels = pages.empty() ? 0 : pages.front().level;
  for (std::uint32_t level = 1; level <= n_levels; ++level) {
    std::vector<float> errors;
    for (const lod::Page& page : pages)
      if (page.level == level) errors.push_back(page.error);
    const auto middle = errors.begin() + static_cast<std::ptrdiff_t>(errors.size() / 2);
    std::nth_element(errors.begin(), middle, errors.end());
    const double away = 1.01 * static_cast<double>(*middle) * around[0].fx + glm::length(half);
    for (const std::size_t side : {std::size_t{0}, around.size() / 2})
      look(centre - away * camera_axis(around[side], 2), centre,
           fmt::format("where level {} begins, {} degrees", level, side * 360 / around.size()));
  }
  return out;
}

}  // namespace rgs::audit
