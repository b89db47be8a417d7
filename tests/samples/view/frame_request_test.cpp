// frame_request_test.cpp - what a page may ask of the renderer. SPDX-License-Identifier: Apache-2.0
#include "frame_request.hpp"

#include <doctest/doctest.h>

#include <nlohmann/json.hpp>
#include <string>

#include "jpeg.hpp"
#include "rgs/image.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using nlohmann::json;
using rgs::view::FrameRequest;
using rgs::view::parse_frame_request;

namespace {

json camera() {
  return {{"id", 3},
          {"img_name", "IMG 3"},
          {"width", 640},
          {"height", 480},
          {"position", {1, 2, 3}},
          {"rotation", {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}},
          {"fx", 500},
          {"fy", 510},
          {"cx", 300},
          {"cy", 250}};
}

json least() {
  return {{"camera", camera()}};
}

rgs::Result<FrameRequest> parsed(const json& request, std::size_t n_scenes = 2) {
  return parse_frame_request(request.dump(), n_scenes);
}

// The error code for a request with one field changed or added.
rgs::Errc code_with(const std::string& field, const json& value) {
  json request = least();
  request[json::json_pointer("/" + field)] = value;
  const auto result = parsed(request);
  return result ? rgs::Errc::internal : result.error().code;
}

}  // namespace

TEST_CASE("a request with only a camera has the defaults") {
  const auto request = parsed(least());
  REQUIRE(request);
  CHECK(request->scene == 0);
  CHECK(request->format == rgs::ImageFormat::png);
  CHECK((request->camera.width == 640 && request->camera.height == 480));
  CHECK((request->camera.cx == 300 && request->camera.cy == 250));
  CHECK(request->camera.world_to_camera[3][2] == -3);
  CHECK(!request->options.detail_px.has_value());
  CHECK(request->options.sh_degree_limit == 3);
}

TEST_CASE("a request's fields are parsed") {
  json all = least();
  all.update({{"scene", 1},
              {"width", 320},
              {"height", 200},
              {"format", "jpeg"},
              {"quality", 70},
              {"background", {0.25, 1, 0}},
              {"sh_degree", 1},
              {"detail", 2.5}});
  const auto request = parsed(all);
  REQUIRE(request);
  CHECK(request->scene == 1);
  CHECK((request->camera.width == 320 && request->camera.height == 200));
  CHECK(request->camera.fx == 250);
  CHECK(request->format == rgs::ImageFormat::jpeg);
  CHECK(request->quality == 70);
  CHECK(request->options.background == std::array<float, 3>{0.25F, 1, 0});
  CHECK(request->options.sh_degree_limit == 1);
  CHECK(request->options.detail_px == 2.5F);
}

TEST_CASE("out-of-range values are refused") {
  using rgs::Errc;
  for (const json& value :
       {json(0), json(-1), json(8193), json(1e300), json(18446744073709551615U), json(4294967297)}) {
    CHECK(code_with("width", value) == Errc::bad_argument);
    CHECK(code_with("height", value) == Errc::bad_argument);
  }
  CHECK(code_with("width", 640.0) == Errc::bad_argument);
  CHECK(code_with("width", "640") == Errc::bad_syntax);
  CHECK(code_with("width", nullptr) == Errc::bad_syntax);
  CHECK(code_with("camera/width", 9000) == Errc::bad_argument);  // the frame's own, if it has no other
  CHECK(code_with("scene", 2) == Errc::bad_argument);
  CHECK(code_with("scene", -1) == Errc::bad_argument);
  CHECK(code_with("quality", 0) == Errc::bad_argument);
  CHECK(code_with("quality", 101) == Errc::bad_argument);
  CHECK(code_with("sh_degree", 4) == Errc::bad_argument);
  CHECK(code_with("sh_degree", -1) == Errc::bad_argument);
  CHECK(code_with("format", "tiff") == Errc::bad_argument);
  CHECK(code_with("format", 7) == Errc::bad_argument);
  CHECK(code_with("detail", -0.5) == Errc::bad_argument);
  CHECK(code_with("detail", 1e39) == Errc::bad_argument);  // no float
  CHECK(code_with("detail", "fine") == Errc::bad_syntax);
  CHECK(code_with("background", {0, 0}) == Errc::bad_syntax);
  CHECK(code_with("background", {0, 0, "a"}) == Errc::bad_syntax);
  CHECK(code_with("background", {0, 0, 1e39}) == Errc::bad_argument);
  CHECK(code_with("background", 0) == Errc::bad_syntax);
}

