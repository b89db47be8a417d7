// streamed_state.cpp - views of a streamed scene: what they draw, what they want, when they are complete.
// SPDX-License-Identifier: Apache-2.0
#include "stream/streamed_state.hpp"

#include <algorithm>
#include <cmath>
#include <glm/gtc/quaternion.hpp>
#include <glm/matrix.hpp>
#include <limits>
#include <utility>

#include "rgs/guard_memory.hpp"
#include "stream/stream_times.hpp"

namespace rgs::detail {
namespace {

using namespace std::chrono_literals;

constexpr auto kViewLives = 1s;         // without a frame
constexpr double kAheadSeconds = 0.5;   // of the camera's motion
constexpr double kMotionSeconds = 0.5;  // between frames, above which they say nothing of motion
constexpr double kMostTurn = 1;         // radians ahead
constexpr int kSoonFrames =
    6;  // that what is about to be seen is looked for once: it takes as long as a frame's own choice
constexpr std::size_t kFirstDrawn = 256;  // pages
/// A block of memory costs its allocator some bytes of its own.
constexpr std::uint64_t kAllocationBytes = 32;

bool is_more(const WantList::Want& a, const WantList::Want& b) {
  return a.rank > b.rank;
}

bool is_same(const StreamEye& a, const StreamEye& b) {
  return a.eye.position == b.eye.position && a.eye.focal_px == b.eye.focal_px && a.eye.z_near == b.eye.z_near &&
         a.detail_px == b.detail_px && a.volume == b.volume;
}

std::uint64_t view_bytes() {
  return sizeof(StreamView) + 2 * WantList::kMost * sizeof(WantList::Want) + 4 * kAllocationBytes;
}

double extent(const Box& box) {
  double squared = 0;
  for (std::size_t k = 0; k < 3; ++k) {
    const double side = static_cast<double>(box.max[k]) - static_cast<double>(box.min[k]);
    squared += side * side;
  }
  return std::sqrt(squared);
}

// Where a camera is after `ahead` times the motion from `before` to `now`, at most `farthest` away.
Camera moved_on(const Camera& before, const Camera& now, double ahead, double farthest) {
  const glm::dmat4 a = glm::inverse(before.world_to_camera), b = glm::inverse(now.world_to_camera);
  const glm::dvec3 from(a[3]), to(b[3]);
  const glm::dquat turn = glm::normalize(glm::quat_cast(glm::dmat3(b)) * glm::inverse(glm::quat_cast(glm::dmat3(a))));
  const double sign = turn.w < 0 ? -1 : 1;
  const glm::dvec3 axis(sign * turn.x, sign * turn.y, sign * turn.z);
  const double sine = glm::length(axis), angle = std::min(2 * std::atan2(sine, sign * turn.w) * ahead, kMostTurn);
  glm::dmat3 rotation(b);
  if (sine > 1e-12) rotation = glm::mat3_cast(glm::angleAxis(angle, axis / sine)) * rotation;
  glm::dmat4 to_world(rotation);
  glm::dvec3 way = (to - from) * ahead;
  if (const double length = glm::length(way); length > farthest) way *= farthest / length;
  to_world[3] = glm::dvec4(to + way, 1);
  Camera camera = now;
  camera.world_to_camera = glm::inverse(to_world);
  return camera;
}

}  // namespace

void WantList::add(std::uint32_t group, float rank) {
  if (wants_.size() < kMost) {
    wants_.push_back({rank, group});
    return;
  }
  if (!std::exchange(is_cut_off_, true)) std::ranges::make_heap(wants_, is_more);
  if (!(rank > wants_.front().rank)) return;
  std::ranges::pop_heap(wants_, is_more);
  wants_.back() = {rank, group};
  std::ranges::push_heap(wants_, is_more);
}

void WantList::order() {
  std::ranges::stable_sort(wants_, is_more);
}

std::vector<WantList::Want>::iterator WantList::find(const Want& want) {
  const auto [begin, end] = std::equal_range(wants_.begin(), wants_.end(), want, is_more);
  const auto at = std::find_if(begin, end, [&](const Want& other) { return other.group == want.group; });
  return at == end ? wants_.end() : at;
}

void WantList::insert(std::uint32_t group, float rank) {
  const Want want{rank, group};
  if (find(want) != wants_.end()) return;
  if (wants_.size() == kMost) {
    is_cut_off_ = true;
    if (!(rank > wants_.back().rank)) return;
    wants_.pop_back();
  }
  wants_.insert(std::ranges::upper_bound(wants_, want, is_more), want);
}

void WantList::erase(std::uint32_t group, float rank) {
  const auto at = find({rank, group});
  if (at != wants_.end()) wants_.erase(at);
}

std::uint64_t StreamedState::list_bytes(std::size_t n) const {
  const std::uint64_t drawn = store->is_on_device() ? file->page_chunks() * sizeof(std::uint32_t) : sizeof(ScenePart);
  return n * (sizeof(std::uint32_t) + drawn) + 2 * kAllocationBytes;
}

std::uint64_t StreamedState::least_view_bytes() const {
  return view_bytes() + list_bytes(kFirstDrawn);
}

std::uint64_t StreamedState::group_bytes(std::uint32_t group) const {
  const lod::Page& above = file->pages()[group];
  std::uint64_t sum = 0;
  for (std::uint32_t k = 0; k < above.n_children; ++k) sum += store->page_bytes(above.first_child + k);
  return sum;
}

Worth StreamedState::worth(std::uint32_t group) const {
  Worth worth;
  for (const auto& view : views) {
    if (view->is_live) worth.px = std::max(worth.px, residency->wanted_px(group, *view->now));
  }
  worth.now = worth.px > 0;
  if (worth.now) return worth;
  for (const auto& view : views) {
    if (view->is_live && view->soon) worth.px = std::max(worth.px, residency->wanted_px(group, *view->soon));
  }
  return worth;
}

void StreamedState::requested(std::uint32_t group) {
  forget_want(group);
  residency->request(group);
  const lod::Page& above = file->pages()[group];
  for (std::uint32_t k = 0; k < above.n_children; ++k) store->reserve(above.first_child + k);
  for (const auto& view : views) view->n_coming += residency->wanted_px(group, *view->now) > 0;
  want_below(group);
  ++n_requested;
}

void StreamedState::give_up(std::uint32_t group) {
  no_longer_coming(group);
  give_room(group);
}

void StreamedState::no_longer_coming(std::uint32_t group) {
  for (const auto& view : views) {
    // The last cut may have missed one whose box is at the edge of the view.
    if (view->n_coming > 0 && residency->wanted_px(group, *view->now) > 0) --view->n_coming;
  }
}

void StreamedState::want(std::uint32_t group) {
  for (const auto& view : views) {
    if (const float px = residency->wanted_px(group, *view->now); px > 0) view->wants.insert(group, rank(group, px));
    if (!view->soon) continue;
    if (const float px = residency->wanted_px(group, *view->soon); px > 0)
      view->soon_wants.insert(group, rank(group, px));
  }
}

// As far as lists are of the cameras as they are: choose_among() finds the rest.
void StreamedState::forget_want(std::uint32_t group) {
  const auto forget = [&](WantList& list, const StreamEye& eye) {
    const float px = residency->wanted_px(group, eye);
    if (px <= 0) return;
    list.erase(group, px);
    if (residency->n_failed(group) > 0) list.erase(group, put_off_rank(px));
  };
  for (const auto& view : views) {
    forget(view->wants, *view->now);
    if (view->soon) forget(view->soon_wants, *view->soon);
  }
}

void StreamedState::want_below(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  const std::uint32_t end = std::min(above.first_child + above.n_children, residency->n_groups());
  for (std::uint32_t child = above.first_child; child < end; ++child) {
    if (residency->is_open(child)) want(child);
  }
}

void StreamedState::give_room(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  for (std::uint32_t k = 0; k < above.n_children; ++k) store->free(above.first_child + k);
  pool->give_pages(group_bytes(group));
}

void StreamedState::count_evicted(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  for (std::uint32_t child = above.first_child; child < above.first_child + above.n_children; ++child) {
    stats.bytes_evicted += file->decoded_bytes(child);
  }
}

void StreamedState::evict(std::uint32_t group) {
  if (residency->state(group) == Residency::State::arrived) no_longer_coming(group);
  residency->evict(group);
  count_evicted(group);
  give_room(group);
  drop_below(group);
  // Not if the page above has failed meanwhile.
  for (const auto& view : views) {
    if (!residency->is_open(group)) break;
    if (const float px = residency->wanted_px(group, *view->now); px > 0) view->wants.insert(group, rank(group, px));
  }
  pool->changed();
}

void StreamedState::arrived(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  for (std::uint32_t child = above.first_child; child < above.first_child + above.n_children; ++child) {
    stats.bytes_decoded += file->decoded_bytes(child);
    if (store->is_on_device()) stats.bytes_uploaded += file->decoded_bytes(child);
  }
  for (const auto& view : views) {
    if (residency->wanted_px(group, *view->now) > 0) view->failures.n = 0;
  }
  if (residency->has(group)) {
    placed(group);
  } else if (residency->waits_for_above(group)) {
    residency->arrive(group);
  } else {
    drop(group);
  }
  // What is there may give room to another, and what is dropped does.
  if (std::exchange(pool->lacks_room, false)) pool->changed();
  if (n_waiting > 0 &&
      std::ranges::any_of(views, [](const auto& view) { return view->n_busy > 0 && view->has_come(); }))
    pool->news.notify_all();
}

void StreamedState::placed(std::uint32_t group) {
  no_longer_coming(group);
  const bool has_failed = residency->n_failed(group) > 0;
  residency->place(group);
  if (has_failed) {  // what is below it was not asked for before
    want_below(group);
    pool->changed();
  }
  const lod::Page& above = file->pages()[group];
  const std::uint32_t end = std::min(above.first_child + above.n_children, residency->n_groups());
  for (std::uint32_t child = above.first_child; child < end; ++child) {
    if (residency->state(child) == Residency::State::arrived) placed(child);
  }
}

// Of what is still being read its thread finds out.
void StreamedState::drop_below(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  const std::uint32_t end = std::min(above.first_child + above.n_children, residency->n_groups());
  for (std::uint32_t child = above.first_child; child < end; ++child) {
    forget_want(child);
    if (residency->state(child) == Residency::State::arrived) drop(child);
  }
}

void StreamedState::drop(std::uint32_t group) {
  give_up(group);
  count_evicted(group);
  residency->drop(group);
  drop_below(group);
}

void StreamedState::look_at_clock(StreamClock::time_point now) {
  for (const auto& view : views) {
    view->is_live = view->n_busy > 0 || now - view->seen < kViewLives || pool->last_view == view.get();
  }
}

void StreamedState::forget_old_views() {
  std::erase_if(views, [&](const std::unique_ptr<StreamView>& view) {
    if (!view->is_live) pool->give(view->bytes + view->lists.bytes);
    return !view->is_live;
  });
}

Result<StreamView*> StreamedState::post(std::uint64_t renderer, const Camera& camera, const StreamRule& rule) {
  const StreamEye eye = rule.eye(camera);
  const auto now = pool->now();
  look_at_clock(now);
  const auto found = std::ranges::find(views, renderer, [](const auto& view) { return view->renderer; });
  StreamView* view = found == views.end() ? nullptr : found->get();
  bool is_new = view == nullptr || !view->is_live;
  const bool had_soon = view != nullptr && view->soon;
  if (view == nullptr) {
    forget_old_views();
    if (pool->take(view_bytes(), kNeeded) != StreamPoolState::Room::taken) {
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "the memory budget has no room for another view: a larger one, or fewer renderers",
                        pool->held + view_bytes(), pool->budget);
    }
    struct Given {
      StreamPoolState* pool;
      ~Given() {
        if (pool != nullptr) pool->give(view_bytes());
      }
    } given{pool.get()};
    view = views.emplace_back(std::make_unique<StreamView>()).get();
    given.pool = nullptr;
    view->bytes = view_bytes();
    view->renderer = renderer;
  } else if (!is_same(*view->now, eye)) {
    const double seconds = std::chrono::duration<double>(now - view->came).count();
    view->soon.reset();
    if (prefetches && seconds > 0 && seconds < kMotionSeconds) {
      view->soon = rule.eye(moved_on(view->camera, camera, kAheadSeconds / seconds, extent(file->pages()[0].bounds)));
    }
    view->is_refined = false;
    is_new = true;
  } else if (!view->is_refined) {
    view->soon.reset();  // it stands
  }
  if (!view->is_refined) view->came = now;
  view->is_refined = false;
  view->camera = camera;
  view->now = eye;
  view->seen = now;
  if (!had_soon || !view->soon || ++view->soon_frames >= kSoonFrames)
    view->is_soon_known = false, view->soon_frames = 0;
  view->is_live = true;
  pool->last_view = view;
  if (is_new) pool->changed();
  return view;
}

