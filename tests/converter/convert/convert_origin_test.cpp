// convert_origin_test.cpp - rgs-convert with scenes whose coordinates are too large for FP32.
// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <cmath>
#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>
#include <random>

#include "archive_bounds.hpp"
#include "convert_program.hpp"
#include "convert_scenes.hpp"
#include "interchange_samples.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/splat_edit.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using Position = std::array<double, 3>;
constexpr Origin kEcef{4.2e6, 1.7e5, 4.8e6};

// A scene of doubles that FP32 cannot hold, and its Gaussians' positions.
std::vector<Position> write_far_scene(const std::string& path, SplatCloud cloud, const Origin& place = kEcef) {
  std::mt19937_64 random(3);
  std::uniform_real_distribution<double> below_fp32(-1e-3, 1e-3);
  std::vector<Position> positions(cloud.size());
  Declarations stated;
  stated.origin = {1, 0, 0};
  std::string text = ply_header(cloud.size(), cloud.sh_degree, stated);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    std::vector<std::byte> row(ply_row_bytes(cloud.sh_degree, {1, 0, 0}));
    const Splat s = cloud.view().splat(i);
    encode_ply_rows({&s, 1}, cloud.sh_degree, row, {1, 0, 0});
    for (std::size_t k = 0; k < 3; ++k)
      positions[i][k] = place[k] + static_cast<double>(s.mean[k]) + below_fp32(random);
    std::memcpy(row.data(), positions[i].data(), sizeof(Position));
    text += text_of(row);
  }
  write_text(path, text);
  return positions;
}

std::vector<Position> positions_of(const SplatFile& file) {
  std::vector<Position> out(file.cloud.size());
  for (std::size_t i = 0; i < 3 * out.size(); ++i) {
    out[i / 3][i % 3] = file.origin[i % 3] + static_cast<double>(file.cloud.mean[i]);
  }
  return out;
}

double largest_error(const std::vector<Position>& a, const std::vector<Position>& b) {
  REQUIRE(a.size() == b.size());
  double largest = 0;
  for (std::size_t i = 0; i < 3 * a.size(); ++i) {
    largest = std::max(largest, std::fabs(a[i / 3][i % 3] - b[i / 3][i % 3]));
  }
  return largest;
}

SplatFile read(const std::string& path) {
  ReadOptions options;
  options.keep_axes = true;
  auto file = read_splats(path, options);
  REQUIRE(file);
  return *std::move(file);
}

// Half an ulp within 32 units of the origin, and FP64's own rounding.
constexpr double kBound = 0x1p-20 + 1e-9;

}  // namespace

TEST_CASE("doubles go through .rgs and back as doubles, to half an ulp at the distance from the origin") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(700, 2, 1);
  const std::string ply = folder.file("far.ply"), rgs = folder.file("far.rgs"), back = folder.file("back.ply");
  const auto positions = write_far_scene(ply, cloud);
  for (const std::string profile : {"direct", "packed"}) {
    for (const std::string order : {"--keep-order", "--keep-permutation"}) {
      CAPTURE(profile);
      CAPTURE(order);
      const auto json = converted({"--profile", profile, order, ply, rgs});
      CHECK(json["profile"] == profile);
      CHECK(json["position_rounding"] <= kBound);
      const Bytes bytes = read_bytes(rgs);
      const auto view = FileView::open(bytes);
      REQUIRE(view);
      CHECK(json["origin"] == view->declarations().origin);
      // Extent within 8 units: multiples of 16.
      CHECK(view->declarations().origin == kEcef);
      converted({rgs, back});
      const SplatFile file = read(back);
      CHECK(file.origin == view->declarations().origin);
      CHECK(largest_error(positions_of(file), positions) <= kBound);
      // Values that were read from it once do not change again.
      converted({"--profile", profile, order, back, rgs});
      CHECK(largest_error(positions_of(read(rgs)), positions_of(file)) <= (order == "--keep-order" ? 0 : HUGE_VAL));
    }
  }
  const auto archived = converted({"--profile", "archive:high", "--keep-permutation", ply, rgs});
  CHECK(archived["profile"] == "archive");
  // Means are where the archive has put them, within its bounds.
  converted({rgs, back});
  const Bytes bytes = read_bytes(rgs);
  const auto view = FileView::open(bytes);
  REQUIRE(view);
  CHECK(view->declarations().origin == kEcef);
  const StatedBounds bounds(bytes);
  const SplatCloud stored = decode(bytes).value();
  std::vector<Position> moved(positions.size());
  for (std::size_t i = 0; i < stored.size(); ++i) {
    const std::uint64_t from = view->source_index(i);
    double squared = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      moved[from][k] = kEcef[k] + static_cast<double>(stored.mean[3 * i + k]);
      squared += std::pow(moved[from][k] - positions[from][k], 2.0);
    }
    CHECK(std::sqrt(squared) <= 1.001 * reach_of_mean(bounds, 0, stored.view().splat(i)) + kBound);
  }
  CHECK(largest_error(positions_of(read(back)), moved) <= kBound);
  // PLY to PLY, and through glb.
  converted({ply, back});
  CHECK(largest_error(positions_of(read(back)), positions) <= kBound);
  CHECK(converted({ply, folder.file("far.glb")})["position_rounding"] <= kBound);
  converted({folder.file("far.glb"), back});
  CHECK(largest_error(positions_of(read(back)), positions) <= kBound);
}

