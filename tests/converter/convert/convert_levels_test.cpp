// convert_levels_test.cpp - rgs-convert of files with levels of detail: leaves, a level, a cut, a missing end.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <sys/resource.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>

#include "convert_scenes.hpp"
#include "counted_program.hpp"
#include "edit_file.hpp"
#include "interchange_samples.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"
#include "run_program.hpp"
#include "sanitized.hpp"
#include "skip.hpp"
#include "streamed_output.hpp"
#include "temporary_folder.hpp"
#include "trivial_levels.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

ProgramResult rgs_convert(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync", "--overwrite"});
  return run_program(arguments);
}

std::string write_file(const std::string& path, const Bytes& bytes) {
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  return path;
}

// The scene of `plain`, with levels.
Bytes with_levels(const std::string& plain, Profile profile) {
  const Bytes bytes = read_bytes(plain);
  const auto view = FileView::open(bytes);
  REQUIRE(view);
  EncodeOptions options = keep_declarations({}, view->declarations());
  options.provenance = view->provenance();
  options.profile = profile;
  options.chunk_size = view->header().chunk_size;
  std::vector<std::uint32_t> positions;
  if (view->find(SectionType::permutation) != nullptr) {
    for (std::uint64_t i = 0; i < view->header().n_gaussians; ++i) {
      positions.push_back(static_cast<std::uint32_t>(view->source_index(i)));
    }
    options.keep_permutation = true;
    options.source_index = positions;
  }
  Bytes levels;
  const lod::Levels tree =
      trivial_levels(decode(bytes).value(), {.chunk_size = view->header().chunk_size, .page_chunks = 2});
  REQUIRE(write_levels(tree, options, levels));
  return levels;
}

std::uint64_t size_of(const std::string& path) {
  const auto file = read_splats(path);
  REQUIRE(file);
  return file->cloud.size();
}

}  // namespace

TEST_CASE("dropping levels gives the bytes of the conversion without them") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(3000, 3, 1);
  cloud.opacity_logit[5] = std::numeric_limits<float>::quiet_NaN();  // is dropped
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), plain = folder.file("plain.rgs"),
                    back = folder.file("back.rgs");
  for (const Profile profile : {Profile::direct, Profile::packed}) {
    const std::string name = profile == Profile::direct ? "direct" : "packed";
    for (const bool positions : {false, true}) {
      CAPTURE(name);
      CAPTURE(positions);
      std::vector<std::string> options{"--profile", name, "--chunk-size", "64"};
      if (positions) options.emplace_back("--keep-permutation");
      const auto convert = [&](const std::string& from, const std::string& to) {
        std::vector<std::string> arguments = options;
        arguments.insert(arguments.end(), {from, to});
        return rgs_convert(arguments);
      };
      REQUIRE(convert(ply, plain).exit_code == 0);
      const std::string levels = write_file(folder.file("levels.rgs"), with_levels(plain, profile));
      const ProgramResult run = convert(levels, back);
      CAPTURE(run.err);
      REQUIRE(run.exit_code == 0);
      CHECK(read_bytes(back) == read_bytes(plain));
      // The same by number, and in another format.
      REQUIRE(rgs_convert({"--level-of-detail", "0", levels, folder.file("levels.ply")}).exit_code == 0);
      REQUIRE(rgs_convert({plain, folder.file("plain.ply")}).exit_code == 0);
      CHECK(read_bytes(folder.file("levels.ply")) == read_bytes(folder.file("plain.ply")));
      // Changes to the scene are reported.
      REQUIRE(convert(plain, folder.file("again.rgs")).exit_code == 0);
      std::vector<std::string> moved = options;
      moved.insert(moved.end(), {"--translate", "1,0,0", levels, back});
      REQUIRE(rgs_convert(moved).exit_code == 0);
      const Bytes bytes = read_bytes(back);
      CHECK(FileView::open(bytes)->provenance()->tool.find(" from levels.rgs") != std::string::npos);
    }
  }
}

