// codes.hpp - the launch that computes a picture's 8-bit codes on the device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// values [n] -> codes [n], math::code8() of each; n > 0. Errors: device_failed.
Status launch_codes(const float* values, std::uint64_t n, std::uint8_t* codes, Stream stream);

}  // namespace rgs::cuda
