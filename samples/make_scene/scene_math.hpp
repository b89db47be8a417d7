// scene_math.hpp - shared by the synthetic scenes: stateless random numbers, noise, rotations, harmonics.
// SPDX-License-Identifier: Apache-2.0
//
// A random choice is a hash of (seed, index, purpose), so that every Gaussian can be made without the others.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <glm/glm.hpp>
#include <span>

#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

using Vec = glm::dvec3;

inline constexpr double kPi = 3.14159265358979323846;
inline const Vec kUp{0, -1, 0};
inline const Vec kSun = glm::normalize(Vec{0.62, -0.80, -0.62});  // towards the sun
inline const Vec kSunRight = glm::normalize(glm::cross(kSun, kUp)), kSunUp = glm::cross(kSunRight, kSun);

// ---- hashing ---------------------------------------------------------------------------------------------------

inline constexpr std::uint64_t kGolden = 0x9E3779B97F4A7C15;

// Finaliser of SplitMix64 (Steele, Lea and Flood 2014).
constexpr std::uint64_t mix(std::uint64_t x) {
  x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9;
  x = (x ^ (x >> 27)) * 0x94D049BB133111EB;
  return x ^ (x >> 31);
}

constexpr double unit(std::uint64_t bits) {  // [0, 1)
  return static_cast<double>(bits >> 11) * 0x1p-53;
}

// The purpose of a random number; each has its own stream.
enum class Use : std::uint64_t { spin, spin_sign, size, thin, flat, opacity, tone, hue, place, tilt, lean, rare, sh };

// Random numbers of one Gaussian.
class Dice {
 public:
  Dice(std::uint64_t seed, std::uint64_t index) : key_(mix(seed + mix(index + kGolden))) {}
  std::uint64_t bits(Use use, std::uint64_t k = 0) const {
    return mix(key_ + (static_cast<std::uint64_t>(use) * 64 + k + 1) * kGolden);
  }
  double uniform(Use use, std::uint64_t k = 0) const { return unit(bits(use, k)); }
  // Mean 0, deviation 1, within +-3.5: four 16-bit uniforms summed (Irwin and Hall), no transcendental function.
  double normal(Use use, std::uint64_t k = 0) const {
    const std::uint64_t b = bits(use, k);
    const double sum = static_cast<double>((b & 0xFFFF) + (b >> 16 & 0xFFFF) + (b >> 32 & 0xFFFF) + (b >> 48));
    return (sum - 131070) / 37837.2;
  }
  Vec vector(Use use, std::uint64_t k = 0) const { return Vec{normal(use, k), normal(use, k + 1), normal(use, k + 2)}; }

 private:
  std::uint64_t key_;
};

inline double lattice(std::int64_t x, std::int64_t y) {
  return unit(mix(static_cast<std::uint64_t>(x) * kGolden + mix(static_cast<std::uint64_t>(y) + 0x632BE59BD9B4E019)));
}

inline double smooth(double t) {
  t = std::clamp(t, 0.0, 1.0);
  return t * t * (3 - 2 * t);
}

// Value noise in [0, 1] with unit lattice distance; three octaves in fractal_noise.
inline double noise(double x, double y) {
  const double fx = std::floor(x), fy = std::floor(y), a = smooth(x - fx), b = smooth(y - fy);
  const auto i = static_cast<std::int64_t>(fx), j = static_cast<std::int64_t>(fy);
  return std::lerp(std::lerp(lattice(i, j), lattice(i + 1, j), a),
                   std::lerp(lattice(i, j + 1), lattice(i + 1, j + 1), a), b);
}

inline double fractal_noise(double x, double y) {
  return (4 * noise(x, y) + 2 * noise(2 * x + 17, 2 * y + 5) + noise(4 * x + 41, 4 * y + 29)) / 7;
}

// Bricks, tiles and paving: cells of width x height with every second row shifted by half.
struct Cell {
  double tone;  // of this cell, [0, 1]
  double x, y;  // position within it, [0, 1)
};

