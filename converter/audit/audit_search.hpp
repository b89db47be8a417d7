// audit_search.hpp - candidates in the search for the worst views.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/page.hpp"

namespace rgs::audit {

/// Views in which a loss may hide from a circle around the scene: with the back to it, from below and above, inside, and
/// where levels of detail switch (`pages`: of the asset, root first; may be empty). 75, and two for each level above the
/// leaves; the same for the same arguments. Names begin with "found".
std::vector<Camera> searched_views(const SceneBounds& bounds, const glm::dvec3& up, const ViewFormat& format,
                                   std::span<const lod::Page> pages);

}  // namespace rgs::audit
