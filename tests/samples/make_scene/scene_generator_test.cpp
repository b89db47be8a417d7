// scene_generator_test.cpp - the synthetic scenes are reproducible, varied and like trained ones.
// SPDX-License-Identifier: Apache-2.0
#include "scene_generator.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <span>
#include <string>
#include <thread>
#include <vector>

#include "garden_generator.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/checksum.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

using namespace rgs;

namespace {

std::vector<Splat> whole(std::uint64_t seed, std::uint64_t n, int degree) {
  std::vector<Splat> splats(n);
  SceneGenerator(seed, n, degree).generate(0, splats);
  return splats;
}

std::vector<Splat> garden(std::uint64_t seed, std::uint64_t n, int degree) {
  std::vector<Splat> splats(n);
  GardenGenerator(seed, n, degree).generate(0, splats);
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

double distance(const Splat& s) {
  return std::hypot(double{s.mean[0]}, double{s.mean[1]}, double{s.mean[2]});
}

}  // namespace

TEST_CASE("a Gaussian depends on seed, count and index, not on its batch or thread") {
  constexpr std::uint64_t kN = 10007;
  const SceneGenerator scene(7, kN, 3);
  const std::vector<Splat> expected = whole(7, kN, 3);
  for (const std::uint64_t batch : {1U, 3U, 1000U, 4096U}) {
    CAPTURE(batch);
    std::vector<Splat> pieces(kN);
    for (std::uint64_t first = 0; first < kN; first += batch) {
      const std::uint64_t count = std::min<std::uint64_t>(batch, kN - first);
      scene.generate(first, std::span(pieces).subspan(first, count));
    }
    CHECK(same_bits(pieces, expected));
  }
  std::vector<Splat> halves(kN);
  std::thread other([&] { scene.generate(0, std::span(halves).first(kN / 2)); });
  scene.generate(kN / 2, std::span(halves).subspan(kN / 2));
  other.join();
  CHECK(same_bits(halves, expected));
}

TEST_CASE("seeds give different scenes of the same kind") {
  const std::vector<Splat> a = whole(1, 5000, 3), b = whole(2, 5000, 3);
  std::size_t equal = 0;
  for (std::size_t i = 0; i < a.size(); ++i)
    equal += std::equal(a[i].mean, a[i].mean + 3, b[i].mean) || a[i].opacity_logit == b[i].opacity_logit ? 1U : 0U;
  CHECK(equal < 5);
}

TEST_CASE("a lower degree is the higher one truncated") {
  const std::vector<Splat> full = whole(3, 2000, 3);
  for (int degree = 0; degree < 3; ++degree) {
    std::vector<Splat> cut = full;
    for (Splat& splat : cut) std::fill(splat.sh + 3 * sh_coefficients(degree), std::end(splat.sh), 0.0F);
    CHECK(same_bits(whole(3, 2000, degree), cut));
  }
}

TEST_CASE("small and empty scenes") {
  whole(1, 0, 3);
  for (std::uint64_t n = 1; n < 300; ++n)
    for (const Splat& splat : whole(1, n, 3)) REQUIRE(std::isfinite(splat.log_scale[0] + splat.mean[0]));
}

TEST_CASE("the largest scene has random access") {
  const SceneGenerator scene(1, kMaxSceneGaussians, 3);
  std::vector<Splat> last(64), again(1);
  scene.generate(kMaxSceneGaussians - last.size(), last);
  scene.generate(kMaxSceneGaussians - 1, again);
  CHECK(std::memcmp(&last.back(), &again.front(), sizeof(Splat)) == 0);
  std::vector<double> size;
  for (const Splat& splat : last) size.push_back(splat.log_scale[0]);
  CHECK(percentile(size, 0.5) < -6);  // below 3 mm
}

TEST_CASE("a scene's bytes never change") {
  const std::vector<Splat> splats = whole(1, 20011, 3);
  Hasher hash;
  for (const Splat& s : splats) hash.update(std::as_bytes(std::span(&s, 1)).first(offsetof(Splat, mean_rest)));
  CHECK(hash.digest() == 17861800317272669149U);
  const std::string cameras = scene_cameras_json();
  CHECK(xxh3(std::as_bytes(std::span(cameras))) == 615894061732631915U);
}

TEST_CASE("statistics match a trained outdoor scene") {
  const std::vector<Splat> splats = whole(1, 100000, 3);
  std::vector<double> longest, flatness, opacity, radius;
  double power[4] = {}, terms[4] = {};
  std::size_t n_dc_outliers = 0, n_bad = 0, n_unnormalised = 0, n_negative_w = 0;
  for (const Splat& s : splats) {
    const float* values = s.mean;
    for (const auto& [first, count] :
         {std::pair{values, 3}, std::pair{s.log_scale + 0, 3}, std::pair{s.rotation + 0, 4},
          std::pair{&s.opacity_logit, 1}, std::pair{s.sh + 0, 48}})
      n_bad += std::all_of(first, first + count, [](float v) { return std::isfinite(v); }) ? 0U : 1U;
    const double norm = std::hypot(std::hypot(double{s.rotation[0]}, double{s.rotation[1]}),
                                   std::hypot(double{s.rotation[2]}, double{s.rotation[3]}));
    n_bad += norm > 0.55 && norm < 1.45 ? 0U : 1U;
    n_unnormalised += std::abs(norm - 1) > 0.05 ? 1U : 0U;
    n_negative_w += s.rotation[0] < 0 ? 1U : 0U;
    const auto [low, high] = std::minmax_element(s.log_scale, s.log_scale + 3);
    longest.push_back(*high);
    flatness.push_back(double{*high} - double{*low});
    opacity.push_back(1 / (1 + std::exp(-double{s.opacity_logit})));
    radius.push_back(distance(s));
    n_dc_outliers += std::any_of(s.sh, s.sh + 3, [](float v) { return std::abs(v) > 3.5F; }) ? 1U : 0U;
    for (int k = 1; k < 16; ++k)
      for (int c = 0; c < 3; ++c) {
        const int degree = k < 4 ? 1 : k < 9 ? 2 : 3;
        power[degree] += double{s.sh[3 * k + c]} * double{s.sh[3 * k + c]};
        terms[degree] += 1;
      }
  }
  CHECK(n_bad == 0);
  CHECK(n_unnormalised > splats.size() / 2);
  CHECK(n_negative_w > splats.size() / 4);

  // Scales: a long upper tail, flat and thin shapes.
  CHECK(percentile(longest, 0.5) > std::log(0.005));
  CHECK(percentile(longest, 0.5) < std::log(0.10));
  CHECK(percentile(longest, 0.999) - percentile(longest, 0.5) > 3);
  CHECK(percentile(flatness, 0.5) > 1.5);
  CHECK(percentile(flatness, 0.99) > 3.5);

  // Opacities: many nearly transparent and nearly opaque, few between.
  const auto share = [&](double low, double high) {
    return static_cast<double>(
               std::count_if(opacity.begin(), opacity.end(), [&](double o) { return o >= low && o < high; })) /
           static_cast<double>(opacity.size());
  };
  CHECK(share(0, 0.2) > 0.1);
  CHECK(share(0.8, 1) > 0.4);
  CHECK(share(0.4, 0.6) < 0.12);
  CHECK(*std::min_element(opacity.begin(), opacity.end()) < 0.02);

  // Colour.
  const double d1 = std::sqrt(power[1] / terms[1]), d2 = std::sqrt(power[2] / terms[2]),
               d3 = std::sqrt(power[3] / terms[3]);
  INFO(d1, " ", d2, " ", d3);
  CHECK(d1 > 0.04);
  CHECK(d1 < 0.08);
  CHECK(d2 < 0.9 * d1);
  CHECK(d3 < 0.9 * d2);
  CHECK(d3 > 0.015);
  CHECK(n_dc_outliers > 20);
  CHECK(n_dc_outliers < 1000);

  // Space: most Gaussians are near, a few far away.
  CHECK(percentile(radius, 0.5) < 6);
  CHECK(percentile(radius, 0.9) < 30);
  CHECK(*std::max_element(radius.begin(), radius.end()) > 250);
  CHECK(*std::max_element(radius.begin(), radius.end()) < 400);
}

TEST_CASE("splats shrink as their number grows") {
  const auto median = [](std::uint64_t n) {
    std::vector<double> size;
    for (const Splat& splat : whole(1, n, 0)) size.push_back(splat.log_scale[0]);
    return percentile(size, 0.5);
  };
  CHECK(median(20000) - median(80000) == doctest::Approx(std::log(2)).epsilon(0.15));
}

TEST_CASE("the portrait camera faces the house with a right-handed frame") {
  const std::string json = scene_cameras_json();
  CHECK(std::count(json.begin(), json.end(), '{') == 8);
  double m[12];
  const char* text = json.c_str() + json.find("world_to_camera");
  for (double& value : m) {
    text += std::strcspn(text, "-0123456789");
    char* end = nullptr;
    value = std::strtod(text, &end);
    text = end;
  }
  const auto row = [&](int r, const double(&p)[3]) {
    return m[4 * r] * p[0] + m[4 * r + 1] * p[1] + m[4 * r + 2] * p[2] + m[4 * r + 3];
  };
  const double door[3] = {0, -0.6, -0.3}, left_wall[3] = {-1.5, -0.6, -0.3}, tower_tip[3] = {1.62, -4.2, 0.05};
  CHECK(row(2, door) > 5);                                                     // in front
  CHECK(std::abs(row(0, door)) < 0.5 * row(2, door));                          // within the 60 degrees
  CHECK(row(0, left_wall) / row(2, left_wall) < row(0, door) / row(2, door));  // x to the right
  CHECK(row(1, tower_tip) < row(1, door));                                     // y down
}

TEST_CASE("a Gaussian of the garden depends on seed, count and index; a lower degree is the higher one truncated") {
  constexpr std::uint64_t kN = 5003;
  const std::vector<Splat> full = garden(3, kN, 3);
  std::vector<Splat> pieces(kN);
  for (std::uint64_t first = 0; first < kN; first += 1000)
    GardenGenerator(3, kN, 3).generate(first,
                                       std::span(pieces).subspan(first, std::min<std::uint64_t>(1000, kN - first)));
  CHECK(same_bits(pieces, full));
  for (int degree = 0; degree < 3; ++degree) {
    std::vector<Splat> cut = full;
    for (Splat& splat : cut) std::fill(splat.sh + 3 * sh_coefficients(degree), std::end(splat.sh), 0.0F);
    CHECK(same_bits(garden(3, kN, degree), cut));
  }
  const std::vector<Splat> other = garden(4, kN, 3);
  std::size_t equal = 0;
  for (std::size_t i = 0; i < kN; ++i) equal += std::equal(full[i].mean, full[i].mean + 3, other[i].mean) ? 1U : 0U;
  CHECK(equal < 5);
}

TEST_CASE("a garden's means lie on its grid, its values are finite, and its bytes never change") {
  const auto is_sound = [](const Splat& s) {
    const auto finite = [](const float* first, int n) {
      return std::all_of(first, first + n, [](float v) { return std::isfinite(v); });
    };
    return finite(s.mean, 3) && finite(s.log_scale, 3) && finite(s.rotation, 4) && std::isfinite(s.opacity_logit) &&
           finite(s.sh, 48) && std::all_of(s.mean, s.mean + 3, [](float v) {
             return v / kGardenStep == std::round(v / kGardenStep) && std::abs(v) <= 200.5F;
           });
  };
  garden(1, 0, 3);
  for (std::uint64_t n = 1; n < 100; ++n) {
    const std::vector<Splat> few = garden(1, n, 3);
    REQUIRE(std::all_of(few.begin(), few.end(), is_sound));
  }
  const std::vector<Splat> splats = garden(1, 20011, 3);
  CHECK(std::all_of(splats.begin(), splats.end(), is_sound));
  Hasher hash;
  for (const Splat& s : splats) hash.update(std::as_bytes(std::span(&s, 1)).first(offsetof(Splat, mean_rest)));
  CHECK(hash.digest() == 13803895856918624913U);
  std::vector<Splat> last(64);
  GardenGenerator(1, kMaxSceneGaussians, 3).generate(kMaxSceneGaussians - last.size(), last);
  CHECK(std::all_of(last.begin(), last.end(), is_sound));
}

TEST_CASE("the garden's cameras stand on its path and look at its middle") {
  const auto set = parse_camera_json(garden_cameras_json());
  REQUIRE(set);
  REQUIRE(set->cameras.size() == 8);
  for (const Camera& camera : set->cameras) {
    const auto& m = camera.world_to_camera;  // columns
    double eye[3] = {};
    for (int a = 0; a < 3; ++a)
      for (int r = 0; r < 3; ++r) eye[a] -= m[a][r] * m[3][r];
    CHECK(std::hypot(eye[0], eye[2]) == doctest::Approx(12));
    CHECK(eye[1] < -1.7);
    CHECK(std::abs(m[3][0]) < 1e-6);  // the middle's x
    CHECK(m[3][2] > 11);              // its depth
  }
}

#ifdef RGS_TEST_MAKE_SCENE
namespace {

int make_scene(const std::string& arguments) {
  return test::run_shell("'" + test::built("rgs-make-scene") + "' --quiet --no-sync " + arguments).exit_code;
}

std::string contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace

TEST_CASE("rgs-make-scene writes header and rows of every degree") {
  const test::TemporaryFolder folder;
  for (int degree = 0; degree <= 3; ++degree) {
    const std::string path = folder.file("d" + std::to_string(degree) + ".ply");
    REQUIRE(make_scene("--gaussians 5k --degree " + std::to_string(degree) + " " + path) == 0);
    const std::string bytes = contents(path);
    const std::size_t header = bytes.find("end_header\n") + 11;
    CHECK(bytes.find("element vertex 5000\n") < header);
    CHECK(bytes.size() - header == 5000U * 4U * static_cast<std::size_t>(17 + 3 * (sh_coefficients(degree) - 1)));
    const std::vector<Splat> splats = whole(1, 5000, degree);
    CHECK(std::memcmp(bytes.data() + header, splats[0].mean, sizeof(splats[0].mean)) == 0);
  }
}

TEST_CASE("rgs-make-scene --origin writes the same scene in doubles, elsewhere") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("far.ply"), cameras = folder.file("far.json");
  REQUIRE(make_scene("--gaussians 2k --degree 0 --origin 4.2e6,-1.7e5,4.8e6 --cameras " + cameras + " " + path) == 0);
  const std::string bytes = contents(path);
  const std::size_t header = bytes.find("end_header\n") + 11;
  CHECK(bytes.find("property double z\n") < header);
  CHECK(bytes.size() - header == 2000U * (4U * 17 + 12));
  const std::vector<Splat> splats = whole(1, 2000, 0);
  double first[3];
  std::memcpy(first, bytes.data() + header, sizeof first);
  CHECK(first[0] == 4.2e6 + static_cast<double>(splats[0].mean[0]));
  CHECK(first[1] == -1.7e5 + static_cast<double>(splats[0].mean[1]));
  const std::string json = contents(cameras);
  CHECK(json == scene_cameras_json(1280, 720, {4.2e6, -1.7e5, 4.8e6}));
  CHECK(json != scene_cameras_json());
  CHECK(make_scene("--gaussians 10 --origin 1,2 " + folder.file("none.ply")) == 2);
  CHECK(make_scene("--gaussians 10 --origin 1,2,1e13 " + folder.file("none.ply")) == 2);
}

TEST_CASE("rgs-make-scene writes the same bytes on one thread and on many") {
  const test::TemporaryFolder folder;
  const std::string one = folder.file("one.ply"), many = folder.file("many.ply");
  REQUIRE(make_scene("--seed 5 --gaussians 30001 --threads 1 " + one) == 0);
  REQUIRE(make_scene("--seed 5 --gaussians 0.030001M --threads 4 " + many) == 0);
  CHECK(contents(one) == contents(many));
  CHECK(contents(one).size() > 30001U * 248U);
}

TEST_CASE("rgs-make-scene --garden writes the generator's Gaussians on any number of threads, and its cameras") {
  const test::TemporaryFolder folder;
  const std::string one = folder.file("one.ply"), many = folder.file("many.ply"), cameras = folder.file("c.json");
  REQUIRE(make_scene("--garden --seed 5 --gaussians 30001 --degree 1 --threads 1 --cameras " + cameras + " " + one) ==
          0);
  REQUIRE(make_scene("--garden --seed 5 --gaussians 30001 --degree 1 --threads 2 " + many) == 0);
  const std::string bytes = contents(one);
  CHECK(bytes == contents(many));
  CHECK(contents(cameras) == garden_cameras_json());
  const std::size_t header = bytes.find("end_header\n") + 11;
  constexpr std::size_t kRow = 4 * (17 + 9);
  REQUIRE(bytes.size() - header == 30001 * kRow);
  const std::vector<Splat> expected = garden(5, 30001, 1);
  std::size_t n_equal = 0;
  for (std::size_t i = 0; i < expected.size(); ++i)
    n_equal += std::memcmp(bytes.data() + header + i * kRow, expected[i].mean, sizeof expected[i].mean) == 0 ? 1U : 0U;
  CHECK(n_equal == expected.size());
  CHECK(make_scene("--garden --gaussians 2k --degree 0 " + folder.file("levels.rgs")) == 0);
  CHECK(make_scene("--garden --town " + folder.file("both.ply")) == 2);
  CHECK(make_scene("--garden --gaussians 201M " + folder.file("more.ply")) == 2);
}

TEST_CASE("rgs-make-scene keeps existing outputs unless told to replace them") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("a.ply"), cameras = folder.file("cameras.json");
  REQUIRE(make_scene("--gaussians 100 --cameras " + cameras + " " + path) == 0);
  CHECK(contents(cameras) == scene_cameras_json());
  const std::string before = contents(path);
  CHECK(make_scene("--gaussians 200 " + path) == 3);
  CHECK(contents(path) == before);
  CHECK(make_scene("--gaussians 200 --overwrite " + path) == 0);
  CHECK(contents(path) != before);
  CHECK(make_scene("--gaussians 100 --cameras " + cameras + " " + folder.file("b.ply")) == 3);
  CHECK(!std::filesystem::exists(folder.file("b.ply")));
}

TEST_CASE("rgs-make-scene refuses bad arguments with exit code 2 and writes no file") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("a.ply");
  for (const char* arguments : {"--gaussians 201M", "--gaussians -5", "--gaussians 1.5", "--gaussians ten",
                                "--degree 4", "--degree -1", "--threads -1", "--seed x", "--unknown"}) {
    CAPTURE(arguments);
    CHECK(make_scene(std::string(arguments) + " " + path) == 2);
  }
  CHECK(make_scene("") == 2);
  CHECK(make_scene("--cameras " + path + " " + path) == 2);
  CHECK(!std::filesystem::exists(path));
  CHECK(make_scene(folder.file("missing/a.ply")) == 3);
}
#endif
