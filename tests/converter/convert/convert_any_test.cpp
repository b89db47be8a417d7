// convert_any_test.cpp - rgs-convert between any two formats, with edits: checks the program's outputs.
// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <nlohmann/json.hpp>

#include "checkout.hpp"
#include "convert_program.hpp"
#include "convert_scenes.hpp"
#include "interchange_samples.hpp"
#include "rgs/splat_edit.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// Largest difference of a mean: it tells frames, orders and positions apart.
double mean_error(const SplatCloud& a, const SplatCloud& b) {
  const SplatError e = compare(a, b);
  return std::max({e.mean[0], e.mean[1], e.mean[2]});
}

bool holds(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

}  // namespace

TEST_CASE("--formats lists what is read and written, and its manual has the same table") {
  const ProgramResult table = rgs_convert({"--formats"});
  CHECK(table.exit_code == 0);
  for (const FormatInfo& info : all_formats()) {
    CAPTURE(info.name);
    CHECK(holds(table.out, std::string("\n| .") + info.name));
    CHECK(holds(table.out, std::string("| ") + info.title));
    CHECK(holds(table.out, std::string("| ") + info.precision));
  }
  CHECK(holds(read_text(source_dir() + "/docs/user/INTERCHANGE.md"), table.out));
}

TEST_CASE("any format converts to any other, chosen by the output's name, each in its own frame") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(600, 2, 1);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud);
  const std::array<std::string, 11> endings{"rgs", "ply", "compressed.ply", "spz",  "splat",  "sog",
                                            "glb", "npz", "usda",           "usdz", "spz.glb"};
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
      // Twice the coarsest step: that of compressed PLY over 16 units.
      CHECK(mean_error(file->cloud, expected) <= 16.0 / 1023 * 1.01);
      const SplatError e = compare(file->cloud, turned_like(file->cloud, expected));
      CHECK(e.opacity <= 2.0 / 255);
      CHECK(e.rotation <= 0.05);
      if (first == "sog" || second == "sog") continue;  // a palette has no steps
      CHECK(e.sh[1] <= 0.1);
      CHECK(e.sh[2] <= 0.15);
    }
  }
}

