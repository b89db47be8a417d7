// town_generator.cpp - the town's surfaces, sampled, shaded and turned into Gaussians.
// SPDX-License-Identifier: Apache-2.0
//
// A quadrilateral with n Gaussians is cut into about sqrt(n) rows of cells, and each Gaussian fits its cell: n is met
// exactly, edges stay where they are, and few Gaussians cover much. Round surfaces use Roberts' R2 sequence (2018).
// Textures finer than the cells fade to their mean, as training on photographs would leave them. Every random choice
// is a hash of (seed, range, index, purpose). Arithmetic is double with sqrt, sin, cos, log and exp from libm, rounded
// to float at the end.
#include "town_generator.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <vector>

#include "scene_cameras.hpp"
#include "scene_math.hpp"
#include "town_layout.hpp"

namespace rgs {

using namespace detail;

namespace {

// A point of a surface: unit normal n, unit tangents t and b; the sizes of its cell along them; (s, r) are texture
// coordinates in metres.
struct Spot {
  Vec p, n, t, b;
  double wide, high, s, r;
};

struct Look {
  Vec albedo;
  double gloss = 0;  // share of mirror reflection
};

// A caster seen from the sun: right and up in a plane that faces the sun, depth towards the sun.
struct Shade {
  double right, up, depth, radius;
  std::span<const HalfSpace> sides;
};

// 1 where cells of `spacing` resolve a pattern of period `period`, 0 where they do not.
double shown(double period, double spacing) {
  return smooth(2 - 4 * spacing / period);
}

double fraction(double x) {
  return x - std::floor(x);
}

constexpr double kGlassGloss = 0.28;

Look glass_look(const Part& part, const Spot& q, double spacing) {
  // A window is dark, has curtains, or shows a lit room; frame and bars darken it where they are too fine to resolve.
  const double mood = unit(part.salt), wide = glm::length(part.corner[1] - part.corner[0]),
               high = glm::length(part.corner[3] - part.corner[0]);
  Vec pane = part.colour;
  if (mood < 0.3) pane = Vec{0.50, 0.48, 0.42} * (0.8 + mood);
  if (mood > 0.92) pane = Vec{0.46, 0.34, 0.16};
  const Vec frame = (part.salt & 7) < 5 ? Vec{0.82, 0.81, 0.78} : Vec{0.30, 0.22, 0.16};
  constexpr double kFrame = 0.07;
  const bool border = q.s < kFrame || q.r < kFrame || wide - q.s < kFrame || high - q.r < kFrame;
  const bool bar = std::abs(q.s - wide / 2) < 0.025 || std::abs(q.r - 0.68 * high) < 0.025;
  const double share = 1 - std::max(0.0, wide - 2 * kFrame) * std::max(0.0, high - 2 * kFrame) / (wide * high);
  const double seen = shown(4 * kFrame, spacing), of_frame = std::lerp(share, border || bar ? 1.0 : 0.0, seen);
  return {glm::mix(pane, frame, of_frame), kGlassGloss * (1 - of_frame)};
}

Look field_look(const Spot& q, double spacing) {
  // A patchwork of fields, woods where the noise is high.
  const double x = q.p.x + 0.3 * q.p.z + 18 * noise(q.p.x / 90, q.p.z / 90), z = q.p.z - 0.2 * q.p.x;
  const Cell c = cell(x, z, 190, 120);
  constexpr std::array<Vec, 6> kCrops{{{0.34, 0.42, 0.15},
                                       {0.58, 0.52, 0.24},
                                       {0.26, 0.38, 0.12},
                                       {0.44, 0.35, 0.23},
                                       {0.40, 0.46, 0.18},
                                       {0.62, 0.58, 0.20}}};
  const Vec crop = kCrops[static_cast<std::size_t>(c.tone * 6)];
  Vec colour = glm::mix(Vec{0.42, 0.44, 0.19}, crop, shown(300, spacing));
  const double wood = smooth(6 * fractal_noise(q.p.x / 420 + 3, q.p.z / 420 + 8) - 3.3);
  colour = glm::mix(colour, Vec{0.15, 0.25, 0.09}, wood) * (0.88 + 0.24 * noise(q.p.x / 9, q.p.z / 9));
  const double haze = smooth(std::sqrt(glm::dot(q.p, q.p)) / 4200);
  return {glm::mix(colour, Vec{0.58, 0.68, 0.76}, 0.75 * haze)};
}

Look look(const Part& part, const Spot& q, const Dice& dice) {
  const double spacing = std::max(q.wide, q.high), tone = dice.normal(Use::tone);
  const Vec& base = part.colour;
  switch (part.stuff) {
    case Stuff::plaster: {
      // Stains run down from the eaves and up from the ground.
      const double stain = fractal_noise(0.5 * q.s + 31, 0.22 * q.r + static_cast<double>(part.salt & 0xFF));
      const double foot = smooth((0.6 - q.r) / 0.5), top = part.eaves > 0 ? smooth(1 - (part.eaves - q.r) / 0.55) : 0;
      return {base * ((0.88 + 0.2 * stain + 0.015 * tone) * (1 - 0.28 * foot) * (1 - 0.3 * top))};
    }
    case Stuff::brick: {
      const Cell c = cell(q.s, q.r, 0.25, 0.085);
      const bool joint = c.x < 0.06 || c.y < 0.17;
      const double top = part.eaves > 0 ? smooth(1 - (part.eaves - q.r) / 0.55) : 0, fine = shown(0.17, spacing);
      const Vec brick = base * (0.75 + 0.5 * std::lerp(0.5, c.tone, shown(0.34, spacing)));
      const Vec colour = glm::mix(brick, Vec{0.66, 0.62, 0.56}, std::lerp(0.22, joint ? 1.0 : 0.0, fine));
      return {colour * ((0.85 + 0.3 * noise(0.4 * q.s, 0.4 * q.r)) * (1 - 0.3 * top))};
    }
    case Stuff::trim: return {base * (1 + 0.03 * tone), 0.02};
    case Stuff::glass: return glass_look(part, q, spacing);
    case Stuff::door: {
      const bool panel = fraction(q.s / 0.55) > 0.16 && fraction(q.r / 0.7) > 0.14;
      return {base * std::lerp(0.92, panel ? 1.0 : 0.7, shown(0.5, spacing)), 0.03};
    }
    case Stuff::tiles: {
      const Cell c = cell(q.s, q.r, 0.28, 0.34);
      const double bulge = 0.72 + 0.38 * std::sqrt(std::max(0.0, 4 * c.x * (1 - c.x))) - 0.22 * (c.y > 0.84);
      const double detail = std::lerp(0.98, bulge * (0.82 + 0.36 * c.tone), shown(0.34, spacing));
      const double moss =
          smooth(3 * fractal_noise(0.3 * q.s + 5, 0.3 * q.r + static_cast<double>(part.salt & 0xFF)) - 1.6);
      return {glm::mix(base, Vec{0.30, 0.26, 0.16}, 0.4 * moss) * detail, 0.03};
    }
    case Stuff::slate: {
      const Cell c = cell(q.s, q.r, 0.3, 0.24);
      const double joint = c.x < 0.08 || c.y < 0.12 ? 0.65 : 1.0;
      const double detail = std::lerp(0.95, joint * (0.8 + 0.4 * c.tone), shown(0.3, spacing));
      return {base * (detail * (0.85 + 0.3 * noise(0.4 * q.s + static_cast<double>(part.salt & 0xFF), 0.4 * q.r))),
              0.06};
    }
    case Stuff::gravel: return {base * (0.85 + 0.3 * noise(0.7 * q.p.x, 0.7 * q.p.z) + 0.08 * tone)};
    case Stuff::asphalt: return {base * (0.82 + 0.36 * noise(0.16 * q.p.x, 0.16 * q.p.z))};
    case Stuff::paving: {
      const Cell c = cell(q.p.x, q.p.z, 0.6, 0.6);
      const double joint = c.x < 0.05 || c.y < 0.05 ? 0.75 : 1.0;
      const double detail = std::lerp(0.98, joint * (0.88 + 0.24 * c.tone), shown(0.6, spacing));
      return {base * (detail * (0.86 + 0.28 * noise(0.25 * q.p.x, 0.25 * q.p.z)))};
    }
    case Stuff::lawn: {
      const double patch = fractal_noise(0.22 * q.p.x + 9, 0.22 * q.p.z + 4), blades = noise(2.1 * q.p.x, 2.1 * q.p.z);
      return {glm::mix(base, Vec{0.42, 0.43, 0.17}, 0.65 * patch) * (0.8 + 0.3 * blades + 0.08 * tone)};
    }
    case Stuff::leaves: {
      const double clump = noise(1.7 * (q.p.x + q.p.y), 1.7 * (q.p.z - q.p.y));
      return {base * (0.68 + 0.64 * clump + 0.16 * tone) + Vec{0.08, 0.04, 0} * dice.uniform(Use::hue), 0.02};
    }
    case Stuff::bark: return {base * (0.7 + 0.6 * noise(14 * q.s, 3 * q.r))};
    case Stuff::water: return {base, 0.5};
    case Stuff::car: return {base, 0.2};
    case Stuff::field: return field_look(q, spacing);
    case Stuff::hill: {
      const double haze = part.corner[1].z / 3, wood = noise(180 * q.s, 12 * q.r);
      return {glm::mix(glm::mix(Vec{0.20, 0.36, 0.14}, Vec{0.36, 0.46, 0.20}, wood), Vec{0.56, 0.68, 0.80},
                       0.3 + 0.55 * haze)};
    }
    case Stuff::sky: return {sky_colour(q.p, TownPlan::kFar)};
    case Stuff::floater: return {Vec{0.5} + 0.15 * dice.vector(Use::hue)};
  }
  return {};
}

bool has_own_light(Stuff stuff) {  // the sky's colour is final
  return stuff == Stuff::sky || stuff == Stuff::hill || stuff == Stuff::floater;
}

}  // namespace

// ---- ranges ----------------------------------------------------------------------------------------------------

struct TownRange::Layout {
  std::uint64_t seed = 0, count = 0;
  int sh_degree = 0;
  std::vector<Part> parts;
  std::vector<std::uint64_t> first;   // [parts + 1] Gaussians before each part
  std::vector<Shade> shades;          // that may fall on this range
  std::shared_ptr<const void> owner;  // owns their sides

