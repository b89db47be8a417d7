// parts_test.cpp - one scene by many processes: the bytes equal one process's in any order of work, and missing,
// damaged or foreign work is reported by file.
// SPDX-License-Identifier: Apache-2.0
#include "parts.hpp"

#include <doctest/doctest.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <deque>
#include <filesystem>
#include <fstream>
#include <functional>
#include <numeric>

#include "batch_plan.hpp"
#include "convert_scenes.hpp"
#include "counted_memory.hpp"
#include "edit_file.hpp"
#include "file_times.hpp"
#include "parts_rows.hpp"
#include "plausible_cloud.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/checksum.hpp"
#include "scene_input.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// 256 Gaussians per page and 7 pages per stretch of one level: stretches of 1,792, which seldom end where bins do.
lod::BuildOptions small_stretches() {
  lod::BuildOptions build;
  build.page_chunks = 4;
  build.stretch_pages = 7;
  build.stretch_levels = 1;
  return build;
}

struct Scene {
  std::vector<std::string> paths;
  EncodeOptions encode;
  std::vector<Similarity> placed;
};

// Three tiles of different sizes and degrees, partly damaged, and an empty one.
Scene three_tiles(const std::string& folder) {
  Scene scene;
  const std::uint64_t sizes[] = {3000, 0, 1900, 2500};
  for (std::size_t i = 0; i < 4; ++i) {
    SplitMix random(40 + i);
    SplatCloud cloud = plausible_cloud(sizes[i], i == 2 ? 0 : 1, random);
    if (i == 2) cloud = damaged(std::move(cloud), 500);
    scene.paths.push_back(write_scene(folder + "/tile" + std::to_string(i) + ".ply", cloud));
    Similarity placed;
    placed.translation = {static_cast<double>(i), 0, i == 3 ? -2.0 : 0.0};
    scene.placed.push_back(placed);
  }
  scene.encode.profile = Profile::packed;
  scene.encode.chunk_size = 64;
  scene.encode.on_bad = BadPolicy::repair;
  return scene;
}

Tile tile_of(const SceneInput& input, const Similarity& placed) {
  auto tile = input.tile(SplatFormat::ply, {});
  REQUIRE(tile);
  tile->placed = placed;
  return std::move(*tile);
}

EncodeOptions with_provenance(const Scene& scene) {
  EncodeOptions encode = scene.encode;
  std::uint64_t bytes = 0;
  for (const std::string& path : scene.paths) bytes += std::filesystem::file_size(path);
  encode.provenance = Provenance{bytes, 0, "tile0.ply and more", "test 1"};
  return encode;
}

// Converted by one process.
Result<ConvertSummary> convert_at_once(const Scene& scene, const std::string& path,
                                       std::uint64_t memory_bytes = lod::kDefaultMemory) {
  std::deque<SceneInput> inputs;
  std::vector<Tile> tiles;
  std::vector<std::uint64_t> hashes;
  for (std::size_t i = 0; i < scene.paths.size(); ++i) {
    REQUIRE(inputs.emplace_back().open(scene.paths[i]));
    tiles.push_back(tile_of(inputs.back(), scene.placed[i]));
    hashes.push_back(inputs.back().hash());
  }
  std::size_t failed_tile = 0;
  const auto stream = TileStream::open(std::move(tiles), scene.encode.axes, failed_tile);
  REQUIRE(stream);
  ConvertOptions options;
  options.encode = with_provenance(scene);
  options.encode.n_source = stream->size();
  options.levels = lod::Quality::fast;
  options.build = small_stretches();
  options.memory_bytes = memory_bytes;
  options.output = {.overwrite = true, .sync = false};
  StreamFacts facts;
  facts.origin = stream->origin();
  facts.hash = [&] { return hash_of_sources(hashes); };
  return convert_to_levels(stream->stream(), facts, path, options);
}

Bytes at_once(const Scene& scene, const std::string& path) {
  REQUIRE(convert_at_once(scene, path));
  return read_bytes(path);
}

PartsJob job_of(const Scene& scene, std::uint32_t n_ranges) {
  PartsJob job;
  job.encode = with_provenance(scene);
  std::vector<Origin> origins;
  for (std::size_t i = 0; i < scene.paths.size(); ++i) {
    SceneInput input;
    REQUIRE(input.open(scene.paths[i]));
    const auto facts = tile_facts(tile_of(input, scene.placed[i]), job.encode.axes);
    REQUIRE(facts);
    job.inputs.push_back({scene.paths[i], input.name(), input.bytes().size(), hash_of_prefix(input.bytes()),
                          SplatFormat::ply, kAxes3dgs, scene.placed[i], *facts, job.n});
    job.n += facts->n;
    job.sh_degree = std::max(job.sh_degree, facts->sh_degree);
    origins.push_back(facts->origin);
  }
  job.encode.origin = merged_origin(origins);
  job.encode.n_source = job.n;
  job.n_ranges = n_ranges;
  job.bin_rows = 700;
  return job;
}

PartsRun run_in(const std::string& folder) {
  PartsRun run;
  run.folder = folder;
  run.scratch = folder;
  run.sync = false;
  run.build = small_stretches();
  return run;
}

