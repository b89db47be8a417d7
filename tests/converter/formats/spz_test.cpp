// spz_test.cpp - SPZ: another tool's files, round trips, older versions, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <zlib.h>

#include <array>
#include <cstring>
#include <glm/geometric.hpp>
#include <glm/gtc/quaternion.hpp>

#include "interchange_samples.hpp"
#include "rgs/splat_edit.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr double kSmallestThreeError = 0.5 * 3 * 0.70711 / 511;
// Version 2: half of the worst angle among 200,000 random rotations.
constexpr double kFirstThreeError = 0.06;

// Half a step of each attribute; the smallest three components determine the fourth's error; SH as given.
void check_within_steps(const SplatError& e, double sh1_step, double sh_step,
                        double rotation_error = kSmallestThreeError) {
  for (int k = 0; k < 3; ++k) {
    CHECK(e.mean[k] <= 0.5 / 4096 * 1.001);
    CHECK(e.log_scale[k] <= 0.5 / 16 * 1.001);
  }
  CHECK(e.opacity <= 0.5 / 255 * 1.001);
  CHECK(e.rotation <= rotation_error);
  CHECK(e.sh[0] <= 0.5 / 255 / 0.15 * 1.001);
  CHECK(e.sh[1] <= sh1_step / 128 * 1.001);
  CHECK(e.sh[2] <= sh_step / 128 * 1.001);
  CHECK(e.sh[3] <= sh_step / 128 * 1.001);
}

// Framing of SPZ versions 2 and 3: header and body in one gzip stream.
Bytes gzip(const Bytes& data) {
  z_stream z{};
  REQUIRE(deflateInit2(&z, 6, Z_DEFLATED, 15 + 16, 8, Z_DEFAULT_STRATEGY) == Z_OK);
  Bytes out(deflateBound(&z, data.size()) + 64);
  z.next_in = reinterpret_cast<Bytef*>(const_cast<std::byte*>(data.data()));
  z.avail_in = static_cast<uInt>(data.size());
  z.next_out = reinterpret_cast<Bytef*>(out.data());
  z.avail_out = static_cast<uInt>(out.size());
  REQUIRE(deflate(&z, Z_FINISH) == Z_STREAM_END);
  out.resize(z.total_out);
  deflateEnd(&z);
  return out;
}

Bytes list_of(std::initializer_list<int> values) {
  Bytes out;
  for (const int value : values) out.push_back(static_cast<std::byte>(value));
  return out;
}

// Two Gaussians of degree 0 in version 2, by hand.
Bytes hand_made_v2() {
  Bytes file = list_of({'N', 'G', 'S', 'P', 2, 0, 0, 0, 2, 0, 0, 0, 0, 8, 1, 0});
  const auto add = [&file](std::initializer_list<int> values) {
    const Bytes more = list_of(values);
    file.insert(file.end(), more.begin(), more.end());
  };
  add({0, 1, 0, 0x80, 0xFE, 0xFF, 0, 0, 0});     // 1, -1.5, 0
  add({0xFF, 0xFF, 0x7F, 0, 0, 0x80, 1, 0, 0});  // the ends of the range, a smallest step
  add({255, 51});                                // opacities 1, 0.2
  add({0, 255, 51, 102, 153, 204});              // colours
  add({0, 160, 255, 16, 32, 48});                // log-scales -10, 0, 5.9375; -9, -8, -7
  add({128, 128, 128, 255, 0, 128});             // about the identity; a quarter turn beyond unit length
  return file;
}

// An extension's record.
Bytes extension(std::uint32_t type, const Bytes& payload, std::optional<std::uint32_t> bytes = std::nullopt) {
  Bytes record(8);
  const std::uint32_t size = bytes.value_or(static_cast<std::uint32_t>(payload.size()));
  std::memcpy(record.data(), &type, 4);
  std::memcpy(record.data() + 4, &size, 4);
  record.insert(record.end(), payload.begin(), payload.end());
  return record;
}

Bytes joined(Bytes first, const Bytes& second) {
  first.insert(first.end(), second.begin(), second.end());
  return first;
}

