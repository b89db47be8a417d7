// sh_rotation.hpp - spherical harmonics under rotations and reflections of the scene.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <glm/mat3x3.hpp>

namespace rgs::detail {

/// Rotates SH coefficients of degree 0..3 with the scene: colour(R d) after = colour(d) before.
class ShRotation {
 public:
  /// `rotation`: orthogonal, proper or not.
  explicit ShRotation(const glm::dmat3& rotation);
  /// sh: [sh_coefficients(degree), 3], coefficient-major, in place.
  void apply(float* sh, int degree) const;

 private:
  double degree1_[3][3], degree2_[5][5], degree3_[7][7];
};

}  // namespace rgs::detail
