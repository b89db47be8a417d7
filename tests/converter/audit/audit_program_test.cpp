// audit_program_test.cpp - rgs-audit as users and pipelines run it, and its report in a browser.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <numeric>
#include <string>
#include <utility>
#include <vector>

#include "audit_command.hpp"
#include "audit_picture.hpp"
#include "audit_program_fixture.hpp"
#include "audit_report.hpp"
#include "image_file.hpp"
#include "rgs/checksum.hpp"
#include "rgs/image_metrics.hpp"
#include "rgs/renderer.hpp"
#include "rgs/splat_edit.hpp"
#include "run_program.hpp"
#include "scene_file.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"

namespace fs = std::filesystem;
using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

// Pictures named like the cameras; their content does not matter.
void write_photos(const std::string& folder, int n, int width = 96, int height = 72) {
  fs::create_directories(folder);
  SplitMix random(3);
  for (int i = 0; i < n; ++i) {
    Image photo = Image::make(width, height, 3);
    for (float& v : photo.pixels) v = random.dyadic(0, 1);
    REQUIRE(write_image(folder + "/" + static_cast<char>('a' + i) + ".png", photo,
                        {.file = {.overwrite = true, .sync = false}}));
  }
}

audit::Picture render(const Scene& scene, double z) {
  Camera camera;
  camera.width = 96, camera.height = 72;
  camera.fx = camera.fy = 90;
  camera.cx = 48, camera.cy = 36;
  camera.world_to_camera[3].z = z;
  auto renderer = Renderer::create();
  const auto over = [&](float grey) {
    Image image = Image::make(96, 72, 3);
    REQUIRE(renderer->render(scene, camera, {.rgb = image.pixels},
                             {.background = {grey, grey, grey}, .pipeline = Pipeline::baseline}));
    return image;
  };
  return {over(0), over(1)};
}

// A report with everything that it can hold, of a file with a hostile name.
ProgramResult full_report(const SceneFolder& scene, const std::string& page) {
  const std::string hostile = scene.file("<img src=x onerror=alert(1)> \"&'.ply");
  fs::copy(scene.ply, hostile);
  write_photos(scene.file("photos"), 3);
  return run_audit({hostile, scene.rgs, "--cameras", scene.cameras, "--photos", scene.file("photos"),
                    "--compare-scales", "--also", scene.ply, "--report", page});
}

}  // namespace

TEST_CASE("an audit measures sizes, attributes and pictures, and its JSON keeps the documented form") {
  const SceneFolder scene;
  const json j = scene.result();
  CHECK(j["schema"] == "rgs-audit/3");
  CHECK(j["source"]["gaussians"] == 700);
  CHECK(j["asset"]["format"] == "rgs");
  CHECK(j["asset"]["made_from_source"] == true);
  CHECK(j["size"]["ratio"].get<double>() ==
        doctest::Approx(static_cast<double>(fs::file_size(scene.ply)) / static_cast<double>(fs::file_size(scene.rgs))));
  CHECK(j["size"]["sections"].size() >= 6);
  CHECK(j["size"]["gpu_bytes"].get<std::uint64_t>() >= 700 * 76);
  CHECK(j["gaussians"]["paired"] == 700);
  CHECK(j["attributes"]["errors"].size() == 16);
  CHECK(j["attributes"]["sh_codes"].size() == 4);
  REQUIRE(j["rendered"]["views"].size() == 3);
  CHECK(j["rendered"]["psnr"].get<double>() > 45);
  CHECK(j["rendered"]["views"][0]["psnr"] == j["rendered"]["worst_psnr"]);
  CHECK(j["rendered"]["views"][0]["psnr"].get<double>() <= j["rendered"]["views"][2]["psnr"].get<double>());

  // The same numbers, directly from renderer and comparison.
  const Scene source = Scene::load(scene.cloud).value(), asset = Scene::load(scene.rgs).value();
  const json* view = nullptr;
  for (const json& v : j["rendered"]["views"])
    if (v["name"] == "b.png") view = &v;
  REQUIRE(view != nullptr);
  const audit::Picture a = render(source, 3), b = render(asset, 3);
  CHECK((*view)["psnr"].get<double>() == doctest::Approx(difference(a, b)->psnr).epsilon(1e-6));
  CHECK((*view)["ssim"].get<double>() == doctest::Approx(*ssim(a, b)).epsilon(1e-9));
  CHECK((*view)["largest"]["difference"].get<double>() == doctest::Approx(difference(a, b)->largest).epsilon(1e-4));
}

TEST_CASE("FLIP is measured when asked for or when a condition needs it, and only then") {
  const SceneFolder scene;
  CHECK_FALSE(scene.result()["rendered"].contains("flip"));
  const json j = scene.result({"--measures", "flip"})["rendered"];
  double sum = 0, worst = 0;
  for (const json& v : j["views"]) sum += v["flip"].get<double>(), worst = std::max(worst, v["flip"].get<double>());
  CHECK(worst > 0);
  CHECK(j["flip"].get<double>() == doctest::Approx(sum / 3).epsilon(1e-12));
  CHECK(j["worst_flip"] == worst);
  const Scene source = Scene::load(scene.cloud).value(), asset = Scene::load(scene.rgs).value();
  const audit::Picture a = render(source, 3), b = render(asset, 3);
  const double over_black = flip(a.black, b.black).value(), over_white = flip(a.white, b.white).value();
  for (const json& v : j["views"])
    if (v["name"] == "b.png")
      CHECK(v["flip"].get<double>() == doctest::Approx(std::max(over_black, over_white)).epsilon(1e-4));
  Image map;
  for (const auto& [x, y] :
       {std::pair(a, b), std::pair(audit::Picture{a.white, a.black}, audit::Picture{b.white, b.black})}) {
    CHECK(audit::measure(audit::kFlip, x, y, &map).value() == std::max(over_black, over_white));
    CHECK(std::accumulate(map.pixels.begin(), map.pixels.end(), 0.0) / (96 * 72) ==
          doctest::Approx(std::max(over_black, over_white)).epsilon(1e-6));
  }

  const std::string page = scene.file("flip.html");
  const auto gated = [&](const std::string& condition, const std::string& asset_path) {
    return run_audit({scene.ply, asset_path, "--cameras", scene.cameras, "--fail-below", condition, "--report", page,
                      "--overwrite"});
  };
  CHECK(gated("flip=0,worst-flip=0", scene.ply).exit_code == 0);
  const ProgramResult fails = gated("worst-flip=0", scene.rgs);
  CHECK(fails.exit_code == 5);
  CHECK(fails.out.find("FLIP") != std::string::npos);
  CHECK(read_text(page).find("<th>FLIP</th>") != std::string::npos);
  CHECK(read_text(page).find("alt=\"FLIP map of b.png\"") != std::string::npos);
  CHECK(gated("flip=1", scene.rgs).exit_code == 0);
  CHECK(run_audit({scene.ply, scene.rgs, "--measures", "other"}).exit_code == 2);
  CHECK(run_audit({scene.ply, scene.rgs, "--measures", "flip", "--no-render"}).exit_code == 2);
}

