// fuzz_reader.cpp - any bytes as an .rgs file: open, validate, and read all that open() lets through.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdlib>

#include "edit_file.hpp"
#include "rgs/decode.hpp"

namespace {

void read_all(std::span<const std::byte> bytes) {
  const auto view = rgs::open(bytes);
  if (!view) return;
  const bool valid = rgs::validate(*view).has_value();
  const std::uint64_t n = view->header().n_gaussians;
  for (std::uint64_t i = 0; i < view->header().n_chunks; ++i) static_cast<void>(view->chunk(i));
  for (std::uint64_t i = 0; i < view->header().n_scale_sets; ++i) static_cast<void>(view->scale_set(i));
  for (std::uint64_t i = 0; i < n; ++i) static_cast<void>(view->source_index(i));
  std::vector<rgs::Splat> splats(std::min<std::uint64_t>(n, 100));
  std::vector<rgs::ActivatedSplat> activated(splats.size());
  for (std::uint64_t first = 0; first < n; first += splats.size()) {
    const std::uint64_t count = std::min<std::uint64_t>(splats.size(), n - first);
    const bool ok =
        view->read(first, std::span(splats).first(count)) && view->read(first, std::span(activated).first(count));
    if (valid && !ok) std::abort();  // documented: after validate() reading cannot fail
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto bytes = std::as_bytes(std::span(data, size));
  read_all(bytes);
  // Checksums would stop every mutation: once more with hashes, and the size, that fit.
  rgs::test::Bytes fixed(bytes.begin(), bytes.end());
  if (size >= 24) rgs::test::put<std::uint64_t>(fixed, 16, size);
  rgs::test::fix_hashes(fixed);
  read_all(fixed);
  return 0;
}
