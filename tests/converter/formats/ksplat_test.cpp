// ksplat_test.cpp - .ksplat: files built from the format's layout, all levels and degrees, buckets, hostile files; files
// that are written.
// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "complexity.hpp"
#include "interchange_samples.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr double kBucketWidth = 5, kCodeRange = 32767;
constexpr std::uint64_t kBucketSize = 4;

template <class T>
void add(Bytes& bytes, T value) {
  const auto raw = std::as_bytes(std::span(&value, 1));
  bytes.insert(bytes.end(), raw.begin(), raw.end());
}

void add_number(Bytes& bytes, float value, int level) {
  level == 0 ? add(bytes, value) : add(bytes, half_from_float(value));
}

std::uint8_t byte_of(double value) {
  return static_cast<std::uint8_t>(std::clamp(value * 255 + 0.5, 0.0, 255.0));
}

void add_record(Bytes& bytes, const Splat& s, int level, int degree, const float (&centre)[3]) {
  for (int k = 0; k < 3; ++k) {
    if (level == 0) {
      add(bytes, s.mean[k]);
    } else {
      const double offset = static_cast<double>(s.mean[k] - centre[k]) * 2 * kCodeRange / kBucketWidth;
      add(bytes, static_cast<std::uint16_t>(std::lround(offset) + 32767));
    }
  }
  for (const float x : s.log_scale) add_number(bytes, std::exp(x), level);
  for (const float x : s.rotation) add_number(bytes, x, level);
  for (int k = 0; k < 3; ++k) add(bytes, byte_of(0.5 + 0.28209479 * static_cast<double>(s.sh[k])));
  add(bytes, byte_of(static_cast<double>(opacity_from_logit(s.opacity_logit))));
  for (int d = 1; d <= degree; ++d) {
    for (int c = 0; c < 3; ++c) {
      for (int k = d * d; k < (d + 1) * (d + 1); ++k) {
        const float value = s.sh[3 * k + c];
        level == 2 ? add(bytes, byte_of((static_cast<double>(value) + 1.5) / 3)) : add_number(bytes, value, level);
      }
    }
  }
}

struct Layout {
  int level = 0, degree = 0;
  std::uint64_t n_full = 0;            ///< buckets of kBucketSize
  std::vector<std::uint32_t> partial;  ///< sizes of partly filled buckets
  std::uint32_t room = 0;              ///< room after the Gaussians
};

// One section; Gaussians fill the buckets in order, centred at their first Gaussian.
void add_section(Bytes& headers, Bytes& data, const SplatCloud& cloud, const Layout& layout) {
  const auto n = static_cast<std::uint32_t>(cloud.size());
  const auto n_buckets = static_cast<std::uint32_t>(layout.n_full + layout.partial.size());
  const std::size_t at = headers.size();
  headers.resize(at + 1024);
  put(headers, at, n);
  put(headers, at + 4, n + layout.room);
  if (layout.level > 0) {
    put(headers, at + 8, static_cast<std::uint32_t>(kBucketSize));
    put(headers, at + 12, n_buckets);
    put(headers, at + 16, static_cast<float>(kBucketWidth));
    put(headers, at + 20, std::uint16_t{12});
    put(headers, at + 24, static_cast<std::uint32_t>(kCodeRange));
    put(headers, at + 32, static_cast<std::uint32_t>(layout.n_full));
    put(headers, at + 36, static_cast<std::uint32_t>(layout.partial.size()));
  }
  put(headers, at + 40, static_cast<std::uint16_t>(layout.degree));
  std::vector<std::uint64_t> starts;
  std::uint64_t next = 0;
  if (layout.level > 0) {
    for (std::uint64_t b = 0; b < layout.n_full; ++b) starts.push_back(next), next += kBucketSize;
    for (const std::uint32_t length : layout.partial) {
      add(data, length);
      starts.push_back(next);
      next += length;
    }
    REQUIRE(next >= n);
    for (const std::uint64_t start : starts) {
      for (int k = 0; k < 3; ++k) add(data, cloud.mean[3 * start + static_cast<std::uint64_t>(k)]);
    }
  }
  Bytes records;
  std::size_t bucket = 0;
  for (std::uint64_t i = 0; i < n; ++i) {
    while (bucket + 1 < starts.size() && starts[bucket + 1] <= i) ++bucket;
    float centre[3] = {0, 0, 0};
    if (!starts.empty()) std::copy_n(&cloud.mean[3 * starts[bucket]], 3, centre);
    add_record(records, cloud.view().splat(i), layout.level, layout.degree, centre);
  }
  records.resize(records.size() / n * (n + layout.room));
  data.insert(data.end(), records.begin(), records.end());
}

