// ply_writer_test.cpp - written PLY files match the original code's layout and read back bit for bit.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <fstream>
#include <iterator>
#include <numeric>
#include <string>
#include <thread>
#include <vector>

#include "ply_samples.hpp"
#include "rgs/ply.hpp"
#include "temporary_folder.hpp"

using rgs::Errc;
using rgs::PlyFile;
using rgs::PlyWriter;
using rgs::Splat;
using namespace rgs::test;

namespace {

std::string contents(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

constexpr rgs::AtomicFile::Options kFast{.overwrite = true, .sync = false};

}  // namespace

TEST_CASE("the header is that of the original 3DGS code") {
  CHECK(rgs::ply_header(7, 0) ==
        "ply\nformat binary_little_endian 1.0\nelement vertex 7\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property float nx\nproperty float ny\nproperty float nz\n"
        "property float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\n"
        "property float opacity\nproperty float scale_0\nproperty float scale_1\nproperty float scale_2\n"
        "property float rot_0\nproperty float rot_1\nproperty float rot_2\nproperty float rot_3\nend_header\n");
  const std::string degree3 = rgs::ply_header(1, 3);
  CHECK(degree3.find("property float f_dc_2\nproperty float f_rest_0\n") != std::string::npos);
  CHECK(degree3.find("property float f_rest_44\nproperty float opacity\n") != std::string::npos);
  CHECK(rgs::ply_row_bytes(0) == 68);
  CHECK(rgs::ply_row_bytes(3) == 248);
}

TEST_CASE("comments state what differs from the original code, and are read back") {
  using namespace rgs;
  Declarations d;
  d.aa_mode = AaMode::mip_splatting, d.low_pass_px2 = 0.1F;
  const std::string format = "ply\nformat binary_little_endian 1.0\n";
  CHECK(ply_header(0, 0, d).starts_with(format + "comment SplatRenderMode: mip\nelement vertex 0\n"));
  d.low_pass_px2 = 0.3F;
  d.colour_space = ColourSpace::linear_display;
  d.metres_per_unit = 0.01F;
  d.axes = {Axis::right, Axis::up, Axis::backward};
  const std::string header = ply_header(0, 0, d);
  CHECK(header.starts_with(format + "comment SplatRenderMode: mip\ncomment rgs_low_pass_px2: 0.3\n"
                                    "comment rgs_colour_space: linear\ncomment rgs_metres_per_unit: 0.01\n"
                                    "comment rgs_axes: right,up,backward\nelement vertex 0\n"));
  const auto ply = PlyFile::open(std::as_bytes(std::span(header)));
  REQUIRE(ply);
  CHECK(ply->declarations().aa_mode == d.aa_mode);
  CHECK(ply->declarations().low_pass_px2 == d.low_pass_px2);
  CHECK(ply->declarations().colour_space == d.colour_space);
  CHECK(ply->declarations().metres_per_unit == d.metres_per_unit);
  CHECK(ply->declarations().axes == d.axes);
  d = {};
  d.aa_mode = AaMode::undeclared, d.colour_space = ColourSpace::undeclared;
  d.axes.fill(Axis::undeclared);
  const std::string unknown = ply_header(0, 0, d);
  CHECK(PlyFile::open(std::as_bytes(std::span(unknown)))->declarations().aa_mode == AaMode::undeclared);
  CHECK(PlyFile::open(std::as_bytes(std::span(unknown)))->declarations().axes == d.axes);
}

TEST_CASE("a row is position, zero normals, DC, channel-major f_rest, opacity, scale, rotation") {
  Splat splat;
  for (int i = 0; i < 3; ++i) {
    splat.mean[i] = static_cast<float>(i);
    splat.log_scale[i] = static_cast<float>(20 + i);
  }
  for (int i = 0; i < 4; ++i) splat.rotation[i] = static_cast<float>(30 + i);
  splat.opacity_logit = 10;
  for (int k = 0; k < 4; ++k) {
    for (int c = 0; c < 3; ++c) splat.sh[3 * k + c] = static_cast<float>(100 * (c + 1) + k);
  }
  std::vector<float> row(rgs::ply_row_bytes(1) / 4);
  rgs::encode_ply_rows({&splat, 1}, 1, std::as_writable_bytes(std::span(row)));
  CHECK(row == std::vector<float>{0,   1,   2,   0,   0,   0,  100, 200, 300, 101, 102, 103, 201,
                                  202, 203, 301, 302, 303, 10, 20,  21,  22,  30,  31,  32,  33});
}

TEST_CASE("written values are read back bit for bit, at every degree") {
  const TemporaryFolder folder;
  for (int degree = 0; degree <= 3; ++degree) {
    for (const std::size_t n : {0UL, 1UL, 1023UL, 1024UL, 2500UL}) {
      CAPTURE(degree);
      CAPTURE(n);
      const auto splats = random_splats(n, degree, 7U + static_cast<std::uint32_t>(n));
      const std::string path = folder.file("scene.ply");
      auto writer = PlyWriter::create(path, n, degree, kFast);
      REQUIRE(writer);
      REQUIRE(writer->write(0, splats));
      REQUIRE(writer->commit());
      const auto ply = PlyFile::open(path);
      REQUIRE(ply);
      CHECK(ply->size() == n);
      CHECK(ply->sh_degree() == degree);
      CHECK(same_bits(read_all(*ply), splats));
      const auto cloud = rgs::read_ply(path);
      REQUIRE(cloud);
      REQUIRE(cloud->view().consistent());
      CHECK(cloud->size() == n);
      bool equal = true;
      for (std::size_t i = 0; i < n; ++i) {
        const Splat s = cloud->view().splat(i);
        equal = equal && same_bits({&s, 1}, {&splats[i], 1});
      }
      CHECK(equal);
    }
  }
}

TEST_CASE("rows written by several threads out of order make the same file") {
  const TemporaryFolder folder;
  constexpr std::size_t kCount = 5000, kPart = 333;
  const auto splats = random_splats(kCount, 3, 3);
  for (const unsigned n_threads : {1U, 2U, 4U}) {
    const std::string path = folder.file("threads.ply");
    auto writer = PlyWriter::create(path, kCount, 3, kFast);
    REQUIRE(writer);
    std::vector<std::thread> threads;
    for (unsigned t = 0; t < n_threads; ++t) {
      threads.emplace_back([&, t] {
        const std::size_t parts = (kCount + kPart - 1) / kPart;
        for (std::size_t p = parts; p-- > 0;) {
          if (p % n_threads != t) continue;
          const std::size_t first = p * kPart;
          const auto status = writer->write(first, std::span(splats).subspan(first, std::min(kPart, kCount - first)));
          if (!status) std::abort();
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
    REQUIRE(writer->commit());
    CHECK(contents(path) == binary_ply(splats, 3));
  }
}

TEST_CASE("the writer refuses bad degrees, impossible counts and existing outputs; without a commit there is no file") {
  const TemporaryFolder folder;
  const std::string path = folder.file("out.ply");
  const auto bad_degree = PlyWriter::create(path, 1, 4, kFast);
  REQUIRE_FALSE(bad_degree);
  CHECK(bad_degree.error().code == Errc::bad_argument);
  for (const std::uint64_t n : {std::uint64_t{1} << 56, ~std::uint64_t{0}}) {
    const auto too_many = PlyWriter::create(path, n, 3, kFast);
    REQUIRE_FALSE(too_many);
    CHECK(too_many.error().code == Errc::bad_argument);
    CHECK(too_many.error().found == n);
  }
  {
    auto writer = PlyWriter::create(path, 1, 0, kFast);
    REQUIRE(writer);
  }
  CHECK(std::filesystem::is_empty(folder.path()));
  std::ofstream(path) << "keep";
  const auto existing = PlyWriter::create(path, 1, 0, {});
  REQUIRE_FALSE(existing);
  CHECK(existing.error().code == Errc::output_exists);
  CHECK(contents(path) == "keep");
}
