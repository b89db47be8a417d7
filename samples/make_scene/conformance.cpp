// conformance.cpp - see conformance.hpp.
// SPDX-License-Identifier: Apache-2.0
#include "conformance.hpp"

#include <array>
#include <cmath>
#include <glm/geometric.hpp>
#include <utility>

namespace rgs {
namespace {

using Rgb = std::array<double, 3>;
using Quaternion = std::array<double, 4>;  // w, x, y, z

constexpr int kSide = 65;
constexpr double kFocal = 64, kMiddle = 32;  // px; pixel (32, 32) is the middle one
constexpr double kShC0 = 0.28209479177387814;
constexpr double kDegree = 0.017453292519943295;
constexpr Rgb kRed{1, 0.1, 0.1}, kGreen{0.1, 1, 0.1}, kBlue{0.1, 0.1, 1}, kWhite{1, 1, 1};

// Without rotation, at the world's origin: looks along +z, x to the right and y down.
Camera front_camera(int width = kSide, int height = kSide) {
  Camera camera;
  camera.name = "front";
  camera.width = width;
  camera.height = height;
  camera.fx = camera.fy = kFocal;
  camera.cx = 0.5 * width;
  camera.cy = 0.5 * height;
  return camera;
}

// At `eye`, with `target` in the middle of the picture.
Camera camera_at(const char* name, const glm::dvec3& eye, const glm::dvec3& target) {
  Camera camera = look_at(eye, target, kWorldUp, {.width = kSide, .height = kSide, .horizontal_fov = 60});
  camera.name = name;
  camera.fx = camera.fy = kFocal;
  return camera;
}

// Around the axis (x, y, z), a unit vector.
Quaternion turned(double degrees, double x, double y, double z) {
  const double half = 0.5 * degrees * kDegree;
  return {std::cos(half), x * std::sin(half), y * std::sin(half), z * std::sin(half)};
}

// What is rotated by b is then rotated by a.
Quaternion product(const Quaternion& a, const Quaternion& b) {
  return {a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3], a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
          a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1], a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
}

// A Gaussian by what it looks like in front_camera(): steps that return the changed Gaussian.
class Gaussian {
 public:
  // Its mean is seen in the middle of pixel (x, y), whole or not, at depth z.
  Gaussian(double x, double y, double z = 4) : z_(z) {
    splat_.mean[0] = static_cast<float>((x - kMiddle) * z / kFocal);
    splat_.mean[1] = static_cast<float>((y - kMiddle) * z / kFocal);
    splat_.mean[2] = static_cast<float>(z);
    round(3).opacity(0.9).colour(kWhite);
  }
  static Gaussian at(double x, double y, double z) {  // in the world
    Gaussian g(kMiddle, kMiddle);
    g.splat_.mean[0] = static_cast<float>(x);
    g.splat_.mean[1] = static_cast<float>(y);
    g.splat_.mean[2] = static_cast<float>(z);
    return g;
  }
  // Standard deviations along the local axes, in pixels at the mean's depth.
  Gaussian& sigmas(double x, double y, double z) {
    const std::array<double, 3> px{x, y, z};
    for (std::size_t i = 0; i < 3; ++i)
      splat_.log_scale[i] = static_cast<float>(std::log(px[i] * std::abs(z_) / kFocal));
    return *this;
  }
  Gaussian& round(double px) { return sigmas(px, px, px); }
  Gaussian& rotation(const Quaternion& q) {
    for (std::size_t i = 0; i < 4; ++i) splat_.rotation[i] = static_cast<float>(q[i]);
    return *this;
  }
  Gaussian& opacity(double o) {
    splat_.opacity_logit = static_cast<float>(std::log(o / (1 - o)));
    return *this;
  }
  Gaussian& colour(const Rgb& c) {
    for (std::size_t i = 0; i < 3; ++i) splat_.sh[i] = static_cast<float>((c[i] - 0.5) / kShC0);
    return *this;
  }
  Gaussian& sh(std::size_t k, const Rgb& c) {
    for (std::size_t i = 0; i < 3; ++i) splat_.sh[3 * k + i] = static_cast<float>(c[i]);
    return *this;
  }
  operator const Splat&() const { return splat_; }  // NOLINT: lists of Gaussians are lists of splats