TEST_CASE("MS-SSIM and GMSD are measured like FLIP, and limited from below and from above") {
  const SceneFolder scene;
  const json plain = scene.result(), both = scene.result({"--measures", "gmsd,ms-ssim"});
  CHECK_FALSE(plain["rendered"].contains("gmsd"));
  CHECK_FALSE(both["rendered"].contains("flip"));
  CHECK(both["fingerprint"] != plain["fingerprint"]);
  CHECK(both["fingerprint"] != scene.result({"--measures", "gmsd"})["fingerprint"]);
  const json& j = both["rendered"];
  const Scene source = Scene::load(scene.cloud).value(), asset = Scene::load(scene.rgs).value();
  const audit::Picture a = render(source, 3), b = render(asset, 3);
  const double lowest = std::min(ms_ssim(a.black, b.black).value(), ms_ssim(a.white, b.white).value());
  const double highest = std::max(gmsd(a.black, b.black).value(), gmsd(a.white, b.white).value());
  for (const auto& [x, y] :
       {std::pair(a, b), std::pair(audit::Picture{a.white, a.black}, audit::Picture{b.white, b.black})}) {
    CHECK(audit::measure(audit::kMsSsim, x, y).value() == lowest);
    CHECK(audit::measure(audit::kGmsd, x, y).value() == highest);
  }
  double m_sum = 0, g_sum = 0, m_worst = 1, g_worst = 0;
  for (const json& v : j["views"]) {
    const double m = v["ms_ssim"].get<double>(), g = v["gmsd"].get<double>();
    m_sum += m, g_sum += g, m_worst = std::min(m_worst, m), g_worst = std::max(g_worst, g);
    if (v["name"] != "b.png") continue;
    CHECK(m == doctest::Approx(lowest).epsilon(1e-6));
    CHECK(g == doctest::Approx(highest).epsilon(1e-6));
  }
  CHECK(m_worst < 1);
  CHECK(g_worst > 0);
  CHECK(j["ms_ssim"].get<double>() == doctest::Approx(m_sum / 3).epsilon(1e-12));
  CHECK(j["gmsd"].get<double>() == doctest::Approx(g_sum / 3).epsilon(1e-12));
  CHECK(j["worst_ms_ssim"] == m_worst);
  CHECK(j["worst_gmsd"] == g_worst);

  const std::string page = scene.file("page.html");
  const auto gated = [&](const std::string& conditions, const std::string& asset_path) {
    return run_audit({scene.ply, asset_path, "--cameras", scene.cameras, "--fail-below", conditions, "--report", page,
                      "--overwrite"});
  };
  CHECK(gated("ms-ssim=1,worst-ms-ssim=1,gmsd=0,worst-gmsd=0", scene.ply).exit_code == 0);
  CHECK(gated("ms-ssim=0.5,worst-gmsd=1", scene.rgs).exit_code == 0);
  CHECK(gated("worst-gmsd=0", scene.rgs).exit_code == 5);
  const ProgramResult fails = gated("worst-ms-ssim=1", scene.rgs);
  CHECK(fails.exit_code == 5);
  CHECK(fails.out.find("MS-SSIM") != std::string::npos);
  CHECK(read_text(page).find("<th>MS-SSIM</th>") != std::string::npos);
  CHECK(read_text(page).find("<dt>MS-SSIM</dt>") != std::string::npos);
  CHECK(read_text(page).find("alt=\"MS-SSIM map of b.png\"") != std::string::npos);
  CHECK(read_text(page).find("alt=\"GMSD map") == std::string::npos);
}

