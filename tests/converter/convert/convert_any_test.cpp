// convert_any_test.cpp - rgs-convert between any two formats, with edits: what comes out of the program.
// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <nlohmann/json.hpp>

#include "convert_scenes.hpp"
#include "interchange_samples.hpp"
#include "rgs/splat_edit.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

ProgramResult rgs_convert(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), {RGS_CONVERT, "--no-sync", "--overwrite"});
  return run_program(arguments);
}

// Largest difference of a mean: what tells frames, orders and places apart.
double mean_error(const SplatCloud& a, const SplatCloud& b) {
  const SplatError e = compare(a, b);
  return std::max({e.mean[0], e.mean[1], e.mean[2]});
}

bool holds(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

}  // namespace

TEST_CASE("any format to any other, by the output's name, in the frame that each has") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(600, 2, 1);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud);
  const std::array<std::string, 6> endings{"rgs", "ply", "compressed.ply", "spz", "splat", "glb"};
  for (const std::string& first : endings) {
    const std::string one = folder.file("one." + first);
    REQUIRE(rgs_convert({"--keep-order", ply, one}).exit_code == 0);
    for (const std::string& second : endings) {
      CAPTURE(first);
      CAPTURE(second);
      const std::string two = folder.file("two." + second);
      const ProgramResult run = rgs_convert({"--keep-order", "--json", one, two});
      CAPTURE(run.err);
      REQUIRE(run.exit_code == 0);
      const auto json = nlohmann::json::parse(run.out);
      CHECK(json["source"]["format"] == first);
      CHECK(json["output"]["format"] == second);
      CHECK(json["output"]["gaussians"] == 600);
      CHECK(json["output"]["bytes"] == std::filesystem::file_size(two));
      const auto file = read_splats(two);
      REQUIRE(file);
      CHECK(format_name(file->format) == second);
      SplatCloud expected = cloud;
      if (first == "splat" || second == "splat") strip_sh(expected, 0);
      REQUIRE(file->cloud.sh_degree == expected.sh_degree);
      // Twice the coarsest step, that of compressed PLY over 16 units.
      CHECK(mean_error(file->cloud, expected) <= 16.0 / 1023 * 1.01);
      const SplatError e = compare(file->cloud, expected);
      CHECK(e.opacity <= 2.0 / 255);
      CHECK(e.rotation <= 0.05);
      CHECK(e.sh[1] <= 0.1);
      CHECK(e.sh[2] <= 0.15);
    }
  }
}

TEST_CASE("inputs are placed one by one, merged, filtered and stripped") {
  const TemporaryFolder folder;
  SplatCloud a = ordinary_cloud(200, 3, 2), b = ordinary_cloud(100, 1, 3);
  const std::string first = write_scene(folder.file("a.ply"), a), second = write_scene(folder.file("b.ply"), b),
                    out = folder.file("out.ply");
  ProgramResult run = rgs_convert({"--merge", "--translate", "-1,2,0.5", "--translate=0,0,-4", "--rotate", "0,30,0",
                                   "--rotate", "1,0,0,0", "--scale", "2", "--json", first, second, out});
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  nlohmann::json json = nlohmann::json::parse(run.out);
  CHECK(json["source"]["format"] == "merged");
  CHECK(json["source"]["name"] == "a.ply and more");
  CHECK(json["source"]["gaussians"] == 300);
  CHECK(json["source"]["bytes"] == std::filesystem::file_size(first) + std::filesystem::file_size(second));
  transform_splats(a, {rotation_from_euler({0, 30, 0}), 2, {-1, 2, 0.5}});
  transform_splats(b, {rotation_from_euler({0, 0, 0}), 2, {0, 0, -4}});
  append_splats(a, b);
  const SplatCloud placed = read_splats(out).value().cloud;
  CHECK(placed.mean == a.mean);
  CHECK(placed.rotation == a.rotation);
  CHECK(placed.sh == a.sh);

  run = rgs_convert({"--crop", "-8,-8,-8,8,8,8", "--min-opacity", "0.25", "--max-count", "20", "--sh-degree", "1",
                     "--json", out, folder.file("few.ply")});
  REQUIRE(run.exit_code == 0);
  filter_splats(a, {Box{{-8, -8, -8}, {8, 8, 8}}, 0.25F, 20});
  strip_sh(a, 1);
  const SplatCloud few = read_splats(folder.file("few.ply")).value().cloud;
  CHECK(few.mean == a.mean);
  CHECK(few.sh == a.sh);
  json = nlohmann::json::parse(run.out);
  CHECK(json["source"]["gaussians"] == 300);
  CHECK(json["output"]["gaussians"] == 20);
  CHECK(json["output"]["sh_degree"] == 1);
  CHECK(json["filtered"] == 280);
  CHECK(json["dropped"] == 0);

  run = rgs_convert({"--max-count", "50", out, folder.file("few.rgs")});
  REQUIRE(run.exit_code == 0);
  CHECK(holds(run.out, "250 filtered out"));
  CHECK(read_splats(folder.file("few.rgs"))->cloud.size() == 50);
}

