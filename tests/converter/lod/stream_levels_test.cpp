// stream_levels_test.cpp - levels built through scratch files: the same bytes as in memory, for any memory limit.
// SPDX-License-Identifier: Apache-2.0
#include "stream_levels.hpp"

#include <doctest/doctest.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "counted_memory.hpp"
#include "lod_scenes.hpp"
#include "rgs/encode.hpp"
#include "rgs/paged_file.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"

namespace {

using namespace rgs;
using namespace rgs::lod;

constexpr std::uint64_t kBlock = 777;

SplatStream stream_of(const SplatCloud& cloud) {
  return {cloud.size(), cloud.sh_degree, [&cloud](const SplatStream::Visit& visit) -> Status {
            std::vector<Splat> rows;
            for (std::uint64_t first = 0; first < cloud.size(); first += kBlock) {
              rows.clear();
              for (std::uint64_t i = first; i < std::min(first + kBlock, cloud.size()); ++i) {
                rows.push_back(cloud.view().splat(i));
              }
              if (Status s = visit(first, rows); !s) return s;
            }
            return {};
          }};
}

Result<std::vector<std::byte>> streamed(const SplatStream& stream, const EncodeOptions& encode,
                                        const StreamOptions& options) {
  SceneScan scan(stream.sh_degree, encode.on_bad);
  std::uint64_t first_damaged = 0;
  if (Status s = scan_stream(stream, options, scan, first_damaged); !s) return tl::unexpected(s.error());
  StreamedLevels levels;
  if (Status s = order_leaves(stream, scan, encode, options, levels); !s) return tl::unexpected(s.error());
  if (Status s = build_upper(encode, options, levels); !s) return tl::unexpected(s.error());
  std::vector<std::byte> bytes;
  const auto written = write_tree(levels, scan, encode, options, bytes);
  if (!written) return tl::unexpected(written.error());
  return bytes;
}

// A wall of 120 x 120 Gaussians, three of them damaged, or fewer or more of them.
SplatCloud scene(std::uint64_t side = 120) {
  test::SplitMix random(5);
  SplatCloud cloud = test::wall(side, 2, random);
  const std::uint64_t n = cloud.size();
  for (const std::uint64_t i : {n / 3, n / 2}) cloud.opacity_logit[i] = std::numeric_limits<float>::quiet_NaN();
  cloud.rotation[4 * (n / 4)] = std::numeric_limits<float>::infinity();
  return cloud;
}

}  // namespace

TEST_CASE("a streamed file's bytes depend on neither memory nor threads and equal those of levels in memory") {
  const SplatCloud cloud = scene();
  const test::TemporaryFolder folder;
  for (const auto& way : {std::pair(Order::morton, 1024U), {Order::input, 1024U}, {Order::morton, 7U}}) {
    const Order order = way.first;
    const unsigned stretch_pages = way.second;
    CAPTURE(stretch_pages);
    EncodeOptions encode;
    encode.profile = Profile::packed;
    encode.chunk_size = 64;
    encode.order = order;
    encode.keep_permutation = order == Order::morton;
    encode.on_bad = order == Order::morton ? BadPolicy::repair : BadPolicy::drop;
    StreamOptions options;
    options.scratch = folder.path();
    options.build.stretch_pages = stretch_pages;  // 7: five stretches
    options.build.stretch_levels = stretch_pages == 7 ? 1 : 4;
    const auto whole = streamed(stream_of(cloud), encode, options);
    REQUIRE(whole);
    for (const std::uint64_t memory : {1'500'000U, 4'000'000U, 40'000'000U}) {
      for (const int threads : {1, 2}) {
        CAPTURE(memory);
        CAPTURE(threads);
        options.memory_bytes = memory;
        Result<std::vector<std::byte>> parts;
        tbb::task_arena(threads).execute([&] { parts = streamed(stream_of(cloud), encode, options); });
        REQUIRE(parts);
        CHECK(*parts == *whole);
      }
    }
    CHECK(std::filesystem::is_empty(folder.path()));

    // Leaves equal those of a file without levels, and levels those of build_levels().
    const auto plain = rgs::encode(cloud.view(), encode);
    REQUIRE(plain);
    const auto leaves = decode(*plain), back = decode(*whole);
    REQUIRE(leaves);
    REQUIRE(back);
    CHECK(leaves->mean == back->mean);
    CHECK(leaves->sh == back->sh);
    const auto file = PagedFile::open(*whole);
    REQUIRE(file);
    CHECK(validate(*file));
    std::vector<std::uint32_t> rows(cloud.size());
    const auto view = FileView::open(*plain);
    if (order != Order::morton) continue;
    SplatCloud sorted;
    sorted.resize(leaves->size(), cloud.sh_degree);
    SceneScan mender(cloud.sh_degree, encode.on_bad);
    std::vector<std::uint32_t> positions;
    for (std::uint64_t i = 0; i < leaves->size(); ++i) {
      positions.push_back(static_cast<std::uint32_t>(view->source_index(i)));
      Splat splat = cloud.view().splat(positions.back());
      REQUIRE(mender.add(splat));
      sorted.set(i, splat);
    }
    encode.source_index = positions;
    encode.n_source = cloud.size();
    encode.n_repaired = mender.n_repaired();
    std::vector<std::byte> in_memory;
    BuildOptions build = options.build;
    build.chunk_size = 64;
    REQUIRE(write_levels(build_levels(sorted.view(), build), encode, in_memory));
    CHECK(in_memory == *whole);
  }
}

