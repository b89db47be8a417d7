// streamed_sog_test.cpp - streamed SOG: levels written and read back, another tool's choices, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <functional>
#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "interchange_samples.hpp"
#include "rgs/level_tree.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/splat_edit.hpp"
#include "temporary_folder.hpp"
#include "trivial_levels.hpp"
#include "zip_samples.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using nlohmann::json;

Bytes rgs_of(const lod::Levels& tree, const EncodeOptions& options = {}, std::uint32_t chunk_size = 32) {
  Bytes bytes;
  EncodeOptions direct = options;
  direct.profile = Profile::direct;
  direct.chunk_size = chunk_size;
  REQUIRE(write_levels(tree, direct, bytes));
  return bytes;
}

Bytes rgs_with_levels(std::uint64_t n, int sh_degree, const EncodeOptions& options = {}) {
  return rgs_of(trivial_levels(ordinary_cloud(n, sh_degree, 5), {.chunk_size = 32, .page_chunks = 2}), options);
}

struct Written {
  Files files;
  LevelsReport report;
};

Written written(const Bytes& rgs, WriteOptions options = {}, int sh_degree = kMaxShDegree) {
  const auto file = PagedFile::open(rgs);
  REQUIRE(file);
  options.axes = file->head().declarations().axes;
  options.origin = file->head().declarations().origin;
  Written out;
  const auto report =
      write_streamed_sog(*file, options, sh_degree, [&](const std::string& name, std::span<const std::byte> bytes) {
        out.files[name] = Bytes(bytes.begin(), bytes.end());
        return Status();
      });
  REQUIRE(report);
  out.report = *report;
  return out;
}

json meta_of(const Files& files) {
  return json::parse(text_of(files.at("lod-meta.json")));
}

ReadOptions level(std::uint32_t wanted) {
  ReadOptions options;
  options.level_of_detail = wanted;
  return options;
}

// Gaussians of the tree's leaves-to-root list of regions, each with its bound.
void for_each_region(const json& node, const std::function<void(const json&)>& visit) {
  if (node.contains("lods")) return visit(node);
  for (const json& child : node["children"]) for_each_region(child, visit);
}

// Three regions in two SOGs: the last one has no level 0.
Files three_regions() {
  const Files first = written(rgs_with_levels(50, 1)).files, second = written(rgs_with_levels(20, 0)).files;
  Files files;
  for (const auto& [name, bytes] : first)
    if (name.starts_with("0_0/")) files[name] = bytes;
  for (const auto& [name, bytes] : second)
    if (name.starts_with("0_0/")) files["1_0/" + name.substr(4)] = bytes;
  const auto run = [](int file, int offset, int count) {
    return json{{"file", file}, {"offset", offset}, {"count", count}};
  };
  json meta{{"version", 1}, {"lodLevels", 2}, {"counts", {50, 20}}, {"filenames", {"0_0/meta.json", "1_0/meta.json"}}};
  meta["tree"]["children"] = {{{"lods", {{"0", run(0, 30, 20)}, {"1", run(1, 0, 5)}}}},
                              {{"children", {{{"lods", {{"0", run(0, 0, 30)}, {"1", run(1, 5, 9)}}}}}}},
                              {{"lods", {{"1", run(1, 14, 6)}, {"0", run(0, 0, 0)}}}}};
  files["lod-meta.json"] = bytes_of(meta.dump());
  return files;
}

}  // namespace

