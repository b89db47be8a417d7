// image.hpp - pixels as values, and the arrays that a renderer fills.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/api.hpp"
#include "rgs/math/pixel_format.hpp"

struct CUstream_st;

namespace RGS_API rgs {

/// Floating-point picture, rows from top to bottom, channels interleaved: pixels [height, width, channels].
/// Colours are display-referred values (what 3DGS trains on 8-bit photographs: 0..1 with their sRGB encoding), so
/// 8-bit output is round(255 * clamp(v, 0, 1)) and nothing else.
struct Image {
  int width = 0;
  int height = 0;  ///< pixels
  int channels = 0;
  std::vector<float> pixels;  ///< [height, width, channels]

  static Image make(int width, int height, int channels) {
    const auto size = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    return {width, height, channels, std::vector<float>(size * static_cast<std::size_t>(channels))};
  }
  float& at(int x, int y, int channel) { return pixels[index(x, y, channel)]; }
  float at(int x, int y, int channel) const { return pixels[index(x, y, channel)]; }

 private:
  std::size_t index(int x, int y, int channel) const {
    const auto row = static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
    return row * static_cast<std::size_t>(channels) + static_cast<std::size_t>(channel);
  }
};

/// 8-bit code of a colour value: round(255 * clamp(v, 0, 1)), halves up; 0 for NaN.
inline std::uint8_t to_8bit(float value) {
  return math::code8(value);
}

/// What one Gaussian contributed to pixels: the sum and the largest of its blending weights, alpha T.
struct Contribution {
  /// Value of 1 in `sum`: a hundredth of the smallest weight that counts, 1e-4 / 255.
  static constexpr double kUnit = 1.0 / (1 << 28);
  std::uint64_t sum = 0;  ///< over pixels, in kUnit; holds 6.8e10 pixels at weight 1
  float largest = 0;      ///< of any pixel

  double weight() const { return static_cast<double>(sum) * kUnit; }
};

/// Caller-owned arrays for pictures of several cameras of one size, picture after picture, rows from top to bottom.
/// Null: not wanted.
struct PictureArrays {
  float* rgb = nullptr;           ///< [n, height, width, 3] colour over the background
  std::uint8_t* codes = nullptr;  ///< [n, height, width, 3] to_8bit() of the colour
  float* alpha = nullptr;         ///< [n, height, width] as in RenderTarget
  float* depth = nullptr;         ///< [n, height, width] as in RenderTarget
  /// The arrays are in the memory of the drawing device, and are written after the work queued on `stream` (a
  /// cudaStream_t; null is the default stream). Otherwise they are in the host's memory.
  bool on_device = false;
  CUstream_st* stream = nullptr;
};

/// Caller-owned arrays of camera.width * camera.height pixels, rows from top to bottom. An empty span: not wanted;
/// every pixel of the others is written.
struct RenderTarget {
  std::span<float> rgb = {};    ///< [height, width, 3] colour over the background
  std::span<float> alpha = {};  ///< [height, width] 1 - transmittance
  std::span<float> depth = {};  ///< [height, width] expected depth (RENDERING.md), world units; 0 where alpha is 0
  std::span<std::uint32_t> evaluated = {};  ///< [height, width] Gaussians that the pixel visited before it stopped
  std::span<std::uint32_t> blended = {};    ///< [height, width] Gaussians that contributed
  /// [Gaussians of the scene], CPU only. Frames add to it: zero it before the first. The same bits for any number of
  /// threads.
  std::span<Contribution> contributions = {};
};

}  // namespace rgs
