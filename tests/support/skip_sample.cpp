// skip_sample.cpp - cases that skip in each way, for skip_test.py. SPDX-License-Identifier: Apache-2.0
#include "skip.hpp"

using namespace rgs::test;

TEST_CASE("device") {
  skip("no device");
}

TEST_CASE("data") {
  return skip_without_data("no data");
}

TEST_CASE("tool") {
  return skip_without_tool("no tool");
}

TEST_CASE("a failure is no skip") {
  CHECK(false);
  skip("after a check");
}

TEST_CASE("a message is no skip") {
  MESSAGE("skipped: doctest puts the place before it");
}
