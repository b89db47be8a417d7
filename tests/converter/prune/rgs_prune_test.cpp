// rgs_prune_test.cpp - rgs-prune as a user runs it: kept Gaussians, formats, refusals, exit codes and --json.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>
#include <random>
#include <string>
#include <vector>

#include "renderer_fixture.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/ply.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

namespace fs = std::filesystem;
using namespace rgs;
using test::ProgramResult;
using test::read_text;

namespace {

void write_bytes(const std::string& path, std::span<const std::byte> bytes) {
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
}

/// A wall of 6x6 at depth 4, Gaussians 0 to 35, that hides one of 6x6 at depth 8, 36 to 71; 72 is behind the cameras.
SplatCloud two_walls() {
  std::vector<Splat> splats;
  for (const double z : {4.0, 8.0}) {
    for (int i = 0; i < 36; ++i) {
      splats.push_back(test::splat_at((i % 6 - 2.5) * 0.8 * z / 4, (i / 6 - 2.5) * 0.8 * z / 4, z, 0.4 * z / 4, 0.999));
    }
  }
  splats.push_back(test::splat_at(0, 0, -4, 0.4, 0.9));
  return test::cloud_of(splats, 1);
}

std::string camera(const char* name, const char* split, double x) {
  return R"({"name":")" + std::string(name) + R"(","split":")" + split +
         R"(","width":64,"height":48,"fx":50,"fy":50,"world_to_camera":[[1,0,0,)" + std::to_string(x) +
         R"(],[0,1,0,0],[0,0,1,0],[0,0,0,1]]})";
}

struct Stage {
  test::TemporaryFolder folder;
  SplatCloud cloud = two_walls();
  std::string ply = folder.file("scene.ply"), cameras = folder.file("cameras.json");
  Stage() {
    write_bytes(ply, encode_splats(cloud.view(), SplatFormat::ply).value());
    std::ofstream(cameras) << "[" << camera("x/a.jpg", "test", 0) << "," << camera("x/b.jpg", "train", 0.2) << ","
                           << camera("x/c.jpg", "train", -0.2) << "]";
  }
  std::string file(const std::string& name) const { return folder.file(name); }
  ProgramResult run(const std::string& input, const std::string& output, const std::vector<std::string>& more) const {
    std::vector<std::string> arguments{test::built("rgs-prune"), input, output, "--cameras", cameras, "--no-sync"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return test::run_program(arguments);
  }
};

}  // namespace

TEST_CASE("a far scene is pruned as it would be near the world's origin, and stays where it is") {
  const Stage stage;
  const Origin place{4.2e6, 1.7e5, 4.8e6};
  const std::string far = stage.file("far.ply"), cameras = stage.file("far.json");
  write_bytes(far, encode_splats(stage.cloud.view(), SplatFormat::ply, {.origin = place}).value());
  std::ofstream(cameras) << R"([{"width":64,"height":48,"fx":50,"fy":50,"world_to_camera":)"
                         << R"([[1,0,0,-4200000],[0,1,0,-170000],[0,0,1,-4800000],[0,0,0,1]]}])";
  for (const std::string& output : {stage.file("out.ply"), stage.file("out.rgs")}) {
    const auto run =
        test::run_program({test::built("rgs-prune"), far, output, "--cameras", cameras, "--no-sync", "--keep", "36"});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    const auto kept = read_splats(output);
    REQUIRE(kept);
    REQUIRE(kept->cloud.size() == 36);
    for (std::uint64_t i = 0; i < 36; ++i) {
      REQUIRE(kept->origin[2] + static_cast<double>(kept->cloud.mean[3 * i + 2]) == place[2] + 4);  // the wall in front
    }
  }
}

TEST_CASE("the visible wall is kept unchanged in scene order, and the hidden one is dropped") {
  const Stage stage;
  const ProgramResult result = stage.run(stage.ply, stage.file("kept.ply"), {"--keep", "36", "--split", "train"});
  REQUIRE_MESSAGE(result.exit_code == 0, result.err);
  CHECK(result.out.find("36 of 73 Gaussians") != std::string::npos);
  const auto kept = read_ply(stage.file("kept.ply"));
  REQUIRE(kept);
  REQUIRE(kept->size() == 36);
  CHECK(kept->sh_degree == 1);
  const auto first = [](const std::vector<float>& values, std::size_t n) {
    return std::vector<float>(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(n));
  };
  CHECK(kept->mean == first(stage.cloud.mean, 36 * 3));
  CHECK(kept->log_scale == first(stage.cloud.log_scale, 36 * 3));
  CHECK(kept->rotation == first(stage.cloud.rotation, 36 * 4));
  CHECK(kept->opacity_logit == first(stage.cloud.opacity_logit, 36));
  CHECK(kept->sh == first(stage.cloud.sh, 36 * 12));
}

TEST_CASE("--json, --scores, and the same bytes from any number of threads") {
  const Stage stage;
  const auto run = [&](const std::string& name, const char* threads) {
    return stage.run(stage.ply, stage.file(name + ".rgs"),
                     {"--keep", "50%", "--threads", threads, "--scores", stage.file(name + ".npy"), "--json"});
  };
  const ProgramResult one = run("one", "1"), two = run("two", "2");
  REQUIRE_MESSAGE(one.exit_code == 0, one.err);
  REQUIRE(two.exit_code == 0);
  CHECK(read_text(stage.file("one.rgs")) == read_text(stage.file("two.rgs")));
  CHECK(read_text(stage.file("one.npy")) == read_text(stage.file("two.npy")));
  const auto json = nlohmann::json::parse(one.out);
  CHECK(json["program"] == "rgs-prune");
  CHECK(json["source"]["gaussians"] == 73);
  CHECK(json["output"]["gaussians"] == 37);
  CHECK(json["output"]["bytes"] == fs::file_size(stage.file("one.rgs")));
  CHECK(json["cameras"] == 3);
  CHECK(json["pixels"] == 3 * 64 * 48);
  CHECK(json["unseen"] >= 1);
  CHECK(json["weight_share"] > 0.9);
  CHECK(json["weight_share"] <= 1.0);
  CHECK(json["seconds"]["render"].is_number());
}

TEST_CASE("cameras: split, view and size; scores: sum, max and a threshold") {
  const Stage stage;
  const auto json = [&](const std::vector<std::string>& more) {
    std::vector<std::string> arguments{"--json", "--overwrite"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const ProgramResult result = stage.run(stage.ply, stage.file("out.ply"), arguments);
    REQUIRE_MESSAGE(result.exit_code == 0, result.err);
    return nlohmann::json::parse(result.out);
  };
  CHECK(json({"--keep", "10", "--split", "train"})["cameras"] == 2);
  CHECK(json({"--keep", "10", "--view", "b"})["cameras"] == 1);
  CHECK(json({"--keep", "10", "--split", "train", "--view", "1"})["cameras"] == 1);
  CHECK(json({"--keep", "10", "--size", "32x24"})["pixels"] == 3 * 32 * 24);
  const auto seen = json({"--min-contribution", "1e-6"});
  CHECK(seen["output"]["gaussians"].get<int>() == 73 - seen["unseen"].get<int>());
  const auto strong = json({"--min-contribution", "0.5", "--score", "max"});
  CHECK(strong["score"] == "max");
  CHECK(strong["lowest_score"] >= 0.5);
  CHECK(strong["output"]["gaussians"] < seen["output"]["gaussians"]);
}

TEST_CASE("other formats can be pruned to .rgs with their source's declarations") {
  const Stage stage;
  write_bytes(stage.file("scene.spz"), encode_splats(stage.cloud.view(), SplatFormat::splat).value());
  EncodeOptions options;
  options.aa_mode = AaMode::mip_splatting;
  options.axes = kAxesOpenGl;
  options.low_pass_px2 = 0.2F;
  options.metres_per_unit = 0.5F;
  options.alpha_max = 0.999F;
  options.depth = DepthRange{0.5F, 32, DepthSource::by_hand};
  options.depth_mapping = DepthMapping::linear;
  options.keep_permutation = true;
  options.provenance = Provenance{1, 2, "garden.ply", "test"};
  write_bytes(stage.file("scene.rgs"), encode(stage.cloud.view(), options).value());
  for (const std::string name : {"scene.spz", "scene.rgs"}) {
    CAPTURE(name);
    const std::string output = stage.file(name + ".pruned.rgs");
    const ProgramResult result = stage.run(stage.file(name), output, {"--keep", "36"});
    REQUIRE_MESSAGE(result.exit_code == 0, result.err);
    const auto file = MappedFile::open(output);
    REQUIRE(file);
    const auto view = FileView::open(file->bytes());
    REQUIRE(view);
    REQUIRE(validate(*view));
    CHECK(view->header().n_gaussians == 36);
    if (name == "scene.spz") continue;
    CHECK(view->declarations().aa_mode == AaMode::mip_splatting);
    CHECK(view->declarations().axes == kAxesOpenGl);
    const Declarations d = view->declarations();
    CHECK(d.low_pass_px2 == 0.2F);
    CHECK(d.metres_per_unit == 0.5F);
    CHECK(d.alpha_max == 0.999F);
    CHECK(d.z_near == 0.5F);
    CHECK(d.z_far == 32);
    CHECK(d.depth_source == DepthSource::by_hand);
    CHECK(d.depth_mapping == DepthMapping::linear);
    CHECK(d.n_source == stage.cloud.size());
    CHECK(d.n_dropped == stage.cloud.size() - 36);
    REQUIRE(view->provenance());
    CHECK(view->provenance()->source_name == "garden.ply");
    for (std::uint64_t i = 0; i < 36; ++i) {
      ActivatedSplat s;
      REQUIRE(view->read(i, {&s, 1}));
      CHECK(s.mean[0] == stage.cloud.mean[3 * view->source_index(i)]);
    }
  }
  // A PLY states it in comments.
  REQUIRE(stage.run(stage.file("scene.rgs"), stage.file("words.ply"), {"--keep", "36"}).exit_code == 0);
  const auto words = read_splats(stage.file("words.ply"));
  REQUIRE(words);
  CHECK(words->aa_mode == AaMode::mip_splatting);
  CHECK(words->low_pass_px2 == 0.2F);
  CHECK(words->metres_per_unit == 0.5F);
  // Its PLY has 3DGS's axes: y and z are turned.
  REQUIRE(stage.run(stage.file("scene.rgs"), stage.file("turned.ply"), {"--keep", "36"}).exit_code == 0);
  const auto turned = read_ply(stage.file("turned.ply"));
  REQUIRE(turned);
  for (std::size_t i = 0; i < turned->size(); ++i) CHECK(turned->mean[3 * i + 2] == -4);
}

TEST_CASE("cameras that see no Gaussian rank none: nothing is written") {
  const Stage stage;
  std::ofstream(stage.cameras) << R"([{"name":"a","width":64,"height":48,"fx":50,"fy":50,)"
                                  R"("world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,-100],[0,0,0,1]]}])";
  for (const char* how : {"--keep", "--min-contribution"}) {
    const ProgramResult blind = stage.run(stage.ply, stage.file("blind.ply"), {how, "1"});
    CHECK(blind.exit_code == 2);
    CHECK(blind.err.find("cameras.json: no camera sees any Gaussian") != std::string::npos);
    CHECK_FALSE(fs::exists(stage.file("blind.ply")));
  }
}

