// interchange_memory_test.cpp - files of other formats without memory.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include "failing_memory.hpp"
#include "plausible_cloud.hpp"
#include "rgs/interchange.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using rgs::test::fail_each_allocation;
using rgs::test::file_bytes;
using rgs::test::hash_of;

TEST_CASE("reading and writing every format without JSON") {
  test::SplitMix random{7};
  const SplatCloud cloud = test::plausible_cloud(40, 1, random);
  const auto reads = [](const std::vector<std::byte>& bytes, SplatFormat format) {
    fail_each_allocation([&]() -> Result<std::uint64_t> {
      const auto file = read_splats(bytes, {{}, format, false});
      if (!file) return tl::unexpected(file.error());
      return hash_of(file->cloud.mean) ^ 3 * hash_of(file->cloud.sh);
    });
  };
  for (const SplatFormat format :
       {SplatFormat::ply, SplatFormat::compressed_ply, SplatFormat::spz, SplatFormat::ksplat, SplatFormat::splat}) {
    CAPTURE(format_name(format));
    fail_each_allocation([&]() -> Result<std::uint64_t> {
      const auto bytes = encode_splats(cloud.view(), format);
      if (!bytes) return tl::unexpected(bytes.error());
      return hash_of(*bytes);
    });
    reads(encode_splats(cloud.view(), format).value(), format);
  }
  reads(file_bytes("golden/packed_degree1.rgs"), SplatFormat::rgs);
}

TEST_CASE("PLY files by name, and cleaning") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("a rather long name, so that its string is on the heap");
  test::SplitMix random{8};
  const SplatCloud cloud = test::plausible_cloud(40, 2, random);
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    auto writer = PlyWriter::create(path, cloud.size(), cloud.sh_degree, {.overwrite = true, .sync = false});
    if (!writer) return tl::unexpected(writer.error());
    for (std::uint64_t i = 0; i < cloud.size(); ++i) {
      const Splat s = cloud.view().splat(i);
      if (Status written = writer->write(i, {&s, 1}); !written) return tl::unexpected(written.error());
    }
    if (const auto done = writer->commit(); !done) return tl::unexpected(done.error());
    return 1;
  });
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    const auto read = read_ply(path);
    if (!read) return tl::unexpected(read.error());
    return hash_of(read->mean);
  });
  SplatCloud cleaned = cloud;
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    const auto scan = clean_splats(cleaned, {});
    if (!scan) return tl::unexpected(scan.error());
    return scan->n_kept();
  });
}
