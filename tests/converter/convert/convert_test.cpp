// convert_test.cpp - rgs-convert, as a library and as a program: bytes, options, reports and exit codes.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "checkout.hpp"
#include "convert.hpp"
#include "convert_scenes.hpp"
#include "counted_memory.hpp"
#include "edit_file.hpp"
#include "rgs/checksum.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/version.hpp"
#include "run_program.hpp"
#include "sanitized.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr int kPlyRow = 248;  // bytes of a row of degree 3

Provenance provenance_of(std::span<const std::byte> ply, const std::string& name) {
  return {ply.size(), xxh3(ply), name, "rgs-convert " RGS_VERSION};
}

Status convert_in_process(const std::string& ply_path, const std::string& output, ConvertOptions options,
                          std::size_t threads) {
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
  const auto ply = PlyFile::open(ply_path);
  if (!ply) return tl::unexpected(ply.error());
  options.output.sync = false;
  options.output.overwrite = true;
  return convert_to_rgs(*ply, output, options).map([](const ConvertSummary&) {});
}

/// The bytes of encode() for the PLY file.
Bytes expected_rgs(const std::string& ply_path, EncodeOptions options, const std::string& name = "scene.ply") {
  options.provenance = provenance_of(read_bytes(ply_path), name);
  const SplatCloud cloud = read_ply(ply_path).value();
  options.first_view = chosen_for(cloud, options);
  const auto file = encode(cloud.view(), options);
  REQUIRE(file);
  return *file;
}

ProgramResult rgs_convert(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync"});
  return run_program(arguments);
}

void check_same_sections(std::span<const std::byte> a, std::span<const std::byte> b,
                         const std::vector<SectionType>& types) {
  const auto x = FileView::open(a), y = FileView::open(b);
  REQUIRE(x);
  REQUIRE(y);
  for (const SectionType type : types) {
    CAPTURE(static_cast<std::uint32_t>(type));
    CHECK(std::ranges::equal(x->stored(type), y->stored(type)));
  }
}

const std::vector<SectionType> kAllButProvenance{SectionType::declarations, SectionType::sh_steps, SectionType::chunks,
                                                 SectionType::means,        SectionType::geometry, SectionType::sh,
                                                 SectionType::permutation};

bool holds(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

}  // namespace

TEST_CASE("a streamed conversion writes the bytes of encode() on any number of threads") {
  const TemporaryFolder folder;
  const std::string out = folder.file("scene.rgs");
  std::vector<EncodeOptions> variants(10);
  variants[1].chunk_size = 32;
  variants[1].chunk_step_sets = false;
  variants[1].keep_permutation = true;
  variants[2].order = Order::input;
  variants[2].chunk_size = 65536;
  variants[2].sh_degree = 1;
  variants[3].max_bad_fraction = 1;
  variants[3].keep_permutation = true;
  variants[4].on_bad = BadPolicy::repair;
  for (const std::size_t v : {5U, 6U, 7U}) variants[v].profile = Profile::packed;
  variants[6].keep_permutation = true;
  variants[6].chunk_step_sets = false;
  variants[6].on_bad = BadPolicy::repair;
  variants[7].chunk_size = 4096;
  variants[7].level = 3;
  for (const std::size_t v : {8U, 9U}) variants[v].profile = Profile::archive;
  variants[8].keep_permutation = true;
  variants[8].on_bad = BadPolicy::repair;
  variants[9].max_bad_fraction = 1;
  variants[9].archive = archive_small();
  variants[7].max_bad_fraction = 1;
  for (const std::uint64_t n : {0U, 1U, 255U, 256U, 257U, kSanitized ? 17000U : 40000U}) {
    const SplatCloud sound = golden_cloud(n, 3, n + 1);
    for (std::size_t v = 0; v < variants.size(); ++v) {
      CAPTURE(n);
      CAPTURE(v);
      const std::string ply = write_scene(folder.file("scene.ply"), v < 3 || v == 5 ? sound : damaged(sound, 7));
      ConvertOptions options;
      options.encode = variants[v];
      const Bytes expected = expected_rgs(ply, variants[v]);
      options.encode.provenance = provenance_of({}, "scene.ply");
      options.encode.provenance->source_bytes = std::filesystem::file_size(ply);
      for (const std::size_t threads : {1U, 2U, 4U}) {
        CAPTURE(threads);
        REQUIRE(convert_in_process(ply, out, options, threads));
        CHECK(read_bytes(out) == expected);
      }
      CHECK(validate(FileView::open(expected).value()));
    }
  }
}

