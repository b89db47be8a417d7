// rad_test.cpp - .rad of Spark: files of its own tool, every encoding that it reads, trees, files that are written,
// hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cstring>
#include <functional>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <numeric>
#include <string>

#include "golden_files.hpp"
#include "interchange_samples.hpp"
#include "rgs/level_tree.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/splat_edit.hpp"
#include "temporary_folder.hpp"
#include "trivial_levels.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using nlohmann::json;

std::string golden(const std::string& name) {
  return (golden_folder() / "rad" / name).string();
}

ReadOptions level(std::uint32_t wanted) {
  ReadOptions options;
  options.level_of_detail = wanted;
  return options;
}

// Half a step of the encodings that are written, for ordinary_cloud(); rotations of 8 bits an angle, at worst.
SplatError half_steps(double log_scale, double colour) {
  SplatError e;
  for (double& step : e.mean) step = 0;
  for (double& step : e.log_scale) step = log_scale / 254 / 2 + 1e-5;
  e.opacity = 0.501 / 255;
  e.rotation = 0.013;
  e.sh[0] = 0.501 / 255 * colour / 0.28209479;
  for (int d = 1; d < 4; ++d) e.sh[d] = 0.501 / 127;
  return e;
}

void check_within(const SplatError& e, const SplatError& most) {
  for (int k = 0; k < 3; ++k) {
    CHECK(e.mean[k] == 0);
    CHECK(e.log_scale[k] <= most.log_scale[k]);
  }
  CHECK(e.opacity <= most.opacity);
  CHECK(e.rotation <= most.rotation);
  for (int d = 0; d < 4; ++d) CHECK(e.sh[d] <= most.sh[d]);
}

// `cloud` in the order of `like`, by means, which .rad keeps exactly.
SplatCloud ordered_like(const SplatCloud& like, SplatCloud cloud) {
  REQUIRE(like.size() == cloud.size());
  const auto key = [](const SplatCloud& c, std::uint64_t i) {
    return std::array{c.mean[3 * i], c.mean[3 * i + 1], c.mean[3 * i + 2]};
  };
  const auto sorted = [&](const SplatCloud& c) {
    std::vector<std::uint64_t> rows(c.size());
    std::iota(rows.begin(), rows.end(), std::uint64_t{0});
    std::ranges::sort(rows, {}, [&](std::uint64_t i) { return key(c, i); });
    return rows;
  };
  const std::vector<std::uint64_t> to = sorted(like), from = sorted(cloud);
  std::vector<std::uint64_t> kept(cloud.size());
  for (std::size_t i = 0; i < to.size(); ++i) kept[to[i]] = from[i];
  SplatCloud out;
  out.resize(cloud.size(), cloud.sh_degree);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) out.set(i, cloud.view().splat(kept[i]));
  return out;
}

// ---- files built from the format's description, without compression -------------------------------------------------

struct Property {
  std::string name, encoding;
  Bytes bytes;
  json more = json::object();
};

template <class T>
void add(Bytes& bytes, T value) {
  const auto raw = std::as_bytes(std::span(&value, 1));
  bytes.insert(bytes.end(), raw.begin(), raw.end());
}
void fill(Bytes& bytes) {
  bytes.resize((bytes.size() + 7) / 8 * 8);
}
Bytes with_json(const char* magic, const json& of) {
  Bytes bytes = bytes_of(magic);
  const std::string text = of.dump();
  add(bytes, static_cast<std::uint32_t>(text.size()));
  const Bytes inside = bytes_of(text);
  bytes.insert(bytes.end(), inside.begin(), inside.end());
  fill(bytes);
  return bytes;
}

using Edit = std::function<void(json& file, json& chunk)>;

// A chunk of `n` Gaussians. `edit` changes the JSON of file and chunk before they are written.
Bytes rad(std::uint64_t n, const std::vector<Property>& properties, json file = json::object(), const Edit& edit = {}) {
  Bytes payload;
  json list = json::array();
  for (const Property& p : properties) {
    json entry{{"offset", payload.size()}, {"bytes", p.bytes.size()}, {"property", p.name}, {"encoding", p.encoding}};
    entry.update(p.more);
    list.push_back(entry);
    payload.insert(payload.end(), p.bytes.begin(), p.bytes.end());
    fill(payload);
  }
  json chunk{{"version", 1}, {"base", 0}, {"count", n}, {"payloadBytes", payload.size()}, {"properties", list}};
  json meta{{"version", 1}, {"type", "gsplat"}, {"count", n}, {"chunks", {{{"offset", 0}, {"bytes", 0}}}}};
  if (file.is_object()) meta.update(file);
  if (edit) edit(meta, chunk);
  Bytes second = with_json("RADC", chunk);
  add(second, std::uint64_t{payload.size()});
  second.insert(second.end(), payload.begin(), payload.end());
  if (meta["chunks"].is_array() && !meta["chunks"].empty() && meta["chunks"][0]["bytes"] == 0)
    meta["chunks"][0]["bytes"] = second.size();
  Bytes bytes = with_json("RAD0", meta);
  bytes.insert(bytes.end(), second.begin(), second.end());
  return bytes;
}

