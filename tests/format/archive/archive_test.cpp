// archive_test.cpp - Profile::archive: decodes within its stated bounds, in one way only, and refuses everything else.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numbers>
#include <numeric>

#include "archive/archive_codec.hpp"
#include "archive/archive_encode.hpp"
#include "archive/archive_tables.hpp"
#include "archive/point_codec.hpp"
#include "archive/rans.hpp"
#include "edit_file.hpp"
#include "plausible_cloud.hpp"
#include "random_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/quantize.hpp"

using namespace rgs;
using namespace rgs::test;
using rgs::detail::verify_archive;

namespace {

EncodeOptions archive_options(const ArchiveOptions& archive = archive_high()) {
  EncodeOptions options;
  options.profile = Profile::archive;
  options.archive = archive;
  options.keep_permutation = true;
  return options;
}

Bytes encode_archive_file(const SplatCloud& cloud, const EncodeOptions& options) {
  auto bytes = encode(cloud.view(), options);
  REQUIRE_MESSAGE(bytes, bytes.error().what);
  return std::move(*bytes);
}

std::vector<std::uint32_t> source_order(const FileView& view) {
  std::vector<std::uint32_t> order(view.header().n_gaussians);
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = static_cast<std::uint32_t>(view.source_index(i));
  return order;
}

bool same(std::span<const std::byte> a, std::span<const std::byte> b) {
  return std::ranges::equal(a, b);
}

// Degrees of SH by which a rotation takes one unit quaternion to another.
double angle(const float a[4], const float b[4]) {
  double dot = 0, aa = 0, bb = 0;
  for (int i = 0; i < 4; ++i) {
    dot += static_cast<double>(a[i]) * static_cast<double>(b[i]);
    aa += static_cast<double>(a[i]) * static_cast<double>(a[i]);
    bb += static_cast<double>(b[i]) * static_cast<double>(b[i]);
  }
  return 2 * std::acos(std::min(1.0, std::abs(dot) / std::sqrt(aa * bb)));
}

// What the steps guarantee for any class: the stated bounds must not be worse.
void check_stated(const ArchiveParameters& p) {
  CHECK(p.bound_mean <= std::ldexp(0.5, -static_cast<int>(p.mean_cells)) * 1.01);
  CHECK(p.bound_opacity <= 0.5 / p.opacity_levels + 0x1p-11);
  for (const ArchiveClass& c : p.classes) {
    const double worst = std::sqrt(3.0) / 2 + std::sqrt(3.0) / 2 * static_cast<double>(c.rotation_step);
    if (worst < 1) CHECK(c.bound_rotation <= 2 * (std::asin(worst) - std::numbers::pi / 3) + 0x1p-8);
    CHECK(c.bound_scale <= c.scale_step / 65536.0 * std::numbers::ln2 / 2 + 0x1p-10);
    CHECK(c.bound_dc <= c.dc_step / 65536.0 * std::sqrt(3.0) / 2 + 0.03);
    CHECK(c.bound_sh <= static_cast<double>(c.sh_step) / 2 * std::sqrt(45.0) + 0.001);
  }
}

}  // namespace

