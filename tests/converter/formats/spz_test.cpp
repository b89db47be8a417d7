// spz_test.cpp - SPZ: the peer's files, round trips, older versions, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <zlib.h>

#include <array>
#include <cstring>

#include "interchange_samples.hpp"
#include "rgs/splat_edit.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// Half a step of each attribute, and what the smallest three leave to the fourth component; SH as given.
void check_within_steps(const SplatError& e, double sh1_step, double sh_step) {
  for (int k = 0; k < 3; ++k) {
    CHECK(e.mean[k] <= 0.5 / 4096 * 1.001);
    CHECK(e.log_scale[k] <= 0.5 / 16 * 1.001);
  }
  CHECK(e.opacity <= 0.5 / 255 * 1.001);
  CHECK(e.rotation <= 0.5 * 3 * 0.70711 / 511);
  CHECK(e.sh[0] <= 0.5 / 255 / 0.15 * 1.001);
  CHECK(e.sh[1] <= sh1_step / 128 * 1.001);
  CHECK(e.sh[2] <= sh_step / 128 * 1.001);
  CHECK(e.sh[3] <= sh_step / 128 * 1.001);
}

// As SPZ versions 2 and 3 frame them: header and body in one gzip stream.
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

}  // namespace

TEST_CASE("SPZ files of versions 3 and 4 by the peer hold the PLY's Gaussians within the format's steps") {
  if (!has_peer_files()) return;
  const SplatCloud original = read_splats(peer_file("crop.ply")).value().cloud;
  for (const std::string name : {"crop.v3.spz", "crop.v4.spz"}) {
    CAPTURE(name);
    const auto file = read_splats(peer_file(name));
    REQUIRE(file);
    CHECK(file->format == SplatFormat::spz);
    CHECK(file->axes == kAxes3dgs);
    CHECK(file->aa_mode == AaMode::classic);
    // Log-scales below -10 do not exist in SPZ; compare what does. The peer rounds SH twice: 4.5 and 8.5 of 128.
    SplatCloud clamped = original;
    for (float& value : clamped.log_scale) value = std::max(value, -10.F);
    for (std::size_t i = 0; i < clamped.sh.size(); ++i) {
      if (i / 3 % 16 == 0) clamped.sh[i] = std::clamp(clamped.sh[i], -0.5F / 0.15F, 0.5F / 0.15F);
    }
    check_within_steps(compare(file->cloud, clamped), 4.5, 8.5);
  }
}

TEST_CASE("SPZ version 4 round trip within half a step, 0.62 of SH, whatever the degree") {
  for (int degree = 0; degree <= 3; ++degree) {
    for (const std::uint64_t n : {0U, 1U, 2U, 1000U}) {
      CAPTURE(degree);
      CAPTURE(n);
      const SplatCloud cloud = ordinary_cloud(n, degree, n + 7);
      const auto bytes = encode_splats(cloud.view(), SplatFormat::spz, {.aa_mode = AaMode::mip_splatting});
      REQUIRE(bytes);
      const auto file = read_splats(*bytes, kKeepAxes);
      REQUIRE(file);
      CHECK(file->axes == kAxesOpenGl);
      CHECK(file->aa_mode == AaMode::mip_splatting);
      CHECK(file->bytes == bytes->size());
      CHECK(get<std::uint8_t>(*bytes, 15) == (degree == 0 ? 5 : 6));  // streams: the peer wants no empty one
      check_within_steps(compare(file->cloud, cloud), 4.96, 9.92);
      const auto again = encode_splats(file->cloud.view(), SplatFormat::spz, {.aa_mode = AaMode::mip_splatting});
      REQUIRE(again);  // decoded values give the same codes; a rotation may change which of two equals is the largest
      const SplatError e = compare(read_splats(*again, kKeepAxes).value().cloud, file->cloud);
      CHECK(e.sum() == e.rotation);
      CHECK(e.rotation <= 0.70711 / 511);
    }
  }
}

TEST_CASE("SPZ's SH codes make up for the errors of neighbours in space, wherever these stand in the file") {
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

TEST_CASE("SPZ gives up fractional bits for distant means, and refuses what no bits can hold") {
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

TEST_CASE("damaged SPZ files of every version are refused or read, never more") {
  const SplatCloud cloud = ordinary_cloud(20, 1, 5);
  check_hostile(encode_splats(cloud.view(), SplatFormat::spz).value(), 1);
  const Bytes v2 = gzip(hand_made_v2());
  check_hostile(v2, 2);
  CHECK(read_splats(v2));
  Bytes longer = v2;
  longer.push_back(std::byte{0});
  CHECK(read_splats(longer).error().code == Errc::trailing_bytes);
}

TEST_CASE("SPZ headers that promise too much are refused before memory is taken") {
  const auto refused = [](Bytes bytes, std::size_t offset, std::uint32_t value, Errc code) {
    CAPTURE(offset);
    std::memcpy(&bytes[offset], &value, 4);
    const auto file = read_splats(bytes);
    REQUIRE_FALSE(file);
    CHECK(file.error().code == code);
  };
  const Bytes v4 = encode_splats(ordinary_cloud(20, 1, 5).view(), SplatFormat::spz).value();
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

TEST_CASE("a file of equal Gaussians is read by the reader's defaults, and a caller's limits are kept") {
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