// The failed step's error; its name is empty if all succeeded.
template <class T>
Failure failure_of(const Outcome<T>& outcome) {
  return outcome ? Failure{"", {}} : outcome.error();
}

std::vector<std::size_t> numbers(std::size_t n) {
  std::vector<std::size_t> all(n);
  std::iota(all.begin(), all.end(), std::size_t{0});
  return all;
}

// All steps, each as if in its own process; `order` permutes the numbers.
Failure all_steps(const PartsRun& run, const std::function<void(std::vector<std::size_t>&)>& order,
                  const std::string& output) {
  const auto job = open_job(run);
  if (!job) return job.error();
  std::vector<std::size_t> inputs = numbers(job->inputs.size()), ranges = numbers(job->n_ranges);
  order(inputs);
  order(ranges);
  for (const std::size_t i : inputs) {
    if (const auto done = scan_input(run, *job, i); !done) return done.error();
  }
  if (const auto done = make_plan(run, *job); !done) return done.error();
  const auto plan = find_plan(run, *job);
  if (!plan) return plan.error();
  REQUIRE(*plan);
  for (const std::size_t i : inputs) {
    if (const auto done = place_input(run, *job, **plan, i); !done) return done.error();
  }
  for (const std::size_t i : ranges) {
    if (const auto done = build_range(run, *job, **plan, i); !done) return done.error();
  }
  return failure_of(assemble_parts(run, *job, **plan, output, {.overwrite = true, .sync = false}));
}

Bytes in_parts(const Scene& scene, std::uint32_t n_ranges, const PartsRun& run, bool backwards) {
  REQUIRE(begin_parts(run, job_of(scene, n_ranges), true));
  const std::string output = run.folder + "/out.rgs";
  const Failure failure = all_steps(
      run,
      [&](std::vector<std::size_t>& order) {
        if (backwards) std::ranges::reverse(order);
      },
      output);
  CAPTURE(failure.file);
  const std::string what = failure.error.what;
  CAPTURE(what);
  REQUIRE(failure.file.empty());
  return read_bytes(output);
}

void write_file(const std::string& path, const Bytes& bytes) {
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
}

}  // namespace

TEST_CASE("parts make the bytes of one process, for any number of ranges, order, threads and memory") {
  const TemporaryFolder folder;
  Scene scene = three_tiles(folder.path());
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    const bool positions = profile != Profile::packed;
    scene.encode.keep_permutation = positions;
    scene.encode.profile = profile;
    scene.encode.archive.step = 1.7f;
    const Bytes whole = at_once(scene, folder.file("whole.rgs"));
    for (const std::uint32_t n_ranges : {1U, 2U, 3U, 11U}) {
      for (const int threads : {1, 2}) {
        CAPTURE(static_cast<int>(profile));
        CAPTURE(n_ranges);
        CAPTURE(threads);
        PartsRun run = run_in(folder.file("work"));
        if (threads == 2) run.memory_bytes = 4'000'000;  // stretches in scratch files
        Bytes parts;
        tbb::task_arena(threads).execute([&] { parts = in_parts(scene, n_ranges, run, threads == 2); });
        CHECK(parts == whole);
      }
    }
  }
}

TEST_CASE("a scene of at most one stretch or one page has the bytes of one process too") {
  const TemporaryFolder folder;
  for (const std::uint64_t n : {100U, 1500U}) {
    SplitMix random(n);
    Scene scene;
    scene.paths = {write_scene(folder.file("a.ply"), plausible_cloud(n, 2, random))};
    scene.placed.resize(1);
    scene.encode.chunk_size = 64;
    const Bytes whole = at_once(scene, folder.file("whole.rgs"));
    CHECK(in_parts(scene, 3, run_in(folder.file("work")), false) == whole);
  }
}

TEST_CASE("who assembles an archive has memory for all its Gaussians, as one process has") {
  const TemporaryFolder folder;
  Scene scene = three_tiles(folder.path());
  scene.encode.profile = Profile::archive;
  PartsRun run = run_in(folder.file("work"));
  const Bytes parts = in_parts(scene, 2, run, false);
  const auto job = open_job(run);
  const auto plan = find_plan(run, *job);
  const std::uint64_t enough = 80 * (*plan)->scan.n_kept();
  const std::string no = folder.file("no.rgs"), yes = folder.file("yes.rgs");
  run.memory_bytes = enough - 1;
  const Failure refused = failure_of(assemble_parts(run, *job, **plan, no, {}));
  CHECK(refused.file == no);
  CHECK(refused.error.code == Errc::limit_exceeded);
  CHECK(refused.error.expected == enough - 1);
  CHECK(refused.error.found == enough);
  const auto one = convert_at_once(scene, no, enough - 1);
  REQUIRE_FALSE(one);
  CHECK(std::string(one.error().what) == refused.error.what);
  CHECK_FALSE(std::filesystem::exists(no));
  run.memory_bytes = enough;
  CHECK(failure_of(assemble_parts(run, *job, **plan, yes, {.sync = false})).file.empty());
  CHECK(read_bytes(yes) == parts);
}

