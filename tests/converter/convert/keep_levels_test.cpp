// keep_levels_test.cpp - a file's own levels of detail become levels of an .rgs: round trips, lacking levels, trees.
// SPDX-License-Identifier: Apache-2.0
#include "keep_levels.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>
#include <new>
#include <nlohmann/json.hpp>
#include <set>

#include "check_error.hpp"
#include "convert.hpp"
#include "convert_scenes.hpp"
#include "counted_memory.hpp"
#include "interchange_samples.hpp"
#include "lcc_samples.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "trivial_levels.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using nlohmann::json;

ProgramResult rgs_convert(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync", "--overwrite"});
  return run_program(arguments);
}

// Gaussians of a level as sorted numbers: means above the leaves are rounded to their error, all else to FP16.
struct Sorted {
  std::vector<float> x, opacity;
};
Sorted sorted(const SplatCloud& cloud) {
  Sorted out;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    out.x.push_back(cloud.mean[3 * i]);
    out.opacity.push_back(opacity_from_logit(cloud.opacity_logit[i]));
  }
  std::ranges::sort(out.x);
  std::ranges::sort(out.opacity);
  return out;
}
void check_same(const SplatCloud& a, const SplatCloud& b, double rounding) {
  REQUIRE(a.size() == b.size());
  const Sorted left = sorted(a), right = sorted(b);
  double x = 0, opacity = 0;
  for (std::size_t i = 0; i < left.x.size(); ++i) {
    x = std::max(x, std::abs(static_cast<double>(left.x[i]) - static_cast<double>(right.x[i])));
    opacity = std::max(opacity, std::abs(static_cast<double>(left.opacity[i]) - static_cast<double>(right.opacity[i])));
  }
  CHECK(x <= rounding);
  CHECK(opacity <= 1e-3);
}

SplatCloud level_of(const std::string& path, std::uint32_t level) {
  ReadOptions options;
  options.level_of_detail = level;
  const auto file = read_splats(path, options);
  REQUIRE(file);
  return file->cloud;
}

// Pages against their children, as rgs-info --verify --levels does.
std::size_t count_refuted(const PagedFile& file) {
  std::size_t refuted = 0;
  for (std::uint32_t i = 0; i < file.n_pages(); ++i) {
    const lod::Page& page = file.pages()[i];
    std::vector<std::uint32_t> children;
    for (std::uint32_t k = 0; k < page.n_children; ++k) children.push_back(page.first_child + k);
    if (children.empty()) continue;
    const SplatCloud finer = read_pages(file, children).value(), coarser = read_pages(file, std::array{i}).value();
    refuted += lod::error_against(finer.view(), coarser.view(), page.error) > lod::kErrorTolerance * page.error;
  }
  return refuted;
}

// A streamed SOG's files: level 0 of `fine` Gaussians and level 1 of `coarse`, in regions of these runs: level, offset,
// count.
struct Run {
  int level, offset, count;
};
std::string streamed_sog(const TemporaryFolder& folder, const SplatCloud& fine, const SplatCloud& coarse,
                         const std::vector<std::vector<Run>>& regions) {
  json meta{{"version", 1}, {"lodLevels", 3}, {"filenames", {"0_0/meta.json", "1_0/meta.json"}}};
  for (const auto& runs : regions) {
    json lods = json::object();
    for (const Run& run : runs)
      lods[std::to_string(run.level)] = {
          {"file", run.level == 0 ? 0 : 1}, {"offset", run.offset}, {"count", run.count}};
    meta["tree"]["children"].push_back({{"lods", lods}});
  }
  for (const auto& [name, cloud] : {std::pair("0_0", &fine), std::pair("1_0", &coarse)}) {
    Bytes rgs;
    EncodeOptions options;
    options.profile = Profile::direct;
    options.chunk_size = 64;
    REQUIRE(write_levels(trivial_levels(*cloud, {.chunk_size = 64, .page_chunks = 200}), options, rgs));
    const auto file = PagedFile::open(rgs);
    REQUIRE(file);
    const std::string to = name;
    REQUIRE(write_streamed_sog(*file, {}, 3, [&](const std::string& path, std::span<const std::byte> bytes) {
      if (!path.starts_with("0_0/")) return Status();
      std::filesystem::create_directories(folder.path() / to);
      write_bytes(folder.file(to + path.substr(3)), bytes);
      return Status();
    }));
  }
  const std::string path = folder.file("lod-meta.json");
  write_bytes(path, bytes_of(meta.dump()));
  return path;
}

