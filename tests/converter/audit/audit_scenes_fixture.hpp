// audit_scenes_fixture.hpp - a small scene, its cameras and its files, for the tests of rgs-audit.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <cmath>
#include <fstream>
#include <numeric>
#include <span>
#include <string>
#include <vector>

#include "golden_scenes.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "text_file.hpp"

namespace rgs::test {

/// A ball of n Gaussians around the origin that fills a picture, the same on every machine.
inline SplatCloud audit_cloud(std::uint64_t n = 700, int sh_degree = 3, std::uint64_t seed = 5) {
  SplitMix random(seed);
  SplatCloud cloud;
  cloud.resize(n, sh_degree);
  for (std::uint64_t i = 0; i < n; ++i) {
    Splat s;
    for (float& x : s.mean) x = random.dyadic(-1, 1);
    for (float& x : s.log_scale) x = random.dyadic(-4, -2);
    for (float& x : s.rotation) x = random.dyadic(-1, 1) + 0x1p-13F;
    s.opacity_logit = random.dyadic(-3, 4);
    for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) s.sh[k] = random.dyadic(-1, 1) * (k < 3 ? 1.5F : 0.2F);
    cloud.set(i, s);
  }
  return cloud;
}

inline std::string write_ply(const std::string& path, const SplatCloud& cloud, const Origin& origin = kNoOrigin) {
  Declarations stated;
  stated.origin = origin;
  auto writer = PlyWriter::create(path, cloud.size(), cloud.sh_degree, {.overwrite = true, .sync = false}, stated);
  REQUIRE(writer);
  std::vector<Splat> splats;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) splats.push_back(cloud.view().splat(i));
  REQUIRE(writer->write(0, splats));
  REQUIRE(writer->commit());
  return path;
}

inline std::string write_bytes(const std::string& path, std::span<const std::byte> bytes) {
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  return path;
}
/// Writes the file with levels at `from` to `to` after change(levels), with sound hashes.
template <class Change>
std::string with_changed_levels(const std::string& from, const std::string& to, const Change& change) {
  const auto mapped = MappedFile::open(from);
  REQUIRE(mapped);
  const auto file = PagedFile::open(mapped->bytes());
  REQUIRE(file);
  std::vector<std::uint32_t> all(file->n_pages());
  std::iota(all.begin(), all.end(), 0U);
  lod::Levels levels{read_pages(*file, all).value(), file->pages(), file->quality_db()};
  change(levels);
  EncodeOptions options;
  options.order = Order::input;
  std::vector<std::byte> bytes;
  REQUIRE(write_levels(levels, options, bytes));
  return write_bytes(to, bytes);
}

inline std::string write_rgs(const std::string& path, const SplatCloud& cloud, const EncodeOptions& options = {}) {
  const auto bytes = encode(cloud.view(), options);
  REQUIRE(bytes);
  return write_bytes(path, *bytes);
}

/// Cameras "a.png", "b.png", ... that look along +z from depth -depths[i] before or behind the ball around `origin`.
inline std::string write_cameras(const std::string& path, std::span<const double> depths, int width = 96,
                                 int height = 72, const Origin& origin = kNoOrigin) {
  std::string text = "[";
  for (std::size_t i = 0; i < depths.size(); ++i) {
    text += std::string(i == 0 ? "" : ",") + R"({"name":")" + std::string(1, static_cast<char>('a' + i)) +
            R"(.png","split":"test","width":)" + std::to_string(width) + R"(,"height":)" + std::to_string(height) +
            R"(,"fx":90,"fy":90,"world_to_camera":[[1,0,0,)" + std::to_string(-origin[0]) + R"(],[0,1,0,)" +
            std::to_string(-origin[1]) + R"(],[0,0,1,)" + std::to_string(depths[i] - origin[2]) + R"(],[0,0,0,1]]})";
  }
  std::ofstream(path) << text << "]";
  return path;
}

/// n cameras in front of the ball, each farther away.
inline std::string write_cameras(const std::string& path, int n, int width = 96, int height = 72,
                                 const Origin& origin = kNoOrigin) {
  std::vector<double> depths;
  for (int i = 0; i < n; ++i) depths.push_back(2.5 + 0.5 * i);
  return write_cameras(path, depths, width, height, origin);
}

}  // namespace rgs::test
