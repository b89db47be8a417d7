// camera.hpp - cameras, default views of scenes without cameras, and paths between cameras.
// SPDX-License-Identifier: Apache-2.0
//
// Frames. Camera axes are OpenCV's: x right, y down, z forward. A world point p has camera coordinates
// c = R p + t, where world_to_camera = [R t; 0 1], and lands at the image position
//     u = fx * c.x / c.z + cx,    v = fy * c.y / c.z + cy    (pixels from the left and the upper edge of the image).
// Other models than the pinhole: docs/format/RENDERING.md, "Camera models".
// Pixel (i, j) covers [i, i + 1) x [j, j + 1) and is sampled at its centre (i + 1/2, j + 1/2), so cx = width / 2,
// cy = height / 2 is the exact centre of the image. This is COLMAP's convention, and the original 3DGS one.
#pragma once

#include <array>
#include <cstdint>
#include <glm/mat4x4.hpp>
#include <glm/vec3.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/math/options.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

struct Box;
struct Declarations;

inline constexpr int kMaxImageSide = 65536;

using math::CameraModel;

/// "pinhole", "opencv", "opencv_fisheye", "equirectangular", "orthographic": as files and programs write it.
const char* camera_model_name(CameraModel model);
/// The model of that name.
std::optional<CameraModel> find_camera_model(std::string_view name);

struct Camera {
  std::string name;                ///< usually the photograph's file name; may be empty
  int width = 0, height = 0;       ///< pixels
  double fx = 0, fy = 0;           ///< focal lengths, px; equirectangular: px per rad; orthographic: px per world unit
  double cx = 0, cy = 0;           ///< principal point, pixels from the left and upper edges
  glm::dmat4 world_to_camera{1.};  ///< rigid motion, last row 0 0 0 1; as in all of GLM, [i] is a column and t is [3]
  CameraModel model = CameraModel::pinhole;
  /// k1 k2 p1 p2 k3 k4 k5 k6 of opencv, k1 k2 k3 k4 of opencv_fisheye, without unit; all others are 0.
  std::array<double, math::kDistortions> distortion{};
};

static_assert(sizeof(glm::dvec3) == 24 && alignof(glm::dmat4) == alignof(double),
              "RoofGS needs GLM's packed types: do not define GLM_FORCE_DEFAULT_ALIGNED_GENTYPES");

/// Files, documents and kernels store matrices row by row.
std::array<double, 16> row_major(const glm::dmat4& matrix);
glm::dmat4 from_row_major(const std::array<double, 16>& matrix);

struct Intrinsics {
  int width = 0, height = 0;              ///< pixels
  double fx = 0, fy = 0, cx = 0, cy = 0;  ///< as in Camera
};

/// Directions of a camera's x, y and z: right, down, forward; or right, up, backward as for glm::lookAt.
enum class CameraAxes : std::uint8_t { opencv, opengl };

/// Camera from a view matrix, also a glm::mat4. Errors: bad_camera, see validate().
Result<Camera> make_camera(const glm::dmat4& world_to_camera, const Intrinsics& intrinsics,
                           CameraAxes axes = CameraAxes::opencv);

/// bad_camera unless sides are 1..kMaxImageSide, focal lengths positive, all finite, the upper 3x3 a rotation
/// (orthonormal to 1e-3, determinant +1), the last row 0 0 0 1, coefficients that the model lacks 0, and an
/// equirectangular image at most the full circle wide (to 1 px).
Status validate(const Camera& camera);

/// The same view at W x H pixels with the same horizontal field of view: s = W / width scales both focal lengths and
/// the principal point's distance from the image centre. A centred principal point becomes exactly (W / 2, H / 2).
Camera resized(const Camera& camera, int width, int height);

/// Position of the camera in the world, -R^-1 t; R may be a rotation to a few digits only.
glm::dvec3 camera_centre(const Camera& camera);
/// Unit direction of a camera axis in the world: right, down, forward.
glm::dvec3 camera_axis(const Camera& camera, int axis);

/// Image format of a view without a camera file. Angles in degrees.
struct ViewFormat {
  int width = 1280, height = 720;  ///< pixels
  double horizontal_fov = 60;      ///< from edge to edge
};

/// Camera at `eye` that sees `target` in the image centre, with `up` pointing up in the image. An `up` along the line
/// of sight is replaced by the world axis farthest from it. eye == target looks along +z.
Camera look_at(const glm::dvec3& eye, const glm::dvec3& target, const glm::dvec3& up, const ViewFormat& format = {});

/// Axis-aligned box of the bulk of a scene.
struct SceneBounds {
  glm::dvec3 low{0, 0, 0}, high{0, 0, 0};  ///< corners, world units
};

/// Views [n, 3] floats, such as a scene's means, as vectors.
std::span<const glm::vec3> as_points(std::span<const float> coordinates);

/// Where a box of means, such as subject_box(), lies in the world.
SceneBounds placed(const Box& box, const Origin& origin);

/// Up in worlds with 3DGS/COLMAP axes (y down); the default of the views below.
inline constexpr glm::dvec3 kWorldUp{0, -1, 0};

/// What an .rgs file declares: its robust box in the world, and up by the axis that points up or down, else kWorldUp.
SceneBounds declared_bounds(const Declarations& declarations);
glm::dvec3 declared_up(const Declarations& declarations);

/// Mean up direction of the cameras; kWorldUp if it is zero.
glm::dvec3 mean_up(std::span<const Camera> cameras);

/// View of a scene without cameras: from the front (-z side), 10 degrees above, as near as shows the ellipsoid in the box:
/// its corners are mostly empty, and between a farther camera and a trained scene there are floaters.
Camera default_view(const SceneBounds& bounds, const ViewFormat& format = {}, const glm::dvec3& up = kWorldUp);

/// `n` such views from all around, evenly spaced; camera 0 is default_view.
std::vector<Camera> orbit(const SceneBounds& bounds, int n, const ViewFormat& format = {},
                          const glm::dvec3& up = kWorldUp);

/// `n_frames` cameras along a smooth path through `keys` in order, first and last included. Positions follow a
/// centripetal Catmull-Rom spline (Barry and Goldman 1988; Yuksel et al. 2011), orientations spherical linear
/// interpolation (Shoemake 1985), focal lengths linear interpolation; frames are evenly spaced along the path. Image
/// size is the first key's, the model that of the key before. Empty without keys or for n_frames < 1; one key is
/// repeated.
std::vector<Camera> interpolated_path(std::span<const Camera> keys, int n_frames);

}  // namespace rgs