TEST_CASE("archives decode to whole direct data within their bounds, on any number of threads") {
  SplitMix random{101};
  for (const std::uint64_t n : {1u, 2u, 31u, 64u, 65u, 600u, 5000u, 33000u}) {
    for (const int degree : {0, 1, 2, 3}) {
      if (n > 10000 && degree != 2) continue;
      CAPTURE(n);
      CAPTURE(degree);
      const SplatCloud cloud = plausible_cloud(n, degree, random);
      EncodeOptions options = archive_options(n % 2 == 0 ? archive_small() : archive_high());
      options.chunk_size = n == 65 ? 32 : n == 600 ? 96 : 256;
      options.chunk_step_sets = n != 64;
      const Bytes bytes = encode_archive_file(cloud, options);
      const auto view = FileView::open(bytes);
      REQUIRE(view);
      CHECK(view->header().version_minor == 2);
      CHECK(view->header().n_gaussians == n);
      REQUIRE(validate(*view));
      REQUIRE(view->archive() != nullptr);
      check_stated(*view->archive());
      const auto order = source_order(*view);
      CHECK(verify_archive(bytes, cloud.view(), order));

      // Independent of the encoder's check: every value against the worst class.
      const ArchiveParameters& p = *view->archive();
      ArchiveClass worst;
      for (const ArchiveClass& c : p.classes) {
        worst.bound_rotation = std::max(worst.bound_rotation, c.bound_rotation);
        worst.bound_scale = std::max(worst.bound_scale, c.bound_scale);
        worst.bound_dc = std::max(worst.bound_dc, c.bound_dc);
        worst.bound_sh = std::max(worst.bound_sh, c.bound_sh);
      }
      const auto one = load_direct(*view, {true, 1}), two = load_direct(*view, {true, 2});
      REQUIRE(one);
      REQUIRE(two);
      CHECK(same(one->means(), two->means()));
      CHECK(same(one->geometry(), two->geometry()));
      CHECK(same(one->sh(), two->sh()));
      std::vector<Splat> decoded(n);
      REQUIRE(one->read(0, decoded));
      for (std::size_t i = 0; i < n; ++i) {
        const Splat source = cloud.view().splat(order[i]);
        const Splat& d = decoded[i];
        REQUIRE(std::ranges::equal(archive_mean(p, source.mean), d.mean));
        const ShStepSet steps = view->chunk_steps(i / options.chunk_size).value();
        for (std::size_t k = 0; k < 3; ++k) {
          const double reach = std::max(p.half_width[k], std::abs(static_cast<double>(d.mean[k]) - p.centre[k]));
          REQUIRE(std::abs(d.mean[k] - source.mean[k]) <= p.bound_mean * reach + 1e-6);
          REQUIRE(std::abs(d.log_scale[k] - source.log_scale[k]) <= worst.bound_scale + 1e-5f);
        }
        REQUIRE(angle(d.rotation, source.rotation) <= worst.bound_rotation + 1e-3);
        REQUIRE(std::abs(opacity_from_logit(d.opacity_logit) - opacity_from_logit(source.opacity_logit)) <=
                p.bound_opacity + 1e-4f);
        for (int k = 0; k < 3 * sh_coefficients(degree); ++k) {
          const float bound = k < 3 ? worst.bound_dc : worst.bound_sh;
          REQUIRE(std::abs(d.sh[k] - source.sh[k]) <= bound + 0.501f * steps.of_value(k));
        }
      }
    }
  }
}

TEST_CASE("an archive does not depend on the number of threads") {
  SplitMix random{102};
  const SplatCloud cloud = plausible_cloud(70000, 1, random);
  EncodeOptions options = archive_options();
  options.archive.threads = 1;
  const Bytes one = encode_archive_file(cloud, options);
  for (const unsigned threads : {2u, 5u}) {
    options.archive.threads = threads;
    CHECK(encode_archive_file(cloud, options) == one);
  }
}

TEST_CASE("verification refuses a source beyond the bounds, and bounds below the errors") {
  SplitMix random{103};
  SplatCloud cloud = plausible_cloud(3000, 1, random);
  Bytes bytes = encode_archive_file(cloud, archive_options());
  const auto order = source_order(*FileView::open(bytes));
  REQUIRE(verify_archive(bytes, cloud.view(), order));
  const auto refused = [&](const SplatCloud& source) {
    const Status s = verify_archive(bytes, source.view(), order);
    REQUIRE_FALSE(s);
    CHECK(s.error().code == Errc::internal);
    CHECK(order[s.error().offset] == 1234);
  };
  for (std::vector<float> SplatCloud::*values :
       {&SplatCloud::mean, &SplatCloud::log_scale, &SplatCloud::opacity_logit, &SplatCloud::sh}) {
    SplatCloud other = cloud;
    (other.*values)[(other.*values).size() / 3000 * 1234] += 3;
    refused(other);
  }
  SplatCloud turned = cloud;
  for (std::size_t k = 0; k < 4; ++k)
    turned.rotation[4 * 1234 + k] = k == 0 ? 1.f : 2.f * cloud.rotation[4 * 1234 + 3 - k];
  refused(turned);

  // A false stated bound: that of means is the f32 at byte 96 of ARCH.
  const std::uint64_t at = section_of(bytes, "ARCH") + 96;
  put(bytes, at, get<float>(bytes, at) * 0.99f);
  fix_hashes(bytes);
  const Status s = verify_archive(bytes, cloud.view(), order);
  REQUIRE_FALSE(s);
  CHECK(s.error().code == Errc::internal);
}

