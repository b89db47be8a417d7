// lcc_test.cpp - LCC and LCC2: folders built from the published layouts, what is refused, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <sys/resource.h>

#include <cstring>
#include <map>
#include <nlohmann/json.hpp>

#include "interchange_samples.hpp"
#include "lcc_samples.hpp"
#include "rgs/level_tree.hpp"
#include "rgs/splat_edit.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using nlohmann::json;

Files edited(Files files, const char* name, const std::function<void(json&)>& edit) {
  json meta = json::parse(text_of(files.at(name)));
  edit(meta);
  files[name] = bytes_of(meta.dump());
  return files;
}

void write_files(const Files& files, const TemporaryFolder& folder) {
  for (const auto& [file, bytes] : files) {
    std::filesystem::create_directories(std::filesystem::path(folder.file(file)).parent_path());
    write_bytes(folder.file(file), bytes);
  }
}

Result<SplatFile> read_folder(const Files& files, const char* name, const ReadOptions& options = kKeepAxes) {
  const TemporaryFolder folder;
  write_files(files, folder);
  return read_splats(folder.file(name), options);
}

ReadOptions level_of_detail(std::uint32_t level) {
  ReadOptions options = kKeepAxes;
  options.level_of_detail = level;
  return options;
}

void check_refused(const Files& files, const char* name, Errc code, std::uint64_t offset) {
  const auto file = read_folder(files, name);
  REQUIRE_FALSE(file);
  CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
  CHECK(file.error().offset == offset);
  CHECK(file.error().what[0] != '\0');
}

// Unlike along each axis, scales as lcc() holds them.
SplatCloud cell_cloud(std::uint64_t n, std::uint64_t seed) {
  SplatCloud cloud = ordinary_cloud(n, 3, seed);
  for (std::size_t i = 0; i < cloud.mean.size(); ++i) cloud.mean[i] += static_cast<float>(10 * (i % 3));
  for (float& x : cloud.log_scale) x = x / 4 - 1;
  return cloud;
}

void check_within_steps(const SplatError& e) {
  for (int k = 0; k < 3; ++k) {
    CHECK(e.mean[k] == 0);
    CHECK(e.log_scale[k] <= 0.51 * kLargest[k] / 65535 / std::exp(-3.25));
  }
  CHECK(e.rotation <= 3 * 0.51 * std::sqrt(2) / 1023);
  CHECK(e.opacity <= 0.501 / 255);
  CHECK(e.sh[0] <= 0.501 / 255 / 0.28209479);
  for (int d = 1; d < 4; ++d) {
    CHECK(e.sh[d] <= 0.501 * 3.25 / 1023);
    CHECK(e.sh[d] > 0);
  }
}

const std::vector<SplatCloud> kCells{cell_cloud(5, 1), cell_cloud(0, 2), cell_cloud(9, 3)};

SplatCloud finest() {
  SplatCloud cloud;
  for (const SplatCloud& cell : kCells) append_splats(cloud, cell);
  return cloud;
}

}  // namespace

TEST_CASE("LCC: the finest level of all cells, within half a step; what is not read is named") {
  Files files = lcc(kCells);
  for (const bool capitals : {false, true}) {
    const auto file = read_folder(files, "a.lcc");
    REQUIRE(file);
    CHECK(file->format == SplatFormat::lcc);
    CHECK(file->axes == kAxesLcc);
    std::uint64_t bytes = 0;
    for (const auto& [name, content] : files) bytes += content.size();
    CHECK(file->bytes == bytes);
    check_within_steps(compare(file->cloud, finest()));
    CHECK(file->unused == std::vector<std::string>{"2 coarser levels of detail"});
    const TemporaryFolder folder;
    write_files(files, folder);
    check_pieces(folder.file("a.lcc"));
    for (const std::string name : {"index.bin", "data.bin", "shcoef.bin"}) {
      if (capitals) continue;
      files[static_cast<char>(name[0] - 32) + name.substr(1)] = files.at(name);
      files.erase(name);
    }
  }
  files = edited(files, "a.lcc", [](json& meta) {
    meta["offset"] = {689605.5, 0, -3};
    meta["shift"] = {0, 0, 0};
    meta["scale"] = {1, 1, 1};
    meta["epsg"] = 32632;
  });
  files["environment.bin"] = files["collision.lci"] = Bytes(7);
  CHECK(read_folder(files, "a.lcc").value().unused ==
        std::vector<std::string>{"2 coarser levels of detail", "environment", "collision mesh",
                                 "offset 689605.500000, 0.000000, -3.000000",
                                 "coordinate reference system EPSG:32632"});
}

