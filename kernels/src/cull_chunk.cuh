// cull_chunk.cuh - whole chunks outside the view, found before an attribute is read.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/cuda/attributes.hpp"
#include "rgs/cuda/frame.hpp"
#include "rgs/math/camera.hpp"

namespace rgs::cuda {

/// FP32 attributes have no chunks.
__device__ inline bool chunk_in_view(const Fp32Attributes&, std::uint32_t, const ViewParameters&) {
  return true;
}

/// False only if no Gaussian of the chunk of Gaussian i can be listed in a tile. With s the largest standard deviation,
/// a Gaussian's covariance on the image is at most (f/z)^2 (1 + slope^2) s^2 + low_pass along an axis, slope being
/// clamped as in the projection, so it reaches at most 3.34 (f/z sqrt(1 + slope^2) s + sqrt(low_pass)) pixels from its
/// mean. Times z/f this is a distance from the planes through the image's edges, moved outwards by the low-pass' share
/// and a pixel. The mean of each plane's linear form over a box is at its centre, and its least value lies |normal|
/// half extents below.
__device__ inline bool chunk_in_view(const CompactAttributes& a, std::uint32_t i, const ViewParameters& v) {
  const auto* const entry = reinterpret_cast<const float4*>(a.chunks + 12 * (i / a.chunk_size));
  const float4 low = __ldg(entry);  // x, y, z; w: three standard deviations
  const float4 high = __ldg(entry + 1);
  const math::View<float>& view = v.view;
  const math::Vec3<float> center =
      math::to_camera(view, {0.5F * (low.x + high.x), 0.5F * (low.y + high.y), 0.5F * (low.z + high.z)});
  const math::Vec3<float> half{0.5F * (high.x - low.x), 0.5F * (high.y - low.y), 0.5F * (high.z - low.z)};
  const float* const w = view.rotation;
  // Half extent of the box along camera direction (x, y, z), with room for the rounding of large coordinates.
  const auto extent = [&](float x, float y, float z) {
    return 1.0001F * (fabsf(x * w[0] + y * w[3] + z * w[6]) * half.x + fabsf(x * w[1] + y * w[4] + z * w[7]) * half.y +
                      fabsf(x * w[2] + y * w[5] + z * w[8]) * half.z) +
           1e-5F * (fabsf(center.x) + fabsf(center.y) + fabsf(center.z));
  };
  const float depth = extent(0, 0, 1);
  if (center.z + depth <= view.near_plane || center.z - depth > view.far_plane) return false;

  const float slope_x = math::max(fabsf(view.slope_low_x), fabsf(view.slope_high_x));
  const float slope_y = math::max(fabsf(view.slope_low_y), fabsf(view.slope_high_y));
  const float sigma = low.w * (1.0F / 3.0F);
  const float reach_x = 3.34F * sqrtf(1.0F + slope_x * slope_x) * sigma;
  const float reach_y = 3.34F * sqrtf(1.0F + slope_y * slope_y) * sigma;
  const float margin = 3.34F * sqrtf(v.low_pass) + 1.0F;
  const float left = (view.cx + margin) / view.fx,
              right = (static_cast<float>(view.width) - view.cx + margin) / view.fx;
  const float top = (view.cy + margin) / view.fy,
              bottom = (static_cast<float>(view.height) - view.cy + margin) / view.fy;
  // Written so that boxes whose numbers overflow stay in view.
  return !(center.x - right * center.z - extent(1, 0, -right) > reach_x) &&
         !(-center.x - left * center.z - extent(-1, 0, -left) > reach_x) &&
         !(center.y - bottom * center.z - extent(0, 1, -bottom) > reach_y) &&
         !(-center.y - top * center.z - extent(0, -1, -top) > reach_y);
}

}  // namespace rgs::cuda