Bytes ksplat(const std::vector<std::pair<SplatCloud, Layout>>& sections, std::uint32_t spare_headers = 0) {
  Bytes file(4096), data;
  const auto n_sections = static_cast<std::uint32_t>(sections.size());
  file[1] = std::byte{1};
  put(file, 4, n_sections + spare_headers);
  put(file, 8, n_sections);
  std::uint32_t n = 0, room = 0;
  for (const auto& [cloud, layout] : sections) {
    n += static_cast<std::uint32_t>(cloud.size());
    room += static_cast<std::uint32_t>(cloud.size()) + layout.room;
  }
  put(file, 12, room);
  put(file, 16, n);
  put(file, 20, static_cast<std::uint16_t>(sections[0].second.level));
  put(file, 36, -1.5F);
  put(file, 40, 1.5F);
  for (const auto& [cloud, layout] : sections) add_section(file, data, cloud, layout);
  file.resize(file.size() + 1024 * spare_headers);
  file.insert(file.end(), data.begin(), data.end());
  return file;
}

// Means within a bucket's range of each other.
SplatCloud near_cloud(std::uint64_t n, int degree, std::uint64_t seed) {
  SplatCloud cloud = ordinary_cloud(n, degree, seed);
  for (float& x : cloud.mean) x /= 8;
  return cloud;
}

void check_within_steps(const SplatError& e, int level) {
  for (int k = 0; k < 3; ++k) {
    CHECK(e.mean[k] <= (level == 0 ? 0 : 0.501 * kBucketWidth / 2 / kCodeRange));
    CHECK(e.log_scale[k] <= (level == 0 ? 1e-6 : 0x1p-11));
  }
  CHECK(e.rotation <= (level == 0 ? 1e-6 : 2 * 0x1p-12));
  CHECK(e.opacity <= 0.501 / 255);
  CHECK(e.sh[0] <= 0.501 / 255 / 0.28209479);
  for (int d = 1; d <= 3; ++d) CHECK(e.sh[d] <= (level == 0 ? 0 : level == 1 ? 0x1p-12 : 0.501 * 3 / 255));
}

}  // namespace

TEST_CASE(".ksplat of all levels and degrees") {
  for (int level = 0; level <= 2; ++level) {
    for (int degree = 0; degree <= 3; ++degree) {
      CAPTURE(level);
      CAPTURE(degree);
      const SplatCloud cloud = near_cloud(17, degree, 5);
      const auto file = read_splats(ksplat({{cloud, {level, degree, 3, {2, 3}, 0}}}));
      REQUIRE(file);
      CHECK(file->format == SplatFormat::ksplat);
      check_within_steps(compare(file->cloud, cloud), level);
    }
  }
}

TEST_CASE(".ksplat with several sections, spare room and different degrees") {
  for (int level = 0; level <= 2; ++level) {
    CAPTURE(level);
    const SplatCloud a = near_cloud(5, 2, 6), b = near_cloud(8, 0, 7), c = near_cloud(3, 1, 8);
    const auto file = read_splats(
        ksplat({{a, {level, 2, 1, {1}, 3}}, {b, {level, 0, 2, {}, 0}}, {c, {level, 1, 0, {1, 1, 1}, 9}}}, 2));
    REQUIRE(file);
    REQUIRE(file->cloud.size() == 16);
    CHECK(file->cloud.sh_degree == 2);
    std::uint64_t at = 0;
    for (const SplatCloud* part : {&a, &b, &c}) {
      for (std::uint64_t i = 0; i < part->size(); ++i, ++at) {
        check_within_steps(compare(file->cloud.view().splat(at), part->view().splat(i), part->sh_degree), level);
      }
    }
    CHECK(file->cloud.sh[27 * 6 + 3] == 0);  // b has no harmonics of its own
  }
}

