// sh_math_test.cpp - spherical harmonics: orthonormal, closed under rotation, and the colour convention.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/math/sh.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <numbers>

#include "random_views.hpp"

using namespace rgs::math;
using namespace rgs::test;

namespace {

Vec3<double> direction(Random& random) {
  const auto q = random.rotation();
  double r[9];
  rotation_matrix(q, r);
  return {r[0], r[3], r[6]};
}

}  // namespace

TEST_CASE("the basis is orthonormal on the sphere") {
  // Exact for products of degree 6: 4 Gauss-Legendre nodes in z, 8 equal steps in azimuth.
  const double nodes[4] = {-0.8611363115940526, -0.3399810435848563, 0.3399810435848563, 0.8611363115940526};
  const double weights[4] = {0.3478548451374538, 0.6521451548625461, 0.6521451548625461, 0.3478548451374538};
  double products[16][16] = {};
  for (int i = 0; i < 4; ++i) {
    for (int j = 0; j < 8; ++j) {
      const double phi = 2 * std::numbers::pi * (j + 0.3) / 8, ring = std::sqrt(1 - nodes[i] * nodes[i]);
      const auto b = sh_basis<double>(3, {ring * std::cos(phi), ring * std::sin(phi), nodes[i]});
      for (int m = 0; m < 16; ++m) {
        for (int n = 0; n < 16; ++n) products[m][n] += weights[i] * 2 * std::numbers::pi / 8 * b.y[m] * b.y[n];
      }
    }
  }
  for (int m = 0; m < 16; ++m) {
    for (int n = 0; n < 16; ++n) CHECK(products[m][n] == doctest::Approx(m == n ? 1 : 0).epsilon(1e-12));
  }
}

TEST_CASE("each degree rotates within itself: the addition theorem") {
  // sum_m Y_lm(a) Y_lm(b) = (2l+1)/(4 pi) P_l(a.b) depends on the angle alone, so a common rotation is absorbed by an
  // orthogonal matrix on the coefficients of degree l.
  Random random(5);
  for (int i = 0; i < 200; ++i) {
    const auto a = direction(random), b = direction(random);
    const auto ya = sh_basis<double>(3, a), yb = sh_basis<double>(3, b);
    const double t = dot(a, b);
    const double legendre[4] = {1, t, (3 * t * t - 1) / 2, (5 * t * t * t - 3 * t) / 2};
    for (int l = 0; l <= 3; ++l) {
      double sum = 0;
      for (int k = l * l; k < (l + 1) * (l + 1); ++k) sum += ya.y[k] * yb.y[k];
      CHECK(std::abs(sum - (2 * l + 1) / (4 * std::numbers::pi) * legendre[l]) < 1e-12);
    }
  }
}

TEST_CASE("signs and order are those of 3DGS: (-y, z, -x) in degree 1") {
  const auto b = sh_basis<double>(1, {0.36, 0.48, 0.8});
  CHECK(b.y[1] == doctest::Approx(-0.4886025119029199 * 0.48));
  CHECK(b.y[2] == doctest::Approx(0.4886025119029199 * 0.8));
  CHECK(b.y[3] == doctest::Approx(-0.4886025119029199 * 0.36));
  CHECK(b.y[4] == 0);
}

TEST_CASE("single precision follows double precision") {
  Random random(6);
  for (int i = 0; i < 200; ++i) {
    const auto d = direction(random);
    const auto a = sh_basis<double>(3, d);
    const auto b = sh_basis<float>(3, cast<float>(d));
    for (int k = 0; k < 16; ++k) CHECK(std::abs(a.y[k] - b.y[k]) < 1e-6);
  }
}

TEST_CASE("colour is 1/2 plus the sum, clamped at 0; coefficients above the degree are not read") {
  const auto basis = sh_basis<float>(3, {0, 0, 1});
  int highest = -1;
  const auto sh = [&](int k) {
    highest = k;
    return k == 0 ? Vec3<float>{1, -5, 0} : Vec3<float>{0, 0, k == 2 ? 1.0F : 0.0F};
  };
  const auto c = sh_color<float>(1, basis, sh);
  CHECK(highest == 3);
  CHECK(c.x == doctest::Approx(0.5 + 0.28209479));
  CHECK(c.y == 0);
  CHECK(c.z == doctest::Approx(0.5 + 0.48860251));
}
