// rgs_render_test.cpp - rgs-render as a user runs it: pictures, folders, refusals, exit codes and --json.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "image_file.hpp"
#include "pace.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/interchange.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_cloud.hpp"
#include "rgs/splat_edit.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"
#include "trivial_levels.hpp"
#if defined(RGS_TEST_HTTP)
#include "skip.hpp"
#include "web_servers.hpp"
#endif

namespace fs = std::filesystem;
using rgs::test::built;
using rgs::test::TemporaryFolder;
using rgs::test::write_text;

namespace {

struct Outcome {
  int code = -1;
  std::string out;  // standard output, then standard error
};

Outcome render(const std::string& arguments) {
  rgs::test::ProgramResult run = rgs::test::run_shell("'" + built("rgs-render") + "' " + arguments + " 2>&1");
  return {run.exit_code, std::move(run.out)};
}

rgs::SplatCloud ball() {
  std::mt19937 generator(11);
  std::uniform_real_distribution<float> coordinate(-1, 1);
  rgs::SplatCloud cloud;
  cloud.resize(400, 1);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    rgs::Splat splat;
    for (float& x : splat.mean) x = coordinate(generator);
    for (float& x : splat.log_scale) x = -2.5F;
    for (float& x : splat.sh) x = coordinate(generator);
    splat.opacity_logit = 2;
    cloud.set(i, splat);
  }
  return cloud;
}

void write_ply(const std::string& path, const rgs::SplatCloud& cloud, const rgs::Origin& origin = rgs::kNoOrigin) {
  rgs::Declarations stated;
  stated.origin = origin;
  auto writer = rgs::PlyWriter::create(path, cloud.size(), cloud.sh_degree, {.overwrite = true, .sync = false}, stated);
  REQUIRE(writer);
  std::vector<rgs::Splat> splats;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) splats.push_back(cloud.view().splat(i));
  REQUIRE(writer->write(0, splats));
  REQUIRE(writer->commit());
}

std::string camera(const std::string& name, const std::string& split, double z, const std::string& fx = "60") {
  return R"({"name":")" + name + R"(","split":")" + split + R"(","width":64,"height":48,"fx":)" + fx +
         R"(,"fy":60,"world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,)" + std::to_string(z) + R"(],[0,0,0,1]]})";
}

// A folder with scene.ply, scene.rgs and cameras.json: a.jpg (test), b.jpg and c.jpg (train).
struct Stage {
  TemporaryFolder folder;
  Stage() {
    const rgs::SplatCloud cloud = ball();
    write_ply(file("scene.ply"), cloud);
    const auto encoded = rgs::encode(cloud.view());
    REQUIRE(encoded);
    write_text(file("scene.rgs"), {reinterpret_cast<const char*>(encoded->data()), encoded->size()});
    write_text(file("cameras.json"), "[" + camera("x/a.jpg", "test", 4) + "," + camera("x/b.jpg", "train", 5) + "," +
                                         camera("c.jpg", "train", 6) + "]");
  }
  std::string file(const std::string& name) const { return folder.file(name); }
  // A command line; @ stands for the folder.
  Outcome run(std::string arguments) const {
    for (std::size_t at; (at = arguments.find('@')) != std::string::npos;)
      arguments.replace(at, 1, folder.path().string() + "/");
    return render(arguments);
  }
  bool has(const std::string& name) const { return fs::exists(file(name)); }
  rgs::Image picture(const std::string& name) const {
    auto image = rgs::read_image(file(name));
    REQUIRE_MESSAGE(image.has_value(), name);
    return std::move(*image);
  }
};

float mean(const rgs::Image& image) {
  double sum = 0;
  for (const float v : image.pixels) sum += v;
  return static_cast<float>(sum / static_cast<double>(image.pixels.size()));
}

float largest_difference(const rgs::Image& a, const rgs::Image& b) {
  REQUIRE(a.pixels.size() == b.pixels.size());
  float largest = 0;
  for (std::size_t i = 0; i < a.pixels.size(); ++i) largest = std::max(largest, std::abs(a.pixels[i] - b.pixels[i]));
  return largest;
}

}  // namespace