TEST_CASE("levels become levels of a streamed SOG, and regions hold them one after another") {
  for (const int degree : {0, 2}) {
    CAPTURE(degree);
    const Bytes rgs = rgs_with_levels(3000, degree);
    const auto file = PagedFile::open(rgs);
    REQUIRE(file);
    REQUIRE(file->n_levels() == 4);
    const Written w = written(rgs);
    const json meta = meta_of(w.files);
    CHECK(w.report.n_levels == 4);  // it is small: one region
    CHECK(w.report.n_regions == 1);
    CHECK(w.report.n_stored == file->n_stored());
    CHECK(meta["count"] == file->n_stored());
    const Bytes zip = zipped(w.files);
    CHECK(detect_format(zip) == SplatFormat::ssog);
    for (std::uint32_t i = 0; i < 4; ++i) {
      CAPTURE(i);
      const SplatCloud expected = read_pages(*file, lod::pages_of_level(file->pages(), i)).value();
      const auto read = read_splats(zip, level(i));
      REQUIRE(read);
      CHECK(meta["counts"][i] == expected.size());
      REQUIRE(read->cloud.size() == expected.size());
      CHECK(read->cloud.sh_degree == degree);
      CHECK(read->n_levels == 4);
      CHECK(read->finest == (i == 0));
      const SplatError e = compare(expected, turned_like(expected, read->cloud));
      CHECK(e.mean[0] <= 1e-3);  // 16 bits of ln(1 + |x|) between -8 and 8
      CHECK(e.opacity <= 0.51 / 255);
      CHECK(e.sh[0] <= 0.05);
    }
    const auto finest = read_splats(zip);
    REQUIRE(finest);
    CHECK(finest->cloud.mean == read_splats(zip, level(0))->cloud.mean);
    CHECK(finest->unused == std::vector<std::string>{"levels of detail but the finest"});
    CHECK(read_splats(zip, level(4)).error().code == Errc::bad_argument);
    CHECK(written(rgs, {.threads = 1}).files == written(rgs, {.threads = 3}).files);
    CHECK(read_splats(zipped(written(rgs, {}, 0).files))->cloud.sh_degree == 0);
  }
}

TEST_CASE("regions are pages of few enough Gaussians, or of a level at which most are narrow") {
  // Two pages below the root, which is wide and holds more than 128 Ki, as they do not.
  SplatCloud wide = ordinary_cloud(200000, 0, 8);
  for (std::uint64_t i = 0; i < wide.size(); ++i) wide.mean[3 * i] = static_cast<float>(i) * 1e-3F;
  const auto regions_of = [&](const SplatCloud& cloud) {
    return written(rgs_of(trivial_levels(cloud, {.chunk_size = 6400}), {}, 6400)).files;
  };
  const auto count = [](const json& meta) {
    std::vector<std::uint64_t> counts;
    for_each_region(meta["tree"], [&](const json& region) {
      counts.push_back(region["lods"]["0"]["count"].get<std::uint64_t>());
      CHECK(region["lods"].size() == meta["lodLevels"]);
    });
    return counts;
  };
  const Files files = regions_of(wide);
  const json meta = meta_of(files);
  CHECK(meta["lodLevels"] == 2);
  CHECK(count(meta) == std::vector<std::uint64_t>{4 * 38400, 200000 - 4 * 38400});
  // Of the regions in order, Gaussians lie in their bounds.
  const auto read = read_splats(zipped(files));
  REQUIRE(read);
  std::uint64_t next = 0, outside = 0;
  for_each_region(meta["tree"], [&](const json& region) {
    const double low = region["bound"]["min"][0], high = region["bound"]["max"][0];
    for (std::uint64_t n = region["lods"]["0"]["count"]; n-- > 0; ++next) {
      const auto x = static_cast<double>(read->cloud.mean[3 * next]);
      outside += x < low - 0.1 || x > high + 0.1;
    }
  });
  CHECK(next == 200000);
  CHECK(outside == 0);
  for (float& x : wide.mean) x *= 0.01F;  // narrow: one region
  CHECK(count(meta_of(regions_of(wide))) == std::vector<std::uint64_t>{200000});
}

TEST_CASE("a streamed SOG is in the axes of 3DGS, without an origin") {
  const SplatCloud cloud = ordinary_cloud(200, 1, 5);
  EncodeOptions options;
  options.axes = {Axis::right, Axis::up, Axis::backward};
  options.origin = {10.1, 20, 30};
  const Written w = written(rgs_with_levels(200, 1, options));
  const auto read = read_splats(zipped(w.files));
  REQUIRE(read);
  CHECK(read->origin == kNoOrigin);
  SplatCloud expected = cloud;
  convert_axes(expected, options.axes, kAxes3dgs);
  double largest = 0;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    const float moved = expected.mean[3 * i + 1] - 20;  // up is -down
    largest = std::max(largest, static_cast<double>(std::abs(moved - read->cloud.mean[3 * i + 1])));
  }
  CHECK(largest < 2e-3);
  const json bound = meta_of(w.files)["tree"]["bound"];
  CHECK(bound["min"][1].get<double>() < -20);
  CHECK(bound["min"][1].get<double>() > -60);
  CHECK(bound["min"][1].get<double>() < bound["max"][1].get<double>());
  CHECK(w.report.position_rounding > 0);
}

