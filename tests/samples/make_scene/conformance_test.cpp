// conformance_test.cpp - every micro-scene is about its rule: a second reading of the definition gives the same picture,
// and with one rule wrong another, which the scene's probes show.
// SPDX-License-Identifier: Apache-2.0
#include "conformance.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <glm/glm.hpp>
#include <glm/gtc/quaternion.hpp>
#include <iterator>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <numeric>
#include <set>
#include <string>
#include <vector>

#include "image_file.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/renderer.hpp"
#include "run_program.hpp"
#include "scene_file.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
namespace fs = std::filesystem;

namespace {

// The definition's rules (docs/format/RENDERING.md); a test makes one of them wrong.
struct Rules {
  double pixel_centre = 0.5, low_pass = -1, near_plane = 0.2;  // low-pass below 0: as declared
  double cutoff = std::numeric_limits<double>::infinity();     // standard deviations
  double alpha_min = 1.0 / 255, alpha_max = 0.99, stop = 1e-4, mip_floor = 0.000025;
  int degree = 3;
  bool compensate = true, clamp_low = true, clamp_high = false, clamp_slopes = true, normalise = true,
       stop_before = true;
  bool w_last = false, order_in_pixels = false, by_distance = false, last_first = false, cull_means = false;
  bool ignore_axes = false, fp32_world = false, linear_light = false, eight_bits = false, centred = false;
  bool square_pixels = false, backward = false, interleaved = false;
};

// How near the thresholds the picture came, relative to them.
struct Margins {
  double alpha = 1, stop = 1;
};

struct Seen {
  double u, v, z, distance, opacity;
  glm::dmat2 conic;
  glm::dvec3 colour, mean;  // mean in the camera
  glm::dmat3 inverse;       // of the covariance in the camera
};

// In the order of coefficients, from the textbook's real harmonics, with Condon-Shortley signs.
std::array<double, 16> harmonics(const glm::dvec3& d) {
  const double pi = std::acos(-1.0), x = d.x, y = d.y, z = d.z;
  const double l1 = std::sqrt(3 / pi) / 2, l2 = std::sqrt(15 / pi) / 2, l33 = std::sqrt(35 / (2 * pi)) / 4;
  const double l32 = std::sqrt(105 / pi) / 2, l31 = std::sqrt(21 / (2 * pi)) / 4;
  return {std::sqrt(1 / pi) / 2,
          -l1 * y,
          l1 * z,
          -l1 * x,
          l2 * x * y,
          -l2 * y * z,
          std::sqrt(5 / pi) / 4 * (3 * z * z - 1),
          -l2 * x * z,
          l2 / 2 * (x * x - y * y),
          -l33 * y * (3 * x * x - y * y),
          l32 * x * y * z,
          -l31 * y * (5 * z * z - 1),
          std::sqrt(7 / pi) / 4 * z * (5 * z * z - 3),
          -l31 * x * (5 * z * z - 1),
          l32 / 2 * z * (x * x - y * y),
          -l33 * x * (x * x - 3 * y * y)};
}

double to_linear(double v) {
  return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
}
double to_srgb(double v) {
  return v <= 0.0031308 ? 12.92 * v : 1.055 * std::pow(v, 1 / 2.4) - 0.055;
}

glm::dvec3 colour(const MicroScene& scene, const Splat& splat, const glm::dvec3& direction, const Rules& rules) {
  const std::array<double, 16> y = harmonics(rules.backward ? -direction : direction);
  const int degree = std::min(scene.sh_degree, rules.degree),
            n_rest = (scene.sh_degree + 1) * (scene.sh_degree + 1) - 1;
  glm::dvec3 c(0.5);
  for (int k = 0; k < (degree + 1) * (degree + 1); ++k)
    for (int i = 0; i < 3; ++i) {
      // The file's f_rest has the channels one after the other; what takes it for interleaved reads another value.
      const int in_file = 3 * (k - 1) + i;
      const int at = rules.interleaved && k > 0 ? 3 * (1 + in_file % n_rest) + in_file / n_rest : 3 * k + i;
      c[i] += y[static_cast<std::size_t>(k)] * double{splat.sh[at]};
    }
  if (rules.clamp_low) c = glm::max(c, 0.0);
  if (rules.clamp_high) c = glm::min(c, 1.0);
  return c;
}

std::vector<Seen> project(const MicroScene& scene, const Camera& camera, const Rules& rules) {
  const bool is_mip = scene.declared.aa_mode == AaMode::mip_splatting;
  const double low_pass = rules.low_pass < 0 ? double{scene.declared.low_pass_px2} : rules.low_pass;
  const glm::dmat3 w(camera.world_to_camera);
  const glm::dvec3 t(camera.world_to_camera[3]);
  const glm::dvec3 origin(scene.declared.origin[0], scene.declared.origin[1], scene.declared.origin[2]);
  const bool y_up = scene.declared.axes[1] == Axis::up && !rules.ignore_axes;
  const glm::dmat3 mirror = glm::dmat3(1, 0, 0, 0, y_up ? -1 : 1, 0, 0, 0, 1);
  const double fy = rules.square_pixels ? camera.fx : camera.fy;
  const double cx = rules.centred ? 0.5 * camera.width : camera.cx,
               cy = rules.centred ? 0.5 * camera.height : camera.cy;
  std::vector<Seen> all;
  for (const Splat& splat : scene.gaussians) {
    const glm::dvec3 mean = origin + mirror * glm::dvec3(splat.mean[0], splat.mean[1], splat.mean[2]);
    glm::dvec3 p = w * mean + t;
    if (rules.fp32_world) p = w * glm::dvec3(glm::vec3(mean)) + glm::dvec3(glm::vec3(t));
    if (p.z <= rules.near_plane) continue;
    const float* q = splat.rotation;
    glm::dquat rotation = rules.w_last ? glm::dquat(q[3], q[0], q[1], q[2]) : glm::dquat(q[0], q[1], q[2], q[3]);
    if (rules.normalise) rotation = glm::normalize(rotation);
    glm::dmat3 spread(0);
    for (int i = 0; i < 3; ++i) spread[i][i] = std::exp(double{splat.log_scale[i]});
    const glm::dmat3 half = w * mirror * glm::mat3_cast(rotation) * spread;
    const glm::dmat3 covariance = half * glm::transpose(half);
    double sx = p.x / p.z, sy = p.y / p.z;
    if (rules.clamp_slopes) {
      const double mx = 0.3 * camera.width / 2 / camera.fx, my = 0.3 * camera.height / 2 / fy;
      sx = std::clamp(sx, -cx / camera.fx - mx, (camera.width - cx) / camera.fx + mx);
      sy = std::clamp(sy, -cy / fy - my, (camera.height - cy) / fy + my);
    }
    const glm::dvec3 du = camera.fx / p.z * glm::dvec3(1, 0, -sx), dv = fy / p.z * glm::dvec3(0, 1, -sy);
    const double uu = glm::dot(du, covariance * du), uv = glm::dot(du, covariance * dv),
                 vv = glm::dot(dv, covariance * dv);
    const glm::dmat2 blurred(uu + low_pass, uv, uv, vv + low_pass);
    double opacity = 1 / (1 + std::exp(-double{splat.opacity_logit}));
    if (is_mip && rules.compensate)
      opacity *= std::sqrt(std::max(rules.mip_floor, (uu * vv - uv * uv) / glm::determinant(blurred)));
    Seen s{camera.fx * p.x / p.z + cx, fy * p.y / p.z + cy, p.z, glm::length(p), opacity, glm::inverse(blurred), {}, p,
           glm::inverse(covariance)};
    if (rules.cull_means && (s.u < 0 || s.u > camera.width || s.v < 0 || s.v > camera.height)) continue;
    s.colour = colour(scene, splat, mirror * glm::normalize(glm::transpose(w) * p), rules);
    all.push_back(s);
  }
  return all;
}

// Where Gaussian s is densest on the ray: its depth for what sorts pixel by pixel.
double depth_on(const glm::dvec3& ray, const Seen& s) {
  return glm::dot(ray, s.inverse * s.mean) / glm::dot(ray, s.inverse * ray);
}

// R, G, B, alpha as by the definition, in FP64 and without tiles.
Image picture(const MicroScene& scene, const Camera& camera, const Rules& rules = {}, Margins* margins = nullptr) {
  const std::vector<Seen> seen = project(scene, camera, rules);
  std::vector<std::size_t> order(seen.size());
  std::iota(order.begin(), order.end(), 0U);
  if (rules.last_first) std::ranges::reverse(order);
  const auto sort_by = [&order](const auto& depth) { std::ranges::stable_sort(order, {}, depth); };
  sort_by([&](std::size_t i) { return rules.by_distance ? seen[i].distance : seen[i].z; });
  Image image = Image::make(camera.width, camera.height, 4);
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      const glm::dvec2 at(x + rules.pixel_centre, y + rules.pixel_centre);
      if (rules.order_in_pixels) {
        const glm::dvec3 ray((at.x - camera.cx) / camera.fx, (at.y - camera.cy) / camera.fy, 1);
        sort_by([&](std::size_t i) { return depth_on(ray, seen[i]); });
      }
      glm::dvec3 rgb(0);
      double transmittance = 1;
      for (const std::size_t i : order) {
        const Seen& s = seen[i];
        const glm::dvec2 d = glm::dvec2(s.u, s.v) - at;
        const double power = -0.5 * glm::dot(d, s.conic * d);
        const double alpha = std::min(rules.alpha_max, s.opacity * std::exp(power));
        if (margins != nullptr) margins->alpha = std::min(margins->alpha, std::abs(alpha / rules.alpha_min - 1));
        if (alpha < rules.alpha_min || -2 * power > rules.cutoff * rules.cutoff) continue;
        const double next = transmittance * (1 - alpha);
        if (margins != nullptr) margins->stop = std::min(margins->stop, std::abs(next / rules.stop - 1));
        if (next < rules.stop && rules.stop_before) break;
        glm::dvec3 c = s.colour;
        if (rules.linear_light)
          for (int k = 0; k < 3; ++k) c[k] = to_linear(c[k]);
        rgb += transmittance * alpha * c;
        if (rules.eight_bits) rgb = glm::round(255.0 * rgb) / 255.0;
        transmittance = next;
        if (next < rules.stop) break;
      }
      for (int k = 0; k < 3; ++k) image.at(x, y, k) = static_cast<float>(rules.linear_light ? to_srgb(rgb[k]) : rgb[k]);
      image.at(x, y, 3) = static_cast<float>(1 - transmittance);
    }
  return image;
}

