// encode_rows.cpp - quantises Gaussians into rows.
// SPDX-License-Identifier: Apache-2.0
#include "file/encode_rows.hpp"

#include <cstring>

#include "file/chunk_summary.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

template <class T>
void store(std::byte*& out, const T& value) {
  std::memcpy(out, &value, sizeof value);
  out += sizeof value;
}

}  // namespace

ChunkEntry encode_rows(std::span<const Splat> splats, const Header& header, const ShStepSet& steps, std::byte* means,
                       std::byte* geometry, std::byte* sh, ValueCounts& counts) {
  const auto floats = static_cast<std::size_t>(3 * sh_coefficients(header.sh_degree));
  const std::size_t stride = sh_bytes(header.sh_degree);
  float step[48];  // per coefficient and channel, so that the loop below needs no look-up
  for (std::size_t i = 0; i < floats; ++i) step[i] = steps.of_value(static_cast<int>(i));
  ChunkSummary summary;
  auto* codes = reinterpret_cast<std::int8_t*>(sh);
  for (const Splat& s : splats) {
    std::uint16_t row[8];
    quantize_rotation(s.rotation, row);
    for (std::size_t i = 0; i < 3; ++i) {
      row[4 + i] = quantize_scale(scale_from_log(s.log_scale[i]), header.scale_exponent);
    }
    row[7] = half_from_float(opacity_from_logit(s.opacity_logit));
    store(means, s.mean);
    store(geometry, row);
    for (std::size_t i = 0; i < floats; ++i) codes[i] = quantize_sh(s.sh[i], step[i]);
    for (std::size_t i = floats; i < stride; ++i) codes[i] = 0;
    codes += stride;
    summary.add(s.mean, row, counts);
  }
  return summary.entry(header.scale_exponent);
}

Status source_changed() {
  return make_error(Errc::read_failed, Error::kNone,
                    "a Gaussian differs from the first pass: the source changed while it was read");
}

}  // namespace rgs::detail
