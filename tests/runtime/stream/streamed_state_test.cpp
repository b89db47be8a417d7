// streamed_state_test.cpp - frames held open, lists without room, combined failures, and moving cameras.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <chrono>
#include <functional>
#include <future>
#include <thread>
#include <vector>

#include "opened_state.hpp"

using namespace rgs;
using namespace rgs::test;
using namespace std::chrono_literals;
using detail::StreamedState;
using detail::StreamFrame;
using detail::StreamPoolState;

TEST_CASE("while a frame is held open its view is chosen again, and afterwards nothing stays pinned") {
  const Bytes bytes = town({.n = 200000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes);
  StreamedState& s = *opened.state;
  // A coarser picture, with more pages than a list of wants holds.
  float coarse = 4096;
  for (;; coarse /= 1.3F) {
    REQUIRE(opened.refine(over(), coarse) == true);
    if (opened.frame(over(), coarse).parts().size() > detail::WantList::kMost + 100) break;
    REQUIRE(coarse > 1e-6F);
  }
  opened.script->is_shut = true;
  {
    const StreamFrame held = opened.frame(over(), 0);
    {
      const std::scoped_lock lock(opened.pool->mutex);
      REQUIRE(s.views.front()->wants.is_cut_off());
    }
    const std::size_t n = held.parts().size();
    const float first = held.parts().front().mean[0];
    opened.script->open_gate();
    std::uint64_t n_pages = s.file->n_pages_in_all();
    opened.await([&] { return s.residency->n_resident() == n_pages; });
    // Another frame and a refine() of the view in the meantime.
    CHECK(opened.refine(over(), 0) == true);
    CHECK(opened.frame(over(), 0).parts().size() > n);
    CHECK(held.parts().size() == n);
    CHECK(held.parts().front().mean[0] == first);
  }
  const std::scoped_lock lock(opened.pool->mutex);
  std::uint64_t n_resident = 0, n_evictable = 0;
  for (std::uint32_t group = 0; group < s.residency->n_groups(); ++group)
    n_resident += s.residency->state(group) == detail::Residency::State::resident;
  s.residency->for_each_evictable([](std::uint32_t) { return true; }, [&](std::uint32_t) { ++n_evictable; });
  CHECK(n_resident > 1000);
  CHECK(n_evictable == n_resident);
}

TEST_CASE("a frame whose list of pages finds no room is not called complete") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes);
  REQUIRE(opened.refine(over(), 0, 2) == true);
  const StreamFrame all = opened.frame(over(), 0, 2);
  REQUIRE(all.parts().size() > 600);
  CHECK(all.cut().missing == 0);
  // All resident pages are pinned, and the rest of the pool is used.
  const std::uint64_t taken = opened.pool->left() - opened.state->least_view_bytes();
  {
    const std::scoped_lock lock(opened.pool->mutex);
    opened.pool->held += taken;
  }
  {
    const StreamFrame coarser = opened.frame(over(), 0, 1);
    CHECK(coarser.parts().size() < all.parts().size());
    CHECK(coarser.cut().missing > 0);
    CHECK(coarser.cut().damaged == 0);
  }
  CHECK(opened.refine(over(), 0, 1, 10) == false);
  {
    const std::scoped_lock lock(opened.pool->mutex);
    opened.pool->held -= taken;
  }
  CHECK(opened.refine(over(), 0, 1) == true);
  CHECK(opened.frame(over(), 0, 1).parts().size() == all.parts().size());
}

