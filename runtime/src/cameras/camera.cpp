// camera.cpp - cameras: validation, resizing, views of a box, smooth paths.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/camera.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <glm/geometric.hpp>
#include <glm/gtc/matrix_access.hpp>
#include <glm/gtc/quaternion.hpp>
#include <glm/gtc/type_ptr.hpp>
#include <glm/matrix.hpp>
#include <iterator>
#include <numbers>

#include "cameras/camera_records.hpp"
#include "rgs/layout.hpp"

namespace rgs {
namespace {

using Vec3 = glm::dvec3;

// Accepts a 3x3 rotation written with single precision or five decimals, not a scaled or mirrored one.
constexpr double kRotationTolerance = 1e-3;
constexpr double kElevation = 10 * std::numbers::pi / 180;
constexpr double kNearest = 0.4;  // nothing nearer than half of it is drawn

// Not glm::length, whose squares overflow or underflow for very large or small numbers.
double norm(const Vec3& a) {
  return std::hypot(a.x, a.y, a.z);
}

// Unit vector along `a`, or `otherwise` if `a` has no direction.
Vec3 normalized(const Vec3& a, const Vec3& otherwise) {
  const double l = norm(a);
  return l > 0 && std::isfinite(l) ? (1 / l) * a : otherwise;
}

// Unit vector perpendicular to the unit vector `axis`, as close to `wish` as possible.
Vec3 perpendicular(const Vec3& wish, const Vec3& axis) {
  const Vec3 unit = normalized(wish, kWorldUp);
  const Vec3 rejected = unit - glm::dot(unit, axis) * axis;
  if (norm(rejected) > 1e-6) return normalized(rejected, kWorldUp);
  const Vec3 size = glm::abs(axis);
  Vec3 other{0, 0, 0};
  other[size.x <= size.y && size.x <= size.z ? 0 : size.y <= size.z ? 1 : 2] = -1;
  return normalized(other - glm::dot(other, axis) * axis, kWorldUp);
}

// Rotation matrix to quaternion by the largest component (Shepperd 1978): never divides by a small number.
glm::dquat quaternion(const glm::dmat4& m) {
  const double xx = m[0][0], yy = m[1][1], zz = m[2][2];
  const double squares[4] = {1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz};
  const auto largest = std::max_element(squares, squares + 4) - squares;
  const double r = std::sqrt(squares[largest]), s = 0.5 / r;
  const Vec3 difference = s * Vec3(m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0]);
  const double xy = s * (m[1][0] + m[0][1]), xz = s * (m[2][0] + m[0][2]), yz = s * (m[2][1] + m[1][2]);
  switch (largest) {
    case 0: return {r / 2, difference};
    case 1: return {difference.x, r / 2, xy, xz};
    case 2: return {difference.y, xy, r / 2, yz};
    default: return {difference.z, xz, yz, r / 2};
  }
}

// Not glm::dot, which adds in another order: paths would change in their last bits.
double dot(const glm::dquat& a, const glm::dquat& b) {
  return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z;
}

// Spherical linear interpolation on the shorter arc (Shoemake 1985); nearly equal ends use the chord. Unlike
// glm::slerp's, the result has length 1.
glm::dquat slerp(const glm::dquat& a, const glm::dquat& b, double t) {
  const double cosine = dot(a, b), angle = std::acos(std::min(std::abs(cosine), 1.0));
  const bool near = angle < 1e-6;
  const double wa = near ? 1 - t : std::sin((1 - t) * angle) / std::sin(angle);
  const double wb = near ? t : std::sin(t * angle) / std::sin(angle);
  const glm::dquat q = wa * a + wb * (cosine < 0 ? -b : b);
  return q / std::sqrt(dot(q, q));
}

// Centripetal Catmull-Rom point between p1 and p2 by the pyramid of Barry and Goldman (1988). Knots are spaced by the
// square root of the distance, which rules out loops and overshoot between unevenly spaced keys (Yuksel et al. 2011).
Vec3 catmull_rom(const Vec3& p0, const Vec3& p1, const Vec3& p2, const Vec3& p3, double t) {
  const auto knot = [](double from, const Vec3& a, const Vec3& b) {
    return from + std::max(std::sqrt(norm(b - a)), 1e-12);
  };
  const double t0 = 0, t1 = knot(t0, p0, p1), t2 = knot(t1, p1, p2), t3 = knot(t2, p2, p3);
  const double x = t1 + t * (t2 - t1);
  const auto mix = [x](const Vec3& a, const Vec3& b, double ta, double tb) {
    return ((tb - x) / (tb - ta)) * a + ((x - ta) / (tb - ta)) * b;
  };
  const Vec3 a1 = mix(p0, p1, t0, t1), a2 = mix(p1, p2, t1, t2), a3 = mix(p2, p3, t2, t3);
  const Vec3 b1 = mix(a1, a2, t0, t2), b2 = mix(a2, a3, t1, t3);
  return mix(b1, b2, t1, t2);
}

enum class Defect : std::size_t { none, side, focal, principal, pose, rigid, model, distortion, circle };

// For a caller's camera and, with the camera's index in Error::found, for one in a file.
constexpr const char* kDefectText[] = {"",
                                       "image sides must be 1 to 65536 pixels",
                                       "focal lengths must be positive and finite",
                                       "the principal point is not finite",
                                       "the pose is not finite",
                                       "the pose is not a rotation and a translation (scaled or mirrored?)",
                                       "the camera model is unknown",
                                       "a distortion coefficient is not finite, or the model has no such coefficient",
                                       "an equirectangular image is wider than the full circle, 2 pi fx"};
constexpr const char* kRecordDefectText[] = {
    "",
    "the camera of this index has an image side that is not an integer from 1 to 65536",
    "the camera of this index has a focal length that is not positive and finite",
    "the camera of this index has a principal point that is not finite",
    "the camera of this index has a pose that is not finite",
    "the camera of this index has a pose that is not a rotation and a translation (scaled or mirrored?)",
    "the camera of this index has an unknown model",
    "the camera of this index has a distortion coefficient that is not finite, or that its model does not have",
    "the camera of this index is equirectangular and wider than the full circle, 2 pi fx"};

Defect defect(const Camera& camera) {
  const auto finite = [](double x) { return std::isfinite(x); };
  const auto side = [](int x) { return x >= 1 && x <= kMaxImageSide; };
  if (!side(camera.width) || !side(camera.height)) return Defect::side;
  if (!(camera.fx > 0) || !(camera.fy > 0) || !finite(camera.fx) || !finite(camera.fy)) return Defect::focal;
  if (!finite(camera.cx) || !finite(camera.cy)) return Defect::principal;
  const double* m = glm::value_ptr(camera.world_to_camera);
  if (!std::all_of(m, m + 16, finite)) return Defect::pose;
  const Vec3 x = camera_axis(camera, 0), y = camera_axis(camera, 1), z = camera_axis(camera, 2);
  const double off = std::max({std::abs(glm::dot(x, x) - 1), std::abs(glm::dot(y, y) - 1), std::abs(glm::dot(z, z) - 1),
                               std::abs(glm::dot(x, y)), std::abs(glm::dot(y, z)), std::abs(glm::dot(z, x))});
  const bool last_row = glm::row(camera.world_to_camera, 3) == glm::dvec4(0, 0, 0, 1);
  if (!(last_row && off <= kRotationTolerance && glm::dot(glm::cross(x, y), z) > 0)) return Defect::rigid;
  if (camera.model > CameraModel::orthographic) return Defect::model;
  const auto& k = camera.distortion;
  const auto is_zero = [](double value) { return value == 0; };
  const auto n = static_cast<std::ptrdiff_t>(detail::n_distortions(camera.model));
  if (!std::all_of(k.begin(), k.begin() + n, finite) || !std::all_of(k.begin() + n, k.end(), is_zero))
    return Defect::distortion;
  const bool is_wide =
      camera.model == CameraModel::equirectangular && camera.width > 2 * std::numbers::pi * camera.fx + 1;
  return is_wide ? Defect::circle : Defect::none;
}

constexpr const char* kModelNames[] = {"pinhole", "opencv", "opencv_fisheye", "equirectangular", "orthographic"};

}  // namespace

