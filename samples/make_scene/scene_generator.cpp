// scene_generator.cpp - house, garden and sky as analytic surfaces, sampled, shaded and turned into Gaussians.
// SPDX-License-Identifier: Apache-2.0
//
// The scene is a list of parts. A part is a surface, a material and a share of the n Gaussians in proportion to
// area * detail. Gaussian i is renamed by a bijection of [0, n) (files of trained scenes have no order), which
// gives its part and its number j within it; j places it on the surface by Roberts' R2 sequence (2018), whose points
// keep their distance, so that few splats cover much. Every other choice is a hash of (seed, i, purpose): no state,
// hence random access. Arithmetic is double with sqrt, sin, cos, log and exp from libm, rounded to float at the end.
#include "scene_generator.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <iterator>
#include <numeric>
#include <vector>

#include "scene_cameras.hpp"
#include "scene_math.hpp"

namespace rgs {

using namespace detail;

namespace {

constexpr double kFar = 300;         // radius of the sky, metres
constexpr double kGardenRadius = 6;  // the ground is sampled evenly up to here and ever coarser outside

// ---- surfaces --------------------------------------------------------------------------------------------------

enum class Shape { quad, triangle, ellipsoid, cone, half_ring, disc, far_disc, ridge, dome, line, fog };
enum class Material {
  brick,
  tile_roof,
  slate_roof,
  stone,
  bark,
  wood,
  paint,
  glass,
  polished,
  ground,
  grass,
  leaf,
  hill,
  sky,
  floater
};

struct Part {
  Shape shape;
  Material material;
  Vec origin;       // corner, centre or foot
  Vec a{}, b{};     // edges; semi-axes; (radius at foot, radius at top, height); (inner, outer radius, 0)
  double detail;    // splats per area, relative
  double area = 0;  // square metres; sqrt(area / count) is the distance between neighbours
  std::uint64_t first = 0, count = 0;
};

// A point of a surface. Unit normal n, unit tangent t at right angles to it; (s, r) are texture coordinates in metres.
struct Point {
  Vec p, n, t;
  double spacing, s, r;
};

double part_area(const Part& part) {
  const Vec &a = part.a, &b = part.b;
  switch (part.shape) {
    case Shape::quad: return glm::length(glm::cross(a, b));
    case Shape::triangle: return glm::length(glm::cross(a, b)) / 2;
    case Shape::ellipsoid: return 4 * kPi * (a.x * a.y + a.y * a.z + a.z * a.x) / 3;
    case Shape::cone: return kPi * (a.x + a.y) * std::hypot(a.x - a.y, a.z);
    case Shape::half_ring: return 2 * kPi * kPi * a.x * a.y;
    case Shape::disc: return kPi * (a.y * a.y - a.x * a.x);
    case Shape::line: return glm::length(a) * 0.1;
    // The background gets its share in trained outdoor scenes, whatever its true area.
    case Shape::far_disc: return 30;
    case Shape::ridge: return 10;
    case Shape::dome: return 16;
    case Shape::fog: return 4;
  }
  return 0;
}

// (u, v) in [0, 1)^2 to the surface.
Point sample(const Part& part, double u, double v, const Dice& dice) {
  const Vec &o = part.origin, &a = part.a, &b = part.b;
  const double spacing = std::sqrt(part.area / static_cast<double>(part.count));
  switch (part.shape) {
    case Shape::triangle:
      if (u + v > 1) {
        u = 1 - u;
        v = 1 - v;
      }
      [[fallthrough]];
    case Shape::quad: {
      const double wide = glm::length(a);
      return {o + u * a + v * b, glm::normalize(glm::cross(a, b)), a / wide, spacing, u * wide, v * glm::length(b)};
    }
    case Shape::ellipsoid: {
      const double y = 1 - 2 * v, ring = std::sqrt(std::max(0.0, 1 - y * y));
      const Vec d = turn(2 * kPi * u) * ring + kUp * y, n = glm::normalize(d / a);
      return {o + d * a, n, any_tangent(n), spacing, u * 2 * kPi * a.x, v * 2 * a.y};
    }
    case Shape::cone: {
      // Uniform in area: the radius is linear in the height, so the height is the root of a quadratic.
      const double r0 = a.x, r1 = a.y, radius = std::sqrt(r0 * r0 + v * (r1 * r1 - r0 * r0));
      const double t = std::abs(r1 - r0) < 1e-9 ? v : (radius - r0) / (r1 - r0);
      const Vec out = turn(2 * kPi * u), n = glm::normalize(out * a.z + kUp * (r0 - r1));
      return {o + out * radius + kUp * (t * a.z), n,      glm::cross(n, glm::normalize(glm::cross(out, kUp))), spacing,
              u * 2 * kPi * std::max(r0, r1),     t * a.z};
    }
    case Shape::half_ring: {
      const double big = kPi * u, small = 2 * kPi * v;
      const Vec out{std::cos(big), -std::sin(big), 0}, n = out * std::cos(small) + Vec{0, 0, std::sin(small)};
      return {o + out * a.x + n * a.y, n, Vec{std::sin(big), std::cos(big), 0}, spacing, big * a.x, small * a.y};
    }
    case Shape::disc: {
      const double radius = std::sqrt(std::lerp(a.x * a.x, a.y * a.y, v));
      const Vec p = o + turn(2 * kPi * u) * radius;
      return {p, kUp, {1, 0, 0}, spacing, p.x, p.z};
    }
    case Shape::far_disc: {
      const double ratio = std::log(a.y / a.x), radius = a.x * std::exp(ratio * v);
      const Vec p = o + turn(2 * kPi * u) * radius;
      return {p, kUp, {1, 0, 0}, radius * std::sqrt(2 * kPi * ratio / static_cast<double>(part.count)), p.x, p.z};
    }
    case Shape::ridge: {
      const double phi = 2 * kPi * u;
      const Vec out = turn(phi);
      const double crest = a.y * ridge_height(phi, a.z);
      return {o + out * (a.x + 1.5 * crest * v) + kUp * (crest * v),
              glm::normalize(1.5 * kUp - out),
              Vec{-out.z, 0, out.x},
              std::sqrt(2 * kPi * a.x * crest * 1.8 / static_cast<double>(part.count)),
              phi,
              v};
    }
    case Shape::dome: {
      const double height = std::lerp(-0.03, 1.0, v);  // cosine of the zenith angle
      const Vec d = turn(2 * kPi * u) * std::sqrt(1 - height * height) + kUp * height;
      return {
          o + d * kFar, -d, any_tangent(d), kFar * std::sqrt(2 * kPi * 1.03 / static_cast<double>(part.count)), u, v};
    }
    case Shape::line: {
      const Vec t = glm::normalize(a), n = any_tangent(t);
      const double radius = std::lerp(b.x, b.y, u), phi = 2 * kPi * v;
      const Vec out = n * std::cos(phi) + glm::cross(t, n) * std::sin(phi);
      return {o + a * u + out * radius, out, t, spacing, u, v};
    }
    case Shape::fog: {
      const Vec p = o + Vec{(2 * u - 1) * a.x, -dice.uniform(Use::place) * a.y, (2 * v - 1) * a.z};
      const Vec n = glm::normalize(dice.vector(Use::tilt) + 1e-3);
      return {p, n, any_tangent(n), 0.3 * spacing + 0.05, u, v};
    }
  }
  return {};
}

// ---- light and materials ---------------------------------------------------------------------------------------

struct Ball {
  Vec centre;
  double radius;
};

// A ball seen from the sun: right and up in a plane that faces the sun, depth towards the sun.
struct Shade {
  double right, up, depth, radius;
};

bool paved(double x, double z) {
  return (std::abs(x) < 2.3 && z > -1.5 && z < 2.5) || (std::abs(x) < 0.62 && z > -5.2 && z <= -1.5);
}

struct Look {
  Vec albedo;
  double gloss = 0;  // share of mirror reflection
};

Look look(Material material, const Point& q, const Part& part, const Dice& dice) {
  const double tone = dice.normal(Use::tone);
  switch (material) {
    case Material::brick: {
      const Cell c = cell(q.s, q.r, 0.30, 0.125);
      if (c.x < 0.09 || c.y < 0.20) return {Vec{0.78, 0.73, 0.66} + 0.02 * tone};
      return {glm::mix(Vec{0.58, 0.22, 0.14}, Vec{0.80, 0.42, 0.28}, c.tone) * (1 + 0.04 * tone)};
    }
    case Material::tile_roof: {
      const Cell c = cell(q.s, q.r, 0.17, 0.15);
      const double bulge = 0.72 + 0.38 * std::sqrt(std::max(0.0, 4 * c.x * (1 - c.x))) - 0.22 * (c.y > 0.84);
      return {glm::mix(Vec{0.62, 0.23, 0.12}, Vec{0.78, 0.36, 0.17}, c.tone) * bulge, 0.03};
    }
    case Material::slate_roof: {
      const Cell c = cell(q.s, q.r, 0.16, 0.15);
      return {glm::mix(Vec{0.20, 0.25, 0.34}, Vec{0.34, 0.40, 0.50}, c.tone) * (c.x < 0.1 || c.y < 0.14 ? 0.6 : 1.0),
              0.05};
    }
    case Material::stone: {
      const Cell c = cell(q.s, q.r, 0.30, 0.20);
      const double joint = c.x < 0.06 || c.y < 0.09 ? 0.72 : 1;
      return {Vec{0.72, 0.69, 0.62} * (joint * (0.78 + 0.22 * c.tone + 0.14 * fractal_noise(9 * q.s, 9 * q.r)))};
    }
    case Material::bark: return {Vec{0.36, 0.26, 0.18} * (0.7 + 0.6 * noise(40 * q.s, 6 * q.r))};
    case Material::wood: {
      const double plank = q.s / 0.12 - std::floor(q.s / 0.12);
      return {Vec{0.34, 0.20, 0.10} * (plank < 0.1 ? 0.5 : 0.9 + 0.25 * noise(50 * q.s, 5 * q.r))};
    }
    case Material::paint: return {Vec{0.93, 0.92, 0.88}, 0.02};
    case Material::glass: return {Vec{0.06, 0.10, 0.15}, 0.45};
    case Material::polished: return {Vec{0.55, 0.10, 0.12} * (0.85 + 0.3 * fractal_noise(3 * q.s, 3 * q.r)), 0.45};
    case Material::ground: {
      if (paved(q.p.x, q.p.z)) {
        const auto i = static_cast<std::int64_t>(std::floor(q.p.x / 0.4 + 0.5)),
                   j = static_cast<std::int64_t>(std::floor(q.p.z / 0.4));
        const double x = q.p.x / 0.4 + 0.5 - static_cast<double>(i), z = q.p.z / 0.4 - static_cast<double>(j);
        if (std::min(x, z) < 0.06) return {Vec{0.40, 0.38, 0.34}};
        const Vec base = ((i + j) & 1) != 0 ? Vec{0.80, 0.75, 0.66} : Vec{0.56, 0.50, 0.44};
        return {base * (0.88 + 0.2 * lattice(i, j)), 0.04};
      }
      const double patch = fractal_noise(0.7 * q.p.x + 9, 0.7 * q.p.z + 4);
      return {glm::mix(Vec{0.20, 0.33, 0.09}, Vec{0.42, 0.46, 0.17}, patch) * (0.9 + 0.1 * tone)};
    }
    case Material::grass: {
      const double patch = fractal_noise(0.7 * q.p.x + 9, 0.7 * q.p.z + 4);
      const double bloom = noise(0.9 * q.p.x + 60, 0.9 * q.p.z);
      if (dice.uniform(Use::rare, 1) < 0.25 * smooth(4 * bloom - 2.4)) {
        constexpr std::array<Vec, 4> kFlowers{
            {{0.95, 0.85, 0.25}, {0.95, 0.95, 0.92}, {0.85, 0.25, 0.35}, {0.6, 0.45, 0.9}}};
        return {kFlowers[dice.bits(Use::hue) % kFlowers.size()]};
      }
      return {glm::mix(Vec{0.24, 0.42, 0.10}, Vec{0.52, 0.58, 0.20}, patch) * (0.95 + 0.16 * tone)};
    }
    case Material::leaf: {
      const double kind = lattice(static_cast<std::int64_t>(std::floor(64 * part.origin.x)), 7);
      const Vec green = glm::mix(Vec{0.15, 0.34, 0.08}, Vec{0.44, 0.50, 0.12}, kind);
      return {green * (1 + 0.2 * tone) + Vec{0.10, 0.05, 0} * dice.uniform(Use::hue), 0.03};
    }
    case Material::hill: {
      const double haze = part.a.z / 3, wood = noise(90 * q.s, 12 * q.r);
      return {glm::mix(glm::mix(Vec{0.20, 0.36, 0.14}, Vec{0.36, 0.46, 0.20}, wood), Vec{0.56, 0.68, 0.80},
                       0.25 + 0.6 * haze)};
    }
    case Material::sky: return {sky_colour(q.p, kFar)};
    case Material::floater: return {Vec{0.55, 0.55, 0.5} + 0.2 * dice.vector(Use::hue)};
  }
  return {};
}

}  // namespace

// ---- the scene -------------------------------------------------------------------------------------------------

struct SceneGenerator::Layout {
  std::uint64_t seed = 0, n = 0;
  std::uint64_t stride = 1, shift = 0;  // i -> (i * stride + shift) mod n; n < 2^28, so the product fits
  std::vector<Part> parts;
  std::vector<Shade> shades;     // cast shadows
  std::vector<HalfSpace> house;  // convex body of walls and roof; casts a shadow