// As the scenes' users compare.
double difference(const Image& a, const Image& b, int x, int y) {
  double largest = 0;
  for (int k = 0; k < 3; ++k)
    largest =
        std::max(largest, double{std::abs(std::clamp(a.at(x, y, k), 0.F, 1.F) - std::clamp(b.at(x, y, k), 0.F, 1.F))});
  return largest;
}

// What `rgs-make-scene --conformance` writes.
struct Written {
  Written() : folder(path.file("scenes")) {
    exit_code = run(folder);
    std::ifstream file(folder + "/conformance.json");
    document = nlohmann::json::parse(file, nullptr, false);
  }
  static int run(const std::string& folder, const std::string& more = "") {
    return test::run_shell("'" + test::built("rgs-make-scene") + "' --quiet --no-sync " + more + " --conformance '" +
                           folder + "'")
        .exit_code;
  }
  std::string file(const MicroScene& scene, const std::string& name) const {
    return folder + "/" + scene.name + "/" + name;
  }
  test::TemporaryFolder path;
  std::string folder;
  int exit_code = -1;
  nlohmann::json document;
};

const Written& written() {
  static const Written once;
  return once;
}

const std::vector<MicroScene>& scenes() {
  static const std::vector<MicroScene> once = micro_scenes();
  return once;
}