TEST_CASE("a range of chunks of an archive equals that part of the whole file") {
  SplitMix random{104};
  Bytes bytes = encode_archive_file(plausible_cloud(70000, 0, random), archive_options());
  const auto view = FileView::open(bytes);
  REQUIRE(view);
  REQUIRE(view->frames(SectionType::means).frames.size() == 3);
  const auto whole = load_direct(*view);
  REQUIRE(whole);
  for (const std::uint64_t first : {0u, 127u, 128u, 273u}) {
    const auto part = read_chunks(*view, first, 1);
    REQUIRE(part);
    const std::uint64_t at = first * 256;
    CHECK(same(part->means(), whole->means().subspan(at * 12, part->size() * 12)));
    CHECK(same(part->geometry(), whole->geometry().subspan(at * 16, part->size() * 16)));
    CHECK(same(part->sh(), whole->sh().subspan(at * 4, part->size() * 4)));
  }
  // A damaged frame breaks only its own rows, and the error has its offset.
  for (const SectionType type : {SectionType::means, SectionType::geometry, SectionType::sh}) {
    const CodedFrame frame = view->frames(type).frames[1];
    std::byte& byte = bytes[frame.offset + frame.stored_bytes / 2];
    byte ^= std::byte{1};
    CHECK(read_chunks(*view, 0, 128));
    const auto damaged = load_direct(*view, {true, 2});
    REQUIRE_FALSE(damaged);
    CHECK(damaged.error().code == Errc::checksum_mismatch);
    CHECK(damaged.error().offset == frame.offset);
    byte ^= std::byte{1};
  }
}

TEST_CASE("extreme and equal Gaussians can be archived") {
  SplitMix random{105};
  SplatCloud extremes = plausible_cloud(2000, 3, random);
  for (std::size_t i = 0; i < extremes.size(); i += 7) {
    extremes.opacity_logit[i] = i % 2 == 0 ? 40.f : -40.f;
    extremes.log_scale[3 * i] = i % 2 == 0 ? 60.f : -60.f;
    extremes.sh[48 * i + 1] = i % 2 == 0 ? 100.f : -100.f;
    extremes.mean[3 * i + 2] = i % 2 == 0 ? 3e38f : -1e30f;
  }
  SplatCloud equals = plausible_cloud(1500, 3, random);
  for (std::size_t i = 1; i < equals.size(); ++i) equals.set(i, equals.view().splat(0));
  SplatCloud flat = plausible_cloud(1500, 1, random);
  for (std::size_t i = 0; i < flat.size(); ++i) flat.mean[3 * i + 1] = 7;
  SplatCloud piled = plausible_cloud(1500, 0, random);
  for (float& x : piled.mean) x = 0;
  for (const SplatCloud* cloud : {&extremes, &equals, &flat, &piled}) {
    const Bytes bytes = encode_archive_file(*cloud, archive_options());
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    CHECK(validate(*view));
    CHECK(verify_archive(bytes, cloud->view(), source_order(*view)));
    check_stated(*view->archive());
  }
}

