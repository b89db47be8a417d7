// slot_plan_test.cpp - how many pages fit in a device's budget, and where they are.
// SPDX-License-Identifier: Apache-2.0
#include "stream/slot_plan.hpp"

#include <doctest/doctest.h>

#include <limits>
#include <vector>

using namespace rgs;
using namespace rgs::detail;

namespace {

constexpr SlotShape kShape{.chunk_size = 256, .page_chunks = 6, .sh_degree = 3};

}  // namespace

TEST_CASE("a slot has room for the largest page: its rows, and a step set and an entry for each chunk") {
  CHECK(kShape.rows() == 1536);
  CHECK(kShape.bytes() == 1536 * (12 + 16 + 48) + 6 * (48 + 48));
  CHECK(SlotShape{32, 4, 0}.bytes() == 128 * (12 + 16 + 4) + 4 * 96);
  CHECK(SlotShape{32, 4, 1}.bytes() == 128 * (12 + 16 + 12) + 4 * 96);
  CHECK(staging_bytes(kShape) >= 2 * kShape.bytes());
  CHECK(staging_bytes(kShape) < 2 * kShape.bytes() + 2 * 5 * 256);
}

TEST_CASE("a plan takes all of a budget but less than a slot, and never more") {
  for (const SlotShape shape : {kShape, SlotShape{32, 4, 1}, SlotShape{64, 1, 0}, SlotShape{256, 1024, 2}}) {
    for (const std::uint64_t budget :
         {shape.bytes() + 5 * 256, 3 * shape.bytes(), 100 * shape.bytes() + 17, std::uint64_t{1} << 33}) {
      CAPTURE(budget);
      CAPTURE(shape.bytes());
      const auto plan = plan_slots(shape, budget);
      REQUIRE(plan);
      CHECK(plan->n_slots >= 1);
      CHECK(plan->bytes <= budget);
      CHECK(plan->n_slots * plan->slot_bytes() <= plan->bytes);
      // One more would not fit, or could not be numbered.
      const std::uint64_t more = plan->n_slots + std::uint64_t{1};
      CHECK((more * plan->slot_bytes() + 5 * 255 > budget || more * shape.rows() > (1u << 31) - 1));
    }
  }
}

TEST_CASE("slots lie side by side in each section, none in another's place, all within the allocation") {
  const auto plan = plan_slots(SlotShape{32, 3, 1}, 100000);
  REQUIRE(plan);
  REQUIRE(plan->n_slots > 3);
  const auto sizes = plan->shape.section_bytes();
  for (std::size_t k = 0; k < sizes.size(); ++k) {
    CHECK(plan->begin[k] % 256 == 0);
    CHECK(plan->at(k, 0) == plan->begin[k]);
    CHECK(plan->at(k, 2) - plan->at(k, 1) == sizes[k]);
    const std::uint64_t end = plan->at(k, plan->n_slots - 1) + sizes[k];
    CHECK(end <= (k + 1 < sizes.size() ? plan->begin[k + 1] : plan->bytes));
  }
  // Row and chunk numbers over all slots are those of a scene that is there as a whole.
  CHECK(plan->first_chunk(2) == 6);
  CHECK((plan->at(0, 2) - plan->begin[0]) / 12 == 2 * 96);
}

TEST_CASE("a budget that holds no page is refused with what one takes, and that is enough") {
  for (const std::uint64_t budget : {std::uint64_t{0}, std::uint64_t{1}, kShape.bytes() - 1}) {
    const auto plan = plan_slots(kShape, budget);
    REQUIRE(!plan);
    CHECK(plan.error().code == Errc::limit_exceeded);
    CHECK(plan.error().found == budget);
    const auto enough = plan_slots(kShape, plan.error().expected);
    REQUIRE(enough);
    CHECK(enough->n_slots == 1);
    CHECK(!plan_slots(kShape, plan.error().expected - 1));
  }
}

TEST_CASE("more memory than rows can be numbered in is not used") {
  const SlotShape shape{32, 1, 0};
  const auto plan = plan_slots(shape, std::numeric_limits<std::uint64_t>::max() / 2);
  REQUIRE(plan);
  CHECK(plan->n_slots == ((std::uint64_t{1} << 31) - 1) / 32);
}
