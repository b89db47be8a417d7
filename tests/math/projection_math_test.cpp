// projection_math_test.cpp - views, EWA covariance and conics against closed forms and invariants.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/math/projection.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "random_views.hpp"

using namespace rgs::math;
using namespace rgs::test;

namespace {

constexpr int kWidth = 1280, kHeight = 960;
constexpr std::array<double, 16> kIdentity{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};

template <class T>
View<T> default_view(const std::array<double, 16>& world_to_camera = kIdentity) {
  return view_of<T>(world_to_camera, kWidth, kHeight, 1000, 1010, kWidth / 2.0, kHeight / 2.0);
}

// Camera-space point inside the image at depth 0.5 .. 50.
Vec3<double> visible_point(Random& random) {
  const double z = random.log_uniform(0.5, 50);
  return {random.uniform(-0.6, 0.6) * z, random.uniform(-0.45, 0.45) * z, z};
}

}  // namespace

TEST_CASE("a point on the optical axis lands between the two middle pixels") {
  const auto view = default_view<double>();
  const auto p = to_pixel(view, {0.0, 0.0, 3.0});
  CHECK(p.u == kWidth / 2.0 - 0.5);
  CHECK(p.v == kHeight / 2.0 - 0.5);
  // ((ndc + 1) * size - 1) / 2 with ndc = 2 fx x / (z W).
  const auto q = to_pixel(view, {0.3, -0.2, 2.0});
  CHECK(q.u == doctest::Approx(((2 * 1000 * 0.15 / kWidth + 1) * kWidth - 1) / 2));
  CHECK(q.v == doctest::Approx(((2 * 1010 * -0.1 / kHeight + 1) * kHeight - 1) / 2));
}

TEST_CASE("depth range: the near plane itself is out, the far plane in, NaN out") {
  auto view = default_view<float>();
  CHECK_FALSE(in_depth_range(view, 0.2F));
  CHECK(in_depth_range(view, std::nextafter(0.2F, 1.0F)));
  CHECK(in_depth_range(view, 1e30F));
  CHECK_FALSE(in_depth_range(view, std::numeric_limits<float>::quiet_NaN()));
  view.far_plane = 10;
  CHECK(in_depth_range(view, 10.0F));
  CHECK_FALSE(in_depth_range(view, std::nextafter(10.0F, 11.0F)));
}

TEST_CASE("covariance equals J Sigma J^T with J by differences of the projection") {
  Random random(1);
  for (int i = 0; i < 200; ++i) {
    const auto world = rigid(random.rotation(), random.vector(-3, 3));
    const auto view = default_view<double>(world);
    const auto inverse_rotation = [&](const Vec3<double>& c) {
      const Vec3<double> d{c.x - world[3], c.y - world[7], c.z - world[11]};
      return Vec3<double>{world[0] * d.x + world[4] * d.y + world[8] * d.z,
                          world[1] * d.x + world[5] * d.y + world[9] * d.z,
                          world[2] * d.x + world[6] * d.y + world[10] * d.z};
    };
    const auto p = visible_point(random);
    const auto mean = inverse_rotation(p);
    const auto q = random.rotation();
    const Vec3<double> s{random.log_uniform(1e-3, 1), random.log_uniform(1e-3, 1), random.log_uniform(1e-3, 1)};
    // Sigma = sum_k s_k^2 a_k a_k^T, so J Sigma J^T = sum_k s_k^2 (J a_k)(J a_k)^T.
    double r[9];
    rotation_matrix(q, r);
    const double scales[3] = {s.x, s.y, s.z};
    Cov2<double> expected{0, 0, 0};
    for (int k = 0; k < 3; ++k) {
      const double h = 1e-5 * p.z;
      const Vec3<double> a{r[k] * h, r[3 + k] * h, r[6 + k] * h};
      const auto plus = to_pixel(view, to_camera(view, {mean.x + a.x, mean.y + a.y, mean.z + a.z}));
      const auto minus = to_pixel(view, to_camera(view, {mean.x - a.x, mean.y - a.y, mean.z - a.z}));
      const double du = (plus.u - minus.u) / (2 * h) * scales[k], dv = (plus.v - minus.v) / (2 * h) * scales[k];
      expected.xx += du * du, expected.xy += du * dv, expected.yy += dv * dv;
    }
    const auto cov = project_covariance(view, to_camera(view, mean), q, s);
    const double size = expected.xx + expected.yy;
    CHECK(std::abs(cov.xx - expected.xx) < 1e-6 * size);
    CHECK(std::abs(cov.xy - expected.xy) < 1e-6 * size);
    CHECK(std::abs(cov.yy - expected.yy) < 1e-6 * size);
  }
}

