// slot_plan_test.cpp - how many slots fit in a device's budget, and their offsets.
// SPDX-License-Identifier: Apache-2.0
#include "stream/slot_plan.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <deque>
#include <limits>
#include <random>
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
  for (const std::uint32_t n : {kLeastStagedPages, kStagedPages}) {
    CHECK(staging_bytes(kShape, n) >= n * kShape.bytes());
    CHECK(staging_bytes(kShape, n) < n * (kShape.bytes() + 5 * 256));
  }
}

TEST_CASE("staged sections start at multiples of 256 and fit where the largest page does") {
  CHECK(staged_section_bytes(1) == 256);
  CHECK(staged_section_bytes(512) == 512);
  CHECK(staged_bytes({1, 256, 257, 48, 384}) == 256 + 256 + 512 + 256 + 512);
  CHECK(staged_bytes(kShape.section_bytes()) == staging_bytes(kShape, 1));
}

TEST_CASE("a ring returns free contiguous ranges and refuses only without room") {
  std::mt19937 random(3);
  for (const std::uint64_t bytes : {std::uint64_t{1024}, std::uint64_t{2560}, std::uint64_t{40 * 256}}) {
    CAPTURE(bytes);
    StagingRing ring(bytes);
    struct Taken {
      std::uint64_t at, n, taken;
    };
    std::deque<Taken> held;
    std::uint64_t n_refused = 0, n_first = 0, given = 0;
    for (int i = 0; i < 20000; ++i) {
      const std::uint64_t n = std::min<std::uint64_t>(bytes, 256 * (1 + random() % 7));
      const auto at = ring.take(n);
      if (!at) {
        ++n_refused;
        REQUIRE(!held.empty());
        // Checked byte by byte, no gap is large enough; or bytes were lost at the ring's end.
        std::uint64_t largest = 0;
        std::vector<bool> is_held(bytes / 256);
        for (const Taken& each : held)
          for (std::uint64_t k = each.at; k < each.at + each.n; k += 256) is_held[k / 256] = true;
        const std::uint64_t next = held.back().at + held.back().n;
        for (const std::uint64_t from : {next, std::uint64_t{0}}) {
          std::uint64_t end = from;
          while (end < bytes && !is_held[end / 256]) end += 256;
          largest = std::max(largest, end - from);
        }
        REQUIRE((largest < n || n > bytes - (ring.taken() - given)));
        given = held.front().taken;
        ring.release_up_to(given);
        held.pop_front();
        continue;
      }
      REQUIRE(*at + n <= bytes);
      for (const Taken& each : held) REQUIRE((*at + n <= each.at || each.at + each.n <= *at));
      n_first += *at == 0;
      held.push_back({*at, n, ring.taken()});
      if (random() % 64 == 0) {  // all, as after finish()
        given = ring.taken();
        ring.release_up_to(given);
        held.clear();
      }
    }
    CHECK(n_refused > 1000);
    CHECK(n_first > 100);
  }
}

TEST_CASE("a plan uses the budget up to less than a slot, and never more") {
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
      // Another slot would not fit or could not be numbered.
      const std::uint64_t more = plan->n_slots + std::uint64_t{1};
      CHECK((more * plan->slot_bytes() + 5 * 255 > budget || more * shape.rows() > (1u << 31) - 1));
    }
  }
}

TEST_CASE("slots are adjacent in each section, do not overlap, and lie within the allocation") {
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
  // Row and chunk numbers over all slots follow a fully resident scene's.
  CHECK(plan->first_chunk(2) == 6);
  CHECK((plan->at(0, 2) - plan->begin[0]) / 12 == 2 * 96);
}

TEST_CASE("a budget below one page is refused with the minimum, which then suffices") {
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

TEST_CASE("memory beyond the numbers of rows is not used") {
  const SlotShape shape{32, 1, 0};
  const auto plan = plan_slots(shape, std::numeric_limits<std::uint64_t>::max() / 2);
  REQUIRE(plan);
  CHECK(plan->n_slots == ((std::uint64_t{1} << 31) - 1) / 32);
}
