// audit_levels_test.cpp - files with levels of detail: leaves are audited like any file's Gaussians, and quality by
// distance is measured against the truth.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "audit_picture.hpp"
#include "audit_program_fixture.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/image_metrics.hpp"
#include "rgs/renderer.hpp"
#include "skip.hpp"

namespace fs = std::filesystem;
using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

/// A ball of Gaussians that shrink below a pixel from afar, as plain.rgs and, in three levels, as levels.rgs.
struct LevelsFolder : TemporaryFolder {
  std::string ply, plain = file("plain.rgs"), levels = file("levels.rgs");
  std::string cameras = write_cameras(file("cameras.json"), 2);

  LevelsFolder() {
    SplatCloud cloud = audit_cloud(14000, 1);
    for (float& s : cloud.log_scale) s -= 1.5F;
    ply = write_ply(file("scene.ply"), cloud);
    for (const std::vector<std::string>& arguments :
         {std::vector<std::string>{ply, plain}, std::vector<std::string>{ply, levels, "--lod"}}) {
      std::vector<std::string> command{built("rgs-convert"), "--quiet"};
      command.insert(command.end(), arguments.begin(), arguments.end());
      const ProgramResult run = run_program(command);
      INFO(run.err);
      REQUIRE(run.exit_code == 0);
    }
  }
  ProgramResult run(const std::string& asset, std::vector<std::string> more = {}) const {
    std::vector<std::string> arguments{ply, asset, "--cameras", cameras, "--quiet", "--backend", "cpu"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_audit(arguments);
  }
  json result(const std::string& asset, std::vector<std::string> more = {}) const {
    more.insert(more.end(), {"--json", "-"});
    const ProgramResult done = run(asset, more);
    INFO(done.err);
    REQUIRE((done.exit_code == 0 || done.exit_code == 5));
    return json::parse(done.out);
  }
};

const LevelsFolder& scene() {
  static const LevelsFolder folder;
  return folder;
}

json without_seconds(json j) {
  j.erase("seconds");
  return j;
}

audit::Picture draw(const Scene& drawn, const Camera& camera, RenderOptions options) {
  auto renderer = Renderer::create({Backend::cpu});
  REQUIRE(renderer);
  const auto over = [&](float grey) {
    Image image = Image::make(camera.width, camera.height, 3);
    options.background = {grey, grey, grey};
    REQUIRE(renderer->render(drawn, camera, {.rgb = image.pixels}, options));
    for (float& v : image.pixels) v = std::clamp(v, 0.0F, 1.0F);
    return image;
  };
  return {over(0), over(1)};
}

/// Scaled by 1 / `far`; the truth is twice as large.
Camera scaled(Camera camera, double by) {
  camera.fx *= by, camera.fy *= by, camera.cx *= by, camera.cy *= by;
  camera.width = static_cast<int>(camera.width * by);
  camera.height = static_cast<int>(camera.height * by);
  return camera;
}

Image averaged(const Image& image, int factor) {
  Image out = Image::make(image.width / factor, image.height / factor, 3);
  for (int y = 0; y < out.height * factor; ++y)
    for (int x = 0; x < out.width * factor; ++x)
      for (int c = 0; c < 3; ++c)
        out.at(x / factor, y / factor, c) += image.at(x, y, c) / static_cast<float>(factor * factor);
  return out;
}

// The arithmetic of an audit.
RenderOptions reference() {
  RenderOptions options{.pipeline = Pipeline::paper};
  options.paper = steps_of({.pipeline = Pipeline::baseline}, Backend::cpu);
  options.detail_px = 0;
  return options;
}

/// The file with levels with noise for the colours and opacities of all pages but the leaves, whose errors are
/// multiplied by `error`, written anew with sound hashes.
std::string with_garbage_above_leaves(const std::string& path, float error) {
  return with_changed_levels(scene().levels, path, [error](lod::Levels& levels) {
    SplitMix random(3);
    for (lod::Page& page : levels.pages) {
      if (page.level == 0) continue;
      page.error *= error;
      for (std::uint64_t i = page.first; i < page.first + page.count; ++i) {
        Splat splat = levels.splats.view().splat(i);
        for (float& x : splat.sh) x = random.dyadic(-3, 3);
        splat.opacity_logit = random.dyadic(-3, 4);
        levels.splats.set(i, splat);
      }
    }
  });
}

}  // namespace

