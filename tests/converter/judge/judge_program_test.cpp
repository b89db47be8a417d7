// judge_program_test.cpp - rgs-judge: pictures from a folder, its outputs and exit codes.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "image_file.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using nlohmann::json;
using namespace rgs;
using namespace rgs::test;
namespace fs = std::filesystem;

namespace {

// A scene, two cameras, and pictures by rgs-render.
struct Pictures {
  TemporaryFolder folder;
  std::string scene = folder.file("scene.ply"), cameras = folder.file("cameras.json"), out = folder.file("out");

  Pictures() {
    REQUIRE(run_program(
                {built("rgs-make-scene"), "--quiet", "--gaussians", "500", "--cameras", folder.file("all.json"), scene})
                .exit_code == 0);
    json all = json::parse(read_text(folder.file("all.json")));
    write_text(cameras, json::array({all.at(0), all.at(1)}).dump());
  }
  void render(std::vector<std::string> options) const {
    std::vector<std::string> arguments{
        built("rgs-render"), scene, "--quiet", "--cameras", cameras, "--view", "all", "--size", "80x60", "--out", out};
    arguments.insert(arguments.end(), options.begin(), options.end());
    REQUIRE(run_program(arguments).exit_code == 0);
  }
  ProgramResult judge(std::vector<std::string> options) const {
    std::vector<std::string> arguments{built("rgs-judge"), scene, "--cameras", cameras, "--size", "80x60"};
    arguments.insert(arguments.end(), options.begin(), options.end());
    return run_program(arguments);
  }
};

}  // namespace

TEST_CASE("pictures of a folder are judged: text, JSON, page and pictures") {
  const Pictures p;
  p.render({"--low-pass", "0.1"});
  const std::string file = p.folder.file("j.json"), page = p.folder.file("page.html"),
                    pictures = p.folder.file("pictures");
  const ProgramResult result = p.judge({"--against", p.out, "--json", file, "--report", page, "--pictures", pictures});
  CAPTURE(result.err);
  REQUIRE(result.exit_code == 0);
  CHECK(result.out.find("adds a low-pass of 0.1 px^2 (found by trying)") != result.out.npos);
  const json found = json::parse(read_text(file));
  CHECK(found.at("schema") == "rgs-judge/1");
  CHECK(found.at("gaussians") == 500);
  CHECK(found.at("causes").at(0).at("key") == "low-pass-0.1");
  CHECK(found.at("causes").at(0).at("share") > 0.95);
  CHECK(found.at("named") > 0.99);
  CHECK(found.at("views").size() == 2);
  CHECK(read_text(page).find("adds a low-pass of 0.1 px^2") != std::string::npos);
  std::size_t n = 0;
  for ([[maybe_unused]] const auto& entry : fs::directory_iterator(pictures)) ++n;
  CHECK(n == 8);
  // An output is kept unless one asks.
  CHECK(p.judge({"--against", p.out, "--json", file}).exit_code == 3);
  CHECK(p.judge({"--against", p.out, "--json", file, "--overwrite"}).exit_code == 0);
}

TEST_CASE("FP32 pictures, and what a folder says of its client") {
  const Pictures p;
  p.render({"--format", "exr", "--scalar"});
  CHECK(p.judge({"--against", p.out}).out.find("as defined") != std::string::npos);
  write_text(p.out + "/client.json", R"({"client": "A name", "key": "spark", "version": "9"})");
  const ProgramResult result = p.judge({"--against", p.out, "--json", "-"});
  REQUIRE(result.exit_code == 0);
  CHECK(json::parse(result.out).at("client") == "Spark");
  CHECK(json::parse(result.out).at("version") == "9");
  write_text(p.out + "/client.json", R"({"client": "A name", "error": "no WebGL"})");
  const ProgramResult refused = p.judge({"--against", p.out});
  CHECK(refused.exit_code == 4);
  CHECK(refused.err.find("no WebGL") != std::string::npos);
}

TEST_CASE("PNG as defined are equal, and pictures may go beside them, again and again") {
  const Pictures p;
  p.render({"--scalar"});
  CHECK(p.judge({"--against", p.out, "--pictures", p.out}).out.find("as defined") != std::string::npos);
  CHECK(p.judge({"--against", p.out, "--pictures", p.out}).exit_code == 3);
  CHECK(p.judge({"--against", p.out, "--pictures", p.out, "--overwrite"}).out.find("as defined") != std::string::npos);
}