TEST_CASE("invalid cameras and unknown fields are refused") {
  using rgs::Errc;
  CHECK(code_with("path", "/etc/passwd") == Errc::bad_syntax);
  CHECK(code_with("camera/k1", 0.1) == Errc::bad_syntax);
  CHECK(code_with("camera/world_to_camera", json::array()) == Errc::bad_syntax);
  CHECK(code_with("camera", nullptr) == Errc::bad_syntax);
  CHECK(code_with("camera", json::array({camera()})) == Errc::bad_syntax);
  CHECK(code_with("camera", json::object()) == Errc::bad_syntax);
  CHECK(code_with("camera/fx", 0) == Errc::bad_value);
  CHECK(code_with("camera/rotation", {{1, 0, 0}, {0, 1, 0}, {0, 0, 2}}) == Errc::bad_value);
  CHECK(code_with("camera/position", {1, 2}) == Errc::bad_syntax);
  CHECK(code_with("camera/img_name", 5) == Errc::bad_syntax);
  CHECK(parse_frame_request("{}", 1).error().code == Errc::bad_syntax);
}

TEST_CASE("input that is no JSON object is refused at its offset") {
  using rgs::Errc;
  const auto broken = parse_frame_request(R"({"scene": 0, "camera": })", 1);
  REQUIRE(!broken);
  CHECK(broken.error().code == Errc::bad_syntax);
  CHECK(broken.error().offset == 23);
  for (const char* body : {"", "null", "[]", "7", "\"text\"", "{\"scene\"", "\xff", "{}{}"}) {
    CAPTURE(body);
    CHECK(parse_frame_request(body, 1).error().code == Errc::bad_syntax);
  }
  CHECK(!parse_frame_request(R"({"detail": 1e999})", 1));
  CHECK(!parse_frame_request(std::string(60'000, '['), 1));
  std::string deep = R"({"camera": )";
  deep += std::string(30'000, '[') + std::string(30'000, ']') + "}";
  CHECK(!parse_frame_request(deep, 1));
}

TEST_CASE("JSON nested deeper than any frame is refused as such") {
  // `levels` of them, including the request's own object.
  const auto nested = [](std::size_t levels) {
    const std::size_t n = levels - 1;
    return parse_frame_request(R"({"camera": )" + std::string(n, '[') + std::string(n, ']') + "}", 1).error();
  };
  constexpr const char* kTooDeep = "the JSON text is nested too deeply";
  CHECK(std::string(nested(8).what) != kTooDeep);
  for (const std::size_t levels : {9U, 10U, 30'000U}) {
    CAPTURE(levels);
    CHECK(nested(levels).code == rgs::Errc::bad_syntax);
    CHECK(std::string(nested(levels).what) == kTooDeep);
  }
  std::string objects;
  for (int i = 0; i < 24'000 / 5; ++i) objects += R"({"a":)";
  CHECK(parse_frame_request(objects + "1" + std::string(24'000 / 5, '}'), 1).error().what == std::string(kTooDeep));
  // Complete after the deep part, and with duplicate fields.
  CHECK(parse_frame_request(R"({"camera": [[[[[[[[0]]]]]]]], "camera": {"a": [1, {"b": 2}]}, "scene": 0})", 1)
            .error()
            .what == std::string(kTooDeep));
}

TEST_CASE("a JPEG is the picture at every size, also from an encoder that has made a larger one") {
  const rgs::test::TemporaryFolder folder;
  rgs::view::JpegEncoder encoder;
  for (const auto& [width, height] :
       {std::pair(1, 1), std::pair(2, 3), std::pair(97, 61), std::pair(17, 16), std::pair(1, 1)}) {
    std::vector<std::uint8_t> rgb;
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x)
        for (int c = 0; c < 3; ++c) rgb.push_back(static_cast<std::uint8_t>(20 + x + y + 30 * c));
    const auto file = encoder.encode(rgb, width, height, 95);
    REQUIRE(file);
    CHECK(file->ends_with("\xFF\xD9"));  // nothing behind its end
    rgs::test::write_text(folder.file("a.jpg"), *file);
    const auto image = rgs::read_image(folder.file("a.jpg"));
    REQUIRE(image);
    REQUIRE((image->width == width && image->height == height && image->channels == 3));
    float worst = 0;
    for (std::size_t i = 0; i < rgb.size(); ++i)
      worst = std::max(worst, std::abs(255 * image->pixels[i] - static_cast<float>(rgb[i])));
    CHECK(worst <= 6);
  }
}
