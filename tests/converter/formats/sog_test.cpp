// sog_test.cpp - SOG: another tool's file, both versions by hand, zipped and as a folder, hostile files, written ones.
// SPDX-License-Identifier: Apache-2.0
#include <webp/encode.h>

#include <cstring>
#include <functional>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>

#include "interchange_samples.hpp"
#include "temporary_folder.hpp"
#include "zip_samples.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using nlohmann::json;

// A lossless WebP; `value(i, channel)` of pixel i.
Bytes webp(int width, int height, const std::function<int(int, int)>& value, bool lossless = true) {
  std::vector<std::uint8_t> rgba;
  for (int i = 0; i < width * height; ++i) {
    for (int c = 0; c < 4; ++c) rgba.push_back(static_cast<std::uint8_t>(value(i, c)));
  }
  WebPConfig config;
  REQUIRE(WebPConfigPreset(&config, WEBP_PRESET_DEFAULT, 75) == 1);
  config.lossless = lossless ? 1 : 0;
  config.exact = 1;
  WebPPicture picture;
  REQUIRE(WebPPictureInit(&picture) == 1);
  picture.use_argb = 1;
  picture.width = width;
  picture.height = height;
  REQUIRE(WebPPictureImportRGBA(&picture, rgba.data(), 4 * width) == 1);
  WebPMemoryWriter writer;
  WebPMemoryWriterInit(&writer);
  picture.writer = WebPMemoryWrite;
  picture.custom_ptr = &writer;
  REQUIRE(WebPEncode(&config, &picture) == 1);
  Bytes out(writer.size);
  std::memcpy(out.data(), writer.mem, writer.size);
  WebPMemoryWriterClear(&writer);
  WebPPictureFree(&picture);
  return out;
}

json ramp(double low, double high) {
  json values = json::array();
  for (int i = 0; i < 256; ++i) values.push_back(low + (high - low) * i / 255);
  return values;
}

// Five Gaussians of degree 1 whose codes are simple functions of their index.
Files version2() {
  json meta;
  meta["version"] = 2;
  meta["count"] = 5;
  meta["means"] = {{"mins", {-1, 0, 1}}, {"maxs", {1, 2, 1}}, {"files", {"low.webp", "high.webp"}}};
  meta["scales"] = {{"codebook", ramp(-10, 0)}, {"files", {"scales.webp"}}};
  meta["quats"] = {{"files", {"quats.webp"}}};
  meta["sh0"] = {{"codebook", ramp(-2, 2)}, {"files", {"sh0.webp"}}};
  meta["shN"] = {{"count", 66}, {"bands", 1}, {"codebook", ramp(-1, 1)}, {"files", {"palette.webp", "labels.webp"}}};
  Files files;
  files["meta.json"] = bytes_of(meta.dump());
  files["low.webp"] = webp(3, 2, [](int i, int c) { return c == 0 ? 51 * i : 0; });
  files["high.webp"] = webp(3, 2, [](int i, int c) { return c < 2 ? 51 * i : 0; });
  files["quats.webp"] = webp(3, 2, [](int i, int c) { return c == 3 ? 252 + i % 4 : 127 + (c == 0 ? i : 0); });
  files["scales.webp"] = webp(3, 2, [](int i, int c) { return 10 * i + c; });
  files["sh0.webp"] = webp(3, 2, [](int i, int c) { return c == 3 ? 51 * i : 100 + 10 * i + c; });
  files["palette.webp"] = webp(192, 2, [](int i, int c) { return (i + 7 * c) % 256; });
  files["labels.webp"] = webp(3, 2, [](int i, int c) { return c == 0 ? 65 - i : 0; });
  return files;
}

// The same scene in version 1, whose values are linear between bounds.
Files version1() {
  Files files = version2();
  json meta;
  meta["means"] = {{"shape", {5, 3}}, {"mins", {-1, 0, 1}}, {"maxs", {1, 2, 1}}, {"files", {"low.webp", "high.webp"}}};
  meta["scales"] = {{"shape", {5, 3}}, {"mins", {-10, -10, -10}}, {"maxs", {0, 0, 0}}, {"files", {"scales.webp"}}};
  meta["quats"] = {{"shape", {5, 4}}, {"encoding", "quaternion_packed"}, {"files", {"quats.webp"}}};
  meta["sh0"] = {{"mins", {-2, -2, -2, -5}}, {"maxs", {2, 2, 2, 5}}, {"files", {"sh0.webp"}}};
  meta["shN"] = {{"mins", -1}, {"maxs", 1}, {"files", {"palette.webp", "labels.webp"}}};
  files["meta.json"] = bytes_of(meta.dump());
  return files;
}