TEST_CASE("projection in single precision follows double precision") {
  Random random(2);
  for (int i = 0; i < 500; ++i) {
    const auto world = rigid(random.rotation(), random.vector(-1, 1));
    const auto exact = default_view<double>(world);
    const auto view = default_view<float>(world);
    const auto mean = random.vector(-5, 5);
    const auto q = random.rotation();
    const Vec3<double> s{random.log_uniform(1e-2, 1), random.log_uniform(1e-2, 1), random.log_uniform(1e-2, 1)};
    const auto a = project(exact, mean, q, s, 0.5, 0.3, AntiAliasing::mip_splatting);
    if (!a.footprint.valid || a.z < 0.3) continue;
    const auto b =
        project(view, cast<float>(mean), cast<float>(q), cast<float>(s), 0.5F, 0.3F, AntiAliasing::mip_splatting);
    REQUIRE(b.footprint.valid);
    const double slopes = 1 + std::abs(a.mean.u / 1000) + std::abs(a.mean.v / 1000);
    CHECK(std::abs(b.z - a.z) < 5e-6);
    CHECK(std::abs(b.mean.u - a.mean.u) < 1e-2 * slopes / a.z);
    CHECK(std::abs(b.mean.v - a.mean.v) < 1e-2 * slopes / a.z);
    const double size = a.footprint.cov.xx + a.footprint.cov.yy;
    CHECK(std::abs(b.footprint.cov.xx - a.footprint.cov.xx) < 1e-4 * size);
    CHECK(std::abs(b.footprint.cov.xy - a.footprint.cov.xy) < 1e-4 * size);
    CHECK(std::abs(b.footprint.cov.yy - a.footprint.cov.yy) < 1e-4 * size);
    CHECK(b.footprint.opacity == doctest::Approx(a.footprint.opacity).epsilon(1e-3));
  }
}

TEST_CASE("far from the world's origin single precision follows double precision as near it") {
  Random random(4);
  const Vec3<double> place{4.2e6, 1.7e5, 4.8e6};
  for (int i = 0; i < 500; ++i) {
    const auto turn = rigid(random.rotation(), {0, 0, 0});
    const auto eye = random.vector(-1, 1), mean = random.vector(-5, 5);
    const auto looking_from = [&](const Vec3<double>& position) {
      auto world = turn;
      const auto t = transform(turn, position);
      world[3] = -t.x, world[7] = -t.y, world[11] = -t.z;
      return world;
    };
    const auto away = looking_from({place.x + eye.x, place.y + eye.y, place.z + eye.z});
    const auto p = to_camera(default_view<double>(looking_from(eye)), mean);
    // Means that are exact in FP32: multiples of 1/2. And others, relative to a nearby origin.
    const Vec3<float> absolute{static_cast<float>(place.x + mean.x), static_cast<float>(place.y + mean.y),
                               static_cast<float>(place.z + mean.z)};
    const auto q = to_camera(default_view<float>(away), absolute);
    const auto expected =
        to_camera(default_view<double>(looking_from(eye)),
                  {static_cast<double>(absolute.x) - place.x, static_cast<double>(absolute.y) - place.y,
                   static_cast<double>(absolute.z) - place.z});
    CHECK(std::abs(static_cast<double>(q.x) - expected.x) < 5e-6);
    CHECK(std::abs(static_cast<double>(q.y) - expected.y) < 5e-6);
    CHECK(std::abs(static_cast<double>(q.z) - expected.z) < 5e-6);
    const Vec3<double> origin{place.x + 16.3, place.y - 7, place.z};
    Matrix4 m;
    for (std::size_t k = 0; k < 16; ++k) m[k] = away[k];
    const auto relative = make_view<float>(m, kWidth, kHeight, 1000, 1010, 640, 480, 0.2F, 0.0F, origin);
    const auto r = to_camera(relative, cast<float>(Vec3<double>{mean.x - 16.3, mean.y + 7, mean.z}));
    CHECK(std::abs(static_cast<double>(r.x) - p.x) < 5e-6);
    CHECK(std::abs(static_cast<double>(r.y) - p.y) < 5e-6);
    CHECK(std::abs(static_cast<double>(r.z) - p.z) < 5e-6);
    const auto d = view_direction(relative, cast<float>(Vec3<double>{mean.x - 16.3, mean.y + 7, mean.z}));
    const auto e = view_direction(default_view<double>(looking_from(eye)), mean);
    CHECK(std::abs(static_cast<double>(d.x) - e.x) < 2e-6 / std::abs(p.z));
  }
}