TEST_CASE("a Gaussian that an archive cannot hold is named by its position in the source, if that is known") {
  const TemporaryFolder folder;
  SplitMix random(9);
  SplatCloud cloud = plausible_cloud(3000, 1, random);
  cloud.sh[12 * 1234] = 1e30f;  // 12 values each
  Scene scene;
  scene.paths = {write_scene(folder.file("a.ply"), plausible_cloud(100, 1, random)),
                 write_scene(folder.file("b.ply"), cloud)};
  scene.placed.resize(2);
  scene.encode.profile = Profile::archive;
  scene.encode.chunk_size = 64;
  const PartsRun run = run_in(folder.file("work"));
  for (const bool positions : {false, true}) {
    CAPTURE(positions);
    scene.encode.keep_permutation = positions;
    REQUIRE(begin_parts(run, job_of(scene, 2), true));
    const Failure failure = all_steps(
        run, [](auto&) {}, folder.file("no.rgs"));
    const auto one = convert_at_once(scene, folder.file("no.rgs"));
    REQUIRE_FALSE(one);
    for (const Error& error : {failure.error, one.error()}) {
      CHECK(error.code == Errc::bad_value);
      CHECK(error.found == (positions ? 1334 : Error::kNone));
    }
  }
  CHECK_FALSE(std::filesystem::exists(folder.file("no.rgs")));
}

TEST_CASE("finished steps and existing work are not repeated") {
  const TemporaryFolder folder;
  const Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  const Bytes parts = in_parts(scene, 2, run, false);
  const auto job = open_job(run);
  REQUIRE(job);
  for (std::size_t i = 0; i < 4; ++i) CHECK_FALSE(scan_input(run, *job, i).value());
  CHECK_FALSE(make_plan(run, *job).value());
  const auto plan = find_plan(run, *job);
  for (std::size_t i = 0; i < 4; ++i) CHECK_FALSE(place_input(run, *job, **plan, i).value());
  for (std::size_t i = 0; i < 2; ++i) CHECK_FALSE(build_range(run, *job, **plan, i).value());
  // Each lost file is made again, and nothing else.
  for (const std::string& path :
       {run.scan_path(1), run.plan_path(), run.rows_path(2), run.range_path(0), run.range_path(1)}) {
    CAPTURE(path);
    const Bytes before = read_bytes(path);
    std::filesystem::remove(path);
    CHECK(scan_input(run, *job, 1).value() == (path == run.scan_path(1)));
    CHECK(make_plan(run, *job).value() == (path == run.plan_path()));
    CHECK(place_input(run, *job, **plan, 2).value() == (path == run.rows_path(2)));
    for (std::size_t i = 0; i < 2; ++i) CHECK(build_range(run, *job, **plan, i).value() == (path == run.range_path(i)));
    CHECK(read_bytes(path) == before);
  }
  // The same job begun again is unchanged, and so is a touched input.
  REQUIRE(begin_parts(run, job_of(scene, 2), false));
  std::filesystem::last_write_time(scene.paths[0], std::filesystem::file_time_type::clock::now());
  CHECK_FALSE(scan_input(run, *job, 0).value());
}

TEST_CASE("rows placed with different memory are the same") {
  const TemporaryFolder folder;
  const Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  const Bytes parts = in_parts(scene, 2, run, false);
  const auto job = open_job(run);
  const auto plan = find_plan(run, *job);
  const Bytes rows = read_bytes(run.rows_path(3));
  PartsRun small = run;
  small.memory_bytes = 200'000;  // shorter blocks
  std::filesystem::remove(run.rows_path(3));
  std::filesystem::remove(run.range_path(1));
  REQUIRE(place_input(small, *job, **plan, 3));
  CHECK(read_bytes(run.rows_path(3)) != rows);
  REQUIRE(build_range(run, *job, **plan, 1));
  CHECK(failure_of(assemble_parts(run, *job, **plan, folder.file("out.rgs"), {.sync = false})).file.empty());
  CHECK(read_bytes(folder.file("out.rgs")) == parts);
}

TEST_CASE("work from other inputs or options is refused unless it may be overwritten") {
  const TemporaryFolder folder;
  Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  in_parts(scene, 2, run, false);
  const auto refused = [&](const PartsJob& job) {
    const auto begun = begin_parts(run, job, false);
    REQUIRE_FALSE(begun);
    CHECK(begun.error().file == run.job_path());
    return begun.error().error.code;
  };
  CHECK(refused(job_of(scene, 3)) == Errc::output_exists);
  Scene other = scene;
  other.encode.sh_degree = 0;
  CHECK(refused(job_of(other, 2)) == Errc::output_exists);
  other = scene;
  other.encode.archive.step = 2;
  CHECK(refused(job_of(other, 2)) == Errc::output_exists);
  other = scene;
  std::swap(other.paths[0], other.paths[2]);
  CHECK(refused(job_of(other, 2)) == Errc::output_exists);
  REQUIRE(begin_parts(run, job_of(other, 2), true));
  CHECK_FALSE(std::filesystem::exists(run.plan_path()));
  CHECK_FALSE(std::filesystem::exists(run.range_path(1)));
  CHECK(in_parts(other, 2, run, false) == at_once(other, folder.file("whole.rgs")));

  // A range of another plan does not count for this one.
  const Bytes range = read_bytes(run.range_path(0));
  in_parts(scene, 2, run, false);
  const auto job = open_job(run);
  const auto plan = find_plan(run, *job);
  write_file(run.range_path(0), range);
  const auto assembled = assemble_parts(run, *job, **plan, folder.file("no.rgs"), {});
  REQUIRE_FALSE(assembled);
  CHECK(assembled.error().file == run.range_path(0));
  CHECK(build_range(run, *job, **plan, 0).value());
  CHECK_FALSE(std::filesystem::exists(folder.file("no.rgs")));
}

