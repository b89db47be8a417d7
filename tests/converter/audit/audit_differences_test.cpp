// audit_differences_test.cpp - what an audit must not miss: differences over other backgrounds, and Gaussians that are
// missing, added or in no view.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "audit_nearest.hpp"
#include "audit_picture.hpp"
#include "audit_program_fixture.hpp"
#include "rgs/splat_edit.hpp"

using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

json audited(std::vector<std::string> arguments, int exit_code = 0) {
  arguments.insert(arguments.end(), {"--json", "-", "--quiet"});
  const ProgramResult run = run_audit(arguments);
  INFO(run.err);
  REQUIRE(run.exit_code == exit_code);
  return json::parse(run.out);
}

// A sphere of black opaque Gaussians around the ball of audit_cloud() and its cameras: the sky.
SplatCloud black_shell(std::uint64_t n = 3000) {
  SplatCloud cloud;
  cloud.resize(n, 3);
  for (std::uint64_t i = 0; i < n; ++i) {
    // Fibonacci's lattice.
    const double z = 1 - (2 * static_cast<double>(i) + 1) / static_cast<double>(n);
    const double turn = 2.399963229728653 * static_cast<double>(i), across = std::sqrt(1 - z * z);
    Splat s;
    s.mean[0] = static_cast<float>(8 * across * std::cos(turn));
    s.mean[1] = static_cast<float>(8 * across * std::sin(turn));
    s.mean[2] = static_cast<float>(8 * z);
    std::fill_n(s.log_scale, 3, -1.F);
    s.rotation[0] = 1;
    s.opacity_logit = 8;
    std::fill_n(s.sh, 3, -2.F);
    cloud.set(i, s);
  }
  return cloud;
}

}  // namespace

TEST_CASE("a black shell around a scene with an open sky is heavy damage in every number") {
  const SceneFolder scene;
  SplatCloud shelled = scene.cloud;
  append_splats(shelled, black_shell());
  const std::string ply = write_ply(scene.file("shelled.ply"), shelled),
                    rgs = write_rgs(scene.file("shelled.rgs"), shelled), page = scene.file("page.html");
  struct Case {
    std::string source, asset;
  };
  for (const Case& c : {Case{scene.ply, ply}, Case{scene.ply, rgs}, Case{ply, scene.ply}, Case{ply, scene.rgs}}) {
    CAPTURE(c.asset);
    const json j = audited({c.source, c.asset, "--cameras", scene.cameras, "--also", c.asset, "--report", page,
                            "--overwrite", "--fail-below", "psnr=20,worst-psnr=20,ssim=0.9,worst-ssim=0.9,largest=200"},
                           5);
    CHECK(j["verdict"]["grade"] == "poor");
    for (const json& condition : j["gate"]["conditions"]) CHECK_MESSAGE(condition["holds"] == false, condition["name"]);
    const json& rendered = j["rendered"];
    CHECK(rendered["psnr"].get<double>() < 15);
    CHECK(rendered["largest"].get<double>() > 0.9);
    CHECK(rendered["views"][0]["background"] == "white");
    CHECK(j["also"][0]["psnr"] == rendered["psnr"]);
    CHECK(j["also"][0]["ssim"] == rendered["ssim"]);
    for (const json& row : rendered["attribution"])
      if (row["key"] == "conversion") CHECK(row["mse"] == rendered["mse"]);
    CHECK(read_text(page).find("Shown over white") != std::string::npos);
  }
  const json same = audited({ply, ply, "--cameras", scene.cameras});
  CHECK(same["verdict"]["grade"] == "identical");
}

TEST_CASE("levels of detail are compared over both backgrounds too") {
  const SceneFolder scene;
  SplatCloud shelled = scene.cloud;
  append_splats(shelled, black_shell(14000));
  const std::string ply = write_ply(scene.file("shelled.ply"), shelled), rgs = scene.file("shelled.rgs");
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", "--lod", ply, rgs}).exit_code == 0);
  const json j = audited({scene.ply, rgs, "--cameras", scene.cameras, "--no-attribution"});
  for (const json& row : j["distances"]["rows"])
    for (const char* scenes : {"leaves", "compensated", "levels"}) CHECK(row[scenes]["psnr"].get<double>() < 15);
}