Image reference(const MicroScene& scene, const Camera& camera) {
  const Result<Image> image = read_image(written().file(scene, camera.name + ".exr"));
  REQUIRE(image);
  REQUIRE(image->channels == 4);
  return *image;
}

std::string bytes_of(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

std::map<std::string, std::string> files_in(const std::string& folder) {
  std::map<std::string, std::string> files;
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    if (entry.is_regular_file()) files[fs::relative(entry.path(), folder).string()] = bytes_of(entry.path());
  return files;
}

}  // namespace

TEST_CASE("there are 24 micro-scenes, of unique names, with cameras and probes") {
  REQUIRE(scenes().size() == 24);
  for (std::size_t i = 0; i < scenes().size(); ++i) {
    const MicroScene& scene = scenes()[i];
    CAPTURE(scene.name);
    CHECK(scene.name.substr(0, 3) == (i < 9 ? "0" : "") + std::to_string(i + 1) + "-");
    CHECK(scene.rule.ends_with('.'));
    CHECK(!scene.gaussians.empty());
    CHECK(scene.gaussians.size() <= 64);
    CHECK(scene.probes.size() >= 2);
    CHECK(scene.probes.size() <= 4);
    std::set<std::string> names;
    for (const Camera& camera : scene.cameras) {
      CHECK(validate(camera));
      CHECK(names.insert(camera.name).second);
    }
    for (const MicroProbe& probe : scene.probes) {
      REQUIRE(probe.camera < scene.cameras.size());
      CHECK(std::clamp(probe.x, 0, scene.cameras[probe.camera].width - 1) == probe.x);
      CHECK(std::clamp(probe.y, 0, scene.cameras[probe.camera].height - 1) == probe.y);
    }
  }
}