TEST_CASE("--video measures its frames in the cameras' order, with the flicker that the source does not have") {
  const SceneFolder scene;
  const double depths[] = {3, 2.5, 3.5};
  const std::string path = write_cameras(scene.cameras, depths);
  CHECK_FALSE(scene.result()["rendered"].contains("video"));
  const json j = scene.result({"--video", "--fps", "2", "--measures", "flip"});
  CHECK(j["fingerprint"] != scene.result({"--video", "--measures", "flip"})["fingerprint"]);
  const json& video = j["rendered"]["video"];
  CHECK(video["fps"] == 2);
  REQUIRE(video["frames"].size() == 3);
  const Scene source = Scene::load(scene.cloud).value(), asset = Scene::load(scene.rgs).value();
  audit::Picture before_s, before_a;
  std::vector<double> flickers;
  for (std::size_t t = 0; t < 3; ++t) {
    const json& frame = video["frames"][t];
    CHECK(frame["name"] == std::string(1, static_cast<char>('a' + t)) + ".png");
    for (const json& v : j["rendered"]["views"])
      if (v["name"] == frame["name"]) CHECK((v["psnr"] == frame["psnr"] && v["flip"] == frame["flip"]));
    const audit::Picture s = render(source, depths[t]), a = render(asset, depths[t]);
    if (t > 0) {
      double squares = 0;
      for (std::size_t i = 0; i < s.black.pixels.size(); ++i) {
        double most = 0;
        for (const bool white : {false, true}) {
          const auto change = [&](const audit::Picture& now, const audit::Picture& before) {
            return static_cast<double>(now.over(white).pixels[i]) - static_cast<double>(before.over(white).pixels[i]);
          };
          most = std::max(most, std::abs(change(a, before_a) - change(s, before_s)));
        }
        squares += most * most;
      }
      flickers.push_back(255 * std::sqrt(squares / static_cast<double>(s.black.pixels.size())));
      CHECK(flickers.back() > 1e-3);
      CHECK(frame["flicker"].get<double>() / flickers.back() == doctest::Approx(1).epsilon(1e-3));
    }
    before_s = s, before_a = a;
  }
  CHECK_FALSE(video["frames"][0].contains("flicker"));
  CHECK(video["flicker"].get<double>() / (flickers[0] + flickers[1]) == doctest::Approx(0.5).epsilon(1e-3));
  CHECK(video["worst_flicker_frame"] == (flickers[0] >= flickers[1] ? 1 : 2));
  const double first = video["frames"][0]["flip"], second = video["frames"][1]["flip"],
               third = video["frames"][2]["flip"];
  CHECK(video["worst_seconds"]["flip"]["first"] == (first >= third ? 0 : 1));
  CHECK(video["worst_seconds"]["flip"]["mean"].get<double>() ==
        doctest::Approx((second + std::max(first, third)) / 2).epsilon(1e-9));
  CHECK(scene.result({"--video", "--fps", "2", "--measures", "flip", "--threads", "1"})["rendered"]["video"] == video);

  const std::string page = scene.file("video.html");
  const auto gated = [&](const std::string& asset_path, const std::string& conditions) {
    return run_audit({scene.ply, asset_path, "--cameras", path, "--video", "--fail-below", conditions, "--report", page,
                      "--overwrite"});
  };
  CHECK(gated(scene.ply, "flicker=0,worst-flicker=0").exit_code == 0);
  CHECK(gated(scene.rgs, "flicker=255").exit_code == 0);
  CHECK(gated(scene.rgs, "flicker=0").exit_code == 5);
  const ProgramResult fails = gated(scene.rgs, "worst-flicker=0");
  CHECK(fails.exit_code == 5);
  CHECK(fails.out.find("3 frames, 30 a second") != std::string::npos);
  CHECK(read_text(page).find("aria-label=\"Flicker of each frame\"") != std::string::npos);
  const auto usage = [&](std::vector<std::string> more) {
    more.insert(more.begin(), {scene.ply, scene.rgs});
    return run_audit(more).exit_code;
  };
  CHECK(usage({"--video"}) == 2);
  CHECK(usage({"--cameras", path, "--fps", "24"}) == 2);
  CHECK(usage({"--cameras", path, "--video", "--no-render"}) == 2);
  CHECK(usage({"--cameras", path, "--fail-below", "flicker=1"}) == 2);
}

TEST_CASE("MS-SSIM refuses views below its window, but not for the small pictures of a search") {
  const SceneFolder scene;
  const auto at = [&](const char* size) {
    return run_audit({scene.ply, scene.rgs, "--no-attribution", "--measures", "ms-ssim", "--views", "2", "--worst", "1",
                      "--size", size});
  };
  CHECK(at("320x16").exit_code == 0);  // searched at 160x8
  const ProgramResult refused = at("320x10");
  CHECK(refused.exit_code != 0);
  CHECK(refused.err.find("MS-SSIM takes pictures of at least 11 pixels a side") != std::string::npos);
}

TEST_CASE("the attribution has every step alone and all together") {
  const SceneFolder scene;
  const json j = scene.result({"--compare-scales"});
  std::map<std::string, double> mse;
  for (const json& row : j["rendered"]["attribution"]) {
    mse[row["key"]] = row["mse"];
    CHECK(row["share"].get<double>() ==
          doctest::Approx(row["mse"].get<double>() / j["rendered"]["attribution"][6]["mse"].get<double>()));
  }
  for (const char* key :
       {"sh", "geometry", "conversion", "key", "exp", "lists", "together", "file_scales", "chunk_scales"})
    CHECK_MESSAGE(mse.count(key) == 1, key);
  CHECK(mse["conversion"] == doctest::Approx(j["rendered"]["mse"].get<double>()));
  CHECK(mse["sh"] < mse["together"]);
  CHECK(mse["geometry"] < mse["sh"]);
  CHECK(mse["sh"] + mse["geometry"] == doctest::Approx(mse["conversion"]).epsilon(0.3));
  CHECK(mse["chunk_scales"] == doctest::Approx(mse["sh"]).epsilon(0.01));  // the encoder's work, repeated
  CHECK(mse["file_scales"] > mse["chunk_scales"]);
  CHECK(mse["exp"] > 1e-8);
  CHECK(scene.result({"--no-attribution"})["rendered"]["attribution"].empty());
}

TEST_CASE("a scene against itself is identical: infinite PSNR, SSIM 1, and no NaN anywhere") {
  const SceneFolder scene;
  const ProgramResult run = run_audit({scene.ply, scene.ply, "--cameras", scene.cameras, "--json", "-", "--fail-below",
                                       "psnr=200,worst-psnr=200,ssim=1,largest=0", "--report", scene.file("r.html")});
  REQUIRE(run.exit_code == 0);
  const json j = json::parse(run.out);
  CHECK(j["verdict"]["grade"] == "identical");
  CHECK(j["rendered"]["psnr"].is_null());
  CHECK(j["rendered"]["mse"] == 0);
  CHECK(j["rendered"]["ssim"] == 1);
  CHECK_FALSE(j.contains("attributes"));
  const std::string page = read_text(scene.file("r.html"));
  CHECK(page.find(">nan") == std::string::npos);
  CHECK(page.find("&infin;") != std::string::npos);
}

TEST_CASE("the pages pass their own tests in a browser") {
  if (browser().empty()) return skip_without_tool("there is no browser to open the report in (Debian: chromium)");
  const SceneFolder scene;
  const std::string same = scene.file("same.html"), full = scene.file("full.html"), tables = scene.file("tables");
  REQUIRE(run_audit({scene.ply, scene.ply, "--cameras", scene.cameras, "--report", same}).exit_code == 0);
  check_in_browser(scene, same, "ok, 0 images, 0 sliders");
  REQUIRE(full_report(scene, full).exit_code == 0);
  check_in_browser(scene, full, "ok, 19 images, 1 sliders");
  for (const char* name : {"ply", "rgs"}) fs::create_directory(scene.file(name));
  fs::copy(scene.ply, scene.file("ply/one.ply"));
  fs::copy(scene.rgs, scene.file("rgs/one.rgs"));
  write_text(scene.file("rgs/alone.rgs"), "damaged");
  CHECK(run_audit({scene.file("ply"), scene.file("rgs"), "--report", tables, "--views", "2", "--size", "64x48",
                   "--no-attribution"})
            .exit_code == 3);
  check_in_browser(scene, tables + "/index.html", "ok, 0 images, 0 sliders");
}