TEST_CASE("a far scene gives the same pictures as near the origin: PLY of doubles, .rgs, with cameras and without") {
  const Stage stage;
  const rgs::Origin place{4.2e6, 1.7e5, 4.8e6};
  write_ply(stage.file("far.ply"), ball(), place);
  rgs::EncodeOptions options;
  options.origin = place;
  const auto encoded = rgs::encode(ball().view(), options);
  REQUIRE(encoded);
  write_text(stage.file("far.rgs"), {reinterpret_cast<const char*>(encoded->data()), encoded->size()});
  write_text(stage.file("far.json"),
             R"([{"name":"a","width":64,"height":48,"fx":60,"fy":60,)"
             R"("world_to_camera":[[1,0,0,-4200000],[0,1,0,-170000],[0,0,1,-4799996],[0,0,0,1]]}])");
  write_text(stage.file("home.json"), "[" + camera("a", "test", 4) + "]");
  for (const std::string ending : {"ply", "rgs"}) {
    CAPTURE(ending);
    REQUIRE(stage.run("@scene." + ending + " --cameras @home.json --out @home.png --overwrite").code == 0);
    REQUIRE(stage.run("@far." + ending + " --cameras @far.json --out @far.png --overwrite").code == 0);
    CHECK(mean(stage.picture("home.png")) > 0.05F);
    CHECK(largest_difference(stage.picture("home.png"), stage.picture("far.png")) <= 1.01F / 255);
    REQUIRE(stage.run("@scene." + ending + " --size 64x48 --out @home.png --overwrite").code == 0);
    REQUIRE(stage.run("@far." + ending + " --size 64x48 --out @far.png --overwrite").code == 0);
    CHECK(mean(stage.picture("home.png")) > 0.05F);
    CHECK(largest_difference(stage.picture("home.png"), stage.picture("far.png")) <= 1.01F / 255);
  }
}

TEST_CASE("other formats show the same scene in the same frame") {
  const Stage stage;
  REQUIRE(stage.run("@scene.ply -c @cameras.json --out @ply.exr").code == 0);
  for (const rgs::SplatFormat format :
       {rgs::SplatFormat::spz, rgs::SplatFormat::compressed_ply, rgs::SplatFormat::glb}) {
    CAPTURE(rgs::format_name(format));
    rgs::SplatCloud cloud = ball();
    rgs::convert_axes(cloud, rgs::kAxes3dgs, rgs::format_info(format).axes);
    const auto bytes = rgs::encode_splats(cloud.view(), format);
    REQUIRE(bytes);
    write_text(stage.file("other"), {reinterpret_cast<const char*>(bytes->data()), bytes->size()});
    REQUIRE(stage.run("@other -c @cameras.json --overwrite --out @other.exr").code == 0);
    const float apart = largest_difference(stage.picture("ply.exr"), stage.picture("other.exr"));
    CHECK(apart < (format == rgs::SplatFormat::glb ? 1e-3F : 0.1F));
  }
}

TEST_CASE("one picture from a camera, in every format and at another size") {
  const Stage stage;
  for (const char* name : {"a.png", "a.jpg", "a.tif", "a.exr"}) {
    const Outcome outcome = stage.run(std::string("@scene.ply -c @cameras.json --out @") + name);
    CAPTURE(outcome.out);
    REQUIRE(outcome.code == 0);
    const rgs::Image image = stage.picture(name);
    CHECK(image.width == 64);
    CHECK(image.height == 48);
    CHECK(image.channels == 3);
    CHECK(mean(image) > 0.05F);
  }
  REQUIRE(stage.run("@scene.ply -c @cameras.json --size 32x18 --out @small.png").code == 0);
  CHECK(stage.picture("small.png").width == 32);
  CHECK(stage.picture("small.png").height == 18);
}

TEST_CASE("without the module of other formats PNG and JPEG are written, and others refused before the work") {
  const Stage stage;
  fs::create_directory(stage.file("bin"));
  fs::copy_file(built("rgs-render"), stage.file("bin/rgs-render"));
  const auto alone = [&](const std::string& out) {
    return rgs::test::run_shell("'" + stage.file("bin/rgs-render") + "' '" + stage.file("scene.ply") + "' -c '" +
                                stage.file("cameras.json") + "' --out '" + stage.file(out) + "' 2>&1");
  };
  for (const char* out : {"a.png", "a.jpg"}) {
    CHECK(alone(out).exit_code == 0);
    CHECK(mean(stage.picture(out)) > 0.05F);
  }
  for (const char* out : {"a.tif", "a.exr"}) {
    const rgs::test::ProgramResult refused = alone(out);
    CAPTURE(refused.out);
    CHECK(refused.exit_code == 2);
    CHECK(refused.out.find("roofgs-pictures") != std::string::npos);
    CHECK(refused.out.find("rendering") == std::string::npos);
  }
}

TEST_CASE(".rgs and .ply show the same, whatever the file's name") {
  const Stage stage;
  fs::copy_file(stage.file("scene.rgs"), stage.file("odd.name"));
  REQUIRE(stage.run("@scene.ply -c @cameras.json --out @ply.png").code == 0);
  REQUIRE(stage.run("@odd.name -c @cameras.json --out @rgs.png").code == 0);
  CHECK(largest_difference(stage.picture("ply.png"), stage.picture("rgs.png")) < 0.03F);
}

