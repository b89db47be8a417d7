// tileset_test.cpp - 3D Tiles: levels and scenes written and read back, others' trees, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <set>
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

PutFile into(Files& files) {
  return [&files](const std::string& name, std::span<const std::byte> bytes) {
    files[name] = Bytes(bytes.begin(), bytes.end());
    return Status();
  };
}

json tree_of(const Files& files) {
  return json::parse(text_of(files.at("tileset.json")));
}

// Writes the files to a folder and reads its tileset.json.
Result<SplatFile> read_files(const Files& files, const ReadOptions& options = kKeepAxes) {
  const TemporaryFolder folder;
  for (const auto& [name, bytes] : files) {
    std::filesystem::create_directories(std::filesystem::path(folder.file(name)).parent_path());
    write_bytes(folder.file(name), bytes);
  }
  return read_splats(folder.file("tileset.json"), options);
}

ReadOptions level(std::uint32_t wanted) {
  ReadOptions options = kKeepAxes;
  options.level_of_detail = wanted;
  return options;
}

// One Gaussian, at x in the axes of glTF.
Bytes glb_at(float x) {
  SplatCloud cloud = ordinary_cloud(1, 1, 7);
  cloud.mean = {x, 2, 3};
  return encode_splats(cloud.view(), SplatFormat::glb, {.axes = kAxesGltf}).value();
}

json tile(const std::string& uri, const std::vector<json>& children = {}) {
  json t{{"boundingVolume", {{"sphere", {0, 0, 0, 9}}}}, {"geometricError", 1}};
  if (!uri.empty()) t["content"]["uri"] = uri;
  if (!children.empty()) t["children"] = children;
  return t;
}

Bytes tileset(json root, const std::string& refine = "REPLACE") {
  if (!root.contains("refine")) root["refine"] = refine;
  return bytes_of(json{{"asset", {{"version", "1.1"}}}, {"geometricError", 9}, {"root", std::move(root)}}.dump());
}

// x of all Gaussians, in axes of tiles, where glTF's are x, -z, y.
std::vector<float> xs_of(const Result<SplatFile>& file) {
  REQUIRE(file);
  std::vector<float> xs;
  for (std::size_t i = 0; i < file->cloud.mean.size(); i += 3) xs.push_back(file->cloud.mean[i]);
  return xs;
}
using Xs = std::vector<float>;

// A .subtree.
Bytes subtree(const std::string& stated, const std::string& buffer = "") {
  Bytes bytes = bytes_of("subt");
  const auto append = [&](std::uint64_t value, int n) {
    for (int i = 0; i < n; ++i) bytes.push_back(static_cast<std::byte>(value >> (8 * i) & 255));
  };
  append(1, 4);
  append(stated.size(), 8);
  append(buffer.size(), 8);
  for (const std::string* part : {&stated, &buffer}) {
    const Bytes more = bytes_of(*part);
    bytes.insert(bytes.end(), more.begin(), more.end());
  }
  return bytes;
}

// A .glb without arrays.
Bytes glb_of(std::string stated) {
  stated.resize((stated.size() + 3) / 4 * 4, ' ');
  Bytes bytes = bytes_of("glTF");
  const auto append = [&](std::uint64_t value) {
    for (int i = 0; i < 4; ++i) bytes.push_back(static_cast<std::byte>(value >> (8 * i) & 255));
  };
  for (const std::uint64_t value : {std::uint64_t{2}, 20 + stated.size(), stated.size(), std::uint64_t{0x4E4F534A}})
    append(value);
  const Bytes text = bytes_of(stated);
  bytes.insert(bytes.end(), text.begin(), text.end());
  return bytes;
}
const std::string kMesh = R"({"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[]}],"buffers":[]})";

// Of four files: the first two levels, whose bits are in its buffer: the root, a tile without content at 0, 0 and one
// at 1, 1; below the latter a subtree whose bits are in a file.
const std::string kFirstSubtree =
    R"({"buffers":[{"byteLength":8}],"bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":1},)"
    R"({"buffer":0,"byteOffset":2,"byteLength":1},{"buffer":0,"byteOffset":4,"byteLength":2}],)"
    R"("tileAvailability":{"bitstream":0},"contentAvailability":[{"bitstream":1}],)"
    R"("childSubtreeAvailability":{"bitstream":2}})";
const std::string kFirstBits("\x13\0\x11\0\0\x20\0\0", 8);
const std::string kSecondSubtree =
    R"({"buffers":[{"uri":"bits%2ebin","byteLength":1}],"bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":1}],)"
    R"("tileAvailability":{"bitstream":0},"contentAvailability":[{"constant":1}],)"
    R"("childSubtreeAvailability":{"constant":0}})";
json implicit_root(const char* scheme = "QUADTREE") {
  json root = tile("c/{level}.{x}.{y}.glb");
  root["geometricError"] = 64;
  root["implicitTiling"] = {{"subdivisionScheme", scheme},
                            {"availableLevels", 3},
                            {"subtreeLevels", 2},
                            {"subtrees", {{"uri", "s/{level}/{x}/{y}.subtree"}}}};
  return root;
}
Files implicit_files() {
  return {{"tileset.json", tileset(implicit_root())},
          {"s/0/0/0.subtree", subtree(kFirstSubtree, kFirstBits)},
          {"s/2/3/2.subtree", bytes_of(kSecondSubtree)},
          {"s/2/3/bits.bin", bytes_of("\x01")},
          {"c/0.0.0.glb", glb_at(1)},
          {"c/1.1.1.glb", glb_at(2)},
          {"c/2.3.2.glb", glb_at(3)}};
}

