// scene_writer_test.cpp - the same file for every sink and number of threads, and errors of sinks and sources.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene_writer.hpp"

#include <doctest/doctest.h>
#include <sys/resource.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <filesystem>
#include <limits>
#include <numeric>
#include <optional>
#include <thread>

#include "plausible_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/file.hpp"
#include "rgs/spatial_order.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

/// The first pass over a cloud.
struct Scanned {
  SceneScan scan;
  std::vector<std::uint32_t> indices;
};

Scanned scan_of(const SplatCloud& cloud, const EncodeOptions& options) {
  Scanned result{SceneScan(std::min(cloud.sh_degree, options.sh_degree), options.on_bad), {}};
  for (std::uint32_t i = 0; i < cloud.size(); ++i) {
    Splat s = cloud.view().splat(i);
    if (result.scan.add(s)) result.indices.push_back(i);
  }
  if (options.order == Order::input) return result;
  const MortonKey key(result.scan.robust());
  std::vector<std::uint64_t> keys;
  for (const std::uint32_t i : result.indices) keys.push_back(key(&cloud.mean[3 * std::size_t{i}]));
  sort_by_key(keys, result.indices);
  return result;
}

void fill(SceneWriter::Batch& batch, std::uint64_t index, const SplatCloud& cloud) {
  for (batch.begin(index); !batch.complete(); batch.encode_chunk()) {
    std::ranges::transform(batch.source_index(), batch.splats().begin(),
                           [&](std::uint32_t i) { return cloud.view().splat(i); });
  }
}

/// All batches concurrently, one thread each, started from the last.
Result<WrittenScene> write(Sink sink, const SplatCloud& cloud, const EncodeOptions& options) {
  const Scanned scanned = scan_of(cloud, options);
  auto created = SceneWriter::create(sink, scanned.scan, options, scanned.indices);
  if (!created) return tl::unexpected(created.error());
  SceneWriter writer = std::move(*created);
  std::vector<SceneWriter::Batch> batches;
  for (std::uint64_t i = 0; i < writer.n_batches(); ++i) batches.emplace_back(writer);
  std::vector<std::thread> threads;
  for (std::uint64_t i = batches.size(); i-- > 0;) threads.emplace_back([&, i] { fill(batches[i], i, cloud); });
  for (std::thread& thread : threads) thread.join();
  for (const SceneWriter::Batch& batch : batches) {
    if (const Status s = writer.add(batch); !s) return tl::unexpected(s.error());
  }
  return writer.finish();
}

/// Limits files to `bytes` during its lifetime.
class FileSizeLimit {
 public:
  explicit FileSizeLimit(std::uint64_t bytes) : handler_(::signal(SIGXFSZ, SIG_IGN)) {
    REQUIRE(::getrlimit(RLIMIT_FSIZE, &before_) == 0);
    const rlimit limit{bytes, before_.rlim_max};
    REQUIRE(::setrlimit(RLIMIT_FSIZE, &limit) == 0);
  }
  ~FileSizeLimit() {
    ::setrlimit(RLIMIT_FSIZE, &before_);
    ::signal(SIGXFSZ, handler_);
  }
  FileSizeLimit(const FileSizeLimit&) = delete;
  FileSizeLimit& operator=(const FileSizeLimit&) = delete;

 private:
  void (*handler_)(int);
  rlimit before_{};
};

constexpr AtomicFile::Options kFast{.overwrite = true, .sync = false};

}  // namespace

TEST_CASE("a file on disk, one in memory and encode()'s have the same bytes") {
  struct Case {
    Profile profile;
    std::uint64_t n;
    int degree;
    std::uint32_t chunk_size = 256;
    bool chunk_step_sets = true;
    bool keep_permutation = false;
  };
  const Case cases[] = {
      {Profile::direct, 0, 3},
      {Profile::direct, 1, 3},
      {Profile::direct, 8192, 1, 96, true, true},
      {Profile::direct, 30000, 2, 256, false, false},
      {Profile::packed, 0, 3},
      {Profile::packed, 1, 0},
      {Profile::packed, 40000, 3, 32, true, true},
      {Profile::packed, 40000, 1, 65536, false, false},  // tables that coding does not shrink
      {Profile::packed, 150000, 0},                      // sections that are not moved in one piece
      {Profile::archive, 0, 2},
      {Profile::archive, 40000, 1, 256, true, true},
  };
  SplitMix random{211};
  const TemporaryFolder folder;
  for (const Case& c : cases) {
    CAPTURE(static_cast<int>(c.profile));
    CAPTURE(c.n);
    SplatCloud cloud = plausible_cloud(c.n, c.degree, random);
    EncodeOptions options;
    options.profile = c.profile;
    options.chunk_size = c.chunk_size;
    options.chunk_step_sets = c.chunk_step_sets;
    options.keep_permutation = c.keep_permutation;
    if (c.keep_permutation) {
      options.provenance = Provenance{1, 2, "name", "tool"};
      options.on_bad = BadPolicy::repair;
      cloud.rotation[2 * c.n] = std::numeric_limits<float>::quiet_NaN();
      cloud.mean[7] = std::numeric_limits<float>::quiet_NaN();
    }
    const auto expected = encode(cloud.view(), options);
    REQUIRE(expected);
    const auto view = FileView::open(*expected);
    REQUIRE(view);
    CHECK(validate(*view));

    std::vector<std::byte> memory(expected->size() + 5000, std::byte{0xA5});  // old contents do not shine through
    const auto in_memory = write(memory, cloud, options);
    REQUIRE(in_memory);
    CHECK((memory == *expected));

    auto file = AtomicFile::create(folder.file("out"), kFast);
    REQUIRE(file);
    const auto on_disk = write(*file, cloud, options);
    REQUIRE(on_disk);
    REQUIRE(file->commit());
    const auto mapped = MappedFile::open(folder.file("out"));
    REQUIRE(mapped);
    CHECK(std::ranges::equal(mapped->bytes(), *expected));

    // finish() returns what a reader sees.
    CHECK(on_disk->header.file_bytes == expected->size());
    CHECK(on_disk->header.version_minor == view->header().version_minor);
    CHECK(on_disk->declarations.full.max == view->declarations().full.max);
    CHECK(on_disk->declarations.n_opacity_one == view->declarations().n_opacity_one);
    REQUIRE(on_disk->sections.size() == view->sections().size());
    for (std::size_t i = 0; i < view->sections().size(); ++i) {
      CHECK(on_disk->sections[i].offset == view->sections()[i].offset);
      CHECK(on_disk->sections[i].xxh3 == view->sections()[i].xxh3);
    }
  }
}

