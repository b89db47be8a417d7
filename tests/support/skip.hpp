// skip.hpp - skips a test case that cannot run: ctest sees the exit code, and .ci/run shows the line.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <cstdlib>
#include <iostream>
#include <string>

namespace rgs::test {

/// Set by skip(): doctest_main.cpp then ends with $RGS_SKIP_RETURN_CODE, unless a check has failed.
inline bool g_skipped = false;

/// Skips the calling case, which then returns before any check: a case that checked something is not skipped. doctest's
/// MESSAGE would print file and line before the text, and the case would count as passed.
inline void skip(const std::string& reason) {
  g_skipped = true;
  std::cout << "skipped: " << reason << std::endl;
}

inline bool is_set(const char* variable) {
  const char* value = std::getenv(variable);
  return value != nullptr && *value != '\0' && std::string(value) != "0";
}

/// For missing measurement data; a failure if RGS_REQUIRE_DATA=1 requires it.
inline void skip_without_data(const std::string& reason) {
  if (is_set("RGS_REQUIRE_DATA")) FAIL("RGS_REQUIRE_DATA is set, but " << reason);
  skip(reason);
}

/// For a missing tool of scripts/install-deps.sh; a failure if RGS_REQUIRE_TOOLS=1 requires it.
inline void skip_without_tool(const std::string& reason) {
  if (is_set("RGS_REQUIRE_TOOLS")) FAIL("RGS_REQUIRE_TOOLS is set, but " << reason);
  skip(reason);
}

}  // namespace rgs::test
