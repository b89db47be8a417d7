// url_source_absent_test.cpp - a build without libcurl says so.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <string_view>

#include "rgs/byte_source.hpp"

using namespace rgs;

TEST_CASE("without libcurl web addresses are unavailable") {
  for (const char* url : {"http://127.0.0.1/x", "https://127.0.0.1/x"}) {
    const auto source = open_source(url);
    REQUIRE_FALSE(source);
    CHECK(source.error().code == Errc::unavailable);
    CHECK(std::string_view(source.error().what).find("RGS_ENABLE_HTTP=ON") != std::string_view::npos);
  }
  CHECK(open_source("no-such-file").error().code == Errc::open_failed);
}