TEST_CASE("refine() waits for room that frames, reads and views of others release, and for nothing else") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 3, .page_chunks = 8});
  Opened opened(bytes, false, 1);
  StreamedState& s = *opened.state;
  StreamPoolState& pool = *opened.pool;
  const auto at_rest = [&] { return s.file->is_verified() && s.settled_at >= pool.changes && s.n_at_work == 0; };
  opened.frame(over(), 1e9F, 1);  // the root, and the rest of the table
  opened.await(at_rest);
  std::uint64_t taken = 0;
  const auto use_up = [&] {
    const std::scoped_lock lock(pool.mutex);
    taken += pool.left();
    pool.held += pool.left();
  };
  const auto release = [&] {
    const std::scoped_lock lock(pool.mutex);
    pool.held -= std::exchange(taken, 0);
  };
  std::uint64_t renderer = 10;
  const auto refined = [&](double seconds) { return opened.refine(over(), 1e9F, ++renderer, seconds); };
  std::future<Result<bool>> complete;
  const auto wait = [&] {
    complete = std::async(std::launch::async, refined, kLong);
    opened.await([&] { return pool.n_waiting_for_room == 1; });
  };

  // The pool has one view, its last, which stays.
  use_up();
  const auto failed = refined(kLong);
  REQUIRE(!failed);
  CHECK(failed.error().code == Errc::limit_exceeded);
  release();

  // A read that arrives can be evicted.
  opened.script->is_shut = true;
  opened.frame(over(), 0, 1);
  opened.await([&] { return opened.script->n_at_once == 1; });
  use_up();
  CHECK(refined(0) == false);
  wait();
  opened.script->open_gate();
  CHECK(complete.get() == true);
  release();

  // So can the pages of a frame that ends.
  REQUIRE(opened.refine(over(), 0, 1) == true);
  std::optional<StreamFrame> frame = opened.frame(over(), 0, 1);
  use_up();
  CHECK(refined(0) == false);
  wait();
  frame.reset();
  CHECK(complete.get() == true);
  release();

  // A view lives for a second.
  Opened lone(bytes, false, 1);
  lone.stop();
  lone.frame(over(), 1e9F, 1);
  lone.frame(over(), 1e9F, 2);
  lone.await([&] { return lone.state->file->is_verified() && lone.state->n_at_work == 0; });
  {
    const std::scoped_lock lock(lone.pool->mutex);
    lone.pool->held += lone.pool->left();
  }
  CHECK(lone.refine(over(), 1e9F, 3, 0) == false);
  complete = std::async(std::launch::async, [&] { return lone.refine(over(), 1e9F, 3); });
  lone.await([&] { return lone.pool->n_waiting_for_room == 1; });
  lone.stop(-2s);
  CHECK(complete.get() == true);
  const std::scoped_lock lock(lone.pool->mutex);
  CHECK(lone.state->views.size() == 2);
  lone.pool->held = 0;  // closing releases more than was counted
}

TEST_CASE("an outage that ends many reads at once is one failure, and a past one is none") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 6, 1);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  for (float coarse = 4096; opened.frame(camera, coarse).parts().size() < 100; coarse /= 1.5F)
    REQUIRE(opened.refine(camera, coarse) == true);
  opened.script->is_shut = true;
  auto complete = std::async(std::launch::async, [&] { return opened.refine(camera, 0); });
  opened.await([&] { return opened.script->n_at_once == 6; });
  opened.script->fails_next = 6;
  opened.script->open_gate();
  CHECK(complete.get() == true);

  Opened dead(bytes, false, 6);
  dead.script->fails = true;
  const auto failed = dead.refine(camera, 0.5F);
  REQUIRE(!failed);
  CHECK(failed.error().code == Errc::read_failed);
  dead.script->fails = false;
  CHECK(dead.refine(camera, 0.5F) == true);
  CHECK(dead.state->status());

  // Waits for one view without a frame in between are one wait.
  Opened steps(bytes, false, 1);
  steps.script->fails = true;
  test::await([&] {
    steps.refine(camera, 0.5F, 1, 0);
    const std::scoped_lock lock(steps.pool->mutex);
    return steps.state->views.front()->failures.n >= StreamedState::kLastingTrouble;
  });
  steps.stop();  // nothing is retried
  CHECK(!steps.refine(camera, 0.5F));
}

