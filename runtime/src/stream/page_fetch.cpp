// page_fetch.cpp - threads that carry out a scheduler's reads: they read, decode and place pages.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <mutex>
#include <optional>

#include "rgs/guard_memory.hpp"
#include "stream/page_reader.hpp"
#include "stream/stream_times.hpp"
#include "stream/streamed_state.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kTableBytes = 128 << 10;  // of a read

pages::event::Fault fault_of(Errc code) {
  if (exit_code(code) != exit_code(Errc::corrupt_data)) return pages::event::Fault::lost;
  return code == Errc::checksum_mismatch ? pages::event::Fault::checksum : pages::event::Fault::damaged;
}

}  // namespace

void StreamedState::fetch(PageReader& reader, const pages::action::Read& run) {
  const std::uint32_t end_of_run = run.first + run.n;
  const lod::Page& last = file->pages()[end_of_run - 1];
  const std::uint32_t end = last.first_child + last.n_children;
  reader.begin_run();
  std::array<PageReader::Ticket, pages::kMostGroups> sent{};  // by group of the run, once decoded
  std::uint32_t reported = run.first;                         // groups before it have arrived or failed
  FileRange known;                                            // bytes of the last page read
  for (std::uint32_t group = run.first; group < end_of_run; ++group) {
    const lod::Page& above = file->pages()[group];
    Status read = guard_memory([&]() -> Status {
      for (std::uint32_t child = above.first_child; child < above.first_child + above.n_children; ++child) {
        if (Status put = reader.read(child, end); !put) return put;
      }
      const auto ticket = reader.send();
      if (!ticket) return tl::unexpected(ticket.error());
      sent[group - run.first] = *ticket;
      return {};
    });
    if (read) known = reader.last_read();
    // A device copies one group while the next is decoded.
    const bool is_last = group + 1 == end_of_run;
    std::uint32_t ready = reported;  // groups before it can be drawn
    while (read && !is_last && ready <= group) {
      const auto is_done = reader.is_done(sent[ready - run.first]);
      if (!is_done) read = tl::unexpected(is_done.error());
      if (!is_done || !*is_done) break;
      ++ready;
    }
    const bool goes_on = read && !is_last;
    if (!goes_on) {
      // Also after a failure: the slots are released below.
      const Status finished = reader.finish();
      if (finished) {
        ready = read ? group + 1 : group;
      } else {
        read = finished;
        group = ready;
      }
    }
    // A frame holds the lock for a millisecond or two while it computes its cut; the next group is decoded meanwhile.
    if (goes_on && ready == reported) continue;
    std::unique_lock lock(pool->mutex, std::defer_lock);
    StreamTimer timer(StreamStep::lock);
    if (goes_on) {
      if (!lock.try_lock()) continue;
    } else {
      lock.lock();
    }
    timer.next(StreamStep::tell);
    stats.bytes_read += reader.take_bytes_read();
    if (reported < ready) {
      readable = known;
      is_troubled = false;
    }
    for (; reported < ready; ++reported) {
      const lod::Page& parent = file->pages()[reported];
      for (std::uint32_t child = parent.first_child; child < parent.first_child + parent.n_children; ++child) {
        stats.bytes_decoded += file->decoded_bytes(child);
        if (store->is_on_device()) stats.bytes_uploaded += file->decoded_bytes(child);
      }
      pool->tell(pages::event::Arrived{id, reported});
    }
    if (read) continue;
    // Damage is of one group. Where bytes or memory are missing for now, the rest of the run is retried with it.
    const pages::event::Fault fault = fault_of(read.error().code);
    const bool is_lost = fault == pages::event::Fault::lost;
    (is_lost ? trouble : damage) = read;
    is_troubled = is_troubled || is_lost;
    reported = is_lost ? end_of_run : group + 1;
    pool->tell(pages::event::Failed{id, group, reported - group, fault});
    if (is_lost) return;
  }
}

// One thread at a time, while others read known pages.
void StreamedState::extend_table(PageReader& reader, std::uint32_t group) {
  const StreamTimer timer(StreamStep::table);
  const auto part = reader.read_range(file->unread_table(group, kTableBytes));
  const Status extended = part ? file->extend(*part, group) : tl::unexpected(part.error());
  const std::scoped_lock lock(pool->mutex);
  stats.bytes_read += reader.take_bytes_read();
  if (extended) {
    is_troubled = false;
    pool->tell(pages::event::TableGrew{id, group, file->is_verified()});
    return;
  }
  const pages::event::Fault fault = fault_of(extended.error().code);
  is_troubled = fault == pages::event::Fault::lost;
  (is_troubled ? trouble : damage) = extended;
  pool->tell(pages::event::TableFailed{id, fault});
}

void StreamedState::probe(PageReader& reader) {
  const FileRange known = [this] {
    const std::scoped_lock lock(pool->mutex);
    return readable;
  }();
  const auto read = reader.read_range(known);
  const std::scoped_lock lock(pool->mutex);
  stats.bytes_read += reader.take_bytes_read();
  if (!read) trouble = tl::unexpected(read.error());
  pool->tell(pages::event::Probed{id, read.has_value()});
}

void StreamedState::work_until_stopped(PageReader& reader) {
  using namespace pages::action;
  if (store->is_on_device()) store->slots()->stay_on_device();
  std::unique_lock lock(pool->mutex);
  while (!is_stopping) {
    const auto task = [&] {
      const StreamTimer timer(StreamStep::choose);
      return pool->tell(pages::event::Idle{id});
    }();
    const WakeAt* later = task ? std::get_if<WakeAt>(&*task) : nullptr;
    if (task && later == nullptr) {
      ++n_claimed;
      work.notify_one();  // another thread may find more
      lock.unlock();
      if (const auto* read = std::get_if<Read>(&*task)) fetch(reader, *read);
      if (const auto* more = std::get_if<ReadTable>(&*task)) extend_table(reader, more->group);
      if (std::holds_alternative<Probe>(*task)) probe(reader);
      {
        const StreamTimer timer(StreamStep::lock);
        lock.lock();
      }
      pool->tell(pages::event::Done{id});
      continue;
    }
    const auto is_awake = [this, seen = pool->n_wakes, claimed = n_claimed] {
      return is_stopping || pool->n_wakes != seen || n_claimed != claimed;
    };
    const StreamTimer timer(StreamStep::idle);
    if (later != nullptr) {
      work.wait_until(lock, std::chrono::steady_clock::time_point(later->at), is_awake);
    } else {
      work.wait(lock, is_awake);
    }
  }
}

}  // namespace rgs::detail
