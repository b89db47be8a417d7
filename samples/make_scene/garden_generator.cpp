// garden_generator.cpp - lawn, path, plants and sky, filled with Gaussians whose means lie on a grid.
// SPDX-License-Identifier: Apache-2.0
//
// A Gaussian's index says whether it is ground, sky or a leaf, so that any part of the file shows the whole garden.
// Ground and sky follow Roberts' R2 sequence (2018), which leaves no holes; a leaf draws its plant and its place. Every
// random choice is a hash of (seed, i, purpose). Arithmetic is double with sqrt, cbrt, hypot, sin, cos and log from
// libm, rounded to the grid and to float at the end.
#include "garden_generator.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <vector>

#include "scene_cameras.hpp"
#include "scene_generator.hpp"
#include "scene_math.hpp"

namespace rgs {

using namespace detail;

namespace {

constexpr double kWalk = 12, kHedge = 28, kGround = 30, kFar = 200;  // metres from the middle; the path is 2 m wide
constexpr std::uint64_t kGroundEvery = 4, kSkyEvery = 64;            // of the Gaussians

struct Plant {
  Vec middle, axes;  // of an ellipsoid; the hedge has none
  Vec green, flower;
  double blooms;  // share of flowers among its outer leaves
};

struct Spot {
  Vec p, n, colour;  // n: unit normal
  double size;       // log of the scale along the surface
  double flat;       // log of its thickness in scales
  double spread;     // deviation of the scales' logs
  double logit;
};

double ground_height(double x, double z) {
  return 0.9 * noise(x / 7 + 3, z / 7 + 8);
}

Vec lit(const Vec& albedo, const Vec& n, double sun) {
  const Vec ambient = glm::mix(Vec{0.20, 0.19, 0.14}, Vec{0.38, 0.45, 0.56}, 0.5 + 0.5 * glm::dot(n, kUp));
  return albedo * (ambient + Vec{1.02, 0.93, 0.76} * sun);
}

}  // namespace

struct GardenGenerator::Layout {
  std::uint64_t seed;
  int sh_degree;
  double ground_size, sky_size, leaf_size;  // logs of scales
  std::vector<Plant> plants;                // the hedge last
  std::vector<double> up_to;                // [plants] share of the leaves in this plant and those before

  Layout(std::uint64_t scene_seed, std::uint64_t n, int degree);
  Spot ground(std::uint64_t j, const Dice& dice) const;
  Spot sky(std::uint64_t j, const Dice& dice) const;
  Spot leaf(const Dice& dice) const;
  Splat splat(std::uint64_t i) const;