void check_scene(const SplatFile& file, bool logit) {
  CHECK(file.format == SplatFormat::sog);
  REQUIRE(file.cloud.size() == 5);
  REQUIRE(file.cloud.sh_degree == 1);
  for (std::uint64_t i = 0; i < 5; ++i) {
    CAPTURE(i);
    const Splat s = file.cloud.view().splat(i);
    const double index = static_cast<double>(i), x = -1 + 2 * 51 * index * 257 / 65535;
    CHECK(s.mean[0] == doctest::Approx(std::copysign(std::exp(std::abs(x)) - 1, x)));
    CHECK(s.mean[1] == doctest::Approx(std::exp(2 * 51 * index * 256 / 65535) - 1));
    CHECK(s.mean[2] == doctest::Approx(std::exp(1) - 1));
    CHECK(s.log_scale[1] == doctest::Approx(-10 + (10 * index + 1) * 10 / 255));
    CHECK(s.sh[2] == doctest::Approx(-2 + (102 + 10 * index) * 4 / 255));
    if (logit) {
      CHECK(s.opacity_logit == doctest::Approx(-5 + 51 * index * 10 / 255));
    } else {
      CHECK(opacity_from_logit(s.opacity_logit) == doctest::Approx(51 * index / 255));
    }
    const auto largest = i % 4;
    CHECK(s.rotation[largest] > 0.99F);
    CHECK(s.rotation[largest == 0 ? 1 : 0] == doctest::Approx(((127 + index) / 255 * 2 - 1) * std::sqrt(0.5)));
    const std::uint64_t label = 65 - i, pixel = label / 64 * 192 + label % 64 * 3;
    for (std::uint64_t k = 0; k < 3; ++k) {
      for (std::uint64_t c = 0; c < 3; ++c) {
        CHECK(s.sh[3 * (k + 1) + c] == doctest::Approx(-1 + static_cast<double>((pixel + k + 7 * c) % 256) * 2 / 255));
      }
    }
  }
}

json meta_of(const Files& files) {
  const Bytes& bytes = files.at("meta.json");
  return json::parse(reinterpret_cast<const char*>(bytes.data()),
                     reinterpret_cast<const char*>(bytes.data()) + bytes.size());
}

}  // namespace

TEST_CASE("a SOG by another tool holds the PLY's Gaussians within the format's steps") {
  if (!has_peer_files()) return;
  const SplatCloud original = read_splats(peer_file("crop.ply")).value().cloud;
  const auto file = read_splats(peer_file("crop.sog"));
  REQUIRE(file);
  REQUIRE(file->cloud.size() == original.size());
  CHECK(file->format == SplatFormat::sog);
  SplatError step;
  std::fill_n(step.mean, 3, 1.5e-5);  // of ln(1 + |x|), whose slope is 1 / (1 + |x|): twice that at the scene's ends
  step.opacity = 1.0 / 255;
  step.rotation = 3 * 2 * 0.70711 / 255;
  step.log_scale[0] = step.log_scale[1] = step.log_scale[2] = step.sh[0] = 0.3;
  Matcher matcher(original);
  double log_scale = 0, dc = 0, sh = 0;
  std::uint64_t n_within = 0;
  for (std::uint64_t i = 0; i < original.size(); ++i) {
    const Splat a = file->cloud.view().splat(i), b = original.view().splat(matcher.nearest(a, step));
    const SplatError e = compare(a, b, 3);
    bool within =
        e.opacity <= 1.001 / 255 && e.rotation <= 1.51 * 2 * 0.70711 / 255;  // the other tool rounds codes down
    for (int k = 0; k < 3; ++k) {
      within = within && e.mean[k] <= 1.01 / 65535 * (1 + std::abs(static_cast<double>(b.mean[k])));
      log_scale += e.log_scale[k] / 3;
    }
    n_within += within ? 1 : 0;
    dc += e.sh[0];
    sh += (e.sh[1] + e.sh[2] + e.sh[3]) / 3;
  }
  // Some Gaussians were split from one and are nearly equal: the search mistakes a few for their twins.
  CHECK(n_within >= original.size() - original.size() / 200);
  CHECK(matcher.n_found() >= original.size() - original.size() / 100);
  // Codebooks and the palette are fitted and have no steps: their mean errors tell right from wrong.
  const auto n = static_cast<double>(original.size());
  CHECK(log_scale / n < 0.02);
  CHECK(dc / n < 0.02);
  CHECK(sh / n < 0.12);
}