inline Cell cell(double s, double r, double width, double height) {
  const double row = std::floor(r / height), shift = row - 2 * std::floor(row / 2) > 0.5 ? 0.5 : 0;
  const double column = std::floor(s / width + shift);
  return {lattice(static_cast<std::int64_t>(column), static_cast<std::int64_t>(row)), s / width + shift - column,
          r / height - row};
}

// ---- geometry --------------------------------------------------------------------------------------------------

inline Vec at(double x, double height, double z) {
  return {x, -height, z};
}

inline Vec any_tangent(const Vec& n) {
  return glm::normalize(glm::cross(n, std::abs(n.y) < 0.9 ? kUp : Vec{1, 0, 0}));
}

inline Vec turn(double angle) {
  return {std::cos(angle), 0, std::sin(angle)};
}

struct HalfSpace {  // dot(n, p) <= d
  Vec n;
  double d;
};

// Length of the ray from p to the sun inside a convex body; negative if it misses. A ray that leaves at once starts on the body's own
// surface.
inline double way_through(std::span<const HalfSpace> body, const Vec& p) {
  double enter = 0.02, leave = 1e9;
  for (const HalfSpace& side : body) {
    const double slope = glm::dot(side.n, kSun), room = side.d - glm::dot(side.n, p);
    (slope < 0 ? enter : leave) =
        slope < 0 ? std::max(enter, room / slope) : std::min(leave, slope > 0 ? room / slope : leave);
    if (slope == 0 && room < 0) leave = -1;
  }
  return leave - enter;
}

// Horizon of hill range `range` above the ground at azimuth phi; sines of whole multiples close without a seam.
inline double ridge_height(double phi, double range) {
  return 0.55 + 0.2 * std::sin(3 * phi + 2.1 * range) + 0.16 * std::sin(5 * phi + range) +
         0.07 * std::sin(11 * phi - 2 * range) + 0.03 * std::sin(23 * phi);
}

// Colour of a sky of radius `far` at p.
inline Vec sky_colour(const Vec& p, double far) {
  const double h = std::max(0.0, -p.y / far);
  const Vec blue = glm::mix(Vec{0.80, 0.88, 0.94}, Vec{0.26, 0.48, 0.80}, smooth(1.7 * h));
  // Clouds on a plane above the ground, which crowds them towards the horizon.
  const double scale = 1.5 / (h + 0.12) / far, cover = fractal_noise(p.x * scale + 7, p.z * scale + 3);
  return glm::mix(blue, Vec{0.97, 0.97, 0.98}, 0.85 * smooth(4.5 * cover - 2.2) * smooth(6 * h));
}

// The quaternion of the frame x, y, z, scaled to `length`.
inline void set_rotation(const Vec& x, const Vec& y, const Vec& z, double length, float out[4]) {
  // Shepperd 1978: divide by the largest of the four components.
  const double t0 = 1 + x.x + y.y + z.z, t1 = 1 + x.x - y.y - z.z, t2 = 1 - x.x + y.y - z.z, t3 = 1 - x.x - y.y + z.z;
  std::array<double, 4> q{};
  if (t0 >= t1 && t0 >= t2 && t0 >= t3) {
    q = {t0, y.z - z.y, z.x - x.z, x.y - y.x};
  } else if (t1 >= t2 && t1 >= t3) {
    q = {y.z - z.y, t1, x.y + y.x, z.x + x.z};
  } else if (t2 >= t3) {
    q = {z.x - x.z, x.y + y.x, t2, y.z + z.y};
  } else {
    q = {x.y - y.x, z.x + x.z, y.z + z.y, t3};
  }
  const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; ++k) out[k] = static_cast<float>(q[static_cast<std::size_t>(k)] * (length / norm));
}

// ---- harmonics -------------------------------------------------------------------------------------------------

