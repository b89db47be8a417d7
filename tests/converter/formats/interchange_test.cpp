// interchange_test.cpp - one API for all formats: detection by content, frames, limits, refusals.
// SPDX-License-Identifier: Apache-2.0
#include <limits>

#include "complexity.hpp"
#include "golden_files.hpp"
#include "interchange_samples.hpp"
#include "rgs/encode.hpp"
#include "rgs/splat_edit.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr SplatFormat kWritable[] = {
    SplatFormat::compressed_ply, SplatFormat::ply,  SplatFormat::spz_glb, SplatFormat::glb, SplatFormat::usda,
    SplatFormat::usdz,           SplatFormat::spz,  SplatFormat::npz,     SplatFormat::sog, SplatFormat::rad,
    SplatFormat::ksplat,         SplatFormat::splat};

}  // namespace

TEST_CASE("written files are recognised by content, whatever their names") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 2, 1);
  for (const SplatFormat format : kWritable) {
    CAPTURE(format_name(format));
    CHECK(format_info(format).writable);
    const Bytes bytes = encode_splats(cloud.view(), format).value();
    CHECK(detect_format(bytes) == format);
    write_bytes(folder.file("scene.bin"), bytes);
    const auto file = read_splats(folder.file("scene.bin"));
    REQUIRE(file);
    CHECK(file->format == format);
    CHECK(file->bytes == bytes.size());
    CHECK(file->cloud.size() == 300);
    CHECK(*encode_splats(cloud.view(), format) == bytes);  // deterministic
  }
  const Bytes rgs = encode(cloud.view()).value();
  CHECK(detect_format(rgs) == SplatFormat::rgs);
  CHECK(read_splats(rgs)->cloud.size() == 300);
  CHECK(detect_format({}) == SplatFormat::unknown);
  CHECK(detect_format(bytes_of("no splats here, only text")) == SplatFormat::unknown);
  for (const SplatFormat format :
       {SplatFormat::rgs, SplatFormat::pt, SplatFormat::lcc, SplatFormat::lcc2, SplatFormat::unknown}) {
    CHECK(format_info(format).writable == (format == SplatFormat::rgs));
    CHECK(encode_splats(cloud.view(), format).error().code == Errc::bad_argument);
  }
}

TEST_CASE("a visitor gets the scene of any format piece by piece, of those that are read in parts in small ones") {
  constexpr std::uint64_t kN = 70'000;
  const SplatCloud cloud = ordinary_cloud(kN, 1, 3);
  for (const SplatFormat format : kWritable) {
    CAPTURE(format_name(format));
    CHECK((check_pieces(encode_splats(cloud.view(), format).value()) < kN) == format_info(format).in_parts);
  }
  EncodeOptions options;
  check_pieces(encode(cloud.view(), options).value());
  options.profile = Profile::packed;
  options.keep_permutation = true;
  check_pieces(encode(cloud.view(), options).value());
  check_pieces(golden_file("levels_packed"));

  const Bytes splat = encode_splats(cloud.view(), SplatFormat::splat).value();
  ReadOptions stops;
  int n_pieces = 0;
  stops.visit = [&](const SplatFile&) -> Status {
    ++n_pieces;
    return make_error(Errc::write_failed, Error::kNone, "no room");
  };
  CHECK(read_splats(splat, stops).error().code == Errc::write_failed);
  CHECK(n_pieces == 1);
}

namespace {

// Gaussians with some attributes outside some formats' ranges.
SplatCloud wide_cloud(std::uint64_t n, int degree, std::uint64_t seed) {
  SplatCloud cloud = ordinary_cloud(n, degree, seed);
  SplitMix random(seed + 1);
  for (float& x : cloud.mean) x *= random.below(9) == 0 ? 1e5F : 1.F;
  for (float& x : cloud.log_scale) x *= random.below(9) == 0 ? 4.F : 1.F;
  for (float& x : cloud.opacity_logit) x *= random.below(9) == 0 ? 40.F : 1.F;
  for (float& x : cloud.sh) x *= random.below(40) == 0 ? 6.F : 1.F;
  return cloud;
}

// Gaussians whose copy differs by more than `step`, half the format's, and the largest distance.
template <class Difference>
Clamped beyond(const SplatCloud& copy, const SplatCloud& original, double step, const Difference& difference) {
  Clamped clamped;
  for (std::uint64_t i = 0; i < original.size(); ++i) {
    const double apart = difference(copy.view().splat(i), original.view().splat(i));
    if (apart <= step) continue;
    ++clamped.n;
    clamped.largest = std::max(clamped.largest, apart);
  }
  return clamped;
}

double apart(const float* a, const float* b, int count) {
  double largest = 0;
  for (int k = 0; k < count; ++k)
    largest = std::max(largest, std::abs(static_cast<double>(a[k]) - static_cast<double>(b[k])));
  return largest;
}

void check_same(const Clamped& counted, const Clamped& seen, double tolerance) {
  CHECK(counted.n == seen.n);
  CHECK(counted.largest == doctest::Approx(seen.largest).epsilon(tolerance));
}

}  // namespace

