// town_generator_test.cpp - the synthetic town does not depend on how it is divided, and looks like a town from afar.
// SPDX-License-Identifier: Apache-2.0
#include "town_generator.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <span>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "complexity.hpp"
#include "counted_program.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "run_program.hpp"
#include "sanitized.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using rgs::test::kSanitized;

namespace {

std::vector<Splat> range_of(const TownGenerator& town, std::uint64_t k) {
  const TownRange range = town.range(k);
  std::vector<Splat> splats(range.size());
  range.generate(0, splats);
  return splats;
}

std::vector<Splat> whole(const TownGenerator& town) {
  std::vector<Splat> splats;
  for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
    const std::vector<Splat> part = range_of(town, k);
    splats.insert(splats.end(), part.begin(), part.end());
  }
  return splats;
}

bool same_bits(const std::vector<Splat>& a, const std::vector<Splat>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(Splat)) == 0;
}

double percentile(std::vector<double> values, double share) {
  const auto at = values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

// Ranges on the ground within the town; the others are sectors of its surroundings.
bool is_block(const TownGenerator& town, std::uint64_t k) {
  const TownGenerator::Bounds box = town.bounds(k);
  return box.high[0] - box.low[0] < 200;
}

using Vector = std::array<double, 3>;

Vector eye(const Camera& camera) {
  Vector at{};
  const auto& m = camera.world_to_camera;
  for (int a = 0; a < 3; ++a)
    for (int r = 0; r < 3; ++r) at[static_cast<std::size_t>(a)] -= m[a][r] * m[3][r];
  return at;
}

double opacity(const Splat& s) {
  return 1 / (1 + std::exp(-double{s.opacity_logit}));
}

}  // namespace

TEST_CASE("a range's Gaussians depend on no other range, division or thread") {
  const TownGenerator town(7, 20011, 2, 2);
  const std::vector<Splat> expected = whole(town);
  REQUIRE(expected.size() == 20011);
  for (std::uint64_t k = town.n_ranges(); k-- > 0;) {  // backwards, each from its own town, in parts
    CAPTURE(k);
    const TownRange range = TownGenerator(7, 20011, 2, 2).range(k);
    std::vector<Splat> pieces(range.size());
    const std::uint64_t step = 1 + 37 * k;
    for (std::uint64_t first = 0; first < pieces.size(); first += step)
      range.generate(first, std::span(pieces).subspan(first, std::min<std::uint64_t>(step, pieces.size() - first)));
    const auto at = expected.begin() + static_cast<std::ptrdiff_t>(town.first(k));
    CHECK(same_bits(pieces, {at, at + static_cast<std::ptrdiff_t>(pieces.size())}));
  }
  std::vector<Splat> shared(expected.size());
  const auto every_second = [&](std::uint64_t from) {
    for (std::uint64_t k = from; k < town.n_ranges(); k += 2)
      town.range(k).generate(0, std::span(shared).subspan(town.first(k), town.first(k + 1) - town.first(k)));
  };
  std::thread other([&] { every_second(0); });
  every_second(1);
  other.join();
  CHECK(same_bits(shared, expected));
}