// Boxes hold those of children, and errors fall.
std::size_t check_tree(const json& node, double error) {
  CHECK(node["geometricError"] < error);
  std::size_t n = 1;
  const auto& box = node["boundingVolume"]["box"];
  if (!node.contains("children")) CHECK(node["geometricError"] == 0);
  for (const json& child : node.value("children", json::array())) {
    const auto& inner = child["boundingVolume"]["box"];
    for (std::size_t k = 0; k < 3; ++k) {
      const double middle = inner[k].get<double>() - box[k].get<double>();
      const double half = inner[3 + 4 * k].get<double>(), outer = box[3 + 4 * k].get<double>();
      CHECK(std::abs(middle) + half <= outer * (1 + 1e-6));
    }
    n += check_tree(child, node["geometricError"].get<double>());
  }
  return n;
}

}  // namespace

TEST_CASE("levels become tiles that replace their parents, and come back level by level") {
  const SplatCloud leaves = ordinary_cloud(100000, 0, 5);
  EncodeOptions direct;
  direct.profile = Profile::direct;
  direct.chunk_size = 1024;
  Bytes rgs;
  REQUIRE(write_levels(trivial_levels(leaves, {.chunk_size = 1024}), direct, rgs));
  const auto file = PagedFile::open(rgs);
  REQUIRE(file);
  REQUIRE(file->n_levels() == 4);
  Files files, again;
  const auto report = write_tileset(*file, {.threads = 1}, 0, "tiles", into(files));
  REQUIRE(report);
  std::vector<std::string> order;
  const auto put = [&](const std::string& name, std::span<const std::byte> bytes) {
    order.push_back(name);
    return into(again)(name, bytes);
  };
  REQUIRE(write_tileset(*file, {.threads = 3}, 0, "tiles", put));
  CHECK(files == again);
  CHECK(order.front() == "tiles/2_0.glb");
  CHECK(order[1] == "tiles/1_0.glb");
  CHECK(order.back() == "tileset.json");
  const auto refuse = [](const std::string& name, std::span<const std::byte>) -> Status {
    if (name == "tiles/1_0.glb") return make_error(Errc::write_failed, 1, "full");
    return {};
  };
  CHECK(write_tileset(*file, {.threads = 3}, 0, "tiles", refuse).error().code == Errc::write_failed);
  CHECK(report->n_levels == 3);  // a tile holds at most 32 Ki Gaussians, here those of four pages
  CHECK(report->n_regions + 1 == files.size());
  CHECK(report->position_rounding <= 0x1p-13);
  const json tree = tree_of(files);
  CHECK(tree["asset"] == json{{"version", "1.1"}});
  const json used{"KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"};
  CHECK(tree["extensions"]["3DTILES_content_gltf"]["extensionsRequired"] == used);
  CHECK(tree["root"]["refine"] == "REPLACE");
  CHECK_FALSE(tree["root"].contains("transform"));
  CHECK(check_tree(tree["root"], tree["geometricError"].get<double>()) == report->n_regions);
  double error = 0;
  for (const lod::Page& page : file->pages())
    if (page.level == 2) error = std::max(error, 16.0 * static_cast<double>(page.error));
  CHECK(tree["root"]["geometricError"] == error);
  std::uint64_t n_stored = 0;
  for (std::uint32_t i = 0; i < 3; ++i) {
    CAPTURE(i);
    const SplatCloud expected = read_pages(*file, lod::pages_of_level(file->pages(), i)).value();
    ReadOptions options = level(i);
    options.keep_axes = false;
    const auto read = read_files(files, options);
    REQUIRE(read);
    n_stored += read->cloud.size();
    CHECK(read->format == SplatFormat::tileset);
    CHECK(read->n_levels == 3);
    CHECK(read->finest == (i == 0));
    CHECK(read->axes == kAxes3dgs);
    REQUIRE(read->cloud.size() == expected.size());
    const SplatError e = compare(expected, turned_like(expected, read->cloud));
    CHECK(e.mean[0] <= 0x1p-13);
    CHECK(e.opacity <= 0.51 / 255);
  }
  CHECK(report->n_stored == n_stored);
  CHECK(read_files(files)->unused == std::vector<std::string>{"levels of detail but the finest"});
  CHECK(read_files(files, level(3)).error().code == Errc::bad_argument);
}

TEST_CASE("a tileset holds millimetres at ECEF, with the coordinates of the CRS, from levels and from a flat scene") {
  const SplatCloud cloud = ordinary_cloud(300, 1, 9);
  const Origin origin{4.2e6 + 0.125, 1.7e5, -4.8e6};
  for (const bool has_crs : {true, false}) {
    for (const Axes& axes : {kAxes3dgs, Axes{Axis::left, Axis::down, Axis::forward},
                             Axes{Axis::undeclared, Axis::undeclared, Axis::undeclared}}) {
      for (const bool has_levels : {true, false}) {
        CAPTURE(has_crs);
        CAPTURE(axes_text(axes));
        CAPTURE(has_levels);
        WriteOptions options{.metres_per_unit = 1, .axes = axes, .origin = origin};
        if (has_crs) options.crs.text = "EPSG:4978";
        Files files;
        if (has_levels) {
          EncodeOptions direct;
          direct.profile = Profile::direct;
          direct.chunk_size = 32;
          Bytes rgs;
          REQUIRE(write_levels(trivial_levels(cloud, {.chunk_size = 32}), direct, rgs));
          REQUIRE(write_tileset(*PagedFile::open(rgs), options, 3, "a b%", into(files)));
        } else {
          REQUIRE(write_tileset(cloud.view(), options, "a b%", into(files)));
        }
        const json transform = tree_of(files)["root"]["transform"];
        const bool is_declared = axes[0] != Axis::undeclared;
        Origin placed = origin;
        if (!has_crs) convert_axes(placed, axes, kAxes3dTiles);
        for (std::size_t k = 0; k < 3; ++k) CHECK(transform[12 + k] == placed[k]);
        const auto read = read_files(files);
        REQUIRE(read);
        CHECK(read->axes == (has_crs || !is_declared ? axes : kAxes3dTiles));
        CHECK(read->crs.text == (has_crs ? "EPSG:4978" : ""));
        CHECK(read->metres_per_unit == 1);
        CHECK(read->origin == placed);
        SplatFile back = *read;
        convert_axes(back.cloud, back.axes, axes);
        REQUIRE(back.cloud.size() == cloud.size());
        const SplatError e = compare(cloud, turned_like(cloud, back.cloud));
        CHECK(e.mean[0] < 1e-3);
      }
    }
  }
}