TEST_CASE("--lod adds levels to the Gaussians, which do not change") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(5000, 1, 9);
  cloud.opacity_logit[7] = std::numeric_limits<float>::quiet_NaN();  // is dropped
  cloud.rotation[4 * 8] = std::numeric_limits<float>::quiet_NaN();   // dropped or repaired
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), plain = folder.file("plain.rgs"),
                    levels = folder.file("levels.rgs"), back = folder.file("back.rgs");
  for (const std::vector<std::string>& options :
       {std::vector<std::string>{"--profile", "direct"},
        {"--profile", "packed", "--keep-permutation", "--on-bad", "repair", "--keep-order"}}) {
    const auto convert = [&](std::vector<std::string> arguments) {
      arguments.insert(arguments.begin(), options.begin(), options.end());
      return rgs_convert(arguments);
    };
    REQUIRE(convert({ply, plain}).exit_code == 0);
    const ProgramResult run = convert({"--lod", ply, levels});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(run.out.find("  levels ") != std::string::npos);
    const Bytes bytes = read_bytes(levels);
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    CHECK(file->n_levels() == 2);
    CHECK(file->pages().front().count <= 1250);
    CHECK(validate(*file));
    REQUIRE(convert({levels, back}).exit_code == 0);
    CHECK(read_bytes(back) == read_bytes(plain));
    REQUIRE(convert({"--threads", "1", "--lod", ply, back}).exit_code == 0);
    CHECK(read_bytes(back) == bytes);
  }
  CHECK(rgs_convert({"--lod", ply, folder.file("no.ply")}).exit_code == 2);
  CHECK(rgs_convert({"--lod-quality", "best", ply, folder.file("no.rgs")}).exit_code == 2);
  CHECK(rgs_convert({"--lod", "--backend", "cuda", ply, folder.file("no.rgs")}).exit_code == 2);
  CHECK_FALSE(std::filesystem::exists(folder.file("no.rgs")));
}

TEST_CASE("tiles at their places get levels without being in memory together") {
  const TemporaryFolder folder;
  const std::string a = write_scene(folder.file("a.ply"), ordinary_cloud(4000, 1, 3)),
                    b = write_scene(folder.file("b.ply"), damaged(ordinary_cloud(3000, 2, 4), 700)),
                    c = folder.file("c.spz"), plain = folder.file("plain.rgs"), levels = folder.file("levels.rgs"),
                    back = folder.file("back.rgs");
  REQUIRE(rgs_convert({"--on-bad", "drop", b, c}).exit_code == 0);
  const std::vector<std::vector<std::string>> cases{
      {"--merge", a, b, c},
      {"--merge", "--translate", "1,2,3", "--rotate", "10,20,30", "--scale", "2", a, b},
      {"--merge", "--translate", "0,0,0", "--translate", "4e6,5e5,1", "--translate", "3,0,0", "--allow-rounding", a, b,
       c},
      {"--merge", "--to-axes", "opengl", "--metres-per-unit", "2", "--keep-permutation", c, a},
      {"--translate", "1e7,0,0", "--keep-order", a}};
  for (const auto& arguments : cases) {
    CAPTURE(arguments.back());
    const auto convert = [&](std::vector<std::string> more, const std::string& out) {
      more.insert(more.end(), {"--on-bad", "repair"});
      more.insert(more.end(), arguments.begin(), arguments.end());
      more.push_back(out);
      return rgs_convert(more);
    };
    REQUIRE(convert({}, plain).exit_code == 0);
    const ProgramResult run = convert({"--lod"}, levels);
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    std::vector<std::string> leaves{"--allow-rounding", levels, back};
    for (const char* option : {"--keep-permutation", "--keep-order"}) {
      if (std::ranges::find(arguments, option) != arguments.end()) leaves.insert(leaves.begin(), option);
    }
    REQUIRE(rgs_convert(leaves).exit_code == 0);
    CHECK(read_bytes(back) == read_bytes(plain));
    const Bytes bytes = read_bytes(levels);
    REQUIRE(
        convert({"--lod", "--threads", "1", "--memory", "128MiB", "--scratch", folder.file("")}, levels).exit_code ==
        0);
    CHECK(read_bytes(levels) == bytes);
  }
  const ProgramResult missing = rgs_convert({"--merge", "--lod", a, folder.file("missing.ply"), levels});
  CHECK(missing.exit_code == 3);
  CHECK(missing.err.find("missing.ply") != std::string::npos);
  CHECK(rgs_convert({"--lod", "--memory", "100MiB", a, levels}).exit_code == 2);
  CHECK(rgs_convert({"--memory", "1GiB", a, levels}).exit_code == 2);
  CHECK(rgs_convert({"--scratch", folder.file(""), a, levels}).exit_code == 2);
}