TEST_CASE("SOG of versions 1 and 2, zipped and as a folder") {
  const TemporaryFolder folder;
  for (const bool old : {false, true}) {
    CAPTURE(old);
    const Files files = old ? version1() : version2();
    const auto file = read_splats(zipped(files));
    REQUIRE(file);
    check_scene(*file, old);
    std::uint64_t total = 0;
    for (const auto& [name, bytes] : files) {
      write_bytes(folder.file(name), bytes);
      total += bytes.size();
    }
    const auto loose = read_splats(folder.file("meta.json"));
    REQUIRE(loose);
    check_scene(*loose, old);
    CHECK(loose->bytes == total);
    CHECK(read_splats(files.at("meta.json")).error().code == Errc::unsupported_feature);
  }
}

TEST_CASE("a SOG declares anti-aliasing in either of two ways") {
  const auto mode_of = [](const char* key, const json& value) {
    Files files = version2();
    json meta = meta_of(files);
    meta[key] = value;
    files["meta.json"] = bytes_of(meta.dump());
    const auto file = read_splats(zipped(files));
    REQUIRE(file);
    return file->aa_mode;
  };
  CHECK(mode_of("model", "antialiased") == AaMode::mip_splatting);
  CHECK(mode_of("model", "default") == AaMode::classic);
  CHECK(mode_of("antialias", true) == AaMode::mip_splatting);
  CHECK(mode_of("antialias", false) == AaMode::classic);
  CHECK(mode_of("antialias", "yes") == AaMode::classic);
  CHECK(mode_of("other", 1) == AaMode::classic);
}

TEST_CASE("a SOG without harmonics") {
  Files files = version2();
  json meta = meta_of(files);
  meta.erase("shN");
  files["meta.json"] = bytes_of(meta.dump());
  const auto file = read_splats(zipped(files));
  REQUIRE(file);
  CHECK(file->cloud.sh_degree == 0);
}

TEST_CASE("damaged SOG files are refused or read, but never crash") {
  check_hostile(zipped(version2()), 4, 600);
  // Damage that the zip's checksum would hide, tried on the images and the text themselves.
  const TemporaryFolder folder;
  for (const auto& [name, bytes] : version2()) write_bytes(folder.file(name), bytes);
  SplitMix random(6);
  for (const auto& [name, bytes] : version2()) {
    for (int i = 0; i < 60; ++i) {
      Bytes damaged = bytes;
      damaged[random.below(damaged.size())] = static_cast<std::byte>(random.below(256));
      if (i % 3 == 0) damaged.resize(random.below(damaged.size()));
      write_bytes(folder.file(name), damaged);
      const auto file = read_splats(folder.file("meta.json"));
      if (file) {
        CHECK(file->cloud.size() <= 9);
      } else {
        CHECK((exit_code(file.error().code) == 4 || file.error().code == Errc::open_failed));  // the wrong file's name
      }
    }
    write_bytes(folder.file(name), bytes);
  }
}

TEST_CASE("SOG of version 1 repeats its number of Gaussians, and the copies must agree") {
  for (const char* name : {"means", "scales", "quats"}) {
    CAPTURE(name);
    Files files = version1();
    json meta = meta_of(files);
    meta[name]["shape"][0] = 4;
    files["meta.json"] = bytes_of(meta.dump());
    const auto file = read_splats(zipped(files));
    REQUIRE_FALSE(file);
    CHECK(file.error().code == Errc::bad_header);
  }
}

