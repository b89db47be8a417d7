// splat_cloud.hpp - 3D Gaussian splats in memory, in the parameters of training.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/api.hpp"

namespace RGS_API rgs {

inline constexpr int kMaxShDegree = 3;

/// SH coefficients per colour channel for degrees 0..degree: 1, 4, 9, 16.
constexpr int sh_coefficients(int degree) {
  return (degree + 1) * (degree + 1);
}

/// SH degree of coefficient 0..15.
constexpr int sh_degree_of(int coefficient) {
  return coefficient < 1 ? 0 : coefficient < 4 ? 1 : coefficient < 9 ? 2 : 3;
}

/// Origin of a scene's FP32 means: world position = origin + mean, in the scene's axes, world units. Zero except for
/// scenes so far away that FP32 would round them, such as georeferenced ones. Declarations, SplatFile and Scene state
/// it; plain Gaussians do not know it.
using Origin = std::array<double, 3>;
inline constexpr Origin kNoOrigin{0, 0, 0};
/// Largest coordinate of an origin.
inline constexpr double kMaxOrigin = 1e12;

/// One Gaussian in the parameters of 3DGS training (Kerbl et al. 2023). The frame is the scene's world frame.
struct Splat {
  float mean[3] = {0, 0, 0};         ///< centre relative to the scene's origin, world units
  float log_scale[3] = {0, 0, 0};    ///< natural logarithm of the standard deviations along the local axes
  float rotation[4] = {1, 0, 0, 0};  ///< quaternion w, x, y, z; need not be normalised
  float opacity_logit = 0;           ///< opacity = 1 / (1 + exp(-opacity_logit))
  float sh[3 * 16] = {};             ///< [16, 3] coefficient-major, R G B interleaved; unused degrees are 0
  float mean_rest[3] = {0, 0, 0};    ///< what FP32 rounded off the mean, if that is known: centre = mean + mean_rest
};

/// Read-only view of N Gaussians, structure of arrays. All spans must have the stated sizes.
struct SplatView {
  std::uint64_t n = 0;
  int sh_degree = 0;                      ///< 0..3
  std::span<const float> mean;            ///< [n, 3] relative to the scene's origin, world units
  std::span<const float> log_scale;       ///< [n, 3]
  std::span<const float> rotation;        ///< [n, 4] w, x, y, z
  std::span<const float> opacity_logit;   ///< [n]
  std::span<const float> sh;              ///< [n, sh_coefficients(sh_degree), 3]
  std::span<const float> mean_rest = {};  ///< [n, 3], see Splat; or empty: 0

  /// Sizes agree with n and sh_degree.
  bool consistent() const;
  /// Gaussian i as one record.
  Splat splat(std::uint64_t i) const;
};

/// Owning counterpart of SplatView.
struct SplatCloud {
  int sh_degree = 0;                  ///< 0 to 3
  std::vector<float> mean;            ///< [n, 3] relative to the scene's origin
  std::vector<float> log_scale;       ///< [n, 3]
  std::vector<float> rotation;        ///< [n, 4] w, x, y, z
  std::vector<float> opacity_logit;   ///< [n]
  std::vector<float> sh;              ///< [n, sh_coefficients(sh_degree), 3]
  std::vector<float> mean_rest = {};  ///< [n, 3], see Splat; or empty: 0. A new size empties it

  std::uint64_t size() const { return opacity_logit.size(); }  ///< Gaussians
  SplatView view() const { return {size(), sh_degree, mean, log_scale, rotation, opacity_logit, sh, mean_rest}; }
  void resize(std::uint64_t n, int degree);
  void set(std::uint64_t i, const Splat& splat);
};

}  // namespace rgs
