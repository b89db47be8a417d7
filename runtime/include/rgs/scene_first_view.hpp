// scene_first_view.hpp - views of a scene without cameras.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "rgs/camera.hpp"
#include "rgs/first_view.hpp"
#include "rgs/scene.hpp"

namespace RGS_API rgs {

/// The view from which the scene is seen first, relative to its origin: that of its declarations; else
/// choose_first_view() of its Gaussians, all of which are read; of a streamed scene, or without visible Gaussians,
/// default_view() of subject_bounds(). Never ViewKind::none. `up` is refined unless it is `exact_up`, as that of cameras.
/// Errors: those of subject_bounds().
Result<FirstView> first_view(const Scene& scene, const glm::dvec3& up = kWorldUp, bool exact_up = false);

/// A first view in a picture of this size, as wide as it says; format.horizontal_fov does not count.
Camera default_view(const FirstView& view, const Origin& origin, const ViewFormat& format = {});

/// `n` such views, evenly spaced: around its pivot, or of ViewKind::inside all around from where it stands. Camera 0 is
/// default_view().
std::vector<Camera> orbit(const FirstView& view, const Origin& origin, int n, const ViewFormat& format = {});

}  // namespace rgs