TEST_CASE("the program writes the bytes of encode() with its options") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(3000, 3, 5)), out = folder.file("out.rgs");
  struct Case {
    std::vector<std::string> arguments;
    EncodeOptions options;
  };
  std::vector<Case> cases;
  const auto add = [&cases](std::vector<std::string> arguments, const std::function<void(EncodeOptions&)>& set) {
    cases.push_back({std::move(arguments), {}});
    cases.back().options.profile = Profile::packed;  // the program's default
    set(cases.back().options);
  };
  add({}, [](auto&) {});
  add({"--threads", "1"}, [](auto&) {});
  add({"--threads", "4", "--profile", "direct"}, [](auto& o) { o.profile = Profile::direct; });
  add({"--profile", "packed", "--level", "5"}, [](auto& o) { o.level = 5; });
  add({"--profile", "archive"}, [](auto& o) { o.profile = Profile::archive; });
  add({"--profile", "archive:high", "--threads", "1"}, [](auto& o) { o.profile = Profile::archive; });
  add({"--profile", "archive:small"}, [](auto& o) {
    o.profile = Profile::archive;
    o.archive = archive_small();
  });
  add({"--profile", "archive:tiny"}, [](auto& o) {
    o.profile = Profile::archive;
    o.archive = archive_tiny();
  });
  add({"--archive-step", "0.5", "--profile", "archive:small"}, [](auto& o) {
    o.profile = Profile::archive;
    o.archive = {.step = 0.5F};
  });
  add({"--keep-order"}, [](auto& o) { o.order = Order::input; });
  add({"--keep-permutation"}, [](auto& o) { o.keep_permutation = true; });
  add({"--chunk-size", "96"}, [](auto& o) { o.chunk_size = 96; });
  add({"--file-scales"}, [](auto& o) { o.chunk_step_sets = false; });
  for (int degree = 0; degree <= 3; ++degree) {
    add({"--sh-degree", std::to_string(degree)}, [degree](auto& o) { o.sh_degree = degree; });
  }
  add({"--near", "0.5", "--far", "42"}, [](auto& o) { o.depth = DepthRange{0.5F, 42.F, DepthSource::by_hand}; });
  add({"--depth-map", "linear"}, [](auto& o) { o.depth_mapping = DepthMapping::linear; });
  add({"--axes", "gltf"}, [](auto& o) { o.axes = {Axis::left, Axis::up, Axis::forward}; });
  add({"--axes", "opengl"}, [](auto& o) { o.axes = {Axis::right, Axis::up, Axis::backward}; });
  add({"--axes", "left,backward,up"}, [](auto& o) { o.axes = {Axis::left, Axis::backward, Axis::up}; });
  add({"--axes", "undeclared"}, [](auto& o) { o.axes.fill(Axis::undeclared); });
  add({"--aa-mode", "mip-splatting"}, [](auto& o) { o.aa_mode = AaMode::mip_splatting; });
  add({"--colour-space", "linear"}, [](auto& o) { o.colour_space = ColourSpace::linear_display; });
  add({"--metres-per-unit", "2.5"}, [](auto& o) { o.metres_per_unit = 2.5F; });
  for (Case& c : cases) {
    CAPTURE(c.arguments);
    c.arguments.insert(c.arguments.end(), {"--quiet", "--overwrite", ply, out});
    const ProgramResult run = rgs_convert(c.arguments);
    CAPTURE(run.err);
    REQUIRE(run.exit_code == 0);
    CHECK(read_bytes(out) == expected_rgs(ply, c.options));
    CHECK(run.out + run.err == "");
  }
}

