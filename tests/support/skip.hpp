// skip.hpp - a test case that cannot run says so: ctest knows it by the exit code, and .ci/run shows the line.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <cstdlib>
#include <iostream>
#include <string>

namespace rgs::test {

/// Set by skip(): doctest_main.cpp then ends with $RGS_SKIP_RETURN_CODE, unless a check has failed.
inline bool g_skipped = false;

/// Leaves out the case that calls it and then returns, before any check: what did run is no skip. doctest's MESSAGE
/// would put file and line before the text, and the case would count as passed.
inline void skip(const std::string& reason) {
  g_skipped = true;
  std::cout << "skipped: " << reason << std::endl;
}

inline bool is_set(const char* variable) {
  const char* value = std::getenv(variable);
  return value != nullptr && *value != '\0' && std::string(value) != "0";
}

/// For lack of measurement data; a failure where RGS_REQUIRE_DATA=1 says that it should be there.
inline void skip_without_data(const std::string& reason) {
  if (is_set("RGS_REQUIRE_DATA")) FAIL("RGS_REQUIRE_DATA is set, but " << reason);
  skip(reason);
}

/// For lack of something that scripts/install-deps.sh installs; a failure where RGS_REQUIRE_TOOLS=1 says that it has.
inline void skip_without_tool(const std::string& reason) {
  if (is_set("RGS_REQUIRE_TOOLS")) FAIL("RGS_REQUIRE_TOOLS is set, but " << reason);
  skip(reason);
}

}  // namespace rgs::test
