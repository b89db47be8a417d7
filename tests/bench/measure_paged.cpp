// measure_paged.cpp - bytes that levels of detail add, and the decoding speed of pages, in every profile: prints the
// second table of docs/records/MEASUREMENTS.md, "Profiles". Each level keeps every fourth Gaussian of the level below, twice as large.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "trivial_levels.hpp"

namespace {

using namespace rgs;

int failed(const char* what, const Error& error) {
  std::fprintf(stderr, "%s: %s\n", what, error.what);
  return exit_code(error.code);
}

// Least CPU time of seven passes over all pages, one page at a time.
double decode_seconds(const PagedFile& file) {
  PageDecoder decoder(file);
  std::vector<std::byte> memory(file.largest_decoded_bytes());
  double best = 1e9;
  for (int turn = 0; turn < 7; ++turn) {
    const std::clock_t began = std::clock();
    for (std::uint32_t i = 0; i < file.n_pages(); ++i) {
      if (!decoder.decode(i, file.bytes(i), std::span(memory).first(file.decoded_bytes(i)))) std::abort();
    }
    best = std::min(best, static_cast<double>(std::clock() - began) / CLOCKS_PER_SEC);
  }
  return best;
}

int measure(const SplatCloud& source, Profile profile, const char* name, std::uint32_t page_chunks) {
  EncodeOptions options;
  options.profile = profile;
  const auto plain = encode(source.view(), options);
  if (!plain) return failed("encode", plain.error());
  // Stored Gaussians, in file order.
  EncodeOptions direct;
  const auto stored = encode(source.view(), direct);
  if (!stored) return failed("encode", stored.error());
  const auto leaves = decode(*stored);
  if (!leaves) return failed("decode", leaves.error());
  const lod::Levels levels = test::trivial_levels(*leaves, {.page_chunks = page_chunks});
  std::vector<std::byte> bytes;
  if (const auto written = write_levels(levels, options, bytes); !written) return failed("write", written.error());
  const auto file = PagedFile::open(bytes);
  if (!file) return failed("open", file.error());
  const auto n = static_cast<double>(source.size());
  const double seconds = decode_seconds(*file);
  std::printf("| %s | %u | %.3f | %.3f | **%.3f** | %.3f | %.3f ms |\n", name, file->n_pages(),
              static_cast<double>(file->n_stored()) / n, static_cast<double>(plain->size()) / n,
              static_cast<double>(bytes.size()) / n,
              static_cast<double>(bytes.size()) / static_cast<double>(plain->size()),
              1e3 * seconds / static_cast<double>(file->n_pages()));
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2 && argc != 3) {
    std::fputs("usage: rgs_measure_paged SCENE.ply [CHUNKS A PAGE]\n", stderr);
    return 2;
  }
  const auto ply = MappedFile::open(argv[1]);
  if (!ply) return failed(argv[1], ply.error());
  const auto opened = PlyFile::open(ply->bytes());
  if (!opened) return failed(argv[1], opened.error());
  const auto cloud = read_cloud(*opened);
  if (!cloud) return failed(argv[1], cloud.error());
  const auto page_chunks = argc == 3 ? static_cast<std::uint32_t>(std::atoi(argv[2])) : lod::kPageChunks;
  std::puts("| | pages | Gaussians stored for each | bytes without | bytes with levels | ratio | decode a page, CPU |");
  std::puts("|---|---|---|---|---|---|---|");
  if (const int code = measure(*cloud, Profile::direct, "direct", page_chunks); code != 0) return code;
  if (const int code = measure(*cloud, Profile::packed, "packed", page_chunks); code != 0) return code;
  return measure(*cloud, Profile::archive, "archive:high", page_chunks);
}
