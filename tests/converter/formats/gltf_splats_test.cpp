// gltf_splats_test.cpp - .glb with KHR_gaussian_splatting: round trips, nodes, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <functional>
#include <nlohmann/json.hpp>

#include "complexity.hpp"
#include "interchange_samples.hpp"
#include "rgs/splat_edit.hpp"

using namespace rgs;
using namespace rgs::test;
using nlohmann::json;

namespace {

json json_of(const Bytes& glb) {
  const std::string text = text_of(glb).substr(20, get<std::uint32_t>(glb, 12));
  return json::parse(text);
}

// The file with its JSON chunk replaced.
Bytes with_json(const Bytes& glb, const json& root) {
  std::string text = root.dump();
  text.resize((text.size() + 3) / 4 * 4, ' ');
  const std::size_t bin = 20 + get<std::uint32_t>(glb, 12);
  Bytes file(glb.begin(), glb.begin() + 20);
  const Bytes chunk = bytes_of(text);
  file.insert(file.end(), chunk.begin(), chunk.end());
  file.insert(file.end(), glb.begin() + static_cast<std::ptrdiff_t>(bin), glb.end());
  put(file, 8, static_cast<std::uint32_t>(file.size()));
  put(file, 12, static_cast<std::uint32_t>(text.size()));
  return file;
}

Result<SplatFile> read_edited(const Bytes& glb, const std::function<void(json&)>& edit) {
  json root = json_of(glb);
  edit(root);
  return read_splats(with_json(glb, root), kKeepAxes);
}

}  // namespace

TEST_CASE(".glb round trip: exact to the last places of a float") {
  for (int degree = 0; degree <= 3; ++degree) {
    for (const std::uint64_t n : {0U, 1U, 500U}) {
      CAPTURE(degree);
      CAPTURE(n);
      const SplatCloud cloud = ordinary_cloud(n, degree, n + 1);
      const auto bytes = encode_splats(cloud.view(), SplatFormat::glb, {.colour_space = ColourSpace::linear_display});
      REQUIRE(bytes);
      const auto file = read_splats(*bytes, kKeepAxes);
      REQUIRE(file);
      CHECK(file->format == SplatFormat::glb);
      CHECK(file->axes == kAxesGltf);
      CHECK(file->colour_space == ColourSpace::linear_display);
      const SplatError e = compare(file->cloud, cloud);
      CHECK(file->cloud.mean == cloud.mean);
      CHECK(file->cloud.sh == cloud.sh);
      for (const double error : e.log_scale) CHECK(error <= 1e-6);
      CHECK(e.opacity <= 1e-7);
      CHECK(e.rotation <= 1e-6);
    }
  }
}

TEST_CASE(".glb: a primitive's extras hold what the extension does not define") {
  const SplatCloud cloud = ordinary_cloud(20, 0, 3);
  const auto plain = encode_splats(cloud.view(), SplatFormat::glb);
  REQUIRE(plain);
  CHECK_FALSE(json_of(*plain)["meshes"][0]["primitives"][0].contains("extras"));
  WriteOptions options;
  options.aa_mode = AaMode::mip_splatting;
  options.low_pass_px2 = 0.3F;
  options.metres_per_unit = 0.5F;
  const auto glb = encode_splats(cloud.view(), SplatFormat::glb, options);
  REQUIRE(glb);
  const auto file = read_splats(*glb);
  REQUIRE(file);
  CHECK(file->aa_mode == AaMode::mip_splatting);
  CHECK(file->low_pass_px2 == 0.3F);
  CHECK(file->metres_per_unit == 0.5F);
  // A scaling node changes the unit along with the scene.
  const auto scaled = read_edited(*glb, [](json& root) { root["nodes"][0]["scale"] = {4, 4, 4}; });
  REQUIRE(scaled);
  CHECK(scaled->metres_per_unit == 0.125F);
  const auto with_extras = [&](const json& ours) {
    return read_edited(*glb, [&](json& root) {
      root["meshes"][0]["primitives"][0]["extras"] = {{"rgs", ours}, {"theirs", {{"anti_aliasing", 7}}}};
    });
  };
  CHECK(with_extras({{"anti_aliasing", "classic"}})->aa_mode == AaMode::classic);
  CHECK(with_extras({{"of_a_later_version", {1, 2}}})->aa_mode == AaMode::classic);
  CHECK(with_extras(nullptr)->aa_mode == AaMode::classic);
  for (const json& wrong : {json{{"anti_aliasing", "best"}}, json{{"low_pass_px2", -1}}, json{{"low_pass_px2", {1}}},
                            json{{"metres_per_unit", 1e300}}, json{{"axes", true}}}) {
    CAPTURE(wrong.dump());
    const auto refused = with_extras(wrong);
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::bad_value);
  }
}