// Converts to the last of these, an .rgs whose levels are kept, and returns it.
Bytes keep(const std::vector<std::string>& arguments) {
  const ProgramResult run = rgs_convert(arguments);
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  CHECK(run.out.find("not kept") == std::string::npos);
  Bytes bytes = read_bytes(arguments.back());
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  CHECK(validate(*file));
  return bytes;
}

}  // namespace

TEST_CASE("levels of an .rgs survive a streamed SOG") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(30000, 1, 3);
  for (float& x : cloud.mean) x *= 8;              // several regions, which are at most 16 units wide ...
  for (float& x : cloud.log_scale) x = x / 4 - 2;  // ... if they hold more than a few Gaussians
  for (std::size_t i = 0; i < 900; ++i) cloud.mean[i] *= 40, cloud.log_scale[i] += 4;  // floaters
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), own = folder.file("own.rgs"),
                    ssog = folder.file("scene.ssog"), kept = folder.file("kept.rgs"), again = folder.file("again.rgs");
  REQUIRE(rgs_convert({"--lod", ply, own}).exit_code == 0);
  REQUIRE(rgs_convert({own, ssog}).exit_code == 0);
  const Bytes bytes = keep({"--keep-permutation", ssog, kept});
  const auto file = PagedFile::open(bytes);
  const std::uint32_t n_levels = read_splats(ssog)->n_levels;
  CHECK(n_levels > 1);
  CHECK(file->n_levels() >= n_levels);
  for (std::uint32_t level = 0; level < n_levels; ++level) {
    CAPTURE(level);
    float error = 0;
    for (const lod::Page& page : file->pages()) error = std::max(error, page.level == level ? page.error : 0);
    check_same(level_of(kept, level), level_of(ssog, level), static_cast<double>(error));
  }
  CHECK(count_refuted(*file) == 0);
  // Positions are those in what is read of the streamed SOG without levels.
  const auto leaves = read_splats(bytes, kKeepAxes), source = read_splats(ssog);
  REQUIRE(leaves);
  REQUIRE(leaves->source_index.size() == 30000);
  std::size_t moved = 0;
  for (std::size_t i = 0; i < 30000; ++i)
    moved += leaves->cloud.mean[3 * i] != source->cloud.mean[3 * leaves->source_index[i]];
  CHECK(moved == 0);
  // Neither threads nor memory change it.
  for (const std::vector<std::string>& options :
       {std::vector<std::string>{"--threads", "1"}, {"--memory", "128MiB", "--scratch", folder.path().string()}}) {
    std::vector<std::string> arguments{"--keep-permutation", ssog, again};
    arguments.insert(arguments.begin(), options.begin(), options.end());
    REQUIRE(rgs_convert(arguments).exit_code == 0);
    CHECK(read_bytes(again) == bytes);
  }
  CHECK(rgs_convert({"--profile", "archive:high", ssog, again}).exit_code == 0);
  CHECK(has_levels(read_bytes(again)));
  // What changes or chooses Gaussians takes the finest level, and says so; --lod builds levels of it.
  for (const std::vector<std::string>& options :
       {std::vector<std::string>{"--min-opacity", "0.1"}, {"--translate", "1,0,0"}, {"--keep-order"}}) {
    std::vector<std::string> arguments{ssog, again};
    arguments.insert(arguments.begin(), options.begin(), options.end());
    const ProgramResult finest = rgs_convert(arguments);
    CHECK(finest.out.find("not kept   levels of detail but the finest") != std::string::npos);
    CHECK_FALSE(has_levels(read_bytes(again)));
  }
  REQUIRE(rgs_convert({"--level-of-detail", "1", ssog, again}).exit_code == 0);
  CHECK_FALSE(has_levels(read_bytes(again)));
  REQUIRE(rgs_convert({"--lod", ssog, again}).exit_code == 0);
  CHECK(read_bytes(again) != bytes);
  CHECK(rgs_convert({"--memory", "1GiB", ssog, folder.file("no.ply")}).exit_code == 2);
}

