// residency.hpp - in which state each page of a file is, and which pages a view draws and wants.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstdint>
#include <span>
#include <vector>

#include "pages/events.hpp"
#include "pages/view_volume.hpp"
#include "rgs/footprint.hpp"
#include "rgs/page.hpp"

namespace rgs::pages {

/// What a view's cut depends on.
struct Eye {
  lod::Eye eye;
  ViewVolume volume;
  float detail_px = 0;
};

/// How urgently a group of pages is wanted.
struct Priority {
  bool now = false;  ///< a view wants or draws it or a descendant; otherwise a view is about to
  float px = 0;      ///< projected error of the page that stands for it; 0: no view wants it
};
/// By a tenth, so that groups of like error do not evict each other in turns.
inline bool outranks(const Priority& a, const Priority& b) {
  return a.now != b.now ? a.now : a.px > 1.1F * b.px;
}

/// The pages of a tree in groups. Group `page` is the children of `page`, which are requested and evicted together,
/// since none can be drawn without the others; the root is always resident. Every ancestor of a resident page is
/// resident, so any part of the scene has something to draw. A group may be requested once its parent page is.
class Residency {
 public:
  enum class State : std::uint8_t {
    absent,
    requested,  ///< being read, decoded or placed
    arrived,    ///< placed, but the parent page is not resident yet
    resident,
  };

  /// `pages` has room for all pages and must outlive it. Unknown ones have no Gaussians; a group is known if all its
  /// pages are, and no others are looked at.
  explicit Residency(const std::vector<lod::Page>& pages);
  /// Memory for a tree.
  static std::uint64_t bytes(std::uint32_t n_pages) {
    return n_pages * sizeof(Group) + n_words(n_pages) * sizeof(std::uint64_t);
  }
  /// Call when pages of `group`, and perhaps of groups behind it, have become known.
  void extend(std::uint32_t group);
  /// No more pages will become known: the others are lost.
  void mark_broken() { is_broken_ = true; }
  bool is_broken() const { return is_broken_; }

  std::uint32_t n_pages() const { return static_cast<std::uint32_t>(pages_.size()); }  ///< with the unknown ones
  bool is_known(std::uint32_t group) const { return groups_[group].is_known; }
  /// The first group that is not; lod::kNoPage: none, though pages may be unknown that no other claims.
  std::uint32_t first_unknown();
  /// Calls f(group) for the groups of a known group's pages.
  template <class F>
  void for_each_below(std::uint32_t group, const F& f) const {
    const std::uint32_t end = pages_[group].first_child + pages_[group].n_children;
    for (std::uint32_t child = pages_[group].first_child; child < end; ++child) {
      if (pages_[child].n_children > 0) f(child);
    }
  }
  State state(std::uint32_t group) const { return groups_[group].state; }
  bool is_resident(std::uint32_t page) const { return page == 0 || state(pages_[page].parent) == State::resident; }
  std::uint64_t n_resident() const { return n_resident_; }  ///< pages, with the root
  std::uint32_t last_used(std::uint32_t group) const { return groups_[group].last_used; }

  bool is_parent_in_flight(std::uint32_t group) const {
    if (group == 0) return false;
    const State above = state(group_of(group));
    return above == State::requested || above == State::arrived;
  }
  /// Absent, not quarantined, and its parent page is resident or in flight. Not below a group that has failed and is
  /// retried: it may fail again.
  bool can_request(std::uint32_t group) const {
    if (state(group) != State::absent || groups_[group].is_quarantined) return false;
    return is_resident(group) || (is_parent_in_flight(group) && n_failed(group_of(group)) == 0);
  }

  void request(std::uint32_t group);  ///< absent -> requested; can_request()
  void drop(std::uint32_t group);     ///< requested or arrived -> absent
  void arrive(std::uint32_t group);   ///< requested -> arrived; is_parent_in_flight()
  /// requested or arrived -> resident, last used as its parent, which is resident
  void make_resident(std::uint32_t group);
  void evict(std::uint32_t group);  ///< resident or arrived -> absent; can_evict()

  /// requested -> absent: it could not be read at `time`, of a clock of the caller's.
  void fail(std::uint32_t group, std::uint32_t time);
  /// The same if it is damaged; after `most_tries` in a row it is quarantined.
  void damage(std::uint32_t group, std::uint32_t time, int most_tries);
  bool is_damaged(std::uint32_t group) const { return groups_[group].is_damaged; }
  std::uint32_t n_damaged() const { return n_damaged_; }  ///< groups
  std::uint32_t n_quarantined() const { return n_quarantined_; }
  /// Failed reads in a row, at most 255, and when the last one was.
  int n_failed(std::uint32_t group) const { return groups_[group].n_failed; }
  std::uint32_t failed_at(std::uint32_t group) const { return groups_[group].failed_at; }

  /// Pinned pages stay resident: a frame draws them.
  void pin(std::span<const std::uint32_t> pages);
  void unpin(std::span<const std::uint32_t> pages);
  /// Resident or arrived, not pinned, and no child group requested, arrived or resident.
  bool can_evict(std::uint32_t group) const {
    const Group& g = groups_[group];
    return has_data(g) && g.pins == 0 && g.n_below == 0;
  }

  /// Calls f(group) of all groups that could be evicted one after the other, children first, where may_go(group) allows
  /// it; it is asked of every resident or arrived group.
  template <class MayGo, class F>
  void for_each_evictable(const MayGo& may_go, const F& f);

