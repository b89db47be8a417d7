// stream_pool.cpp - makes room for pages: evicts the least wanted, and of these the least recently used, first.
// SPDX-License-Identifier: Apache-2.0
#include "stream/stream_pool.hpp"

#include <algorithm>

#include "stream/streamed_state.hpp"

namespace rgs::detail {

// A descendant has a smaller error and was used no later, so it precedes its ancestors: the first victim can always be
// evicted.
bool StreamPoolState::evicts_before(const Victim& a, const Victim& b) {
  if (a.priority.now != b.priority.now) return b.priority.now;
  if (a.priority.px != b.priority.px) return a.priority.px < b.priority.px;
  if (a.last_used != b.last_used) return a.last_used < b.last_used;
  return a.group > b.group;
}

StreamPoolState::Room StreamPoolState::find_victims(std::uint64_t bytes, const Priority& priority) {
  n_victims_ = 0;
  std::uint64_t evictable_bytes = 0, reclaimable_bytes = 0;  // the second with pinned groups and their ancestors
  const auto at = now();
  for (StreamedState* const scene : scenes) {
    scene->update_live_views(at);
    Priority own;
    scene->residency->for_each_evictable(
        [&](std::uint32_t group) {
          own = scene->priority(group);
          if (!outranks(priority, own)) return false;
          reclaimable_bytes += scene->group_bytes(group);
          return true;
        },
        [&](std::uint32_t group) {
          evictable_bytes += scene->group_bytes(group);
          const Victim victim{scene, group, scene->residency->last_used(group), own};
          const auto begin = victims_.begin(), end = begin + static_cast<std::ptrdiff_t>(n_victims_);
          if (n_victims_ < victims_.size()) {
            *end = victim;
            ++n_victims_;
            std::push_heap(begin, end + 1, evicts_before);
          } else if (evicts_before(victim, *begin)) {
            std::pop_heap(begin, end, evicts_before);
            *(end - 1) = victim;
            std::push_heap(begin, end, evicts_before);
          }
        });
  }
  std::sort(victims_.begin(), victims_.begin() + static_cast<std::ptrdiff_t>(n_victims_),
            [](const Victim& a, const Victim& b) { return evicts_before(b, a); });
  reclaimable_bytes_ = reclaimable_bytes;
  if (evictable_bytes >= bytes - left_for_pages()) return Room::taken;
  return reclaimable_bytes >= bytes - left_for_pages() ? Room::pinned : Room::none;
}

StreamPoolState::Room StreamPoolState::take(std::uint64_t bytes, const Priority& priority) {
  if (!is_on_device()) return take_pages(bytes, priority);
  if (bytes > left()) return Room::none;
  held += bytes;
  return Room::taken;
}

StreamPoolState::Room StreamPoolState::take_pages(std::uint64_t bytes, const Priority& priority) {
  reclaimable_bytes_ = pages_budget();
  if (bytes > pages_budget()) return Room::none;
  // The victims found before may still be enough; their priorities may have changed since.
  bool is_enough = left_for_pages() >= bytes;
  if (!is_enough) {
    std::uint64_t sum = 0;
    for (std::size_t i = n_victims_; i-- > 0 && sum < bytes - left_for_pages();) {
      Victim& v = victims_[i];
      v.priority = v.scene->priority(v.group);
      if (!v.scene->residency->can_evict(v.group) || !outranks(priority, v.priority)) break;
      sum += v.scene->group_bytes(v.group);
    }
    is_enough = sum >= bytes - left_for_pages();
  }
  while (left_for_pages() < bytes) {
    if (n_victims_ == 0 || !is_enough) {
      if (const Room room = find_victims(bytes, priority); room != Room::taken) return room;
      is_enough = true;
    }
    const Victim& v = victims_[--n_victims_];
    if (v.scene->residency->can_evict(v.group)) v.scene->evict(v.group);
  }
  (is_on_device() ? slots_held : held) += bytes;
  return Room::taken;
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
  slots_budget = (*made)->plan().n_slots * (*made)->plan().slot_bytes();
  slots_held = 0;
  return made;
}

void StreamPoolState::changed() {
  ++changes;
  if (n_waiting_for_room > 0) news.notify_all();
  for (StreamedState* const scene : scenes) scene->work.notify_one();
}

bool StreamPoolState::wait_for_room(std::unique_lock<std::mutex>& lock, const StreamView* own,
                                    StreamClock::time_point deadline) {
  const std::uint64_t held_before = held;
  const auto at = now();
  bool is_held = false;
  auto until = deadline;
  for (StreamedState* const scene : scenes) {
    scene->update_live_views(at);
    scene->remove_old_views();
    is_held = is_held || scene->n_at_work > 0;
    for (const auto& view : scene->views) {
      const bool is_idle = view->n_busy == 0;
      if (view.get() == own || (is_idle && (view.get() == last_view || view->lists.bytes == 0))) continue;
      is_held = true;
      if (is_idle) until = std::min(until, view->seen + kViewLives);
    }
  }
  if (held < held_before) return true;
  if (!is_held) return false;
  waits_for_pins = lacks_room = true;
  ++n_waiting_for_room;
  news.wait_until(lock, until, [this, seen = changes] { return changes != seen; });
  --n_waiting_for_room;
  return true;
}

void StreamPoolState::forget(StreamedState* scene) {
  std::erase(scenes, scene);
  n_victims_ = 0;
  changed();
  news.notify_all();
}

}  // namespace rgs::detail
