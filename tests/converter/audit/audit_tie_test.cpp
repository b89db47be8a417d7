// audit_tie_test.cpp - a scene on a grid, with many equal means: an asset in Morton order shows them as its source does.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <fstream>
#include <nlohmann/json.hpp>
#include <random>
#include <string>
#include <vector>

#include "audit_program_fixture.hpp"
#include "random_views.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

/// The ball of audit_cloud() with means rounded to 1/4, so that hundreds share a depth and some a position.
SplatCloud grid_cloud() {
  SplatCloud cloud = audit_cloud(4000);
  for (float& x : cloud.mean) x = std::round(4 * x) / 4;
  return cloud;
}

/// Cameras before the ball, turned so that only equal means have equal depths.
std::string turned_cameras(const std::string& path, const Origin& origin) {
  json cameras = json::array();
  for (const double away : {2.5, 3.0, 3.5}) {
    auto m = rigid({0.98, 0.14, -0.1, 0.1}, {0, 0, away});
    for (std::size_t row = 0; row < 3; ++row) {
      for (std::size_t k = 0; k < 3; ++k) m[4 * row + 3] -= m[4 * row + k] * origin[k];
    }
    json rows = json::array();
    for (std::size_t row = 0; row < 4; ++row)
      rows.push_back({m[4 * row], m[4 * row + 1], m[4 * row + 2], m[4 * row + 3]});
    cameras.push_back({{"name", std::to_string(cameras.size()) + ".png"},
                       {"split", "test"},
                       {"width", 96},
                       {"height", 72},
                       {"fx", 90},
                       {"fy", 90},
                       {"world_to_camera", rows}});
  }
  std::ofstream(path) << cameras;
  return path;
}

struct Quality {
  double psnr, worst;
};
Quality audited(const std::string& source, const std::string& asset, const std::string& cameras) {
  const ProgramResult run = run_audit({source, asset, "--cameras", cameras, "--json", "-", "--quiet"});
  INFO(run.err);
  REQUIRE((run.exit_code == 0 || run.exit_code == 5));
  const json result = json::parse(run.out);
  return {result.at("rendered").at("psnr").get<double>(), result.at("rendered").at("worst_psnr").get<double>()};
}

std::string converted(const TemporaryFolder& folder, const std::string& source, const std::string& name,
                      std::vector<std::string> more) {
  std::vector<std::string> command{built("rgs-convert"), source, folder.file(name)};
  command.insert(command.end(), more.begin(), more.end());
  const ProgramResult run = run_program(command);
  INFO(run.err);
  REQUIRE(run.exit_code == 0);
  return folder.file(name);
}

}  // namespace

TEST_CASE("an audit of a scene on a grid gives nearly the same results in source order and reordered") {
  const TemporaryFolder folder;
  for (const Origin& place : {kNoOrigin, Origin{4.2e6, 1.7e5, 4.8e6}}) {
    const bool far = place[0] != 0;
    CAPTURE(far);
    const std::string source = write_ply(folder.file("scene.ply"), grid_cloud(), place);
    const std::string cameras = turned_cameras(folder.file("cameras.json"), place);
    const std::vector<std::string> overwrite{"--overwrite"};
    const Quality kept =
        audited(source, converted(folder, source, "kept.rgs", {"--keep-order", "--overwrite"}), cameras);
    const Quality direct = audited(source, converted(folder, source, "direct.rgs", overwrite), cameras);
    const Quality packed =
        audited(source, converted(folder, source, "packed.rgs", {"--profile", "packed", "--overwrite"}), cameras);
    MESSAGE("in the source's order ", kept.psnr, " dB, reordered ", direct.psnr, " dB, packed ", packed.psnr, " dB");
    CHECK(kept.worst > 50);
    for (const Quality& q : {direct, packed}) {
      CHECK(q.psnr > kept.psnr - 3);
      CHECK(q.worst > kept.worst - 3);
    }
  }
}
