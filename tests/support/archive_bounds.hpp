// archive_bounds.hpp - the errors of a file of Codec::archive as docs/format/ARCHIVE.md "Bounds" measures them, and the
// bounds that it states, from its bytes: apart from the library's formulas.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

#include "edit_file.hpp"
#include "rgs/decode.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::test {

/// Stated in ARCH; of bounds by class the largest of any.
struct StatedBounds {
  explicit StatedBounds(std::span<const std::byte> file) {
    const std::uint64_t arch = section_of(file, "ARCH");
    for (std::uint64_t k = 0; k < 3; ++k) centre[k] = get<double>(file, arch + 24 + 8 * k);
    nearest = get<double>(file, arch + 72);
    blur = get<std::int32_t>(file, arch + 80) / 65536.0;
    opacity = static_cast<double>(get<float>(file, arch + 108));
    for (std::uint64_t c = 0; c < get<std::uint32_t>(file, arch + 8); ++c) {
      std::uint64_t field = arch + 128 + 24 * c + 8;
      for (double* bound : {&mean, &covariance, &dc, &sh}) {
        *bound = std::max(*bound, static_cast<double>(get<float>(file, field)));
        field += 4;
      }
    }
  }
  std::array<double, 3> centre{};
  double nearest = 0, blur = 0;
  double mean = 0, covariance = 0, opacity = 0, dc = 0, sh = 0;
};

using Matrix3 = std::array<std::array<double, 3>, 3>;

/// R diag(scale^2) R^T of a quaternion w x y z that need not be normalised.
inline Matrix3 covariance_of(const float q[4], const std::array<double, 3>& scale) {
  double n = 0;
  for (int k = 0; k < 4; ++k) n += static_cast<double>(q[k]) * static_cast<double>(q[k]);
  const double s = std::sqrt(n), w = q[0] / s, x = q[1] / s, y = q[2] / s, z = q[3] / s;
  const Matrix3 r{{{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)},
                   {2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)},
                   {2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}}};
  Matrix3 out{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      for (std::size_t k = 0; k < 3; ++k) out[i][j] += r[i][k] * scale[k] * scale[k] * r[j][k];
    }
  }
  return out;
}

/// By the adjugate.
inline Matrix3 inverse(const Matrix3& m) {
  Matrix3 out{};
  double determinant = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      const std::size_t a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
      out[i][j] = m[a][c] * m[b][d] - m[a][d] * m[b][c];
    }
  }
  for (std::size_t k = 0; k < 3; ++k) determinant += m[0][k] * out[k][0];
  for (auto& row : out) {
    for (double& x : row) x /= determinant;
  }
  return out;
}

struct BlurredErrors {
  double mean = 0, covariance = 0;
};

/// Of a decoded Gaussian on a level, in the frame where it is a unit sphere once blurred.
inline BlurredErrors blurred_errors(const StatedBounds& of, int level, const Splat& source,
                                    const ActivatedSplat& decoded) {
  std::array<double, 3> scale{}, source_scale{}, moved{};
  double distance = 0;
  for (std::size_t k = 0; k < 3; ++k) {
    const double mean = decoded.mean[k], from_centre = mean - of.centre[k];
    distance += from_centre * from_centre;
    moved[k] = mean - static_cast<double>(source.mean[k]);
    scale[k] = decoded.scale[k];
    source_scale[k] = std::exp(static_cast<double>(source.log_scale[k]));
  }
  const Matrix3 now = covariance_of(decoded.rotation, scale), before = covariance_of(source.rotation, source_scale);
  Matrix3 blurred = now, change{};
  for (std::size_t i = 0; i < 3; ++i) {
    blurred[i][i] += std::exp2(2 * of.blur + 2 * level) * std::max(distance, of.nearest);
    for (std::size_t j = 0; j < 3; ++j) change[i][j] = now[i][j] - before[i][j];
  }
  // With A S A^T = 1, A^T A is the inverse P of S: |A d|^2 = d P d, and |A E A^T|^2 is the trace of E P E P.
  const Matrix3 p = inverse(blurred);
  Matrix3 ep{};
  BlurredErrors errors;
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      errors.mean += moved[i] * p[i][j] * moved[j];
      for (std::size_t k = 0; k < 3; ++k) ep[i][j] += change[i][k] * p[k][j];
    }
  }
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) errors.covariance += ep[i][j] * ep[j][i];
  }
  return {std::sqrt(std::max(errors.mean, 0.0)), std::sqrt(std::max(errors.covariance, 0.0))};
}

/// How far at most a mean is from its source's, by the bound: along the widest axis of the decoded Gaussian, blurred.
inline double reach_of_mean(const StatedBounds& of, int level, const Splat& decoded) {
  double distance = 0;
  for (std::size_t k = 0; k < 3; ++k) distance += std::pow(static_cast<double>(decoded.mean[k]) - of.centre[k], 2.0);
  const double scale = std::exp(static_cast<double>(*std::max_element(decoded.log_scale, decoded.log_scale + 3)));
  return of.mean * std::sqrt(scale * scale + std::exp2(2 * of.blur + 2 * level) * std::max(distance, of.nearest));
}

/// Whether a decoded Gaussian is its source within these bounds, and the rounding of the decoded numbers. `step`: of SH
/// coefficients [48].
template <class StepOf>
bool is_within(const StatedBounds& bounds, int level, int sh_degree, const Splat& source, const ActivatedSplat& decoded,
               const StepOf& step) {
  const BlurredErrors e = blurred_errors(bounds, level, source, decoded);
  const double opacity = 1 / (1 + std::exp(-static_cast<double>(source.opacity_logit)));
  constexpr double kRounding = 1.001;
  bool within = e.mean <= bounds.mean * kRounding + 1e-5 && e.covariance <= bounds.covariance * kRounding + 1e-5 &&
                std::abs(std::sqrt(static_cast<double>(decoded.opacity)) - std::sqrt(opacity)) <= bounds.opacity + 1e-6;
  for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) {
    const double bound = (k < 3 ? bounds.dc : bounds.sh) + 0.501 * static_cast<double>(step(k));
    within = within && std::abs(decoded.sh[k] - source.sh[k]) <= bound + 1e-6;
  }
  return within;
}

}  // namespace rgs::test
