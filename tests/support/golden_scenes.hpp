// golden_scenes.hpp - the scenes and options of tests/golden, made by integer arithmetic alone.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/encode.hpp"

namespace rgs::test {

/// SplitMix64 (Steele et al. 2014): the same numbers on every machine, unlike the distributions of <random>.
class SplitMix {
 public:
  explicit SplitMix(std::uint64_t seed) : state_(seed) {}
  std::uint64_t bits() {
    std::uint64_t z = state_ += 0x9E3779B97F4A7C15u;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9u;
    z = (z ^ z >> 27) * 0x94D049BB133111EBu;
    return z ^ z >> 31;
  }
  std::uint64_t below(std::uint64_t n) { return bits() % n; }
  /// A multiple of 2^-12 in [low, high), whose bounds are multiples too: exact in FP32 up to magnitude 4096.
  float dyadic(int low, int high) {
    const auto steps = static_cast<std::uint64_t>(high - low) * 4096;
    return static_cast<float>(low) + static_cast<float>(below(steps)) / 4096.f;
  }

 private:
  std::uint64_t state_;
};

/// n Gaussians of a small scene: dyadic numbers whose codes keep away from rounding boundaries of exp.
inline SplatCloud golden_cloud(std::uint64_t n, int sh_degree, std::uint64_t seed) {
  SplitMix random(seed);
  SplatCloud cloud;
  cloud.resize(n, sh_degree);
  for (std::uint64_t i = 0; i < n; ++i) {
    Splat s;
    for (float& x : s.mean) x = random.dyadic(-8, 8);
    for (float& x : s.log_scale) x = random.dyadic(-7, 0);
    for (float& x : s.rotation) x = random.dyadic(-1, 1);
    s.opacity_logit = random.dyadic(-6, 6);
    for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) {
      const float fall[4] = {2.f, 0.5f, 0.25f, 0.125f};
      s.sh[k] = random.dyadic(-1, 1) * fall[sh_degree_of(k / 3)];
    }
    cloud.set(i, s);
  }
  return cloud;
}

/// Two Gaussians whose every stored value is known by hand; docs/format/FORMAT_EXAMPLE.md prints their file.
inline SplatCloud two_cloud() {
  SplatCloud cloud;
  cloud.resize(2, 0);
  Splat first;
  first.mean[0] = 1.f, first.mean[1] = -2.f, first.mean[2] = 0.5f;
  first.opacity_logit = 0.f;                                   // opacity 0.5
  first.sh[0] = 127.f, first.sh[1] = -127.f, first.sh[2] = 0;  // steps 1, 1, 0
  cloud.set(0, first);                                         // log-scale 0: scale 1; rotation 1 0 0 0
  Splat second;
  second.mean[0] = -3.f, second.mean[1] = 4.f, second.mean[2] = 0.25f;
  second.rotation[0] = -3.f, second.rotation[1] = 0.f, second.rotation[2] = 4.f, second.rotation[3] = 0.f;
  second.opacity_logit = 20.f;               // opacity 1 after rounding
  second.sh[0] = 2.5f, second.sh[1] = 3.5f;  // ties: codes 2 and 4
  cloud.set(1, second);
  return cloud;
}

struct GoldenScene {
  std::string name;  ///< tests/golden/NAME.rgs
  SplatCloud cloud;
  EncodeOptions options;
  bool earlier = false;  ///< written by an earlier version with options of its own: still read, no longer written
};

/// The defaults of format 1.0's first files.
inline EncodeOptions golden_options() {
  EncodeOptions options;
  options.depth_mapping = DepthMapping::linear;
  return options;
}