TEST_CASE("inputs are transformed one by one, merged, filtered and stripped") {
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
  filter_splats(a, {WorldBox{{-8, -8, -8}, {8, 8, 8}}, 0.25F, 20});
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

TEST_CASE("axes are declared by the file or the user, and turned for formats that prescribe theirs or on demand") {
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

  // The tools of SPZ leave coordinates as the PLY has them.
  REQUIRE(rgs_convert({ply, spz}).exit_code == 0);
  CHECK(mean_error(read(spz).cloud, cloud) <= 1.0 / 4096);
  ProgramResult run = rgs_convert({"--json", spz, back});
  REQUIRE(run.exit_code == 0);
  CHECK(mean_error(read(back).cloud, cloud) <= 1.0 / 4096);
  CHECK(nlohmann::json::parse(run.out)["notes"] ==
        nlohmann::json{"the axes of scene.spz are right,down,forward, assumed because it declares none (--spz-axes)"});
  run = rgs_convert({"--spz-axes", "opengl", spz, back});
  REQUIRE(run.exit_code == 0);
  CHECK(mean_error(read(back).cloud, up) <= 1.0 / 4096);
  CHECK(holds(run.out, "note       the axes of scene.spz are right,up,backward, assumed"));
  // From tiles the same.
  run = rgs_convert({"--json", "--lod", "--merge", ply, spz, rgs});
  REQUIRE(run.exit_code == 0);
  CHECK(holds(run.out, "the axes of scene.spz are right,down,forward, assumed"));
  const std::string glb = folder.file("scene.glb");
  REQUIRE(rgs_convert({spz, glb}).exit_code == 0);
  CHECK(read(glb).axes == kAxesGltf);
  CHECK(mean_error(read_splats(glb)->cloud, cloud) <= 1.0 / 4096);

  run = rgs_convert({"--spz-axes", "opengl", ply, spz});
  REQUIRE(run.exit_code == 0);
  CHECK(mean_error(read(spz).cloud, up) <= 1.0 / 4096);
  CHECK(holds(run.out, "the output's axes are right,up,backward, which the SPZ does not state (--spz-axes)"));
  // The scene returns to the frame of 3DGS cameras unless the .rgs is to declare another.
  REQUIRE(rgs_convert({"--keep-order", "--spz-axes", "opengl", spz, rgs}).exit_code == 0);
  CHECK(read(rgs).axes == kAxes3dgs);
  CHECK(mean_error(read(rgs).cloud, cloud) <= 1.0 / 4096);
  REQUIRE(rgs_convert({"--keep-order", "--to-axes", "opengl", ply, rgs}).exit_code == 0);
  CHECK(read(rgs).axes == kAxesOpenGl);
  CHECK(read(rgs).cloud.mean == up.mean);
  // A declared frame is honoured on output...
  REQUIRE(rgs_convert({rgs, back}).exit_code == 0);
  CHECK(read(back).cloud.mean == cloud.mean);
  // ... and --axes overrides it.
  REQUIRE(rgs_convert({"--axes", "3dgs", rgs, back}).exit_code == 0);
  CHECK(read(back).cloud.mean == up.mean);
  REQUIRE(rgs_convert({"--axes", "undeclared", rgs, spz}).exit_code == 0);
  CHECK(mean_error(read(spz).cloud, up) <= 1.0 / 4096);
  // From one of the two frames of SPZ to the other.
  REQUIRE(rgs_convert({"--axes", "opengl", spz, folder.file("other.spz")}).exit_code == 0);
  CHECK(mean_error(read(folder.file("other.spz")).cloud, cloud) <= 1.0 / 4096);
}

TEST_CASE("SPZ is written in the requested version, else in version 3") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 3, 4);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), spz = folder.file("scene.spz");
  const auto first_bytes = [&spz] { return get<std::uint32_t>(read_bytes(spz), 0); };
  constexpr std::uint32_t kGzip = 0x00088B1F, kSpz = 0x5053474E;
  for (const std::string number : {"2", "3", "4"}) {
    CAPTURE(number);
    const ProgramResult run = rgs_convert({"--json", "--spz-version", number, ply, spz});
    REQUIRE(run.exit_code == 0);
    CHECK(nlohmann::json::parse(run.out)["output"]["spz_version"] == std::stoi(number));
    CHECK(first_bytes() == (number == "4" ? kSpz : kGzip));
    CHECK(holds(rgs_convert({"--spz-version", number, ply, spz}).out, "  version    " + number + "\n"));
    REQUIRE(rgs_convert({spz, folder.file("back.ply")}).exit_code == 0);
    CHECK(mean_error(read_splats(folder.file("back.ply"))->cloud, cloud) <= 1.0 / 4096);
  }
  const auto json = nlohmann::json::parse(rgs_convert({"--json", ply, spz}).out);
  CHECK(json["output"]["spz_version"] == 3);
  CHECK(first_bytes() == kGzip);
  const auto other = nlohmann::json::parse(rgs_convert({"--json", ply, folder.file("scene.glb")}).out);
  CHECK_FALSE(other["output"].contains("spz_version"));
  for (const std::string number : {"1", "5", "three", ""}) {
    CHECK(rgs_convert({"--spz-version", number, ply, spz}).exit_code == 2);
  }
  const ProgramResult elsewhere = rgs_convert({"--spz-version", "3", ply, folder.file("scene.rgs")});
  CHECK(elsewhere.exit_code == 2);
  CHECK(holds(elsewhere.err, "--spz-version is for .spz outputs"));
}

TEST_CASE("SPZ extensions that are not kept are reported, unknown ones refused unless told otherwise") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 1, 4);
  const Bytes plain = encode_splats(cloud.view(), SplatFormat::spz, {.spz_version = 4}).value();
  const auto write = [&](std::uint32_t type, std::uint32_t bytes) {
    Bytes file = plain;
    file[14] |= std::byte{2};
    file.insert(file.begin() + 32, 8 + bytes, std::byte{0});
    put<std::uint32_t>(file, 16, 40 + bytes);
    put<std::uint32_t>(file, 32, type);
    put<std::uint32_t>(file, 36, bytes);
    write_bytes(folder.file("scene.spz"), file);
  };
  const std::string spz = folder.file("scene.spz"), rgs = folder.file("scene.rgs");
  write(0xADBE0002, 12);
  const std::string orbit = "SPZ extension 0xADBE0002 (safe orbit camera, 12 bytes)";
  CHECK(holds(rgs_convert({spz, rgs}).out, "  not kept   " + orbit + "\n"));
  CHECK(nlohmann::json::parse(rgs_convert({"--json", spz, rgs}).out)["source"]["unused"] ==
        nlohmann::json::array({orbit}));
  write(0x12340001, 6);
  const ProgramResult refused = rgs_convert({spz, folder.file("no.rgs")});
  CHECK(refused.exit_code == 4);
  CHECK(holds(refused.err, "byte 32"));
  CHECK(holds(refused.err, "--skip-unknown-extensions"));
  CHECK_FALSE(std::filesystem::exists(folder.file("no.rgs")));
  const ProgramResult skipped = rgs_convert({"--skip-unknown-extensions", spz, rgs});
  CHECK(skipped.exit_code == 0);
  CHECK(holds(skipped.out, "  not kept   SPZ extension 0x12340001 (unknown, 6 bytes)\n"));
}