TEST_CASE("LCC: cells are chains of the levels that they have, the coarsest first") {
  const Files files = lcc(kCells);
  const TemporaryFolder folder;
  const auto open = [&](const Files& some) {
    for (const auto& [name, bytes] : some) write_bytes(folder.file(name), bytes);
    return open_levels(some.at("a.lcc"), folder.path().string(), {});
  };
  const auto tree = open(files);
  REQUIRE(tree);
  CHECK(tree->file.axes == kAxesLcc);
  CHECK(tree->file.unused.empty());
  std::vector<SplatCloud> pieces;
  REQUIRE(tree->read([&](std::uint32_t node, SplatFile piece) -> Status {
    CHECK(node == pieces.size());
    pieces.push_back(std::move(piece.cloud));
    return {};
  }));
  REQUIRE(pieces.size() == tree->nodes.size());
  SplatCloud leaves;
  for (std::size_t i = 0; i < pieces.size(); ++i) {
    const LevelTree::Node& node = tree->nodes[i];
    CHECK(pieces[i].size() == node.n);
    if (node.level == 0) append_splats(leaves, pieces[i]);
    if (node.level > 0) CHECK(pieces[i].mean[0] > 50);
    if (node.parent != LevelTree::kNoParent) {
      CHECK(node.parent + 1 == i);
      CHECK(tree->nodes[node.parent].level > node.level);
    }
  }
  check_within_steps(compare(leaves, finest()));
  // Counts and places are held to the .lcc and the files on all levels.
  Files cut = files;
  put(cut.at("index.bin"), 4 + 16, 200U);
  CHECK(exit_code(open(cut).error().code) == 4);
  CHECK(read_folder(cut, "a.lcc"));  // the finest is read all the same
  cut = files;
  cut.at("data.bin").resize(cut.at("data.bin").size() - 1);
  CHECK(std::string(open(cut).error().what).find("--lod") != std::string::npos);
  // The .lcc may state the finest level's alone.
  const Files stated = edited(files, "a.lcc", [](json& meta) { meta["splats"] = {14}; });
  const auto counted = open(stated);
  REQUIRE(counted);
  CHECK(counted->nodes.size() == tree->nodes.size());
  // The second cell has no finest level: its Gaussians have no place, and are counted.
  Files without = stated;
  put(without.at("index.bin"), kCell + 4 + 16, 2U);
  put(without.at("index.bin"), kCell + 4 + 16 + 12, 64U);
  CHECK(open(without)->file.unused == std::vector<std::string>{"2 Gaussians of cells without a finest level"});
}

TEST_CASE("LCC: a level is that of each cell, or the next finer one that it has") {
  const Files files = lcc({cell_cloud(8, 1), cell_cloud(2, 2), cell_cloud(9, 3)});
  const Files stated = edited(files, "a.lcc", [](json& meta) { meta["splats"] = {19, 4, 4}; });
  std::vector<std::uint64_t> n;
  for (std::uint32_t level = 0; level < kLevels; ++level) {
    const auto file = read_folder(stated, "a.lcc", level_of_detail(level));
    REQUIRE(file);
    CHECK(file->n_levels == kLevels);
    CHECK(file->finest == (level == 0));
    CHECK(file->unused.empty());
    n.push_back(file->cloud.size());
    // Coarser ones are far away; the second cell has none.
    CHECK(file->cloud.mean[0] + (level == 0 ? 100 : 0) > 50);
    if (level > 0) CHECK(file->cloud.mean[3 * 2] < 50);
    if (level == 0) CHECK(file->cloud.mean == read_folder(stated, "a.lcc")->cloud.mean);
  }
  CHECK(n == std::vector<std::uint64_t>{19, 2 + 2 + 2, 2 + 2 + 2});
  CHECK(read_folder(stated, "a.lcc", level_of_detail(kLevels)).error().code == Errc::bad_argument);
  // Of a cell without the finest level nothing is read, and what is not asked for may be missing.
  Files damaged = stated;
  put(damaged.at("index.bin"), 2 * kCell + 4 + 16 * 2, 200U);
  CHECK(read_folder(damaged, "a.lcc", level_of_detail(1)));
  CHECK(exit_code(read_folder(damaged, "a.lcc", level_of_detail(2)).error().code) == 4);
  ReadOptions few = level_of_detail(1);
  few.limits.max_gaussians = 6;
  CHECK(read_folder(stated, "a.lcc", few));
  few.limits.max_gaussians = 5;
  CHECK(read_folder(stated, "a.lcc", few).error().code == Errc::limit_exceeded);
}