Bytes ungzip(const Bytes& data) {
  z_stream z{};
  REQUIRE(inflateInit2(&z, 15 + 16) == Z_OK);
  Bytes out(std::size_t{1} << 22);
  z.next_in = reinterpret_cast<Bytef*>(const_cast<std::byte*>(data.data()));
  z.avail_in = static_cast<uInt>(data.size());
  z.next_out = reinterpret_cast<Bytef*>(out.data());
  z.avail_out = static_cast<uInt>(out.size());
  REQUIRE(inflate(&z, Z_FINISH) == Z_STREAM_END);
  CHECK(z.avail_in == 0);
  out.resize(z.total_out);
  inflateEnd(&z);
  return out;
}

// The file with these extension records at its version's location: behind the streams, or before their table.
Bytes with_extensions(const Bytes& file, const Bytes& records) {
  Bytes out = get<std::uint16_t>(file, 0) == 0x8B1F ? ungzip(file) : file;
  out[14] |= std::byte{2};
  if (out.size() != file.size() || file[0] == std::byte{0x1F}) return gzip(joined(out, records));
  out.insert(out.begin() + 32, records.begin(), records.end());
  const auto table = static_cast<std::uint32_t>(32 + records.size());
  std::memcpy(&out[16], &table, 4);
  return out;
}

// Offset of with_extensions()'s first record: in the file, or in its inflated gzip stream.
std::uint64_t extensions_at(const Bytes& file) {
  return get<std::uint16_t>(file, 0) == 0x8B1F ? ungzip(file).size() : 32;
}

WriteOptions version(int number, AaMode aa_mode = AaMode::classic) {
  WriteOptions options;
  options.spz_version = number;
  options.aa_mode = aa_mode;
  return options;
}

constexpr std::uint32_t kOrbit = 0xADBE0002, kAxesType = 0xADBE0003, kGeoreference = 0x4E530001, kUnknown = 0x12340001;

}  // namespace

TEST_CASE("SPZ files of versions 3 and 4 by another tool hold the PLY's Gaussians within the format's steps") {
  if (!has_peer_files()) return;
  const SplatCloud original = read_splats(peer_file("crop.ply")).value().cloud;
  // The first two are turned over, as that tool's version 2.7.1 did; the last one declares its axes.
  ReadOptions turned;
  turned.spz_axes = kAxesOpenGl;
  for (const std::string name : {"crop.v3.spz", "crop.v4.spz", "crop.adobe.spz"}) {
    CAPTURE(name);
    const auto file = read_splats(peer_file(name), turned);
    REQUIRE(file);
    CHECK(file->format == SplatFormat::spz);
    CHECK(file->axes == kAxes3dgs);
    const bool adobe = name == "crop.adobe.spz";
    CHECK(file->axes_assumed == !adobe);
    CHECK(file->aa_mode == (adobe ? AaMode::mip_splatting : AaMode::classic));
    // SPZ has no log-scales below -10; compare the others. The other tool rounds SH twice: 4.5 and 8.5 of 128.
    SplatCloud clamped = original;
    for (float& value : clamped.log_scale) value = std::max(value, -10.F);
    for (std::size_t i = 0; i < clamped.sh.size(); ++i) {
      if (i / 3 % 16 == 0) clamped.sh[i] = std::clamp(clamped.sh[i], -0.5F / 0.15F, 0.5F / 0.15F);
    }
    check_within_steps(compare(file->cloud, clamped), 4.5, 8.5);
  }
}

TEST_CASE("SPZ round trip within half a step, 0.62 of SH, whatever version and degree") {
  for (int degree = 0; degree <= 3; ++degree) {
    for (const int number : {2, 3, 4}) {
      for (const std::uint64_t n : {0U, 1U, 2U, 1000U}) {
        CAPTURE(degree);
        CAPTURE(number);
        CAPTURE(n);
        const SplatCloud cloud = ordinary_cloud(n, degree, n + 7);
        const WriteOptions options = version(number, AaMode::mip_splatting);
        const auto bytes = encode_splats(cloud.view(), SplatFormat::spz, options);
        REQUIRE(bytes);
        CHECK(detect_format(*bytes) == SplatFormat::spz);
        const auto file = read_splats(*bytes, kKeepAxes);
        REQUIRE(file);
        CHECK(file->format == SplatFormat::spz);
        CHECK(file->axes == kAxes3dgs);
        CHECK(file->axes_assumed);
        CHECK(file->aa_mode == AaMode::mip_splatting);
        CHECK(file->bytes == bytes->size());
        CHECK(file->unused.empty());
        check_within_steps(compare(file->cloud, cloud), 4.96, 9.92,
                           number == 2 ? kFirstThreeError : kSmallestThreeError);
        const Bytes head = number == 4 ? *bytes : ungzip(*bytes);
        CHECK(get<std::uint32_t>(head, 4) == static_cast<std::uint32_t>(number));
        // Streams: other readers refuse empty ones. Reserved before version 4.
        CHECK(get<std::uint8_t>(head, 15) == (number < 4 ? 0 : degree == 0 ? 5 : 6));
        const auto again = encode_splats(file->cloud.view(), SplatFormat::spz, options);
        // Decoded values give the same codes. A rotation may exchange which of two equal components is the largest; in
        // version 2 codes may exceed a unit quaternion.
        REQUIRE(again);
        const SplatError e = compare(read_splats(*again, kKeepAxes).value().cloud, file->cloud);
        CHECK(e.sum() == e.rotation);
        CHECK(e.rotation <= (number == 2 ? 1 / 127.5 : 0.70711 / 511));
      }
    }
  }
}

