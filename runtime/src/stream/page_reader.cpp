// page_reader.cpp - reads pages, several at once where they lie side by side.
// SPDX-License-Identifier: Apache-2.0
#include "stream/page_reader.hpp"

#include <algorithm>
#include <span>

#include "stream/stream_times.hpp"

namespace rgs::detail {

std::uint64_t PageReader::bytes(const PagedFile& file, std::uint64_t read_bytes, const DeviceSlots* slots,
                                std::uint32_t n_staged) {
  // Kept by a decoder from page to page: its tables, and a frame's content or an archive's codes, up to twice the
  // largest page.
  constexpr std::uint64_t kTables = 320 << 10;
  const std::uint64_t largest = file.most_decoded_bytes();
  const std::uint64_t times = file.codec() == Codec::none ? 0 : file.codec() == Codec::planes ? 2 : 3;
  const std::uint64_t staged = slots == nullptr ? 0 : staging_bytes(slots->plan().shape, n_staged);
  return sizeof(PageReader) + read_bytes + (1 + times) * largest + (times > 0 ? kTables : 4096) + staged;
}

Status PageReader::fill(std::uint32_t page, std::uint32_t end) {
  begin_ = end_ = 0;
  const std::uint64_t begin = file_.stored(page).offset;
  std::uint64_t read_end = begin;
  for (std::uint32_t next = page; next < end; ++next) {
    const StoredPage& stored = file_.stored(next);
    const std::uint64_t end_of_page = stored.offset + stored.stored_bytes;
    if (end_of_page - begin > capacity_) break;
    // If the end of the file is missing, reads what is before it.
    if (next > page && end_of_page > source_.size()) break;
    read_end = end_of_page;
  }
  if (read_end == begin) {
    return make_error(Errc::limit_exceeded, begin, "a page's stored bytes are more than it decodes to", capacity_);
  }
  if (read_end > source_.size()) {
    return make_error(Errc::truncated, source_.size(), "the end of the file is missing, and with it pages", read_end,
                      source_.size());
  }
  {
    const StreamTimer timer(StreamStep::read);
    if (Status read = source_.read(begin, {stored_.get(), read_end - begin}); !read) return read;
  }
  begin_ = begin;
  end_ = read_end;
  bytes_read_ += read_end - begin;
  return {};
}

Status PageReader::decode(std::uint32_t page) {
  const StoredPage& stored = file_.stored(page);
  const std::span<const std::byte> bytes(stored_.get() + (stored.offset - begin_), stored.stored_bytes);
  const auto rows = [&] {
    const StreamTimer timer(StreamStep::decode);
    return decoder_.decode(page, bytes, decoded_.first(file_.decoded_bytes(page)));
  }();
  if (!rows) return tl::unexpected(rows.error());
  return store_.put(page, *rows, writer_ ? &*writer_ : nullptr);
}

Status PageReader::finish() {
  return writer_ ? writer_->finish() : Status();
}

Status PageReader::read(std::uint32_t page, std::uint32_t end) {
  const StoredPage& stored = file_.stored(page);
  if (stored.offset < begin_ || stored.offset + stored.stored_bytes > end_) {
    if (Status filled = fill(page, end); !filled) return filled;
  }
  Status put = decode(page);
  // The bytes may have been damaged in transit.
  if (put || put.error().code != Errc::checksum_mismatch) return put;
  if (Status filled = fill(page, page + 1); !filled) return filled;
  return decode(page);
}

Result<FilePart> PageReader::read_range(const FileRange& range) {
  begin_run();
  const std::span<std::byte> bytes(stored_.get(), std::min(range.bytes, capacity_));
  if (Status read = source_.read(range.offset, bytes); !read) return tl::unexpected(read.error());
  bytes_read_ += bytes.size();
  return FilePart{range.offset, bytes};
}

}  // namespace rgs::detail