TEST_CASE("setting one end of the depth range keeps the other as found") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(500, 0, 5)), out = folder.file("out.rgs");
  const Bytes plain = expected_rgs(ply, {});
  REQUIRE(rgs_convert({"--near", "1.25", ply, out}).exit_code == 0);
  const Bytes bytes = read_bytes(out);
  const Declarations d = FileView::open(bytes).value().declarations(),
                     found = FileView::open(plain).value().declarations();
  CHECK(d.z_near == 1.25F);
  CHECK(d.z_far == found.z_far);
  CHECK(d.depth_source == DepthSource::by_hand);
  CHECK(found.depth_source == DepthSource::scene_extent);
}

TEST_CASE(".rgs to PLY to .rgs restores the same sections") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(5000, 2, 9)), one = folder.file("one.rgs"),
                    back = folder.file("back.ply"), two = folder.file("two.rgs");
  for (const std::string option : {"--keep-permutation", "--keep-order", "--file-scales"}) {
    CAPTURE(option);
    REQUIRE(rgs_convert({"--overwrite", option, ply, one}).exit_code == 0);
    REQUIRE(rgs_convert({"--overwrite", "--threads", "3", one, back}).exit_code == 0);
    REQUIRE(rgs_convert({"--overwrite", option, back, two}).exit_code == 0);
    const Bytes a = read_bytes(one), b = read_bytes(two);
    check_same_sections(a, b, {kAllButProvenance.begin() + 1, kAllButProvenance.end()});
    // The first view is chosen anew, from rounded values.
    const auto a_declared = FileView::open(a)->stored(SectionType::declarations).first(176);
    CHECK(std::ranges::equal(a_declared, FileView::open(b)->stored(SectionType::declarations).first(176)));
  }
}

TEST_CASE("a kept permutation restores the original order, without dropped Gaussians") {
  const TemporaryFolder folder;
  const SplatCloud cloud = damaged(golden_cloud(9000, 0, 3), 11);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), rgs = folder.file("scene.rgs"),
                    back = folder.file("back.ply");
  REQUIRE(rgs_convert({"--keep-permutation", "--on-bad", "drop", ply, rgs}).exit_code == 0);
  REQUIRE(rgs_convert({rgs, back}).exit_code == 0);
  std::vector<float> expected;
  for (const Splat& s : splats_of(cloud)) {
    if (find_defects(s, 0) == 0) expected.insert(expected.end(), s.mean, s.mean + 3);
  }
  CHECK(expected.size() == 3 * (9000 - 819));
  CHECK(read_ply(back).value().mean == expected);
}

TEST_CASE("equal means keep the source's order in a file, in every profile, with levels and merged") {
  const TemporaryFolder folder;
  SplatCloud cloud = golden_cloud(6000, 1, 3);
  for (float& x : cloud.mean) x = std::round(x);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), rgs = folder.file("scene.rgs");
  const std::vector<std::vector<std::string>> ways{{"--profile", "direct", ply},
                                                   {"--profile", "packed", ply},
                                                   {"--profile", "archive:high", ply},
                                                   {"--lod", "--profile", "packed", ply},
                                                   {"--lod", "--profile", "archive:high", ply},
                                                   {"--merge", ply, ply}};
  for (std::vector<std::string> arguments : ways) {
    CAPTURE(arguments);
    arguments.insert(arguments.begin(), {"--overwrite", "--keep-permutation"});
    arguments.push_back(rgs);
    REQUIRE(rgs_convert(arguments).exit_code == 0);
    Bytes bytes = read_bytes(rgs);
    if (arguments[2] == "--lod") {
      const auto paged = PagedFile::open(bytes);
      REQUIRE(paged);
      bytes = leaves_as_file(*paged).value();
    }
    const auto file = FileView::open(bytes);
    REQUIRE(file);
    std::map<std::array<float, 3>, std::uint64_t> last;  // position in the source of the last one at a mean, plus 1
    std::uint64_t n_shared = 0;
    for (std::uint64_t i = 0; i < file->header().n_gaussians; ++i) {
      const std::uint64_t at = file->source_index(i), in_cloud = at % cloud.size();
      std::uint64_t& before =
          last[{cloud.mean[3 * in_cloud], cloud.mean[3 * in_cloud + 1], cloud.mean[3 * in_cloud + 2]}];
      n_shared += before > 0;
      REQUIRE(before <= at);
      before = at + 1;
    }
    CHECK(n_shared > 500);
  }
}