 private:
  Splat splat_;
  double z_;
};

// With front_camera() alone.
MicroScene scene(const char* name, const char* rule, std::vector<Splat> gaussians, std::vector<MicroProbe> probes) {
  MicroScene s;
  s.name = name;
  s.rule = rule;
  s.gaussians = std::move(gaussians);
  s.cameras = {front_camera()};
  s.probes = std::move(probes);
  return s;
}

// Grey Gaussians around (0, 0, 4), each with one coefficient of degree l, and `middle` there, seen from three sides.
MicroScene sh(const char* name, const char* rule, std::size_t l, const Gaussian& middle) {
  MicroScene s = scene(name, rule, {}, {{0, 32, 32}, {1, 32, 32}, {2, 32, 32}, {0, 32, 50}});
  s.sh_degree = static_cast<int>(l);
  const glm::dvec3 target{0, 0, 4};
  s.cameras = {front_camera(), camera_at("from-the-right", {3.2, -0.8, 5.6}, target),
               camera_at("from-above", {-1, -3.4, 2.6}, target)};
  const std::size_t n = 2 * l + 1;
  for (std::size_t m = 0; m < n; ++m) {
    const double angle = 360.0 * static_cast<double>(m) / static_cast<double>(n) * kDegree;
    s.gaussians.push_back(Gaussian::at(1.1 * std::sin(angle), 1.1 * std::cos(angle), 4 + 0.5 * std::sin(2 * angle + 1))
                              .round(l < 3 ? 3 : 3.25)
                              .colour({0.5, 0.5, 0.5})
                              .sh(l * l + m, {0.8, -0.6, 0.4}));
  }
  s.gaussians.push_back(middle);
  return s;
}

}  // namespace