TEST_CASE("no background within 0..1 shows a larger difference than black and white do") {
  SplitMix random(7);
  const auto picture = [&](std::vector<float>& alpha) {
    Image image = Image::make(24, 16, 3);
    for (std::size_t i = 0; i < image.pixels.size(); ++i) {
      if (i % 3 == 0) alpha.push_back(random.dyadic(0, 1));
      image.pixels[i] = alpha.back() * random.dyadic(0, 1);
    }
    return image;
  };
  std::vector<float> alpha_a, alpha_b;
  const Image a = picture(alpha_a), b = picture(alpha_b);
  const auto found = audit::difference(audit::over_backgrounds(a, alpha_a), audit::over_backgrounds(b, alpha_b));
  REQUIRE(found);
  double most = 0, squares = 0;
  for (std::size_t i = 0; i < a.pixels.size(); ++i) {
    double worst = 0;
    for (int k = 0; k <= 64; ++k) {
      const double background = k / 64.0, t_a = 1 - static_cast<double>(alpha_a[i / 3]),
                   t_b = 1 - static_cast<double>(alpha_b[i / 3]);
      worst = std::max(worst, std::abs(static_cast<double>(a.pixels[i]) + t_a * background -
                                       static_cast<double>(b.pixels[i]) - t_b * background));
    }
    most = std::max(most, worst);
    squares += worst * worst;
  }
  CHECK(static_cast<double>(found->largest) == doctest::Approx(most).epsilon(1e-6));
  CHECK(found->mse == doctest::Approx(squares / static_cast<double>(a.pixels.size())).epsilon(1e-6));
}

TEST_CASE("Gaussians added behind the cameras are counted in assets of every format") {
  const SceneFolder scene;
  SplatCloud more = scene.cloud, behind = audit_cloud(3000, 3, 77);
  for (std::uint64_t i = 0; i < behind.size(); ++i) behind.mean[3 * i + 2] -= 12;
  append_splats(more, behind);
  const std::string ply = write_ply(scene.file("more.ply"), more), text = scene.file("page.html");
  for (const char* format : {"ply", "rgs", "spz", "splat", "sog", "glb", "compressed.ply"}) {
    CAPTURE(format);
    const std::string same = scene.file(std::string("same.") + format),
                      asset = scene.file(std::string("more.") + format);
    if (std::string(format) == "ply")
      write_ply(same, scene.cloud);
    else {
      REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", scene.ply, same}).exit_code == 0);
      REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", ply, asset}).exit_code == 0);
    }
    const json kept = audited({scene.ply, same, "--no-render", "--fail-below", "added=0,dropped=0"});
    CHECK(kept["gaussians"]["paired"] == 700);
    for (const bool reverse : {false, true}) {
      const std::string junit = scene.file("junit.xml");
      const json j = audited({reverse ? asset : scene.ply, reverse ? scene.ply : asset, "--cameras", scene.cameras,
                              "--no-attribution", "--report", text, "--overwrite", "--junit", junit, "--fail-below",
                              reverse ? "added=0,dropped=2999,unseen=2999" : "added=2999,dropped=0,unseen=2999"},
                             5);
      CHECK(j["gaussians"]["paired"] == 700);
      CHECK(j["gaussians"][reverse ? "dropped" : "added"] == 3000);
      CHECK(j["rendered"][reverse ? "source_unseen" : "asset_unseen"] == 3000);
      CHECK(j["rendered"][reverse ? "asset_unseen" : "source_unseen"] == 0);
      CHECK(j["verdict"]["grade"] != "identical");
      CHECK(j["verdict"]["detail"].get<std::string>().find(reverse ? "3,000 Gaussians of the source are missing"
                                                                   : "3,000 Gaussians of the asset are not") !=
            std::string::npos);
      CHECK(read_text(text).find("lie in no rated view") != std::string::npos);
      CHECK(read_text(junit).find("unseen 3000 &gt; 2999") != std::string::npos);
    }
  }
}

