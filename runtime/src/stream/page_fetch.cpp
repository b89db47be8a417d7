// page_fetch.cpp - threads that read and decode absent pages: what views want, largest projected error first; then
// prefetch.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <limits>
#include <optional>
#include <utility>

#include "rgs/guard_memory.hpp"
#include "stream/page_reader.hpp"
#include "stream/stream_times.hpp"
#include "stream/streamed_state.hpp"

namespace rgs::detail {
namespace {

using namespace std::chrono_literals;

constexpr StreamClock::duration kFirstPause = 250ms, kLongestPause = 8s;  // after reads that failed
constexpr StreamClock::duration kLongestWaited = 1s;                      // while a caller waits
constexpr std::uint32_t kMostGroups = 64;                                 // of a run
constexpr std::uint64_t kRecordBytes = 112;                               // of a page's record in the file's table
constexpr std::uint64_t kLeastTableBytes = 64 << 10;                      // of a read
constexpr float kSideShare = 0.25F;  // A neighbour joins a run if it has this share of the first group's error.
/// Wants for which victims are searched; each search visits all resident groups.
constexpr int kMostLooks = 8;

bool is_damage(Errc code) {
  return exit_code(code) == exit_code(Errc::corrupt_data);
}

/// For Residency. Wraps after 49 days; an older failure then counts as a new one.
std::uint32_t milliseconds(StreamClock::time_point time) {
  return static_cast<std::uint32_t>(
      std::chrono::duration_cast<std::chrono::milliseconds>(time.time_since_epoch()).count());
}

}  // namespace

// Brings the views' lists of wants (`now`) or prefetch wants up to date.
void StreamedState::find_wants(bool now) {
  for (const auto& view : views) {
    if (!view->is_live || (!now && !view->ahead)) continue;
    WantList& list = now ? view->wants : view->prefetch_wants;
    const bool is_over = !now && list.wants().empty() && list.is_cut_off();
    if (!now && (!std::exchange(view->prefetch_is_current, true) || is_over)) {
      list.clear();
      residency->cut(
          *view->ahead, pool->tick, [](std::uint32_t) { return true; },
          [&](std::uint32_t group, float px) { list.add(group, rank(group, px)); }, view->ahead->detail_px);
      list.order();
    }
    if (now) {
      list.rank_put_off([&](std::uint32_t group) { return rank(group, residency->wanted_px(group, *view->now)); });
    }
    const bool is_used_up = list.wants().empty() || list.wants().front().rank < 0;
    if (now && is_used_up && list.is_cut_off()) cut(*view, nullptr);
    view->next_want = 0;
  }
}

// Claims the group of largest error that fits, and its neighbours in the file.
StreamedState::Choice StreamedState::choose_among(bool now, Run& run) {
  find_wants(now);
  const auto list_of = [now](StreamView& view) -> WantList& { return now ? view.wants : view.prefetch_wants; };
  bool lacks_room = false, is_pinned = false;
  std::uint64_t reclaimable_bytes = pool->pages_budget();  // an upper bound for the next want
  for (int looks = 0;;) {
    StreamView* best = nullptr;
    WantList::Want want{};
    for (const auto& view : views) {
      if (!view->is_live || (!now && !view->ahead)) continue;
      const auto wants = list_of(*view).wants();
      if (view->next_want == wants.size()) continue;
      if (best != nullptr && wants[view->next_want].rank <= want.rank) continue;
      best = view.get();
      want = wants[view->next_want];
    }
    if (best == nullptr) break;
    if (!residency->can_request(want.group)) {  // the camera has moved on since it was listed
      list_of(*best).erase_at(best->next_want);
      continue;
    }
    ++best->next_want;
    const Priority own = priority(want.group);
    if (own.px <= 0 || is_put_off(want.group, run)) continue;
    if (residency->is_known(want.group)) {
      const std::uint64_t n = group_bytes(want.group);
      if (pool->left_for_pages() < n && (n > pool->left_for_pages() + reclaimable_bytes || ++looks > kMostLooks))
        continue;
    }
    const Choice choice = claim(want.group, own, run);
    if (choice == Choice::run || choice == Choice::table) return choice;
    if (choice == Choice::nothing) continue;
    lacks_room = true;
    reclaimable_bytes = std::min(reclaimable_bytes, pool->reclaimable_bytes());
    is_pinned = is_pinned || choice == Choice::pinned;
  }
  return is_pinned ? Choice::pinned : lacks_room ? Choice::no_room : Choice::nothing;
}

// While reads fail: the group that has failed least often, since the most wanted one may be unreadable.
StreamedState::Choice StreamedState::choose_elsewhere(Run& run) {
  find_wants(true);
  WantList::Want chosen{0, lod::kNoPage};
  int least = std::numeric_limits<int>::max();
  for (const auto& view : views) {
    if (!view->is_live) continue;
    for (const WantList::Want& want : view->wants.wants()) {
      const int n_times = residency->is_known(want.group) ? residency->n_failed(want.group) : n_table_failures;
      if (n_times > least || (n_times == least && want.rank <= chosen.rank)) continue;
      if (!residency->can_request(want.group)) continue;
      if (is_put_off(want.group, run)) continue;
      least = n_times;
      chosen = want;
    }
  }
  if (chosen.group == lod::kNoPage) return Choice::nothing;
  const Priority own = priority(chosen.group);
  return own.px > 0 ? claim(chosen.group, own, run) : Choice::nothing;
}

// Claims an absent group if there is room for it.
StreamedState::Choice StreamedState::claim(std::uint32_t group, const Priority& own, Run& run) {
  if (!residency->is_known(group)) {
    const lod::Page& above = file->pages()[group];
    return claim_table((above.first_child + above.n_children - file->n_pages() + 1) * kRecordBytes, run);
  }
  const StreamPoolState::Room room = pool->take_pages(group_bytes(group), own);
  if (room != StreamPoolState::Room::taken)
    return room == StreamPoolState::Room::pinned ? Choice::pinned : Choice::no_room;
  requested(group);
  run.first = group, run.n = 1;
  extend(run, own);
  return Choice::run;
}

StreamedState::Choice StreamedState::claim_table(std::uint64_t n, Run& run) {
  if (is_extending || !can_extend()) return Choice::nothing;
  const auto now = pool->now();
  if (const auto left = pause_left(std::max(n_table_failures, n_table_damages), now - table_failed_at); left > 0s) {
    run.later = std::min(run.later, now + left);
    return Choice::nothing;
  }
  run.table_bytes = n;
  return Choice::table;
}

StreamedState::Choice StreamedState::choose(Run& run) {
  const auto now = pool->now();
  if (const auto left = pause_left(n_unreachable, now - failed_at); left > 0s) {
    run.later = now + left;
    return Choice::later;
  }
  update_live_views(now);
  Choice choice = failures.n > 0 ? choose_elsewhere(run) : Choice::nothing;
  if (choice != Choice::run && choice != Choice::table) choice = choose_among(true, run);
  // Prefetch waits while callers wait, and evicts nothing that views want.
  if (choice == Choice::nothing && prefetches && n_waiting == 0) choice = choose_among(false, run);
  // The end of the table completes its hash. Not while pages are read: it would share their bandwidth.
  if (choice == Choice::nothing && n_at_work == 0 && !views.empty()) choice = claim_table(traits.most_bytes, run);
  if (choice == Choice::pinned) pool->waits_for_pins = true;
  if (choice == Choice::pinned || choice == Choice::no_room) pool->lacks_room = true;
  if (choice == Choice::run || choice == Choice::table) return choice;
  if (run.later != StreamClock::time_point::max()) return Choice::later;
  if (choice == Choice::nothing || choice == Choice::no_room) settled_at = pool->changes;
  return choice;
}

// How many wanted groups a run may take, so that idle threads get their share.
std::uint32_t StreamedState::share(bool now) const {
  std::size_t n = 1;  // the one that is requested already
  for (const auto& view : views) {
    if (view->is_live) n += (now ? view->wants : view->prefetch_wants).wants().size();
  }
  const auto n_others = static_cast<std::size_t>(n_at_work);
  const std::size_t n_idle = readers.size() > n_others ? readers.size() - n_others : 1;
  return static_cast<std::uint32_t>(std::min<std::size_t>((n + n_idle - 1) / n_idle, kMostGroups));
}

bool StreamedState::has_wants() const {
  return std::ranges::any_of(views, [](const auto& view) {
    return view->is_live && !(view->wants.wants().empty() && (!view->ahead || view->prefetch_wants.wants().empty()));
  });
}

// Groups of neighbouring pages are neighbours in the file.
void StreamedState::extend(Run& run, const Priority& best) {
  const std::vector<lod::Page>& pages = file->pages();
  const auto begin_of = [&](std::uint32_t group) { return file->stored(pages[group].first_child).offset; };
  const auto end_of = [&](std::uint32_t group) {
    const StoredPage& last = file->stored(pages[group].first_child + pages[group].n_children - 1);
    return last.offset + last.stored_bytes;
  };
  const std::uint32_t most_groups = share(best.now);
  const auto takes = [&](std::uint32_t group, std::uint64_t begin, std::uint64_t end, std::uint64_t gap) {
    if (run.n == most_groups || end - begin > traits.most_bytes || gap > traits.gap_bytes) return false;
    if (!residency->can_request(group) || residency->n_failed(group) > 0) return false;
    const Priority own = priority(group);
    if (own.now != best.now || own.px <= 0 || own.px < kSideShare * best.px) return false;
    if (pool->take_pages(group_bytes(group), own) != StreamPoolState::Room::taken) return false;
    requested(group);
    ++run.n;
    return true;
  };
  if (residency->n_failed(run.first) > 0) return;  // a neighbour may be the unreadable part
  std::uint64_t begin = begin_of(run.first), end = end_of(run.first);
  for (std::uint32_t next = run.first + 1; next < residency->n_groups() && residency->is_known(next); ++next) {
    if (!takes(next, begin, end_of(next), begin_of(next) - end)) break;
    end = end_of(next);
  }
  while (run.first > 0) {
    const std::uint32_t before = run.first - 1;  // known, since the one behind it is
    // The search for room for one neighbour may have evicted those on the other side.
    if (!takes(before, begin_of(before), end, begin - end_of(before))) break;
    begin = begin_of(before);
    run.first = before;
  }
}

void StreamedState::fetch(PageReader& reader, const Run& run, std::uint64_t begun) {
  const auto page_of = [this](std::uint32_t group) {
    const std::shared_lock lock(table);
    return file->pages()[group];
  };
  const lod::Page last = page_of(run.first + run.n - 1);
  const std::uint32_t end = last.first_child + last.n_children;
  reader.begin_run();
  std::array<PageReader::Ticket, kMostGroups> sent{};  // by group of the run, once decoded
  std::uint32_t reported = run.first;                  // groups before it have arrived or failed
  FileRange known;                                     // bytes of the last page read
  for (std::uint32_t group = run.first; group < run.first + run.n; ++group) {
    const lod::Page above = page_of(group);
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
    const bool is_last = group + 1 == run.first + run.n;
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
    std::optional<StreamTimer> timer(std::in_place, StreamStep::lock);
    if (goes_on) {
      if (!lock.try_lock()) continue;
    } else {
      lock.lock();
    }
    timer->next(StreamStep::tell);
    stats.bytes_read += reader.take_bytes_read();
    if (reported < ready) {
      readable = known;
      succeed();
    }
    for (; reported < ready; ++reported) arrived(reported);
    if (read) continue;
    reported = group + 1;
    cancel(group);
    const std::uint32_t now = milliseconds(pool->now());
    if (is_damage(read.error().code)) {
      // Another answer may have the right bytes. Other damage is in the file.
      residency->damage(group, now, read.error().code == Errc::checksum_mismatch ? kMostTries : 1);
      drop_below(group);
      if (residency->can_request(group)) want(group);
      damage = read;
      pool->changed();
      continue;
    }
    // Bytes or memory are missing for now. The rest of the run is retried with it.
    for (std::uint32_t again = group; again < run.first + run.n; ++again) {
      if (again > group) cancel(again);
      residency->fail(again, now);
      drop_below(again);
      if (residency->can_request(again)) want(again);
    }
    const int n_times = residency->n_failed(group);
    lock.unlock();
    timer.reset();  // fail() waits and reads
    return fail(reader, read, {group, run.first + run.n - group}, n_times, begun);
  }
}

// Doubles with each failure; shorter while a caller waits.
StreamClock::duration StreamedState::pause_left(int n, StreamClock::duration since) const {
  if (n <= 0) return 0s;
  const StreamClock::duration grown = kFirstPause * (1 << std::min(n - 1, 5));
  return std::max<StreamClock::duration>(0s, std::min(grown, n_waiting > 0 ? kLongestWaited : kLongestPause) - since);
}

// Delays one group; others are read meanwhile.
StreamClock::duration StreamedState::put_off_for(std::uint32_t group) const {
  const int n = residency->n_failed(group);
  if (n == 0) return 0s;
  return pause_left(n, std::chrono::milliseconds(milliseconds(pool->now()) - residency->failed_at(group)));
}

bool StreamedState::is_put_off(std::uint32_t group, Run& run) const {
  const auto left = put_off_for(group);
  if (left <= 0s) return false;
  run.later = std::min(run.later, pool->now() + left);
  return true;
}

float StreamedState::rank(std::uint32_t group, float px) const {
  return put_off_for(group) > 0s ? put_off_rank(px) : px;
}

void StreamedState::succeed() {
  failures.n = n_unreachable = 0;
  trouble = {};
}

void StreamedState::fail(PageReader& reader, const Status& read, const Run& failed, int n_times, std::uint64_t begun) {
  FileRange known;
  {
    const std::scoped_lock lock(pool->mutex);
    trouble = read;
    ++n_failed;
    if (failures.add(begun, n_failed)) {
      failed_at = pool->now();
      ++n_unreachable;
      known = readable;
    }
    const bool is_lasting = std::max(n_times, n_unreachable) >= kLastingTrouble;
    for (const auto& view : views) {
      // All views share the table, and a source that no longer answers.
      bool is_own = failed.n == 0 || n_unreachable > 1;
      for (std::uint32_t group = failed.first; !is_own && group < failed.first + failed.n; ++group)
        is_own = residency->wanted_px(group, *view->now) > 0;
      if (!is_own) continue;
      view->failures.add(begun, n_failed);
      view->is_lasting = is_lasting;
      view->trouble = read;
    }
    pool->changed();
    if (n_waiting > 0) pool->news.notify_all();
  }
  // Does the whole source fail, or only this range?
  if (known.bytes == 0 || !reader.read_again(known)) return;
  const std::scoped_lock lock(pool->mutex);
  stats.bytes_read += reader.take_bytes_read();
  n_unreachable = 0;
  pool->changed();
}

bool StreamedState::can_extend() const {
  return !file->is_verified() && !residency->is_broken();
}

void StreamedState::extend_table(PageReader& reader, std::uint64_t n, std::uint64_t begun) {
  const StreamTimer timer(StreamStep::table);
  FileRange unread;
  {
    const std::shared_lock lock(table);
    unread = file->unread_table();
  }
  const auto part = reader.read_table(unread, std::max(n, kLeastTableBytes));
  // Waits until no page is being decoded, so not under the lock that frames need.
  std::unique_lock alone(table, std::defer_lock);
  if (part) alone.lock();
  std::unique_lock lock(pool->mutex);
  stats.bytes_read += reader.take_bytes_read();
  is_extending = false;
  if (!part) {
    table_failed_at = pool->now();
    const int n_times = ++n_table_failures;
    lock.unlock();
    return fail(reader, tl::unexpected(part.error()), {}, n_times, begun);
  }
  succeed();
  n_table_failures = 0;
  for (const auto& view : views) view->failures.n = 0;
  if (const Status extended = file->extend(*part); extended) {
    residency->extend();
    n_table_damages = 0;
  } else {
    damage = extended;
    table_failed_at = pool->now();
    if (++n_table_damages == kMostTries) residency->mark_broken();
  }
  pool->changed();
  if (n_waiting > 0) pool->news.notify_all();
}

void StreamedState::work_until_stopped(PageReader& reader) {
  if (store->is_on_device()) store->slots()->stay_on_device();
  std::unique_lock lock(pool->mutex);
  while (!is_stopping) {
    Run run;
    const Choice choice = [&] {
      const StreamTimer timer(StreamStep::choose);
      return choose(run);
    }();
    if (choice == Choice::run || choice == Choice::table) {
      ++n_at_work;
      is_extending = is_extending || choice == Choice::table;
      if (has_wants()) work.notify_one();
      const std::uint64_t begun = n_failed;
      lock.unlock();
      if (choice == Choice::table) {
        extend_table(reader, run.table_bytes, begun);
      } else {
        fetch(reader, run, begun);
      }
      {
        const StreamTimer timer(StreamStep::lock);
        lock.lock();
      }
      --n_at_work;
      continue;
    }
    if (n_waiting > 0) pool->news.notify_all();
    const auto is_awake = [this, seen = pool->changes, requested = n_requested] {
      return is_stopping || pool->changes != seen || n_requested != requested;
    };
    const StreamTimer timer(StreamStep::idle);
    if (choice == Choice::later) {
      work.wait_until(lock, run.later, is_awake);
    } else {
      work.wait(lock, is_awake);
    }
  }
}

}  // namespace rgs::detail