TEST_CASE("an input that changes or vanishes is named, and work that does not need it goes on") {
  const TemporaryFolder folder;
  const Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  REQUIRE(begin_parts(run, job_of(scene, 2), false));
  const auto job = open_job(run);
  for (std::size_t i = 0; i < 4; ++i) REQUIRE(scan_input(run, *job, i));
  REQUIRE(make_plan(run, *job));
  const auto plan = find_plan(run, *job);

  const Bytes original = read_bytes(scene.paths[2]);
  Bytes changed = original;
  changed[changed.size() - 100] ^= std::byte{1};
  wait_for_later_time(scene.paths[2]);
  write_file(scene.paths[2], changed);
  const Failure other = failure_of(place_input(run, *job, **plan, 2));
  CHECK(other.file == scene.paths[2]);
  CHECK(other.error.code == Errc::read_failed);
  // Begin's findings may be outdated as well.
  const Failure scanned = failure_of(scan_input(run, *job, 2));
  CHECK(scanned.file == scene.paths[2]);
  CHECK(scanned.error.code == Errc::read_failed);

  changed.pop_back();
  write_file(scene.paths[2], changed);
  CHECK(failure_of(scan_input(run, *job, 2)).error.code == Errc::read_failed);
  std::filesystem::remove(scene.paths[2]);
  const Failure vanished = failure_of(place_input(run, *job, **plan, 2));
  CHECK(vanished.file == scene.paths[2]);
  CHECK(vanished.error.code == Errc::open_failed);
  CHECK(place_input(run, *job, **plan, 0).value());
  const Failure missing = failure_of(build_range(run, *job, **plan, 0));
  CHECK(missing.file == run.rows_path(1));
  CHECK(missing.error.code == Errc::open_failed);

  // Restored: everything goes on.
  write_file(scene.paths[2], original);
  REQUIRE(scan_input(run, *job, 2));
  const Failure none = all_steps(
      run, [](auto&) {}, folder.file("out.rgs"));
  const std::string what = none.error.what;
  CAPTURE(what);
  CHECK(none.file.empty());
  CHECK(read_bytes(folder.file("out.rgs")) == at_once(scene, folder.file("whole.rgs")));

  // Begun again, it is another scene.
  changed = original;
  changed[changed.size() - 100] ^= std::byte{1};
  wait_for_later_time(scene.paths[2]);
  write_file(scene.paths[2], changed);
  CHECK(failure_of(scan_input(run, *job, 2)).file == scene.paths[2]);
  CHECK(in_parts(scene, 2, run, false) == at_once(scene, folder.file("whole.rgs")));
}

TEST_CASE("an input whose header changes before it is scanned is named: the job holds what it declared") {
  const TemporaryFolder folder;
  const Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  REQUIRE(begin_parts(run, job_of(scene, 2), false));
  const auto job = open_job(run);
  Bytes changed = read_bytes(scene.paths[0]);
  changed[5000] ^= std::byte{1};
  write_file(scene.paths[0], changed);
  const Failure failure = failure_of(scan_input(run, *job, 0));
  CHECK(failure.file == scene.paths[0]);
  CHECK(failure.error.code == Errc::read_failed);
  CHECK_FALSE(std::filesystem::exists(run.scan_path(0)));
  CHECK(failure_of(begin_parts(run, job_of(scene, 2), false)).error.code == Errc::output_exists);
}