TEST_CASE("a view equals its matrix, even if the rotation has five decimals and the camera is far away") {
  Random random(5);
  for (int i = 0; i < 100; ++i) {
    auto world = rigid(random.rotation(), random.vector(-1, 1));
    for (const std::size_t k : {0u, 1u, 2u, 4u, 5u, 6u, 8u, 9u, 10u}) world[k] = std::round(world[k] * 1e5) / 1e5;
    const auto far = random.vector(-4e6, 4e6);
    // R p + t equals that of the picture's point beside `far`.
    const auto t = transform({world[0], world[1], world[2], 0, world[4], world[5], world[6], 0, world[8], world[9],
                              world[10], 0, 0, 0, 0, 1},
                             far);
    world[3] -= t.x, world[7] -= t.y, world[11] -= t.z;
    const Vec3<double> p{far.x + 3, far.y - 2, far.z + 7};
    const auto a = transform(world, p), b = to_camera(default_view<double>(world), p);
    CHECK(std::abs(a.x - b.x) < 1e-8);
    CHECK(std::abs(a.y - b.y) < 1e-8);
    CHECK(std::abs(a.z - b.z) < 1e-8);
  }
}

TEST_CASE("moving camera and scene together does not change the image") {
  Random random(3);
  for (int i = 0; i < 200; ++i) {
    const auto world = rigid(random.rotation(), random.vector(-3, 3));
    const auto turn = random.rotation();
    const auto motion = rigid(turn, random.vector(-10, 10));
    // The moved camera undoes the motion: world' = world * motion^-1.
    const Quaternion<double> back{turn.w, -turn.x, -turn.y, -turn.z};
    auto inverse = rigid(back, {0, 0, 0});
    const auto t = transform(inverse, {motion[3], motion[7], motion[11]});
    inverse[3] = -t.x, inverse[7] = -t.y, inverse[11] = -t.z;
    const auto view = default_view<double>(world);
    const auto moved = default_view<double>(compose(world, inverse));
    const auto mean = random.vector(-5, 5);
    const auto q = random.rotation();
    const Vec3<double> s{random.log_uniform(1e-3, 1), random.log_uniform(1e-3, 1), random.log_uniform(1e-3, 1)};
    const auto a = project(view, mean, q, s, 0.5, 0.3, AntiAliasing::classic);
    const auto b = project(moved, transform(motion, mean), multiply(turn, q), s, 0.5, 0.3, AntiAliasing::classic);
    REQUIRE(a.footprint.valid == b.footprint.valid);
    if (!a.footprint.valid) continue;
    CHECK(a.mean.u == doctest::Approx(b.mean.u).epsilon(1e-8));
    CHECK(a.footprint.cov.xx == doctest::Approx(b.footprint.cov.xx).epsilon(1e-8));
    CHECK(std::abs(a.footprint.cov.xy - b.footprint.cov.xy) < 1e-8 * (a.footprint.cov.xx + a.footprint.cov.yy));
    CHECK(a.footprint.cov.yy == doctest::Approx(b.footprint.cov.yy).epsilon(1e-8));
    // The view direction turns with the scene.
    const auto d = transform(rigid(turn, {0, 0, 0}), view_direction(view, mean));
    const auto e = view_direction(moved, transform(motion, mean));
    CHECK(dot(d, e) == doctest::Approx(1).epsilon(1e-9));
  }
}