inline std::vector<GoldenScene> golden_scenes() {
  std::vector<GoldenScene> scenes;
  scenes.push_back({"empty", golden_cloud(0, 1, 0), golden_options()});
  scenes.push_back({"two", two_cloud(), golden_options()});
  scenes.back().options.order = Order::input;
  scenes.back().options.depth = DepthRange{0.25f, 64.f, DepthSource::by_hand};
  scenes.push_back({"degree0", golden_cloud(5, 0, 10), golden_options()});
  scenes.push_back({"degree1", golden_cloud(7, 1, 11), golden_options()});
  scenes.back().options.depth = DepthRange{0.5f, 32.f, DepthSource::cameras};
  scenes.back().options.depth_mapping = DepthMapping::logarithmic;
  scenes.back().options.aa_mode = AaMode::mip_splatting;
  scenes.back().options.low_pass_px2 = 0.3f;
  scenes.back().options.axes = {Axis::right, Axis::up, Axis::backward};
  scenes.back().options.colour_space = ColourSpace::linear_display;
  scenes.back().options.metres_per_unit = 0.5f;
  scenes.push_back({"degree2", golden_cloud(9, 2, 12), golden_options()});
  scenes.back().options.axes = {Axis::undeclared, Axis::undeclared, Axis::undeclared};
  scenes.back().options.colour_space = ColourSpace::undeclared;
  scenes.back().options.aa_mode = AaMode::undeclared;
  scenes.push_back({"degree3", golden_cloud(40, 3, 13), golden_options()});
  scenes.back().options.chunk_size = 32;
  scenes.push_back({"global", golden_cloud(40, 1, 14), golden_options()});
  scenes.back().options.chunk_size = 32;
  scenes.back().options.chunk_step_sets = false;
  scenes.push_back({"optional", golden_cloud(6, 0, 15), golden_options()});
  scenes.back().options.keep_permutation = true;
  scenes.back().options.provenance = Provenance{1234, 0x0123456789ABCDEFu, "garden.ply", "golden 1"};
  scenes.push_back({"origin", golden_cloud(40, 1, 25), golden_options()});
  scenes.back().options.chunk_size = 32;
  scenes.back().options.origin = {4201984.125, -1e12, 0.1};
  {
    // The ends of every range: FP16 zero and subnormal scales, opacity 0 and 1, absent SH, an outlier, dropped input.
    SplatCloud cloud = golden_cloud(250, 1, 16);
    for (std::size_t i = 0; i < 30; ++i) cloud.log_scale[i] = static_cast<float>(i) - 29.f;
    cloud.log_scale[750 - 1] = 3.f;
    cloud.opacity_logit[0] = 30.f, cloud.opacity_logit[1] = -30.f, cloud.opacity_logit[2] = 8.f;
    cloud.opacity_logit[3] = -16.f;
    for (std::size_t i = 0; i < cloud.sh.size(); i += 3) cloud.sh[i] = 0.f;
    cloud.mean[0] = 65536.f;
    cloud.mean[7] = -0.f;
    cloud.rotation[0] = -0.f;
    cloud.sh[13] = 1024.f;
    cloud.opacity_logit[200] = std::numeric_limits<float>::quiet_NaN();  // dropped
    scenes.push_back({"edges", std::move(cloud), golden_options()});
    scenes.back().options.chunk_size = 64;
    scenes.back().options.keep_permutation = true;
  }
  // The same in coded sections, with enough Gaussians for lanes that cross chunks and for an incomplete one.
  for (const char* name : {"empty", "degree0", "degree1", "global", "edges", "origin"}) {
    scenes.push_back(*std::ranges::find(scenes, name, &GoldenScene::name));
    scenes.back().name = "packed_" + scenes.back().name;
    scenes.back().options.profile = Profile::packed;
  }
  scenes.push_back({"packed_degree3", golden_cloud(300, 3, 18), golden_options()});
  scenes.back().options.profile = Profile::packed;
  scenes.back().options.chunk_size = 32;
  scenes.back().options.provenance = Provenance{1234, 0x0123456789ABCDEFu, "garden.ply", "golden 1"};
  scenes.push_back({"packed_degree2", golden_cloud(130, 2, 19), golden_options()});
  scenes.back().options.profile = Profile::packed;
  // Lossy: every degree, one Gaussian, several chunks, and distant means. Options are spelled out, because presets may
  // change. archive_*: Codec::archive_draco; archive3_*: Codec::archive.
  const std::uint64_t counts[] = {5, 1, 70, 300};
  for (const char* name : {"archive_degree", "archive3_degree"}) {
    for (int degree = 0; degree <= kMaxShDegree; ++degree) {
      scenes.push_back({name + std::to_string(degree),
                        golden_cloud(counts[degree], degree, 21 + static_cast<std::uint64_t>(degree)),
                        golden_options()});
      scenes.back().earlier = std::string_view(name) == "archive_degree";
      EncodeOptions& options = scenes.back().options;
      options.profile = Profile::archive;
      options.keep_permutation = true;
      options.chunk_size = 32;
      options.archive.step = 0.7f;
    }
    scenes.back().cloud.mean[30] = 65536.f;
    scenes.back().cloud.mean[91] = -300.f;
  }
  scenes.push_back({"crs", golden_cloud(6, 1, 26), golden_options()});
  scenes.back().options.origin = {4201984.125, 168424.5, 4780209.25};
  scenes.back().options.crs = {"GEODCRS[\"Z\u00fcrich \U0001f30d\", CS[Cartesian, 3]]",
                               {Axis::right, Axis::forward, Axis::up}};
  scenes.push_back({"first_view", golden_cloud(6, 0, 27), golden_options()});
  scenes.back().options.first_view = {ViewKind::inside, {1.5F, -2, 0.25F}, {-3, -1.5F, 8}, {0.6F, -0.8F, 0}, 75};
  return scenes;
}

}  // namespace rgs::test
