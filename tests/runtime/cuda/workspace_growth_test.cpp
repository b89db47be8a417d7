// workspace_growth_test.cpp - growth of workspaces in limited memory.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/workspace_growth.hpp"

#include <doctest/doctest.h>

#include <vector>

using namespace rgs;
using rgs::detail::reserve_growing;
using rgs::detail::with_room_to_grow;

TEST_CASE("a workspace grows by half, or by the need if that is more, up to its limit") {
  CHECK(with_room_to_grow(101, 100, 1000) == 150);
  CHECK(with_room_to_grow(400, 100, 1000) == 400);
  CHECK(with_room_to_grow(901, 900, 1000) == 1000);
  CHECK(with_room_to_grow(1000, 900, 1000) == 1000);
  CHECK(with_room_to_grow(7, 0, 1000) == 7);
  CHECK(with_room_to_grow(2, 1, 1000) == 2);
}

TEST_CASE("with little memory the workspace grows by the need alone, and other errors are final") {
  // Two arrays of equal size in `memory` units, which a frame needs together.
  std::vector<std::uint64_t> asked;
  const auto grow = [&asked](std::uint64_t needed, std::uint64_t held, std::uint64_t memory, Errc refusal) {
    asked.clear();
    return reserve_growing([&](bool generous) -> Status {
      asked.push_back(generous ? with_room_to_grow(needed, held, 1 << 20) : needed);
      if (2 * asked.back() <= memory) return {};
      return make_error(refusal, Error::kNone, "no more", asked.back());
    });
  };
  CHECK(grow(110, 100, 400, Errc::device_out_of_memory));
  CHECK(asked == std::vector<std::uint64_t>{150});
  CHECK(grow(110, 100, 299, Errc::device_out_of_memory));
  CHECK(asked == std::vector<std::uint64_t>{150, 110});
  const auto refused = grow(110, 100, 219, Errc::device_out_of_memory);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().expected == 110);  // the frame's need, not the first request
  CHECK(asked == std::vector<std::uint64_t>{150, 110});
  CHECK_FALSE(grow(110, 100, 0, Errc::device_failed));
  CHECK(asked == std::vector<std::uint64_t>{150});
}