TEST_CASE("levels of an .rgs survive a tileset, with its origin") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(60000, 1, 3);
  for (float& x : cloud.mean) x *= 8;
  for (float& x : cloud.log_scale) x = x / 4 - 2;
  for (std::size_t i = 0; i < 900; ++i) cloud.mean[i] *= 40, cloud.log_scale[i] += 4;  // floaters
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), own = folder.file("own.rgs"),
                    tiles = folder.file("tileset.json"), kept = folder.file("kept.rgs"),
                    again = folder.file("again.rgs");
  REQUIRE(rgs_convert({"--lod", "--translate", "4200000.125,0,0", "--crs", "EPSG:4978", ply, own}).exit_code == 0);
  REQUIRE(rgs_convert({own, tiles}).exit_code == 0);
  const Bytes bytes = keep({tiles, kept});
  const auto file = PagedFile::open(bytes);
  const auto source = read_splats(tiles);
  CHECK(source->n_levels == 3);
  CHECK(file->n_levels() >= 3);
  CHECK(file->head().declarations().crs.text == "EPSG:4978");
  CHECK(read_splats(kept)->origin == source->origin);
  CHECK(source->origin[0] == 4200000.125);
  float error = lod::kMostError;
  for (const lod::Page& page : file->pages()) error = page.level == 1 ? std::min(error, page.error) : error;
  check_same(level_of(kept, 0), level_of(tiles, 0), 0);
  check_same(level_of(kept, 1), level_of(tiles, 1), static_cast<double>(error) * 8);
  // The stated error of a tile; pages of floaters have more.
  double stated = HUGE_VAL;
  const json tree = json::parse(text_of(read_bytes(tiles)));
  for (const json& child : tree["root"]["children"]) stated = std::min(stated, child["geometricError"].get<double>());
  CHECK(stated == 16 * static_cast<double>(error));
  CHECK(count_refuted(*file) == 0);
  REQUIRE(rgs_convert({"--threads", "1", tiles, again}).exit_code == 0);
  CHECK(read_bytes(again) == bytes);
}

TEST_CASE("a tileset of more levels or repeats than are kept is converted without them") {
  const TemporaryFolder folder;
  const std::string tiles = folder.file("tileset.json"), rgs = folder.file("out.rgs");
  const auto convert = [&](int n, const char* refine, const std::vector<std::string>& options = {}) {
    json root;
    for (int i = n; i-- > 0;) {
      const std::string name = std::to_string(i) + ".glb";
      const SplatCloud cloud = ordinary_cloud(10, 0, static_cast<std::uint64_t>(i));
      write_bytes(folder.file(name), *encode_splats(cloud.view(), SplatFormat::glb, {.axes = kAxesGltf}));
      json tile{{"content", {{"uri", name}}}, {"geometricError", n - i}};
      if (i + 1 < n) tile["children"].push_back(std::move(root));
      root = std::move(tile);
    }
    root["refine"] = refine;
    write_bytes(tiles, bytes_of(json{{"asset", {{"version", "1.1"}}}, {"geometricError", 99}, {"root", root}}.dump()));
    std::vector<std::string> arguments{tiles, rgs};
    arguments.insert(arguments.begin(), options.begin(), options.end());
    return rgs_convert(arguments);
  };
  const auto check = [&](const ProgramResult& run, std::uint64_t n, bool is_kept) {
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK((run.out.find("levels of detail are not kept: ") == std::string::npos) == is_kept);
    CHECK(run.out.find("pass --lod") == run.out.rfind("pass --lod"));
    CHECK(has_levels(read_bytes(rgs)) == is_kept);
    CHECK(read_splats(rgs)->cloud.size() == n);
  };
  check(convert(33, "REPLACE"), 10, false);
  check(convert(20, "ADD"), 200, false);
  check(convert(3, "ADD"), 30, true);
  // In memory, which is then not limited.
  CHECK(convert(33, "REPLACE", {"--memory", "1GiB"}).exit_code == 4);
}