TEST_CASE("the references are what a second reading of the definition draws in FP64") {
  REQUIRE(written().exit_code == 0);
  for (const MicroScene& scene : scenes())
    for (const Camera& camera : scene.cameras) {
      CAPTURE(scene.name);
      CAPTURE(camera.name);
      const Image drawn = reference(scene, camera), expected = picture(scene, camera);
      REQUIRE(drawn.pixels.size() == expected.pixels.size());
      double largest = 0;
      for (std::size_t i = 0; i < drawn.pixels.size(); ++i)
        largest = std::max(largest, double{std::abs(drawn.pixels[i] - expected.pixels[i])});
      CHECK(largest < 2e-5);
    }
}

TEST_CASE("no pixel of the micro-scenes is near a threshold") {
  for (const MicroScene& scene : scenes())
    for (const Camera& camera : scene.cameras) {
      CAPTURE(scene.name);
      CAPTURE(camera.name);
      Margins margins;
      picture(scene, camera, {}, &margins);
      CHECK(margins.alpha > kMicroMargin);
      CHECK(margins.stop > kMicroMargin);
    }
}

TEST_CASE("each micro-scene's probes show that its rule is wrong") {
  const struct {
    std::size_t number;
    std::string what;
    Rules rules;
  } wrong[] = {{1, "cut at 3 standard deviations", {.cutoff = 3}},
               {2, "sampled at the pixel's corner", {.pixel_centre = 0}},
               {3, "quaternion x, y, z, w", {.w_last = true}},
               {4, "ordered pixel by pixel", {.order_in_pixels = true}},
               {5, "no low-pass", {.low_pass = 0}},
               {5, "Mip-Splatting's low-pass", {.low_pass = 0.1}},
               {6, "not compensated", {.compensate = false}},
               {6, "the low-pass of 3DGS", {.low_pass = 0.3}},
               {6, "no floor", {.mip_floor = 0}},
               {7, "a nearer near plane", {.near_plane = 0.1}},
               {7, "a farther near plane", {.near_plane = 0.23}},
               {7, "no near plane", {.near_plane = -10}},
               {8, "culled by the mean", {.cull_means = true}},
               {9, "no threshold", {.alpha_min = 1e-6}},
               {9, "a threshold of 2/255", {.alpha_min = 2.0 / 255}},
               {10, "no clamp", {.alpha_max = 1}},
               {11, "never stopped", {.stop = 0}},
               {11, "stopped after the last", {.stop_before = false}},
               {12, "no clamp at 0", {.clamp_low = false}},
               {12, "clamped at 1", {.clamp_high = true}},
               {13, "degree 0", {.degree = 0}},
               {13, "the direction to the camera", {.backward = true}},
               {13, "interleaved", {.interleaved = true}},
               {14, "degree 1", {.degree = 1}},
               {15, "degree 2", {.degree = 2}},
               {15, "the direction to the camera", {.backward = true}},
               {16, "no clamp", {.clamp_slopes = false}},
               {17, "the last row first", {.last_first = true}},
               {18, "ordered by distance", {.by_distance = true}},
               {19, "axes ignored", {.ignore_axes = true}},
               {20, "a world in FP32", {.fp32_world = true}},
               {21, "blended as light", {.linear_light = true}},
               {22, "sums in 8 bits", {.eight_bits = true}},
               {23, "a centred principal point", {.centred = true}},
               {23, "square pixels", {.square_pixels = true}},
               {24, "not normalised", {.normalise = false}}};
  std::set<std::size_t> tested;
  for (const auto& w : wrong) {
    const MicroScene& scene = scenes().at(w.number - 1);
    CAPTURE(scene.name);
    CAPTURE(w.what);
    tested.insert(w.number);
    double largest = 0;
    for (const MicroProbe& probe : scene.probes) {
      const Camera& camera = scene.cameras[probe.camera];
      largest =
          std::max(largest, difference(picture(scene, camera), picture(scene, camera, w.rules), probe.x, probe.y));
    }
    CHECK(largest > 1.25 * kMicroTolerance);
  }
  CHECK(tested.size() == scenes().size());
}