TEST_CASE("folders: all cameras, a split, a view, with depth and alpha") {
  const Stage stage;
  REQUIRE(stage.run("@scene.ply -c @cameras.json --out @all --depth @depth").code == 0);
  for (const char* name : {"all/a.png", "all/b.png", "all/c.png"}) CHECK(stage.has(name));
  const rgs::Image depth = stage.picture("depth/b_depth.exr");
  CHECK(depth.channels == 1);
  const float middle = depth.at(32, 24, 0);
  CHECK(middle > 3.5F);
  CHECK(middle < 6.5F);
  CHECK(depth.at(0, 0, 0) == 0);

  REQUIRE(stage.run("@scene.ply -c @cameras.json --split train --format jpg --out @train").code == 0);
  CHECK(std::distance(fs::directory_iterator(stage.file("train")), {}) == 2);
  REQUIRE(stage.run("@scene.ply -c @cameras.json --split train --view 1 --out @second").code == 0);
  CHECK(stage.has("second/c.png"));
  CHECK(std::distance(fs::directory_iterator(stage.file("second")), {}) == 1);
  REQUIRE(stage.run("@scene.ply -c @cameras.json --view x/b.jpg --out @b.png --alpha").code == 0);
  const rgs::Image rgba = stage.picture("b.png");
  CHECK(rgba.channels == 4);
  CHECK(rgba.at(0, 0, 3) == 0);
  CHECK(rgba.at(32, 24, 3) > 0.5F);
}

TEST_CASE("views without cameras, orbits and paths") {
  const Stage stage;
  REQUIRE(stage.run("@scene.rgs --size 64x36 --out @view.png").code == 0);
  const rgs::Image view = stage.picture("view.png");
  CHECK(view.width == 64);
  CHECK(view.at(32, 18, 0) + view.at(32, 18, 1) + view.at(32, 18, 2) > 0);
  CHECK(view.at(0, 0, 0) == 0);  // the whole scene is in the picture
  REQUIRE(stage.run("@scene.ply --orbit 3 --size 32x18 --out @orbit").code == 0);
  CHECK(stage.has("orbit/orbit_0000.png"));
  CHECK(stage.has("orbit/orbit_0002.png"));
  REQUIRE(stage.run("@scene.ply --path @cameras.json --frames 4 --out @path").code == 0);
  CHECK(stage.has("path/frame_0003.png"));
  CHECK(stage.picture("path/frame_0003.png").width == 64);
}

TEST_CASE("each option changes the picture as documented") {
  const Stage stage;
  const std::string base = "@scene.ply -c @cameras.json --quiet --overwrite --out @o.exr ";
  const auto picture = [&](const std::string& options) {
    const Outcome outcome = stage.run(base + options);
    CAPTURE(options);
    CAPTURE(outcome.out);
    REQUIRE(outcome.code == 0);
    CHECK(outcome.out == "");
    return stage.picture("o.exr");
  };
  const rgs::Image plain = picture("");
  CHECK(picture("--background 0,1,0.5").at(0, 0, 1) == 1);
  CHECK(mean(picture("--near 100")) == 0);
  CHECK(mean(picture("--far 1")) == 0);
  CHECK(largest_difference(plain, picture("--sh-degree 0")) > 0.05F);
  CHECK(largest_difference(plain, picture("--aa mip")) > 0.001F);
  for (const char* options : {"--exp paper", "--exp zero-mean", "--exponent folded", "--key linear", "--key log",
                              "--key linear --depth-bits 10 --depth-range 2,8", "--extent square", "--scalar",
                              "--threads 1", "--backend cpu", "--backend auto"}) {
    CAPTURE(options);
    const rgs::Image image = picture(options);
    CHECK(largest_difference(plain, image) < 0.5F);
    CHECK(mean(image) == doctest::Approx(mean(plain)).epsilon(0.05));
  }
  CHECK(largest_difference(plain, picture("--exp paper")) > 0);
  // On the CPU, so that equal options give equal bytes.
  struct Mode {
    std::string name, options;
  };
  for (const Mode& mode :
       {Mode{"--mode baseline", "--extent square"}, Mode{"--mode paper", "--exp paper --exponent folded --key linear"},
        Mode{"--mode turbo", "--exponent folded"}}) {
    CAPTURE(mode.name);
    CHECK(largest_difference(picture(mode.name + " --backend cpu"), picture(mode.options + " --backend cpu")) == 0);
  }
}

TEST_CASE("a depth key that is too coarse is reported, with its resolution in the JSON summary") {
  const Stage stage;
  const auto run = [&](const std::string& options) {
    return stage.run("@scene.ply -c @cameras.json --backend cpu --overwrite --out @o " + options);
  };
  const std::string warning = "Gaussians may be drawn out of order";
  const Outcome coarse = run("--key linear --depth-bits 12 --depth-range 2,8");
  CHECK(coarse.code == 0);
  CHECK_MESSAGE(coarse.out.find("depth key of 12 bits resolves 0.00073 of the depth") != std::string::npos, coarse.out);
  CHECK(coarse.out.find(warning) != std::string::npos);
  CHECK(coarse.out.find(warning) == coarse.out.rfind(warning));  // once, for three pictures
  for (const char* fine : {"", "--key log", "--mode turbo", "--key linear --depth-bits 24"}) {
    CAPTURE(fine);
    CHECK(run(fine).out.find(warning) == std::string::npos);
  }
  const auto json = nlohmann::json::parse(run("--key log --depth-bits 16 --depth-range 2,8 --json --quiet").out);
  for (const auto& frame : json["frames"]) {
    CHECK(frame["depth_bits"] == 16);
    CHECK(frame["depth_resolution"].get<double>() == doctest::Approx(std::log(4.0) / 65535).epsilon(1e-4));
  }
}