TEST_CASE("files of FP32 scenes have no origin and no doubles") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(300, 1, 2)), rgs = folder.file("a.rgs");
  const auto json = converted({ply, rgs});
  CHECK(json["origin"] == Origin{0, 0, 0});
  converted({rgs, folder.file("back.ply")});
  CHECK(text_of(read_bytes(folder.file("back.ply"))).find("double") == std::string::npos);
}

TEST_CASE("formats without an origin: the summary states the rounding") {
  const TemporaryFolder folder;
  const std::string ply = folder.file("far.ply"), rgs = folder.file("far.rgs");
  write_far_scene(ply, ordinary_cloud(300, 1, 3));
  converted({ply, rgs});
  for (const std::string format : {"splat", "spz", "compressed.ply", "sog"}) {
    CAPTURE(format);
    for (const std::string& input : {ply, rgs}) {
      const auto json = converted({input, folder.file("far." + format)});
      CHECK(json["origin"] == Origin{0, 0, 0});
      const double rounding = json["position_rounding"];
      CHECK(rounding > (format == "spz" ? 0.45 : 0.2));
      CHECK(rounding <= (format == "spz" ? 0.75 : 0.25) + 1e-6);
    }
    const ProgramResult text =
        run_program({built("rgs-convert"), "--no-sync", "--overwrite", ply, folder.file("far." + format)});
    REQUIRE(text.exit_code == 0);
    CHECK(text.out.find("positions  rounded by up to 0.") != std::string::npos);
    CHECK(text.out.find("  origin  ") == std::string::npos);
    const ProgramResult strict =
        run_program({built("rgs-convert"), "--no-sync", "--overwrite", "--strict", ply, folder.file("far." + format)});
    CHECK(strict.exit_code == 4);
    CHECK(strict.err.find("holds no origin") != std::string::npos);
  }
  const ProgramResult kept = run_program({built("rgs-convert"), "--no-sync", "--overwrite", ply, rgs});
  CHECK(kept.out.find("origin     4200000, 170000, 4800000") != std::string::npos);
  CHECK(kept.out.find("rounded by up to ") != std::string::npos);
}

TEST_CASE("an SPZ of version 4 keeps a far scene and its CRS within a millimetre, one of version 3 names both") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 1, 6);
  const std::string ply = folder.file("far.ply"), spz = folder.file("far.spz"), back = folder.file("back.ply");
  const auto positions = write_far_scene(ply, cloud, {4194304.5, -555555.25, 4713930.125});
  for (const std::string axes : {"ply", "opengl"}) {
    CAPTURE(axes);
    const auto json = converted({"--crs", "EPSG:4978", "--spz-axes", axes, "--spz-version", "4", ply, spz});
    CHECK(json["lost"].empty());
    CHECK(json["notes"].empty());
    CHECK(json["position_rounding"] <= 1e-3);
    const auto again = converted({spz, back});
    CHECK(again["declared"]["crs"] == "EPSG:4978");
    CHECK(again["source"]["unused"].empty());
    CHECK(largest_error(positions_of(read(back)), positions) <= 1e-3);
    CHECK(read(back).crs == Crs{"EPSG:4978", {}});
  }
  const auto old = converted({"--crs", "EPSG:4978", ply, spz});
  CHECK(old["lost"] == nlohmann::json::array({"coordinate reference system (EPSG:4978)"}));
  CHECK(old["notes"][1] == "version 4 of SPZ keeps the origin (--spz-version 4)");
  CHECK(old["position_rounding"] > 0.1);
}

