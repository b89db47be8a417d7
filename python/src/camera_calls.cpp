// camera_calls.cpp - cameras, camera files and views of scenes without cameras.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <span>
#include <string>

#include "calls.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/file.hpp"
#include "rgs/scene_first_view.hpp"

namespace rgs::python {
namespace {

constexpr std::size_t kNumbers = 31;

Json numbers_of(const Camera& c) {
  Json row{c.width, c.height, c.fx, c.fy, c.cx, c.cy};
  for (const double value : row_major(c.world_to_camera)) row.push_back(value);
  row.push_back(static_cast<int>(c.model));
  for (const double value : c.distortion) row.push_back(value);
  return row;
}
Json rows_of(std::span<const Camera> cameras) {
  Json rows = Json::array();
  for (const Camera& camera : cameras) rows.push_back(numbers_of(camera));
  return rows;
}

glm::dvec3 vector(const Json& a, const char* name) {
  const auto v = a.at(name).get<std::array<double, 3>>();
  return {v[0], v[1], v[2]};
}

ViewFormat view_format(const Json& a, double horizontal_fov) {
  return {a.at("width"), a.at("height"), horizontal_fov};
}

// Each of them is a camera.
Json check(const Json& a) {
  for (const Camera& camera : cameras_of(a)) take(validate(camera));
  return nullptr;
}

Json resized_camera(const Json& a) {
  return numbers_of(resized(cameras_of(a).front(), a.at("width"), a.at("height")));
}

// Without threads, so that the process may fork afterwards.
Json read_cameras(const Json& a) {
  static constexpr const char* kSources[] = {"list", "training", "transforms", "colmap"};
  const auto set = take(read_camera_set(path_of(a)));
  Json names = Json::array(), test = Json::array();
  for (const Camera& camera : set.cameras) names.push_back(camera.name);
  for (const Split split : set.split) test.push_back(split == Split::test);
  return {{"source", kSources[static_cast<int>(set.source)]},
          {"names", names},
          {"cameras", rows_of(set.cameras)},
          {"is_test", test},
          {"split_declared", set.split_declared}};
}

Json write_cameras(const Json& a) {
  const std::string json = a.at("json");
  auto file = take(AtomicFile::create(path_of(a), {.overwrite = a.at("overwrite")}));
  take(file.write_at(0, std::as_bytes(std::span(json))));
  take(file.commit());
  return nullptr;
}

Json look_at_target(const Json& a) {
  const Camera camera =
      look_at(vector(a, "eye"), vector(a, "target"), vector(a, "up"), view_format(a, a.at("horizontal_fov")));
  take(validate(camera));
  return numbers_of(camera);
}

// Around the first view of a scene.
Json orbit_scene(const Json& a) {
  const Scene scene = scene_of(a);
  auto view = take(first_view(scene, vector(a, "up")));
  if (const auto fov = optional<double>(a, "horizontal_fov")) view.horizontal_fov = static_cast<float>(*fov);
  const ViewFormat format = view_format(a, static_cast<double>(view.horizontal_fov));
  return rows_of(orbit(view, scene.origin(), a.at("n"), format));
}

Json path_through(const Json& a) {
  return rows_of(interpolated_path(cameras_of(a), a.at("n_frames")));
}

}  // namespace

std::vector<Camera> cameras_of(const Json& a) {
  std::vector<Camera> cameras(a.at("n").get<std::size_t>());
  const auto* row = address<const double>(a, "cameras");
  for (Camera& c : cameras) {
    c.width = static_cast<int>(row[0]);
    c.height = static_cast<int>(row[1]);
    c.fx = row[2];
    c.fy = row[3];
    c.cx = row[4];
    c.cy = row[5];
    std::array<double, 16> matrix{};
    std::copy_n(row + 6, matrix.size(), matrix.begin());
    c.world_to_camera = from_row_major(matrix);
    c.model = static_cast<CameraModel>(row[22]);
    std::copy_n(row + 23, c.distortion.size(), c.distortion.begin());
    row += kNumbers;
  }
  return cameras;
}

Calls camera_calls() {
  return {{"check_cameras", check},           {"resized", resized_camera}, {"read_cameras", read_cameras},
          {"write_cameras", write_cameras},   {"look_at", look_at_target}, {"orbit", orbit_scene},
          {"interpolated_path", path_through}};
}

}  // namespace rgs::python