  void share_out();
  void paint(std::size_t p, std::uint64_t from, std::span<Splat> out, std::vector<const Shade*>& near) const;
  void paint_quad(std::size_t p, std::uint64_t from, std::span<Splat> out, std::vector<const Shade*>& near) const;
  Spot round_spot(std::size_t p, std::uint64_t j, const Dice& dice) const;
  double sunlight(const Vec& p, const std::vector<const Shade*>& near) const;
  Splat splat(const Part& part, Spot q, const Dice& dice, const std::vector<const Shade*>& near, double fit_wide,
              double fit_high) const;
};

// The range's Gaussians go to its parts by area * detail; sums of rounded shares meet `count` exactly.
void TownRange::Layout::share_out() {
  double total = 0, before = 0;
  for (const Part& part : parts) total += part.area * part.detail;
  first.assign(1, 0);
  for (const Part& part : parts) {
    before += part.area * part.detail;
    first.push_back(std::min(count, static_cast<std::uint64_t>(before / total * static_cast<double>(count))));
  }
  first.back() = count;
}

// Share of the sun that reaches p, with soft edges.
double TownRange::Layout::sunlight(const Vec& p, const std::vector<const Shade*>& near) const {
  double light = 1;
  const double right = glm::dot(p, kSunRight), up = glm::dot(p, kSunUp), depth = glm::dot(p, kSun);
  for (const Shade* shade : near) {
    const double dx = shade->right - right, dy = shade->up - up, miss2 = dx * dx + dy * dy,
                 r2 = shade->radius * shade->radius;
    if (miss2 > 1.5 * r2) continue;
    if (shade->sides.empty()) {
      if (shade->depth - depth > 0.3 * shade->radius) light *= 0.35 + 0.65 * smooth(miss2 / r2 - 0.5);
      continue;
    }
    light *= 1 - smooth(way_through(shade->sides, p) / 0.4);
  }
  return light;
}

Splat TownRange::Layout::splat(const Part& part, Spot q, const Dice& dice, const std::vector<const Shade*>& near,
                               double fit_wide, double fit_high) const {
  const bool leaf = part.stuff == Stuff::leaves;
  const Look surface = look(part, q, dice);
  Vec colour = surface.albedo, shine{0};
  if (!has_own_light(part.stuff)) {
    const double cosine = glm::dot(q.n, kSun),
                 lambert = leaf ? 0.3 + 0.7 * std::max(0.0, cosine) : std::max(0.0, cosine);
    const double sun = lambert > 0 ? sunlight(q.p + 0.03 * q.n, near) : 0;
    const double open = 0.5 + 0.5 * glm::dot(q.n, kUp);
    const Vec ambient = glm::mix(Vec{0.20, 0.19, 0.15}, Vec{0.38, 0.44, 0.54}, open);
    colour *= ambient + Vec{1.02, 0.93, 0.76} * (sun * lambert);
    shine = Vec{1.0, 0.95, 0.85} * (3.2 * surface.gloss * sun);
  }

  // Orientation: along the surface, a little off as after training; leaves at random.
  Vec n = q.n, t = q.t;
  if (leaf) {
    n = glm::normalize(n + 0.9 * dice.vector(Use::tilt) + 1e-3);
    t = glm::normalize(glm::cross(n, dice.vector(Use::spin) + 1e-3));
  } else {
    const std::uint64_t off = dice.bits(Use::tilt);
    const double most = part.stuff == Stuff::field ? 0.01 : 0.1;  // large ones would tower over the plain
    const auto part16 = [off, most](int s) { return most * (static_cast<double>(off >> s & 0xFFFF) * 0x1p-16 - 0.5); };
    n = glm::normalize(q.n + part16(0) * q.t + part16(16) * q.b);
    t = q.t + part16(32) * q.b;
    t = glm::normalize(t - glm::dot(t, n) * n);
  }

  // Tail: a few are large, soft and faint, as after densification.
  const double rare = dice.uniform(Use::rare);
  const bool large = rare < 0.01 && !has_own_light(part.stuff);
  const double size = 0.1 * dice.normal(Use::size) + (large ? 0.2 + 60 * rare : 0);
  double logit = large ? -1.2 + dice.normal(Use::opacity) : (leaf ? 2.2 : 3.4) + 1.1 * dice.normal(Use::opacity);
  if (part.stuff == Stuff::floater) logit = -4.0 + 0.6 * dice.normal(Use::opacity);
  if (part.stuff == Stuff::sky || part.stuff == Stuff::hill) logit = 4 + 0.5 * dice.normal(Use::opacity);

  Splat out;
  const double scale[3] = {std::log(q.wide * fit_wide) + size, std::log(q.high * fit_high) + size,
                           std::log(std::min(q.wide, q.high) * (leaf                         ? 0.2
                                                                : part.stuff == Stuff::field ? 0.006
                                                                                             : 0.06)) -
                               0.5 * std::abs(dice.normal(Use::flat))};
  for (int k = 0; k < 3; ++k) {
    out.mean[k] = static_cast<float>(q.p[k]);
    out.log_scale[k] = static_cast<float>(scale[k]);
  }
  const std::uint64_t spin = dice.bits(Use::spin_sign);
  set_rotation(t, glm::cross(n, t), n, (0.6 + 0.8 * unit(spin)) * ((spin & 1) != 0 ? -1 : 1), out.rotation);
  out.opacity_logit = static_cast<float>(logit);
  Shine shining{colour, q.n, surface.gloss, shine};
  shining.noise = has_own_light(part.stuff) ? 0.3 : 0.6;
  set_harmonics(shining, dice, sh_degree, out.sh);
  return out;
}

void TownRange::Layout::paint_quad(std::size_t p, std::uint64_t from, std::span<Splat> out,
                                   std::vector<const Shade*>& near) const {
  const Part& part = parts[p];
  const auto& c = part.corner;
  const std::uint64_t n = first[p + 1] - first[p];
  const Vec across = (c[1] + c[2] - c[0] - c[3]) / 2.0, upwards = (c[3] + c[2] - c[0] - c[1]) / 2.0;
  const Vec normal = glm::normalize(glm::cross(across, upwards)), t = glm::normalize(across), b = glm::cross(normal, t);
  const double low = glm::length(c[1] - c[0]), top = glm::length(c[2] - c[3]), wide = (low + top) / 2,
               high = glm::dot(upwards, b);

  // Rows get Gaussians by their width; before(r) of them lie below row r.
  const auto amount = static_cast<double>(n);
  const auto n_rows = static_cast<std::uint64_t>(std::clamp(std::round(std::sqrt(amount * high / wide)), 1.0, amount));
  const auto rows = static_cast<double>(n_rows);
  const auto before = [&](std::uint64_t r) {
    const double v = static_cast<double>(r) / rows;
    return r == n_rows ? n : static_cast<std::uint64_t>(std::floor(amount * v * (low + (top - low) * v / 2) / wide));
  };
  std::uint64_t row = 0, above = n_rows;  // the row that holds Gaussian `from`
  while (above - row > 1) {
    const std::uint64_t middle = (row + above) / 2;
    (before(middle) <= from ? row : above) = middle;
  }
  std::uint64_t j = from;
  const std::uint64_t end = from + out.size();
  for (; j < end; ++row) {
    const std::uint64_t start = before(row), stop = before(row + 1), m = stop - start;
    if (m == 0) continue;
    const double columns = static_cast<double>(m), v_row = (static_cast<double>(row) + 0.5) / rows,
                 cell_wide = std::lerp(low, top, v_row) / columns, cell_high = high / rows;
    // A lone Gaussian stays within its cell; many overlap, so that no light comes through.
    const double fit_wide = m == 1 ? 0.40 : m < 4 ? 0.5 : 0.6, fit_high = n_rows == 1 ? 0.40 : n_rows < 4 ? 0.5 : 0.6;
    for (; j < std::min(stop, end); ++j) {
      const Dice dice(seed, first[p] + j);
      const std::uint64_t place = dice.bits(Use::place);
      const double du = static_cast<double>(place & 0xFFFF) * 0x1p-16 - 0.5,
                   dv = static_cast<double>(place >> 16 & 0xFFFF) * 0x1p-16 - 0.5;
      const double u = (static_cast<double>(j - start) + 0.5 + 0.3 * du) / columns, v = v_row + 0.3 * dv / rows;
      Vec at_point = glm::mix(glm::mix(c[0], c[1], u), glm::mix(c[3], c[2], u), v);
      const Vec within = at_point - c[0];
      Spot q{at_point, normal, t, b, cell_wide, cell_high, part.s + glm::dot(within, t), part.r + glm::dot(within, b)};
      if (part.stuff == Stuff::leaves) {  // hedges are not flat
        q.p += normal * (0.12 * std::clamp(dice.normal(Use::lean), -3.0, 3.0));
        q.wide = q.high = std::sqrt(cell_wide * cell_high) * 1.2;
      }
      out[j - from] = splat(part, q, dice, near, fit_wide, fit_high);
    }
  }
}

Spot TownRange::Layout::round_spot(std::size_t p, std::uint64_t j, const Dice& dice) const {
  const Part& part = parts[p];
  // R2: multiples of 1/g and 1/g^2, g = 1.3247..., as 64-bit fractions.
  const double u = unit(part.salt + (j + 1) * 0xC13FA9A902A6328F),
               v = unit(mix(part.salt) + (j + 1) * 0x91E10DA5C79E7B1C);
  const Vec &o = part.corner[0], &a = part.corner[1];
  const auto n = static_cast<double>(first[p + 1] - first[p]);
  double spacing = std::sqrt(part.area / n);
  const auto frame = [](const Vec& point, const Vec& normal, const Vec& tangent, double size, double s, double r) {
    return Spot{point, normal, tangent, glm::cross(normal, tangent), size, size, s, r};
  };
  // The background: sector [o.x, o.y) of a circle around the town.
  const Vec& town = part.corner[2];
  const double middle = (town.x + town.y) / 2, phi = std::lerp(o.x, o.y, u), sector = o.y - o.x;
  const Vec centre{middle * TownPlan::kPitchX, 0, middle * TownPlan::kPitchZ};
  switch (part.shape) {
    case Part::Shape::quad: break;
    case Part::Shape::ellipsoid: {
      const double y = 1 - 2 * v, ring = std::sqrt(std::max(0.0, 1 - y * y));
      const Vec d = turn(2 * kPi * u) * ring + kUp * y, normal = glm::normalize(d / a);
      Spot q = frame(o + d * a, normal, any_tangent(normal), spacing, u * 2 * kPi * a.x, v * 2 * a.y);
      if (part.stuff == Stuff::leaves) {
        const double deep = dice.uniform(Use::place), rough = dice.normal(Use::lean);
        q.p -= d * a * (0.4 * deep * deep * deep - 0.07 * rough);
      }
      return q;
    }
    case Part::Shape::cone: {
      // Uniform in area: the radius is linear in the height, so the height is the root of a quadratic.
      const double r0 = a.x, r1 = a.y, radius = std::sqrt(r0 * r0 + v * (r1 * r1 - r0 * r0));
      const double h = std::abs(r1 - r0) < 1e-9 ? v : (radius - r0) / (r1 - r0);
      const Vec out = turn(2 * kPi * u), normal = glm::normalize(out * a.z + kUp * (r0 - r1));
      const double rough = part.stuff == Stuff::leaves ? 1 + 0.07 * dice.normal(Use::lean) : 1;
      Spot q = frame(o + out * (radius * rough) + kUp * (h * a.z), normal,
                     glm::cross(normal, glm::normalize(glm::cross(out, kUp))), spacing, u * 2 * kPi * std::max(r0, r1),
                     h * a.z);
      if (part.stuff != Stuff::leaves) {  // poles and trunks are longer than wide
        q.high = std::min(q.high, 2 * radius + 0.02);
        q.wide = std::min(spacing * spacing / q.high, 0.6 * a.z);
      }
      return q;
    }
    case Part::Shape::fog: {
      const Vec point = o + Vec{(2 * u - 1) * a.x, -dice.uniform(Use::place) * a.y, (2 * v - 1) * a.z};
      const Vec normal = glm::normalize(dice.vector(Use::tilt) + 1e-3);
      return frame(point, normal, any_tangent(normal), 0.15 + 0.5 * dice.uniform(Use::size, 1), u, v);
    }
    case Part::Shape::country: {
      const Vec d = turn(phi);
      const double inner = edge_distance(static_cast<int>(town.x), static_cast<int>(town.y), d.x, d.z),
                   ratio = std::log(TownPlan::kFar / inner), radius = inner * std::exp(ratio * v);
      spacing = radius * std::sqrt(sector * ratio / n);
      return frame(centre + d * radius + Vec{0, 0.05, 0}, kUp, {1, 0, 0}, spacing, 0, 0);
    }
    case Part::Shape::ridge: {                     // rows of cells, so that the skyline is even
      const double aspect = a.y / (a.x * sector);  // of the hills' face
      const auto n_rows = static_cast<std::uint64_t>(std::max(1.0, std::round(std::sqrt(n * aspect))));
      const auto rows = static_cast<double>(n_rows);
      const std::uint64_t column = j / n_rows;
      const double columns = std::ceil(n / rows), up = (static_cast<double>(j % n_rows) + 0.5) / rows,
                   azimuth = std::lerp(o.x, o.y, (static_cast<double>(column) + v) / columns);
      const Vec out = turn(azimuth);
      const double crest = a.y * ridge_height(azimuth, a.z);
      Spot q = frame(centre + out * (a.x + 1.5 * crest * up) + kUp * (crest * up), glm::normalize(1.5 * kUp - out),
                     Vec{-out.z, 0, out.x}, a.x * sector / columns, azimuth, up);
      q.high = 1.8 * crest / rows;
      return q;
    }
    case Part::Shape::dome: {
      const double height = std::lerp(-0.03, 1.0, v);  // cosine of the zenith angle
      const Vec d = turn(phi) * std::sqrt(1 - height * height) + kUp * height;
      return frame(centre + d * TownPlan::kFar, -d, any_tangent(d), TownPlan::kFar * std::sqrt(sector * 1.03 / n), u,
                   v);
    }
  }
  return {};
}

void TownRange::Layout::paint(std::size_t p, std::uint64_t from, std::span<Splat> out,
                              std::vector<const Shade*>& near) const {
  const Part& part = parts[p];
  near.clear();
  if (!has_own_light(part.stuff) && part.stuff != Stuff::field) {
    const Box box = part_box(part);
    const Vec middle = (box.low + box.high) / 2.0;
    const double reach = glm::length(box.high - box.low) / 2, right = glm::dot(middle, kSunRight),
                 up = glm::dot(middle, kSunUp), depth = glm::dot(middle, kSun);
    for (const Shade& shade : shades) {
      const double far = reach + 1.25 * shade.radius, dx = shade.right - right, dy = shade.up - up;
      if (dx * dx + dy * dy < far * far && shade.depth + shade.radius > depth - reach) near.push_back(&shade);
    }
  }
  if (part.shape == Part::Shape::quad) {
    paint_quad(p, from, out, near);
    return;
  }
  for (std::size_t k = 0; k < out.size(); ++k) {
    const Dice dice(seed, first[p] + from + k);
    // R2 is less even than cells, and the background must not have holes.
    const double fit = part.shape >= Part::Shape::country ? 0.8 : 0.62;
    out[k] = splat(part, round_spot(p, from + k, dice), dice, near, fit, fit);
  }
}

std::uint64_t TownRange::size() const {
  return layout_->count;
}

void TownRange::generate(std::uint64_t first, std::span<Splat> out) const {
  assert(first <= layout_->count && out.size() <= layout_->count - first);
  const std::vector<std::uint64_t>& starts = layout_->first;
  std::vector<const Shade*> near;
  auto after = std::upper_bound(starts.begin(), starts.end(), first);
  while (!out.empty()) {
    const auto p = static_cast<std::size_t>(after - starts.begin()) - 1;
    const std::uint64_t count = std::min<std::uint64_t>(out.size(), starts[p + 1] - first);
    if (count > 0) layout_->paint(p, first - starts[p], out.first(count), near);
    out = out.subspan(count);
    first += count;
    ++after;
  }
}

// ---- the town --------------------------------------------------------------------------------------------------

struct TownGenerator::Layout {
  struct Entry {
    std::uint64_t first = 0;
    Box box;
    std::vector<Caster> casters;
    std::vector<HalfSpace> sides;
  };
  std::uint64_t seed, n;
  int sh_degree, blocks;
  double backdrop = 0;  // weight of fields, hills and sky in each sector
  TownPlan plan;
  std::vector<Entry> ranges;  // sectors around the town, then blocks, i fastest; one more with first = n

