// camera_models_test.cpp - lenses, panoramas and parallel rays against pinholes and against their formulas.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <glm/geometric.hpp>
#include <glm/gtc/matrix_transform.hpp>
#include <glm/mat2x2.hpp>
#include <glm/vec2.hpp>
#include <numbers>
#include <string>
#include <vector>

#include "render_options.hpp"
#include "renderer_fixture.hpp"
#include "rgs/camera_view.hpp"

using namespace rgs;
using namespace rgs::test;
using std::numbers::pi;

namespace {

constexpr RendererOptions kOnCpu{.backend = Backend::cpu};

Camera camera_of(CameraModel model, int width, int height, double focal) {
  Camera camera = front_camera(width, height);
  camera.fx = camera.fy = focal;
  camera.model = model;
  return camera;
}
Camera lens() {
  Camera camera = camera_of(CameraModel::opencv, 240, 180, 150);
  camera.fy = 157, camera.cx = 112, camera.cy = 96.5;
  camera.distortion = {-0.21, 0.06, 0.004, -0.006, 0.011, 0.03, -0.02, 0.004};
  return camera;
}
constexpr double kFisheyeAngle = 95 * pi / 180;  // to the axis
Camera fisheye() {
  Camera camera = camera_of(CameraModel::opencv_fisheye, 270, 270, 80);
  camera.cx = 131.5, camera.fy = 82;
  camera.distortion = {0.03, -0.012, 0.004, -0.0006, 0, 0, 0, 0};
  return camera;
}
Camera panorama(int width = 480) {
  Camera camera = camera_of(CameraModel::equirectangular, width, width / 2, width / (2 * pi));
  return camera;
}
Camera map() {
  Camera camera = camera_of(CameraModel::orthographic, 240, 180, 40);
  camera.fy = 45;
  return camera;
}

/// Where the documents of OpenCV and RENDERING.md say that a point in the camera's axes lands; image coordinates.
glm::dvec2 by_formula(const Camera& c, const glm::dvec3& p) {
  const auto& k = c.distortion;
  double x = p.x, y = p.y;
  if (c.model == CameraModel::opencv || c.model == CameraModel::pinhole) {
    const double a = p.x / p.z, b = p.y / p.z, r = std::hypot(a, b);
    const double radial = (1 + k[0] * std::pow(r, 2) + k[1] * std::pow(r, 4) + k[4] * std::pow(r, 6)) /
                          (1 + k[5] * std::pow(r, 2) + k[6] * std::pow(r, 4) + k[7] * std::pow(r, 6));
    x = a * radial + 2 * k[2] * a * b + k[3] * (r * r + 2 * a * a);
    y = b * radial + k[2] * (r * r + 2 * b * b) + 2 * k[3] * a * b;
  } else if (c.model == CameraModel::opencv_fisheye) {
    const double rho = std::hypot(p.x, p.y), t = std::atan2(rho, p.z);
    const double distorted =
        t * (1 + k[0] * std::pow(t, 2) + k[1] * std::pow(t, 4) + k[2] * std::pow(t, 6) + k[3] * std::pow(t, 8));
    x = rho > 0 ? distorted * p.x / rho : 0, y = rho > 0 ? distorted * p.y / rho : 0;
  } else if (c.model == CameraModel::equirectangular) {
    x = std::atan2(p.x, p.z), y = std::asin(p.y / glm::length(p));
  }
  return {c.fx * x + c.cx, c.fy * y + c.cy};
}

/// By how much the place on the image moves with the point along two axes, px per unit.
glm::dmat2 slopes(const Camera& c, const glm::dvec3& p, const glm::dvec3& a, const glm::dvec3& b) {
  constexpr double kStep = 1e-5;
  const auto along = [&](const glm::dvec3& axis) {
    return (by_formula(c, p + kStep * axis) - by_formula(c, p - kStep * axis)) / (2 * kStep);
  };
  return {along(a), along(b)};
}

/// A unit vector, in the camera's axes, that lands at a place of the image; by Newton's method on the sphere.
bool find_ray(const Camera& c, const glm::dvec2& place, glm::dvec3& ray) {
  const double x = (place.x - c.cx) / c.fx, y = (place.y - c.cy) / c.fy, r = std::hypot(x, y);
  const double angle = c.model == CameraModel::opencv_fisheye ? r : std::atan(r);
  ray = {std::sin(angle) * x / (r + 1e-12), std::sin(angle) * y / (r + 1e-12), std::cos(angle)};
  if (c.model == CameraModel::equirectangular) {
    ray = {std::cos(y) * std::sin(x), std::sin(y), std::cos(y) * std::cos(x)};
    return true;
  }
  for (int i = 0; i < 50; ++i) {
    const glm::dvec2 off = place - by_formula(c, ray);
    if (glm::length(off) < 1e-9) return true;
    const glm::dvec3 a = glm::normalize(glm::cross(ray, glm::dvec3(0.3, 1, 0.2))), b = glm::cross(ray, a);
    const glm::dvec2 step = glm::inverse(slopes(c, ray, a, b)) * off;
    ray = glm::normalize(ray + step.x * a + step.y * b);
  }
  return false;
}

/// A pinhole camera in whose middle a pixel of another camera is, with the same pixels there: the axes are those of the
/// ellipse that a small circle becomes.
Camera pinhole_at(const Camera& c, const glm::dvec3& ray) {
  constexpr int kSide = 15;
  const glm::dvec3 a = glm::normalize(glm::cross(ray, glm::dvec3(0.3, 1, 0.2))), b = glm::cross(ray, a);
  const glm::dmat2 m = slopes(c, ray, a, b), square = glm::transpose(m) * m;
  const double turn = 0.5 * std::atan2(2 * square[0][1], square[0][0] - square[1][1]);
  const glm::dvec2 first(std::cos(turn), std::sin(turn)), second(-first.y, first.x);
  Camera out = front_camera(kSide, kSide);
  out.fx = glm::length(m * first), out.fy = glm::length(m * second);
  const glm::dvec3 x = first.x * a + first.y * b, y = second.x * a + second.y * b;
  const glm::dmat4 turned(glm::transpose(glm::dmat3(x, y, ray)));  // from the camera's axes
  out.world_to_camera = turned * c.world_to_camera;
  return out;
}

/// Far behind, so that rays are nearly parallel.
constexpr double kFar = 1000;
Camera far_pinhole_at(const Camera& c, const glm::dvec2& place) {
  Camera out = front_camera(15, 15);
  out.fx = c.fx * kFar, out.fy = c.fy * kFar;
  out.world_to_camera = c.world_to_camera;
  out.world_to_camera[3] += glm::dvec4(-(place.x - c.cx) / c.fx, -(place.y - c.cy) / c.fy, kFar, 0);
  return out;
}

/// Gaussians all around, most of them some pixels wide in a picture of so many pixels a radian.
std::vector<Splat> splats_around(unsigned seed, int n, double pixels_per_radian) {
  Random random(seed);
  std::vector<Splat> splats;
  for (int i = 0; i < n; ++i) {
    const double distance = random.uniform(1.5, 6), height = random.uniform(-1, 1), turn = random.uniform(-pi, pi);
    const double level = distance * std::sqrt(1 - height * height);
    Splat s = splat_at(level * std::sin(turn), distance * height, level * std::cos(turn), 1, random.uniform(0.2, 0.9));
    for (float& log_scale : s.log_scale)
      log_scale = static_cast<float>(std::log(random.uniform(0.5, 2.0) * distance / pixels_per_radian));
    const auto q = cast<float>(random.rotation());
    s.rotation[0] = q.w, s.rotation[1] = q.x, s.rotation[2] = q.y, s.rotation[3] = q.z;
    for (int k = 0; k < 12; ++k) s.sh[k] = static_cast<float>(random.uniform(-1, 1) * (k < 3 ? 1.5 : 0.3));
    splats.push_back(s);
  }
  return splats;
}

Camera turned(Camera camera, double angle, const glm::dvec3& axis) {
  camera.world_to_camera = glm::rotate(glm::dmat4(1), angle, axis) * camera.world_to_camera;
  return camera;
}

/// PSNR of every seventh pixel of each row against a pinhole's in whose middle it is.
double against_pinholes(const Scene& scene, const Camera& camera, int& n) {
  const Frame frame = render(scene, camera, Arithmetic(), kOnCpu);
  const bool is_fisheye = camera.model == CameraModel::opencv_fisheye;
  std::vector<float> drawn, truth;
  Arithmetic options;
  if (camera.model == CameraModel::orthographic) options.near_plane = static_cast<float>(kFar) + math::kNearPlane;
  for (int y = 0; y < camera.height; ++y) {
    for (int x = y % 7; x < camera.width; x += 7) {
      const glm::dvec2 place(x + 0.5, y + 0.5);
      Camera pinhole;
      if (camera.model == CameraModel::orthographic) {
        pinhole = far_pinhole_at(camera, place);
      } else {
        glm::dvec3 ray;
        if (!find_ray(camera, place, ray) || (is_fisheye && ray.z < std::cos(kFisheyeAngle))) continue;
        pinhole = pinhole_at(camera, ray);
      }
      const Frame one = render(scene, pinhole, options, kOnCpu);
      for (std::size_t k = 0; k < 3; ++k) {
        drawn.push_back(frame.rgb[3 * static_cast<std::size_t>(y * camera.width + x) + k]);
        truth.push_back(one.rgb[3 * static_cast<std::size_t>(7 * 15 + 7) + k]);
      }
    }
  }
  n = static_cast<int>(drawn.size() / 3);
  return psnr(drawn, truth);
}

}  // namespace

