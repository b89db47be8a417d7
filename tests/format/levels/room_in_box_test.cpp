// room_in_box_test.cpp - the quick answer to whether a page's box holds a Gaussian, beside the extent that it stands for.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <random>

#include "levels/page_table.hpp"
#include "rgs/quantize.hpp"

using namespace rgs;
using namespace rgs::detail;

namespace {

struct Row {
  std::array<float, 3> mean;
  std::array<std::uint16_t, 8> geometry;

  const std::byte* mean_bytes() const { return reinterpret_cast<const std::byte*>(mean.data()); }
  const std::byte* geometry_bytes() const { return reinterpret_cast<const std::byte*>(geometry.data()); }
};

class Rows {
 public:
  /// Turned at random, or about one axis; with scales alike, or as far apart as FP16 has them.
  Row next() {
    Row row;
    for (float& x : row.mean) x = static_cast<float>(uniform(-100, 100));
    float q[4];
    for (float& x : q) x = static_cast<float>(uniform(-1, 1));
    if (random_() % 3 == 0) q[1 + random_() % 3] = 0;
    if (random_() % 3 == 0) q[1] = q[2] = 0;
    quantize_rotation(q, row.geometry.data());
    const bool is_wild = random_() % 2 == 0;
    for (std::size_t k = 4; k < 7; ++k)
      row.geometry[k] = static_cast<std::uint16_t>(is_wild ? random_() % 0x7C00 : 0x3000 + random_() % 0x1000);
    row.geometry[7] = 0x3800;
    return row;
  }
  double uniform(double low, double high) { return low + (high - low) * static_cast<double>(random_()) / 4294967296.0; }

 private:
  std::mt19937 random_{5};
};

bool holds(const Box& box, const Extent& e) {
  for (std::size_t k = 0; k < 3; ++k) {
    if (!(e.mean[k] - kExtentShare * e.reach[k] >= static_cast<double>(box.min[k]))) return false;
    if (!(e.mean[k] + kExtentShare * e.reach[k] <= static_cast<double>(box.max[k]))) return false;
  }
  return true;
}

/// Of `share` of the extent, each side moved at random by up to `jitter` of it.
Box box_of(const Extent& e, double share, double jitter, Rows& rows) {
  Box box;
  for (std::size_t k = 0; k < 3; ++k) {
    box.min[k] = static_cast<float>(e.mean[k] - e.reach[k] * (share + rows.uniform(-jitter, jitter)));
    box.max[k] = static_cast<float>(e.mean[k] + e.reach[k] * (share + rows.uniform(-jitter, jitter)));
  }
  return box;
}

}  // namespace

TEST_CASE("a Gaussian that a box is quickly said to hold is held by its extent's measure, also at the edge") {
  Rows rows;
  int n_yes = 0, n_no = 0, n_left = 0;
  for (int i = 0; i < 400000; ++i) {
    const Row row = rows.next();
    const int exponent = i % 7 * 4 - 12;
    const Extent e = extent_of(row.mean_bytes(), row.geometry_bytes(), exponent);
    const Box box = box_of(e, i % 2 == 0 ? kExtentShare : 1, 0x1p-10, rows);
    const bool is_held = holds(box, e),
               is_enough = RoomInBox(box, exponent).is_enough(row.mean_bytes(), row.geometry_bytes());
    if (is_enough && !is_held) {
      CAPTURE(i);
      FAIL("said to be held, and is not");
    }
    n_yes += is_enough, n_no += !is_held, n_left += is_held && !is_enough;
  }
  CHECK(n_yes > 10000);
  CHECK(n_no > 100000);
  CHECK(n_left > 10000);
}

TEST_CASE("boxes that are as large as the extent, and rounded outwards, are said to hold it without it") {
  Rows rows;
  int n_left = 0;
  for (int i = 0; i < 20000; ++i) {
    const Row row = rows.next();
    const Extent e = extent_of(row.mean_bytes(), row.geometry_bytes(), 8);
    Box box = box_of(e, 1, 0, rows);
    for (std::size_t k = 0; k < 3; ++k) {
      box.min[k] = std::nextafter(box.min[k], -INFINITY);
      box.max[k] = std::nextafter(box.max[k], INFINITY);
    }
    n_left += !RoomInBox(box, 8).is_enough(row.mean_bytes(), row.geometry_bytes());
  }
  CHECK(n_left == 0);
}

TEST_CASE("a Gaussian beside the box is not said to be held, whatever its size") {
  const Box box{{-1, -1, -1}, {1, 1, 1}};
  for (const std::uint16_t scale : {std::uint16_t{0}, std::uint16_t{1}, std::uint16_t{0x3400}}) {
    for (std::size_t k = 0; k < 3; ++k) {
      Row row{{0, 0, 0}, {0x3C00, 0, 0, 0, scale, scale, 0, 0}};
      CHECK(RoomInBox(box, 4).is_enough(row.mean_bytes(), row.geometry_bytes()));
      for (const float x : {-1.5F, 1.5F}) {
        row.mean[k] = x;
        CHECK(!RoomInBox(box, 4).is_enough(row.mean_bytes(), row.geometry_bytes()));
      }
    }
  }
}
