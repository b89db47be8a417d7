// failure.hpp - an error and the file that it is about.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <tl/expected.hpp>

#include "rgs/result.hpp"

namespace rgs {

/// The error of one file, or of none ("").
struct Failure {
  std::string file;
  Error error;
};
template <class T>
using Outcome = tl::expected<T, Failure>;

inline tl::unexpected<Failure> failed(const std::string& file, const Error& error) {
  return tl::unexpected(Failure{file, error});
}

}  // namespace rgs