TEST_CASE("SPZ versions hold the same codes, except the rotations of version 2") {
  const SplatCloud cloud = ordinary_cloud(3000, 3, 11);
  const auto coded = [&](int number) {
    return read_splats(encode_splats(cloud.view(), SplatFormat::spz, version(number)).value(), kKeepAxes).value().cloud;
  };
  const SplatCloud v2 = coded(2), v3 = coded(3), v4 = coded(4);
  CHECK(compare(v3, v4).sum() == 0);
  const SplatError e = compare(v2, v4);
  CHECK(e.sum() == e.rotation);
  CHECK(encode_splats(cloud.view(), SplatFormat::spz).value() ==
        encode_splats(cloud.view(), SplatFormat::spz, version(3)).value());
  for (const int number : {-1, 0, 1, 5}) {
    const auto refused = encode_splats(cloud.view(), SplatFormat::spz, version(number));
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::bad_argument);
  }
}

TEST_CASE("SPZ of versions 2 and 3 holds no time and no place of writing") {
  const SplatCloud cloud = ordinary_cloud(50, 1, 3);
  for (const int number : {2, 3}) {
    const Bytes file = encode_splats(cloud.view(), SplatFormat::spz, version(number)).value();
    CHECK(std::ranges::equal(std::span(file).first(10), list_of({0x1F, 0x8B, 8, 0, 0, 0, 0, 0, 2, 255})));
    CHECK(file == encode_splats(cloud.view(), SplatFormat::spz, version(number)).value());
  }
}

TEST_CASE("rotations in SPZ version 2 take the nearest of the surrounding codes") {
  // Rounding each component gives a w near 0 all of their errors.
  const SplatCloud cloud = ordinary_cloud(20000, 0, 5);
  const SplatCloud coded =
      read_splats(encode_splats(cloud.view(), SplatFormat::spz, version(2)).value(), kKeepAxes).value().cloud;
  double worst = 0, squares = 0;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    const float *a = &cloud.rotation[4 * i], *b = &coded.rotation[4 * i];
    double dot = 0, length = 0;
    for (int k = 0; k < 4; ++k) {
      dot += static_cast<double>(a[k]) * static_cast<double>(b[k]);
      length += static_cast<double>(b[k]) * static_cast<double>(b[k]);
    }
    const double angle = 2 * std::acos(std::min(1.0, std::abs(dot) / std::sqrt(length)));
    worst = std::max(worst, angle);
    squares += angle * angle;
  }
  CHECK(worst < 0.13);                                                    // 0.21 rad by rounding
  CHECK(std::sqrt(squares / static_cast<double>(cloud.size())) < 0.018);  // 0.030
}