TEST_CASE("values that come back farther away than half a step count as clamped") {
  for (int degree = 0; degree <= 3; ++degree) {
    CAPTURE(degree);
    const SplatCloud cloud = wide_cloud(600, degree, 40);
    double largest_log_scale = 0;
    for (const float x : cloud.log_scale)
      largest_log_scale = std::max(largest_log_scale, std::abs(static_cast<double>(x)));
    const int n_rest = 3 * (sh_coefficients(degree) - 1);
    const auto log_scale = [](const Splat& a, const Splat& b) { return apart(a.log_scale, b.log_scale, 3); };
    const auto mean = [](const Splat& a, const Splat& b) { return apart(a.mean, b.mean, 3); };
    const auto dc = [](const Splat& a, const Splat& b) { return apart(a.sh, b.sh, 3); };
    const auto rest = [&](const Splat& a, const Splat& b) { return apart(a.sh + 3, b.sh + 3, n_rest); };
    WriteReport report;
    const auto copy_as = [&](SplatFormat format) {
      const auto bytes = encode_splats(cloud.view(), format, {.keep_order = true}, &report);
      REQUIRE(bytes);
      CHECK(*bytes == encode_splats(cloud.view(), format, {.keep_order = true}).value());
      const auto strict = encode_splats(cloud.view(), format, {.strict = true});
      CHECK(strict.has_value() == !report.any());
      if (!strict) {
        CHECK(std::string(errc_name(strict.error().code)) == "bad_value");
        CHECK(strict.error().found > 0);
        CHECK(strict.error().offset == Error::kNone);
      }
      SplatCloud copy = read_splats(*bytes, kKeepAxes).value().cloud;
      if (copy.sh_degree == degree) return copy;
      SplatCloud wider;  // .splat has no harmonics: as zeros
      wider.resize(copy.size(), degree);
      for (std::uint64_t i = 0; i < copy.size(); ++i) wider.set(i, copy.view().splat(i));
      return wider;
    };
    SplatCloud copy = copy_as(SplatFormat::spz);
    check_same(report.mean, beyond(copy, cloud, 0x1p-13, mean), 1e-6);
    check_same(report.log_scale, beyond(copy, cloud, 1 / 32.0 + 1e-6, log_scale), 1e-6);
    check_same(report.sh_dc, beyond(copy, cloud, 0.5 / 255 / 0.15 + 1e-6, dc), 1e-6);
    // Codes of harmonics absorb each other's errors, so the copy reveals only values far outside.
    CHECK(report.sh.n >= beyond(copy, cloud, 0.3, rest).n);
    CHECK((report.sh.n > 0) == (degree > 0));
    CHECK(report.opacity_logit.n == 0);
    CHECK(report.mean.n > 0);
    CHECK(report.log_scale.n > 0);
    CHECK(report.sh_dc.n > 0);

    copy = copy_as(SplatFormat::splat);
    check_same(report.sh_dc, beyond(copy, cloud, 0.5 / 255 / 0.28209479 + 1e-6, dc), 1e-6);
    check_same(report.sh, beyond(copy, cloud, 0, rest), 1e-6);
    CHECK(report.mean.n + report.log_scale.n + report.opacity_logit.n == 0);

    copy = copy_as(SplatFormat::compressed_ply);
    // The outermost codes represent the ends of the range, a whole step from the next code: only values beyond count.
    const auto outside = [&](const Splat& a, const Splat& b) {
      double largest = 0;
      for (int k = 3; k < 3 + n_rest; ++k) {
        if (std::abs(b.sh[k]) > 4) largest = std::max(largest, apart(a.sh + k, b.sh + k, 1));
      }
      return largest;
    };
    check_same(report.sh, beyond(copy, cloud, 1 / 64.0 + 1e-6, outside), 1e-6);
    CHECK((report.sh.n > 0) == (degree > 0));
    CHECK(report.log_scale.n > 0);
    CHECK(report.log_scale.largest == doctest::Approx(largest_log_scale - 20));
    CHECK(report.mean.n + report.opacity_logit.n + report.sh_dc.n == 0);

    copy = copy_as(SplatFormat::glb);
    const auto logit = [](const Splat& a, const Splat& b) { return apart(&a.opacity_logit, &b.opacity_logit, 1); };
    CHECK(report.opacity_logit.n > 0);
    CHECK(report.opacity_logit.n == beyond(copy, cloud, 1, logit).n);
    CHECK(report.mean.n + report.log_scale.n + report.sh_dc.n + report.sh.n == 0);

    copy_as(SplatFormat::ply);
    CHECK_FALSE(report.any());
  }
  WriteReport report;
  const SplatCloud ordinary = ordinary_cloud(300, 0, 3);
  for (const SplatFormat format : kWritable) {
    CAPTURE(format_name(format));
    CHECK(encode_splats(ordinary.view(), format, {.strict = true}, &report));
    CHECK_FALSE(report.any());
  }
}