TEST_CASE("SOG texts that contradict their images, or point elsewhere, are refused") {
  const auto refused = [](const std::function<void(json&, Files&)>& edit, Errc code) {
    Files files = version2();
    json meta = meta_of(files);
    edit(meta, files);
    files["meta.json"] = bytes_of(meta.dump());
    const auto file = read_splats(zipped(files));
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
  };
  refused([](json& m, Files&) { m["count"] = 7; }, Errc::size_mismatch);
  refused([](json& m, Files&) { m["count"] = 0; }, Errc::size_mismatch);
  refused([](json&, Files& f) { f["scales.webp"] = webp(6, 1, [](int, int) { return 9; }); }, Errc::size_mismatch);
  refused([](json&, Files& f) { f["labels.webp"] = webp(4, 2, [](int, int) { return 0; }); }, Errc::size_mismatch);
  refused([](json& m, Files&) { m["count"] = 200000000; }, Errc::limit_exceeded);
  refused([](json& m, Files&) { m["count"] = -1; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["version"] = 3; }, Errc::unsupported_version);
  refused([](json& m, Files&) { m["shN"]["count"] = 65; }, Errc::bad_value);
  refused([](json& m, Files&) { m["shN"]["bands"] = 2; }, Errc::size_mismatch);
  refused([](json& m, Files&) { m["sh0"]["codebook"].erase(0); }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["means"]["maxs"][0] = 1e300; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["quats"]["files"] = {"../quats.webp"}; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["quats"]["files"] = {std::string("quats.webp\0x", 12)}; }, Errc::bad_syntax);
  refused([](json& m, Files&) { m["quats"]["files"] = {"none.webp"}; }, Errc::missing_section);
  refused([](json&, Files& f) { f["quats.webp"] = webp(3, 2, [](int, int) { return 251; }); }, Errc::bad_value);
  refused(
      [](json&, Files& f) {
        f["sh0.webp"] = webp(
            3, 2, [](int, int c) { return c; }, false);
      },
      Errc::unsupported_feature);
  refused([](json&, Files& f) { f["sh0.webp"] = webp(1000, 1000, [](int, int) { return 9; }); }, Errc::limit_exceeded);
}

namespace {

SplatCloud written_and_read(const SplatCloud& cloud, WriteOptions options = {.keep_order = true}) {
  const auto bytes = encode_splats(cloud.view(), SplatFormat::sog, options);
  REQUIRE(bytes);
  const auto file = read_splats(*bytes);
  REQUIRE(file);
  REQUIRE(file->cloud.size() == cloud.size());
  REQUIRE(file->cloud.sh_degree == cloud.sh_degree);
  return file->cloud;
}

// Harmonics above degree 0.
double distortion(const SplatCloud& a, const SplatCloud& b) {
  double total = 0;
  const auto floats = static_cast<std::size_t>(3 * sh_coefficients(a.sh_degree));
  for (std::size_t i = 0; i < a.sh.size(); ++i) {
    const double d = static_cast<double>(a.sh[i]) - static_cast<double>(b.sh[i]);
    if (i % floats >= 3) total += d * d;
  }
  return total;
}

}  // namespace

TEST_CASE("a written SOG holds the Gaussians within the format's steps, of every degree and number") {
  for (int degree = 0; degree <= 3; ++degree) {
    for (const std::uint64_t n : {1U, 2U, 3U, 63U, 64U, 65U, 700U, 5000U}) {
      CAPTURE(degree);
      CAPTURE(n);
      const SplatCloud cloud = ordinary_cloud(n, degree, n + 1);
      const SplatCloud copy = written_and_read(cloud);
      const SplatError e = compare(copy, turned_like(copy, cloud));
      // Half a code of at most 2 ln(1 + 8) / 65535, times the slope of exp there, and FP32.
      for (const double x : e.mean) CHECK(x <= 0.5 * 2 * std::log(9) / 65535 * 9 * 1.01);
      CHECK(e.opacity <= 0.501 / 255);
      CHECK(e.rotation <= 3 * 0.51 * 2 * 0.70711 / 255);  // of w, which is at least a half and follows from three
      for (const double x : e.log_scale) CHECK(x <= (3 * n <= 256 ? 0 : 0.5 * 10 / 256 * 4));
      CHECK(e.sh[0] <= (3 * n <= 256 ? 0 : 0.5 * 3.4 / 256 * 4));
      for (std::uint64_t i = 0; i < n; ++i) CHECK(copy.rotation[4 * i] >= 0.49F);  // w is the largest
      if (n < 3) CHECK(distortion(copy, cloud) < 1e-12);                           // rounded once
    }
  }
}

TEST_CASE("a SOG's codebooks hold outliers, and stay fine between them") {
  SplatCloud cloud = ordinary_cloud(5000, 0, 6);
  for (const auto& [at, value] : {std::pair(30, 9.F), {60, 10.F}, {900, -7.F}, {1200, 40.F}}) {
    cloud.sh[static_cast<std::size_t>(at)] = value;
  }
  cloud.log_scale[77] = -40;
  const SplatError e = compare(turned_like(cloud, written_and_read(cloud)), cloud);
  CHECK(e.sh[0] <= 0.5 * 3.4 / 256 * 4);
  for (const double x : e.log_scale) CHECK(x <= 0.5 * 10 / 256 * 4);
}