TEST_CASE("the report is one page, whatever the files' names") {
  const SceneFolder scene;
  const std::string page = scene.file("report.html");
  const ProgramResult run = full_report(scene, page);
  INFO(run.err);
  REQUIRE(run.exit_code == 0);
  CHECK(run.out.find("report: " + page) != std::string::npos);
  const std::string text = read_text(page);
  CHECK(text.size() < audit::kMaxReportBytes);
  CHECK(text.find("<img src=x") == std::string::npos);
  CHECK(text.find("http://") == std::string::npos);
  CHECK(text.find("https://") == std::string::npos);
  for (const char* id : {"where", "views", "steps", "attributes", "worst", "size", "method"})
    CHECK_MESSAGE(text.find("<h2 id=\"" + std::string(id) + "\"") != std::string::npos, id);
  check_in_browser(scene, page, "ok, 19 images, 1 sliders");
}

TEST_CASE("a report shows photographs beside the pictures, and each view has the command that opens it") {
  const SceneFolder scene;
  const std::string photos = scene.file("photos"), page = scene.file("report.html");
  write_photos(photos, 3);
  const ProgramResult run = run_audit({scene.ply, scene.rgs, "--cameras", scene.cameras, "--photos", photos,
                                       "--no-attribution", "--report", page, "--quiet"});
  REQUIRE(run.exit_code == 0);
  const std::string text = read_text(page);
  CHECK(text.find(", photograph\">") != std::string::npos);
  CHECK(text.find("<span>Photograph</span>") != std::string::npos);
  const std::string command =
      "rgs-view " + scene.ply + " " + scene.rgs + " --cameras " + scene.cameras + " --photos " + photos;
  CHECK(text.find("data-command=\"" + command + "\">" + command + "</code>") != std::string::npos);
  for (const char* view : {"a.png", "b.png", "c.png"})
    CHECK(text.find("data-view=\" --view=" + std::string(view) + "\"") != std::string::npos);
  if (browser().empty()) return skip_without_tool("no browser");
  check_in_browser(scene, page, "ok, 19 images, 1 sliders");
}

TEST_CASE("commands are quoted for a shell, or omitted") {
  using audit::shell_word, audit::view_command;
  for (const std::string& text :
       {std::string("a b"), std::string("it's $HOME `id`; \"x\" & | > * ? ~ # !"), std::string("-rf"),
        std::string("\xc3\xa4/\xe2\x82\xac"), std::string("'"), std::string("plain/a-b_c.rgs")}) {
    const ProgramResult said = run_shell("printf %s " + shell_word(text));
    CHECK(said.out == text);
  }
  CHECK(shell_word("plain/a-b_c.rgs") == "plain/a-b_c.rgs");
  for (const std::string& text :
       {std::string(), std::string("two\nlines"), std::string("a\xE2\x80\xAEgnp"), std::string("byte\xff"),
        std::string("\x1b[2J"), std::string("back\\slash"), std::string(5000, 'x')})
    CHECK(shell_word(text).empty());
  audit::Options options;
  options.source = "-a.ply", options.asset = "b c.rgs";
  CHECK(view_command(options) == "rgs-view ./-a.ply 'b c.rgs'");
  options.cameras = "cameras.json";
  CHECK(view_command(options) == "rgs-view ./-a.ply 'b c.rgs' --cameras cameras.json");
  options.cameras = "two\nlines";
  CHECK(view_command(options).empty());
  options.cameras.clear(), options.source = "a\n.ply";
  CHECK(view_command(options).empty());
  CHECK(audit::view_argument("--export=x") == " --view='--export=x'");
}

TEST_CASE("large noisy pictures keep to the report's size, photographs too") {
  const TemporaryFolder folder;
  audit::Report report;
  report.render.emplace();
  SplitMix random(4);
  for (std::size_t i = 0; i < 3; ++i) {
    Image source = Image::make(2400, 1600, 3), asset = source;
    for (float& v : source.pixels) v = static_cast<float>(random.below(256)) / 255;
    for (float& v : asset.pixels) v = static_cast<float>(random.below(256)) / 255;
    audit::ViewPictures p{i, {source, source}, {asset, asset}, asset};
    report.render->pictures.push_back(std::move(p));
    audit::ViewResult view;
    view.name = "noise";
    view.width = 2400, view.height = 1600;
    view.score.psnr = 8, view.score.mse = 0.16;
    report.render->views.push_back(view);
  }
  report.render->psnr = report.render->worst_psnr = 8;
  report.render->n_rated = 3;
  const std::string page = audit::audit_html(report);
  CHECK(page.size() < audit::kMaxReportBytes);
  CHECK(page.size() > 3'000'000);
  CHECK(page.find("\"data:,\" ") == std::string::npos);  // no picture was omitted
}

TEST_CASE("failed gates are exit code 5 and are named") {
  const SceneFolder scene;
  const ProgramResult run =
      run_audit({scene.ply, scene.rgs, "--cameras", scene.cameras, "--no-attribution", "--fail-below",
                 "psnr=20,worst-ssim=0.999999999", "--fail-below", "bytes-per-gaussian=60", "--quiet"});
  CHECK(run.exit_code == 5);
  CHECK(run.out.empty());
  CHECK(run.err.find("worst-ssim") != std::string::npos);
  CHECK(run.err.find("bytes-per-gaussian") != std::string::npos);
  CHECK(run.err.find("psnr 4") == std::string::npos);
  CHECK(run_audit({scene.ply, scene.rgs, "--no-render", "--fail-below", "bytes-per-gaussian=90,ratio=2,dropped=0"})
            .exit_code == 0);
}

