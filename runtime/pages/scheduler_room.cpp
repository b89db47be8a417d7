// scheduler_room.cpp - makes room for pages: the least wanted leave, and of these the least recently used, first.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <utility>

#include "pages/scheduler.hpp"

namespace rgs::pages {
namespace {

constexpr std::size_t kSpareActions = 256;  // of a step: those that nothing else limits

}  // namespace

std::uint64_t Scheduler::group_bytes(const Scene& scene, std::uint32_t group) {
  const std::vector<lod::Page>& pages = *scene.setup.pages;
  const lod::Page& above = pages[group];
  std::uint64_t rows = 0;
  for (std::uint32_t k = 0; k < above.n_children; ++k) rows += pages[above.first_child + k].count;
  return above.n_children * scene.setup.page_bytes + rows * scene.setup.row_bytes;
}

void Scheduler::leave_flight(SceneId id, std::uint32_t group) {
  for (View& view : views_) {
    // The last cut may have missed a group whose box is at the view's edge.
    if (view.scene != id || view.n_in_flight == 0) continue;
    if (scenes_[id]->residency->wanted_px(group, view.now) > 0) --view.n_in_flight;
  }
}

void Scheduler::became_resident(SceneId id, std::uint32_t group) {
  Scene& scene = *scenes_[id];
  leave_flight(id, group);
  if (scene.residency->n_failed(group) > 0) {  // its child groups were not requested while it failed
    ++scene.generation;
    changed();
  }
  scene.residency->make_resident(group);
  scene.residency->for_each_below(group, [&](std::uint32_t child) {
    if (scene.residency->state(child) == Residency::State::arrived) became_resident(id, child);
  });
}

// Ends its flight and releases its memory.
void Scheduler::cancel(SceneId id, std::uint32_t group, bool was_placed) {
  leave_flight(id, group);
  held_ -= group_bytes(id, group);
  actions_.emplace_back(action::Evict{id, group, was_placed});
}

void Scheduler::drop(SceneId id, std::uint32_t group) {
  cancel(id, group, true);
  scenes_[id]->residency->drop(group);
  ++scenes_[id]->generation;
  drop_below(id, group);
}

// Groups still in flight are dropped when they arrive; those that a step has no room to name can be evicted.
void Scheduler::drop_below(SceneId id, std::uint32_t group) {
  const Scene& scene = *scenes_[id];
  scene.residency->for_each_below(group, [&](std::uint32_t child) {
    if (actions_.capacity() - actions_.size() < kSpareActions) return;
    if (scene.residency->state(child) == Residency::State::arrived) drop(id, child);
  });
}

void Scheduler::evict(const Victim& victim) {
  Scene& scene = *scenes_[victim.scene];
  if (scene.residency->state(victim.group) == Residency::State::arrived) leave_flight(victim.scene, victim.group);
  scene.residency->evict(victim.group);
  held_ -= group_bytes(victim.scene, victim.group);
  actions_.emplace_back(action::Evict{victim.scene, victim.group, true});
  drop_below(victim.scene, victim.group);
  if (victim.priority.px > 0) ++scene.generation;  // some view wants it all the same
  changed();
}

// A descendant has a smaller error and was used no later, so it precedes its ancestors: the first victim can always be
// evicted.
bool Scheduler::evicts_before(const Victim& a, const Victim& b) {
  if (a.priority.now != b.priority.now) return b.priority.now;
  if (a.priority.px != b.priority.px) return a.priority.px < b.priority.px;
  if (a.last_used != b.last_used) return a.last_used < b.last_used;
  return a.scene != b.scene ? a.scene < b.scene : a.group > b.group;
}

Scheduler::Room Scheduler::find_victims(std::uint64_t bytes, const Priority& asking) {
  n_victims_ = 0;
  std::uint64_t evictable_bytes = 0, reclaimable_bytes = 0;  // the second with pinned groups and their ancestors
  for (SceneId id = 0; id < scenes_.size(); ++id) {
    if (scenes_[id] == nullptr) continue;
    Residency& residency = *scenes_[id]->residency;
    Priority own;
    residency.for_each_evictable(
        [&](std::uint32_t group) {
          own = priority(id, group);
          if (!outranks(asking, own)) return false;
          reclaimable_bytes += group_bytes(id, group);
          return true;
        },
        [&](std::uint32_t group) {
          evictable_bytes += group_bytes(id, group);
          const Victim victim{id, group, residency.last_used(group), own};
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
  // The first to leave comes last.
  const auto begin = victims_.begin(), end = begin + static_cast<std::ptrdiff_t>(n_victims_);
  std::sort_heap(begin, end, evicts_before);
  std::reverse(begin, end);
  reclaimable_bytes_ = reclaimable_bytes;
  if (evictable_bytes >= bytes - left()) return Room::taken;
  return reclaimable_bytes >= bytes - left() ? Room::pinned : Room::none;
}

// Takes memory; groups of lower priority leave if that makes enough room.
Scheduler::Room Scheduler::take(std::uint64_t bytes, const Priority& asking) {
  reclaimable_bytes_ = budget_;
  if (bytes > budget_) return Room::none;
  // The victims found before may still be enough; their priorities may have changed since.
  bool is_enough = left() >= bytes;
  if (!is_enough) {
    std::uint64_t sum = 0;
    for (std::size_t i = n_victims_; i-- > 0 && sum < bytes - left();) {
      Victim& v = victims_[i];
      v.priority = priority(v.scene, v.group);
      if (!scenes_[v.scene]->residency->can_evict(v.group) || !outranks(asking, v.priority)) break;
      sum += group_bytes(v.scene, v.group);
    }
    is_enough = sum >= bytes - left();
  }
  while (left() < bytes) {
    if (actions_.capacity() - actions_.size() < kSpareActions) return Room::none;
    if (n_victims_ == 0 || !is_enough) {
      if (const Room room = find_victims(bytes, asking); room != Room::taken) return room;
      is_enough = true;
    }
    const Victim& v = victims_[--n_victims_];
    if (scenes_[v.scene]->residency->can_evict(v.group)) evict(v);
  }
  held_ += bytes;
  return Room::taken;
}

void Scheduler::on(const event::Take& asked) {
  const bool is_taken = take(asked.bytes, kNeeded) == Room::taken;
  if (!is_taken) lacks_room_ = waits_for_pins_ = true;
  actions_.emplace_back(action::Taken{is_taken});
}

void Scheduler::on(const event::Release& released) {
  held_ -= released.bytes;
  if (std::exchange(lacks_room_, false)) changed();
}

}  // namespace rgs::pages