TEST_CASE("LCC is right, forward, up, and comes in 3DGS's frame") {
  const auto there = read_folder(lcc(kCells), "a.lcc"), here = read_folder(lcc(kCells), "a.lcc", {});
  REQUIRE(there);
  REQUIRE(here);
  CHECK(here->axes == kAxes3dgs);
  for (std::size_t i = 0; i < 3 * std::size_t{14}; i += 3) {
    CHECK(here->cloud.mean[i] == there->cloud.mean[i]);
    CHECK(here->cloud.mean[i + 1] == -there->cloud.mean[i + 2]);
    CHECK(here->cloud.mean[i + 2] == there->cloud.mean[i + 1]);
  }
}

TEST_CASE("LCC: harmonics are there if fileType is Quality, or nothing says that they are not") {
  const Files files = lcc(kCells);
  const auto degree = [&](const std::function<void(json&)>& edit) {
    return read_folder(edited(files, "a.lcc", edit), "a.lcc").value().cloud.sh_degree;
  };
  CHECK(degree([](json& meta) { meta["fileType"] = "Portable"; }) == 0);
  CHECK(degree([](json& meta) { meta.erase("fileType"); }) == 3);
  const auto state_none = [](json& meta) {
    meta.erase("fileType");
    meta["attributes"][0]["min"] = {0, 0, 0};
    meta["attributes"][0]["max"] = {1, 1, 1};
  };
  CHECK(degree(state_none) == 0);
  CHECK(degree([&](json& meta) { state_none(meta), meta["fileType"] = "Quality"; }) == 3);
  CHECK(degree([](json& meta) { meta.erase("fileType"), meta["attributes"].erase(0); }) == 0);
}

TEST_CASE("LCC: what contradicts itself is refused where it does, and nothing is read twice") {
  const Files files = lcc(kCells);
  const auto by_json = [&](Errc code, std::uint64_t offset, const std::function<void(json&)>& edit) {
    check_refused(edited(files, "a.lcc", edit), "a.lcc", code, offset);
  };
  const auto by_index = [&](Errc code, std::uint64_t offset, std::uint64_t at, auto value) {
    Files damaged = files;
    put(damaged.at("index.bin"), at, value);
    check_refused(damaged, "a.lcc", code, offset);
  };
  by_json(Errc::bad_syntax, 0, [](json& meta) { meta.erase("splats"); });
  by_json(Errc::bad_syntax, 0, [](json& meta) { meta["totalLevel"] = 0; });
  by_json(Errc::bad_syntax, 0, [](json& meta) { meta["attributes"].erase(1); });
  by_json(Errc::bad_syntax, 0, [](json& meta) { meta["attributes"].erase(0); });
  by_json(Errc::bad_syntax, 0, [](json& meta) { meta["attributes"][1]["max"] = {1, 2}; });
  by_json(Errc::unsupported_feature, 0, [](json& meta) { meta["encoding"] = "RAW"; });
  by_json(Errc::truncated, 3 * kCell, [](json& meta) { meta["totalLevel"] = 4; });
  by_json(Errc::truncated, 3 * kCell, [](json& meta) { meta["totalLevel"] = ~std::uint64_t{0}; });
  by_json(Errc::size_mismatch, 3 * kCell, [](json& meta) { meta["splats"][0] = 13; });
  const std::uint64_t data_bytes = files.at("data.bin").size();
  by_json(Errc::truncated, data_bytes, [](json& meta) { meta["splats"][0] = 1000000; });
  by_index(Errc::size_mismatch, 3 * kCell, 4, 4U);
  by_index(Errc::bad_header, 16, 4, 6U);
  by_index(Errc::bad_header, 2 * kCell + 16, 2 * kCell + 16, 32U * 9 - 1);
  by_index(Errc::truncated, 2 * kCell + 8, 2 * kCell + 8, data_bytes - 32 * 9 + 1);
  by_index(Errc::truncated, 8, 8, ~std::uint64_t{0});
  Files cut = files;
  cut.at("shcoef.bin").resize(2 * (data_bytes - 32 * 4) - 1);
  check_refused(cut, "a.lcc", Errc::truncated, 2 * kCell + 8);
  // All cells with the Gaussians of one.
  Files many = files;
  const Bytes cell(files.at("index.bin").begin(), files.at("index.bin").begin() + kCell);
  for (int i = 0; i < 1000; ++i) many.at("index.bin").insert(many.at("index.bin").end(), cell.begin(), cell.end());
  many = edited(many, "a.lcc", [](json& meta) { meta["splats"][0] = 14 + 1000 * 5; });
  check_refused(many, "a.lcc", Errc::truncated, data_bytes);
  ReadOptions options = kKeepAxes;
  options.limits.max_gaussians = 13;
  CHECK(read_folder(files, "a.lcc", options).error().code == Errc::limit_exceeded);
  const auto lone = read_splats(files.at("a.lcc"));
  CHECK(lone.error().code == Errc::unsupported_feature);
  for (const std::string name : {"index.bin", "data.bin", "shcoef.bin"}) {
    Files without = files;
    without.erase(name);
    const auto file = read_folder(without, "a.lcc");
    REQUIRE_FALSE(file);
    CHECK(file.error().code == Errc::open_failed);
    CHECK(std::string(file.error().what).find(name) != std::string::npos);
  }
}

