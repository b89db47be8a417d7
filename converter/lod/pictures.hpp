// pictures.hpp - small parallel-projection pictures of a group of Gaussians, what each gave to them, and their gradients.
// SPDX-License-Identifier: Apache-2.0
//
// The picture is the renderer's (docs/format/RENDERING.md): low-pass, with or without compensated opacity, depth order by the mean,
// alpha between 1/255 and 0.99. There is no perspective, no end of a pixel before the last Gaussian, and no background:
// pixels hold what is in front of it, and how much of it remains. Same bits on every machine: lanes are summed in one order.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "gaussians.hpp"

namespace rgs::lod {

/// Axes of a picture in the world, orthonormal: right, down, forward (away from the eye).
struct Axes3 {
  float right[3], down[3], forward[3];
};

/// Where a picture's pixels are: pixel (0, 0) begins at (`left`, `top`) along right and down, world units; `pixel` is a
/// pixel's side.
struct Frame {
  Axes3 axes;
  float left = 0, top = 0, pixel = 1;
  int width = 0, height = 0;
};

struct Filter {
  float low_pass;    ///< px^2
  bool compensated;  ///< opacity falls as the low-pass widens: docs/format/RENDERING.md, mip
};

/// Premultiplied r, g, b and the transmittance, planes of [height][stride].
class Picture {
 public:
  /// All values 0.
  void reset(int width, int height);
  /// Values of whatever was there before: for who sets all of them.
  void resize(int width, int height);
  int width() const { return width_; }
  int height() const { return height_; }
  std::size_t stride() const { return stride_; }
  float* plane(int channel) { return &values_[static_cast<std::size_t>(channel) * plane_]; }
  const float* plane(int channel) const { return &values_[static_cast<std::size_t>(channel) * plane_]; }
  std::size_t plane_size() const { return plane_; }

 private:
  int width_ = 0, height_ = 0;
  std::size_t stride_ = 0, plane_ = 0;
  std::vector<float> values_;
};

/// A Gaussian on a picture; its rectangle of pixels is not empty.
struct Dot {
  float u, v;     // mean, pixels from the picture's corner
  float a, b, c;  // conic
  float opacity;  // compensated
  float color[3];
  float xx, xy, yy;  // covariance before the low-pass
  std::uint32_t index;
  std::int16_t x0, x1, y0, y1;
};

/// What the functions below need besides, kept from call to call.
struct Projection {
  std::vector<float> values;               // [9][padded]: see project_all()
  std::vector<float> placed;               // [8][padded]: see place_all()
  std::vector<std::uint64_t> keys, spare;  // front to back
  float pixel = 1;                         // of the frame that `values` are of
  std::vector<Dot> dots;                   // front to back
};

/// Puts Gaussians on a picture, front to back. Dot::color is 0.5 where colours are not `wanted`.
enum class Colors : std::uint8_t { wanted, unwanted };
void project(const Gaussians& gaussians, const Frame& frame, const Filter& filter, Projection& out,
             Colors colors = Colors::wanted);
/// The same of a frame of other pixels but the same axes and corner as that of the last project() of these Gaussians, at a
/// part of the cost; the same bits if pixels differ by a power of two.
void project_again(const Gaussians& gaussians, const Frame& frame, const Filter& filter, Projection& out);

/// Sets all of a picture that has its size.
void draw(std::span<const Dot> dots, Picture& picture);

/// Adds to `sums` [n] the weight with which each Gaussian went into the picture's pixels, in pixels. Draws transmittance only;
/// the picture has its size.
void contributions(std::span<const Dot> dots, Picture& picture, std::span<float> sums);

/// Gradients of a number that depends on a picture by what depends on each Gaussian: arrays [padded] each.
enum Gradient : int { kByMean = 0, kByTurn = 3, kByLogScale = 6, kByLogOpacity = 9, kByColor = 10, kGradients = 13 };

/// `by_picture`: derivatives by r, g, b and by what is covered (1 - transmittance), in the planes of a picture; `drawn`:
/// what draw() gave. Sets `gradients` [kGradients][padded], zero for Gaussians that are not in `dots`. Turns are by the
/// vector of a rotation in the world that follows the Gaussian's own; colours by the colour before harmonics are clamped.
void gradients(const Gaussians& gaussians, const Frame& frame, const Filter& filter, std::span<const Dot> dots,
               const Picture& by_picture, const Picture& drawn, Picture& scratch, std::vector<float>& out);

/// Pixels of `fine` in squares of factor x factor, averaged; `fine` has factor times the sides.
void box_filter(const Picture& fine, int factor, Picture& out);

}  // namespace rgs::lod