TEST_CASE(".ksplat: a partly loaded file holds fewer Gaussians than it has room for, as in GaussianSplats3D") {
  for (int level = 0; level <= 2; ++level) {
    CAPTURE(level);
    const SplatCloud a = near_cloud(6, 1, 9), b = near_cloud(3, 1, 10);
    const Bytes file = ksplat({{a, {level, 1, 1, {2}, 0}}, {b, {level, 1, 0, {3}, 0}}});
    // Gaussians read from each section; empty if the file is refused.
    using Counts = std::pair<std::uint64_t, std::uint64_t>;
    const auto check = [&](const std::vector<std::pair<std::size_t, std::uint32_t>>& edits,
                           const std::optional<Counts>& counts) {
      Bytes edited = file;
      for (const auto& [at, value] : edits) put(edited, at, value);
      CHECK(detect_format(edited) == SplatFormat::ksplat);
      const auto read = read_splats(edited);
      REQUIRE(read.has_value() == counts.has_value());
      if (!read) {
        CHECK(std::string(errc_name(read.error().code)) == "bad_header");
        CHECK((read.error().offset == 12 || read.error().offset == 16));
        return;
      }
      REQUIRE(read->cloud.size() == counts->first + counts->second);
      const SplatView all = read->cloud.view();
      for (std::uint64_t i = 0; i < all.n; ++i) {
        const bool in_a = i < counts->first;
        check_within_steps(compare(all.splat(i), (in_a ? a : b).view().splat(in_a ? i : i - counts->first), 1), level);
      }
    };
    constexpr std::size_t kLoaded = 8, kRoom = 12, kN = 16, kA = 4096, kB = 4096 + 1024;
    check({}, Counts(6, 3));
    check({{kLoaded, 0}}, Counts(6, 3));  // the sections are still there
    check({{kLoaded, 1}}, Counts(6, 3));
    check({{kLoaded, 0}, {kN, 0}}, Counts(6, 3));
    check({{kLoaded, 0}, {kN, 0}, {kA, 0}, {kB, 0}}, Counts(6, 3));
    check({{kA, 2}}, Counts(6, 3));                // streamed: the section counts its first part
    check({{kA, 2}, {kN, 5}}, Counts(2, 3));       // loaded so far, by its own count
    check({{kLoaded, 1}, {kN, 6}}, Counts(6, 0));  // the second section was not reached
    check({{kA, 2}, {kN, 6}}, std::nullopt);
    check({{kN, 8}}, std::nullopt);
    check({{kN, 10}}, std::nullopt);
    check({{kN, 0}, {kRoom, 0}}, std::nullopt);
    check({{kN, 0}, {kRoom, 8}}, std::nullopt);
  }
}

TEST_CASE(".ksplat: an empty scene is one that declares none") {
  Bytes file(4096 + 1024);
  file[1] = std::byte{1};
  put(file, 4, 1U);
  const auto empty = read_splats(file);
  REQUIRE(empty);
  CHECK(empty->cloud.size() == 0);
  put(file, 12, 4U);
  const auto promised = read_splats(file);
  REQUIRE_FALSE(promised);
  CHECK(promised.error().offset == 12);
  CHECK(promised.error().expected == 4);
  CHECK(promised.error().found == 0);
  put(file, 4, 0U);  // no sections
  CHECK_FALSE(read_splats(file, {{}, SplatFormat::ksplat, true}));
}

TEST_CASE(".ksplat: buckets hold the section's Gaussians, and nothing follows the last section") {
  const Bytes file = ksplat({{near_cloud(6, 1, 9), {1, 1, 1, {2}, 0}}});
  const auto refused = [&](const Bytes& edited, Errc code, std::uint64_t offset) {
    const auto read = read_splats(edited, {{}, SplatFormat::ksplat, true});
    REQUIRE_FALSE(read);
    CHECK(std::string(errc_name(read.error().code)) == errc_name(code));
    CHECK(read.error().offset == offset);
  };
  for (const std::uint32_t length : {0U, 1U, 3U, 0xFFFFFFFFU}) {  // of the partly filled bucket
    Bytes edited = file;
    put(edited, 4096 + 1024, length);
    refused(edited, Errc::bad_header, 4096 + 32);
  }
  for (const std::uint32_t size : {3U, 5U}) {  // of the full bucket
    Bytes edited = file;
    put(edited, 4096 + 8, size);
    refused(edited, Errc::bad_header, 4096 + 32);
  }
  Bytes longer = file;
  longer.resize(file.size() + 4);
  refused(longer, Errc::trailing_bytes, file.size());
}