namespace {

// exp(-d^T cov^-1 d / 2) for the covariance [xx xy; xy yy].
double fall_off(double xx, double xy, double yy, double dx, double dy) {
  return std::exp(-0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy));
}

// The same of a round Gaussian of `sigma` px at pixel (x, y), whose slopes are (x - 32) / 64 and (y - 32) / 64.
double round_fall_off(double x, double y, double sigma, double low_pass, double dx, double dy) {
  const double sx = (x - 32) / 64, sy = (y - 32) / 64, s2 = sigma * sigma;
  return fall_off(s2 * (1 + sx * sx) + low_pass, s2 * sx * sy, s2 * (1 + sy * sy) + low_pass, dx, dy);
}

}  // namespace

TEST_CASE("pixels of the micro-scenes have the values that the definition gives by hand") {
  struct Pixel {
    std::size_t number;
    int x, y;
    glm::dvec3 rgb;
  };
  const double mip =
      0.9 * std::sqrt(0.015625 * 0.015625 * 1.125 /  // slopes of 1/4: det = s^4 (1 + 1/16 + 1/16)
                      ((0.015625 * 1.0625 + 0.1) * (0.015625 * 1.0625 + 0.1) - 0.015625 * 0.0625 * 0.015625 * 0.0625));
  const double faint = 1 - std::pow(0.99, 64), fainter = 1 - std::pow(1 - 0.01 * std::exp(-25 / 200.6), 64);
  const double threshold = 1.05 / 255;
  const double first = 0.8 * round_fall_off(12, 16, 4, 0.3, 4, 0), second = 0.8 * round_fall_off(20, 16, 4, 0.3, 4, 0);
  const double front = 0.9 * round_fall_off(58, 40, 5, 0.3, 7, 0), back = 0.9 * round_fall_off(44, 40, 5, 0.3, 7, 0);
  const double slope = -14.0 / 64;
  const double turned = 0.9 * fall_off(36 * 0.75 + 0.25 + slope * slope + 0.3, 35 * std::sqrt(0.1875) + slope * slope,
                                       36 * 0.25 + 0.75 + slope * slope + 0.3, 3, 2);
  const std::vector<Pixel> pixels{
      {1, 32, 32, {0.9, 0.54, 0.27}},
      {1, 36, 32, std::exp(-16 / 32.6) * glm::dvec3(0.9, 0.54, 0.27)},
      {1, 44, 34, std::exp(-148 / 32.6) * glm::dvec3(0.9, 0.54, 0.27)},
      {1, 46, 32, {0, 0, 0}},
      {2, 15, 16, 0.9 * round_fall_off(16.25, 16, 0.75, 0.3, 1.25, 0) * glm::dvec3(1, 0.1, 0.1)},
      {2, 17, 16, 0.9 * round_fall_off(16.25, 16, 0.75, 0.3, 0.75, 0) * glm::dvec3(1, 0.1, 0.1)},
      {5, 16, 16, {0.9, 0.09, 0.09}},
      {5, 17, 16, 0.9 * round_fall_off(16, 16, 0.125, 0.3, 1, 0) * glm::dvec3(1, 0.1, 0.1)},
      {6, 16, 16, mip * glm::dvec3(1, 0.1, 0.1)},
      {6, 17, 16, {0, 0, 0}},  // alpha is 0.0018
      {6, 48, 48, glm::dvec3(1 - std::pow(1 - 0.9 * 0.005, 24))},
      {9, 16, 32, glm::dvec3(1 - std::pow(1 - threshold, 32))},
      {9, 17, 32, glm::dvec3(1 - std::pow(1 - threshold * round_fall_off(16, 32, 6, 0.3, 1, 0), 32))},
      {9, 18, 32, {0, 0, 0}},
      {9, 48, 32, {0, 0, 0}},
      {10, 20, 32, {0.99, 0, 0.009}},
      {10, 44, 32, {0.009, 0.009, 0.009}},
      {12, 16, 16, {0, 0.2, 0.8}},
      {12, 48, 16, {0.45, 0.45, 0.7}},
      {12, 16, 48, {0.75, 0.375, 0}},
      {12, 48, 48, {0.225, 0.45, 0.675}},
      {17, 16, 16, first * glm::dvec3(1, 0.1, 0.1) + (1 - first) * second * glm::dvec3(0.1, 1, 0.1)},
      {17, 48, 16, first * glm::dvec3(0.1, 1, 0.1) + (1 - first) * second * glm::dvec3(1, 0.1, 0.1)},
      {17, 32, 48, {0.08 + 0.16 + 0.032, 0.08 + 0.16 + 0.0032, 0.8 + 0.016 + 0.032}},
      {18, 51, 40, front * glm::dvec3(0.1, 1, 0.1) + (1 - front) * back * glm::dvec3(1, 0.1, 0.1)},
      {22, 32, 32, faint * glm::dvec3(0.15, 0.3, 0.7)},
      {22, 37, 32, fainter * glm::dvec3(0.15, 0.3, 0.7)},
      {24, 21, 20, turned * glm::dvec3(1, 0.1, 0.1)}};
  for (const Pixel& pixel : pixels) {
    const MicroScene& scene = scenes().at(pixel.number - 1);
    CAPTURE(scene.name);
    CAPTURE(pixel.x);
    CAPTURE(pixel.y);
    const Image drawn = reference(scene, scene.cameras[0]);
    for (int c = 0; c < 3; ++c) CHECK(std::abs(drawn.at(pixel.x, pixel.y, c) - pixel.rgb[c]) < 2e-5);
  }
}

