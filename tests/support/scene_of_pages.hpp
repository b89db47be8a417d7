// scene_of_pages.hpp - some pages of a scene with levels of detail as a scene without.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "rgs/paged_file.hpp"
#include "rgs/scene.hpp"

namespace rgs::test {

/// The Gaussians of these pages, page after page, with the same declarations.
inline Result<Scene> scene_of_pages(const Scene& scene, std::span<const std::uint32_t> pages) {
  const auto all = scene.all_pages();
  if (!all) return tl::unexpected(all.error());
  SplatCloud cloud;  // activated
  for (const std::uint32_t number : pages) {
    const lod::Page& page = scene.levels()->pages()[number];
    const auto append = [&](std::vector<float>& to, std::span<const float> from) {
      const std::size_t floats = from.size() / all->n;
      const auto rows = from.subspan(page.first * floats, page.count * floats);
      to.insert(to.end(), rows.begin(), rows.end());
    };
    append(cloud.mean, all->mean);
    append(cloud.rotation, all->rotation);
    append(cloud.log_scale, all->scale);
    append(cloud.opacity_logit, all->opacity);
    append(cloud.sh, all->sh);
  }
  const SceneView activated{cloud.size(),    scene.sh_degree(),   cloud.mean, cloud.rotation,
                            cloud.log_scale, cloud.opacity_logit, cloud.sh};
  return Scene::load(activated, scene.declarations());
}

}  // namespace rgs::test