TEST_CASE("an .rgs whose last values break a rule gives no PLY, whatever its profile and order") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(20'000, 1, 8)),
                    rgs = folder.file("scene.rgs"), back = folder.file("back.ply");
  for (const char* options : {"--profile=direct", "--profile=packed", "--profile=archive:high", "--keep-permutation"}) {
    CAPTURE(options);
    REQUIRE(rgs_convert({"--overwrite", options, ply, rgs}).exit_code == 0);
    Bytes bytes = read_bytes(rgs);
    put(bytes, section_of(bytes, "DECL") + 144, std::uint64_t{20'001});  // opacities of 1: known after the last row
    fix_hashes(bytes);
    write_text(rgs, {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
    const ProgramResult run = rgs_convert({rgs, back});
    CHECK(run.exit_code == 4);
    CHECK(holds(run.err, "byte " + std::to_string(section_of(bytes, "DECL") + 144) + ":"));
    CHECK_FALSE(std::filesystem::exists(back));
  }
}

TEST_CASE("ASCII and big-endian PLY give the sections of the binary file") {
  const TemporaryFolder folder;
  for (int degree = 0; degree <= 3; ++degree) {
    CAPTURE(degree);
    const SplatCloud cloud = golden_cloud(700, degree, 21);
    const std::string ply = write_scene(folder.file("scene.ply"), cloud);
    EncodeOptions options;
    options.profile = Profile::packed;
    const Bytes expected = expected_rgs(ply, options);
    for (const bool ascii : {false, true}) {
      CAPTURE(ascii);
      const std::string other = folder.file("other.ply"), out = folder.file("out.rgs");
      write_text(other, other_ply(cloud, ascii));
      REQUIRE(rgs_convert({"--overwrite", other, out}).exit_code == 0);
      check_same_sections(read_bytes(out), expected, kAllButProvenance);
    }
  }
}

TEST_CASE("pipes: standard input and output in both directions") {
  const TemporaryFolder folder;
  EncodeOptions packed;
  packed.profile = Profile::packed;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(20000, 3, 4)),
                    rgs = folder.file("piped.rgs"), back = folder.file("back.ply"), named = folder.file("named.ply");
  const std::string program = "'" + built("rgs-convert") + "' ";
  REQUIRE(run_shell("cat " + ply + " | " + program + "--quiet --to rgs - - | cat > " + rgs).exit_code == 0);
  CHECK(read_bytes(rgs) == expected_rgs(ply, packed, "stdin"));
  const ProgramResult run = run_shell("cat " + rgs + " | " + program + "--to ply - - > " + back);
  REQUIRE(run.exit_code == 0);
  CHECK(holds(run.err, "20,000 written"));  // the summary does not mix with the data
  REQUIRE(rgs_convert({rgs, named}).exit_code == 0);
  CHECK(read_bytes(back) == read_bytes(named));
  CHECK(run_shell(program + "- " + folder.file("empty.rgs") + " < /dev/null").exit_code == 4);
}

TEST_CASE("a reader that closes the pipe early leaves no temporary file behind") {
  const TemporaryFolder folder, scratch;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(20000, 3, 4));
  run_shell("TMPDIR=" + scratch.path().string() + " '" + built("rgs-convert") + "' --quiet --to rgs " + ply +
            " - | head -c 10");
  CHECK(entries(scratch.path()) == 0);
}

TEST_CASE("damaged Gaussians: each policy, its counts and its limit") {
  const TemporaryFolder folder;
  const std::string few = write_scene(folder.file("few.ply"), damaged(golden_cloud(1000, 3, 6), 125)),
                    many = write_scene(folder.file("many.ply"), damaged(golden_cloud(1000, 3, 6), 50));
  const auto convert = [&](const std::string& ply, std::vector<std::string> options) {
    std::filesystem::remove(folder.file("out.rgs"));
    options.insert(options.end(), {"--json", ply, folder.file("out.rgs")});
    return rgs_convert(options);
  };
  const auto written = [&] { return std::filesystem::exists(folder.file("out.rgs")); };

  ProgramResult run = convert(few, {});
  REQUIRE(run.exit_code == 0);
  nlohmann::json json = nlohmann::json::parse(run.out);
  CHECK(json["dropped"] == 8);
  CHECK(json["repaired"] == 0);
  for (const char* kind : {"mean", "rotation_nan", "rotation_zero", "sh"}) CHECK(json["damaged"][kind] == 2);
  CHECK(json["damaged"]["scale"] == 0);

  run = convert(many, {});
  CHECK(run.exit_code == 4);
  CHECK(holds(run.err, "too_many_bad"));
  CHECK(holds(run.err, "(expected 10, found 20)"));
  CHECK_FALSE(written());

  run = convert(many, {"--on-bad", "drop"});
  REQUIRE(run.exit_code == 0);
  CHECK(nlohmann::json::parse(run.out)["dropped"] == 20);

  run = convert(many, {"--on-bad", "repair"});
  REQUIRE(run.exit_code == 0);
  json = nlohmann::json::parse(run.out);
  CHECK(json["dropped"] == 5);
  CHECK(json["repaired"] == 15);
  CHECK(json["output"]["gaussians"] == 995);

  // Gaussians 0, 50, ... are damaged: move the first one so that the offset distinguishes rows from bytes.
  SplatCloud one = golden_cloud(1000, 3, 6);
  one.rotation[4 * 321 + 2] = std::numeric_limits<float>::infinity();
  const std::string ply = write_scene(folder.file("one.ply"), one);
  run = convert(ply, {"--on-bad", "refuse"});
  CHECK(run.exit_code == 4);
  CHECK(holds(run.err, "byte " + std::to_string(ply_header(1000, 3).size() + 321 * kPlyRow) + ": a damaged Gaussian"));
  CHECK_FALSE(written());
  CHECK(convert(write_scene(folder.file("sound.ply"), golden_cloud(10, 3, 6)), {"--on-bad", "refuse"}).exit_code == 0);
  CHECK(entries(folder.path()) == 5);  // four scenes, one output
}

TEST_CASE("--json matches the file, and the text summary goes to standard output") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(1000, 3, 8)), rgs = folder.file("out.rgs");
  ProgramResult run = rgs_convert({"--json", "--quiet", "--chunk-size", "128", "--sh-degree", "2", ply, rgs});
  REQUIRE(run.exit_code == 0);
  CHECK(run.err == "");
  nlohmann::json json = nlohmann::json::parse(run.out);
  const Bytes bytes = read_bytes(rgs);
  const FileView view = FileView::open(bytes).value();
  CHECK(json["schema"] == "rgs-convert/1");
  CHECK(json["source"]["name"] == "scene.ply");
  CHECK(json["source"]["format"] == "ply");
  CHECK(json["source"]["bytes"] == std::filesystem::file_size(ply));
  CHECK(json["source"]["gaussians"] == 1000);
  CHECK(json["source"]["sh_degree"] == 3);
  CHECK(json["output"]["format"] == "rgs");
  CHECK(json["output"]["bytes"] == bytes.size());
  CHECK(json["output"]["sh_degree"] == 2);
  REQUIRE(json["sections"].size() == view.sections().size());
  for (std::size_t i = 0; i < view.sections().size(); ++i) {
    CHECK(json["sections"][i]["stored_bytes"] == view.sections()[i].stored_bytes);
  }
  CHECK(json["chunks"]["size"] == 128);
  CHECK(json["chunks"]["count"] == 8);
  CHECK(json["chunks"]["scale_sets"] == 8);
  CHECK(json["scale"]["exponent"] == view.header().scale_exponent);
  const SplatCloud cloud = read_ply(ply).value();
  CHECK(json["scale"]["max"].get<double>() == doctest::Approx(std::exp(*std::ranges::max_element(cloud.log_scale))));
  CHECK(json["scale"]["zero"] == view.declarations().n_scale_zero);
  CHECK(json["opacity"]["one"] == view.declarations().n_opacity_one);
  CHECK(json["depth"]["far"].get<float>() == view.declarations().z_far);
  CHECK(json["depth"]["source"] == "scene extent");
  CHECK(json["seconds"]["total"].is_number());
  CHECK(json["seconds"]["sync"] == 0.0);

  run = rgs_convert({"--json", rgs, folder.file("back.ply")});
  REQUIRE(run.exit_code == 0);
  json = nlohmann::json::parse(run.out);
  CHECK(json["output"]["format"] == "ply");
  CHECK(json["output"]["bytes"] == std::filesystem::file_size(folder.file("back.ply")));
  CHECK(json.count("sections") == 0);

  run = rgs_convert({"--overwrite", ply, rgs});
  CHECK(run.exit_code == 0);
  CHECK(holds(run.out, "1,000 read, 1,000 written, 0 dropped"));
  CHECK(holds(run.err, "encode"));                                // progress
  CHECK(rgs_convert({"--quiet", "--json", ply, rgs}).out == "");  // exists: only an error
}