TEST_CASE("points, and scenes of subnormal size, can be archived") {
  SplitMix random{114};
  const SplatCloud base = plausible_cloud(700, 1, random);
  const auto encoded = [](const SplatCloud& cloud, int mean_cells) {
    EncodeOptions options = archive_options();
    options.archive.mean_cells = mean_cells;
    Bytes bytes = encode_archive_file(cloud, options);
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    REQUIRE(validate(*view));
    CHECK(verify_archive(bytes, cloud.view(), source_order(*view)));
    return bytes;
  };
  // An axis with equal means is exact.
  for (const float place : {0.f, 0x1p-149f, -1e-39f, 7.3f, -1e30f}) {
    CAPTURE(place);
    SplatCloud cloud = base;
    std::ranges::fill(cloud.mean, place);
    const Bytes bytes = encoded(cloud, 4);
    CHECK(FileView::open(bytes)->archive()->bound_mean == 0);
    CHECK(decode(bytes)->mean == cloud.mean);
    for (std::size_t i = 0; i < cloud.size(); ++i) cloud.mean[3 * i + 2] = base.mean[3 * i + 2];
    const SplatCloud line = decode(encoded(cloud, 4)).value();
    for (std::size_t i = 0; i < line.size(); ++i) REQUIRE(line.mean[3 * i + 1] == place);
  }
  // Rounding to such small numbers may at most double the cells' error.
  for (const double extent : {1e-36, 1e-37, 1e-38, 1e-39, 1e-40, 1e-42, 1e-44}) {
    for (const int mean_cells : {4, 10, 15, 20}) {
      for (const std::size_t n_axes : {1u, 3u}) {
        CAPTURE(extent);
        CAPTURE(mean_cells);
        SplatCloud cloud = base;
        for (std::size_t i = 0; i < cloud.mean.size(); ++i) {
          if (i % 3 < n_axes) cloud.mean[i] = static_cast<float>(extent * random.dyadic(-1, 1));
        }
        const Bytes bytes = encoded(cloud, mean_cells);
        const ArchiveParameters p = *FileView::open(bytes)->archive();
        CHECK(p.bound_mean <= std::ldexp(1.002, -mean_cells));
        const auto order = source_order(*FileView::open(bytes));
        const SplatCloud decoded = decode(bytes).value();
        for (std::size_t i = 0; i < decoded.mean.size(); ++i) {
          const double mean = decoded.mean[i], source = cloud.mean[3 * order[i / 3] + i % 3];
          const double reach = std::max(p.half_width[i % 3], std::abs(mean - p.centre[i % 3]));
          REQUIRE(std::abs(mean - source) <= p.bound_mean * reach);
        }
      }
    }
  }
}

TEST_CASE("an empty scene is not stored as an archive") {
  const Bytes bytes = encode_archive_file(SplatCloud{}, archive_options());
  const auto view = FileView::open(bytes);
  REQUIRE(view);
  CHECK(view->archive() == nullptr);
}

TEST_CASE("Gaussians that an archive cannot hold are refused with their index") {
  SplitMix random{106};
  SplatCloud cloud = plausible_cloud(100, 3, random);
  for (const float huge : {1e6f, 1e28f}) {
    cloud.sh[48 * 37 + 20] = huge;
    const auto bytes = encode(cloud.view(), archive_options());
    REQUIRE_FALSE(bytes);
    CHECK(bytes.error().code == Errc::bad_value);
    CHECK(bytes.error().found == 37);
  }
  // Any input: a file that its encoder has verified, or that error.
  for (int turn = 0; turn < 40; ++turn) {
    const auto any = encode(random_cloud(random.below(300) + 1, turn % 4, random).view(), archive_options());
    if (!any) CHECK(any.error().code == Errc::bad_value);
  }
}

