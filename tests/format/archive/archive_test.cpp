// archive_test.cpp - Profile::archive: decodes within its stated bounds, in one way only, and refuses everything else.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numeric>
#include <string>

#include "archive/archive_codec.hpp"
#include "archive/archive_encode.hpp"
#include "archive/archive_tables.hpp"
#include "archive/point_codec.hpp"
#include "archive/rans.hpp"
#include "archive_bounds.hpp"
#include "draco_points.hpp"
#include "edit_file.hpp"
#include "instruction_sets.hpp"
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
  REQUIRE_MESSAGE(bytes, std::string(bytes.error().what));
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

// What the steps guarantee: the stated bounds must not be worse. Those of class 0 have no end; others have an importance of
// at least `least`, by which all is so much finer. longest: how many times a Gaussian is longer than wide, blurred, if the
// least step of a turn, 2^-12, shows, and that rotations are FP16.
void check_stated(const ArchiveParameters& p, double longest = 0) {
  const ShapeParameters& shape = p.shape;
  const auto octaves = [](double x) { return std::exp2(x / 65536.0); };
  const auto n_classes = static_cast<int>(p.classes.size());
  CHECK(p.bound_opacity <= 0.5 / p.opacity_levels + 0x1p-11);
  for (int i = 0; i < n_classes; ++i) {
    CAPTURE(i);
    const ArchiveClass& c = p.classes[static_cast<std::size_t>(i)];
    CHECK(c.bound_dc <= c.dc_step / 65536.0 * std::sqrt(3.0) / 2 + 0.03);
    // Neighbours make up for each other's errors: a part of those of any class comes on top.
    const double passed_on = 0.3 * static_cast<double>(p.classes.front().sh_step) / 2;
    CHECK(c.bound_sh <= (static_cast<double>(c.sh_step) / 2 + passed_on) * std::sqrt(45.0) + 0.001);
    if (i == 0) continue;
    const double least = i - n_classes / 2 - 0.5;
    const auto finer = [&](double importance) { return shape.slope / 2.0 * importance; };
    // On each axis half a part of a cell, and a part is at most sqrt(2) times the step, or a 4096th of a cell. Cells grow
    // with the distance. log() is off by up to 0.09 octaves, thrice.
    const double widest = *std::ranges::max_element(p.half_width);
    const double part =
        std::max(std::sqrt(2.0) * octaves(shape.mean_step - finer(least)),
                 std::ldexp(std::max(1.0, widest / std::sqrt(shape.nearest)), -12 - static_cast<int>(p.mean_cells)) /
                     octaves(shape.blur));
    CHECK(c.bound_mean <= 1.2 * 3 * part / 2);
    // Half a step of each scale, which is the coarse one where fine ones are larger, and the variance that hides below the
    // blur. Steps are off by a quarter of an octave. The importance behind them is that of coarse scales.
    const double fine = shape.fine_step - finer(least - shape.coarse_step / 65536.0) + 65536 / 4;
    const double scale = std::min(octaves(fine), shape.coarse_step / 65536.0),
                 variance = std::exp2(scale) - 1 + 1.0 / 64;
    // Half a step around each axis moves a quaternion's component, and turns by twice as much. Of a needle whose end moves
    // by v, in units of its blurred width, the covariance changes by v on both sides and by v v^T across.
    const double turn = octaves(shape.turn_step - finer(least) + 65536 / 4) + longest * 0x1p-12;
    const double moved = 3 * turn * turn;
    CHECK(c.bound_covariance <= 1.2 * std::sqrt(3 * variance * variance + 2 * moved + moved * moved));
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
      CHECK(view->header().version_minor == 5);
      CHECK(view->header().n_gaussians == n);
      REQUIRE(validate(*view));
      REQUIRE(view->archive() != nullptr);
      check_stated(*view->archive());
      const auto order = source_order(*view);
      CHECK(verify_archive(bytes, cloud.view(), order));

      // Independent of the encoder's check: every value against the worst class.
      const StatedBounds bounds(bytes);
      const auto one = load_direct(*view, {true, 1}), two = load_direct(*view, {true, 2});
      REQUIRE(one);
      REQUIRE(two);
      CHECK(same(one->means(), two->means()));
      CHECK(same(one->geometry(), two->geometry()));
      CHECK(same(one->sh(), two->sh()));
      std::vector<ActivatedSplat> decoded(n);
      REQUIRE(one->read(0, decoded));
      for (std::size_t i = 0; i < n; ++i) {
        const ShStepSet steps = view->chunk_steps(i / options.chunk_size).value();
        const auto step = [&steps](int k) { return steps.of_value(k); };
        REQUIRE(is_within(bounds, 0, degree, cloud.view().splat(order[i]), decoded[i], step));
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

  // Stated bounds that are too small: of opacity, and of the classes that have Gaussians.
  const std::uint64_t arch = section_of(bytes, "ARCH");
  std::size_t n_false = 0;
  const auto too_small = [&](std::uint64_t at) {
    const auto stated = get<float>(bytes, at);
    if (stated == 0) return;
    put(bytes, at, stated * 0.99f);
    fix_hashes(bytes);
    const Status s = verify_archive(bytes, cloud.view(), order);
    REQUIRE_FALSE(s);
    CHECK(s.error().code == Errc::internal);
    put(bytes, at, stated);
    ++n_false;
  };
  too_small(arch + 108);
  for (std::uint64_t c = 0; c < get<std::uint32_t>(bytes, arch + 8); ++c) {
    for (const std::uint64_t field : {8u, 12u}) too_small(arch + 128 + 24 * c + field);
  }
  CHECK(n_false > 20);
}

TEST_CASE("a range of chunks of an archive equals that part of the whole file") {
  SplitMix random{104};
  Bytes bytes = encode_archive_file(plausible_cloud(18000, 0, random), archive_options());
  const auto view = FileView::open(bytes);
  REQUIRE(view);
  REQUIRE(view->frames(SectionType::means).frames.size() == 3);
  const auto whole = load_direct(*view);
  REQUIRE(whole);
  for (const std::uint64_t first : {0u, 31u, 32u, 70u}) {
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
    CHECK(read_chunks(*view, 0, 32));
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
    extremes.log_scale[3 * i] = i % 2 == 0 ? 30.f : -60.f;
    extremes.sh[48 * i + 1] = i % 2 == 0 ? 100.f : -100.f;
    extremes.mean[3 * i + 2] = i % 2 == 0 ? 3e38f : -1e30f;
  }
  SplatCloud equals = plausible_cloud(1500, 3, random);
  for (std::size_t i = 1; i < equals.size(); ++i) equals.set(i, equals.view().splat(0));
  SplatCloud flat = plausible_cloud(1500, 1, random);
  for (std::size_t i = 0; i < flat.size(); ++i) flat.mean[3 * i + 1] = 7;
  SplatCloud piled = plausible_cloud(1500, 0, random);
  for (float& x : piled.mean) x = 0;
  SplatCloud noise = golden_cloud(20000, 1, 8);  // neighbours have nothing in common
  for (const SplatCloud* cloud : {&extremes, &equals, &flat, &piled, &noise}) {
    const Bytes bytes = encode_archive_file(*cloud, archive_options());
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    CHECK(validate(*view));
    CHECK(verify_archive(bytes, cloud->view(), source_order(*view)));
    // The blur of the one is nothing, that of the other 2^-10 of a distance of about 8 from Gaussians of scales up to 1.
    check_stated(*view->archive(), cloud == &piled ? std::exp(6) : cloud == &noise ? 128 : 0);
  }
}

TEST_CASE("points, and scenes of subnormal size, can be archived") {
  SplitMix random{114};
  const SplatCloud base = plausible_cloud(700, 1, random);
  const auto encoded = [](const SplatCloud& cloud, float step) {
    Bytes bytes = encode_archive_file(cloud, archive_options({.step = step}));
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
    const Bytes bytes = encoded(cloud, 64);
    const ArchiveParameters p = *FileView::open(bytes)->archive();
    for (const ArchiveClass& c : p.classes) CHECK(c.bound_mean == 0);
    CHECK(decode(bytes)->mean == cloud.mean);
    for (std::size_t i = 0; i < cloud.size(); ++i) cloud.mean[3 * i + 2] = base.mean[3 * i + 2];
    const SplatCloud line = decode(encoded(cloud, 64)).value();
    for (std::size_t i = 0; i < line.size(); ++i) REQUIRE(line.mean[3 * i + 1] == place);
  }
  // A cell, and the rounding to such small numbers.
  for (const double extent : {1e-36, 1e-37, 1e-38, 1e-39, 1e-40, 1e-42, 1e-44}) {
    for (const float step : {0.0625f, 1.f, 64.f}) {
      for (const std::size_t n_axes : {1u, 3u}) {
        CAPTURE(extent);
        CAPTURE(step);
        SplatCloud cloud = base;
        for (std::size_t i = 0; i < cloud.mean.size(); ++i) {
          if (i % 3 < n_axes) cloud.mean[i] = static_cast<float>(extent * random.dyadic(-1, 1));
        }
        const Bytes bytes = encoded(cloud, step);
        const ArchiveParameters p = *FileView::open(bytes)->archive();
        const auto order = source_order(*FileView::open(bytes));
        const SplatCloud decoded = decode(bytes).value();
        for (std::size_t i = 0; i < decoded.mean.size(); ++i) {
          const double mean = decoded.mean[i], source = cloud.mean[3 * order[i / 3] + i % 3];
          const double reach = std::max(p.half_width[i % 3], 2 * std::abs(mean - p.centre[i % 3]));
          REQUIRE(std::abs(mean - source) <= std::ldexp(reach, -static_cast<int>(p.mean_cells)) + 0x1p-149);
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
  // Something so long and thin that its place does not fit any FP32 bound once it is turned by the least step.
  cloud = plausible_cloud(100, 1, random);
  cloud.log_scale[3 * 23] = 60;
  const auto needle = encode(cloud.view(), archive_options());
  REQUIRE_FALSE(needle);
  CHECK(needle.error().code == Errc::bad_value);
  CHECK(needle.error().found == 23);
  // Any input: a file that its encoder has verified, or that error.
  for (int turn = 0; turn < 40; ++turn) {
    const auto any = encode(random_cloud(random.below(300) + 1, turn % 4, random).view(), archive_options());
    if (!any) CHECK(any.error().code == Errc::bad_value);
  }
}

TEST_CASE("archive options out of range are refused") {
  SplitMix random{107};
  const SplatCloud cloud = plausible_cloud(10, 0, random);
  std::vector<ArchiveOptions> bad;
  for (const float step : {0.f, 0.06f, 64.5f, -1.f, std::nanf(""), std::numeric_limits<float>::infinity()}) {
    bad.push_back({.step = step});
  }
  for (const ArchiveOptions& o : bad) {
    const auto bytes = encode(cloud.view(), archive_options(o));
    REQUIRE_FALSE(bytes);
    CHECK(bytes.error().code == Errc::bad_argument);
  }
  EncodeOptions in_order = archive_options();
  in_order.order = Order::input;
  CHECK(encode(cloud.view(), in_order).error().code == Errc::bad_argument);
  EncodeOptions large_chunks = archive_options();
  large_chunks.chunk_size = 32768 + 32;
  CHECK(encode(cloud.view(), large_chunks).error().code == Errc::bad_argument);
  large_chunks.chunk_size = 32768;
  CHECK(encode(cloud.view(), large_chunks));
}

TEST_CASE("finer steps take more bytes and give smaller errors") {
  SplitMix random{108};
  const SplatCloud cloud = plausible_cloud(20000, 3, random);
  const Bytes high = encode_archive_file(cloud, archive_options()),
              small = encode_archive_file(cloud, archive_options(archive_small())),
              tiny = encode_archive_file(cloud, archive_options(archive_tiny()));
  for (const auto& [fine, coarse] : {std::pair(&high, &small), std::pair(&small, &tiny)}) {
    CHECK(coarse->size() < 0.85 * static_cast<double>(fine->size()));
    const StatedBounds a(*fine), b(*coarse);
    for (const auto bound : {&StatedBounds::opacity, &StatedBounds::dc, &StatedBounds::sh}) {
      CHECK(1.2 * a.*bound < b.*bound);
    }
    const auto fine_view = FileView::open(*fine), coarse_view = FileView::open(*coarse);
    for (const auto bound : {&ArchiveClass::bound_mean, &ArchiveClass::bound_covariance}) {
      CHECK(1.2 * fine_view->archive()->classes[8].*bound < coarse_view->archive()->classes[8].*bound);
    }
  }
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
  for (const std::uint32_t codec : {1u, 2u, 4u}) {
    put<std::uint32_t>(bytes, entry_of(bytes, "GEOM") + 8, codec);
    CHECK(error_of(bytes).code == Errc::unsupported_codec);
    CHECK(error_of(bytes).offset == entry_of(bytes, "GEOM") + 8);
  }
  bytes = original;
  std::memcpy(bytes.data() + entry_of(bytes, "ARCH"), "XRCH", 4);
  put<std::uint32_t>(bytes, entry_of(bytes, "XRCH") + 4, 0);
  CHECK(error_of(bytes).code == Errc::missing_section);
  bytes = original;
  put<std::uint16_t>(bytes, 10, 4);  // an older file has no such codec
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
                         {20, 65537, Errc::bad_value},
                         {28, 0x7FF00000u, Errc::bad_value},
                         {52, 0, Errc::bad_value},
                         {76, 0, Errc::bad_value},
                         {80, 1u << 23, Errc::bad_value},
                         {84, 0, Errc::bad_value},
                         {84, (1u << 20) + 1, Errc::bad_value},
                         {88, 0x80000000u, Errc::bad_value},
                         {92, (1u << 24) + 1, Errc::bad_value},
                         {96, 0u - (1u << 24) - 1, Errc::bad_value},
                         {100, (1u << 24) + 1, Errc::bad_value},
                         {104, 0xBF800000u, Errc::bad_value},
                         {108, 0x7FC00000u, Errc::bad_value},
                         {112, 1, Errc::reserved_bits},
                         {128, 0, Errc::bad_value},
                         {132, 0, Errc::bad_value},
                         {136, 0x7F800000u, Errc::bad_value},
                         {148, 0x7FC00000u, Errc::bad_value}}) {
    CAPTURE(f.at);
    bytes = original;
    put(bytes, section_of(bytes, "ARCH") + f.at, f.value);
    const bool upper_half = f.at == 28 || f.at == 52 || f.at == 76;  // of a binary64
    if (upper_half && f.value == 0) put(bytes, section_of(bytes, "ARCH") + f.at - 4, 0u);
    const Error error = error_of(bytes);
    CHECK(error.code == f.code);
    CHECK(error.offset == section_of(bytes, "ARCH") + (upper_half ? f.at - 4 : f.at));
  }
  // More distributions than the tables have.
  bytes = original;
  put<std::uint32_t>(bytes, section_of(bytes, "ARCH") + 16,
                     get<std::uint32_t>(bytes, section_of(bytes, "ARCH") + 16) + 1);
  CHECK(error_of(bytes).code == Errc::corrupt_data);
}

// ---- means, scales and rotations -------------------------------------------------------------------------------------

namespace {

using rgs::detail::GridPoint;

// Every number is as likely, in all contexts of cells.
struct FlatCoder {
  FlatCoder() : frequencies(rgs::detail::kRansTokens, 4096 / rgs::detail::kRansTokens), map(28, 0) {
    frequencies[0] += 4096 % rgs::detail::kRansTokens;
    REQUIRE(tables.assign(frequencies));
  }
  std::vector<std::uint16_t> frequencies;
  std::vector<std::uint8_t> map;
  rgs::detail::RansTables tables;

  std::vector<std::byte> encode(std::vector<GridPoint> points, const std::array<std::uint8_t, 3>& bits) const {
    rgs::detail::RansWriter writer(frequencies, map);
    rgs::detail::PointTree tree;
    REQUIRE(tree.walk(points, bits, writer));
    return writer.finish();
  }
  // False if the stream is refused, if only for its end: its points are legal.
  bool decode(std::span<const std::byte> stream, const std::array<std::uint8_t, 3>& bits,
              std::vector<GridPoint>& points) const {
    const std::vector<std::byte> exact(stream.begin(), stream.end());  // for sanitizers
    rgs::detail::RansReader reader(tables, map);
    if (!reader.begin(exact)) return false;
    rgs::detail::PointTree tree;
    if (!tree.walk(points, bits, reader)) return false;
    for (const GridPoint& point : points) {
      for (std::size_t k = 0; k < 3; ++k) REQUIRE(point[k] < 1u << bits[k]);
    }
    return reader.ok() && reader.finished();
  }
};

enum class Places { random, equal, clustered };

std::vector<GridPoint> points_of(Places places, std::size_t n, const std::array<std::uint8_t, 3>& bits,
                                 SplitMix& random) {
  std::vector<GridPoint> points(n);
  GridPoint centre{};
  for (std::size_t i = 0; i < n; ++i) {
    if (i == 0 || (places == Places::clustered && i % 50 == 0) || places == Places::random) {
      for (std::size_t k = 0; k < 3; ++k) {
        centre[k] = static_cast<std::uint32_t>(random.below(std::uint64_t{1} << bits[k]));
      }
    }
    points[i] = centre;
    if (places != Places::clustered) continue;
    for (std::size_t k = 0; k < 3; ++k)
      points[i][k] ^= static_cast<std::uint32_t>(random.below(4)) & ((1u << bits[k]) - 1);
  }
  return points;
}

// Bits from the highest on, x before y before z at each.
std::array<bool, 84> morton(const GridPoint& point) {
  std::array<bool, 84> key{};
  for (std::size_t bit = 0; bit < 28; ++bit) {
    for (std::size_t axis = 0; axis < 3; ++axis) key[3 * bit + axis] = (point[axis] >> (27 - bit) & 1u) != 0;
  }
  return key;
}

}  // namespace

TEST_CASE("the order of points is that of their Morton codes") {
  SplitMix random{121};
  std::size_t n_equal = 0;
  for (int i = 0; i < 20000; ++i) {
    GridPoint a{}, b{};
    for (std::size_t k = 0; k < 3; ++k) {
      a[k] = static_cast<std::uint32_t>(random.below(1u << 28) >> random.below(29));
      b[k] =
          random.below(2) == 0 ? a[k] : a[k] ^ static_cast<std::uint32_t>(random.below(1u << 28) >> random.below(29));
    }
    REQUIRE(rgs::detail::tree_less(a, b) == (morton(a) < morton(b)));
    REQUIRE(rgs::detail::tree_less(b, a) == (morton(b) < morton(a)));
    n_equal += a == b;
  }
  CHECK(n_equal > 1000);
}

TEST_CASE("a tree of points gives them back in its order") {
  SplitMix random{122};
  const FlatCoder coder;
  for (const std::array<std::uint8_t, 3>& bits : std::to_array<std::array<std::uint8_t, 3>>(
           {{0, 0, 0}, {1, 0, 0}, {3, 3, 3}, {7, 0, 12}, {12, 13, 11}, {28, 28, 28}, {0, 28, 1}})) {
    for (const std::size_t n : {1u, 2u, 3u, 64u, 3000u, 32768u}) {
      for (const Places places : {Places::random, Places::equal, Places::clustered}) {
        CAPTURE(n);
        CAPTURE(static_cast<int>(bits[0]));
        CAPTURE(static_cast<int>(places));
        std::vector<GridPoint> points = points_of(places, n, bits, random);
        std::ranges::sort(points, {}, morton);
        const std::vector<std::byte> stream = coder.encode(points, bits);
        std::vector<GridPoint> decoded(n, GridPoint{~0u, ~0u, ~0u});  // what was there before does not matter
        REQUIRE(coder.decode(stream, bits, decoded));
        REQUIRE(decoded == points);
      }
    }
  }
}

TEST_CASE("any other stream of points is refused or gives points of the grid") {
  SplitMix random{123};
  const FlatCoder coder;
  const std::array<std::uint8_t, 3> bits{9, 14, 6};
  std::size_t n_refused = 0, n_changed = 0;
  for (const std::size_t n : {1u, 2u, 9u, 64u}) {
    std::vector<GridPoint> points = points_of(n == 9 ? Places::clustered : Places::random, n, bits, random);
    std::ranges::sort(points, {}, morton);
    const std::vector<std::byte> stream = coder.encode(points, bits);
    std::vector<GridPoint> decoded(n);
    for (std::size_t size = 0; size < stream.size(); ++size) {
      REQUIRE_FALSE(coder.decode(std::span(stream).first(size), bits, decoded));
    }
    std::vector<std::byte> longer = stream;
    longer.resize(longer.size() + 2);
    REQUIRE_FALSE(coder.decode(longer, bits, decoded));
    for (std::size_t at = 0; at < stream.size(); at += 2) {
      for (int turn = 0; turn < 20; ++turn) {
        std::vector<std::byte> changed = stream;
        put(changed, at, static_cast<std::uint16_t>(random.below(65536)));
        if (changed == stream) continue;
        ++n_changed;
        n_refused += coder.decode(changed, bits, decoded) ? 0u : 1u;
      }
    }
  }
  // Other raw bits are other points; the states in the end reveal the rest.
  CHECK(n_refused > n_changed / 2);
  CHECK(n_refused < n_changed);
}

namespace {

// Rotations of a cube onto itself as quaternions of whole numbers, and the axes onto which each takes x, y and z.
struct Cube {
  std::array<int, 4> q;
  std::array<std::size_t, 3> axes;
};

std::vector<Cube> cubes() {
  std::vector<Cube> out;
  for (int code = 0; code < 81; ++code) {
    const std::array<int, 4> q{code / 27 - 1, code / 9 % 3 - 1, code / 3 % 3 - 1, code % 3 - 1};
    const auto first = std::ranges::find_if(q, [](int x) { return x != 0; });
    const auto n = std::ranges::count_if(q, [](int x) { return x != 0; });
    if (n == 0 || n == 3 || *first < 0) continue;  // q and -q are the same rotation
    Cube cube{q, {}};
    const auto [w, x, y, z] = q;
    const int columns[3][3] = {{w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)},
                               {2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)},
                               {2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z}};
    for (std::size_t j = 0; j < 3; ++j) {
      while (columns[j][cube.axes[j]] == 0) ++cube.axes[j];
    }
    out.push_back(cube);
  }
  return out;
}

// The Gaussians turned by `cube` first, and their scales in the order of the axes: the same Gaussians.
SplatCloud described_by(const Cube& cube, const SplatCloud& cloud) {
  SplatCloud out = cloud;
  const auto [w, x, y, z] = cube.q;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const float* a = &cloud.rotation[4 * i];
    const std::array<float, 4> b{static_cast<float>(w), static_cast<float>(x), static_cast<float>(y),
                                 static_cast<float>(z)};
    out.rotation[4 * i] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    out.rotation[4 * i + 1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    out.rotation[4 * i + 2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    out.rotation[4 * i + 3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
    for (std::size_t k = 0; k < 3; ++k) out.log_scale[3 * i + k] = cloud.log_scale[3 * i + cube.axes[k]];
  }
  return out;
}

}  // namespace

TEST_CASE("a Gaussian decodes to the same whichever of its 24 descriptions was given") {
  SplitMix random{124};
  SplatCloud cloud = plausible_cloud(500, 0, random);
  // Whole numbers, so that all products are exact.
  for (float& x : cloud.rotation) x = static_cast<float>(random.below(2001)) - 1000;
  const std::vector<Cube> all = cubes();
  REQUIRE(all.size() == 24);
  std::vector<std::byte> means, geometry;
  for (const Cube& cube : all) {
    const Bytes bytes = encode_archive_file(described_by(cube, cloud), archive_options());
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    const auto data = load_direct(*view);
    REQUIRE(data);
    if (means.empty()) {
      means.assign(data->means().begin(), data->means().end());
      geometry.assign(data->geometry().begin(), data->geometry().end());
    }
    CHECK(same(data->means(), means));
    CHECK(same(data->geometry(), geometry));
  }
}

TEST_CASE("needles, discs and spheres of any direction keep their shape") {
  SplitMix random{125};
  const float long_side = -2, short_side = -7;
  struct Shape {
    const char* name;
    std::array<float, 3> log_scale;
  };
  for (const Shape& shape :
       {Shape{"needle", {long_side, short_side, short_side}}, Shape{"disc", {long_side, long_side, short_side}},
        Shape{"sphere", {long_side, long_side, long_side}}, Shape{"any", {long_side, -4, short_side}}}) {
    CAPTURE(std::string(shape.name));
    SplatCloud cloud = plausible_cloud(4000, 0, random);
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      for (std::size_t k = 0; k < 3; ++k) cloud.log_scale[3 * i + k] = shape.log_scale[(i + k) % 3];
      cloud.opacity_logit[i] = 3;
    }
    const Bytes bytes = encode_archive_file(cloud, archive_options());
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    check_stated(*view->archive());
    const StatedBounds bounds(bytes);
    std::vector<ActivatedSplat> decoded(cloud.size());
    REQUIRE(view->read(0, std::span(decoded)));
    BlurredErrors largest, sum;
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      const BlurredErrors e = blurred_errors(bounds, 0, cloud.view().splat(view->source_index(i)), decoded[i]);
      largest = {std::max(largest.mean, e.mean), std::max(largest.covariance, e.covariance)};
      sum = {sum.mean + e.mean, sum.covariance + e.covariance};
    }
    const auto n = static_cast<double>(cloud.size());
    // Twice what they are; check_stated() has what follows from the steps.
    CHECK(largest.mean < 0.12);
    CHECK(sum.mean / n < 0.05);
    CHECK(largest.covariance < 0.2);
    CHECK(sum.covariance / n < 0.12);
  }
}

TEST_CASE("whatever codes and parameters a file has, its rows are finite and the same with all instructions") {
  using namespace rgs::detail;
  SplitMix random{126};
  for (int turn = 0; turn < 300; ++turn) {
    CAPTURE(turn);
    ArchiveTables t;
    const int degree = turn % 4;
    t.n_sh = archive_sh_count(degree);
    ArchiveParameters& p = t.parameters;
    const auto any = [&random](std::int32_t low, std::int32_t high) {  // the limits more often
      const std::uint64_t which = random.below(4);
      if (which < 2) return which == 0 ? low : high;
      return static_cast<std::int32_t>(
          low + static_cast<std::int64_t>(random.below(static_cast<std::uint64_t>(std::int64_t{high} - low + 1))));
    };
    const auto any_power = [&](std::int32_t low, std::int32_t high) { return std::ldexp(1.0, any(low, high)); };
    p.mean_cells = static_cast<std::uint32_t>(any(4, 20));
    p.mean_bits = static_cast<std::uint32_t>(any(1, static_cast<std::int32_t>(std::min(p.mean_cells + 9, 28u))));
    p.opacity_levels = static_cast<std::uint32_t>(any(1, 4096));
    p.classes.resize(static_cast<std::size_t>(any(1, 32)));
    for (ArchiveClass& c : p.classes) {
      c.dc_step = static_cast<std::uint32_t>(any(1, 1 << 26));
      c.sh_units = static_cast<std::uint32_t>(any(1, 1 << 15));
    }
    for (std::size_t k = 0; k < 3; ++k) {
      p.centre[k] = any_power(-200, 128) * (random.below(2) == 0 ? 1 : -1);
      p.half_width[k] = any_power(-1074, 128);
    }
    ShapeParameters& shape = p.shape;
    shape.nearest = any_power(-1000, 300);
    shape.blur = any(-(1 << 22), 1 << 22);
    shape.coarse_step = any(1, 1 << 20);
    shape.slope = any(0, 1 << 16);
    for (std::int32_t* step : {&shape.fine_step, &shape.turn_step, &shape.mean_step, &shape.middle}) {
      *step = any(-(1 << 24), 1 << 24);
    }
    for (std::uint32_t i = 0; i <= p.opacity_levels; ++i)
      t.opacity.push_back(static_cast<std::uint16_t>(any(1, 0x3C00)));
    t.dc_matrix.fill(-32768);
    for (float& x : t.dc_centre) x = static_cast<float>(any_power(-60, 40));
    for (std::size_t k = 0; k < t.n_sh; ++k) t.sh_centre.push_back(static_cast<float>(any_power(-60, 40)));
    t.sh_matrix.assign(t.n_sh * t.n_sh, static_cast<std::int16_t>(any(-32768, 32767)));
    t.sh_unit = static_cast<float>(any_power(-60, 40));
    for (ArchiveTables::Smoothing* s : {&t.dc_smoothing, &t.sh_smoothing}) {
      s->recent = static_cast<std::uint8_t>(any(0, 255));
      s->kept = static_cast<std::uint8_t>(any(0, 255 - s->recent));
    }
    t.map.resize(t.contexts().count);
    t.frequencies.assign(kRansTokens, 4096 / kRansTokens);
    t.frequencies[0] += 4096 % kRansTokens;
    REQUIRE(t.rans.assign(t.frequencies));

    constexpr std::size_t kN = 100;
    std::vector<std::byte> stream(4 + 32 + 4 * kN * 30);
    for (std::byte& b : stream) b = static_cast<std::byte>(random.below(256));
    for (std::size_t k = 0; k < 3; ++k)
      stream[k] = static_cast<std::byte>(any(0, static_cast<std::int32_t>(p.mean_bits)));
    stream[3] = std::byte{0};
    const int level = any(0, 63), scale_exponent = any(-110, 110);
    std::vector<std::byte> means, geometry, steps, sh;
    with_each_instruction_set([&] {
      ArchiveDecoder decoder(t);
      // Refused for its end at the latest; the codes are there nevertheless, if its points are.
      REQUIRE_FALSE(decoder.codes({{stream, 0}, {}, {}}, kN, level));
      std::vector<std::byte> rows[] = {std::vector<std::byte>(12 * kN), std::vector<std::byte>(16 * kN),
                                       std::vector<std::byte>(4 * 48), std::vector<std::byte>(kN * sh_bytes(degree))};
      decoder.rows(scale_exponent, rows[0], rows[1]);
      decoder.sh_and_steps(degree, 32, rows[2], rows[3]);
      if (means.empty()) {
        means = rows[0], geometry = rows[1], steps = rows[2], sh = rows[3];
      }
      REQUIRE(same(means, rows[0]));
      REQUIRE(same(geometry, rows[1]));
      REQUIRE(same(steps, rows[2]));
      REQUIRE(same(sh, rows[3]));
    });
    for (std::size_t i = 0; i < 3 * kN; ++i) REQUIRE(std::isfinite(get<float>(means, 4 * i)));
    for (std::size_t i = 0; i < 8 * kN; ++i) {
      const auto half = get<std::uint16_t>(geometry, 2 * i);
      REQUIRE((half & 0x7FFFu) < 0x7C00u);
      if (i % 8 == 0 || i % 8 >= 4) REQUIRE(half < 0x8000u);
    }
    for (std::size_t i = 0; i < 4 * 12; ++i) {
      const auto step = get<float>(steps, 4 * i);
      REQUIRE(std::isfinite(step));
      REQUIRE_FALSE(std::signbit(step));
    }
    for (const std::byte code : sh) REQUIRE(code != std::byte{0x80});
  }
}

// ---- the entropy coder -----------------------------------------------------------------------------------------------

namespace {

struct Planes {
  std::vector<std::int16_t> codes;
  std::vector<std::uint16_t> levels, raw;
  std::vector<std::uint8_t> widths;  // of raw
};

// Two contexts in turn; raw bits between.
template <class Coder>
void walk(Planes& p, Coder& coder) {
  coder.plane(p.codes.size(), p.codes.data(), 0, [](std::size_t i) { return i % 2; });
  coder.bits(p.raw.size(), p.raw.data(), p.widths.data());
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
    planes.widths.push_back(static_cast<std::uint8_t>(random.below(13)));
    planes.raw.push_back(static_cast<std::uint16_t>(random.below(std::uint64_t{1} << planes.widths.back())));
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
    out.raw.assign(planes.raw.size(), 0);
    out.widths = planes.widths;
    RansReader reader(tables, map);
    if (!reader.begin(bytes)) return false;
    walk(out, reader);
    return reader.ok() && reader.finished();
  };
  Planes out;
  REQUIRE(decode_stream(stream, out));
  CHECK(out.codes == planes.codes);
  CHECK(out.levels == planes.levels);
  CHECK(out.raw == planes.raw);
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
  good.parameters.opacity_levels = 2;
  good.opacity = {1, 0x3800, 0x3C00};
  good.sh_centre.resize(good.n_sh);
  good.sh_matrix.resize(good.n_sh * good.n_sh);
  good.map.resize(good.contexts().count);
  good.frequencies.assign(2 * kRansTokens, 0);
  good.frequencies[3] = good.frequencies[kRansTokens] = kRansTotal;
  const std::uint64_t frame = 1000 + 128 + 3 * 24;
  const auto parse = [](const std::vector<std::byte>& bytes) {
    return parse_archive_tables(bytes, 1000, Codec::archive, 1);
  };
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
  for (const float unit : {0.f, 0x1p-61f, 0x1p41f, std::nanf("")}) {
    bad = good;
    bad.sh_unit = unit;
    refused(write_archive_tables(bad), Errc::bad_value, frame);
  }
  for (ArchiveTables::Smoothing ArchiveTables::*smoothing :
       {&ArchiveTables::dc_smoothing, &ArchiveTables::sh_smoothing}) {
    bad = good;
    bad.*smoothing = {200, 55};
    CHECK(parse(write_archive_tables(bad)));
    bad.*smoothing = {200, 56};
    refused(write_archive_tables(bad), Errc::bad_value, frame);
  }
  for (const std::uint16_t opacity : std::array<std::uint16_t, 6>{0, 0x3C01, 0x7C00, 0x7E00, 0x8000, 0xB800}) {
    bad = good;
    bad.opacity[1] = opacity;
    refused(write_archive_tables(bad), Errc::bad_value, frame);
  }
  bad = good;
  bad.opacity.push_back(0x3C00);
  refused(write_archive_tables(bad), Errc::corrupt_data, frame);
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
  CHECK_FALSE(parse_archive_tables(original, 1000, Codec::archive, 2));  // of another degree
  CHECK_FALSE(parse_archive_tables(original, 1000, Codec::archive_draco, 1));
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
  const std::vector<std::byte> stream = draco_encode(points);
  std::vector<GridPoint> decoded(points.size());
  REQUIRE(decode_points(stream, 0, 12, decoded));
  CHECK(decoded == draco_decode(stream));
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
      const std::vector<std::byte> written = draco_encode(some);
      REQUIRE(decode_points(written, 0, bits, read));
      CHECK(read == draco_decode(written));
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
  CHECK(error_of(stream, 11) == Errc::corrupt_data);
  CHECK(error_of(stream, 12, 499) == Errc::corrupt_data);
  for (std::size_t n = 0; n < stream.size(); ++n) {
    const std::vector<std::byte> prefix(stream.begin(), stream.begin() + static_cast<std::ptrdiff_t>(n));
    REQUIRE(error_of(prefix) == Errc::corrupt_data);
  }
  std::vector<std::byte> bytes = stream;
  bytes.push_back({});
  CHECK(error_of(bytes) == Errc::corrupt_data);
  for (std::size_t i = 0; i < 31; ++i) {  // the header; coordinates may also have fewer bits
    bytes = stream;
    bytes[i] ^= std::byte{0x40};
    CHECK(error_of(bytes) == Errc::corrupt_data);
  }
  for (const std::uint64_t at : {11u, 27u}) {
    bytes = stream;
    put<std::uint32_t>(bytes, at, 0x7FFFFFFFu);
    CHECK(error_of(bytes) == Errc::corrupt_data);
  }
}