TEST_CASE("Gaussians that the conversion dropped appear in numbers, attribution and verdict") {
  const SceneFolder scene;
  const SplatCloud part = [&] {
    SplatCloud out = scene.cloud;
    for (std::uint64_t i = 0; i < 40; ++i) out.mean[3 * i] = std::nanf("");
    return out;
  }();
  EncodeOptions options;
  options.max_bad_fraction = 1;
  const std::string rgs = write_rgs(scene.file("part.rgs"), part, options);
  const ProgramResult run =
      run_audit({scene.ply, rgs, "--cameras", scene.cameras, "--json", "-", "--fail-below", "dropped=10", "--quiet"});
  CHECK(run.exit_code == 5);
  const json j = json::parse(run.out);
  CHECK(j["gaussians"]["dropped"] == 40);
  CHECK(j["asset"]["made_from_source"].is_null());
  CHECK(j["rendered"]["attribution"][0]["key"] == "left_out");
  CHECK(j["rendered"]["attribution"][0]["share"].get<double>() > 0.9);
  CHECK(j["verdict"]["detail"].get<std::string>().find("40 Gaussians of the source are missing from the asset") !=
        std::string::npos);
  // A damaged source: Gaussians that cannot be drawn are counted, not an error.
  const std::string damaged = write_ply(scene.file("damaged.ply"), part);
  const ProgramResult with = run_audit({damaged, rgs, "--cameras", scene.cameras, "--json", "-", "--quiet"});
  REQUIRE(with.exit_code == 0);
  CHECK(json::parse(with.out)["rendered"]["n_undrawable"] == 40);
}

TEST_CASE("photographs are found by name and compared with both sides") {
  const SceneFolder scene;
  const std::string photos = scene.file("photos");
  write_photos(photos, 3);
  const json j = scene.result({"--photos", photos, "--no-attribution"});
  REQUIRE(j["rendered"]["photos"].is_object());
  const json& view = j["rendered"]["views"][0];
  const std::string name = view["name"];
  Image source = render(Scene::load(scene.cloud).value(), 2.5 + 0.5 * (name[0] - 'a')).black;
  for (float& v : source.pixels) v = std::clamp(v, 0.F, 1.F);
  const Image photo = read_image(photos + "/" + name).value();
  CHECK(view["photo"]["source_psnr"].get<double>() == doctest::Approx(difference(photo, source)->psnr).epsilon(1e-6));
  CHECK(view["photo"]["source_ssim"].get<double>() == doctest::Approx(*ssim(photo, source)).epsilon(1e-6));
  CHECK(view["photo"]["loss"].get<double>() ==
        doctest::Approx(view["photo"]["source_psnr"].get<double>() - view["photo"]["asset_psnr"].get<double>()));

  fs::remove(photos + "/b.png");
  const std::vector<std::string> command{scene.ply,  scene.rgs, "--cameras", scene.cameras,
                                         "--photos", photos,    "--quiet"};
  const ProgramResult missing = run_audit(command);
  CHECK(missing.exit_code == 2);
  CHECK(missing.err.find("b.png") != std::string::npos);
  CHECK(missing.err.find("a.png") == std::string::npos);
  REQUIRE(write_image(photos + "/b.png", Image::make(64, 48, 3)));
  const ProgramResult size = run_audit(command);
  CHECK(size.exit_code == 2);
  CHECK(size.err.find("b.png (64x48, its camera 96x72)") != std::string::npos);
  write_text(photos + "/b.png", "not a picture");
  CHECK(run_audit(command).exit_code == 4);
}

TEST_CASE("a far scene is audited as it would be near the world's origin") {
  const SceneFolder scene;
  const Origin place{4.2e6, 1.7e5, 4.8e6};
  const std::string ply = write_ply(scene.file("far.ply"), scene.cloud, place), rgs = scene.file("far.rgs"),
                    cameras = write_cameras(scene.file("far.json"), 3, 96, 72, place);
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", ply, rgs}).exit_code == 0);
  const auto audited = [](const std::vector<std::string>& files) {
    std::vector<std::string> arguments{files};
    arguments.insert(arguments.end(), {"--json", "-", "--quiet"});
    const ProgramResult run = run_audit(arguments);
    INFO(run.err);
    REQUIRE(run.exit_code == 0);
    return json::parse(run.out);
  };
  const json home = audited({scene.ply, scene.rgs, "--cameras", scene.cameras}),
             far = audited({ply, rgs, "--cameras", cameras});
  CHECK(far["rendered"]["psnr"].get<double>() == doctest::Approx(home["rendered"]["psnr"].get<double>()).epsilon(0.01));
  // A circle around the scene sees it too.
  const json around = audited({ply, rgs, "--views", "2", "--size", "64x48", "--no-attribution"});
  CHECK(around["rendered"]["psnr"].get<double>() > 30);
  CHECK(around["rendered"]["psnr"].get<double>() < 90);  // null if both were empty
}

TEST_CASE("an audit warns that FP32 rounds the source's positions as it does the asset's") {
  const SceneFolder scene;
  SplatCloud apart = scene.cloud;
  for (std::uint64_t i = 0; i < apart.size(); ++i) apart.mean[3 * i] += i % 2 == 0 ? 6.4e6F : -6.4e6F;
  const std::string ply = write_ply(scene.file("apart.ply"), apart, {0.1, 0, 0}), rgs = scene.file("apart.rgs");
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", "--allow-rounding", ply, rgs}).exit_code == 0);
  const ProgramResult run = run_audit({ply, rgs, "--no-render", "--json", "-", "--quiet"});
  REQUIRE(run.exit_code == 0);
  CHECK(json::parse(run.out)["warnings"].dump().find("positions by up to 0.1 world units") != std::string::npos);
}

TEST_CASE("views without cameras, other sizes and splits") {
  const SceneFolder scene;
  const ProgramResult run = run_audit({scene.ply, scene.rgs, "--views", "2", "--worst", "1", "--size", "64x48",
                                       "--json", "-", "--no-attribution", "--quiet"});
  REQUIRE(run.exit_code == 0);
  const json j = json::parse(run.out);
  CHECK(j["rendered"]["automatic_views"] == true);
  REQUIRE(j["rendered"]["views"].size() == 2 + 1);
  CHECK(j["rendered"]["views"][0]["width"] == 64);
  CHECK(run_audit({scene.ply, scene.rgs, "--cameras", scene.cameras, "--split", "train"}).exit_code == 2);
}

