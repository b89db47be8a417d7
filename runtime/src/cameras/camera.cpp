// camera.cpp - camera values: validation, resizing, views around a box and smooth paths.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/camera.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "cameras/camera_records.hpp"

namespace rgs {
namespace {

using Quaternion = std::array<double, 4>;  // w, x, y, z

// A 3x3 rotation that was written with single precision or five decimals passes; a scaled or mirrored one does not.
constexpr double kRotationTolerance = 1e-3;
constexpr double kElevation = 20 * std::numbers::pi / 180;

Vec3 operator+(const Vec3& a, const Vec3& b) {
  return {a[0] + b[0], a[1] + b[1], a[2] + b[2]};
}
Vec3 operator-(const Vec3& a, const Vec3& b) {
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}
Vec3 operator*(double s, const Vec3& a) {
  return {s * a[0], s * a[1], s * a[2]};
}
double dot(const Vec3& a, const Vec3& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
Vec3 cross(const Vec3& a, const Vec3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
double length(const Vec3& a) {
  return std::hypot(a[0], a[1], a[2]);
}

// Unit vector along `a`, or `otherwise` if `a` has no direction.
Vec3 normalized(const Vec3& a, const Vec3& otherwise) {
  const double l = length(a);
  return l > 0 && std::isfinite(l) ? (1 / l) * a : otherwise;
}

// Unit vector perpendicular to the unit vector `axis`, as close to `wish` as possible.
Vec3 perpendicular(const Vec3& wish, const Vec3& axis) {
  const Vec3 unit = normalized(wish, kWorldUp);
  const Vec3 rejected = unit - dot(unit, axis) * axis;
  if (length(rejected) > 1e-6) return normalized(rejected, kWorldUp);
  Vec3 other{0, 0, 0};
  const auto smallest =
      std::min_element(axis.begin(), axis.end(), [](double a, double b) { return std::abs(a) < std::abs(b); });
  other[static_cast<std::size_t>(smallest - axis.begin())] = -1;
  return normalized(other - dot(other, axis) * axis, kWorldUp);
}

void set_pose(Camera& camera, const Vec3& eye, const Vec3& right, const Vec3& down, const Vec3& forward) {
  auto& m = camera.world_to_camera;
  m = {right[0],   right[1],   right[2],   -dot(right, eye),    //
       down[0],    down[1],    down[2],    -dot(down, eye),     //
       forward[0], forward[1], forward[2], -dot(forward, eye),  //
       0,          0,          0,          1};
}

// Rotation matrix to quaternion by the largest component (Shepperd 1978): never divides by a small number.
Quaternion quaternion(const std::array<double, 16>& m) {
  const double xx = m[0], yy = m[5], zz = m[10];
  const std::array<double, 4> squares{1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz};
  const auto largest = std::max_element(squares.begin(), squares.end()) - squares.begin();
  const double r = std::sqrt(squares[static_cast<std::size_t>(largest)]), s = 0.5 / r;
  switch (largest) {
    case 0: return {r / 2, (m[9] - m[6]) * s, (m[2] - m[8]) * s, (m[4] - m[1]) * s};
    case 1: return {(m[9] - m[6]) * s, r / 2, (m[1] + m[4]) * s, (m[2] + m[8]) * s};
    case 2: return {(m[2] - m[8]) * s, (m[1] + m[4]) * s, r / 2, (m[6] + m[9]) * s};
    default: return {(m[4] - m[1]) * s, (m[2] + m[8]) * s, (m[6] + m[9]) * s, r / 2};
  }
}

// Spherical linear interpolation on the shorter arc (Shoemake 1985); nearly equal ends fall back to the chord.
Quaternion slerp(const Quaternion& a, Quaternion b, double t) {
  double cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  if (cosine < 0) {
    cosine = -cosine;
    for (double& x : b) x = -x;
  }
  const double angle = std::acos(std::min(cosine, 1.0));
  const bool near = angle < 1e-6;
  const double wa = near ? 1 - t : std::sin((1 - t) * angle) / std::sin(angle);
  const double wb = near ? t : std::sin(t * angle) / std::sin(angle);
  Quaternion q;
  double norm = 0;
  for (std::size_t i = 0; i < 4; ++i) {
    q[i] = wa * a[i] + wb * b[i];
    norm += q[i] * q[i];
  }
  for (double& x : q) x /= std::sqrt(norm);
  return q;
}

// Centripetal Catmull-Rom point between p1 and p2 by the pyramid of Barry and Goldman (1988). Knots are spaced by the
// square root of the distance, which rules out loops and overshoot between unevenly spaced keys (Yuksel et al. 2011).
Vec3 catmull_rom(const Vec3& p0, const Vec3& p1, const Vec3& p2, const Vec3& p3, double t) {
  const auto knot = [](double from, const Vec3& a, const Vec3& b) {
    return from + std::max(std::sqrt(length(b - a)), 1e-12);
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

enum class Defect : std::size_t { none, side, focal, principal, pose, rigid };

// As a caller's mistake and, with the camera's index in Error::found, as a mistake in a file.
constexpr const char* kDefectText[] = {"",
                                       "image sides must be 1 to 65536 pixels",
                                       "focal lengths must be positive and finite",
                                       "the principal point is not finite",
                                       "the pose is not finite",
                                       "the pose is not a rotation and a translation (scaled or mirrored?)"};
constexpr const char* kRecordDefectText[] = {
    "",
    "the camera of this index has an image side that is not an integer from 1 to 65536",
    "the camera of this index has a focal length that is not positive and finite",
    "the camera of this index has a principal point that is not finite",
    "the camera of this index has a pose that is not finite",
    "the camera of this index has a pose that is not a rotation and a translation (scaled or mirrored?)"};

Defect defect(const Camera& camera) {
  const auto finite = [](double x) { return std::isfinite(x); };
  const auto side = [](int x) { return x >= 1 && x <= kMaxImageSide; };
  if (!side(camera.width) || !side(camera.height)) return Defect::side;
  if (!(camera.fx > 0) || !(camera.fy > 0) || !finite(camera.fx) || !finite(camera.fy)) return Defect::focal;
  if (!finite(camera.cx) || !finite(camera.cy)) return Defect::principal;
  const auto& m = camera.world_to_camera;
  if (!std::all_of(m.begin(), m.end(), finite)) return Defect::pose;
  const Vec3 x = camera_axis(camera, 0), y = camera_axis(camera, 1), z = camera_axis(camera, 2);
  const double off = std::max({std::abs(dot(x, x) - 1), std::abs(dot(y, y) - 1), std::abs(dot(z, z) - 1),
                               std::abs(dot(x, y)), std::abs(dot(y, z)), std::abs(dot(z, x))});
  const bool last_row = m[12] == 0 && m[13] == 0 && m[14] == 0 && m[15] == 1;
  return last_row && off <= kRotationTolerance && dot(cross(x, y), z) > 0 ? Defect::none : Defect::rigid;
}

}  // namespace

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

Camera resized(const Camera& camera, int width, int height) {
  Camera out = camera;
  const double s = static_cast<double>(width) / camera.width;
  out.width = width;
  out.height = height;
  out.fx = camera.fx * s;
  out.fy = camera.fy * s;
  out.cx = 0.5 * width + s * (camera.cx - 0.5 * camera.width);
  out.cy = 0.5 * height + s * (camera.cy - 0.5 * camera.height);
  return out;
}

Vec3 camera_axis(const Camera& camera, int axis) {
  const auto* row = camera.world_to_camera.data() + 4 * axis;
  return {row[0], row[1], row[2]};
}

Vec3 camera_centre(const Camera& camera) {
  const auto& m = camera.world_to_camera;
  return -1.0 * (m[3] * camera_axis(camera, 0) + m[7] * camera_axis(camera, 1) + m[11] * camera_axis(camera, 2));
}

Camera look_at(const Vec3& eye, const Vec3& target, const Vec3& up, const ViewFormat& format) {
  Camera camera;
  camera.width = format.width;
  camera.height = format.height;
  camera.fx = camera.fy = 0.5 * format.width / std::tan(format.horizontal_fov * std::numbers::pi / 360);
  camera.cx = 0.5 * format.width;
  camera.cy = 0.5 * format.height;
  const Vec3 forward = normalized(target - eye, {0, 0, 1});
  const Vec3 down = -1.0 * perpendicular(up, forward);
  set_pose(camera, eye, cross(down, forward), down, forward);
  return camera;
}

SceneBounds robust_bounds(std::span<const float> mean) {
  SceneBounds bounds{{-0.5, -0.5, -0.5}, {0.5, 0.5, 0.5}};
  std::vector<float> values;
  values.reserve(mean.size() / 3);
  for (std::size_t axis = 0; axis < 3; ++axis) {
    values.clear();
    for (std::size_t i = 0; i + 2 < mean.size(); i += 3)
      if (std::isfinite(mean[i]) && std::isfinite(mean[i + 1]) && std::isfinite(mean[i + 2]))
        values.push_back(mean[i + axis]);
    if (values.empty()) return bounds;
    const std::size_t cut = values.size() / 50;
    const auto low = values.begin() + static_cast<std::ptrdiff_t>(cut);
    std::nth_element(values.begin(), low, values.end());
    bounds.low[axis] = *low;
    const auto high = values.end() - 1 - static_cast<std::ptrdiff_t>(cut);
    std::nth_element(values.begin(), high, values.end());
    bounds.high[axis] = *high;
  }
  return bounds;
}

Vec3 mean_up(std::span<const Camera> cameras) {
  Vec3 sum{0, 0, 0};
  for (const Camera& camera : cameras) sum = sum - camera_axis(camera, 1);
  return normalized(sum, kWorldUp);
}

std::vector<Camera> orbit(const SceneBounds& bounds, int n, const ViewFormat& format, const Vec3& up_wish) {
  const Vec3 up = normalized(up_wish, kWorldUp);
  const Vec3 target = 0.5 * (bounds.low + bounds.high);
  const double radius = std::max(0.5 * length(bounds.high - bounds.low), 1e-6);
  // The box's sphere fits the narrower of the two fields of view.
  const double tan_x = std::tan(format.horizontal_fov * std::numbers::pi / 360);
  const double half_angle = std::atan(tan_x * std::min(1.0, static_cast<double>(format.height) / format.width));
  const double distance = radius / std::sin(half_angle);
  const Vec3 front = perpendicular({0, 0, -1}, up), side = cross(up, front);
  std::vector<Camera> cameras;
  for (int i = 0; i < n; ++i) {
    const double angle = 2 * std::numbers::pi * i / n;
    const Vec3 level = std::cos(angle) * front + std::sin(angle) * side;
    const Vec3 eye = target + distance * (std::cos(kElevation) * level + std::sin(kElevation) * up);
    cameras.push_back(look_at(eye, target, up, format));
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
  std::vector<Quaternion> rotations;
  for (const Camera& key : keys) {
    centres.push_back(camera_centre(key));
    rotations.push_back(quaternion(key.world_to_camera));
  }
  // A phantom key before the first and after the last one, mirrored, gives the ends the slope of their segment.
  const auto position = [&](std::size_t segment, double t) {
    const Vec3 &p1 = centres[segment], &p2 = centres[segment + 1];
    const Vec3 p0 = segment > 0 ? centres[segment - 1] : p1 + (p1 - p2);
    const Vec3 p3 = segment + 1 < last ? centres[segment + 2] : p2 + (p2 - p1);
    return catmull_rom(p0, p1, p2, p3, t);
  };

  // Path length at kSteps samples a segment; frames are placed by inverting this table. A turn on the spot counts too:
  // one radian as much as the mean distance between keys, so that pure rotations take time as well.
  constexpr std::size_t kSteps = 32;
  double mean_distance = 0;
  for (std::size_t i = 0; i < last; ++i)
    mean_distance += length(centres[i + 1] - centres[i]) / static_cast<double>(last);
  std::vector<double> travelled{0};
  for (std::size_t segment = 0; segment < last; ++segment) {
    const Quaternion &a = rotations[segment], &b = rotations[segment + 1];
    const double cosine = std::abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]);
    const double turn = 2 * std::acos(std::min(cosine, 1.0)) * std::max(mean_distance, 1e-12) / kSteps;
    for (std::size_t i = 0; i < kSteps; ++i) {
      const Vec3 step =
          position(segment, static_cast<double>(i + 1) / kSteps) - position(segment, static_cast<double>(i) / kSteps);
      travelled.push_back(travelled.back() + std::hypot(length(step), turn));
    }
  }

  for (int frame = 0; frame < n_frames; ++frame) {
    Camera camera = keys.front();
    const double wanted = n_frames > 1 ? travelled.back() * frame / (n_frames - 1) : 0;
    if (travelled.back() > 0) {
      const auto above = std::upper_bound(travelled.begin() + 1, travelled.end() - 1, wanted);
      const auto cell = static_cast<std::size_t>(above - travelled.begin()) - 1;
      const double width = travelled[cell + 1] - travelled[cell];
      const double inside = width > 0 ? std::clamp((wanted - travelled[cell]) / width, 0.0, 1.0) : 0;
      const std::size_t segment = cell / kSteps;
      const double t = (static_cast<double>(cell % kSteps) + inside) / kSteps;
      const Quaternion q = slerp(rotations[segment], rotations[segment + 1], t);
      const double w = q[0], x = q[1], y = q[2], z = q[3];
      set_pose(camera, position(segment, t), {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
               {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
               {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)});
      const Camera a = resized(keys[segment], camera.width, camera.height);
      const Camera b = resized(keys[segment + 1], camera.width, camera.height);
      camera.fx = std::lerp(a.fx, b.fx, t);
      camera.fy = std::lerp(a.fy, b.fy, t);
      camera.cx = std::lerp(a.cx, b.cx, t);
      camera.cy = std::lerp(a.cy, b.cy, t);
    }
    camera.name = "frame_" + std::to_string(frame);
    path.push_back(camera);
  }
  return path;
}

}  // namespace rgs