// One dimension after the other; `plane` of the bytes of numbers in *_lebytes.
Bytes array_of(const std::vector<std::vector<float>>& rows, const std::string& encoding, float low = 0,
               float high = 1) {
  Bytes bytes;
  const bool planes = encoding.ends_with("_lebytes");
  const std::size_t width = encoding.starts_with("f32") ? 4 : encoding.find("f16") != std::string::npos ? 2 : 1;
  for (std::size_t plane = 0; plane < (planes ? width : 1); ++plane) {
    for (std::size_t k = 0; k < rows[0].size(); ++k) {
      int last = 0;
      for (const auto& row : rows) {
        Bytes one;
        if (width == 4) {
          add(one, row[k]);
        } else if (width == 2) {
          add(one, half_from_float(row[k]));
        } else {
          const bool is_signed = encoding.starts_with("s8");
          const int code =
              static_cast<int>(std::lround(is_signed ? row[k] / high * 127 : (row[k] - low) / (high - low) * 255));
          add(one, static_cast<std::uint8_t>(code - (encoding.ends_with("_delta") ? std::exchange(last, code) : 0)));
        }
        const auto first = one.begin() + static_cast<std::ptrdiff_t>(plane);
        bytes.insert(bytes.end(), first, planes ? first + 1 : one.end());
      }
    }
  }
  return bytes;
}

const json kBounds{{"min", -2}, {"max", 2}};

// Three Gaussians by hand, with numbers that all encodings hold or nearly hold.
std::vector<Property> three(const std::string& center = "f32", const std::string& alpha = "f32",
                            const std::string& rgb = "f32", const std::string& scales = "f32",
                            const std::string& orientation = "f32") {
  const float e = std::exp(1.F);
  std::vector<std::vector<float>> size{{e, 1, 1 / e}, {e, e, 1}, {1, 1, 1}};
  if (scales == "ln_f16")
    for (auto& row : size)
      for (float& x : row) x = std::log(x);
  return {{"center", center, array_of({{1, 2, -3}, {0.5F, 0, 8}, {-4, 5, 6}}, center)},
          {"alpha", alpha, array_of({{0.2F}, {0.4F}, {0.6F}}, alpha), {{"min", 0}, {"max", 1}}},
          {"rgb", rgb, array_of({{0, 0.2F, 0.4F}, {1, 0.6F, 0.8F}, {0.2F, 0, 1}}, rgb, -2, 2), kBounds},
          {"scales", scales, array_of(size, scales)},
          {"orientation", orientation, array_of({{0.6F, 0, 0}, {0, -0.28F, 0}, {0.5F, 0.5F, 0.5F}}, orientation)}};
}

Bytes tree_of(const std::vector<std::uint16_t>& counts, const std::vector<std::uint32_t>& starts) {
  const std::size_t n = counts.size();
  std::vector<std::vector<float>> xyz, one(n, {0.5F}), grey(n, {0.5F, 0.5F, 0.5F});
  for (std::size_t i = 0; i < n; ++i) xyz.push_back({static_cast<float>(i), 0, 0});
  const auto raw = [](const auto& values) {
    const auto bytes = std::as_bytes(std::span(values));
    return Bytes(bytes.begin(), bytes.end());
  };
  return rad(n,
             {{"center", "f32", array_of(xyz, "f32")},
              {"alpha", "f32", array_of(one, "f32")},
              {"rgb", "f32", array_of(grey, "f32")},
              {"scales", "f32", array_of(grey, "f32")},
              {"orientation", "f32", array_of(grey, "f32")},
              {"child_count", "u16", raw(counts)},
              {"child_start", "u32", raw(starts)}},
             {{"lodTree", true}});
}

// The means' x of each node, and of the leaves by their positions.
struct NodesRead {
  std::vector<std::vector<float>> x;
  std::map<std::uint32_t, float> leaves;
};
NodesRead read_nodes(const LevelTree& tree) {
  NodesRead out;
  std::vector<bool> is_leaf(tree.nodes.size(), true);
  for (const LevelTree::Node& node : tree.nodes)
    if (node.parent != LevelTree::kNoParent) is_leaf[node.parent] = false;
  REQUIRE(tree.read([&](std::uint32_t node, const SplatFile& piece) -> Status {
    CHECK(node == out.x.size());
    CHECK(piece.cloud.size() == tree.nodes[node].n);
    CHECK(is_leaf[node] == (tree.nodes[node].level == 0));
    REQUIRE(piece.source_index.size() == piece.cloud.size());
    out.x.emplace_back();
    for (std::uint64_t i = 0; i < piece.cloud.size(); ++i) {
      out.x.back().push_back(piece.cloud.mean[3 * i]);
      if (is_leaf[node]) CHECK(out.leaves.emplace(piece.source_index[i], out.x.back().back()).second);
    }
    std::ranges::sort(out.x.back());
    return {};
  }));
  return out;
}

