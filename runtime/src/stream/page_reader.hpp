// page_reader.hpp - pages from their source to where they are drawn: what one thread needs for it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <shared_mutex>
#include <utility>

#include "rgs/byte_source.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/result.hpp"
#include "splat_arrays.hpp"
#include "stream/page_store.hpp"

namespace rgs::detail {

/// Of a table of pages. Who waits for it alone keeps others from taking it: threads that decode one page after the other would never
/// let go of it all at once.
class TableMutex {
 public:
  void lock() {
    const std::scoped_lock next(turn_);
    table_.lock();
  }
  void unlock() { table_.unlock(); }
  void lock_shared() {
    const std::scoped_lock next(turn_);
    table_.lock_shared();
  }
  void unlock_shared() { table_.unlock_shared(); }

 private:
  std::mutex turn_;
  std::shared_mutex table_;
};

class PageReader {
 public:
  /// `read_bytes`: of one read, at least least_bytes(file). `table` guards the file's table of pages, which may grow. All must outlive it.
  /// `writer`: of a store that is on a device.
  PageReader(const PagedFile& file, TableMutex& table, ByteSource& source, std::uint64_t read_bytes, PageStore& store,
             std::optional<SlotWriter> writer)
      : file_(file),
        table_(table),
        source_(source),
        store_(store),
        writer_(std::move(writer)),
        stored_(std::make_unique_for_overwrite<std::byte[]>(read_bytes)),
        capacity_(read_bytes),
        decoded_(file.most_decoded_bytes()),
        decoder_(file) {}

  /// Most memory that one takes. `slots`: of a store that is on a device, with the pages that its writer stages.
  static std::uint64_t bytes(const PagedFile& file, std::uint64_t read_bytes, const DeviceSlots* slots,
                             std::uint32_t n_staged);
  /// Room for any page: what coding makes larger than it is is a little larger.
  static std::uint64_t least_bytes(const PagedFile& file) {
    const std::uint64_t largest = file.most_decoded_bytes();
    return largest + largest / 8 + 4096;
  }

  /// Before pages that do not follow those that were read before.
  void begin_run() { begin_ = end_ = 0; }
  /// Puts a page in its place. Reads along what follows of pages before `end`, for the next calls. Errors: those of
  /// ByteSource::read(), PageDecoder::decode() and PageStore::put(); damage is that of a page that was read twice.
  Status read(std::uint32_t page, std::uint32_t end);
  /// Of what was put up to a send().
  using Ticket = SlotWriter::Ticket;
  /// Sends what was put to where it is drawn, where it is on its way to a device. Errors: device_failed.
  Result<Ticket> send() { return writer_ ? writer_->send() : Result<Ticket>(0); }
  /// Whether it is there, without waiting. Errors: device_failed.
  Result<bool> is_done(Ticket ticket) { return writer_ ? writer_->is_done(ticket) : Result<bool>(true); }
  /// Sends what was put and waits until it is where it is drawn; whatever it returns, nothing is on its way any more. Errors: device_failed.
  Status finish();
  /// What follows of the table of pages, `n` bytes or as many as fit, valid until the next call of any. Errors: those of
  /// ByteSource::read().
  Result<FilePart> read_table(const FileRange& unread, std::uint64_t n);
  /// Of the bytes that the last read() gave the first, a few hundred.
  FileRange last_read() const { return {begin_, std::min<std::uint64_t>(end_ - begin_, 512)}; }
  /// Reads what could be read before. Errors: those of ByteSource::read().
  Status read_again(const FileRange& range);
  /// Since the last call.
  std::uint64_t take_bytes_read() { return std::exchange(bytes_read_, 0); }

 private:
  Status fill(std::uint32_t page, std::uint32_t end);
  Status decode(std::uint32_t page);

  const PagedFile& file_;
  TableMutex& table_;
  ByteSource& source_;
  PageStore& store_;
  std::optional<SlotWriter> writer_;
  std::unique_ptr<std::byte[]> stored_;  // bytes begin_ .. end_ - 1 of the file
  std::uint64_t capacity_, begin_ = 0, end_ = 0, bytes_read_ = 0;
  PageMemory decoded_;
  PageDecoder decoder_;
};

}  // namespace rgs::detail