Status StreamedState::need(DrawLists& lists) {
  if (lists.pages.capacity() > 0 || grow(lists)) return {};
  return make_error(Errc::limit_exceeded, Error::kNone, "the memory budget has no room for a view's lists of pages",
                    pool->held + list_bytes(kFirstDrawn), pool->budget);
}

// Room for twice as many pages.
bool StreamedState::grow(DrawLists& lists) {
  const std::size_t n = std::max(2 * lists.pages.capacity(), kFirstDrawn);
  if (pool->take(list_bytes(n), kNeeded) != StreamPoolState::Room::taken) return false;
  free(lists);
  lists.bytes = list_bytes(n);
  lists.pages.reserve(n);
  if (store->is_on_device()) {
    lists.chunks.reserve(n * file->page_chunks());
  } else {
    lists.parts.reserve(n);
  }
  return true;
}

void StreamedState::free(DrawLists& lists) {
  const std::uint64_t n = lists.bytes;
  lists = DrawLists();
  pool->give(n);
}

Residency::Cut StreamedState::cut(StreamView& view, DrawLists* lists) {
  StreamEye eye = *view.now;
  for (;;) {
    ++pool->tick;
    view.wants.clear();
    if (lists != nullptr) lists->pages.clear();
    const auto draw = [&](std::uint32_t page) {
      if (lists == nullptr) return true;
      if (lists->pages.size() == lists->pages.capacity()) return false;
      lists->pages.push_back(page);
      return true;
    };
    const Residency::Cut cut = residency->cut(
        eye, pool->tick, draw, [&](std::uint32_t group, float px) { view.wants.add(group, rank(group, px)); },
        view.now->detail_px);
    if (cut.fits) {
      view.wants.order();
      view.n_coming = cut.coming;
      return cut;
    }
    if (grow(*lists)) continue;
    // Where not even the list of pages fits, the picture is coarser. One page fits, or there is no list at all.
    if (lists->pages.capacity() == 0) {
      lists = nullptr;
    } else {
      eye.detail_px = std::max(2 * eye.detail_px, 1.0F);
    }
  }
}