TEST_CASE("growth: all formats are read and written in linear time, coincident Gaussians and outliers too") {
  const auto ordinary = [](std::uint64_t n) { return ordinary_cloud(n, 1, 5); };
  const auto coincident = [](std::uint64_t n) {
    SplatCloud one = ordinary_cloud(1, 1, 5), cloud;
    for (std::uint64_t i = 0; i < n; ++i) append_splats(cloud, one);
    return cloud;
  };
  const auto outliers = [](std::uint64_t n) {
    SplatCloud cloud = ordinary_cloud(n, 1, 5);
    for (std::uint64_t i = 0; i < 3 * n; i += 7) cloud.mean[i] *= 1000;
    return cloud;
  };
  const auto check = [](SplatFormat format, const auto& prepare) {
    CAPTURE(std::string(format_name(format)));
    const auto write = [format](const SplatCloud& cloud) {
      const auto bytes = format == SplatFormat::rgs ? encode(cloud.view()) : encode_splats(cloud.view(), format);
      REQUIRE(bytes);
      return *bytes;
    };
    CHECK(growth(1000, prepare, write) < kLinearGrowth);
    const auto file = [&](std::uint64_t count) { return write(prepare(count)); };
    CHECK(growth(1000, file, [](const Bytes& bytes) { CHECK(read_splats(bytes)); }) < kLinearGrowth);
  };
  std::vector<SplatFormat> formats(std::begin(kWritable), std::end(kWritable));
  formats.push_back(SplatFormat::rgs);
  for (const SplatFormat format : formats) {
    check(format, coincident);
    if (format == SplatFormat::spz || format == SplatFormat::spz_glb)
      continue;  // without repetitions, Zstandard's search outgrows one cache after another
    check(format, ordinary);
    check(format, outliers);
  }
}

TEST_CASE("formats that are not read are named, with what to do, and so is an empty file") {
  const std::pair<std::string, const char*> files[] = {
      {"RADC....{\"version\":1}", ".radc of Spark"},
      {std::string("PXR-USDC") + std::string(80, '\0'), "OpenUSD"},
      {std::string("PK\3\4") + std::string(22, '\0') + std::string("\17\0\0\0", 4) + "@3dtilesIndex1@", "3D Tiles"},
      {std::string("\x93NUMPY\1\0v", 9) + std::string(90, ' '), ".npy"}};
  for (const auto& [text, named] : files) {
    const std::string what = named;
    CAPTURE(what);
    const Bytes bytes = bytes_of(text);
    CHECK(detect_format(bytes) == SplatFormat::unknown);
    const auto file = read_splats(bytes);
    REQUIRE_FALSE(file);
    CHECK(file.error().code == Errc::unsupported_feature);
    CHECK(file.error().offset == 0);
    CHECK(std::string(file.error().what).find(what) != std::string::npos);
    CHECK(std::string(file.error().what).find(" not read: ") != std::string::npos);
  }
  const auto empty = read_splats(Bytes());
  REQUIRE_FALSE(empty);
  CHECK(empty.error().code == Errc::truncated);
  CHECK(std::string(empty.error().what) == "the file is empty");
  const auto text = read_splats(bytes_of("no splats here, only text"));
  REQUIRE_FALSE(text);
  CHECK(text.error().code == Errc::bad_magic);
  CHECK(std::string(text.error().what) ==
        "is not a .rgs, .compressed.ply, .ply, .tileset.json, .spz.glb, .glb, .usda, .usdz, .spz, .npz, .pt, .ssog, "
        ".sog, "
        ".rad, .lcc, .lcc2, .ksplat or .splat file");
}

