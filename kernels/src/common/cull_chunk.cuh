// cull_chunk.cuh - finds chunks outside the view before their attributes are read.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>

#include "common/attributes.hpp"
#include "common/frame.hpp"
#include "rgs/math/camera.hpp"

namespace rgs::cuda {

/// Planes that bound what the view can show. A box of means with centre c, relative to the camera in the world's axes,
/// and half extents h is beyond a plane if normal . c + offset > extent . h + reach s + rounding (|c| + |h|), where s
/// is three standard deviations of its largest Gaussian. The last term allows for rounding far from the camera.
struct CullPlanes {
  struct Plane {
    math::Vec3<float> normal, extent;
    float offset, reach, rounding;
  };
  Plane plane[6];
};

/// With s the largest standard deviation, a Gaussian's covariance on the image is at most (f/z)^2 (1 + slope^2) s^2 +
/// low_pass along an axis, with the slope clamped as in the projection, so it reaches at most 3.34 (f/z sqrt(1 +
/// slope^2) s + sqrt(low_pass)) pixels from its mean. Times z/f this is a distance from the planes through the image's
/// edges, moved outwards by the low-pass' share and a pixel.
///
/// Of other models than the pinhole everything is in view.
inline CullPlanes cull_planes(const ViewParameters& v) {
  const math::View<float>& view = v.view;
  if (view.model != math::CameraModel::pinhole) return {};
  const float* const w = view.rotation;
  // Beyond the plane: x X + y Y + z Z > distance in camera coordinates.
  const auto plane = [&](double x, double y, double z, double distance, float reach) {
    constexpr double kRounding = 1e-5;
    const auto along = [&](int axis) { return x * w[axis] + y * w[3 + axis] + z * w[6 + axis]; };
    const auto extent = [&](int axis) { return static_cast<float>(1.0001 * std::fabs(along(axis))); };
    const double size = std::fabs(x) + std::fabs(y) + std::fabs(z);
    return CullPlanes::Plane{{static_cast<float>(along(0)), static_cast<float>(along(1)), static_cast<float>(along(2))},
                             {extent(0), extent(1), extent(2)},
                             static_cast<float>(-distance),
                             reach / 3,
                             static_cast<float>(kRounding * size)};
  };
  const auto reach = [](float low, float high) {
    const float slope = std::fmax(std::fabs(low), std::fabs(high));
    return 3.34F * std::sqrt(1 + slope * slope);
  };
  const float reach_x = reach(view.slope_low_x, view.slope_high_x),
              reach_y = reach(view.slope_low_y, view.slope_high_y);
  const float margin = 3.34F * std::sqrt(v.low_pass) + 1;
  const float left = (view.cx + margin) / view.fx, top = (view.cy + margin) / view.fy;
  const float right = (static_cast<float>(view.width) - view.cx + margin) / view.fx;
  const float bottom = (static_cast<float>(view.height) - view.cy + margin) / view.fy;
  return {{plane(0, 0, -1, -view.near_plane, 0), plane(0, 0, 1, view.far_plane, 0), plane(1, 0, -right, 0, reach_x),
           plane(-1, 0, -left, 0, reach_x), plane(0, 1, -bottom, 0, reach_y), plane(0, -1, -top, 0, reach_y)}};
}

/// The box of a chunk's means, relative to the camera, in the world's axes.
struct ChunkBox {
  math::Vec3<float> center, half;
  float size;    ///< sum of the magnitudes of its coordinates
  float radius;  ///< three standard deviations of its largest Gaussian
};

__device__ inline ChunkBox load_chunk_box(const std::uint32_t* chunks, std::uint32_t chunk,
                                          const math::View<float>& view) {
  const auto* const entry = reinterpret_cast<const float4*>(chunks + 12 * chunk);
  const float4 first = __ldg(entry);  // x, y, z; w: three standard deviations
  const float4 last = __ldg(entry + 1);
  const math::Vec3<float> low = math::from_camera(view, {first.x, first.y, first.z});
  const math::Vec3<float> high = math::from_camera(view, {last.x, last.y, last.z});
  const math::Vec3<float> center{0.5F * (low.x + high.x), 0.5F * (low.y + high.y), 0.5F * (low.z + high.z)};
  const math::Vec3<float> half{0.5F * (high.x - low.x), 0.5F * (high.y - low.y), 0.5F * (high.z - low.z)};
  return {center, half, fabsf(center.x) + fabsf(center.y) + fabsf(center.z) + half.x + half.y + half.z, first.w};
}

__device__ inline bool is_beyond(const CullPlanes::Plane& p, const ChunkBox& box) {
  const math::Vec3<float>&c = box.center, &h = box.half;
  const float distance = fmaf(p.normal.x, c.x, fmaf(p.normal.y, c.y, fmaf(p.normal.z, c.z, p.offset)));
  const float reach = fmaf(p.reach, box.radius, p.rounding * box.size);
  // Overflowing numbers make the comparison false, so the box stays in view.
  return distance > fmaf(p.extent.x, h.x, fmaf(p.extent.y, h.y, fmaf(p.extent.z, h.z, reach)));
}

/// False only if no tile can list a Gaussian of the chunk. For one thread.
__device__ inline bool chunk_in_view(const std::uint32_t* chunks, std::uint32_t chunk, const math::View<float>& view,
                                     const CullPlanes& planes) {
  const ChunkBox box = load_chunk_box(chunks, chunk, view);
  bool beyond = false;
#pragma unroll
  for (const CullPlanes::Plane& plane : planes.plane) beyond = beyond || is_beyond(plane, box);
  return !beyond;
}

/// The same for the chunk of Gaussian i. All lanes of a warp call it with Gaussians of one chunk; each tests one plane.
__device__ inline bool chunk_in_view(const CompactAttributes& a, std::uint32_t i, const math::View<float>& view,
                                     const CullPlanes& planes) {
  const ChunkBox box = load_chunk_box(a.chunks, i / a.chunk_size, view);
  return !__any_sync(0xFFFFFFFFu, is_beyond(planes.plane[math::min(threadIdx.x % 32, 5u)], box));
}

}  // namespace rgs::cuda