TEST_CASE("archive options out of range are refused") {
  SplitMix random{107};
  const SplatCloud cloud = plausible_cloud(10, 0, random);
  std::vector<ArchiveOptions> bad(14);
  bad[0].mean_cells = 3;
  bad[1].mean_cells = 21;
  bad[2].sh_step = 0;
  bad[3].sh_step = std::nanf("");
  bad[4].dc_step = 0;
  bad[5].dc_step = 65;
  bad[6].rotation_step = 0;
  bad[7].rotation_step = 0.6f;
  bad[8].scale_step = 0;
  bad[9].scale_step = 2.1f;
  bad[10].opacity_levels = 0;
  bad[11].opacity_levels = 4097;
  bad[12].slope = -0.1f;
  bad[13].slope = 1.1f;
  for (const ArchiveOptions& o : bad) {
    const auto bytes = encode(cloud.view(), archive_options(o));
    REQUIRE_FALSE(bytes);
    CHECK(bytes.error().code == Errc::bad_argument);
  }
  EncodeOptions in_order = archive_options();
  in_order.order = Order::input;
  CHECK(encode(cloud.view(), in_order).error().code == Errc::bad_argument);
}

TEST_CASE("finer steps take more bytes and give smaller errors") {
  SplitMix random{108};
  const SplatCloud cloud = plausible_cloud(20000, 3, random);
  const auto high = encode_archive_file(cloud, archive_options()),
             small = encode_archive_file(cloud, archive_options(archive_small()));
  CHECK(small.size() < 0.85 * static_cast<double>(high.size()));
  const auto a = FileView::open(high), b = FileView::open(small);
  CHECK(a->archive()->classes[4].bound_sh < b->archive()->classes[4].bound_sh);
  CHECK(a->archive()->bound_mean < b->archive()->bound_mean);
}

TEST_CASE("every prefix and every single-byte change of an archive is an error or a valid decode") {
  SplitMix random{109};
  EncodeOptions options = archive_options();
  options.chunk_size = 32;
  const Bytes original = encode_archive_file(plausible_cloud(40, 1, random), options);
  for (std::size_t n = 0; n < original.size(); ++n) {
    const Bytes prefix(original.begin(), original.begin() + static_cast<std::ptrdiff_t>(n));  // exact, for sanitizers
    REQUIRE_FALSE(FileView::open(prefix));
  }
  Bytes bytes = original;
  std::size_t n_valid = 0;
  for (std::size_t i = 0; i < bytes.size(); ++i) {
    const std::byte before = bytes[i];
    bytes[i] ^= static_cast<std::byte>(1u << (i % 8));
    Bytes fixed = bytes;
    fix_hashes(fixed);
    if (const auto view = FileView::open(fixed)) {
      const auto data = load_direct(*view, {false, 1});
      const bool valid = validate(*view).has_value();
      n_valid += valid;
      if (valid) REQUIRE(data);
    }
    REQUIRE_FALSE(decode(bytes));
    bytes[i] = before;
  }
  CHECK(n_valid > 0);  // bounds, for example
}

