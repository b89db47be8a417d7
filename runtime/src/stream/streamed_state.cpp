// streamed_state.cpp - views of a streamed scene: their frames, and callers that wait for them.
// SPDX-License-Identifier: Apache-2.0
#include "stream/streamed_state.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <utility>

#include "stream/stream_times.hpp"

namespace rgs::detail {
namespace {

/// An allocator adds some bytes to each block.
constexpr std::uint64_t kAllocationBytes = 32;

}  // namespace

std::uint64_t StreamedState::view_bytes() {
  return sizeof(StreamView) + pages::Scheduler::view_bytes() + 4 * kAllocationBytes;
}

std::uint64_t StreamedState::list_bytes(std::size_t n) const {
  const std::uint64_t drawn = store->is_on_device() ? file->page_chunks() * sizeof(std::uint32_t) : sizeof(ScenePart);
  return n * (sizeof(std::uint32_t) + drawn) + 2 * kAllocationBytes;
}

void StreamedState::reserve_pages(const pages::action::Read& read) {
  for (std::uint32_t group = read.first; group < read.first + read.n; ++group) {
    const lod::Page& above = file->pages()[group];
    for (std::uint32_t k = 0; k < above.n_children; ++k) store->reserve(above.first_child + k);
  }
}

void StreamedState::free_pages(const pages::action::Evict& evict) {
  const lod::Page& above = file->pages()[evict.group];
  for (std::uint32_t child = above.first_child; child < above.first_child + above.n_children; ++child) {
    store->free(child);
    if (evict.was_placed) stats.bytes_evicted += file->decoded_bytes(child);
  }
}

void StreamedState::remove_old_views() {
  std::erase_if(views, [&](const std::unique_ptr<StreamView>& view) {
    if (pool->scheduler->is_live(view->id, pool->now())) return false;
    pool->scheduler->remove_view(view->id);
    pool->release(view_bytes() + view->lists.bytes);
    return true;
  });
}

Result<StreamView*> StreamedState::post(std::uint64_t renderer, const Camera& camera, const StreamRule& rule) {
  const auto found = std::ranges::find_if(views, [&](const auto& view) { return view->renderer == renderer; });
  StreamView* view = found == views.end() ? nullptr : found->get();
  if (view == nullptr) {
    remove_old_views();
    if (!pool->take(view_bytes())) {
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "the memory budget has no room for another view: raise it, or use fewer renderers",
                        pool->held() + view_bytes(), pool->budget);
    }
    struct Taken {
      StreamPoolState* pool;
      ~Taken() {
        if (pool != nullptr) pool->release(view_bytes());
      }
    } taken{pool.get()};
    auto made = std::make_unique<StreamView>();
    made->renderer = renderer;
    views.reserve(views.size() + 1);
    made->id = pool->scheduler->add_view(id);
    view = views.emplace_back(std::move(made)).get();
    taken.pool = nullptr;
  }
  pool->tell(pages::event::Looks{view->id, rule.look(camera)});
  return view;
}

Status StreamedState::need(DrawLists& lists) {
  if (!lists.pages.empty() || grow(lists)) return {};
  return make_error(Errc::limit_exceeded, Error::kNone, "the memory budget has no room for a view's lists of pages",
                    pool->held() + list_bytes(kFirstDrawn), pool->budget);
}

// Doubles the lists.
bool StreamedState::grow(DrawLists& lists) {
  const std::size_t n = std::max(2 * lists.pages.size(), kFirstDrawn);
  if (!pool->take(list_bytes(n))) return false;
  free(lists);
  lists.bytes = list_bytes(n);
  lists.pages.resize(n);
  if (store->is_on_device()) {
    lists.chunks.reserve(n * file->page_chunks());
  } else {
    lists.parts.reserve(n);
  }
  return true;
}

void StreamedState::offer(StreamView& view, bool can_grow) {
  view.needs_list = false;
  pool->tell(pages::event::Lists{view.id, view.lists.pages, can_grow});
}

void StreamedState::answer_grow(StreamView& view) {
  const bool has_grown = grow(view.lists);
  offer(view, has_grown);
}

// Released first: that is a step, which may fill the lists.
void StreamedState::free(DrawLists& lists) {
  if (lists.bytes > 0) pool->release(lists.bytes);
  lists = DrawLists();
}

StreamStats StreamedState::stats_now() const {
  StreamStats now = stats;
  now.pages_resident = residency().n_resident();
  return now;
}

void StreamedState::count_seen(const StreamView& view) {
  const pages::Cut& cut = pool->scheduler->last_cut(view.id);
  stats.pages_missing = cut.missing;
  stats.detail_reached_px = cut.reached_px;
}

