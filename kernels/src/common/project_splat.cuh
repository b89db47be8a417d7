// project_splat.cuh - projects one Gaussian from its stored attributes.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "common/frame.hpp"
#include "common/load_splat.cuh"
#include "rgs/math/projection.hpp"

namespace rgs::cuda {

/// Draw it only if footprint.valid. Geometry is read only inside the depth range.
template <class Attributes>
__device__ inline math::Projected<float> project_splat(const Attributes& attributes, std::uint32_t i,
                                                       const ViewParameters& v, const math::Vec3<float>& mean) {
  if (!math::in_depth_range(v.view, math::to_camera(v.view, mean).z)) return {};
  const Geometry g = load_geometry(attributes, i);
  return math::project(v.view, mean, g.rotation, g.scale, g.opacity, v.low_pass, v.anti_aliasing);
}

__device__ inline ScreenSplat screen_splat(const math::Projected<float>& p, float cutoff,
                                           const math::Vec3<float>& color) {
  const float log2_opacity = math::kLog2AlphaMin - math::kLog2E * cutoff;
  return {p.mean, p.footprint.conic, p.footprint.opacity, log2_opacity, p.z, color, cutoff};
}

}  // namespace rgs::cuda
