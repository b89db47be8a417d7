// town_generator.hpp - a deterministic synthetic town of up to a billion Gaussians, made range by range.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <utility>

#include "rgs/splat_cloud.hpp"

namespace rgs {

/// Largest town.
inline constexpr std::uint64_t kMaxTownGaussians = 1'000'000'000;
/// Most blocks along a side.
inline constexpr int kMaxTownBlocks = 64;

/// A range of a town: one block with its houses, gardens, trees and half of its streets, or a sector of the fields, hills
/// and sky around the town. Thread-safe; copies share their state.
class TownRange {
 public:
  std::uint64_t size() const;
  /// Gaussians first .. first + out.size() - 1 of the range, which must lie in [0, size()). They do not depend on
  /// how the range is cut or which other ranges exist.
  void generate(std::uint64_t first, std::span<Splat> out) const;

 private:
  friend class TownGenerator;
  struct Layout;
  explicit TownRange(std::shared_ptr<const Layout> layout) : layout_(std::move(layout)) {}
  std::shared_ptr<const Layout> layout_;
};

/// A town on the plane y = 0 in metres, 3DGS axes (x right, y down, z forward): streets on a slightly irregular grid,
/// terraces, villas with gardens, apartment houses, parks, a church, cars and trees; fields, hills and a sky 5 km away
/// around it. Blocks measure about 78 x 64 m and a crossing near the middle is the origin. Block (i, j) of a seed is the same
/// whatever the town's size, so that a larger town contains the smaller one, with other Gaussians. Gaussians are flat
/// discs that fit the surfaces, as wide as their neighbours are apart; most are nearly opaque.
/// Memory: 10 KB for each block, and about 1 MB for each TownRange that exists. Values are finite. Thread-safe; copies share
/// their state.
class TownGenerator {
 public:
  /// n 0..kMaxTownGaussians; sh_degree 0..3; blocks along a side 1..kMaxTownBlocks, 0: as default_blocks(n).
  TownGenerator(std::uint64_t seed, std::uint64_t n, int sh_degree, int blocks = 0);

  /// Blocks grow with the fourth root of n, so that n grows the town and its detail alike: 4 a side for 1 M, 8 for 20 M,
  /// 13 for 100 M, 22 for 1 G Gaussians.
  static int default_blocks(std::uint64_t n);

  std::uint64_t size() const;
  int sh_degree() const;
  int blocks() const;

  std::uint64_t n_ranges() const;
  /// Gaussians before range k in the order of ranges; first(n_ranges()) == size(). Gaussian first(k) + i of the town is
  /// Gaussian i of range k.
  std::uint64_t first(std::uint64_t k) const;
  /// A box around the means of range k, metres.
  struct Bounds {
    std::array<double, 3> low, high;
  };
  Bounds bounds(std::uint64_t k) const;
  TownRange range(std::uint64_t k) const;

 private:
  struct Layout;
  std::shared_ptr<const Layout> layout_;
};

/// Eight views as a camera list (docs/user/CAMERAS.md), as scene_cameras_json() writes it: three from a street, one over
/// gardens, two over the roofs, one from 500 m away, one from above.
std::string town_cameras_json(std::uint64_t seed, int width = 1280, int height = 720, const Origin& origin = kNoOrigin);

/// The number of cameras of a path, and their rate.
inline constexpr int kTownPathFrames = 600, kTownPathFramesPerSecond = 60;
/// A flight through the town's middle at 30 m/s: 120 m along a street at eye level, then up and over the roofs. It is the same for
/// every size of a seed's town; towns of fewer than four blocks a side are shorter than it.
std::string town_path_json(std::uint64_t seed, int width = 1280, int height = 720, const Origin& origin = kNoOrigin);

}  // namespace rgs