TEST_CASE("an unreadable range does not keep anything else from being read") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 2);
  StreamedState& s = *opened.state;
  REQUIRE(opened.refine(over(), 0) == true);
  const std::uint64_t n_all = s.residency->n_resident();
  std::uint32_t group = 0;  // in the middle, with leaves as children
  while (group < s.residency->n_groups() && s.file->pages()[group].level != 1) ++group;
  group += (s.residency->n_groups() - group) / 2;
  const auto range = s.file->stored(s.file->pages()[group].first_child);
  const std::uint32_t n_children = s.file->pages()[group].n_children;

  Opened lossy(bytes, false, 2);
  lossy.script->gone_from = range.offset, lossy.script->gone_to = range.offset + 1;
  const auto complete = lossy.refine(over(), 0);
  REQUIRE(!complete);
  CHECK(complete.error().code == Errc::read_failed);
  lossy.await([&] { return lossy.state->residency->n_resident() == n_all - n_children; });
  lossy.script->gone_to = 0;
  CHECK(lossy.refine(over(), 0) == true);
}

TEST_CASE("a view whose pages cannot be read fails, whatever is read for another view meanwhile") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 2);
  StreamedState& s = *opened.state;
  REQUIRE(opened.refine(over(), 0, 2) == true);
  float coarse = 4096;
  while (opened.frame(over(), coarse, 2).n_pages() < 60) coarse /= 1.5F;
  const auto eye = opened.rule(coarse).eye(over());
  // Pages that the coarse view wants without descendants, and pages that only the other view wants.
  std::uint32_t lost = 0, others = 0;
  const auto is_below = [&](std::uint32_t page, std::uint32_t above) {
    while (page > above) page = s.file->pages()[page].parent;
    return page == above;
  };
  {
    const std::scoped_lock lock(opened.pool->mutex);
    const std::uint32_t n = s.residency->n_groups();
    for (std::uint32_t group = 1; group < n; ++group) {
      if (s.residency->wanted_px(group, eye) > 0) lost = group;
    }
    for (std::uint32_t group = 1; group < n; ++group) {
      if (s.residency->wanted_px(group, eye) <= 0 && s.residency->can_evict(group) && !is_below(group, lost))
        others = group;
    }
  }
  REQUIRE(lost > 0);
  REQUIRE(others > 0);
  const auto range = s.file->stored(s.file->pages()[lost].first_child);

  Opened lossy(bytes, false, 2);
  StreamedState& t = *lossy.state;
  lossy.script->gone_from = range.offset, lossy.script->gone_to = range.offset + 1;
  lossy.frame(over(), 0, 2);
  lossy.await([&] { return t.residency->can_evict(others) && t.residency->n_failed(lost) > 0; });
  auto complete = std::async(std::launch::async, [&] { return lossy.refine(over(), coarse, 1); });
  const auto is_over = [&] { return complete.wait_for(0s) == std::future_status::ready; };
  // Each time the other view's pages are resident they are evicted.
  int n_read = 0;
  test::await([&] {
    lossy.frame(over(), 0, 2);
    const std::scoped_lock lock(lossy.pool->mutex);
    if (t.residency->can_evict(others)) {
      t.evict(others);
      ++n_read;
    }
    return is_over() && n_read > 1;
  });
  const auto refined = complete.get();
  REQUIRE(!refined);
  CHECK(refined.error().code == Errc::read_failed);
  lossy.script->gone_to = 0;
  CHECK(lossy.refine(over(), coarse, 1) == true);
}

TEST_CASE("unreadable ranges, however many and however wanted, leave time and room for everything else") {
  const Bytes bytes = town({.n = 300000, .sh_degree = 0, .page_chunks = 1});
  Opened sound(bytes);
  REQUIRE(sound.refine(over(), 0) == true);
  const PagedFile& file = *sound.state->file;
  const std::vector<lod::Page>& pages = file.pages();
  // The first half of level 2, and nine tenths of level 1: more than a list of wants holds.
  for (const std::uint16_t level : {std::uint16_t{2}, std::uint16_t{1}}) {
    CAPTURE(level);
    std::vector<std::uint32_t> groups;
    for (std::uint32_t page = 0; page < pages.size(); ++page) {
      if (pages[page].level == level) groups.push_back(page);
    }
    const std::size_t n_lost = level == 2 ? groups.size() / 2 : groups.size() - groups.size() / 10;
    if (level == 1) REQUIRE(n_lost > detail::WantList::kMost);
    const std::uint32_t end = groups[n_lost - 1];
    std::vector<char> is_there(pages.size(), 0);
    is_there[0] = 1;
    for (std::uint32_t page = 0; page < pages.size(); ++page) {
      const bool is_lost = page >= groups.front() && page <= end;
      if (is_there[page] == 0 || is_lost || page >= sound.state->residency->n_groups()) continue;
      if (sound.state->residency->state(page) != detail::Residency::State::resident) continue;  // out of view
      std::fill_n(is_there.begin() + pages[page].first_child, pages[page].n_children, char{1});
    }
    const auto n_there = static_cast<std::uint64_t>(std::ranges::count(is_there, char{1}));
    REQUIRE(n_there > groups.size());

    Opened lossy(bytes, false, 2);
    lossy.script->gone_from = file.stored(pages[groups.front()].first_child).offset;
    lossy.script->gone_to = file.stored(pages[end].first_child + pages[end].n_children - 1).offset + 1;
    lossy.frame(over(), 0);
    lossy.await([&] { return lossy.state->residency->n_resident() == n_there; });
  }
}