TEST_CASE("a town has the requested number of Gaussians, all finite and within their range's bounds") {
  for (const int blocks : {0, 1, 2, 5})
    for (const std::uint64_t n : {0U, 1U, 7U, 100U, 9999U, 123457U}) {
      CAPTURE(blocks);
      CAPTURE(n);
      const TownGenerator town(3, n, 1, blocks);
      CHECK(town.first(0) == 0);
      CHECK(town.first(town.n_ranges()) == n);
      std::uint64_t made = 0, n_bad = 0, n_outside = 0;
      for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
        const std::vector<Splat> splats = range_of(town, k);
        REQUIRE(splats.size() == town.first(k + 1) - town.first(k));
        made += splats.size();
        const TownGenerator::Bounds box = town.bounds(k);
        for (const Splat& s : splats) {
          const float* values = s.mean;
          for (const auto& [first, count] :
               {std::pair{values, 3}, std::pair{s.log_scale + 0, 3}, std::pair{s.rotation + 0, 4},
                std::pair{&s.opacity_logit, 1}, std::pair{s.sh + 0, 48}})
            n_bad += std::all_of(first, first + count, [](float v) { return std::isfinite(v); }) ? 0U : 1U;
          const double norm = std::hypot(std::hypot(double{s.rotation[0]}, double{s.rotation[1]}),
                                         std::hypot(double{s.rotation[2]}, double{s.rotation[3]}));
          n_bad += norm > 0.55 && norm < 1.45 ? 0U : 1U;
          for (std::size_t c = 0; c < 3; ++c)
            n_outside += double{s.mean[c]} >= box.low[c] && double{s.mean[c]} <= box.high[c] ? 0U : 1U;
        }
      }
      CHECK(made == n);
      CHECK(n_bad == 0);
      CHECK(n_outside == 0);
    }
}

TEST_CASE("a town's bytes never change, whatever the compiler") {
  const std::vector<Splat> splats = whole(TownGenerator(1, 50021, 3, 3));
  const std::string cameras = town_cameras_json(1) + town_path_json(1);
  Hasher hash;
  for (const Splat& s : splats) hash.update(std::as_bytes(std::span(&s, 1)).first(offsetof(Splat, mean_rest)));
  CHECK(hash.digest() == 18176096755127476755U);
  CHECK(xxh3(std::as_bytes(std::span(cameras))) == 3235692612974067230U);
}

TEST_CASE("a lower degree of the town is the higher one truncated, and seeds give other towns") {
  const std::vector<Splat> full = whole(TownGenerator(3, 3000, 3, 1));
  for (int degree = 0; degree < 3; ++degree) {
    std::vector<Splat> cut = full;
    for (Splat& splat : cut) std::fill(splat.sh + 3 * sh_coefficients(degree), std::end(splat.sh), 0.0F);
    CHECK(same_bits(whole(TownGenerator(3, 3000, degree, 1)), cut));
  }
  const std::vector<Splat> other = whole(TownGenerator(4, 3000, 3, 1));
  std::size_t equal = 0;
  for (std::size_t i = 0; i < full.size(); ++i)
    equal += std::equal(full[i].mean, full[i].mean + 3, other[i].mean) ? 1U : 0U;
  CHECK(equal < 5);
}

TEST_CASE("blocks have the right size in metres, and a larger town contains the smaller one") {
  const TownGenerator small(1, 10000, 0, 2), large(1, 50000, 0, 5);
  const auto boxes = [](const TownGenerator& town) {
    std::vector<TownGenerator::Bounds> all;
    for (std::uint64_t k = 0; k < town.n_ranges(); ++k)
      if (is_block(town, k)) all.push_back(town.bounds(k));
    return all;
  };
  const std::vector<TownGenerator::Bounds> few = boxes(small), many = boxes(large);
  CHECK(few.size() == 4);
  CHECK(many.size() == 25);
  for (const TownGenerator::Bounds& box : few) {
    CHECK(std::count_if(many.begin(), many.end(),
                        [&](const TownGenerator::Bounds& b) { return b.low == box.low && b.high == box.high; }) == 1);
  }
  double low = 0, high = 0, top = 0;
  for (const TownGenerator::Bounds& box : many) {
    CHECK(box.high[0] - box.low[0] > 60);
    CHECK(box.high[0] - box.low[0] < 100);
    CHECK(box.high[2] - box.low[2] > 50);
    CHECK(box.high[2] - box.low[2] < 90);
    CHECK(box.high[1] < 1.5);  // y is down: nothing lies below the ground
    low = std::min(low, box.low[0]);
    high = std::max(high, box.high[0]);
    top = std::min(top, box.low[1]);
  }
  CHECK(high - low == doctest::Approx(5 * 78).epsilon(0.05));
  CHECK(top < -12);  // houses of four floors and more
  CHECK(top > -60);
}