TEST_CASE("growth: .ksplat: reading is linear in sections and buckets, empty ones too") {
  const SplatCloud one = near_cloud(1, 0, 3);
  const auto read = [](const Bytes& file) { CHECK(read_splats(file)); };
  const auto sections = [&](std::uint64_t n) {
    return ksplat(std::vector<std::pair<SplatCloud, Layout>>(n, {one, {1, 0, 0, {1}, 0}}));
  };
  CHECK(growth(200, sections, read) < kLinearGrowth);
  const auto buckets = [&](std::uint64_t n) {
    Bytes file = ksplat({{one, {1, 0, 0, {1}, 0}}});
    put(file, 4096 + 12, static_cast<std::uint32_t>(n));
    put(file, 4096 + 36, static_cast<std::uint32_t>(n));
    put(file, 4096 + 1024, 0U);
    Bytes more(16 * (n - 1));
    put(more, 4 * (n - 2), 1U);  // all but the last are empty
    file.insert(file.begin() + 4096 + 1024 + 4, more.begin(), more.end());
    return file;
  };
  CHECK(growth(5000, buckets, read) < kLinearGrowth);
}

// ---- writing --------------------------------------------------------------------------------------------------------

TEST_CASE(".ksplat: written Gaussians come back within half a step of level 1, degree 3 without its harmonics") {
  for (int degree = 0; degree <= 3; ++degree) {
    CAPTURE(degree);
    const SplatCloud cloud = ordinary_cloud(900, degree, 21);
    WriteReport report;
    const Bytes bytes = encode_splats(cloud.view(), SplatFormat::ksplat, {}, &report).value();
    CHECK(report.sh.n == (degree == 3 ? 900 : 0));
    CHECK((report.sh.largest > 0.9) == (degree == 3));
    CHECK(report.log_scale.n + report.sh_dc.n + report.mean.n + report.opacity_logit.n == 0);
    const auto file = read_splats(bytes);
    REQUIRE(file);
    REQUIRE(file->cloud.size() == 900);
    CHECK(file->cloud.sh_degree == std::min(degree, 2));
    SplatError step;
    std::ranges::fill(step.mean, kBucketWidth / 2 / kCodeRange);
    Matcher matcher(cloud);
    for (std::uint64_t i = 0; i < 900; ++i) {
      const Splat s = file->cloud.view().splat(i);
      check_within_steps(compare(s, cloud.view().splat(matcher.nearest(s, step)), std::min(degree, 2)), 1);
    }
    CHECK(matcher.n_found() == 900);
  }
}