namespace {

using State = detail::Residency::State;

/// Groups in a state; under the lock.
std::uint64_t count(const StreamedState& s, State state) {
  std::uint64_t n = 0;
  for (std::uint32_t group = 0; group < s.residency->n_groups(); ++group) n += s.residency->state(group) == state;
  return n;
}

FileRange range_of(const StreamedState& s, std::uint32_t group) {
  const lod::Page& above = s.file->pages()[group];
  const StoredPage &first = s.file->stored(above.first_child),
                   &last = s.file->stored(above.first_child + above.n_children - 1);
  return {first.offset, last.offset + last.stored_bytes - first.offset};
}

/// No read has pages of two groups.
void read_by_group(Opened& opened) {
  const std::scoped_lock lock(opened.pool->mutex);
  opened.state->traits.most_bytes = 1;
}

}  // namespace

TEST_CASE("descendants are read beside their ancestor, and drawn only after it") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 4);
  StreamedState& s = *opened.state;
  read_by_group(opened);
  const FileRange top = range_of(s, 0);
  opened.script->shut_from = top.offset, opened.script->shut_to = top.offset + top.bytes;
  opened.script->is_shut = true;
  CHECK(opened.frame(over(), 0).n_pages() == 1);
  // Everything else arrives: three threads suffice.
  opened.await([&] { return count(s, State::arrived) + 1 == s.residency->n_groups(); });
  {
    const StreamFrame frame = opened.frame(over(), 0);
    CHECK(frame.n_pages() == 1);
    CHECK(frame.cut().in_flight == s.residency->n_groups());
    CHECK(frame.cut().missing == s.file->pages()[0].n_children);
    CHECK(frame.stats().pages_resident == 1);
  }
  opened.script->open_gate();
  opened.await([&] { return s.residency->n_resident() == s.file->n_pages_in_all(); });
  CHECK(opened.refine(over(), 0) == true);
  CHECK(opened.frame(over(), 0).cut().in_flight == 0);
}

TEST_CASE("pages that wait for a missing ancestor make room, and come again after it") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 0, .page_chunks = 1});
  for (const bool is_damaged : {false, true}) {
    CAPTURE(is_damaged);
    std::shared_ptr<detail::StreamPoolState> pool;
    {
      Opened opened(bytes, false, 4);
      pool = opened.pool;
      StreamedState& s = *opened.state;
      read_by_group(opened);
      const std::uint32_t lost = 2;  // the root's second child
      const FileRange range = range_of(s, lost);
      Script& script = *opened.script;
      script.shut_from = range.offset, script.shut_to = range.offset + range.bytes;
      script.is_shut = true;
      opened.frame(over(), 0);
      const auto is_below = [&](std::uint32_t group) {
        while (group > lost) group = s.file->pages()[group].parent;
        return group == lost;
      };
      std::uint64_t n_below = 0;
      for (std::uint32_t group = lost + 1; group < s.residency->n_groups(); ++group) n_below += is_below(group);
      REQUIRE(n_below > 10);
      opened.await(
          [&] { return count(s, State::arrived) == n_below && count(s, State::requested) == 1 && s.n_at_work == 1; });
      std::uint64_t held = 0;
      {
        const std::scoped_lock lock(pool->mutex);
        held = pool->held;
      }
      auto& from = is_damaged ? script.flip_from : script.gone_from;
      auto& to = is_damaged ? script.flip_to : script.gone_to;
      from = range.offset + 40, to = range.offset + 41;
      script.open_gate();
      opened.await([&] {
        const bool is_over = is_damaged ? s.residency->is_damaged(lost) : s.residency->n_failed(lost) > 0;
        return is_over && s.n_at_work == 0;
      });
      {
        const std::scoped_lock lock(pool->mutex);
        CHECK(count(s, State::arrived) == 0);
        std::uint64_t given = s.group_bytes(lost);
        for (std::uint32_t group = lost + 1; group < s.residency->n_groups(); ++group) {
          if (is_below(group)) given += s.group_bytes(group);
        }
        CHECK(pool->held + given == held);
      }
      to = 0;
      CHECK(opened.refine(over(), 0) == true);
      CHECK(s.residency->n_resident() == s.file->n_pages_in_all());
    }
    CHECK(pool->held == 0);
  }
}