TEST_CASE("--lod takes no more than --memory, leaves --scratch empty, and refuses a missing one") {
  if (kSanitized) return;  // sanitizers use more memory
  // 64 MB of Gaussians, 92 bytes each.
  const TemporaryFolder folder, scratch;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(700'000, 1, 3)),
                    levels = folder.file("levels.rgs");
  const ProgramResult none =
      rgs_convert({"--lod", "--memory", "128MiB", "--scratch", scratch.file("missing"), ply, levels});
  CHECK(none.exit_code == 3);
  CHECK(none.err.find("--scratch") != std::string::npos);
  CHECK(none.err.find(scratch.file("missing")) != std::string::npos);
  CHECK_FALSE(std::filesystem::exists(levels));
  const auto peak_bytes = [&](std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync", "--overwrite", "--threads", "2"});
    arguments.insert(arguments.end(), {ply, levels});
    const CountedResult run = run_counted(arguments);
    CAPTURE(run.program.err);
    REQUIRE(run.program.exit_code == 0);
    CHECK(run.peak_bytes > 0);
    return run.peak_bytes;
  };
  for (const char* profile : {"packed", "archive:high"}) {
    CAPTURE(profile);
    CHECK(peak_bytes({"--profile", profile, "--lod", "--memory", "128MiB", "--scratch", scratch.path().string()}) <=
          128 << 20);
    CHECK(std::filesystem::is_empty(scratch.path()));
  }
  // Without levels 64 bytes a Gaussian, and the sample that archives are fitted to.
  CHECK(peak_bytes({"--profile", "archive:high"}) <= 64 * 700'000 + (8 << 20));
}

TEST_CASE("--lod accepts chunks of any size, and colours far beyond those of a picture") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(70'000, 0, 5);
  for (std::size_t k = 0; k < 3000; ++k) cloud.sh[k] = k % 2 == 0 ? 2.7e26F : -1e5F;
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), levels = folder.file("levels.rgs");
  const ProgramResult run = rgs_convert({"--lod", "--chunk-size", "16384", ply, levels});
  CAPTURE(run.err);
  CHECK(run.exit_code == 0);
  // Pages of an archive have half as many Gaussians at most.
  const std::string modest = write_scene(folder.file("modest.ply"), ordinary_cloud(70'000, 0, 5)),
                    archive = folder.file("archive.rgs");
  const ProgramResult lossy =
      rgs_convert({"--lod", "--profile", "archive:small", "--chunk-size", "16384", modest, archive});
  CAPTURE(lossy.err);
  REQUIRE(lossy.exit_code == 0);
  const Bytes bytes = read_bytes(archive);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  CHECK(std::ranges::max(file->pages(), {}, &lod::Page::count).count == 32768);
}

TEST_CASE("--merge takes more inputs than the shell's limit of open files") {
  constexpr rlim_t kOpen = 64, kEnough = 256;
  rlimit limit{};
  if (::getrlimit(RLIMIT_NOFILE, &limit) != 0 || limit.rlim_max < kEnough)
    return skip("the hard limit of open files is below 256");
  limit.rlim_cur = kOpen;
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(50, 0, 6));
  std::vector<std::string> inputs;
  for (int i = 0; i < 100; ++i) {
    inputs.push_back(folder.file("tile" + std::to_string(i) + ".ply"));
    std::filesystem::create_hard_link(ply, inputs.back());
  }
  for (const bool lod : {false, true}) {
    std::vector<std::string> arguments{built("rgs-convert"), "--no-sync", "--merge"};
    if (lod) arguments.emplace_back("--lod");
    arguments.insert(arguments.end(), inputs.begin(), inputs.end());
    const std::string out = folder.file(lod ? "levels.rgs" : "plain.rgs");
    arguments.push_back(out);
    const ProgramResult run = run_program(arguments, [&limit] { ::setrlimit(RLIMIT_NOFILE, &limit); });
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(size_of(out) == 5000);
  }
}

TEST_CASE("--lod accepts floaters at any distance") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(5000, 1, 6);
  for (std::size_t i = 0; i < 300; ++i) cloud.mean[3 * i + i % 3] = 1e37F * (1 + 1e-3F * static_cast<float>(i));
  cloud.mean[1500] = 3e38F;
  cloud.mean[1503] = -3e38F;
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), levels = folder.file("levels.rgs");
  const ProgramResult run = rgs_convert({"--lod", "--on-bad", "refuse", ply, levels});
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  const Bytes bytes = read_bytes(levels);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  CHECK(file->head().header().n_gaussians == 5000);
  CHECK(validate(*file));
}

