// residency.cpp - groups of pages change their state.
// SPDX-License-Identifier: Apache-2.0
#include "pages/residency.hpp"

#include <algorithm>
#include <cassert>
#include <limits>

namespace rgs::pages {

float error_px(const lod::Page& page, double footprint) {
  if (page.error <= 0) return 0;
  using Limits = std::numeric_limits<float>;
  const double px = static_cast<double>(page.error) / footprint;
  return static_cast<float>(std::clamp(px, static_cast<double>(Limits::min()), static_cast<double>(Limits::max())));
}

Residency::Residency(const std::vector<lod::Page>& pages)
    : pages_(pages), groups_(pages.size()), occupied_(n_words(n_pages())) {
  extend(0);
}

void Residency::extend(std::uint32_t group) {
  for (; group < n_pages() && pages_[group].n_children > 0 && !groups_[group].is_known; ++group) {
    const lod::Page& last = pages_[pages_[group].first_child + pages_[group].n_children - 1];
    if (last.parent != group) return;
    groups_[group].is_known = true;
  }
}

// As the groups before it are known, so is its parent page.
std::uint32_t Residency::first_unknown() {
  while (first_unknown_ < n_pages() && (pages_[first_unknown_].n_children == 0 || is_known(first_unknown_)))
    ++first_unknown_;
  return first_unknown_ < n_pages() ? first_unknown_ : lod::kNoPage;
}

void Residency::count_below(std::uint32_t group, int n) {
  const std::uint32_t above = group_of(group);
  if (above != kNoGroup) groups_[above].n_below = static_cast<std::uint8_t>(groups_[above].n_below + n);
}

void Residency::set_occupied(std::uint32_t group, bool is_occupied) {
  const std::uint64_t bit = std::uint64_t{1} << (group % 64);
  if (is_occupied) {
    occupied_[group / 64] |= bit;
  } else {
    occupied_[group / 64] &= ~bit;
  }
}

void Residency::request(std::uint32_t group) {
  assert(can_request(group));
  groups_[group].state = State::requested;
  set_occupied(group, true);
  count_below(group, 1);
}

void Residency::drop(std::uint32_t group) {
  assert(state(group) == State::requested || state(group) == State::arrived);
  groups_[group].state = State::absent;
  set_occupied(group, false);
  count_below(group, -1);
}

void Residency::set_damaged(Group& group, bool is_damaged) {
  n_damaged_ = n_damaged_ - group.is_damaged + is_damaged;
  group.is_damaged = is_damaged;
}

void Residency::fail(std::uint32_t group, std::uint32_t time) {
  drop(group);
  Group& g = groups_[group];
  set_damaged(g, false);
  if (g.n_failed < std::numeric_limits<std::uint8_t>::max()) ++g.n_failed;
  g.failed_at = time;
}

void Residency::damage(std::uint32_t group, std::uint32_t time, int most_tries) {
  Group& g = groups_[group];
  const int n_before = g.is_damaged ? g.n_failed : 0;
  fail(group, time);
  g.n_failed = static_cast<std::uint8_t>(n_before + 1);
  set_damaged(g, true);
  g.is_quarantined = g.n_failed >= most_tries;
  n_quarantined_ += g.is_quarantined;
}

void Residency::arrive(std::uint32_t group) {
  assert(state(group) == State::requested && is_parent_in_flight(group));
  groups_[group].state = State::arrived;
  set_damaged(groups_[group], false);
}

void Residency::make_resident(std::uint32_t group) {
  assert((state(group) == State::requested || state(group) == State::arrived) && is_resident(group));
  groups_[group].state = State::resident;
  groups_[group].n_failed = 0;
  set_damaged(groups_[group], false);
  // Not newer than its parent, which is evicted later.
  if (const std::uint32_t above = group_of(group); above != kNoGroup)
    groups_[group].last_used = groups_[above].last_used;
  n_resident_ += pages_[group].n_children;
}

void Residency::evict(std::uint32_t group) {
  assert(can_evict(group));
  if (state(group) == State::resident) n_resident_ -= pages_[group].n_children;
  groups_[group].state = State::absent;
  set_occupied(group, false);
  count_below(group, -1);
}

void Residency::pin(std::span<const std::uint32_t> pages) {
  for (const std::uint32_t page : pages) {
    if (page != 0) ++groups_[group_of(page)].pins;
  }
}

void Residency::unpin(std::span<const std::uint32_t> pages) {
  for (const std::uint32_t page : pages) {
    if (page != 0) --groups_[group_of(page)].pins;
  }
}

float Residency::wanted_px(std::uint32_t group, const Eye& eye) const {
  const lod::Page& page = pages_[group];
  if (!eye.volume.may_show(page.bounds)) return 0;
  const double footprint = lod::footprint(page.core, eye.eye);
  return lod::is_fine_enough(page.error, eye.detail_px, footprint) ? 0 : error_px(page, footprint);
}

}  // namespace rgs::pages