TEST_CASE("contents of a tileset that one origin rounds by more than a millimetre get origins of their own") {
  const TemporaryFolder folder;
  const std::string path = folder.file("tileset.json"), out = folder.file("out.rgs");
  write_bytes(folder.file("a"), encode_splats(ordinary_cloud(500, 0, 1).view(), SplatFormat::glb).value());
  json children;
  for (const double x : {0.0, 2e5}) {
    const std::string name = x == 0 ? "b" : "c";
    write_bytes(folder.file(name), encode_splats(ordinary_cloud(2000, 0, 2).view(), SplatFormat::glb).value());
    children.push_back({{"transform", {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1}},
                        {"geometricError", 0},
                        {"content", {{"uri", name}}}});
  }
  json stated{{"asset", {{"version", "1.1"}}}, {"geometricError", 9}};
  stated["root"] = {{"refine", "REPLACE"}, {"geometricError", 9}, {"content", {{"uri", "a"}}}, {"children", children}};
  write_bytes(path, bytes_of(stated.dump()));
  CHECK(rgs_convert({"--profile", "archive:high", path, out}).exit_code == 4);
  REQUIRE(rgs_convert({path, out}).exit_code == 0);
  const auto kept = read_splats(out), source = read_splats(path);
  REQUIRE(kept->cloud.size() == source->cloud.size());
  CHECK(PagedFile::open(read_bytes(out))->n_pages_with_origins() != 0);
  CHECK(kept->position_rounding > 0.001);  // of FP32, without the rests
  double sum = 0;
  for (const SplatFile* file : {&*kept, &*source}) {
    REQUIRE(!file->cloud.mean_rest.empty());
    for (std::size_t i = 0; i < file->cloud.mean.size(); ++i) {
      const double x = static_cast<double>(file->cloud.mean[i]) + static_cast<double>(file->cloud.mean_rest[i]);
      sum += file == &*kept ? x : -x;
    }
  }
  CHECK(std::fabs(sum) < 0.00025 * static_cast<double>(kept->cloud.size()));
  const ProgramResult run = rgs_convert({"--allow-rounding", "--overwrite", path, out});
  CHECK(run.exit_code == 0);
  CHECK(run.out.find("rounded by up to 0.00") != std::string::npos);
  CHECK(has_levels(read_bytes(out)));
}

