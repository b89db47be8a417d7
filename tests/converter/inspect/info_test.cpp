// info_test.cpp - runs rgs-info on generated files.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cstring>
#include <fstream>
#include <nlohmann/json.hpp>
#include <random>

#include "build_levels.hpp"
#include "edit_file.hpp"
#include "golden_files.hpp"
#include "golden_levels.hpp"
#include "rgs/rgs.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using test::ProgramResult;
using test::run_shell;

namespace {

class Fixture {
 public:
  // `after` may redirect standard output.
  ProgramResult run(const std::string& arguments, const std::string& after = "") {
    return run_shell("'" + test::built("rgs-info") + "' " + arguments + " " + after);
  }

  std::string write(const std::vector<std::byte>& bytes, const std::string& name = "scene.rgs") {
    const std::string path = folder_.file(name);
    std::ofstream(path, std::ios::binary)
        .write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
    return path;
  }

  nlohmann::json json(const std::string& arguments, int code = 0) {
    const ProgramResult r = run(arguments + " --json");
    CHECK(r.exit_code == code);
    CHECK(std::ranges::all_of(r.out, [](char c) { return c == '\n' || (c >= ' ' && c <= '~'); }));
    nlohmann::json j = nlohmann::json::parse(r.out, nullptr, false);
    REQUIRE_FALSE(j.is_discarded());
    CHECK(j["schema"] == "rgs-info/1");
    return j;
  }