Bytes rgs_of(const SplatCloud& leaves, const EncodeOptions& options = {}) {
  Bytes bytes;
  EncodeOptions direct = options;
  direct.profile = Profile::direct;
  direct.chunk_size = 32;
  REQUIRE(write_levels(trivial_levels(leaves, {.chunk_size = 32, .page_chunks = 2}), direct, bytes));
  return bytes;
}

Bytes with_levels(const Bytes& rgs, WriteOptions options = {}, LevelsReport* report = nullptr) {
  const auto file = PagedFile::open(rgs);
  REQUIRE(file);
  options.axes = file->head().declarations().axes;
  options.origin = file->head().declarations().origin;
  Bytes bytes;
  const auto written = write_rad(*file, options, kMaxShDegree, [&](const std::string&, std::span<const std::byte> put) {
    bytes.assign(put.begin(), put.end());
    return Status();
  });
  REQUIRE(written);
  if (report != nullptr) *report = *written;
  return bytes;
}

}  // namespace

TEST_CASE("files of Spark's own tool: leaves are the scene that they were made from") {
  for (const auto& [name, degree] :
       {std::pair<const char*, int>("tree.rad", 3), {"palette.rad", 2}, {"chunked-lod.rad", 3}}) {
    const std::string file_name = name;
    CAPTURE(file_name);
    const auto file = read_splats(golden(name));
    REQUIRE(file);
    CHECK(file->format == SplatFormat::rad);
    CHECK(file->n_levels > 2);
    CHECK(file->unused == std::vector<std::string>{"levels of detail but the finest"});
    const SplatCloud source = ordinary_cloud(40, degree, 7), read = ordered_like(source, file->cloud);
    CHECK(read.sh_degree == degree);
    // Spark has FP16 in between, stores log-scales from -12 to 9 and alphas up to 2, and takes the nearest code of each
    // number of a rotation.
    SplatError most = half_steps(21, 1);
    for (double& step : most.log_scale) step += 4 * 0x1p-11;
    for (double& step : most.sh) step += 4 * 0x1p-12;
    most.opacity = 0.501 / 127 + 0x1p-12;
    most.rotation = 0.025;
    check_within(compare(source, read), most);
    std::uint64_t last = 41;
    for (std::uint32_t i = 0; i < file->n_levels; ++i) {
      const auto cut = read_splats(golden(name), level(i));
      REQUIRE(cut);
      CHECK(cut->cloud.size() < last);
      CHECK(cut->finest == (i == 0));
      last = cut->cloud.size();
    }
    CHECK(last == 1);
    CHECK(read_splats(golden(name), level(file->n_levels)).error().code == Errc::bad_argument);
  }
  const auto chunked = read_splats(golden("chunked-lod.rad"));
  CHECK(chunked->bytes == std::filesystem::file_size(golden("chunked-lod.rad")) +
                              std::filesystem::file_size(golden("chunked-lod-0.radc")));
}

TEST_CASE("a .radc is read with its .rad, and not alone") {
  const TemporaryFolder folder;
  std::filesystem::copy_file(golden("chunked-lod.rad"), folder.file("a.rad"));
  const auto missing = read_splats(folder.file("a.rad"));
  REQUIRE_FALSE(missing);
  CHECK(missing.error().code == Errc::open_failed);
  std::filesystem::copy_file(golden("chunked-lod-0.radc"), folder.file("chunked-lod-0.radc"));
  CHECK(read_splats(folder.file("a.rad"))->cloud.size() == 40);
  const auto alone = read_splats(folder.file("chunked-lod-0.radc"));
  REQUIRE_FALSE(alone);
  CHECK(alone.error().code == Errc::unsupported_feature);
  std::ofstream(folder.file("chunked-lod-0.radc"), std::ios::app) << "x";
  CHECK(read_splats(folder.file("a.rad")).error().code == Errc::size_mismatch);
  for (const char* name : {"../a.radc", "a/b.radc", ".a", "", "a\\b"}) {
    const Bytes bytes = rad(3, three(), {}, [&](json& file, json&) {
      file["chunks"] = {{{"offset", 0}, {"bytes", 9}, {"filename", name}}};
    });
    write_bytes(folder.file("b.rad"), bytes);
    CHECK(read_splats(folder.file("b.rad")).error().code == Errc::bad_syntax);
  }
}

