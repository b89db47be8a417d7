// stream_pool.cpp - room for pages: what is wanted least and longest ago goes first.
// SPDX-License-Identifier: Apache-2.0
#include "stream/stream_pool.hpp"

#include <algorithm>

#include "stream/streamed_state.hpp"

namespace rgs::detail {

// What is below a page is worth less and was used no later: it goes first. So the first that goes can go, always.
bool StreamPoolState::goes_before(const Victim& a, const Victim& b) {
  if (a.worth.now != b.worth.now) return b.worth.now;
  if (a.worth.px != b.worth.px) return a.worth.px < b.worth.px;
  if (a.last_used != b.last_used) return a.last_used < b.last_used;
  return a.group > b.group;
}

StreamPoolState::Room StreamPoolState::look_for_victims(std::uint64_t bytes, const Worth& worth) {
  n_victims_ = 0;
  std::uint64_t could_go = 0, would_go = 0;  // pinned ones and what is above them too
  const auto at = now();
  for (StreamedState* const scene : scenes) {
    scene->look_at_clock(at);
    Worth own;
    scene->residency->for_each_evictable(
        [&](std::uint32_t group) {
          own = scene->worth(group);
          if (!outranks(worth, own)) return false;
          would_go += scene->group_bytes(group);
          return true;
        },
        [&](std::uint32_t group) {
          could_go += scene->group_bytes(group);
          const Victim victim{scene, group, scene->residency->last_used(group), own};
          const auto begin = victims_.begin(), end = begin + static_cast<std::ptrdiff_t>(n_victims_);
          if (n_victims_ < victims_.size()) {
            *end = victim;
            ++n_victims_;
            std::push_heap(begin, end + 1, goes_before);
          } else if (goes_before(victim, *begin)) {
            std::pop_heap(begin, end, goes_before);
            *(end - 1) = victim;
            std::push_heap(begin, end, goes_before);
          }
        });
  }
  std::sort(victims_.begin(), victims_.begin() + static_cast<std::ptrdiff_t>(n_victims_),
            [](const Victim& a, const Victim& b) { return goes_before(b, a); });
  could_go_ = would_go;
  if (could_go >= bytes - left_for_pages()) return Room::taken;
  return would_go >= bytes - left_for_pages() ? Room::pinned : Room::none;
}

StreamPoolState::Room StreamPoolState::take(std::uint64_t bytes, const Worth& worth) {
  if (!is_on_device()) return take_pages(bytes, worth);
  if (bytes > left()) return Room::none;
  held += bytes;
  return Room::taken;
}

StreamPoolState::Room StreamPoolState::take_pages(std::uint64_t bytes, const Worth& worth) {
  could_go_ = pages_budget();
  if (bytes > pages_budget()) return Room::none;
  // Whether those that were found before are enough; frames have moved on since.
  bool is_enough = left_for_pages() >= bytes;
  if (!is_enough) {
    std::uint64_t sum = 0;
    for (std::size_t i = n_victims_; i-- > 0 && sum < bytes - left_for_pages();) {
      Victim& v = victims_[i];
      v.worth = v.scene->worth(v.group);
      if (!v.scene->residency->can_evict(v.group) || !outranks(worth, v.worth)) break;
      sum += v.scene->group_bytes(v.group);
    }
    is_enough = sum >= bytes - left_for_pages();
  }
  while (left_for_pages() < bytes) {
    if (n_victims_ == 0 || !is_enough) {
      if (const Room room = look_for_victims(bytes, worth); room != Room::taken) return room;
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
        "the pool's device memory is of scenes of another SH degree, chunk or page size: a pool of its own");
  }
  auto made = DeviceSlots::create(shape, device_memory);
  if (!made) return made;
  slots = *made;
  slots_budget = (*made)->plan().n_slots * (*made)->plan().slot_bytes();
  slots_held = 0;
  return made;
}

void StreamPoolState::changed() {
  ++changes;
  for (StreamedState* const scene : scenes) scene->work.notify_one();
}

void StreamPoolState::forget(StreamedState* scene) {
  std::erase(scenes, scene);
  n_victims_ = 0;
  changed();
  news.notify_all();
}

}  // namespace rgs::detail
