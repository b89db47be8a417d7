// scene_first_view.cpp - the first view of a scene, and orbits from it.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene_first_view.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <glm/geometric.hpp>
#include <numbers>
#include <span>

#include "rgs/decode.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kDecodedAtOnce = std::uint64_t{1} << 18;  // Gaussians

glm::dvec3 vector(const std::array<float, 3>& v) {
  return {v[0], v[1], v[2]};
}
std::array<float, 3> list(const glm::dvec3& v) {
  return {static_cast<float>(v.x), static_cast<float>(v.y), static_cast<float>(v.z)};
}
glm::dvec3 vector(const Origin& origin) {
  return {origin[0], origin[1], origin[2]};
}

Status add_file(const FileView& file, FirstViewSample& sample) {
  const std::uint64_t n_chunks = file.header().n_chunks;
  const std::uint64_t at_once = std::max<std::uint64_t>(1, kDecodedAtOnce / file.header().chunk_size);
  std::array<ActivatedSplat, 64> buffer;
  for (std::uint64_t chunk = 0; chunk < n_chunks; chunk += at_once) {
    const auto data = read_chunks(file, chunk, std::min(at_once, n_chunks - chunk), {.validate = false});
    if (!data) return tl::unexpected(data.error());
    for (std::uint64_t i = 0; i < data->size(); i += buffer.size()) {
      const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), data->size() - i));
      if (const Status s = data->read(data->first() + i, part); !s) return s;
      for (const ActivatedSplat& s : part) sample.add(s.mean, s.scale, s.rotation, s.opacity);
    }
  }
  return {};
}

}  // namespace

Result<FirstView> first_view(const Scene& scene, const glm::dvec3& up, bool exact_up) {
  if (const auto& declared = scene.declarations(); declared && declared->first_view != FirstView())
    return declared->first_view;
  if (!scene.is_streamed()) {
    FirstViewSample sample;
    if (scene.has_file()) {
      if (const Status s = add_file(*scene.file(), sample); !s) return tl::unexpected(s.error());
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
