// format_memory_test.cpp - the format library without memory: a value or host_out_of_memory, nothing else.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <atomic>
#include <filesystem>
#include <numeric>
#include <stdexcept>

#include "failing_memory.hpp"
#include "file/workers.hpp"
#include "golden_levels.hpp"
#include "plausible_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using rgs::test::fail_each_allocation;
using rgs::test::file_bytes;
using rgs::test::hash_of;

namespace {

Result<std::uint64_t> hash_of_cloud(const Result<SplatCloud>& cloud) {
  if (!cloud) return tl::unexpected(cloud.error());
  return hash_of(cloud->mean) ^ 3 * hash_of(cloud->rotation) ^ 5 * hash_of(cloud->sh);
}

Result<std::uint64_t> hash_of_data(const Result<DirectData>& data) {
  if (!data) return tl::unexpected(data.error());
  return hash_of(data->means()) ^ 3 * hash_of(data->geometry()) ^ 5 * hash_of(data->sh());
}

std::vector<std::byte> encoded(std::uint64_t n, Profile profile) {
  test::SplitMix random{5};
  EncodeOptions options;
  options.profile = profile;
  return encode(test::plausible_cloud(n, 3, random).view(), options).value();
}

}  // namespace

TEST_CASE("opening, checking and decoding files of every profile") {
  for (const char* name :
       {"degree3", "optional", "packed_degree3", "packed_global", "archive_degree3", "archive3_degree3"}) {
    CAPTURE(name);
    const auto bytes = file_bytes(std::string("golden/") + name + ".rgs");
    CHECK(fail_each_allocation([&] { return hash_of_cloud(decode(bytes)); }) >= 8);
    fail_each_allocation([&]() -> Result<std::uint64_t> {
      auto view = FileView::open(bytes);
      if (!view) return tl::unexpected(view.error());
      if (Status s = validate(*view); !s) return tl::unexpected(s.error());
      if (Status s = view->preload(); !s) return tl::unexpected(s.error());
      ActivatedSplat last;
      if (Status s = view->read(view->header().n_gaussians - 1, std::span(&last, 1)); !s)
        return tl::unexpected(s.error());
      return hash_of(std::as_bytes(std::span(&last, 1)));
    });
  }
}

TEST_CASE("decoding on several threads") {
  for (const Profile profile : {Profile::packed, Profile::archive}) {
    const auto bytes = encoded(20'000, profile);
    fail_each_allocation([&]() -> Result<std::uint64_t> {
      const auto view = FileView::open(bytes);
      if (!view) return tl::unexpected(view.error());
      return hash_of_data(load_direct(*view, {.validate = true, .threads = 3}));
    });
  }
}

TEST_CASE("encoding every profile") {
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    test::SplitMix random{6};
    const SplatCloud cloud = test::plausible_cloud(200, 1, random);
    EncodeOptions options;
    options.profile = profile;
    options.keep_permutation = true;
    fail_each_allocation([&]() -> Result<std::uint64_t> {
      const auto bytes = encode(cloud.view(), options);
      if (!bytes) return tl::unexpected(bytes.error());
      return hash_of(*bytes);
    });
  }
}

TEST_CASE("writing and reading levels of every profile") {
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    const test::GoldenLevels scene = test::golden_levels("", profile, 150, 1, 7, 1);
    fail_each_allocation([&]() -> Result<std::uint64_t> {
      std::vector<std::byte> bytes;
      const auto written = write_levels(scene.levels, scene.options, bytes, 1);
      if (!written) return tl::unexpected(written.error());
      return hash_of(bytes);
    });
    const std::vector<std::byte> bytes = test::encode_levels(scene);
    fail_each_allocation([&]() -> Result<std::uint64_t> {
      const auto file = PagedFile::open(bytes);
      if (!file) return tl::unexpected(file.error());
      if (const Status s = validate(*file, 1); !s) return tl::unexpected(s.error());
      const auto plain = leaves_as_file(*file, {.threads = 1});
      if (!plain) return tl::unexpected(plain.error());
      const auto root = read_pages(*file, std::array{std::uint32_t{0}}, {.threads = 1});
      const auto mixed = hash_of_cloud(root);
      if (!mixed) return mixed;
      return *mixed ^ hash_of(*plain);
    });
  }
}

TEST_CASE("an output appears whole or not at all, and leaves no other file") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("a rather long name, so that its string is on the heap");
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    const std::byte byte{7};
    auto file = AtomicFile::create(path, {.overwrite = true, .sync = true});
    if (!file) return tl::unexpected(file.error());
    if (Status s = file->write_at(0, {&byte, 1}); !s) return tl::unexpected(s.error());
    if (const auto done = file->commit(); !done) return tl::unexpected(done.error());
    return 1;
  });
  CHECK(std::distance(std::filesystem::directory_iterator(folder.path()), {}) == 1);
  CHECK(std::filesystem::file_size(path) == 1);
}

TEST_CASE("a worker's exception ends the loop on the caller's thread, not the program") {
  for (const unsigned threads : {1u, 4u}) {
    std::vector<int> done(1000);
    const auto run = [&](auto fail) {
      return detail::run_jobs(done.size(), threads, [&](unsigned, std::uint64_t i) -> Status {
        if (i == 400) fail();
        done[i] = 1;
        return {};
      });
    };
    CHECK_THROWS_AS(static_cast<void>(run([] { throw std::bad_alloc(); })), std::bad_alloc);
    CHECK(std::accumulate(done.begin(), done.begin() + 400, 0) == 400);
    CHECK_THROWS_AS(static_cast<void>(run([] { throw std::runtime_error("x"); })), std::runtime_error);
    REQUIRE(run([] {}));
    CHECK(std::accumulate(done.begin(), done.end(), 0) == 1000);
  }
  // Neither the list of threads nor a thread is required to do the work.
  fail_each_allocation([]() -> Result<std::uint64_t> {
    std::atomic<std::uint64_t> sum{0};
    try {
      const Status s = detail::run_jobs(100, 4, [&](unsigned, std::uint64_t i) -> Status {
        sum += i;
        return {};
      });
      if (!s) return tl::unexpected(s.error());
    } catch (const std::bad_alloc&) {
      return make_error(Errc::host_out_of_memory, 0, "caught");
    }
    return sum.load();
  });
}
