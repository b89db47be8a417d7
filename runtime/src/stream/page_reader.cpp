// page_reader.cpp - reads pages, several at once where they lie side by side.
// SPDX-License-Identifier: Apache-2.0
#include "stream/page_reader.hpp"

#include <algorithm>
#include <span>

namespace rgs::detail {

std::uint64_t PageReader::largest_stored(const PagedFile& file) {
  std::uint64_t largest = 0;
  for (std::uint32_t i = 0; i < file.n_pages(); ++i)
    largest = std::max<std::uint64_t>(largest, file.stored(i).stored_bytes);
  return largest;
}

std::uint64_t PageReader::bytes(const PagedFile& file, std::uint64_t read_bytes) {
  // What a decoder keeps from page to page: contents of a frame or codes of an archive, up to twice what the largest takes, and
  // its tables.
  constexpr std::uint64_t kTables = 512 << 10;
  const std::uint64_t largest = file.largest_decoded_bytes();
  const std::uint64_t times = file.codec() == Codec::none ? 0 : file.codec() == Codec::planes ? 2 : 4;
  return sizeof(PageReader) + read_bytes + (1 + times) * largest + (times > 0 ? kTables : 4096);
}

Status PageReader::fill(std::uint32_t page, std::uint32_t end) {
  const std::uint64_t begin = file_.stored(page).offset;
  std::uint64_t read_end = begin;
  for (std::uint32_t next = page; next < end; ++next) {
    const StoredPage& stored = file_.stored(next);
    if (stored.offset + stored.stored_bytes - begin > capacity_) break;
    read_end = stored.offset + stored.stored_bytes;
  }
  begin_ = end_ = 0;
  if (Status read = source_.read(begin, {stored_.get(), read_end - begin}); !read) return read;
  begin_ = begin;
  end_ = read_end;
  bytes_read_ += read_end - begin;
  return {};
}

Result<std::unique_ptr<float[]>> PageReader::decode(std::uint32_t page) {
  const StoredPage& stored = file_.stored(page);
  const std::span<const std::byte> bytes(stored_.get() + (stored.offset - begin_), stored.stored_bytes);
  const auto rows = decoder_.decode(page, bytes, decoded_.first(file_.decoded_bytes(page)));
  if (!rows) return tl::unexpected(rows.error());
  const int sh_degree = file_.head().header().sh_degree;
  auto block = SplatArrays::memory(rows->n, sh_degree);
  const Status set = SplatArrays(block.get(), rows->n, sh_degree).set_page(file_, page, *rows, 0);
  if (!set) return tl::unexpected(set.error());
  return block;
}

Result<std::unique_ptr<float[]>> PageReader::read(std::uint32_t page, std::uint32_t end) {
  const StoredPage& stored = file_.stored(page);
  if (stored.offset < begin_ || stored.offset + stored.stored_bytes > end_) {
    if (const Status filled = fill(page, end); !filled) return tl::unexpected(filled.error());
  }
  auto block = decode(page);
  if (block || block.error().code == Errc::host_out_of_memory) return block;
  // Bytes may be damaged on their way.
  if (const Status filled = fill(page, page + 1); !filled) return tl::unexpected(filled.error());
  return decode(page);
}

}  // namespace rgs::detail
