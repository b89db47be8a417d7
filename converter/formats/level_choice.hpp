// level_choice.hpp - whether a file has the level of detail that is asked for.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Errors: bad_argument.
inline Status check_level(std::uint64_t n_levels, const ReadOptions& options) {
  const std::uint64_t wanted = options.level_of_detail.value_or(0);
  if (wanted < n_levels) return {};
  return make_error(Errc::bad_argument, Error::kNone, "the file has no such level of detail (0 is the finest)",
                    n_levels, wanted);
}

}  // namespace rgs::detail