TEST_CASE("every format has one entry, by which it is found") {
  std::string written;
  for (const FormatInfo& info : all_formats()) {
    CAPTURE(info.name);
    CHECK(format_info(info.format).name == info.name);
    CHECK(format_of_name(std::string("a.") + info.name) == info.format);
    CHECK(std::string(info.title) != "");
    CHECK(std::string(info.precision) != "");
    // These are written from more than Gaussians.
    if (info.writable && info.format != SplatFormat::rgs && info.format != SplatFormat::ssog &&
        info.format != SplatFormat::tileset)
      written += std::string(" ") + info.name;
  }
  std::string expected;
  for (const SplatFormat format : kWritable) expected += std::string(" ") + format_name(format);
  CHECK(written == expected);
  CHECK(std::string(format_name(SplatFormat::unknown)) == "unknown");
  CHECK_FALSE(format_info(SplatFormat::unknown).writable);
}

TEST_CASE("an output's extension chooses the format") {
  for (const char* folder : {"", "a/", "a.ply/"}) CHECK(format_of_name(folder) == SplatFormat::unknown);
  CHECK(format_of_name("a/b.ply") == SplatFormat::ply);
  CHECK(format_of_name("b.compressed.ply") == SplatFormat::compressed_ply);
  CHECK(format_of_name("B.Compressed.PLY") == SplatFormat::compressed_ply);
  CHECK(format_of_name("x.spz") == SplatFormat::spz);
  CHECK(format_of_name("x.splat") == SplatFormat::splat);
  CHECK(format_of_name("x.ksplat") == SplatFormat::ksplat);
  CHECK(format_of_name("x.sog") == SplatFormat::sog);
  CHECK(format_of_name("scene/meta.json") == SplatFormat::sog);
  CHECK(format_of_name("x.ssog") == SplatFormat::ssog);
  CHECK(format_of_name("scene/lod-meta.json") == SplatFormat::ssog);
  CHECK(format_of_name("x.glb") == SplatFormat::glb);
  CHECK(format_of_name("x.spz.glb") == SplatFormat::spz_glb);
  CHECK(format_of_name("tiles/tileset.json") == SplatFormat::tileset);
  CHECK(format_of_name("x.rgs") == SplatFormat::rgs);
  CHECK(format_of_name("spz") == SplatFormat::unknown);
  CHECK(format_of_name("x.zip") == SplatFormat::unknown);
}

TEST_CASE("Gaussians arrive in 3DGS's frame unless the caller keeps theirs or none is declared") {
  const SplatCloud cloud = ordinary_cloud(100, 3, 2);
  for (const SplatFormat format : {SplatFormat::spz, SplatFormat::glb}) {
    CAPTURE(format_name(format));
    SplatCloud turned = cloud;
    convert_axes(turned, kAxes3dgs, format_info(format).axes);
    const Bytes bytes = encode_splats(turned.view(), format).value();
    const auto there = read_splats(bytes, kKeepAxes), here = read_splats(bytes);
    REQUIRE(there);
    REQUIRE(here);
    CHECK(there->axes == format_info(format).axes);
    CHECK(here->axes == kAxes3dgs);
    CHECK(compare(there->cloud, turned).mean[1] <= 1e-3);
    CHECK(compare(here->cloud, cloud).mean[1] <= 1e-3);
    CHECK(compare(here->cloud, cloud).sh[3] <= 0.62 / 8);  // steps of SPZ, see spz.cpp
  }
  EncodeOptions options;
  options.axes = {Axis::right, Axis::up, Axis::backward};
  const auto declared = read_splats(encode(cloud.view(), options).value());
  options.axes.fill(Axis::undeclared);
  options.aa_mode = AaMode::mip_splatting;
  const auto undeclared = read_splats(encode(cloud.view(), options).value());
  REQUIRE(declared);
  REQUIRE(undeclared);
  CHECK(declared->axes == kAxes3dgs);
  CHECK(undeclared->axes == options.axes);
  CHECK(undeclared->aa_mode == AaMode::mip_splatting);
  CHECK(declared->cloud.mean[1] == -undeclared->cloud.mean[1]);
}