TEST_CASE("SPZ extensions: axes are honoured, harmless ones named, the rest refused") {
  const SplatCloud cloud = ordinary_cloud(20, 3, 5);
  const Bytes orbit = extension(kOrbit, Bytes(12)), georeference = extension(kGeoreference, Bytes(85));
  for (const int number : {2, 3, 4}) {
    CAPTURE(number);
    const Bytes plain = encode_splats(cloud.view(), SplatFormat::spz, version(number)).value();
    const SplatCloud coded = read_splats(plain, kKeepAxes).value().cloud;
    const std::uint64_t at = extensions_at(plain);
    const auto same_codes = [&](const Result<SplatFile>& file) {
      REQUIRE(file);
      CHECK(compare(file->cloud, coded).sum() == 0);
    };
    const auto refused = [&](const Bytes& records, Errc code, std::uint64_t offset) {
      const auto file = read_exact(with_extensions(plain, records));
      REQUIRE_FALSE(file);
      CHECK(file.error().code == code);
      CHECK(file.error().offset == at + offset);
    };
    // Axes by the value's name; 0 states nothing.
    const std::pair<int, Axes> systems[] = {{0, kAxes3dgs},
                                            {4, kAxesOpenGl},
                                            {6, kAxes3dgs},
                                            {7, kAxesGltf},
                                            {1, {Axis::left, Axis::down, Axis::backward}},
                                            {8, {Axis::right, Axis::up, Axis::forward}},
                                            {9, {Axis::left, Axis::forward, Axis::down}},
                                            {12, {Axis::right, Axis::forward, Axis::up}},
                                            {16, {Axis::right, Axis::backward, Axis::up}}};
    for (const auto& system : systems) {
      CAPTURE(system.first);
      const auto& [value, axes] = system;
      const Bytes file = with_extensions(plain, extension(kAxesType, list_of({value, 0, 0, 0})));
      const auto kept = read_splats(file, kKeepAxes);
      same_codes(kept);
      CHECK(kept->axes == axes);
      CHECK(kept->axes_assumed == (value == 0));
      ReadOptions other = kKeepAxes;
      other.spz_axes = kAxesOpenGl;
      CHECK(read_splats(file, other)->axes == (value == 0 ? kAxesOpenGl : axes));
      CHECK(kept->unused.empty());
      SplatCloud turned = coded;
      convert_axes(turned, axes, kAxes3dgs);
      CHECK(compare(read_splats(file)->cloud, turned).sum() == 0);
    }
    const auto several = read_splats(
        with_extensions(plain, joined(joined(orbit, extension(kAxesType, list_of({6, 0, 0, 0}))), georeference)),
        kKeepAxes);
    same_codes(several);
    CHECK(several->axes == kAxes3dgs);
    CHECK(several->unused == std::vector<std::string>{"SPZ extension 0xADBE0002 (safe orbit camera, 12 bytes)",
                                                      "SPZ extension 0x4E530001 (georeference, 85 bytes)"});
    same_codes(read_splats(with_extensions(plain, {}), kKeepAxes));
    // The reference library's first builds wrote no length.
    Bytes old = orbit;
    old.erase(old.begin() + 4, old.begin() + 8);
    const auto early = read_splats(with_extensions(plain, old), kKeepAxes);
    same_codes(early);
    CHECK(early->unused.size() == 1);

    refused(extension(kUnknown, Bytes(5)), Errc::unsupported_feature, 0);
    refused(joined(orbit, extension(kUnknown, {})), Errc::unsupported_feature, 20);
    refused(extension(0xADBE0001, Bytes(2)), Errc::unsupported_feature, 0);
    ReadOptions lenient = kKeepAxes;
    lenient.skip_unknown_extensions = true;
    const auto skipped = read_splats(with_extensions(plain, extension(kUnknown, Bytes(5))), lenient);
    same_codes(skipped);
    CHECK(skipped->unused == std::vector<std::string>{"SPZ extension 0x12340001 (unknown, 5 bytes)"});

    refused(extension(kAxesType, list_of({17, 0, 0, 0})), Errc::bad_value, 8);
    refused(extension(kAxesType, list_of({6, 0, 0, 1})), Errc::bad_value, 8);
    refused(extension(kAxesType, list_of({6, 0, 0})), Errc::bad_header, 4);
    refused(extension(kAxesType, list_of({6, 0, 0, 0, 0})), Errc::bad_header, 4);
    refused(extension(kAxesType, list_of({6, 0, 0, 0}), 5), Errc::truncated, 4);
    refused(extension(kAxesType, list_of({6, 0, 0, 0}), 0xFFFFFFFF), Errc::truncated, 4);
    refused(extension(kOrbit, Bytes(13)), Errc::bad_header, 4);
    refused(joined(orbit, list_of({3, 0, 0xBE})), Errc::truncated, 20);
    refused(joined(orbit, list_of({3, 0, 0xBE, 0xAD, 4, 0, 0})), Errc::truncated, 20);
    const Bytes axes = extension(kAxesType, list_of({6, 0, 0, 0}));
    refused(joined(axes, axes), Errc::bad_header, 12);
  }
}

