// fuzz_reader.cpp - arbitrary bytes as an .rgs file without levels: open, validate, and read everything that
// FileView::open() accepts.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdlib>

#include "edit_file.hpp"
#include "rgs/decode.hpp"

#if defined(RGS_LIBFUZZER)
#include "rgs_mutator.hpp"

extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t max_size,
                                               unsigned seed) {
  return rgs::fuzz::mutate_rgs(data, size, max_size, seed);
}
#endif

namespace {

// Reads all decoded attributes; false if an entry of the tables stops it.
bool read_attributes(const rgs::DirectData& data) {
  std::vector<rgs::Splat> splats(std::min<std::uint64_t>(data.size(), 100));
  std::vector<rgs::ActivatedSplat> activated(splats.size());
  for (std::uint64_t done = 0; done < data.size(); done += splats.size()) {
    const std::uint64_t count = std::min<std::uint64_t>(splats.size(), data.size() - done);
    if (!data.read(data.first() + done, std::span(splats).first(count)) ||
        !data.read(data.first() + done, std::span(activated).first(count))) {
      return false;
    }
  }
  return true;
}

void read_all(std::span<const std::byte> bytes) {
  const auto view = rgs::FileView::open(bytes);
  if (!view) return;
  const bool valid = rgs::validate(*view).has_value();
  const std::uint64_t n = view->header().n_gaussians, n_chunks = view->header().n_chunks;
  for (std::uint64_t i = 0; i < n_chunks; ++i) static_cast<void>(view->chunk(i));
  for (std::uint64_t i = 0; i < view->header().n_step_sets; ++i) static_cast<void>(view->step_set(i));
  for (std::uint64_t i = 0; i < n; ++i) static_cast<void>(view->source_index(i));
  const auto data = rgs::load_direct(*view, {.validate = false, .threads = 1});
  const bool read = data && read_attributes(*data);
  if (n_chunks != 0) {
    const auto last = rgs::read_chunks(*view, n_chunks - 1, 1, {.validate = false, .threads = 1});
    if (last) static_cast<void>(read_attributes(*last));
  }
  const auto cloud = rgs::decode(bytes);
  if (cloud && !cloud->view().consistent()) std::abort();
  // Documented: after validate() none of this can fail.
  if (valid && !(read && cloud && rgs::load_direct(*view, {.threads = 1}))) std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto bytes = std::as_bytes(std::span(data, size));
  read_all(bytes);
  read_all(rgs::test::repaired(bytes));
  return 0;
}