TEST_CASE("other assets: sizes always, quality if they can be read") {
  const SceneFolder scene;
  write_text(scene.file("scene.spz"), "some other format");
  const json j = scene.result({"--also", scene.ply, "--also", scene.file("scene.spz"), "--no-attribution"});
  REQUIRE(j["also"].size() == 2);
  CHECK(j["also"][0]["measured"] == true);
  CHECK(j["also"][0]["psnr"].is_null());  // the source itself
  CHECK(j["also"][0]["ssim"] == 1);
  CHECK(j["also"][1]["bytes"] == 17);
  CHECK(j["also"][1]["measured"] == false);
  CHECK_FALSE(j["also"][1]["note"].get<std::string>().empty());
  CHECK(run_audit({scene.ply, scene.rgs, "--no-render", "--also", scene.file("absent.sog")}).exit_code == 3);
}

TEST_CASE("files of other formats are measured, also as the asset") {
  const SceneFolder scene;
  const std::string spz = scene.file("scene.spz"), packed_ply = scene.file("scene.compressed.ply");
  for (const std::string& file : {spz, packed_ply})
    REQUIRE(run_program({built("rgs-convert"), scene.ply, file, "--quiet"}).exit_code == 0);
  for (const std::string version : {"2", "3", "4"}) {
    CAPTURE(version);
    REQUIRE(run_program({built("rgs-convert"), scene.ply, spz, "--quiet", "--overwrite", "--spz-version", version})
                .exit_code == 0);
    const json also = scene.result({"--also", spz, "--no-attribution"})["also"][0];
    CHECK(also["measured"] == true);
    CHECK(also["bytes"] == fs::file_size(spz));
    CHECK(also["gaussians"] == 700);
    CHECK(also["psnr"].get<double>() > 25);
  }
  const ProgramResult run = run_audit({scene.ply, packed_ply, "--cameras", scene.cameras, "--json", "-", "--quiet"});
  REQUIRE(run.exit_code == 0);
  const json j = json::parse(run.out);
  CHECK(j["asset"]["format"] == "compressed.ply");
  CHECK(j["rendered"]["psnr"].get<double>() > 25);
}

TEST_CASE("an asset of another format is drawn as it declares, and the source too") {
  const SceneFolder scene;
  const auto bytes = encode_splats(scene.cloud.view(), SplatFormat::spz, {.aa_mode = AaMode::mip_splatting});
  REQUIRE(bytes);
  const std::string spz = write_bytes(scene.file("mip.spz"), *bytes);
  const std::string cameras = write_cameras(scene.file("far.json"), std::array{9.0});
  const ProgramResult run = run_audit({scene.ply, spz, "--cameras", cameras, "--json", "-", "--quiet"});
  REQUIRE(run.exit_code == 0);
  const SceneFile asset = load_scene_file(spz).value();
  REQUIRE(asset.scene.declarations()->aa_mode == AaMode::mip_splatting);
  const Scene as_declared = Scene::load(scene.cloud, asset.scene.declarations()).value(),
              classic = Scene::load(scene.cloud).value();
  const double expected = difference(render(as_declared, 9), render(asset.scene, 9))->psnr;
  CHECK(json::parse(run.out)["rendered"]["psnr"].get<double>() == doctest::Approx(expected).epsilon(1e-6));
  CHECK(difference(render(as_declared, 9), render(classic, 9))->psnr < 40);  // which matters
}

TEST_CASE("a source in axes other than 3DGS's is compared with assets turned to 3DGS's") {
  const SceneFolder scene;
  SplatCloud turned = scene.cloud;
  convert_axes(turned, kAxes3dgs, kAxesOpenGl);
  const std::string source =
      write_bytes(scene.file("gl.ply"), encode_splats(turned.view(), SplatFormat::ply, {.axes = kAxesOpenGl}).value());
  const std::string spz = write_bytes(scene.file("gl.spz"), encode_splats(turned.view(), SplatFormat::spz).value());
  EncodeOptions declared;
  declared.axes = kAxesOpenGl;
  const std::string rgs = write_rgs(scene.file("gl.rgs"), turned, declared);
  for (const auto& [asset, also] : {std::pair(spz, scene.ply), {scene.ply, spz}, {rgs, scene.ply}}) {
    const ProgramResult run = run_audit(
        {source, asset, "--also", also, "--cameras", scene.cameras, "--spz-axes", "opengl", "--json", "-", "--quiet"});
    REQUIRE_MESSAGE(run.exit_code == 0, run.err);
    const json result = json::parse(run.out);
    const json &psnr = result["rendered"]["psnr"], &of_also = result["also"][0]["psnr"];
    CHECK((psnr.is_null() || psnr.get<double>() > 30));
    CHECK((of_also.is_null() || of_also.get<double>() > 30));
  }
}

TEST_CASE("an anti-aliasing that the source declares and the asset has lost is reported") {
  const SceneFolder scene;
  const auto bytes = encode_splats(scene.cloud.view(), SplatFormat::ply, {.aa_mode = AaMode::mip_splatting});
  REQUIRE(bytes);
  const std::string source = write_bytes(scene.file("mip.ply"), *bytes);
  const std::string cameras = write_cameras(scene.file("far.json"), std::array{9.0});
  EncodeOptions as_stated;
  as_stated.aa_mode = AaMode::mip_splatting;
  const std::string lost = write_rgs(scene.file("lost.rgs"), scene.cloud),
                    kept = write_rgs(scene.file("kept.rgs"), scene.cloud, as_stated);
  const auto audit = [&](const std::string& asset) {
    const ProgramResult run = run_audit({source, asset, "--cameras", cameras, "--json", "-", "--quiet"});
    REQUIRE(run.exit_code == 0);
    return json::parse(run.out);
  };
  const json a = audit(lost), b = audit(kept);
  CHECK(a["rendered"]["psnr"].get<double>() < 40);
  CHECK(b["rendered"]["psnr"].get<double>() > 50);
  constexpr const char* kSaid =
      "anti-aliasing as Mip-Splatting, opacity compensated, low-pass 0.1 px^2; the asset: classic";
  CHECK(a["verdict"]["detail"].get<std::string>().find(kSaid) != std::string::npos);
  CHECK(b["verdict"]["detail"].get<std::string>().find("states mip") == std::string::npos);
}

