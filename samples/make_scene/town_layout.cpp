// town_layout.cpp - streets, plots, houses and trees from hashes of (seed, block).
// SPDX-License-Identifier: Apache-2.0
//
// Nearly everything is a quadrilateral: streets bend at their crossings, plots are cut out of blocks by bilinear
// coordinates, and a house's walls stand on the sides of a quadrilateral cut out of its plot. Walls are cut around
// windows and doors, and ground around houses, where that shows: as after training, surfaces do not overlap.
#include "town_layout.hpp"

namespace rgs::detail {
namespace {

using Plan = glm::dvec2;  // x, z on the ground

// Corners of a piece of ground: front left, front right, back right, back left, as seen from its street.
using Plot = std::array<Plan, 4>;

Vec above(const Plan& p, double height) {
  return at(p.x, height, p.y);
}

Plan place(const Plot& plot, double u, double v) {
  return glm::mix(glm::mix(plot[0], plot[1], u), glm::mix(plot[3], plot[2], u), v);
}

Plot piece(const Plot& plot, double u0, double u1, double v0, double v1) {
  return {place(plot, u0, v0), place(plot, u1, v0), place(plot, u1, v1), place(plot, u0, v1)};
}

double width(const Plot& plot) {
  return (glm::distance(plot[0], plot[1]) + glm::distance(plot[3], plot[2])) / 2;
}

double depth(const Plot& plot) {
  return (glm::distance(plot[0], plot[3]) + glm::distance(plot[1], plot[2])) / 2;
}

// Side k, from corner k to the next, moves outwards by by[k].
Plot outset(const Plot& plot, const std::array<double, 4>& by) {
  std::array<Plan, 4> start{}, along{};
  for (std::size_t k = 0; k < 4; ++k) {
    along[k] = glm::normalize(plot[(k + 1) % 4] - plot[k]);
    start[k] = plot[k] + Plan{along[k].y, -along[k].x} * by[k];
  }
  Plot out{};
  for (std::size_t k = 0; k < 4; ++k) {  // corner k: where side k - 1 meets side k
    const std::size_t before = (k + 3) % 4;
    const Plan a = along[before], b = along[k], gap = start[k] - start[before];
    const double t = (gap.x * b.y - gap.y * b.x) / (a.x * b.y - a.y * b.x);
    out[k] = start[before] + a * t;
  }
  return out;
}

Plot outset(const Plot& plot, double by) {
  return outset(plot, {by, by, by, by});
}

Plot rectangle(const Plan& middle, const Plan& along, double length, double wide) {
  const Plan a = along * (length / 2), b = Plan{-along.y, along.x} * (wide / 2);
  return {middle - a - b, middle + a - b, middle + a + b, middle - a + b};
}

Plot turned(const Plot& plot) {
  return {plot[1], plot[2], plot[3], plot[0]};
}

// A sequence of random numbers, for plans only. One draw a call or declaration: compilers evaluate arguments and operands
// in different orders, and every draw changes the next.
class Draws {
 public:
  explicit Draws(std::uint64_t key) : key_(key) {}
  std::uint64_t bits() { return mix(key_ += kGolden); }
  double next() { return unit(bits()); }
  double between(double low, double high) { return low + (high - low) * next(); }
  bool happens(double chance) { return next() < chance; }
  template <class T, std::size_t kN>
  const T& pick(const std::array<T, kN>& from) {
    return from[bits() % kN];
  }

 private:
  std::uint64_t key_;
};

std::uint64_t key_of(std::uint64_t seed, int i, int j, std::uint64_t what) {
  return mix(mix(seed + what * kGolden) + mix(static_cast<std::uint64_t>(std::int64_t{i}) * kGolden) * 3 +
             mix(static_cast<std::uint64_t>(std::int64_t{j}) + kGolden));
}

// Half the road's and the pavement's width of street i of either direction; every third is a main street.
struct Street {
  double road, pavement;
};

Street street(int i) {
  return i % 3 == 0 ? Street{5.2, 3.2} : Street{3.3, 1.9};
}

constexpr std::array<Vec, 10> kPlaster{{{0.80, 0.72, 0.56},
                                        {0.76, 0.60, 0.34},
                                        {0.74, 0.52, 0.44},
                                        {0.82, 0.80, 0.76},
                                        {0.62, 0.62, 0.60},
                                        {0.54, 0.62, 0.68},
                                        {0.62, 0.68, 0.52},
                                        {0.68, 0.40, 0.26},
                                        {0.82, 0.74, 0.42},
                                        {0.70, 0.66, 0.58}}};
constexpr std::array<Vec, 4> kBrick{{{0.52, 0.22, 0.15}, {0.62, 0.34, 0.22}, {0.66, 0.54, 0.36}, {0.40, 0.24, 0.19}}};
constexpr std::array<Vec, 4> kTiles{{{0.47, 0.21, 0.14}, {0.53, 0.29, 0.19}, {0.40, 0.20, 0.15}, {0.42, 0.28, 0.21}}};
constexpr std::array<Vec, 3> kSlate{{{0.24, 0.27, 0.33}, {0.32, 0.33, 0.35}, {0.30, 0.25, 0.23}}};
constexpr std::array<Vec, 5> kTrim{
    {{0.86, 0.85, 0.82}, {0.30, 0.36, 0.30}, {0.20, 0.27, 0.40}, {0.42, 0.22, 0.16}, {0.72, 0.70, 0.66}}};
constexpr std::array<Vec, 7> kPaint{{{0.62, 0.10, 0.09},
                                     {0.10, 0.20, 0.42},
                                     {0.78, 0.78, 0.78},
                                     {0.10, 0.11, 0.12},
                                     {0.42, 0.44, 0.47},
                                     {0.16, 0.34, 0.22},
                                     {0.76, 0.60, 0.16}}};
constexpr std::array<Vec, 5> kGreen{
    {{0.17, 0.31, 0.08}, {0.26, 0.38, 0.10}, {0.36, 0.42, 0.12}, {0.14, 0.26, 0.12}, {0.42, 0.36, 0.10}}};
const Vec kLawn{0.27, 0.40, 0.12}, kPaving{0.56, 0.53, 0.49}, kGravel{0.50, 0.47, 0.41}, kAsphalt{0.25, 0.25, 0.26},
    kWhite{0.72, 0.72, 0.70}, kWater{0.10, 0.18, 0.20}, kGlass{0.06, 0.10, 0.15}, kBark{0.30, 0.23, 0.17};

enum class Roof { gable, gable_across, hip, flat };

struct House {
  Plot foot;
  int storeys = 2;
  double storey = 2.8;  // height, metres
  Stuff wall = Stuff::plaster, cover = Stuff::tiles;
  Vec wall_colour = kPlaster[0], cover_colour = kTiles[0], trim = kTrim[0], door = kTrim[2];
  Roof roof = Roof::gable;
  double slope = 0.8;
  double over = 0.4;                           // how far the roof reaches over the walls
  double window = 1.1, sill = 0.9, row = 2.7;  // width, height of the sill, distance from one to the next
  bool shutters = false, shop = false, balconies = false, attached = false;
  int dormers = 0, chimneys = 1;