TEST_CASE("what a file declares of its anti-aliasing is drawn, in every format, unless another is requested") {
  const Stage stage;
  const rgs::SplatCloud cloud = ball();
  const auto write = [&](const std::string& name, const rgs::Result<std::vector<std::byte>>& bytes) {
    REQUIRE(bytes);
    write_text(stage.file(name), {reinterpret_cast<const char*>(bytes->data()), bytes->size()});
  };
  using rgs::AaMode;
  for (const AaMode mode : {AaMode::classic, AaMode::mip_splatting}) {
    rgs::EncodeOptions rgs_options;
    rgs_options.aa_mode = mode;
    const std::string name = mode == AaMode::classic ? "classic" : "mip";
    write(name + ".rgs", rgs::encode(cloud.view(), rgs_options));
    for (const auto format : {rgs::SplatFormat::spz, rgs::SplatFormat::ply, rgs::SplatFormat::glb}) {
      write(name + "." + rgs::format_name(format), rgs::encode_splats(cloud.view(), format, {.aa_mode = mode}));
    }
  }
  const auto picture = [&](const std::string& arguments) {
    const Outcome outcome = stage.run(arguments + " -c @cameras.json --quiet --overwrite --backend cpu --out @o.exr");
    CAPTURE(outcome.out);
    REQUIRE(outcome.code == 0);
    return stage.picture("o.exr");
  };
  // All formats in the default mode, and all modes with one format; what options are called once: each picture is a
  // process.
  for (const std::string format : {".rgs", ".spz", ".ply", ".glb"}) {
    for (const std::string mode : {"", " --mode baseline", " --mode paper", " --mode turbo", " --exp paper"}) {
      if (format != ".rgs" && !mode.empty()) continue;
      CAPTURE(format);
      CAPTURE(mode);
      const rgs::Image classic = picture("@classic" + format + mode), mip = picture("@mip" + format + mode);
      CHECK(largest_difference(classic, mip) > 0.001F);
      CHECK(largest_difference(mip, picture("@classic" + format + mode + " --aa mip")) == 0);
      CHECK(largest_difference(classic, picture("@mip" + format + mode + " --aa classic")) == 0);
      if (format != ".rgs" || !mode.empty()) continue;
      CHECK(largest_difference(classic, picture("@classic" + format + mode + " --low-pass 0.3")) == 0);
      CHECK(largest_difference(mip, picture("@mip" + format + mode + " --low-pass 0.1")) == 0);
      CHECK(largest_difference(mip, picture("@mip" + format + mode + " --aa mip-splatting")) == 0);
    }
  }
}

TEST_CASE("existing pictures are kept before anything is rendered") {
  const Stage stage;
  write_text(stage.file("a.png"), "mine");
  const Outcome kept = stage.run("@scene.ply -c @cameras.json --out @a.png");
  CHECK(kept.code == 3);
  CHECK(kept.out.find("--overwrite") != std::string::npos);
  CHECK(fs::file_size(stage.file("a.png")) == 4);
  fs::create_directory(stage.file("d"));
  write_text(stage.file("d/c.png"), "mine");
  CHECK(stage.run("@scene.ply -c @cameras.json --out @d").code == 3);
  CHECK_FALSE(stage.has("d/a.png"));
  CHECK(stage.run("@scene.ply -c @cameras.json --out @d --overwrite").code == 0);
  CHECK(stage.picture("d/c.png").width == 64);
}