TEST_CASE("a file that is read, filtered and encoded again keeps its declarations") {
  const SplatCloud cloud = ordinary_cloud(100, 1, 5);
  EncodeOptions first;
  first.aa_mode = AaMode::mip_splatting;
  first.low_pass_px2 = 0.2F;
  first.metres_per_unit = 0.5F;
  first.depth = DepthRange{0.5F, 32, DepthSource::cameras};
  first.keep_permutation = true;
  first.provenance = Provenance{1, 2, "garden.ply", "test"};
  auto file = read_splats(encode(cloud.view(), first).value());
  REQUIRE(file);
  REQUIRE(file->source_index.size() == 100);
  const std::vector<std::uint64_t> kept = filter_splats(file->cloud, {std::nullopt, 0, 40});
  REQUIRE(kept.size() == 40);
  std::vector<std::uint32_t> source_index;
  for (const std::uint64_t i : kept) source_index.push_back(file->source_index[i]);
  EncodeOptions again = keep_declarations({}, *file);
  again.keep_permutation = true;
  again.source_index = source_index;
  const Bytes bytes = encode(file->cloud.view(), again).value();
  const auto view = FileView::open(bytes);
  REQUIRE(view);
  REQUIRE(validate(*view));
  const Declarations& d = view->declarations();
  CHECK(d.aa_mode == AaMode::mip_splatting);
  CHECK(d.low_pass_px2 == 0.2F);
  CHECK(d.metres_per_unit == 0.5F);
  CHECK(d.z_far == 32);
  CHECK(d.n_source == 100);
  CHECK(view->provenance()->source_name == "garden.ply");
  // Another format has no depth range: the new file computes its own.
  file = read_splats(encode_splats(cloud.view(), SplatFormat::spz, {.aa_mode = AaMode::mip_splatting}).value());
  REQUIRE(file);
  const Bytes own = encode(file->cloud.view(), keep_declarations({}, *file)).value();
  const Declarations of_spz = FileView::open(own)->declarations();
  const Declarations usual = FileView::open(encode(file->cloud.view()).value())->declarations();
  CHECK(of_spz.aa_mode == AaMode::mip_splatting);
  CHECK(of_spz.low_pass_px2 == 0.1F);
  CHECK(of_spz.z_far == usual.z_far);
  CHECK(of_spz.depth_mapping == usual.depth_mapping);
}

TEST_CASE("limits hold for every format") {
  const SplatCloud cloud = ordinary_cloud(300, 1, 3);
  std::vector<Bytes> files{encode(cloud.view()).value()};
  for (const SplatFormat format : kWritable) files.push_back(encode_splats(cloud.view(), format).value());
  for (const Bytes& bytes : files) {
    CAPTURE(format_name(detect_format(bytes)));
    ReadOptions options;
    options.limits.max_gaussians = 300;
    CHECK(read_splats(bytes, options));
    options.limits.max_gaussians = 299;
    CHECK(read_splats(bytes, options).error().code == Errc::limit_exceeded);
    options = {};
    options.limits.max_file_bytes = bytes.size() - 1;
    CHECK(read_splats(bytes, options).error().code == Errc::limit_exceeded);
  }
}

TEST_CASE("PLY passes damaged Gaussians on, and formats that cannot express them refuse") {
  SplatCloud cloud = ordinary_cloud(10, 1, 4);
  cloud.opacity_logit[7] = std::numeric_limits<float>::quiet_NaN();
  for (const SplatFormat format : kWritable) {
    CAPTURE(format_name(format));
    const auto bytes = encode_splats(cloud.view(), format);
    if (format == SplatFormat::ply) {
      REQUIRE(bytes);
      CHECK(std::isnan(read_splats(*bytes)->cloud.opacity_logit[7]));
    } else {
      REQUIRE_FALSE(bytes);
      CHECK(bytes.error().code == Errc::bad_value);
      CHECK(bytes.error().offset == 7);
    }
  }
}