TEST_CASE("axes: declared by the file or the user, turned for formats that prescribe theirs or on demand") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 2, 4);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), spz = folder.file("scene.spz"),
                    rgs = folder.file("scene.rgs"), back = folder.file("back.ply");
  const auto read = [](const std::string& path) {
    ReadOptions options;
    options.keep_axes = true;
    return read_splats(path, options).value();
  };
  SplatCloud up = cloud;
  convert_axes(up, kAxes3dgs, kAxesOpenGl);

  REQUIRE(rgs_convert({ply, spz}).exit_code == 0);
  CHECK(mean_error(read(spz).cloud, up) <= 1.0 / 4096);
  // The scene comes back into the frame that 3DGS cameras know, unless the .rgs is to declare another.
  REQUIRE(rgs_convert({"--keep-order", spz, rgs}).exit_code == 0);
  CHECK(read(rgs).axes == kAxes3dgs);
  CHECK(mean_error(read(rgs).cloud, cloud) <= 1.0 / 4096);
  REQUIRE(rgs_convert({"--keep-order", "--to-axes", "opengl", ply, rgs}).exit_code == 0);
  CHECK(read(rgs).axes == kAxesOpenGl);
  CHECK(read(rgs).cloud.mean == up.mean);
  // A declared frame is honoured on the way out...
  REQUIRE(rgs_convert({rgs, back}).exit_code == 0);
  CHECK(read(back).cloud.mean == cloud.mean);
  // ... and one declared by hand beats it.
  REQUIRE(rgs_convert({"--axes", "3dgs", rgs, back}).exit_code == 0);
  CHECK(read(back).cloud.mean == up.mean);
  REQUIRE(rgs_convert({"--axes", "undeclared", rgs, spz}).exit_code == 0);
  CHECK(mean_error(read(spz).cloud, up) <= 1.0 / 4096);
}

TEST_CASE("pipes, wrong names and damage in other formats") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 1, 5);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), spz = folder.file("scene.spz"),
                    misnamed = folder.file("scene.glb");
  const std::string program = "'" RGS_CONVERT "' --quiet --no-sync ";
  REQUIRE(run_shell("cat " + ply + " | " + program + "--to spz - - | cat > " + spz).exit_code == 0);
  CHECK(read_splats(spz)->cloud.size() == 300);
  REQUIRE(rgs_convert({"--to", "splat", ply, misnamed}).exit_code == 0);
  const ProgramResult run = rgs_convert({"--json", misnamed, folder.file("again.rgs")});
  CHECK(nlohmann::json::parse(run.out)["source"]["format"] == "splat");
  CHECK(rgs_convert({"--from", "spz", misnamed, folder.file("no.rgs")}).exit_code == 4);

  const std::string bad = write_scene(folder.file("bad.ply"), damaged(cloud, 100));
  REQUIRE(rgs_convert({bad, spz}).exit_code == 0);
  CHECK(read_splats(spz)->cloud.size() == 297);
  REQUIRE(rgs_convert({"--on-bad", "repair", bad, spz}).exit_code == 0);
  CHECK(read_splats(spz)->cloud.size() == 299);
  CHECK(rgs_convert({"--on-bad", "refuse", bad, folder.file("no.spz")}).exit_code == 4);
  Bytes cut = read_bytes(spz);
  cut.pop_back();
  write_bytes(misnamed, cut);
  const ProgramResult refused = rgs_convert({"--merge", ply, misnamed, folder.file("no.rgs")});
  CHECK(refused.exit_code == 4);
  CHECK(holds(refused.err, "scene.glb: byte "));
  CHECK(holds(refused.err, "[truncated]"));
  CHECK(rgs_convert({"--merge", ply, folder.file("none.spz"), folder.file("no.rgs")}).exit_code == 3);
  CHECK(rgs_convert({ply, ply}).exit_code == 2);
  CHECK_FALSE(std::filesystem::exists(folder.file("no.rgs")));
  CHECK_FALSE(std::filesystem::exists(folder.file("no.spz")));
}
