// stream_pool.cpp - carries out a scheduler's actions, but for those of readers.
// SPDX-License-Identifier: Apache-2.0
#include "stream/stream_pool.hpp"

#include <algorithm>
#include <chrono>

#include "stream/streamed_state.hpp"

namespace rgs::detail {

StreamPoolState::StreamPoolState(std::uint64_t bytes, std::uint64_t device_bytes, std::uint64_t workspace_bytes)
    : budget(bytes),
      device_memory(device_bytes),
      workspace_memory(workspace_bytes),
      now([] { return std::chrono::duration_cast<pages::Time>(std::chrono::steady_clock::now().time_since_epoch()); }) {
  if (!is_on_device()) scheduler.emplace(budget);
}

StreamedState& StreamPoolState::scene_of(pages::SceneId id) const {
  return **std::ranges::find_if(scenes, [id](const StreamedState* scene) { return scene->id == id; });
}

StreamView* StreamPoolState::view_of(pages::ViewId id) const {
  for (const StreamedState* scene : scenes) {
    const auto found = std::ranges::find_if(scene->views, [id](const auto& view) { return view->id == id; });
    if (found != scene->views.end()) return found->get();
  }
  return nullptr;
}

std::optional<pages::Action> StreamPoolState::tell(const pages::Event& event) {
  using namespace pages::action;
  std::optional<pages::Action> rest;
  for (const pages::Action& action : scheduler->step(event, now())) {
    if (const auto* evict = std::get_if<Evict>(&action)) {
      scene_of(evict->scene).free_pages(*evict);
    } else if (const auto* draw = std::get_if<Draw>(&action)) {
      view_of(draw->view)->n_drawn = draw->n;
    } else if (const auto* grow = std::get_if<Grow>(&action)) {
      view_of(grow->view)->needs_list = true;
      news.notify_all();
    } else if (const auto* refined = std::get_if<Refined>(&action)) {
      view_of(refined->view)->verdict = refined->verdict;
      news.notify_all();
    } else if (std::holds_alternative<Wake>(action)) {
      wake();
    } else {
      if (const auto* read = std::get_if<Read>(&action)) scene_of(read->scene).reserve_pages(*read);
      rest = action;
    }
  }
  return rest;
}

bool StreamPoolState::take_for_pages(std::uint64_t bytes) {
  // A step evicts so many pages.
  for (std::uint64_t before = ~std::uint64_t{0}; scheduler->held() < before;) {
    before = scheduler->held();
    if (std::get<pages::action::Taken>(*tell(pages::event::Take{bytes})).is_taken) return true;
  }
  return false;
}

bool StreamPoolState::take(std::uint64_t bytes) {
  if (!is_on_device()) return take_for_pages(bytes);
  if (bytes > left()) return false;
  held_beside += bytes;
  return true;
}

void StreamPoolState::release(std::uint64_t bytes) {
  if (is_on_device()) {
    held_beside -= bytes;
  } else {
    tell(pages::event::Release{bytes});
  }
}

Result<std::shared_ptr<DeviceSlots>> StreamPoolState::slots_of(const SlotShape& shape) {
  if (auto there = slots.lock()) {
    if (there->plan().shape == shape) return there;
    return make_error(
        Errc::bad_argument, Error::kNone,
        "the pool's scenes have another SH degree, chunk size or page size: open this scene in a pool of its own");
  }
  auto made = DeviceSlots::create(shape, device_memory - workspace_memory, workspace_memory);
  if (!made) {
    Error error = made.error();
    if (error.code == Errc::limit_exceeded) error.expected += workspace_memory, error.found = device_memory;
    return tl::unexpected(error);
  }
  slots = *made;
  scheduler.emplace((*made)->plan().n_slots * (*made)->plan().slot_bytes());
  return made;
}

void StreamPoolState::wake() {
  ++n_wakes;
  if (n_waiting_for_room > 0) news.notify_all();
  for (StreamedState* const scene : scenes) scene->work.notify_one();
}

bool StreamPoolState::wait_for_room(std::unique_lock<std::mutex>& lock, const StreamView* own, pages::Time deadline) {
  const std::uint64_t held_before = held();
  bool is_held = false;
  pages::Time until = deadline;
  for (StreamedState* const scene : scenes) {
    scene->remove_old_views();
    is_held = is_held || scheduler->is_reading(scene->id);
    for (const auto& view : scene->views) {
      const bool is_busy = scheduler->is_busy(view->id);
      const pages::Time end = scheduler->lives_until(view->id);
      if (view.get() == own || (!is_busy && (end == pages::kNever || view->lists.bytes == 0))) continue;
      is_held = true;
      until = std::min(until, end);
    }
  }
  if (held() < held_before) return true;
  if (!is_held) return false;
  ++n_waiting_for_room;
  news.wait_until(lock, std::chrono::steady_clock::time_point(until),
                  [this, seen = n_wakes] { return n_wakes != seen; });
  --n_waiting_for_room;
  return true;
}

}  // namespace rgs::detail
