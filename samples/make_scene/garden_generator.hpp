// garden_generator.hpp - a deterministic synthetic garden of many small Gaussians on a grid, for long lists.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "rgs/splat_cloud.hpp"

namespace rgs {

/// Means are whole multiples of this, metres.
inline constexpr float kGardenStep = 0x1p-6F;

/// A round garden in metres, 3DGS axes (x right, y down, z forward), its middle at the origin: a lawn with low beds, a
/// round gravel path of radius 12, shrubs, a hedge of radius 28, a sky 200 m away. Every fourth Gaussian is ground,
/// mostly opaque; most others are leaves that fill the plants, mostly faint. So many lie behind a pixel, as in dense
/// trained scenes. Gaussian i has the same mean for every n; with n ground and sky shrink as 1/sqrt(n), leaves as
/// 1/cbrt(n), to about 14 mm for 13.6 M. There is no spatial order.
/// Values are finite. Thread-safe; copies share their state.
class GardenGenerator {
 public:
  /// sh_degree 0..3; n 0..kMaxSceneGaussians.
  GardenGenerator(std::uint64_t seed, std::uint64_t n, int sh_degree);

  /// Gaussians first .. first + out.size() - 1; the range must lie in [0, n). Gaussian i depends on
  /// (seed, n, sh_degree, i) alone, and not on how the range is cut; lower degrees are the higher ones cut off.
  void generate(std::uint64_t first, std::span<Splat> out) const;

 private:
  struct Layout;
  std::shared_ptr<const Layout> layout_;
};

/// Eight views from the path towards the middle, 1.8 m above the ground, as scene_cameras_json() writes them.
std::string garden_cameras_json(int width = 1280, int height = 720, const Origin& origin = kNoOrigin);

}  // namespace rgs
