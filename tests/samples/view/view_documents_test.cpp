// view_documents_test.cpp - what the page is told. SPDX-License-Identifier: Apache-2.0
#include "view_documents.hpp"

#include <doctest/doctest.h>

#include <nlohmann/json.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "rgs/camera_file.hpp"

using nlohmann::json;
using rgs::view::cameras_json;
using rgs::view::percent_encoded;
using rgs::view::view_json;

namespace {

// The numbers of "name=1,2,3" in a link.
void check_field(const std::string& link, const std::string& name, const std::vector<double>& expected) {
  const std::size_t at = ("&" + link).find("&" + name + "=");
  REQUIRE(at != std::string::npos);
  std::istringstream in(link.substr(at + name.size() + 1));
  for (std::size_t i = 0; i < expected.size(); ++i) {
    double value = 1e9;
    in >> value;
    CHECK(value == doctest::Approx(expected[i]));
    const int next = in.get();
    CHECK((next == ',') == (i + 1 < expected.size()));
  }
}

}  // namespace

TEST_CASE("cameras from cameras.json are unchanged") {
  std::vector<rgs::Camera> cameras;
  for (int i = 0; i < 20; ++i) {
    const double a = 0.37 * i;
    rgs::Camera camera =
        rgs::look_at({3 * a, -2 + a, 5 - a * a}, {0.1 * a, 1, 2}, {0.1, -1, 0.05 * a}, {640 + i, 480 - i, 50});
    camera.name = "photos/frame " + std::to_string(i) + ".jpg";
    camera.cx += 3.25 * i;
    camera.cy -= 1.5 * i;
    camera.fy *= 1.01;
    cameras.push_back(camera);
  }
  const auto back = rgs::parse_camera_json(cameras_json(cameras));
  REQUIRE(back);
  CHECK(back->source == rgs::CameraSet::Source::training);
  REQUIRE(back->cameras.size() == cameras.size());
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    const rgs::Camera &a = cameras[i], &b = back->cameras[i];
    CHECK(a.name == b.name);
    CHECK((a.width == b.width && a.height == b.height));
    CHECK((a.fx == b.fx && a.fy == b.fy && a.cx == b.cx && a.cy == b.cy));
    for (int column = 0; column < 4; ++column)
      for (int row = 0; row < 4; ++row)
        CHECK(a.world_to_camera[column][row] == doctest::Approx(b.world_to_camera[column][row]).epsilon(1e-12));
  }
}

TEST_CASE("a rotation is written as the matrix from the camera to the world") {
  rgs::Camera camera = rgs::look_at({0, 0, 0}, {1, 0, 0}, {0, -1, 0});
  const json entry = json::parse(cameras_json({{camera}}))[0];
  // The camera looks along +x: its third axis, the third column.
  CHECK(entry["rotation"][0][2].get<double>() == doctest::Approx(1));
  CHECK(entry["rotation"][1][1].get<double>() == doctest::Approx(1));
  CHECK(entry["rotation"][2][0].get<double>() == doctest::Approx(-1));
}

TEST_CASE("a link starts at its camera and orbits the centre of all cameras") {
  std::vector<rgs::Camera> cameras{rgs::look_at({0, 0, -4}, {0, 0, 0}, {0, -1, 0}, {200, 100, 90}),
                                   rgs::look_at({0, 0, 4}, {0, 0, 0}, {0, -1, 0})};
  cameras[0].cx += 20;
  cameras[0].cy -= 10;
  cameras[0].fy = 1.5 * cameras[0].fx;
  check_field(rgs::view::view_link(cameras[0], cameras, false), "at", {0, 0, -4});
  check_field(rgs::view::view_link(cameras[0], cameras, false), "axes", {1, 0, 0, 0, 1, 0, 0, 0, 1});
  check_field(rgs::view::view_link(cameras[0], cameras, false), "lens", {0.5, 1.5, 0.1, -0.05});
  check_field(rgs::view::view_link(cameras[0], cameras, false), "pivot", {0, 0, 0});
  CHECK(rgs::view::view_link(cameras[0], cameras, true) ==
        rgs::view::view_link(cameras[0], cameras, false) + "&mode=slider");
  // No other camera is ahead.
  check_field(rgs::view::view_link(cameras[0], {cameras.data(), 1}, false), "pivot", {0, 0, -3});
  const rgs::Camera turned = rgs::look_at({0, 0, 0}, {1, 0, 0}, {0, -1, 0});
  check_field(rgs::view::view_link(turned, cameras, false), "axes", {0, 0, 1, 0, 1, 0, -1, 0, 0});
}

TEST_CASE("names in addresses are letters, digits and percent signs") {
  CHECK(percent_encoded("south-1_a~.rgs") == "south-1_a~.rgs");
  CHECK(percent_encoded("a b/c?d#e%\"<>") == "a%20b%2Fc%3Fd%23e%25%22%3C%3E");
  CHECK(percent_encoded("\xc3\xa4\xff") == "%C3%A4%FF");
}

TEST_CASE("view.json states what there is and null for the rest") {
  const json least = json::parse(view_json({.scenes = {{"a.rgs", "scenes/0/a.rgs", 12}}}));
  CHECK(least == json::parse(R"({"version": 1, "scenes": [{"name": "a.rgs", "url": "scenes/0/a.rgs", "bytes": 12}],
                                 "cameras": null, "photos": [], "frames": null})"));
  CHECK(json::parse(view_json({.scenes = {}, .spz_opengl = true}))["settings"] == json{{"spz_axes", "opengl"}});
  const json most = json::parse(view_json({.scenes = {{"a\xff.rgs", "u", 1}, {"</script>", "v", 2}},
                                           .cameras = "cameras.json",
                                           .photos = {{"IMG 1", "photos/0.jpg"}},
                                           .backend = "cpu"}));
  CHECK(most["scenes"][0]["name"] == "a\xef\xbf\xbd.rgs");
  CHECK(most["scenes"][1]["name"] == "</script>");
  CHECK(most["cameras"] == "cameras.json");
  CHECK(most["photos"] == json::parse(R"([{"camera": "IMG 1", "url": "photos/0.jpg"}])"));
  CHECK(most["frames"] == json::parse(R"({"url": "frame", "backend": "cpu"})"));
}