TEST_CASE(".ksplat: header, buckets and a record are those of GaussianSplats3D, byte for byte") {
  // 300 Gaussians in the cube of the smallest coordinates, 3 in the next but one along x, 2 in the next along z.
  SplatCloud cloud = ordinary_cloud(305, 1, 22);
  for (std::uint64_t i = 0; i < 305; ++i) {
    const bool along_x = i % 100 == 50, along_z = i == 7 || i == 300;
    for (std::uint64_t k = 0; k < 3; ++k) cloud.mean[3 * i + k] = static_cast<float>(k + 1) + static_cast<float>(i % 4);
    if (along_x) cloud.mean[3 * i] += 10;
    if (along_z) cloud.mean[3 * i + 2] += 5;
  }
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::ksplat).value();
  const auto u32 = [&](std::size_t at) { return get<std::uint32_t>(bytes, at); };
  const auto u16 = [&](std::size_t at) { return get<std::uint16_t>(bytes, at); };
  const auto f32 = [&](std::size_t at) { return get<float>(bytes, at); };
  CHECK(u32(0) == 0x100);  // version 0.1
  for (const std::size_t at : {4U, 8U}) CHECK(u32(at) == 1);
  for (const std::size_t at : {12U, 16U, 4096U, 4100U}) CHECK(u32(at) == 305);
  CHECK(u16(20) == 1);
  for (const std::size_t at : {24U, 28U, 32U}) CHECK(f32(at) == 0);  // the scene's centre
  float low = 0, high = 0;
  for (std::size_t i = 0; i < cloud.sh.size(); ++i) {
    if (i % 12 >= 3) low = std::min(low, cloud.sh[i]), high = std::max(high, cloud.sh[i]);
  }
  CHECK(f32(36) == low);
  CHECK(f32(40) == high);
  CHECK(u32(4096 + 8) == 256);
  CHECK(u32(4096 + 12) == 4);  // buckets
  CHECK(f32(4096 + 16) == 5);
  CHECK(u16(4096 + 20) == 12);
  CHECK(u32(4096 + 24) == 32767);
  CHECK(u32(4096 + 28) == bytes.size() - 5120);
  CHECK(u32(4096 + 32) == 1);
  CHECK(u32(4096 + 36) == 3);
  CHECK(u16(4096 + 40) == 1);
  CHECK(bytes.size() == 5120 + 3 * 4 + 4 * 12 + 305 * 42);
  for (const std::size_t at : {22U, 44U, 4095U, 4096U + 42, 5119U}) CHECK(bytes[at] == std::byte{0});
  const std::array<std::uint32_t, 3> lengths{44, 2, 3};
  for (std::size_t b = 0; b < 3; ++b) CHECK(u32(5120 + 4 * b) == lengths[b]);
  const float centres[4][3] = {{3.5F, 4.5F, 5.5F}, {3.5F, 4.5F, 5.5F}, {3.5F, 4.5F, 10.5F}, {13.5F, 4.5F, 5.5F}};
  for (std::size_t i = 0; i < 12; ++i) CHECK(f32(5132 + 4 * i) == centres[i / 3][i % 3]);
  // The third along z's first Gaussian, 7, at the corner of its bucket farthest along x.
  const std::size_t record = 5180 + 42 * 300;
  const Splat s = cloud.view().splat(7);
  for (std::size_t k = 0; k < 3; ++k) {
    CHECK(u16(record + 2 * k) == 32767 + std::lround(0.5 * 32767 / 2.5));
    CHECK(u16(record + 6 + 2 * k) == half_from_float(std::exp(s.log_scale[k])));
    CHECK(bytes[record + 20 + k] == static_cast<std::byte>(byte_of(0.5 + 0.28209479 * static_cast<double>(s.sh[k]))));
  }
  for (std::size_t k = 0; k < 4; ++k) CHECK(u16(record + 12 + 2 * k) == half_from_float(s.rotation[k]));
  CHECK(bytes[record + 23] ==
        static_cast<std::byte>(byte_of(static_cast<double>(opacity_from_logit(s.opacity_logit)))));
  for (std::size_t k = 0; k < 9; ++k) CHECK(u16(record + 24 + 2 * k) == half_from_float(s.sh[3 + k % 3 * 3 + k / 3]));
}

TEST_CASE(".ksplat: what FP16 and colours of 8 bits cannot hold is clamped and counted, and flat Gaussians stay flat") {
  SplatCloud cloud = ordinary_cloud(5, 1, 23);
  cloud.log_scale[0] = 12;  // FP16 ends at exp(11.09)
  cloud.log_scale[4] = -17;
  cloud.log_scale[8] = -std::numeric_limits<float>::infinity();
  cloud.sh[12 * 3] = 3;
  cloud.sh[12 * 4 + 5] = -70000;
  for (float& x : cloud.mean) x += 3e6F;  // FP32 has quarters there
  WriteReport report;
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::ksplat, {}, &report).value();
  CHECK(report.log_scale.n == 2);
  CHECK(report.log_scale.largest == doctest::Approx(12 - std::log(65504.0)));
  CHECK(report.sh_dc.n == 1);
  CHECK(report.sh_dc.largest == doctest::Approx(3 - 0.5 / 0.28209479));
  CHECK(report.sh.n == 1);
  CHECK(report.sh.largest == doctest::Approx(70000 - 65504));
  CHECK(encode_splats(cloud.view(), SplatFormat::ksplat, {.strict = true}).error().code == Errc::bad_value);
  const SplatCloud copy = read_splats(bytes).value().cloud;
  Matcher matcher(copy);
  SplatError step;
  std::ranges::fill(step.mean, 0.125);
  for (std::uint64_t i = 0; i < 5; ++i) {
    const Splat s = copy.view().splat(matcher.nearest(cloud.view().splat(i), step));
    for (int k = 0; k < 3; ++k) {
      CHECK(std::abs(s.mean[k] - cloud.mean[3 * i + static_cast<std::uint64_t>(k)]) <= 0.25F);
      const float log_scale = cloud.log_scale[3 * i + static_cast<std::uint64_t>(k)];
      CHECK(s.log_scale[k] ==
            doctest::Approx(std::clamp(log_scale, std::log(0x1p-24F), std::log(65504.F))).epsilon(1e-3));
    }
  }
}