 private:
  test::TemporaryFolder folder_;
};

SplatCloud cloud(std::uint64_t n, int degree) {
  std::mt19937 random(7);
  std::normal_distribution<float> normal;
  SplatCloud c;
  c.resize(n, degree);
  for (float& x : c.mean) x = normal(random);
  for (float& x : c.log_scale) x = -4 + normal(random);
  for (float& x : c.rotation) x = normal(random);
  for (float& x : c.opacity_logit) x = 2 * normal(random);
  for (float& x : c.sh) x = 0.3f * normal(random);
  return c;
}

std::vector<std::byte> encoded(std::uint64_t n, int degree, const EncodeOptions& options = {}) {
  return encode(cloud(n, degree).view(), options).value();
}

bool has(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

void flip(std::vector<std::byte>& bytes, std::uint64_t at) {
  bytes[at] ^= std::byte{1};
}

// A file whose levels are built, not just every fourth Gaussian, in small pages.
std::vector<std::byte> with_levels(Profile profile, lod::Quality quality = lod::Quality::fast) {
  EncodeOptions options;
  options.profile = profile;
  options.chunk_size = 32;
  SplatCloud leaves = cloud(3000, 1);
  for (float& x : leaves.log_scale) x += 1;  // neighbours overlap
  const auto scan = encode(leaves.view(), options);
  REQUIRE(scan);
  const auto ordered = decode(*scan);
  REQUIRE(ordered);
  const lod::Levels levels =
      lod::build_levels(ordered->view(), {.quality = quality, .chunk_size = 32, .page_chunks = 6});
  std::vector<std::byte> bytes;
  const auto written = write_levels(levels, options, bytes, 1);
  REQUIRE(written);
  return bytes;
}

// Multiplies the errors of all pages; hashes are right again.
std::vector<std::byte> with_errors_times(std::vector<std::byte> bytes, float factor) {
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const std::uint64_t records = file->head().find(SectionType::levels)->offset + 64;
  const std::uint32_t n = file->n_pages();
  for (std::uint64_t i = 0; i < n; ++i) {
    const std::uint64_t at = records + 112 * i + 36;
    test::put(std::span(bytes), at, factor * test::get<float>(std::span(bytes), at));
  }
  test::fix_hashes(bytes);
  return bytes;
}

}  // namespace

TEST_CASE_FIXTURE(Fixture, "the text states the file's contents and declarations") {
  EncodeOptions options;
  options.chunk_size = 64;
  options.depth = DepthRange{0.25f, 80.f, DepthSource::cameras};
  options.depth_mapping = DepthMapping::logarithmic;
  options.aa_mode = AaMode::mip_splatting;
  options.axes = {Axis::right, Axis::up, Axis::forward};
  options.provenance = Provenance{1234567, 0xabcdef, "garden.ply", "maker 1.2"};
  const auto bytes = encoded(1000, 3, options);
  const ProgramResult r = run(write(bytes));
  CHECK(r.exit_code == 0);
  CHECK(r.err == "");
  for (const char* part :
       {"1,000 Gaussians, SH degree 3", "as PLY 248.0 kB (248 a Gaussian)", "16 of 64 (the last 40), Morton order",
        "\"garden.ply\", 1,234,567 bytes, xxh3 0000000000abcdef", "\"maker 1.2\"",
        "x right, y up, z forward (left-handed)", "0.25 .. 80, logarithmic, from cameras", "Mip-Splatting",
        "alpha 1/255 to 0.99", "SH steps, 16 sets", "box diagonal", "values, 1,000", "█"}) {
    CAPTURE(part);
    CHECK(has(r.out, part));
  }
  for (const char* type : {"DECL", "SHSC", "CHNK", "MEAN", "GEOM", "SHI8", "PROV"}) CHECK(has(r.out, type));
  CHECK_FALSE(has(r.out, "PERM"));

  const ProgramResult ascii = run(write(bytes) + " --ascii");
  CHECK(std::ranges::all_of(ascii.out, [](char c) { return c > 0; }));
  const ProgramResult brief = run(write(bytes) + " --no-stats");
  CHECK(has(brief.out, "values not read"));
  CHECK_FALSE(has(brief.out, "entropy"));
}

TEST_CASE_FIXTURE(Fixture, "an origin is stated if there is one") {
  EncodeOptions options;
  options.origin = {4201984.125, -1.7e5, 0.5};
  const std::string far = write(encoded(100, 0, options)), home = write(encoded(100, 0), "home.rgs");
  const ProgramResult r = run(far);
  CHECK(has(r.out, "RoofGS 1.3"));
  CHECK(has(r.out, "x 4201984.125, y -170000, z 0.5; means are relative to it"));
  CHECK(json(far)["declarations"]["origin"] == options.origin);
  CHECK_FALSE(has(run(home).out, "origin"));
  CHECK(json(home)["declarations"]["origin"] == kNoOrigin);
}

TEST_CASE_FIXTURE(Fixture, "the JSON matches the file in every degree, with one step set and with many") {
  for (int degree = 0; degree <= 3; ++degree) {
    CAPTURE(degree);
    EncodeOptions options;
    options.chunk_size = 32;
    options.chunk_step_sets = degree % 2 == 0;
    options.keep_permutation = true;
    options.profile = degree >= 2 ? Profile::packed : Profile::direct;
    const auto bytes = encoded(777, degree, options);
    const FileView view = FileView::open(bytes).value();
    const auto j = json(write(bytes));
    CHECK(j["file"]["bytes"] == bytes.size());
    CHECK(j["header"]["n_gaussians"] == 777);
    CHECK(j["header"]["sh_degree"] == degree);
    CHECK(j["header"]["n_scale_sets"] == view.header().n_step_sets);
    CHECK(j["header"]["scale_exponent"] == view.header().scale_exponent);
    CHECK(j["declarations"]["handedness"] == "right");
    CHECK(j["declarations"]["depth"]["source"] == "scene_extent");
    CHECK(j["declarations"]["depth"]["far"].get<float>() == view.declarations().z_far);
    CHECK(j["provenance"].is_null());
    CHECK_FALSE(j.contains("verified"));
    CHECK_FALSE(j.contains("error"));

    REQUIRE(j["sections"].size() == view.sections().size());
    double share = 0;
    for (std::size_t i = 0; i < view.sections().size(); ++i) {
      const SectionEntry& s = view.sections()[i];
      CHECK(j["sections"][i]["offset"] == s.offset);
      CHECK(j["sections"][i]["stored_bytes"] == s.stored_bytes);
      CHECK(std::stoull(j["sections"][i]["xxh3"].get<std::string>(), nullptr, 16) == s.xxh3);
      share += j["sections"][i]["share"].get<double>();
    }
    CHECK(share < 1);

    // The same figures, computed directly.
    std::vector<ActivatedSplat> splats(777);
    REQUIRE(view.read(0, std::span(splats)));
    std::vector<float> opacities, scales, dc_red;
    for (const ActivatedSplat& s : splats) {
      opacities.push_back(s.opacity);
      scales.insert(scales.end(), s.scale, s.scale + 3);
      dc_red.push_back(s.sh[0]);
    }
    std::ranges::sort(opacities);
    std::ranges::sort(scales);
    const auto& v = j["values"];
    CHECK(v["opacity"]["min"].get<float>() == opacities.front());
    CHECK(v["opacity"]["median"].get<float>() == opacities[388]);
    CHECK(v["opacity"]["max"].get<float>() == opacities.back());
    CHECK(v["scale"]["n"] == 3 * 777);
    CHECK(v["scale"]["median"].get<float>() == scales[1165]);
    CHECK(v["scale"]["max"].get<float>() == scales.back());
    REQUIRE(v["sh"].size() == static_cast<std::size_t>(degree + 1));
    CHECK(v["sh"][0]["min"][0].get<float>() == std::ranges::min(dc_red));
    CHECK(v["sh"][0]["max"][0].get<float>() == std::ranges::max(dc_red));
    for (const auto& histogram : {v["opacity"]["histogram"], v["scale"]["histogram"]}) {
      std::uint64_t sum = 0;
      for (const auto& bin : histogram["bins"]) sum += bin.get<std::uint64_t>();
      CHECK(sum == (histogram["axis"] == "linear" ? 777 : 3 * 777));
    }

    std::vector<float> radii, steps;
    for (std::uint64_t i = 0; i < view.header().n_chunks; ++i) radii.push_back(view.chunk(i)->radius);
    for (std::uint64_t i = 0; i < view.header().n_step_sets; ++i) steps.push_back(view.step_set(i)->step[degree][2]);
    std::ranges::sort(radii);
    std::ranges::sort(steps);
    CHECK(j["chunks"]["radius"]["median"].get<float>() == radii[(radii.size() - 1) / 2]);
    CHECK(j["chunks"]["radius"]["max"].get<float>() == radii.back());
    const auto& spread = j["sh_steps"][static_cast<std::size_t>(degree)][2];
    CHECK(spread["min"].get<float>() == steps.front());
    CHECK(spread["median"].get<float>() == steps[(steps.size() - 1) / 2]);
    CHECK(spread["max"].get<float>() == steps.back());
  }
}

TEST_CASE_FIXTURE(Fixture, "a packed file: its profile, frames and one chunk, also beside a damaged frame") {
  EncodeOptions options;
  options.chunk_size = 64;
  options.profile = Profile::packed;
  auto bytes = encoded(20000, 1, options);
  const FileView view = FileView::open(bytes).value();
  const std::string path = write(bytes);
  const ProgramResult text = run(path + " --verify");
  CHECK(text.exit_code == 0);
  CHECK(has(text.out, "packed, 2 frames of 16,384"));
  CHECK(has(text.out, "planes"));
  const auto j = json(path + " --chunk 300");
  const FrameTable& frames = view.frames(SectionType::geometry);
  CHECK(j["chunk"]["first"] == 300 * 64);
  CHECK(j["chunk"]["stored"]["GEOM"]["frame"] == 1);
  CHECK(j["chunk"]["stored"]["GEOM"]["offset"] == frames.frames[1].offset);
  CHECK(j["chunk"]["stored"]["GEOM"]["bytes"] == frames.frames[1].stored_bytes);
  CHECK(j["values"]["opacity"]["max"].get<float>() == view.chunk(300)->max_opacity);
  for (const auto& section : j["sections"]) {
    if (section["type"] == "GEOM") CHECK(section["frames"]["n"] == 2);
    if (section["type"] == "DECL") CHECK_FALSE(section.contains("frames"));
  }
  bytes[frames.frames[0].offset + 20] ^= std::byte{1};
  const std::string damaged = write(bytes);
  CHECK(run(damaged + " --chunk 300").exit_code == 0);
  const ProgramResult other = run(damaged + " --chunk 3");
  CHECK(other.exit_code == 4);
  CHECK(has(other.err, std::to_string(frames.frames[0].offset)));
}

TEST_CASE_FIXTURE(Fixture, "an archive: its preset, steps and bounds") {
  EncodeOptions options;
  options.profile = Profile::archive;
  for (const auto& [archive, name] : {std::pair(archive_high(), "archive:high"),
                                      {archive_small(), "archive:small"},
                                      {archive_tiny(), "archive:tiny"},
                                      {ArchiveOptions{.step = 0.77F}, "archive"}}) {
    const std::string preset = name;
    CAPTURE(preset);
    options.archive = archive;
    const auto bytes = encoded(3000, 2, options);
    const std::string path = write(bytes);
    const ProgramResult text = run(path + " --verify");
    CHECK(text.exit_code == 0);
    CHECK(has(text.out, " " + preset + ", 1 frames"));
    CHECK(has(text.out, "0.77; fall with importance") == (archive.step == 0.77F));
    const ArchiveParameters p = *FileView::open(bytes).value().archive();
    CHECK(has(text.out, std::to_string(p.opacity_levels) + " levels"));
    const auto j = json(path)["archive"];
    CHECK(j["profile"] == preset);
    CHECK(j["codec"] == 3);
    CHECK(j["step"].get<float>() == archive.step);
    CHECK(j["opacity_levels"] == p.opacity_levels);
    CHECK(j["bound_opacity"].get<float>() == p.bound_opacity);
    REQUIRE(j["classes"].size() == p.classes.size());
    CHECK(j["classes"][8]["bound_mean"].get<float>() == p.classes[8].bound_mean);
    CHECK(j["classes"][8]["bound_covariance"].get<float>() == p.classes[8].bound_covariance);
    CHECK(j["classes"][3]["bound_sh"].get<float>() == p.classes[3].bound_sh);
    CHECK_FALSE(j["classes"][3].contains("rotation_step"));
  }
}

TEST_CASE_FIXTURE(Fixture, "an archive of version 1.2: its steps and bounds") {
  const auto bytes = test::golden_file("archive_degree3");
  const std::string path = write(bytes);
  const ProgramResult text = run(path + " --verify");
  CHECK(text.exit_code == 0);
  CHECK(has(text.out, " archive, 1 frames"));
  CHECK(has(text.out, "50 levels"));
  CHECK(has(text.out, "rotation, degrees"));
  const ArchiveParameters p = *FileView::open(bytes).value().archive();
  const auto j = json(path)["archive"];
  CHECK(j["profile"] == "archive");
  CHECK(j["codec"] == 2);
  CHECK(j["opacity_levels"] == 50);
  CHECK(j["bound_mean"].get<float>() == p.bound_mean);
  REQUIRE(j["classes"].size() == p.classes.size());
  CHECK(j["classes"][3]["bound_rotation"].get<float>() == p.classes[3].bound_rotation);
  CHECK_FALSE(j["classes"][3].contains("bound_covariance"));
}

TEST_CASE_FIXTURE(Fixture, "one chunk") {
  EncodeOptions options;
  options.chunk_size = 64;
  const auto bytes = encoded(100, 1, options);
  const FileView view = FileView::open(bytes).value();
  const std::string path = write(bytes);
  const auto j = json(path + " --chunk 1");
  CHECK(j["chunk"]["first"] == 64);
  CHECK(j["chunk"]["n"] == 36);
  CHECK(j["chunk"]["radius"].get<float>() == view.chunk(1)->radius);
  CHECK(j["chunk"]["stored"]["GEOM"]["offset"] == view.find(SectionType::geometry)->offset + 64 * 16);
  CHECK(j["chunk"]["stored"]["GEOM"]["bytes"] == 36 * 16);
  CHECK(j["values"]["first"] == 64);
  CHECK(j["values"]["opacity"]["n"] == 36);
  CHECK(j["values"]["opacity"]["max"].get<float>() == view.chunk(1)->max_opacity);
  CHECK_FALSE(j.contains("chunks"));
  const ProgramResult text = run(path + " --chunk 1");
  CHECK(text.exit_code == 0);
  CHECK(has(text.out, "chunk 1 of 2"));
  CHECK(has(text.out, "36 from 64 on"));
  const ProgramResult absent = run(path + " --chunk 2");
  CHECK(absent.exit_code == 2);
  CHECK(absent.out == "");
  CHECK(has(absent.err, "no such chunk"));
}

TEST_CASE_FIXTURE(Fixture, "--verify accepts a good file and names offset and section of damage") {
  auto bytes = encoded(500, 2);
  const ProgramResult good = run(write(bytes) + " --verify");
  CHECK(good.exit_code == 0);
  CHECK(has(good.out, "verified"));
  CHECK(json(write(bytes) + " --verify")["verified"] == true);

  const SectionEntry geometry = *FileView::open(bytes).value().find(SectionType::geometry);
  flip(bytes, geometry.offset + 100);
  const std::string path = write(bytes);
  CHECK(run(path).exit_code == 0);  // the payload's checksums are checked only on request
  const ProgramResult damaged = run(path + " --verify");
  CHECK(damaged.exit_code == 4);
  CHECK(has(damaged.err, "byte " + std::to_string(geometry.offset) + ":"));
  CHECK(has(damaged.err, "[checksum_mismatch]"));
  CHECK(has(damaged.out, "DAMAGED"));
  CHECK(has(damaged.out, "OK"));
  CHECK_FALSE(has(damaged.out, "verified"));
  const auto j = json(path + " --verify", 4);
  CHECK(j["verified"] == false);
  CHECK(j["error"]["code"] == "checksum_mismatch");
  CHECK(j["error"]["offset"] == geometry.offset);
  CHECK(j["error"]["exit_code"] == 4);
  for (const auto& s : j["sections"]) CHECK((s["xxh3"] == s["xxh3_found"]) == (s["type"] != "GEOM"));
}

TEST_CASE_FIXTURE(Fixture, "--verify also checks values under valid checksums") {
  auto bytes = encoded(50, 0);
  const FileView view = FileView::open(bytes).value();
  const std::uint64_t at = view.find(SectionType::geometry)->offset + 14;  // opacity of the first Gaussian
  std::size_t entry = 0;
  while (view.sections()[entry].type != static_cast<std::uint32_t>(SectionType::geometry)) ++entry;
  bytes[at + 1] = std::byte{0x40};  // 2.0
  const auto put = [&bytes](std::uint64_t where, std::uint64_t value) {
    for (int i = 0; i < 8; ++i) bytes[where + static_cast<std::uint64_t>(i)] = static_cast<std::byte>(value >> (8 * i));
  };
  const std::uint64_t table_end = kHeaderBytes + view.sections().size() * kSectionEntryBytes;
  put(kHeaderBytes + entry * kSectionEntryBytes + 40, xxh3(view.stored(SectionType::geometry)));
  put(table_end, xxh3(std::span(bytes).first(table_end)));
  const ProgramResult r = run(write(bytes) + " --verify");
  CHECK(r.exit_code == 4);
  CHECK(has(r.err, "byte " + std::to_string(at) + ":"));
  CHECK(has(r.out, "1 stored numbers are not legal"));
}

TEST_CASE_FIXTURE(Fixture, "with a damaged table the readable part is printed, then the error") {
  auto bytes = encoded(500, 1);
  const std::uint64_t chunks = FileView::open(bytes).value().find(SectionType::chunks)->offset;
  bytes[chunks + 44] = std::byte{1};
  const ProgramResult r = run(write(bytes));
  CHECK(r.exit_code == 4);
  CHECK(has(r.out, "CHNK"));
  CHECK(has(r.err, "byte " + std::to_string(chunks + 44) + ":"));
}

TEST_CASE_FIXTURE(Fixture, "of an unknown section only certain facts are stated") {
  EncodeOptions options;
  options.keep_permutation = true;
  auto bytes = encoded(500, 0, options);
  const std::uint64_t entry = test::entry_of(bytes, "PERM");
  std::memcpy(bytes.data() + entry, "ZZZZ", 4);
  for (const std::uint32_t codec : {1u, 2u, 7u}) {
    test::put(bytes, entry + 8, codec);
    test::put(bytes, entry + 32, ~std::uint64_t{0});  // decoded bytes
    test::fix_hashes(bytes);
    const std::string path = write(bytes), name = "codec " + std::to_string(codec);
    const ProgramResult r = run(path + " --verify");
    CHECK(r.exit_code == 0);
    const std::string line = r.out.substr(r.out.find("ZZZZ"), 140);
    CHECK(has(line, "unknown, skipped"));
    CHECK(has(line, " ? "));
    CHECK(has(line, name));
    const std::string total = r.out.substr(r.out.find("  total "), 100), size = std::to_string(bytes.size());
    const std::string grouped = size.substr(0, size.size() - 3) + "," + size.substr(size.size() - 3);
    CHECK(total.find(grouped) != total.rfind(grouped));  // stored, and decoded: equal here
    CHECK(json(path)["sections"][6]["codec"] == name);
    CHECK(json(path)["sections"][6]["known"] == false);
  }
}

TEST_CASE_FIXTURE(Fixture, "an empty scene") {
  const std::string path = write(encoded(0, 3));
  const ProgramResult r = run(path + " --verify --stats");
  CHECK(r.exit_code == 0);
  CHECK(has(r.out, " 0 Gaussians"));
  CHECK_FALSE(has(r.out, "nan"));
  CHECK_FALSE(has(r.out, "inf"));
  CHECK(json(path)["values"]["n"] == 0);
  CHECK(run(path + " --chunk 0").exit_code == 2);
}

TEST_CASE_FIXTURE(Fixture, "texts from the file cannot control the terminal") {
  EncodeOptions options;
  options.provenance =
      Provenance{1, 2, "a\x1b[31m\n\r\x7f\\b\xc2\x9b\xe2\x80\xae\xff\xc3\xa9\"", std::string(3000, 'x')};
  const std::string path = write(encoded(10, 0, options));
  const ProgramResult r = run(path);
  CHECK(r.exit_code == 0);
  CHECK(has(r.out, "\"a\\u{1b}[31m\\u{a}\\u{d}\\u{7f}\\\\b\\u{9b}\\u{202e}\\xff\xc3\xa9\"\""));
  CHECK(has(r.out, "xxx...\""));
  CHECK_FALSE(has(r.out, std::string(300, 'x')));
  CHECK(has(run(path + " --ascii").out, "\\xff\\u{e9}\""));
  CHECK(json(path)["provenance"]["tool"] == std::string(3000, 'x'));
}

TEST_CASE_FIXTURE(Fixture, "exit codes") {
  const std::string path = write(encoded(10, 0));
  CHECK(run("--help").exit_code == 0);
  CHECK(has(run("--version").out, "rgs-info "));
  for (const std::string& arguments :
       {std::string(), path + " --unknown", path + " --chunk x", path + " --chunk -1", path + " --stats --no-stats"}) {
    CAPTURE(arguments);
    const ProgramResult r = run(arguments);
    CHECK(r.exit_code == 2);
    CHECK(r.out == "");
    CHECK(has(r.err, "--help"));
  }
  CHECK(run(path + ".missing").exit_code == 3);
  CHECK(json(path + ".missing", 3)["error"]["code"] == "open_failed");
  CHECK(run("/").exit_code == 3);
  const ProgramResult junk = run(write(std::vector<std::byte>(5000, std::byte{'j'}), "junk.rgs"));
  CHECK(junk.exit_code == 4);
  CHECK(has(junk.err, "[bad_magic]"));
  CHECK(run(write({}, "nothing.rgs")).exit_code == 4);
}

TEST_CASE_FIXTURE(Fixture, "a closed or full standard output is reported") {
  const std::string path = write(encoded(10, 0));
  // The pipe has no reader by the time the program writes; its exit code goes past the pipe.
  const ProgramResult closed =
      run_shell("{ ( sleep 0.1; '" + test::built("rgs-info") + "' '" + path + "'; echo $? >&3 ) | true; } 3>&1");
  CHECK(closed.out == "0\n");
  CHECK(run(path, ">/dev/full").exit_code == 3);
}

TEST_CASE("levels of detail are listed, page by page on request") {
  Fixture f;
  for (const test::GoldenLevels& scene : test::all_golden_levels()) {
    CAPTURE(scene.name);
    const std::vector<std::byte> bytes = test::file_of(scene);
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    const std::string path = f.write(bytes);
    const nlohmann::json j = f.json(path + " --verify");
    CHECK(j["verified"] == true);
    CHECK(j["header"]["n_gaussians"] == scene.leaves.size());
    const nlohmann::json& levels = j["levels"];
    CHECK(levels["n_levels"] == file->n_levels());
    CHECK(levels["n_pages"] == file->n_pages());
    CHECK(levels["pages_present"] == file->n_pages());
    CHECK(levels["complete"] == true);
    CHECK(levels["n_gaussians"] == file->n_stored());
    CHECK((levels["quality_db"].is_null() || levels["quality_db"] == 40.0));
    REQUIRE(levels["levels"].size() == file->n_levels());
    std::uint64_t n = 0, stored = 0;
    for (const auto& level : levels["levels"]) {
      n += level["gaussians"].get<std::uint64_t>();
      stored += level["stored_bytes"].get<std::uint64_t>();
    }
    CHECK(n == file->n_stored());
    CHECK(stored <= file->head().find(SectionType::pages)->stored_bytes);
    // Values refer to the leaves.
    CHECK(j["values"]["n"] == scene.leaves.size());
    const ProgramResult text = f.run(path + " --verify --ascii");
    CHECK(text.exit_code == 0);
    CHECK(has(text.out, "verified: every checksum and every value"));
    CHECK(has(text.out, "0, finest"));
    for (std::uint32_t i = 0; i < file->n_pages(); ++i) {
      const nlohmann::json page = f.json(path + " --page " + std::to_string(i))["page"];
      CHECK(page["level"] == file->pages()[i].level);
      CHECK(page["n"] == file->pages()[i].count);
      CHECK(page["offset"] == file->stored(i).offset);
      for (std::size_t k = 0; k < 3; ++k) {
        CHECK(page["core"]["min"][k].get<float>() == file->pages()[i].core.min[k]);
        CHECK(page["core"]["max"][k].get<float>() == file->pages()[i].core.max[k]);
      }
      CHECK(page["parent"].is_null() == (i == 0));
      CHECK(f.run(path + " --page " + std::to_string(i)).exit_code == 0);
    }
    CHECK(f.run(path + " --page " + std::to_string(file->n_pages())).exit_code == 2);
    const nlohmann::json chunk = f.json(path + " --chunk 1")["chunk"];
    CHECK(chunk["first"] == 32);
    CHECK(chunk["stored"]["PAGE"]["page"] == lod::pages_of_level(file->pages(), 0)[0]);
    CHECK(f.run(path + " --chunk 1").exit_code == 0);
    // --no-stats omits values, but not requested parts.
    CHECK(f.json(path + " --chunk 1 --no-stats")["chunk"]["first"] == 32);
  }
  CHECK(f.run(f.write(encoded(10, 0)) + " --page 0").exit_code == 2);
}

TEST_CASE("a missing end of a file with levels is a warning with its own exit code, damage is not") {
  Fixture f;
  const test::GoldenLevels scene = test::golden_levels("", Profile::packed, 300, 1, 60);
  std::vector<std::byte> bytes = test::encode_levels(scene);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  std::vector<std::byte> part(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(file->stored(4).offset));
  for (const char* options : {"", " --verify", " --no-stats", " --stats"}) {
    CAPTURE(options);
    const ProgramResult r = f.run(f.write(part) + options);
    CHECK(r.exit_code == 6);
    CHECK(has(r.err, "the end of the file is missing"));
    CHECK(has(r.out, "levels"));
    CHECK_FALSE(has(r.out, "DAMAGED"));
  }
  const nlohmann::json j = f.json(f.write(part) + " --verify", 6);
  CHECK(j["levels"]["complete"] == false);
  CHECK(j["levels"]["pages_present"] == 4);
  CHECK(j["error"]["code"] == "pages_missing");
  CHECK(j["error"]["exit_code"] == 6);
  CHECK(j["error"]["offset"] == part.size());
  CHECK(f.run(f.write(part) + " --page 0").exit_code == 6);
  // The present part is checked nevertheless.
  part[file->stored(2).offset + 30] ^= std::byte{1};
  const nlohmann::json damaged = f.json(f.write(part) + " --verify", 4);
  CHECK(damaged["error"]["code"] == "checksum_mismatch");
  CHECK(damaged["error"]["offset"] == file->stored(2).offset);
  bytes[file->stored(5).offset + 30] ^= std::byte{1};
  const nlohmann::json whole = f.json(f.write(bytes) + " --verify", 4);
  CHECK(whole["error"]["offset"] == file->stored(5).offset);
  // Not even the root.
  part.resize(file->stored(0).offset + 10);
  CHECK(f.run(f.write(part)).exit_code == 4);
}

TEST_CASE("pages are compared with their children on request, and false errors refused") {
  Fixture f;
  for (const Profile profile : {Profile::packed, Profile::direct, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    const std::vector<std::byte> bytes = with_levels(profile);
    const std::string path = f.write(bytes);
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    const auto n_inner = static_cast<std::uint32_t>(
        std::ranges::count_if(file->pages(), [](const lod::Page& page) { return page.n_children != 0; }));
    REQUIRE(n_inner > 3);

    // As built, nothing is refuted.
    const nlohmann::json all = f.json(path + " --verify --levels 100%");
    CHECK(all["verified"] == true);
    CHECK(all["levels"]["check"]["share"] == 1);
    CHECK(all["levels"]["check"]["pages"] == n_inner);
    CHECK(all["levels"]["check"]["pages_checked"] == n_inner);
    CHECK(all["levels"]["check"]["refuted"].empty());
    CHECK(f.json(path + " --verify --levels 10%")["levels"]["check"]["pages_checked"] == (n_inner + 9) / 10);
    CHECK(f.json(path + " --verify --levels 0.001")["levels"]["check"]["pages_checked"] == 1);
    CHECK_FALSE(f.json(path + " --verify")["levels"].contains("check"));
    CHECK(has(f.run(path + " --verify --levels 100% --ascii").out, "pages above the leaves compared with"));

    // Every page is caught, so any share is enough.
    const std::string lie = f.write(with_errors_times(bytes, 1e-6F), "lie.rgs");
    CHECK(f.json(lie + " --verify")["verified"] == true);
    const nlohmann::json refused = f.json(lie + " --verify --levels 100%", 4);
    CHECK(refused["verified"] == false);
    CHECK(refused["error"]["code"] == "bad_value");
    CHECK(refused["levels"]["check"]["refuted"].size() == n_inner);
    const std::uint64_t records = file->head().find(SectionType::levels)->offset + 64;
    for (const auto& page : refused["levels"]["check"]["refuted"]) {
      const auto i = page["page"].get<std::uint32_t>();
      CHECK(page["level"] == file->pages()[i].level);
      CHECK(page["offset"] == records + 112 * i);
      CHECK(page["error"].get<float>() == 1e-6F * file->pages()[i].error);
      CHECK(page["measured_error"].get<float>() > 0.05F * file->pages()[i].error);
    }
    CHECK(refused["error"]["offset"] == refused["levels"]["check"]["refuted"][0]["offset"]);
    const ProgramResult text = f.run(lie + " --verify --levels 10% --ascii");
    CHECK(text.exit_code == 4);
    CHECK(has(text.err, "the error stated for a page is smaller than"));
    CHECK(has(text.out, "REFUTED"));
    CHECK_FALSE(has(text.out, "verified: every"));
    CHECK(f.run(lie + " --verify --levels 10% --ascii").out == text.out);  // the same pages
    if (profile == Profile::archive) continue;  // its losses hide less than a factor of 1,000
    const std::string small = f.write(with_errors_times(bytes, 0.01F), "small.rgs");
    CHECK(f.json(small + " --verify --levels 100%", 4)["levels"]["check"]["refuted"].size() >= 1);
  }
}

TEST_CASE("pages of a file whose end is missing are compared as far as their children are there") {
  Fixture f;
  const std::vector<std::byte> bytes = with_levels(Profile::packed);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const lod::Page& second = file->pages()[1];
  const std::uint64_t size = file->stored(second.first_child + second.n_children).offset;
  const auto part = [size](const std::vector<std::byte>& whole) {
    return std::vector<std::byte>(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(size));
  };
  CHECK(f.json(f.write(part(bytes)) + " --verify --levels 100%", 6)["levels"]["check"]["pages_checked"] == 2);
  const std::string lie = f.write(part(with_errors_times(bytes, 1e-6F)));
  CHECK(f.json(lie + " --verify --levels 100%", 4)["levels"]["check"]["refuted"].size() == 2);
}

TEST_CASE_FIXTURE(Fixture, "--levels takes a percentage, --verify, and a file with levels") {
  const std::string path = write(with_levels(Profile::packed));
  CHECK(run(path + " --levels 10%").exit_code == 2);
  for (const char* percentage : {"0%", "-1%", "101%", "ten", "%", "10%%", "nan", "''"}) {
    CAPTURE(percentage);
    CHECK(run(path + " --verify --levels " + percentage).exit_code == 2);
  }
  const ProgramResult without = run(write(encoded(10, 0)) + " --verify --levels 10%");
  CHECK(without.exit_code == 2);
  CHECK(has(without.err, "no levels of detail"));
}