TEST_CASE("every pixel of a lens, a panorama or parallel rays is a pinhole's in that direction") {
  for (const Camera& camera : {lens(), fisheye(), panorama(), map()}) {
    const std::string name = camera_model_name(camera.model);
    CAPTURE(name);
    const double focal = camera.model == CameraModel::orthographic ? 4 * camera.fx : camera.fx;
    const Scene scene = scene_of(cloud_of(splats_around(7, 1000, focal), 1));
    int n = 0;
    const double quality = against_pinholes(scene, turned(camera, 0.4, glm::normalize(glm::dvec3(1, 2, -1))), n);
    CHECK(n > camera.width * camera.height / 10);
    CHECK(quality > 50);
  }
}

TEST_CASE("a point lands where the formulas say, and its derivatives are theirs") {
  Random random(11);
  for (const Camera& camera : {lens(), fisheye(), panorama(), map()}) {
    const std::string name = camera_model_name(camera.model);
    CAPTURE(name);
    const auto view = rgs::view_of(camera, kNoOrigin, 0.01, 0.0);
    const double period = math::period_px(view);
    int n = 0;
    for (int i = 0; i < 300; ++i) {
      const auto v = random.vector(-2, 2);
      const glm::dvec3 p(v.x, v.y, v.z);
      if (camera.model == CameraModel::opencv && !(p.z > 0.1)) continue;
      const auto landing = math::land(view, {p.x, p.y, p.z});
      if (!landing.is_drawn) continue;
      ++n;
      const glm::dvec2 expected = by_formula(camera, p);
      CHECK(landing.at.u + 0.5 == doctest::Approx(math::nearest_copy(expected.x, camera.cx, period)).epsilon(1e-12));
      CHECK(landing.at.v + 0.5 == doctest::Approx(expected.y).epsilon(1e-12));
      const double slope_x = p.x / p.z, slope_y = p.y / p.z;
      const bool is_clamped =
          camera.model == CameraModel::opencv && (slope_x < view.slope_low_x || slope_x > view.slope_high_x ||
                                                  slope_y < view.slope_low_y || slope_y > view.slope_high_y);
      if (is_clamped || std::abs(std::remainder(expected.x - camera.cx, period)) > 0.49 * period) continue;
      const glm::dmat2 xy = slopes(camera, p, {1, 0, 0}, {0, 1, 0}), z = slopes(camera, p, {0, 0, 1}, {0, 0, 1});
      const double found[] = {landing.du.x, landing.du.y, landing.du.z, landing.dv.x, landing.dv.y, landing.dv.z};
      const double sought[] = {xy[0].x, xy[1].x, z[0].x, xy[0].y, xy[1].y, z[0].y};
      for (int k = 0; k < 6; ++k) CHECK(std::abs(found[k] - sought[k]) < 1e-5 * (1 + std::abs(sought[k])) * camera.fx);
    }
    CHECK(n > 50);
  }
  // On the axis, where a fisheye's direction is any.
  const auto view = rgs::view_of(fisheye(), kNoOrigin, 0.01, 0.0);
  const auto landing = math::land(view, {0.0, 0.0, 2.0});
  CHECK(landing.du.x == doctest::Approx(view.fx / 2));
  CHECK(landing.dv.y == doctest::Approx(view.fy / 2));
  CHECK(landing.dv.x == 0);
}