TEST_CASE("an empty scene stays empty") {
  const Stage stage;
  write_bytes(stage.file("empty.ply"), encode_splats(SplatCloud().view(), SplatFormat::ply).value());
  REQUIRE(stage.run(stage.file("empty.ply"), stage.file("out.ply"), {"--keep", "20%"}).exit_code == 0);
  CHECK(read_ply(stage.file("out.ply"))->size() == 0);
}

TEST_CASE("exit codes: 2 usage, 3 files, 4 malformed input; existing outputs are kept") {
  const Stage stage;
  const std::string out = stage.file("out.ply");
  const auto code = [&](const std::vector<std::string>& more) { return stage.run(stage.ply, out, more).exit_code; };
  CHECK(code({}) == 2);
  CHECK(code({"--keep", "120%"}) == 2);
  CHECK(code({"--keep", "1", "--min-contribution", "1"}) == 2);
  CHECK(code({"--keep", "1", "--view", "9"}) == 2);
  CHECK(code({"--keep", "1", "--score", "mean"}) == 2);
  CHECK(code({"--keep", "1", "--size", "0x4"}) == 2);
  CHECK(code({"--keep", "1", "--scores", out}) == 2);
  CHECK(stage.run(stage.ply, stage.file("out.spz"), {"--keep", "1"}).exit_code == 2);
  CHECK_FALSE(fs::exists(out));
  CHECK(test::run_program({test::built("rgs-prune"), "--help"}).exit_code == 0);
  CHECK(stage.run(stage.file("missing.ply"), out, {"--keep", "1"}).exit_code == 3);
  CHECK(stage.run(stage.ply, stage.ply, {"--keep", "1", "--overwrite"}).exit_code == 2);
  std::ofstream(out) << "mine";
  const ProgramResult kept = stage.run(stage.ply, out, {"--keep", "1"});
  CHECK(kept.exit_code == 3);
  CHECK(kept.err.find("--overwrite") != std::string::npos);
  CHECK(read_text(out) == "mine");
  CHECK(stage.run(stage.ply, out, {"--keep", "1", "--overwrite"}).exit_code == 0);
  CHECK(stage.run(stage.cameras, stage.file("a.ply"), {"--keep", "1"}).exit_code == 4);
  SplatCloud damaged = stage.cloud;
  damaged.mean[3 * 7] = NAN;
  write_bytes(stage.file("nan.ply"), encode_splats(damaged.view(), SplatFormat::ply).value());
  const ProgramResult nan = stage.run(stage.file("nan.ply"), stage.file("a.ply"), {"--keep", "1"});
  CHECK(nan.exit_code == 4);
  CHECK(nan.err.find("(found 7)") != std::string::npos);
}

