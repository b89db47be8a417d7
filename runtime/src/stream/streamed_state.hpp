// streamed_state.hpp - a streamed scene: its tables, the pages that are there, the views that want more, the threads that read it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
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

/// Groups that a view misses and that are open, most projected error first (StreamedState::rank()); of very many the first. Whoever
/// changes what is open changes the lists (StreamedState::want(), forget_want()): nobody has to go through them.
class WantList {
 public:
  struct Want {
    float rank;
    std::uint32_t group;
  };
  static constexpr std::size_t kMost = 1024;

  WantList() { wants_.reserve(kMost); }
  /// Any number of add(), then order().
  void clear() { wants_.clear(), is_cut_off_ = false; }
  void add(std::uint32_t group, float rank);
  void order();
  /// One more, unless it is there with that rank.
  void insert(std::uint32_t group, float rank);
  /// One less, if it is there with that rank.
  void erase(std::uint32_t group, float rank);
  void erase_at(std::size_t i) { wants_.erase(wants_.begin() + static_cast<std::ptrdiff_t>(i)); }
  /// rank(group) of those that were put off: for some the pause may be over.
  template <class Rank>
  void rank_put_off(const Rank& rank);
  std::span<const Want> wants() const { return wants_; }
  /// There were more.
  bool is_cut_off() const { return is_cut_off_; }

 private:
  std::vector<Want>::iterator find(const Want& want);  // end: it is not there

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

/// What a renderer draws of a scene, wherever its camera is.
struct StreamRule {
  FrameSettings settings;
  Origin origin = kNoOrigin;
  float z_near = 0;  ///< as the scene declares it
  float detail_px = 0;

  StreamEye eye(const Camera& camera) const {
    return {eye_of(camera, origin, z_near), ViewVolume(make_view(camera, origin, settings), settings.low_pass),
            detail_px};
  }
};

/// What a frame draws. Of the view between frames, of the frame while it is at work.
struct DrawLists {
  std::vector<std::uint32_t> pages;
  std::vector<ScenePart> parts;       ///< on the host
  std::vector<std::uint32_t> chunks;  ///< on a device
  std::uint64_t bytes = 0;            ///< taken from the pool
};

/// Reads that failed, one after the other. One outage ends all reads at work, and is one failure: those that began before the last one
/// that counts are part of it.
struct Failures {
  int n = 0;
  std::uint64_t last = 0;  ///< StreamedState::n_failed then

  bool add(std::uint64_t begun, std::uint64_t n_failed) {
    if (begun < last) return false;
    last = n_failed;
    ++n;
    return true;
  }
};

/// What one renderer sees of a scene.
struct StreamView {
  std::uint64_t renderer = 0;
  Camera camera;
  StreamClock::time_point
      came;  ///< when that camera was last asked for, a refine() and the frame that follows being one
  StreamClock::time_point seen;  ///< when that was, or ended
  bool is_refined = false;       ///< that camera has come with a refine(), and no frame since
  std::optional<StreamEye> now;
  std::optional<StreamEye> soon;  ///< where the camera is about to be
  WantList wants, soon_wants;
  std::uint64_t n_coming = 0;  ///< groups that it wants and are on their way; never more than there are
  bool is_soon_known = false;  ///< soon_wants are those of `soon`, or of one a few frames ago
  int soon_frames = 0;         ///< since they were
  std::size_t next_want = 0;   ///< of either list, while one is chosen
  int n_busy = 0;              ///< frames at work, and callers that wait
  bool is_live = true;         ///< counts: see StreamedState::look_at_clock()
  DrawLists lists;             ///< empty while a frame has them
  Failures failures;           ///< of reads of what it wants, since it is waited for and something of it has come
  bool is_lasting = false;     ///< what failed last of them has done so often, or the source
  Status trouble;              ///< the last of them
  std::uint64_t bytes = 0;     ///< taken from the pool, but for lists

  /// Nothing of what it wants is on its way or can be asked for.
  bool has_come() const { return wants.wants().empty() && n_coming == 0; }
};

struct StreamedState {
  StreamedState() = default;
  ~StreamedState();
  StreamedState(const StreamedState&) = delete;
  StreamedState& operator=(const StreamedState&) = delete;

  // Set by open(), then constant.
  std::shared_ptr<StreamPoolState> pool;
  std::unique_ptr<ByteSource> source;
  std::optional<PagedFile> file;  // more of its table comes with both `table` and pool->mutex, locked in this order
  TableMutex table;
  std::optional<Declarations> declarations;
  bool prefetches = true;
  bool has_root = false;  // its room is taken
  ByteSource::Traits traits;

  // Of pool->mutex.
  std::optional<Residency> residency;
  std::uint64_t bytes = 0;  // taken from the pool, but for pages and views
  std::vector<std::unique_ptr<StreamView>> views;
  StreamStats stats;
  std::condition_variable work;   // for threads that read: `pool->changes` or n_requested grew
  std::uint64_t n_requested = 0;  // groups, all that ever were: each opens what is below it
  Status damage, trouble;         // of a page; of reading, while it lasts
  Failures failures;
  std::uint64_t n_failed = 0;  // reads, all that ever did
  StreamClock::time_point failed_at{};
  int n_away = 0;            // of `failures` the last, where not even `readable` could be read
  FileRange readable;        // bytes that were there once
  int n_table_failures = 0;  // of the table, one after the other
  StreamClock::time_point table_failed_at{};
  int n_at_work = 0;          // threads that read or decode
  int n_waiting = 0;          // callers that wait for a view
  bool is_extending = false;  // a thread reads more of the table
  bool is_stopping = false;
  /// Value of pool->changes when the threads last found nothing that they could do.
  std::uint64_t settled_at = 0;

