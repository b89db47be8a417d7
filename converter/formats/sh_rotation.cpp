// sh_rotation.cpp - the matrices that rotate real spherical harmonics.
//
// Y_k(R^-1 d) = sum_j D_jk Y_j(d) within a degree, so D_jk is the integral of Y_j(d) Y_k(R^-1 d) over the sphere. The
// integrand is a polynomial of degree 6: a product of four Gauss-Legendre nodes in z and eight even steps in azimuth
// integrates it exactly. Recursions (Ivanic and Ruedenberg 1996) are faster but would restate the basis; here
// rgs::math::sh_basis stays its only definition, signs included, and reflections need nothing of their own.
// SPDX-License-Identifier: Apache-2.0
#include "sh_rotation.hpp"

#include <cmath>
#include <numbers>

#include "rgs/math/sh.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {
namespace {

// Makes entries of axis flips and permutations exact: rounding must not pollute zeros.
double snap(double entry) {
  const double nearest = std::round(entry);
  return std::abs(entry - nearest) < 1e-12 ? nearest : entry;
}

template <std::size_t n>
void copy_block(const double (&all)[16][16], std::size_t first, double (&block)[n][n]) {
  for (std::size_t j = 0; j < n; ++j) {
    for (std::size_t k = 0; k < n; ++k) block[j][k] = snap(all[first + j][first + k]);
  }
}

template <std::size_t n>
void apply_block(const double (&block)[n][n], float* sh) {
  for (std::size_t c = 0; c < 3; ++c) {
    double turned[n] = {};
    for (std::size_t j = 0; j < n; ++j) {
      for (std::size_t k = 0; k < n; ++k) turned[j] += block[j][k] * static_cast<double>(sh[3 * k + c]);
    }
    for (std::size_t j = 0; j < n; ++j) sh[3 * j + c] = static_cast<float>(turned[j]);
  }
}

}  // namespace

ShRotation::ShRotation(const glm::dmat3& rotation) {
  constexpr int kSteps = 8;
  constexpr double kNodes[4] = {-0.8611363115940526, -0.3399810435848563, 0.3399810435848563, 0.8611363115940526};
  constexpr double kWeights[4] = {0.3478548451374538, 0.6521451548625461, 0.6521451548625461, 0.3478548451374538};
  double all[16][16] = {};
  for (int i = 0; i < 4; ++i) {
    for (int step = 0; step < kSteps; ++step) {
      const double angle = 2 * std::numbers::pi * step / kSteps, radius = std::sqrt(1 - kNodes[i] * kNodes[i]);
      const glm::dvec3 d{radius * std::cos(angle), radius * std::sin(angle), kNodes[i]};
      const glm::dvec3 back = d * rotation;  // by the transposed matrix, which is the inverse
      const auto here = math::sh_basis(kMaxShDegree, math::Vec3<double>{d.x, d.y, d.z});
      const auto there = math::sh_basis(kMaxShDegree, math::Vec3<double>{back.x, back.y, back.z});
      const double weight = kWeights[i] * 2 * std::numbers::pi / kSteps;
      for (int j = 0; j < 16; ++j) {
        for (int k = 0; k < 16; ++k) all[j][k] += weight * here.y[j] * there.y[k];
      }
    }
  }
  copy_block(all, 1, degree1_);
  copy_block(all, 4, degree2_);
  copy_block(all, 9, degree3_);
}

void ShRotation::apply(float* sh, int degree) const {
  if (degree >= 1) apply_block(degree1_, sh + 3 * 1);
  if (degree >= 2) apply_block(degree2_, sh + 3 * 4);
  if (degree >= 3) apply_block(degree3_, sh + 3 * 9);
}

}  // namespace rgs::detail