  /// Calls draw(page) until it returns false, and want(group, px) for groups that can_request(), below groups in flight
  /// too. Pages outside the view are left out. `tick`: the time, for last_used(). `asked_px`: the detail by which
  /// missing pages are counted, at most that of `eye`.
  template <class Draw, class Want>
  Cut cut(const Eye& eye, std::uint32_t tick, const Draw& draw, const Want& want, float asked_px);

  /// Projected error, px, of the group's parent page if the view sees it and it is not fine enough, else 0.
  float wanted_px(std::uint32_t group, const Eye& eye) const;

 private:
  struct Group {
    std::uint32_t last_used = 0;
    std::uint32_t pins = 0;
    std::uint32_t failed_at = 0;  // if n_failed > 0
    std::uint8_t n_failed = 0;
    std::uint8_t n_below = 0;  // child groups that are requested, arrived or resident
    State state = State::absent;
    bool blocked : 1 = false;         // by a descendant, during for_each_evictable()
    bool is_damaged : 1 = false;      // at the last try
    bool is_quarantined : 1 = false;  // damaged too often: never requested again
    bool is_known : 1 = false;
  };
  static constexpr std::uint32_t kNoGroup = lod::kNoPage;
  static bool has_data(const Group& g) { return g.state == State::resident || g.state == State::arrived; }

  /// For an absent group that a view wants with error `px`: calls want(), or descends if the group is in flight. Adds
  /// to cut.in_flight and cut.wanted.
  template <class Want>
  void want_descendants(std::uint32_t group, float px, const Eye& eye, const Want& want, Cut& cut) const;

  std::uint32_t group_of(std::uint32_t page) const { return pages_[page].parent; }  // kNoGroup: of the root
  void count_below(std::uint32_t group, int n);
  void set_damaged(Group& group, bool is_damaged);
  static std::size_t n_words(std::uint32_t n_pages) { return (std::size_t{n_pages} + 63) / 64; }
  void set_occupied(std::uint32_t group, bool is_occupied);

  const std::vector<lod::Page>& pages_;
  std::vector<Group> groups_;            // [n_pages()]; leaves have none
  std::vector<std::uint64_t> occupied_;  // a bit a group: requested, arrived or resident
  std::uint32_t first_unknown_ = 0, n_damaged_ = 0, n_quarantined_ = 0;
  bool is_broken_ = false;
  std::uint64_t n_resident_ = 1;
};

/// Projected error of a page, px; above 0 if its error is.
float error_px(const lod::Page& page, double footprint);

template <class MayGo, class F>
void Residency::for_each_evictable(const MayGo& may_go, const F& f) {
  // Children have larger numbers. Every ancestor of a resident page is resident.
  for (std::size_t w = 0; w < occupied_.size(); ++w) {
    for (std::uint64_t left = occupied_[w]; left != 0; left &= left - 1)
      groups_[64 * w + static_cast<std::size_t>(std::countr_zero(left))].blocked = false;
  }
  for (std::size_t w = occupied_.size(); w-- > 0;) {
    for (std::uint64_t left = occupied_[w]; left != 0;) {
      const int bit = 63 - std::countl_zero(left);
      left &= ~(std::uint64_t{1} << bit);
      const auto i = static_cast<std::uint32_t>(64 * w + static_cast<std::size_t>(bit));
      const Group& g = groups_[i];
      if (has_data(g) && may_go(i) && g.pins == 0 && !g.blocked) {
        f(i);
        continue;
      }
      if (const std::uint32_t above = group_of(i); above != kNoGroup) groups_[above].blocked = true;
    }
  }
}

template <class Want>
void Residency::want_descendants(std::uint32_t group, float px, const Eye& eye, const Want& want, Cut& cut) const {
  if (can_request(group)) {
    want(group, px);
    ++cut.wanted;
  }
  if (state(group) != State::requested && state(group) != State::arrived) return;
  ++cut.in_flight, ++cut.wanted;
  for_each_below(group, [&](std::uint32_t child) {
    if (const float below_px = wanted_px(child, eye); below_px > 0) want_descendants(child, below_px, eye, want, cut);
  });
}

template <class Draw, class Want>
Cut Residency::cut(const Eye& eye, std::uint32_t tick, const Draw& draw, const Want& want, float asked_px) {
  using lod::Walk;
  Cut cut;
  lod::walk_pages(pages_, [&](std::uint32_t i) {
    const lod::Page& page = pages_[i];
    if (!eye.volume.may_show(page.bounds)) return Walk::on;
    const double footprint = lod::footprint(page.core, eye.eye);
    const bool is_fine = page.n_children == 0 || lod::is_fine_enough(page.error, eye.detail_px, footprint);
    if (!is_fine && groups_[i].state == State::resident) {
      groups_[i].last_used = tick;
      return Walk::down;
    }
    cut.fits = draw(i);
    if (!cut.fits) return Walk::end;
    const float px = error_px(page, footprint);
    cut.gaussians += page.count;
    cut.reached_px = static_cast<double>(px) > cut.reached_px ? static_cast<double>(px) : cut.reached_px;
    if (page.n_children > 0 && !lod::is_fine_enough(page.error, asked_px, footprint)) {
      cut.missing += page.n_children;
      if (groups_[i].is_damaged || (is_broken_ && !is_known(i))) cut.damaged += page.n_children;
      if (!is_fine) want_descendants(i, px, eye, want, cut);
    }
    return Walk::on;
  });
  return cut;
}

}  // namespace rgs::pages