TEST_CASE("pipes, wrong names and damage in other formats") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 1, 5);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), spz = folder.file("scene.spz"),
                    misnamed = folder.file("scene.glb");
  const std::string program = "'" + built("rgs-convert") + "' --quiet --no-sync ";
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

TEST_CASE("values that a format clamps are counted in text and JSON, and --strict then writes nothing") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(300, 1, 5);
  cloud.mean[0] = 4.2e6F;      // of SPZ's means; all then move by up to half a unit
  cloud.log_scale[4] = 17.9F;  // 11.96 beyond SPZ's range, within that of compressed PLY
  cloud.log_scale[7] = -25;
  cloud.sh[12 * 9] = 5.5F;        // of f_dc
  cloud.sh[12 * 10 + 5] = -4.5F;  // of f_rest
  cloud.opacity_logit[11] = 30;
  const std::string ply = write_scene(folder.file("scene.ply"), cloud);
  struct Counts {
    std::uint64_t mean, log_scale, opacity_logit, sh_dc, sh;
  };
  const std::vector<std::pair<std::string, Counts>> formats{
      {"spz", {300, 2, 0, 1, 1}}, {"splat", {0, 0, 0, 1, 300}}, {"compressed.ply", {0, 1, 0, 0, 1}},
      {"glb", {0, 0, 1, 0, 0}},   {"usda", {0, 0, 1, 0, 0}},    {"sog", {0, 0, 0, 0, 0}},
      {"ply", {0, 0, 0, 0, 0}}};
  for (const auto& entry : formats) {
    CAPTURE(entry.first);
    const auto& [format, counts] = entry;
    const std::string out = folder.file("out." + format);
    const ProgramResult text = rgs_convert({ply, out}), run = rgs_convert({"--json", ply, out});
    REQUIRE(run.exit_code == 0);
    const auto json = nlohmann::json::parse(run.out)["clamped"];
    CHECK(json["log_scale"]["gaussians"] == counts.log_scale);
    CHECK(json["opacity_logit"]["gaussians"] == counts.opacity_logit);
    CHECK(json["sh_dc"]["gaussians"] == counts.sh_dc);
    CHECK(json["sh"]["gaussians"] == counts.sh);
    CHECK(json["mean"]["gaussians"].get<std::uint64_t>() <= counts.mean);
    CHECK((json["mean"]["gaussians"].get<std::uint64_t>() > 290) == (counts.mean > 0));
    if (format == "spz") {
      CHECK(json["log_scale"]["largest"].get<double>() == doctest::Approx(15));  // -25 is farther out than 17.9
      CHECK(json["sh_dc"]["largest"].get<double>() == doctest::Approx(5.5 - 0.5 / 0.15));
      CHECK(json["mean"]["largest"].get<double>() == doctest::Approx(0.5).epsilon(0.1));
    }
    const bool any = format != "ply" && format != "sog";
    CHECK(holds(text.out, "  clamped ") == any);
    CHECK(holds(text.out, "colours (f_dc)") == (counts.sh_dc != 0));
    CHECK(holds(text.out, "log-scales") == (counts.log_scale != 0));

    // Nothing is written, and the existing file stays.
    write_text(out, "as it was");
    const ProgramResult strict = rgs_convert({"--strict", ply, out});
    CHECK(strict.exit_code == (any ? 4 : 0));
    CHECK(holds(strict.err, "--strict") == any);
    if (any) CHECK(std::filesystem::file_size(out) == 9);
  }
}