TEST_CASE("rgs-make-scene --conformance writes files that read back as the micro-scenes") {
  REQUIRE(written().exit_code == 0);
  const nlohmann::json& document = written().document;
  CHECK(document["version"] == 1);
  CHECK(document["tolerance"]["channel"] == kMicroTolerance);
  REQUIRE(document["scenes"].size() == scenes().size());
  const std::string readme = bytes_of(written().folder + "/README.md");
  CHECK(bytes_of(written().folder + "/LICENSE").find("https://creativecommons.org/publicdomain/zero/1.0/") !=
        std::string::npos);
  auto renderer = Renderer::create({.backend = Backend::cpu, .simd = false});
  auto vectors = Renderer::create({.backend = Backend::cpu});
  REQUIRE(renderer);
  REQUIRE(vectors);
  for (std::size_t i = 0; i < scenes().size(); ++i) {
    const MicroScene& scene = scenes()[i];
    CAPTURE(scene.name);
    const nlohmann::json& entry = document["scenes"][i];
    CHECK(entry["name"] == scene.name);
    CHECK(entry["rule"] == scene.rule);
    CHECK(entry["gaussians"] == scene.gaussians.size());
    CHECK(entry["near_plane"] == 0.2);
    CHECK(readme.find("| `" + scene.name + "` | " + scene.rule + " |\n") != std::string::npos);

    const std::string path = written().file(scene, "scene.ply");
    const Result<PlyFile> ply = PlyFile::open(path);
    REQUIRE(ply);
    REQUIRE(ply->size() == scene.gaussians.size());
    CHECK(ply->sh_degree() == scene.sh_degree);
    CHECK(ply->declarations().axes == scene.declared.axes);
    CHECK(ply->declarations().aa_mode == scene.declared.aa_mode);
    CHECK(ply->declarations().low_pass_px2 == scene.declared.low_pass_px2);
    CHECK(ply->declarations().colour_space == ColourSpace::srgb_display);
    std::vector<Splat> rows(scene.gaussians.size());
    ply->read(0, rows);
    for (std::size_t k = 0; k < rows.size(); ++k) {
      const Splat &row = rows[k], &expected = scene.gaussians[k];
      for (std::size_t c = 0; c < 3; ++c)
        CHECK(std::abs(ply->origin()[c] + row.mean[c] - scene.declared.origin[c] - expected.mean[c]) < 1e-6);
      CHECK(std::equal(row.log_scale, row.log_scale + 3, expected.log_scale));
      CHECK(std::equal(row.rotation, row.rotation + 4, expected.rotation));
      CHECK(row.opacity_logit == expected.opacity_logit);
      CHECK(std::equal(row.sh, row.sh + 48, expected.sh));
    }

    const auto cameras = read_cameras(written().file(scene, "cameras.json"));
    REQUIRE(cameras);
    REQUIRE(cameras->size() == scene.cameras.size());
    const auto listed = parse_camera_json(entry["cameras"].dump());
    REQUIRE(listed);
    const Result<SceneFile> file = load_scene_file(path);
    REQUIRE(file);
    for (std::size_t k = 0; k < cameras->size(); ++k) {
      const Camera &camera = (*cameras)[k], &expected = scene.cameras[k];
      CHECK(camera.name == expected.name);
      CHECK(camera.world_to_camera == expected.world_to_camera);
      CHECK(listed->cameras[k].world_to_camera == expected.world_to_camera);
      CHECK(entry["pictures"][k] == camera.name + ".exr");
      CHECK(std::array{camera.fx, camera.fy, camera.cx, camera.cy} ==
            std::array{expected.fx, expected.fy, expected.cx, expected.cy});
      const Image stored = reference(scene, camera);
      Image rgb = Image::make(camera.width, camera.height, 3), alpha = Image::make(camera.width, camera.height, 1);
      RenderTarget target;
      target.rgb = rgb.pixels;
      target.alpha = alpha.pixels;
      REQUIRE(renderer->render(file->scene, camera, target));
      std::size_t n_other = 0;
      for (std::size_t at = 0; at < alpha.pixels.size(); ++at) {
        n_other += std::equal(rgb.pixels.data() + 3 * at, rgb.pixels.data() + 3 * at + 3, stored.pixels.data() + 4 * at)
                       ? 0U
                       : 1U;
        n_other += alpha.pixels[at] == stored.pixels[4 * at + 3] ? 0U : 1U;
      }
      CHECK(n_other == 0);
      // Our own vectors pass, too.
      REQUIRE(vectors->render(file->scene, camera, target));
      double largest = 0;
      for (int y = 0; y < camera.height; ++y)
        for (int x = 0; x < camera.width; ++x) largest = std::max(largest, difference(rgb, stored, x, y));
      CHECK(largest < 1e-4);
    }
    REQUIRE(entry["probes"].size() == scene.probes.size());
    for (std::size_t k = 0; k < scene.probes.size(); ++k) {
      const MicroProbe& probe = scene.probes[k];
      const nlohmann::json& said = entry["probes"][k];
      const Camera& camera = scene.cameras[probe.camera];
      CHECK(said["camera"] == camera.name);
      CHECK(said["x"] == probe.x);
      CHECK(said["y"] == probe.y);
      const Image stored = reference(scene, camera);
      for (int c = 0; c < 3; ++c)
        CHECK(std::abs(said["rgb"][static_cast<std::size_t>(c)].get<double>() - stored.at(probe.x, probe.y, c)) < 1e-6);
    }
  }
}

