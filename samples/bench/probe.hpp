// probe.hpp - measures the current device: the roofs of a roofline.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/result.hpp"

namespace rgs::cuda {

/// Rates a second of the whole device.
struct DeviceRates {
  double copy_bytes;    ///< device memory, bytes read plus bytes written by a copy
  double l2_bytes;      ///< read from L2 by all multiprocessors, past L1
  double fp32;          ///< FP32 operations of single lanes, one FMA each; also the rate at which lanes issue anything
  double special;       ///< ex2.approx of single lanes, the rate of the special function units
  double shared_loads;  ///< 128-bit loads from shared memory by whole warps, all lanes at one address
};

/// Takes about a quarter of a second and up to 2 GiB of device memory, which it frees; waits for the device. The best
/// of several runs and sizes counts, because disturbances only slow a run down. Errors:
/// device_out_of_memory (not even 64 MiB twice), device_failed.
Result<DeviceRates> measure_rates();

}  // namespace rgs::cuda
