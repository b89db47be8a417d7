// value_checks.hpp - what load_direct() and read_chunks() share with validate().
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/decode.hpp"

namespace rgs::detail {

/// Values of the range against the specification and their chunks' entries.
Status check_values(const DirectData& data, unsigned threads);
/// `data` is the whole file: all that validate() checks but the hashes of coded sections, whose frames were checked.
Status check_file(const DirectData& data, unsigned threads);

}  // namespace rgs::detail