TEST_CASE("far scenes are moved, cropped, turned and merged in FP64") {
  const TemporaryFolder folder;
  const std::string ply = folder.file("far.ply"), out = folder.file("out.ply"), near = folder.file("near.ply");
  const SplatCloud cloud = ordinary_cloud(400, 1, 4);
  const auto positions = write_far_scene(ply, cloud);
  const auto moved = [&](const glm::dmat3& turn, double scale, const glm::dvec3& by) {
    std::vector<Position> expected;
    for (const Position& p : positions) {
      const glm::dvec3 q = turn * glm::dvec3(p[0], p[1], p[2]) * scale + by;
      expected.push_back({q.x, q.y, q.z});
    }
    return expected;
  };
  converted({"--translate", "0.001,1000,-0.25", ply, out});
  CHECK(largest_error(positions_of(read(out)), moved(glm::dmat3(1.0), 1, {0.001, 1000, -0.25})) <= kBound);
  // Moved to the world's origin and back: the scene's origin vanishes, and FP32 positions are written.
  converted({"--translate=-4200000,-170000,-4800000", ply, near});
  CHECK(read(near).origin == kNoOrigin);
  CHECK(largest_error(positions_of(read(near)), moved(glm::dmat3(1.0), 1, {-kEcef[0], -kEcef[1], -kEcef[2]})) <=
        kBound);
  CHECK(text_of(read_bytes(near)).find("double") == std::string::npos);
  converted({"--translate", "4200000,170000,4800000", near, out});
  CHECK(largest_error(positions_of(read(out)), positions) <= 2 * kBound);
  converted({"--rotate", "10,20,30", "--scale", "2", ply, out});
  CHECK(largest_error(positions_of(read(out)), moved(rotation_from_euler({10, 20, 30}), 2, {0, 0, 0})) <=
        4 * kBound + 1e-8);
  // Other axes: 3DGS to OpenGL negates y and z.
  converted({"--to-axes", "opengl", ply, folder.file("turned.rgs")});
  CHECK(read(folder.file("turned.rgs")).origin == Origin{kEcef[0], -kEcef[1], -kEcef[2]});

  converted({"--crop", "4199999.95,0,0,4200003.05,1e9,1e9", ply, out});
  std::size_t n_inside = 0;
  for (const Position& p : positions) n_inside += p[0] >= 4199999.95 && p[0] <= 4200003.05;
  CHECK(n_inside > 20);
  CHECK(read(out).cloud.size() == n_inside);

  // Merged: the origin is in the middle, and scenes nearby lose next to nothing.
  const std::string beside = folder.file("beside.ply");
  const auto others = write_far_scene(beside, cloud, {4.2e6 + 32, 1.7e5 - 16, 4.8e6});
  auto json = converted({"--merge", ply, beside, out});
  for (std::size_t k = 0; k < 3; ++k) {
    const double middle = kEcef[k] + std::array{16., -8., 0.}[k];
    CHECK(std::fabs(json["origin"][k].get<double>() - middle) < 2);
  }
  CHECK(json["position_rounding"] <= 4 * kBound);  // within 128 units
  auto both = positions;
  both.insert(both.end(), others.begin(), others.end());
  CHECK(largest_error(positions_of(read(out)), both) <= 4 * kBound);
}

