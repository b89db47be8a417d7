// streamed_state_test.cpp - frames that are held open, lists that find no room, failures that are one, and cameras that move on.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <chrono>
#include <future>
#include <thread>

#include "opened_state.hpp"

using namespace rgs;
using namespace rgs::test;
using namespace std::chrono_literals;
using detail::StreamedState;
using detail::StreamFrame;

TEST_CASE("while a frame is held open its view is looked at again, and afterwards nothing stays pinned") {
  const Bytes bytes = town({.n = 200000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes);
  StreamedState& s = *opened.state;
  // A coarser picture, of more pages than a list of wants takes.
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
    CHECK(opened.comes([&] { return s.residency->n_resident() == n_pages; }));
    // Another frame and a refine() of the view meanwhile.
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
  // All that is there is pinned, and the rest of the pool taken.
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

TEST_CASE("an outage that ends many reads at once is one failure, and one that is over is none") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 6, 1);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  for (float coarse = 4096; opened.frame(camera, coarse).parts().size() < 100; coarse /= 1.5F)
    REQUIRE(opened.refine(camera, coarse) == true);
  opened.script->is_shut = true;
  auto complete = std::async(std::launch::async, [&] { return opened.refine(camera, 0); });
  CHECK(opened.comes([&] { return opened.script->n_at_once == 6; }));
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
}

TEST_CASE("a range that cannot be read keeps nothing else from being read") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 2);
  StreamedState& s = *opened.state;
  REQUIRE(opened.refine(over(), 0) == true);
  const std::uint64_t n_all = s.residency->n_resident();
  std::uint32_t group = 0;  // in the middle, its children leaves
  while (group < s.residency->n_groups() && s.file->pages()[group].level != 1) ++group;
  group += (s.residency->n_groups() - group) / 2;
  const auto range = s.file->stored(s.file->pages()[group].first_child);
  const std::uint32_t n_children = s.file->pages()[group].n_children;

  Opened lossy(bytes, false, 2);
  lossy.script->gone_from = range.offset, lossy.script->gone_to = range.offset + 1;
  const auto complete = lossy.refine(over(), 0);
  REQUIRE(!complete);
  CHECK(complete.error().code == Errc::read_failed);
  CHECK(lossy.comes([&] { return lossy.state->residency->n_resident() == n_all - n_children; }));
  lossy.script->gone_to = 0;
  CHECK(lossy.refine(over(), 0) == true);
}

TEST_CASE("a view whose pages cannot be read fails, whatever is read for another one meanwhile") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes, false, 2);
  StreamedState& s = *opened.state;
  REQUIRE(opened.refine(over(), 0, 2) == true);
  float coarse = 4096;
  while (opened.frame(over(), coarse, 2).n_pages() < 60) coarse /= 1.5F;
  const auto eye = opened.rule(coarse).eye(over());
  // What the coarse view wants and has nothing below it that it wants, and what only the other one wants.
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
  CHECK(lossy.comes([&] { return t.residency->can_evict(others) && t.residency->n_failed(lost) > 0; }));
  auto complete = std::async(std::launch::async, [&] { return lossy.refine(over(), coarse, 1); });
  const auto is_over = [&] { return complete.wait_for(0s) == std::future_status::ready; };
  int n_before = 0, n_failed = 0, n_read = 0;
  {
    const std::scoped_lock lock(lossy.pool->mutex);
    n_before = t.residency->n_failed(lost);
  }
  // Each time that the other view's pages are there they go. It ends long before so many failures.
  CHECK(test::comes([&] {
    lossy.frame(over(), 0, 2);
    const std::scoped_lock lock(lossy.pool->mutex);
    n_failed = t.residency->n_failed(lost) - n_before;
    if (t.residency->can_evict(others)) {
      t.evict(others);
      ++n_read;
    }
    return is_over() || n_failed == 15;
  }));
  CHECK(n_failed < 15);
  CHECK(n_read > 1);
  lossy.script->gone_to = n_failed < 15 ? lossy.script->gone_to.load() : 0;
  const auto refined = complete.get();
  REQUIRE(!refined);
  CHECK(refined.error().code == Errc::read_failed);
  lossy.script->gone_to = 0;
  CHECK(lossy.refine(over(), coarse, 1) == true);
}

TEST_CASE("ranges that cannot be read, however many and however wanted, leave time and room for everything else") {
  const Bytes bytes = town({.n = 300000, .sh_degree = 0, .page_chunks = 1});
  Opened sound(bytes);
  REQUIRE(sound.refine(over(), 0) == true);
  const PagedFile& file = *sound.state->file;
  const std::vector<lod::Page>& pages = file.pages();
  // Of level 2 the first half, and of level 1 all but every tenth: more than a list of wants takes.
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
    CHECK(lossy.comes([&] { return lossy.state->residency->n_resident() == n_there; }));
  }
}

TEST_CASE("a complete view is at rest: nothing is read any more, and no thread waits for the clock") {
  const Bytes bytes = town();
  Opened opened(bytes, true);
  REQUIRE(opened.refine(over(), 0.5F) == true);
  const StreamedState& s = *opened.state;
  CHECK(opened.comes([&] { return s.settled_at >= opened.pool->changes && s.n_at_work == 0; }));
  const std::scoped_lock lock(opened.pool->mutex);
  StreamedState::Run run;
  CHECK(opened.state->choose(run) == StreamedState::Choice::nothing);
  CHECK(run.later == detail::StreamClock::time_point::max());
}

TEST_CASE("what a moving camera is about to see is read before it is seen") {
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
      x = s.views.front()->soon->eye.position[0];
    } else {
      opened.frame(at(-24), 0.05F);
    }
    CHECK(opened.comes([&] { return s.settled_at >= opened.pool->changes && s.n_at_work == 0; }));
    CHECK(opened.frame(at(-24), 0.05F).cut().missing == 0);
    CHECK((opened.frame(at(x), 0.05F).cut().missing == 0) == prefetch);
  }
}

TEST_CASE("where the camera is about to be follows from when it came, and outlives the frame after a refine()") {
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
    if (!view.soon) return -1;
    return view.soon->eye.position[0] - view.now->eye.position[0];
  };
  opened.move(at(0), at(1), 1);
  CHECK(soon() > 1);  // 1 in 0.25 s, or a little more
  CHECK(soon() <= 2.01);
  // A refine() is waited for without what is about to be seen, which follows.
  REQUIRE(comes([&] {
    opened.frame(at(1), 1);
    REQUIRE(opened.refine(at(1.5), 1) == true);
    return soon() > 0;
  }));
  CHECK(opened.comes([&] { return s.views.front()->is_soon_known; }));
  opened.frame(at(1.5), 1);
  CHECK(soon() > 0);
  opened.frame(at(1.5), 1);
  CHECK(soon() == -1);  // it stands
  // Never farther than the scene is large.
  opened.move(at(0), at(1e5), 1);
  CHECK(soon() > 10);
  CHECK(soon() < 1000);
}