TEST_CASE("damaged files of an LCC are refused or read, but never crash") {
  const Files files = lcc(kCells);
  const TemporaryFolder folder;
  SplitMix random(31);
  for (const auto& [name, whole] : files) {
    const std::string damaged_file = name;
    CAPTURE(damaged_file);
    Files damaged = files;
    for (std::size_t size = 0; size < whole.size(); size += 1 + whole.size() / 200) {
      damaged[name].assign(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(size));
      const auto file = read_folder(damaged, "a.lcc");
      if (!file) CHECK(exit_code(file.error().code) == 4);
      // Coarser levels, which come last, may be missing; the first bytes of the JSON pass for .splat.
      if (file && file->format == SplatFormat::lcc) CHECK((name.ends_with(".bin") && file->cloud.size() == 14));
    }
    for (int i = 0; i < 200; ++i) {
      damaged[name] = whole;
      damaged[name][random.below(whole.size())] = static_cast<std::byte>(random.below(256));
      const auto file = read_folder(damaged, "a.lcc");
      if (!file) CHECK(exit_code(file.error().code) == 4);
      if (file) CHECK(file->cloud.size() <= files.at("data.bin").size() / 32);
      for (const auto& [beside, bytes] : damaged) write_bytes(folder.file(beside), bytes);
      const auto tree = open_levels(damaged.at("a.lcc"), folder.path().string(), {});
      if (tree) (void)tree->read([](std::uint32_t, const SplatFile&) { return Status(); });
    }
  }
}

// ---- LCC2 -----------------------------------------------------------------------------------------------------------

namespace {

const std::vector<SplatCloud> kChunks{cell_cloud(4, 11), cell_cloud(3, 12), cell_cloud(6, 13), cell_cloud(8, 14)};

json node(int file, std::optional<int> count, int start = 0) {
  json out = {{"data", {{"3dgs", {{"name", file}, {"start", start}}}}}};
  if (count) out["data"]["3dgs"]["count"] = *count;
  return out;
}

// Chunk 0 is coarse, 1 the environment, 3 that of two nodes.
Files lcc2(SplatFormat format, bool legacy = false) {
  Files files;
  const std::string ending = std::string(".") + format_name(format);
  json names = json::array();
  for (std::size_t i = 0; i < kChunks.size(); ++i) {
    const std::string name = "data/3dgs/" + std::to_string(i);
    files[name + ending] = encode_splats(kChunks[i].view(), format, {.keep_order = true}).value();
    names.push_back(legacy ? "/" + name : name + ending);
  }
  json coarse = node(0, 4);
  coarse["child"] = {{"0", node(3, 5)}, {"1", node(2, 6)}, {"2", node(3, 3, 5)}, {"3", node(1, 3)}};
  json root = {{"data", {{"env", {{"name", 1}}}}}, {legacy ? "files" : "splatFiles", names}, {"child", {coarse}}};
  const json meta =
      legacy
          ? json{{"total_splats", 18}, {"lod_3dgs_info", {4, 14}}, {"lod_level", 2}, {"root", root}}
          : json{
                {"totalSplats", 18}, {"lodSplats", {14, 4}}, {"totalLevels", 2}, {"splatType", ending}, {"root", root}};
  files["a.lcc2"] = bytes_of(meta.dump());
  return files;
}

}  // namespace