TEST_CASE("means that one origin rounds by more than a millimetre are refused unless that is allowed") {
  const TemporaryFolder folder;
  const std::string home = folder.file("home.ply"), away = folder.file("away.ply"), out = folder.file("out.rgs");
  const SplatCloud cloud = ordinary_cloud(300, 0, 4);
  const auto runs = [](std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync", "--overwrite", "--json"});
    return run_program(arguments);
  };
  const auto refused = [&](const std::vector<std::string>& arguments) {
    const ProgramResult run = runs(arguments);
    CHECK(run.exit_code == 4);
    CHECK(run.err.find(arguments.front() + ": FP32 rounds positions this far") != std::string::npos);
    CHECK(run.err.find("pass --allow-rounding") != std::string::npos);
    CHECK(!std::filesystem::exists(out));
  };
  const auto merged = [&](const std::vector<std::string>& more) {
    std::vector<std::string> all{home, away, out, "--merge",
                                 "--profile=archive:high"};  // which has no origins of pages
    all.insert(all.end(), more.begin(), more.end());
    return all;
  };
  write_far_scene(home, cloud, kNoOrigin);
  for (const std::string way : {"--keep-permutation", "--lod"}) {  // in memory, and tile by tile
    CAPTURE(way);
    // 500 km apart.
    write_far_scene(away, cloud, {5e5, 0, 0});
    refused(merged({way}));
    refused(merged({way, "--strict"}));
    CHECK(runs(merged({way})).err.find("(expected 1,000, found 7,791)") != std::string::npos);
    refused(merged({way, "--metres-per-unit", "0.2"}));
    const nlohmann::json json = converted(merged({way, "--allow-rounding"}));
    CHECK(std::fabs(json["origin"][0].get<double>() - 2.5e5) < 1000);
    CHECK(std::fabs(json["origin"][1].get<double>()) < 1000);
    CHECK(json["position_rounding"] > 0.007);
    CHECK(json["position_rounding"] <= 0.5 / 64);  // half an ulp of 250,000
    CHECK(json["notes"].dump().find("positions are rounded by up to 0.00779 world units") != std::string::npos);
    std::filesystem::remove(out);
    // In decimetres it is less.
    CHECK(converted(merged({way, "--metres-per-unit", "0.1"}))["position_rounding"] > 0.007);
    std::filesystem::remove(out);
    // Opposite points of the earth.
    write_far_scene(home, cloud, {6.4e6, 0, 0});
    write_far_scene(away, cloud, {-6.4e6, 0, 0});
    refused(merged({way}));
    CHECK(converted(merged({way, "--allow-rounding"}))["position_rounding"] <= 0.25);
    std::filesystem::remove(out);
    write_far_scene(home, cloud, kNoOrigin);
  }
  // The same in one file.
  SplatCloud both = cloud;
  for (std::uint64_t i = 0; i < both.size(); ++i) both.mean[3 * i] += i % 2 == 0 ? 6.4e6F : -6.4e6F;
  write_far_scene(home, both, {0.1, 0, 0});
  for (const std::string way : {"--keep-permutation", "--scale=2", "--crop=-1e9,-1e9,-1e9,1e9,1e9,1e9"}) {
    CAPTURE(way);
    refused({home, out, way});
    CHECK(converted({home, out, way, "--allow-rounding"})["position_rounding"] > 0.09);
    std::filesystem::remove(out);
  }
}

TEST_CASE("levels of scenes however far apart keep a quarter of a millimetre, through files and back") {
  const TemporaryFolder folder;
  const std::string home = folder.file("home.ply"), away = folder.file("away.ply"), both = folder.file("both.ply"),
                    out = folder.file("out.rgs"), again = folder.file("again.rgs"), back = folder.file("back.ply");
  const SplatCloud cloud = ordinary_cloud(3000, 0, 4);
  // In the order of the tiles.
  const auto exact = [](const std::string& path) {
    const SplatFile file = read(path);
    auto positions = positions_of(file), ordered = positions;
    for (std::size_t i = 0; i < file.cloud.mean_rest.size(); ++i)
      positions[i / 3][i % 3] += static_cast<double>(file.cloud.mean_rest[i]);
    for (std::size_t i = 0; i < positions.size(); ++i)
      ordered[file.source_index.empty() ? i : file.source_index[i]] = positions[i];
    return ordered;
  };
  constexpr double kKept = 0x1p-12 + 1e-6;
  for (const double apart : {1e5, 1.28e7}) {  // two towns, and opposite points of the earth
    CAPTURE(apart);
    const double beside = apart == 1e5 ? 0 : 1000;  // else the middle has an origin
    auto positions = write_far_scene(home, cloud, {-apart / 2, 0, 0});
    const auto others = write_far_scene(away, cloud, {apart / 2, 0, beside});
    positions.insert(positions.end(), others.begin(), others.end());
    const auto check = [&](const std::string& path) { CHECK(largest_error(exact(path), positions) <= kKept); };
    for (const std::string profile : {"direct", "packed"}) {
      CAPTURE(profile);
      const auto json =
          converted({home, away, out, "--merge", "--lod", "--keep-permutation", "--profile", profile, "--overwrite"});
      CHECK(json["position_rounding"] <= 0.00025);
      CHECK(json["notes"].dump().find("rounded") == std::string::npos);
      const Bytes bytes = read_bytes(out);
      const auto paged = PagedFile::open(bytes);
      REQUIRE(paged);
      CHECK(paged->n_pages_with_origins() != 0);
      CHECK(validate(*paged));
      check(out);
      converted({out, back, "--overwrite"});
      check(back);
      // A PLY of doubles, and an .rgs, are as good sources as the tiles.
      converted({back, again, "--lod", "--keep-permutation", "--profile", profile, "--overwrite"});
      check(again);
      converted({out, again, "--lod", "--keep-permutation", "--profile", profile, "--overwrite"});
      check(again);
      converted({out, home, again, "--merge", "--lod", "--profile", profile, "--overwrite"});
      CHECK(read(again).cloud.size() == 9000);
      // What need not round does not.
      converted({home, away, again, "--merge", "--lod", "--allow-rounding", "--keep-permutation", "--profile", profile,
                 "--overwrite"});
      check(again);
      for (const std::string ending : {".rad", ".ssog", ".splat"}) {
        CAPTURE(ending);
        const ProgramResult run = rgs_convert({out, folder.file("o" + ending)});
        CHECK(run.exit_code == 4);
        CHECK(run.err.find("--allow-rounding") != std::string::npos);
      }
      Bytes damaged = bytes;
      damaged[section_of(damaged, "PERM") + 5] ^= std::byte{1};
      write_bytes(folder.file("damaged.rgs"), damaged);
      CHECK(rgs_convert({folder.file("damaged.rgs"), folder.file("d.ply")}).exit_code == 4);
    }
  }
}