TEST_CASE(".glb writes what glTF requires") {
  const SplatCloud cloud = ordinary_cloud(9, 1, 1);
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::glb).value();
  const json root = json_of(bytes);
  CHECK(bytes.size() % 4 == 0);
  CHECK(get<std::uint32_t>(bytes, 8) == bytes.size());
  CHECK(root["asset"]["version"] == "2.0");
  CHECK(root["extensionsUsed"] == json::array({"KHR_gaussian_splatting"}));
  const json& primitive = root["meshes"][0]["primitives"][0];
  CHECK(primitive["mode"] == 0);
  CHECK(primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse");
  CHECK(primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display");
  CHECK(primitive["attributes"].size() == 5 + 4);
  const json& position = root["accessors"][primitive["attributes"]["POSITION"].get<std::size_t>()];
  for (std::size_t k = 0; k < 3; ++k) {
    float low = cloud.mean[k], high = cloud.mean[k];
    for (std::size_t i = k; i < cloud.mean.size(); i += 3) {
      low = std::min(low, cloud.mean[i]), high = std::max(high, cloud.mean[i]);
    }
    CHECK(position["min"][k].get<float>() == low);
    CHECK(position["max"][k].get<float>() == high);
  }
  CHECK(root["buffers"][0]["byteLength"] == bytes.size() - 28 - get<std::uint32_t>(bytes, 12));
}

TEST_CASE(".glb: nodes move, turn and scale their meshes, however often they show them") {
  const SplatCloud cloud = ordinary_cloud(50, 3, 2);
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::glb).value();
  const double half = std::sqrt(0.5);
  const auto file = read_edited(bytes, [&](json& root) {
    root["nodes"] = json::parse(R"([{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "scale": [2, 2, 2]},
                                    {"mesh": 0, "matrix": [0, 3, 0, 0, -3, 0, 0, 0, 0, 0, 3, 0, 5, 6, 7, 1]}])");
    root["nodes"][0]["rotation"] = {half, 0, 0, half};  // a quarter turn about x
    root["scenes"][0]["nodes"] = {0, 2};
  });
  REQUIRE(file);
  REQUIRE(file->cloud.size() == 100);
  SplatCloud first = cloud, second = cloud;
  transform_splats(first, {rotation_from_euler({90, 0, 0}), 2, {1, 2, 3}});
  transform_splats(second, {rotation_from_euler({0, 0, 90}), 3, {5, 6, 7}});
  append_splats(first, second);
  const SplatError e = compare(file->cloud, first);
  for (const double error : e.mean) CHECK(error <= 1e-5);
  for (const double error : e.log_scale) CHECK(error <= 2e-6);
  for (const double error : e.sh) CHECK(error <= 1e-6);
  CHECK(e.rotation <= 1e-6);
}

TEST_CASE(".glb: far nodes get one origin in the middle of theirs, and the rounding is stated") {
  const SplatCloud cloud = ordinary_cloud(50, 0, 2);
  const auto read = [&](double left, double right) {
    return read_edited(encode_splats(cloud.view(), SplatFormat::glb).value(), [&](json& root) {
      root["nodes"] = {{{"mesh", 0}, {"translation", {left, 0, 0}}}, {{"mesh", 0}, {"translation", {right, 0, 0}}}};
      root["scenes"][0]["nodes"] = {0, 1};
    });
  };
  const auto near = read(4e6, 4e6 + 16), far = read(-6.4e6, 6.4e6);
  REQUIRE(near);
  CHECK(near->origin == Origin{4e6 + 8, 0, 0});
  CHECK(near->position_rounding < 1e-6);
  REQUIRE(far);
  CHECK(far->origin == kNoOrigin);
  CHECK(far->position_rounding > 0.1);
  CHECK(far->position_rounding <= 0.25);
}