TEST_CASE("of tiles that replace each other the finest are read or those some levels above, of others all") {
  const auto glb = [](float x) { return glb_at(x); };
  Files files{{"a.glb", glb(1)}, {"b.glb", glb(2)}, {"sub/c d.glb", glb(3)}, {"d.glb", glb(4)}, {"e.glb", glb(5)}};
  // The first branch has three levels, the second ends with a coarser tile.
  const json branch = tile("b.glb", {tile("", {tile("./sub//c%20d.glb")}), tile("d.glb")});
  files["tileset.json"] = tileset(tile("a.glb", {branch, tile("e.glb")}));
  CHECK(xs_of(read_files(files)) == Xs{3, 4, 5});
  CHECK(read_files(files)->n_levels == 3);
  CHECK(xs_of(read_files(files, level(1))) == Xs{2, 5});
  CHECK(xs_of(read_files(files, level(2))) == Xs{1});
  files["tileset.json"] = tileset(tile("a.glb", {branch, tile("e.glb")}), "ADD");
  CHECK(xs_of(read_files(files)) == Xs{1, 2, 3, 4, 5});
  CHECK(read_files(files)->n_levels == 1);
  // A branch that replaces within one that adds.
  json replaced = branch;
  replaced["refine"] = "REPLACE";
  files["tileset.json"] = tileset(tile("a.glb", {replaced, tile("e.glb")}), "ADD");
  CHECK(xs_of(read_files(files)) == Xs{1, 3, 4, 5});
  CHECK(xs_of(read_files(files, level(1))) == Xs{1, 2, 5});
  // Several contents, some of which are no splats; a tile below which there are none is not replaced.
  json several = tile("");
  for (const char* uri : {"a.glb", "b.glb", "x.b3dm"}) several["contents"].push_back(json::object({{"uri", uri}}));
  several["children"].push_back(tile(""));
  files["x.b3dm"] = bytes_of("b3dm....");
  files["mesh.gltf"] = bytes_of(kMesh);
  files["tileset.json"] = tileset(tile("", {several, tile("mesh.gltf")}));
  CHECK(xs_of(read_files(files)) == Xs{1, 2});
  CHECK(read_files(files)->unused == std::vector<std::string>{"contents of tiles without splats: 2"});
  files["tileset.json"] = tileset(tile("x.b3dm"));
  CHECK(read_files(files).error().code == Errc::not_gaussian_splats);
  // What has no splats replaces none.
  files["mesh.glb"] = glb_of(kMesh);
  for (const char* uri : {"x.b3dm", "mesh.gltf", "mesh.glb"}) {
    CAPTURE(uri);
    files["tileset.json"] = tileset(tile("a.glb", {tile(uri)}));
    CHECK(xs_of(read_files(files)) == Xs{1});
    CHECK(read_files(files)->n_levels == 1);
    CHECK(read_files(files)->unused == std::vector<std::string>{"contents of tiles without splats: 1"});
  }
  // One that is cut off is damaged.
  files["mesh.glb"].pop_back();
  CHECK(read_files(files).error().code == Errc::truncated);
}

TEST_CASE("tiles are placed by their transforms, also through external tilesets") {
  Files files{{"a.glb", glb_at(1)}, {"in/b.glb", glb_at(1)}, {"in/deep/c.glb", glb_at(1)}};
  json turned = tile("b.glb", {tile("deep/tileset.json")});
  turned["transform"] = {0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 10, 0, 0, 1};  // a quarter turn about z, twice as large
  files["in/tileset.json"] = tileset(turned, "ADD");
  files["in/deep/tileset.json"] = tileset(tile("c.glb"));
  json root = tile("a.glb", {tile("in/tileset.json")});
  root["transform"] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1};
  files["tileset.json"] = tileset(root, "ADD");
  const auto file = read_files(files);
  REQUIRE(file);
  // 1, 2, 3 of glTF is 1, -3, 2.
  CHECK(file->cloud.mean == Xs{1, -3, 7, 16, 2, 9, 16, 2, 9});
  CHECK(file->cloud.log_scale[3] == doctest::Approx(file->cloud.log_scale[0] + std::log(2.0F)));
  std::uint64_t bytes = 0;
  for (const auto& [name, content] : files) bytes += content.size();
  CHECK(file->bytes == bytes);
}