TEST_CASE("every encoding that Spark reads") {
  const auto exact = read_splats(rad(3, three()));
  REQUIRE(exact);
  const Splat first = exact->cloud.view().splat(0);
  CHECK(first.mean[2] == -3);
  CHECK(first.log_scale[0] == doctest::Approx(1));
  CHECK(first.log_scale[2] == doctest::Approx(-1));
  CHECK(first.rotation[0] == doctest::Approx(0.8));
  CHECK(first.rotation[1] == doctest::Approx(0.6));
  CHECK(opacity_from_logit(first.opacity_logit) == doctest::Approx(0.2));
  CHECK(first.sh[0] == doctest::Approx(-0.5 / 0.28209479));
  CHECK(exact->n_levels == 0);
  CHECK(read_splats(rad(3, three()), level(0)).error().code == Errc::bad_argument);
  for (const std::vector<Property>& properties :
       {three("f16"), three("f32_lebytes"), three("f16_lebytes"), three("f32", "f16"), three("f32", "r8"),
        three("f32", "f32", "f16"), three("f32", "f32", "r8"), three("f32", "f32", "r8_delta"),
        three("f32", "f32", "f32", "ln_f16"), three("f32", "f32", "f32", "f32", "f16")}) {
    const auto file = read_splats(rad(3, properties));
    REQUIRE(file);
    const SplatError e = compare(exact->cloud, file->cloud);
    CHECK(e.mean[0] == 0);
    CHECK(e.opacity < 0.002);
    CHECK(e.log_scale[0] < 1e-3);
    CHECK(e.rotation < 0.001);
    CHECK(e.sh[0] < 0.5 * 4 / 255 / 0.282 + 1e-4);
  }
  for (const std::string encoding : {"f32", "f16", "r8", "r8_delta", "s8", "s8_delta"}) {
    CAPTURE(encoding);
    for (const bool palette : {false, true}) {
      std::vector<std::vector<float>> sh;
      for (int i = 0; i < 3; ++i) {
        sh.emplace_back();
        for (int k = 0; k < 9; ++k) sh.back().push_back(static_cast<float>(i - 1) + 0.1F * static_cast<float>(k));
      }
      std::vector<Property> properties = three();
      properties.push_back({palette ? "sh1_code" : "sh1", encoding, array_of(sh, encoding, -2, 2), kBounds});
      Bytes labels;
      for (const std::uint32_t label : {2U, 0U, 1U}) add(labels, label);
      if (palette) properties.push_back({"sh_label", "u32", labels});
      const auto file = read_splats(rad(3, properties, {{"maxSh", 1}}));
      REQUIRE(file);
      for (std::size_t i = 0; i < 3; ++i) {
        for (std::size_t k = 0; k < 9; ++k) {
          const float expected = sh[palette ? std::array{2U, 0U, 1U}[i] : i][k];
          CHECK(file->cloud.sh[12 * i + 3 + k] == doctest::Approx(expected).epsilon(0.01));
        }
      }
    }
  }
  // A scale of 0, and a profile that is wider than a Gaussian: one of opacity 1 that Spark would inflate likewise.
  std::vector<Property> properties = three();
  properties[1].bytes = array_of({{1.25F}, {1}, {0}}, "f32");
  properties[3] = {"scales", "ln_0r8", Bytes(9, std::byte{1}), {{"min", -6}, {"max", 3}}};
  properties[3].bytes[1] = std::byte{0};
  properties[3].bytes[2] = std::byte{255};
  const auto file = read_splats(rad(3, properties));
  REQUIRE(file);
  CHECK(file->cloud.log_scale[0] == doctest::Approx(-6 + 3 / (3 * 2.718281828)));  // (2^2 - 1) / (3 e)
  CHECK(file->cloud.log_scale[3] == doctest::Approx(std::log(0x1p-26)));
  CHECK(file->cloud.log_scale[6] == doctest::Approx(3));
  CHECK(opacity_from_logit(file->cloud.opacity_logit[0]) > 0.999F);
}

