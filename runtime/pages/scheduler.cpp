// scheduler.cpp - setup, steps, and what views draw, want and wait for.
// SPDX-License-Identifier: Apache-2.0
#include "pages/scheduler.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "pages/motion.hpp"

namespace rgs::pages {
namespace {

constexpr double kAheadSeconds = 0.5;                          // of the camera's motion
constexpr Time kMotionLasts = std::chrono::milliseconds(500);  // frames farther apart say nothing of motion
/// Prefetch runs every sixth frame, because it costs as much as choosing the pages.
constexpr int kPrefetchFrames = 6;
constexpr std::size_t kMostActions = 1024;  // of a step

bool is_same(const Eye& a, const Eye& b) {
  return a.eye.position == b.eye.position && a.eye.focal_px == b.eye.focal_px && a.eye.z_near == b.eye.z_near &&
         a.volume == b.volume;
}

Eye eye_of(const Look& look) {
  return {look.eye, ViewVolume(look.view, look.low_pass), look.detail_px};
}

double diagonal(const Box& box) {
  const auto side = [&](std::size_t k) { return static_cast<double>(box.max[k]) - static_cast<double>(box.min[k]); };
  return std::sqrt(side(0) * side(0) + side(1) * side(1) + side(2) * side(2));
}

}  // namespace

Scheduler::Scheduler(std::uint64_t budget) : budget_(budget) {
  actions_.reserve(kMostActions);
}

SceneId Scheduler::add_scene(const SceneSetup& setup) {
  auto scene = std::make_unique<Scene>();
  scene->setup = setup;
  scene->residency.emplace(*setup.pages);
  scene->is_verified = setup.is_verified;
  const auto free = std::ranges::find_if(scenes_, [](const auto& one) { return one == nullptr; });
  const auto id = static_cast<SceneId>(free - scenes_.begin());
  if (free == scenes_.end()) {
    scenes_.push_back(std::move(scene));
  } else {
    *free = std::move(scene);
  }
  return id;
}

void Scheduler::remove_scene(SceneId id) {
  for (ViewId view = 0; view < views_.size(); ++view) {
    if (views_[view].scene == id) remove_view(view);
  }
  const Residency& residency = *scenes_[id]->residency;
  for (std::uint32_t group = 0; group < residency.n_pages(); ++group) {
    if (residency.state(group) != Residency::State::absent) held_ -= group_bytes(id, group);
  }
  scenes_[id].reset();
  n_victims_ = 0;
  ++changes_;
}

ViewId Scheduler::add_view(SceneId scene) {
  const auto free = std::ranges::find(views_, kNone, &View::scene);
  const auto id = static_cast<ViewId>(free - views_.begin());
  View& view = free == views_.end() ? views_.emplace_back() : *free;
  view = View();
  view.wants.wants.reserve(kMostWants);
  view.prefetch.wants.reserve(kMostWants);
  view.scene = scene;
  return id;
}

void Scheduler::remove_view(ViewId view) {
  views_[view] = View();
  if (last_view_ == view) last_view_ = kNone;
}

std::span<const Action> Scheduler::step(std::span<const Event> events, Time now) {
  now_ = now;
  actions_.clear();
  for (const Event& event : events) std::visit([this](const auto& one) { on(one); }, event);
  for (ViewId id = 0; id < views_.size(); ++id) {
    View& view = views_[id];
    if (view.is_waiting && (std::exchange(view.must_judge, false) || now_ >= view.deadline)) judge(id);
  }
  if (std::exchange(has_changed_, false)) actions_.emplace_back(action::Wake{});
  return actions_;
}

void Scheduler::changed() {
  ++changes_;
  has_changed_ = true;
}

bool Scheduler::is_live(const View& view, ViewId id, Time now) const {
  return view.n_busy > 0 || id == last_view_ || (view.has_looked && now - view.seen < kViewLives);
}

Time Scheduler::lives_until(ViewId view) const {
  return is_busy(view) || view == last_view_ ? kNever : views_[view].seen + kViewLives;
}

void Scheduler::judge_all(SceneId scene) {
  for (View& view : views_) view.must_judge = view.must_judge || (view.scene == scene && view.is_waiting);
}

bool Scheduler::is_before(const Want& a, const Want& b) {
  return a.px != b.px ? a.px > b.px : a.group < b.group;
}

void Scheduler::WantList::clear(std::uint64_t generation) {
  wants.clear();
  made_of = generation;
  is_cut_off = false;
  due = kNever;
}

void Scheduler::WantList::add(std::uint32_t group, float px) {
  if (wants.size() < kMostWants) {
    wants.push_back({px, group});
    return;
  }
  if (!std::exchange(is_cut_off, true)) std::ranges::make_heap(wants, is_before);
  if (!is_before({px, group}, wants.front())) return;
  std::ranges::pop_heap(wants, is_before);
  wants.back() = {px, group};
  std::ranges::push_heap(wants, is_before);
}

void Scheduler::WantList::order() {
  if (!is_cut_off) std::ranges::make_heap(wants, is_before);
  std::ranges::sort_heap(wants, is_before);
}

void Scheduler::WantList::insert(std::uint32_t group, float px) {
  if (wants.size() == kMostWants) {
    is_cut_off = true;
    if (!is_before({px, group}, wants.back())) return;
    wants.pop_back();
  }
  wants.insert(std::ranges::upper_bound(wants, Want{px, group}, is_before), {px, group});
}

void Scheduler::on(const event::Looks& looks) {
  View& view = views_[looks.view];
  const Scene& scene = scene_of(view);
  Eye eye = eye_of(looks.look);
  bool is_new = !view.has_looked || !is_live(view, looks.view, now_);
  const bool had_ahead = view.ahead.has_value();
  if (view.has_looked && (!is_same(view.now, eye) || view.asked_px != eye.detail_px)) {
    const Time since = now_ - view.came;
    view.ahead.reset();
    if (scene.setup.prefetches && since > Time() && since < kMotionLasts) {
      const double times = kAheadSeconds / std::chrono::duration<double>(since).count();
      view.ahead = eye_of(moved_on(view.look, looks.look, times, diagonal(scene.setup.pages->front().bounds)));
    }
    view.is_refined = false;
    is_new = true;
  } else if (view.has_looked && !view.is_refined) {
    view.ahead.reset();  // the camera stands still
  }
  is_new = is_new || view.look.most_gaussians != looks.look.most_gaussians;
  if (!view.is_refined) view.came = now_;
  view.is_refined = false;
  view.look = looks.look;
  view.asked_px = eye.detail_px;
  // Near what fitted last.
  if (view.has_looked && view.most_gaussians != kNoLimit)
    eye.detail_px = std::max(eye.detail_px, view.now.detail_px / lod::kDetailStep);
  view.now = eye;
  view.seen = now_;
  view.has_looked = true;
  if (!had_ahead || !view.ahead || ++view.frames_since_prefetch >= kPrefetchFrames)
    view.prefetch.made_of = 0, view.frames_since_prefetch = 0;
  last_view_ = looks.view;
  if (is_new) changed();
}

void Scheduler::on(const event::Lists& lists) {
  View& view = views_[lists.view];
  view.list = lists.pages;
  view.can_grow = lists.can_grow;
  view.must_judge = view.is_waiting;
}

void Scheduler::on(const event::Frame& frame) {
  View& view = views_[frame.view];
  if (!cut(frame.view, true)) return;
  const auto n = static_cast<std::uint32_t>(view.n_listed);
  scene_of(view).residency->pin(view.list.first(n));
  view.list = {};
  ++view.n_busy;
  actions_.emplace_back(action::Draw{frame.view, n});
}

void Scheduler::on(const event::FrameEnds& ends) {
  View& view = views_[ends.view];
  scene_of(view).residency->unpin(ends.pages);
  const bool fits = ends.fitting >= ends.gaussians;
  view.most_gaussians = fits && !view.is_guess ? std::max(view.most_gaussians, ends.fitting) : ends.fitting;
  view.is_guess = !fits;
  view.seen = now_;
  --view.n_busy;
  if (std::exchange(waits_for_pins_, false)) changed();
}

void Scheduler::on(const event::Waits& waits) {
  View& view = views_[waits.view];
  view.now.detail_px = view.asked_px;
  view.is_refined = true;
  view.is_waiting = view.must_judge = true;
  view.waits_since = now_, view.deadline = waits.deadline;
  ++view.n_busy, ++scene_of(view).n_waiting;
  changed();  // pauses are shorter now
}

void Scheduler::on(const event::WaitEnds& ends) {
  View& view = views_[ends.view];
  view.is_waiting = false;
  view.seen = now_;
  --view.n_busy;
  if (--scene_of(view).n_waiting == 0) changed();  // prefetch has waited
}

// Fills the view's list of wants and, if asked, the list that a frame draws. False if that list is to grow first.
bool Scheduler::cut(ViewId id, bool fills_list) {
  View& view = views_[id];
  Scene& scene = scene_of(view);
  const bool has_list = fills_list && !view.list.empty();
  lod::DetailChoice allowed{.detail_px = view.asked_px};
  if (view.look.most_gaussians != kNoLimit) {
    const std::vector<lod::Page>& pages = *scene.setup.pages;
    allowed = lod::finest_detail_of(
        pages, view.look.eye, view.asked_px, view.look.most_gaussians,
        [&](std::uint32_t page) { return pages[page].n_children > 0 && scene.residency->is_known(page); });
    view.now.detail_px = std::max(view.now.detail_px, allowed.detail_px);
  }
  for (;;) {
    ++tick_;
    view.wants.clear(scene.generation);
    view.n_failed = view.n_lasting = 0;
    std::uint64_t gaussians = 0;
    std::size_t n = 0;
    bool is_full = false;
    const std::uint64_t most_gaussians = std::min(view.most_gaussians, view.look.most_gaussians);
    const auto draw = [&](std::uint32_t page) {
      gaussians += (*scene.setup.pages)[page].count;
      if (n > 0 && gaussians > most_gaussians) return false;
      is_full = has_list && n == view.list.size();
      if (is_full) return false;
      if (has_list) view.list[n] = page;
      ++n;
      return true;
    };
    const auto want = [&](std::uint32_t group, float px) {
      if (const Time due = put_off_until(scene, group); due > now_) {
        view.wants.due = std::min(view.wants.due, due);
      } else {
        view.wants.add(group, px);
      }
      const bool is_known = scene.residency->is_known(group);
      if (is_known ? scene.residency->is_damaged(group) : scene.is_table_damaged) return;
      const int n_failures = n_failed(scene, group);
      if (n_failures > 0) ++view.n_failed;
      if (n_failures >= kLastingFailures && failed_at(scene, group) >= view.waits_since) ++view.n_lasting;
    };
    view.cut = scene.residency->cut(view.now, tick_, draw, want, allowed.detail_px);
    view.cut.detail_px = view.now.detail_px;
    view.cut.allowed_gaussians = allowed.gaussians;
    if (view.cut.fits) {
      view.wants.order();
      view.n_in_flight = view.cut.in_flight;
      if (view.ahead) view.ahead->detail_px = view.now.detail_px;
      view.n_listed = has_list ? n : 0;
      return true;
    }
    if (is_full && view.can_grow) {
      view.wants.made_of = 0;  // it has a part of them
      actions_.emplace_back(action::Grow{id});
      return false;
    }
    view.now.detail_px = lod::coarser(view.now.detail_px);
  }
}

void Scheduler::list_prefetch(View& view) {
  Scene& scene = scene_of(view);
  view.prefetch.clear(scene.generation);
  scene.residency->cut(
      *view.ahead, tick_, [](std::uint32_t) { return true; },
      [&](std::uint32_t group, float px) {
        if (put_off_until(scene, group) <= now_) view.prefetch.add(group, px);
      },
      view.ahead->detail_px);
  view.prefetch.order();
}

void Scheduler::judge(ViewId id) {
  View& view = views_[id];
  Scene& scene = scene_of(view);
  // With its list, so that the next frame needs no more memory.
  if (!cut(id, true)) return;
  const auto [missing, damaged] = std::pair(view.cut.missing, view.cut.damaged);
  const auto decided = [&](action::Verdict verdict) { actions_.emplace_back(action::Refined{id, verdict}); };
  // Complete only once the table's hash is verified.
  if (missing == 0 && scene.is_verified) return decided(action::Verdict::complete);
  if (missing == 0 && scene.residency->is_broken()) return decided(action::Verdict::damaged);
  const bool needs_table = missing == 0;
  const bool is_late = now_ >= view.deadline, is_settled = this->is_settled(scene);
  const bool is_table_lost = scene.table.n > 0 && !scene.is_table_damaged;
  const auto is_lasting = [&](const Outage& outage) {
    return outage.n >= kLastingFailures && outage.at >= view.waits_since;
  };
  bool is_lost = is_late && (view.n_failed > 0 || scene.is_suspect || (needs_table && is_table_lost));
  is_lost = is_lost || is_lasting(scene.source) || (needs_table && is_table_lost && is_lasting(scene.table));
  is_lost = is_lost || (view.n_lasting > 0 && view.wants.wants.empty() && view.n_in_flight == 0);
  if (is_lost && (needs_table || missing > damaged)) return decided(action::Verdict::lost);
  if (damaged > 0 && (is_settled || is_late || is_lost)) return decided(action::Verdict::damaged);
  if (is_settled || is_late) return decided(action::Verdict::incomplete);
}

Scheduler::Priority Scheduler::priority(SceneId id, std::uint32_t group) const {
  const Residency& residency = *scenes_[id]->residency;
  const auto most = [&](bool ahead) {
    float px = 0;
    for (ViewId v = 0; v < views_.size(); ++v) {
      const View& view = views_[v];
      if (view.scene != id || !view.has_looked || (ahead && !view.ahead) || !is_live(view, v, now_)) continue;
      px = std::max(px, residency.wanted_px(group, ahead ? *view.ahead : view.now));
    }
    return px;
  };
  if (const float px = most(false); px > 0) return {true, px};
  return {false, most(true)};
}

// By a tenth, so that groups of like error do not evict each other in turns.
bool Scheduler::outranks(const Priority& a, const Priority& b) {
  return a.now != b.now ? a.now : a.px > 1.1F * b.px;
}

bool Scheduler::is_damaged(SceneId id) const {
  const Scene& scene = *scenes_[id];
  return scene.residency->n_damaged() > 0 || scene.is_table_damaged;
}

}  // namespace rgs::pages