TEST_CASE("a region is read at its finest level, or at that asked for, or at the next that it has") {
  const Files files = three_regions();
  const auto finest = read_splats(zipped(files)), coarse = read_splats(zipped(files), level(1));
  REQUIRE(finest);
  REQUIRE(coarse);
  CHECK(finest->cloud.size() == 50 + 6);
  CHECK(finest->cloud.sh_degree == 1);
  CHECK(coarse->cloud.size() == 20);
  CHECK(coarse->cloud.sh_degree == 0);
  CHECK(check_pieces(zipped(files)) == 50);  // one SOG after the other
  // The last region's Gaussians, of level 1, come last.
  CHECK(std::equal(finest->cloud.mean.end() - 18, finest->cloud.mean.end(), coarse->cloud.mean.end() - 18));
  // The same in a folder, and with a folder above it in an archive.
  const TemporaryFolder folder;
  Files inside;
  std::uint64_t bytes = 0;
  for (const auto& [name, content] : files) {
    std::filesystem::create_directories((folder.path() / name).parent_path());
    write_bytes(folder.file(name), content);
    inside["scene/" + name] = content;
    bytes += content.size();
  }
  const auto from_folder = read_splats(folder.file("lod-meta.json"));
  REQUIRE(from_folder);
  CHECK(from_folder->format == SplatFormat::ssog);
  CHECK(from_folder->cloud.mean == finest->cloud.mean);
  CHECK(from_folder->bytes == bytes);
  CHECK(read_splats(zipped(inside))->cloud.mean == finest->cloud.mean);
  const auto alone = read_splats(files.at("lod-meta.json"));
  REQUIRE_FALSE(alone);
  CHECK(alone.error().code == Errc::unsupported_feature);
  // An environment is named; its file is not read.
  Files with_sky = files;
  json meta = meta_of(files);
  meta["environment"] = "env/meta.json";
  with_sky["lod-meta.json"] = bytes_of(meta.dump());
  CHECK(read_splats(zipped(with_sky))->unused.back() == "the environment, a SOG of its own");
}

TEST_CASE("regions are chains of nodes, the coarsest first, read one SOG at a time") {
  const Bytes zip = zipped(three_regions());
  const auto tree = open_levels(zip, ".", {});
  REQUIRE(tree);
  std::vector<std::uint32_t> levels, parents;
  std::vector<std::uint64_t> counts;
  for (const LevelTree::Node& node : tree->nodes) {
    levels.push_back(node.level), parents.push_back(node.parent), counts.push_back(node.n);
    CHECK(node.error == 0);
  }
  constexpr std::uint32_t kNone = LevelTree::kNoParent;
  CHECK(levels == std::vector<std::uint32_t>{1, 0, 1, 0, 1});
  CHECK(parents == std::vector<std::uint32_t>{kNone, 0, kNone, 2, kNone});
  CHECK(counts == std::vector<std::uint64_t>{5, 20, 9, 30, 6});
  CHECK(tree->file.unused.empty());
  CHECK(tree->file.bytes == zip.size());
  // Nodes without children are what is read without levels, in its order.
  SplatCloud leaves;
  std::vector<std::uint32_t> visited;
  for (int pass = 0; pass < 2; ++pass) {
    leaves = {}, visited = {};
    const Status read = tree->read([&](std::uint32_t node, const SplatFile& piece) -> Status {
      visited.push_back(node);
      CHECK(piece.cloud.size() == counts[node]);
      if (node == 1 || node == 3 || node == 4) append_splats(leaves, piece.cloud);
      return {};
    });
    CHECK(read);
  }
  CHECK(visited == std::vector<std::uint32_t>{3, 1, 0, 2, 4});
  CHECK(leaves.mean == read_splats(zip)->cloud.mean);
  ReadOptions few;
  few.limits.max_gaussians = 69;
  CHECK(open_levels(zip, ".", few).error().code == Errc::limit_exceeded);
  CHECK(open_levels(bytes_of("ply"), ".", {}).error().code == Errc::bad_argument);
}