TEST_CASE("a packed asset has the direct one's errors and pictures, in fewer bytes") {
  const SceneFolder scene;
  EncodeOptions options;
  options.profile = Profile::packed;
  const std::string packed = write_rgs(scene.file("packed.rgs"), scene.cloud, options);
  const ProgramResult run = run_audit({scene.ply, packed, "--cameras", scene.cameras, "--json", "-", "--quiet"});
  REQUIRE(run.exit_code == 0);
  const json a = scene.result(), b = json::parse(run.out);
  CHECK(b["attributes"]["errors"] == a["attributes"]["errors"]);
  CHECK(b["attributes"]["sh_codes"] == a["attributes"]["sh_codes"]);
  CHECK(b["rendered"]["mse"] == a["rendered"]["mse"]);
  CHECK(b["rendered"]["attribution"] == a["rendered"]["attribution"]);
  CHECK(b["size"]["gpu_bytes"] == a["size"]["gpu_bytes"]);
  CHECK(b["asset"]["bytes"] == fs::file_size(packed));
  CHECK(fs::file_size(packed) < fs::file_size(scene.rgs));
}

TEST_CASE("an archive's Gaussians are paired despite their moved means") {
  const SceneFolder scene;
  EncodeOptions options;
  options.profile = Profile::archive;
  const std::string archive = write_rgs(scene.file("archive.rgs"), scene.cloud, options);
  const ProgramResult run = run_audit({scene.ply, archive, "--cameras", scene.cameras, "--json", "-", "--quiet"});
  REQUIRE(run.exit_code == 0);
  const json j = json::parse(run.out);
  CHECK(j["gaussians"]["paired"] == scene.cloud.size());
  CHECK(j["gaussians"]["paired_by"] == "nearest");
  CHECK(j["rendered"]["psnr"].get<double>() > 30);
}

TEST_CASE("bad usage, missing and damaged files have their exit codes, and outputs are kept") {
  const SceneFolder scene;
  CHECK(run_audit({}).exit_code == 2);
  CHECK(run_audit({scene.ply, scene.rgs, "--fail-below", "speed=3"}).exit_code == 2);
  CHECK(run_audit({scene.ply, scene.rgs, "--fail-below", "loss=3"}).exit_code == 2);
  CHECK(run_audit({scene.ply, scene.rgs, "--size", "3"}).exit_code == 2);
  CHECK(run_audit({scene.ply, scene.path().string()}).exit_code == 2);
  CHECK(run_audit({scene.file("absent.ply"), scene.rgs}).exit_code == 3);
  CHECK(run_audit({scene.ply, scene.file("absent.rgs")}).exit_code == 3);
  CHECK(run_audit({scene.cameras, scene.rgs}).exit_code == 4);  // no scene
  CHECK(run_audit({scene.ply, scene.rgs, "--cameras", scene.ply}).exit_code == 4);
  std::string bytes = read_text(scene.rgs);
  bytes[bytes.size() / 2] = static_cast<char>(bytes[bytes.size() / 2] ^ 1);
  write_text(scene.file("damaged.rgs"), bytes);
  const ProgramResult damaged = run_audit({scene.ply, scene.file("damaged.rgs")});
  CHECK(damaged.exit_code == 4);
  CHECK(damaged.err.find("checksum_mismatch") != std::string::npos);
  const ProgramResult stranger =
      run_audit({scene.ply, write_rgs(scene.file("stranger.rgs"), audit_cloud(50, 1, 8)), "--no-render"});
  CHECK(stranger.exit_code == 4);
  CHECK(stranger.err.find("none of its Gaussians") != std::string::npos);
  write_text(scene.file("r.html"), "mine");
  const std::vector<std::string> again{scene.ply, scene.rgs, "--no-render", "--report", scene.file("r.html"),
                                       "--quiet"};
  CHECK(run_audit(again).exit_code == 3);
  CHECK(read_text(scene.file("r.html")) == "mine");
  std::vector<std::string> replace = again;
  replace.emplace_back("--overwrite");
  CHECK(run_audit(replace).exit_code == 0);
  CHECK(read_text(scene.file("r.html")).starts_with("<!doctype html>"));
}

TEST_CASE("an empty scene is audited without a division by zero") {
  const TemporaryFolder folder;
  const SplatCloud none = audit_cloud(0, 1);
  const std::string ply = write_ply(folder.file("e.ply"), none), rgs = write_rgs(folder.file("e.rgs"), none);
  const ProgramResult run = run_audit(
      {ply, rgs, "--views", "1", "--size", "32x32", "--json", "-", "--report", folder.file("e.html"), "--quiet"});
  INFO(run.err);
  REQUIRE(run.exit_code == 0);
  CHECK(json::parse(run.out)["verdict"]["grade"] == "unrated");
  CHECK(read_text(folder.file("e.html")).find("nan") == std::string::npos);
}

TEST_CASE("two folders become a table, and an interrupted run continues") {
  const TemporaryFolder folder;
  for (const char* name : {"ply", "rgs"}) fs::create_directory(folder.file(name));
  for (const char* name : {"one", "two", "three"}) {
    const SplatCloud cloud = audit_cloud(200, 1, static_cast<std::uint64_t>(name[1]));
    write_ply(folder.file("ply/" + std::string(name) + ".ply"), cloud);
    write_rgs(folder.file("rgs/" + std::string(name) + ".rgs"), cloud);
  }
  write_ply(folder.file("ply/alone.ply"), audit_cloud(10, 0));
  write_text(folder.file("rgs/three.rgs"), "damaged");
  const std::string out = folder.file("out");
  const std::vector<std::string> command{
      folder.file("ply"), folder.file("rgs"), "--report",        out, "--views", "2", "--size", "64x48",
      "--fail-below",     "psnr=30",          "--no-attribution"};
  const ProgramResult first = run_audit(command);
  CHECK(first.exit_code == 3);  // of the first problem: alone.ply has no partner
  CHECK(first.err.find("alone") != std::string::npos);
  CHECK(first.err.find("three") != std::string::npos);
  const auto statuses = [&] {
    std::map<std::string, std::string> status;
    const json index = json::parse(read_text(out + "/index.json"));
    for (const json& row : index["pairs"]) status[row["name"]] = row["status"];
    return status;
  };
  CHECK(statuses() == std::map<std::string, std::string>{
                          {"alone", "unpaired"}, {"one", "passed"}, {"two", "passed"}, {"three", "error"}});
  const std::string csv = read_text(out + "/index.csv");
  CHECK(std::count(csv.begin(), csv.end(), '\n') == 5);
  CHECK(fs::exists(out + "/one.html"));

  // Repaired: only new work is done.
  fs::remove(folder.file("ply/alone.ply"));
  write_rgs(folder.file("rgs/three.rgs"), audit_cloud(200, 1, static_cast<std::uint64_t>('h')));
  fs::last_write_time(out + "/one.html", fs::file_time_type::clock::now() - std::chrono::hours(1));
  const auto written = fs::last_write_time(out + "/one.html");
  const ProgramResult second = run_audit(command);
  INFO(second.err);
  CHECK(second.exit_code == 0);
  CHECK(second.out.find("one: ") != std::string::npos);
  CHECK(std::string(second.out).find("(as before)") != second.out.rfind("(as before)"));
  CHECK(fs::last_write_time(out + "/one.html") == written);
  CHECK(statuses()["three"] == "passed");

  // A changed asset is new, and its result is not replaced without permission.
  EncodeOptions coarse;
  coarse.sh_degree = 0;
  write_rgs(folder.file("rgs/one.rgs"), audit_cloud(200, 1, static_cast<std::uint64_t>('n')), coarse);
  CHECK(run_audit(command).exit_code == 3);
  std::vector<std::string> replace = command;
  replace.emplace_back("--overwrite");
  const ProgramResult third = run_audit(replace);
  CHECK(third.exit_code == 0);
  CHECK(third.out.find("two: ") != std::string::npos);
  CHECK(fs::last_write_time(out + "/one.html") != written);
  // Stricter gates are other options.
  replace[9] = "psnr=300";
  CHECK(run_audit(replace).exit_code == 5);
  CHECK(run_audit({folder.file("ply"), folder.file("rgs")}).exit_code == 2);
}

