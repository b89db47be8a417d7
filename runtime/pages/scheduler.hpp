// scheduler.hpp - decides the life of every page: which ones views draw, which are read, kept and evicted.
//
// No input or output, threads, locks, clocks, allocation after setup, or CUDA: events in, actions out. Drivers (threads
// over files and web servers, a browser's workers, a test's world) carry the actions out. docs/develop/PAGES.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "pages/events.hpp"
#include "pages/residency.hpp"
#include "rgs/page.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::pages {

inline constexpr Time kViewLives = std::chrono::seconds(1);  ///< after its last frame or wait
inline constexpr int kMostTries = 6;                         ///< of damaged bytes, in a row
inline constexpr int kLastingFailures = 3;                   ///< in a row: a waiting caller is told
inline constexpr std::size_t kMostWants = 1024;              ///< of a view
inline constexpr std::uint32_t kMostGroups = 64;             ///< of a read

/// A scene's tree and how it is read. What it points to outlives the scene.
struct SceneSetup {
  const std::vector<lod::Page>* pages = nullptr;  ///< unknown ones, which TableGrew makes known, have no Gaussians
  const StoredPage* stored = nullptr;             ///< of each page
  bool is_verified = false;                       ///< the table is complete
  std::uint64_t page_bytes = 0, row_bytes = 0;    ///< memory of a page: page_bytes + row_bytes a Gaussian
  std::uint32_t n_readers = 1;
  std::uint64_t most_bytes = 1, gap_bytes = 0;  ///< of one read: ByteSource::Traits
  bool prefetches = true;
};

/// Scenes that share a budget of memory, and the views of them.
class Scheduler {
 public:
  /// `budget`: bytes of pages, and of whatever Take takes.
  explicit Scheduler(std::uint64_t budget);

  // Setup, which allocates. Numbers of scenes and views that are removed are used again.

  /// The root's memory must be taken (Take), and the root be placed.
  SceneId add_scene(const SceneSetup& setup);
  /// Nothing is in flight. Releases the memory of all its pages but the root; its views go with it.
  void remove_scene(SceneId scene);
  ViewId add_view(SceneId scene);
  void remove_view(ViewId view);
  /// Host memory of a scene of so many pages, of a view.
  static std::uint64_t scene_bytes(std::uint32_t n_pages) { return sizeof(Scene) + Residency::bytes(n_pages); }
  static std::uint64_t view_bytes() { return sizeof(View) + 2 * kMostWants * sizeof(Want); }

  /// The actions are valid until the next call.
  std::span<const Action> step(std::span<const Event> events, Time now);
  std::span<const Action> step(const Event& event, Time now) { return step(std::span(&event, 1), now); }

  std::uint64_t budget() const { return budget_; }
  std::uint64_t held() const { return held_; }
  std::uint64_t left() const { return budget_ - held_; }
  const Residency& residency(SceneId scene) const { return *scenes_[scene]->residency; }
  std::uint64_t group_bytes(SceneId scene, std::uint32_t group) const { return group_bytes(*scenes_[scene], group); }
  /// The table or a page of it is damaged.
  bool is_damaged(SceneId scene) const;
  /// Some reader of the scene is at work.
  bool is_reading(SceneId scene) const { return scenes_[scene]->n_at_work > 0; }
  /// Nothing is read, and nothing that is wanted can be.
  bool is_at_rest(SceneId scene) const { return is_settled(*scenes_[scene]); }
  /// Used by frames or callers, used in the last second, or the last one used of all: keep it.
  bool is_live(ViewId view, Time now) const { return is_live(views_[view], view, now); }
  /// When it is not live any more by time alone; kNever: not before something ends.
  Time lives_until(ViewId view) const;
  bool is_busy(ViewId view) const { return views_[view].n_busy > 0; }
  /// What the view's last frame drew, or its last wait saw.
  const Cut& last_cut(ViewId view) const { return views_[view].cut; }
  /// Where the view's camera is about to be.
  const std::optional<Eye>& ahead(ViewId view) const { return views_[view].ahead; }
  const Eye& eye(ViewId view) const { return views_[view].now; }

 private:
  /// How urgently a group of pages is wanted.
  struct Priority {
    bool now = false;  // a view wants or draws it or a descendant; otherwise a view is about to
    float px = 0;      // projected error of the page that stands for it; 0: no view wants it
  };
  static constexpr Priority kNeeded{true, 3e38F};  // what cannot be done without
  static bool outranks(const Priority& a, const Priority& b);

  struct Want {
    float px;
    std::uint32_t group;
  };
  static bool is_before(const Want& a, const Want& b);
  /// Groups that an eye wants and that can be requested, the largest projected error first, at most kMostWants. Those
  /// that pause after a failure are left out until the first of the pauses is over.
  struct WantList {
    std::vector<Want> wants;
    std::uint64_t made_of = 0;  // Scene::generation; 0: of nothing
    bool is_cut_off = false;    // there were more
    Time due = kNever;          // the end of a pause
    std::size_t next = 0;       // during a choice
    void clear(std::uint64_t generation);
    void add(std::uint32_t group, float px);  // then order()
    void order();
    void insert(std::uint32_t group, float px);
  };

