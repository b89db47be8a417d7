// view_volume.hpp - which boxes of Gaussians a picture can show nothing of.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "rgs/layout.hpp"
#include "rgs/math/camera.hpp"

namespace rgs::detail {

/// The part of space that a view draws: six planes, beyond which a Gaussian must reach with more than its mean to change a pixel.
class ViewVolume {
 public:
  ViewVolume(const math::View<float>& view, float low_pass);
  /// False only if no Gaussian changes a pixel whose mean lies in the box with 3 standard deviations along each axis (lod::Page::bounds).
  /// Of a box inside another it says no more often than of that other.
  bool may_show(const Box& box) const;
  bool operator==(const ViewVolume&) const = default;

 private:
  struct Plane {
    std::array<double, 3> normal;  ///< outwards, in the scene's axes
    double offset;
    double reach;     ///< of a Gaussian, along the normal, for each unit of three standard deviations
    double rounding;  ///< of the picture's arithmetic, for each unit of distance
    bool operator==(const Plane&) const = default;
  };
  std::array<double, 3> eye_;
  std::array<Plane, 6> planes_;
};

}  // namespace rgs::detail
