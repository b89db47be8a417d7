// audit_unrated_test.cpp - views that do not show the scene count for nothing: no gate, mean or verdict uses them.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "audit_program_fixture.hpp"
#include "image_file.hpp"

namespace fs = std::filesystem;
using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

constexpr double kBehind = -4, kTiny = 100, kSmall = 20, kNear = 2.5;

// The program's result for `asset` seen from these depths.
struct Seen {
  ProgramResult run;
  json result;

  Seen(const SceneFolder& scene, const std::string& asset, std::vector<double> depths,
       const std::vector<std::string>& more = {}) {
    std::vector<std::string> arguments{
        scene.ply, asset,        "--cameras", write_cameras(scene.file("seen.json"), depths),
        "--json",  "-",          "--report",  scene.file("seen.html"),
        "--quiet", "--overwrite"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    run = run_audit(arguments);
    INFO(run.err);
    REQUIRE((run.exit_code == 0 || run.exit_code == 5));
    result = json::parse(run.out);
  }
  std::string page(const SceneFolder& scene) const { return read_text(scene.file("seen.html")); }
};

bool is_warned_of(const json& result, const std::string& words) {
  return std::any_of(result["warnings"].begin(), result["warnings"].end(),
                     [&](const json& w) { return w.get<std::string>().find(words) != std::string::npos; });
}

}  // namespace

TEST_CASE("cameras that see nothing rate nothing: the verdict says so, and a gate fails") {
  const SceneFolder scene;
  for (const std::string& asset : {scene.rgs, scene.ply}) {
    const Seen seen(scene, asset, {kBehind, kBehind - 1});
    CHECK(seen.run.exit_code == 0);
    CHECK(seen.result["verdict"]["grade"] == "unrated");
    CHECK(seen.result["verdict"]["headline"].get<std::string>().find("identical") == std::string::npos);
    const json& rendered = seen.result["rendered"];
    CHECK(rendered["n_rated"] == 0);
    CHECK(rendered["drawn"] == 0);
    CHECK(rendered["source_unseen"] == 700);
    CHECK(rendered["asset_unseen"] == 700);
    // Nothing was measured, so nothing can pass for the null of identical pictures.
    for (const char* field : {"psnr", "worst_psnr", "ssim", "worst_ssim", "mse", "largest"})
      CHECK_FALSE_MESSAGE(rendered.contains(field), field);
    CHECK(rendered["attribution"].empty());
    for (const json& view : rendered["views"]) {
      CHECK(view["rated"] == false);
      CHECK(view["hardly_sees"] == true);
      CHECK_FALSE(view.contains("psnr"));
    }
    CHECK(is_warned_of(seen.result, "0 of 2 views show"));
    const std::string page = seen.page(scene);
    CHECK(page.find("0 of 2 views show") != std::string::npos);
    CHECK(page.find("&infin;") == std::string::npos);
    for (const char* nan : {">nan", " nan", "\"nan"}) CHECK(page.find(nan) == std::string::npos);
    for (const char* gate : {"psnr=20", "worst-psnr=20", "ssim=0.1", "worst-ssim=0.1", "largest=255", "ratio=0.01",
                             "together-psnr=20", "dropped=1000"}) {
      const Seen gated(scene, asset, {kBehind}, {"--fail-below", gate});
      CHECK_MESSAGE(gated.run.exit_code == 5, gate);
      CHECK(gated.result["gate"]["holds"] == false);
      CHECK(gated.run.err.find("condition failed") != std::string::npos);
    }
  }
  // Size gates still work: they need no picture.
  CHECK(run_audit({scene.ply, scene.rgs, "--no-render", "--fail-below", "ratio=0.01"}).exit_code == 0);
}