TEST_CASE("a level is a cut through the tree by generations above the leaves") {
  // 0 above 1, 2; 1 above 3, 4, 5; 3 above 6. 2, 4, 5, 6 are leaves; 7, 8 are of no tree: one above the other.
  const Bytes bytes = tree_of({2, 3, 0, 1, 0, 0, 0, 1, 0}, {1, 3, 0, 6, 0, 0, 0, 8, 0});
  const auto x = [&](std::uint32_t wanted) {
    std::vector<int> read;
    const auto file = read_splats(bytes, level(wanted));
    REQUIRE(file);
    for (std::uint64_t i = 0; i < file->cloud.size(); ++i) read.push_back(static_cast<int>(file->cloud.mean[3 * i]));
    return read;
  };
  CHECK(x(0) == std::vector<int>{2, 4, 5, 6, 8});
  CHECK(x(1) == std::vector<int>{2, 3, 4, 5, 7});
  CHECK(x(2) == std::vector<int>{1, 2, 7});
  CHECK(x(3) == std::vector<int>{0, 7});
  CHECK(read_splats(bytes)->n_levels == 4);
  for (const auto& [counts, starts] :
       {std::pair<std::vector<std::uint16_t>, std::vector<std::uint32_t>>({1, 1, 0}, {2, 2, 0}),  // two parents
        {{1, 1, 0}, {1, 0, 0}},                                                                   // in a circle
        {{1, 0, 0}, {0, 0, 0}},                                                                   // below itself
        {{3, 0, 0}, {1, 0, 0}},                                                                   // beyond the end
        {{1, 0, 0}, {4000000000, 0, 0}}}) {
    const auto file = read_splats(tree_of(counts, starts));
    REQUIRE_FALSE(file);
    CHECK(file.error().code == Errc::bad_value);
    CHECK(file.error().offset == 8);
  }
}

TEST_CASE("levels are cuts that halve, in parts of at most a page, which those below them replace") {
  // Four below each: 1, 4, 16, 64, 256, 1024 and 4096 leaves.
  constexpr std::uint32_t kInner = 1365;
  std::vector<std::uint16_t> counts(kInner + 4096);
  std::vector<std::uint32_t> starts(counts.size());
  for (std::uint32_t i = 0; i < kInner; ++i) counts[i] = 4, starts[i] = 4 * i + 1;
  const Bytes bytes = tree_of(counts, starts);
  const auto tree = open_levels(bytes, "", {});
  REQUIRE(tree);
  CHECK(tree->file.format == SplatFormat::rad);
  CHECK(tree->file.bytes == bytes.size());
  CHECK(tree->file.unused.empty());
  const NodesRead nodes = read_nodes(*tree);
  std::map<std::uint32_t, std::uint64_t> n_of_level;
  std::vector<std::vector<float>> below(tree->nodes.size());
  for (std::size_t i = 0; i < tree->nodes.size(); ++i) {
    const LevelTree::Node& node = tree->nodes[i];
    n_of_level[node.level] += node.n;
    CHECK(node.error == 0);
    CHECK(node.n <= 1536);
    if (node.parent == LevelTree::kNoParent) continue;
    CHECK(node.parent < i);
    CHECK(tree->nodes[node.parent].level == node.level + 1);
    below[node.parent].insert(below[node.parent].end(), nodes.x[i].begin(), nodes.x[i].end());
  }
  // Without the one Gaussian above all.
  CHECK(n_of_level == std::map<std::uint32_t, std::uint64_t>{{0, 4096}, {1, 1024}, {2, 256}, {3, 64}, {4, 16}, {5, 4}});
  CHECK(tree->nodes.size() == 5 + 3);  // the leaves are three parts, side by side
  CHECK(nodes.x[5].back() < nodes.x[6].front());
  for (std::size_t i = 0; i < tree->nodes.size(); ++i) {
    if (tree->nodes[i].level == 0) continue;
    std::vector<float> expected;
    for (const float x : nodes.x[i])
      for (int k = 1; k <= 4; ++k) expected.push_back(4 * x + static_cast<float>(k));
    std::ranges::sort(below[i]);
    CHECK(below[i] == expected);
  }
  // Positions are those in what is read without levels.
  const auto leaves = read_splats(bytes);
  REQUIRE(nodes.leaves.size() == leaves->cloud.size());
  for (const auto& [position, x] : nodes.leaves) CHECK(x == leaves->cloud.mean[3 * std::size_t{position}]);
  ReadOptions few;
  few.limits.max_gaussians = counts.size() - 1;
  CHECK(open_levels(bytes, "", few).error().code == Errc::limit_exceeded);
}