TEST_CASE("the town's Gaussians are thin, nearly opaque discs as wide as their spacing") {
  const TownGenerator town(1, 200000, 3, 2);
  std::vector<double> longest, aspect, flatness, opaque;
  std::size_t n = 0, n_visible = 0, n_faint_high = 0;
  double power[4] = {}, terms[4] = {};
  for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
    if (!is_block(town, k)) continue;
    for (const Splat& s : range_of(town, k)) {
      float scale[3] = {s.log_scale[0], s.log_scale[1], s.log_scale[2]};
      std::sort(scale, scale + 3);
      longest.push_back(double{scale[2]});
      aspect.push_back(double{scale[2]} - double{scale[1]});
      flatness.push_back(double{scale[1]} - double{scale[0]});
      opaque.push_back(opacity(s));
      ++n;
      n_visible += opacity(s) > 0.05 ? 1U : 0U;
      n_faint_high += opacity(s) < 0.1 && s.mean[1] < -1 ? 1U : 0U;
      for (int c = 3; c < 48; ++c) {
        power[sh_degree_of(c / 3)] += double{s.sh[c]} * double{s.sh[c]};
        terms[sh_degree_of(c / 3)] += 1;
      }
    }
  }
  CHECK(n > 160000);  // the rest is around the town
  CHECK(percentile(flatness, 0.5) > std::log(4));
  CHECK(percentile(aspect, 0.5) < std::log(2));
  CHECK(percentile(opaque, 0.5) > 0.9);
  CHECK(percentile(opaque, 0.1) > 0.5);
  CHECK(static_cast<double>(n_visible) > 0.98 * static_cast<double>(n));
  CHECK(n_faint_high > n / 2000);  // floaters
  CHECK(n_faint_high < n / 50);
  // A deviation of 0.6 of a cell; at this density cells lie between a street's and a window's.
  CHECK(percentile(longest, 0.5) > std::log(0.1));
  CHECK(percentile(longest, 0.5) < std::log(0.4));
  // Harmonics fall with their degree and only add gloss.
  const double d1 = std::sqrt(power[1] / terms[1]), d2 = std::sqrt(power[2] / terms[2]),
               d3 = std::sqrt(power[3] / terms[3]);
  INFO(d1, " ", d2, " ", d3);
  CHECK(d1 > 0.02);
  CHECK(d1 < 0.12);
  CHECK(d2 < d1);
  CHECK(d3 < d2);
  CHECK(d3 > 0.005);
}

TEST_CASE("four times the Gaussians are half as wide") {
  const auto median = [](std::uint64_t n) {
    const TownGenerator town(1, n, 0, 2);
    std::vector<double> size;
    for (std::uint64_t k = 0; k < town.n_ranges(); ++k)
      if (is_block(town, k))
        for (const Splat& s : range_of(town, k))
          size.push_back(double{s.log_scale[0]} / 2 + double{s.log_scale[1]} / 2);
    return percentile(size, 0.5);
  };
  CHECK(median(50000) - median(200000) == doctest::Approx(std::log(2)).epsilon(0.15));
}

TEST_CASE("from afar houses differ from one another, not only their Gaussians") {
  // Colour in house-sized cells of roofs and walls: its variance between cells, against the variance of the same
  // Gaussians at random.
  const TownGenerator town(1, 200000, 0, 3);
  struct Sum {
    double n = 0, red = 0, green = 0;
  };
  std::map<std::pair<int, int>, Sum> cells;
  Sum all;
  double squares = 0;
  for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
    if (!is_block(town, k)) continue;
    for (const Splat& s : range_of(town, k)) {
      if (s.mean[1] > -3) continue;
      Sum& cell = cells[{static_cast<int>(std::floor(s.mean[0] / 8)), static_cast<int>(std::floor(s.mean[2] / 8))}];
      const double red = double{s.sh[0]} - double{s.sh[2]};
      for (Sum* sum : {&cell, &all}) {
        sum->n += 1;
        sum->red += red;
      }
      squares += red * red;
    }
  }
  REQUIRE(all.n > 50000);
  const double mean = all.red / all.n, variance = squares / all.n - mean * mean;
  double between = 0, by_chance = 0;
  std::size_t n_cells = 0;
  for (const auto& [place, cell] : cells) {
    if (cell.n < 30) continue;
    const double off = cell.red / cell.n - mean;
    between += off * off;
    by_chance += variance / cell.n;
    ++n_cells;
  }
  CHECK(n_cells > 200);
  CHECK(between > 20 * by_chance);
  CHECK(between / static_cast<double>(n_cells) > 0.15 * variance);
}