TEST_CASE("beginning again removes the work's own files and nothing else") {
  const TemporaryFolder folder;
  const PartsRun run = run_in(folder.file("work"));
  std::filesystem::create_directories(run.folder + "/rows.9");
  Scene scene;
  for (const char* name : {"plan.ply", "scan.ply", "scan.1.ply", "planet.ply", "range."}) {
    SplitMix random(scene.paths.size());
    scene.paths.push_back(write_scene(run.folder + "/" + name, plausible_cloud(300, 0, random)));
  }
  scene.placed.resize(scene.paths.size());
  std::vector<std::string> kept = scene.paths;
  for (const char* name :
       {"plans.txt", "range.csv", "scan.1x", "scan.-1", "rows", "replan", "plan.tmp-", "plan.tmp-12345",
        "plan.tmp-1234567", ".tmp-123456", "planet.tmp-123456", "job.1", "job.ply.tmp-123456"}) {
    kept.push_back(run.folder + "/" + name);
    write_file(kept.back(), {std::byte{7}});
  }
  in_parts(scene, 2, run, false);
  std::vector<std::string> made{run.plan_path(), run.scan_path(4), run.rows_path(0), run.range_path(1)};
  for (const std::string& path : made) REQUIRE(std::filesystem::exists(path));
  for (const char* name : {"plan.tmp-aB3456", "job.tmp-123456", "scan.17.tmp-zzzzzz", "rows.40", "range.123"}) {
    made.push_back(run.folder + "/" + name);
    write_file(made.back(), {std::byte{7}});
  }
  std::vector<Bytes> before;
  for (const std::string& path : kept) before.push_back(read_bytes(path));
  scene.encode.sh_degree = 0;
  REQUIRE(begin_parts(run, job_of(scene, 3), true));
  for (const std::string& path : made) {
    CAPTURE(path);
    CHECK_FALSE(std::filesystem::exists(path));
  }
  for (std::size_t i = 0; i < kept.size(); ++i) {
    CAPTURE(kept[i]);
    REQUIRE(std::filesystem::exists(kept[i]));
    CHECK(read_bytes(kept[i]) == before[i]);
  }
  CHECK(std::filesystem::is_directory(run.folder + "/rows.9"));
  // Beginning again removes the plan, whether the job file is lost or the same.
  for (const bool lost : {true, false}) {
    CAPTURE(lost);
    write_file(run.plan_path(), {std::byte{7}});
    if (lost) std::filesystem::remove(run.job_path());
    REQUIRE(begin_parts(run, job_of(scene, 3), true));
    CHECK_FALSE(std::filesystem::exists(run.plan_path()));
  }
}

TEST_CASE("inputs and camera files named like a file of the work are refused and stay") {
  const TemporaryFolder folder;
  const PartsRun run = run_in(folder.file("work"));
  std::filesystem::create_directories(run.folder);
  SplitMix random(1);
  const SplatCloud cloud = plausible_cloud(300, 0, random);
  const std::string link = folder.file("link.ply"), other = write_scene(folder.file("other.ply"), cloud);
  std::filesystem::create_symlink(run.folder + "/range.1", link);
  for (const char* name : {"plan", "scan.0", "rows.12", "range.1", "scan.3.tmp-123456"}) {
    CAPTURE(name);
    const std::string path = write_scene(run.folder + "/" + name, cloud);
    Scene scene;
    scene.paths = {std::string(name) == "range.1" ? link : path};
    scene.placed.resize(1);
    const Bytes before = read_bytes(path);
    PartsJob of_cameras = job_of(scene, 2);
    of_cameras.inputs[0].path = other;
    of_cameras.cameras = path;
    for (const bool overwrite : {false, true}) {
      for (const PartsJob& job : {job_of(scene, 2), of_cameras}) {
        const Failure refused = failure_of(begin_parts(run, job, overwrite));
        CHECK(refused.file == path);
        CHECK(refused.error.code == Errc::bad_argument);
      }
    }
    CHECK(read_bytes(path) == before);
    CHECK_FALSE(std::filesystem::exists(run.job_path()));
    std::filesystem::remove(path);
  }
}

TEST_CASE("files of another version count as missing") {
  const TemporaryFolder folder;
  const Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  const Bytes whole = in_parts(scene, 2, run, false);
  const auto job = open_job(run);
  const auto plan = find_plan(run, *job);
  const auto age = [](const std::string& path) {
    Bytes bytes = read_bytes(path);
    bytes[16] ^= std::byte{1};  // of the version
    const std::uint64_t hash = xxh3(std::span(bytes).first(56));
    std::ranges::copy(std::as_bytes(std::span(&hash, 1)), bytes.begin() + 56);
    write_file(path, bytes);
    CHECK(WorkFile::open(path, WorkKind::plan).error().code == Errc::unsupported_version);
  };
  age(run.range_path(0));
  const Failure assembled = failure_of(assemble_parts(run, *job, **plan, folder.file("no.rgs"), {}));
  CHECK(assembled.file == run.range_path(0));
  CHECK(assembled.error.code == Errc::open_failed);
  age(run.rows_path(1));
  const Failure built = failure_of(build_range(run, *job, **plan, 0));
  CHECK(built.file == run.rows_path(1));
  CHECK(built.error.code == Errc::open_failed);
  age(run.plan_path());
  CHECK_FALSE(find_plan(run, *job).value().has_value());
  REQUIRE(list_parts(run));
  age(run.scan_path(2));
  CHECK_FALSE(find_plan(run, *job).value().has_value());
  const Failure planned = failure_of(make_plan(run, *job));
  CHECK(planned.file == run.scan_path(2));
  CHECK(planned.error.code == Errc::open_failed);
  REQUIRE(list_parts(run));
  const std::string output = folder.file("out.rgs");
  CHECK(all_steps(
            run, [](auto&) {}, output)
            .file.empty());
  CHECK(read_bytes(output) == whole);
  // Everything depends on the job file, so it reports the version itself.
  age(run.job_path());
  CHECK(failure_of(open_job(run)).error.code == Errc::unsupported_version);
  CHECK(failure_of(begin_parts(run, job_of(scene, 2), false)).error.code == Errc::unsupported_version);
  CHECK(in_parts(scene, 2, run, false) == whole);
}