TEST_CASE("SPZ of version 4 holds an origin and a CRS, whose axes may be others, to a millimetre") {
  const SplatCloud cloud = ordinary_cloud(200, 1, 12);
  const Origin origin{4194304.5, -555555.25, 4713930.125};
  const auto written = [&](const WriteOptions& options) {
    return read_splats(encode_splats(cloud.view(), SplatFormat::spz, options).value(), kKeepAxes).value();
  };
  WriteOptions options = version(4);
  options.origin = origin;
  options.crs.text = "EPSG:4978";
  for (const Axes& axes : {kAxes3dgs, kAxesOpenGl, kAxesGltf}) {
    for (const Axes& of_crs : {Axes{}, kAxesLcc, Axes{Axis::forward, Axis::left, Axis::up}}) {
      CAPTURE(axes_text(axes));
      CAPTURE(axes_text(of_crs));
      options.axes = axes;
      options.crs.axes = of_crs;
      const SplatFile file = written(options);
      CHECK(file.axes == axes);
      CHECK_FALSE(file.axes_assumed);
      CHECK(file.origin == origin);
      CHECK(file.crs == options.crs);
      CHECK(file.unused.empty());
      const SplatError e = compare(file.cloud, cloud);
      for (const double error : e.mean) CHECK(error <= 0x1p-13);
      CHECK(position_rounding(cloud.view(), SplatFormat::spz, options).value() <= 0x1p-13);
    }
  }
  // As the description of the record computes a position.
  options.axes = kAxes3dgs;
  options.crs.axes = kAxesLcc;
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::spz, options).value();
  CHECK(get<std::uint32_t>(bytes, 32) == kAxesType);
  CHECK(get<std::uint32_t>(bytes, 40) == 6);
  CHECK(get<std::uint32_t>(bytes, 44) == kGeoreference);
  CHECK(get<std::uint32_t>(bytes, 48) == 76 + 9);
  CHECK(get<std::uint32_t>(bytes, 52) == (1 | 9 << 16));
  CHECK(get<double>(bytes, 56) == origin[0]);
  CHECK(get<double>(bytes, 64) == origin[2]);
  CHECK(get<double>(bytes, 72) == -origin[1]);
  const glm::dmat3 rotation = rotation_from_quaternion(
      {get<double>(bytes, 104), get<double>(bytes, 80), get<double>(bytes, 88), get<double>(bytes, 96)});
  const glm::dvec3 moved = rotation * glm::dvec3(1, 2, 3);  // right, up, backward
  CHECK(glm::length(moved - glm::dvec3(1, -3, 2)) < 1e-12);
  CHECK(get<double>(bytes, 112) == 1);
  CHECK(std::isnan(get<double>(bytes, 120)));
  CHECK(text_of(std::span(bytes).subspan(128, 9)) == "EPSG:4978");
  // What other texts and axes keep.
  const auto keeps = [](const WriteOptions& o) {
    const auto k = keeps_of(SplatFormat::spz, o);
    return std::array{k.origin, k.crs, k.axes};
  };
  CHECK(keeps(options) == std::array{true, true, true});
  CHECK(keeps(version(4)) == std::array{true, false, false});
  options.crs.axes = {Axis::forward, Axis::right, Axis::up};  // mirrored
  CHECK(keeps(options) == std::array{false, false, false});
  options.crs = {"{\"type\":\"GeodeticCRS\",\"name\":\"Moon\"}", {}};
  CHECK(written(options).crs == options.crs);
  for (const char* text : {"", "GEOCCS[\"WGS 84\"]", "EPSG:4978@2020", "EPSG:", ":1", "a:b:c"}) {
    CAPTURE(text);
    options.crs.text = text;
    CHECK(keeps(options) == std::array{true, false, true});
    const SplatFile file = written(options);
    CHECK(file.origin == origin);
    CHECK(file.crs == Crs());
  }
  // Undeclared axes are taken for those of a PLY.
  options.axes = {};
  options.crs.text = "EPSG:4978";
  CHECK(keeps(options) == std::array{true, true, false});
  const SplatFile undeclared = written(options);
  CHECK(undeclared.origin == origin);
  CHECK(undeclared.crs == options.crs);
  CHECK(compare(undeclared.cloud, cloud).mean[2] <= 0x1p-13);
  // Without either there are no records; older versions have none.
  options = version(4);
  CHECK(get<std::uint32_t>(encode_splats(cloud.view(), SplatFormat::spz, options).value(), 16) == 32);
  options.spz_version = 3;
  const Bytes old = encode_splats(cloud.view(), SplatFormat::spz, options).value();
  options.crs.text = "EPSG:4978";
  CHECK(keeps(options) == std::array{false, false, false});
  CHECK(encode_splats(cloud.view(), SplatFormat::spz, options).value() == old);
}