  Layout(std::uint64_t seed_, std::uint64_t n_, int sh_degree_, int blocks_)
      : seed(mix(seed_ + kGolden)), n(n_), sh_degree(sh_degree_), blocks(blocks_), plan(seed) {}
  int low() const { return -(blocks / 2); }
  Block block(std::size_t k) const {
    if (k < TownPlan::kSectors) return plan.surroundings(low(), low() + blocks, static_cast<int>(k), backdrop);
    const auto at_block = static_cast<int>(k) - TownPlan::kSectors;
    return plan.block(low() + at_block % blocks, low() + at_block / blocks);
  }
};

int TownGenerator::default_blocks(std::uint64_t n) {
  const int side = static_cast<int>(std::lround(4 * std::sqrt(std::sqrt(static_cast<double>(n) * 1e-6))));
  return std::clamp(side, 1, kMaxTownBlocks);
}

TownGenerator::TownGenerator(std::uint64_t seed, std::uint64_t n, int sh_degree, int blocks) {
  assert(n <= kMaxTownGaussians && sh_degree >= 0 && sh_degree <= kMaxShDegree);
  assert(blocks >= 0 && blocks <= kMaxTownBlocks);
  const auto layout = std::make_shared<Layout>(seed, n, sh_degree, blocks > 0 ? blocks : default_blocks(n));
  const auto n_all = static_cast<std::size_t>(TownPlan::kSectors + layout->blocks * layout->blocks);
  layout->ranges.resize(n_all + 1);
  std::vector<double> weight(n_all);
  double total = 0;
  for (std::size_t k = 0; k < n_all; ++k) {
    Block block = layout->block(k);
    Layout::Entry& entry = layout->ranges[k];
    for (const Part& part : block.parts) {
      weight[k] += part.area * part.detail;
      const Box box = part_box(part);
      entry.box.low = glm::min(entry.box.low, box.low);
      entry.box.high = glm::max(entry.box.high, box.high);
    }
    total += weight[k];
    entry.casters.assign(block.casters.begin(), block.casters.end());  // releases spare capacity
    entry.sides.assign(block.sides.begin(), block.sides.end());
  }
  // The share of fields, hills and sky falls with n, because their distance stays, but stays large enough to cover them.
  const double amount = static_cast<double>(n),
               share = std::min(0.25, 13000 / std::max(amount, 1.0)) + 0.003 / std::sqrt(1 + amount / 2e7);
  layout->backdrop = total * share / (1 - share) / TownPlan::kSectors;
  total /= 1 - share;
  double before = 0;
  for (std::size_t k = 0; k < n_all; ++k) {
    layout->ranges[k].first = std::min(n, static_cast<std::uint64_t>(before / total * amount));
    before += weight[k] + (k < TownPlan::kSectors ? layout->backdrop : 0);
  }
  layout->ranges[n_all].first = n;
  layout_ = layout;
}

std::uint64_t TownGenerator::size() const {
  return layout_->n;
}

int TownGenerator::sh_degree() const {
  return layout_->sh_degree;
}

int TownGenerator::blocks() const {
  return layout_->blocks;
}

std::uint64_t TownGenerator::n_ranges() const {
  return layout_->ranges.size() - 1;
}

std::uint64_t TownGenerator::first(std::uint64_t k) const {
  assert(k <= n_ranges());
  return layout_->ranges[k].first;
}

TownGenerator::Bounds TownGenerator::bounds(std::uint64_t k) const {
  assert(k < n_ranges());
  const Box& box = layout_->ranges[k].box;
  return {{box.low.x, box.low.y, box.low.z}, {box.high.x, box.high.y, box.high.z}};
}

TownRange TownGenerator::range(std::uint64_t k) const {
  assert(k < n_ranges());
  const auto range = std::make_shared<TownRange::Layout>();
  range->seed = mix(layout_->seed + k * kGolden);
  range->count = first(k + 1) - first(k);
  range->sh_degree = layout_->sh_degree;
  range->parts = layout_->block(k).parts;
  range->share_out();
  if (k < TownPlan::kSectors) return TownRange(range);

  // Shadows fall from this block and its neighbours.
  const int side = layout_->blocks, at_block = static_cast<int>(k) - TownPlan::kSectors, i = at_block % side,
            j = at_block / side;
  const Box& box = layout_->ranges[k].box;
  const Vec middle = (box.low + box.high) / 2.0;
  const double reach = glm::length(box.high - box.low) / 2, right = glm::dot(middle, kSunRight),
               up = glm::dot(middle, kSunUp);
  for (int y = std::max(0, j - 1); y <= std::min(side - 1, j + 1); ++y)
    for (int x = std::max(0, i - 1); x <= std::min(side - 1, i + 1); ++x) {
      const auto neighbour = static_cast<std::size_t>(TownPlan::kSectors + y * side + x);
      const TownGenerator::Layout::Entry& entry = layout_->ranges[neighbour];
      for (const Caster& caster : entry.casters) {
        const Shade shade{glm::dot(caster.centre, kSunRight), glm::dot(caster.centre, kSunUp),
                          glm::dot(caster.centre, kSun), caster.radius,
                          std::span(entry.sides).subspan(caster.first_side, caster.n_sides)};
        if (std::hypot(shade.right - right, shade.up - up) < reach + 1.25 * shade.radius)
          range->shades.push_back(shade);
      }
    }
  range->owner = layout_;
  return TownRange(range);
}

// ---- cameras ---------------------------------------------------------------------------------------------------

namespace {

// The street between block rows -1 and 0 as a smooth line: x in blocks, Catmull and Rom's spline (1974).
Vec street_point(const TownPlan& plan, double x) {
  const int i = static_cast<int>(std::floor(x));
  const double t = x - i;
  const Vec a = plan.crossing(i - 1, 0), b = plan.crossing(i, 0), c = plan.crossing(i + 1, 0),
            d = plan.crossing(i + 2, 0);
  return 0.5 * (2.0 * b + (c - a) * t + (2.0 * a - 5.0 * b + 4.0 * c - d) * (t * t) +
                (3.0 * b - a - 3.0 * c + d) * (t * t * t));
}

constexpr double kEyeLevel = 1.7;

}  // namespace

std::string town_cameras_json(std::uint64_t seed, int width, int height, const Origin& origin) {
  const TownPlan plan(mix(seed + kGolden));
  const auto street = [&](double x, double h, double aside = 0) {
    return street_point(plan, x) + h * kUp + Vec{0, 0, aside};
  };
  const std::array<View, 8> views{{{street(-0.8, kEyeLevel, 1.5), street(0.2, 3)},
                                   {street(0.05, kEyeLevel, -3.5), street(0.8, 4, 16)},
                                   {street(0.45, kEyeLevel, -3), street(0.62, 3.4, 12)},
                                   {street(0.2, 7.5, 30), street(0.75, 2, 36)},
                                   {street(-0.6, 15, -8), street(0.5, 6, 25)},
                                   {street(-1.0, 32, -40), street(0.3, 2, 20)},
                                   {at(-350, 130, -330), at(0, 0, 0)},
                                   {at(-25, 190, -60), at(0, 0, 5)}}};
  return camera_list_json(views, width, height, origin);
}

std::string town_path_json(std::uint64_t seed, int width, int height, const Origin& origin) {
  const TownPlan plan(mix(seed + kGolden));
  constexpr double kStep = 30.0 / kTownPathFramesPerSecond;  // metres
  constexpr int kWalk = 240;                                 // frames in the street
  std::vector<View> views;
  double x = -2;
  Vec eye = street_point(plan, x) + kEyeLevel * kUp;
  for (int k = 0; k < kWalk; ++k) {
    x += 0.01 * kStep / glm::distance(street_point(plan, x), street_point(plan, x + 0.01));
    views.push_back({eye, street_point(plan, x + 0.15) + 1.9 * kUp});
    eye = street_point(plan, x) + kEyeLevel * kUp;
  }
  const Vec street_way = glm::normalize(street_point(plan, x + 0.15) - street_point(plan, x));
  for (int k = kWalk; k < kTownPathFrames; ++k) {
    // Up, steepest in the middle of the climb, turning towards the blocks on the left.
    const double flight = static_cast<double>(k - kWalk) / (kTownPathFrames - kWalk);
    const double climb = 0.75 * smooth(3 * flight) * (1 - smooth((flight - 0.4) / 0.35)),
                 bend = 0.75 * smooth(1.3 * flight);
    const Vec flat =
        glm::normalize(Vec{std::cos(bend), 0, std::sin(bend)} + (1 - smooth(4 * flight)) * (street_way - Vec{1, 0, 0}));
    const Vec way = flat * std::cos(climb) + kUp * std::sin(climb);
    const double dip = 0.42 * smooth(1.6 * flight);
    views.push_back({eye, eye + 20.0 * (flat * std::cos(dip) - kUp * std::sin(dip))});
    eye += kStep * way;
  }
  return camera_list_json(views, width, height, origin);
}

}  // namespace rgs