StreamStats StreamedState::stats_now() const {
  StreamStats now = stats;
  now.pages_resident = residency->n_resident();
  return now;
}

Result<StreamFrame> StreamFrame::begin(std::shared_ptr<StreamedState> state, std::uint64_t renderer,
                                       const Camera& camera, const StreamRule& rule) {
  StreamedState& s = *state;
  StreamTimer timer(StreamStep::frame_lock);
  const std::scoped_lock lock(s.pool->mutex);
  timer.next(StreamStep::frame_cut);
  const auto view = s.post(renderer, camera, rule);
  if (!view) return tl::unexpected(view.error());
  DrawLists& lists = (*view)->lists;
  if (Status there = s.need(lists); !there) return tl::unexpected(there.error());
  StreamFrame frame;
  frame.cut_ = s.cut(**view, &lists);
  lists.parts.clear(), lists.chunks.clear();
  for (const std::uint32_t page : lists.pages) {
    if (s.store->is_on_device()) {
      s.store->add_chunks(page, lists.chunks);
    } else {
      lists.parts.push_back(s.store->part(page));
    }
  }
  s.stats.pages_missing = frame.cut_.missing;
  s.stats.detail_reached_px = frame.cut_.reached_px;
  frame.stats_ = s.stats_now();
  s.residency->pin(lists.pages);
  frame.lists_ = std::exchange(lists, {});
  ++(*view)->n_busy;
  frame.view_ = *view;
  frame.state_ = std::move(state);
  return frame;
}