TEST_CASE("no picture that is judged, and no picture of a camera of the same name, is replaced") {
  const Pictures p;
  json cameras = json::parse(read_text(p.cameras));
  const std::string name = cameras.at(0).at("name").get<std::string>(), pictures = p.folder.file("pictures");
  cameras.at(1).at("name") = name + ".client";
  write_text(p.cameras, cameras.dump());
  p.render({});
  CHECK(p.judge({"--against", p.out, "--pictures", p.out, "--overwrite"}).exit_code == 2);
  cameras.at(1).at("name") = name;
  write_text(p.cameras, cameras.dump());
  REQUIRE(p.judge({"--against", p.out, "--pictures", pictures}).exit_code == 0);
  CHECK(fs::exists(pictures + "/" + name + ".client.png"));
  CHECK(fs::exists(pictures + "/" + name + "_0001.client.png"));
}

TEST_CASE("cameras that are no pinholes are refused") {
  const Pictures p;
  json cameras = json::parse(read_text(p.cameras));
  cameras.at(1)["model"] = "opencv_fisheye";
  write_text(p.cameras, cameras.dump());
  p.render({});
  const ProgramResult result = p.judge({"--against", p.out});
  CHECK(result.exit_code == 4);
  CHECK(result.err.find("pinhole cameras alone") != std::string::npos);
}

TEST_CASE("a picture with NaN is refused") {
  const Pictures p;
  p.render({"--format", "exr"});
  const fs::path picture = fs::directory_iterator(p.out)->path();
  Image image = read_image(picture.string()).value();
  image.pixels[5] = std::numeric_limits<float>::quiet_NaN();
  ImageFileOptions options;
  options.file.overwrite = true;
  REQUIRE(write_image(picture.string(), image, options));
  const ProgramResult result = p.judge({"--against", p.out});
  CHECK(result.exit_code == 4);
  CHECK(result.err.find(picture.filename().string()) != std::string::npos);
}

TEST_CASE("a client's script says what it likes, and its pictures are judged") {
  const Pictures p;
  p.render({"--scalar"});
  json cameras = json::parse(read_text(p.cameras));
  for (json& camera : cameras) camera["width"] = 80, camera["height"] = 60;
  const std::string folder = p.folder.file("a folder");
  fs::create_directories(folder);
  const auto judge = [&](const json& list) {
    write_text(folder + "/cameras.json", list.dump());
    return run_program({built("rgs-judge"), p.scene, "--cameras", folder + "/cameras.json", "--against", "spark",
                        "--clients", folder, "--json", "-"});
  };
  write_text(folder + "/draw.mjs", R"(console.log("noise"); process.exit(1);)");
  const ProgramResult failed = judge(cameras);
  CHECK(failed.exit_code == 3);
  CHECK(failed.out.empty());
  cameras.at(0).erase("name");
  const ProgramResult nameless = judge(cameras);
  CHECK(nameless.exit_code == 2);
  CHECK(nameless.err.find("no name") != std::string::npos);
}

TEST_CASE("mistakes") {
  const Pictures p;
  p.render({});
  CHECK(p.judge({"--against", "nobody"}).exit_code == 2);
  CHECK(p.judge({"--against", p.out, "--client", "nobody"}).exit_code == 2);
  CHECK(p.judge({}).exit_code == 2);
  CHECK(p.judge({"--against", p.scene}).exit_code == 2);
  CHECK(p.judge({"--against", "spark"}).exit_code == 2);  // --size is of a folder's pictures
  for (const char* near : {"0", "-1", "inf", "1e39", "1e-50"})
    CHECK(p.judge({"--against", p.out, "--near", near}).exit_code == 2);
  for (const std::string& facts :
       {std::string("no JSON"), std::string("[1]"), std::string(), std::string(2 << 20, '[')}) {
    write_text(p.out + "/client.json", facts);
    CHECK(p.judge({"--against", p.out}).exit_code == 4);
  }
  fs::remove(p.out + "/client.json");
  fs::create_directory(p.out + "/client.json");
  CHECK(p.judge({"--against", p.out}).exit_code == 3);
  fs::remove(p.out + "/client.json");
  const ProgramResult absent = run_program(
      {built("rgs-judge"), p.scene, "--cameras", p.cameras, "--against", "spark", "--clients", p.folder.file("none")});
  CHECK(absent.exit_code == 3);
  CHECK(absent.err.find("draw.mjs") != absent.err.npos);
  for (const auto& entry : fs::directory_iterator(p.out)) {
    fs::remove(entry.path());
    break;
  }
  const ProgramResult missing = p.judge({"--against", p.out});
  CHECK(missing.exit_code == 2);
  CHECK(missing.err.find("without a photograph") != missing.err.npos);
}