TEST_CASE("a lens and a fisheye without distortion are a pinhole, the fisheye near its axis") {
  const Scene scene = scene_of(cloud_of(random_splats(3, 400), 3));
  Camera camera = front_camera(120, 90);
  const Frame pinhole = render(scene, camera, Arithmetic(), kOnCpu);
  camera.model = CameraModel::opencv;
  const Frame plain = render(scene, camera, Arithmetic(), kOnCpu);
  CHECK(psnr(plain.rgb, pinhole.rgb) > 90);
  CHECK(psnr(plain.depth, pinhole.depth) > 60);

  Camera narrow = front_camera(64, 64);
  narrow.fx = narrow.fy = 2000;
  std::vector<Splat> splats;
  Random random(5);
  for (int i = 0; i < 100; ++i)
    splats.push_back(splat_at(random.uniform(-0.1, 0.1), random.uniform(-0.1, 0.1), 5 + 0.02 * i,
                              random.log_uniform(0.001, 0.01), random.uniform(0.1, 0.9)));
  const Scene small = scene_of(cloud_of(splats));
  const Frame straight = render(small, narrow, Arithmetic(), kOnCpu);
  narrow.model = CameraModel::opencv_fisheye;
  CHECK(psnr(render(small, narrow, Arithmetic(), kOnCpu).rgb, straight.rgb) > 60);
}