TEST_CASE("any level, and the finest cut of a number of Gaussians, converts to any format") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(3000, 1, 2)),
                    plain = folder.file("plain.rgs");
  REQUIRE(rgs_convert({"--profile", "direct", "--chunk-size", "64", ply, plain}).exit_code == 0);
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    const Bytes bytes = with_levels(plain, profile);
    const std::string levels = write_file(folder.file("levels.rgs"), bytes);
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    REQUIRE(file->n_levels() == 4);
    for (std::uint32_t level = 0; level < file->n_levels(); ++level) {
      CAPTURE(level);
      std::uint64_t expected = 0;
      for (const lod::Page& page : file->pages()) expected += page.level == level ? page.count : 0;
      for (const char* ending : {"ply", "rgs", "splat", "spz"}) {
        const std::string out = folder.file(std::string("out.") + ending);
        const ProgramResult run = rgs_convert({"--level-of-detail", std::to_string(level), levels, out});
        CAPTURE(run.err);
        REQUIRE(run.exit_code == 0);
        CHECK(size_of(out) == expected);
      }
    }
    const std::string out = folder.file("cut.ply");
    std::uint64_t before = 0;
    for (const std::uint64_t count : {60u, 200u, 1000u, 2999u, 3000u, 100000u}) {
      REQUIRE(rgs_convert({"--max-count", std::to_string(count), levels, out}).exit_code == 0);
      const std::uint64_t n = size_of(out);
      CHECK(n <= count);
      CHECK(n >= before);
      before = n;
    }
    CHECK(before == 3000);
    const ProgramResult none = rgs_convert({"--max-count", "10", levels, out});
    CHECK(none.exit_code == 2);
    CHECK(none.err.find("coarsest level") != std::string::npos);
    CHECK(rgs_convert({"--level-of-detail", "4", levels, out}).exit_code == 2);
  }
  CHECK(rgs_convert({"--level-of-detail", "0", plain, folder.file("no.ply")}).exit_code == 2);
  CHECK(rgs_convert({"--level-of-detail", "1", ply, folder.file("no.rgs")}).exit_code == 2);
  CHECK_FALSE(std::filesystem::exists(folder.file("no.ply")));
}

TEST_CASE("--max-count counts the Gaussians of a file with levels that --crop and --min-opacity keep") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(12000, 1, 7)),
                    plain = folder.file("plain.rgs"), out = folder.file("out.ply"), all = folder.file("all.ply");
  REQUIRE(rgs_convert({"--profile", "direct", "--chunk-size", "64", ply, plain}).exit_code == 0);
  const std::string levels = write_file(folder.file("levels.rgs"), with_levels(plain, Profile::packed));
  const SplatCloud cloud = read_splats(plain).value().cloud;
  std::vector<float> x, opacity;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    x.push_back(cloud.mean[3 * i]);
    opacity.push_back(opacity_from_logit(cloud.opacity_logit[i]));
  }
  std::nth_element(x.begin(), x.begin() + 4000, x.end());
  std::nth_element(opacity.begin(), opacity.begin() + 6000, opacity.end());
  const std::string middle = std::to_string(x[4000]), moved = std::to_string(x[4000] + 500);
  // A third of the scene; the same after moving it far enough for an origin and turning it upside down; half by
  // opacity.
  const std::vector<std::vector<std::string>> filters{
      {"--crop=-1e6,-1e6,-1e6," + middle + ",1e6,1e6"},
      {"--translate=500,0,0", "--crop=-1e6,-1e6,-1e6," + moved + ",1e6,1e6"},
      {"--axes", "opengl", "--to-axes", "3dgs", "--crop=-1e6,-1e6,-1e6," + middle + ",1e6,1e6"},
      {"--min-opacity", std::to_string(opacity[6000])}};
  for (const std::vector<std::string>& filter : filters) {
    CAPTURE(filter.back());
    const auto convert = [&](std::vector<std::string> arguments, const std::string& to) {
      arguments.insert(arguments.end(), filter.begin(), filter.end());
      arguments.insert(arguments.end(), {levels, to});
      const ProgramResult run = rgs_convert(arguments);
      CAPTURE(run.err);
      REQUIRE(run.exit_code == 0);
      return size_of(to);
    };
    // In this tree errors depend on the level: a cut is a level.
    for (const char* level : {"0", "1"}) {
      const std::uint64_t n = convert({"--level-of-detail", level}, all);
      REQUIRE(n > 200);
      CHECK(convert({"--max-count", std::to_string(n)}, out) == n);
      CHECK(read_bytes(out) == read_bytes(all));
    }
  }
}