TEST_CASE("lists of wants match a new choice for the view, whatever arrives, fails or is evicted") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 2});
  Opened opened(bytes, true, 3);
  StreamedState& s = *opened.state;
  std::uint64_t taken = 0;  // there is room for a part of it
  {
    const std::scoped_lock lock(opened.pool->mutex);
    taken = opened.pool->left() - (std::uint64_t{3} << 20);
    opened.pool->held += taken;
  }
  std::size_t n_compared = 0, n_in_flight = 0;
  const auto look = [&] {
    const std::scoped_lock lock(opened.pool->mutex);
    for (const auto& view : s.views) {
      if (view->wants.is_cut_off()) continue;
      std::vector<std::uint32_t> found, listed;
      const auto cut = s.residency->cut(
          *view->now, opened.pool->tick, [](std::uint32_t) { return true; },
          [&](std::uint32_t group, float) { found.push_back(group); }, view->now->detail_px);
      for (const auto& want : view->wants.wants()) listed.push_back(want.group);
      CHECK(std::ranges::is_sorted(view->wants.wants(), std::greater{}, &detail::WantList::Want::rank));
      std::ranges::sort(found);
      std::ranges::sort(listed);
      CHECK(listed == found);
      CHECK(view->n_in_flight == cut.in_flight);
      n_compared += found.size(), n_in_flight += cut.in_flight;
    }
  };
  opened.script->fails_every = 23;
  for (const Camera& camera : town_cameras(41, 40)) {
    opened.script->is_shut = true;
    opened.frame(camera, 0.02F, 1);
    opened.frame(over(), 1, 2);
    opened.await(
        [&] { return opened.script->n_at_once > 0 || (s.settled_at >= opened.pool->changes && s.n_at_work == 0); });
    look();
    opened.script->open_gate();
    for (int i = 0; i < 20; ++i) {
      look();
      std::this_thread::yield();
    }
  }
  CHECK(n_compared > 1000);
  CHECK(n_in_flight > 0);
  const std::scoped_lock lock(opened.pool->mutex);
  CHECK(s.stats.bytes_evicted > 0);
  CHECK(s.n_failed > 0);
  opened.pool->held -= taken;
}

TEST_CASE("a group without room is tried again once another scene's pages are resident and evictable") {
  const Bytes bytes = town({.n = 5000, .sh_degree = 0, .page_chunks = 1});
  Opened one(bytes, false, 1);
  StreamPoolState& pool = *one.pool;
  one.script->is_shut = true;
  one.frame(camera_at({0, 400, 800}, {0, 0, 0}), 0);
  one.await([&] { return one.script->n_at_once == 1; });
  Opened two(bytes, false, 1, 64 << 10, 0, one.pool);
  {
    const std::scoped_lock lock(pool.mutex);
    pool.held += pool.left() - two.state->least_view_bytes();
  }
  CHECK(two.frame(over(), 0).n_pages() == 1);
  // Pages in flight cannot be evicted.
  two.await([&] { return two.state->settled_at >= pool.changes && two.state->n_at_work == 0; });
  CHECK(two.frame(over(), 0).n_pages() == 1);
  one.script->open_gate();
  two.await([&] { return two.state->residency->n_resident() > 1; });
  CHECK(one.state->stats.bytes_evicted > 0);
}