TEST_CASE("a source that changes between the passes causes an error, whatever the change") {
  SplitMix random{3};
  const SplatCloud cloud = plausible_cloud(5000, 2, random);
  constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
  const std::pair<const char*, void (*)(Splat&)> changes[] = {
      {"a mean that is no number", [](Splat& s) { s.mean[1] = kNan; }},
      {"a mean far away", [](Splat& s) { s.mean[0] = 1e6F; }},
      {"a scale that is no number", [](Splat& s) { s.log_scale[2] = kNan; }},
      {"a scale beyond any other", [](Splat& s) { s.log_scale[0] = 59.F; }},
      {"a rotation of zero", [](Splat& s) { std::ranges::fill(s.rotation, 0.F); }},
      {"a logit that is no number", [](Splat& s) { s.opacity_logit = kNan; }},
      {"a coefficient that is no number", [](Splat& s) { s.sh[5] = kNan; }}};
  for (const auto& entry : changes) {
    CAPTURE(entry.first);
    for (const Profile profile : {Profile::direct, Profile::packed}) {
      EncodeOptions options;
      options.profile = profile;
      const Scanned scanned = scan_of(cloud, options);
      SplatCloud changed = cloud;
      Splat splat = cloud.view().splat(1234);
      entry.second(splat);
      changed.set(1234, splat);
      std::vector<std::byte> file;
      auto writer = SceneWriter::create(file, scanned.scan, options, scanned.indices);
      REQUIRE(writer);
      SceneWriter::Batch batch(*writer);
      Status status;
      for (std::uint64_t i = 0; i < writer->n_batches() && status; ++i) {
        fill(batch, i, changed);
        status = writer->add(batch);
      }
      const auto written = writer->finish();
      REQUIRE_FALSE(written);
      CHECK(written.error().code == Errc::read_failed);
    }
  }
}

TEST_CASE("a sink that fails at any point causes an error and keeps the old output") {
  SplitMix random{212};
  const SplatCloud cloud = plausible_cloud(60000, 1, random);  // direct: 60000 * 40 bytes
  const TemporaryFolder folder;
  const std::string path = folder.file("out");
  {
    auto old = AtomicFile::create(path, kFast);
    REQUIRE(old);
    REQUIRE(old->write_at(0, std::vector<std::byte>(3)));
    REQUIRE(old->commit());
  }
  enum class Step { create, add, finish };
  struct Case {
    Profile profile;
    Step step;  // that fails
    std::uint64_t limit;
  };
  const Case cases[] = {
      {Profile::direct, Step::create, 1'000'000}, {Profile::direct, Step::add, 1'000'000},
      {Profile::direct, Step::add, 2'000'000},    {Profile::direct, Step::finish, 100},
      {Profile::packed, Step::add, 1'000'000},    {Profile::packed, Step::finish, 5000},
      {Profile::archive, Step::finish, 100'000},
  };
  for (const Case& c : cases) {
    CAPTURE(static_cast<int>(c.profile));
    CAPTURE(c.limit);
    auto file = AtomicFile::create(path, kFast);
    REQUIRE(file);
    EncodeOptions options;
    options.profile = c.profile;
    const Scanned scanned = scan_of(cloud, options);
    std::optional<FileSizeLimit> limit;
    const auto check = [&](const Error& error, Step step) {
      CHECK(step == c.step);
      CHECK(error.code == Errc::write_failed);
      CHECK(error.system == EFBIG);
      if (step != Step::create) CHECK(error.offset >= c.limit);
    };
    if (c.step == Step::create) limit.emplace(c.limit);
    auto writer = SceneWriter::create(*file, scanned.scan, options, scanned.indices);
    if (!writer) {
      check(writer.error(), Step::create);
      continue;
    }
    if (c.step == Step::add) limit.emplace(c.limit);
    SceneWriter::Batch batch(*writer);
    std::uint64_t n_added = 0;
    Status added;
    for (; added && n_added < writer->n_batches(); n_added += added ? 1U : 0U) {
      fill(batch, n_added, cloud);
      added = writer->add(batch);
    }
    if (!added) {
      check(added.error(), Step::add);
      if (c.profile == Profile::direct && c.limit == 2'000'000) CHECK(n_added > 1);  // not the first batch
      continue;
    }
    limit.emplace(c.limit);
    const auto written = writer->finish();
    REQUIRE_FALSE(written);
    check(written.error(), Step::finish);
  }
  CHECK(std::filesystem::file_size(path) == 3);
  CHECK(std::distance(std::filesystem::directory_iterator(folder.path()), {}) == 1);
}