TEST_CASE("exit codes: 2 usage, 3 files, 4 malformed input") {
  const Stage stage;
  for (const char* arguments :
       {"", "@scene.ply", "@scene.ply --out @a.bmp", "@scene.ply --out @a.png --size 0x4",
        "@scene.ply --out @a.png --view 0", "@scene.ply --out @a.png -c @cameras.json --view 3",
        "@scene.ply --out @a.png -c @cameras.json --view all", "@scene.ply --out @a.jpg --alpha",
        "@scene.ply --out @a.png --depth @d.png", "@scene.ply --out @a.png --exp fast",
        "@scene.ply --out @a.png --orbit 0", "@scene.ply --out @a.png --frames 4",
        "@scene.ply --out @a.png --backend vulkan", "@scene.ply --out @a.png --mode paper --exp exact",
        "@scene.ply --out @a.png --background 1,2", "@scene.ply --out @a.png --devices x"}) {
    CAPTURE(arguments);
    const Outcome outcome = stage.run(arguments);
    CHECK(outcome.code == 2);
    CHECK(outcome.out != "");
    CHECK_FALSE(stage.has("a.png"));
  }
  const Outcome negative = stage.run("--devices 0,-1 @scene.ply --out @a.png");
  CHECK(negative.code == 2);
  CHECK(negative.out.find("negative") != std::string::npos);
  CHECK(stage.run("@missing.ply --out @a.png").code == 3);
  CHECK(stage.run("@missing.ply --out @a.png").out.find("No such file") != std::string::npos);
  CHECK(stage.run("@scene.ply -c @missing.json --out @a.png").code == 3);
  CHECK(stage.run("@scene.ply -c @cameras.json --out @none/a.png").code == 3);
  CHECK(stage.run("@cameras.json --out @a.png").code == 4);
  write_text(stage.file("cut.ply"), "ply\nformat binary_little_endian 1.0\nelement ver");
  CHECK(stage.run("@cut.ply --out @a.png").code == 4);
  std::ifstream in(stage.file("scene.rgs"), std::ios::binary);
  std::string rgs_bytes{std::istreambuf_iterator<char>(in), {}};
  write_text(stage.file("cut.rgs"), rgs_bytes.substr(0, rgs_bytes.size() / 2));
  CHECK(stage.run("@cut.rgs --out @a.png").code == 4);
  write_text(stage.file("bad.json"), "[" + camera("a", "test", 4, "-1") + "]");
  const Outcome bad_camera = stage.run("@scene.ply -c @bad.json --out @a.png");
  CHECK(bad_camera.code == 4);
  CHECK(bad_camera.out.find("byte 1: ") != std::string::npos);
  CHECK(bad_camera.out.find("the camera of index 0 ") != std::string::npos);
  rgs::SplatCloud damaged = ball();
  damaged.mean[3 * 7] = std::numeric_limits<float>::quiet_NaN();
  write_ply(stage.file("nan.ply"), damaged);
  const Outcome nan = stage.run("@nan.ply --out @a.png");
  CHECK(nan.code == 4);
  CHECK(nan.out.find("(found 7)") != std::string::npos);
  CHECK_FALSE(stage.has("a.png"));
}

TEST_CASE("an empty scene is a picture of the background") {
  const Stage stage;
  write_ply(stage.file("empty.ply"), {});
  REQUIRE(stage.run("@empty.ply --size 8x8 --background 0,0,1 --out @a.png").code == 0);
  CHECK(stage.picture("a.png").at(3, 3, 2) == 1);
}

TEST_CASE("--json prints one JSON object about the run") {
  const Stage stage;
  const Outcome outcome = stage.run("@scene.rgs -c @cameras.json --out @all --depth @all --json 2>/dev/null #");
  REQUIRE(outcome.code == 0);
  const auto json = nlohmann::json::parse(outcome.out, nullptr, false);
  REQUIRE(json.is_object());
  CHECK(json["program"] == "rgs-render");
  CHECK(json["scene"]["gaussians"] == 400);
  CHECK(json["scene"]["sh_degree"] == 1);
  REQUIRE(json["frames"].size() == 3);
  CHECK(json["frames"][0]["camera"] == "x/a.jpg");
  CHECK(json["frames"][0]["width"] == 64);
  CHECK(json["frames"][0]["visible"] > 0);
  for (const auto* time :
       {&json["frames"][0]["ms"]["total"], &json["first_frame_ms"], &json["total_seconds"], &json["median_ms"]})
    CHECK(time->is_number());
  CHECK(fs::exists(json["frames"][2]["file"].get<std::string>()));
  CHECK(fs::exists(json["frames"][2]["depth_file"].get<std::string>()));
}

TEST_CASE("infinite logits are opacities of 1 and 0, and a log-scale of -inf is a scale of 0") {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  const TemporaryFolder folder;
  rgs::SplatCloud infinite = ball(), finite = ball();
  for (std::uint64_t i = 0; i < 40; ++i) {
    infinite.opacity_logit[i] = i % 2 == 0 ? kInfinity : -kInfinity;
    finite.opacity_logit[i] = i % 2 == 0 ? 40.F : -90.F;
    infinite.log_scale[3 * i + 1] = -kInfinity;
    finite.log_scale[3 * i + 1] = -100.F;
  }
  write_ply(folder.file("infinite.ply"), infinite);
  write_ply(folder.file("finite.ply"), finite);
  std::string pictures[2];
  for (const int k : {0, 1}) {
    const std::string name = k == 0 ? "infinite" : "finite";
    const Outcome run =
        render("--size 64x48 '" + folder.file(name + ".ply") + "' -o '" + folder.file(name + ".png") + "'");
    CAPTURE(run.out);
    REQUIRE(run.code == 0);
    std::ifstream in(folder.file(name + ".png"), std::ios::binary);
    pictures[k] = {std::istreambuf_iterator<char>(in), {}};
  }
  CHECK(pictures[0].size() > 100);
  CHECK(pictures[0] == pictures[1]);
}