TEST_CASE("a tileset is handed over content by content, each with the origin that fits it") {
  Files files{{"a.glb", glb_at(0.1F)}, {"b.glb", glb_at(0.2F)}, {"c.glb", glb_at(0.3F)}};
  std::vector<json> children;
  for (const auto& [uri, x] : std::vector<std::pair<std::string, double>>{{"b.glb", 3e6}, {"c.glb", -5e6}}) {
    children.push_back(tile(uri));
    children.back()["transform"] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1};
  }
  files["tileset.json"] = tileset(tile("a.glb", children), "ADD");
  const TemporaryFolder folder;
  for (const auto& [name, bytes] : files) write_bytes(folder.file(name), bytes);
  ReadOptions options = kKeepAxes;
  std::vector<float> xs;
  std::vector<double> origins;
  options.visit = [&](SplatFile& piece) {
    CHECK(piece.axes == kAxes3dTiles);
    CHECK(piece.cloud.size() == 1);
    CHECK(piece.position_rounding == 0);
    xs.push_back(piece.cloud.mean[0]);
    origins.push_back(piece.origin[0]);
    return Status();
  };
  const auto visited = read_splats(folder.file("tileset.json"), options), whole = read_files(files);
  REQUIRE(visited);
  CHECK(xs == Xs{0.1F, 0.2F, 0.3F});
  CHECK(origins == std::vector<double>{0, 3e6, -5e6});
  CHECK(visited->cloud.size() == 0);
  CHECK(visited->origin == whole->origin);
  CHECK(visited->origin[0] == -1e6);
  CHECK(visited->bytes == whole->bytes);
  CHECK(visited->aa_mode == whole->aa_mode);
  CHECK(visited->unused == whole->unused);
  CHECK(whole->position_rounding > 0.001);
  // An error of the visitor ends the reading.
  options.visit = [&](const SplatFile&) -> Status { return make_error(Errc::read_failed, 1, "enough"); };
  CHECK(read_splats(folder.file("tileset.json"), options).error().offset == 1);
}

TEST_CASE("tiles become nodes of levels, whose leaves are what is read, also where tiles add to each other") {
  Files files{{"a.glb", glb_at(1)}, {"b.glb", glb_at(2)}, {"c.glb", glb_at(3)},
              {"d.glb", glb_at(4)}, {"e.glb", glb_at(5)}, {"mesh.glb", glb_of(kMesh)}};
  const json branch = tile("b.glb", {tile("", {tile("c.glb")}), tile("d.glb")});
  struct Nodes {
    std::vector<std::uint32_t> levels, parents;
    std::vector<float> errors;
    Xs xs;
  };
  const auto nodes_of = [&](const json& root, const std::string& refine) {
    const float scale = root.contains("transform") ? 2 : 1;
    files["tileset.json"] = tileset(root, refine);
    const TemporaryFolder folder;
    for (const auto& [name, bytes] : files) write_bytes(folder.file(name), bytes);
    Nodes out;
    const Bytes bytes = files["tileset.json"];
    const auto tree = open_levels(bytes, folder.path().string(), {});
    REQUIRE(tree);
    if (tree->nodes.empty()) return out;
    CHECK(tree->file.format == SplatFormat::tileset);
    CHECK(tree->file.axes == kAxes3dTiles);
    Xs leaves;
    std::vector<bool> is_leaf(tree->nodes.size(), true);
    for (const LevelTree::Node& node : tree->nodes) {
      out.levels.push_back(node.level);
      out.parents.push_back(node.parent);
      out.errors.push_back(node.error);
      if (node.parent != LevelTree::kNoParent) is_leaf[node.parent] = false;
    }
    std::uint64_t stored = tree->file.bytes;
    REQUIRE(tree->read([&](std::uint32_t node, const SplatFile& piece) {
      CHECK(node == out.xs.size());
      CHECK(piece.cloud.size() == tree->nodes[node].n);
      out.xs.push_back(piece.cloud.mean[0]);
      stored += piece.bytes;
      if (is_leaf[node]) leaves.push_back(piece.cloud.mean[0]);
      return Status();
    }));
    CHECK(leaves == xs_of(read_files(files)));
    std::uint64_t expected = bytes.size();
    for (const float x : std::set<float>(out.xs.begin(), out.xs.end()))
      expected += files[std::string(1, static_cast<char>('a' + std::lround(x / scale) - 1)) + ".glb"].size();
    CHECK(stored == expected);
    return out;
  };
  constexpr std::uint32_t kNone = LevelTree::kNoParent;
  json root = tile("a.glb", {branch, tile("e.glb")});
  root["geometricError"] = 64;
  root["transform"] = {2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1};
  root["children"][0]["geometricError"] = 32;
  const Nodes replaced = nodes_of(root, "REPLACE");
  CHECK(replaced.levels == std::vector<std::uint32_t>{2, 1, 0, 0, 0});
  CHECK(replaced.parents == std::vector<std::uint32_t>{kNone, 0, 1, 1, 0});
  CHECK(replaced.errors == std::vector<float>{8, 4, 0, 0, 0});
  CHECK(replaced.xs == Xs{2, 4, 6, 8, 10});
  // One that does not fall is none.
  root["children"][0]["geometricError"] = 64;
  CHECK(nodes_of(root, "REPLACE").errors == std::vector<float>{0, 8, 0, 0, 0});
  for (const double beyond : {1e300, -1e300, 1e40}) {
    root["geometricError"] = beyond;
    CHECK(nodes_of(root, "REPLACE").errors == std::vector<float>{0, 8, 0, 0, 0});
  }
  root["geometricError"] = 64;
  root["children"][0]["geometricError"] = -1;
  CHECK(nodes_of(root, "REPLACE").errors == std::vector<float>{8, 0, 0, 0, 0});
  root.erase("transform");
  // What is added to a node is beside a repeat of it.
  const Nodes added = nodes_of(root, "ADD");
  CHECK(added.levels == std::vector<std::uint32_t>{2, 0, 1, 0, 0, 0, 0});
  CHECK(added.parents == std::vector<std::uint32_t>{kNone, 0, 0, 2, 2, 2, 0});
  CHECK(added.xs == Xs{1, 1, 2, 2, 3, 4, 5});
  root["children"][0]["refine"] = "REPLACE";
  CHECK(nodes_of(root, "ADD").xs == Xs{1, 1, 2, 3, 4, 5});
  // A tile that something without splats replaces is a leaf.
  const Nodes lost = nodes_of(tile("", {tile("a.glb", {tile("mesh.glb")}), tile("b.glb", {tile("c.glb")})}), "REPLACE");
  CHECK(lost.xs == Xs{1, 2, 3});
  CHECK(nodes_of(tile("", {tile("a.glb"), tile("b.glb")}), "ADD").xs.empty());
}