  double eaves() const { return storeys * storey + 0.35; }
};

class BlockBuilder {
 public:
  BlockBuilder(Block& block, std::uint64_t key) : block_(block), draws_(key) {}

  Draws& draws() { return draws_; }

  Part& quad(Stuff stuff, double detail, const Vec& colour, const std::array<Vec, 4>& corner) {
    return add(Part::Shape::quad, stuff, detail, colour, corner);
  }
  Part& ground(Stuff stuff, double detail, const Vec& colour, const Plot& plot, double height = 0) {
    return quad(stuff, detail, colour,
                {above(plot[0], height), above(plot[1], height), above(plot[2], height), above(plot[3], height)});
  }
  Part& add(Part::Shape shape, Stuff stuff, double detail, const Vec& colour, const std::array<Vec, 4>& corner) {
    block_.parts.push_back({shape, stuff, corner, colour, detail});
    block_.parts.back().salt = draws_.bits();
    return block_.parts.back();
  }

  // Sides and top of a body whose top is drawn in by `in`.
  void body(const Plot& foot, double low, double high, double in, Stuff side, const Vec& side_colour, Stuff top,
            const Vec& top_colour, double detail) {
    const Plot upper = outset(foot, -in);
    for (std::size_t k = 0; k < 4; ++k) {
      const std::size_t n = (k + 1) % 4;
      quad(side, detail, side_colour,
           {above(foot[k], low), above(foot[n], low), above(upper[n], high), above(upper[k], high)});
    }
    ground(top, detail, top_colour, upper, high);
  }

  void house(const House& house);
  // Of the height and radius in between.
  void tree(const Plan& foot, double low, double high);
  void bush(const Plan& foot, double low, double high);
  Plan somewhere(const Plot& plot, double u0, double u1, double v0, double v1) {
    const double u = draws_.between(u0, u1), v = draws_.between(v0, v1);
    return place(plot, u, v);
  }
  void hedge(const Plot& foot, double height, const Vec& colour) {
    body(foot, 0, height, 0.03, Stuff::leaves, colour, Stuff::leaves, colour, 0.9);
  }
  void car(const Plan& middle, const Plan& along);
  void lamp(const Plan& foot);

  void detached(const Plot& plot);
  void terraced(const Plot& plot, double set_back, bool shops);
  void apartments(const Plot& plot);
  void park(const Plot& plot);
  void church(const Plot& plot);
  void streets(const Plot& middle, const Plot& kerb, const Plot& inner, const std::array<Street, 4>& sides);

 private:
  void markings(const Plan& from, const Plan& to, double first, double last, double half, bool line);
  void wall(const House& house, const Plan& from, const Plan& to, bool windows, bool door);
  void gable(const House& house, const Plot& foot, const Plot& eaves);
  void dress(House& house);
  // A roof's surface, which bounds the body that casts the shadow too.
  void cover(const House& house, const std::array<Vec, 4>& corner);

