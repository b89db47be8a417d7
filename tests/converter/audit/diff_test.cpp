// diff_test.cpp - rgs-diff: what it finds between two files, its exit codes and its outputs.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "audit_scenes_fixture.hpp"
#include "diff.hpp"
#include "rgs/splat_edit.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using nlohmann::json;
using namespace rgs;
using namespace rgs::test;

namespace {

ProgramResult run_diff(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), built("rgs-diff"));
  return run_program(arguments);
}

template <class Change>
void change(SplatCloud& cloud, std::uint64_t i, const Change& edit) {
  Splat s = cloud.view().splat(i);
  edit(s);
  cloud.set(i, s);
}

// The files, and what is found between them.
struct Files {
  TemporaryFolder folder;
  SplatCloud cloud = audit_cloud(200);
  std::string a = write_ply(folder.file("a.ply"), cloud), b = folder.file("b.ply");

  audit::Diff found(double tolerance = 0) const {
    audit::Sides sides;
    auto diff = audit::compare_files(a, b, {}, tolerance, sides);
    REQUIRE(diff);
    return *std::move(diff);
  }
  audit::Diff with(const SplatCloud& other, double tolerance = 0) const {
    write_ply(b, other);
    return found(tolerance);
  }
};

const audit::Change& of(const audit::Diff& diff, const std::string& key) {
  return *std::find_if(diff.changes.begin(), diff.changes.end(), [&](const audit::Change& c) { return c.key == key; });
}

std::string colour_name(const Splat& s) {
  std::string bits;
  for (int k = 0; k < 3; ++k) {
    const double c = 0.5 + 0.28209479177387814 * static_cast<double>(s.sh[k]);
    bits += std::abs(c - 0.5) < 1e-6 ? 'h' : std::abs(c) < 1e-6 ? '0' : std::abs(c - 1) < 1e-6 ? '1' : '?';
  }
  return bits;
}

}  // namespace

TEST_CASE("a file and itself are the same, in order") {
  const Files f;
  const audit::Diff diff = f.with(f.cloud);
  CHECK(diff.same());
  CHECK(diff.pairs.by == audit::PairedBy::order);
  CHECK(diff.n_equal == 200);
  const ProgramResult run = run_diff({f.a, f.a});
  CHECK(run.exit_code == 0);
  CHECK(run.out.ends_with("same\n"));
}

TEST_CASE("a shuffled file is matched by means, and the same") {
  const Files f;
  SplatCloud other;
  other.resize(200, 3);
  for (std::uint64_t i = 0; i < 200; ++i) other.set(77 * i % 200, f.cloud.view().splat(i));
  const audit::Diff diff = f.with(other);
  CHECK(diff.same());
  CHECK(diff.pairs.by == audit::PairedBy::means);
}

TEST_CASE("each change is found, with its size and where it is") {
  const Files f;
  SplatCloud other = f.cloud;
  change(other, 3, [](Splat& s) { s.mean[1] += 0x1p-10F; });
  change(other, 5, [](Splat& s) { s.sh[4] += 0.5F; });
  change(other, 7, [](Splat& s) { s.opacity_logit += 1; });
  change(other, 9, [](Splat& s) { s.log_scale[2] += std::log(2.0F); });
  const audit::Diff diff = f.with(other);
  CHECK_FALSE(diff.same());
  CHECK(diff.pairs.by == audit::PairedBy::nearest);
  CHECK(diff.pairs.n_paired == 200);
  CHECK(diff.n_equal == 196);
  CHECK(diff.n_reshaped == 1);
  CHECK(of(diff, "rotation").n == 0);
  const std::vector<std::pair<std::string, std::uint64_t>> rows{
      {"mean", 3}, {"colour", 5}, {"opacity", 7}, {"scale", 9}};
  for (const auto& row : rows) {
    INFO(row.first);
    const audit::Change& c = of(diff, row.first);
    CHECK(c.n == 1);
    CHECK(c.a == row.second);
    CHECK(c.b == row.second);
    CHECK(c.rms == doctest::Approx(c.largest / std::sqrt(200.0)));
  }
  CHECK(of(diff, "mean").largest == 0x1p-10);
  CHECK(of(diff, "scale").largest == doctest::Approx(100).epsilon(1e-4));
  CHECK(of(diff, "colour").largest == doctest::Approx(255 * 0.28209479 * 0.5 / std::sqrt(3.0)).epsilon(1e-5));
  CHECK(diff.fates[3] == audit::Fate::moved);
  CHECK(diff.fates[5] == audit::Fate::recoloured);
  CHECK(diff.fates[7] == audit::Fate::opacity);
  CHECK(diff.fates[9] == audit::Fate::reshaped);
  CHECK(f.found(0x1p-10).n_equal == 197);
  CHECK(f.found(0x1p-11).n_equal == 196);
}

