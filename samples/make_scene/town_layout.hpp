// town_layout.hpp - the plan of the synthetic town: streets, plots, houses and trees as a list of surfaces.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "scene_math.hpp"

namespace rgs::detail {

/// A surface's material; town_generator.cpp defines its look.
enum class Stuff : std::uint8_t {
  plaster,
  brick,
  trim,  // painted wood, metal, concrete
  glass,
  door,
  tiles,
  slate,
  gravel,  // also flat roofs
  asphalt,
  paving,
  lawn,
  leaves,
  bark,
  water,
  car,
  field,
  hill,
  sky,
  floater
};

/// A surface of the town and its share of the block's Gaussians, which goes by area * detail.
struct Part {
  enum class Shape : std::uint8_t {
    quad,       // corners: lower left, lower right, upper right, upper left as seen from outside
    ellipsoid,  // centre, semi-axes
    cone,       // foot, (radius at the foot, radius at the top, height)
    fog,        // middle of the foot, half sizes and height
    country,    // fields around the town, of one sector
    ridge,      // hills, of one sector; corner[1] = (distance, height, number)
    dome        // sky, of one sector
  };
  Shape shape;
  Stuff stuff;
  std::array<Vec, 4> corner{};
  Vec colour;
  double detail;        // Gaussians per area, relative
  double s = 0, r = 0;  // where the texture's coordinates begin, metres
  double eaves = 0;     // height of a wall
  std::uint64_t salt = 0;
  double area = 0;  // square metres
};

/// A shadow caster: a ball, or a convex body within it.
struct Caster {
  Vec centre;
  double radius;
  std::uint32_t first_side = 0, n_sides = 0;  // in Block::sides; no sides: a ball
};

struct Box {
  Vec low{1e30}, high{-1e30};
};

struct Block {
  std::vector<Part> parts;
  std::vector<Caster> casters;
  std::vector<HalfSpace> sides;
};

/// Streets run between the points crossing(i, j); block (i, j) lies between crossings (i, j) and (i + 1, j + 1). They
/// exist for any i and j: a larger town contains the smaller one.
class TownPlan {
 public:
  explicit TownPlan(std::uint64_t seed) : seed_(seed) {}

  static constexpr double kPitchX = 78, kPitchZ = 64;  // metres from street to street

  /// On the ground, in the middle of the streets.
  Vec crossing(int i, int j) const;
  Block block(int i, int j) const;
  /// Sector `sector` of kSectors around a town of blocks first .. last - 1 both ways: trees, and fields, hills
  /// and sky with the weight `backdrop` together, whatever their area.
  Block surroundings(int first, int last, int sector, double backdrop) const;
  static constexpr int kSectors = 8;
  static constexpr double kFar = 5000;  // radius of the sky, metres

 private:
  std::uint64_t seed_;
};

/// Distance from the middle of the town to its edge in direction (x, z), a little inside, for blocks first .. last - 1.
double edge_distance(int first, int last, double x, double z);

/// Contains the means of all Gaussians of the part.
Box part_box(const Part& part);

}  // namespace rgs::detail