TEST_CASE("towns grow with the number of Gaussians, up to a billion") {
  CHECK(TownGenerator::default_blocks(0) == 1);
  CHECK(TownGenerator::default_blocks(10'000) == 1);
  CHECK(TownGenerator::default_blocks(1'000'000) == 4);
  CHECK(TownGenerator::default_blocks(20'000'000) == 8);
  CHECK(TownGenerator::default_blocks(100'000'000) == 13);
  CHECK(TownGenerator::default_blocks(kMaxTownGaussians) == 22);
  const TownGenerator town(1, kMaxTownGaussians, 3);
  CHECK(town.size() == kMaxTownGaussians);
  CHECK(town.n_ranges() == 22 * 22 + 8);
  std::uint64_t largest = 0;
  for (std::uint64_t k = 0; k < town.n_ranges(); ++k) largest = std::max(largest, town.first(k + 1) - town.first(k));
  CHECK(largest < 6'000'000);
  const TownRange last = town.range(town.n_ranges() - 1);
  std::vector<Splat> tail(4096), again(1);
  last.generate(last.size() - tail.size(), tail);
  last.generate(last.size() - 1, again);
  CHECK(std::memcmp(&tail.back(), &again.front(), sizeof(Splat)) == 0);
  std::vector<Splat> middle(4096);
  last.generate(last.size() / 2, middle);
  std::vector<double> size;
  for (const Splat& s : middle) size.push_back(double{s.log_scale[0]});
  CHECK(percentile(size, 0.5) < std::log(0.1));
}

TEST_CASE("growth: generating a town is linear in its Gaussians") {
  std::vector<Splat> batch(2048);
  const auto generate = [&batch](const TownGenerator& town) {
    for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
      const TownRange range = town.range(k);
      for (std::uint64_t first = 0; first < range.size(); first += batch.size())
        range.generate(first, std::span(batch).first(std::min<std::uint64_t>(batch.size(), range.size() - first)));
    }
  };
  const auto town = [](std::uint64_t n) { return TownGenerator(1, n, 1, 2); };
  CHECK(test::growth(5000, town, generate) < test::kLinearGrowth);
}

TEST_CASE("the town's cameras and path can be read, and the path is 30 m/s") {
  const Result<CameraSet> views = parse_camera_json(town_cameras_json(1)), path = parse_camera_json(town_path_json(1));
  REQUIRE(views.has_value());
  REQUIRE(path.has_value());
  CHECK(views->cameras.size() == 8);
  REQUIRE(path->cameras.size() == kTownPathFrames);
  const auto forward = [](const Camera& camera) {
    const auto& m = camera.world_to_camera;
    return Vector{m[0][2], m[1][2], m[2][2]};
  };
  double n_low = 0;
  for (std::size_t k = 1; k < path->cameras.size(); ++k) {
    const Vector a = eye(path->cameras[k - 1]), b = eye(path->cameras[k]), from = forward(path->cameras[k - 1]),
                 to = forward(path->cameras[k]);
    CAPTURE(k);
    CHECK(std::hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]) == doctest::Approx(0.5).epsilon(0.02));
    CHECK(from[0] * to[0] + from[1] * to[1] + from[2] * to[2] > std::cos(0.03));  // no jerk above 2 degrees
    n_low += b[1] > -1.9 && b[1] < -1.5;                                          // eye level
  }
  CHECK(n_low >= 235);
  CHECK(eye(path->cameras.back())[1] < -40);
  CHECK(town_path_json(1) != town_path_json(2));
  CHECK(town_path_json(1, 1280, 720, {1e6, 0, 0}) != town_path_json(1));
}