TEST_CASE("a plan records the scans that it was made from") {
  const TemporaryFolder folder;
  const Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  PartsJob wanted = job_of(scene, 2);
  wanted.cameras = folder.file("cameras.json");
  std::ofstream(wanted.cameras) << R"([{"id":0,"img_name":"a","width":640,"height":480,"position":[0,0,-4],)"
                                   R"("rotation":[[1,0,0],[0,1,0],[0,0,1]],"fx":500,"fy":500}])";
  wanted.cameras_hash = options_hash({}, wanted.cameras).value();
  const auto job = begin_parts(run, wanted, false);
  REQUIRE(job);
  for (std::size_t i = 0; i < 4; ++i) REQUIRE(scan_input(run, *job, i));
  const Bytes scan = read_bytes(run.scan_path(3)), original = read_bytes(scene.paths[3]);
  Bytes changed = original;
  changed[changed.size() - 100] ^= std::byte{1};
  write_file(scene.paths[3], changed);
  std::filesystem::remove(run.scan_path(3));
  REQUIRE(scan_input(run, *job, 3));
  const Bytes other = read_bytes(run.scan_path(3));
  REQUIRE(other != scan);
  write_file(scene.paths[3], original);
  write_file(run.scan_path(3), scan);
  // One scan is replaced after all were read, when the cameras' sample begins.
  PartsRun disturbed = run;
  bool is_disturbed = false;
  disturbed.observer.begin = [&](const char* stage, std::uint64_t, const char*) {
    if (std::string(stage) != "sample") return;
    is_disturbed = true;
    write_file(run.scan_path(3), other);
  };
  CHECK(make_plan(disturbed, *job).value());
  CHECK(is_disturbed);
  const auto plan = find_plan(run, *job);
  REQUIRE(plan);
  CHECK_FALSE(plan->has_value());
  write_file(run.scan_path(3), scan);
  CHECK(find_plan(run, *job).value().has_value());
}

TEST_CASE("waiting rows stay within the memory limit, however many bins there are") {
  if (!counts_live_memory()) return skip("the sanitizer replaces the allocator and counts nothing");
  const TemporaryFolder folder;
  PartsPlan plan;
  SplitMix random(5);
  const SplatCloud cloud = plausible_cloud(4000, 1, random);
  plan.scan = SceneScan(1, BadPolicy::drop);
  std::vector<Splat> rows;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) plan.scan.add(rows.emplace_back(cloud.view().splat(i)));
  const std::uint64_t row_bytes = leaf_rows(plan).row_bytes();
  std::vector<std::uint64_t> keys = lod::keys_of(rows, MortonKey(plan.scan.robust()));
  std::ranges::sort(keys);
  constexpr std::size_t kBins = 20;
  for (std::size_t bin = 0; bin < kBins; ++bin) plan.bins.push_back(bin == 0 ? 0 : keys[bin * keys.size() / kBins]);
  // 50 times the same Gaussians, bin by bin, like adjacent tiles: 1 MB each.
  constexpr std::uint64_t kMemory = 8'000'000;
  auto file = WorkWriter::create(folder.file("rows.0"), WorkKind::rows, 0, false);
  REQUIRE(file);
  const std::int64_t before = live_bytes();
  RowsWriter writer(*file, plan, kMemory);
  const std::vector<std::uint32_t> positions(1, 0);
  const MortonKey key(plan.scan.robust());
  std::int64_t most = 0;
  for (std::size_t bin = 0; bin < kBins; ++bin) {
    for (int again = 0; again < 50; ++again) {
      for (const Splat& row : rows) {
        const std::uint64_t k = key(row.mean);
        if (k < plan.bins[bin] || (bin + 1 < kBins && k >= plan.bins[bin + 1])) continue;
        REQUIRE(writer.add(0, positions, std::span(&row, 1)));
      }
    }
    most = std::max(most, live_bytes() - before);
  }
  REQUIRE(rows.size() * 50 * row_bytes > kMemory);
  CHECK(most < static_cast<std::int64_t>(kMemory / 4));
  REQUIRE(writer.finish());
}