TEST_CASE("archives with inconsistent sections are refused") {
  SplitMix random{110};
  const Bytes original = encode_archive_file(plausible_cloud(40, 1, random), archive_options());
  const auto error_of = [](Bytes bytes) {
    fix_hashes(bytes);
    const auto view = FileView::open(bytes);
    REQUIRE_FALSE(view);
    return view.error();
  };
  Bytes bytes = original;
  put<std::uint32_t>(bytes, entry_of(bytes, "GEOM") + 8, 1);
  CHECK(error_of(bytes).code == Errc::unsupported_codec);
  CHECK(error_of(bytes).offset == entry_of(bytes, "GEOM") + 8);
  bytes = original;
  std::memcpy(bytes.data() + entry_of(bytes, "ARCH"), "XRCH", 4);
  put<std::uint32_t>(bytes, entry_of(bytes, "XRCH") + 4, 0);
  CHECK(error_of(bytes).code == Errc::missing_section);
  bytes = original;
  put<std::uint16_t>(bytes, 10, 1);  // an older file has no such codec
  CHECK(error_of(bytes).code == Errc::unsupported_codec);

  // Fields of ARCH, by offset.
  struct Field {
    std::uint64_t at;
    std::uint32_t value;
    Errc code;
  };
  for (const Field& f : {Field{0, 3, Errc::bad_value},
                         {0, 21, Errc::bad_value},
                         {4, 0, Errc::bad_value},
                         {4, 29, Errc::bad_value},
                         {8, 0, Errc::bad_value},
                         {8, 33, Errc::bad_value},
                         {8, 0xFFFFFFFFu, Errc::bad_value},
                         {12, 0, Errc::bad_value},
                         {12, 4097, Errc::bad_value},
                         {16, 0, Errc::bad_value},
                         {16, 256, Errc::bad_value},
                         {20, 1, Errc::reserved_bits},
                         {28, 0x7FF00000u, Errc::bad_value},
                         {52, 0, Errc::bad_value},
                         {72, 0x7FC00000u, Errc::bad_value},
                         {96, 0xBF800000u, Errc::bad_value},
                         {104, 1, Errc::reserved_bits},
                         {128, 0x7FC00000u, Errc::bad_value},
                         {132, 0, Errc::bad_value},
                         {136, 0x00800001u, Errc::bad_value},
                         {140, 0, Errc::bad_value},
                         {144, 0, Errc::bad_value},
                         {160, 0x7F800000u, Errc::bad_value}}) {
    CAPTURE(f.at);
    bytes = original;
    put(bytes, section_of(bytes, "ARCH") + f.at, f.value);
    if (f.at == 52) put(bytes, section_of(bytes, "ARCH") + 48, 0u);  // both halves of a binary64
    const Error error = error_of(bytes);
    CHECK(error.code == f.code);
    CHECK(error.offset == section_of(bytes, "ARCH") + (f.at == 52 || f.at == 28 ? f.at - 4 : f.at));
  }
  // More distributions than the tables have.
  bytes = original;
  put<std::uint32_t>(bytes, section_of(bytes, "ARCH") + 16,
                     get<std::uint32_t>(bytes, section_of(bytes, "ARCH") + 16) + 1);
  CHECK(error_of(bytes).code == Errc::corrupt_data);
}

// ---- the entropy coder -----------------------------------------------------------------------------------------------

namespace {

struct Planes {
  std::vector<std::int16_t> codes;
  std::vector<std::uint16_t> levels;
};

// Two contexts in turn.
template <class Coder>
void walk(Planes& p, Coder& coder) {
  coder.plane(p.codes.size(), p.codes.data(), 0, [](std::size_t i) { return i % 2; });
  coder.plane(p.levels.size(), p.levels.data(), 300, [](std::size_t) { return std::size_t{2}; });
}

}  // namespace

TEST_CASE("the entropy coder restores its input and detects every other stream") {
  using namespace rgs::detail;
  SplitMix random{111};
  Planes planes;
  for (std::size_t i = 0; i < 3001; ++i) {
    planes.codes.push_back(i % 2 == 0 ? std::int16_t{0} : static_cast<std::int16_t>(random.below(100) - 50));
    if (i % 97 == 0) planes.codes.back() = static_cast<std::int16_t>(random.below(65536) - 32768);
    planes.levels.push_back(static_cast<std::uint16_t>(random.below(301)));
  }
  planes.codes[1] = -32768;
  planes.codes[3] = 32767;
  std::vector<std::uint16_t> frequencies(2 * kRansTokens, 4096 / kRansTokens);
  for (const std::size_t row : {0u, 1u}) frequencies[row * kRansTokens] += 4096 % kRansTokens;
  const std::array<std::uint8_t, 3> map{0, 1, 1};
  RansWriter writer(frequencies, map);
  walk(planes, writer);
  const std::vector<std::byte> stream = writer.finish();
  RansTables tables;
  REQUIRE(tables.assign(frequencies));
  const auto decode_stream = [&](std::span<const std::byte> bytes, Planes& out) {
    out.codes.assign(planes.codes.size(), 0);
    out.levels.assign(planes.levels.size(), 0);
    RansReader reader(tables, map);
    if (!reader.begin(bytes)) return false;
    walk(out, reader);
    return reader.ok() && reader.finished();
  };
  Planes out;
  REQUIRE(decode_stream(stream, out));
  CHECK(out.codes == planes.codes);
  CHECK(out.levels == planes.levels);
  for (std::size_t n = 0; n < stream.size(); n += n < 100 ? 1 : 37) {
    const std::vector<std::byte> prefix(stream.begin(), stream.begin() + static_cast<std::ptrdiff_t>(n));
    REQUIRE_FALSE(decode_stream(prefix, out));
  }
  std::vector<std::byte> longer = stream;
  longer.resize(longer.size() + 2);
  CHECK_FALSE(decode_stream(longer, out));
  Planes beyond = planes;
  beyond.levels[7] = 301;
  walk(beyond, writer);
  CHECK_FALSE(decode_stream(writer.finish(), out));  // a number above its limit
  frequencies[5] += 1;
  CHECK_FALSE(tables.assign(frequencies));
}