  Layout(std::uint64_t scene_seed, std::uint64_t count);
  Splat splat(std::uint64_t i, int sh_degree) const;

 private:
  void add(Shape shape, Material material, double detail, const Vec& origin, const Vec& a, const Vec& b = Vec{0}) {
    parts.push_back({shape, material, origin, a, b, detail});
  }
  void add_shade(const Ball& ball) {
    shades.push_back(
        {glm::dot(ball.centre, kSunRight), glm::dot(ball.centre, kSunUp), glm::dot(ball.centre, kSun), ball.radius});
  }
  void add_window(const Vec& centre, const Vec& right, const Vec& up);
  void add_tree(double x, double z, double height, double crown, const Dice& dice);
  void build_house();
  void build_garden();
  double sunlight(const Vec& p) const;
};

void SceneGenerator::Layout::add_window(const Vec& centre, const Vec& right, const Vec& up) {
  const Vec out = glm::normalize(glm::cross(right, up));
  const double w = glm::length(right), h = glm::length(up);
  add(Shape::quad, Material::glass, 13, centre - right / 2.0 - up / 2.0 + 0.04 * out, right, up);
  const auto bar = [&](double x, double y, double wide, double high) {  // centre and size as shares of the window
    const Vec a = right * wide, b = up * high;
    add(Shape::quad, Material::paint, 36, centre + right * x + up * y - a / 2.0 - b / 2.0 + 0.06 * out, a, b);
  };
  const double tx = 0.05 / w, ty = 0.05 / h;
  bar(-0.5, 0, tx, 1 + ty);
  bar(0.5, 0, tx, 1 + ty);
  bar(0, -0.5, 1 + 2 * tx, 1.4 * ty);
  bar(0, 0.5, 1 + tx, ty);
  bar(0, 0, 0.7 * tx, 1);
  bar(0, 0, 1, 0.7 * ty);
}

void SceneGenerator::Layout::build_house() {
  constexpr double kX = 1.5, kFront = -0.3, kBack = 1.7, kEaves = 1.6, kRidge = 2.75, kOver = 0.22;
  constexpr double kMiddle = (kFront + kBack) / 2, kHalf = (kBack - kFront) / 2, kRise = kRidge - kEaves;
  const Vec right{1, 0, 0}, forward{0, 0, 1};
  add(Shape::quad, Material::brick, 13, at(-kX, 0, kFront), 2 * kX * right, kEaves * kUp);
  add(Shape::quad, Material::brick, 10, at(kX, 0, kBack), -2 * kX * right, kEaves * kUp);
  add(Shape::quad, Material::brick, 13, at(-kX, 0, kBack), -2 * kHalf * forward, kEaves * kUp);
  add(Shape::quad, Material::brick, 10, at(kX, 0, kFront), 2 * kHalf * forward, kEaves * kUp);
  add(Shape::triangle, Material::brick, 13, at(-kX, kEaves, kBack), -2 * kHalf * forward,
      -kHalf * forward + kRise * kUp);
  add(Shape::triangle, Material::brick, 10, at(kX, kEaves, kFront), 2 * kHalf * forward, kHalf * forward + kRise * kUp);
  // Roof planes overhang walls and gables; the ridge is 4 cm above the gables' tips.
  const double slope = kRise / kHalf, drop = slope * kOver, lift = 0.04;
  const double length = 2 * (kX + kOver);
  const Vec up_front = (kHalf + kOver) * forward + (kRise + drop) * kUp;
  const Vec up_back = -(kHalf + kOver) * forward + (kRise + drop) * kUp;
  add(Shape::quad, Material::tile_roof, 9, at(-kX - kOver, kEaves - drop + lift, kFront - kOver), length * right,
      up_front);
  add(Shape::quad, Material::tile_roof, 7, at(kX + kOver, kEaves - drop + lift, kBack + kOver), -length * right,
      up_back);
  add(Shape::line, Material::tile_roof, 25, at(-kX - kOver, kRidge + lift, kMiddle), length * right,
      Vec{0.05, 0.05, 0});
  for (const double x : {-kX - kOver, kX + kOver}) {  // barge boards
    add(Shape::line, Material::paint, 26, at(x, kEaves - drop, kFront - kOver), up_front, Vec{0.035, 0.035, 0});
    add(Shape::line, Material::paint, 26, at(x, kEaves - drop, kBack + kOver), up_back, Vec{0.035, 0.035, 0});
  }
  add(Shape::line, Material::paint, 26, at(-kX - kOver, kEaves - drop, kFront - kOver), length * right,
      Vec{0.035, 0.035, 0});

  add_window(at(-0.90, 0.95, kFront), 0.52 * right, 0.70 * kUp);
  add_window(at(0.72, 0.95, kFront), 0.44 * right, 0.70 * kUp);
  add_window(at(-kX, 0.95, kMiddle + 0.45), -0.52 * forward, 0.70 * kUp);
  add_window(at(-kX, 0.95, kMiddle - 0.45), -0.52 * forward, 0.70 * kUp);
  add_window(at(-kX, 1.95, kMiddle), -0.40 * forward, 0.44 * kUp);
  add_window(at(kX, 0.95, kMiddle + 0.3), 0.52 * forward, 0.70 * kUp);
  add_window(at(-0.5, 0.95, kBack), -0.52 * right, 0.70 * kUp);
  add_window(at(0.5, 0.95, kBack), -0.52 * right, 0.70 * kUp);
  add(Shape::quad, Material::wood, 16, at(-0.24, 0.06, kFront - 0.015), 0.48 * right, 1.04 * kUp);
  for (const double x : {-0.28, 0.28})
    add(Shape::line, Material::paint, 31, at(x, 0.04, kFront - 0.02), 1.12 * kUp, Vec{0.04, 0.04, 0});
  add(Shape::line, Material::paint, 31, at(-0.32, 1.14, kFront - 0.02), 0.64 * right, Vec{0.045, 0.045, 0});
  add(Shape::quad, Material::stone, 5, at(-0.45, 0.06, kFront - 0.35), 0.9 * right, 0.35 * forward);
  add(Shape::quad, Material::stone, 5, at(-0.45, 0, kFront - 0.35), 0.9 * right, 0.06 * kUp);

  // Chimney.
  const double cx = -0.75, cz = kMiddle + 0.32, w = 0.34, foot = 2.0, top = 3.15;
  for (int side = 0; side < 4; ++side) {
    const Vec out = std::array<Vec, 4>{-forward, right, forward, -right}[static_cast<std::size_t>(side)];
    const Vec along = glm::cross(kUp, out);
    add(Shape::quad, Material::brick, 16, at(cx, foot, cz) + out * (w / 2) - along * (w / 2), along * w,
        (top - foot) * kUp);
    add(Shape::quad, Material::stone, 6, at(cx, top, cz) + out * (w / 2 + 0.04) - along * (w / 2 + 0.04),
        along * (w + 0.08), 0.09 * kUp);
  }
  add(Shape::quad, Material::stone, 4, at(cx - w / 2 - 0.04, top + 0.09, cz - w / 2 - 0.04), (w + 0.08) * right,
      (w + 0.08) * forward);

  // Tower with a pointed roof.
  const Vec tower = at(1.62, 0, 0.05);
  add(Shape::cone, Material::stone, 8, tower, Vec{0.66, 0.60, 2.75});
  add(Shape::cone, Material::stone, 12, tower + 2.62 * kUp, Vec{0.62, 0.72, 0.18});
  add(Shape::cone, Material::slate_roof, 9, tower + 2.78 * kUp, Vec{0.84, 0.01, 1.45});
  add(Shape::ellipsoid, Material::polished, 20, tower + 4.28 * kUp, Vec{0.07});
  add_window(tower + 1.85 * kUp - 0.63 * forward, 0.28 * right, 0.52 * kUp);
  for (int k = 0; k < 6; ++k) add_shade({tower + (0.3 + 0.5 * k) * kUp, 0.6});
  add_shade({tower + 3.2 * kUp, 0.55});
  add_shade({tower + 3.75 * kUp, 0.28});

  house = {{{-1, 0, 0}, kX}, {{1, 0, 0}, kX}, {{0, 0, -1}, -kFront}, {{0, 0, 1}, kBack}, {{0, 1, 0}, 0}};
  for (const double side : {-1.0, 1.0})  // height <= ridge - slope * |z - middle|
    house.push_back({Vec{0, -1, side * slope}, kRidge + side * slope * kMiddle});
}

void SceneGenerator::Layout::add_tree(double x, double z, double height, double crown, const Dice& dice) {
  const Vec foot = at(x, 0, z), fork = foot + kUp * (0.45 * height);
  if (height > 1.2)
    add(Shape::cone, Material::bark, 4, foot, Vec{0.09 * crown + 0.04, 0.05 * crown + 0.02, 0.8 * height});
  const std::uint64_t n_blobs = height > 1.2 ? 8 : 3;
  for (std::uint64_t k = 0; k < n_blobs; ++k) {
    const double phi = 2.4 * static_cast<double>(k) + 6 * dice.uniform(Use::spin, k),
                 low = static_cast<double>(k) / static_cast<double>(n_blobs);
    const double radius = crown * (0.52 - 0.16 * low + 0.1 * dice.uniform(Use::size, k));
    const Vec centre = foot + kUp * (height * (n_blobs == 3 ? 0.4 : 0.58 + 0.42 * low)) +
                       turn(phi) * (crown * 0.62 * (1 - 0.75 * low));
    add(Shape::ellipsoid, Material::leaf, 3, centre, Vec{radius, 0.82 * radius, radius});
    add_shade({centre, 0.8 * radius});
    if (n_blobs > 3) add(Shape::line, Material::bark, 5, fork, centre - fork, Vec{0.035 * crown, 0.01, 0});
  }
}

void SceneGenerator::Layout::build_garden() {
  const Dice dice(seed, 0x5CE7E);
  add(Shape::disc, Material::ground, 1.5, at(0, 0, 0), Vec{0, kGardenRadius, 0});
  add(Shape::quad, Material::ground, 9, at(-2.3, 0.005, -1.5), Vec{4.6, 0, 0}, Vec{0, 0, 4});
  add(Shape::quad, Material::ground, 11, at(-0.62, 0.005, -5.2), Vec{1.24, 0, 0}, Vec{0, 0, 3.7});
  add(Shape::disc, Material::grass, 1.6, at(0, 0, 0), Vec{0, kGardenRadius + 2, 0});
  add(Shape::far_disc, Material::ground, 1, at(0, 0, 0), Vec{kGardenRadius - 0.1, kFar, 0});

  // Arch over the path, and the ball on its pedestal.
  for (const double x : {-0.85, 0.85}) {
    add(Shape::cone, Material::stone, 12, at(x, 0, -3.0), Vec{0.21, 0.19, 0.16});
    add(Shape::cone, Material::stone, 12, at(x, 0.16, -3.0), Vec{0.15, 0.14, 1.0});
    add(Shape::cone, Material::stone, 12, at(x, 1.12, -3.0), Vec{0.14, 0.19, 0.04});
    add(Shape::cone, Material::stone, 12, at(x, 1.16, -3.0), Vec{0.19, 0.19, 0.09});
    add(Shape::disc, Material::stone, 12, at(x, 1.25, -3.0), Vec{0, 0.17, 0});
    for (int k = 0; k < 4; ++k) add_shade({at(x, 0.15 + 0.3 * k, -3.0), 0.16});
  }
  add(Shape::half_ring, Material::stone, 12, at(0, 1.22, -3.0), Vec{0.85, 0.14, 0});
  for (int k = 0; k <= 8; ++k)
    add_shade({at(0.85 * std::cos(kPi * k / 8), 1.22 + 0.85 * std::sin(kPi * k / 8), -3.0), 0.15});
  const Vec pedestal = at(-2.35, 0, -2.0);
  add(Shape::cone, Material::stone, 12, pedestal, Vec{0.34, 0.30, 0.34});
  add(Shape::disc, Material::stone, 4, pedestal + 0.34 * kUp, Vec{0, 0.30, 0});
  add(Shape::ellipsoid, Material::polished, 24, pedestal + 0.77 * kUp, Vec{0.45});
  add_shade({pedestal + 0.77 * kUp, 0.44});

  struct Tree {
    double x, z, height, crown;
  };
  constexpr std::array<Tree, 12> kTrees{{{-3.9, 1.9, 2.9, 1.25},
                                         {3.9, 2.2, 3.3, 1.4},
                                         {-1.4, 4.3, 3.6, 1.5},
                                         {1.9, 4.9, 3.0, 1.3},
                                         {4.7, -1.2, 2.3, 1.0},
                                         {-5.4, 0.1, 2.0, 0.85},
                                         {-1.95, 0.1, 0.5, 0.5},
                                         {-1.95, 1.2, 0.6, 0.55},
                                         {2.6, -0.9, 0.5, 0.5},
                                         {1.1, -2.2, 0.35, 0.32},
                                         {-1.1, -2.3, 0.3, 0.30},
                                         {3.2, 0.9, 0.6, 0.6}}};
  for (std::size_t k = 0; k < kTrees.size(); ++k) {
    const Dice own(seed, 0x7EE + k);
    const double wander = kTrees[k].height > 1.2 ? 0.3 : 0.06;
    add_tree(kTrees[k].x + wander * own.normal(Use::place), kTrees[k].z + wander * own.normal(Use::place, 1),
             kTrees[k].height, kTrees[k].crown, own);
  }
  for (std::uint64_t k = 0; k < 14; ++k) {  // trees of the wider country
    const double phi = 2 * kPi * (static_cast<double>(k) + 0.6 * dice.uniform(Use::place, k)) / 14,
                 r = 9 + 12 * dice.uniform(Use::size, k);
    const Vec foot = turn(phi) * r;
    add(Shape::cone, Material::bark, 0.5, foot, Vec{0.18, 0.12, 1.6});
    add(Shape::ellipsoid, Material::leaf, 0.25, foot + kUp * 2.6, Vec{1.5, 1.8, 1.5});
    add(Shape::ellipsoid, Material::leaf, 0.25, foot + kUp * 3.9, Vec{1.0, 1.2, 1.0});
  }
  for (int k = 0; k < 3; ++k) add(Shape::ridge, Material::hill, 1, at(0, 0, 0), Vec{40 + 55 * k, 7 + 12 * k, k + 1});
  add(Shape::dome, Material::sky, 1, at(0, 0, 0), Vec{kFar});
  add(Shape::fog, Material::floater, 1, at(0, 0, 0), Vec{7, 4, 7});
}

SceneGenerator::Layout::Layout(std::uint64_t scene_seed, std::uint64_t count)
    : seed(mix(scene_seed + kGolden)), n(count) {
  build_house();
  build_garden();
  double total = 0;
  for (Part& part : parts) {
    part.area = part_area(part);
    total += part.area * part.detail;
  }
  double before = 0;
  for (Part& part : parts) {
    part.first = static_cast<std::uint64_t>(before / total * static_cast<double>(n));
    before += part.area * part.detail;
  }
  for (std::size_t k = 0; k < parts.size(); ++k)
    parts[k].count = (k + 1 < parts.size() ? parts[k + 1].first : n) - parts[k].first;
  if (n > 1) {
    stride = static_cast<std::uint64_t>(0.6180339887498949 * static_cast<double>(n)) | 1;
    while (std::gcd(stride, n) != 1) stride += 2;
    shift = mix(seed) % n;
  }
}

// Share of the sun that reaches p, with soft edges.
double SceneGenerator::Layout::sunlight(const Vec& p) const {
  double light = 1;
  const double right = glm::dot(p, kSunRight), up = glm::dot(p, kSunUp), depth = glm::dot(p, kSun);
  for (const Shade& shade : shades) {
    const double dx = shade.right - right, dy = shade.up - up, miss2 = dx * dx + dy * dy,
                 r2 = shade.radius * shade.radius;
    if (miss2 < 1.5 * r2 && shade.depth - depth > 0.3 * shade.radius) light *= smooth(miss2 / r2 - 0.5);
  }
  return light * (1 - smooth(way_through(house, p) / 0.12));
}

Splat SceneGenerator::Layout::splat(std::uint64_t i, int sh_degree) const {
  const std::uint64_t renamed = (i * stride + shift) % n;
  const auto after = std::upper_bound(parts.begin(), parts.end(), renamed,
                                      [](std::uint64_t value, const Part& part) { return value < part.first; });
  const Part& part = *std::prev(after);
  const Dice dice(seed, i);
  // R2: multiples of 1/g and 1/g^2, g = 1.3247..., as 64-bit fractions; the offset differs by part and seed.
  const std::uint64_t j = renamed - part.first + 1, offset = mix(seed + part.first);
  Point q = sample(part, unit(offset + j * 0xC13FA9A902A6328F), unit(mix(offset) + j * 0x91E10DA5C79E7B1C), dice);
  const Material material = part.material;

  // Shape: standard deviations along t (long), n x t (wide) and n (thin), in units of the distance to the neighbours.
  Vec blade = q.n;  // normal of the splat; light falls on the surface as a whole
  double along = 0.60, across = 0.52, thin = 0.08;
  if (material == Material::grass) {
    for (std::uint64_t k = 0; paved(q.p.x, q.p.z) && k < 16; ++k) {  // none on the paving
      const Vec moved =
          turn(2 * kPi * dice.uniform(Use::place, k)) * ((kGardenRadius + 2) * std::sqrt(dice.uniform(Use::lean, k)));
      q.p.x = moved.x;
      q.p.z = moved.z;
    }
    const double height = 0.05 + 0.06 * dice.uniform(Use::size, 1) + 0.06 * noise(1.3 * q.p.x, 1.3 * q.p.z);
    q.t = glm::normalize(kUp + 0.35 * dice.vector(Use::tilt));
    q.p += q.t * (height * (0.15 + 0.8 * dice.uniform(Use::tone, 1)));
    blade = any_tangent(q.t);
    q.n = kUp;
    along = 0.4 * std::sqrt(height / q.spacing);
    across = 0.20;
    thin = 0.06;
  } else if (material == Material::leaf) {
    const Vec leaf = glm::normalize(q.n + 0.9 * dice.vector(Use::tilt) + 1e-3);
    const double deep = dice.uniform(Use::place), rough = dice.normal(Use::lean);
    q.p -= (q.p - part.origin) * (0.4 * deep * deep * deep - 0.07 * rough);
    q.t = glm::normalize(glm::cross(leaf, dice.vector(Use::spin) + 1e-3));
    blade = leaf;
    along = 0.75;
    across = 0.50;
    thin = 0.08;
  } else if (part.shape == Shape::line) {
    along = 1.2;
    across = 0.4;
  } else if (material == Material::floater || material == Material::sky || material == Material::hill) {
    along = 0.75;
    across = 0.6;
  }

  // Light.
  const Look surface = look(material, q, part, dice);
  Vec colour = surface.albedo, shine{0};
  if (material != Material::sky && material != Material::hill && material != Material::floater) {
    const bool soft = material == Material::leaf || material == Material::grass;
    const double cosine = glm::dot(q.n, kSun),
                 lambert = soft ? 0.3 + 0.7 * std::max(0.0, cosine) : std::max(0.0, cosine);
    const double sun = glm::dot(q.p, q.p) > 900 ? 1 : lambert > 0 ? sunlight(q.p + 0.03 * q.n) : 0;
    const double open = 0.5 + 0.5 * glm::dot(q.n, kUp);
    const Vec ambient = glm::mix(Vec{0.20, 0.19, 0.14}, Vec{0.38, 0.45, 0.58}, open);
    colour *= ambient + Vec{1.02, 0.93, 0.76} * (sun * lambert);
    if (part.shape == Shape::far_disc) {
      const double haze = smooth(std::sqrt(glm::dot(q.p, q.p)) / 260);
      colour = glm::mix(colour, Vec{0.66, 0.76, 0.82}, 0.8 * haze);
    }
    shine = Vec{1.0, 0.95, 0.85} * (3.2 * surface.gloss * sun);
  }

  // Tail: one in sixteen is large, soft and faint, as after densification.
  const double rare = dice.uniform(Use::rare);
  const bool large = rare<0.06, outlier = rare> 0.998 && material != Material::sky;
  const double size = std::log(q.spacing) + 0.22 * dice.normal(Use::size) + (large ? 0.25 + 1.1 * rare / 0.06 : 0) -
                      (outlier ? 0.8 : 0);
  const double scale[3] = {size + std::log(along) + 0.15 * std::abs(dice.normal(Use::thin)),
                           size + std::log(across) - 0.25 * std::abs(dice.normal(Use::thin, 1)),
                           size + std::log(thin) - 0.9 * std::abs(dice.normal(Use::flat))};

  double logit = 2.6 + 1.5 * dice.normal(Use::opacity);
  if (large || outlier || dice.uniform(Use::opacity, 1) < 0.15) logit = -2.2 + 1.1 * dice.normal(Use::opacity);
  if (material == Material::sky) logit = 3.5 + dice.normal(Use::opacity);
  if (material == Material::floater) logit = -4.2 + 0.5 * dice.normal(Use::opacity);

  Vec tangent = q.t;
  const bool grained = part.shape == Shape::line || material == Material::grass || material == Material::leaf ||
                       part.shape == Shape::quad;
  if (!grained) {
    const double phi = kPi * dice.uniform(Use::spin);
    tangent = std::cos(phi) * q.t + std::sin(phi) * glm::cross(q.n, q.t);
  }
  const double length = (0.6 + 0.8 * dice.uniform(Use::spin_sign, 1)) * (dice.uniform(Use::spin_sign) < 0.5 ? -1 : 1);

  Splat out;
  for (int k = 0; k < 3; ++k) {
    out.mean[k] = static_cast<float>(q.p[k]);
    out.log_scale[k] = static_cast<float>(scale[k]);
  }
  set_rotation(tangent, glm::cross(blade, tangent), blade, length, out.rotation);
  out.opacity_logit = static_cast<float>(logit);

  Shine shining{colour, q.n, surface.gloss, shine};
  if (material == Material::sky) shining.noise = 0.3;
  if (outlier) shining.dc_gain = 3.0 + 3.0 * dice.uniform(Use::tone, 3);
  set_harmonics(shining, dice, sh_degree, out.sh);
  return out;
}

SceneGenerator::SceneGenerator(std::uint64_t seed, std::uint64_t n, int sh_degree)
    : n_(n), sh_degree_(sh_degree), layout_(std::make_shared<const Layout>(seed, n)) {
  assert(n <= kMaxSceneGaussians && sh_degree >= 0 && sh_degree <= kMaxShDegree);
}

void SceneGenerator::generate(std::uint64_t first, std::span<Splat> out) const {
  assert(first <= n_ && out.size() <= n_ - first);
  for (std::size_t k = 0; k < out.size(); ++k) out[k] = layout_->splat(first + k, sh_degree_);
}

std::string scene_cameras_json(int width, int height, const Origin& origin) {
  const std::array<View, 8> views{{{at(-3.9, 1.9, -7.3), at(0.25, 1.62, 0.2)},
                                   {at(0.0, 1.2, -6.6), at(0.1, 1.45, 0)},
                                   {at(4.6, 1.9, -5.2), at(0.3, 1.3, 0.2)},
                                   {at(6.6, 2.6, -2.9), at(0.4, 1.3, 0.4)},
                                   {at(3.4, 6.0, 7.6), at(0.2, 1.2, 0.6)},
                                   {at(-4.6, 5.4, 6.6), at(0.1, 1.2, 0.6)},
                                   {at(-7.2, 2.2, -1.6), at(-0.2, 1.2, 0.3)},
                                   {at(-3.3, 1.3, -4.4), at(-1.6, 0.95, -1.2)}}};
  return camera_list_json(views, width, height, origin);
}

}  // namespace rgs