TEST_CASE("a cut that does not halve is no level, nor a part that would be the same") {
  // As above: 2, 4, 5, 6, 8, then 2, 3, 4, 5, 7 and 1, 2, 7, then 0 and 7.
  const auto tree = open_levels(tree_of({2, 3, 0, 1, 0, 0, 0, 1, 0}, {1, 3, 0, 6, 0, 0, 0, 8, 0}), "", {});
  REQUIRE(tree);
  const NodesRead nodes = read_nodes(*tree);
  CHECK(nodes.x == std::vector<std::vector<float>>{{0, 7}, {2, 4, 5, 6, 8}});
  // 1,800 leaves and one above 1,802 more: the coarsest part that has nothing below it is one of leaves.
  std::vector<std::uint16_t> counts(3603);
  counts[1800] = 1802;
  std::vector<std::uint32_t> starts(3603);
  starts[1800] = 1801;
  const auto mixed = open_levels(tree_of(counts, starts), "", {});
  REQUIRE(mixed);
  std::vector<std::pair<std::uint32_t, std::uint32_t>> kinds;
  for (const LevelTree::Node& node : mixed->nodes) kinds.emplace_back(node.level, node.parent);
  constexpr std::uint32_t kNone = LevelTree::kNoParent;
  CHECK(kinds == std::vector<std::pair<std::uint32_t, std::uint32_t>>{{0, kNone}, {1, kNone}, {0, 1}, {0, 1}});
  CHECK(read_nodes(*mixed).leaves.size() == 3602);
  // Without a tree there are no levels, and what has no order is cut apart all the same.
  const auto none = open_levels(rad(3, three()), "", {});
  REQUIRE(none);
  CHECK(none->nodes.empty());
  Bytes damaged = tree_of(counts, starts);
  const std::array begin{0.F, 1.F, 2.F};
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const auto raw = std::as_bytes(std::span(begin));
  const auto first = std::search(damaged.begin(), damaged.end(), raw.begin(), raw.end()) - damaged.begin();
  for (std::size_t i = 0; i < 3603; i += 3) put(damaged, static_cast<std::size_t>(first) + 4 * i, nan);
  const auto unordered = open_levels(damaged, "", {});
  REQUIRE(unordered);
  CHECK(unordered->nodes.size() == 4);
  // Files beside it are read if there is a folder.
  CHECK(open_levels(read_bytes(golden("chunked-lod.rad")), (golden_folder() / "rad").string(), {})->nodes.size() == 3);
  CHECK(open_levels(read_bytes(golden("chunked-lod.rad")), "", {}).error().code == Errc::unsupported_feature);
}

TEST_CASE("a scene is written within half a step, in its order, in chunks of 65,536") {
  for (const int degree : {0, 1, 3}) {
    CAPTURE(degree);
    const SplatCloud cloud = ordinary_cloud(degree == 0 ? 70000 : 500, degree, 3);
    WriteReport report;
    const auto bytes = encode_splats(cloud.view(), SplatFormat::rad, {.threads = 1, .strict = true}, &report);
    REQUIRE(bytes);
    CHECK_FALSE(report.any());
    const auto file = read_splats(*bytes);
    REQUIRE(file);
    CHECK(file->n_levels == 0);
    check_within(compare(cloud, file->cloud), half_steps(10, 1));
    CHECK(*bytes == encode_splats(cloud.view(), SplatFormat::rad, {.threads = 3}).value());
  }
  SplatCloud cloud = ordinary_cloud(4, 1, 3);
  cloud.log_scale[0] = -std::numeric_limits<float>::infinity();
  cloud.log_scale[3] = -20;
  cloud.sh[0] = 9;
  cloud.sh[20] = 1.5F;
  WriteReport report;
  const auto bytes = encode_splats(cloud.view(), SplatFormat::rad, {}, &report);
  REQUIRE(bytes);
  CHECK(report.log_scale.n == 1);
  CHECK(report.log_scale.largest == doctest::Approx(8));
  CHECK(report.sh_dc.n == 1);
  CHECK(report.sh.n == 1);
  CHECK_FALSE(encode_splats(cloud.view(), SplatFormat::rad, {.strict = true}));
  const auto file = read_splats(*bytes);
  REQUIRE(file);
  CHECK(file->cloud.log_scale[0] == doctest::Approx(std::log(0x1p-26)));
  CHECK(file->cloud.log_scale[3] == doctest::Approx(-12));
  CHECK(file->cloud.sh[20] == doctest::Approx(1));
  CHECK(read_splats(encode_splats(SplatCloud().view(), SplatFormat::rad).value())->cloud.size() == 0);
}