TEST_CASE("a cut does not read pages whose Gaussians are all dropped") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(3000, 1, 8)),
                    plain = folder.file("plain.rgs"), out = folder.file("out.ply");
  REQUIRE(rgs_convert({"--profile", "direct", "--chunk-size", "64", ply, plain}).exit_code == 0);
  const std::string levels = write_file(folder.file("levels.rgs"), with_levels(plain, Profile::packed));
  const Bytes bytes = read_bytes(levels);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  REQUIRE_FALSE(file->has_source_index());
  ReadOptions options;
  options.max_count = 3000;
  options.page_counts.assign(file->n_pages(), 0);
  CHECK(read_splats(levels, options).value().cloud.size() == 0);
  const std::uint32_t last = lod::pages_of_level(file->pages(), 0).back();
  for (std::uint32_t i = last; i != lod::kNoPage; i = file->pages()[i].parent) options.page_counts[i] = 5;
  for (const std::uint64_t count : {5u, 3000u}) {  // by a cut, and without one
    options.max_count = count;
    CHECK(read_splats(levels, options).value().cloud.size() == file->pages()[last].count);
  }
  options.page_counts.pop_back();
  CHECK(read_splats(levels, options).error().code == Errc::bad_argument);
  // The crop holds the whole coarsest level, and the error says which Gaussians count.
  const ProgramResult none = rgs_convert({"--max-count", "10", "--crop=-1e6,-1e6,-1e6,1e6,1e6,1e6", levels, out});
  CHECK(none.exit_code == 2);
  CHECK(none.err.find("the coarsest level (--crop") != std::string::npos);
}

TEST_CASE("a file whose end is missing converts only the levels that are present") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(3000, 1, 3)),
                    plain = folder.file("plain.rgs"), out = folder.file("out.ply");
  REQUIRE(rgs_convert({"--profile", "direct", "--chunk-size", "64", ply, plain}).exit_code == 0);
  Bytes bytes = with_levels(plain, Profile::packed);
  const auto whole = PagedFile::open(bytes);
  REQUIRE(whole);
  const std::uint32_t first_leaf = lod::pages_of_level(whole->pages(), 0).front();
  const Bytes beginning(bytes.begin(),
                        bytes.begin() + static_cast<std::ptrdiff_t>(whole->stored(first_leaf).offset + 1));
  const std::string part = write_file(folder.file("part.rgs"), beginning);
  const ProgramResult leaves = rgs_convert({part, out});
  CHECK(leaves.exit_code == 6);
  CHECK(leaves.err.find("pages_missing") != std::string::npos);
  CHECK_FALSE(std::filesystem::exists(out));
  REQUIRE(rgs_convert({"--level-of-detail", "1", part, out}).exit_code == 0);
  // A cut uses the present pages.
  REQUIRE(rgs_convert({"--max-count", "2000", part, out}).exit_code == 0);
  CHECK(size_of(out) <= 2000);
  bytes.resize(whole->stored(0).offset + 1);
  CHECK(rgs_convert({"--overwrite", "--max-count", "100", write_file(folder.file("no_root.rgs"), bytes), out})
            .exit_code == 6);
  bytes.resize(300);
  const ProgramResult head = rgs_convert({write_file(folder.file("head.rgs"), bytes), out});
  CHECK(head.exit_code == 4);
}

namespace {

// Names and contents of all files below a folder.
std::map<std::string, Bytes> files_below(const std::string& folder) {
  std::map<std::string, Bytes> files;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(folder)) {
    if (entry.is_regular_file())
      files[entry.path().lexically_relative(folder).string()] = read_bytes(entry.path().string());
  }
  return files;
}

}  // namespace

