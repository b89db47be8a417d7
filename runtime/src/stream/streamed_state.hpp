// streamed_state.hpp - a streamed scene: its tables, its residency, the views that want pages, the threads that read
// them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <span>
#include <thread>
#include <vector>

#include "cpu/reference_renderer.hpp"
#include "render_options.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/camera.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/streamed_scene.hpp"
#include "stream/page_reader.hpp"
#include "stream/page_store.hpp"
#include "stream/residency.hpp"
#include "stream/stream_pool.hpp"

namespace rgs::detail {

/// Groups that a view wants and that can be requested, largest projected error first (StreamedState::rank()), at most
/// kMost. Whoever changes what can be requested updates the lists (StreamedState::want(), forget_want()), so that they
/// are never rebuilt by a scan.
class WantList {
 public:
  struct Want {
    float rank;
    std::uint32_t group;
  };
  static constexpr std::size_t kMost = 1024;

  WantList() { wants_.reserve(kMost); }
  /// Then any number of add(), then order().
  void clear() { wants_.clear(), is_cut_off_ = false; }
  void add(std::uint32_t group, float rank);
  void order();
  /// Unless it is listed with that rank.
  void insert(std::uint32_t group, float rank);
  /// If it is listed with that rank.
  void erase(std::uint32_t group, float rank);
  void erase_at(std::size_t i) { wants_.erase(wants_.begin() + static_cast<std::ptrdiff_t>(i)); }
  /// Ranks delayed groups again: the pause of some may be over.
  template <class Rank>
  void rank_put_off(const Rank& rank);
  std::span<const Want> wants() const { return wants_; }
  /// There were more than kMost.
  bool is_cut_off() const { return is_cut_off_; }

 private:
  std::vector<Want>::iterator find(const Want& want);  // end() if not listed

  std::vector<Want> wants_;
  bool is_cut_off_ = false;
};

template <class Rank>
void WantList::rank_put_off(const Rank& rank) {
  bool is_raised = false;
  for (auto want = wants_.rbegin(); want != wants_.rend() && want->rank < 0; ++want) {
    const float now = rank(want->group);
    if (now > 0) want->rank = now, is_raised = true;
  }
  if (is_raised) order();
}

/// What a renderer draws of a scene, for any camera.
struct StreamRule {
  FrameSettings settings;
  Origin origin = kNoOrigin;
  float z_near = 0;  ///< as the scene declares
  float detail_px = 0;

  StreamEye eye(const Camera& camera) const {
    return {eye_of(camera, origin, z_near), ViewVolume(make_view(camera, origin, settings), settings.low_pass),
            detail_px};
  }
};

/// What a frame draws. Owned by the view between frames, by the frame meanwhile.
struct DrawLists {
  std::vector<std::uint32_t> pages;
  std::vector<ScenePart> parts;       ///< on the host
  std::vector<std::uint32_t> chunks;  ///< on a device
  std::uint64_t bytes = 0;            ///< taken from the pool
};

/// Failed reads in a row. One outage fails all reads in flight and counts once: reads that began before the last
/// counted failure belong to it.
struct Failures {
  int n = 0;
  std::uint64_t last = 0;  ///< StreamedState::n_failed at the last one

  bool add(std::uint64_t begun, std::uint64_t n_failed) {
    if (begun < last) return false;
    last = n_failed;
    ++n;
    return true;
  }
};

/// A renderer's view of a scene.
struct StreamView {
  std::uint64_t renderer = 0;
  Camera camera;
  StreamClock::time_point came;    ///< when that camera last came; a refine() and the frame after it count once
  StreamClock::time_point seen;    ///< its last frame or wait
  bool is_refined = false;         ///< refine() had that camera, and no frame since
  std::optional<StreamEye> now;    ///< its detail is coarser than asked for if that does not fit
  std::optional<StreamEye> ahead;  ///< where the camera is about to be
  float asked_px = 0;              ///< detail
  /// That a frame may draw, because more did not fit the workspace.
  std::uint64_t most_gaussians = std::numeric_limits<std::uint64_t>::max();
  WantList wants, prefetch_wants;
  std::uint64_t n_in_flight = 0;     ///< groups that it wants
  bool prefetch_is_current = false;  ///< prefetch_wants fit `ahead`, or that of a few frames ago
  int frames_since_prefetch = 0;
  std::size_t next_want = 0;  ///< into either list, during a choice
  int n_busy = 0;             ///< frames and waiting callers
  bool is_live = true;        ///< counts: see StreamedState::update_live_views()
  DrawLists lists;            ///< empty during a frame
  bool has_run_out = false;   ///< of time, the last refine(): the next one of that camera goes on with it
  Failures failures;          ///< of reads that it wants; reset when it starts to wait or a group arrives
  bool is_lasting = false;    ///< the last of them failed too often, or the source did
  Status trouble;             ///< the last of them
  std::uint64_t bytes = 0;    ///< taken from the pool, without lists