TEST_CASE("every byte of every file of the work is checked") {
  const TemporaryFolder folder;
  Scene scene = three_tiles(folder.path());
  scene.encode.keep_permutation = true;
  const PartsRun run = run_in(folder.file("work"));
  in_parts(scene, 2, run, false);
  const auto job = open_job(run);
  const auto plan = find_plan(run, *job);
  // The step that reads the file, after its own output is removed.
  const auto reads = [&](const std::string& path) -> Failure {
    if (path == run.job_path()) return failure_of(open_job(run));
    if (path == run.plan_path() || path == run.scan_path(0)) {
      if (path == run.scan_path(0)) std::filesystem::remove(run.plan_path());
      const Failure planned = path == run.scan_path(0) ? failure_of(make_plan(run, *job)) : Failure{"", {}};
      return planned.file.empty() ? failure_of(find_plan(run, *job)) : planned;
    }
    if (path == run.rows_path(0)) {
      for (std::size_t i = 0; i < 2; ++i) {
        std::filesystem::remove(run.range_path(i));
        if (const Failure built = failure_of(build_range(run, *job, **plan, i)); !built.file.empty()) return built;
      }
      return {"", {}};
    }
    return failure_of(assemble_parts(run, *job, **plan, folder.file("no.rgs"), {.overwrite = true, .sync = false}));
  };
  for (const std::string& path :
       {run.job_path(), run.scan_path(0), run.rows_path(0), run.plan_path(), run.range_path(1)}) {
    CAPTURE(path);
    in_parts(scene, 2, run, false);
    const Bytes whole = read_bytes(path);
    const std::size_t step = std::max<std::size_t>(1, whole.size() / (path == run.rows_path(0) ? 12 : 40));
    for (std::size_t at = 0; at < whole.size(); at += at < 64 ? 7 : step) {
      CAPTURE(at);
      Bytes damaged_bytes = whole;
      damaged_bytes[at] ^= std::byte{4};
      write_file(path, damaged_bytes);
      const Failure failure = reads(path);
      CHECK(failure.file == path);
      damaged_bytes.resize(at);
      write_file(path, damaged_bytes);
      CHECK(reads(path).file == path);
    }
    write_file(path, whole);
    if (path == run.scan_path(0) || path == run.plan_path()) REQUIRE(make_plan(run, *job));
    CHECK(reads(path).file.empty());
  }
}

TEST_CASE("tables with valid hashes that contradict the plan are refused") {
  const TemporaryFolder folder;
  const Scene scene = three_tiles(folder.path());
  const PartsRun run = run_in(folder.file("work"));
  in_parts(scene, 2, run, false);
  const auto job = open_job(run);
  const auto plan = find_plan(run, *job);
  // The file with another table and matching hashes.
  const auto reseal = [&](const std::string& path, WorkKind kind, const std::function<void(nlohmann::json&)>& change) {
    auto file = WorkFile::open(path, kind);
    REQUIRE(file);
    Bytes bytes(file->end() - kWorkHeadBytes);
    REQUIRE(file->read(kWorkHeadBytes, bytes));
    nlohmann::json about = file->about();
    change(about);
    auto writer = WorkWriter::create(path, kind, file->basis(), false);
    REQUIRE(writer->append(bytes));
    REQUIRE(writer->finish(about));
  };
  const Bytes rows = read_bytes(run.rows_path(0));
  const std::vector<std::function<void(std::vector<std::uint64_t>&)>> changes{
      [](auto& t) { t[0] = 1'000'000; }, [](auto& t) { t[1] += 8; },      [](auto& t) { t[1] = ~std::uint64_t{0}; },
      [](auto& t) { t[2] = 0; },         [](auto& t) { t[2] = ~0ULL; },   [](auto& t) { t[2] -= 1; },
      [](auto& t) { t.resize(4); },      [](auto& t) { t.push_back(1); }, [](auto& t) { t.clear(); }};
  for (std::size_t i = 0; i < changes.size(); ++i) {
    CAPTURE(i);
    reseal(run.rows_path(0), WorkKind::rows, [&](nlohmann::json& about) {
      auto table = unpack_numbers<std::uint64_t>(about["blocks"]);
      changes[i](*table);
      about["blocks"] = pack_numbers(std::span<const std::uint64_t>(*table));
    });
    std::filesystem::remove(run.range_path(0));
    const Failure failure = failure_of(build_range(run, *job, **plan, 0));
    CHECK(failure.file == run.rows_path(0));
    CHECK(failure.error.code == Errc::bad_value);
    write_file(run.rows_path(0), rows);
  }
  for (const auto& value : {nlohmann::json(), nlohmann::json(3), nlohmann::json::binary({1, 2, 3})}) {
    reseal(run.rows_path(0), WorkKind::rows, [&](nlohmann::json& about) { about["blocks"] = value; });
    CHECK(failure_of(build_range(run, *job, **plan, 0)).error.code == Errc::bad_value);
    write_file(run.rows_path(0), rows);
  }
  REQUIRE(build_range(run, *job, **plan, 0));

  const Bytes range = read_bytes(run.range_path(1));
  const std::vector<std::function<void(std::vector<std::uint32_t>&)>> page_changes{
      [](auto& w) { w[0] ^= 1; },  [](auto& w) { w[3] = 0; },         [](auto& w) { w[3] += 1; },
      [](auto& w) { w[17] += 1; }, [](auto& w) { w[17] = ~0U; },      [](auto& w) { w[17] = 0; },
      [](auto& w) { w.clear(); },  [](auto& w) { w.resize(17); },     [](auto& w) { w.resize(18); },
      [](auto& w) { w[16] = 7; },  [](auto& w) { w[4] = 0x7FC00000; }};
  for (std::size_t level = 0; level < 2; ++level) {
    for (std::size_t i = 0; i < page_changes.size(); ++i) {
      CAPTURE(level);
      CAPTURE(i);
      if (i == 9 && level > 0) continue;  // a page's error of 1e-44 is as valid as any other nonzero one
      reseal(run.range_path(1), WorkKind::range, [&](nlohmann::json& about) {
        nlohmann::json& pages = about["stretches"][0]["levels"][level]["pages"];
        auto words = unpack_numbers<std::uint32_t>(pages);
        page_changes[i](*words);
        pages = pack_numbers(std::span<const std::uint32_t>(*words));
      });
      CHECK_FALSE(assemble_parts(run, *job, **plan, folder.file("no.rgs"), {}));
      write_file(run.range_path(1), range);
    }
  }
  const std::vector<std::function<void(nlohmann::json&)>> about_changes{
      [](auto& j) { j["stretches"].erase(0); },
      [](auto& j) { j["stretches"][0]["tops"][0] = ~0ULL; },
      [](auto& j) { j["stretches"][0]["tops"][1] = 0; },
      [](auto& j) { j["stretches"][0]["tops"][1] = ~0ULL; },
      [](auto& j) { j["stretches"][0]["levels"].erase(1); },
      [](auto& j) { j.erase("stretches"); },
      [](auto& j) { j["stretches"][0]["levels"] = {}; },
      [](auto& j) { j["stretches"][0]["levels"][0]["offset"] = ~0ULL; }};
  for (std::size_t i = 0; i < about_changes.size(); ++i) {
    CAPTURE(i);
    reseal(run.range_path(1), WorkKind::range, about_changes[i]);
    const Failure failure = failure_of(assemble_parts(run, *job, **plan, folder.file("no.rgs"), {}));
    CHECK(failure.file == run.range_path(1));
    write_file(run.range_path(1), range);
  }
  CHECK_FALSE(std::filesystem::exists(folder.file("no.rgs")));
  CHECK(failure_of(assemble_parts(run, *job, **plan, folder.file("yes.rgs"), {.sync = false})).file.empty());
}

