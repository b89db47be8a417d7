// micro_scene_fixture.hpp - the conformance scenes in memory, and pictures of them by rules.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <string>
#include <utility>
#include <vector>

#include "conformance.hpp"
#include "judge.hpp"
#include "rgs/scene.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs::test {

struct Micro {
  MicroScene scene;
  Scene defined, stored;

  explicit Micro(MicroScene micro) : scene(std::move(micro)) {
    SplatCloud cloud;
    cloud.resize(scene.gaussians.size(), scene.sh_degree);
    for (std::size_t i = 0; i < scene.gaussians.size(); ++i) cloud.set(i, scene.gaussians[i]);
    stored = load(cloud);
    convert_axes(cloud, scene.declared.axes, {Axis::right, Axis::down, Axis::forward});
    defined = load(cloud);
  }
  judge::Scenes scenes() const { return {defined.view().value(), stored.view().value()}; }
  judge::Rules rules() const { return judge::definition(scene.declared, kMicroNearPlane); }
  /// As a program of these rules shows it, in 8 bits.
  std::vector<judge::Shown> shown(const judge::Rules& rules) const {
    std::vector<judge::Shown> pictures;
    for (const Camera& camera : scene.cameras) {
      Image image = judge::draw((rules.ignores_axes ? stored : defined).view().value(), camera, rules,
                                pictures.empty() ? camera : pictures.back().camera);
      for (float& v : image.pixels) v = static_cast<float>(to_8bit(v)) / 255;
      pictures.push_back({camera, std::move(image)});
    }
    return pictures;
  }

 private:
  Scene load(const SplatCloud& cloud) const {
    auto loaded = Scene::load(cloud, scene.declared);
    REQUIRE(loaded);
    return *std::move(loaded);
  }
};

inline std::vector<Micro> micro_fixtures() {
  std::vector<Micro> all;
  for (MicroScene& scene : micro_scenes()) all.emplace_back(std::move(scene));
  return all;
}

/// The scene of this number, "05".
inline Micro micro_fixture(const std::string& number) {
  for (MicroScene& scene : micro_scenes())
    if (scene.name.starts_with(number)) return Micro(std::move(scene));
  FAIL("there is no scene ", number);
  return Micro(MicroScene{});
}

}  // namespace rgs::test