TEST_CASE("tilesets that are not read are refused with what is wrong") {
  const Bytes glb = glb_at(1);
  const auto refused = [&](const json& stated, const Files& more = {}) {
    Files files = more;
    files["a.glb"] = glb;
    files["tileset.json"] = bytes_of(stated.dump());
    const auto file = read_files(files);
    REQUIRE_FALSE(file);
    CHECK(file.error().what[0] != '\0');
    CAPTURE(stated.dump());
    if (exit_code(file.error().code) == 4) CHECK(file.error().offset == 0);
    return file.error().code;
  };
  const json good = json::parse(text_of(tileset(tile("a.glb"))));
  CHECK(read_files({{"a.glb", glb}, {"tileset.json", bytes_of(good.dump())}}));
  const auto with = [&](const char* pointer, const json& value) {
    json edited = good;
    edited[json::json_pointer(pointer)] = value;
    return edited;
  };
  for (const char* uri :
       {"../a.glb", "sub/../../a.glb", "%2e%2e/a.glb", "/a.glb", "https://example.org/a.glb", "b\\a.glb"})
    CHECK(refused(with("/root/content/uri", uri)) == Errc::unsupported_feature);
  CHECK(refused(with("/root/content/uri", "b.glb")) == Errc::open_failed);
  CHECK(std::string(read_files({{"tileset.json", tileset(tile("b.glb"))}}).error().what).find("a tile") !=
        std::string::npos);
  CHECK(refused(with("/root/content", json::object())) == Errc::bad_syntax);
  CHECK(refused(with("/root/contents", {{"uri", 1}})) == Errc::bad_syntax);
  CHECK(refused(with("/root/content/uri", "c"), {{"c", bytes_of("neither")}}) == Errc::bad_magic);
  CHECK(refused(with("/root/contents", {{{"uri", "./a.glb"}}})) == Errc::unsupported_feature);
  // An external tileset that names itself, or one that is named twice.
  CHECK(refused(with("/root/content/uri", "b.json"), {{"b.json", tileset(tile("b.json"))}}) ==
        Errc::unsupported_feature);
  CHECK(refused(with("/root/content/uri", "tileset.json")) == Errc::unsupported_feature);
  CHECK(refused(with("/root/content/uri", "b.json"), {{"b.json", bytes_of("{\"geometricError\":")}}) ==
        Errc::bad_syntax);
  CHECK(refused(with("/asset/version", "2.0")) == Errc::unsupported_version);
  CHECK(refused(with("/asset", json::object())) == Errc::bad_syntax);
  CHECK(refused(with("/asset/gltfUpAxis", "Z")) == Errc::unsupported_feature);
  CHECK(refused(with("/asset/extras/rgs/axes", "up,up,up")) == Errc::bad_value);
  CHECK(refused(with("/extensionsRequired", {"3DTILES_unknown"})) == Errc::unsupported_feature);
  CHECK(refused(with("/root/refine", "MIX")) == Errc::bad_syntax);
  CHECK(refused(with("/root/children", 1)) == Errc::bad_syntax);
  CHECK(refused(with("/root/children", {1})) == Errc::bad_syntax);
  CHECK(refused(with("/root", 1)) == Errc::bad_syntax);
  CHECK(refused(with("/root/transform", {1, 2})) == Errc::bad_syntax);
  CHECK(refused(with("/root/transform", {1, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1})) ==
        Errc::unsupported_feature);
  CHECK(refused(with("/root/transform", {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 2})) ==
        Errc::unsupported_feature);
  CHECK(refused(with("/root/transform", {-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1})) ==
        Errc::unsupported_feature);
  // Each is a similarity, but not their product.
  for (const double x : {1e200, 1e-200}) {
    const json scales{x, 0, 0, 0, 0, x, 0, 0, 0, 0, x, 0, 0, 0, 0, 1};
    json inner = tile("a.glb");
    inner["transform"] = scales;
    json outer = tile("", {inner});
    outer["transform"] = scales;
    CHECK(refused(json::parse(text_of(tileset(outer)))) == Errc::bad_value);
  }
  // Some overflow by themselves, others with what they move.
  const auto scaled = [](double x) { return json{x, 0, 0, 0, 0, x, 0, 0, 0, 0, x, 0, 0, 0, 0, 1}; };
  CHECK(refused(with("/root/transform", scaled(1e39))) == Errc::bad_value);
  CHECK(refused(with("/root/transform", scaled(1e-39))) == Errc::bad_value);
  SplatCloud wide = ordinary_cloud(1, 1, 7);
  wide.mean = {1e10F, 0, 0};
  Files far{{"b.glb", encode_splats(wide.view(), SplatFormat::glb, {.axes = kAxesGltf}).value()}};
  json large = with("/root/content/uri", "b.glb");
  large["root"]["transform"] = scaled(1e29);
  CHECK(refused(large, far) == Errc::bad_value);
  large["root"]["transform"] = scaled(1e20);
  far["a.glb"] = glb, far["tileset.json"] = bytes_of(large.dump());
  CHECK(read_files(far));
  // Colours of two kinds.
  const Bytes linear = encode_splats(ordinary_cloud(1, 0, 1).view(), SplatFormat::glb,
                                     {.colour_space = ColourSpace::linear_display, .axes = kAxesGltf})
                           .value();
  json both = good;
  both["root"]["contents"].push_back(json::object({{"uri", "b.glb"}}));
  CHECK(refused(both, {{"b.glb", linear}}) == Errc::unsupported_feature);
  CHECK(read_files({{"b.glb", linear}, {"tileset.json", bytes_of(with("/root/content/uri", "b.glb").dump())}})
            ->colour_space == ColourSpace::linear_display);
  // From memory there are no contents; an archive is named.
  CHECK(read_splats(tileset(tile("a.glb"))).error().code == Errc::unsupported_feature);
  const Bytes archive = zipped({{"tileset.json", tileset(tile("a.glb"))}, {"@3dtilesIndex1@", bytes_of("x")}});
  CHECK(std::string(read_splats(archive).error().what).find(".3tz") != std::string::npos);
}