const char* camera_model_name(CameraModel model) {
  return kModelNames[static_cast<std::size_t>(model)];
}

std::optional<CameraModel> find_camera_model(std::string_view name) {
  const auto* const found = std::ranges::find(kModelNames, name);
  if (found == std::end(kModelNames)) return std::nullopt;
  return static_cast<CameraModel>(found - std::begin(kModelNames));
}

std::size_t detail::n_distortions(CameraModel model) {
  return model == CameraModel::opencv ? 8 : model == CameraModel::opencv_fisheye ? 4 : 0;
}

void detail::simplify(Camera& camera) {
  const bool is_plain = std::ranges::all_of(camera.distortion, [](double k) { return k == 0; });
  if (camera.model == CameraModel::opencv && is_plain) camera.model = CameraModel::pinhole;
}

Status validate(const Camera& camera) {
  const Defect found = defect(camera);
  if (found == Defect::none) return {};
  return make_error(Errc::bad_camera, Error::kNone, kDefectText[static_cast<std::size_t>(found)]);
}

Status detail::validate_record(const Camera& camera, std::uint64_t offset, std::uint64_t index) {
  const Defect found = defect(camera);
  if (found == Defect::none) return {};
  return make_error(Errc::bad_value, offset, kRecordDefectText[static_cast<std::size_t>(found)], Error::kNone, index);
}