TEST_CASE("covariances are positive semi-definite, also for flat, tiny and huge Gaussians in single precision") {
  Random random(4);
  const auto view = default_view<float>();
  for (int i = 0; i < 2000; ++i) {
    const auto p = cast<float>(visible_point(random));
    const auto extreme = [&] { return i % 4 == 0 ? 0.0 : random.log_uniform(1e-12, 1e6); };
    const Vec3<double> s{extreme(), random.log_uniform(1e-12, 1e6), extreme()};
    const auto cov = project_covariance(view, p, cast<float>(random.rotation()), cast<float>(s));
    CHECK(cov.xx >= 0);
    CHECK(cov.yy >= 0);
    CHECK(std::abs(cov.xy) <= std::sqrt(cov.xx) * std::sqrt(cov.yy) * 1.00001F);
    const auto f = footprint(cov, 1.0F, kLowPass, AntiAliasing::classic);
    if (!f.valid) continue;
    CHECK(f.conic.a > 0);
    CHECK(f.conic.c > 0);
  }
  CHECK_FALSE(footprint(Cov2<float>{1e30F, 0, 1e30F}, 1.0F, kLowPass, AntiAliasing::classic).valid);
  CHECK_FALSE(footprint(Cov2<float>{NAN, 0, 1}, 1.0F, kLowPass, AntiAliasing::classic).valid);
  CHECK_FALSE(footprint(Cov2<float>{0, 0, 0}, 1.0F, 0.0F, AntiAliasing::classic).valid);
}

TEST_CASE("outside the image the projection is linearised at the clamped slope") {
  const auto view = view_of<double>(kIdentity, 1000, 500, 500, 500, 400, 250);
  // Edges at slopes (0 - 400)/500 and (1000 - 400)/500, margin 0.3 * 1000 / (2 * 500).
  CHECK(view.slope_low_x == doctest::Approx(-0.8 - 0.3));
  CHECK(view.slope_high_x == doctest::Approx(1.2 + 0.3));
  CHECK(view.slope_low_y == doctest::Approx(-0.5 * 1.3));
  CHECK(view.slope_high_y == doctest::Approx(0.5 * 1.3));
  const Quaternion<double> q{1, 0, 0, 0};
  const Vec3<double> s{0.1, 0.1, 0.1};
  const auto inside = project_covariance(view, {1.4, 0.0, 1.0}, q, s);
  const auto edge = project_covariance(view, {1.5, 0.0, 1.0}, q, s);
  const auto outside = project_covariance(view, {40.0, 0.0, 1.0}, q, s);
  CHECK(edge.xx == outside.xx);
  CHECK(inside.xx < outside.xx);
}

TEST_CASE("the conic inverts the low-passed covariance; the Mip filter keeps the integral") {
  const Cov2<double> cov{4, 1.5, 2};
  const auto classic = footprint(cov, 0.8, 0.3, AntiAliasing::classic);
  CHECK(classic.opacity == 0.8);
  CHECK(classic.conic.a * 4.3 + classic.conic.b * 1.5 == doctest::Approx(1));
  CHECK(classic.conic.a * 1.5 + classic.conic.b * 2.3 == doctest::Approx(0));
  CHECK(classic.conic.b * 1.5 + classic.conic.c * 2.3 == doctest::Approx(1));
  const auto mip = footprint(cov, 0.8, 0.3, AntiAliasing::mip_splatting);
  CHECK(mip.opacity * std::sqrt(determinant(mip.cov)) == doctest::Approx(0.8 * std::sqrt(determinant(cov))));
  CHECK(footprint(Cov2<double>{1e-9, 0, 1e-9}, 1.0, 0.3, AntiAliasing::mip_splatting).opacity ==
        doctest::Approx(0.005));
}
