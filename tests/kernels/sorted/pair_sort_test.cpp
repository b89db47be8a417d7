// pair_sort_test.cpp - the order of (tile, Gaussian) pairs and the tiles' ranges, against the standard library.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <numeric>

#include "device_fixture.hpp"
#include "golden_scenes.hpp"
#include "sorted/sort.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

template <class Key>
void check_sort(std::uint64_t n, int bits, std::uint64_t n_distinct) {
  SplitMix random(n * 67 + static_cast<std::uint64_t>(bits));
  const std::uint64_t mask = bits == 0 ? 0 : ~std::uint64_t{0} >> (64 - bits);
  std::vector<Key> keys(n);
  // Bits above the sorted ones are noise, so that a sort that reads them fails.
  for (Key& k : keys) {
    k = static_cast<Key>((random.bits() & ~mask) | (random.below(n_distinct) * 0x9E3779B97F4A7C15u & mask));
  }
  std::vector<std::uint32_t> values(n);
  std::iota(values.begin(), values.end(), 0u);

  const DeviceArray<Key> device_keys{std::span<const Key>(keys)}, spare_keys(n);
  const DeviceArray<std::uint32_t> device_values{std::span<const std::uint32_t>(values)}, spare_values(n);
  const bool narrow = sizeof(Key) == 4;
  const auto bytes = cuda::sort_bytes(n, narrow);
  require_ok(bytes);
  const DeviceArray<std::byte> temporary(*bytes);
  cuda::SortBuffers buffers{device_keys.data(), spare_keys.data(), device_values.data(), spare_values.data(), narrow};
  require_ok(cuda::launch_sort(buffers, n, bits, temporary.data(), *bytes, nullptr));

  const bool swapped_keys = buffers.keys != device_keys.data();
  const bool swapped_values = buffers.gaussians != device_values.data();
  CHECK((swapped_keys ? buffers.keys == spare_keys.data() && buffers.spare_keys == device_keys.data()
                      : buffers.spare_keys == spare_keys.data()));
  const auto sorted_keys = (swapped_keys ? spare_keys : device_keys).download();
  const auto sorted_values = (swapped_values ? spare_values : device_values).download();
  for (const auto* a : {&device_keys, &spare_keys}) a->check_guards();
  for (const auto* a : {&device_values, &spare_values}) a->check_guards();
  temporary.check_guards();

  std::stable_sort(values.begin(), values.end(),
                   [&](std::uint32_t a, std::uint32_t b) { return (keys[a] & mask) < (keys[b] & mask); });
  std::uint64_t n_wrong = 0, first = 0;
  for (std::uint64_t i = 0; i < n; ++i) {
    const bool same = sorted_values[i] == values[i] && sorted_keys[i] == keys[values[i]];
    if (!same && n_wrong++ == 0) first = i;
  }
  if (n_wrong > 0) {
    FAIL_CHECK((8 * sizeof(Key)), "-bit keys, ", bits, " bits, n = ", n, ", ", n_distinct, " distinct: ", n_wrong,
               " differ; at ", first, " the device has value ", sorted_values[first], " key ",
               static_cast<std::uint64_t>(sorted_keys[first]), ", expected value ", values[first], " key ",
               static_cast<std::uint64_t>(keys[values[first]]));
  }
}

template <class Key>
void check_ranges(std::uint64_t n, std::uint32_t n_tiles, int depth_bits) {
  SplitMix random(n * 31 + n_tiles);
  std::vector<Key> keys(n);
  const std::uint64_t depths = std::uint64_t{1} << depth_bits;
  for (Key& k : keys) {
    // Two of three tiles stay empty, the first among them.
    std::uint64_t tile = random.below(n_tiles);
    if (n_tiles > 4) tile = std::min<std::uint64_t>(tile / 3 * 3 + 1, n_tiles - 1);
    k = static_cast<Key>(tile << depth_bits | random.below(depths));
  }
  std::sort(keys.begin(), keys.end());
  std::vector<cuda::TileRange> expected(n_tiles, {0, 0});
  for (std::uint64_t i = 0; i < n; ++i) {
    auto& range = expected[static_cast<std::uint64_t>(keys[i]) >> depth_bits];
    if (range.end == 0) range.begin = static_cast<std::uint32_t>(i);
    range.end = static_cast<std::uint32_t>(i) + 1;
  }
  const DeviceArray<Key> device_keys{std::span<const Key>(keys)};
  const DeviceArray<cuda::TileRange> ranges(n_tiles);
  require_ok(cuda::launch_ranges(device_keys.data(), sizeof(Key) == 4, n, depth_bits, ranges.data(), n_tiles, nullptr));
  const auto found = ranges.download();
  for (std::uint32_t t = 0; t < n_tiles; ++t) {
    const bool same = found[t].begin == expected[t].begin && found[t].end == expected[t].end;
    REQUIRE_MESSAGE(same, (8 * sizeof(Key)), "-bit keys, ", depth_bits, " bits of depth, n = ", n, ", tile ", t, " of ",
                    n_tiles, ": ", found[t].begin, " .. ", found[t].end, " instead of ", expected[t].begin, " .. ",
                    expected[t].end);
  }
}

}  // namespace

TEST_CASE("sorting is stable and reads the lowest bits only") {
  if (!device_answers()) return;
  std::vector<std::uint64_t> sizes{0, 1, 2, 255, 256, 257, 5000, 300001, 2000003};
  if (small_sizes()) sizes.resize(7);
  if (race_sizes()) sizes = {1, 257, 5000};
  for (const std::uint64_t n : sizes) {
    const bool large = n > 300001;
    for (const int bits : {0, 1, 7, 8, 13, 19, 31, 32}) {
      if (large && bits != 32) continue;
      if (race_sizes() && bits != 8 && bits != 32) continue;
      check_sort<std::uint32_t>(n, bits, 1000);
      check_sort<std::uint32_t>(n, bits, std::uint64_t{1} << 40);
    }
    for (const int bits : {0, 1, 32, 33, 40, 45, 49, 56, 63, 64}) {
      if (large && bits != 45) continue;
      if (race_sizes() && bits != 45 && bits != 64) continue;
      check_sort<std::uint64_t>(n, bits, 1000);
      check_sort<std::uint64_t>(n, bits, std::uint64_t{1} << 40);
    }
  }
}

TEST_CASE("ranges cover each tile's pairs, empty tiles and a single tile with 32 bits of depth") {
  if (!device_answers()) return;
  for (const std::uint64_t n : {0u, 1u, 2u, 255u, 256u, 257u, 4097u, 300000u}) {
    if (small_sizes() && n > 4097) continue;
    if (race_sizes() && n != 257) continue;
    check_ranges<std::uint32_t>(n, 1, 32);
    check_ranges<std::uint64_t>(n, 1, 32);
    for (const std::uint32_t n_tiles : {2u, 3u, 920u, 8160u}) {
      check_ranges<std::uint32_t>(n, n_tiles, 19);
      check_ranges<std::uint64_t>(n, n_tiles, 32);
    }
    check_ranges<std::uint32_t>(n, 129600, 15);
    check_ranges<std::uint64_t>(n, 129600, 32);
  }
}
