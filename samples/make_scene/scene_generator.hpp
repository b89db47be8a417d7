// scene_generator.hpp - a deterministic synthetic scene of any size, for tests, benchmarks and demonstrations.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "rgs/splat_cloud.hpp"

namespace rgs {

/// Largest scene.
inline constexpr std::uint64_t kMaxSceneGaussians = 200'000'000;

/// A small house under a gabled roof, with tower, arch, polished ball, trees, grass, hills and sky: metres, 3DGS axes
/// (x right, y down, z forward), the house at the origin on the plane y = 0, garden to radius 6, background to 300.
/// Splats shrink as 1/sqrt(n), so that every n shows the same scene. Values have the statistics of trained scenes: flat
/// and thin Gaussians, heavy-tailed scales, opacities from nearly transparent to opaque, view-dependent colour that
/// falls with the SH degree, a few DC outliers, unnormalised quaternions, no spatial order.
/// Values are finite. Thread-safe; copies share their state.
class SceneGenerator {
 public:
  /// sh_degree 0..3; n 0..kMaxSceneGaussians.
  SceneGenerator(std::uint64_t seed, std::uint64_t n, int sh_degree);

  std::uint64_t size() const { return n_; }
  int sh_degree() const { return sh_degree_; }

  /// Gaussians first .. first + out.size() - 1; the range must lie in [0, size()). Gaussian i depends on
  /// (seed, n, sh_degree, i) alone, and not on how the range is cut; lower degrees are the higher ones cut off.
  void generate(std::uint64_t first, std::span<Splat> out) const;

 private:
  struct Layout;
  std::uint64_t n_;
  int sh_degree_;
  std::shared_ptr<const Layout> layout_;
};

/// Eight views of the scene at width x height pixels, horizontal field of view 60 degrees, the first one the
/// portrait: a JSON list of {name, split, width, height, fx, fy, cx, cy, world_to_camera [4][4] row-major}, camera
/// axes x right, y down, z forward. They move with a scene whose means are relative to `origin`.
std::string scene_cameras_json(int width = 1280, int height = 720, const Origin& origin = kNoOrigin);

}  // namespace rgs