TEST_CASE("infinite logits are opacities of 1 and 0: one is kept and hides, the other is dropped") {
  const Stage stage;
  SplatCloud cloud = stage.cloud;
  for (std::size_t i = 0; i < 36; ++i) cloud.opacity_logit[i] = std::numeric_limits<float>::infinity();
  for (std::size_t i = 36; i < 72; ++i) cloud.opacity_logit[i] = -std::numeric_limits<float>::infinity();
  cloud.log_scale[2] = -std::numeric_limits<float>::infinity();
  write_bytes(stage.file("infinite.ply"), encode_splats(cloud.view(), SplatFormat::ply).value());
  const ProgramResult result = stage.run(stage.file("infinite.ply"), stage.file("kept.ply"), {"--keep", "36"});
  REQUIRE_MESSAGE(result.exit_code == 0, result.err);
  const auto kept = read_ply(stage.file("kept.ply"));
  REQUIRE(kept);
  CHECK(std::ranges::count(kept->opacity_logit, std::numeric_limits<float>::infinity()) == 36);
}

TEST_CASE("scales that FP16 flushes are counted in text and JSON") {
  Stage stage;
  const auto run = [&](const char* name, std::vector<std::string> more) {
    more.insert(more.end(), {"--keep", "100%", "--overwrite"});
    const ProgramResult result = stage.run(stage.ply, stage.file(name), more);
    REQUIRE_MESSAGE(result.exit_code == 0, result.err);
    return result.out;
  };
  CHECK(nlohmann::json::parse(run("out.rgs", {"--json"}))["scale"]["zero"] == 0);
  CHECK(run("out.rgs", {}).find("flushed to 0") == std::string::npos);
  stage.cloud.log_scale[3 * 72] = 10;
  stage.cloud.log_scale[3 * 72 + 1] = -25;
  write_bytes(stage.ply, encode_splats(stage.cloud.view(), SplatFormat::ply).value());
  CHECK(nlohmann::json::parse(run("out.rgs", {"--json"}))["scale"]["zero"] == 1);
  CHECK(run("out.rgs", {}).find("flushed to 0 1") != std::string::npos);
  CHECK(nlohmann::json::parse(run("out.ply", {"--json"}))["scale"]["zero"] == 0);  // PLY holds them
}