TEST_CASE("a conversion to a larger file does not call its output smaller") {
  const SceneFolder scene;
  const std::string small = scene.file("small.spz"), large = scene.file("large.ply");
  REQUIRE(run_program({built("rgs-convert"), scene.ply, small, "--quiet"}).exit_code == 0);
  const ProgramResult run = run_program({built("rgs-convert"), small, large});
  REQUIRE(run.exit_code == 0);
  CHECK(run.out.find("smaller") == std::string::npos);
  CHECK(run.out.find("x larger, ") != std::string::npos);
  const ProgramResult audited = run_audit({scene.ply, scene.ply, "--no-render"});
  CHECK(audited.out.find(": same size, ") != std::string::npos);
}

TEST_CASE("rgs-convert --audit leaves a report beside its output and passes the verdict on") {
  const SceneFolder scene;
  const std::string out = scene.file("made.rgs");
  const std::vector<std::string> command{built("rgs-convert"), scene.ply, out, "--audit", "--cameras", scene.cameras};
  const ProgramResult run = run_program(command);
  INFO(run.err);
  CHECK(run.exit_code == 0);
  CHECK(run.out.find("bytes per Gaussian") != std::string::npos);
  CHECK(run.out.find("report: " + scene.file("made.audit.html")) != std::string::npos);
  CHECK(read_text(scene.file("made.audit.html")).starts_with("<!doctype html>"));
  CHECK(run_program(command).exit_code == 3);  // both exist already
  CHECK(run_program({built("rgs-convert"), scene.ply, "-", "--to", "rgs", "--audit"}).exit_code == 2);
  CHECK(run_program({built("rgs-convert"), out, scene.file("back.ply"), "--audit"}).exit_code == 2);
  // Unpairable outputs are refused before the conversion; dropped Gaussians are reported.
  const std::string again = scene.file("again.rgs");
  CHECK(run_program({built("rgs-convert"), out, again, "--audit", "--level-of-detail", "0"}).exit_code == 2);
  CHECK(run_program({built("rgs-convert"), scene.ply, again, "--audit", "--scale", "2"}).exit_code == 2);
  CHECK(run_program({built("rgs-convert"), scene.ply, scene.ply, again, "--merge", "--audit"}).exit_code == 2);
  CHECK_FALSE(fs::exists(again));
  CHECK(run_program({built("rgs-convert"), scene.ply, again, "--audit", "--max-count", "600"}).exit_code == 0);
  CHECK(fs::exists(scene.file("again.audit.html")));
  CHECK(run_program({built("rgs-convert"), out, scene.file("from-rgs.rgs"), "--audit"}).exit_code == 0);
  CHECK(fs::exists(scene.file("from-rgs.audit.html")));
  // Without rgs-audit the program says so before it converts anything.
  fs::create_directory(scene.file("bin"));
  fs::copy(built("rgs-convert"), scene.file("bin/rgs-convert"));
  const ProgramResult alone =
      run_program({scene.file("bin/rgs-convert"), scene.ply, scene.file("other.rgs"), "--audit"});
  CHECK(alone.exit_code == 3);
  CHECK(alone.err.find("rgs-audit") != std::string::npos);
  CHECK_FALSE(fs::exists(scene.file("other.rgs")));
}

TEST_CASE("infinite logits and scales of 0 have finite errors, and nothing is omitted") {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  const SceneFolder scene;
  SplatCloud cloud = scene.cloud;
  for (std::size_t i = 0; i < 60; ++i) {
    cloud.opacity_logit[i] = i % 2 == 0 ? kInfinity : -kInfinity;
    if (i < 20) cloud.log_scale[3 * i] = -kInfinity;
    if (i < 5) cloud.log_scale[3 * i + 1] = cloud.log_scale[3 * i + 2] = -kInfinity;
  }
  const std::string ply = write_ply(scene.file("infinite.ply"), cloud);
  for (const Profile profile : {Profile::direct, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    EncodeOptions options;
    options.profile = profile;
    const std::string rgs = write_rgs(scene.file("infinite.rgs"), cloud, options);
    const ProgramResult run = run_audit({ply, rgs, "--cameras", scene.cameras, "--json", "-", "--quiet"});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(run.out.find("nan") == std::string::npos);
    const json j = json::parse(run.out);
    CHECK(j["gaussians"]["paired"] == 700);
    for (const auto& error : j["attributes"]["errors"].items()) {
      CAPTURE(error.key());
      CAPTURE(error.value().dump());
      CHECK(error.value().dump().find("null") == std::string::npos);
    }
    CHECK(j["rendered"]["psnr"] > (profile == Profile::direct ? 50 : 30));
    REQUIRE(j["rendered"]["attribution"].size() > 1);
    for (const json& step : j["rendered"]["attribution"]) CHECK(step["mse"].is_number());
  }
}