TEST_CASE("a depth range from cameras covers the means they see, in both JSON formats") {
  const TemporaryFolder folder;
  const SplatCloud cloud = golden_cloud(4000, 0, 12);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud);
  // At the origin along +z, and at (-15, 1, 2) along +x with y still down.
  write_text(folder.file("list.json"), R"([
    {"width": 640, "height": 480, "fx": 500, "fy": 520,
     "world_to_camera": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]},
    {"width": 640, "height": 480, "fx": 500, "fy": 520,
     "world_to_camera": [[0,0,-1,2],[0,1,0,-1],[1,0,0,15],[0,0,0,1]]}])");
  write_text(folder.file("cameras.json"), R"([
    {"id": 0, "img_name": "a", "width": 640, "height": 480, "fx": 500, "fy": 520, "position": [0,0,0],
     "rotation": [[1,0,0],[0,1,0],[0,0,1]]},
    {"id": 1, "img_name": "b", "width": 640, "height": 480, "fx": 500, "fy": 520, "position": [-15,1,2],
     "rotation": [[0,0,1],[0,1,0],[-1,0,0]]}])");
  std::vector<double> depths;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const double x = cloud.mean[3 * i], y = cloud.mean[3 * i + 1], z = cloud.mean[3 * i + 2];
    for (const auto& [right, down, depth] : {std::array{x, y, z}, std::array{2 - z, y - 1, x + 15}}) {
      if (depth > 0.2 && std::abs(500 * right / depth) < 320 && std::abs(520 * down / depth) < 240) {
        depths.push_back(depth);
      }
    }
  }
  std::ranges::sort(depths);
  REQUIRE(depths.size() > 1000);
  const double high = depths[(depths.size() - 1) * 999 / 1000];
  for (const char* cameras : {"list.json", "cameras.json"}) {
    CAPTURE(cameras);
    const std::string out = folder.file("out.rgs");
    REQUIRE(rgs_convert({"--overwrite", "--cameras", folder.file(cameras), ply, out}).exit_code == 0);
    const Bytes bytes = read_bytes(out);
    const Declarations d = FileView::open(bytes).value().declarations();
    CHECK(d.depth_source == DepthSource::cameras);
    CHECK(d.z_near == 0.2F);
    CHECK(d.depth_mapping == DepthMapping::logarithmic);
    CHECK(static_cast<double>(d.z_far) == doctest::Approx(1.1 * high).epsilon(1e-6));

    REQUIRE(rgs_convert({"--overwrite", "--far", "50", "--cameras", folder.file(cameras), ply, out}).exit_code == 0);
    const Bytes by_hand = read_bytes(out);
    CHECK(FileView::open(by_hand).value().declarations().z_near == d.z_near);
    CHECK(FileView::open(by_hand).value().declarations().z_far == 50.F);
    CHECK(FileView::open(by_hand).value().declarations().depth_source == DepthSource::by_hand);
  }
}