 private:
  // R2: multiples of 1/g and 1/g^2, g = 1.3247..., as 64-bit fractions.
  double across(std::uint64_t j) const { return unit(seed + (j + 1) * 0xC13FA9A902A6328F); }
  double along(std::uint64_t j) const { return unit(mix(seed) + (j + 1) * 0x91E10DA5C79E7B1C); }
};

GardenGenerator::Layout::Layout(std::uint64_t scene_seed, std::uint64_t n, int degree)
    : seed(mix(scene_seed + kGolden)), sh_degree(degree) {
  const auto amount = static_cast<double>(std::max<std::uint64_t>(n, 1));
  ground_size = std::log(0.62 * kGround * std::sqrt(kPi * kGroundEvery / amount));
  sky_size = std::log(0.8 * kFar * std::sqrt(2 * kPi * kSkyEvery / amount));
  leaf_size = std::log(0.014 * std::cbrt(13.6e6 / amount));

  constexpr std::size_t kBeds = 110, kShrubs = 110;
  plants.reserve(kBeds + kShrubs + 1);
  up_to.reserve(kBeds + kShrubs + 1);
  constexpr std::array<Vec, 5> kFlowers{
      {{0.92, 0.80, 0.22}, {0.94, 0.92, 0.90}, {0.84, 0.22, 0.34}, {0.56, 0.38, 0.86}, {0.93, 0.52, 0.64}}};
  for (std::size_t k = 0; k < kBeds + kShrubs; ++k) {
    const Dice dice(mix(seed), k);
    const bool bed = k < kBeds;  // low, so that one sees over it
    const double wide = bed ? 0.4 + 0.5 * dice.uniform(Use::size) : 0.8 + 1.3 * dice.uniform(Use::size);
    const double high = wide * (bed ? 0.8 : 0.8 + 0.9 * dice.uniform(Use::lean));
    const double inner = bed ? 3.5 : 15.5, outer = bed ? 10 : 26;
    const double far = std::sqrt(std::lerp(inner * inner, outer * outer, dice.uniform(Use::place)));
    const Vec foot = turn(2 * kPi * dice.uniform(Use::spin)) * far;
    const Vec green = glm::mix(Vec{0.13, 0.31, 0.08}, Vec{0.40, 0.48, 0.13}, dice.uniform(Use::hue));
    plants.push_back({at(foot.x, ground_height(foot.x, foot.z) + 0.7 * high, foot.z), Vec{wide, high, wide}, green,
                      kFlowers[dice.bits(Use::tone) % kFlowers.size()],
                      bed ? 0.5 * dice.uniform(Use::rare) : std::max(0.0, 0.6 * dice.uniform(Use::rare) - 0.4)});
  }
  plants.push_back({Vec{0}, Vec{0}, Vec{0.12, 0.27, 0.09}, Vec{0}, 0});
  double total = 0;
  for (const Plant& plant : plants) up_to.push_back(total += plant.axes.x > 0 ? 3 * plant.axes.x : 2 * kHedge);
  for (double& share : up_to) share /= total;
}

Spot GardenGenerator::Layout::ground(std::uint64_t j, const Dice& dice) const {
  Vec p = turn(2 * kPi * across(j)) * (kGround * std::sqrt(along(j)));
  const double height = ground_height(p.x, p.z);
  const Vec n =
      glm::normalize(Vec{height - ground_height(p.x + 0.05, p.z), -0.05, height - ground_height(p.x, p.z + 0.05)});
  p.y = -height;
  double sun = std::max(0.0, glm::dot(n, kSun));
  for (const Plant& plant : std::span(plants).first(plants.size() - 1)) {  // shadows, where the plant is a unit ball
    const Vec to = (plant.middle - p) / plant.axes, ray = kSun / plant.axes;
    const double near = glm::dot(to, ray), miss2 = glm::dot(to, to) - near * near / glm::dot(ray, ray);
    if (near > 0 && miss2 < 1.5) sun *= 0.15 + 0.85 * smooth(miss2 - 0.5);
  }
  const bool path = std::abs(std::hypot(p.x, p.z) - kWalk) < 1 + 0.1 * noise(2 * p.x, 2 * p.z);
  const double grain = 0.85 + 0.3 * noise(3 * p.x, 3 * p.z) + 0.1 * dice.normal(Use::tone);
  const Vec lawn = glm::mix(Vec{0.20, 0.34, 0.09}, Vec{0.40, 0.46, 0.16}, fractal_noise(0.4 * p.x + 9, 0.4 * p.z + 4));
  const Vec albedo = (path ? Vec{0.66, 0.60, 0.50} : lawn) * grain;
  return {p, n, lit(albedo, n, sun), ground_size, -1.5, 0.3, 2 + 1.5 * dice.normal(Use::opacity)};
}

Spot GardenGenerator::Layout::sky(std::uint64_t j, const Dice& dice) const {
  const double height = std::lerp(-0.03, 1.0, along(j));  // cosine of the zenith angle
  const Vec d = turn(2 * kPi * across(j)) * std::sqrt(1 - height * height) + kUp * height;
  return {d * kFar, -d, sky_colour(d * kFar, kFar), sky_size, -2, 0.1, 4 + 0.5 * dice.normal(Use::opacity)};
}

Spot GardenGenerator::Layout::leaf(const Dice& dice) const {
  const auto at_plant = std::upper_bound(up_to.begin(), up_to.end() - 1, dice.uniform(Use::place)) - up_to.begin();
  const Plant& plant = plants[static_cast<std::size_t>(at_plant)];
  Vec p, n;
  double rim;  // 0 in the plant's middle, 1 at its surface
  if (plant.axes.x > 0) {
    rim = std::max(dice.uniform(Use::place, 1), dice.uniform(Use::place, 2));
    const Vec d = glm::normalize(dice.vector(Use::lean) + 1e-3);
    const Vec bumps = 2.2 * d + plant.middle;
    p = plant.middle + d * plant.axes * (rim * (0.75 + 0.4 * fractal_noise(bumps.x + bumps.y, bumps.z - bumps.y)));
    p.y = std::min(p.y, -2 * ground_height(p.x, p.z) - p.y);  // what is below the ground grows above it
    n = glm::normalize(d / plant.axes);
  } else {
    const double height = 2.5 * dice.uniform(Use::lean), deep = dice.uniform(Use::place, 1);
    const Vec away = turn(2 * kPi * dice.uniform(Use::place, 2));
    rim = std::max(1 - deep, height / 2.5);
    p = away * (kHedge + 1.4 * deep + 0.15 * dice.normal(Use::lean, 1));
    p.y = -ground_height(p.x, p.z) - height;
    n = height > 2.3 ? kUp : -away;
  }
  const bool flower = rim > 0.75 && dice.uniform(Use::rare) < plant.blooms;
  const double tone = 0.5 + 0.7 * noise(2.5 * (p.x + p.y), 2.5 * (p.z - p.y)) + 0.15 * dice.normal(Use::tone);
  const Vec albedo = flower ? plant.flower : plant.green * tone + Vec{0.08, 0.04, 0} * dice.uniform(Use::hue);
  const double sun = 0.3 + 0.7 * std::max(0.0, glm::dot(n, kSun)), dim = 0.3 + 0.7 * rim * rim;
  return {p, n, lit(albedo, n, sun) * dim, leaf_size, 0, 0.7, -0.6 + 2 * dice.normal(Use::opacity)};
}

Splat GardenGenerator::Layout::splat(std::uint64_t i) const {
  const Dice dice(seed, i);
  const bool on_ground = i % kGroundEvery == 0, in_sky = i % kSkyEvery == 1;
  const Spot spot = on_ground ? ground(i / kGroundEvery, dice) : in_sky ? sky(i / kSkyEvery, dice) : leaf(dice);
  Splat out;
  for (int k = 0; k < 3; ++k) {
    out.mean[k] = kGardenStep * static_cast<float>(std::floor(spot.p[k] / kGardenStep + 0.5));
    const double size = spot.size + spot.spread * dice.normal(Use::size, static_cast<std::uint64_t>(k));
    out.log_scale[k] = static_cast<float>(k == 2 ? size + spot.flat : size);
  }
  const Vec n = on_ground || in_sky ? spot.n : glm::normalize(dice.vector(Use::tilt) + 1e-3);
  const Vec t = glm::normalize(glm::cross(n, dice.vector(Use::spin) + 1e-3));
  set_rotation(t, glm::cross(n, t), n, 0.6 + 0.8 * dice.uniform(Use::spin_sign), out.rotation);
  out.opacity_logit = static_cast<float>(spot.logit);
  Shine shine{spot.colour, spot.n};
  shine.noise = in_sky ? 0.3 : 0.6;
  set_harmonics(shine, dice, sh_degree, out.sh);
  return out;
}

GardenGenerator::GardenGenerator(std::uint64_t seed, std::uint64_t n, int sh_degree)
    : layout_(std::make_shared<const Layout>(seed, n, sh_degree)) {
  assert(n <= kMaxSceneGaussians && sh_degree >= 0 && sh_degree <= kMaxShDegree);
}

void GardenGenerator::generate(std::uint64_t first, std::span<Splat> out) const {
  for (std::size_t k = 0; k < out.size(); ++k) out[k] = layout_->splat(first + k);
}

std::string garden_cameras_json(int width, int height, const Origin& origin) {
  std::array<View, 8> views{};
  for (std::size_t k = 0; k < views.size(); ++k) {
    const Vec p = turn(kPi / 4 * static_cast<double>(k)) * kWalk;
    views[k] = {at(p.x, ground_height(p.x, p.z) + 1.8, p.z), at(0, ground_height(0, 0) + 0.5, 0)};
  }
  return camera_list_json(views, width, height, origin);
}

}  // namespace rgs
