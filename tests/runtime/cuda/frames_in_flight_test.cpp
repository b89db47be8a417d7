// frames_in_flight_test.cpp - queued frames against a device that has room for so much, without a device.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/frames_in_flight.hpp"

#include <doctest/doctest.h>

#include <array>
#include <random>
#include <set>
#include <vector>

using namespace rgs;
using rgs::detail::FramesInFlight;

namespace {

struct Frame {
  int number, need;
  std::size_t target, place;
};
struct Settled {
  int number;
  bool is_repeated;
};
constexpr int kPart = -1, kMost = 100;  // a picture of a frame that did not fit; more than this is an error

/// A renderer whose frames need some of a workspace that grows.
struct Device {
  explicit Device(std::size_t most) : in_flight(most), had_room(most) {}

  Status queue(const Frame& f) {
    had_room[f.place] = f.need <= room;
    pictures[f.target] = had_room[f.place] ? f.number : kPart;
    if (f.number == refused) return make_error(Errc::device_failed, Error::kNone, "refused");
    return {};
  }
  Result<Settled> settle(const Frame& f) {
    if (f.need > kMost) return make_error(Errc::limit_exceeded, Error::kNone, "too much");
    if (had_room[f.place]) return Settled{f.number, false};
    room = f.need;
    if (const Status ok = queue(f); !ok) return tl::unexpected(ok.error());
    return Settled{f.number, true};
  }
  Result<Settled> settle_oldest() {
    return in_flight.settle_oldest([this](const Frame& f) { return settle(f); },
                                   [this](const Frame& f) { return queue(f); });
  }
  void add(int need, std::size_t target) {
    const Frame f{n_added++, need, target, in_flight.next_number()};
    REQUIRE(queue(f));
    in_flight.add(f);
  }

  FramesInFlight<Frame> in_flight;
  std::vector<bool> had_room;  // by next_number()
  std::array<int, 4> pictures{};
  int room = 0, n_added = 0, refused = -1;
};

}  // namespace

TEST_CASE("targets of frames in flight end as if each frame had been drawn alone, and frames are settled in order") {
  std::mt19937 random(1700);
  for (const std::size_t most : {1u, 3u, 8u}) {
    CAPTURE(most);
    Device device(most);
    std::array<int, 4> expected{};
    int n_settled = 0;
    const auto settle = [&] {
      const auto settled = device.settle_oldest();
      REQUIRE(settled);
      CHECK(settled->number == n_settled++);
    };
    for (int turn = 0; turn < 200; ++turn) {
      while (device.in_flight.is_full() || (!device.in_flight.is_empty() && random() % 4 == 0)) settle();
      const std::size_t target = random() % 4;
      expected[target] = device.n_added;
      device.add(static_cast<int>(random() % (turn < 100 ? 10 : kMost)), target);
      if (random() % 16 != 0) continue;
      while (!device.in_flight.is_empty()) settle();
      CHECK(device.pictures == expected);
    }
    CHECK(n_settled > 150);
  }
}

TEST_CASE("frames in flight never share a number, also after errors") {
  Device device(3);
  for (int turn = 0; turn < 20; ++turn) {
    CAPTURE(turn);
    std::set<std::size_t> numbers;
    for (int k = 0; k < 3; ++k) {
      CHECK(numbers.insert(device.in_flight.next_number()).second);
      CHECK_FALSE(device.in_flight.is_full());
      device.add(turn % 4 == 3 && k == turn % 3 ? kMost + 1 : 1, 0);
    }
    CHECK(numbers.size() == 3);
    CHECK(*numbers.rbegin() == 2);
    CHECK(device.in_flight.is_full());
    while (!device.in_flight.is_empty()) {
      if (!device.settle_oldest()) CHECK(device.in_flight.is_empty());
    }
    if (turn % 2 == 0) {  // the next turn begins with another number
      device.add(1, 0);
      CHECK(device.settle_oldest());
    }
  }
}

TEST_CASE("an error of a frame in flight is told once, and those queued after it end") {
  Device device(3);
  device.add(1, 0), device.add(kMost + 1, 1), device.add(1, 2);
  CHECK(device.settle_oldest());
  const auto refused = device.settle_oldest();
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::limit_exceeded);
  CHECK(device.in_flight.is_empty());

  // A later frame that cannot be drawn again.
  device.add(50, 0), device.add(1, 1), device.add(1, 2);
  device.refused = device.n_added - 1;
  const auto later = device.settle_oldest();
  REQUIRE_FALSE(later);
  CHECK(later.error().code == Errc::device_failed);
  CHECK(device.in_flight.is_empty());

  device.add(60, 3);
  const auto again = device.settle_oldest();
  REQUIRE(again);
  CHECK(again->is_repeated);
  CHECK(device.pictures[3] == again->number);
}