TEST_CASE("--max-expansion limits what a compressed scene may decode to") {
  const TemporaryFolder folder;
  rgs::SplatCloud cloud;
  cloud.resize(40'000, 0);
  const rgs::SplatCloud some = ball();
  for (std::uint64_t i = 0; i < cloud.size(); ++i) cloud.set(i, some.view().splat(i % 400));
  for (const rgs::SplatFormat format : {rgs::SplatFormat::rgs, rgs::SplatFormat::spz}) {
    rgs::EncodeOptions options;
    options.profile = rgs::Profile::packed;
    const auto bytes =
        format == rgs::SplatFormat::rgs ? rgs::encode(cloud.view(), options) : rgs::encode_splats(cloud.view(), format);
    REQUIRE(bytes);
    std::ofstream(folder.file("scene"), std::ios::binary)
        .write(reinterpret_cast<const char*>(bytes->data()), static_cast<std::streamsize>(bytes->size()));
    const std::string rest =
        " --size 16x12 --overwrite '" + folder.file("scene") + "' -o '" + folder.file("a.png") + "'";
    CHECK(render("--max-expansion 500kB" + rest).code == 4);
    CHECK(render("--max-expansion 1GB" + rest).code == 0);
    CHECK(render(rest).code == 0);
  }
}

namespace {

// A stage with town.rgs: levels of detail over some thousand Gaussians, in pages of 128.
struct StreamStage : Stage {
  rgs::SplatCloud cloud;
  StreamStage() {
    std::mt19937 generator(5);
    std::uniform_real_distribution<float> coordinate(-3, 3);
    cloud.resize(20000, 0);
    for (std::uint64_t i = 0; i < cloud.size(); ++i) {
      rgs::Splat splat;
      for (float& x : splat.mean) x = coordinate(generator);
      for (float& x : splat.log_scale) x = -2.5F;
      for (int k = 0; k < 3; ++k) splat.sh[k] = coordinate(generator) / 3;
      splat.opacity_logit = 2;
      cloud.set(i, splat);
    }
    rgs::EncodeOptions options;
    options.chunk_size = 32;
    const auto plain = rgs::encode(cloud.view(), options);
    REQUIRE(plain);
    auto ordered = rgs::decode(*plain);
    REQUIRE(ordered);
    std::vector<std::byte> bytes;
    rgs::lod::Levels levels = rgs::test::trivial_levels(*ordered, {.chunk_size = 32, .page_chunks = 4});
    for (rgs::lod::Page& page : levels.pages) page.error *= 20;
    REQUIRE(rgs::write_levels(levels, options, bytes));
    write_text(file("town.rgs"), {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  }
};

std::string without_summary(std::string out) {  // progress, before the JSON
  return out.substr(out.find('{'));
}

}  // namespace

TEST_CASE("with --host-memory a file is streamed: the same pictures, and the reads in the JSON summary") {
  const StreamStage stage;
  CHECK(stage.run("@town.rgs --cameras @cameras.json --detail 0.5 --backend cpu --out @whole/").code == 0);
  const Outcome run =
      stage.run("@town.rgs --cameras @cameras.json --detail 0.5 --host-memory 64MiB --json --quiet --out @streamed/");
  REQUIRE(run.code == 0);
  for (const char* const name : {"a.png", "b.png", "c.png"}) {
    const std::string n = name;
    CHECK(rgs::test::read_text(stage.file("whole/" + n)) == rgs::test::read_text(stage.file("streamed/" + n)));
  }
  const auto json = nlohmann::json::parse(without_summary(run.out));
  CHECK(json["host_memory"] == 64 << 20);
  CHECK(json["wait_seconds"] == 60);
  CHECK(json["scene"]["gaussians"] == 20000);
  CHECK(json["scene"]["memory_bytes"] <= 64 << 20);
  for (const auto& frame : json["frames"]) {
    CHECK(frame["pages"] > 0);
    const auto& stream = frame["stream"];
    CHECK(stream["pages_missing"] == 0);
    CHECK(stream["pages_resident"] >= frame["pages"]);
    CHECK(stream["bytes_read"] > 0);
    CHECK(stream["bytes_decoded"] > 0);
    CHECK(stream["bytes_uploaded"] == 0);
    CHECK(stream["bytes_evicted"] == 0);
    CHECK(stream["detail_reached_px"] <= 0.5);
    CHECK(stream["wait_ms"] >= 0);
    CHECK(!stream.contains("due_ms"));
  }
}

TEST_CASE("a budget too small for a view gives coarser pictures, a warning with their error, and exit code 6") {
  const StreamStage stage;
  const Outcome run =
      stage.run("@town.rgs --cameras @cameras.json --view 0 --detail 0 --host-memory 1MiB --out @a.png");
  CHECK(run.code == 6);
  CHECK(run.out.find("pages are missing, its error is ") != std::string::npos);
  CHECK(mean(stage.picture("a.png")) > 0.01F);
  const Outcome none = stage.run("@town.rgs --host-memory 100kB --out @none.png");
  CHECK(none.code == 4);
  CHECK(none.out.find("budget") != std::string::npos);
  CHECK(!stage.has("none.png"));
}

TEST_CASE("in real time a path's frames are drawn on time, from resident pages, with a report of each") {
  const StreamStage stage;
  const Outcome run = stage.run(
      "@town.rgs --path @cameras.json --frames 8 --host-memory 64MiB --realtime 20 --json --quiet --out @flight/");
  const auto json = nlohmann::json::parse(without_summary(run.out));
  CHECK(json["realtime_fps"] == 20);
  CHECK(json["reached_fps"] > 0);
  CHECK(json["frames_late"] <= 8);
  REQUIRE(json["frames"].size() == 8);
  CHECK(run.code == (json["frames_incomplete"] == 0 ? 0 : 6));
  double before = -1;
  for (std::size_t i = 0; i < 8; ++i) {
    const auto& stream = json["frames"][i]["stream"];
    CHECK(stream["due_ms"].get<double>() == doctest::Approx(50.0 * static_cast<double>(i)));
    CHECK(stream["begin_ms"].get<double>() >= stream["due_ms"].get<double>());
    CHECK(stream["begin_ms"].get<double>() > before);
    before = stream["begin_ms"].get<double>();
    CHECK(stream.contains("detail_reached_px"));
    CHECK(!stream.contains("wait_ms"));
  }
  CHECK(stage.has("flight/frame_0007.png"));
}

TEST_CASE("in real time, too, coarser pictures than asked for end with exit code 6 and a message") {
  const StreamStage stage;
  const std::string flight = "@town.rgs --path @cameras.json --frames 3 --detail 0 --host-memory 1MiB --realtime 20";
  const Outcome run = stage.run(flight + " --out @flight/");
  CHECK(run.code == 6);
  CHECK(run.out.find("of 3 frames ") != std::string::npos);
  CHECK(run.out.find(" 3 are coarser than asked for: ") != std::string::npos);
  const Outcome quiet = stage.run(flight + " --quiet --json --overwrite --out @flight/");
  CHECK(quiet.code == 6);
  const auto json = nlohmann::json::parse(quiet.out);
  CHECK(json["frames_incomplete"] == 3);
}

TEST_CASE(
    "a file without its end is drawn coarser with exit code 6, in memory and streamed, unless the view needs no more") {
  const StreamStage stage;
  const std::string town = rgs::test::read_text(stage.file("town.rgs"));
  write_text(stage.file("cut.rgs"), town.substr(0, town.size() * 9 / 10));
  const std::string view = " --cameras @cameras.json --view 0 --backend cpu --overwrite --out @a.png";
  for (const std::string memory : {"", " --host-memory 64MiB"}) {
    CAPTURE(memory);
    const Outcome run = stage.run("@cut.rgs --detail 0" + memory + view);
    CHECK(run.code == 6);
    CHECK(run.out.find("missing") != std::string::npos);
    CHECK(stage.run("@cut.rgs --detail 0 --quiet" + memory + view).code == 6);
  }
  CHECK(stage.run("@cut.rgs --detail 1e6" + view).code == 0);  // the root
}

TEST_CASE("a frame in real time has until the next is due, less what is done besides, and a late one is made up for") {
  rgs::render::Pace pace(10);
  CHECK(pace.draw_ms() == 100);
  CHECK(pace.begin(0) == 0);
  CHECK(pace.draw_ms() == 100);
  pace.drew(60);
  CHECK(pace.begin(90) == 100);  // 30 besides
  CHECK(pace.n_late() == 0);
  CHECK(pace.draw_ms() == 70);
  pace.drew(90);
  CHECK(pace.begin(220) == 200);
  CHECK(pace.n_late() == 1);
  CHECK(pace.draw_ms() == 50);
  pace.drew(30);
  CHECK(pace.begin(280) == 300);
  CHECK(pace.draw_ms() == 70);
  pace.drew(1000);
  CHECK(pace.begin(1330) == 400);
  CHECK(pace.n_late() == 2);
  CHECK(pace.draw_ms() == 25);
}

TEST_CASE("a limit of Gaussians gives coarser pictures, complete, with their detail") {
  const StreamStage stage;
  const std::string view = "@town.rgs --cameras @cameras.json --view 0 --backend cpu --json --quiet --overwrite";
  const auto frame = [&](const std::string& arguments) {
    const Outcome run = stage.run(view + arguments + " --out @a.png");
    CHECK(run.code == 0);
    return nlohmann::json::parse(run.out)["frames"][0];
  };
  const auto all = frame("");
  CHECK(all["detail_px"] == 1);
  CHECK(frame(" --detail 0")["detail_px"] == 0);
  const auto n = all["gaussians"].get<std::uint64_t>() / 2;
  for (const std::string memory : {"", " --host-memory 64MiB"}) {
    const auto fewer = frame(memory + " --max-gaussians " + std::to_string(n));
    CHECK(fewer["gaussians"] <= n);
    CHECK(fewer["detail_px"] > 1);
    if (memory.empty()) continue;
    CHECK(fewer["stream"]["pages_missing"] == 0);
    CHECK(fewer["detail_px"] == frame(" --max-gaussians " + std::to_string(n))["detail_px"]);
  }
}

TEST_CASE("inputs that cannot be streamed are refused with advice") {
  const StreamStage stage;
  const auto refused = [&](const std::string& arguments, int code, const std::string& says) {
    CAPTURE(arguments);
    const Outcome run = stage.run(arguments + " --out @x.png");
    CHECK(run.code == code);
    CAPTURE(run.out);
    CHECK(run.out.find(says) != std::string::npos);
    CHECK(!stage.has("x.png"));
  };
  refused("@scene.rgs --host-memory 1GiB", 2, "rgs-convert --lod");
  refused("@scene.ply --host-memory 1GiB", 2, "rgs-convert --lod");
  refused("@town.rgs --host-memory 0", 2, "0 bytes");
  refused("@town.rgs --host-memory much", 2, "--host-memory");
  refused("@town.rgs --host-memory 1GiB --backend cuda", 2, "--device-memory");
  refused("@town.rgs --device-memory 1GiB --backend cpu", 2, "--device-memory");
  refused("@town.rgs --device-memory 0", 2, "0 bytes");
  refused("@town.rgs --device-memory 1GiB --devices 0,1", 2, "--devices");
  refused("@scene.rgs --device-memory much", 2, "--device-memory");
  refused("@town.rgs --wait 3", 2, "--host-memory");
  refused("@town.rgs --host-memory 1GiB --realtime 10", 2, "--path");
  refused("@town.rgs --host-memory 1GiB --path @cameras.json --realtime 10 --wait 3", 2, "exclude");
  refused("@nothing.rgs --host-memory 1GiB", 3, "nothing.rgs");
  // An output is never an input.
  CHECK(stage.run("@town.rgs --host-memory 1GiB --overwrite --out @town.rgs").code != 0);
  CHECK(stage.run("@town.rgs --out @y.png").code == 0);
}

#if defined(RGS_TEST_HTTP)
TEST_CASE("an address is printed without its query") {
  const StreamStage stage;
  const Outcome run = stage.run("'http://127.0.0.1:1/a.rgs?key=hidden#hidden' --out @x.png");
  CHECK(run.code == 3);
  CAPTURE(run.out);
  CHECK(run.out.find("http://127.0.0.1:1/a.rgs") != std::string::npos);
  CHECK(run.out.find("hidden") == std::string::npos);
}

TEST_CASE("--wait limits the opening of an address, whatever its server does") {
  const StreamStage stage;
  const rgs::test::HostileServer server;
  for (const std::string kind : {"silent?", "slow?all&rate=1&", "status?code=503&retry_after=999999&"}) {
    CAPTURE(kind);
    const Outcome run =
        stage.run("'" + server.url("/" + kind + "file=" + stage.file("town.rgs")) + "' --wait 0.05 --out @x.png");
    CHECK(run.code == 3);
    CHECK(run.out.find("longer than allowed") != std::string::npos);
    CHECK(!stage.has("x.png"));
  }
}

TEST_CASE("a file on a web server is drawn like a local one, and other formats are refused") {
  if (!rgs::test::Nginx::is_installed()) {
    rgs::test::skip_without_tool(std::string("there is no ") + rgs::test::Nginx::kProgram);
    return;
  }
  const StreamStage stage;
  CHECK(stage.run("@town.rgs --cameras @cameras.json --view 0 --backend cpu --out @whole.png").code == 0);
  const rgs::test::Nginx server(false);
  for (const char* const name : {"town.rgs", "scene.rgs", "scene.ply"}) fs::copy(stage.file(name), server.file(name));
  const auto at = [&](const std::string& name) { return "'" + server.url(name) + "'"; };
  CHECK(stage.run(at("town.rgs") + " --cameras @cameras.json --view 0 --out @far.png").code == 0);
  CHECK(rgs::test::read_text(stage.file("whole.png")) == rgs::test::read_text(stage.file("far.png")));
  for (const char* const name : {"scene.ply", "scene.rgs"}) {
    const Outcome run = stage.run(at(name) + " --out @x.png");
    CHECK(run.code == 4);
    CHECK(run.out.find("download it first") != std::string::npos);
  }
  CHECK(stage.run(at("absent.rgs") + " --out @x.png").code == 3);
}
#endif