TEST_CASE("levels become a streamed SOG, a folder or an archive of the same files, and come back") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(5000, 1, 9)),
                    levels = folder.file("levels.rgs"), out = folder.file("out"), meta = out + "/a/lod-meta.json",
                    zip = folder.file("scene.ssog"), back = folder.file("back.rgs");
  REQUIRE(rgs_convert({"--lod", "--chunk-size", "32", ply, levels}).exit_code == 0);
  const ProgramResult run = rgs_convert({levels, meta});
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  CHECK(run.out.find("in 1 regions in all") != std::string::npos);
  const auto files = files_below(out);
  CHECK(files.contains("a/lod-meta.json"));
  CHECK(files.contains("a/0_0/meta.json"));
  CHECK(std::ranges::none_of(files, [](const auto& file) { return file.first.find(".tmp-") != std::string::npos; }));
  REQUIRE(rgs_convert({"--threads", "1", levels, zip}).exit_code == 0);
  const auto from_folder = read_splats(meta), from_zip = read_splats(zip);
  REQUIRE(from_folder);
  REQUIRE(from_zip);
  CHECK(from_folder->cloud.size() == 5000);
  CHECK(from_zip->format == SplatFormat::ssog);
  CHECK(from_zip->cloud.mean == from_folder->cloud.mean);
  CHECK(from_zip->bytes > from_folder->bytes);
  // Python's reader of archives checks all of them.
  CHECK(run_program({"/usr/bin/python3", "-m", "zipfile", "-t", zip}).exit_code == 0);
  REQUIRE(rgs_convert({meta, back}).exit_code == 0);
  CHECK(size_of(back) == 5000);
  REQUIRE(rgs_convert({"--level-of-detail", "1", zip, back}).exit_code == 0);
  CHECK(size_of(back) < 1500);
  // An output may be none of the files that are read.
  CHECK(rgs_convert({meta, out + "/a/0_0/meta.json", "--to", "sog"}).exit_code == 2);
  // What is there is kept unless --overwrite is given, and then has the same bytes.
  CHECK(run_program({built("rgs-convert"), levels, meta}).exit_code == 3);
  std::filesystem::remove(meta);
  const ProgramResult kept = run_program({built("rgs-convert"), levels, meta});
  CHECK(kept.exit_code == 3);
  CHECK(kept.err.find("--overwrite") != std::string::npos);
  CHECK(files_below(out).size() + 1 == files.size());
  REQUIRE(rgs_convert({levels, meta}).exit_code == 0);
  CHECK(files_below(out) == files);
}

TEST_CASE("levels become the tree of a .rad, and edited ones or none a .rad without") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(5000, 1, 9)),
                    levels = folder.file("levels.rgs"), rad = folder.file("scene.rad"), back = folder.file("back.ply");
  REQUIRE(rgs_convert({"--lod", "--chunk-size", "32", ply, levels}).exit_code == 0);
  const ProgramResult run = rgs_convert({levels, rad});
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  CHECK(run.out.find("Gaussians in all") != std::string::npos);
  const auto tree = read_splats(rad);
  REQUIRE(tree);
  CHECK(tree->cloud.size() == 5000);
  CHECK(tree->n_levels > 2);
  REQUIRE(rgs_convert({"--level-of-detail", "1", rad, back}).exit_code == 0);
  CHECK(size_of(back) < 2000);
  for (const std::vector<std::string>& arguments :
       {std::vector<std::string>{"--overwrite", ply, rad}, {"--overwrite", "--crop=-9,-9,-9,9,9,9", levels, rad}}) {
    REQUIRE(rgs_convert(arguments).exit_code == 0);
    const auto flat = read_splats(rad);
    REQUIRE(flat);
    CHECK(flat->cloud.size() == 5000);
    CHECK(flat->n_levels == 0);
  }
  // An output may be none of the files that may be read.
  std::ofstream(folder.file("scene-0.radc")) << "x";
  CHECK(rgs_convert({"--overwrite", rad, folder.file("scene-0.radc"), "--to", "ply"}).exit_code == 2);
}

TEST_CASE("a streamed SOG is refused for scenes without levels and for edits, and leaves nothing") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(600, 0, 9)),
                    plain = folder.file("plain.rgs"), levels = folder.file("levels.rgs"),
                    meta = folder.file("out/lod-meta.json");
  REQUIRE(rgs_convert({ply, plain}).exit_code == 0);
  REQUIRE(rgs_convert({"--lod", "--chunk-size", "32", ply, levels}).exit_code == 0);
  for (const std::vector<std::string>& arguments : {std::vector<std::string>{ply, meta},
                                                    {plain, meta},
                                                    {"--scale", "2", levels, meta},
                                                    {"--min-opacity", "0.5", levels, meta},
                                                    {"--level-of-detail", "0", levels, meta}}) {
    CAPTURE(arguments);
    const ProgramResult run = rgs_convert(arguments);
    CHECK(run.exit_code == 4);
    CHECK(run.err.find("rgs-convert --lod") != std::string::npos);
  }
  CHECK(rgs_convert({"--lod", ply, meta}).exit_code == 2);
  const Bytes whole = read_bytes(levels);
  const std::string cut = write_file(folder.file("cut.rgs"), Bytes(whole.begin(), whole.end() - 100));
  CHECK(rgs_convert({cut, meta}).exit_code == 6);
  CHECK_FALSE(std::filesystem::exists(folder.file("out")));
}