TEST_CASE("regions are drawn whole, and those of few Gaussians are joined") {
  const TemporaryFolder folder;
  // Three regions side by side, the second without level 0, and two of fewer than a chunk's Gaussians.
  SplatCloud fine = ordinary_cloud(9030, 0, 5), coarse = ordinary_cloud(3000, 0, 6);
  for (SplatCloud* cloud : {&fine, &coarse}) {
    for (float& x : cloud->log_scale) x = x / 4 - 2;
  }
  const std::string path = streamed_sog(folder, fine, coarse,
                                        {{{0, 0, 5000}, {1, 0, 1000}, {2, 2900, 60}},
                                         {{0, 9000, 10}},
                                         {{1, 1000, 1000}},
                                         {{0, 9010, 20}, {1, 2960, 40}},
                                         {{0, 5000, 4000}, {2, 2000, 900}}});
  const std::string rgs = folder.file("kept.rgs");
  const ProgramResult run = rgs_convert({"--chunk-size", "64", path, rgs});
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  const Bytes bytes = read_bytes(rgs);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  CHECK(validate(*file));
  const auto read = read_splats(path);
  REQUIRE(read);
  REQUIRE(read->cloud.size() == 10030);
  check_same(level_of(rgs, 0), read->cloud, 0);
  // The first two, 5010 Gaussians, end inside a chunk, which those of the third fill that show least.
  const SplatCloud leaves = level_of(rgs, 0);
  const auto shows = [&](std::uint64_t i) {
    float side[3];
    for (std::size_t k = 0; k < 3; ++k) side[k] = std::exp(leaves.log_scale[3 * i + k]);
    return (side[0] * side[1] + side[1] * side[2] + side[2] * side[0]) * opacity_from_logit(leaves.opacity_logit[i]);
  };
  float most = 0, least = shows(5056);
  for (std::uint64_t i = 5010; i < 5056; ++i) most = std::max(most, shows(i));
  for (std::uint64_t i = 5056; i < 6010; ++i) least = std::min(least, shows(i));
  CHECK(most <= 1.01F * least);
  // Lacking levels are the next finer ones.
  std::uint64_t n[3] = {};
  std::map<std::vector<float>, std::set<float>> errors;  // of regions, by their cores
  for (const lod::Page& page : file->pages()) {
    if (page.level < 3) n[page.level] += page.count;
    if (page.level == 0 || page.level > 2) continue;
    std::vector<float> core{static_cast<float>(page.level)};
    core.insert(core.end(), page.core.min.begin(), page.core.min.end());
    core.insert(core.end(), page.core.max.begin(), page.core.max.end());
    errors[core].insert(page.error);
  }
  CHECK(n[0] == 10030);
  CHECK(n[1] == 1000 + 10 + 1000 + 40 + 4000);
  CHECK(n[2] == 60 + 10 + 1000 + 40 + 900);
  CHECK(errors.size() == 2 * 4);  // the second is joined to the first
  for (const auto& [core, of_region] : errors) CHECK(of_region.size() == 1);
  // A page of large floaters, which are lost above, has an error of its own, so that a check does not refute it.
  for (std::uint64_t i = 0; i < 9030; ++i) {
    const bool floats = i % 60 == 0;
    for (std::size_t k = 0; k < 3 && floats; ++k) fine.mean[3 * i + k] += 300, fine.log_scale[3 * i + k] += 4;
    if (i % 3 != 0 || i / 3 >= 3000) continue;
    Splat s = fine.view().splat(i);
    for (float& x : s.log_scale) x += floats ? -4 : 0.5F;
    coarse.set(i / 3, s);
  }
  const std::string one = streamed_sog(folder, fine, coarse, {{{0, 0, 9030}, {1, 0, 3000}}});
  REQUIRE(rgs_convert({"--chunk-size", "64", one, rgs}).exit_code == 0);
  const Bytes floaters = read_bytes(rgs);
  CHECK(count_refuted(PagedFile::open(floaters).value()) == 0);
  // Repeats of leaves, which are whole chunks, have errors of their own too.
  const std::string repeated = streamed_sog(folder, fine, coarse, {{{0, 0, 5000}, {1, 0, 3000}}, {{0, 5000, 4030}}});
  REQUIRE(rgs_convert({"--chunk-size", "4096", repeated, rgs}).exit_code == 0);
  const Bytes leaves_again = read_bytes(rgs);
  CHECK(count_refuted(PagedFile::open(leaves_again).value()) == 0);
  // Equal ones have none, unless they are stored with losses.
  const std::string equal = streamed_sog(folder, fine, coarse, {{{0, 0, 4096}, {1, 0, 3000}}, {{0, 4096, 4934}}});
  for (const std::string profile : {"packed", "archive:high"}) {
    CAPTURE(profile);
    REQUIRE(rgs_convert({"--chunk-size", "4096", "--profile", profile, equal, rgs}).exit_code == 0);
    const Bytes of_profile = read_bytes(rgs);
    const auto opened = PagedFile::open(of_profile);
    REQUIRE(opened);
    float error = 1;
    for (const lod::Page& page : opened->pages()) error = page.level == 1 ? std::min(error, page.error) : error;
    CHECK((error < 1e-30F) == (profile == "packed"));
  }
  // Nothing else than a region without Gaussians.
  json meta = json::parse(text_of(read_bytes(one)));
  meta["tree"] = {{"children", {{{"lods", json::object()}}}}};
  write_bytes(one, bytes_of(meta.dump()));
  CHECK(rgs_convert({one, rgs}).exit_code == 0);  // no Gaussians, no levels
  CHECK_FALSE(has_levels(read_bytes(rgs)));
}

