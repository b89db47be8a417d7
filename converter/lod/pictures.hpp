// pictures.hpp - small parallel-projection pictures of a group of Gaussians, and their gradients by opacity and colour.
// SPDX-License-Identifier: Apache-2.0
//
// Drawn as the renderer does (docs/format/RENDERING.md): low-pass, with or without compensated opacity, depth order by
// the mean, alpha between 1/255 and 0.99. But without perspective, early termination and background: pixels hold
// premultiplied colour and the remaining transmittance. Same bits on every machine: lanes are summed in one order.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "gaussians.hpp"

namespace rgs::lod {

/// Orthonormal axes of a picture in the world: right, down, forward (away from the eye).
struct Axes3 {
  float right[3], down[3], forward[3];
};

/// A picture's grid: pixel (0, 0) begins at (`left`, `top`) along right and down, world units; `pixel` is a pixel's
/// side.
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
  /// All values become 0.
  void reset(int width, int height);
  /// Values are left undefined, for callers that set all of them.
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

/// A projected Gaussian; its rectangle of pixels is not empty.
struct Dot {
  float u, v;     // mean, pixels from the picture's corner
  float a, b, c;  // conic
  float opacity;  // compensated
  float color[3];
  std::uint32_t index;
  std::int16_t x0, x1, y0, y1;
};

/// Scratch of the functions below, reused by later calls.
struct Projection {
  std::vector<float> values;               // [9][padded]: see project_all()
  std::vector<float> placed;               // [8][padded]: see place_all()
  std::vector<std::uint64_t> keys, spare;  // front to back
  float pixel = 1;                         // of the frame of `values`
  std::vector<Dot> dots;                   // front to back
};

/// Projects Gaussians, front to back.
void project(const Gaussians& gaussians, const Frame& frame, const Filter& filter, Projection& out);
/// The same for a frame with the axes and corner of the last project() of these Gaussians but another pixel size, at a
/// part of the cost; the same bits if the sizes differ by a power of two.
void project_again(const Gaussians& gaussians, const Frame& frame, const Filter& filter, Projection& out);

/// Overwrites the whole picture, whose size is set.
void draw(std::span<const Dot> dots, Picture& picture);

/// Derivatives of a function of the picture by each Gaussian's opacity and colour: arrays [n] each.
enum Gradient : int { kByLogOpacity = 0, kByColor = 1, kGradients = 4 };

/// `by_picture`: derivatives by r, g, b and by coverage (1 - transmittance), in a picture's planes; `drawn`: the result
/// of draw(). Sets `out` [kGradients][n], zero for Gaussians that are not in `dots` or cross the frame's edge; by
/// colours before they are clamped at 0.
void gradients(const Frame& frame, std::span<const Dot> dots, const Picture& by_picture, const Picture& drawn,
               Picture& scratch, std::size_t n, std::vector<float>& out);

/// Averages squares of factor x factor pixels of `fine`, whose sides are `factor` times those of `out`.
void box_filter(const Picture& fine, int factor, Picture& out);

}  // namespace rgs::lod