TEST_CASE("pages that wait for an ancestor make room for larger errors of another scene") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 0, .page_chunks = 1});
  Opened one(bytes, false, 4);
  StreamPoolState& pool = *one.pool;
  StreamedState& s = *one.state;
  read_by_group(one);
  Opened two(bytes, false, 2, 64 << 10, 0, one.pool);
  for (Opened* each : {&one, &two}) {
    each->frame(over(), 1e9F);  // the rest of the table
    each->await([&] { return each->state->file->is_verified() && each->state->n_at_work == 0; });
  }
  const FileRange top = range_of(s, 0);
  one.script->shut_from = top.offset, one.script->shut_to = top.offset + top.bytes;
  one.script->is_shut = true;
  const Camera far = camera_at({0, 300, 600}, {0, 0, 0});
  one.frame(far, 0);
  one.await([&] { return count(s, State::arrived) + 1 == s.residency->n_groups() && s.n_at_work == 1; });
  std::uint64_t taken = 0;
  {
    const std::scoped_lock lock(pool.mutex);
    taken = pool.left() - two.state->least_view_bytes() - two.state->list_bytes(4096);
    pool.held += taken;
  }
  CHECK(two.refine(over(), 0.05F, 2) == true);
  CHECK(s.stats.bytes_evicted > 0);
  CHECK(count(s, State::arrived) + 1 < s.residency->n_groups());
  {
    const std::scoped_lock lock(pool.mutex);
    pool.held -= taken;
  }
  // It is read again.
  one.script->open_gate();
  CHECK(one.refine(far, 0) == true);
  CHECK(one.frame(far, 0).cut().in_flight == 0);
}

TEST_CASE("room freed by a page that arrived in vain is used") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 1);
  StreamedState& s = *opened.state;
  opened.frame(over(), 1e9F);
  opened.await([&] { return s.file->is_verified() && s.settled_at >= opened.pool->changes && s.n_at_work == 0; });
  const std::scoped_lock lock(opened.pool->mutex);
  REQUIRE(!s.residency->is_resident(1));
  s.residency->request(0), s.residency->request(1);
  for (const std::uint32_t group : {0U, 1U})
    REQUIRE(opened.pool->take_pages(s.group_bytes(group), {true, 1}) == StreamPoolState::Room::taken);
  s.cancel(0);
  s.residency->damage(0, 0, 1);
  opened.pool->lacks_room = true;
  const std::uint64_t changes = opened.pool->changes, held = opened.pool->held;
  s.arrived(1);
  CHECK(s.residency->state(1) == State::absent);
  CHECK(opened.pool->held + s.group_bytes(1) == held);
  CHECK(opened.pool->changes > changes);
  CHECK(s.stats.bytes_evicted > 0);
}

TEST_CASE("pauses after failed reads grow up to a limit, which is lower while a caller waits") {
  const Bytes bytes = town({.n = 3000});
  Opened opened(bytes);
  StreamedState& s = *opened.state;
  const std::scoped_lock lock(opened.pool->mutex);
  CHECK(s.pause_left(0, 0s) == 0s);
  CHECK(s.pause_left(1, 0s) == 250ms);
  CHECK(s.pause_left(1, 100ms) == 150ms);
  CHECK(s.pause_left(1, 300ms) == 0s);
  CHECK(s.pause_left(2, 0s) == 500ms);
  CHECK(s.pause_left(100, 0s) == 8s);
  s.n_waiting = 1;
  CHECK(s.pause_left(2, 0s) == 500ms);
  CHECK(s.pause_left(100, 0s) == 1s);
  s.n_waiting = 0;
}