TEST_CASE("tiles keep half a millimetre however far apart they are, but where one spans the gap") {
  const TemporaryFolder folder;
  const std::string home = folder.file("home.ply"), away = folder.file("away.ply"), out = folder.file("out.rgs"),
                    tiles = folder.file("tileset.json"), back = folder.file("back.ply");
  const SplatCloud cloud = ordinary_cloud(40000, 0, 4);
  auto positions = write_far_scene(home, cloud, {-5e4, 7, 0});
  const auto others = write_far_scene(away, cloud, {5e4, 0, 1000});
  positions.insert(positions.end(), others.begin(), others.end());
  std::sort(positions.begin(), positions.end());
  converted({home, away, out, "--merge", "--lod"});
  converted({out, tiles});
  converted({tiles, back, "--lod", "--profile=direct", "--to", "rgs"});
  const SplatFile file = read(back);
  REQUIRE(file.cloud.size() == positions.size());
  std::size_t n_kept[2] = {};  // of each side
  for (std::size_t i = 0; i < file.cloud.size(); ++i) {
    Position p{};
    for (std::size_t k = 0; k < 3; ++k) {
      p[k] = file.origin[k] + static_cast<double>(file.cloud.mean[3 * i + k]) +
             static_cast<double>(file.cloud.mean_rest[3 * i + k]);
    }
    constexpr double kKept = 0x1p-12 + 0x1p-13 + 1e-6;  // of origins of pages and an SPZ
    const auto is_same = [&](const Position& q) {
      return std::fabs(p[0] - q[0]) <= kKept && std::fabs(p[1] - q[1]) <= kKept && std::fabs(p[2] - q[2]) <= kKept;
    };
    for (auto q = std::lower_bound(positions.begin(), positions.end(), Position{p[0] - kKept, -1e9, -1e9});
         q != positions.end() && (*q)[0] <= p[0] + kKept; ++q) {
      if (!is_same(*q)) continue;
      ++n_kept[p[0] > 0 ? 1 : 0];
      break;
    }
  }
  CHECK(std::min(n_kept[0], n_kept[1]) >= cloud.size() / 2);
}

TEST_CASE("cameras in the world see a far scene as they see it near the world's origin") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(3000, 0, 5);
  const std::string home = folder.file("home.ply"), far = folder.file("far.ply"), cameras = folder.file("cameras.json"),
                    rgs = folder.file("out.rgs");
  write_far_scene(home, cloud, kNoOrigin);
  write_far_scene(far, cloud);
  const auto range = [&](const std::string& ply, double x, double y, double z) {
    char text[400];
    std::snprintf(text, sizeof text,
                  R"([{"width": 640, "height": 480, "fx": 500, "fy": 520,
                       "world_to_camera": [[1,0,0,%.17g],[0,1,0,%.17g],[0,0,1,%.17g],[0,0,0,1]]}])",
                  -x, -y, 12 - z);
    write_text(cameras, text);
    return converted({"--cameras", cameras, ply, rgs})["depth"];
  };
  const auto here = range(home, 0, 0, 0), there = range(far, kEcef[0], kEcef[1], kEcef[2]);
  CHECK(here["source"] == "cameras");
  CHECK(double(there["far"]) == doctest::Approx(double(here["far"])).epsilon(1e-4));
}
