// camera_records.hpp - what the camera readers share.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/camera_file.hpp"

namespace rgs::detail {

/// As validate(), but as the error of camera `index` of a file whose record starts at byte `offset`: bad_value.
Status validate_record(const Camera& camera, std::uint64_t offset, std::uint64_t index);

/// Sets the rotation (row-major 3x3) and the translation of world_to_camera.
void set_world_to_camera(Camera& camera, const double (&rotation)[9], const double (&translation)[3]);

/// Inverse of the above: the camera's axes are the columns of `rotation`, its centre is `position`.
void set_camera_to_world(Camera& camera, const double (&rotation)[9], const double (&position)[3]);

/// Every eighth camera in name order becomes a test camera.
void split_by_name(CameraSet& set);

}  // namespace rgs::detail