TEST_CASE("--strict refuses damaged Gaussians and scales that FP16 flushes") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(300, 1, 5);
  const std::string good = write_scene(folder.file("good.ply"), cloud),
                    bad = write_scene(folder.file("bad.ply"), damaged(cloud, 100));
  cloud.log_scale[4] = 20;
  cloud.log_scale[7] = -20;
  const std::string wide = write_scene(folder.file("wide.ply"), cloud), out = folder.file("out.rgs");
  for (const char* profile : {"direct", "packed", "archive"}) {
    CAPTURE(profile);
    std::filesystem::remove(out);
    for (const std::string& input : {bad, wide}) {
      const ProgramResult run = rgs_convert({"--strict", "--profile", profile, input, out});
      CHECK(run.exit_code == 4);
      CHECK(holds(run.err, "bad_value"));
      CHECK_FALSE(std::filesystem::exists(out));
    }
    CHECK(rgs_convert({"--strict", "--profile", profile, good, out}).exit_code == 0);
    CHECK(rgs_convert({"--profile", profile, wide, out}).exit_code == 0);
  }
  CHECK(rgs_convert({"--strict", bad, folder.file("out.glb")}).exit_code == 4);
  CHECK(rgs_convert({"--strict", bad, folder.file("out.ply")}).exit_code == 0);  // PLY keeps them
  CHECK(rgs_convert({"--strict", "--on-bad", "drop", good, out}).exit_code == 2);
  CHECK_FALSE(std::filesystem::exists(folder.file("out.glb")));
}

TEST_CASE("infinite logits and scales of 0 survive every format") {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(600, 1, 8);
  cloud.opacity_logit[10] = kInfinity;
  cloud.opacity_logit[20] = -kInfinity;
  cloud.log_scale[3 * 30 + 2] = -kInfinity;
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), text = folder.file("text.ply");
  write_text(text, other_ply(cloud, true));
  for (const std::string ending : {"rgs", "ply", "compressed.ply", "spz", "splat", "sog", "glb", "usda"}) {
    CAPTURE(ending);
    const std::string one = folder.file("one." + ending), two = folder.file("two.ply");
    const ProgramResult run =
        rgs_convert({"--keep-order", "--on-bad", "refuse", "--json", ending == "spz" ? text : ply, one});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(run.err.find("damaged") == std::string::npos);
    REQUIRE(rgs_convert({"--keep-order", "--on-bad", "refuse", one, two}).exit_code == 0);
    const auto file = read_splats(two);
    REQUIRE(file);
    REQUIRE(file->cloud.size() == 600);
    CHECK(half_from_float(opacity_from_logit(file->cloud.opacity_logit[10])) == half_from_float(1));
    CHECK(half_from_float(opacity_from_logit(file->cloud.opacity_logit[20])) == 0);
    // SPZ's codes are at least e^-10, those of compressed PLY e^-20.
    CHECK(file->cloud.log_scale[3 * 30 + 2] <= (ending == "spz" ? -10.F : -15.F));
    for (const float x : file->cloud.log_scale) CHECK(x < 10);
    if (ending == "ply") CHECK((file->cloud.opacity_logit == cloud.opacity_logit));
  }
  for (const std::string profile : {"direct", "packed", "archive"}) {
    CAPTURE(profile);
    const ProgramResult run = rgs_convert({"--profile", profile, "--json", ply, folder.file("out.rgs")});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    const auto json = nlohmann::json::parse(run.out);
    CHECK(json["dropped"] == 0);
    CHECK(json["repaired"] == 0);
    CHECK(json["output"]["gaussians"] == 600);
  }
}

TEST_CASE("a million equal Gaussians can be read back, and --max-expansion limits what a file may decode to") {
  const TemporaryFolder folder;
  SplatCloud cloud;
  cloud.resize(300'000, 0);
  const Splat s = ordinary_cloud(1, 0, 5).view().splat(0);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) cloud.set(i, s);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), back = folder.file("back.ply");
  for (const std::string profile : {"packed", "direct", "archive"}) {
    CAPTURE(profile);
    const std::string rgs = folder.file(profile + ".rgs");
    REQUIRE(rgs_convert({"--profile", profile, ply, rgs}).exit_code == 0);
    const ProgramResult run = rgs_convert({rgs, back});
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(std::filesystem::file_size(back) >= 300'000 * 56);
    const std::string other = folder.file("other.rgs");
    CHECK(rgs_convert({"--max-expansion", "4096", "--to-axes", "gltf", rgs, other}).exit_code == 0);
    if (profile == "direct") continue;  // nothing to decode
    for (const char* little : {"1", "5MB"}) {
      const ProgramResult refused = rgs_convert({"--max-expansion", little, rgs, back});
      CHECK(refused.exit_code == 4);
      CHECK(holds(refused.err, "limit_exceeded"));
      CHECK(holds(refused.err, "--max-expansion"));
      CHECK(rgs_convert({"--max-expansion", little, "--to-axes", "gltf", rgs, other}).exit_code == 4);
    }
  }
  CHECK(rgs_convert({"--max-expansion", "much", ply, back}).exit_code == 2);
}