TEST_CASE("levels become a tree: every Gaussian is below one of its page's parent") {
  for (const int degree : {0, 2}) {
    CAPTURE(degree);
    const SplatCloud leaves = ordinary_cloud(3000, degree, 5);
    const Bytes rgs = rgs_of(leaves);
    const auto file = PagedFile::open(rgs);
    REQUIRE(file);
    REQUIRE(file->n_levels() == 4);
    LevelsReport report;
    const Bytes bytes = with_levels(rgs, {}, &report);
    CHECK(report.n_levels == 5);
    CHECK(report.n_stored == file->n_stored() + 1);
    CHECK_FALSE(report.clamped.any());
    for (std::uint32_t i = 0; i < 4; ++i) {
      CAPTURE(i);
      const SplatCloud expected = read_pages(*file, lod::pages_of_level(file->pages(), i)).value();
      const auto read = read_splats(bytes, level(i));
      REQUIRE(read);
      CHECK(read->n_levels == 5);
      CHECK(read->cloud.size() == expected.size());
      SplatError most = half_steps(12.1, 1);
      most.opacity = 0.51 / 255;
      check_within(compare(expected, ordered_like(expected, read->cloud)), most);
    }
    const auto root = read_splats(bytes, level(4));
    REQUIRE(root);
    REQUIRE(root->cloud.size() == 1);
    for (std::size_t k = 0; k < 3; ++k) {
      CHECK(std::abs(root->cloud.mean[k]) < 8);  // a few are as wide as the scene
      CHECK(root->cloud.log_scale[k] > 1);
      CHECK(root->cloud.log_scale[k] < 3.2F);
    }
    CHECK(with_levels(rgs, {.threads = 1}) == with_levels(rgs, {.threads = 3}));
  }
  // One page has no level above, and more Gaussians at a level than below it are left out.
  CHECK(read_splats(with_levels(rgs_of(ordinary_cloud(20, 0, 5))), level(0))->cloud.size() == 20);
  CHECK(read_splats(with_levels(rgs_of(ordinary_cloud(1, 0, 5))))->n_levels == 1);
  SplatCloud same = ordinary_cloud(600, 0, 5);
  std::ranges::fill(same.mean, 1.F);
  CHECK(read_splats(with_levels(rgs_of(same)), level(0))->cloud.size() == 600);
}

TEST_CASE("children of a .rad lie near their parent") {
  // A line of Gaussians: each coarser one's children are the leaves around it.
  SplatCloud line = ordinary_cloud(256, 0, 5);
  for (std::uint64_t i = 0; i < line.size(); ++i) {
    line.mean[3 * i] = static_cast<float>(i);
    line.mean[3 * i + 1] = line.mean[3 * i + 2] = 0;
  }
  const Bytes bytes = with_levels(rgs_of(line));
  const auto leaves = read_splats(bytes), above = read_splats(bytes, level(1));
  REQUIRE(leaves);
  REQUIRE(above);
  REQUIRE(above->cloud.size() == 64);
  // Leaves are in the order of their parents, of which each has four.
  for (std::uint64_t i = 0; i < 256; ++i)
    CHECK(std::abs(leaves->cloud.mean[3 * i] - above->cloud.mean[3 * (i / 4)]) <= 4);
}

TEST_CASE("a .rad is in the axes of 3DGS, without an origin") {
  const SplatCloud cloud = ordinary_cloud(200, 1, 5);
  EncodeOptions options;
  options.axes = {Axis::right, Axis::up, Axis::backward};
  options.origin = {10.1, 20, 30};
  LevelsReport report;
  const Bytes rgs = rgs_of(cloud, options);
  const auto read = read_splats(with_levels(rgs, {}, &report));
  REQUIRE(read);
  CHECK(report.position_rounding > 0);
  double mean = 0;
  for (std::uint64_t i = 0; i < 200; ++i) mean += static_cast<double>(read->cloud.mean[3 * i + 1]) / 200;
  CHECK(std::abs(mean + 20) < 2);  // up is -down
  const auto paged = PagedFile::open(rgs);
  WriteOptions strict{.axes = options.axes, .origin = options.origin, .strict = true};
  CHECK(write_rad(*paged, strict, 3, [](auto&&...) { return Status(); }).error().code == Errc::bad_value);
}