TEST_CASE("levels of an .rgs survive a .rad") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(20000, 1, 3);
  for (float& x : cloud.log_scale) x = x / 4 - 2;
  for (std::size_t i = 0; i < 900; ++i) cloud.mean[i] *= 40, cloud.log_scale[i] += 4;  // floaters
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), own = folder.file("own.rgs"),
                    rad = folder.file("scene.rad"), kept = folder.file("kept.rgs"), again = folder.file("again.rgs");
  REQUIRE(rgs_convert({"--lod", ply, own}).exit_code == 0);
  REQUIRE(rgs_convert({own, rad}).exit_code == 0);
  const std::uint32_t n_levels = read_splats(rad)->n_levels - 1;  // without the one Gaussian above all
  CHECK(n_levels > 2);
  // Chunks of which a page holds fewer than a region do not change that one page is drawn with all below it.
  for (const std::string chunk_size : {"256", "32"}) {
    CAPTURE(chunk_size);
    const ProgramResult run = rgs_convert({"--keep-permutation", "--chunk-size", chunk_size, rad, kept});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(run.out.find("not kept") == std::string::npos);
    const Bytes bytes = read_bytes(kept);
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    CHECK(validate(*file));
    CHECK(file->n_levels() == n_levels);
    for (std::uint32_t level = 0; level < n_levels; ++level) {
      CAPTURE(level);
      float error = 0, least = std::numeric_limits<float>::max();
      for (const lod::Page& page : file->pages()) {
        if (page.level != level) continue;
        error = std::max(error, page.error), least = std::min(least, page.error);
      }
      check_same(level_of(kept, level), level_of(rad, level), static_cast<double>(error));
      if (level == 1) CHECK(least < 3);  // the scene is 16 units wide
    }
    CHECK(count_refuted(*file) == 0);
    const auto leaves = read_splats(bytes, kKeepAxes), source = read_splats(rad);
    REQUIRE(leaves);
    REQUIRE(leaves->source_index.size() == 20000);
    std::size_t moved = 0;
    for (std::size_t i = 0; i < 20000; ++i)
      moved += leaves->cloud.mean[3 * i] != source->cloud.mean[3 * std::size_t{leaves->source_index[i]}];
    CHECK(moved == 0);
    REQUIRE(rgs_convert({"--threads", "1", "--memory", "128MiB", "--scratch", folder.path().string(),
                         "--keep-permutation", "--chunk-size", chunk_size, rad, again})
                .exit_code == 0);
    CHECK(read_bytes(again) == bytes);
  }
  REQUIRE(rgs_convert({"--level-of-detail", "1", rad, again}).exit_code == 0);
  CHECK_FALSE(has_levels(read_bytes(again)));
  const ProgramResult piped = run_shell("'" + built("rgs-convert") + "' --overwrite - '" + again + "' < '" + rad + "'");
  CHECK(piped.exit_code == 0);
  CHECK(has_levels(read_bytes(again)));
  // Without a tree there are no levels to keep.
  REQUIRE(rgs_convert({ply, rad}).exit_code == 0);
  REQUIRE(rgs_convert({rad, again}).exit_code == 0);
  CHECK_FALSE(has_levels(read_bytes(again)));
}

TEST_CASE("levels of an LCC become levels of an .rgs") {
  const TemporaryFolder folder;
  std::vector<SplatCloud> cells{ordinary_cloud(4000, 3, 1), ordinary_cloud(3, 3, 2), ordinary_cloud(2000, 3, 3)};
  for (SplatCloud& cell : cells) {
    for (float& x : cell.log_scale) x = x / 4 - 1;
  }
  auto files = lcc(cells);
  json meta = json::parse(text_of(files.at("a.lcc")));
  meta["splats"] = {6003, 1500, 1500};
  files["a.lcc"] = bytes_of(meta.dump());
  for (const auto& [name, bytes] : files) write_bytes(folder.file(name), bytes);
  const std::string rgs = folder.file("a.rgs");
  const Bytes bytes = keep({folder.file("a.lcc"), rgs});
  const auto file = PagedFile::open(bytes);
  std::uint64_t n[3] = {};
  for (const lod::Page& page : file->pages())
    n[std::min<std::uint32_t>(page.level, 2)] += page.level < 3 ? page.count : 0;
  CHECK(n[0] == 6003);
  CHECK(n[1] == 1500 + 3);  // the second cell has no other level
  CHECK(n[2] == 1500 + 3);
  check_same(level_of(rgs, 0), read_splats(folder.file("a.lcc"))->cloud, 0);
  // What comes by standard input has no files beside it, whatever the current folder holds.
  const ProgramResult piped = run_shell("cd '" + folder.path().string() + "' && '" + built("rgs-convert") +
                                        "' --overwrite - piped.rgs < a.lcc");
  CHECK(piped.exit_code == 4);
  // A coordinate reference system runs along the axes of the .lcc.
  const std::string placed = folder.file("placed.rgs");
  REQUIRE(rgs_convert({"--crs", "EPSG:25832", folder.file("a.lcc"), placed}).exit_code == 0);
  const Bytes of_placed = read_bytes(placed);
  CHECK(PagedFile::open(of_placed)->head().declarations().crs == Crs{"EPSG:25832", kAxesLcc});
  // Damaged Gaussians above the leaves are treated as others are: level 1 of the first cell lies after 4000 Gaussians.
  const auto convert_damaged = [&](std::size_t n_damaged, const std::vector<std::string>& options) {
    Bytes data = files.at("data.bin");
    for (std::size_t i = 0; i < n_damaged; ++i) put(data, 32 * (4000 + i), std::numeric_limits<float>::quiet_NaN());
    write_bytes(folder.file("data.bin"), data);
    std::vector<std::string> arguments{folder.file("a.lcc"), rgs};
    arguments.insert(arguments.begin(), options.begin(), options.end());
    return rgs_convert(arguments);
  };
  CHECK(convert_damaged(30, {}).out.find("30 damaged Gaussians of coarser levels dropped") != std::string::npos);
  CHECK(convert_damaged(31, {}).exit_code == 4);
  CHECK(convert_damaged(31, {"--on-bad", "drop"}).exit_code == 0);
  CHECK(convert_damaged(1, {"--on-bad", "refuse"}).exit_code == 4);
  CHECK(convert_damaged(1, {"--strict"}).exit_code == 4);
}