TEST_CASE("as many Gaussians replaced as were there do not go unnoticed") {
  const SceneFolder scene;
  SplatCloud replaced = scene.cloud;
  for (std::uint64_t i = 0; i < 50; ++i) replaced.mean[3 * i + 2] -= 12;
  const std::string ply = write_ply(scene.file("replaced.ply"), replaced), spz = scene.file("replaced.spz");
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", ply, spz}).exit_code == 0);
  for (const std::string& asset : {ply, spz}) {
    const json found = audited({scene.ply, asset, "--no-render"})["gaussians"];
    CHECK(found["added"] == 50);
    CHECK(found["dropped"] == 50);
  }
}

TEST_CASE("the nearest point that is left is the one a search of all finds") {
  SplitMix random(11);
  std::vector<audit::Point> points(500);
  for (auto& p : points)
    for (float& x : p) x = std::round(random.dyadic(-4, 4) * 4) / 4;  // many coincide
  audit::NearestPoints nearest(points);
  std::vector<std::uint8_t> taken(points.size());
  const auto squared = [&](const audit::Point& a, const audit::Point& b) {
    return (a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) + (a[2] - b[2]) * (a[2] - b[2]);
  };
  std::size_t n = 0;
  for (int i = 0; i < 2000; ++i) {
    const audit::Point p{random.dyadic(-4, 4), random.dyadic(-4, 4), random.dyadic(-4, 4)};
    const float radius = i % 5 == 0 ? 0.25F : 3;
    float least = radius * radius;
    bool any = false;
    for (std::size_t k = 0; k < points.size(); ++k)
      if (taken[k] == 0 && squared(points[k], p) <= least) least = squared(points[k], p), any = true;
    const auto found = nearest.take(p, radius);
    REQUIRE(found.has_value() == any);
    if (!found) continue;
    CHECK(taken[*found] == 0);
    CHECK(squared(points[*found], p) == least);
    taken[*found] = 1;
    ++n;
  }
  CHECK(n > 300);
  CHECK_FALSE(audit::NearestPoints({}).take({0, 0, 0}, 1));
}

TEST_CASE("a file audited against itself is identical, in pictures and attributes, whatever its profile") {
  const SceneFolder scene;
  const std::string rgs = scene.file("self.rgs");
  const auto more = [](const char* a, const char* b = nullptr) {
    std::vector<std::string> out;
    for (const char* text : {a, b})
      if (text != nullptr) out.emplace_back(text);
    return out;
  };
  for (const auto& options : {more("--keep-order"), more("--profile", "packed"), more("--profile", "archive"),
                              more("--lod"), more("--axes", "opengl"), more("--aa", "mip")}) {
    CAPTURE(options[0]);
    std::vector<std::string> command{built("rgs-convert"), "--no-sync", "--quiet", "--overwrite", scene.ply, rgs};
    command.insert(command.end(), options.begin(), options.end());
    REQUIRE(run_program(command).exit_code == 0);
    const json j = audited({rgs, rgs, "--cameras", scene.cameras, "--no-attribution"});
    CHECK(j["verdict"]["grade"] == "identical");
    CHECK(j["declared_differences"].empty());
    CHECK(j["rendered"]["mse"] == 0);
    for (const json& error : j["attributes"]["errors"]) CHECK_MESSAGE(error["meaning"]["max"] == 0, error["key"]);
  }
}