// Real spherical harmonics with the signs of the 3DGS code (Condon and Shortley's phase) at the unit direction d.
inline std::array<double, 16> harmonics(const Vec& d) {
  const double x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  return {0.28209479177387814,
          -0.4886025119029199 * y,
          0.4886025119029199 * z,
          -0.4886025119029199 * x,
          1.0925484305920792 * x * y,
          -1.0925484305920792 * y * z,
          0.31539156525252005 * (2 * zz - xx - yy),
          -1.0925484305920792 * x * z,
          0.5462742152960396 * (xx - yy),
          -0.5900435899266435 * y * (3 * xx - yy),
          2.890611442640554 * x * y * z,
          -0.4570457994644658 * y * (4 * zz - xx - yy),
          0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
          -0.4570457994644658 * x * (4 * zz - xx - yy),
          1.445305721320277 * z * (xx - yy),
          -0.5900435899266435 * x * (xx - 3 * yy)};
}

// The ingredients of a Gaussian's colour.
struct Shine {
  Vec colour;          // as lit, without reflections
  Vec n;               // unit normal
  double gloss = 0;    // share of mirror reflection
  Vec sun{0};          // highlight of the sun
  double noise = 1;    // of the harmonics above degree 0
  double dc_gain = 1;  // 1 but for outliers
};

// Colour: 0.5 + sum of coefficients times harmonics of the direction from the camera to the splat.
inline void set_harmonics(const Shine& shine, const Dice& dice, int sh_degree, float out[48]) {
  constexpr double kY0 = 0.28209479177387814, kY1 = 0.4886025119029199;
  Vec colour = shine.colour;
  Vec reflected{0};  // colour = base + reflected * dot(view, bend): the mirror image of a sky that brightens upwards
  Vec bend{0};
  if (shine.gloss > 0.02) {
    // The reflected ray r = d - 2 (d.n) n meets the sky at height r.up, which is linear in d: exact in degree 1.
    bend = kUp - 2 * glm::dot(kUp, shine.n) * shine.n;
    reflected = shine.gloss * Vec{0.30, 0.36, 0.44};
    colour = colour * (1 - shine.gloss) + shine.gloss * Vec{0.42, 0.47, 0.50};
  }
  Vec dc = (colour - 0.5) / kY0 + 0.05 * dice.normal(Use::tone, 2);
  dc *= shine.dc_gain;
  for (int c = 0; c < 3; ++c) out[c] = static_cast<float>(std::clamp(dc[c], -8.0, 8.0));
  if (sh_degree == 0) return;

  std::array<double, 16> lobe{};
  if (shine.gloss > 0.02) lobe = harmonics(2 * glm::dot(shine.n, kSun) * -shine.n + kSun);
  // Noise: with what gloss adds, a deviation near 0.06, 0.03, 0.02 in degrees 1, 2, 3; a factor per Gaussian with
  // E[f^2] = 1 and a long tail; the channels share most of it, as they do after training.
  constexpr double kDeviation[4] = {0, 0.042, 0.025, 0.017};
  constexpr double kLobe[4] = {0, 0.55, 0.40, 0.24};  // a highlight about 40 degrees wide, cut at degree 3
  const double factor = shine.noise / std::sqrt(3.536 * (dice.uniform(Use::sh) + 0.03));
  const Vec linear[4] = {Vec{0}, -bend.y / kY1 * reflected, bend.z / kY1 * reflected, -bend.x / kY1 * reflected};
  const int n_coefficients = sh_coefficients(sh_degree);
  for (int k = 1; k < n_coefficients; ++k) {
    const int degree = sh_degree_of(k);
    const std::uint64_t b = dice.bits(Use::sh, static_cast<std::uint64_t>(k));
    const auto part16 = [b](int s) { return static_cast<double>(b >> s & 0xFFFF) * 0x1p-16 - 0.5; };
    const double shared = part16(0) + part16(16), own[3] = {part16(32), part16(48), -part16(32)};
    const double gain = kDeviation[degree] * factor * 2.38;
    for (int c = 0; c < 3; ++c) {
      double value = gain * (shared + 0.35 * own[c]) + kLobe[degree] * shine.sun[c] * lobe[static_cast<std::size_t>(k)];
      if (degree == 1) value += linear[k][c];
      out[3 * k + c] = static_cast<float>(value);
    }
  }
}

}  // namespace rgs::detail
