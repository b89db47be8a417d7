// gltf_splats_test.cpp - .glb with KHR_gaussian_splatting: round trips, nodes, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <functional>
#include <nlohmann/json.hpp>

#include "complexity.hpp"
#include "golden_files.hpp"
#include "interchange_samples.hpp"
#include "rgs/splat_edit.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;
using nlohmann::json;

namespace {

json json_of(const Bytes& glb) {
  const std::string text = text_of(glb).substr(20, get<std::uint32_t>(glb, 12));
  return json::parse(text);
}

Bytes bin_of(const Bytes& glb) {
  return {glb.begin() + 28 + get<std::uint32_t>(glb, 12), glb.end()};
}

Bytes make_glb(const json& root, Bytes bin) {
  std::string text = root.dump();
  text.resize((text.size() + 3) / 4 * 4, ' ');
  bin.resize((bin.size() + 3) / 4 * 4);
  Bytes file = bytes_of("glTF\2" + std::string(11, '\0') + "JSON" + text + std::string(4, '\0') + "BIN" + '\0');
  put(file, 12, static_cast<std::uint32_t>(text.size()));
  put(file, 20 + text.size(), static_cast<std::uint32_t>(bin.size()));
  file.insert(file.end(), bin.begin(), bin.end());
  put(file, 8, static_cast<std::uint32_t>(file.size()));
  return file;
}

// The file with its JSON chunk replaced.
Bytes with_json(const Bytes& glb, const json& root) {
  return make_glb(root, bin_of(glb));
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

TEST_CASE(".glb: COLOR_0, for viewers that show points, is linear") {
  SplatCloud cloud = ordinary_cloud(1, 0, 1);
  cloud.opacity_logit[0] = 0;
  cloud.sh = {0, 10, -10};  // colours of 1/2, above 1 and below 0
  for (const ColourSpace space : {ColourSpace::srgb_display, ColourSpace::linear_display}) {
    const Bytes bytes = encode_splats(cloud.view(), SplatFormat::glb, {.colour_space = space}).value();
    const json root = json_of(bytes);
    const json& accessor =
        root["accessors"][root["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"].get<std::size_t>()];
    const std::uint64_t at = root["bufferViews"][accessor["bufferView"].get<std::size_t>()]["byteOffset"];
    const Bytes bin = bin_of(bytes);
    const std::array<int, 4> expected{space == ColourSpace::srgb_display ? 55 : 128, 255, 0, 128};
    for (std::uint64_t k = 0; k < 4; ++k) CHECK(get<std::uint8_t>(bin, at + k) == expected[k]);
  }
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
  refused([](json& r) { r["accessors"][2]["componentType"] = 5123; }, Errc::unsupported_feature);
  refused([](json& r) { r["accessors"][0].erase("bufferView"); }, Errc::unsupported_feature);
  refused([](json& r) { r["accessors"][0]["bufferView"] = 99; }, Errc::bad_syntax);
  refused([](json& r) { r["accessors"][0]["sparse"] = json::object(); }, Errc::bad_syntax);
  refused([](json& r) { r["bufferViews"][0]["byteOffset"] = 4294967295U; }, Errc::truncated);
  refused([](json& r) { r["bufferViews"][0]["byteStride"] = 4; }, Errc::bad_syntax);
  refused([](json& r) { r["bufferViews"][0]["buffer"] = 1; }, Errc::bad_syntax);
  refused([](json& r) { r["buffers"][0]["uri"] = "scene.bin"; }, Errc::unsupported_feature);
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

namespace {

struct Stored {
  int component = 0;
  bool normalized = false;
  std::uint64_t accessor = 0, components = 0;
  double one() const {
    return !normalized ? 1 : component == 5120 ? 127 : component == 5121 ? 255 : component == 5122 ? 32767 : 65535;
  }
  std::uint64_t bytes_each() const { return component == 5126 ? 4 : component < 5122 ? 1 : 2; }
  void store(Bytes& bin, std::uint64_t at, double value) const {
    const auto code = static_cast<std::int64_t>(std::lround(value * one()));
    if (component == 5126) {
      put(bin, at, static_cast<float>(value));
    } else if (component < 5122) {
      put(bin, at, static_cast<std::uint8_t>(code));
    } else {
      put(bin, at, static_cast<std::uint16_t>(code));
    }
  }
};

// Four Gaussians whose attribute `s.accessor` is stored as `s` says, every `stride` bytes.
Bytes quantised(const Stored& s, std::uint64_t stride,
                const std::function<double(std::uint64_t, std::uint64_t)>& value) {
  const Bytes plain = encode_splats(ordinary_cloud(4, 0, 3).view(), SplatFormat::glb).value();
  json root = json_of(plain);
  Bytes bin = bin_of(plain);
  const std::uint64_t start = bin.size(), bytes = 3 * stride + s.components * s.bytes_each();
  bin.resize(start + bytes);
  for (std::uint64_t i = 0; i < 4; ++i) {
    for (std::uint64_t k = 0; k < s.components; ++k) s.store(bin, start + stride * i + k * s.bytes_each(), value(i, k));
  }
  root["buffers"][0]["byteLength"] = bin.size();
  json& accessor = root["accessors"][s.accessor];
  accessor["bufferView"] = root["bufferViews"].size();
  accessor["componentType"] = s.component;
  accessor["normalized"] = s.normalized;
  root["bufferViews"].push_back({{"buffer", 0}, {"byteOffset", start}, {"byteLength", bytes}, {"byteStride", stride}});
  return make_glb(root, bin);
}

}  // namespace

TEST_CASE(".glb: attributes of all types that the extension allows, in any stride") {
  const auto signed_value = [](std::uint64_t i, std::uint64_t k) {
    return (static_cast<double>(i) - 2) / 2 + 0.03 * static_cast<double>(k);
  };
  const auto unsigned_value = [](std::uint64_t i, std::uint64_t k) {
    return (static_cast<double>(i) + 1) / 5 + 0.03 * static_cast<double>(k);
  };
  for (const int component : {5120, 5121, 5122, 5123, 5126}) {
    for (const bool normalized : {false, true}) {
      for (const auto& [accessor, components, which] :
           {std::tuple{0U, 3U, 0}, {2U, 4U, 1}, {3U, 3U, 2}, {4U, 1U, 3}, {5U, 3U, 4}}) {
        const Stored s{component, normalized, accessor, components};
        const bool is_signed = component == 5120 || component == 5122, is_float = component == 5126;
        const bool allowed = is_float || which == 0 || (which == 1 && is_signed && normalized) ||
                             (which == 2 && !is_signed) || (which == 3 && !is_signed && normalized);
        const int attribute = which, type = component;
        CAPTURE(attribute);
        CAPTURE(type);
        CAPTURE(normalized);
        const auto value = [&](std::uint64_t i, std::uint64_t k) {
          const double v = attribute < 2 && (is_signed || is_float) ? signed_value(i, k) : unsigned_value(i, k);
          return normalized || is_float ? v : std::round(50 * v);
        };
        const std::uint64_t stride =
            (components * s.bytes_each() + 3) / 4 * 4 + 4 * static_cast<std::uint64_t>(normalized);
        const auto file = read_splats(quantised(s, stride, value), kKeepAxes);
        REQUIRE(file.has_value() == allowed);
        if (!allowed) {
          CHECK(file.error().code == Errc::unsupported_feature);
          continue;
        }
        for (std::uint64_t i = 0; i < 4; ++i) {
          const Splat splat = file->cloud.view().splat(i);
          for (std::uint64_t k = 0; k < components; ++k) {
            const double got = which == 0   ? static_cast<double>(splat.mean[k])
                               : which == 1 ? static_cast<double>(splat.rotation[(k + 1) % 4])
                               : which == 2 ? std::exp(static_cast<double>(splat.log_scale[k]))
                               : which == 3 ? static_cast<double>(opacity_from_logit(splat.opacity_logit))
                                            : static_cast<double>(splat.sh[k]);
            CHECK(std::abs(got - value(i, k)) <= (is_float ? 1e-6 : 0.5001 / s.one() * (normalized ? 1 : 1e-4)) + 1e-5);
          }
        }
      }
    }
  }
  // The lowest code of a signed type is -1, as the next one.
  const auto lowest = read_splats(quantised({5120, true, 2, 4}, 4, [](auto, auto) { return -128.0 / 127; }), kKeepAxes);
  REQUIRE(lowest);
  CHECK(lowest->cloud.rotation[0] == -1);
}

TEST_CASE(".glb: sparse accessors replace single elements, of a buffer view or of zeros") {
  const SplatCloud cloud = ordinary_cloud(4, 0, 3);
  const Bytes plain = encode_splats(cloud.view(), SplatFormat::glb).value();
  const auto read = [&](int component, std::vector<std::uint32_t> indices, const std::function<void(json&)>& edit) {
    json root = json_of(plain);
    Bytes bin = bin_of(plain);
    const std::uint64_t start = bin.size(), bytes_each = component == 5121 ? 1 : component == 5123 ? 2 : 4;
    bin.resize(start + 4 * indices.size() + 12 * indices.size());
    for (std::uint64_t k = 0; k < indices.size(); ++k) {
      std::memcpy(&bin[start + k * bytes_each], &indices[k], bytes_each);
      for (std::uint64_t c = 0; c < 3; ++c)
        put(bin, start + 4 * indices.size() + 12 * k + 4 * c, static_cast<float>(100 * k + c));
    }
    const std::uint64_t view = root["bufferViews"].size();
    root["bufferViews"].push_back({{"buffer", 0}, {"byteOffset", start}, {"byteLength", 4 * indices.size()}});
    root["bufferViews"].push_back(
        {{"buffer", 0}, {"byteOffset", start + 4 * indices.size()}, {"byteLength", 12 * indices.size()}});
    root["accessors"][0]["sparse"] = {{"count", indices.size()},
                                      {"indices", {{"bufferView", view}, {"componentType", component}}},
                                      {"values", {{"bufferView", view + 1}}}};
    edit(root);
    return read_splats(make_glb(root, bin), kKeepAxes);
  };
  const auto as_is = [](json&) {};
  for (const int component : {5121, 5123, 5125}) {
    CAPTURE(component);
    const auto file = read(component, {1, 3}, as_is);
    REQUIRE(file);
    const auto zeros = read(component, {1, 3}, [](json& r) { r["accessors"][0].erase("bufferView"); });
    REQUIRE(zeros);
    for (std::uint64_t k = 0; k < 12; ++k) {
      const std::uint64_t i = k / 3, c = k % 3;
      CHECK(file->cloud.mean[k] == (i == 1   ? static_cast<float>(c)
                                    : i == 3 ? static_cast<float>(100 + c)
                                             : cloud.mean[k]));
      CHECK(zeros->cloud.mean[k] == (i == 1 ? static_cast<float>(c) : i == 3 ? static_cast<float>(100 + c) : 0.F));
    }
  }
  const auto refused = [&](std::vector<std::uint32_t> indices, const std::function<void(json&)>& edit, Errc code,
                           std::uint64_t offset) {
    const auto file = read(5125, std::move(indices), edit);
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
    if (offset != 0) CHECK(file.error().offset == offset);
  };
  refused({3, 1}, as_is, Errc::bad_value, 0);
  refused({1, 1}, as_is, Errc::bad_value, 0);
  refused({4}, as_is, Errc::bad_value, 0);
  refused({0, 1, 2, 3, 3}, as_is, Errc::bad_syntax, 20);
  refused(
      {1}, [](json& r) { r["accessors"][0]["sparse"]["count"] = 2; }, Errc::truncated, 0);
  refused(
      {1}, [](json& r) { r["accessors"][0]["sparse"]["indices"]["componentType"] = 5126; }, Errc::bad_syntax, 20);
  refused(
      {1}, [](json& r) { r["accessors"][0]["sparse"]["values"].erase("bufferView"); }, Errc::bad_syntax, 20);
  // Zeros take no bytes, so a count alone must not make a scene.
  const auto count_alone = [](json& r) {
    r["accessors"][0]["sparse"]["count"] = 1;
    for (json& accessor : r["accessors"]) {
      accessor["sparse"] = r["accessors"][0]["sparse"];
      accessor.erase("bufferView");
      accessor["count"] = 4000000000U;
    }
  };
  refused({0, 1}, count_alone, Errc::limit_exceeded, 20);
}

namespace {

std::string base64(const Bytes& bytes) {
  constexpr const char* kDigits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    std::uint32_t code = 0;
    for (std::size_t k = i; k < i + 3; ++k)
      code = code << 8 | (k < bytes.size() ? std::to_integer<std::uint32_t>(bytes[k]) : 0);
    for (std::size_t k = 0; k < 4; ++k) text += i + k > bytes.size() ? '=' : kDigits[code >> (18 - 6 * k) & 63];
  }
  return text;
}

}  // namespace

TEST_CASE(".gltf: buffers are data: URIs or files in its folder") {
  const SplatCloud cloud = ordinary_cloud(5, 1, 6);
  const Bytes glb = encode_splats(cloud.view(), SplatFormat::glb).value(), bin = bin_of(glb);
  const auto text = [&](const std::string& uri) {
    json root = json_of(glb);
    root["buffers"][0]["uri"] = uri;
    return bytes_of("  \n" + root.dump());
  };
  const std::string data = "data:application/octet-stream;base64," + base64(bin);
  for (const std::string& uri : {data, data.substr(0, data.find_last_not_of('=') + 1)}) {
    const auto file = read_splats(text(uri), kKeepAxes);
    REQUIRE(file);
    CHECK(file->format == SplatFormat::glb);
    CHECK(file->bytes == text(uri).size());
    CHECK(file->cloud.mean == cloud.mean);
    CHECK(file->cloud.sh == cloud.sh);
  }
  for (const char* wrong : {"data:;base64,QQ=A", "data:;base64,Q", "data:;base64,Q?==", "data:,abc", "data:;base64"}) {
    CAPTURE(wrong);
    const auto file = read_splats(text(wrong));
    REQUIRE_FALSE(file);
    CHECK(file.error().code == Errc::bad_syntax);
    CHECK(file.error().offset == 0);
  }
  const auto alone = read_splats(text("scene.bin"));
  REQUIRE_FALSE(alone);
  CHECK(alone.error().code == Errc::unsupported_feature);
  CHECK(std::string(alone.error().what).find("one .glb") != std::string::npos);

  const TemporaryFolder folder;
  const auto read = [&](const std::string& uri) {
    write_bytes(folder.file("in/scene.gltf"), text(uri));
    return read_splats(folder.file("in/scene.gltf"), kKeepAxes);
  };
  std::filesystem::create_directories(folder.file("in/a part"));
  for (const char* name : {"in/scene.bin", "in/a part/1.bin", "outside.bin"}) write_bytes(folder.file(name), bin);
  for (const char* uri : {"scene.bin", "./scene.bin", "a%20part/1.bin", "a part/%31.bin", data.c_str()}) {
    const std::string which = std::string(uri).substr(0, 20);
    CAPTURE(which);
    const auto file = read(uri);
    REQUIRE(file);
    CHECK(file->cloud.mean == cloud.mean);
    CHECK(file->bytes == text(uri).size() + (uri == data ? 0 : bin.size()));
  }
  // Other spellings of a file's name do not make it count again, which would raise the limits on expansion.
  json root = json_of(glb);
  root["buffers"][0]["uri"] = "scene.bin";
  for (const char* uri : {"./scene.bin", ".//scene.bin", "%2E/./scene.bin"}) {
    root["bufferViews"][root["buffers"].size()]["buffer"] = root["buffers"].size();
    root["buffers"].push_back({{"uri", uri}});
  }
  const Bytes spellings = bytes_of(root.dump());
  write_bytes(folder.file("in/scene.gltf"), spellings);
  const auto once = read_splats(folder.file("in/scene.gltf"), kKeepAxes);
  REQUIRE(once);
  CHECK(once->bytes == spellings.size() + bin.size());
  CHECK(once->cloud.mean == cloud.mean);
  const std::string absolute = folder.file("outside.bin");
  for (const std::string& uri :
       {std::string("../outside.bin"), std::string("a part/../../outside.bin"), absolute,
        std::string("%2e%2E/outside.bin"), std::string("..%2foutside.bin"), "file://" + absolute,
        std::string("https://example.org/scene.bin"), std::string("..\\outside.bin"), std::string("scene.bin%00"),
        std::string("scene%2"), std::string()}) {
    CAPTURE(uri);
    const auto file = read(uri);
    REQUIRE_FALSE(file);
    CHECK(file.error().code == Errc::unsupported_feature);
    CHECK(std::string(file.error().what).find("copy it there") != std::string::npos);
  }
  CHECK(read("missing.bin").error().code == Errc::open_failed);
  write_bytes(folder.file("in/scene.bin"), std::span(bin).first(bin.size() - 1));
  const auto cut = read("scene.bin");
  REQUIRE_FALSE(cut);
  CHECK(cut.error().code == Errc::truncated);
  CHECK(read_splats(bytes_of(R"({"accessors": [)")).error().code == Errc::bad_syntax);
}

TEST_CASE("damaged .gltf files are refused or read, but never crash") {
  const Bytes glb = encode_splats(ordinary_cloud(2, 0, 3).view(), SplatFormat::glb).value();
  json root = json_of(glb);
  root["buffers"][0]["uri"] = "data:;base64," + base64(bin_of(glb));
  const std::string text = root.dump();
  ReadOptions options;
  options.format = SplatFormat::glb;
  for (std::size_t size = 1; size < text.size(); ++size)
    CHECK_FALSE(read_splats(bytes_of(text.substr(0, size)), options));
  SplitMix random(5);
  for (int i = 0; i < 1000; ++i) {
    std::string damaged = text;
    damaged[random.below(damaged.size())] = static_cast<char>(random.below(128));
    const auto file = read_splats(bytes_of(damaged), options);
    if (!file) CHECK(exit_code(file.error().code) == 4);
  }
}

namespace {

// A .glb whose primitive is `spz`.
Bytes glb_of_spz(
    const Bytes& spz, std::uint64_t n, const std::string& extension,
    const std::function<void(json&)>& edit = [](json&) {}) {
  json primitive = json::parse(R"({"mode": 0, "attributes": {"POSITION": 0}, "extensions": {}})");
  json& extensions = primitive["extensions"];
  if (extension.starts_with("KHR_gaussian_splatting")) {
    extensions["KHR_gaussian_splatting"] = {{"kernel", "ellipse"}, {"colorSpace", "lin_rec709_display"}};
    extensions["KHR_gaussian_splatting"]["extensions"][extension]["bufferView"] = 0;
  } else {
    extensions[extension]["bufferView"] = 0;
  }
  json root = json::parse(R"({"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
                              "accessors": [{"componentType": 5126, "type": "VEC3"}],
                              "buffers": [{}], "bufferViews": [{"buffer": 0}], "meshes": [{}]})");
  root["meshes"][0]["primitives"] = json::array({primitive});
  root["accessors"][0]["count"] = n;
  root["buffers"][0]["byteLength"] = root["bufferViews"][0]["byteLength"] = spz.size();
  edit(root);
  return make_glb(root, spz);
}

}  // namespace

TEST_CASE(".glb: a primitive may be an SPZ, in the frame of glTF or the one that it declares") {
  const SplatCloud cloud = ordinary_cloud(40, 2, 8);
  for (const int version : {2, 3, 4}) {
    WriteOptions write;
    write.spz_version = version;
    write.aa_mode = AaMode::mip_splatting;
    const Bytes spz = encode_splats(cloud.view(), SplatFormat::spz, write).value();
    const SplatCloud expected = read_splats(spz, kKeepAxes)->cloud;
    for (const char* extension : {"KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz",
                                  "KHR_spz_gaussian_splats_compression"}) {
      CAPTURE(version);
      CAPTURE(extension);
      const auto file = read_splats(glb_of_spz(spz, 40, extension), kKeepAxes);
      REQUIRE(file);
      CHECK(file->axes == kAxesGltf);
      CHECK(file->aa_mode == AaMode::mip_splatting);
      CHECK((file->colour_space == ColourSpace::linear_display) == (extension[4] == 'g'));
      CHECK(file->cloud.mean == expected.mean);
      CHECK(file->cloud.rotation == expected.rotation);
      CHECK(file->cloud.log_scale == expected.log_scale);
      CHECK(file->cloud.opacity_logit == expected.opacity_logit);
      CHECK(file->cloud.sh == expected.sh);
    }
  }
  const Bytes spz = encode_splats(cloud.view(), SplatFormat::spz).value();
  const auto twice = read_splats(glb_of_spz(spz, 40, "KHR_gaussian_splatting_compression_spz_2",
                                            [](json& r) {
                                              r["nodes"].push_back({{"mesh", 0}, {"translation", {0, 0, 3}}});
                                              r["scenes"][0]["nodes"] = {0, 1};
                                            }),
                                 kKeepAxes);
  REQUIRE(twice);
  CHECK(twice->cloud.size() == 80);
  CHECK(twice->cloud.mean[3 * 40 + 2] == twice->cloud.mean[2] + 3);
}

TEST_CASE(".glb: an SPZ that is damaged, overlaps another or unfolds too far is refused") {
  const Bytes spz = encode_splats(ordinary_cloud(400, 0, 8).view(), SplatFormat::spz).value();
  const std::string extension = "KHR_gaussian_splatting_compression_spz_2";
  const auto refused = [&](const Bytes& glb, Errc code, std::uint64_t offset, const DecodeLimits& limits = {}) {
    ReadOptions options = kKeepAxes;
    options.limits = limits;
    const auto file = read_splats(glb, options);
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
    CHECK(file.error().offset == offset);
  };
  const auto edited = [&](const std::function<void(json&)>& edit) { return glb_of_spz(spz, 400, extension, edit); };
  const auto spz_at = [](const Bytes& glb) { return 28 + get<std::uint32_t>(glb, 12); };
  const Bytes whole = edited([](json&) {});
  REQUIRE(read_splats(whole));
  refused(edited([](json& r) { r["accessors"][0]["count"] = 399; }), Errc::size_mismatch, 20);
  refused(edited([](json& r) { r["meshes"][0]["primitives"][0]["mode"] = 4; }), Errc::bad_syntax, 20);
  refused(edited([](json& r) { r["bufferViews"].clear(); }), Errc::bad_syntax, 20);
  Bytes other = whole;
  put(other, spz_at(whole), std::uint8_t{0});
  refused(other, Errc::bad_magic, spz_at(whole));
  const Bytes cut = edited([&](json& r) { r["bufferViews"][0]["byteLength"] = spz.size() - 9; });
  refused(cut, Errc::truncated, spz_at(cut) + spz.size() - 9);
  DecodeLimits limits;
  limits.max_gaussians = 399;
  CHECK(read_splats(whole, {limits}).error().code == Errc::limit_exceeded);
  limits = {};
  limits.max_decoded_bytes = 1000;
  CHECK(read_splats(whole, {limits}).error().code == Errc::limit_exceeded);
  Bytes both = spz;
  both.insert(both.end(), spz.begin(), spz.end());
  const Bytes two = glb_of_spz(both, 400, extension, [&](json& r) {
    r["bufferViews"][0]["byteLength"] = spz.size();
    r["bufferViews"].push_back({{"buffer", 0}, {"byteOffset", spz.size()}, {"byteLength", spz.size()}});
    json& primitives = r["meshes"][0]["primitives"];
    primitives.push_back(primitives[0]);
    primitives[1]["extensions"]["KHR_gaussian_splatting"]["extensions"][extension]["bufferView"] = 1;
  });
  limits.max_decoded_bytes = 400 * 2 * 20;
  CHECK(read_splats(two, {limits}));
  limits.max_decoded_bytes = 400 * 2 * 20 * 3 / 4;  // holds each, but not both
  CHECK(read_splats(two, {limits}).error().code == Errc::limit_exceeded);
  refused(edited([&](json& r) {
            json& primitives = r["meshes"][0]["primitives"];
            for (std::size_t i = 1; i < 4; ++i) {
              r["bufferViews"].push_back(r["bufferViews"][0]);
              primitives.push_back(primitives[0]);
              primitives[i]["extensions"]["KHR_gaussian_splatting"]["extensions"][extension]["bufferView"] = i;
            }
          }),
          Errc::limit_exceeded, 20);
  check_hostile(glb_of_spz(encode_splats(ordinary_cloud(2, 0, 8).view(), SplatFormat::spz).value(), 2, extension), 9,
                1000);
}

// Of tests/golden/gltf: buffer views by meshoptimizer, with what it decodes as the uncompressed fallback.
TEST_CASE(".glb: meshopt buffer views hold what their encoder's own decoder gives") {
  for (const char* name : {"meshopt_version0.glb", "meshopt_version1.glb"}) {
    CAPTURE(name);
    const Bytes glb = read_bytes(golden_folder() / "gltf" / name);
    const auto packed = read_splats(glb, kKeepAxes);
    REQUIRE(packed);
    const auto fallback = read_edited(glb, [](json& root) {
      for (json& view : root["bufferViews"]) view.erase("extensions");
    });
    REQUIRE(fallback);
    REQUIRE(packed->cloud.size() == 3 * 49);
    CHECK(packed->cloud.mean == fallback->cloud.mean);
    CHECK(packed->cloud.sh == fallback->cloud.sh);
    constexpr float kCode = 1.001F / 32767;  // filters may differ by one code, except the exponential one
    for (std::uint64_t i = 0; i < packed->cloud.size(); ++i) {
      const Splat a = packed->cloud.view().splat(i), b = fallback->cloud.view().splat(i);
      CHECK(std::abs(opacity_from_logit(a.opacity_logit) - opacity_from_logit(b.opacity_logit)) <= kCode);
      for (int k = 0; k < 4; ++k) CHECK(std::abs(a.rotation[k] - b.rotation[k]) <= kCode);
      for (int k = 0; k < 3; ++k) CHECK(std::abs(std::exp(a.log_scale[k]) - std::exp(b.log_scale[k])) <= kCode);
    }
  }
}

TEST_CASE(".glb: meshopt buffer views that are damaged, of another mode, or unfold too far are refused") {
  const Bytes glb = read_bytes(golden_folder() / "gltf/meshopt_version1.glb");
  const json root = json_of(glb);
  const std::uint64_t bin = 28 + get<std::uint32_t>(glb, 12);
  const json& first = root["bufferViews"][0]["extensions"]["KHR_meshopt_compression"];
  const std::uint64_t at = first["byteOffset"], size = first["byteLength"];
  const auto refused = [](const Result<SplatFile>& file, Errc code, std::uint64_t offset) {
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
    CHECK(file.error().offset == offset);
  };
  const auto edited = [&](const std::function<void(json&, json&)>& edit, Errc code, bool in_json = true,
                          std::uint64_t within = 0) {
    json changed = root;
    edit(changed["bufferViews"][0], changed["bufferViews"][0]["extensions"]["KHR_meshopt_compression"]);
    const Bytes file = with_json(glb, changed);
    refused(read_splats(file), code, in_json ? 20 : 28 + get<std::uint32_t>(file, 12) + at + within);
  };
  edited([](json&, json& m) { m["mode"] = "TRIANGLES"; }, Errc::unsupported_feature);
  edited([](json&, json& m) { m["filter"] = "BEST"; }, Errc::unsupported_feature);
  edited([](json&, json& m) { m["filter"] = 1; }, Errc::unsupported_feature);
  edited([](json&, json& m) { m["count"] = 48; }, Errc::bad_syntax);
  edited([](json&, json& m) { m["byteStride"] = 264; }, Errc::bad_syntax);
  edited([](json&, json& m) { m["buffer"] = 1; }, Errc::bad_syntax);
  edited([](json& v, json& m) { m["byteStride"] = 66, m["count"] = 98, v["byteStride"] = 66; }, Errc::bad_header,
         false);
  edited([](json&, json& m) { m["filter"] = "QUATERNION"; }, Errc::bad_header, false);
  edited([&](json&, json& m) { m["byteLength"] = 60; }, Errc::truncated, false, 60);
  edited([](json& v, json& m) { m["count"] = 30000000, v["byteLength"] = 30000000ULL * 132; }, Errc::limit_exceeded,
         false);
  edited([](json& v, json& m) { m["count"] = 100000, v["byteLength"] = 100000 * 132; }, Errc::truncated, false, size);
  const auto changed = [&](std::uint64_t within, std::uint8_t value) {
    Bytes file = glb;
    put(file, bin + at + within, value);
    return read_splats(file);
  };
  refused(changed(0, 0xE1), Errc::unsupported_feature, bin + at);
  refused(changed(size - 1, 3), Errc::bad_value, bin + at + size - 1);
  refused(changed(size - 1, 0x11), Errc::bad_value, bin + at + size - 1);
  const auto longer = read_edited(glb, [](json& r) {
    json& view = r["bufferViews"][0];
    view["byteLength"] = 48 * 132;
    view["extensions"]["KHR_meshopt_compression"]["count"] = 48;
  });
  REQUIRE_FALSE(longer);
  CHECK(longer.error().code == Errc::trailing_bytes);
  CHECK(longer.error().offset > bin + at);
  // Views that share their bytes would decompress them over and over.
  json many = root;
  for (std::size_t i = 0; i < 20; ++i) {
    many["bufferViews"].push_back(many["bufferViews"][0]);
    many["accessors"].push_back(many["accessors"][0]);
    many["accessors"].back()["bufferView"] = many["bufferViews"].size() - 1;
    json primitive = many["meshes"][0]["primitives"][0];
    primitive["attributes"]["POSITION"] = many["accessors"].size() - 1;
    many["meshes"][0]["primitives"].push_back(primitive);
  }
  refused(read_splats(with_json(glb, many)), Errc::limit_exceeded, 20);
  // Each change of a byte of the streams is refused or read.
  SplitMix random(4);
  for (const char* name : {"meshopt_version0.glb", "meshopt_version1.glb"}) {
    const Bytes whole = read_bytes(golden_folder() / "gltf" / name);
    for (int i = 0; i < 500; ++i) {
      Bytes damaged = whole;
      const std::uint64_t begin = 28 + get<std::uint32_t>(whole, 12);
      put(damaged, begin + random.below(whole.size() - begin), static_cast<std::uint8_t>(random.below(256)));
      const auto file = read_splats(damaged);
      if (!file) check_refusal(file, damaged.size());
    }
  }
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

TEST_CASE("growth: .gltf: reading is linear in the arrays of a data: URI") {
  // n primitives with arrays of their own, in one buffer of 1000 n bytes.
  const auto many_arrays = [](std::uint64_t n) {
    const Bytes glb = encode_splats(ordinary_cloud(1, 0, 4).view(), SplatFormat::glb).value();
    json root = json_of(glb);
    Bytes bin = bin_of(glb);
    bin.resize(1000 * n);
    root["buffers"][0] = {{"byteLength", bin.size()}, {"uri", "data:;base64," + base64(bin)}};
    json primitive = root["meshes"][0]["primitives"][0];
    const json position = root["accessors"][0];
    for (std::uint64_t i = 1; i < n; ++i) {
      primitive["attributes"]["POSITION"] = root["accessors"].size();
      root["accessors"].push_back(position);
      root["meshes"][0]["primitives"].push_back(primitive);
    }
    return bytes_of(root.dump());
  };
  CHECK(growth(300, many_arrays, [](const Bytes& file) { CHECK(read_splats(file)); }) < kLinearGrowth);
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

TEST_CASE(".spz.glb: holds what an SPZ does, in the axes of glTF, as CesiumJS wants it") {
  for (const int degree : {0, 2, 3}) {
    CAPTURE(degree);
    const SplatCloud cloud = ordinary_cloud(50, degree, 3);
    const Origin origin{4.2e6, 1.7e5, -4.8e6};
    const WriteOptions options{.colour_space = ColourSpace::linear_display,
                               .aa_mode = AaMode::mip_splatting,
                               .metres_per_unit = 2,
                               .axes = kAxesGltf,
                               .origin = origin,
                               .crs = {"EPSG:4978", {}}};
    const Bytes bytes = encode_splats(cloud.view(), SplatFormat::spz_glb, options).value();
    CHECK(detect_format(bytes) == SplatFormat::spz_glb);
    const json root = json_of(bytes), primitive = root["meshes"][0]["primitives"][0];
    CHECK(root["extensionsRequired"].size() == 2);
    CHECK(root["nodes"][0]["matrix"][12] == origin[0]);
    CHECK(primitive["attributes"].size() == static_cast<std::size_t>(4 + sh_coefficients(degree) - 1));
    for (const json& accessor : root["accessors"]) CHECK_FALSE(accessor.contains("bufferView"));
    const auto file = read_splats(bytes, kKeepAxes);
    REQUIRE(file);
    CHECK(file->origin == origin);
    CHECK(file->colour_space == ColourSpace::linear_display);
    CHECK(file->aa_mode == AaMode::mip_splatting);
    CHECK(file->metres_per_unit == 2);
    CHECK(file->crs.text == "EPSG:4978");
    const auto spz = read_splats(encode_splats(cloud.view(), SplatFormat::spz).value(), kKeepAxes);
    REQUIRE(spz);
    CHECK(file->cloud.mean == spz->cloud.mean);
    CHECK(file->cloud.sh == spz->cloud.sh);
    // Any glTF reader of splats reads it, named so or not.
    CHECK(read_splats(bytes, {{}, SplatFormat::glb, true})->cloud.mean == spz->cloud.mean);
  }
}

TEST_CASE("damaged .spz.glb files are refused or read, but never crash") {
  check_hostile(encode_splats(ordinary_cloud(4, 0, 3).view(), SplatFormat::spz_glb).value(), 8, 300);
}