TEST_CASE("what is drawn alike at other depths differs when depths are compared") {
  const SceneFolder scene;
  const std::string camera = write_cameras(scene.file("one.json"), 1);
  // Twice as far from the camera and twice as large: the same picture.
  SplatCloud moved = scene.cloud;
  for (std::uint64_t i = 0; i < moved.size(); ++i) {
    Splat s = moved.view().splat(i);
    for (float& x : s.mean) x *= 2;
    s.mean[2] += 2.5F;
    for (float& x : s.log_scale) x += std::log(2.0F);
    moved.set(i, s);
  }
  const std::string far = write_ply(scene.file("far.ply"), moved);
  const auto audit = [&](const std::string& asset, const char* conditions, int exit_code) {
    return audited({scene.ply, asset, "--cameras", camera, "--backend", "cpu", "--depth", "--fail-below", conditions},
                   exit_code);
  };
  CHECK(audit(scene.ply, "depth=0", 0)["rendered"]["depth"]["error"] == 0);
  audit(far, "psnr=60", 0);
  const json found = audit(far, "psnr=60,depth=0.1", 5)["rendered"];
  CHECK(found["depth"]["error"].get<double>() == doctest::Approx(1).epsilon(1e-3));
  CHECK(found["depth"]["compared"].get<double>() > 0.5);
  CHECK(found["views"][0]["depth"] == found["depth"]);
  // Where little is drawn nothing is compared, and the gate says so.
  for (float& x : moved.opacity_logit) x = -6;
  const std::string thin = write_ply(scene.file("thin.ply"), moved);
  const json none = audit(thin, "depth=10", 5);
  CHECK(none["gate"]["conditions"][0]["measured"] == false);
  CHECK(run_audit({scene.ply, far, "--fail-below", "depth=1"}).exit_code == 2);
}

TEST_CASE("a linear asset of an sRGB source fails every gate that does not allow it") {
  const SceneFolder scene;
  EncodeOptions linear;
  linear.colour_space = ColourSpace::linear_display;
  const std::string rgs = write_rgs(scene.file("linear.rgs"), scene.cloud, linear), glb = scene.file("linear.glb");
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", "--colour-space", "linear", scene.ply, glb})
              .exit_code == 0);
  for (const std::string& asset : {rgs, glb}) {
    const std::vector<std::string> command{scene.ply, asset, "--cameras", scene.cameras, "--no-attribution"};
    const auto gated = [&](const char* conditions, int exit_code) {
      std::vector<std::string> with = command;
      with.insert(with.end(), {"--fail-below", conditions});
      return audited(with, exit_code);
    };
    const json j = gated("psnr=20", 5);
    CHECK(j["verdict"]["grade"] == "visible");
    CHECK(j["declared_differences"][0]["key"] == "colour_space");
    CHECK(j["verdict"]["headline"].get<std::string>().find("contradictions 1 > 0") != std::string::npos);
    CHECK(j["verdict"]["detail"].get<std::string>().find("colour space as sRGB, display-referred; the asset: linear") !=
          std::string::npos);
    gated("psnr=20,contradictions=1", 0);
    CHECK(audited({asset, asset, "--no-render"})["declared_differences"].empty());
  }
  // The reverse, and a format that cannot state it.
  const std::string spz = scene.file("linear.spz");
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", "--quiet", rgs, spz}).exit_code == 0);
  for (const std::string& asset : {scene.ply, spz})
    audited({rgs, asset, "--cameras", scene.cameras, "--no-attribution", "--fail-below", "psnr=20"}, 5);
  const json other = audited({scene.ply, scene.rgs, "--no-render", "--fail-below", "contradictions=0"});
  CHECK(other["declared_differences"].empty());
  EncodeOptions here, there;
  here.crs.text = "EPSG:4978", there.crs.text = "EPSG:9988";
  const std::string a = write_rgs(scene.file("a.rgs"), scene.cloud, here),
                    b = write_rgs(scene.file("b.rgs"), scene.cloud, there);
  const json placed = audited({a, b, "--no-render", "--fail-below", "contradictions=0"});
  REQUIRE(placed["declared_differences"].size() == 1);
  CHECK(placed["declared_differences"][0]["key"] == "crs");
  CHECK(placed["declared_differences"][0]["asset"] == "EPSG:9988");
  CHECK(audited({a, scene.rgs, "--no-render"})["declared_differences"].empty());
}
