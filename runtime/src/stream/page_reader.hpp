// page_reader.hpp - brings pages from their source to the store: what one thread needs for it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <utility>

#include "rgs/byte_source.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/result.hpp"
#include "splat_arrays.hpp"
#include "stream/page_store.hpp"

namespace rgs::detail {

class PageReader {
 public:
  /// `read_bytes`: of one read, at least least_bytes(file). All must outlive it. `writer`: needed if the store is on a
  /// device.
  PageReader(const PagedFile& file, ByteSource& source, std::uint64_t read_bytes, PageStore& store,
             std::optional<SlotWriter> writer)
      : file_(file),
        source_(source),
        store_(store),
        writer_(std::move(writer)),
        stored_(std::make_unique_for_overwrite<std::byte[]>(read_bytes)),
        capacity_(read_bytes),
        decoded_(file.most_decoded_bytes()),
        decoder_(file) {}

  /// Most memory that a reader takes. `slots`: of a store on a device, with `n_staged` pages that its writer stages.
  static std::uint64_t bytes(const PagedFile& file, std::uint64_t read_bytes, const DeviceSlots* slots,
                             std::uint32_t n_staged);
  /// Enough for any page: coding may make a page a little larger than it is.
  static std::uint64_t least_bytes(const PagedFile& file) {
    const std::uint64_t largest = file.most_decoded_bytes();
    return largest + largest / 8 + 4096;
  }

  /// Call before pages that do not follow those read before.
  void begin_run() { begin_ = end_ = 0; }
  /// Reads, decodes and stores a page. Reads the pages that follow it, up to `end`, along with it for the next calls. A
  /// page whose checksum does not match is read a second time. Errors: those of ByteSource::read(), PageDecoder::decode() and
  /// PageStore::put().
  Status read(std::uint32_t page, std::uint32_t end);
  /// Numbers what was stored up to one send().
  using Ticket = SlotWriter::Ticket;
  /// On a device, sends what was stored to its slots. Errors: device_failed.
  Result<Ticket> send() { return writer_ ? writer_->send() : Result<Ticket>(0); }
  /// Whether that has arrived; does not wait. Errors: device_failed.
  Result<bool> is_done(Ticket ticket) { return writer_ ? writer_->is_done(ticket) : Result<bool>(true); }
  /// Sends what was stored and waits for it; after any return nothing is in flight. Errors: device_failed.
  Status finish();
  /// The first bytes of any range of the file, as many as fit, valid until the next call. Errors: those of
  /// ByteSource::read().
  Result<FilePart> read_range(const FileRange& range);
  /// The first few hundred bytes of the last read().
  FileRange last_read() const { return {begin_, std::min<std::uint64_t>(end_ - begin_, 512)}; }
  /// Since the last call.
  std::uint64_t take_bytes_read() { return std::exchange(bytes_read_, 0); }

 private:
  Status fill(std::uint32_t page, std::uint32_t end);
  Status decode(std::uint32_t page);

  const PagedFile& file_;
  ByteSource& source_;
  PageStore& store_;
  std::optional<SlotWriter> writer_;
  std::unique_ptr<std::byte[]> stored_;  // bytes begin_ .. end_ - 1 of the file
  std::uint64_t capacity_, begin_ = 0, end_ = 0, bytes_read_ = 0;
  PageMemory decoded_;
  PageDecoder decoder_;
};

}  // namespace rgs::detail