TEST_CASE("a .rad that contradicts itself is refused, with the offset") {
  const auto refused = [](const Edit& edit, Errc code, bool in_chunk = true, std::vector<Property> properties = three(),
                          const json& file = json::object()) {
    const Bytes bytes = rad(3, properties, file, edit);
    const auto read = read_splats(bytes);
    REQUIRE_FALSE(read);
    CAPTURE(read.error().what);
    CHECK(std::string(errc_name(read.error().code)) == errc_name(code));
    std::uint32_t json_bytes = 0;
    std::memcpy(&json_bytes, bytes.data() + 4, 4);
    const std::uint64_t chunk = 8 + (json_bytes + 7) / 8 * 8;
    CHECK(read.error().offset == (in_chunk ? chunk + 8 : 8));
  };
  refused([](json& f, json&) { f["version"] = 2; }, Errc::unsupported_version, false);
  refused([](json& f, json&) { f["type"] = "mesh"; }, Errc::unsupported_feature, false);
  refused([](json& f, json&) { f.erase("count"); }, Errc::bad_syntax, false);
  refused([](json& f, json&) { f["chunks"] = 3; }, Errc::bad_syntax, false);
  refused([](json& f, json&) { f["chunks"][0].erase("offset"); }, Errc::bad_syntax, false);
  refused([](json& f, json&) { f["chunks"][0]["offset"] = 8; }, Errc::bad_header, false);
  refused([](json& f, json&) { f["maxSh"] = 4; }, Errc::unsupported_feature, false);
  refused([](json& f, json&) { f["count"] = 4; }, Errc::size_mismatch, false);
  refused([](json& f, json&) { f["count"] = 1e30; }, Errc::bad_syntax, false);
  refused([](json& f, json&) { f["count"] = std::uint64_t{1} << 40; }, Errc::limit_exceeded, false);
  refused([](json&, json& c) { c["version"] = 0; }, Errc::unsupported_version);
  refused([](json&, json& c) { c["base"] = 1; }, Errc::bad_header);
  refused([](json&, json& c) { c["count"] = 0; }, Errc::bad_header);
  refused([](json&, json& c) { c["count"] = 4; }, Errc::bad_header);
  refused([](json&, json& c) { c["count"] = 2; }, Errc::size_mismatch);
  refused([](json&, json& c) { c["properties"] = 2; }, Errc::bad_syntax);
  const auto property = [](const char* key, const json& value) {
    return [key, value](json&, json& c) { c["properties"][1][key] = value; };
  };
  refused(property("property", "colour"), Errc::unsupported_feature);
  refused(property("encoding", "r9"), Errc::unsupported_feature);
  refused(property("encoding", "oct88r8"), Errc::unsupported_feature);
  refused(property("compression", "zstd"), Errc::unsupported_feature);
  refused(property("bytes", nullptr), Errc::bad_syntax);
  refused(property("bytes", 11), Errc::size_mismatch);
  refused(property("offset", 0), Errc::bad_header);
  refused(property("property", "center"), Errc::unsupported_feature, true, three("f32", "r8"));
  refused([](json&, json& c) { c["properties"][1].erase("max"); }, Errc::bad_syntax, true, three("f32", "r8"));
  refused([](json&, json& c) { c["properties"][1]["min"] = 1e300; }, Errc::bad_syntax, true, three("f32", "r8"));
  refused({}, Errc::missing_section, true, three(), {{"maxSh", 1}});
  refused({}, Errc::missing_section, true, three(), {{"lodTree", true}});
  for (const std::size_t gone : {0U, 4U}) {
    std::vector<Property> properties = three();
    properties.erase(properties.begin() + static_cast<std::ptrdiff_t>(gone));
    refused({}, Errc::missing_section, true, properties);
  }
  // What a deflate stream unfolds to must be the Gaussians; and what is promised is checked before.
  std::vector<Property> properties = three();
  properties[0].more["compression"] = "gz";
  const auto damaged = read_splats(rad(3, properties));
  REQUIRE_FALSE(damaged);
  CHECK(damaged.error().code == Errc::bad_value);
  const auto huge = [](json& file, json& chunk) {
    file["count"] = chunk["count"] = 300000000;
    for (json& p : chunk["properties"]) p["compression"] = "gz";
  };
  const auto promised = read_splats(rad(3, three("f16", "r8", "r8", "ln_f16", "f16"), {}, huge));
  REQUIRE_FALSE(promised);
  CHECK(promised.error().code == Errc::limit_exceeded);
  CHECK(promised.error().offset == 8);
  // Labels count as what they stand for: 66 bytes without harmonics, 6 of labels, 27 of the palette, 27 of its rows.
  properties = three("f16", "r8", "r8", "ln_f16", "f16");
  properties.push_back({"sh1_code", "s8", Bytes(27), kBounds});
  properties.push_back({"sh_label", "u16", Bytes(6)});
  const Bytes labelled = rad(3, properties, {{"maxSh", 1}});
  ReadOptions options;
  options.limits.max_decoded_bytes = 126;
  CHECK(read_splats(labelled, options));
  options.limits.max_decoded_bytes = 125;
  CHECK(read_splats(labelled, options).error().code == Errc::limit_exceeded);
  properties = three();
  properties.push_back({"sh1_code", "s8", Bytes(27), kBounds});
  properties.push_back({"sh_label", "u16", Bytes(6, std::byte{3})});
  CHECK(read_splats(rad(3, properties, {{"maxSh", 1}})).error().code == Errc::bad_value);
}

TEST_CASE("damaged .rad files are refused or read, but never crash") {
  check_hostile(encode_splats(ordinary_cloud(30, 2, 5).view(), SplatFormat::rad).value(), 3);
  check_hostile(with_levels(rgs_of(ordinary_cloud(100, 0, 5))), 4);
  check_hostile(read_bytes(golden("palette.rad")), 5, 300);
  const Bytes whole = tree_of({2, 3, 0, 1, 0, 0, 0, 1, 0}, {1, 3, 0, 6, 0, 0, 0, 8, 0});
  SplitMix random(7);
  for (int i = 0; i < 1000; ++i) {
    Bytes damaged = whole;
    damaged[random.below(damaged.size())] = static_cast<std::byte>(random.below(256));
    const auto tree = open_levels(damaged, "", {});
    if (tree) (void)tree->read([](std::uint32_t, const SplatFile&) { return Status(); });
  }
}