TEST_CASE("progress goes on while merges are weighed, and ends at all Gaussians below the root") {
  const SplatCloud cloud = scene();
  EncodeOptions encode;
  encode.on_bad = BadPolicy::drop;
  StreamOptions options;
  SceneScan scan(cloud.sh_degree, encode.on_bad);
  std::uint64_t first_damaged = 0, done = 0;
  REQUIRE(scan_stream(stream_of(cloud), options, scan, first_damaged));
  StreamedLevels levels;
  REQUIRE(order_leaves(stream_of(cloud), scan, encode, options, levels));
  std::vector<std::uint64_t> steps;
  options.advance = [&](std::uint64_t units) {
    done += units;
    steps.push_back(done);
  };
  tbb::task_arena(1).execute([&] { REQUIRE(build_upper(encode, options, levels)); });
  const std::size_t n_leaf_pages = levels.pages.front().size();
  REQUIRE(steps.size() > n_leaf_pages);
  CHECK(steps[n_leaf_pages - 1] < levels.n_leaves / 3);
  CHECK(done == levels.n_stored() - levels.pages.back().front().count);
}

TEST_CASE("too little memory to sort is an error, and so is a source that changes between passes") {
  SplatCloud cloud = scene();
  EncodeOptions encode;
  StreamOptions options;
  const test::TemporaryFolder folder;
  options.scratch = folder.path();
  options.memory_bytes = 2'000'000;
  SplatCloud crowd = cloud;
  for (std::uint64_t i = 0; i < 10'000; ++i) std::copy_n(&crowd.mean[0], 3, &crowd.mean[3 * i]);
  CHECK(streamed(stream_of(crowd), encode, options).error().code == Errc::limit_exceeded);
  encode.order = Order::input;
  CHECK(streamed(stream_of(crowd), encode, options));
  encode.order = Order::morton;
  options.memory_bytes = 20'000'000;
  CHECK(streamed(stream_of(crowd), encode, options));

  // Between the passes: shorter, longer, moved.
  for (const std::uint64_t memory : {2'000'000U, 20'000'000U}) {
    options.memory_bytes = memory;
    for (const int change : {0, 1, 2}) {
      for (const int pass : {1, 2}) {
        if (memory > 10'000'000 && pass == 2) continue;    // there are two passes
        if (memory > 10'000'000 && change == 2) continue;  // writers notice only if it leaves the scene's box
        CAPTURE(change);
        CAPTURE(pass);
        SplatCloud other = cloud;
        if (change == 0) other.resize(cloud.size() - 3000, cloud.sh_degree);
        if (change == 1) other = scene(130);
        if (change == 2) std::reverse(other.mean.begin(), other.mean.begin() + 20'000);
        int n_passes = 0;
        SplatStream changing = stream_of(cloud);
        changing.read = [&](const SplatStream::Visit& visit) {
          return stream_of(n_passes++ < pass ? cloud : other).read(visit);
        };
        const auto bytes = streamed(changing, encode, options);
        if (change == 2 && bytes) continue;  // equal counts in each range: other Gaussians, still complete
        REQUIRE_FALSE(bytes);
        CHECK(bytes.error().code == Errc::read_failed);
      }
    }
  }

  options.memory_bytes = 1'000'000;
  options.scratch = folder.file("missing");
  const auto nowhere = streamed(stream_of(cloud), encode, options);
  REQUIRE_FALSE(nowhere);
  CHECK(nowhere.error().code == Errc::open_failed);
}

TEST_CASE("scratch files return what was written and leave nothing behind") {
  const test::TemporaryFolder folder;
  std::vector<std::byte> bytes(1000, std::byte{7}), back(500);
  for (const bool on_disk : {false, true}) {
    ScratchFile file;
    if (on_disk) {
      auto created = ScratchFile::create(folder.path());
      REQUIRE(created);
      file = std::move(*created);
    }
    REQUIRE(file.write(5000, bytes));
    bytes[0] = std::byte{9};
    REQUIRE(file.write(100, bytes));
    REQUIRE(file.read(5500, back));
    CHECK(std::ranges::count(back, std::byte{7}) == 500);
    REQUIRE(file.read(100, back));
    CHECK(back[0] == std::byte{9});
    CHECK(file.read(5501, back).error().code == Errc::read_failed);
    bytes[0] = std::byte{7};
    CHECK(std::filesystem::is_empty(folder.path()));
  }
}

TEST_CASE("sorting keeps rows and order in memory, but no keys") {
  if (!rgs::test::counts_memory()) return rgs::test::skip("a sanitizer replaces the allocator");
  constexpr std::uint64_t kRowBytes = 200, kRows = 20'000;
  const auto before = rgs::test::live_bytes();
  std::vector<std::byte> rows(kRows * kRowBytes);
  for (std::uint64_t i = 0; i < kRows; ++i) {
    const float mean[3] = {static_cast<float>(i * 7919 % kRows), 0, 0};
    std::memcpy(&rows[i * kRowBytes], mean, sizeof mean);
  }
  const MortonKey key({{0, 0, 0}, {kRows, 1, 1}});
  rgs::test::reset_peak_bytes();
  sort_rows(rows, kRowBytes, key);
  CHECK(rgs::test::peak_bytes() - before < static_cast<std::int64_t>(kRows * (2 * kRowBytes + 4 + 6)));
  float last[3];
  std::memcpy(last, &rows[(kRows - 1) * kRowBytes], sizeof last);
  CHECK(last[0] >= kRows - kRows / 128.0);  // in the last cell of the curve, which keeps the source's order
}
