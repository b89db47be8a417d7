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

/// Adds the counts of n Gaussians to `out`; 0 < n < 2^31. The caller has zeroed `out` and checked the chunk table's
/// step_set indices. Errors: device_failed.
Status launch_check_values(const CompactAttributes& attributes, std::uint32_t n, CheckedValues* out, Stream stream);

}  // namespace rgs::cuda
