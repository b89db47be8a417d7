// spz_codes.cpp - what the codes of Niantic's .spz mean.
//
// Streams: means 3 x i24 fixed point; alpha u8; colour 3 x u8; log-scale 3 x u8; rotation u32 (version 2: 3 x u8);
// SH u8 [coefficients - 1, 3].
// SPDX-License-Identifier: Apache-2.0
#include "spz_codes.hpp"

#include <algorithm>
#include <cmath>

#include "quantised.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

double fixed24(std::span<const std::byte> bytes, std::uint64_t offset) {
  const std::uint32_t code = load_u8(bytes, offset) | static_cast<std::uint32_t>(load_u8(bytes, offset + 1)) << 8 |
                             static_cast<std::uint32_t>(load_u8(bytes, offset + 2)) << 16;
  return static_cast<double>(static_cast<std::int32_t>(code << 8) >> 8);  // sign-extended
}

// Quaternion codes are in the order x, y, z, w; a Splat has w first.
void put_xyzw(const float (&xyzw)[4], float (&rotation)[4]) {
  rotation[0] = xyzw[3];
  std::copy_n(xyzw, 3, rotation + 1);
}

// 2 bits: index of the largest; then, from the top, sign and 9 bits of magnitude of each of the others in order.
void decode_rotation(std::uint32_t code, float (&rotation)[4]) {
  SmallestThree s;
  s.largest = code >> 30;
  for (unsigned i = 0; i < 3; ++i) {
    const std::uint32_t bits = code >> (20 - 10 * i);
    const double magnitude = kRootHalf * (bits & kSpzMagnitudeMax) / kSpzMagnitudeMax;
    s.rest[i] = (bits >> 9 & 1) != 0 ? -magnitude : magnitude;
  }
  float xyzw[4];
  from_smallest_three(s, xyzw);
  put_xyzw(xyzw, rotation);
}

}  // namespace

void decode_spz_rotation_v2(std::span<const std::byte> code, float (&rotation)[4]) {
  SmallestThree s;
  s.largest = 3;
  for (std::uint64_t i = 0; i < 3; ++i) s.rest[i] = load_u8(code, i) / 127.5 - 1;
  float xyzw[4];
  from_smallest_three(s, xyzw);
  put_xyzw(xyzw, rotation);
}

SplatCloud decode_spz_streams(const SpzHeader& header, const SpzStreams& in) {
  SplatCloud cloud;
  cloud.resize(header.n, header.sh_degree);
  const double unit = std::ldexp(1.0, -header.fractional_bits);
  for (std::uint64_t i = 0; i < 3 * cloud.size(); ++i) {
    cloud.mean[i] = static_cast<float>(fixed24(in[0], 3 * i) * unit);
    cloud.log_scale[i] = static_cast<float>(load_u8(in[3], i) / 16.0 - 10);
  }
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(header.sh_degree));
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    cloud.opacity_logit[i] = logit_from_opacity(static_cast<float>(load_u8(in[1], i)) / 255.F);
    float rotation[4];
    if (header.version == 2) {
      decode_spz_rotation_v2(in[4].subspan(3 * i, 3), rotation);
    } else {
      decode_rotation(load<std::uint32_t>(in[4], 4 * i), rotation);
    }
    std::copy_n(rotation, 4, &cloud.rotation[4 * i]);
    float* sh = &cloud.sh[floats * i];
    for (std::uint64_t c = 0; c < 3; ++c) {
      sh[c] = static_cast<float>((load_u8(in[2], 3 * i + c) / 255.0 - 0.5) / kSpzColourScale);
    }
    for (std::uint64_t k = 3; k < floats; ++k) {
      sh[k] = static_cast<float>((load_u8(in[5], (floats - 3) * i + k - 3) - 128) / 128.0);
    }
  }
  return cloud;
}

}  // namespace rgs::detail
