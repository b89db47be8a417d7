// fuzz_archive_encode.cpp - arbitrary Gaussians and options of Profile::archive: the encoder verifies what it accepts.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <span>

#include "rgs/encode.hpp"

// Three bytes of options, then Gaussians as arrays of FP32 bit patterns.
extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 3) return 0;
  const int degree = data[0] & 3;
  rgs::EncodeOptions options;
  options.profile = rgs::Profile::archive;
  options.on_bad = rgs::BadPolicy::repair;
  options.chunk_size = 32u * (1u + data[1] % 8u);
  options.chunk_step_sets = (data[2] & 1) != 0;
  options.archive = {.step = std::ldexp(1.f, data[2] / 2 % 11 - 4), .threads = 1};
  const auto floats = static_cast<std::size_t>(11 + 3 * rgs::sh_coefficients(degree));
  const std::size_t n = std::min<std::size_t>((size - 3) / (4 * floats), 100);
  rgs::SplatCloud cloud;
  cloud.resize(n, degree);
  const std::uint8_t* next = data + 3;
  for (auto* values : {&cloud.mean, &cloud.log_scale, &cloud.rotation, &cloud.opacity_logit, &cloud.sh}) {
    if (values->empty()) continue;
    std::memcpy(values->data(), next, values->size() * sizeof(float));
    next += values->size() * sizeof(float);
  }
  const auto file = rgs::encode(cloud.view(), options);
  if (!file && file.error().code != rgs::Errc::bad_value) std::abort();
  return 0;
}