TEST_CASE("a SOG's palette holds what repeats, and comes near to what does not") {
  const SplatCloud few = ordinary_cloud(60, 2, 9);
  SplatCloud cloud = ordinary_cloud(5000, 2, 8);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    for (std::uint64_t k = 3; k < 27; ++k) cloud.sh[27 * i + k] = std::round(few.sh[27 * (i * i % 60) + k] * 100) / 100;
  }
  CHECK(distortion(written_and_read(cloud), cloud) < 1e-6);
  // Of a whole octave of Gaussians about half have entries of their own.
  const SplatCloud all = ordinary_cloud(4095, 1, 7);
  SplatCloud none = all;
  for (std::size_t i = 0; i < none.sh.size(); ++i) none.sh[i] = i % 12 < 3 ? none.sh[i] : 0;
  CHECK(distortion(written_and_read(all), all) < 0.12 * distortion(none, all));
}

TEST_CASE("a written SOG does not depend on the number of threads, and lies along a curve unless told otherwise") {
  const SplatCloud cloud = ordinary_cloud(20000, 1, 10);
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::sog, {.threads = 1}).value();
  for (const unsigned threads : {2U, 5U}) {
    CHECK(encode_splats(cloud.view(), SplatFormat::sog, {.threads = threads}).value() == bytes);
  }
  CHECK(encode_splats(cloud.view(), SplatFormat::sog, {.keep_order = true}).value().size() > bytes.size());
  SplatCloud copy = read_splats(bytes).value().cloud, sorted = cloud;
  std::ranges::sort(copy.opacity_logit);
  std::ranges::sort(sorted.opacity_logit);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    CHECK(std::abs(opacity_from_logit(copy.opacity_logit[i]) - opacity_from_logit(sorted.opacity_logit[i])) <
          0.502 / 255);
  }
}

TEST_CASE("a SOG that readers would refuse as too compressed is not written") {
  const SplatCloud one = ordinary_cloud(1, 0, 1);
  SplatCloud equal;
  equal.resize(100'000, 0);
  for (std::uint64_t i = 0; i < equal.size(); ++i) equal.set(i, one.view().splat(0));
  CHECK(encode_splats(equal.view(), SplatFormat::sog).error().code == Errc::limit_exceeded);
}

TEST_CASE("a written SOG declares anti-aliasing, and refuses what it cannot hold") {
  SplatCloud cloud = ordinary_cloud(10, 1, 11);
  for (const AaMode mode : {AaMode::classic, AaMode::mip_splatting}) {
    CHECK(read_splats(encode_splats(cloud.view(), SplatFormat::sog, {.aa_mode = mode}).value())->aa_mode == mode);
  }
  // A scale of 0 comes back as a tiny one, far coordinates as near as 16 bits allow.
  cloud.log_scale[4] = -std::numeric_limits<float>::infinity();
  cloud.mean[6] = 3e38F;
  cloud.mean[9] = -3e38F;
  const SplatCloud copy = written_and_read(cloud);
  CHECK(copy.log_scale[4] <= -60);
  CHECK(copy.mean[6] == doctest::Approx(3e38).epsilon(1e-5));
  CHECK(copy.mean[9] == doctest::Approx(-3e38).epsilon(1e-5));
  // Harmonics far out are clamped, and spoil no others.
  cloud.sh[12 * 5 + 7] = -1e30F;
  WriteReport report;
  CHECK(encode_splats(cloud.view(), SplatFormat::sog, {.strict = true}, &report).error().code == Errc::bad_value);
  CHECK(report.sh.n == 1);
  const SplatCloud clamped = written_and_read(cloud);
  for (std::size_t i = 0; i < cloud.sh.size(); ++i) {
    if (i / 12 != 5) CHECK(std::abs(clamped.sh[i]) <= 1.71F);
  }
  CHECK(clamped.sh[12 * 5 + 7] == -1e6F);
  const auto refused = [](const SplatCloud& bad) {
    const auto bytes = encode_splats(bad.view(), SplatFormat::sog);
    REQUIRE_FALSE(bytes);
    CHECK(bytes.error().code == Errc::bad_value);
    return bytes.error().offset;
  };
  CHECK(refused(SplatCloud()) == Error::kNone);
  cloud.mean[7 * 3] = std::numeric_limits<float>::infinity();
  CHECK(refused(cloud) == 7);
}
