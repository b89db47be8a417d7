// interchange_test.cpp - one call for all formats: told apart by content, frames, limits, refusals.
// SPDX-License-Identifier: Apache-2.0
#include <limits>

#include "interchange_samples.hpp"
#include "rgs/encode.hpp"
#include "rgs/splat_edit.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr SplatFormat kWritable[] = {SplatFormat::ply, SplatFormat::compressed_ply, SplatFormat::spz,
                                     SplatFormat::splat, SplatFormat::glb};

}  // namespace

TEST_CASE("what is written is recognised by its content, whatever its name") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 2, 1);
  for (const SplatFormat format : kWritable) {
    CAPTURE(format_name(format));
    CHECK(is_writable(format));
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
  for (const SplatFormat format : {SplatFormat::rgs, SplatFormat::ksplat, SplatFormat::sog, SplatFormat::unknown}) {
    CHECK_FALSE(is_writable(format));
    CHECK(encode_splats(cloud.view(), format).error().code == Errc::bad_argument);
  }
}

TEST_CASE("names give a format by their ending") {
  CHECK(format_of_name("a/b.ply") == SplatFormat::ply);
  CHECK(format_of_name("b.compressed.ply") == SplatFormat::compressed_ply);
  CHECK(format_of_name("B.Compressed.PLY") == SplatFormat::compressed_ply);
  CHECK(format_of_name("x.spz") == SplatFormat::spz);
  CHECK(format_of_name("x.splat") == SplatFormat::splat);
  CHECK(format_of_name("x.ksplat") == SplatFormat::ksplat);
  CHECK(format_of_name("x.sog") == SplatFormat::sog);
  CHECK(format_of_name("scene/meta.json") == SplatFormat::sog);
  CHECK(format_of_name("x.glb") == SplatFormat::glb);
  CHECK(format_of_name("x.rgs") == SplatFormat::rgs);
  CHECK(format_of_name("spz") == SplatFormat::unknown);
  CHECK(format_of_name("x.zip") == SplatFormat::unknown);
}

TEST_CASE("Gaussians arrive in the frame of 3DGS unless asked otherwise or undeclared") {
  const SplatCloud cloud = ordinary_cloud(100, 3, 2);
  for (const SplatFormat format : {SplatFormat::spz, SplatFormat::glb}) {
    CAPTURE(format_name(format));
    SplatCloud turned = cloud;
    convert_axes(turned, kAxes3dgs, format_axes(format));
    const Bytes bytes = encode_splats(turned.view(), format).value();
    const auto there = read_splats(bytes, kKeepAxes), here = read_splats(bytes);
    REQUIRE(there);
    REQUIRE(here);
    CHECK(there->axes == format_axes(format));
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

TEST_CASE("a file that is read, filtered and encoded again keeps what it declared") {
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
  // Of another format, which has no depth range: that is the new file's own.
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

TEST_CASE("damaged Gaussians are passed on by PLY and refused by formats that cannot say so") {
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