TEST_CASE("damage is treated as requested, and an empty scene is an error") {
  const TemporaryFolder folder;
  Scene scene = three_tiles(folder.path());
  scene.encode.on_bad = BadPolicy::refuse;
  const PartsRun run = run_in(folder.file("work"));
  REQUIRE(begin_parts(run, job_of(scene, 2), false));
  const Failure refused = all_steps(
      run, [](auto&) {}, folder.file("no.rgs"));
  CHECK(refused.file == scene.paths[2]);
  CHECK(refused.error.code == Errc::bad_value);
  CHECK(refused.error.offset < std::filesystem::file_size(scene.paths[2]));

  scene.paths = {scene.paths[1]};
  scene.placed.resize(1);
  REQUIRE(begin_parts(run, job_of(scene, 1), true));
  const Failure empty = all_steps(
      run, [](auto&) {}, folder.file("no.rgs"));
  CHECK(empty.file == scene.paths[0]);
  CHECK(empty.error.code == Errc::bad_argument);
}

TEST_CASE("more Gaussians in one bin than memory holds is an error") {
  const TemporaryFolder folder;
  SplitMix random(3);
  SplatCloud cloud = plausible_cloud(20'000, 0, random);
  for (std::uint64_t i = 0; i < 15'000; ++i) std::copy_n(&cloud.mean[3 * 17'000], 3, &cloud.mean[3 * i]);
  Scene scene;
  scene.paths = {write_scene(folder.file("a.ply"), cloud)};
  scene.placed.resize(1);
  PartsRun run = run_in(folder.file("work"));
  run.memory_bytes = 4'000'000;
  REQUIRE(begin_parts(run, job_of(scene, 2), false));
  CHECK(all_steps(
            run, [](auto&) {}, folder.file("no.rgs"))
            .error.code == Errc::limit_exceeded);
  run.memory_bytes = 400'000'000;
  CHECK(all_steps(
            run, [](auto&) {}, folder.file("yes.rgs"))
            .file.empty());
}

TEST_CASE("a process chooses its work by numbers") {
  CHECK(parse_selection("all")->last == ~std::size_t{0});
  CHECK(parse_selection("none")->last < parse_selection("none")->first);
  CHECK(parse_selection("4")->first == 4);
  CHECK(parse_selection("4")->last == 4);
  CHECK(parse_selection("4-7")->last == 7);
  CHECK(parse_selection("4-7")->is_part);
  for (const char* text : {"", "-", "x", "4-", "-4", "7-4", "4-7x", "4 ", " 4", "99999999999999999999"}) {
    CAPTURE(text);
    CHECK_FALSE(parse_selection(text));
  }
  for (std::size_t n = 0; n < 9; ++n) {
    std::size_t next = 0;
    for (std::size_t range = 0; range < 4; ++range) {
      const StretchRange of = stretches_of_range(n, range, 4);
      CHECK(of.first == next);
      CHECK(of.last - of.first <= n / 4 + 1);
      next = of.last;
    }
    CHECK(next == n);
  }
}