  Block& block_;
  Draws draws_;
};

// ---- houses ------------------------------------------------------------------------------------------------------

void BlockBuilder::wall(const House& house, const Plan& from, const Plan& to, bool windows, bool door) {
  const double wide = glm::distance(from, to), eaves = house.eaves() + (house.roof == Roof::flat ? 0.5 : 0);
  const Plan along = (to - from) / wide;
  const auto put = [&](double s0, double s1, double h0, double h1, Stuff stuff, double detail, const Vec& colour) {
    if (s1 - s0 < 0.02 || h1 - h0 < 0.02) return;
    const Plan a = from + along * s0, b = from + along * s1;
    Part& part = quad(stuff, detail, colour, {above(a, h0), above(b, h0), above(b, h1), above(a, h1)});
    if (stuff == house.wall) {
      part.s = s0;
      part.r = h0;
      part.eaves = eaves;
    }
  };
  // A window with its sill and lintel, which stand out a little.
  const auto window = [&](double s0, double s1, double h0, double h1) {
    put(s0, s1, h0, h1, Stuff::glass, 3, kGlass);
    const Plan out = Plan{along.y, -along.x} * 0.05, a = from + along * (s0 - 0.1) + out,
               b = from + along * (s1 + 0.1) + out;
    for (const double h : {h0 - 0.1, h1})
      quad(Stuff::trim, 2.2, house.trim, {above(a, h), above(b, h), above(b, h + 0.12), above(a, h + 0.12)});
  };
  const auto plain = [&](double s0, double s1, double h0, double h1) {
    put(s0, s1, h0, h1, house.wall, 1.3, house.wall_colour);
  };
  if (!windows || wide < 2.4) {
    put(0, wide, 0, eaves, house.wall, 0.9, house.wall_colour);
    return;
  }
  const int columns = std::max(1, static_cast<int>((wide - 0.6) / house.row));
  const double step = wide / columns;
  const int entry = door ? static_cast<int>(draws_.bits() % static_cast<std::uint64_t>(columns)) : -1;
  double done = 0;  // height up to which the wall stands
  for (int k = 0; k < house.storeys; ++k) {
    const bool shop = house.shop && k == 0;
    const double floor = k * house.storey + 0.25, bottom = floor + (shop ? 0.3 : house.sill),
                 top = floor + house.storey - (shop ? 0.75 : 0.5), pane = shop ? 0.84 * step : house.window;
    const bool way = entry >= 0 && k == 0;
    const double middle = (entry + 0.5) * step;
    if (way) {
      plain(0, middle - 0.55, done, bottom);
      plain(middle + 0.55, wide, done, bottom);
      put(middle - 0.55, middle + 0.55, 0, top, Stuff::door, 3, house.door);
    } else {
      plain(0, wide, done, bottom);
    }
    double s = 0;
    for (int c = 0; c < columns; ++c) {
      const bool is_door = way && c == entry;
      const double half = is_door ? 0.55 : pane / 2, centre = (c + 0.5) * step;
      if (house.shutters && !is_door && !shop && step > 2 * pane) {
        plain(s, centre - 2 * half, bottom, top);
        put(centre - 2 * half, centre - half, bottom, top, Stuff::trim, 2.2, house.door);
        window(centre - half, centre + half, bottom, top);
        put(centre + half, centre + 2 * half, bottom, top, Stuff::trim, 2.2, house.door);
        s = centre + 2 * half;
        continue;
      }
      plain(s, centre - half, bottom, top);
      if (!is_door) window(centre - half, centre + half, bottom, top);
      if (house.balconies && !is_door && k > 0 && c % 2 == 0) {
        const Plan out = Plan{along.y, -along.x} * 1.2, a = from + along * (centre - 0.45 * step),
                   b = from + along * (centre + 0.45 * step);
        body({a + out, b + out, b, a}, floor - 0.15, floor + 0.9, 0, Stuff::trim, house.trim, Stuff::gravel, kGravel,
             1.4);
      }
      s = centre + half;
    }
    plain(s, wide, bottom, top);
    done = top;
    if (shop) {
      plain(0, wide, done, done + 0.1);
      put(0, wide, done + 0.1, done + 0.6, Stuff::trim, 2.2, house.door);
      done += 0.6;
    }
  }
  plain(0, wide, done, eaves);
}

void BlockBuilder::cover(const House& house, const std::array<Vec, 4>& corner) {
  quad(house.cover, 1.5, house.cover_colour, corner);
  const Vec n = glm::normalize(
      glm::cross(corner[1] + corner[2] - corner[0] - corner[3], corner[3] + corner[2] - corner[0] - corner[1]));
  block_.sides.push_back({n, glm::dot(n, (corner[0] + corner[1] + corner[2] + corner[3]) / 4.0)});
}

void BlockBuilder::house(const House& house) {
  const Plot& foot = house.foot;
  const double eaves = house.eaves();
  std::vector<HalfSpace>& sides = block_.sides;
  const std::size_t first_side = sides.size();
  for (std::size_t k = 0; k < 4; ++k) {
    const std::size_t n = (k + 1) % 4;
    wall(house, foot[k], foot[n], k % 2 == 0 || !house.attached, k == 0);
    const Plan along = glm::normalize(foot[n] - foot[k]), out{along.y, -along.x};
    sides.push_back({{out.x, 0, out.y}, glm::dot(out, foot[k])});
  }

  // The roof; its ridge runs along the front unless that is the shorter side or the gable is to be in front.
  const double o = house.over, party = house.attached ? 0.0 : o;
  Plot body_foot = foot, edge = outset(foot, {o, party, o, party});
  if (house.roof == Roof::gable_across || (house.roof == Roof::hip && width(foot) < depth(foot))) {
    body_foot = turned(foot);
    edge = turned(edge);
  }
  const double half = depth(body_foot) / 2, rise = house.roof == Roof::flat ? 0 : house.slope * half;
  const double low = eaves - house.slope * o, high = eaves + rise + 0.03;
  const Plan left = (edge[0] + edge[3]) / 2.0, right = (edge[1] + edge[2]) / 2.0;
  if (house.roof == Roof::flat) {
    const Plot inner = outset(foot, -0.3);
    quad(house.cover, 1.0, house.cover_colour,
         {above(inner[0], eaves + 0.1), above(inner[1], eaves + 0.1), above(inner[2], eaves + 0.1),
          above(inner[3], eaves + 0.1)});
    for (std::size_t k = 0; k < 4; ++k) {  // the parapet's top and inner side
      const std::size_t n = (k + 1) % 4;
      const double top = eaves + 0.5;
      quad(Stuff::trim, 1.5, house.trim,
           {above(foot[k], top), above(foot[n], top), above(inner[n], top), above(inner[k], top)});
      quad(house.wall, 0.8, house.wall_colour,
           {above(inner[n], eaves + 0.1), above(inner[k], eaves + 0.1), above(inner[k], top), above(inner[n], top)});
    }
    sides.push_back({kUp, eaves + 0.5});
    for (int k = 0; k < house.chimneys; ++k) {
      const Plan spot = somewhere(foot, 0.2, 0.8, 0.3, 0.7);
      body(rectangle(spot, glm::normalize(foot[1] - foot[0]), 2.6, 1.9), eaves + 0.1, eaves + 1.9, 0, Stuff::trim,
           house.trim, Stuff::gravel, kGravel, 1.2);
    }
  } else if (house.roof == Roof::hip) {
    const double in = std::min(0.5, half / width(body_foot));
    const Plan a = glm::mix(left, right, in), b = glm::mix(left, right, 1 - in);
    cover(house, {above(edge[0], low), above(edge[1], low), above(b, high), above(a, high)});
    cover(house, {above(edge[1], low), above(edge[2], low), above(b, high), above(b, high)});
    cover(house, {above(edge[2], low), above(edge[3], low), above(a, high), above(b, high)});
    cover(house, {above(edge[3], low), above(edge[0], low), above(a, high), above(a, high)});
  } else {
    cover(house, {above(edge[0], low), above(edge[1], low), above(right, high), above(left, high)});
    cover(house, {above(edge[2], low), above(edge[3], low), above(left, high), above(right, high)});
    for (const std::size_t k : {1U, 3U}) {
      const std::size_t n = (k + 1) % 4;
      const Plan top = (body_foot[k] + body_foot[n]) / 2.0;
      Part& part = quad(
          house.wall, 1.2, house.wall_colour,
          {above(body_foot[k], eaves), above(body_foot[n], eaves), above(top, eaves + rise), above(top, eaves + rise)});
      part.r = eaves;
    }
  }
  if (house.roof != Roof::flat) {
    for (const std::size_t k : {0U, 2U}) {  // boards along the eaves
      const Plan a = edge[k], b = edge[k + 1];
      quad(Stuff::trim, 2.5, house.trim,
           {above(a, low - 0.16), above(b, low - 0.16), above(b, low + 0.04), above(a, low + 0.04)});
    }
    const Plan along = glm::normalize(right - left);
    for (int k = 0; k < house.dormers; ++k) {
      const double u = (k + 0.5) / house.dormers;
      const Plan spot = glm::mix(glm::mix(edge[0], edge[1], u), glm::mix(left, right, u), 0.42);
      const Plot sides_of = rectangle(spot, along, 1.5, 0.42 * half);
      const double foot_height = low + (high - low) * 0.2, top = low + (high - low) * 0.66;
      const Plan inwards = Plan{-along.y, along.x};
      quad(Stuff::glass, 3, kGlass,
           {above(sides_of[0], foot_height), above(sides_of[1], foot_height), above(sides_of[1], top),
            above(sides_of[0], top)});
      const Plan reach = inwards * (0.25 * half);
      quad(house.cover, 1.5, house.cover_colour,
           {above(sides_of[0], top), above(sides_of[1], top), above(sides_of[2] + reach, top + 0.25),
            above(sides_of[3] + reach, top + 0.25)});
      for (const std::size_t c : {1U, 3U}) {  // its cheeks; the part below the roof is hidden
        const Plan front = c == 1 ? sides_of[1] : sides_of[0], back = c == 1 ? sides_of[2] : sides_of[3];
        const std::array<Vec, 4> cheek{above(front, foot_height), above(front, foot_height), above(back, top),
                                       above(front, top)};
        quad(house.wall, 1.2, house.wall_colour, c == 1 ? cheek : std::array{cheek[1], cheek[0], cheek[3], cheek[2]});
      }
    }
    for (int k = 0; k < house.chimneys; ++k) {
      const double u = draws_.between(0.15, 0.85);
      const Plan spot = place(edge, u, 0.5 + (draws_.happens(0.5) ? 0.12 : -0.12));
      const Vec red = kBrick[0];
      body(rectangle(spot, along, 0.9, 0.55), eaves + 0.6 * rise, high + 0.9, 0, Stuff::brick, red, Stuff::gravel,
           0.4 * kGravel, 2);
    }
  }

  const Plan middle = (foot[0] + foot[1] + foot[2] + foot[3]) / 4.0;
  const double half_height = (high + 0.5) / 2;
  Caster caster{above(middle, half_height), 0};
  for (const Plan& corner : edge)
    caster.radius = std::max(caster.radius, std::hypot(glm::distance(corner, middle), half_height));
  caster.first_side = static_cast<std::uint32_t>(first_side);
  caster.n_sides = static_cast<std::uint32_t>(sides.size() - first_side);
  block_.casters.push_back(caster);
}

// Colours and materials, mostly those of the neighbours.
void BlockBuilder::dress(House& house) {
  if (draws_.happens(0.3)) {
    house.wall = Stuff::brick;
    house.wall_colour = draws_.pick(kBrick);
  } else {
    house.wall_colour = draws_.pick(kPlaster);
  }
  house.wall_colour *= draws_.between(0.88, 1.1);
  const bool slate = draws_.happens(0.3);
  house.cover = house.roof == Roof::flat ? Stuff::gravel : slate ? Stuff::slate : Stuff::tiles;
  house.cover_colour = house.roof == Roof::flat ? kGravel : slate ? draws_.pick(kSlate) : draws_.pick(kTiles);
  house.cover_colour *= draws_.between(0.8, 1.2);
  house.trim = draws_.pick(kTrim);
  house.door = draws_.pick(kPaint);
}

// ---- plants and things -------------------------------------------------------------------------------------------

void BlockBuilder::tree(const Plan& foot, double low, double high) {
  const double height = draws_.between(low, high);
  Vec green = draws_.pick(kGreen);
  green *= draws_.between(0.85, 1.15);
  const double kind = draws_.next();
  constexpr double kLeaves = 0.65;
  const auto crown = [&](const Vec& middle, double across, double tall) {
    add(Part::Shape::ellipsoid, Stuff::leaves, kLeaves, green, {middle, Vec{across, tall, across}});
    block_.casters.push_back({middle, 0.9 * std::min(across, tall)});
  };
  add(Part::Shape::cone, Stuff::bark, 1.5, kBark, {above(foot, 0), Vec{0.02 * height + 0.06, 0.08, 0.6 * height}});
  if (kind < 0.15) {  // poplar
    for (const double at_height : {0.36, 0.58, 0.8})
      crown(above(foot, at_height * height), 0.11 * height * (1.25 - 0.5 * at_height), 0.22 * height);
  } else if (kind < 0.35) {  // fir
    for (const double at_height : {0.15, 0.4, 0.65}) {
      const double across = 0.26 * height * (1.05 - at_height);
      add(Part::Shape::cone, Stuff::leaves, kLeaves, 0.7 * green,
          {above(foot, at_height * height), Vec{across, 0.03, 0.38 * height}});
      block_.casters.push_back({above(foot, (at_height + 0.1) * height), 0.8 * across});
    }
  } else {
    const std::uint64_t n = 3 + draws_.bits() % 3;
    for (std::uint64_t k = 0; k < n; ++k) {
      const double up = static_cast<double>(k) / static_cast<double>(n), phi = 2.4 * static_cast<double>(k) + kind * 9;
      const double across = height * (0.27 - 0.09 * up) * draws_.between(0.85, 1.15);
      crown(above(foot, height * (0.5 + 0.34 * up)) + turn(phi) * (0.17 * height * (1 - 0.6 * up)), across,
            0.85 * across);
    }
  }
}

void BlockBuilder::bush(const Plan& foot, double low, double high) {
  const double radius = draws_.between(low, high);
  const Vec green = draws_.pick(kGreen);
  const Vec middle = above(foot, 0.7 * radius);
  add(Part::Shape::ellipsoid, Stuff::leaves, 0.8, green, {middle, Vec{radius, 0.8 * radius, radius}});
  block_.casters.push_back({middle, 0.8 * radius});
}

void BlockBuilder::car(const Plan& middle, const Plan& along) {
  const Vec paint = draws_.pick(kPaint);
  const double length = draws_.between(3.9, 4.7);
  body(rectangle(middle, along, length, 1.75), 0.22, 0.88, 0.05, Stuff::car, paint, Stuff::car, paint, 3);
  body(rectangle(middle - along * 0.2, along, 0.58 * length, 1.6), 0.88, 1.46, 0.3, Stuff::glass, kGlass, Stuff::car,
       paint, 3);
  const Plot under = rectangle(middle, along, length - 0.3, 1.6);
  body(under, 0, 0.24, 0, Stuff::door, Vec{0.04}, Stuff::door, Vec{0.04}, 0.8);
  block_.casters.push_back({above(middle + along * 1.1, 0.6), 0.8});
  block_.casters.push_back({above(middle - along * 1.1, 0.6), 0.8});
  block_.casters.push_back({above(middle, 0.8), 0.85});
}

void BlockBuilder::lamp(const Plan& foot) {
  add(Part::Shape::cone, Stuff::trim, 4, Vec{0.22, 0.25, 0.24}, {above(foot, 0), Vec{0.09, 0.05, 5.2}});
  add(Part::Shape::ellipsoid, Stuff::trim, 4, Vec{0.85, 0.84, 0.75}, {above(foot, 5.35), Vec{0.24, 0.22, 0.24}});
}

double part_area(const Part& part) {
  const auto& c = part.corner;
  switch (part.shape) {
    case Part::Shape::quad: return glm::length(glm::cross(c[1] + c[2] - c[0] - c[3], c[3] + c[2] - c[0] - c[1])) / 4;
    case Part::Shape::ellipsoid: return 4 * kPi * (2 * c[1].x * c[1].y + c[1].x * c[1].x) / 3;
    case Part::Shape::cone: return kPi * (c[1].x + c[1].y) * std::hypot(c[1].x - c[1].y, c[1].z);
    default: return 0;
  }
}

// ---- plots -------------------------------------------------------------------------------------------------------

void BlockBuilder::detached(const Plot& plot) {
  const double w = width(plot), d = depth(plot);
  House house;
  constexpr std::array<Roof, 5> kRoofs{{Roof::gable, Roof::gable, Roof::gable_across, Roof::hip, Roof::flat}};
  house.roof = draws_.pick(kRoofs);
  dress(house);
  house.storeys = draws_.happens(0.6) ? 2 : 1;
  house.storey = draws_.between(2.6, 3.0);
  house.slope = draws_.between(0.65, 1.1);
  house.window = draws_.between(1.0, 1.5);
  house.row = draws_.between(2.6, 3.4);
  house.shutters = draws_.happens(0.35);
  house.dormers = house.roof == Roof::gable && draws_.happens(0.4) ? 2 : 0;
  const double wide = std::min(w - 2.6, draws_.between(8, 12)), deep = std::min(0.5 * d, draws_.between(7.5, 10.5));
  const double u0 = (w - wide) * draws_.between(0.3, 0.7) / w, u1 = u0 + wide / w, v0 = draws_.between(3.5, 6) / d,
               v1 = v0 + deep / d;
  house.foot = piece(plot, u0, u1, v0, v1);
  this->house(house);

  // Ground: front garden with a path, strips beside the house, terrace and back garden.
  const double path = u0 + (u1 - u0) * draws_.between(0.3, 0.6), half = 0.7 / w;
  const Vec lawn = kLawn * draws_.between(0.8, 1.15);
  const bool drive = draws_.happens(0.5);
  ground(Stuff::lawn, 0.8, lawn, piece(plot, 0, path - half, 0, v0));
  ground(Stuff::paving, 1.2, kPaving * draws_.between(0.8, 1.1), piece(plot, path - half, path + half, 0, v0));
  ground(Stuff::lawn, 0.8, lawn, piece(plot, path + half, u1, 0, v0));
  ground(drive ? Stuff::gravel : Stuff::lawn, 0.8, drive ? kGravel : lawn, piece(plot, u1, 1, 0, v0));
  ground(Stuff::gravel, 0.7, kGravel, piece(plot, 0, u0, v0, v1));
  ground(drive ? Stuff::gravel : Stuff::lawn, 0.7, drive ? kGravel : lawn, piece(plot, u1, 1, v0, v1));
  const double back = v1 + 2.8 / d;
  ground(Stuff::lawn, 0.8, lawn, piece(plot, 0, u0, v1, back));
  ground(Stuff::paving, 1.0, kPaving * draws_.between(0.8, 1.2), piece(plot, u0, u1, v1, back));
  ground(Stuff::lawn, 0.8, lawn, piece(plot, u1, 1, v1, back));
  ground(Stuff::lawn, 0.8, lawn, piece(plot, 0, 1, back, 1));

  const double border = draws_.next(), thick = (border < 0.45 ? 0.7 : 0.2) / d;
  const Vec green = draws_.pick(kGreen);
  const double last = drive ? u1 : 1;
  for (const auto& [from, to] : {std::pair{0.0, path - half}, std::pair{path + half, last}}) {
    if (to - from < 0.05) continue;
    const Plot line = piece(plot, from, to, 0.01, 0.01 + thick);
    if (border < 0.45) {
      hedge(line, 1.2, green);
    } else if (border < 0.85) {
      body(line, 0, 0.9, 0, border < 0.65 ? Stuff::trim : Stuff::brick, border < 0.65 ? house.trim : kBrick[1],
           Stuff::trim, house.trim, 1.2);
    }
  }
  hedge(piece(plot, 0, 0.6 / w, v1, 1), draws_.between(1.0, 1.9), green);
  if (draws_.happens(0.5)) hedge(piece(plot, 0.02, 1, 1 - 0.6 / d, 1), draws_.between(1.0, 1.9), green);
  if (drive && draws_.happens(0.7)) {
    const Plan along = glm::normalize(plot[3] - plot[0]);
    car(place(plot, (u1 + 1) / 2, 0.6 * v0), along);
  }
  if (draws_.happens(0.4)) {
    House shed;
    shed.storeys = 1;
    shed.storey = 2;
    shed.wall_colour = Vec{0.40, 0.29, 0.19};
    shed.wall = Stuff::trim;
    shed.cover = Stuff::slate;
    shed.cover_colour = draws_.pick(kSlate);
    shed.attached = true;
    shed.chimneys = 0;
    shed.over = 0.2;
    shed.slope = 0.5;
    shed.row = 4;
    shed.foot = piece(plot, 1 - 4.0 / w, 1 - 0.9 / w, 1 - 4.2 / d, 1 - 1.2 / d);
    this->house(shed);
  }
  for (std::uint64_t k = draws_.bits() % 4; k < 4; ++k) tree(somewhere(plot, 0.12, 0.85, back + 0.08, 0.92), 4, 10);
  if (draws_.happens(0.5)) {
    const double u = draws_.happens(0.5) ? 0.1 : 0.9;
    tree(somewhere(plot, u, u, 0.4 * v0, 0.7 * v0), 3, 7);
  }
  const double front = v0 - 0.9 / d;
  for (int k = 0; k < 2; ++k) bush(somewhere(plot, 0.08, 0.92, front, front), 0.35, 0.9);
  for (int k = 0; k < 3; ++k) bush(somewhere(plot, 0.08, 0.92, back, 0.95), 0.35, 0.9);
}

void BlockBuilder::terraced(const Plot& plot, double set_back, bool shops) {
  const double d = depth(plot);
  House house;
  house.attached = true;
  house.roof = draws_.happens(0.85) ? Roof::gable : Roof::flat;
  dress(house);
  house.storeys = 3 + static_cast<int>(draws_.bits() % 2);
  house.storey = draws_.between(2.9, 3.4);
  house.slope = draws_.between(0.7, 1.1);
  house.window = draws_.between(0.95, 1.25);
  house.sill = draws_.between(0.6, 0.95);
  house.row = draws_.between(2.0, 2.6);
  house.shop = shops && draws_.happens(0.7);
  house.shutters = draws_.happens(0.3);
  house.dormers = house.roof == Roof::gable && draws_.happens(0.6) ? 2 : 0;
  const double v0 = set_back / d, v1 = v0 + draws_.between(9.5, 12) / d;
  house.foot = piece(plot, 0, 1, v0, v1);
  this->house(house);
  if (v0 > 0) ground(Stuff::paving, 1.0, kPaving, piece(plot, 0, 1, 0, v0));
  const double yard = v1 + draws_.between(2, 5) / d;
  ground(Stuff::paving, 0.8, 0.9 * kPaving, piece(plot, 0, 1, v1, yard));
  ground(Stuff::lawn, 0.8, kLawn * draws_.between(0.8, 1.15), piece(plot, 0, 1, yard, 1));
  const Vec brick = draws_.pick(kBrick);
  body(piece(plot, 0, 0.03, yard, 1), 0, 1.7, 0, Stuff::brick, brick, Stuff::brick, brick, 0.8);
  if (draws_.happens(0.75)) tree(somewhere(plot, 0.3, 0.7, yard + 0.1, 0.9), 4, 8);
  for (int k = 0; k < 2; ++k) bush(somewhere(plot, 0.15, 0.85, yard, 0.95), 0.4, 0.8);
}

void BlockBuilder::apartments(const Plot& plot) {
  const double w = width(plot), d = depth(plot);
  House house;
  house.roof = Roof::flat;
  dress(house);
  house.wall = Stuff::plaster;
  house.wall_colour = glm::mix(draws_.pick(kPlaster), Vec{0.75, 0.74, 0.72}, 0.5);
  house.storeys = 5 + static_cast<int>(draws_.bits() % 3);
  house.window = 1.6;
  house.row = 3.1;
  house.balconies = true;
  house.chimneys = 2;
  const double u0 = 3.5 / w, u1 = 1 - u0, v0 = 5.5 / d, v1 = v0 + std::min(0.5 * d, 11.0) / d;
  house.foot = piece(plot, u0, u1, v0, v1);
  this->house(house);
  const Vec lawn = kLawn * draws_.between(0.8, 1.1);
  ground(Stuff::lawn, 0.7, lawn, piece(plot, 0, 0.47, 0, v0));
  ground(Stuff::paving, 0.9, kPaving, piece(plot, 0.47, 0.53, 0, v0));
  ground(Stuff::lawn, 0.7, lawn, piece(plot, 0.53, 1, 0, v0));
  ground(Stuff::lawn, 0.7, lawn, piece(plot, 0, u0, v0, v1));
  ground(Stuff::lawn, 0.7, lawn, piece(plot, u1, 1, v0, v1));
  ground(Stuff::asphalt, 0.7, kAsphalt, piece(plot, 0, 1, v1, 1));
  const Plan across = glm::normalize(plot[3] - plot[0]);
  for (double s = 3; s < w - 3; s += 2.9)
    if (draws_.happens(0.6)) car(place(plot, s / w, 1 - 3.2 / d), across);
  for (int k = 0; k < 5; ++k) tree(somewhere(plot, 0.05, 0.95, 0.2 * v0, 0.6 * v0), 5, 9);
}

void BlockBuilder::park(const Plot& plot) {
  const double w = width(plot), d = depth(plot);
  const std::array<double, 4> u{0, 0.5 - 2 / w, 0.5 + 2 / w, 1}, v{0, 0.5 - 2 / d, 0.5 + 2 / d, 1};
  for (std::size_t a = 0; a < 3; ++a)
    for (std::size_t b = 0; b < 3; ++b) {
      const Plot cell = piece(plot, u[a], u[a + 1], v[b], v[b + 1]);
      if (a == 1 || b == 1) {
        ground(Stuff::gravel, 0.8, kGravel * 1.15, cell);
      } else if (a == 2 && b == 2) {  // a pond
        ground(Stuff::lawn, 0.7, kLawn, piece(cell, 0, 1, 0, 0.2));
        ground(Stuff::lawn, 0.7, kLawn, piece(cell, 0, 0.2, 0.2, 0.8));
        ground(Stuff::water, 1.2, kWater, piece(cell, 0.2, 0.8, 0.2, 0.8), -0.1);
        ground(Stuff::lawn, 0.7, kLawn, piece(cell, 0.8, 1, 0.2, 0.8));
        ground(Stuff::lawn, 0.7, kLawn, piece(cell, 0, 1, 0.8, 1));
      } else {
        ground(Stuff::lawn, 0.7, kLawn, cell);
      }
    }
  const Plan middle = place(plot, 0.5, 0.5);
  add(Part::Shape::cone, Stuff::trim, 2, kPaving, {above(middle, 0), Vec{1.5, 1.5, 0.5}});
  add(Part::Shape::cone, Stuff::trim, 2, kPaving, {above(middle, 0), Vec{0.25, 0.15, 1.8}});
  add(Part::Shape::ellipsoid, Stuff::trim, 2, kPaving, {above(middle, 1.9), Vec{0.5, 0.2, 0.5}});
  for (std::size_t k = 0; k < 34; ++k) {
    const double x = draws_.between(0.04, 0.96), y = draws_.between(0.04, 0.96);
    const bool on_path = std::abs(x - 0.5) < 4 / w || std::abs(y - 0.5)<4 / d, in_pond = x> 0.57 && y > 0.57;
    if (!on_path && (!in_pond || k % 4 == 0)) tree(place(plot, x, in_pond ? 0.95 : y), 6, 14);
  }
  for (int k = 0; k < 14; ++k) bush(somewhere(plot, 0.03, 0.45, 0.03, 0.97), 0.4, 1.1);
}

void BlockBuilder::church(const Plot& plot) {
  const double w = width(plot), d = depth(plot);
  const double u0 = 0.5 - 16 / w, u1 = 0.5 + 16 / w, v0 = 0.5 - 6.5 / d, v1 = 0.5 + 6.5 / d;
  House nave;
  nave.foot = piece(plot, u0, u1, v0, v1);
  nave.storeys = 1;
  nave.storey = 10;
  nave.wall_colour = Vec{0.70, 0.65, 0.56};
  nave.cover = Stuff::slate;
  nave.cover_colour = kSlate[0];
  nave.slope = 1.3;
  nave.sill = 3;
  nave.window = 1.5;
  nave.row = 4.4;
  nave.chimneys = 0;
  house(nave);
  House tower = nave;
  tower.foot = piece(plot, u0 - 7 / w, u0, 0.5 - 3.5 / d, 0.5 + 3.5 / d);
  tower.storeys = 6;
  tower.storey = 4.6;
  tower.sill = 1.6;
  tower.row = 3;
  tower.window = 0.9;
  tower.roof = Roof::hip;
  tower.slope = 4.2;
  tower.over = 0.25;
  house(tower);
  const Vec stone = kPaving * 1.1;
  ground(Stuff::paving, 0.8, stone, piece(plot, 0, 1, 0, v0));
  ground(Stuff::paving, 0.8, stone, piece(plot, 0, u0, v0, v1));
  ground(Stuff::paving, 0.8, stone, piece(plot, u1, 1, v0, v1));
  ground(Stuff::paving, 0.8, stone, piece(plot, 0, 1, v1, 1));
  for (int k = 0; k < 9; ++k) {
    tree(place(plot, 0.06 + 0.11 * k, 0.08), 5, 7);
    tree(place(plot, 0.06 + 0.11 * k, 0.93), 5, 7);
  }
}

// ---- streets -----------------------------------------------------------------------------------------------------

// Paint on the half of the street at the left of `from` to `to`: zebra crossings within first .. last and, if `line`, the
// middle line between them.
void BlockBuilder::markings(const Plan& from, const Plan& to, double first, double last, double half, bool line) {
  const Plan along = glm::normalize(to - from), in{-along.y, along.x};
  const auto paint = [&](double s0, double s1, double r0, double r1) {
    const Plan a = from + along * s0, b = from + along * s1;
    ground(Stuff::trim, 2.5, kWhite, {a + in * r0, b + in * r0, b + in * r1, a + in * r1}, 0.02);
  };
  for (const double s : {first, last - 3}) {
    if (draws_.happens(0.45)) continue;
    for (double r = 0.25; r < half - 0.5; r += 1) paint(s, s + 3, r, r + 0.5);
  }
  for (double s = first + 5; line && s < last - 7; s += 6) paint(s, s + 3, -0.08, 0.08);
}

void BlockBuilder::streets(const Plot& middle, const Plot& kerb, const Plot& inner,
                           const std::array<Street, 4>& sides) {
  for (std::size_t k = 0; k < 4; ++k) {
    const std::size_t n = (k + 1) % 4;
    const double length = glm::distance(middle[k], middle[n]);
    quad(Stuff::asphalt, 0.8, kAsphalt * draws_.between(0.85, 1.2),
         {above(middle[k], 0), above(middle[n], 0), above(kerb[n], 0), above(kerb[k], 0)});
    markings(middle[k], middle[n], sides[(k + 3) % 4].road + 1.2, length - sides[n].road - 1.2, sides[k].road,
             k == 0 || k == 3);
    quad(Stuff::trim, 2, 1.1 * kPaving,
         {above(kerb[k], 0), above(kerb[n], 0), above(kerb[n], 0.12), above(kerb[k], 0.12)});
    quad(Stuff::paving, 1.0, kPaving * draws_.between(0.85, 1.1),
         {above(kerb[k], 0.12), above(kerb[n], 0.12), above(inner[n], 0.1), above(inner[k], 0.1)});

    const double side = glm::distance(kerb[k], kerb[n]);
    const Plan along = (kerb[n] - kerb[k]) / side, out{along.y, -along.x};
    const bool wide = sides[k].road > 4;
    const double busy = draws_.between(0.15, 0.7);
    for (double s = 9; s < side - 9; s += 5.8)
      if (draws_.happens(busy)) car(kerb[k] + along * (s + draws_.between(-0.3, 0.3)) + out * 1.15, along);
    for (double s = 5; s < side - 4; s += wide ? 9.0 : 26.0) {
      const Plan spot = kerb[k] + along * s - out * 0.6;
      if (wide && draws_.happens(0.75)) tree(spot, 5, 8);
    }
    for (double s = 9.5; s < side - 4; s += 25) lamp(kerb[k] + along * s - out * 0.4);
  }
}

}  // namespace

// ---- the town ------------------------------------------------------------------------------------------------------

Vec TownPlan::crossing(int i, int j) const {
  Draws draws(key_of(seed_, i, j, 1));
  const double x = draws.between(-0.07, 0.07), z = draws.between(-0.08, 0.08);
  return at((i + x) * kPitchX, 0, (j + z) * kPitchZ);
}

Block TownPlan::block(int i, int j) const {
  Block block;
  BlockBuilder builder(block, key_of(seed_, i, j, 2));
  Draws& draws = builder.draws();
  Plot middle{};
  for (std::size_t k = 0; k < 4; ++k) {
    const Vec c = crossing(i + (k == 1 || k == 2 ? 1 : 0), j + (k >= 2 ? 1 : 0));
    middle[k] = {c.x, c.z};
  }
  const std::array<Street, 4> sides{street(j), street(i + 1), street(j + 1), street(i)};
  std::array<double, 4> roads{}, walks{};
  for (std::size_t k = 0; k < 4; ++k) {
    roads[k] = -sides[k].road;
    walks[k] = -sides[k].road - sides[k].pavement;
  }
  const Plot kerb = outset(middle, roads), inner = outset(middle, walks);

  // Dense in the middle, green outside; one church, a park beside it and some more.
  const double out = std::hypot(i + 0.5, j + 0.5), luck = draws.next();
  if ((i == -1 && j == 0) || luck < 0.01) {
    builder.church(inner);
  } else if ((i == 1 && j == -1) || luck < 0.06) {
    builder.park(inner);
  } else {
    for (int row = 0; row < 2; ++row) {
      const double dense = 0.95 - 0.14 * out + 0.5 * (noise(0.4 * i + 7, 0.4 * j + 3) - 0.5), roll = draws.next();
      enum {
        terraced,
        apartments,
        detached
      } kind = roll < dense          ? terraced
               : roll < dense + 0.16 ? apartments
                                     : detached;
      if (out < 0.8) kind = row == 0 ? terraced : detached;
      const double length = glm::distance(inner[0], inner[1]);
      const int n = std::max(2, static_cast<int>(length /
                                                 (kind == terraced     ? 8
                                                  : kind == apartments ? 30
                                                                       : 14) *
                                                 draws.between(0.9, 1.12)));
      const double set_back = draws.happens(0.5) ? 0 : draws.between(0.8, 2);
      const bool shops = sides[row == 0 ? 0 : 2].road > 4;
      double u = 0;
      for (int k = 1; k <= n; ++k) {
        const double next = k == n ? 1 : (k + 0.24 * (draws.next() - 0.5)) / n;
        const Plot plot = row == 0 ? piece(inner, u, next, 0, 0.5) : piece(inner, 1 - u, 1 - next, 1, 0.5);
        if (kind == terraced) builder.terraced(plot, set_back, shops);
        if (kind == apartments) builder.apartments(plot);
        if (kind == detached) builder.detached(plot);
        u = next;
      }
    }
  }
  builder.streets(middle, kerb, inner, sides);
  const Plan centre = place(middle, 0.5, 0.5);
  Part& fog = builder.add(Part::Shape::fog, Stuff::floater, 1, Vec{0.5},
                          {above(centre, 0), Vec{0.45 * kPitchX, 18, 0.45 * kPitchZ}});
  double total = 0;
  for (Part& part : block.parts) {
    if (part.shape != Part::Shape::fog) part.area = part_area(part);
    total += part.area * part.detail;
  }
  fog.area = 0.003 * total;  // of every thousand Gaussians three float in the air
  return block;
}

Block TownPlan::surroundings(int first, int last, int sector, double backdrop) const {
  Block block;
  BlockBuilder builder(block, key_of(seed_, sector, last - first, 3));
  Draws& draws = builder.draws();
  const double from = 2 * kPi * sector / kSectors, to = 2 * kPi * (sector + 1) / kSectors;
  const Vec span{from, to, 0}, town{static_cast<double>(first), static_cast<double>(last), 0};
  const auto add = [&](Part::Shape shape, Stuff stuff, double share, const Vec& what) {
    builder.add(shape, stuff, backdrop, Vec{0.5}, {span, what, town}).area = share;
  };
  add(Part::Shape::country, Stuff::field, 0.74, {});
  for (int k = 0; k < 3; ++k) add(Part::Shape::ridge, Stuff::hill, 0.03, Vec{2600 + 800 * k, 130 + 110 * k, k + 1});
  add(Part::Shape::dome, Stuff::sky, 0.17, {});
  const double middle = (first + last) / 2.0;
  for (int k = 0; k < 6 * (last - first); ++k) {
    const double phi = draws.between(from, to);
    const Vec d = turn(phi);
    const double off = draws.next();
    const double r = edge_distance(first, last, d.x, d.z) + 25 + 400 * off * off;
    const std::size_t before = block.parts.size();
    builder.tree(Plan{middle * kPitchX + d.x * r, middle * kPitchZ + d.z * r}, 5, 13);
    for (std::size_t p = before; p < block.parts.size(); ++p) {
      Part& part = block.parts[p];
      part.area = part_area(part);
      part.detail *= 0.6;
    }
  }
  return block;
}

double edge_distance(int first, int last, double x, double z) {
  constexpr double kIn = 14;  // crossings lie up to 6 m beside the grid
  const double half_x = (last - first) * TownPlan::kPitchX / 2 - kIn,
               half_z = (last - first) * TownPlan::kPitchZ / 2 - kIn;
  return std::min(half_x / std::max(std::abs(x), 1e-9), half_z / std::max(std::abs(z), 1e-9));
}

Box part_box(const Part& part) {
  Box box;
  const auto cover = [&box](const Vec& p, const Vec& margin) {
    box.low = glm::min(box.low, p - margin);
    box.high = glm::max(box.high, p + margin);
  };
  const auto& c = part.corner;
  switch (part.shape) {
    case Part::Shape::quad:
      for (const Vec& p : c) cover(p, Vec{0.5});
      break;
    case Part::Shape::ellipsoid: cover(c[0], 1.3 * c[1]); break;
    case Part::Shape::cone: {
      const double wide = 1.3 * std::max(c[1].x, c[1].y);
      cover(c[0] + kUp * (c[1].z / 2), Vec{wide, 0.65 * c[1].z + 0.2, wide});
      break;
    }
    case Part::Shape::fog: cover(c[0] + kUp * (c[1].y / 2), Vec{c[1].x, c[1].y / 2, c[1].z}); break;
    default: {  // a sector of 45 degrees, the first along x: ends of its arcs are its extremes
      const int first = static_cast<int>(c[2].x), last = static_cast<int>(c[2].y);
      const double middle = (first + last) / 2.0;
      const Vec centre{middle * TownPlan::kPitchX, 0, middle * TownPlan::kPitchZ};
      for (const double phi : {c[0].x, c[0].y}) {
        const Vec d = turn(phi);
        cover(centre + d * edge_distance(first, last, d.x, d.z), Vec{1});
        cover(centre + d * (1.01 * TownPlan::kFar), Vec{1});
      }
      if (part.shape != Part::Shape::country) {  // hills and sky
        cover(centre, Vec{1});
        box.low.y = -1.01 * TownPlan::kFar;
        box.high.y = 0.04 * TownPlan::kFar;
      }
      break;
    }
  }
  return box;
}

}  // namespace rgs::detail
