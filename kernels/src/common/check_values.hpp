// check_values.hpp - launch that checks a file's values on the device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/attributes.hpp"
#include "common/frame.hpp"
#include "rgs/result.hpp"
#include "rgs/stored_values.hpp"

namespace rgs::cuda {

struct CheckedValues {
  ValueCounts counts;  ///< of all rows of GEOM
  std::uint64_t
      n_damaged;  ///< chunks that break a rule of docs/format/FORMAT.md or contradict their entry of the chunk table
};

/// Adds to `out` what n Gaussians hold; 0 < n < 2^31. The caller has zeroed it, and has checked the chunk table itself:
/// that each step_set is one. Errors: device_failed.
Status launch_check_values(const CompactAttributes& attributes, std::uint32_t n, CheckedValues* out, Stream stream);

}  // namespace rgs::cuda