glm::dmat4 detail::rigid_motion(const glm::dmat3& rotation, const Vec3& translation) {
  glm::dmat4 motion(rotation);
  motion[3] = glm::dvec4(translation, 1);
  return motion;
}

glm::dmat4 detail::world_to_camera(const glm::dmat3& axes, const Vec3& centre) {
  return rigid_motion(glm::transpose(axes), -(centre * axes));
}

std::array<double, 16> row_major(const glm::dmat4& matrix) {
  return std::bit_cast<std::array<double, 16>>(glm::transpose(matrix));
}

glm::dmat4 from_row_major(const std::array<double, 16>& matrix) {
  return glm::transpose(glm::make_mat4(matrix.data()));
}

Result<Camera> make_camera(const glm::dmat4& world_to_camera, const Intrinsics& intrinsics, CameraAxes axes) {
  const auto& [width, height, fx, fy, cx, cy] = intrinsics;
  Camera camera{{}, width, height, fx, fy, cx, cy, world_to_camera, CameraModel::pinhole, {}};
  if (axes == CameraAxes::opengl) {
    for (int column = 0; column < 4; ++column) {
      camera.world_to_camera[column].y *= -1;
      camera.world_to_camera[column].z *= -1;
    }
  }
  if (const Status valid = validate(camera); !valid) return tl::unexpected(valid.error());
  return camera;
}

Camera resized(const Camera& camera, int width, int height) {
  Camera out = camera;
  const double s = static_cast<double>(width) / camera.width;
  out.width = width;
  out.height = height;
  out.fx = camera.fx * s;
  // A full circle stays one: validate() allows a pixel of it.
  if (camera.model == CameraModel::equirectangular) out.fx = std::max(out.fx, (width - 0.5) / (2 * std::numbers::pi));
  out.fy = camera.fy * s;
  out.cx = 0.5 * width + s * (camera.cx - 0.5 * camera.width);
  out.cy = 0.5 * height + s * (camera.cy - 0.5 * camera.height);
  return out;
}