TEST_CASE("a view is unrated where less than a hundredth of its pixels is drawn") {
  const SceneFolder scene;
  const Seen seen(scene, scene.rgs, {kTiny, kSmall, kNear});
  const json& rendered = seen.result["rendered"];
  REQUIRE(rendered["views"].size() == 3);
  CHECK(rendered["n_rated"] == 2);
  // Rated views come first, the worst on top; unrated ones come last.
  CHECK(rendered["views"][2]["name"] == "a.png");
  CHECK(rendered["views"][2]["rated"] == false);
  CHECK(rendered["views"][2]["drawn"].get<double>() > 0);
  CHECK(rendered["views"][2]["drawn"].get<double>() < 0.01);
  for (const json& view : rendered["views"]) {
    if (view["name"] == "b.png") {
      CHECK(view["rated"] == true);
      CHECK(view["hardly_sees"] == true);
      CHECK(view["drawn"].get<double>() > 0.01);
      CHECK(view["drawn"].get<double>() < 0.1);
    }
    if (view["name"] == "c.png") {
      CHECK(view["hardly_sees"] == false);
      CHECK(view["drawn"].get<double>() > 0.5);
    }
  }
  CHECK(is_warned_of(seen.result, "1 of 3 views"));
}

TEST_CASE("unrated views enter no mean, no worst view, no attribution row and no other file") {
  const SceneFolder scene;
  const std::vector<std::string> more{"--also", scene.rgs, "--compare-scales"};
  const json with = Seen(scene, scene.rgs, {kNear, kBehind, 3, kTiny}, more).result;
  const json without = Seen(scene, scene.rgs, {kNear, 3}, more).result;
  for (const char* field : {"psnr", "worst_psnr", "ssim", "worst_ssim", "mse", "largest"})
    CHECK_MESSAGE(with["rendered"][field] == without["rendered"][field], field);
  CHECK(with["rendered"]["attribution"] == without["rendered"]["attribution"]);
  CHECK(with["rendered"]["attribution"].size() == 9);
  CHECK(with["also"] == without["also"]);
  CHECK(with["verdict"]["grade"] == without["verdict"]["grade"]);
  CHECK(without["warnings"].empty());
}

TEST_CASE("unrated views enter no mean against photographs either") {
  const SceneFolder scene;
  const std::string photos = scene.file("photos");
  fs::create_directories(photos);
  SplitMix random(3);
  for (const char* name : {"a.png", "b.png", "c.png"}) {
    Image photo = Image::make(96, 72, 3);
    for (float& v : photo.pixels) v = random.dyadic(0, 1);
    REQUIRE(write_image(photos + "/" + name, photo));
  }
  const std::vector<std::string> more{"--photos", photos, "--also", scene.rgs};
  const json with = Seen(scene, scene.rgs, {kNear, 3, kBehind}, more).result;
  const json without = Seen(scene, scene.rgs, {kNear, 3}, more).result;
  CHECK(with["rendered"]["photos"] == without["rendered"]["photos"]);
  CHECK(with["rendered"]["attribution"] == without["rendered"]["attribution"]);
  CHECK(with["also"] == without["also"]);
  const Seen none(scene, scene.rgs, {kBehind}, {"--photos", photos, "--fail-below", "loss=1"});
  CHECK(none.run.exit_code == 5);
  CHECK(none.result["rendered"]["photos"].is_null());
}

TEST_CASE("a view counts as soon as one side draws: an empty asset is heavy damage") {
  const SceneFolder scene;
  const std::string empty = write_ply(scene.file("none.ply"), audit_cloud(0, 3));
  const Seen lost(scene, empty, {kNear}, {"--fail-below", "psnr=40"});
  CHECK(lost.run.exit_code == 5);
  CHECK(lost.result["rendered"]["n_rated"] == 1);
  CHECK(lost.result["verdict"]["grade"] == "poor");
  // The reverse: what only the asset draws is a difference too.
  const ProgramResult added = run_audit({empty, scene.ply, "--cameras", scene.cameras, "--json", "-", "--quiet"});
  REQUIRE(added.exit_code == 0);
  CHECK(json::parse(added.out)["verdict"]["grade"] == "poor");
}