TEST_CASE("garbage above the leaves that is drawn by default fails gate and grade") {
  const std::string bad = with_garbage_above_leaves(scene().file("garbage.rgs"), 1e-6F);
  const ProgramResult run = scene().run(bad, {"--no-attribution", "--no-distances", "--fail-below", "psnr=40"});
  CHECK(run.exit_code == 5);
  CHECK(run.err.find("psnr") != std::string::npos);
  const json j = scene().result(bad, {"--no-attribution", "--no-distances"});
  CHECK(j["verdict"]["grade"] == "poor");
  CHECK(j["rendered"]["psnr"].get<double>() < 25);
  for (const json& view : j["rendered"]["views"]) {
    CHECK(view["psnr"] == view["levels"]["psnr"]);
    CHECK(view["leaves"]["psnr"].get<double>() > 40);
  }
}

TEST_CASE("garbage above the leaves that is drawn from afar alone fails gate and grade") {
  const std::string bad = with_garbage_above_leaves(scene().file("far_garbage.rgs"), 1);
  const json j = scene().result(bad, {"--no-attribution", "--fail-below", "ratio=0.01"});
  CHECK(j["distances"]["loss"].get<double>() > 6);
  CHECK(j["gate"]["holds"] == false);
  REQUIRE(j["gate"]["conditions"].size() == 2);
  CHECK(j["gate"]["conditions"][1]["name"] == "levels-loss");
  CHECK(j["verdict"]["grade"] == "poor");
  CHECK(scene().run(bad, {"--no-attribution", "--fail-below", "levels-loss=100"}).exit_code ==
        0);  // as the caller says
  CHECK(scene().run(scene().levels, {"--no-attribution", "--fail-below", "ratio=0.01"}).exit_code == 0);
}

TEST_CASE("a file with levels audited against itself is identical") {
  const ProgramResult run = run_audit({scene().levels, scene().levels, "--cameras", scene().cameras, "--quiet",
                                       "--json", "-", "--no-attribution", "--backend", "cpu"});
  CHECK(json::parse(run.out)["verdict"]["grade"] == "identical");
}

TEST_CASE("the leaves of a file with levels are audited like the Gaussians of a file without") {
  const json plain = scene().result(scene().plain), levels = scene().result(scene().levels);
  CHECK(levels["rendered"]["level_psnr"]["leaves"] == plain["rendered"]["psnr"]);
  for (const json& view : levels["rendered"]["views"]) {
    const json& all = plain["rendered"]["views"];
    const json& of_plain =
        *std::find_if(all.begin(), all.end(), [&](const json& v) { return v["name"] == view["name"]; });
    CHECK(view["leaves"]["psnr"] == of_plain["psnr"]);
    CHECK(view["psnr"] == std::min(view["leaves"]["psnr"], view["levels"]["psnr"]));
  }
  CHECK(without_seconds(levels["attributes"]) == without_seconds(plain["attributes"]));
  CHECK(levels["asset"]["gaussians"] == 14000);
  CHECK(levels["asset"]["made_from_source"] == true);
  CHECK(levels["rendered"]["attribution"].size() == plain["rendered"]["attribution"].size());
  CHECK(levels["asset"]["bytes"] == fs::file_size(scene().levels));
  CHECK(levels["size"]["levels"]["levels"] == 3);
  CHECK(levels["size"]["levels"]["gaussians"].get<int>() > 14000);
  CHECK(levels["size"]["gpu_bytes"].get<std::uint64_t>() > plain["size"]["gpu_bytes"].get<std::uint64_t>());
  CHECK(plain["size"]["levels"].is_null());
  CHECK_FALSE(plain.contains("distances"));
}

