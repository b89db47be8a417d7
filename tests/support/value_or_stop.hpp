// value_or_stop.hpp - a measuring program takes a result's value, or prints the error and ends.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdio>
#include <cstdlib>
#include <utility>

#include "rgs/result.hpp"

namespace rgs::test {

/// `what` names the result in the message.
template <class T>
T value_or_stop(Result<T> result, const char* what) {
  if (!result) {
    std::fprintf(stderr, "%s: %s\n", what, result.error().what);
    std::exit(exit_code(result.error().code));
  }
  return *std::move(result);
}

}  // namespace rgs::test