TEST_CASE("an SPZ's georeference that turns or scales transforms the Gaussians; an invalid one is named") {
  const SplatCloud cloud = ordinary_cloud(50, 1, 13);
  const Bytes plain = encode_splats(cloud.view(), SplatFormat::spz, version(4)).value();
  const SplatCloud coded = read_splats(plain, kKeepAxes).value().cloud;
  const glm::dquat turn = glm::normalize(glm::dquat(0.5, 0.1, -0.7, 0.3));
  const auto record = [&](std::uint8_t flags, const std::string& text, double scale, const glm::dquat& q,
                          double x = 4194304.5) {
    Bytes payload = list_of({1, flags, static_cast<int>(text.size()), 0});
    payload.resize(76);
    const double values[] = {x, -555555.25, 4713930.125, q.x, q.y, q.z, q.w, scale, 2026.75};
    std::memcpy(&payload[4], values, sizeof values);
    return extension(kGeoreference, joined(payload, bytes_of(text)));
  };
  const auto read = [&](const Bytes& records) { return read_splats(with_extensions(plain, records)).value(); };
  const Bytes axes = extension(kAxesType, list_of({6, 0, 0, 0}));

  const SplatFile file = read(joined(record(1, "EPSG:4978", 0.5, turn), axes));
  CHECK(file.axes == Axes{});
  CHECK(file.crs == Crs{"EPSG:4978", {}});
  CHECK(file.origin == Origin{4194304.5, -555555.25, 4713930.125});
  REQUIRE(file.unused.size() == 2);
  CHECK(file.unused[1] == "epoch of the coordinate reference system (2026.75)");
  SplatCloud expected = coded;
  convert_axes(expected, kAxes3dgs, kAxesOpenGl);
  transform_splats(expected, {rotation_from_quaternion(turn), 0.5, {0, 0, 0}});
  CHECK(compare(file.cloud, expected).sum() == 0);

  // Without axes it starts from those of the description. A quarter turn, roughly, about the first axis.
  ReadOptions keep = kKeepAxes;
  const double half = std::sqrt(0.5);
  const Bytes quarter = record(0, "EPSG:4978", 1, {half, half + 1e-9, 0, 0});
  const auto turned = read_splats(with_extensions(plain, quarter), keep).value();
  CHECK(turned.axes == kAxesOpenGl);
  CHECK_FALSE(turned.axes_assumed);
  CHECK(turned.crs.axes == kAxesLcc);
  CHECK(turned.origin == Origin{4194304.5, 4713930.125, 555555.25});
  CHECK(compare(turned.cloud, coded).sum() == 0);
  // A slight turn is one: 2 cm at 2 km.
  const auto tilted = read_splats(with_extensions(plain, record(0, "EPSG:4978", 1, {1, 0, 0, 5e-6})), keep).value();
  CHECK(tilted.axes == Axes{});
  CHECK(compare(tilted.cloud, coded).sum() > 0);
  CHECK(read(record(2, "{\n}", 1, {1, 0, 0, 0})).crs.text == "{ }");

  for (const Bytes& bad :
       {record(0, "", 1, turn), record(0, "EPSG", 1, turn), record(2, "EPSG:4978", 1, turn), record(4, "A:1", 1, turn),
        record(2, "{\x80}", 1, turn), record(0, "A:1", 0, turn), record(0, "A:1", -1, turn),
        record(0, "A:1", std::nan(""), turn), record(0, "A:1", HUGE_VAL, turn), record(0, "A:1", 1, {1, 0, 0, 1}),
        record(0, "A:1", 1, turn, std::nan("")), record(0, "A:1", 1, turn, 1e13)}) {
    const SplatFile kept = read(joined(bad, axes));
    CHECK(compare(kept.cloud, coded).sum() == 0);
    CHECK(kept.origin == kNoOrigin);
    CHECK(kept.crs == Crs());
    REQUIRE(kept.unused.size() == 1);
    CHECK(kept.unused[0].starts_with("SPZ extension 0x4E530001 (georeference, "));
  }
}