TEST_CASE("a streamed SOG that cannot replace or must not leaves the folder as it was") {
  const TemporaryFolder folder;
  const std::string out = folder.file("out"), meta = out + "/lod-meta.json";
  const Bytes old = bytes_of("old"), content = bytes_of("new");
  // Puts two SOGs and lod-meta.json, meanwhile changes the folder, and commits.
  const auto commit = [&](bool overwrite, const std::function<void()>& meanwhile) {
    auto output = StreamedOutput::create(meta, {.overwrite = overwrite, .sync = false});
    REQUIRE(output);
    for (const char* name : {"0_0/meta.json", "1_0/meta.json", "lod-meta.json"}) REQUIRE(output->put(name, content));
    meanwhile();
    const auto done = output->commit();
    REQUIRE_FALSE(done);
    for (const auto& [name, bytes] : files_below(out)) CHECK((bytes == old || name.find(".tmp-") != name.npos));
    return done.error().code;
  };
  const auto make = [&](const std::string& name) {
    std::filesystem::create_directories(std::filesystem::path(out + "/" + name).parent_path());
    write_file(out + "/" + name, old);
  };
  CHECK(commit(false, [&] { make("1_0/meta.json"); }) == Errc::output_exists);
  std::filesystem::remove_all(out);
  CHECK(commit(false, [&] { make("lod-meta.json"); }) == Errc::output_exists);
  CHECK(read_bytes(meta) == old);
  // A file in place of a SOG's folder, or a folder in place of its file.
  make("0_0/meta.json");
  CHECK(commit(true, [&] { make("1_0"); }) == Errc::write_failed);
  CHECK(read_bytes(meta) == old);
  std::filesystem::remove(out + "/1_0");
  CHECK(commit(true, [&] { make("1_0/meta.json/inside"); }) == Errc::output_unusable);
  CHECK(read_bytes(meta) == old);
}

TEST_CASE("the SOGs of a streamed SOG lie beside its file, where a link leads") {
  const TemporaryFolder folder;
  std::filesystem::create_directories(folder.path() / "scene");
  write_file(folder.file("scene/lod-meta.json"), bytes_of("old"));
  std::filesystem::create_symlink("scene/lod-meta.json", folder.path() / "lod-meta.json");
  auto output = StreamedOutput::create(folder.file("lod-meta.json"), {.overwrite = true, .sync = false});
  REQUIRE(output);
  for (const char* name : {"0_0/meta.json", "lod-meta.json"}) REQUIRE(output->put(name, bytes_of("new")));
  REQUIRE(output->commit());
  CHECK(read_bytes(folder.file("scene/0_0/meta.json")) == bytes_of("new"));
  CHECK(read_bytes(folder.file("scene/lod-meta.json")) == bytes_of("new"));
}

TEST_CASE("tilesets of one folder have tiles of their own") {
  const TemporaryFolder folder;
  std::vector<std::string> tilesets;
  for (const char* name :
       {"tileset.json", "a.tileset.json", "b %:.tileset.json", "a.json", "tiles.json", "tiles_.json"}) {
    const std::string ply = folder.file("scene.ply");
    tilesets.push_back(folder.file(name));
    write_scene(ply, ordinary_cloud(10 * tilesets.size(), 1, 9));
    const ProgramResult run = rgs_convert({"--overwrite", "--to", "tileset.json", ply, tilesets.back()});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
  }
  for (const char* tile : {"tiles/0_0.glb", "a.tileset/0_0.glb", "b %~c.tileset/0_0.glb", "a/0_0.glb"})
    CHECK(std::filesystem::exists(folder.file(tile)));
  // An input stays as it is.
  REQUIRE(rgs_convert({"--crop", "-100,-100,-100,0,100,100", tilesets[1], folder.file("d.tileset.json")}).exit_code ==
          0);
  for (std::size_t i = 0; i < tilesets.size(); ++i) {
    const std::string back = folder.file("back.rgs");
    REQUIRE(rgs_convert({"--overwrite", tilesets[i], back}).exit_code == 0);
    CHECK(size_of(back) == 10 * (i + 1));
  }
}

