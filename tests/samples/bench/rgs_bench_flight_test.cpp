// rgs_bench_flight_test.cpp - rgs-bench-flight as a user runs it, on the CPU.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "checkout.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

namespace {

using rgs::test::built;
using rgs::test::ProgramResult;
using rgs::test::read_text;
using rgs::test::run_program;
using rgs::test::source_dir;
using rgs::test::TemporaryFolder;

const std::string kLevels = source_dir() + "/tests/golden/levels_packed.rgs";  // 300 Gaussians, 3 levels in 8 pages

struct Stage {
  TemporaryFolder folder;
  std::string cameras = folder.file("cameras.json");
  Stage() {
    const auto camera = [](const char* name, int z) {
      return std::string(R"({"name":")") + name +
             R"(","width":64,"height":48,"fx":60,"fy":60,"world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,)" +
             std::to_string(z) + "],[0,0,0,1]]}";
    };
    std::ofstream(cameras) << "[" << camera("a", 8) << "," << camera("b", 5) << "," << camera("c", 12) << "]";
  }
  ProgramResult run(const std::vector<std::string>& more, const std::string& scene = kLevels) const {
    std::vector<std::string> arguments{built("rgs-bench-flight"), scene, "--path", cameras, "--size", "64x48"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_program(arguments);
  }
};

}  // namespace

TEST_CASE("rgs-bench-flight refuses what it cannot measure, and keeps existing outputs") {
  const Stage stage;
  CHECK(run_program({built("rgs-bench-flight")}).exit_code == 2);
  CHECK(run_program({built("rgs-bench-flight"), kLevels}).exit_code == 2);
  CHECK(stage.run({"--frames", "0"}).exit_code == 2);
  CHECK(stage.run({"--fps", "0"}).exit_code == 2);
  CHECK(stage.run({"--host-memory", "0"}).exit_code == 2);
  CHECK(stage.run({"--device-memory", "0"}).exit_code == 2);
  CHECK(stage.run({"--pictures", "."}).exit_code == 2);  // without --compare
  CHECK(stage.run({"--cold"}, "http://127.0.0.1:1/a.rgs").exit_code == 2);
  CHECK(stage.run({"--frames", "2"}, stage.folder.file("nothing.rgs")).exit_code == 3);
  CHECK(stage.run({"--frames", "2"}, source_dir() + "/tests/golden/degree3.rgs").exit_code == 4);  // no levels
  const ProgramResult small = stage.run({"--frames", "2", "--host-memory", "1000"});
  CHECK(small.exit_code == 4);
  CHECK(small.err.find("budget") != std::string::npos);
#ifdef RGS_TEST_NO_CUDA
  const ProgramResult device = stage.run({"--frames", "2", "--device-memory", "1GB"});
  CHECK(device.exit_code == 2);
  CHECK(device.err.find("CUDA") != std::string::npos);
#endif
  const std::string output = stage.folder.file("flight.json");
  std::ofstream(output) << "mine";
  const ProgramResult kept = stage.run({"--frames", "2", "--json", output});
  CHECK(kept.exit_code == 3);
  CHECK(kept.out.empty());
  CHECK(read_text(output) == "mine");
}

TEST_CASE("rgs-bench-flight measures an opening, a flight, pictures against complete ones, and jumps") {
  const Stage stage;
  const std::string pictures = stage.folder.file("pictures");
  std::filesystem::create_directory(pictures);
  const ProgramResult run = stage.run({"--frames", "9", "--fps", "100", "--detail", "0", "--compare", "2", "--pictures",
                                       pictures, "--teleport", "9", "--cold", "--host-memory", "64MiB", "--json", "-"});
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  const auto json = nlohmann::json::parse(run.out);
  CHECK(json["schema"] == "rgs-bench-flight/1");
  CHECK(json["scene"]["name"] == "levels_packed.rgs");
  CHECK(json["scene"]["gaussians"] == 300);
  CHECK(json["width"] == 64);
  CHECK(json["cold"] == true);
  CHECK(json["host_memory"] == 64 << 20);
  CHECK(json["host_bytes"].get<std::uint64_t>() <= 64 << 20);
  CHECK(json["device_memory"] == 0);

  const auto& opening = json["opening"];
  CHECK(opening["open_bytes_read"].get<std::uint64_t>() > 0);
  CHECK(opening["first_bytes_read"].get<std::uint64_t>() >= opening["open_bytes_read"].get<std::uint64_t>());
  CHECK(opening["open_ms"].get<double>() <= opening["first_ms"].get<double>());
  CHECK(opening["first_ms"].get<double>() <= opening["ms_to_complete"].get<double>());
  CHECK(opening["ms_to_35_db"].get<double>() <= opening["ms_to_40_db"].get<double>());
  CHECK(opening["ms_to_40_db"].get<double>() <= opening["ms_to_complete"].get<double>());

  // The pages that arrived during its frames.
  const auto& progress = opening["progress"];
  REQUIRE(!progress.empty());
  CHECK(progress.back()[0] == opening["ms_to_complete"]);
  CHECK(progress.back()[1] == opening["bytes_decoded"]);
  CHECK(progress.back()[2] == 0);
  for (std::size_t i = 1; i < progress.size(); ++i) {
    CHECK(progress[i - 1][0].get<double>() < progress[i][0].get<double>());
    CHECK(progress[i - 1][1].get<std::uint64_t>() <= progress[i][1].get<std::uint64_t>());
    CHECK(progress[i - 1][2].get<int>() > 0);
  }
  CHECK(opening["bytes_decoded"].get<std::uint64_t>() > 0);
  CHECK(!opening.contains("steps"));  // not in builds like this one

  const auto& flight = json["flight"];
  REQUIRE(flight["frames"].size() == 9);
  for (std::size_t i = 0; i < 9; ++i) {
    const auto& frame = flight["frames"][i];
    CHECK(frame["due_ms"].get<double>() == doctest::Approx(10.0 * static_cast<double>(i)));
    CHECK(frame["begin_ms"].get<double>() >= frame["due_ms"].get<double>());
    CHECK(frame["render_ms"].get<double>() > 0);
    CHECK(frame["wall_ms"].get<double>() >= frame["render_ms"].get<double>());
    CHECK(frame["pages"].get<int>() >= 1);
    CHECK(frame.contains("bytes_uploaded"));
  }
  CHECK(flight["render_ms_median"].get<double>() <= flight["render_ms_p99"].get<double>());
  // Frames 0, 2, 4, 6, 8. The pool holds the whole scene, so that each view becomes complete.
  CHECK(flight["compared"]["pictures"] == 5);
  CHECK(flight["compared"]["incomplete"] == 0);
  REQUIRE(flight["compared"]["each"].size() == 5);
  CHECK(flight["compared"]["each"][4]["frame"] == 8);
  // Frame 0 is the view that the opening waited for.
  CHECK(flight["compared"]["each"][0]["psnr"].is_null());

  CHECK(read_text(pictures + "/frame_0008.ppm").substr(0, 13) == "P6\n64 48\n255\n");
  CHECK(read_text(pictures + "/frame_0008.ppm").size() == 13 + 3 * 64 * 48);

  REQUIRE(json["teleports"].size() == 9);
  std::set<int> seen;  // each view once
  for (const auto& jump : json["teleports"]) {
    seen.insert(jump["frame"].get<int>());
    CHECK(jump["ms_to_complete"].get<double>() >= jump["first_ms"].get<double>());
  }
  CHECK(seen.size() == 9);
  CHECK(*seen.rbegin() == 8);
  CHECK(run.err.find("flight") != std::string::npos);
}

TEST_CASE("rgs-bench-flight reports when the pool is too small for a view, and compares no picture with it") {
  const Stage stage;
  const std::string output = stage.folder.file("flight.json");
  // Room for tables and the root: grown until it opens.
  ProgramResult run{};
  for (int kib = 300; kib < 2000; kib += 8) {
    run = stage.run({"--frames", "3", "--fps", "100", "--detail", "0", "--compare", "1", "--wait", "0.2", "--overwrite",
                     "--host-memory", std::to_string(kib) + "KiB", "--json", output});
    if (run.exit_code == 0) break;
    REQUIRE(run.exit_code == 4);
  }
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  const auto json = nlohmann::json::parse(read_text(output));
  CHECK(json["opening"]["ms_to_complete"].is_null());
  CHECK(json["flight"]["compared"]["pictures"] == 0);
  CHECK(json["flight"]["compared"]["incomplete"] == 3);
  CHECK(json["flight"]["detail_px_largest"].get<double>() > 0);
}