TEST_CASE("damaged SPZ extensions are refused or read, but never crash") {
  const SplatCloud cloud = ordinary_cloud(3, 0, 5);
  WriteOptions placed = version(4);
  placed.crs.text = "EPSG:4978";
  const Bytes georeferenced = encode_splats(cloud.view(), SplatFormat::spz, placed).value();
  const Bytes records = joined(extension(kOrbit, Bytes(12)), Bytes(&georeferenced[32], &georeferenced[32] + 12 + 93));
  for (const int number : {2, 3, 4}) {
    const Bytes plain = encode_splats(cloud.view(), SplatFormat::spz, version(number)).value();
    check_hostile(with_extensions(plain, records), 3, 100);
    SplitMix random(static_cast<std::uint64_t>(number));
    for (int i = 0; i < 300; ++i) {  // the records alone, so that a checksum cannot hide them
      Bytes damaged = records;
      damaged[random.below(damaged.size())] = static_cast<std::byte>(random.below(256));
      damaged.resize(random.below(2) == 0 ? damaged.size() : random.below(damaged.size()));
      const Bytes bytes = with_extensions(plain, damaged);
      const auto file = read_exact(bytes);
      if (!file) CHECK(exit_code(file.error().code) == 4);
    }
  }
  // The size of an inflated gzip stream is bounded before it is kept.
  const Bytes plain = encode_splats(cloud.view(), SplatFormat::spz, version(3)).value();
  const auto bomb = read_exact(with_extensions(plain, Bytes((std::size_t{16} << 20) + 1)));
  REQUIRE_FALSE(bomb);
  CHECK(bomb.error().code == Errc::limit_exceeded);
}

TEST_CASE("SPZ's SH codes compensate for the errors of neighbours in space, wherever they are in the file") {
  SplatCloud cloud = ordinary_cloud(4000, 1, 9), reversed = cloud;
  SplitMix random(4);
  for (std::size_t i = 0; i < cloud.sh.size(); ++i) {
    if (i % 12 >= 3) cloud.sh[i] = (3 + static_cast<float>(random.below(900)) / 1000) / 128;  // the nearest code is 0
  }
  for (std::uint64_t i = 0; i < cloud.size(); ++i) reversed.set(cloud.size() - 1 - i, cloud.view().splat(i));
  const auto coded = [](const SplatCloud& scene) {
    return read_splats(encode_splats(scene.view(), SplatFormat::spz).value(), kKeepAxes).value().cloud;
  };
  const SplatCloud a = coded(cloud), b = coded(reversed);
  double error = 0;
  for (std::size_t i = 0; i < cloud.sh.size(); ++i) error += static_cast<double>(a.sh[i] - cloud.sh[i]);
  CHECK(std::abs(error / (9 * 4000)) < 0.2 / 128);  // -3.45 / 128 if each took the nearest
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    const Splat one = a.view().splat(i), other = b.view().splat(cloud.size() - 1 - i);
    REQUIRE(std::ranges::equal(one.sh, other.sh));
  }
}

TEST_CASE("SPZ spends fractional bits on distant means, and refuses means beyond all bits") {
  SplatCloud cloud = ordinary_cloud(3, 0, 1);
  cloud.mean[4] = -50000.F;
  const auto bytes = encode_splats(cloud.view(), SplatFormat::spz);
  REQUIRE(bytes);
  const auto file = read_splats(*bytes, kKeepAxes);
  REQUIRE(file);
  const SplatError e = compare(file->cloud, cloud);
  CHECK(e.mean[0] <= 0.5 / 128);  // 2^23 / 50,000 leaves 7 bits
  CHECK(e.mean[1] <= 0.5 / 128);
  cloud.mean[4] = 1e7F;
  const auto refused = encode_splats(cloud.view(), SplatFormat::spz);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::bad_value);
  CHECK(refused.error().offset == 1);
}