Result<StreamFrame> StreamFrame::begin(std::shared_ptr<StreamedState> state, std::uint64_t renderer,
                                       const Camera& camera, const StreamRule& rule) {
  StreamedState& s = *state;
  StreamTimer timer(StreamStep::frame_lock);
  const std::scoped_lock lock(s.pool->mutex);
  timer.next(StreamStep::frame_cut);
  const auto posted = s.post(renderer, camera, rule);
  if (!posted) return tl::unexpected(posted.error());
  StreamView& view = **posted;
  if (Status there = s.need(view.lists); !there) return tl::unexpected(there.error());
  s.offer(view);
  s.pool->tell(pages::event::Frame{view.id});
  while (view.needs_list) {
    s.answer_grow(view);
    s.pool->tell(pages::event::Frame{view.id});
  }
  StreamFrame frame;
  frame.lists_ = std::exchange(view.lists, {});
  frame.n_pages_ = view.n_drawn;
  frame.cut_ = s.pool->scheduler->last_cut(view.id);
  frame.fitting_ = frame.cut_.gaussians;
  frame.lists_.parts.clear(), frame.lists_.chunks.clear();
  for (const std::uint32_t page : std::span(frame.lists_.pages).first(view.n_drawn)) {
    if (s.store->is_on_device()) {
      s.store->add_chunks(page, frame.lists_.chunks);
    } else {
      frame.lists_.parts.push_back(s.store->part(page));
    }
  }
  s.count_seen(view);
  frame.stats_ = s.stats_now();
  frame.view_ = &view;
  frame.state_ = std::move(state);
  return frame;
}

StreamFrame::~StreamFrame() {
  if (state_ == nullptr) return;
  const std::scoped_lock lock(state_->pool->mutex);
  const auto list = std::span(lists_.pages).first(n_pages_);
  state_->pool->tell(pages::event::FrameEnds{view_->id, list, cut_.gaussians, fitting_});
  // Another frame of the view may have made lists of its own.
  const bool is_longer = view_->lists.pages.size() < lists_.pages.size();
  if (is_longer) std::swap(view_->lists, lists_);
  state_->free(lists_);
  if (is_longer) state_->offer(*view_);
}

void StreamFrame::drawn(std::uint64_t bytes) {
  if (cut_.gaussians == 0) return;  // the camera looks away
  const FrameWorkspace& workspace = slots()->workspace();
  const std::uint64_t free = workspace.bytes() - workspace.held();
  fitting_ += free / 4 * 3 / (bytes / cut_.gaussians + 1);  // not all: buffers grow by more than they need
}

Result<bool> refine_view(StreamedState& s, std::uint64_t renderer, const Camera& camera, const StreamRule& rule,
                         double seconds) {
  constexpr double kLongest = 1e7;
  StreamPoolState& pool = *s.pool;
  const auto wait = std::chrono::duration<double>(std::isnan(seconds) ? 0 : std::clamp(seconds, 0.0, kLongest));
  const pages::Time deadline = pool.now() + std::chrono::duration_cast<pages::Time>(wait);
  std::unique_lock lock(pool.mutex);
  Result<StreamView*> posted = nullptr;
  for (;;) {
    posted = s.post(renderer, camera, rule);
    const Status room = posted ? s.need((*posted)->lists) : Status(tl::unexpected(posted.error()));
    if (room) break;
    if (!pool.wait_for_room(lock, posted ? *posted : nullptr, deadline)) return tl::unexpected(room.error());
    if (pool.now() >= deadline) return false;
  }
  StreamView& view = **posted;
  view.verdict.reset();
  s.offer(view);
  pool.tell(pages::event::Waits{view.id, deadline});
  while (!view.verdict) {
    if (view.needs_list) {
      s.answer_grow(view);
      continue;
    }
    pool.news.wait_until(lock, std::chrono::steady_clock::time_point(deadline),
                         [&] { return view.verdict || view.needs_list; });
    if (!view.verdict && !view.needs_list) pool.tell(pages::event::Tick{});  // time is up
  }
  pool.tell(pages::event::WaitEnds{view.id});
  s.count_seen(view);
  switch (*view.verdict) {
    case pages::action::Verdict::complete: return true;
    case pages::action::Verdict::incomplete: return false;
    case pages::action::Verdict::lost: return tl::unexpected(s.trouble.error());
    case pages::action::Verdict::damaged: return tl::unexpected(s.damage.error());
  }
  return false;
}

}  // namespace rgs::detail
