// golden_levels.hpp - the golden files with levels of detail.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

#include "golden_scenes.hpp"
#include "rgs/levels_writer.hpp"
#include "trivial_levels.hpp"

namespace rgs::test {

struct GoldenLevels {
  std::string name;   ///< tests/golden/NAME.rgs
  SplatCloud leaves;  ///< in file order
  lod::Levels levels;
  EncodeOptions options;
  bool earlier = false;  ///< written by an earlier version with options of its own: still read, no longer written
};

/// Pages of a few chunks of 32, so that few Gaussians have three levels.
inline GoldenLevels golden_levels(const std::string& name, Profile profile, std::uint64_t n, int sh_degree,
                                  std::uint64_t seed, std::uint32_t page_chunks = 2) {
  GoldenLevels scene{name, golden_cloud(n, sh_degree, seed), {}, golden_options()};
  scene.levels = trivial_levels(scene.leaves, {.chunk_size = 32, .page_chunks = page_chunks});
  scene.options.profile = profile;
  scene.options.chunk_size = 32;
  scene.options.order = profile == Profile::archive ? Order::morton : Order::input;
  scene.options.keep_permutation = true;
  scene.options.provenance = Provenance{1234, 0x0123456789ABCDEFu, "garden.ply", "golden 1"};
  scene.options.archive.step = 0.7f;
  return scene;
}

/// The same scene where every third Gaussian is moved by these many units on the first axis, to a multiple of 2^-10, and
/// some by a 1000th of them; FP32 does not hold such positions.
inline GoldenLevels golden_origins(const std::string& name, Profile profile, std::uint64_t n, std::uint64_t seed,
                                   double moved = 300000) {
  GoldenLevels scene = golden_levels(name, profile, n, 0, seed);
  SplatCloud& leaves = scene.leaves;
  leaves.mean_rest.resize(leaves.mean.size());
  for (std::size_t i = 0; i < n; ++i) {
    const double x = static_cast<double>(leaves.mean[3 * i]) +
                     (i % 3 == 1   ? moved
                      : i % 7 == 2 ? 0.001 * moved
                                   : 0) +
                     0x1p-10;
    leaves.mean[3 * i] = static_cast<float>(x);
    leaves.mean_rest[3 * i] = static_cast<float>(x - static_cast<double>(leaves.mean[3 * i]));
  }
  scene.levels = trivial_levels(leaves, {.chunk_size = 32, .page_chunks = 2});
  scene.levels.splats.mean_rest.resize(scene.levels.splats.mean.size());
  std::ranges::copy(leaves.mean_rest, scene.levels.splats.mean_rest.end() - static_cast<std::ptrdiff_t>(3 * n));
  scene.options.page_origins = true;
  scene.options.metres_per_unit = 0;
  return scene;
}

inline std::vector<GoldenLevels> all_golden_levels() {
  std::vector<GoldenLevels> scenes;
  scenes.push_back(golden_levels("levels_direct", Profile::direct, 300, 1, 31));
  scenes.back().levels.quality_db = 40.f;
  scenes.push_back(
      golden_levels("levels_shared", Profile::direct, 40, 0, 32));  // one page, one set of steps for the file
  scenes.back().options.chunk_step_sets = false;
  scenes.back().options.origin = {4e6, 1e5, -0.1};
  scenes.push_back(golden_levels("levels_packed", Profile::packed, 300, 2, 33));
  scenes.push_back(golden_levels("levels_archive", Profile::archive, 300, 1, 34));  // Codec::archive_draco
  scenes.back().earlier = true;
  scenes.push_back(golden_levels("levels_archive3", Profile::archive, 300, 1, 34));
  scenes.push_back(golden_levels("levels_crs", Profile::packed, 140, 0, 36));
  scenes.back().options.crs = {"EPSG:4978", {}};
  scenes.push_back(golden_levels("levels_first_view", Profile::packed, 140, 0, 39));
  scenes.back().options.first_view = {ViewKind::outside, {0, -12, -24}, {0, 0, 0.5F}, {0, -1, 0}, 60};
  scenes.push_back(golden_origins("levels_origins_direct", Profile::direct, 140, 37));
  scenes.push_back(golden_origins("levels_origins_packed", Profile::packed, 140, 38));
  return scenes;
}

/// The scene's bytes; empty if it cannot be written.
inline std::vector<std::byte> encode_levels(const GoldenLevels& scene) {
  std::vector<std::byte> bytes;
  const auto written = write_levels(scene.levels, scene.options, bytes, 1);
  if (!written) bytes.clear();
  return bytes;
}

}  // namespace rgs::test
