// convert_target_test.cpp - rgs-convert --target-psnr and --target-size: what is written is what was asked for.
// SPDX-License-Identifier: Apache-2.0
#include "audit_program_fixture.hpp"

using namespace rgs;
using namespace rgs::test;
namespace fs = std::filesystem;

namespace {

ProgramResult convert(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), built("rgs-convert"));
  return run_program(arguments);
}
std::size_t n_files(const std::string& folder) {
  return static_cast<std::size_t>(std::distance(fs::directory_iterator(folder), {}));
}

}  // namespace

TEST_CASE("--target-psnr writes an archive that rgs-audit measures above it") {
  const SceneFolder scene;
  const std::string out = scene.file("out.rgs"), again = scene.file("again.rgs");
  const std::size_t before = n_files(scene.path());
  std::vector<float> steps;
  for (const char* wanted : {"32", "45"}) {
    CAPTURE(wanted);
    const ProgramResult run = convert({"--profile", "archive", "--target-psnr", wanted, "--cameras", scene.cameras,
                                       "--json", "--overwrite", scene.ply, out});
    INFO(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(n_files(scene.path()) == before + steps.size() + 1);  // no pass is left
    const auto target = nlohmann::json::parse(run.out)["target"];
    const auto& passes = target["passes"];
    REQUIRE((!passes.empty() && passes.size() <= 3));
    CHECK(target["psnr"] == std::stod(wanted));
    steps.push_back(target["step"].get<float>());
    const nlohmann::json* kept = nullptr;
    for (const auto& pass : passes)
      if (pass["step"] == target["step"]) kept = &pass;
    REQUIRE(kept != nullptr);
    CHECK((*kept)["bytes"] == fs::file_size(out));
    for (const auto& pass : passes)
      if (pass["psnr"] >= target["psnr"]) CHECK(pass["bytes"] >= (*kept)["bytes"]);
    // Measured again, from the file.
    const ProgramResult audited = run_audit({scene.ply, out, "--cameras", scene.cameras, "--json", "-", "--quiet",
                                             "--fail-below", std::string("psnr=") + wanted});
    CHECK(audited.exit_code == 0);
    CHECK(nlohmann::json::parse(audited.out)["rendered"]["psnr"] == (*kept)["psnr"]);
    // The same bytes as with this step.
    REQUIRE(convert({"--profile", "archive", "--archive-step", target["step"].dump(), "--cameras", scene.cameras,
                     "--overwrite", "--quiet", scene.ply, again})
                .exit_code == 0);
    CHECK(read_text(again) == read_text(out));
  }
  CHECK(steps[0] > steps[1]);
}

TEST_CASE("--target-size writes an archive that is not larger") {
  const SceneFolder scene;
  // Without SH, which in these scenes is noise that few steps shrink.
  const std::string ply = write_ply(scene.file("plain.ply"), audit_cloud(5000, 0));
  const std::string out = scene.file("out.rgs"), high = scene.file("high.rgs");
  REQUIRE(convert({"--profile", "archive:high", "--quiet", ply, high}).exit_code == 0);
  for (const std::uint64_t percent : {60U, 75U, 90U}) {
    CAPTURE(percent);
    const std::uint64_t wanted = fs::file_size(high) * percent / 100;
    const ProgramResult run =
        convert({"--profile", "archive", "--target-size", std::to_string(wanted), "--overwrite", ply, out});
    INFO(run.err);
    REQUIRE(run.exit_code == 0);
    INFO(run.out);
    CHECK(run.out.find("  target     at most ") != std::string::npos);
    CHECK(run.out.find("  written\n") != std::string::npos);
    CHECK(fs::file_size(out) <= wanted);
    CHECK(fs::file_size(out) >= wanted * 3 / 4);
  }
}

TEST_CASE("a target out of reach fails the gate, says what was reached, and writes nothing") {
  const SceneFolder scene;
  const std::string out = scene.file("out.rgs");
  const std::size_t before = n_files(scene.path());
  const ProgramResult size = convert({"--profile", "archive", "--target-size", "2KiB", "-q", scene.ply, out});
  CHECK(size.exit_code == 5);
  CHECK(size.err.find("step 64 reached ") != std::string::npos);
  const ProgramResult psnr =
      convert({"--profile", "archive", "--target-psnr", "140", "--cameras", scene.cameras, "-q", scene.ply, out});
  CHECK(psnr.exit_code == 5);
  CHECK(psnr.err.find("step 0.0625 reached ") != std::string::npos);
  CHECK(psnr.err.find("--profile packed") != std::string::npos);
  CHECK(size.err.find("--target-size 2048:") != std::string::npos);
  CHECK(n_files(scene.path()) == before);
}

TEST_CASE("targets keep an output that exists, and never write to an input") {
  const SceneFolder scene;
  const std::string kept = read_text(scene.rgs);
  for (const auto& [option, value] : {std::pair{"--target-size", "1MB"}, {"--target-psnr", "30"}}) {
    std::vector<std::string> arguments{"--profile", "archive", option, value, "-q", scene.ply, scene.rgs};
    const ProgramResult exists = convert(arguments);
    CHECK(exists.exit_code == 3);
    CHECK(exists.err.find("--overwrite") != std::string::npos);
    arguments[5] = scene.rgs;  // is the output too
    arguments.insert(arguments.begin(), "--overwrite");
    CHECK(convert(arguments).exit_code == 2);
  }
  // Out of reach, with --overwrite.
  CHECK(
      convert({"--profile", "archive", "--target-size", "100", "--overwrite", "-q", scene.ply, scene.rgs}).exit_code ==
      5);
  CHECK(read_text(scene.rgs) == kept);
}

TEST_CASE("targets refuse what they cannot be combined with") {
  const SceneFolder scene;
  const std::string out = scene.file("out.rgs");
  const std::vector<std::vector<std::string>> cases{
      {"--target-psnr", "40", scene.ply, out},
      {"--profile", "direct", "--target-size", "1MB", scene.ply, out},
      {"--profile", "archive", "--target-size", "0", scene.ply, out},
      {"--profile", "archive", "--target-psnr", "40", "--archive-step", "2", scene.ply, out},
      {"--profile", "archive", "--target-psnr", "40", "--target-size", "1MB", scene.ply, out},
      {"--profile", "archive", "--target-psnr", "40", "--scale", "2", scene.ply, out},
      {"--profile", "archive", "--target-psnr", "40", "--merge", scene.ply, scene.ply, out},
      {"--profile", "archive", "--target-psnr", "40", scene.ply, "-", "--to", "rgs"},
      {"--profile", "archive", "--target-size", "1MB", scene.ply, scene.file("out.spz")},
      {"--profile", "archive", "--target-size", "1MB", "--to", "rgs", scene.path(), scene.file("out")},
      {"--profile", "archive", "--target-size", "1MB", "--ranges", "2", "--lod-partition", scene.file("w"), scene.ply}};
  for (const auto& arguments : cases) {
    CAPTURE(arguments);
    const ProgramResult run = convert(arguments);
    CHECK(run.exit_code == 2);
    CHECK(run.err.find("--target-") != std::string::npos);
  }
  CHECK_FALSE(fs::exists(out));
  // Levels of detail and, for a size, several inputs are no obstacle.
  CHECK(
      convert({"--profile", "archive", "--target-size", "1MB", "--merge", "-q", scene.ply, scene.ply, out}).exit_code ==
      0);
  CHECK(convert({"--profile", "archive", "--target-psnr", "30", "--lod", "--cameras", scene.cameras, "-q", scene.ply,
                 scene.file("levels.rgs")})
            .exit_code == 0);
}