TEST_CASE("an implicit tileset is read as the tiles that its subtrees have") {
  Files files = implicit_files();
  CHECK(xs_of(read_files(files)) == Xs{3});
  CHECK(read_files(files)->n_levels == 3);
  CHECK(xs_of(read_files(files, level(1))) == Xs{2});
  std::uint64_t bytes = 0;
  for (const auto& [name, content] : files) bytes += name.ends_with(".glb") ? 0 : content.size();
  CHECK(read_files(files)->bytes == bytes + files["c/2.3.2.glb"].size());
  // Below another tileset's tile, turned into nodes: errors are halved from level to level.
  json root = implicit_root();
  root["transform"] = {2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1};
  files["in.json"] = tileset(root);
  files["tileset.json"] = tileset(tile("in.json"));
  CHECK(xs_of(read_files(files)) == Xs{6});
  const TemporaryFolder folder;
  for (const auto& [name, content] : files) {
    std::filesystem::create_directories(std::filesystem::path(folder.file(name)).parent_path());
    write_bytes(folder.file(name), content);
  }
  const auto tree = open_levels(files["tileset.json"], folder.path().string(), {});
  REQUIRE(tree);
  REQUIRE(tree->nodes.size() == 3);
  for (std::uint32_t i = 0; i < 3; ++i) CHECK(tree->nodes[i].level == 2 - i);
  CHECK(tree->nodes[0].error == 8);
  CHECK(tree->nodes[1].error == 4);
  // Metadata may state other errors.
  files["s/0/0/0.subtree"] =
      subtree(kFirstSubtree.substr(0, kFirstSubtree.size() - 1) + R"(,"tileMetadata":0})", kFirstBits);
  write_bytes(folder.file("s/0/0/0.subtree"), files["s/0/0/0.subtree"]);
  CHECK(open_levels(files["tileset.json"], folder.path().string(), {})->nodes[1].error == 0);
  // Several contents of a tile, and an octree: z is the highest bit.
  root = implicit_root("OCTREE");
  root.erase("content");
  for (const char* uri : {"a{level}{x}{y}{z}", "b{level}{x}{y}{z}"})
    root["contents"].push_back(json::object({{"uri", uri}}));
  root["implicitTiling"]["availableLevels"] = 2;
  root["implicitTiling"]["subtrees"]["uri"] = "{level}{x}{y}{z}";
  files = {{"tileset.json", tileset(root, "ADD")},
           {"0000", subtree(R"({"buffers":[{"byteLength":6}],"bufferViews":[)"
                            R"({"buffer":0,"byteLength":2},{"buffer":0,"byteOffset":2,"byteLength":2},)"
                            R"({"buffer":0,"byteOffset":4,"byteLength":2}],"tileAvailability":{"bitstream":0},)"
                            R"("contentAvailability":[{"bitstream":1},{"bitstream":2}],)"
                            R"("childSubtreeAvailability":{"constant":1}})",
                            std::string("\x29\0\x21\0\x09\0", 6))},
           {"a0000", glb_at(1)},
           {"b0000", glb_at(2)},
           {"b1010", glb_at(3)},
           {"a1001", glb_at(4)}};
  CHECK(xs_of(read_files(files)) == Xs{1, 2, 3, 4});
}

TEST_CASE("subtrees as drafts of implicit tiling and other writers state them are read") {
  Files files = implicit_files();
  const std::string first = "s/0/0/0.subtree";
  const auto restate = [&](const std::string& from, const std::string& to) {
    std::string text = kFirstSubtree;
    text.replace(text.find(from), from.size(), to);
    files[first] = subtree(text, kFirstBits);
    return read_files(files);
  };
  CHECK(xs_of(restate(R"([{"bitstream":1}])", R"({"bitstream":1})")) == Xs{3});
  CHECK(xs_of(restate(R"("tileAvailability":{"bitstream":0})", R"("tileAvailability":{"bufferView":0})")) == Xs{3});
  CHECK(xs_of(restate(R"([{"bitstream":1}])", R"([{"bitstream":1},{"constant":0}])")) == Xs{3});
  // A tile that has no content says so.
  json root = implicit_root();
  root.erase("content");
  files["tileset.json"] = tileset(tile("", {tile("c/0.0.0.glb"), root}));
  std::string second = kSecondSubtree;
  second.replace(second.find(R"({"constant":1})"), 14, R"({"constant":0})");
  files["s/2/3/2.subtree"] = bytes_of(second);
  CHECK(xs_of(restate(R"([{"bitstream":1}])", R"([{"constant":0}])")) == Xs{1});
  CHECK(restate(R"([{"bitstream":1}])", R"([{"constant":1}])").error().code == Errc::bad_syntax);
  // More contents than files may be open or mapped, all with bits in one file.
  root = implicit_root();
  root.erase("content");
  root["implicitTiling"]["availableLevels"] = root["implicitTiling"]["subtreeLevels"] = 1;
  std::string stated;
  for (int i = 0; i < 70000; ++i) {
    root["contents"].push_back(json::object({{"uri", i == 0 ? "c/0.0.0.glb" : "none"}}));
    stated += i == 0 ? R"({"bitstream":0})" : R"(,{"bitstream":1})";
  }
  files["tileset.json"] = tileset(root);
  files["s/0/0/bits.bin"] = Bytes{std::byte{1}, std::byte{0}};
  files[first] =
      bytes_of(R"({"buffers":[{"uri":"bits.bin","byteLength":2}],"bufferViews":[{"buffer":0,"byteLength":1},)"
               R"({"buffer":0,"byteOffset":1,"byteLength":1}],"tileAvailability":{"constant":1},)"
               R"("childSubtreeAvailability":{"constant":0},"contentAvailability":[)" +
               stated + "]}");
  CHECK(xs_of(read_files(files)) == Xs{1});
}

