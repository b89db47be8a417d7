// value_or_stop.hpp - what a measuring program does with a result: takes the value, or says the error and ends.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdio>
#include <cstdlib>
#include <utility>

#include "rgs/result.hpp"

namespace rgs::test {

/// `what`: of which the result is, in the message.
template <class T>
T value_or_stop(Result<T> result, const char* what) {
  if (!result) {
    std::fprintf(stderr, "%s: %s\n", what, result.error().what);
    std::exit(exit_code(result.error().code));
  }
  return *std::move(result);
}

}  // namespace rgs::test