TEST_CASE("cameras that hardly see the scene cause a warning everywhere, and in the verdict") {
  const SceneFolder scene;
  const Seen seen(scene, scene.rgs, {kSmall, kSmall + 1});
  CHECK(seen.run.exit_code == 0);
  CHECK(is_warned_of(seen.result, "less than 10 %"));
  CHECK(seen.result["verdict"]["hardly_seen"] == true);
  CHECK(seen.result["verdict"]["headline"].get<std::string>().find("hardly") != std::string::npos);
  CHECK(seen.page(scene).find("less than 10 %") != std::string::npos);
  const ProgramResult text = run_audit({scene.ply, scene.rgs, "--cameras", scene.file("seen.json")});
  CHECK(text.exit_code == 0);
  CHECK(text.out.find("warning") != std::string::npos);
  CHECK(text.out.find("less than 10 %") != std::string::npos);
  const json good = scene.result();
  CHECK(good["warnings"].empty());
  CHECK(good["verdict"]["hardly_seen"] == false);
}

TEST_CASE("views full of a few Gaussians of a scene elsewhere cause a warning") {
  // Twenty large Gaussians before the camera, like floaters, and the scene behind it.
  SceneFolder scene;
  SplatCloud cloud = audit_cloud(1000, 0);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    if (i >= 20) cloud.mean[3 * i + 2] -= 40;
    if (i >= 20) continue;
    std::fill_n(&cloud.log_scale[3 * i], 3, -0.5F);
    cloud.mean[3 * i] /= 2, cloud.mean[3 * i + 1] /= 2;
  }
  scene.ply = write_ply(scene.file("elsewhere.ply"), cloud);
  const Seen seen(scene, write_rgs(scene.file("elsewhere.rgs"), cloud), {kNear});
  CHECK(seen.result["rendered"]["n_rated"] == 1);
  CHECK(seen.result["rendered"]["drawn"].get<double>() > 0.5);
  CHECK(seen.result["rendered"]["source_unseen"] == 980);
  CHECK(is_warned_of(seen.result, "2.0 % of the source's Gaussians"));
  CHECK(seen.result["verdict"]["hardly_seen"] == true);
}