TEST_CASE("levels of an LCC2 become levels of an .rgs") {
  const TemporaryFolder folder;
  SplatCloud fine = ordinary_cloud(6000, 1, 1), coarse;
  for (float& x : fine.log_scale) x = x / 4 - 1;
  coarse.resize(1500, 1);
  for (std::uint64_t i = 0; i < 1500; ++i) coarse.set(i, fine.view().splat(4 * i));
  const auto node = [](int file, int start, int count) {
    return json{{"data", {{"3dgs", {{"name", file}, {"start", start}, {"count", count}}}}}};
  };
  json above = node(1, 0, 1500);
  above["child"] = {{"0", node(0, 0, 4000)}, {"1", node(0, 4000, 2000)}};
  const json meta = {{"lodSplats", {6000, 1500}},
                     {"totalLevels", 2},
                     {"splatType", ".spz"},
                     {"root", {{"splatFiles", {"0.spz", "1.spz"}}, {"child", {above}}}}};
  write_bytes(folder.file("a.lcc2"), bytes_of(meta.dump()));
  write_bytes(folder.file("0.spz"), encode_splats(fine.view(), SplatFormat::spz).value());
  write_bytes(folder.file("1.spz"), encode_splats(coarse.view(), SplatFormat::spz).value());
  const std::string rgs = folder.file("a.rgs");
  const Bytes bytes = keep({folder.file("a.lcc2"), rgs});
  const auto file = PagedFile::open(bytes);
  CHECK(count_refuted(*file) == 0);
  CHECK(file->head().declarations().axes == kAxes3dgs);
  for (std::uint32_t level = 0; level < 2; ++level) {
    float error = 0;
    for (const lod::Page& page : file->pages()) error = std::max(error, page.level == level ? page.error : 0);
    check_same(level_of(rgs, level), level_of(folder.file("a.lcc2"), level), static_cast<double>(error));
  }
  REQUIRE(rgs_convert({"--level-of-detail", "1", folder.file("a.lcc2"), rgs}).exit_code == 0);
  CHECK(read_splats(rgs)->cloud.size() == 1500);
}