TEST_CASE("turning a panorama shifts its picture around, across its seam and over its poles") {
  constexpr int kShift = 37, kWidth = 200;  // neither are whole tiles
  std::vector<Splat> splats = splats_around(23, 600, kWidth / (2 * pi));
  for (int i = 0; i < 40; ++i) splats[static_cast<std::size_t>(i)].log_scale[i % 3] += 2;  // some are wide
  for (const double x : {0.0, 0.02, -0.3}) splats.push_back(splat_at(x, 3, 0.01, 0.3, 0.5));
  splats.push_back(splat_at(0, 3, 0, 0.3, 0.9)), splats.push_back(splat_at(0, -3, 0, 0.3, 0.9));
  const Scene scene = scene_of(cloud_of(splats, 1));
  const Camera camera = panorama(kWidth), shifted = turned(camera, 2 * pi * kShift / kWidth, {0, 1, 0});
  for (const auto extent : {math::Extent::ellipse, math::Extent::square}) {
    for (const auto exponent : {math::Exponent::direct, math::Exponent::folded}) {
      for (const bool simd : {true, false}) {
        CAPTURE(simd);
        Arithmetic options;
        options.extent = extent, options.exponent = exponent;
        const RendererOptions how{.backend = Backend::cpu, .simd = simd};
        const Frame a = render(scene, camera, options, how), b = render(scene, shifted, options, how);
        std::vector<float> around(b.rgb.size());
        for (int y = 0; y < camera.height; ++y) {
          for (int x = 0; x < kWidth; ++x) {
            const auto to = static_cast<std::size_t>(y * kWidth + x);
            const auto from = static_cast<std::size_t>(y * kWidth + (x + kShift) % kWidth);
            for (std::size_t k = 0; k < 3; ++k) around[3 * to + k] = b.rgb[3 * from + k];
          }
        }
        CHECK(psnr(around, a.rgb) > 50);
      }
    }
  }
}

