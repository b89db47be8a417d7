// mutate_files.cpp - mutated .rgs files and what the library says of them, for other readers to compare with.
// SPDX-License-Identifier: Apache-2.0
//
// rgs_mutate_files SEED COUNT FILE... > OUT prints for each mutation a line `CODE OFFSET SIZE` and the file's bytes. CODE and
// OFFSET are the error's, `none` and 0 of a sound file.

#include <cinttypes>
#include <cstdio>
#include <cstdlib>

#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs_mutator.hpp"

namespace {

using namespace rgs;

std::mt19937 bytes_random;

Status read_whole(std::span<const std::byte> bytes) {
  if (!has_levels(bytes)) {
    const auto view = FileView::open(bytes);
    return view ? validate(*view) : tl::unexpected(view.error());
  }
  const auto file = PagedFile::open(bytes);
  if (!file) return tl::unexpected(file.error());
  if (Status s = validate(*file); !s) return s;
  return file->complete() ? Status() : make_error(Errc::pages_missing, bytes.size(), "");
}

test::Bytes mutated(std::span<const std::byte> bytes, unsigned seed) {
  test::Bytes file = fuzz::RgsMutator(seed).mutate(bytes, 1 << 20).value_or(test::Bytes(bytes.begin(), bytes.end()));
  switch (seed % 8) {
    case 0: file.resize(file.size() + 1 + seed % 300); break;
    case 1:  // another size than it states
      test::put(std::span(file), 16, std::uint64_t{file.size() + 8 - seed % 16});
      test::fix_hashes(file);
      break;
    case 2:  // no longer what its checksums say
      file[bytes_random() % file.size()] ^= std::byte{1};
      break;
    default: break;
  }
  return file;
}

}  // namespace

/// Changes, adds or removes a byte, in place of libFuzzer's.
extern "C" std::size_t LLVMFuzzerMutate(std::uint8_t* data, std::size_t size, std::size_t max_size) {
  const auto value = static_cast<std::uint8_t>(bytes_random());
  if (size == 0 || (bytes_random() % 3 == 0 && size < max_size)) {
    data[size] = value;
    return size + 1;
  }
  if (bytes_random() % 2 == 0) return size - 1;
  data[bytes_random() % size] = value;
  return size;
}

int main(int argc, char** argv) {
  if (argc < 4) {
    std::fputs("usage: rgs_mutate_files SEED COUNT FILE... > OUT\n", stderr);
    return 2;
  }
  std::vector<test::Bytes> files;
  for (int i = 3; i < argc; ++i) files.push_back(test::read_bytes(argv[i]));
  const auto first = static_cast<unsigned>(std::strtoul(argv[1], nullptr, 10));
  const auto count = static_cast<unsigned>(std::strtoul(argv[2], nullptr, 10));
  for (unsigned seed = first; seed != first + count; ++seed) {
    bytes_random.seed(seed);
    const test::Bytes file = mutated(files[seed % files.size()], seed);
    const Status read = read_whole(file);
    const Error error = read ? Error{} : read.error();
    std::printf("%s %" PRIu64 " %zu\n", read ? "none" : errc_name(error.code), read ? 0 : error.offset, file.size());
    std::fwrite(file.data(), 1, file.size(), stdout);
  }
  return 0;
}