  // Pages of requested groups are of the thread that reads them, those of resident ones constant.
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
  /// Takes memory that is kept as long as the scene. Errors: limit_exceeded, with what the pool would have to hold.
  Status take(std::uint64_t n);

  /// What the first frame of a view takes.
  std::uint64_t least_view_bytes() const;

  // With the lock.
  std::uint64_t group_bytes(std::uint32_t group) const;  // room that its pages take
  std::uint64_t list_bytes(std::size_t n_pages) const;
  void requested(std::uint32_t group);  // its room is taken
  void give_room(std::uint32_t group);  // of pages that are not drawn
  void want(std::uint32_t group);       // is open: in the lists of views that want it
  void forget_want(std::uint32_t group);
  void want_below(std::uint32_t group);
  void no_longer_coming(std::uint32_t group);
  void give_up(std::uint32_t group);  // on its way until now, and its room others'
  Worth worth(std::uint32_t group) const;
  void evict(std::uint32_t group);  // and gives its memory back
  void count_evicted(std::uint32_t group);
  /// Views that count are those of frames at work and of the last second, and the pool's last.
  void look_at_clock(StreamClock::time_point now);
  void forget_old_views();
  /// The renderer's view, of this camera from now on. Errors: limit_exceeded.
  Result<StreamView*> post(std::uint64_t renderer, const Camera& camera, const StreamRule& rule);
  bool grow(DrawLists& lists);
  Status need(DrawLists& lists);  // room for some. Errors: limit_exceeded
  void free(DrawLists& lists);
  /// What the view draws; fills its lists of wants, and `lists` with pages unless null.
  Residency::Cut cut(StreamView& view, DrawLists* lists);
  StreamStats stats_now() const;
  Status status() const { return damage ? trouble : damage; }

  // Threads that read. All but fetch(), extend_table(), fail() and work_until_stopped() with the lock.
  struct Run {
    std::uint32_t first = 0, n = 0;                                  // groups, one after the other
    std::uint64_t table_bytes = 0;                                   // Choice::table
    StreamClock::time_point later = StreamClock::time_point::max();  // when what was put off is due
  };
  enum class Choice : std::uint8_t {
    run,
    table,    // more of it has to be read
    nothing,  // is missing
    no_room,  // for what is missing
    pinned,   // is what would give it room
    later,    // reading failed; nothing else can be done
  };
  Choice choose(Run& run);
  Choice choose_among(bool now, Run& run);
  Choice choose_elsewhere(Run& run);
  void find_wants(bool now);
  Choice claim(std::uint32_t group, const Worth& own, Run& run);
  Choice claim_table(std::uint64_t n, Run& run);
  void extend(Run& run, const Worth& best);
  std::uint32_t share(bool now) const;
  bool has_wants() const;
  void arrived(std::uint32_t group);     // all of it is there: draws it, or waits for the page above
  void placed(std::uint32_t group);      // the page above is there, too
  void drop(std::uint32_t group);        // all of it is there, in vain
  void drop_below(std::uint32_t group);  // does not come: nor does what waits for it
  void fetch(PageReader& reader, const Run& run, std::uint64_t begun);
  void extend_table(PageReader& reader, std::uint64_t n, std::uint64_t begun);
  /// Without the lock. `failed`: of the table if it has no groups; `n_times`: that it has failed, this one too; `begun`: n_failed when
  /// it began to be read.
  void fail(PageReader& reader, const Status& read, const Run& failed, int n_times, std::uint64_t begun);
  static constexpr int kLastingTrouble = 3;
  void succeed();
  /// Of the pause after n failures, the last of them so long ago.
  StreamClock::duration pause_left(int n, StreamClock::duration since) const;
  /// How long a group that could not be read is not asked for.
  StreamClock::duration put_off_for(std::uint32_t group) const;
  bool is_put_off(std::uint32_t group, Run& run) const;  ///< and run.later knows it
  /// Of a want in its list: its projected error; negative if it is put off, and after all others.
  float rank(std::uint32_t group, float px) const;
  static float put_off_rank(float px) { return -1 / px; }
  bool can_extend() const;  ///< the table
  void work_until_stopped(PageReader& reader);
};

/// What a frame draws, which stays until this goes.
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

 private:
  StreamFrame() = default;
  std::shared_ptr<StreamedState> state_;  // null after a move
  StreamView* view_ = nullptr;
  DrawLists lists_;  // its pages are pinned
  Residency::Cut cut_;
  StreamStats stats_;
};

/// Waits until the view is complete: true. Errors: those that keep it from being so.
Result<bool> refine_view(StreamedState& state, std::uint64_t renderer, const Camera& camera, const StreamRule& rule,
                         double seconds);

}  // namespace rgs::detail
