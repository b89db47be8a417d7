// streamed_state_test.cpp - what a scheduler's driver does: frames held open, lists without room, callers and threads.
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
    if (opened.frame(over(), coarse).parts().size() > pages::kMostWants + 100) break;
    REQUIRE(coarse > 1e-6F);
  }
  opened.script->is_shut = true;
  {
    const StreamFrame held = opened.frame(over(), 0);
    const std::size_t n = held.parts().size();
    const float first = held.parts().front().mean[0];
    opened.script->open_gate();
    std::uint64_t n_pages = s.file->n_pages_in_all();
    opened.await([&] { return s.residency().n_resident() == n_pages; });
    // Another frame and a refine() of the view in the meantime.
    CHECK(opened.refine(over(), 0) == true);
    CHECK(opened.frame(over(), 0).parts().size() > n);
    CHECK(held.parts().size() == n);
    CHECK(held.parts().front().mean[0] == first);
  }
  const std::scoped_lock lock(opened.pool->mutex);
  // All of it but the root can leave.
  CHECK(s.residency().n_resident() > 1000);
  pages::Scheduler& scheduler = *opened.pool->scheduler;
  while (!s.views.empty()) {
    scheduler.remove_view(s.views.back()->id);
    opened.pool->release(StreamedState::view_bytes() + s.views.back()->lists.bytes);
    s.views.pop_back();
  }
  const std::uint64_t all = scheduler.budget() - s.bytes - s.root_bytes();
  CHECK(opened.pool->take(all));
  CHECK(s.residency().n_resident() == 1);
  opened.pool->release(all);
}

TEST_CASE("a view needs no part of the table but what it looks at") {
  const Bytes bytes = town({.n = 200000, .sh_degree = 0, .page_chunks = 1, .has_large = false});
  const auto whole = PagedFile::open(bytes);
  REQUIRE(whole);
  Opened opened(bytes, false, 3, 1);  // reads are of one page, or of as many bytes of the table
  const Camera corner = camera_at({18, 4, 18}, {25, 0, 25});
  const pages::Look look = opened.rule(0).look(corner);
  const pages::ViewVolume volume(look.view, look.low_pass);
  const auto record = [&](std::uint64_t page) {
    return whole->head().find(SectionType::levels)->offset + kLevelsHeadBytes + page * kPageRecordBytes;
  };
  const auto leaf = std::ranges::find(whole->pages(), 0U, &lod::Page::level);
  const auto seen =
      std::ranges::find_if(leaf, whole->pages().end(), [&](const auto& page) { return volume.may_show(page.bounds); });
  REQUIRE(seen != whole->pages().end());
  // Leaves that it does not see, but for some with which a read may end.
  opened.script->shut_from = record(static_cast<std::uint64_t>(leaf - whole->pages().begin()) + 300);
  opened.script->shut_to = record(whole->pages()[seen->parent].first_child);
  REQUIRE(opened.script->shut_from + 1000 * kPageRecordBytes < opened.script->shut_to);
  opened.script->is_shut = true;
  opened.frame(corner, 0);
  opened.await([&] { return opened.state->residency().n_resident() > 1; });
  test::await([&] { return opened.frame(corner, 0).cut().missing == 0; });
  CHECK(opened.refine(corner, 0, 1, 0) == false);  // only the whole table is known to be sound
  opened.script->open_gate();
  CHECK(opened.refine(corner, 0) == true);
}

TEST_CASE("a frame whose list of pages finds no room is not called complete") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  Opened opened(bytes);
  REQUIRE(opened.refine(over(), 0, 2) == true);
  const StreamFrame all = opened.frame(over(), 0, 2);
  REQUIRE(all.parts().size() > 600);
  CHECK(all.cut().missing == 0);
  // All resident pages are pinned, and the rest of the pool is used.
  const std::uint64_t taken = opened.use_up(opened.state->least_view_bytes());
  {
    const StreamFrame coarser = opened.frame(over(), 0, 1);
    CHECK(coarser.parts().size() < all.parts().size());
    CHECK(coarser.cut().missing > 0);
    CHECK(coarser.cut().damaged == 0);
  }
  CHECK(opened.refine(over(), 0, 1, 10) == false);
  opened.release(taken);
  CHECK(opened.refine(over(), 0, 1) == true);
  CHECK(opened.frame(over(), 0, 1).parts().size() == all.parts().size());
}

TEST_CASE("refine() waits for room that frames, reads and views of others release, and for nothing else") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 3, .page_chunks = 8});
  Opened opened(bytes, false, 1);
  StreamedState& s = *opened.state;
  StreamPoolState& pool = *opened.pool;
  const auto at_rest = [&] { return pool.scheduler->is_at_rest(s.id); };
  opened.frame(over(), 1e9F, 1);  // the root, and the rest of the table
  opened.await(at_rest);
  std::uint64_t taken = 0;
  const auto use_up = [&] { taken += opened.use_up(); };
  const auto release = [&] { opened.release(std::exchange(taken, 0)); };
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
  lone.await([&] { return lone.pool->scheduler->is_at_rest(lone.state->id); });
  const std::uint64_t rest = lone.use_up();
  CHECK(lone.refine(over(), 1e9F, 3, 0) == false);
  complete = std::async(std::launch::async, [&] { return lone.refine(over(), 1e9F, 3); });
  lone.await([&] { return lone.pool->n_waiting_for_room == 1; });
  lone.stop(-2s);
  CHECK(complete.get() == true);
  lone.release(rest);
  const std::scoped_lock lock(lone.pool->mutex);
  CHECK(lone.state->views.size() == 2);
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
}
