// convert_scenes.hpp - scenes as PLY files, intact and damaged, for the tests of rgs-convert.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdio>
#include <filesystem>
#include <limits>
#include <string>
#include <vector>

#include "golden_scenes.hpp"
#include "ply_samples.hpp"
#include "rgs/camera.hpp"
#include "rgs/scene_scan.hpp"
#include "text_file.hpp"

namespace rgs::test {

inline std::vector<Splat> splats_of(const SplatCloud& cloud) {
  std::vector<Splat> splats;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) splats.push_back(cloud.view().splat(i));
  return splats;
}

/// The first view that a conversion with these options states.
inline FirstView chosen_for(const SplatCloud& cloud, const EncodeOptions& options = {}) {
  SceneScan scan(cloud.sh_degree, options.on_bad, true);
  for (Splat splat : splats_of(cloud)) scan.add(splat);
  Declarations declared;
  declared.axes = options.axes;
  const glm::dvec3 up = declared_up(declared);
  return choose_first_view(scan.view_sample(), {up.x, up.y, up.z}, true);
}

inline std::string write_scene(const std::string& path, const SplatCloud& cloud) {
  write_text(path, binary_ply(splats_of(cloud), cloud.sh_degree));
  return path;
}

/// The scene as ASCII or big-endian PLY without normals; nine digits restore each float.
inline std::string other_ply(const SplatCloud& cloud, bool ascii) {
  const int per_channel = sh_coefficients(cloud.sh_degree) - 1;
  std::string text =
      header_of(splat_properties(3 * per_channel), std::to_string(cloud.size()), ascii ? "ascii" : "binary_big_endian");
  for (const Splat& s : splats_of(cloud)) {
    std::vector<float> row(s.mean, s.mean + 3);
    row.insert(row.end(), s.sh, s.sh + 3);
    for (int c = 0; c < 3; ++c) {
      for (int k = 1; k <= per_channel; ++k) row.push_back(s.sh[3 * k + c]);
    }
    row.push_back(s.opacity_logit);
    row.insert(row.end(), s.log_scale, s.log_scale + 3);
    row.insert(row.end(), s.rotation, s.rotation + 4);
    for (const float value : row) {
      if (ascii) {
        char digits[32];
        std::snprintf(digits, sizeof digits, "%.9g ", static_cast<double>(value));
        text += digits;
      } else {
        append_value(text, value, true);
      }
    }
    if (ascii) text += '\n';
  }
  return text;
}

/// Damages Gaussians 0, every, 2 every, ... in turn: a NaN mean, a NaN rotation, a zero quaternion, an infinite SH
/// coefficient. Repair fixes all but the first kind.
inline SplatCloud damaged(SplatCloud cloud, std::uint64_t every) {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  for (std::uint64_t i = 0, kind = 0; i < cloud.size(); i += every, ++kind) {
    Splat s = cloud.view().splat(i);
    switch (kind % 4) {
      case 0: s.mean[1] = std::numeric_limits<float>::quiet_NaN(); break;
      case 1: s.rotation[2] = std::numeric_limits<float>::quiet_NaN(); break;
      case 2: std::fill_n(s.rotation, 4, 0.F); break;
      default: s.sh[1] = kInfinity; break;
    }
    cloud.set(i, s);
  }
  return cloud;
}

inline std::size_t entries(const std::filesystem::path& folder) {
  return static_cast<std::size_t>(
      std::distance(std::filesystem::directory_iterator(folder), std::filesystem::directory_iterator()));
}

}  // namespace rgs::test