TEST_CASE("LCC2: chunks of the finest level in the order of their files, in LCC's frame whatever their format says") {
  for (const auto& [format, legacy] :
       {std::pair(SplatFormat::sog, false), std::pair(SplatFormat::spz, false), std::pair(SplatFormat::sog, true)}) {
    const std::string name = format_name(format);
    CAPTURE(name);
    const Files files = lcc2(format, legacy);
    const auto file = read_folder(files, "a.lcc2");
    REQUIRE(file);
    CHECK(file->format == SplatFormat::lcc2);
    CHECK(file->axes == kAxesLcc);
    CHECK_FALSE(file->axes_assumed);
    CHECK(file->unused == std::vector<std::string>{"1 coarser levels of detail", "environment"});
    SplatCloud chunks;
    for (const std::size_t i : {2U, 3U}) {
      append_splats(chunks, read_splats(files.at("data/3dgs/" + std::to_string(i) + "." + name), kKeepAxes)->cloud);
    }
    CHECK(compare(file->cloud, chunks).sum() == 0);
    CHECK(read_folder(files, "a.lcc2", {}).value().cloud.mean[1] == -chunks.mean[2]);
    const TemporaryFolder folder;
    write_files(files, folder);
    CHECK(check_pieces(folder.file("a.lcc2")) < chunks.size());
  }
}