TEST_CASE("a tree of nodes with several children, stated errors and damaged Gaussians") {
  SplatCloud cloud = ordinary_cloud(2000, 0, 9);
  LevelTree tree;
  tree.nodes = {{1, LevelTree::kNoParent, 300, 1e4F},
                {0, 0, 1000},
                {0, 0, 900},
                {0, LevelTree::kNoParent, 100},
                {0, LevelTree::kNoParent, 1}};
  tree.file.format = SplatFormat::ssog;
  tree.read = [&](const LevelTree::Visit& visit) -> Status {
    for (std::uint32_t node = 0; node < tree.nodes.size(); ++node) {
      SplatFile piece;
      piece.cloud.resize(tree.nodes[node].n, 0);
      for (std::uint64_t i = 0; i < tree.nodes[node].n; ++i)
        piece.cloud.set(i, cloud.view().splat((i + 400 * node) % cloud.size()));
      if (node == 4) piece.cloud.mean[0] = std::numeric_limits<float>::quiet_NaN();
      if (Status s = visit(node, std::move(piece)); !s) return s;
    }
    return {};
  };
  const TemporaryFolder folder;
  ConvertOptions options;
  options.encode.chunk_size = 64;
  options.encode.axes = kAxes3dgs;
  options.output.sync = false;
  const auto convert = [&]() -> Result<ConvertSummary> {
    const auto kept = KeptLevels::open(tree, kAxes3dgs, options.encode);
    REQUIRE(kept);
    StreamFacts facts;
    facts.hash = [] { return 0; };
    facts.arrange = [&](auto&... of) { return kept->arrange(of...); };
    return convert_to_levels(kept->leaves(), facts, folder.file("tree.rgs"), options);
  };
  const auto summary = convert();
  REQUIRE(summary);
  CHECK(summary->n_source == 2001);
  CHECK(summary->n_written == 2000);
  const Bytes bytes = read_bytes(folder.file("tree.rgs"));
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  CHECK(validate(*file));
  std::uint64_t n = 0;
  for (const lod::Page& page : file->pages()) {
    if (page.level != 1) continue;
    n += page.count;
    CHECK((page.error == 1e4F || page.count == 100));
  }
  CHECK(n == 300 + 100);
  // One that a check would refute does not hold.
  options.output.overwrite = true;
  tree.nodes[0].error = 1e-9F;
  REQUIRE(convert());
  const Bytes mended = read_bytes(folder.file("tree.rgs"));
  CHECK(count_refuted(*PagedFile::open(mended)) == 0);
  tree.nodes[0].error = 1e4F;
  // Levels that no node has are left out.
  tree.nodes[0].level = 31;
  REQUIRE(convert());
  CHECK(read_bytes(folder.file("tree.rgs")) == bytes);
  tree.nodes[0].level = 40;
  CHECK(KeptLevels::open(tree, kAxes3dgs, options.encode).error().code == Errc::unsupported_feature);
  // Levels that one region has are not made of repeats.
  tree.nodes = {{0, LevelTree::kNoParent, 2000}};
  for (std::uint32_t k = 0; k < 7; ++k) tree.nodes.push_back({6 - k, k == 0 ? LevelTree::kNoParent : k, 100});
  CHECK(convert().error().code == Errc::limit_exceeded);
  // They are counted before there are regions, of which each takes some hundred bytes.
  constexpr std::uint32_t kMany = 50'000;
  tree.nodes.resize(1);
  for (std::uint32_t level = 31; level > 0; --level)
    tree.nodes.push_back({level - 1, static_cast<std::uint32_t>(tree.nodes.size() - 1), 1});
  tree.nodes[0] = {31, LevelTree::kNoParent, 1};
  tree.nodes.resize(kMany, {0, LevelTree::kNoParent, 1});
  tree.read = [&](const LevelTree::Visit& visit) -> Status {
    for (std::uint32_t node = 0; node < kMany; ++node) {
      SplatFile piece;
      piece.cloud.resize(1, 0);
      piece.cloud.set(0, cloud.view().splat(0));
      if (Status s = visit(node, std::move(piece)); !s) return s;
    }
    return {};
  };
  const auto kept = KeptLevels::open(tree, kAxes3dgs, options.encode);
  REQUIRE(kept);
  SceneScan scan(3, BadPolicy::drop);
  lod::StreamedLevels levels;
  const std::int64_t before = live_bytes();
  reset_peak_bytes();
  CHECK(kept->arrange(scan, options.encode, {}, levels).error().code == Errc::limit_exceeded);
  if (counts_memory()) CHECK(peak_bytes() - before < 100 * static_cast<std::int64_t>(kMany));
  tree.read = [](const LevelTree::Visit&) -> Status { throw std::bad_alloc(); };
  CHECK(KeptLevels::open(tree, kAxes3dgs, options.encode).error().code == Errc::host_out_of_memory);
}