TEST_CASE("rgs-make-scene --conformance writes the same bytes again, and only over its own files") {
  REQUIRE(written().exit_code == 0);
  const test::TemporaryFolder other;
  CHECK(Written::run(other.path().string()) == 0);  // it is empty
  const auto files = files_in(written().folder);
  CHECK(files.size() == 3 + 3 * 24 + 7);
  CHECK(files == files_in(other.path().string()));

  const std::string damaged = other.file(scenes()[0].name + "/scene.ply");
  std::ofstream(damaged) << "other";
  CHECK(Written::run(other.path().string()) == 3);
  CHECK(bytes_of(damaged) == "other");
  CHECK(Written::run(other.path().string(), "--overwrite") == 0);
  CHECK(files == files_in(other.path().string()));

  const test::TemporaryFolder used;
  std::ofstream(used.file("notes")) << "other";
  CHECK(Written::run(used.path().string()) == 3);
  CHECK(Written::run(used.file("notes"), "--overwrite") == 3);  // not a folder
  CHECK(files_in(used.path().string()).size() == 1);
}

TEST_CASE("rgs-make-scene --conformance takes no other scene's options") {
  const test::TemporaryFolder other;
  const std::string folder = other.file("scenes");
  for (const char* more :
       {"--seed 2", "--gaussians 10", "--town", "--degree 1", "--origin 1,2,3", "--threads 1", "out.ply"}) {
    CAPTURE(more);
    CHECK(Written::run(folder, more) == 2);
    CHECK(!fs::exists(folder));
  }
  CHECK(test::run_shell("'" + test::built("rgs-make-scene") + "'").exit_code == 2);
}