Vec3 camera_axis(const Camera& camera, int axis) {
  return Vec3(glm::row(camera.world_to_camera, axis));
}

Vec3 camera_centre(const Camera& camera) {
  return -(glm::inverse(glm::dmat3(camera.world_to_camera)) * Vec3(camera.world_to_camera[3]));
}

Camera look_at(const Vec3& eye, const Vec3& target, const Vec3& up, const ViewFormat& format) {
  Camera camera;
  camera.width = format.width;
  camera.height = format.height;
  camera.fx = camera.fy = 0.5 * format.width / std::tan(format.horizontal_fov * std::numbers::pi / 360);
  camera.cx = 0.5 * format.width;
  camera.cy = 0.5 * format.height;
  const Vec3 forward = normalized(target - eye, {0, 0, 1});
  const Vec3 down = -perpendicular(up, forward);
  camera.world_to_camera = detail::world_to_camera({glm::cross(down, forward), down, forward}, eye);
  return camera;
}

std::span<const glm::vec3> as_points(std::span<const float> coordinates) {
  static_assert(sizeof(glm::vec3) == 3 * sizeof(float) && alignof(glm::vec3) == alignof(float));
  return {reinterpret_cast<const glm::vec3*>(coordinates.data()), coordinates.size() / 3};
}

SceneBounds placed(const Box& box, const Origin& origin) {
  const Vec3 at = glm::make_vec3(origin.data());
  return {at + Vec3(glm::make_vec3(box.min.data())), at + Vec3(glm::make_vec3(box.max.data()))};
}

SceneBounds declared_bounds(const Declarations& declarations) {
  return placed(declarations.robust, declarations.origin);
}

Vec3 declared_up(const Declarations& declarations) {
  for (int k = 0; k < 3; ++k) {
    const Axis axis = declarations.axes[static_cast<std::size_t>(k)];
    if (axis != Axis::up && axis != Axis::down) continue;
    Vec3 up{0, 0, 0};
    up[k] = axis == Axis::up ? 1 : -1;
    return up;
  }
  return kWorldUp;
}

Vec3 mean_up(std::span<const Camera> cameras) {
  Vec3 sum{0, 0, 0};
  for (const Camera& camera : cameras) sum = sum - camera_axis(camera, 1);
  return normalized(sum, kWorldUp);
}

std::vector<Camera> orbit(const SceneBounds& bounds, int n, const ViewFormat& format, const Vec3& up_wish) {
  const Vec3 up = normalized(up_wish, kWorldUp);
  const Vec3 target = 0.5 * (bounds.low + bounds.high), half = 0.5 * (bounds.high - bounds.low);
  const double tan_x = std::tan(format.horizontal_fov * std::numbers::pi / 360);
  const double tan_y = tan_x * format.height / format.width;
  const Vec3 front = perpendicular({0, 0, -1}, up), side = glm::cross(up, front);
  std::vector<Camera> cameras;
  for (int i = 0; i < n; ++i) {
    const double angle = 2 * std::numbers::pi * i / n;
    const Vec3 level = std::cos(angle) * front + std::sin(angle) * side, right = glm::cross(up, level);
    const Vec3 away = std::cos(kElevation) * level + std::sin(kElevation) * up, down = glm::cross(away, right);
    // A point at c from the middle has the depth distance - dot(away, c). It is in the picture if that is at least
    // dot(edge, c) for every edge. Of all points of the ellipsoid one has the direction of half * (away + edge).
    double distance = norm(half * away) + kNearest;
    for (const Vec3& edge : {right / tan_x, -right / tan_x, down / tan_y, -down / tan_y})
      distance = std::max(distance, norm(half * (away + edge)));
    cameras.push_back(look_at(target + distance * away, target, up, format));
  }
  return cameras;
}

Camera default_view(const SceneBounds& bounds, const ViewFormat& format, const Vec3& up) {
  return orbit(bounds, 1, format, up).front();
}

