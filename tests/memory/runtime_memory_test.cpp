// runtime_memory_test.cpp - camera files, pictures and the CPU renderer where memory runs out.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <string_view>

#include "failing_memory.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/image_metrics.hpp"

using namespace rgs;
using rgs::test::fail_each_allocation;
using rgs::test::hash_of;

TEST_CASE("COLMAP's cameras") {
  constexpr std::string_view kLenses = "1 PINHOLE 640 480 500 500 320 240\n";
  constexpr std::string_view kImages = "1 1 0 0 0 0.5 0 2 1 a name that is longer than a short string.jpg\n\n";
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    const auto set = parse_colmap_text(kLenses, kImages);
    if (!set) return tl::unexpected(set.error());
    return hash_of(std::as_bytes(std::span(set->cameras.at(0).name)));
  });
}