std::vector<MicroScene> micro_scenes() {
  std::vector<MicroScene> all;
  all.reserve(24);  // references to scenes stay valid
  const auto add = [&](const char* name, const char* rule, const std::vector<Splat>& gaussians,
                       const std::vector<MicroProbe>& probes) -> MicroScene& {
    return all.emplace_back(scene(name, rule, gaussians, probes));
  };

  add("01-round-in-the-middle",
      "Opacity falls off as exp(-d^2 / 2) of the distance in standard deviations, down to alpha = "
      "1/255 and not to a fixed number of them.",
      {Gaussian(32, 32).round(4).opacity(0.9).colour({1, 0.6, 0.3}),
       Gaussian(12, 12).round(2).opacity(0.5).colour(kRed), Gaussian(52, 12).round(2.5).opacity(0.7).colour(kGreen),
       Gaussian(12, 52).round(3).opacity(0.3).colour(kBlue), Gaussian(52, 52).round(1.5).opacity(0.95).colour(kWhite)},
      {{0, 32, 32}, {0, 36, 32}, {0, 44, 34}, {0, 46, 32}});

  add("02-a-quarter-pixel-off",
      "A pixel is sampled at its centre, half a pixel from its edges: a Gaussian a quarter of a pixel "
      "off has one brighter neighbour.",
      {Gaussian(16.25, 16).round(0.75).colour(kRed), Gaussian(48, 16.25).round(0.75).colour(kGreen),
       Gaussian(16.5, 48).round(0.75).colour(kBlue), Gaussian(47.75, 47.75).round(0.75).colour(kWhite)},
      {{0, 15, 16}, {0, 17, 16}, {0, 16, 48}, {0, 47, 47}});

  add("03-needle-at-45-degrees",
      "The quaternion is w, x, y, z and turns the local axes into the world's: about +z by 45 degrees, "
      "the local x axis points right and down.",
      {Gaussian(32, 32).sigmas(8, 0.5, 0.5).rotation(turned(45, 0, 0, 1)),
       Gaussian(52, 12).sigmas(4, 0.5, 0.5).rotation(product(turned(45, 0, 0, 1), turned(60, 0, 1, 0))).colour(kRed),
       Gaussian(12, 52).sigmas(0.5, 4, 0.5).rotation(turned(-20, 0, 0, 1)).colour(kGreen)},
      {{0, 37, 37}, {0, 37, 27}, {0, 54, 14}, {0, 13, 55}});

  // Tilted: the farther mean's needle reaches nearer than the other's at the crossing.
  add("04-crossing-needles",
      "Order is by the depth of the means, for all pixels alike, also where two Gaussians pass through "
      "each other.",
      {Gaussian(32, 32, 4.25).sigmas(10, 1.5, 0.5).rotation(turned(-40, 0, 0, 1)).colour(kRed),
       Gaussian(28, 28)
           .sigmas(10, 1.5, 0.5)
           .rotation(product(turned(45, 0, 0, 1), turned(-50, 0, 1, 0)))
           .colour(kGreen)},
      {{0, 32, 32}, {0, 28, 28}, {0, 40, 25}, {0, 36, 36}});

  // The same Gaussians for both low-passes.
  const std::vector<Splat> sub_pixel{Gaussian(16, 16).round(0.125).colour(kRed),
                                     Gaussian(48.25, 16).round(0.25).colour(kGreen),
                                     Gaussian(32, 32).sigmas(6, 0.0625, 0.0625).rotation(turned(30, 0, 0, 1)),
                                     Gaussian(16, 48).round(2).colour(kBlue)};
  add("05-sub-pixel-classic", "0.3 px^2 are added to both variances on the image, and opacity stays as it is.",
      sub_pixel, {{0, 16, 16}, {0, 17, 16}, {0, 32, 33}, {0, 18, 48}});

  MicroScene& mip =
      add("06-sub-pixel-mip",
          "Declared mip-splatting: 0.1 px^2 are added, and opacity is multiplied by sqrt(max(0.000025, det "
          "before / det after)).",
          sub_pixel, {{0, 16, 16}, {0, 48, 16}, {0, 32, 32}, {0, 48, 48}});
  mip.declared.aa_mode = AaMode::mip_splatting;
  mip.declared.low_pass_px2 = 0.1F;
  // The floor keeps 0.005 of an opacity of 0.9, above 1/255: enough of them are seen.
  mip.gaussians.insert(mip.gaussians.end(), 24, Gaussian(48, 48).round(0.001));

  add("07-near-plane",
      "Drawn is what has its mean beyond the near plane, wherever the rest lies; the mean at or before "
      "it, or behind the camera, draws nothing.",
      {Gaussian(16, 16, 0.19).sigmas(3, 3, 12).colour(kRed), Gaussian(48, 16, 0.21).sigmas(3, 3, 12).colour(kGreen),
       Gaussian(16, 48, -1).round(3).colour(kBlue), Gaussian(48, 48, 0.25).round(5).colour(kWhite)},
      {{0, 16, 16}, {0, 48, 16}, {0, 16, 48}, {0, 48, 48}});

  add("08-mean-outside-the-picture", "A Gaussian with its mean outside the picture is drawn where it reaches in.",
      {Gaussian(-8, 20).round(8).colour(kRed), Gaussian(44, 72).round(7).colour(kGreen),
       Gaussian(70, -5).round(6).colour(kBlue)},
      {{0, 0, 20}, {0, 44, 64}, {0, 64, 0}, {0, 8, 20}});

  std::vector<Splat> faint(32, Gaussian(16, 32).round(6).opacity(1.05 / 255));
  faint.insert(faint.end(), 32, Gaussian(48, 32).round(6).opacity(0.95 / 255));
  add("09-opacity-near-the-threshold",
      "Alpha below 1/255 is skipped pixel by pixel: 32 layers just above add up on the left, 32 just "
      "below show nothing on the right.",
      faint, {{0, 16, 32}, {0, 17, 32}, {0, 18, 32}, {0, 48, 32}});

  add("10-opacity-clamped", "Alpha is at most 0.99, so that 0.01 of what is behind an opacity of 0.999 shows.",
      {Gaussian(20, 32).round(5).opacity(0.999).colour({1, 0, 0}),
       Gaussian(20, 32, 5).round(6).opacity(0.9).colour({0, 0, 1}),
       Gaussian(44, 32).round(5).opacity(0.999).colour({0, 0, 0}),
       Gaussian(44, 32, 5).round(6).opacity(0.9).colour(kWhite)},
      {{0, 20, 32}, {0, 44, 32}, {0, 28, 32}});

  std::vector<Splat> stopping;
  stopping.reserve(9);
  for (int k = 0; k < 5; ++k)
    stopping.push_back(Gaussian(32, 32, 4 + 0.125 * k).sigmas(60, 60, 1).opacity(0.82).colour({0.2, 0.2, 0.2}));
  for (const double x : {20.0, 44.0}) {
    // In its middle it would end the pixel; farther out it is a ring.
    stopping.push_back(Gaussian(x, 32, 5).round(4).opacity(x < 32 ? 0.8 : 0.9).colour({0, 400, 0}));
    stopping.push_back(Gaussian(x, 32, 6).round(8).opacity(0.1).colour({0, 0, 800}));
  }
  add("11-transmittance-stop",
      "A pixel stops for good before the Gaussian that would take its transmittance below 1e-4; colours "
      "far above 1 make visible what is left out.",
      stopping, {{0, 20, 32}, {0, 24, 32}, {0, 44, 32}, {0, 50, 32}});

  add("12-sh-0", "Colour is 1/2 + 0.28209479 f_dc, raised to 0 where below it, and kept where above 1.",
      {Gaussian(16, 16).round(4).opacity(0.4).colour({-0.5, 0.5, 2}),
       Gaussian(48, 16).round(4).opacity(0.5).colour({-1, -1, 0.5}),
       Gaussian(48, 16, 5).round(6).opacity(0.9).colour(kWhite),
       Gaussian(16, 48).round(4).opacity(0.25).colour({3, 1.5, 0}),
       Gaussian(48, 48).round(4).colour({0.25, 0.5, 0.75})},
      {{0, 16, 16}, {0, 48, 16}, {0, 16, 48}, {0, 48, 48}});

  const Gaussian grey = Gaussian(32, 32).round(4).colour({0.5, 0.5, 0.5});
  // One colour an axis.
  all.push_back(
      sh("13-sh-1",
         "Degree 1 is 0.48860251 (-y, z, -x) of the direction from the camera to the mean, in the world's axes; "
         "f_rest holds all red coefficients, then green, then blue.",
         1, Gaussian(grey).sh(1, {1, 0, 0}).sh(2, {0, 1, 0}).sh(3, {0, 0, 1})));

  all.push_back(sh("14-sh-2", "Degree 2 has five terms, from xy to x^2 - y^2, one for each Gaussian here.", 2,
                   Gaussian(grey).sh(6, {0.5, 0, 0}).sh(4, {0, 0.8, 0}).sh(8, {0, 0, 0.8})));

  all.push_back(sh("15-sh-3",
                   "Degree 3 has seven terms, from y (3 x^2 - y^2) to x (x^2 - 3 y^2), one for each Gaussian here.", 3,
                   Gaussian(grey).sh(12, {0.5, 0, 0}).sh(10, {0, 0.8, 0}).sh(14, {0, 0, 0.8})));

  add("16-slope-clamp",
      "In the Jacobian the slopes x/z and y/z are clamped to 1.3 times those of the picture's edges, "
      "which limits how far a large Gaussian beside the camera smears into the picture.",
      {Gaussian(128, 20).round(33).colour(kRed), Gaussian(20, -100).round(36).colour(kGreen),
       Gaussian(-64, 128).round(41).colour(kBlue)},
      {{0, 64, 20}, {0, 20, 0}, {0, 0, 64}, {0, 40, 20}});

  for (Splat& g : add("17-equal-depths", "Gaussians of equal depth are blended in the order of the file's rows.",
                      {Gaussian(12, 16).round(4).colour(kRed), Gaussian(52, 16).round(4).colour(kGreen),
                       Gaussian(32, 48).round(4).colour(kBlue), Gaussian(20, 16).round(4).colour(kGreen),
                       Gaussian(44, 16).round(4).colour(kRed), Gaussian(32, 48).round(5).colour({1, 1, 0.1}),
                       Gaussian(32, 48).round(6.25).colour({1, 0.1, 1})},
                      {{0, 16, 16}, {0, 48, 16}, {0, 32, 48}, {0, 38, 48}})
                      .gaussians)
    g.opacity_logit = static_cast<float>(std::log(4.0));  // 0.8

  add("18-z-and-not-distance",
      "Depth is the camera's z and not the distance: toward the edge the nearer z is in front, although "
      "its mean is farther away.",
      {Gaussian(44, 40, 4.125).round(5).colour(kRed), Gaussian(58, 40).round(5).colour(kGreen),
       Gaussian(20, 22, 4.125).round(4).colour(kWhite), Gaussian(10, 12).round(4).colour(kBlue)},
      {{0, 51, 40}, {0, 15, 17}, {0, 48, 40}, {0, 18, 20}});

  MicroScene& mirrored =
      add("19-mirrored-axes",
          "The file declares that its y points up: positions, rotations and harmonics are mirrored into the "
          "cameras' world, where y points down.",
          {Gaussian(32, 40).sigmas(7, 1, 1).rotation(turned(30, 0, 0, 1)),
           Gaussian(14, 16).round(4).colour({0.5, 0.5, 0.5}).sh(1, {2, 0, 0}).sh(3, {0, 1.5, 0}),
           Gaussian(50, 12).round(4).colour({0.5, 0.5, 0.5}).sh(4, {0, 2, 0}).sh(5, {0, 0, 2})},
          {{0, 32, 24}, {0, 36, 22}, {0, 14, 48}, {0, 50, 52}});
  mirrored.declared.axes = {Axis::right, Axis::up, Axis::forward};
  mirrored.sh_degree = 2;

  MicroScene& grid =
      add("20-far-origin",
          "Coordinates far from 0, as those of a national grid, are doubles, and the camera's position is "
          "subtracted before anything is rounded to FP32.",
          {Gaussian(32, 32).round(2), Gaussian(24, 24).sigmas(5, 1, 1).rotation(turned(-45, 0, 0, 1)).colour(kRed),
           Gaussian(41, 36).round(2).colour(kGreen), Gaussian(27, 43, 4.5).round(3).colour(kBlue)},
          {{0, 32, 32}, {0, 41, 36}, {1, 32, 32}, {0, 27, 43}});
  grid.declared.origin = {500000.25, 4000000.5, 120.125};
  grid.cameras.push_back(camera_at("from-the-right", {2.5, -1, 1}, {0, 0, 4}));
  for (Camera& camera : grid.cameras) {
    const glm::dmat3 rotation(camera.world_to_camera);
    const Origin& o = grid.declared.origin;
    camera.world_to_camera[3] -= glm::dvec4(rotation * glm::dvec3(o[0], o[1], o[2]), 0);
  }

  add("21-display-referred",
      "Colours are blended as they are stored, as values for the display with sRGB's encoding, and no "
      "transfer curve is applied before, between or after.",
      {Gaussian(16, 20).round(5).opacity(0.5).colour({1, 0, 0}),
       Gaussian(16, 20, 5).round(7).opacity(0.9).colour({0, 1, 0}),
       Gaussian(48, 20).round(5).opacity(0.5).colour(kWhite),
       Gaussian(32, 48).round(5).opacity(0.5).colour({0.2, 0.5, 0.8}),
       Gaussian(32, 48, 5).round(7).opacity(0.9).colour({0.8, 0.5, 0.2})},
      {{0, 16, 20}, {0, 48, 20}, {0, 32, 48}});

  std::vector<Splat> layers;
  layers.reserve(64);
  for (int k = 0; k < 64; ++k)
    layers.push_back(Gaussian(32, 32, 4 + k / 64.0).round(10).opacity(0.01).colour({0.15, 0.3, 0.7}));
  add("22-many-faint-layers",
      "Sums are kept in floating point: 64 layers of opacity 0.01 lose no part of an 8-bit step each.", layers,
      {{0, 32, 32}, {0, 37, 32}, {0, 32, 42}});

  Camera& camera = add("23-principal-point",
                       "The principal point need not be the middle, pixels need not be square, and neither need the "
                       "picture.",
                       {Gaussian(32, 32).round(4), Gaussian(56, 24).round(3).colour(kRed),
                        Gaussian(48, 44).sigmas(8, 1, 1).rotation(turned(45, 0, 0, 1)).colour(kGreen),
                        Gaussian(22, 12).round(3).colour(kBlue)},
                       {{0, 24, 30}, {0, 54, 24}, {0, 44, 39}, {0, 29, 30}})
                       .cameras[0];
  camera = front_camera(81, 49);
  camera.cx = 24.5;
  camera.cy = 30.5;
  camera.fx = 80;
  camera.fy = 48;

  const auto times = [](double factor, Quaternion q) {
    for (double& v : q) v *= factor;
    return q;
  };
  add("24-unnormalised-quaternion", "Quaternions are normalised before use, and q turns as -q does.",
      {Gaussian(18, 18).sigmas(6, 1, 1).rotation(times(-2.5, turned(30, 0, 0, 1))).colour(kRed),
       Gaussian(46, 18).sigmas(6, 1, 1).rotation(times(0.05, turned(120, 0, 0, 1))).colour(kGreen),
       Gaussian(18, 46)
           .sigmas(6, 1, 2)
           .rotation(times(-0.4, product(turned(70, 0, 0, 1), turned(40, 0, 1, 0))))
           .colour(kBlue),
       Gaussian(46, 46).sigmas(6, 1, 1).rotation(turned(150, 0, 0, 1))},
      {{0, 21, 20}, {0, 44, 21}, {0, 19, 49}, {0, 43, 48}});
  return all;
}

}  // namespace rgs