StreamFrame::~StreamFrame() {
  if (state_ == nullptr) return;
  const std::scoped_lock lock(state_->pool->mutex);
  state_->residency->unpin(lists_.pages);
  // Another frame of the view may have made lists of its own.
  if (view_->lists.pages.capacity() < lists_.pages.capacity()) std::swap(view_->lists, lists_);
  state_->free(lists_);
  view_->seen = state_->pool->now();
  --view_->n_busy;
  if (std::exchange(state_->pool->waits_for_pins, false)) state_->pool->changed();
}

Result<bool> refine_view(StreamedState& s, std::uint64_t renderer, const Camera& camera, const StreamRule& rule,
                         double seconds) {
  constexpr double kLongest = 1e7;
  const auto deadline =
      s.pool->now() + std::chrono::duration_cast<StreamClock::duration>(std::chrono::duration<double>(
                               std::isnan(seconds) ? 0 : std::clamp(seconds, 0.0, kLongest)));
  std::unique_lock lock(s.pool->mutex);
  const auto posted = s.post(renderer, camera, rule);
  if (!posted) return tl::unexpected(posted.error());
  StreamView& view = **posted;
  if (Status there = s.need(view.lists); !there) return tl::unexpected(there.error());
  view.is_refined = true;
  ++view.n_busy, ++s.n_waiting;
  s.pool->changed();  // pauses are shorter now
  struct Waiter {
    StreamedState& scene;
    StreamView& view;
    ~Waiter() {
      view.seen = scene.pool->now();
      --view.n_busy, --scene.n_waiting;
      if (scene.n_waiting == 0) scene.pool->changed();  // what is about to be seen has waited
    }
  } waiter{s, view};
  view.failures.n = 0;
  const auto fails_for_long = [&] { return view.is_lasting && view.failures.n >= StreamedState::kLastingTrouble; };
  for (;;) {
    // Its lists too: the frame that follows shall need no more room.
    const Residency::Cut cut = s.cut(view, &view.lists);
    s.stats.pages_missing = cut.missing;
    s.stats.detail_reached_px = cut.reached_px;
    // Before the hash of its table is compared nobody knows that the view is right.
    if (cut.missing == 0 && s.file->is_verified()) return true;
    if (cut.missing == 0 && s.residency->is_broken()) return tl::unexpected(s.damage.error());
    const std::uint64_t changes = s.pool->changes, n_resident = s.residency->n_resident();
    const auto is_settled = [&] { return s.settled_at >= changes && s.n_at_work == 0; };
    const bool is_late = s.pool->now() >= deadline;
    const bool is_failing = is_late ? view.failures.n > 0 : fails_for_long();
    if (is_failing && (cut.missing > cut.damaged || cut.missing == 0)) return tl::unexpected(view.trouble.error());
    if (cut.damaged > 0 && (is_settled() || is_late || is_failing)) return tl::unexpected(s.damage.error());
    if (is_settled() || is_late) return false;
    s.pool->news.wait_until(lock, deadline, [&] {
      if (is_settled() || fails_for_long()) return true;
      if (cut.missing == 0) return !s.can_extend();
      return view.has_come() && s.residency->n_resident() != n_resident;
    });
  }
}

}  // namespace rgs::detail