TEST_CASE("LCC2: nodes are those of the tree, of which a level may be read") {
  for (const SplatFormat format : {SplatFormat::sog, SplatFormat::spz}) {
    const std::string ending = std::string(".") + format_name(format);
    CAPTURE(ending);
    // Below the first node another without Gaussians, and one of the coarser level alone.
    const Files files = edited(lcc2(format), "a.lcc2", [](json& meta) {
      meta["root"]["child"][0]["child"]["4"] = {{"data", {{"3dgs", nullptr}}}};
      meta["root"]["child"].push_back({{"child", {node(4, 2)}}});
      meta["root"]["child"].push_back(node(0, 4));
      meta["root"]["child"][0]["data"]["3dgs"]["start"] = 4;
      meta["root"]["splatFiles"].push_back("4" + meta["splatType"].get<std::string>());
    });
    Files all = files;
    SplatCloud twice = kChunks[0];
    append_splats(twice, kChunks[0]);
    for (std::size_t i = 12; i < 24; ++i) twice.mean[i] += 100;
    all["data/3dgs/0" + ending] = encode_splats(twice.view(), format, {.keep_order = true}).value();
    all["4" + ending] = encode_splats(cell_cloud(2, 15).view(), format, {.keep_order = true}).value();
    const TemporaryFolder folder;
    write_files(all, folder);
    const auto tree = open_levels(all.at("a.lcc2"), folder.path().string(), {});
    REQUIRE(tree);
    CHECK(tree->file.format == SplatFormat::lcc2);
    CHECK(tree->file.axes == kAxesLcc);
    CHECK(tree->file.unused == std::vector<std::string>{"1 nodes that have only coarser levels", "environment"});
    std::vector<std::uint64_t> n;
    std::uint32_t coarse = LevelTree::kNoParent;
    for (std::uint32_t i = 0; i < tree->nodes.size(); ++i) {
      n.push_back(tree->nodes[i].n);
      if (tree->nodes[i].level == 1) coarse = i;
    }
    std::ranges::sort(n);
    CHECK(n == std::vector<std::uint64_t>{2, 3, 4, 5, 6});
    REQUIRE(coarse != LevelTree::kNoParent);
    for (const LevelTree::Node& node : tree->nodes)
      CHECK(node.parent == (node.level == 0 && node.n != 2 ? coarse : LevelTree::kNoParent));
    SplatCloud leaves, above;
    std::uint64_t bytes = tree->file.bytes;
    REQUIRE(tree->read([&](std::uint32_t node, const SplatFile& piece) -> Status {
      CHECK(piece.cloud.size() == tree->nodes[node].n);
      append_splats(tree->nodes[node].level == 0 ? leaves : above, piece.cloud);
      bytes += piece.bytes;
      return {};
    }));
    const auto finest = read_splats(folder.file("a.lcc2"), kKeepAxes),
               coarser = read_splats(folder.file("a.lcc2"), level_of_detail(1));
    REQUIRE(finest);
    CHECK(leaves.mean == finest->cloud.mean);
    CHECK(bytes == finest->bytes + all.at("data/3dgs/0" + ending).size());
    // The node's own Gaussians alone, and the finer ones where there is no node above.
    REQUIRE(coarser);
    CHECK(coarser->cloud.size() == 4 + 2);
    CHECK_FALSE(coarser->finest);
    above.resize(4, 3);
    for (std::uint64_t i = 0; i < 12; ++i) CHECK(coarser->cloud.mean[i] == above.mean[i]);
    CHECK(above.mean[0] > 50);
    CHECK(read_folder(all, "a.lcc2", level_of_detail(2)).error().code == Errc::bad_argument);
    ReadOptions few;
    few.limits.max_gaussians = 19 + 4;
    CHECK(open_levels(all.at("a.lcc2"), folder.path().string(), few).error().code == Errc::limit_exceeded);
    // What does not say which Gaussians are whose has the finest level alone.
    const Files unclear = edited(all, "a.lcc2", [](json& meta) {
      for (json& child : meta["root"]["child"][0]["child"]) {
        if (child["data"]["3dgs"].is_object()) child["data"]["3dgs"]["start"] = 0;
      }
    });
    CHECK(open_levels(unclear.at("a.lcc2"), folder.path().string(), {})->nodes.empty());
    CHECK(read_folder(unclear, "a.lcc2")->cloud.size() == finest->cloud.size());
    // Nor does a coarser node of the same Gaussians, which takes nothing from the finest.
    const Files shared =
        edited(all, "a.lcc2", [](json& meta) { meta["root"]["child"][0]["data"] = node(3, 8)["data"]; });
    CHECK(open_levels(shared.at("a.lcc2"), folder.path().string(), {})->nodes.empty());
    CHECK(read_folder(shared, "a.lcc2")->cloud.mean == finest->cloud.mean);
    const Files wrong =
        edited(all, "a.lcc2", [](json& meta) { meta["root"]["child"][0]["data"]["3dgs"]["count"] = 5; });
    const auto damaged = open_levels(wrong.at("a.lcc2"), folder.path().string(), {});
    REQUIRE(damaged);
    CHECK(damaged->read([](std::uint32_t, const SplatFile&) { return Status(); }).error().code == Errc::size_mismatch);
  }
}

TEST_CASE("LCC2: nodes without a finest level are named, but for the environment") {
  const auto file = read_folder(edited(lcc2(SplatFormat::spz), "a.lcc2",
                                       [](json& meta) {
                                         for (const int name : {0, 1}) meta["root"]["child"].push_back(node(name, 4));
                                       }),
                                "a.lcc2");
  REQUIRE(file);
  CHECK(file->unused ==
        std::vector<std::string>{"1 coarser levels of detail", "1 nodes that have only coarser levels", "environment"});
}

TEST_CASE("LCC2: more chunks than a process may hold open") {
  constexpr int kMany = 200;
  Files files;
  json names = json::array(), nodes = json::array();
  const Bytes chunk = encode_splats(kChunks[0].view(), SplatFormat::spz).value();
  for (int i = 0; i < kMany; ++i) {
    names.push_back(std::to_string(i) + ".spz");
    files[std::to_string(i) + ".spz"] = chunk;
    nodes.push_back(node(i, 4));
  }
  files["a.lcc2"] = bytes_of(json{{"lodSplats", {4 * kMany}},
                                  {"totalLevels", 1},
                                  {"splatType", ".spz"},
                                  {"root", {{"splatFiles", names}, {"child", nodes}}}}
                                 .dump());
  rlimit before{};
  REQUIRE(getrlimit(RLIMIT_NOFILE, &before) == 0);
  const rlimit few{100, before.rlim_max};
  REQUIRE(setrlimit(RLIMIT_NOFILE, &few) == 0);
  const auto file = read_folder(files, "a.lcc2");
  setrlimit(RLIMIT_NOFILE, &before);
  REQUIRE(file);
  CHECK(file->cloud.size() == 4 * kMany);
}