  struct View {
    SceneId scene = kNone;
    Look look;
    bool has_looked = false;
    Time came{}, seen{};       // when that camera last came; the last frame or wait
    bool is_refined = false;   // a wait had that camera, and no frame since: both count once
    Eye now;                   // its detail is coarser than asked for if that does not fit
    std::optional<Eye> ahead;  // where the camera is about to be
    float asked_px = 0;
    std::uint64_t most_gaussians = kNoLimit;  // that fit the renderer's memory, as it seems
    bool is_guess = false;                    // no frame has fitted since one did not
    WantList wants, prefetch;
    int frames_since_prefetch = 0;
    std::uint64_t n_in_flight = 0;              // groups that it wants
    std::uint64_t n_failed = 0, n_lasting = 0;  // of its wants at the last cut
    Cut cut;
    std::span<std::uint32_t> list;  // of the next frame
    std::size_t n_listed = 0;
    bool can_grow = false;
    int n_busy = 0;  // frames and waits
    bool is_waiting = false, must_judge = false;
    Time waits_since{}, deadline{};
  };

  /// Failures in a row.
  struct Outage {
    int n = 0;
    Time at{};
  };
  struct Scene {
    SceneSetup setup;
    std::optional<Residency> residency;
    std::uint64_t generation = 1;  // counts what makes further groups wantable
    Outage source, table;
    bool is_verified = false;
    bool is_table_damaged = false;  // at its last read
    bool is_suspect = false;        // a read has failed, and none succeeded since
    bool is_probing = false, is_extending = false;
    std::uint32_t n_at_work = 0, n_waiting = 0;
    std::uint64_t settled_at = 0;  // changes_ when its readers last found nothing to do
  };
  struct Victim {
    SceneId scene;
    std::uint32_t group;
    std::uint32_t last_used;
    Priority priority;
  };
  enum class Room : std::uint8_t { taken, none, pinned /* it fits once frames have ended */ };
  enum class Claim : std::uint8_t { made, nothing, no_room, pinned };
  static constexpr std::uint32_t kNone = ~0U;

  void on(const event::Looks& looks);
  void on(const event::Lists& lists);
  void on(const event::Frame& frame);
  void on(const event::FrameEnds& ends);
  void on(const event::Waits& waits);
  void on(const event::WaitEnds& ends);
  void on(const event::Idle& idle);
  void on(const event::Done& done);
  void on(const event::Arrived& arrived);
  void on(const event::Failed& failed);
  void on(const event::TableGrew& grew);
  void on(const event::TableFailed& failed);
  void on(const event::Probed& probed);
  void on(const event::Tick&) {}
  void on(const event::Take& take);
  void on(const event::Release& release);

  Scene& scene_of(const View& view) { return *scenes_[view.scene]; }
  template <class F>
  void for_each_live_view(SceneId scene, const F& f);
  bool is_live(const View& view, ViewId id, Time now) const;
  void changed();
  void judge_all(SceneId scene);

  // What views draw and want.
  bool cut(ViewId view, bool fills_list);
  void list_prefetch(View& view);
  void judge(ViewId view);
  bool is_settled(const Scene& scene) const { return scene.settled_at >= changes_ && scene.n_at_work == 0; }
  Priority priority(SceneId scene, std::uint32_t group) const;

  // Failures.
  Time pause(const Scene& scene, int n) const;
  // Of a group, or of the table that does not know it yet: failures in a row, the last one, and until when it is not
  // requested.
  int n_failed(const Scene& scene, std::uint32_t group) const;
  Time failed_at(const Scene& scene, std::uint32_t group) const;
  Time put_off_until(const Scene& scene, std::uint32_t group) const;
  std::uint32_t milliseconds() const;
  void succeed(Scene& scene);

  // What is read.
  Claim choose(SceneId id, bool ahead, Time& later);
  bool relist(SceneId id, bool ahead);
  Claim claim(SceneId id, std::uint32_t group, const Priority& own, Time& later);
  Claim claim_table(SceneId id, std::uint32_t group, Time& later);
  void extend(SceneId id, const Priority& best, std::uint32_t& first, std::uint32_t& n);
  std::uint32_t share(SceneId id, bool now) const;
  void request(SceneId id, std::uint32_t group);

  // What leaves.
  static std::uint64_t group_bytes(const Scene& scene, std::uint32_t group);
  void leave_flight(SceneId id, std::uint32_t group);
  void became_resident(SceneId id, std::uint32_t group);
  void cancel(SceneId id, std::uint32_t group, bool was_placed);
  void drop(SceneId id, std::uint32_t group);
  void drop_below(SceneId id, std::uint32_t group);
  void evict(const Victim& victim);
  Room take(std::uint64_t bytes, const Priority& priority);
  Room find_victims(std::uint64_t bytes, const Priority& priority);
  static bool evicts_before(const Victim& a, const Victim& b);

  std::uint64_t budget_, held_ = 0;
  std::vector<std::unique_ptr<Scene>> scenes_;  // null: removed
  std::vector<View> views_;                     // of no scene: removed
  std::vector<Action> actions_;
  Time now_{};
  std::uint64_t changes_ = 1;  // counts whatever may make a page wanted, or make room for one
  bool has_changed_ = false;
  std::uint32_t tick_ = 0;             // of cuts
  ViewId last_view_ = kNone;           // last used, of all scenes
  bool waits_for_pins_ = false;        // a request would fit if no frame pinned pages
  bool lacks_room_ = false;            // a request did not fit at the last try
  std::array<Victim, 256> victims_{};  // the first to evict comes last
  std::size_t n_victims_ = 0;
  std::uint64_t reclaimable_bytes_ = 0;  // that the last take() without success could have evicted, pinned or not
};

}  // namespace rgs::pages