TEST_CASE("SPZ version 2 by hand") {
  const auto file = read_splats(gzip(hand_made_v2()), kKeepAxes);
  REQUIRE(file);
  const SplatCloud& c = file->cloud;
  REQUIRE(c.size() == 2);
  CHECK(file->aa_mode == AaMode::mip_splatting);
  CHECK(c.mean == std::vector<float>{1, -1.5F, 0, 8388607.F / 256, -32768, 1.F / 256});
  CHECK(c.log_scale == std::vector<float>{-10, 0, 5.9375F, -9, -8, -7});
  CHECK(c.opacity_logit[0] == logit_from_opacity(1));
  CHECK(opacity_from_logit(c.opacity_logit[1]) == doctest::Approx(0.2));
  CHECK(c.sh[0] == doctest::Approx(-0.5 / 0.15));
  CHECK(c.sh[1] == doctest::Approx(0.5 / 0.15));
  CHECK(c.sh[5] == doctest::Approx((0.8 - 0.5) / 0.15));
  CHECK(c.rotation[0] == doctest::Approx(1).epsilon(1e-4));
  CHECK(c.rotation[1] == doctest::Approx(128 / 127.5 - 1));
  CHECK(c.rotation[4] == 0);  // no room is left for w
  CHECK(c.rotation[5] == 1);
  CHECK(c.rotation[6] == -1);
}

TEST_CASE("damaged SPZ files of every version are refused or read, but never crash") {
  const SplatCloud cloud = ordinary_cloud(20, 1, 5);
  for (const int number : {2, 3, 4}) {
    check_hostile(encode_splats(cloud.view(), SplatFormat::spz, version(number)).value(), 1);
  }
  const Bytes v2 = gzip(hand_made_v2());
  check_hostile(v2, 2);
  CHECK(read_splats(v2));
  Bytes longer = v2;
  longer.push_back(std::byte{0});
  CHECK(read_splats(longer).error().code == Errc::trailing_bytes);
}

TEST_CASE("SPZ headers that declare too much are refused before allocating") {
  const auto refused = [](Bytes bytes, std::size_t offset, std::uint32_t value, Errc code) {
    CAPTURE(offset);
    std::memcpy(&bytes[offset], &value, 4);
    const auto file = read_splats(bytes);
    REQUIRE_FALSE(file);
    CHECK(file.error().code == code);
  };
  const Bytes v4 = encode_splats(ordinary_cloud(20, 1, 5).view(), SplatFormat::spz, version(4)).value();
  refused(v4, 8, 0xFFFFFFFF, Errc::limit_exceeded);
  refused(v4, 8, 21, Errc::size_mismatch);
  refused(v4, 4, 1, Errc::unsupported_version);
  refused(v4, 4, 5, Errc::unsupported_version);
  refused(v4, 16, 0xFFFFFFFF, Errc::bad_header);
  refused(v4, 20, 1, Errc::reserved_bits);
  refused(v4, 12, 0x06000C04, Errc::unsupported_feature);
  refused(v4, 12, 0x06800C01, Errc::reserved_bits);
  refused(v4, 32, 0xFFFFFFFF, Errc::truncated);
  for (const std::uint32_t n : {3U, 1000U, 100000000U, 0xFFFFFFFFU}) {
    Bytes v2 = hand_made_v2();
    std::memcpy(&v2[8], &n, 4);
    const auto file = read_splats(gzip(v2));
    REQUIRE_FALSE(file);
    CHECK(file.error().code == (n > 100000 ? Errc::limit_exceeded : Errc::truncated));
  }
}

TEST_CASE("the reader's defaults accept a file of equal Gaussians, and a caller's limits hold") {
  SplatCloud cloud;
  cloud.resize(300'000, 0);
  const Splat s = ordinary_cloud(1, 0, 5).view().splat(0);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) cloud.set(i, s);
  const auto bytes = encode_splats(cloud.view(), SplatFormat::spz);
  REQUIRE(bytes);
  CHECK(bytes->size() < 300'000 * 20 / 100);
  const auto file = read_splats(*bytes);
  REQUIRE(file);
  CHECK(file->cloud.size() == 300'000);
  ReadOptions options;
  options.limits.max_expansion = 2;
  CHECK(read_splats(*bytes, options).error().code == Errc::limit_exceeded);
  options.limits.max_expansion = 1032;
  options.limits.max_decoded_bytes = 5'000'000;
  CHECK(read_splats(*bytes, options).error().code == Errc::limit_exceeded);
}
