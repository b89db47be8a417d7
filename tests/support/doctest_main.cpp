// doctest_main.cpp - entry point of every test program.
// SPDX-License-Identifier: Apache-2.0
#define DOCTEST_CONFIG_IMPLEMENT
#include <doctest/doctest.h>

#include <cstdlib>

#include "skip.hpp"

int main(int argc, char** argv) {
  doctest::Context context(argc, argv);
  const int result = context.run();
  const char* const skip_code = std::getenv("RGS_SKIP_RETURN_CODE");  // ctest runs one case at a time
  if (result == 0 && rgs::test::g_skipped && skip_code != nullptr) return std::atoi(skip_code);
  return result;
}
