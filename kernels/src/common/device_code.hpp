// device_code.hpp - whether this build has kernels for a device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/result.hpp"

namespace rgs::cuda {

/// Checks the current device. Errors: unavailable (no code for its architecture, or a driver older than the code);
/// device_failed.
Status check_device_code();

}  // namespace rgs::cuda