TEST_CASE("each band of a panorama takes the nearer copy, and no other, in tiles of both sizes") {
  constexpr int kWidth = 200, kBand = math::kCopyBand;
  for (const double focal : {kWidth / (2 * pi), kWidth / 5.0}) {  // the full circle and a part of it
    Camera camera = panorama(kWidth);
    camera.fx = focal;
    const auto view = rgs::view_of(camera, kNoOrigin, 0.01, 0.0);
    const double period = math::period_px(view), middle = 0.5 * (kWidth - 1);
    const auto check = [&]<int kTile>(double u) {
      math::Projected<double> p[2]{};
      p[0].mean.u = p[1].mean.u = u;
      const math::TileGrid grid = math::tile_grid<kTile>(kWidth, kWidth / 2);
      const auto own = math::place_copy<kTile>(view, 0, grid, p[0]),
                 other = math::place_copy<kTile>(view, 1, grid, p[1]);
      CHECK(p[0].mean.u == u);
      CHECK(std::abs(p[1].mean.u - (u < middle ? u + period : u - period)) < 1e-9);
      for (int tile = 0; tile < grid.columns; ++tile) {
        const double band = kBand * (kTile * tile / kBand) + 0.5 * (kBand - 1);
        const bool is_own = std::abs(band - p[0].mean.u) <= std::abs(band - p[1].mean.u);
        CHECK((own.first <= tile && tile < own.last) == is_own);
        CHECK((other.first <= tile && tile < other.last) != is_own);
      }
    };
    for (double u = middle - period / 2; u < middle + period / 2; u += 0.37) {
      check.operator()<16>(u);
      check.operator()<32>(u);
    }
  }
}

TEST_CASE("what lies beyond the rise of a distortion, or behind, is not drawn") {
  const auto is_drawn = [](const Camera& camera, double x, double y, double z) {
    const Scene scene = scene_of(cloud_of(std::vector{splat_at(x, y, z, 0.3, 0.9)}));
    return render(scene, camera, Arithmetic(), kOnCpu).stats.visible > 0;
  };
  Camera barrel = front_camera(120, 90);
  barrel.model = CameraModel::opencv;
  barrel.distortion[0] = -0.4;  // x (1 - 0.4 x^2) rises up to x^2 = 1 / 1.2
  CHECK(rgs::view_of(barrel, kNoOrigin, 0.2, 0.0).reach == doctest::Approx(1 / 1.2));
  CHECK(is_drawn(barrel, 0.9 * 4, 0, 4));
  CHECK_FALSE(is_drawn(barrel, 0.93 * 4, 0, 4));   // it would land beside the other one
  CHECK_FALSE(is_drawn(barrel, 1.581 * 4, 0, 4));  // in the middle
  CHECK_FALSE(is_drawn(barrel, 0, 0, -4));
  CHECK_FALSE(is_drawn(map(), 0, 0, -4));
  CHECK(is_drawn(panorama(), 0, 0, -4));
  CHECK(is_drawn(fisheye(), 4, 0, -0.2));
  Camera bent = fisheye();
  bent.distortion = {-1.0 / 3, 0, 0, 0, 0, 0, 0, 0};  // a (1 - a^2 / 3) rises up to 1 rad
  CHECK(rgs::view_of(bent, kNoOrigin, 0.2, 0.0).reach == doctest::Approx(1));
  CHECK(is_drawn(bent, 4 * std::tan(0.99), 0, 4));
  CHECK_FALSE(is_drawn(bent, 4 * std::tan(1.01), 0, 4));
  // What chooses depth ranges and counts unseen means agrees.
  const auto seen = [](const Camera& camera, double x, double y, double z) {
    return see(rgs::view_of(camera, kNoOrigin, 0.2, 0.0), {x, y, z});
  };
  CHECK(seen(panorama(), 3, 0, -4).is_in_picture);
  CHECK(seen(panorama(), 3, 0, -4).depth == 5);
  CHECK(seen(map(), 0, 0, 4).depth == 4);
  CHECK(seen(map(), 2.9, 0, 4).is_in_picture);
  CHECK_FALSE(seen(map(), 3.1, 0, 4).is_in_picture);
  CHECK_FALSE(seen(barrel, 0, 0, -4).is_in_picture);
  CHECK_FALSE(seen(barrel, 1.581 * 4, 0, 4).is_in_picture);
  // The near plane and depths are distances where all directions are seen.
  CHECK_FALSE(is_drawn(panorama(), 0.1, 0, 0.1));
  CHECK(is_drawn(panorama(), 0.2, 0, 0.1));
  const Scene scene = scene_of(cloud_of(std::vector{splat_at(3, 0, 4, 0.3, 0.9)}));
  const Frame frame = render(scene, panorama(), Arithmetic(), kOnCpu);
  CHECK(*std::ranges::max_element(frame.depth) == doctest::Approx(5));
}