TEST_CASE("the path hits nothing") {
  for (const std::uint64_t seed : {1U, 2U}) {
    CAPTURE(seed);
    const Result<CameraSet> path = parse_camera_json(town_path_json(seed));
    REQUIRE(path.has_value());
    std::size_t n_near = 0, n_below = 0;
    for (const Splat& s : whole(TownGenerator(seed, 200000, 0, 4))) {
      if (s.opacity_logit < 0) continue;
      for (std::size_t k = 0; k < path->cameras.size(); k += 4) {
        const Vector at = eye(path->cameras[k]);
        const double distance =
            std::hypot(double{s.mean[0]} - at[0], double{s.mean[1]} - at[1], double{s.mean[2]} - at[2]);
        n_near += distance < 1.2 ? 1U : 0U;
        n_below += distance < 2.2 ? 1U : 0U;  // the road
      }
    }
    CHECK(n_near == 0);
    CHECK(n_below > 0);
  }
}

#ifdef RGS_TEST_MAKE_SCENE
namespace {

int make_town(const std::string& arguments) {
  return test::run_shell("'" + test::built("rgs-make-scene") + "' --town --quiet --no-sync " + arguments).exit_code;
}

std::string contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace

TEST_CASE("rgs-make-scene --town writes the generator's Gaussians in range order, on any number of threads") {
  const test::TemporaryFolder folder;
  const std::string one = folder.file("one.ply"), many = folder.file("many.ply");
  REQUIRE(make_town("--seed 5 --gaussians 30001 --degree 1 --blocks 2 --threads 1 " + one) == 0);
  REQUIRE(make_town("--seed 5 --gaussians 30001 --degree 1 --blocks 2 --threads 4 " + many) == 0);
  const std::string bytes = contents(one);
  CHECK(bytes == contents(many));
  const std::size_t header = bytes.find("end_header\n") + 11;
  CHECK(bytes.find("comment rgs_metres_per_unit: 1\n") < header);
  constexpr std::size_t kRow = 4 * (17 + 9);
  REQUIRE(bytes.size() - header == 30001 * kRow);
  const std::vector<Splat> expected = whole(TownGenerator(5, 30001, 1, 2));
  std::size_t n_equal = 0;
  for (std::size_t i = 0; i < expected.size(); ++i)
    n_equal += std::memcmp(bytes.data() + header + i * kRow, expected[i].mean, sizeof expected[i].mean) == 0 ? 1U : 0U;
  CHECK(n_equal == expected.size());
}

TEST_CASE("rgs-make-scene --town writes its cameras and its path") {
  const test::TemporaryFolder folder;
  const std::string ply = folder.file("a.ply"), views = folder.file("v.json"), path = folder.file("p.json");
  const std::string both = "--gaussians 100 --cameras " + views + " --camera-path " + path + " ";
  REQUIRE(make_town(both + "--seed 3 " + ply) == 0);
  CHECK(contents(views) == town_cameras_json(3));
  CHECK(contents(path) == town_path_json(3));
  // Existing files are kept, and then nothing else is written.
  std::filesystem::remove(views);
  CHECK(make_town(both + folder.file("b.ply")) == 3);
  CHECK(contents(path) == town_path_json(3));
  CHECK(!std::filesystem::exists(views));
  CHECK(!std::filesystem::exists(folder.file("b.ply")));
  CHECK(make_town(both + "--seed 4 --overwrite " + ply) == 0);
  CHECK(contents(path) == town_path_json(4));
  CHECK(make_town("--gaussians 100 --origin 4.2e6,-1.7e5,4.8e6 --camera-path " + path + " --overwrite " + ply) == 0);
  CHECK(contents(path) == town_path_json(1, 1280, 720, {4.2e6, -1.7e5, 4.8e6}));
}

TEST_CASE("rgs-make-scene --town refuses bad arguments with exit code 2 and writes no file") {
  const test::TemporaryFolder folder;
  const std::string ply = folder.file("a.ply"), path = folder.file("p.json");
  for (const char* arguments :
       {"--gaussians 1.000000001G", "--gaussians 2G", "--blocks 0", "--blocks 65", "--blocks x"}) {
    CAPTURE(arguments);
    CHECK(make_town(std::string(arguments) + " " + ply) == 2);
  }
  CHECK(make_town("--camera-path " + ply + " " + ply) == 2);
  CHECK(make_town("--camera-path " + path + " --cameras " + path + " " + ply) == 2);
  // A path and blocks require a town.
  const std::string plain = "'" + test::built("rgs-make-scene") + "' --quiet --no-sync --gaussians 10 ";
  CHECK(test::run_shell(plain + "--camera-path " + path + " " + ply).exit_code == 2);
  CHECK(test::run_shell(plain + "--blocks 2 " + ply).exit_code == 2);
  CHECK(!std::filesystem::exists(ply));
  CHECK(!std::filesystem::exists(path));
}

TEST_CASE("rgs-make-scene --town writes an .rgs with levels, whose leaves are the town") {
  const test::TemporaryFolder folder;
  const std::string rgs = folder.file("town.rgs"), again = folder.file("again.rgs");
  const std::string arguments = "--gaussians 6k --blocks 1 --degree 1 ";
  REQUIRE(make_town(arguments + rgs) == 0);
  REQUIRE(make_town(arguments + "--threads 1 --memory 128MiB --scratch " + folder.path().string() + " " + again) == 0);
  CHECK(contents(rgs) == contents(again));
  const TownGenerator town(1, 6000, 1, 1);
  SplatCloud cloud;
  cloud.resize(town.size(), 1);
  for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
    const std::vector<Splat> splats = range_of(town, k);
    for (std::uint64_t i = 0; i < splats.size(); ++i) cloud.set(town.first(k) + i, splats[i]);
  }
  EncodeOptions options;
  options.profile = Profile::packed;
  options.metres_per_unit = 1;
  const auto plain = encode(cloud.view(), options);
  REQUIRE(plain);
  const std::string bytes = contents(rgs);
  const auto leaves = decode(std::as_bytes(std::span(bytes))), expected = decode(*plain);
  REQUIRE(leaves);
  REQUIRE(expected);
  CHECK(leaves->mean == expected->mean);
  CHECK(leaves->log_scale == expected->log_scale);
  CHECK(leaves->sh == expected->sh);
  CHECK(make_town(arguments + "--cameras " + folder.file("views.json") + " " + rgs) == 3);  // exists
  CHECK_FALSE(std::filesystem::exists(folder.file("views.json")));
  CHECK(make_town("--memory 100MiB " + folder.file("b.rgs")) == 2);
  CHECK(make_town("--memory 1GiB " + folder.file("b.ply")) == 2);
  CHECK(make_town("--gaussians 0 " + folder.file("b.rgs")) == 2);
}

TEST_CASE("rgs-make-scene --town needs little memory, however large the town") {
  if (kSanitized) return;  // sanitizers use more memory
  const test::TemporaryFolder folder;
  const auto peak_bytes = [&](const char* n_gaussians, const char* n_blocks) {
    const test::CountedResult run = test::run_counted({test::built("rgs-make-scene"), "--town", "--quiet", "--no-sync",
                                                       "--degree", "0", "--overwrite", "--threads", "2", "--gaussians",
                                                       n_gaussians, "--blocks", n_blocks, folder.file("a.ply")});
    CHECK(run.program.exit_code == 0);
    CHECK(run.peak_bytes > 0);
    return run.peak_bytes;
  };
  CHECK(peak_bytes("2M", "2") < 10'000'000);  // a PLY of 136 MB
  CHECK(peak_bytes("100k", "64") < 100'000'000);
}
#endif