TEST_CASE("streamed SOGs that contradict themselves, or point elsewhere, are refused") {
  const auto refused = [](const std::function<void(json&, Files&)>& edit, Errc code) {
    Files files = three_regions();
    json meta = meta_of(files);
    edit(meta, files);
    files["lod-meta.json"] = bytes_of(meta.dump());
    const auto file = read_splats(zipped(files));
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
    const std::uint64_t offset = code == Errc::missing_section ? Error::kNone : 0;
    CHECK(file.error().offset == offset);
  };
  const auto region = [](json& m) -> json& { return m["tree"]["children"][0]["lods"]; };
  refused([](json& m, Files&) { m["version"] = 2; }, Errc::unsupported_version);
  refused([](json& m, Files&) { m["lodLevels"] = 0; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["lodLevels"] = 1; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["lodLevels"] = 1e30; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["counts"] = {49, 20}; }, Errc::size_mismatch);
  refused([](json& m, Files&) { m["counts"] = {50}; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["tree"] = 3; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m.erase("tree"); }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["tree"]["children"] = 3; }, Errc::bad_syntax);
  for (const char* name :
       {"../meta.json", "/meta.json", "0_0/../1_0/meta.json", "0_0//meta.json", "", "0_0\\meta.json"})
    refused([&](json& m, Files&) { m["filenames"][0] = name; }, Errc::bad_syntax);
  refused([&](json& m, Files&) { m["filenames"][0] = std::string("0_0/meta.json\0x", 15); }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["filenames"][0] = m["filenames"][1]; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["filenames"][0] = "2_0/meta.json"; }, Errc::missing_section);
  refused([](json&, Files& f) { f.erase("0_0/sh0.webp"); }, Errc::missing_section);
  refused([&](json& m, Files&) { region(m)["0"]["file"] = 2; }, Errc::bad_syntax);
  refused([&](json& m, Files&) { region(m)["0"]["offset"] = -1; }, Errc::bad_syntax);
  refused([&](json& m, Files&) { region(m)["2"] = region(m)["0"]; }, Errc::bad_syntax);
  refused([&](json& m, Files&) { region(m)["00"] = region(m)["0"]; }, Errc::bad_syntax);
  refused([&](json& m, Files&) { region(m)["0"]["offset"] = 29; }, Errc::bad_value);
  refused([&](json& m, Files&) { region(m)["0"]["offset"] = 31; }, Errc::size_mismatch);
  refused(
      [&](json& m, Files&) {
        m.erase("counts");
        region(m)["0"]["count"] = 21;
      },
      Errc::size_mismatch);
  refused(
      [&](json& m, Files&) {
        m.erase("counts");
        region(m)["0"]["count"] = 4000000000;  // more than the archive can unfold to
      },
      Errc::limit_exceeded);
  // Parsed JSON takes many times its text's bytes.
  Files files = three_regions();
  files["lod-meta.json"].resize((std::size_t{1} << 25) + 1, std::byte{' '});
  const auto longer = read_splats(zipped(files));
  REQUIRE_FALSE(longer);
  CHECK(longer.error().code == Errc::limit_exceeded);
  // As deep as a small file can be.
  std::string deep = R"({"version":1,"lodLevels":1,"filenames":[],"tree":)";
  for (int i = 0; i < 100000; ++i) deep += R"({"children":[)";
  deep += "{}";
  for (int i = 0; i < 100000; ++i) deep += "]}";
  files["lod-meta.json"] = bytes_of(deep + "}");
  const auto empty = read_splats(zipped(files));
  REQUIRE(empty);
  CHECK(empty->cloud.size() == 0);
}

TEST_CASE("damaged streamed SOGs are refused or read, but never crash") {
  check_hostile(zipped(three_regions()), 4, 300);
  const Files files = three_regions();
  const TemporaryFolder folder;
  for (const auto& [name, bytes] : files) {
    std::filesystem::create_directories((folder.path() / name).parent_path());
    write_bytes(folder.file(name), bytes);
  }
  SplitMix random(6);
  for (int i = 0; i < 300; ++i) {
    Bytes damaged = files.at("lod-meta.json");
    damaged[random.below(damaged.size())] = static_cast<std::byte>(random.below(256));
    write_bytes(folder.file("lod-meta.json"), damaged);
    const auto file = read_splats(folder.file("lod-meta.json"));
    if (!file) CHECK((exit_code(file.error().code) == 4 || file.error().code == Errc::open_failed));
    const auto tree = open_levels(damaged, folder.path().string(), {});
    if (tree) (void)tree->read([](std::uint32_t, const SplatFile&) { return Status(); });
    if (tree) CHECK(tree->nodes.size() <= 5);
  }
}