  /// No group is in flight or can be requested.
  bool has_nothing_pending() const { return wants.wants().empty() && n_in_flight == 0; }
};

struct StreamedState {
  StreamedState() = default;
  ~StreamedState();
  StreamedState(const StreamedState&) = delete;
  StreamedState& operator=(const StreamedState&) = delete;

  // Set by open(), then constant.
  std::shared_ptr<StreamPoolState> pool;
  std::unique_ptr<ByteSource> source;
  std::optional<PagedFile> file;  // its table grows under both `table` and pool->mutex, locked in this order
  TableMutex table;
  std::optional<Declarations> declarations;
  SceneBounds subject;
  bool prefetches = true;
  bool has_root = false;  // its memory is taken
  ByteSource::Traits traits;

  // Guarded by pool->mutex.
  std::optional<Residency> residency;
  std::uint64_t bytes = 0;  // taken from the pool, without pages and views
  std::vector<std::unique_ptr<StreamView>> views;
  StreamStats stats;
  std::condition_variable work;   // wakes reading threads: pool->changes or n_requested grew
  std::uint64_t n_requested = 0;  // groups ever requested; each lets its child groups be requested
  Status damage, trouble;         // the last of a page or the table; of reading: while it lasts
  Failures failures;
  std::uint64_t n_failed = 0;  // reads that ever failed
  StreamClock::time_point failed_at{};
  int n_unreachable = 0;                          // latest of `failures` in which not even `readable` could be read
  FileRange readable;                             // bytes that were read before
  int n_table_failures = 0, n_table_damages = 0;  // of the table, in a row
  StreamClock::time_point table_failed_at{};
  int n_at_work = 0;          // reading threads that are busy
  int n_waiting = 0;          // callers that wait for a view
  bool is_extending = false;  // a thread reads more of the table
  bool is_stopping = false;
  /// pool->changes when the threads last found nothing to do.
  std::uint64_t settled_at = 0;

  // Pages of a requested group belong to the thread that reads them; resident pages are constant.
  std::optional<PageStore> store;
  std::vector<std::unique_ptr<PageReader>> readers;  // one a thread
  std::vector<std::thread> threads;

  /// Errors: as of StreamedScene::open().
  static Result<std::shared_ptr<StreamedState>> open(std::unique_ptr<ByteSource> source, const StreamOptions& options,
                                                     std::shared_ptr<StreamPoolState> pool);
  Status read_tables(const DecodeLimits& limits);
  Status make_room_for_pages();
  Status read_root();
  Status start_threads();
  /// Takes memory for the scene's life. Errors: limit_exceeded; Error::expected: the budget needed.
  Status take(std::uint64_t n);

  std::uint64_t least_view_bytes() const;

  // With the lock.
  std::uint64_t group_bytes(std::uint32_t group) const;  // memory of its pages
  std::uint64_t list_bytes(std::size_t n_pages) const;
  void requested(std::uint32_t group);   // its memory is taken
  void free_pages(std::uint32_t group);  // of pages that are not drawn
  void want(std::uint32_t group);        // adds a group that can be requested to the views' lists
  void forget_want(std::uint32_t group);
  void want_below(std::uint32_t group);
  void leave_flight(std::uint32_t group);
  void cancel(std::uint32_t group);  // ends its flight and frees its pages
  Priority priority(std::uint32_t group) const;
  void evict(std::uint32_t group);
  void count_evicted(std::uint32_t group);
  /// Live views are those with frames at work, those of the last second, and the pool's last one.
  void update_live_views(StreamClock::time_point now);
  void remove_old_views();
  /// Sets the camera of the renderer's view. Errors: limit_exceeded.
  Result<StreamView*> post(std::uint64_t renderer, const Camera& camera, const StreamRule& rule);
  bool grow(DrawLists& lists);
  Status need(DrawLists& lists);  // makes the first lists. Errors: limit_exceeded
  void free(DrawLists& lists);
  /// Computes the view's cut: fills its lists of wants, and `lists` with pages unless null.
  Residency::Cut cut(StreamView& view, DrawLists* lists);
  StreamStats stats_now() const;
  Status status() const { return residency->n_damaged() > 0 || n_table_damages > 0 ? damage : trouble; }