TEST_CASE("damaged bytes are read again after pauses that grow, a limited number of times") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const std::uint32_t lost = 2;  // the root's second child
  const StoredPage& stored = file->stored(file->pages()[lost].first_child);
  const FileRange unread =
      PagedFile::open_beginning(std::vector<FilePart>{{0, std::span(bytes).first(64 << 10)}})->unread_table();
  REQUIRE(unread.bytes > 0);
  enum class Where { page, table };
  for (const Where where : {Where::page, Where::table}) {
    for (const int n_bad : {1, 3, StreamedState::kMostTries}) {
      CAPTURE(where == Where::page);
      CAPTURE(n_bad);
      Opened opened(bytes, false, 1);
      StreamedState& s = *opened.state;
      Script& script = *opened.script;
      opened.stop();
      script.flip_from = (where == Where::page ? stored.offset : unread.offset + 20),
      script.flip_to = script.flip_from + 1;
      const auto n_tries = [&] { return where == Where::page ? s.residency->n_failed(lost) : s.n_table_damages; };
      const bool is_final = n_bad == StreamedState::kMostTries;
      auto pause = 250ms;
      for (int n = 1; n <= n_bad; ++n, pause *= 2) {
        opened.frame(over(), 0);
        opened.await([&] { return n_tries() == n && s.n_at_work == 0; });
        {
          const std::scoped_lock lock(opened.pool->mutex);
          REQUIRE(!s.status());
          CHECK(exit_code(s.status().error().code) == 4);
        }
        const int n_reads = script.n_reads;
        if (n == n_bad) script.flip_to = 0;
        opened.stop(-pause + 10ms);
        {
          const std::scoped_lock lock(opened.pool->mutex);
          StreamedState::Run run;
          CHECK(s.choose(run) ==
                (is_final && n == n_bad ? StreamedState::Choice::nothing : StreamedState::Choice::later));
          if (run.later != detail::StreamClock::time_point::max()) CHECK(run.later - opened.pool->now() <= 11ms);
        }
        CHECK(script.n_reads == n_reads);
        opened.stop(-20ms);
        const std::scoped_lock lock(opened.pool->mutex);
        opened.pool->changed();
      }
      const auto complete = opened.refine(over(), 0);
      const std::scoped_lock lock(opened.pool->mutex);
      CHECK(complete.has_value() == !is_final);
      CHECK(s.status().has_value() == !is_final);
      CHECK((s.residency->n_resident() == s.file->n_pages_in_all()) == !is_final);
    }
  }
}

TEST_CASE("postponed groups come after all others, until their pause is over") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 1);
  StreamedState& s = *opened.state;
  float coarse = 4096;
  for (; opened.frame(over(), coarse).n_pages() < 60; coarse /= 1.5F) REQUIRE(opened.refine(over(), coarse) == true);
  opened.script->is_shut = true;
  opened.frame(over(), 0);
  opened.await([&] { return opened.script->n_at_once == 1; });
  opened.stop();
  {
    const std::scoped_lock lock(opened.pool->mutex);
    detail::WantList& wants = s.views.front()->wants;
    REQUIRE(wants.wants().size() > 10);
    const auto [px, group] = wants.wants()[2];
    const auto fail = [&, group = group](std::chrono::seconds ago) {
      const auto at =
          std::chrono::duration_cast<std::chrono::milliseconds>((opened.pool->now() - ago).time_since_epoch());
      s.residency->request(group);
      s.residency->fail(group, static_cast<std::uint32_t>(at.count()));
    };
    fail(0s);
    wants.erase(group, px);
    wants.insert(group, s.rank(group, px));
    s.find_wants(true);
    CHECK(wants.wants().back().group == group);
    CHECK(wants.wants().back().rank < 0);
    fail(60s);
    s.find_wants(true);
    CHECK(wants.wants()[2].group == group);
    CHECK(wants.wants()[2].rank == px);
  }
  *opened.stopped = 0;
  opened.script->open_gate();
  CHECK(opened.refine(over(), 0) == true);
}