TEST_CASE(".glb: unsupported or invalid input is refused with its reason") {
  const Bytes bytes = encode_splats(ordinary_cloud(4, 1, 3).view(), SplatFormat::glb).value();
  const auto refused = [&](const std::function<void(json&)>& edit, Errc code) {
    const auto file = read_edited(bytes, edit);
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
  };
  refused([](json& r) { r["nodes"][0]["scale"] = {1, 2, 1}; }, Errc::unsupported_feature);
  refused([](json& r) { r["nodes"][0]["scale"] = {-1, -1, -1}; }, Errc::unsupported_feature);
  refused([](json& r) { r["nodes"][0]["rotation"] = {0, 0, 0, 0}; }, Errc::unsupported_feature);
  refused([](json& r) { r["nodes"][0]["translation"] = {"a", 0, 0}; }, Errc::bad_syntax);
  refused([](json& r) { r["nodes"][0]["children"] = {0}; }, Errc::bad_syntax);
  refused([](json& r) { r["scenes"][0]["nodes"] = {1}; }, Errc::bad_syntax);
  refused([](json& r) { r["scenes"][0]["nodes"] = json::array(); }, Errc::not_gaussian_splats);
  refused([](json& r) { r["meshes"][0]["primitives"][0].erase("extensions"); }, Errc::not_gaussian_splats);
  refused([](json& r) { r["meshes"][0]["primitives"][0]["mode"] = 4; }, Errc::bad_syntax);
  refused([](json& r) { r["meshes"][0]["primitives"][0]["attributes"].erase("KHR_gaussian_splatting:SCALE"); },
          Errc::bad_syntax);
  refused(
      [](json& r) { r["meshes"][0]["primitives"][0]["attributes"].erase("KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"); },
      Errc::bad_syntax);
  refused([](json& r) { r["accessors"][0]["count"] = 5; }, Errc::truncated);
  refused([](json& r) { r["accessors"][0]["count"] = 3; }, Errc::bad_syntax);
  refused([](json& r) { r["accessors"][0]["count"] = 4294967295U; }, Errc::truncated);
  refused([](json& r) { r["accessors"][0]["count"] = 1.5; }, Errc::bad_syntax);
  refused([](json& r) { r["accessors"][0]["componentType"] = 5123; }, Errc::unsupported_feature);
  refused([](json& r) { r["accessors"][0]["sparse"] = json::object(); }, Errc::unsupported_feature);
  refused([](json& r) { r["bufferViews"][0]["byteOffset"] = 4294967295U; }, Errc::truncated);
  refused([](json& r) { r["bufferViews"][0]["byteStride"] = 4; }, Errc::bad_syntax);
  refused([](json& r) { r["bufferViews"][0]["buffer"] = 1; }, Errc::unsupported_feature);
  refused(  // one mesh, shown repeatedly
      [](json& r) {
        for (int i = 0; i < 100; ++i) r["meshes"][0]["primitives"].push_back(r["meshes"][0]["primitives"][0]);
        for (int i = 1; i < 400; ++i) {
          r["nodes"].push_back({{"mesh", 0}});
          r["scenes"][0]["nodes"].push_back(i);
        }
      },
      Errc::limit_exceeded);
}

TEST_CASE(".glb: no mesh of a node is dropped silently") {
  const Bytes bytes = encode_splats(ordinary_cloud(4, 2, 3).view(), SplatFormat::glb).value();
  const auto refused = [&](const std::function<void(json&)>& edit, Errc code) {
    const auto file = read_edited(bytes, edit);
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
    CHECK(file.error().offset == 20);
  };
  const auto attributes = [](json& r) -> json& { return r["meshes"][0]["primitives"][0]["attributes"]; };
  refused([](json& r) { r["nodes"][0]["mesh"] = 1; }, Errc::bad_syntax);
  refused([](json& r) { r["nodes"][0]["mesh"] = "0"; }, Errc::bad_syntax);
  refused([](json& r) { r["meshes"][0].erase("primitives"); }, Errc::bad_syntax);
  refused([](json& r) { r["nodes"].push_back(r["nodes"][0]), r["nodes"][0]["children"] = 1; }, Errc::bad_syntax);
  refused([&](json& r) { attributes(r).erase("KHR_gaussian_splatting:SH_DEGREE_1_COEF_0"); },
          Errc::unsupported_feature);
  refused(
      [&](json& r) {
        attributes(r)["KHR_gaussian_splatting:SH_DEGREE_4_COEF_0"] =
            attributes(r)["KHR_gaussian_splatting:SH_DEGREE_1_COEF_0"];
      },
      Errc::unsupported_feature);
}