TEST_CASE("quality by distance compares the pages that a view draws with the averaged truth") {
  const json j = scene().result(scene().levels, {"--no-attribution"})["distances"];
  CHECK(j["detail_px"] == 1);
  REQUIRE(j["rows"].size() == 4);
  double drawn_before = 1, loss = -1000;
  for (std::size_t i = 0; i < 4; ++i) {
    const json& row = j["rows"][i];
    CHECK(row["far"] == 1 << i);
    CHECK(row["views"].size() == 2);
    CHECK(row["drawn"].get<double>() <= drawn_before);
    drawn_before = row["drawn"];
    for (const json& view : row["views"])
      loss = std::max(loss, std::min(44.0, view["compensated"]["psnr"].get<double>()) -
                                std::min(44.0, view["levels"]["psnr"].get<double>()));
  }
  CHECK(j["loss"].get<double>() == doctest::Approx(loss));
  CHECK(drawn_before < 0.8);
  // The classic low-pass thickens distant Gaussians; levels do not.
  const json& far = j["rows"][3];
  CHECK(far["leaves"]["psnr"].get<double>() + 3 < far["levels"]["psnr"].get<double>());

  // The same numbers, directly from renderer and comparison.
  const Scene source = Scene::load(PlyFile::open(scene().ply).and_then(read_cloud).value()).value();
  const Scene asset = Scene::load(scene().levels).value();
  const Camera camera = read_camera_set(scene().cameras)->cameras[1];
  RenderOptions compensated = reference(), levels;
  compensated.anti_aliasing = math::AntiAliasing::mip_splatting;
  compensated.low_pass = 0.1F;
  levels = compensated;
  levels.detail_px = kDefaultDetailPx;
  const audit::Picture large = draw(source, scaled(camera, 2), reference());
  for (const int i : {0, 2, 3}) {
    const int times = 1 << i;
    const audit::Picture truth{averaged(large.black, 2 * times), averaged(large.white, 2 * times)};
    const Camera smaller = scaled(camera, 1.0 / times);
    const json& views = j["rows"][static_cast<std::size_t>(i)]["views"];
    const auto view = std::find_if(views.begin(), views.end(), [](const json& v) { return v["name"] == "b.png"; });
    REQUIRE(view != views.end());
    CHECK((*view)["width"] == smaller.width);
    const std::pair<const char*, RenderOptions> drawn[] = {
        {"leaves", reference()}, {"compensated", compensated}, {"levels", levels}};
    for (const auto& [name, options] : drawn) {
      const auto& key = name;  // clang 14 cannot capture a structured binding
      INFO(key << ", " << times << " times as far");
      const audit::Picture image = draw(asset, smaller, options);
      CHECK((*view)[key]["psnr"].get<double>() == doctest::Approx(difference(truth, image)->psnr).epsilon(1e-4));
      CHECK((*view)[key]["ssim"].get<double>() == doctest::Approx(ssim(truth, image).value()).epsilon(1e-4));
    }
    std::uint64_t n = 0;
    const auto pages = drawn_pages(asset, smaller, kDefaultDetailPx);
    REQUIRE(pages);
    for (const std::uint32_t page : *pages) n += asset.levels()->pages()[page].count;
    CHECK((*view)["drawn"].get<double>() == doctest::Approx(static_cast<double>(n) / 14000));
  }
}

TEST_CASE("gates name the quality of levels by distance") {
  const auto gate = [&](const char* conditions) {
    return scene().run(scene().levels, {"--no-attribution", "--fail-below", conditions});
  };
  CHECK(gate("levels-psnr-8x=10,levels-drawn-1x=1,levels-loss=60").exit_code == 0);
  const ProgramResult poor = gate("levels-psnr-4x=90");
  CHECK(poor.exit_code == 5);
  CHECK(poor.err.find("levels-psnr-4x") != std::string::npos);
  CHECK(gate("levels-drawn-8x=0.0001").exit_code == 5);
  CHECK(gate("levels-loss=-90").exit_code == 5);
  // An unmeasured gate fails; an impossible one is refused before any work.
  const ProgramResult none = scene().run(scene().plain, {"--no-attribution", "--fail-below", "levels-psnr-1x=10"});
  CHECK(none.exit_code == 5);
  CHECK(none.err.find("levels-psnr-1x not measured") != std::string::npos);
  const ProgramResult off = scene().run(scene().levels, {"--no-distances", "--fail-below", "levels-drawn-8x=1"});
  CHECK(off.exit_code == 2);
  CHECK(off.err.find("--no-distances") != std::string::npos);
  CHECK_FALSE(scene().result(scene().levels, {"--no-attribution", "--no-distances"}).contains("distances"));
}

