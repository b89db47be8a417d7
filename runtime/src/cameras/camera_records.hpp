// camera_records.hpp - what the camera readers share.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <glm/mat3x3.hpp>

#include "rgs/camera_file.hpp"

namespace rgs::detail {

/// validate(), but as the error of camera `index` of a file, whose record starts at byte `offset`: bad_value.
Status validate_record(const Camera& camera, std::uint64_t offset, std::uint64_t index);

/// Coefficients that the model has: the first ones of Camera::distortion.
std::size_t n_distortions(CameraModel model);

/// An opencv camera without distortion becomes the pinhole that it is.
void simplify(Camera& camera);

glm::dmat4 rigid_motion(const glm::dmat3& rotation, const glm::dvec3& translation);

/// World to camera of a camera at `centre` whose axes in the world are the columns of `axes`.
glm::dmat4 world_to_camera(const glm::dmat3& axes, const glm::dvec3& centre);

/// Every eighth camera in name order becomes a test camera.
void split_by_name(CameraSet& set);

}  // namespace rgs::detail