TEST_CASE("invalid tables of an archive are refused") {
  using namespace rgs::detail;
  ArchiveTables good;
  good.n_sh = archive_sh_count(1);
  good.parameters.classes.resize(3);
  for (ArchiveClass& c : good.parameters.classes) c.rotation_step = c.sh_step = 1;
  good.sh_centre.resize(good.n_sh);
  good.sh_matrix.resize(good.n_sh * good.n_sh);
  good.map.resize(good.contexts().count);
  good.frequencies.assign(2 * kRansTokens, 0);
  good.frequencies[3] = good.frequencies[kRansTokens] = kRansTotal;
  const std::uint64_t frame = 1000 + 128 + 3 * 36;
  const auto parse = [](const std::vector<std::byte>& bytes) { return parse_archive_tables(bytes, 1000, 1); };
  const std::vector<std::byte> original = write_archive_tables(good);
  REQUIRE(parse(original));
  const auto refused = [&](const std::vector<std::byte>& bytes, Errc code, std::uint64_t offset) {
    const auto result = parse(bytes);
    REQUIRE_FALSE(result);
    CHECK(result.error().code == code);
    CHECK(result.error().offset == offset);
  };
  ArchiveTables bad = good;
  bad.map[17] = 2;
  refused(write_archive_tables(bad), Errc::bad_value, frame);
  bad = good;
  bad.frequencies[3] = kRansTotal - 1;
  refused(write_archive_tables(bad), Errc::bad_value, frame);
  bad = good;
  bad.sh_centre[4] = std::nanf("");
  refused(write_archive_tables(bad), Errc::bad_value, frame);
  bad = good;
  bad.dc_centre[0] = 0x1p41f;
  refused(write_archive_tables(bad), Errc::bad_value, frame);
  bad = good;
  bad.map.push_back(0);
  refused(write_archive_tables(bad), Errc::corrupt_data, frame);
  for (std::size_t n = 0; n < original.size(); ++n) {
    const std::vector<std::byte> prefix(original.begin(), original.begin() + static_cast<std::ptrdiff_t>(n));
    refused(prefix, n < frame - 1000 ? Errc::size_mismatch : Errc::corrupt_data, n < frame - 1000 ? 1000 : frame);
  }
  std::vector<std::byte> twice = original;  // a second frame behind the first
  twice.insert(twice.end(), original.begin() + static_cast<std::ptrdiff_t>(frame - 1000), original.end());
  refused(twice, Errc::corrupt_data, frame);
  CHECK_FALSE(parse_archive_tables(original, 1000, 2));  // of another degree
}

TEST_CASE("tokens cover every number once") {
  using namespace rgs::detail;
  std::uint32_t before = 0;
  for (std::uint32_t z = 0; z < 65536; ++z) {
    const RansToken t = rans_token(z);
    REQUIRE(t.token < kRansTokens);
    REQUIRE(t.token >= before);
    before = t.token;
    REQUIRE((t.token < 32 ? t.token : (4 + t.token % 4) << t.n_bits | t.bits) == z);
    REQUIRE(fold_code(unfold_code(z)) == z);
  }
  CHECK(before == kRansTokens - 1);
}

