// view_volume.hpp - which boxes of Gaussians cannot show in a picture.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "rgs/layout.hpp"
#include "rgs/math/camera.hpp"

namespace rgs::pages {

/// The part of space that a view draws, as six planes. A Gaussian whose mean is beyond one must reach across it to
/// change a pixel.
class ViewVolume {
 public:
  ViewVolume() = default;                                     ///< sees everything
  ViewVolume(const math::View<float>& view, float low_pass);  ///< of width 0, or no pinhole: sees everything
  /// False only if no Gaussian of the box changes a pixel; the box must hold means and 3 standard deviations along each
  /// axis (lod::Page::bounds). Monotone: false for a box implies false for any box inside it.
  bool may_show(const Box& box) const;
  bool operator==(const ViewVolume&) const = default;

 private:
  struct Plane {
    std::array<double, 3> normal{};  ///< outwards, in the scene's axes
    std::array<double, 3> reach{};   ///< of a box's Gaussians along the normal, per unit of its half extents
    double offset = 0;
    double rounding = 0;  ///< of the picture's arithmetic, per unit of distance
    bool operator==(const Plane&) const = default;
  };
  std::array<double, 3> eye_{};
  std::array<Plane, 6> planes_;
};

}  // namespace rgs::pages