TEST_CASE("subtrees that are not read are refused at their byte") {
  const auto refused = [&](const Files& changed) {
    Files files = implicit_files();
    for (const auto& [name, bytes] : changed) files[name] = bytes;
    const auto file = read_files(files);
    REQUIRE_FALSE(file);
    CHECK(file.error().what[0] != '\0');
    return std::pair(file.error().code, file.error().offset);
  };
  using Refusal = std::pair<Errc, std::uint64_t>;
  const std::string first = "s/0/0/0.subtree", second = "s/2/3/2.subtree";
  const Bytes good = subtree(kFirstSubtree, kFirstBits);
  const auto edited = [&](std::size_t at, unsigned value) {
    Bytes bytes = good;
    bytes[at] = static_cast<std::byte>(value);
    return Files{{first, bytes}};
  };
  const auto with = [](std::string text, const std::string& from, const std::string& to) {
    REQUIRE(text.find(from) != text.npos);
    return text.replace(text.find(from), from.size(), to);
  };
  const auto restated = [&](const std::string& from, const std::string& to) {
    return Files{{first, subtree(with(kFirstSubtree, from, to), kFirstBits)}};
  };
  const std::uint64_t bits = 24 + kFirstSubtree.size();
  CHECK(refused({{first, Bytes(good.begin(), good.begin() + 20)}}) == Refusal{Errc::truncated, 20});
  CHECK(refused(edited(4, 2)) == Refusal{Errc::unsupported_version, 4});
  CHECK(refused(edited(15, 255)) == Refusal{Errc::truncated, 8});
  CHECK(refused(edited(23, 255)) == Refusal{Errc::truncated, 16});
  CHECK(refused(edited(16, 7)) == Refusal{Errc::trailing_bytes, good.size() - 1});
  CHECK(refused(edited(24, '[')) == Refusal{Errc::bad_syntax, 24});
  CHECK(refused(edited(bits, 0x12)) == Refusal{Errc::bad_value, bits});                   // no root
  CHECK(refused(edited(bits, 0x33)) == Refusal{Errc::bad_value, bits});                   // a bit beyond the tiles
  CHECK(refused(edited(bits + 2, 0x15)) == Refusal{Errc::bad_value, bits + 2});           // content without a tile
  CHECK(refused(edited(bits + 4, 0x10)) == Refusal{Errc::bad_value, bits + 4});           // a subtree without a parent
  CHECK(refused({{"s/2/3/bits.bin", bytes_of("\x03")}}) == Refusal{Errc::bad_value, 0});  // a fourth level
  CHECK(refused({{"s/2/3/bits.bin", {}}}).first == Errc::truncated);
  CHECK(refused({{second, bytes_of(with(kSecondSubtree, "bits%2ebin", "../bits.bin"))}}).first ==
        Errc::unsupported_feature);
  CHECK(refused({{second, bytes_of(with(kSecondSubtree, R"("uri":"bits%2ebin",)", ""))}}) ==
        Refusal{Errc::bad_syntax, 0});
  CHECK(refused(restated(R"("byteLength":8)", R"("byteLength":9)")) == Refusal{Errc::truncated, bits + 1 + 8 - 1});
  CHECK(refused(restated(R"("byteOffset":4,"byteLength":2)", R"("byteOffset":7,"byteLength":2)")) ==
        Refusal{Errc::bad_value, 24});
  CHECK(refused(restated(R"("byteOffset":4,"byteLength":2)", R"("byteOffset":4,"byteLength":1)")) ==
        Refusal{Errc::truncated, bits + 4});
  CHECK(refused(restated(R"({"bitstream":0})", R"({"constant":0})")) == Refusal{Errc::bad_value, 24});
  for (const char* availability : {R"({"constant":2})", R"({"bitstream":3})", R"({"bitstream":-1})", "{}", "0"})
    CHECK(refused(restated(R"({"bitstream":0})", availability)) == Refusal{Errc::bad_syntax, 24});
  CHECK(refused(restated(R"([{"bitstream":1}])", R"([])")) == Refusal{Errc::bad_syntax, 24});
  CHECK(refused(restated(R"([{"bitstream":1}])", R"([{"constant":1}])")).first == Errc::open_failed);
  CHECK(refused({{second, bytes_of("{}")}}) == Refusal{Errc::bad_syntax, 0});
  const auto with_root = [&](const char* pointer, const json& value) {
    json root = implicit_root();
    root[json::json_pointer(pointer)] = value;
    return refused({{"tileset.json", tileset(root)}}).first;
  };
  CHECK(with_root("/children", json::array()) == Errc::bad_syntax);
  CHECK(with_root("/implicitTiling", 1) == Errc::bad_syntax);
  CHECK(with_root("/implicitTiling/subdivisionScheme", "BINARY") == Errc::bad_syntax);
  CHECK(with_root("/implicitTiling/availableLevels", 0) == Errc::bad_syntax);
  CHECK(with_root("/implicitTiling/availableLevels", 61) == Errc::limit_exceeded);
  CHECK(with_root("/implicitTiling/subtreeLevels", 25) == Errc::limit_exceeded);
  CHECK(with_root("/implicitTiling/subtrees", 1) == Errc::bad_syntax);
  CHECK(with_root("/implicitTiling/subtrees/uri", "s/0/0/0.subtree") == Errc::unsupported_feature);
  CHECK(with_root("/content/uri", "c/0.0.0.glb") == Errc::unsupported_feature);
  // All of 2^48 tiles, or a subtree below each, without a bit for any of them.
  const std::string all = R"({"tileAvailability":{"constant":1},"childSubtreeAvailability":{"constant":1},)"
                          R"("contentAvailability":[{"constant":0}]})";
  json root = implicit_root();
  root["implicitTiling"]["availableLevels"] = 60;
  root["implicitTiling"]["subtreeLevels"] = 24;
  CHECK(refused({{"tileset.json", tileset(root)}, {first, bytes_of(all)}}).first == Errc::limit_exceeded);
  // Tiles without end that ask for contents without end, of which there is one.
  std::string views = R"({"buffers":[{"byteLength":3}],"bufferViews":[{"buffer":0,"byteLength":3}],)"
                      R"("tileAvailability":{"constant":1},"childSubtreeAvailability":{"constant":0},)"
                      R"("contentAvailability":[{"bitstream":0})";
  json many = implicit_root();
  many.erase("content");
  many["implicitTiling"]["availableLevels"] = many["implicitTiling"]["subtreeLevels"] = 9;
  for (int i = 0; i < 1000; ++i) {
    many["contents"].push_back(json::object({{"uri", std::to_string(i) + "{level}.{x}.{y}"}}));
    if (i > 0) views += R"(,{"bitstream":0})";
  }
  const std::string n_bytes = std::to_string(((1 << 18) / 3 + 7) / 8);
  for (std::size_t at; (at = views.find(R"("byteLength":3})")) != views.npos;)
    views.replace(at, 14, R"("byteLength":)" + n_bytes);
  std::string last(static_cast<std::size_t>(std::stoi(n_bytes)), '\0');
  last.back() = 16;
  CHECK(refused({{"tileset.json", tileset(many)}, {first, subtree(views + "]}", last)}}).first == Errc::limit_exceeded);
  views = R"({"tileAvailability":{"constant":1},"childSubtreeAvailability":{"constant":0},"contentAvailability":[)";
  for (int i = 0; i < 1000; ++i) views += i == 0 ? R"({"constant":0})" : R"(,{"constant":0})";
  CHECK(refused({{"tileset.json", tileset(many)}, {first, bytes_of(views + "]}")}}).first == Errc::not_gaussian_splats);
  root["implicitTiling"]["subtreeLevels"] = 1;
  CHECK(refused({{"tileset.json", tileset(root)}, {first, bytes_of(all)}}).first == Errc::open_failed);
}