std::vector<Camera> interpolated_path(std::span<const Camera> keys, int n_frames) {
  std::vector<Camera> path;
  if (keys.empty() || n_frames < 1) return path;
  const std::size_t last = keys.size() - 1;
  std::vector<Vec3> centres;
  std::vector<glm::dquat> rotations;
  for (const Camera& key : keys) {
    centres.push_back(camera_centre(key));
    rotations.push_back(quaternion(key.world_to_camera));
  }
  // A mirrored phantom key beyond each end gives it the slope of its segment.
  const auto position = [&](std::size_t segment, double t) {
    const Vec3 &p1 = centres[segment], &p2 = centres[segment + 1];
    const Vec3 p0 = segment > 0 ? centres[segment - 1] : p1 + (p1 - p2);
    const Vec3 p3 = segment + 1 < last ? centres[segment + 2] : p2 + (p2 - p1);
    return catmull_rom(p0, p1, p2, p3, t);
  };

  // Path length at kSteps samples a segment; frames are placed by inverting this table. One radian of turning counts as
  // much as the mean distance between keys, so that pure rotations take time too.
  constexpr std::size_t kSteps = 32;
  double mean_distance = 0;
  for (std::size_t i = 0; i < last; ++i) mean_distance += norm(centres[i + 1] - centres[i]) / static_cast<double>(last);
  std::vector<double> travelled{0};
  for (std::size_t segment = 0; segment < last; ++segment) {
    const double cosine = std::abs(dot(rotations[segment], rotations[segment + 1]));
    const double turn = 2 * std::acos(std::min(cosine, 1.0)) * std::max(mean_distance, 1e-12) / kSteps;
    for (std::size_t i = 0; i < kSteps; ++i) {
      const Vec3 step =
          position(segment, static_cast<double>(i + 1) / kSteps) - position(segment, static_cast<double>(i) / kSteps);
      travelled.push_back(travelled.back() + std::hypot(norm(step), turn));
    }
  }

  for (int frame = 0; frame < n_frames; ++frame) {
    Camera camera = keys.front();
    const bool is_last = frame > 0 && frame == n_frames - 1;  // the quotient may be a little less than the whole path
    const double wanted = is_last ? travelled.back() : frame > 0 ? travelled.back() * frame / (n_frames - 1) : 0;
    if (travelled.back() > 0) {
      const auto above = std::upper_bound(travelled.begin() + 1, travelled.end() - 1, wanted);
      const auto cell = static_cast<std::size_t>(above - travelled.begin()) - 1;
      const double width = travelled[cell + 1] - travelled[cell];
      const double inside = width > 0 ? std::clamp((wanted - travelled[cell]) / width, 0.0, 1.0) : 0;
      const std::size_t segment = cell / kSteps;
      const double t = (static_cast<double>(cell % kSteps) + inside) / kSteps;
      const glm::dmat3 rotation = glm::mat3_cast(slerp(rotations[segment], rotations[segment + 1], t));
      camera.world_to_camera = detail::world_to_camera(glm::transpose(rotation), position(segment, t));
      const Camera a = resized(keys[segment], camera.width, camera.height);
      const Camera b = resized(keys[segment + 1], camera.width, camera.height);
      // Between two models there is nothing.
      const double s = a.model == b.model ? t : t < 1 ? 0 : 1;
      camera.model = s < 1 ? a.model : b.model;
      camera.fx = std::lerp(a.fx, b.fx, s);
      camera.fy = std::lerp(a.fy, b.fy, s);
      camera.cx = std::lerp(a.cx, b.cx, s);
      camera.cy = std::lerp(a.cy, b.cy, s);
      for (std::size_t k = 0; k < a.distortion.size(); ++k)
        camera.distortion[k] = std::lerp(a.distortion[k], b.distortion[k], s);
    }
    camera.name = "frame_" + std::to_string(frame);
    path.push_back(camera);
  }
  return path;
}

}  // namespace rgs
