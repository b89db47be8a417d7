// page_fetch.cpp - threads that read and decode what views miss: the largest projected error first, then what the camera is about to see.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <utility>

#include "rgs/guard_memory.hpp"
#include "stream/page_reader.hpp"
#include "stream/streamed_state.hpp"

namespace rgs::detail {
namespace {

using namespace std::chrono_literals;

constexpr StreamClock::duration kFirstPause = 250ms, kLongestPause = 8s;  // after reads that failed
constexpr StreamClock::duration kLongestWaited = 1s;                      // the same, while a caller waits
constexpr std::uint32_t kMostGroups = 64;                                 // of a run
constexpr std::uint64_t kRecordBytes = 112;                               // of a page, in the file's table
constexpr std::uint64_t kLeastTableBytes = 64 << 10;                      // of a read
constexpr float kSideShare = 0.25F;  // of the first group's worth, that its neighbours must have
/// Wants for which room is looked for among other pages, each of which takes a look at all of them.
constexpr int kMostLooks = 8;

bool is_damage(Errc code) {
  return exit_code(code) == exit_code(Errc::corrupt_data);
}

}  // namespace

// The best group that there is room for, and what lies beside it.
StreamedState::Choice StreamedState::choose_among(bool now, Run& run) {
  for (const auto& view : views) {
    if (!view->is_live || (!now && !view->soon)) continue;
    WantList& list = now ? view->wants : view->soon_wants;
    if (!now && !std::exchange(view->is_soon_known, true)) {
      list.clear();
      residency->cut(
          *view->soon, pool->tick, [](std::uint32_t) { return true; },
          [&](std::uint32_t group, float px) { list.add(group, px); }, view->soon->detail_px);
      list.order();
    }
    list.tidy(*residency);
    if (now && list.wants().empty() && list.is_cut_off()) cut(*view, nullptr);
    view->next_want = 0;
  }
  bool is_refused = false, is_pinned = false;
  std::uint64_t could_go = pool->pages_budget();  // for the next want, at most
  for (int looks = 0;;) {
    StreamView* best = nullptr;
    WantList::Want want{};
    for (const auto& view : views) {
      if (!view->is_live || (!now && !view->soon)) continue;
      const auto wants = (now ? view->wants : view->soon_wants).wants();
      if (view->next_want == wants.size()) continue;
      if (best != nullptr && wants[view->next_want].px <= want.px) continue;
      best = view.get();
      want = wants[view->next_want];
    }
    if (best == nullptr) break;
    ++best->next_want;
    // Evictions since then may have changed what is there.
    if (residency->state(want.group) != Residency::State::absent || !residency->has(want.group)) continue;
    const Worth own = worth(want.group);
    if (own.px <= 0 || is_put_off(want.group, run)) continue;
    if (!residency->is_known(want.group)) {
      if (is_extending || !can_extend() || is_put_off(PutOff::kTable, run)) continue;
      const lod::Page& above = file->pages()[want.group];
      run.table_bytes = (above.first_child + above.n_children - file->n_pages() + 1) * kRecordBytes;
      return Choice::table;
    }
    const std::uint64_t n = group_bytes(want.group);
    if (pool->left_for_pages() < n && (n > pool->left_for_pages() + could_go || ++looks > kMostLooks)) continue;
    const StreamPoolState::Room room = pool->take_pages(n, own);
    if (room == StreamPoolState::Room::taken) {
      requested(want.group);
      run = {want.group, 1};
      extend(run, own);
      return Choice::run;
    }
    is_refused = true;
    could_go = std::min(could_go, pool->could_go());
    is_pinned = is_pinned || room == StreamPoolState::Room::pinned;
  }
  return is_pinned ? Choice::pinned : is_refused ? Choice::no_room : Choice::nothing;
}

StreamedState::Choice StreamedState::choose(Run& run) {
  const auto now = StreamClock::now();
  if (now < retry_at) {
    run.later = retry_at;
    return Choice::later;
  }
  look_at_clock(now);
  Choice choice = choose_among(true, run);
  // What is about to be seen waits for what is waited for, and takes no room from it.
  if (choice == Choice::nothing && prefetches && n_waiting == 0) choice = choose_among(false, run);
  // With the last of it, its hash is compared. Not beside what a view waits for: its bytes would share the line.
  if (choice == Choice::nothing && n_at_work == 0 && !views.empty() && !is_extending && can_extend() &&
      !is_put_off(PutOff::kTable, run)) {
    run.table_bytes = traits.most_bytes;
    choice = Choice::table;
  }
  if (choice == Choice::pinned) pool->waits_for_pins = true;
  if (choice == Choice::run || choice == Choice::table) return choice;
  if (run.later != StreamClock::time_point::max()) return Choice::later;
  if (choice == Choice::nothing || choice == Choice::no_room) settled_at = pool->changes;
  return choice;
}

// Groups of the pages before and after lie before and after in the file.
void StreamedState::extend(Run& run, const Worth& best) {
  const std::vector<lod::Page>& pages = file->pages();
  const auto begin_of = [&](std::uint32_t group) { return file->stored(pages[group].first_child).offset; };
  const auto end_of = [&](std::uint32_t group) {
    const StoredPage& last = file->stored(pages[group].first_child + pages[group].n_children - 1);
    return last.offset + last.stored_bytes;
  };
  const auto takes = [&](std::uint32_t group, std::uint64_t begin, std::uint64_t end, std::uint64_t gap) {
    if (run.n == kMostGroups || end - begin > traits.most_bytes || gap > traits.gap_bytes) return false;
    if (residency->state(group) != Residency::State::absent || !residency->has(group)) return false;
    if (was_put_off(group)) return false;
    const Worth own = worth(group);
    if (own.now != best.now || own.px <= 0 || own.px < kSideShare * best.px) return false;
    if (pool->take_pages(group_bytes(group), own) != StreamPoolState::Room::taken) return false;
    requested(group);
    ++run.n;
    return true;
  };
  if (was_put_off(run.first)) return;
  std::uint64_t begin = begin_of(run.first), end = end_of(run.first);
  for (std::uint32_t next = run.first + 1; next < residency->n_groups() && residency->is_known(next); ++next) {
    if (!takes(next, begin, end_of(next), begin_of(next) - end)) break;
    end = end_of(next);
  }
  while (run.first > 0) {
    const std::uint32_t before = run.first - 1;  // known, as what is behind it
    // Room for one neighbour may have been found among those on the other side.
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
  for (std::uint32_t group = run.first; group < run.first + run.n; ++group) {
    const lod::Page above = page_of(group);
    Status read = guard_memory([&]() -> Status {
      for (std::uint32_t child = above.first_child; child < above.first_child + above.n_children; ++child) {
        if (Status put = reader.read(child, end); !put) return put;
      }
      return {};
    });
    // What has failed, too: its slots are others' from here on.
    const Status there = reader.finish();
    if (read) read = there;
    const std::scoped_lock lock(pool->mutex);
    stats.bytes_read += reader.take_bytes_read();
    if (read) {
      succeed(group);
      placed(group);
      if (n_waiting > 0) pool->news.notify_all();
      continue;
    }
    give_room(group);
    if (is_damage(read.error().code)) {
      residency->refuse(group);
      if (damage) damage = read;
      pool->changed();
      continue;
    }
    // Without bytes or memory now. What is left of the run waits with it.
    residency->drop(group);
    put_off(group);
    for (std::uint32_t rest = group + 1; rest < run.first + run.n; ++rest) {
      residency->drop(rest);
      put_off(rest);
      give_room(rest);
    }
    for (const auto& view : views) {
      for (std::uint32_t again = group; again < run.first + run.n; ++again) {
        if (const float px = residency->wanted_px(again, *view->now); px > 0) view->wants.insert(again, px);
      }
    }
    fail(read, begun);
    return;
  }
}

StreamClock::duration StreamedState::pause(int n_before) const {
  const StreamClock::duration grown = kFirstPause * (1 << std::min(n_before, 5));
  return std::min(grown, n_waiting > 0 ? kLongestWaited : kLongestPause);
}

// Others are read meanwhile: a range that cannot be read keeps nothing else from being so.
void StreamedState::put_off(std::uint32_t group) {
  auto found = std::ranges::find(put_offs, group, &PutOff::group);
  if (found == put_offs.end() && put_offs.size() < PutOff::kMost) {
    found = put_offs.insert(found, PutOff{group, 0, {}});
  } else if (found == put_offs.end()) {
    found = std::ranges::min_element(put_offs, {}, &PutOff::until);
    *found = PutOff{group, 0, {}};
  }
  found->until = StreamClock::now() + pause(found->n);
  ++found->n;
}

bool StreamedState::was_put_off(std::uint32_t group) const {
  return std::ranges::find(put_offs, group, &PutOff::group) != put_offs.end();
}

bool StreamedState::is_put_off(std::uint32_t group, Run& run) const {
  const auto found = std::ranges::find(put_offs, group, &PutOff::group);
  if (found == put_offs.end() || found->until <= StreamClock::now()) return false;
  run.later = std::min(run.later, found->until);
  return true;
}

void StreamedState::hurry() {
  const auto latest = StreamClock::now() + kLongestWaited;
  bool is_sooner = retry_at > latest;
  retry_at = std::min(retry_at, latest);
  for (PutOff& each : put_offs) {
    is_sooner = is_sooner || each.until > latest;
    each.until = std::min(each.until, latest);
  }
  if (is_sooner) pool->changed();
}

void StreamedState::succeed(std::uint32_t group) {
  n_failures = 0;
  trouble = {};
  retry_at = {};
  std::erase_if(put_offs, [&](const PutOff& each) { return each.group == group; });
}

// Asks again after a pause, which grows. One outage ends all reads at work, and is one failure.
void StreamedState::fail(const Status& read, std::uint64_t begun) {
  trouble = read;
  if (begun == n_failed) {
    retry_at = StreamClock::now() + pause(n_failures);
    ++n_failures, ++n_failed;
  }
  pool->changed();
  if (n_waiting > 0) pool->news.notify_all();
}

bool StreamedState::can_extend() const {
  return !file->is_verified() && !residency->is_broken();
}

void StreamedState::extend_table(PageReader& reader, std::uint64_t n, std::uint64_t begun) {
  FileRange unread;
  {
    const std::shared_lock lock(table);
    unread = file->unread_table();
  }
  const auto part = reader.read_table(unread, std::max(n, kLeastTableBytes));
  // Waits for pages that are being decoded: not with the lock that frames need.
  std::unique_lock alone(table, std::defer_lock);
  if (part) alone.lock();
  const std::scoped_lock lock(pool->mutex);
  stats.bytes_read += reader.take_bytes_read();
  is_extending = false;
  if (!part) {
    put_off(PutOff::kTable);
    return fail(tl::unexpected(part.error()), begun);
  }
  succeed(PutOff::kTable);
  const Status extended = file->extend(*part);
  residency->extend();
  if (!extended) {
    residency->end_here();
    if (damage) damage = extended;
  }
  pool->changed();
  if (n_waiting > 0) pool->news.notify_all();
}

void StreamedState::work_until_stopped(PageReader& reader) {
  std::unique_lock lock(pool->mutex);
  while (!is_stopping) {
    Run run;
    const Choice choice = choose(run);
    if (choice == Choice::run || choice == Choice::table) {
      ++n_at_work;
      is_extending = is_extending || choice == Choice::table;
      work.notify_one();  // there may be more to do
      const std::uint64_t begun = n_failed;
      lock.unlock();
      if (choice == Choice::table) {
        extend_table(reader, run.table_bytes, begun);
      } else {
        fetch(reader, run, begun);
      }
      lock.lock();
      --n_at_work;
      continue;
    }
    if (n_waiting > 0) pool->news.notify_all();
    const auto is_awake = [this, seen = pool->changes] { return is_stopping || pool->changes != seen; };
    if (choice == Choice::later) {
      work.wait_until(lock, run.later, is_awake);
    } else {
      work.wait(lock, is_awake);
    }
  }
}

}  // namespace rgs::detail