TEST_CASE("the report has a strip of pictures for each distance, and a folder's tables have a column") {
  const std::string page = scene().file("levels.html");
  REQUIRE(scene().run(scene().levels, {"--no-attribution", "--report", page}).exit_code == 0);
  const std::string text = read_text(page);
  std::size_t n_strips = 0;
  for (std::size_t at = text.find("class=\"quad\""); at != std::string::npos; at = text.find("class=\"quad\"", at + 1))
    ++n_strips;
  CHECK(n_strips == 4);
  CHECK(text.find(">nan") == std::string::npos);
  CHECK(text.find("Levels of detail at a distance") != std::string::npos);

  const std::string sources = scene().file("sources"), assets = scene().file("assets"), out = scene().file("out");
  fs::create_directories(sources);
  fs::create_directories(assets);
  for (const auto& [name, asset] : {std::pair("a", scene().levels), std::pair("b", scene().plain)}) {
    fs::copy(scene().ply, sources + "/" + name + ".ply", fs::copy_options::overwrite_existing);
    fs::copy(asset, assets + "/" + std::string(name) + ".rgs", fs::copy_options::overwrite_existing);
  }
  REQUIRE(run_audit({sources, assets, "--cameras", scene().cameras, "--no-attribution", "--report", out, "--quiet"})
              .exit_code == 0);
  const json index = json::parse(read_text(out + "/index.json"));
  REQUIRE(index["pairs"].size() == 2);
  CHECK(index["pairs"][0]["distances"].size() == 4);
  CHECK(index["pairs"][0]["distances"][3]["drawn"].get<double>() < 1);
  CHECK_FALSE(index["pairs"][1].contains("distances"));
  const std::string csv = read_text(out + "/index.csv");
  CHECK(csv.find(",loss,levels_psnr_1x,levels_drawn_1x,") != std::string::npos);
  CHECK(csv.find(",,,,,,,,,\"\",\"\"\n") != std::string::npos);  // no levels: eight empty cells
}

TEST_CASE("views that are too small from afar drop distances and say so") {
  const json j =
      scene().result(scene().levels, {"--no-attribution", "--size", "40x31", "--fail-below", "levels-psnr-4x=1"});
  CHECK(j["distances"]["rows"].size() == 2);
  CHECK(j["distances"]["note"].get<std::string>().find("8 pixels") != std::string::npos);
  CHECK(j["gate"]["conditions"][0]["measured"] == false);
}

TEST_CASE("the error of a file without its end names the missing part, that of a damaged file the offset") {
  const auto size = fs::file_size(scene().levels);
  const std::string part = scene().file("part.rgs");
  fs::copy(scene().levels, part, fs::copy_options::overwrite_existing);
  fs::resize_file(part, size - 5000);
  const ProgramResult cut = scene().run(part);
  CHECK(cut.exit_code == 6);
  CHECK(cut.err.find("the end of the file is missing") != std::string::npos);

  const std::string bad = scene().file("bad.rgs");
  fs::copy(scene().levels, bad, fs::copy_options::overwrite_existing);
  std::fstream(bad, std::ios::in | std::ios::out | std::ios::binary)
      .seekp(static_cast<std::streamoff>(size - 3000))
      .put('\x5a');
  CHECK(scene().run(bad).exit_code == 4);
}

TEST_CASE("a page of a file with levels passes its own tests in a browser") {
  if (browser().empty()) return skip_without_tool("there is no browser to open the report in (Debian: chromium)");
  const std::string page = scene().file("browser.html");
  REQUIRE(scene().run(scene().levels, {"--no-attribution", "--report", page}).exit_code == 0);
  TemporaryFolder folder;
  const std::string text = read_text(page);
  std::size_t n = 0;
  for (std::size_t at = text.find("<img "); at != std::string::npos; at = text.find("<img ", at + 1)) ++n;
  check_in_browser(folder, page, "ok, " + std::to_string(n) + " images, 1 sliders");
}

TEST_CASE("the flicker of levels of detail is that of the drawing with more") {
  const double depths[] = {4, 24};
  const std::string far = write_cameras(scene().file("far.json"), depths);
  const auto flicker = [&](const std::string& asset) {
    const ProgramResult run = run_audit({scene().ply, asset, "--cameras", far, "--no-attribution", "--no-distances",
                                         "--video", "--json", "-", "--quiet"});
    INFO(run.err);
    REQUIRE(run.exit_code == 0);
    return json::parse(run.out)["rendered"]["video"]["worst_flicker"].get<double>();
  };
  const double leaves = flicker(scene().plain);
  CHECK(flicker(scene().levels) >= leaves);
  CHECK(flicker(with_garbage_above_leaves(scene().file("popping.rgs"), 1)) > 2 * leaves);  // drawn from afar alone
}