TEST_CASE("limits hold for all tiles of a tileset together") {
  const Files files{
      {"a.glb", glb_at(1)}, {"b.glb", glb_at(2)}, {"tileset.json", tileset(tile("", {tile("a.glb"), tile("b.glb")}))}};
  ReadOptions options = kKeepAxes;
  options.limits.max_gaussians = 2;
  CHECK(read_files(files, options));
  options.limits.max_gaussians = 1;
  CHECK(read_files(files, options).error().code == Errc::limit_exceeded);
  // Deep trees take no stack.
  std::string text = text_of(tileset(tile("a.glb")));
  const std::size_t at = text.find("\"content\"");
  std::string deep;
  for (int i = 0; i < 100000; ++i) deep += "\"children\":[{";
  text.insert(at, deep);
  std::string closing;
  for (int i = 0; i < 100000; ++i) closing += "}]";
  text.insert(text.find("a.glb\"}") + 7, closing);
  CHECK(read_files({{"a.glb", glb_at(1)}, {"tileset.json", bytes_of(text)}}));
}

TEST_CASE("damaged subtrees are refused or read, but never crash") {
  const TemporaryFolder folder;
  for (const auto& [name, bytes] : implicit_files()) {
    std::filesystem::create_directories(std::filesystem::path(folder.file(name)).parent_path());
    write_bytes(folder.file(name), bytes);
  }
  const std::string path = folder.file("s/0/0/0.subtree");
  const auto check = [&](const Bytes& bytes) {
    write_bytes(path, bytes);
    const auto file = read_splats(folder.file("tileset.json"));
    CHECK((file ? file->cloud.view().consistent() : file.error().what[0] != '\0'));
    CHECK((file || exit_code(file.error().code) >= 3));
    return file.has_value();
  };
  const Bytes good = subtree(kFirstSubtree, kFirstBits);
  for (std::size_t n = 0; n < good.size(); ++n)
    CHECK_FALSE(check(Bytes(good.begin(), good.begin() + static_cast<std::ptrdiff_t>(n))));
  for (std::size_t i = 0; i < good.size(); ++i) {
    for (const unsigned flip : {1U, 0x20U, 0x80U}) {
      Bytes bytes = good;
      bytes[i] ^= static_cast<std::byte>(flip);
      check(bytes);
    }
  }
}

TEST_CASE("damaged tilesets are refused or read, but never crash") {
  const TemporaryFolder folder;
  write_bytes(folder.file("a.glb"), glb_at(1));
  write_bytes(folder.file("b.json"), tileset(tile("c.glb")));
  write_bytes(folder.file("c.glb"), glb_at(2));
  json root = tile("", {tile("a.glb"), tile("b.json")});
  root["transform"] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1};
  const Bytes good = tileset(root);
  const std::string path = folder.file("tileset.json");
  const auto check = [&](const Bytes& bytes) {
    write_bytes(path, bytes);
    const auto file = read_splats(path);
    CHECK((file ? file->cloud.view().consistent() : file.error().what[0] != '\0'));
    CHECK((file || exit_code(file.error().code) >= 3));
  };
  for (std::size_t n = 0; n < good.size(); ++n)
    check(Bytes(good.begin(), good.begin() + static_cast<std::ptrdiff_t>(n)));
  for (std::size_t i = 0; i < good.size(); ++i) {
    for (const unsigned flip : {1U, 0x20U, 0x80U}) {
      Bytes bytes = good;
      bytes[i] ^= static_cast<std::byte>(flip);
      check(bytes);
    }
  }
}
