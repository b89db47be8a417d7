// chunk_encoder.cpp - quantises the Gaussians of one chunk.
// SPDX-License-Identifier: Apache-2.0
#include "file/chunk_encoder.hpp"

#include <cstring>

#include "rgs/scene_scan.hpp"

namespace rgs::detail {
namespace {

template <class T>
void store(std::byte*& out, const T& value) {
  std::memcpy(out, &value, sizeof value);
  out += sizeof value;
}

}  // namespace

ShStepSet chunk_steps(std::span<const Splat> splats, int sh_degree) {
  ShMagnitudes magnitudes;
  for (const Splat& s : splats) magnitudes.add(s.sh, sh_degree);
  return magnitudes.steps();
}

ChunkEntry encode_chunk(std::span<const Splat> splats, int sh_degree, int scale_exponent, const ShStepSet& steps,
                        std::byte* means, std::byte* geometry, std::byte* sh, ValueCounts& counts) {
  const auto floats = static_cast<std::size_t>(3 * sh_coefficients(sh_degree));
  const std::size_t stride = sh_bytes(sh_degree);
  float step[48];  // per coefficient and channel, so that the loop below has no look-up
  for (std::size_t i = 0; i < floats; ++i) step[i] = steps.of_value(static_cast<int>(i));

  ChunkSummary summary;
  auto* codes_out = reinterpret_cast<std::int8_t*>(sh);
  for (const Splat& s : splats) {
    for (const float x : s.mean) store(means, x);
    std::uint16_t row[8];
    quantize_rotation(s.rotation, row);
    for (std::size_t i = 0; i < 3; ++i) row[4 + i] = quantize_scale(scale_from_log(s.log_scale[i]), scale_exponent);
    row[7] = half_from_float(opacity_from_logit(s.opacity_logit));
    store(geometry, row);
    summary.add(s.mean, row);
    counts.add(row);
    for (std::size_t i = 0; i < floats; ++i) codes_out[i] = quantize_sh(s.sh[i], step[i]);
    for (std::size_t i = floats; i < stride; ++i) codes_out[i] = 0;
    codes_out += stride;
  }
  return summary.entry(scale_exponent);
}

}  // namespace rgs::detail