TEST_CASE("a scene that is empty or draws nothing is unrated") {
  const TemporaryFolder folder;
  SplatCloud damaged = audit_cloud(5, 1);
  std::fill(damaged.mean.begin(), damaged.mean.end(), std::numeric_limits<float>::quiet_NaN());
  for (const SplatCloud& cloud : {audit_cloud(0, 1), damaged}) {
    const std::string ply = write_ply(folder.file("e.ply"), cloud);
    const std::string rgs = write_rgs(folder.file("e.rgs"), audit_cloud(0, 1));
    const std::vector<std::string> command{ply, rgs, "--views", "2", "--size", "32x32", "--json", "-", "--quiet"};
    const ProgramResult run = run_audit(command);
    INFO(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(json::parse(run.out)["verdict"]["grade"] == "unrated");
    std::vector<std::string> gated = command;
    gated.insert(gated.end(), {"--fail-below", "psnr=1"});
    CHECK(run_audit(gated).exit_code == 5);
  }
}

TEST_CASE("unrated pairs of folders do not count as pairs of infinite PSNR") {
  const SceneFolder scene;
  for (const char* name : {"ply", "rgs", "cameras"}) fs::create_directory(scene.file(name));
  for (const char* name : {"blind", "fine"}) {
    fs::copy(scene.ply, scene.file("ply/" + std::string(name) + ".ply"));
    fs::copy(scene.rgs, scene.file("rgs/" + std::string(name) + ".rgs"));
  }
  write_cameras(scene.file("cameras/blind.json"), std::array{kBehind, kBehind - 1});
  write_cameras(scene.file("cameras/fine.json"), 1);
  const std::string out = scene.file("out");
  const std::vector<std::string> command{scene.file("ply"), scene.file("rgs"),     "--report",        out,
                                         "--cameras",       scene.file("cameras"), "--no-attribution"};
  CHECK(run_audit(command).exit_code == 0);
  const json index = json::parse(read_text(out + "/index.json"));
  const json &blind = index["pairs"][0], &fine = index["pairs"][1];
  CHECK(blind["name"] == "blind");
  CHECK(blind["grade"] == "unrated");
  CHECK(blind["n_rated"] == 0);
  CHECK_FALSE(blind.contains("psnr"));
  CHECK(fine["grade"] == "no_visible_loss");
  CHECK(fine["psnr"].get<double>() > 40);
  const std::string csv = read_text(out + "/index.csv");
  CHECK(csv.starts_with(
      "name,status,grade,source_bytes,asset_bytes,gaussians,ratio,bytes_per_gaussian,n_views,n_rated,"));
  CHECK(csv.find("inf") == std::string::npos);
  CHECK(csv.find("nan") == std::string::npos);
  const std::string table = read_text(out + "/index.html");
  CHECK(table.find("&infin;") == std::string::npos);
  CHECK(table.find("2 of 2 pairs pass, 1 not rated.") != std::string::npos);
  std::vector<std::string> gated = command;
  gated.insert(gated.end(), {"--fail-below", "psnr=20", "--overwrite"});
  CHECK(run_audit(gated).exit_code == 5);
  // Again: the row comes from the stored result and is the same.
  const json first = json::parse(read_text(out + "/index.json"));
  CHECK(first["pairs"][0]["status"] == "gate failed");
  CHECK(run_audit(gated).exit_code == 5);
  CHECK(json::parse(read_text(out + "/index.json")) == first);
}

TEST_CASE("rgs-convert --audit reports that nothing was rated") {
  const SceneFolder scene;
  const std::string cameras = write_cameras(scene.file("far.json"), std::array{kTiny});
  const ProgramResult run =
      run_program({built("rgs-convert"), scene.ply, scene.file("made.rgs"), "--audit", "--cameras", cameras});
  INFO(run.err);
  CHECK(run.exit_code == 0);
  CHECK(run.out.find("not rated") != std::string::npos);
  CHECK(run.out.find("identical") == std::string::npos);
}

TEST_CASE("the number of rated views can be a gate of its own") {
  const SceneFolder scene;
  CHECK(Seen(scene, scene.rgs, {kNear, 3, kBehind}, {"--fail-below", "rated-views=2"}).run.exit_code == 0);
  const Seen few(scene, scene.rgs, {kNear, 3, kBehind}, {"--fail-below", "rated-views=3"});
  CHECK(few.run.exit_code == 5);
  CHECK(few.run.err.find("rated-views 2 < 3") != std::string::npos);
}

TEST_CASE("cameras that mirror the scene and pictures without pixels are refused, not rated") {
  const SceneFolder scene;
  const std::string cameras = scene.file("bad.json");
  const auto audit_with = [&](const std::string& width, const std::string& x) {
    write_text(cameras, R"([{"name":"a","width":)" + width + R"(,"height":72,"fx":90,"fy":90,"world_to_camera":[[)" +
                            x + R"(,0,0,0],[0,1,0,0],[0,0,1,2.5],[0,0,0,1]]}])");
    return run_audit({scene.ply, scene.rgs, "--cameras", cameras, "--quiet", "--fail-below", "psnr=1"});
  };
  CHECK(audit_with("96", "1").exit_code == 0);
  CHECK(audit_with("96", "-1").exit_code == 4);
  CHECK(audit_with("0", "1").exit_code == 4);
  CHECK(run_audit({scene.ply, scene.rgs, "--size", "0x0"}).exit_code == 2);
  // Colours beyond FP32: pictures are not finite.
  SplatCloud glaring = scene.cloud;
  std::fill(glaring.sh.begin(), glaring.sh.end(), std::numeric_limits<float>::max());
  const std::string ply = write_ply(scene.file("glaring.ply"), glaring);
  const ProgramResult run = run_audit({ply, ply, "--cameras", scene.cameras, "--quiet", "--fail-below", "psnr=1"});
  CHECK(run.exit_code == 4);
  CHECK(run.err.find("view a.png") != std::string::npos);
  for (const char* gate : {"largest=nan", "psnr=-inf", "rated-views=nan", "psnr=1e999"})
    CHECK(run_audit({scene.ply, scene.rgs, "--fail-below", gate}).exit_code == 2);
}