TEST_CASE("cameras that are damaged, missing or see nothing are refused without an output") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(100, 0, 12)), out = folder.file("out.rgs");
  const std::string cameras = folder.file("cameras.json");
  write_text(cameras, R"([{"width": 64, "height": 48, "fx": 50, "fy": 50,
                           "world_to_camera": [[1,0,0,0],[0,1,0,0],[0,0,1,-100],[0,0,0,1]]}])");
  const ProgramResult run = rgs_convert({"--cameras", cameras, ply, out});
  CHECK(run.exit_code == 2);
  CHECK(holds(run.err, "no camera sees any Gaussian"));
  write_text(cameras, "[{\"width\": 64,");
  CHECK(rgs_convert({"--cameras", cameras, ply, out}).exit_code == 4);
  CHECK(rgs_convert({"--cameras", folder.file("none.json"), ply, out}).exit_code == 3);
  CHECK(entries(folder.path()) == 2);
}

TEST_CASE("wrong command lines exit with 2 and write nothing") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(40, 1, 2)), rgs = folder.file("scene.rgs"),
                    out = folder.file("out.rgs");
  REQUIRE(rgs_convert({ply, rgs}).exit_code == 0);
  const std::vector<std::vector<std::string>> lines{{"--unknown", ply, out},
                                                    {ply},
                                                    {ply, out, "third"},
                                                    {"--merge", ply},
                                                    {ply, folder.file("nameless")},
                                                    {ply, "-"},
                                                    {"--json", "--to", "rgs", ply, "-"},
                                                    {"--to", "pt", ply, out},
                                                    {ply, folder.file("out.pt")},
                                                    {"--to-axes", "3dgs", ply, folder.file("out.spz")},
                                                    {"--to-axes", "up", ply, out},
                                                    {"--translate", "1,2", ply, out},
                                                    {"--translate", "1,2,x", ply, out},
                                                    {"--rotate", "0,0,0,0", ply, out},
                                                    {"--rotate", "nan,0,0", ply, out},
                                                    {"--scale", "0", ply, out},
                                                    {"--scale", "2", "--scale", "3", ply, out},
                                                    {"--crop", "0,0,0,1,1", ply, out},
                                                    {"--crop", "0,0,0,1,1,-1", ply, out},
                                                    {"--min-opacity", "1.5", ply, out},
                                                    {"--max-count", "-1", ply, out},
                                                    {"--merge", "-", "-", out},
                                                    {"--chunk-size", "33", ply, out},
                                                    {"--chunk-size", "0", ply, out},
                                                    {"--chunk-size", "131072", ply, out},
                                                    {"--sh-degree", "4", ply, out},
                                                    {"--near", "0", ply, out},
                                                    {"--near", "-1", ply, out},
                                                    {"--near", "nan", ply, out},
                                                    {"--near", "5", "--far", "2", ply, out},
                                                    {"--depth-map", "cubic", ply, out},
                                                    {"--axes", "up,down,left", ply, out},
                                                    {"--axes", "right,down", ply, out},
                                                    {"--axes", "right,down,forward,", ply, out},
                                                    {"--aa-mode", "best", ply, out},
                                                    {"--on-bad", "ignore", ply, out},
                                                    {"--metres-per-unit", "-1", ply, out},
                                                    {"--profile", "small", ply, out},
                                                    {"--level", "0", ply, out},
                                                    {"--level", "20", ply, out},
                                                    {"--threads", "0", ply, out},
                                                    {"--chunk-size", "64", rgs, folder.file("back.ply")}};
  for (const auto& line : lines) {
    CAPTURE(line);
    const ProgramResult run = rgs_convert(line);
    CHECK(run.exit_code == 2);
    CHECK(run.out == "");
    CHECK(run.err != "");
  }
  CHECK(entries(folder.path()) == 2);
  CHECK(rgs_convert({"--version"}).out == "rgs-convert " RGS_VERSION "\n");
  CHECK(holds(rgs_convert({"--help"}).out, "--keep-permutation"));
}