TEST_CASE("sizes of codes match the specification") {
  using namespace rgs::detail;
  SplitMix random{113};
  constexpr std::size_t kN = 200;
  CodeSizes sizes;
  sizes.reset(kN);
  std::array<int, kN> history{};
  for (int plane = 0; plane < 60; ++plane) {
    std::array<std::int16_t, kN> codes;
    for (std::int16_t& code : codes) {
      code = static_cast<std::int16_t>(random.below(std::uint64_t{2} << random.below(16)));
      if (random.below(3) == 0) code = static_cast<std::int16_t>(-code);
    }
    codes[0] = -32768;
    codes[1] = 255;
    sizes.note(codes.data());
    for (std::size_t i = 0; i < kN; ++i) {
      history[i] = (13 * history[i] + 128 * std::min(std::abs(int{codes[i]}), 255)) / 16;
      std::size_t size = 0;
      for (const int limit : {3, 7, 12, 22, 37, 60, 98}) size += history[i] >= limit;
      REQUIRE(sizes[i] == size);
    }
  }
}

TEST_CASE("Draco streams decode to the same points, and damaged ones are refused") {
  using namespace rgs::detail;
  SplitMix random{112};
  std::vector<GridPoint> points(500);
  for (GridPoint& p : points)
    p = {static_cast<std::uint32_t>(random.below(64)), static_cast<std::uint32_t>(random.below(4096)), 7};
  const auto stream = encode_points(points);
  REQUIRE(stream);
  std::vector<GridPoint> decoded(points.size());
  REQUIRE(decode_points(*stream, 0, 12, decoded));
  std::ranges::sort(points);
  std::ranges::sort(decoded);
  CHECK(points == decoded);
  for (const std::uint32_t bits : {0u, 1u, 9u, 28u}) {
    for (const std::size_t n : {1u, 2u, 3u, 63u, 64u, 65u, 3000u}) {
      std::vector<GridPoint> some(n), read(n);
      for (GridPoint& p : some) {
        const std::uint64_t within = std::uint64_t{1} << (random.below(4) == 0 ? bits : bits / 2);
        for (std::uint32_t& x : p) x = static_cast<std::uint32_t>(random.below(within));
      }
      CAPTURE(bits);
      CAPTURE(n);
      REQUIRE(decode_points(encode_points(some).value(), 0, bits, read));
      std::ranges::sort(some);
      std::ranges::sort(read);
      CHECK(some == read);
    }
  }
  const auto error_of = [&](std::span<const std::byte> bytes, std::uint32_t bits = 12, std::size_t n = 500) {
    std::vector<GridPoint> out(n);
    const Status s = decode_points(bytes, 77, bits, out);
    if (s) return Errc::internal;
    CHECK(s.error().offset == 77);
    return s.error().code;
  };
  CHECK(error_of(*stream, 11) == Errc::corrupt_data);
  CHECK(error_of(*stream, 12, 499) == Errc::corrupt_data);
  for (std::size_t n = 0; n < stream->size(); ++n) {
    const std::vector<std::byte> prefix(stream->begin(), stream->begin() + static_cast<std::ptrdiff_t>(n));
    REQUIRE(error_of(prefix) == Errc::corrupt_data);
  }
  std::vector<std::byte> bytes = *stream;
  bytes.push_back({});
  CHECK(error_of(bytes) == Errc::corrupt_data);
  for (std::size_t i = 0; i < 31; ++i) {  // the header; coordinates may also have fewer bits
    bytes = *stream;
    bytes[i] ^= std::byte{0x40};
    CHECK(error_of(bytes) == Errc::corrupt_data);
  }
  for (const std::uint64_t at : {11u, 27u}) {
    bytes = *stream;
    put<std::uint32_t>(bytes, at, 0x7FFFFFFFu);
    CHECK(error_of(bytes) == Errc::corrupt_data);
  }
}