TEST_CASE("LCC2: what names no chunk in the folder, or one twice, is refused") {
  const Files files = lcc2(SplatFormat::spz);
  const auto refused = [&](Errc code, const std::function<void(json&)>& edit) {
    check_refused(edited(files, "a.lcc2", edit), "a.lcc2", code, 0);
  };
  for (const char* name : {"", ".", "..", "/etc/passwd", "../3.spz", "data/../../3.spz", "data\\3.spz", "data/3dgs/"}) {
    CAPTURE(std::string(name));
    refused(Errc::bad_syntax, [&](json& meta) { meta["root"]["splatFiles"][3] = name; });
  }
  CHECK(read_folder(
      edited(files, "a.lcc2", [](json& meta) { meta["root"]["splatFiles"][3] = "./data//x/../3dgs/3.spz"; }),
      "a.lcc2"));
  refused(Errc::bad_value, [](json& meta) { meta["root"]["splatFiles"][3] = "data/3dgs/./2.spz"; });
  refused(Errc::bad_value, [](json& meta) { meta["root"]["child"][0]["child"]["1"]["data"]["3dgs"]["name"] = 4; });
  refused(Errc::bad_value, [](json& meta) { meta["root"]["child"][0]["child"]["1"]["data"]["3dgs"]["name"] = -1; });
  refused(Errc::size_mismatch, [](json& meta) { meta["root"]["child"][0]["child"]["1"]["data"]["3dgs"]["count"] = 5; });
  CHECK(read_folder(edited(files, "a.lcc2",
                           [](json& meta) { meta["root"]["child"][0]["child"]["1"]["data"]["3dgs"].erase("count"); }),
                    "a.lcc2"));
  refused(Errc::bad_syntax, [](json& meta) { meta["totalLevels"] = 3; });
  refused(Errc::bad_syntax, [](json& meta) { meta["totalLevels"] = 0; });
  refused(Errc::bad_syntax, [](json& meta) { meta.erase("root"); });
  refused(Errc::bad_syntax, [](json& meta) { meta["root"] = 7; });
  refused(Errc::unsupported_feature, [](json& meta) { meta["splatType"] = ".ply"; });
  Files without = files;
  without.erase("data/3dgs/3.spz");
  CHECK(read_folder(without, "a.lcc2").error().code == Errc::open_failed);
  without["data/3dgs/3.spz"] = bytes_of("no chunk");
  CHECK(exit_code(read_folder(without, "a.lcc2").error().code) == 4);
  ReadOptions options = kKeepAxes;
  options.limits.max_gaussians = 13;
  CHECK(read_folder(files, "a.lcc2", options).error().code == Errc::limit_exceeded);
  CHECK(read_splats(files.at("a.lcc2")).error().code == Errc::unsupported_feature);
}

TEST_CASE("a damaged .lcc2 is refused or read, but never crashes") {
  const Files files = lcc2(SplatFormat::spz);
  const Bytes& whole = files.at("a.lcc2");
  const TemporaryFolder folder;
  SplitMix random(32);
  Files damaged = files;
  for (int i = 0; i < 400; ++i) {
    damaged["a.lcc2"] = whole;
    damaged["a.lcc2"][random.below(whole.size())] = static_cast<std::byte>(random.below(256));
    const auto file = read_folder(damaged, "a.lcc2");
    // A name may have changed into that of no file.
    if (!file) CHECK((exit_code(file.error().code) == 4 || file.error().code == Errc::open_failed));
    if (file) CHECK(file->cloud.size() <= 21);
    write_files(damaged, folder);
    const auto tree = open_levels(damaged.at("a.lcc2"), folder.path().string(), {});
    if (tree) (void)tree->read([](std::uint32_t, const SplatFile&) { return Status(); });
  }
  // Nodes as deep as the text is long.
  std::string deep = R"({"totalLevels": 200000, "lodSplats": [], "root": )";
  for (int i = 0; i < 100000; ++i) deep += R"({"splatFiles": [], "child": [)";
  for (int i = 0; i < 100000; ++i) deep += "]}";
  damaged["a.lcc2"] = bytes_of(deep + "}");
  check_refused(damaged, "a.lcc2", Errc::bad_syntax, 0);
}