TEST_CASE("no tile replaces a file that is read") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(10, 1, 9)),
                    tiles = folder.file("e/tileset.json"), tile = folder.file("e/tiles/0_0.glb");
  REQUIRE(rgs_convert({ply, tiles}).exit_code == 0);
  std::filesystem::create_directory_symlink("e", folder.path() / "link");
  const auto before = files_below(folder.file("e"));
  for (const std::string& output : {tiles, folder.file("link/tileset.json")}) {
    const ProgramResult run = rgs_convert({"--crop", "-100,-100,-100,0,100,100", tile, output});
    CAPTURE(run.err);
    CHECK(run.exit_code == 3);
    CHECK(run.err.find("is one that is read") != std::string::npos);
  }
  CHECK(files_below(folder.file("e")) == before);
  REQUIRE(rgs_convert({tiles, folder.file("back.rgs")}).exit_code == 0);
  CHECK(size_of(folder.file("back.rgs")) == 10);
}

TEST_CASE("levels become a tileset, a scene without levels one tile, and both come back") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(5000, 1, 9)),
                    levels = folder.file("levels.rgs"), tiles = folder.file("tiles/tileset.json"),
                    flat = folder.file("flat/tileset.json"), back = folder.file("back.rgs");
  REQUIRE(rgs_convert({"--lod", "--chunk-size", "32", ply, levels}).exit_code == 0);
  const ProgramResult run = rgs_convert({levels, tiles});
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  CHECK(run.out.find("in 1 tiles in all") != std::string::npos);
  CHECK(files_below(folder.file("tiles")).contains("tiles/0_0.glb"));
  REQUIRE(rgs_convert({tiles, back}).exit_code == 0);
  CHECK(size_of(back) == 5000);
  // What changes Gaussians, or a source without levels, gives one tile.
  REQUIRE(rgs_convert({ply, flat}).exit_code == 0);
  CHECK(files_below(folder.file("flat")).size() == 2);
  REQUIRE(rgs_convert({flat, back}).exit_code == 0);
  CHECK(size_of(back) == 5000);
  REQUIRE(rgs_convert({"--level-of-detail", "1", levels, flat}).exit_code == 0);
  REQUIRE(rgs_convert({flat, back}).exit_code == 0);
  CHECK(size_of(back) < 1500);
  // The name is that of a file in a folder; no output is a file that is read.
  CHECK(rgs_convert({"--to", "tileset.json", ply, folder.file("x.ssog")}).exit_code == 2);
  CHECK(rgs_convert({tiles, folder.file("tiles/tiles/0_0.glb"), "--to", "glb"}).exit_code == 2);
  CHECK(run_program({built("rgs-convert"), ply, flat}).exit_code == 3);
}

TEST_CASE("--lod takes each content of a tileset from its own origin") {
  const TemporaryFolder folder;
  const std::string path = folder.file("tileset.json"), built_levels = folder.file("levels.rgs");
  nlohmann::json children;
  for (const double x : {3e6, 3.004e6}) {
    const std::string name = "at " + std::to_string(x);
    SplatCloud cloud = ordinary_cloud(2000, 1, 9);
    write_bytes(folder.file(name), encode_splats(cloud.view(), SplatFormat::glb, {.axes = kAxesGltf}).value());
    children.push_back({{"transform", {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1}}, {"content", {{"uri", name}}}});
  }
  const nlohmann::json stated{
      {"asset", {{"version", "1.1"}}}, {"geometricError", 9}, {"root", {{"refine", "ADD"}, {"children", children}}}};
  write_bytes(path, bytes_of(stated.dump()));
  REQUIRE(rgs_convert({"--lod", "--chunk-size", "32", path, built_levels}).exit_code == 0);
  const auto whole = read_splats(path), kept = read_splats(built_levels);
  REQUIRE(whole);
  REQUIRE(kept);
  CHECK(kept->origin == whole->origin);
  CHECK(kept->n_levels > 1);
  std::vector<float> of_whole = whole->cloud.mean, of_kept = kept->cloud.mean;
  std::ranges::sort(of_whole);
  std::ranges::sort(of_kept);
  CHECK(of_whole == of_kept);
}
