// view_documents.cpp - view.json and cameras.json.
// SPDX-License-Identifier: Apache-2.0
#include "view_documents.hpp"

#include <fmt/format.h>

#include <cstddef>
#include <glm/geometric.hpp>
#include <nlohmann/json.hpp>

namespace rgs::view {
namespace {

using Json = nlohmann::ordered_json;

std::string dumped(const Json& json) {
  return json.dump(-1, ' ', false, Json::error_handler_t::replace);
}

}  // namespace

std::string percent_encoded(std::string_view name) {
  std::string out;
  for (const char c : name) {
    const bool plain = (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '-' ||
                       c == '.' || c == '_' || c == '~';
    out += plain ? std::string(1, c) : fmt::format("%{:02X}", static_cast<unsigned char>(c));
  }
  return out;
}

std::string cameras_json(std::span<const Camera> cameras) {
  Json list = Json::array();
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    const Camera& camera = cameras[i];
    const glm::dvec3 centre = camera_centre(camera);
    // Rows of camera to world are the columns of GLM's world to camera.
    Json rotation = Json::array();
    for (int row = 0; row < 3; ++row) {
      const glm::dvec4& column = camera.world_to_camera[row];
      rotation.push_back({column.x, column.y, column.z});
    }
    list.push_back({{"id", i},
                    {"img_name", camera.name},
                    {"width", camera.width},
                    {"height", camera.height},
                    {"position", {centre.x, centre.y, centre.z}},
                    {"rotation", std::move(rotation)},
                    {"fx", camera.fx},
                    {"fy", camera.fy},
                    {"cx", camera.cx},
                    {"cy", camera.cy}});
  }
  return dumped(list);
}

std::string view_link(const Camera& camera, std::span<const Camera> all, bool two_scenes) {
  const glm::dvec3 eye = camera_centre(camera), ahead = camera_axis(camera, 2);
  glm::dvec3 middle{0};
  for (const Camera& other : all) middle += camera_centre(other) / static_cast<double>(all.size());
  const double distance = glm::dot(middle - eye, ahead);
  const glm::dvec3 pivot = eye + (distance > 0 ? distance : 1) * ahead;
  const glm::dmat4& m = camera.world_to_camera;  // its columns are the rows of camera to world
  return fmt::format("at={},{},{}&axes={},{},{},{},{},{},{},{},{}&lens={},{},{},{}&pivot={},{},{}{}", eye.x, eye.y,
                     eye.z, m[0][0], m[0][1], m[0][2], m[1][0], m[1][1], m[1][2], m[2][0], m[2][1], m[2][2],
                     camera.fx / camera.width, camera.fy / camera.fx, (camera.cx - 0.5 * camera.width) / camera.width,
                     (camera.cy - 0.5 * camera.height) / camera.width, pivot.x, pivot.y, pivot.z,
                     two_scenes ? "&mode=slider" : "");
}

std::string view_json(const ViewDocument& document) {
  Json scenes = Json::array(), photos = Json::array();
  for (const auto& scene : document.scenes)
    scenes.push_back({{"name", scene.name}, {"url", scene.url}, {"bytes", scene.bytes}});
  for (const auto& photo : document.photos) photos.push_back({{"camera", photo.camera}, {"url", photo.url}});
  Json json{{"version", 1}, {"scenes", std::move(scenes)}};
  json["cameras"] = document.cameras.empty() ? Json(nullptr) : Json(document.cameras);
  json["photos"] = std::move(photos);
  json["frames"] = document.backend.empty() ? Json(nullptr) : Json{{"url", "frame"}, {"backend", document.backend}};
  if (document.spz_opengl) json["settings"] = {{"spz_axes", "opengl"}};
  return dumped(json);
}

}  // namespace rgs::view
