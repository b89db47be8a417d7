// scheduler_reads.cpp - what an idle reader is given, and what comes of it.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <utility>

#include "pages/scheduler.hpp"

namespace rgs::pages {
namespace {

using namespace std::chrono_literals;

constexpr Time kFirstPause = 250ms, kLongestPause = 8s;  // after reads that failed
constexpr Time kLongestWaited = 1s;                      // while a caller waits
constexpr float kSideShare = 0.25F;  // A neighbour joins a read if it has this share of the first group's error.
/// Wants for which victims are searched; each search visits all resident groups.
constexpr int kMostLooks = 8;

}  // namespace

// Doubles with each failure; shorter while a caller waits.
Time Scheduler::pause(const Scene& scene, int n) const {
  if (n <= 0) return Time();
  return std::min<Time>(kFirstPause * (1 << std::min(n - 1, 5)), scene.n_waiting > 0 ? kLongestWaited : kLongestPause);
}

// Wraps after 49 days; an older failure then counts as a new one.
std::uint32_t Scheduler::milliseconds() const {
  return static_cast<std::uint32_t>(std::chrono::duration_cast<std::chrono::milliseconds>(now_).count());
}

int Scheduler::n_failed(const Scene& scene, std::uint32_t group) const {
  return scene.residency->is_known(group) ? scene.residency->n_failed(group) : scene.table.n;
}

Time Scheduler::failed_at(const Scene& scene, std::uint32_t group) const {
  if (!scene.residency->is_known(group)) return scene.table.at;
  return now_ - std::chrono::milliseconds(milliseconds() - scene.residency->failed_at(group));
}

Time Scheduler::put_off_until(const Scene& scene, std::uint32_t group) const {
  const int n = n_failed(scene, group);
  const bool is_final = scene.residency->is_broken() && !scene.residency->is_known(group);
  return n == 0 || is_final ? Time() : failed_at(scene, group) + pause(scene, n);
}

void Scheduler::succeed(Scene& scene) {
  scene.is_suspect = false;
  scene.source = {};
}

void Scheduler::on(const event::Idle& idle) {
  Scene& scene = *scenes_[idle.scene];
  Time later = kNever;
  Claim claim = Claim::nothing;
  if (scene.is_suspect) {
    // Does the whole source fail, or only a range of it?
    if (scene.is_probing) return;
    const Time due = scene.source.n > 0 ? scene.source.at + pause(scene, scene.source.n) : now_;
    if (due > now_) {
      later = due;
    } else {
      scene.is_probing = true;
      actions_.emplace_back(action::Probe{idle.scene});
      claim = Claim::made;
    }
  } else {
    claim = choose(idle.scene, false, later);
    // Prefetch waits while callers wait, and evicts nothing that views want.
    if (claim == Claim::nothing && scene.setup.prefetches && scene.n_waiting == 0)
      claim = choose(idle.scene, true, later);
    // The end of the table completes its hash. Not while pages are read: it would share their bandwidth.
    const auto is_of_scene = [&](const View& view) { return view.scene == idle.scene && view.has_looked; };
    if (claim == Claim::nothing && scene.n_at_work == 0 && std::ranges::any_of(views_, is_of_scene))
      claim = claim_table(idle.scene, scene.residency->first_unknown(), later);
    if (claim == Claim::no_room || claim == Claim::pinned) lacks_room_ = true;
    if (claim == Claim::pinned) waits_for_pins_ = true;
  }
  if (claim == Claim::made) {
    ++scene.n_at_work;
    return;
  }
  if (later == kNever && claim != Claim::pinned) scene.settled_at = changes_;
  // A view that ends leaves room.
  for (ViewId id = 0; id < views_.size() && claim == Claim::no_room; ++id) {
    if (views_[id].scene != kNone && is_live(views_[id], id, now_)) later = std::min(later, lives_until(id));
  }
  if (later != kNever) actions_.emplace_back(action::WakeAt{idle.scene, later});
  judge_all(idle.scene);
}

// The lists of the scene's live views that are out of date. False if there are none.
bool Scheduler::relist(SceneId id, bool ahead) {
  const Scene& scene = *scenes_[id];
  bool is_any = false;
  for (ViewId v = 0; v < views_.size(); ++v) {
    View& view = views_[v];
    if (view.scene != id || !view.has_looked || (ahead && !view.ahead) || !is_live(view, v, now_)) continue;
    WantList& list = ahead ? view.prefetch : view.wants;
    // Prefetch costs as much as choosing what is drawn: new ones, and what did not fit into the list.
    const bool is_due = ahead ? list.made_of == 0 || (list.is_cut_off && list.wants.empty())
                              : list.made_of != scene.generation || now_ >= list.due ||
                                    (list.is_cut_off && list.wants.size() < kMostWants);
    if (!is_due) continue;
    if (ahead) {
      list_prefetch(view);
    } else {
      cut(v, false);
    }
    is_any = true;
  }
  return is_any;
}

// Claims the group of largest error that fits, and its neighbours in the file.
Scheduler::Claim Scheduler::choose(SceneId id, bool ahead, Time& later) {
  const auto list_of = [ahead](View& view) -> WantList& { return ahead ? view.prefetch : view.wants; };
  Claim refused = Claim::nothing;
  std::uint64_t reclaimable_bytes = budget_;  // an upper bound for the next want
  int looks = 0;
  for (View& view : views_) list_of(view).next = 0;
  for (bool is_fresh = false;;) {
    View* best = nullptr;
    for (ViewId v = 0; v < views_.size(); ++v) {
      View& view = views_[v];
      if (view.scene != id || (ahead && !view.ahead) || !is_live(view, v, now_)) continue;
      const WantList& list = list_of(view);
      if (list.next == list.wants.size()) continue;
      if (best == nullptr || list.wants[list.next].px > list_of(*best).wants[list_of(*best).next].px) best = &view;
    }
    if (best == nullptr) {
      if (std::exchange(is_fresh, true) || !relist(id, ahead)) break;
      for (View& view : views_) list_of(view).next = 0;
      refused = Claim::nothing, looks = 0, reclaimable_bytes = budget_;
      continue;
    }
    WantList& list = list_of(*best);
    const std::uint32_t group = list.wants[list.next].group;
    const Residency& residency = *scenes_[id]->residency;
    if (!residency.can_request(group)) {
      list.wants.erase(list.wants.begin() + static_cast<std::ptrdiff_t>(list.next));
      continue;
    }
    ++list.next;
    const Priority own = priority(id, group);
    if (own.px <= 0) continue;
    if (const Time due = put_off_until(*scenes_[id], group); due > now_) {
      later = std::min(later, due);
      continue;
    }
    if (residency.is_known(group)) {
      const std::uint64_t n = group_bytes(id, group);
      if (left() < n && (n > left() + reclaimable_bytes || ++looks > kMostLooks)) {
        if (refused == Claim::nothing) refused = Claim::no_room;
        continue;
      }
    }
    const Claim claimed = claim(id, group, own, later);
    if (claimed == Claim::made) return claimed;
    if (claimed == Claim::nothing) continue;
    if (refused != Claim::pinned) refused = claimed;
    reclaimable_bytes = std::min(reclaimable_bytes, reclaimable_bytes_);
  }
  for (ViewId v = 0; v < views_.size() && !ahead; ++v) {
    if (views_[v].scene == id && is_live(views_[v], v, now_)) later = std::min(later, views_[v].wants.due);
  }
  return refused;
}

// Claims an absent group if there is room for it.
Scheduler::Claim Scheduler::claim(SceneId id, std::uint32_t group, const Priority& own, Time& later) {
  Scene& scene = *scenes_[id];
  if (!scene.residency->is_known(group)) return claim_table(id, group, later);
  const Room room = take(group_bytes(id, group), own);
  if (room != Room::taken) return room == Room::pinned ? Claim::pinned : Claim::no_room;
  request(id, group);
  std::uint32_t first = group, n = 1;
  extend(id, own, first, n);
  actions_.emplace_back(action::Read{id, first, n});
  return Claim::made;
}

Scheduler::Claim Scheduler::claim_table(SceneId id, std::uint32_t group, Time& later) {
  Scene& scene = *scenes_[id];
  if (scene.is_extending || scene.is_verified || scene.residency->is_broken()) return Claim::nothing;
  if (const Time due = scene.table.n > 0 ? scene.table.at + pause(scene, scene.table.n) : Time(); due > now_) {
    later = std::min(later, due);
    return Claim::nothing;
  }
  scene.is_extending = true;
  actions_.emplace_back(action::ReadTable{id, group});
  return Claim::made;
}

void Scheduler::request(SceneId id, std::uint32_t group) {
  Residency& residency = *scenes_[id]->residency;
  residency.request(group);
  for (View& view : views_) {
    if (view.scene != id || !view.has_looked) continue;
    view.n_in_flight += residency.wanted_px(group, view.now) > 0;
    // Its child groups can be requested now.
    residency.for_each_below(group, [&](std::uint32_t child) {
      if (!residency.can_request(child) || put_off_until(*scenes_[id], child) > now_) return;
      if (const float px = residency.wanted_px(child, view.now); px > 0) view.wants.insert(child, px);
      if (!view.ahead) return;
      if (const float px = residency.wanted_px(child, *view.ahead); px > 0) view.prefetch.insert(child, px);
    });
  }
}

// How many wanted groups a read may take, so that idle readers get their share.
std::uint32_t Scheduler::share(SceneId id, bool now) const {
  const Scene& scene = *scenes_[id];
  std::size_t n = 1;  // the one that is requested already
  for (const View& view : views_) {
    if (view.scene == id) n += (now ? view.wants : view.prefetch).wants.size();
  }
  const std::size_t n_idle = std::max(scene.setup.n_readers, scene.n_at_work + 1) - scene.n_at_work;
  return static_cast<std::uint32_t>(std::min<std::size_t>((n + n_idle - 1) / n_idle, kMostGroups));
}

// Groups of neighbouring pages are neighbours in the file.
void Scheduler::extend(SceneId id, const Priority& best, std::uint32_t& first, std::uint32_t& n) {
  const Scene& scene = *scenes_[id];
  const Residency& residency = *scene.residency;
  const std::vector<lod::Page>& pages = *scene.setup.pages;
  const auto begin_of = [&](std::uint32_t group) { return scene.setup.stored[pages[group].first_child].offset; };
  const auto end_of = [&](std::uint32_t group) {
    const StoredPage& last = scene.setup.stored[pages[group].first_child + pages[group].n_children - 1];
    return last.offset + last.stored_bytes;
  };
  const std::uint32_t most_groups = share(id, best.now);
  const auto takes = [&](std::uint32_t group, std::uint64_t begin, std::uint64_t end, std::uint64_t gap) {
    if (n == most_groups || end - begin > scene.setup.most_bytes || gap > scene.setup.gap_bytes) return false;
    if (!residency.can_request(group) || residency.n_failed(group) > 0) return false;
    const Priority own = priority(id, group);
    if (own.now != best.now || own.px <= 0 || own.px < kSideShare * best.px) return false;
    if (take(group_bytes(id, group), own) != Room::taken) return false;
    request(id, group);
    ++n;
    return true;
  };
  if (residency.n_failed(first) > 0) return;  // a neighbour may be the unreadable part
  std::uint64_t begin = begin_of(first), end = end_of(first);
  for (std::uint32_t next = first + 1; residency.is_known(next); ++next) {  // the last page has no group
    if (!takes(next, begin, end_of(next), begin_of(next) - end)) break;
    end = end_of(next);
  }
  while (first > 0 && residency.is_known(first - 1)) {
    const std::uint32_t before = first - 1;
    // The search for room for one neighbour may have evicted those on the other side.
    if (!takes(before, begin_of(before), end, begin - end_of(before))) break;
    begin = begin_of(before);
    first = before;
  }
}

void Scheduler::on(const event::Done& done) {
  Scene& scene = *scenes_[done.scene];
  --scene.n_at_work;
}

void Scheduler::on(const event::Arrived& arrived) {
  Scene& scene = *scenes_[arrived.scene];
  succeed(scene);
  if (scene.residency->is_resident(arrived.group)) {
    became_resident(arrived.scene, arrived.group);
  } else if (scene.residency->is_parent_in_flight(arrived.group)) {
    scene.residency->arrive(arrived.group);
  } else {
    drop(arrived.scene, arrived.group);
  }
  // A resident group can be evicted for another, and a dropped one has left room.
  if (std::exchange(lacks_room_, false)) changed();
  for (View& view : views_) {
    if (view.scene == arrived.scene && view.is_waiting && view.n_in_flight == 0) view.must_judge = true;
  }
}

void Scheduler::on(const event::Failed& failed) {
  Scene& scene = *scenes_[failed.scene];
  const std::uint32_t now = milliseconds();
  for (std::uint32_t group = failed.first; group < failed.first + failed.n; ++group) {
    cancel(failed.scene, group, false);
    if (failed.fault == event::Fault::lost) {
      scene.residency->fail(group, now);
    } else {
      scene.residency->damage(group, now, failed.fault == event::Fault::checksum ? kMostTries : 1);
    }
    drop_below(failed.scene, group);
  }
  if (failed.fault == event::Fault::lost) scene.is_suspect = true;
  ++scene.generation;
  changed();
  judge_all(failed.scene);
}

void Scheduler::on(const event::TableGrew& grew) {
  Scene& scene = *scenes_[grew.scene];
  scene.is_extending = scene.is_table_damaged = false;
  if (std::exchange(scene.table, {}).n > 0) ++scene.generation;  // wants that paused
  scene.is_verified = grew.is_verified;
  scene.residency->extend(grew.group);
  succeed(scene);
  changed();
  judge_all(grew.scene);
}

void Scheduler::on(const event::TableFailed& failed) {
  Scene& scene = *scenes_[failed.scene];
  scene.is_extending = false;
  const bool is_damaged = failed.fault != event::Fault::lost;
  if (std::exchange(scene.is_table_damaged, is_damaged) != is_damaged) scene.table.n = 0;
  scene.table = {scene.table.n + 1, now_};
  if (!is_damaged) scene.is_suspect = true;
  if (is_damaged && scene.table.n == kMostTries) scene.residency->mark_broken();
  ++scene.generation;
  changed();
  judge_all(failed.scene);
}

void Scheduler::on(const event::Probed& probed) {
  Scene& scene = *scenes_[probed.scene];
  scene.is_probing = false;
  if (probed.is_there) {
    succeed(scene);
  } else if (scene.is_suspect) {
    scene.source = {scene.source.n + 1, now_};
  }
  changed();
  judge_all(probed.scene);
}

}  // namespace rgs::pages