TEST_CASE("quaternions and names of axes that mean the same Gaussian are no change") {
  const Files f;
  SplatCloud other = f.cloud;
  change(other, 0, [](Splat& s) {
    for (float& x : s.rotation) x = -x;
  });
  change(other, 1, [](Splat& s) {
    for (float& x : s.rotation) x *= 3;
  });
  // Times (1 + k) / sqrt(2): x becomes y, y becomes -x.
  change(other, 2, [](Splat& s) {
    const std::array<float, 4> q{s.rotation[0], s.rotation[1], s.rotation[2], s.rotation[3]};
    const std::array<float, 4> turned{q[0] - q[3], q[1] + q[2], q[2] - q[1], q[3] + q[0]};
    std::copy(turned.begin(), turned.end(), s.rotation);
    std::swap(s.log_scale[0], s.log_scale[1]);
  });
  CHECK(f.with(other).same());
  // By 2 atan(1/64) around x.
  change(other, 4, [](Splat& s) {
    const std::array<float, 4> q{s.rotation[0], s.rotation[1], s.rotation[2], s.rotation[3]};
    const float t = 0x1p-6F;
    const std::array<float, 4> turned{q[0] - t * q[1], q[1] + t * q[0], q[2] + t * q[3], q[3] - t * q[2]};
    std::copy(turned.begin(), turned.end(), s.rotation);
  });
  const audit::Diff diff = f.with(other);
  CHECK(of(diff, "rotation").n == 1);
  CHECK(of(diff, "rotation").a == 4);
  CHECK(of(diff, "rotation").largest == doctest::Approx(2 * std::atan(0x1p-6) * 180 / 3.14159265358979).epsilon(1e-3));
  CHECK(of(diff, "scale").n == 0);
}

TEST_CASE("values that are not numbers are equal only to each other") {
  const Files f;
  SplatCloud other = f.cloud;
  change(other, 8, [](Splat& s) { s.opacity_logit = NAN; });
  const audit::Diff diff = f.with(other);
  CHECK(of(diff, "opacity").n == 1);
  CHECK(std::isinf(of(diff, "opacity").largest));
  CHECK(json::parse(audit::diff_json(diff))["changes"]["opacity"]["largest"].is_null());
  CHECK(run_diff({f.b, f.b, "-q"}).exit_code == 0);
}

TEST_CASE("a file of a lower SH degree lacks colour, an empty one all") {
  const Files f;
  SplatCloud plain;
  plain.resize(200, 0);
  for (std::uint64_t i = 0; i < 200; ++i) plain.set(i, f.cloud.view().splat(i));
  const audit::Diff diff = f.with(plain);
  CHECK(diff.b.sh_degree == 0);
  CHECK(of(diff, "colour").n == 200);
  CHECK(of(diff, "mean").n == 0);
  SplatCloud none;
  none.resize(0, 0);
  const audit::Diff gone = f.with(none);
  CHECK(gone.pairs.n_source_only == 200);
  CHECK(gone.removed.size() == 200);
  CHECK(run_diff({f.b, f.a, "-q"}).exit_code == 1);
  CHECK(run_diff({f.b, f.b, "-q"}).exit_code == 0);
}

TEST_CASE("an .rgs is matched with its source by its permutation, either way, and with an edited file by means") {
  const Files f;
  const std::string rgs = f.folder.file("a.rgs");
  REQUIRE(run_program({built("rgs-convert"), "-q", "--no-sync", "--keep-permutation", f.a, rgs}).exit_code == 0);
  SplatCloud other = f.cloud;
  change(other, 3, [](Splat& s) { s.mean[0] = 50; });
  write_ply(f.b, other);
  audit::Sides sides;
  for (const bool swapped : {false, true}) {
    CAPTURE(swapped);
    const auto diff = audit::compare_files(swapped ? rgs : f.a, swapped ? f.a : rgs, {}, 0, sides);
    REQUIRE(diff);
    CHECK(diff->pairs.by == audit::PairedBy::permutation);
    CHECK(diff->pairs.n_paired == 200);
    CHECK(of(*diff, "mean").n == 0);
    CHECK(of(*diff, "colour").n > 100);
    CHECK(of(*diff, "colour").largest < 4);
  }
  const auto edited = audit::compare_files(f.b, rgs, {}, 0, sides);
  REQUIRE(edited);
  CHECK(edited->pairs.by == audit::PairedBy::means);
  CHECK(edited->removed == std::vector<std::uint32_t>{3});
}

TEST_CASE("a declaration alone makes files different") {
  const Files f;
  Declarations stated;
  stated.aa_mode = AaMode::mip_splatting;
  auto writer = PlyWriter::create(f.b, 200, 3, {.overwrite = true, .sync = false}, stated);
  REQUIRE(writer);
  std::vector<Splat> splats;
  for (std::uint64_t i = 0; i < 200; ++i) splats.push_back(f.cloud.view().splat(i));
  REQUIRE(writer->write(0, splats));
  REQUIRE(writer->commit());
  const audit::Diff diff = f.found();
  CHECK(diff.n_equal == 200);
  REQUIRE(diff.declared.size() == 1);
  CHECK(diff.declared[0].key == "anti_aliasing");
  CHECK_FALSE(diff.same());
}

