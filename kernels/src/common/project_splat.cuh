// project_splat.cuh - projects one Gaussian from its stored attributes.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <type_traits>

#include "common/frame.hpp"
#include "common/load_splat.cuh"
#include "rgs/math/camera_models.hpp"
#include "rgs/math/projection.hpp"

namespace rgs::cuda {

/// Calls f(std::bool_constant<kAnyModel>()) for a view: kernels for pinholes, false, hold nothing of other models.
template <class F>
inline void with_model(const math::View<float>& view, const F& f) {
  view.model == math::CameraModel::pinhole ? f(std::false_type()) : f(std::true_type());
}

/// Draw it only if footprint.valid.
template <bool kAnyModel>
__device__ inline math::Projected<float> project(const ViewParameters& v, const math::Vec3<float>& mean,
                                                 const Geometry& g) {
  if constexpr (kAnyModel) {
    return math::project_by_model(v.view, mean, g.rotation, g.scale, g.opacity, v.low_pass, v.anti_aliasing);
  } else {
    return math::project(v.view, mean, g.rotation, g.scale, g.opacity, v.low_pass, v.anti_aliasing);
  }
}

/// The same for Gaussian i, whose geometry is read only inside the depth range.
template <bool kAnyModel, class Attributes>
__device__ inline math::Projected<float> project_splat(const Attributes& attributes, std::uint32_t i,
                                                       const ViewParameters& v, const math::Vec3<float>& mean) {
  const math::Vec3<float> p = math::to_camera(v.view, mean);
  if (!math::in_depth_range(v.view, kAnyModel ? math::depth_of(v.view, p) : p.z)) return {};
  return project<kAnyModel>(v, mean, load_geometry(attributes, i));
}

/// Splat i is copy i % n_copies of this Gaussian.
template <bool kAnyModel>
__device__ inline std::uint32_t gaussian_of(const ViewParameters& v, std::uint32_t i) {
  return kAnyModel ? i / math::n_copies(v.view) : i;
}
/// Makes `p`, of splat i's Gaussian, the projection of that splat. Returns the columns of tiles that may show it.
template <bool kAnyModel, int kTile>
__device__ inline math::TileSpan place_copy(const ViewParameters& v, std::uint32_t i, math::Projected<float>& p) {
  if constexpr (kAnyModel) return math::place_copy<kTile>(v.view, i % math::n_copies(v.view), v.grid, p);
  return {0, v.grid.columns};
}

__device__ inline ScreenSplat screen_splat(const math::Projected<float>& p, float cutoff,
                                           const math::Vec3<float>& color) {
  const float log2_opacity = math::kLog2AlphaMin - math::kLog2E * cutoff;
  return {p.mean, p.footprint.conic, log2_opacity, p.footprint.opacity, p.z, color, cutoff};
}

}  // namespace rgs::cuda