TEST_CASE("levels of detail are chosen by the largest magnification in the picture") {
  const auto focal = [](const Camera& camera) { return detail::eye_of(camera, kNoOrigin, 0.2F).focal_px; };
  Camera camera = front_camera(120, 90);
  CHECK(focal(camera) == camera.fx);
  camera.model = CameraModel::opencv;
  CHECK(focal(camera) == camera.fx);
  camera.distortion[0] = -0.05;
  CHECK(focal(camera) == camera.fx);  // it makes edges smaller
  camera.distortion[0] = 0.1;
  const double corner = std::hypot(60, 45) / camera.fx;
  CHECK(focal(camera) > camera.fx * (1 + 0.3 * 0.8 * corner * corner));
  camera.model = CameraModel::opencv_fisheye, camera.distortion = {};
  CHECK(focal(camera) > camera.fx * corner / std::sin(corner) * 0.98);
  CHECK(focal(panorama()) == panorama().fx);
  // Parallel rays: the same from everywhere.
  const lod::Eye eye = detail::eye_of(map(), kNoOrigin, 0.2F);
  CHECK(eye.z_near / eye.focal_px == doctest::Approx(1 / map().fy));
  CHECK(eye.z_near > 1e20);
}

TEST_CASE("whatever a valid camera's numbers, its picture is finite") {
  Random random(29);
  const Scene scene = scene_of(cloud_of(splats_around(31, 200, 20), 1));
  const auto any = [&] { return random.log_uniform(1e-6, 1e9) * (random.uniform(-1, 1) < 0 ? -1 : 1); };
  for (int i = 0; i < 400; ++i) {
    CAPTURE(i);
    Camera camera = camera_of(static_cast<CameraModel>(i % 5), 40, 24, random.log_uniform(1e-3, 1e6));
    if (camera.model == CameraModel::equirectangular) camera.fx = random.log_uniform(40 / (2 * pi), 1e6);
    const int n = camera.model == CameraModel::opencv ? 8 : camera.model == CameraModel::opencv_fisheye ? 4 : 0;
    for (int k = 0; k < n; ++k)
      if (random.uniform(0, 1) < 0.5) camera.distortion[static_cast<std::size_t>(k)] = any();
    if (i % 3 == 0) camera.cx = any();
    REQUIRE(validate(camera));
    Arithmetic options;
    options.extent = i % 2 == 0 ? math::Extent::ellipse : math::Extent::square;
    const Frame frame = render(scene, camera, options, kOnCpu);
    CHECK(std::ranges::all_of(frame.rgb, [](float value) { return std::isfinite(value); }));
    CHECK(detail::eye_of(camera, kNoOrigin, 0.2F).focal_px > 0);
  }
}

TEST_CASE("a Gaussian straight above, below or behind the camera is drawn") {
  const Camera camera = panorama(200);
  for (const double y : {3.0, -3.0}) {
    const Frame frame = render(scene_of(cloud_of(std::vector{splat_at(0, y, 0, 0.3, 0.9)})), camera, {}, kOnCpu);
    const std::size_t row = y > 0 ? 200 * 99 : 0;
    for (std::size_t x = 0; x < 200; x += 20) CHECK(frame.alpha[row + x] > 0.5);
  }
  const Camera behind = camera_of(CameraModel::opencv_fisheye, 200, 200, 100 / pi);
  const Frame ring = render(scene_of(cloud_of(std::vector{splat_at(0, 0, -3, 0.3, 0.9)})), behind, {}, kOnCpu);
  CHECK(ring.alpha[200 * 100 + 199] > 0.5);
}

TEST_CASE("tangential distortion folds nothing into the picture") {
  Camera camera = camera_of(CameraModel::opencv, 200, 100, 100);
  camera.distortion = {0, 0, 0, 0.01, 0, 0, 0, 0};
  const double x = -33.333;  // x + 0.03 x^2 is 0 again
  const Scene scene = scene_of(cloud_of(std::vector{splat_at(x, 0, 1, 0.02, 0.9)}));
  const Frame frame = render(scene, camera, {}, kOnCpu);
  for (const float alpha : frame.alpha) REQUIRE(alpha == 0);
}