TEST_CASE(".glb: meshes of unlike degrees and several primitives are one scene") {
  const SplatCloud a = ordinary_cloud(5, 0, 1), b = ordinary_cloud(7, 2, 2);
  Bytes file = encode_splats(a.view(), SplatFormat::glb).value();
  json root = json_of(file);
  const json other = json_of(encode_splats(b.view(), SplatFormat::glb).value());
  const Bytes more = encode_splats(b.view(), SplatFormat::glb).value();
  const std::size_t bin = 28 + get<std::uint32_t>(more, 12), first_bytes = root["buffers"][0]["byteLength"];
  file.insert(file.end(), more.begin() + static_cast<std::ptrdiff_t>(bin), more.end());
  const std::size_t n_views = root["bufferViews"].size(), n_accessors = root["accessors"].size();
  for (json view : other["bufferViews"]) {
    view["byteOffset"] = view["byteOffset"].get<std::size_t>() + first_bytes;
    root["bufferViews"].push_back(view);
  }
  for (json accessor : other["accessors"]) {
    accessor["bufferView"] = accessor["bufferView"].get<std::size_t>() + n_views;
    root["accessors"].push_back(accessor);
  }
  json primitive = other["meshes"][0]["primitives"][0];
  for (json& index : primitive["attributes"]) index = index.get<std::size_t>() + n_accessors;
  root["meshes"][0]["primitives"].push_back(primitive);
  root["nodes"].push_back({{"mesh", 0}, {"translation", {0, 0, 1}}});
  root["scenes"][0]["nodes"] = {0, 1};
  root["buffers"][0]["byteLength"] = first_bytes + more.size() - bin;
  put(file, 20 + get<std::uint32_t>(file, 12), static_cast<std::uint32_t>(first_bytes + more.size() - bin));
  const auto read = read_splats(with_json(file, root), kKeepAxes);
  REQUIRE(read);
  SplatCloud expected = a;
  append_splats(expected, b);
  SplatCloud moved = expected;
  transform_splats(moved, {glm::dmat3(1.0), 1, {0, 0, 1}});
  append_splats(expected, moved);
  const SplatError e = compare(read->cloud, expected);
  for (const double error : e.mean) CHECK(error <= 1e-6);
  for (const double error : e.sh) CHECK(error == 0);
}

namespace {

// `n_nodes` nodes that all show one mesh of `n_primitives`.
Bytes many_instances(const SplatCloud& cloud, std::uint64_t n_nodes, std::uint64_t n_primitives) {
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::glb).value();
  json root = json_of(bytes);
  const json primitive = root["meshes"][0]["primitives"][0], node{{"mesh", 0}, {"rotation", {0, 0, 1, 0}}};
  root["meshes"][0]["primitives"] = std::vector<json>(n_primitives, primitive);
  root["nodes"] = std::vector<json>(n_nodes, node);
  std::vector<std::uint64_t> indices(n_nodes);
  for (std::uint64_t i = 0; i < n_nodes; ++i) indices[i] = i;
  root["scenes"][0]["nodes"] = indices;
  return with_json(bytes, root);
}

}  // namespace

TEST_CASE("growth: .glb: reading is linear in the Gaussians that nodes show") {
  const SplatCloud one = ordinary_cloud(1, 0, 4);
  const auto read = [](const Bytes& file) { CHECK(read_splats(file)); };
  CHECK(growth(
            3000, [&](std::uint64_t n) { return many_instances(one, n, 1); }, read) < kLinearGrowth);
  CHECK(growth(
            3000, [&](std::uint64_t n) { return many_instances(one, 1, n); }, read) < kLinearGrowth);
  // Nodes without Gaussians are work as well.
  const SplatCloud none = ordinary_cloud(0, 0, 4);
  const auto refuse = [](const Bytes& file) { CHECK_FALSE(read_splats(file)); };
  CHECK(growth(
            500, [&](std::uint64_t n) { return many_instances(none, n, n); }, refuse) < kLinearGrowth);
}

TEST_CASE(".glb: the file's size bounds what its nodes may show") {
  for (const std::uint64_t n : {std::uint64_t{0}, std::uint64_t{1}}) {
    const auto refused = read_splats(many_instances(ordinary_cloud(n, 0, 4), 3000, 3000));
    REQUIRE_FALSE(refused);
    CHECK(std::string(errc_name(refused.error().code)) == "limit_exceeded");
    CHECK(refused.error().offset == 20);
    CHECK(refused.error().found > refused.error().expected);
  }
  // A small scene may repeat its trees.
  const auto forest = read_splats(many_instances(ordinary_cloud(50, 0, 5), 100, 1));
  REQUIRE(forest);
  CHECK(forest->cloud.size() == 5000);
}

TEST_CASE("damaged .glb files are refused or read, but never crash") {
  check_hostile(encode_splats(ordinary_cloud(4, 0, 3).view(), SplatFormat::glb).value(), 8, 1000);
}