TEST_CASE("the program writes JSON, and a PLY in the colours of what happened") {
  const Files f;
  SplatCloud other = f.cloud;
  change(other, 3, [](Splat& s) { s.mean[1] += 0x1p-10F; });
  change(other, 5, [](Splat& s) { s.sh[4] += 0.5F; });
  change(other, 6, [](Splat& s) { s.mean[2] = 40; });
  write_ply(f.b, other);
  const std::string ply = f.folder.file("diff.ply");
  const ProgramResult run = run_diff({f.a, f.b, "--json", "-", "--ply", ply});
  CHECK(run.exit_code == 1);
  const json j = json::parse(run.out);
  CHECK(j["schema"] == "rgs-diff/1");
  CHECK(j["same"] == false);
  CHECK(j["a"]["gaussians"] == 200);
  CHECK(j["b"]["format"] == "ply");
  CHECK(j["matched_by"] == "nearest");
  CHECK(j["matched"] == 199);
  CHECK(j["equal"] == 197);
  CHECK(j["removed"] == 1);
  CHECK(j["added"] == 1);
  CHECK(j["changes"]["mean"]["a"] == 3);
  CHECK(j["changes"]["colour"]["b"] == 5);
  CHECK_FALSE(j["changes"]["opacity"].contains("a"));

  const auto painted = read_ply(ply);
  REQUIRE(painted);
  REQUIRE(painted->size() == 201);
  CHECK(painted->sh_degree == 0);
  CHECK(colour_name(painted->view().splat(0)) == "hhh");
  CHECK(colour_name(painted->view().splat(3)) == "001");
  CHECK(colour_name(painted->view().splat(5)) == "010");
  CHECK(colour_name(painted->view().splat(6)) == "011");
  CHECK(colour_name(painted->view().splat(200)) == "100");
  CHECK(painted->mean[602] == f.cloud.mean[20]);
  CHECK(run_diff({f.a, f.b, "--ply", ply}).exit_code == 3);
  const ProgramResult quiet = run_diff({f.a, f.b, "--ply", ply, "--overwrite", "--quiet"});
  CHECK(quiet.exit_code == 1);
  CHECK(quiet.out.empty());
}

TEST_CASE("with cameras the program draws both files and their difference") {
  const Files f;
  SplatCloud other = f.cloud;
  for (std::uint64_t i = 0; i < 50; ++i) change(other, i, [](Splat& s) { s.sh[0] += 1; });
  write_ply(f.b, other);
  const std::string cameras = write_cameras(f.folder.file("cameras.json"), 2), pictures = f.folder.file("pictures");
  const std::vector<std::string> options{"--cameras", cameras, "--pictures", pictures, "--json", "-"};
  const auto run = [&](const std::string& b, const std::vector<std::string>& more) {
    std::vector<std::string> arguments{f.a, b};
    arguments.insert(arguments.end(), options.begin(), options.end());
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_diff(arguments);
  };
  const ProgramResult first = run(f.b, {});
  REQUIRE(first.exit_code == 1);
  const json views = json::parse(first.out).at("views");
  REQUIRE(views.size() == 2);
  CHECK(views[0].at("psnr") < 50);
  CHECK(views[0].at("largest") > 0.01);
  std::size_t n = 0;
  for ([[maybe_unused]] const auto& entry : std::filesystem::directory_iterator(pictures)) ++n;
  CHECK(n == 6);
  CHECK(run(f.b, {}).exit_code == 3);
  // Cameras of one name have pictures each, and no output is an input.
  json twins = json::parse(read_text(cameras));
  for (json& camera : twins) camera[camera.contains("img_name") ? "img_name" : "name"] = "twin";
  write_text(cameras, twins.dump());
  REQUIRE(run(f.b, {"--overwrite"}).exit_code == 1);
  CHECK(std::filesystem::exists(pictures + "/twin_0001.a.png"));
  CHECK(run(f.b, {"--overwrite", "--ply", pictures + "/twin.a.png"}).exit_code == 2);
  const ProgramResult same = run(f.a, {"--overwrite", "--size", "48x36"});
  REQUIRE(same.exit_code == 0);
  CHECK(json::parse(same.out).at("views")[1].at("psnr").is_null());
  CHECK(run_diff({f.a, f.b, "--cameras", cameras}).exit_code == 2);
  CHECK(run_diff({f.a, f.b, "--pictures", pictures}).exit_code == 2);
}

TEST_CASE("usage, missing and malformed files have exit codes of their own, and no input is written") {
  const Files f;
  const std::string damaged = f.folder.file("damaged.ply");
  write_text(damaged, read_text(f.a).substr(0, 5000));
  CHECK(run_diff({f.a}).exit_code == 2);
  CHECK(run_diff({f.a, f.a, "--tolerance", "-1"}).exit_code == 2);
  CHECK(run_diff({f.a, f.a, "--ply", f.a, "--overwrite"}).exit_code == 2);
  CHECK(run_diff({f.a, f.a, "--json", f.a, "--overwrite"}).exit_code == 2);
  CHECK(run_diff({f.a, f.folder.file("none.ply")}).exit_code == 3);
  CHECK(run_diff({f.a, damaged}).exit_code == 4);
  CHECK(run_diff({damaged, f.a}).exit_code == 4);
}
