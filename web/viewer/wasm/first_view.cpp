// first_view.cpp - choose_first_view() for JavaScript; src/chooser.ts calls it. One sample, one thread.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/first_view.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdlib>
#include <new>

#include "rgs/quantize.hpp"

#define RGS_EXPORT(name) extern "C" [[clang::export_name(#name)]]

namespace {

rgs::FirstViewSample sample;

}  // namespace

// Without exceptions: a trap, which JavaScript reports.
RGS_EXPORT(rgs_start) void rgs_start() {
  std::set_new_handler([] { __builtin_trap(); });
}

/// Null if out of memory.
RGS_EXPORT(rgs_allocate) void* rgs_allocate(std::uint32_t bytes) {
  return std::malloc(std::max<std::uint32_t>(bytes, 1));
}
RGS_EXPORT(rgs_free) void rgs_free(void* memory) {
  std::free(memory);
}

/// Adds Gaussians: means and scales [n, 3], rotations [n, 4], opacities [n].
RGS_EXPORT(rgs_sample)
void rgs_sample(const float* means, const float* scales, const float* rotations, const float* opacities,
                std::uint32_t n) {
  for (std::uint32_t i = 0; i < n; ++i) sample.add(means + 3 * i, scales + 3 * i, rotations + 4 * i, opacities[i]);
}
/// The same as stored: geometry [n, 8].
RGS_EXPORT(rgs_sample_stored)
void rgs_sample_stored(const float* means, const std::uint16_t* geometry, int scale_exponent, std::uint32_t n) {
  for (std::uint32_t i = 0; i < n; ++i, means += 3, geometry += 8) {
    std::array<float, 3> scale;
    std::array<float, 4> rotation;
    rgs::dequantize_rotation(geometry, rotation.data());
    for (std::size_t k = 0; k < 3; ++k) scale[k] = rgs::dequantize_scale(geometry[4 + k], scale_exponent);
    sample.add(means, scale.data(), rotation.data(), rgs::float_from_half(geometry[7]));
  }
}

/// For this direction of up: kind, position, pivot, up, field of view.
RGS_EXPORT(rgs_first_view) const float* rgs_first_view(double x, double y, double z) {
  static std::array<float, 11> out;
  const rgs::FirstView view = choose_first_view(sample, {x, y, z}, true);
  out = {static_cast<float>(view.kind)};
  std::ranges::copy(view.position, &out[1]);
  std::ranges::copy(view.pivot, &out[4]);
  std::ranges::copy(view.up, &out[7]);
  out[10] = view.horizontal_fov;
  return out.data();
}