TEST_CASE("malformed inputs exit with 4, state the offset, and write nothing") {
  const TemporaryFolder folder;
  const std::string out = folder.file("out.rgs"), back = folder.file("back.ply"), bad = folder.file("bad");
  ProgramResult run = rgs_convert({source_dir() + "/tests/fuzz/corpus/ply/two_scales_2dgs", out});
  CHECK(run.exit_code == 4);
  CHECK(holds(run.err, "2DGS"));

  const std::string ply = binary_ply(splats_of(golden_cloud(300, 1, 2)), 1);
  write_text(bad, ply.substr(0, ply.size() - 1));
  run = rgs_convert({bad, out});
  CHECK(run.exit_code == 4);
  CHECK(holds(run.err, "truncated"));
  write_text(bad, "");
  CHECK(rgs_convert({bad, out}).exit_code == 4);

  const Bytes sound = encode(golden_cloud(300, 1, 2).view()).value();
  const std::string rgs(reinterpret_cast<const char*>(sound.data()), sound.size());
  write_text(bad, rgs.substr(0, rgs.size() / 2));
  run = rgs_convert({bad, back});
  CHECK(run.exit_code == 4);
  CHECK(holds(run.err, "byte "));
  CHECK(holds(run.err, "[truncated]"));

  std::string flipped = rgs;
  const std::uint64_t means = section_of(sound, "MEAN");
  flipped[means + 5] = static_cast<char>(flipped[means + 5] ^ 1);
  write_text(bad, flipped);
  run = rgs_convert({bad, back});
  CHECK(run.exit_code == 4);
  CHECK(holds(run.err, "[checksum_mismatch]"));
  CHECK(holds(run.err, "byte "));
  CHECK(entries(folder.path()) == 1);
}

TEST_CASE("means are freed once Gaussians are in order") {
  if (!counts_live_memory()) return skip("the sanitizer replaces the allocator and counts nothing");
  const TemporaryFolder folder;
  constexpr std::int64_t kN = 400'000;
  const auto ply = PlyFile::open(write_scene(folder.file("a.ply"), golden_cloud(kN, 0, 1)));
  REQUIRE(ply);
  ConvertOptions options;
  options.output.sync = false;
  std::int64_t before = 0, after = -1;
  StageObserver observer;
  observer.begin = [&](const char* stage, std::uint64_t, const char*) {
    if (std::string(stage) == "scan") before = live_bytes();
    if (std::string(stage) == "encode") after = live_bytes();
  };
  REQUIRE(convert_to_rgs(*ply, folder.file("a.rgs"), options, observer));
  REQUIRE(after > 0);
  CHECK(after - before < 12 * kN);  // 4 bytes each for the order; a mean takes 12 more
}