TEST_CASE(".ksplat: an empty scene, and one in a plane across many cubes, where GaussianSplats3D mixes buckets up") {
  SplatCloud none;
  none.resize(0, 1);
  const auto empty = read_splats(encode_splats(none.view(), SplatFormat::ksplat).value());
  REQUIRE(empty);
  CHECK(empty->cloud.size() == 0);
  SplatCloud plane = ordinary_cloud(40, 0, 24);
  for (std::uint64_t i = 0; i < 40; ++i) {
    plane.mean[3 * i] = 7.F * static_cast<float>(i / 2);
    plane.mean[3 * i + 1] = 5.F * static_cast<float>(i % 2);
    plane.mean[3 * i + 2] = 1;
  }
  const SplatCloud copy = read_splats(encode_splats(plane.view(), SplatFormat::ksplat).value()).value().cloud;
  CHECK(compare(copy, plane).mean[0] <= 0.501 * kBucketWidth / 2 / kCodeRange + 1e-5);
  CHECK(compare(copy, plane).mean[1] <= 0.501 * kBucketWidth / 2 / kCodeRange + 1e-5);
}

TEST_CASE(".ksplat: a Gaussian however far out leaves the others where they are") {
  SplatCloud cloud = ordinary_cloud(3, 0, 25);
  cloud.mean = {-1e30F, -1e20F, -1e17F, 3, 1, 2, 1000, 1, 2};
  const SplatCloud copy = read_splats(encode_splats(cloud.view(), SplatFormat::ksplat).value()).value().cloud;
  for (std::size_t i = 0; i < 9; ++i) CHECK(copy.mean[i] == doctest::Approx(cloud.mean[i]).epsilon(1e-4));
}

TEST_CASE("damaged .ksplat files are refused or read, but never crash") {
  const Bytes file = ksplat({{near_cloud(6, 1, 9), {1, 1, 1, {2}, 0}}});
  for (std::size_t size = 0; size < file.size(); ++size) {
    CAPTURE(size);
    check_refusal(read_exact(std::span(file).first(size)), size);
    check_refusal(read_splats(std::span(file).first(size), {{}, SplatFormat::ksplat, true}), size);
  }
  SplitMix random(10);
  for (int i = 0; i < 600; ++i) {
    Bytes damaged = file;
    const std::uint64_t place = random.below(3);
    damaged[place == 0   ? random.below(48)
            : place == 1 ? 4096 + random.below(48)
                         : random.below(file.size())] = static_cast<std::byte>(random.below(256));
    const auto read = read_exact(damaged);
    if (!read) check_refusal(read, damaged.size());
    if (read) CHECK(read->cloud.size() <= damaged.size() / 24);
  }
}

TEST_CASE(".ksplat headers that declare too much are refused") {
  const Bytes file = ksplat({{near_cloud(6, 1, 9), {1, 1, 1, {2}, 0}}});
  for (const std::size_t at : {4U, 8U, 4096U, 4100U, 4108U, 4128U, 4132U}) {
    for (const std::uint32_t value : {7U, 1000000U, 0xFFFFFFFFU}) {
      CAPTURE(at);
      CAPTURE(value);
      Bytes damaged = file;
      put(damaged, at, value);
      const auto read = read_splats(damaged);
      check_refusal(read, damaged.size());
      check_refusal(read_splats(damaged, {{}, SplatFormat::ksplat, true}), damaged.size());
    }
  }
}