  // For reading threads. With the lock, but fetch(), extend_table(), fail() and work_until_stopped().
  struct Run {
    std::uint32_t first = 0, n = 0;                                  // neighbouring groups
    std::uint64_t table_bytes = 0;                                   // Choice::table
    StreamClock::time_point later = StreamClock::time_point::max();  // when the first delayed one is due
  };
  enum class Choice : std::uint8_t {
    run,
    table,    // read more of it first
    nothing,  // nothing is wanted
    no_room,  // for what is wanted
    pinned,   // pages of frames at work are in the way
    later,    // reads failed; retry later
  };
  Choice choose(Run& run);
  Choice choose_among(bool now, Run& run);
  Choice choose_elsewhere(Run& run);
  void find_wants(bool now);
  Choice claim(std::uint32_t group, const Priority& own, Run& run);
  Choice claim_table(std::uint64_t n, Run& run);
  void extend(Run& run, const Priority& best);
  std::uint32_t share(bool now) const;
  bool has_wants() const;
  void arrived(std::uint32_t group);          // decoded: becomes resident, or waits for its parent
  void became_resident(std::uint32_t group);  // its parent is resident
  void drop(std::uint32_t group);             // decoded in vain
  void drop_below(std::uint32_t group);       // cancels descendants of a group that will not arrive
  void fetch(PageReader& reader, const Run& run, std::uint64_t begun);
  void extend_table(PageReader& reader, std::uint64_t n, std::uint64_t begun);
  /// Without the lock. `failed`: no groups mean the table. `n_times`: its failures, this one included. `begun`:
  /// n_failed when the read began.
  void fail(PageReader& reader, const Status& read, const Run& failed, int n_times, std::uint64_t begun);
  static constexpr int kLastingTrouble = 3;
  static constexpr int kMostTries = 6;  ///< of damaged bytes, in a row
  void succeed();
  /// What is left of the pause after n failures, the last one `since` ago.
  StreamClock::duration pause_left(int n, StreamClock::duration since) const;
  /// How long a failed group is not requested.
  StreamClock::duration put_off_for(std::uint32_t group) const;
  bool is_put_off(std::uint32_t group, Run& run) const;  ///< then notes it in run.later
  /// A want's rank: its projected error; if delayed negative, behind all others.
  float rank(std::uint32_t group, float px) const;
  static float put_off_rank(float px) { return -1 / px; }
  bool can_extend() const;  ///< the table
  void work_until_stopped(PageReader& reader);
};

/// What a frame draws; pinned until it is destroyed.
class StreamFrame {
 public:
  /// Errors: limit_exceeded (the pool has no room for the lists of a view).
  static Result<StreamFrame> begin(std::shared_ptr<StreamedState> state, std::uint64_t renderer, const Camera& camera,
                                   const StreamRule& rule);
  StreamFrame(StreamFrame&& other) noexcept = default;
  StreamFrame& operator=(StreamFrame&&) = delete;
  ~StreamFrame();

  std::size_t n_pages() const { return lists_.pages.size(); }
  std::span<const ScenePart> parts() const { return lists_.parts; }        ///< on the host
  std::span<const std::uint32_t> chunks() const { return lists_.chunks; }  ///< on a device, of slots()
  const DeviceSlots* slots() const { return state_->store->slots().get(); }
  const Residency::Cut& cut() const { return cut_; }
  const StreamStats& stats() const { return stats_; }
  /// Call once it is drawn or did not fit the workspace: the view's next frame has fewer Gaussians, or more if there
  /// is room.
  void drawn(bool fits) const;

 private:
  StreamFrame() = default;
  std::shared_ptr<StreamedState> state_;  // null after a move
  StreamView* view_ = nullptr;
  DrawLists lists_;  // its pages are pinned
  Residency::Cut cut_;
  StreamStats stats_;
};

/// Waits until the view is complete: true. Errors: those that keep it from completing.
Result<bool> refine_view(StreamedState& state, std::uint64_t renderer, const Camera& camera, const StreamRule& rule,
                         double seconds);

}  // namespace rgs::detail
