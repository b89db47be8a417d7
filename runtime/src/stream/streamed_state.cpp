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

constexpr double kAheadSeconds = 0.5;   // of the camera's motion
constexpr double kMotionSeconds = 0.5;  // frames farther apart say nothing of motion
constexpr double kMostTurn = 1;         // radians ahead
/// Prefetch runs every sixth frame, because it costs as much as choosing the pages.
constexpr int kPrefetchFrames = 6;
constexpr std::size_t kFirstDrawn = 256;  // pages
/// A step of the detail where a view does not fit; a fifth fewer to a third fewer Gaussians.
constexpr float kCoarser = 1.2F, kFirstCoarser = 0.25F;
/// An allocator adds some bytes to each block.
constexpr std::uint64_t kAllocationBytes = 32;

bool is_more(const WantList::Want& a, const WantList::Want& b) {
  return a.rank > b.rank;
}

bool is_same(const StreamEye& a, const StreamEye& b) {
  return a.eye.position == b.eye.position && a.eye.focal_px == b.eye.focal_px && a.eye.z_near == b.eye.z_near &&
         a.volume == b.volume;
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

// The camera moved on by `ahead` times the motion from `before` to `now`, but at most `farthest`.
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

Priority StreamedState::priority(std::uint32_t group) const {
  Priority priority;
  for (const auto& view : views) {
    if (view->is_live) priority.px = std::max(priority.px, residency->wanted_px(group, *view->now));
  }
  priority.now = priority.px > 0;
  if (priority.now) return priority;
  for (const auto& view : views) {
    if (view->is_live && view->ahead) priority.px = std::max(priority.px, residency->wanted_px(group, *view->ahead));
  }
  return priority;
}

void StreamedState::requested(std::uint32_t group) {
  forget_want(group);
  residency->request(group);
  const lod::Page& above = file->pages()[group];
  for (std::uint32_t k = 0; k < above.n_children; ++k) store->reserve(above.first_child + k);
  for (const auto& view : views) view->n_in_flight += residency->wanted_px(group, *view->now) > 0;
  want_below(group);
  ++n_requested;
}

void StreamedState::cancel(std::uint32_t group) {
  leave_flight(group);
  free_pages(group);
}

void StreamedState::leave_flight(std::uint32_t group) {
  for (const auto& view : views) {
    // The last cut may have missed a group whose box is at the view's edge.
    if (view->n_in_flight > 0 && residency->wanted_px(group, *view->now) > 0) --view->n_in_flight;
  }
}

void StreamedState::want(std::uint32_t group) {
  for (const auto& view : views) {
    if (const float px = residency->wanted_px(group, *view->now); px > 0) view->wants.insert(group, rank(group, px));
    if (!view->ahead) continue;
    if (const float px = residency->wanted_px(group, *view->ahead); px > 0)
      view->prefetch_wants.insert(group, rank(group, px));
  }
}

// Finds wants of the current cameras alone; choose_among() drops stale ones.
void StreamedState::forget_want(std::uint32_t group) {
  const auto forget = [&](WantList& list, const StreamEye& eye) {
    const float px = residency->wanted_px(group, eye);
    if (px <= 0) return;
    list.erase(group, px);
    if (residency->n_failed(group) > 0) list.erase(group, put_off_rank(px));
  };
  for (const auto& view : views) {
    forget(view->wants, *view->now);
    if (view->ahead) forget(view->prefetch_wants, *view->ahead);
  }
}

void StreamedState::want_below(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  const std::uint32_t end = std::min(above.first_child + above.n_children, residency->n_groups());
  for (std::uint32_t child = above.first_child; child < end; ++child) {
    if (residency->can_request(child)) want(child);
  }
}

void StreamedState::free_pages(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  for (std::uint32_t k = 0; k < above.n_children; ++k) store->free(above.first_child + k);
  pool->release_pages(group_bytes(group));
}

void StreamedState::count_evicted(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  for (std::uint32_t child = above.first_child; child < above.first_child + above.n_children; ++child) {
    stats.bytes_evicted += file->decoded_bytes(child);
  }
}

void StreamedState::evict(std::uint32_t group) {
  if (residency->state(group) == Residency::State::arrived) leave_flight(group);
  residency->evict(group);
  count_evicted(group);
  free_pages(group);
  drop_below(group);
  // Unless the parent page has failed meanwhile.
  for (const auto& view : views) {
    if (!residency->can_request(group)) break;
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
  if (residency->is_resident(group)) {
    became_resident(group);
  } else if (residency->is_parent_in_flight(group)) {
    residency->arrive(group);
  } else {
    drop(group);
  }
  // A resident group can be evicted for another, and a dropped one has left room.
  if (std::exchange(pool->lacks_room, false)) pool->changed();
  if (n_waiting > 0 &&
      std::ranges::any_of(views, [](const auto& view) { return view->n_busy > 0 && view->has_nothing_pending(); }))
    pool->news.notify_all();
}

void StreamedState::became_resident(std::uint32_t group) {
  leave_flight(group);
  const bool has_failed = residency->n_failed(group) > 0;
  residency->make_resident(group);
  if (has_failed) {  // its child groups were not requested while it failed
    want_below(group);
    pool->changed();
  }
  const lod::Page& above = file->pages()[group];
  const std::uint32_t end = std::min(above.first_child + above.n_children, residency->n_groups());
  for (std::uint32_t child = above.first_child; child < end; ++child) {
    if (residency->state(child) == Residency::State::arrived) became_resident(child);
  }
}

// Groups still being read are dropped when they arrive.
void StreamedState::drop_below(std::uint32_t group) {
  const lod::Page& above = file->pages()[group];
  const std::uint32_t end = std::min(above.first_child + above.n_children, residency->n_groups());
  for (std::uint32_t child = above.first_child; child < end; ++child) {
    forget_want(child);
    if (residency->state(child) == Residency::State::arrived) drop(child);
  }
}

void StreamedState::drop(std::uint32_t group) {
  cancel(group);
  count_evicted(group);
  residency->drop(group);
  drop_below(group);
}

void StreamedState::update_live_views(StreamClock::time_point now) {
  for (const auto& view : views) {
    view->is_live = view->n_busy > 0 || now - view->seen < kViewLives || pool->last_view == view.get();
  }
}

void StreamedState::remove_old_views() {
  std::erase_if(views, [&](const std::unique_ptr<StreamView>& view) {
    if (!view->is_live) pool->release(view->bytes + view->lists.bytes);
    return !view->is_live;
  });
}

Result<StreamView*> StreamedState::post(std::uint64_t renderer, const Camera& camera, const StreamRule& rule) {
  StreamEye eye = rule.eye(camera);
  const auto now = pool->now();
  update_live_views(now);
  const auto found = std::ranges::find(views, renderer, [](const auto& view) { return view->renderer; });
  StreamView* view = found == views.end() ? nullptr : found->get();
  bool is_new = view == nullptr || !view->is_live;
  const bool had_ahead = view != nullptr && view->ahead;
  if (view == nullptr) {
    remove_old_views();
    if (pool->take(view_bytes(), kNeeded) != StreamPoolState::Room::taken) {
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "the memory budget has no room for another view: raise it, or use fewer renderers",
                        pool->held + view_bytes(), pool->budget);
    }
    struct Given {
      StreamPoolState* pool;
      ~Given() {
        if (pool != nullptr) pool->release(view_bytes());
      }
    } given{pool.get()};
    view = views.emplace_back(std::make_unique<StreamView>()).get();
    given.pool = nullptr;
    view->bytes = view_bytes();
    view->renderer = renderer;
  } else if (!is_same(*view->now, eye) || view->asked_px != eye.detail_px) {
    const double seconds = std::chrono::duration<double>(now - view->came).count();
    view->ahead.reset();
    if (prefetches && seconds > 0 && seconds < kMotionSeconds) {
      view->ahead = rule.eye(moved_on(view->camera, camera, kAheadSeconds / seconds, extent(file->pages()[0].bounds)));
    }
    view->is_refined = view->has_run_out = false;
    is_new = true;
  } else if (!view->is_refined) {
    view->ahead.reset();  // the camera stands still
  }
  if (!view->is_refined) view->came = now;
  view->is_refined = false;
  view->camera = camera;
  view->asked_px = eye.detail_px;
  // Near what fitted last.
  if (view->now && view->most_gaussians != std::numeric_limits<std::uint64_t>::max())
    eye.detail_px = std::max(eye.detail_px, view->now->detail_px / kCoarser);
  view->now = eye;
  view->seen = now;
  if (!had_ahead || !view->ahead || ++view->frames_since_prefetch >= kPrefetchFrames)
    view->prefetch_is_current = false, view->frames_since_prefetch = 0;
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

// Doubles the lists.
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
  pool->release(n);
}

Residency::Cut StreamedState::cut(StreamView& view, DrawLists* lists) {
  StreamEye& eye = *view.now;
  for (;;) {
    ++pool->tick;
    view.wants.clear();
    if (lists != nullptr) lists->pages.clear();
    std::uint64_t n = 0;
    bool is_full = false;
    const auto draw = [&](std::uint32_t page) {
      const bool is_first = n == 0;
      n += file->pages()[page].count;
      if (!is_first && n > view.most_gaussians) return false;
      if (lists == nullptr) return true;
      is_full = lists->pages.size() == lists->pages.capacity();
      if (!is_full) lists->pages.push_back(page);
      return !is_full;
    };
    const Residency::Cut cut = residency->cut(
        eye, pool->tick, draw, [&](std::uint32_t group, float px) { view.wants.add(group, rank(group, px)); },
        view.asked_px);
    if (cut.fits) {
      view.wants.order();
      view.n_in_flight = cut.in_flight;
      if (view.ahead) view.ahead->detail_px = eye.detail_px;
      return cut;
    }
    if (is_full && grow(*lists)) continue;
    // If not even the list of pages fits, the picture is coarser. One page fits, or there is no list at all.
    if (is_full && lists->pages.capacity() == 0) {
      lists = nullptr;
    } else {
      eye.detail_px = std::max(kCoarser * eye.detail_px, kFirstCoarser);
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

void StreamFrame::drawn(bool fits) const {
  const std::scoped_lock lock(state_->pool->mutex);
  std::uint64_t& most = view_->most_gaussians;
  const FrameWorkspace& workspace = slots()->workspace();
  if (!fits) {
    most = cut_.gaussians - cut_.gaussians / 4;
  } else if (view_->now->detail_px > view_->asked_px && workspace.held() < workspace.bytes() - workspace.bytes() / 4) {
    most += std::min(most / 8, std::numeric_limits<std::uint64_t>::max() - most);
  }
}

Result<bool> refine_view(StreamedState& s, std::uint64_t renderer, const Camera& camera, const StreamRule& rule,
                         double seconds) {
  constexpr double kLongest = 1e7;
  const auto deadline = s.pool->now() + std::chrono::duration_cast<StreamClock::duration>(std::chrono::duration<double>(
                                            std::isnan(seconds) ? 0 : std::clamp(seconds, 0.0, kLongest)));
  std::unique_lock lock(s.pool->mutex);
  Result<StreamView*> posted = nullptr;
  for (;;) {
    posted = s.post(renderer, camera, rule);
    const Status room = posted ? s.need((*posted)->lists) : Status(tl::unexpected(posted.error()));
    if (room) break;
    if (!s.pool->wait_for_room(lock, posted ? *posted : nullptr, deadline)) return tl::unexpected(room.error());
    if (s.pool->now() >= deadline) return false;
  }
  StreamView& view = **posted;
  view.now->detail_px = view.asked_px;
  view.is_refined = true;
  ++view.n_busy, ++s.n_waiting;
  s.pool->changed();  // pauses are shorter now
  struct Waiter {
    StreamedState& scene;
    StreamView& view;
    ~Waiter() {
      view.seen = scene.pool->now();
      --view.n_busy, --scene.n_waiting;
      if (scene.n_waiting == 0) scene.pool->changed();  // prefetch has waited
    }
  } waiter{s, view};
  if (!std::exchange(view.has_run_out, false)) view.failures.n = 0;
  const auto fails_for_long = [&] { return view.is_lasting && view.failures.n >= StreamedState::kLastingTrouble; };
  for (;;) {
    // With its lists, so that the next frame needs no more memory.
    const Residency::Cut cut = s.cut(view, &view.lists);
    s.stats.pages_missing = cut.missing;
    s.stats.detail_reached_px = cut.reached_px;
    // The view is verified only once the table's hash is.
    if (cut.missing == 0 && s.file->is_verified()) return true;
    if (cut.missing == 0 && s.residency->is_broken()) return tl::unexpected(s.damage.error());
    const std::uint64_t changes = s.pool->changes, n_resident = s.residency->n_resident();
    const auto is_settled = [&] { return s.settled_at >= changes && s.n_at_work == 0; };
    const bool is_late = view.has_run_out = s.pool->now() >= deadline;
    const bool is_failing = is_late ? view.failures.n > 0 : fails_for_long();
    if (is_failing && (cut.missing > cut.damaged || cut.missing == 0)) return tl::unexpected(view.trouble.error());
    if (cut.damaged > 0 && (is_settled() || is_late || is_failing)) return tl::unexpected(s.damage.error());
    if (is_settled() || is_late) return false;
    s.pool->news.wait_until(lock, deadline, [&] {
      if (is_settled() || fails_for_long()) return true;
      if (cut.missing == 0) return !s.can_extend();
      return view.has_nothing_pending() && s.residency->n_resident() != n_resident;
    });
  }
}

}  // namespace rgs::detail
