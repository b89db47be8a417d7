// audit_search_test.cpp - without cameras, a loss that no view of a circle shows is searched for.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "audit_program_fixture.hpp"

using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

constexpr std::uint64_t kShell = 2000, kCore = 40;

/// An opaque shell of radius 1 around a core.
SplatCloud shell_and_core() {
  SplatCloud cloud;
  cloud.resize(kShell + kCore, 0);
  SplitMix random(4);
  for (std::uint64_t i = 0; i < kShell + kCore; ++i) {
    Splat s;
    float square = 0;
    for (float& x : s.mean) x = random.dyadic(-1, 1), square += x * x;
    for (float& x : s.mean) x *= (i < kShell ? 1 : 0.15F) / std::sqrt(square);
    for (float& x : s.log_scale) x = i < kShell ? -2 : -3;
    s.rotation[0] = 1;
    s.opacity_logit = 6;
    s.sh[i % 3] = 1;
    cloud.set(i, s);
  }
  return cloud;
}

ProgramResult search(const std::string& source, const std::string& asset, const std::vector<std::string>& more = {}) {
  std::vector<std::string> arguments{source,         asset,          "--size", "160x90", "--backend",
                                     "cpu",          "--quiet",      "--json", "-",      "--no-attribution",
                                     "--fail-below", "worst-psnr=40"};
  arguments.insert(arguments.end(), more.begin(), more.end());
  return run_audit(arguments);
}

/// The gate passes on the circle alone and fails by default, in a view whose name begins so.
void check_found(const std::string& source, const std::string& asset, const std::string& name,
                 const std::vector<std::string>& more = {}) {
  std::vector<std::string> circle = more;
  circle.insert(circle.end(), {"--worst", "0"});
  const ProgramResult unsearched = search(source, asset, circle), searched = search(source, asset, more);
  CHECK(unsearched.exit_code == 0);
  CHECK(json::parse(unsearched.out)["rendered"]["n_views"] == 8);
  CHECK(searched.exit_code == 5);
  const json rendered = json::parse(searched.out)["rendered"];
  CHECK(rendered["n_searched"].get<int>() >= 75);
  CHECK(rendered["n_views"] <= 8 + 4);
  CHECK_MESSAGE(rendered["views"][0]["name"].get<std::string>().starts_with(name), rendered["views"][0]["name"]);
  CHECK(rendered["views"][0]["psnr"].get<double>() < 30);
}

}  // namespace

TEST_CASE("a changed core of an opaque shell is found from inside, in the same views with any number of threads") {
  TemporaryFolder folder;
  SplatCloud cloud = shell_and_core();
  const std::string source = write_ply(folder.file("shell.ply"), cloud);
  for (std::uint64_t i = kShell; i < kShell + kCore; ++i) {
    Splat s = cloud.view().splat(i);
    s.sh[i % 3] = -1;
    cloud.set(i, s);
  }
  const std::string asset = write_rgs(folder.file("shell.rgs"), cloud);
  check_found(source, asset, "found inside");
  CHECK(json::parse(search(source, asset, {"--threads", "1"}).out)["rendered"]["views"] ==
        json::parse(search(source, asset, {"--threads", "2"}).out)["rendered"]["views"]);
  CHECK(json::parse(search(source, asset, {"--worst", "2"}).out)["rendered"]["n_views"] == 8 + 2);
  CHECK(search(source, asset, {"--worst", "2", "--cameras", folder.file("none.json")}).exit_code == 2);
}

TEST_CASE("what an asset adds behind the circle's cameras is found") {
  TemporaryFolder folder;
  SplatCloud cloud = shell_and_core();
  const std::string source = write_ply(folder.file("shell.ply"), cloud);
  SplitMix random(5);
  const std::uint64_t n = cloud.size();
  cloud.resize(n + 40, 0);
  for (std::uint64_t i = n; i < n + 40; ++i) {
    Splat s = cloud.view().splat(0);
    s.mean[0] = random.dyadic(-1, 1), s.mean[1] = -3.5F, s.mean[2] = random.dyadic(-12, -10);
    for (float& x : s.log_scale) x = -1;
    cloud.set(i, s);
  }
  check_found(source, write_rgs(folder.file("more.rgs"), cloud), "found behind");
}

TEST_CASE("levels that are bad where they switch alone are found there") {
  TemporaryFolder folder;
  SplatCloud cloud = audit_cloud(14000, 1);
  for (float& s : cloud.log_scale) s -= 1.5F;
  const std::string source = write_ply(folder.file("scene.ply"), cloud), good = folder.file("good.rgs");
  REQUIRE(run_program({built("rgs-convert"), "--quiet", "--no-sync", source, good, "--lod"}).exit_code == 0);
  const std::string bad = with_changed_levels(good, folder.file("bad.rgs"), [](lod::Levels& levels) {
    REQUIRE(levels.pages.front().level == 2);
    // Level 1 is drawn in a narrow range of distances, and is black there.
    for (lod::Page& page : levels.pages) {
      if (page.level != 1) continue;
      page.error = 0.9F * levels.pages.front().error;
      for (std::uint64_t i = page.first; i < page.first + page.count; ++i) {
        Splat splat = levels.splats.view().splat(i);
        for (float& x : splat.sh) x = -3;
        levels.splats.set(i, splat);
      }
    }
  });
  check_found(source, bad, "found where level 1 begins", {"--no-distances"});
}