TEST_CASE("threads decode on while a frame chooses its pages") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 1, 1);
  StreamedState& s = *opened.state;
  float coarse = 4096;
  for (; opened.frame(over(), coarse).n_pages() < 60; coarse /= 1.5F) REQUIRE(opened.refine(over(), coarse) == true);
  opened.script->is_shut = true;
  {
    // A run of many reads.
    const std::scoped_lock lock(opened.pool->mutex);
    s.traits.most_bytes = 64 << 10;
  }
  opened.frame(over(), 0);
  opened.await([&] {
    const bool is_there = opened.script->n_at_once == 1 && count(s, State::requested) > 8;
    if (!is_there) opened.script->let_one_go();  // a shorter run before it
    return is_there;
  });
  const std::scoped_lock lock(opened.pool->mutex);
  const int n_before = opened.script->n_reads;
  opened.script->open_gate();
  await([&] { return opened.script->n_reads >= n_before + 4; });
}

TEST_CASE("idle threads share the wanted pages") {
  const Bytes bytes = town({.n = 10000, .sh_degree = 0, .page_chunks = 2});
  Opened opened(bytes, false, 6, 1 << 20);  // a single read could take all of it
  opened.script->is_shut = true;
  opened.frame(over(), 0);
  opened.await([&] { return opened.script->n_at_once == 6; });
}

TEST_CASE("a complete view is at rest: nothing is read, and no thread waits for the clock") {
  const Bytes bytes = town();
  Opened opened(bytes, true);
  REQUIRE(opened.refine(over(), 0.5F) == true);
  const StreamedState& s = *opened.state;
  opened.await([&] { return s.settled_at >= opened.pool->changes && s.n_at_work == 0; });
  const std::scoped_lock lock(opened.pool->mutex);
  StreamedState::Run run;
  CHECK(opened.state->choose(run) == StreamedState::Choice::nothing);
  CHECK(run.later == detail::StreamClock::time_point::max());
}

TEST_CASE("prefetch reads the pages that a moving camera is about to see") {
  const Bytes bytes = town({.n = 40000});
  const auto at = [](double x) { return camera_at({x, 2, 0}, {x + 10, 2, 0}); };
  double x = 0;
  for (const bool prefetch : {true, false}) {
    CAPTURE(prefetch);
    Opened opened(bytes, prefetch);
    const StreamedState& s = *opened.state;
    if (prefetch) {
      opened.move(at(-30), at(-24), 0.05F);
      const std::scoped_lock lock(opened.pool->mutex);
      x = s.views.front()->ahead->eye.position[0];
    } else {
      opened.frame(at(-24), 0.05F);
    }
    opened.await([&] { return s.settled_at >= opened.pool->changes && s.n_at_work == 0; });
    CHECK(opened.frame(at(-24), 0.05F).cut().missing == 0);
    CHECK((opened.frame(at(x), 0.05F).cut().missing == 0) == prefetch);
  }
}

TEST_CASE("the predicted camera follows from the frames' times, and outlives the frame after a refine()") {
  const Bytes bytes = town();
  Opened opened(bytes, true);
  StreamedState& s = *opened.state;
  const auto at = [](double x) { return camera_at({x, 2, 0}, {x + 10, 2, 0}); };
  const auto came = [&] {
    const std::scoped_lock lock(opened.pool->mutex);
    return s.views.front()->came;
  };
  std::optional<StreamFrame> held = opened.frame(at(0), 1);
  const auto begun = came();
  held.reset();
  CHECK(came() == begun);
  const auto soon = [&]() -> double {
    const std::scoped_lock lock(opened.pool->mutex);
    const auto& view = *s.views.front();
    if (!view.ahead) return -1;
    return view.ahead->eye.position[0] - view.now->eye.position[0];
  };
  opened.move(at(0), at(1), 1);
  CHECK(soon() == doctest::Approx(2));  // half a second ahead at 1 per quarter
  // A refine() does not wait for prefetched pages, which follow.
  opened.frame(at(1), 1);
  opened.stop(-250ms);
  REQUIRE(opened.refine(at(1.5), 1) == true);
  CHECK(soon() == doctest::Approx(1));
  opened.await([&] { return s.views.front()->prefetch_is_current; });
  opened.frame(at(1.5), 1);
  CHECK(soon() > 0);
  opened.frame(at(1.5), 1);
  CHECK(soon() == -1);  // it stands still
  // Never farther than the scene's size.
  opened.move(at(0), at(1e5), 1);
  CHECK(soon() > 10);
  CHECK(soon() < 1000);
}
