// streamed_state.hpp - a streamed scene: its tables, its pages' memory, its renderers' views, and the threads that carry
// out what its pool's scheduler asks of readers.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <condition_variable>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <thread>
#include <vector>

#include "cpu/reference_renderer.hpp"
#include "pages/scheduler.hpp"
#include "render_options.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/camera.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/scene.hpp"
#include "stream/page_reader.hpp"
#include "stream/page_store.hpp"
#include "stream/stream_pool.hpp"

namespace rgs::detail {

/// What a renderer draws of a scene, for any camera.
struct StreamRule {
  FrameSettings settings;
  Origin origin = kNoOrigin;
  float z_near = 0;  ///< as the scene declares
  float detail_px = 0;
  std::uint64_t most_gaussians = pages::kNoLimit;

  pages::Look look(const Camera& camera) const {
    return {eye_of(camera, origin, z_near), make_view(camera, origin, settings), settings.low_pass, detail_px,
            most_gaussians};
  }
};

/// What a frame draws. Owned by the view between frames, by the frame meanwhile.
struct DrawLists {
  std::vector<std::uint32_t> pages;   ///< [longest list]
  std::vector<ScenePart> parts;       ///< on the host
  std::vector<std::uint32_t> chunks;  ///< on a device
  std::uint64_t bytes = 0;            ///< taken from the pool
};

/// A renderer's view of a scene.
struct StreamView {
  std::uint64_t renderer = 0;
  pages::ViewId id = 0;
  DrawLists lists;            ///< empty during a frame
  std::uint32_t n_drawn = 0;  ///< action::Draw
  bool needs_list = false;    ///< action::Grow
  std::optional<pages::action::Verdict> verdict;
};

struct StreamedState {
  StreamedState() = default;
  ~StreamedState();
  StreamedState(const StreamedState&) = delete;
  StreamedState& operator=(const StreamedState&) = delete;

  // Set by open(), then constant.
  std::shared_ptr<StreamPoolState> pool;
  std::unique_ptr<ByteSource> source;
  std::optional<PagedFile> file;  // but one reader at a time adds pages, which others see with pool->mutex
  SceneBounds subject;
  pages::SceneId id = 0;
  bool is_scheduled = false;  // it has an id
  bool has_root = false;      // its memory is taken
  ByteSource::Traits traits;

  // Guarded by pool->mutex.
  std::uint64_t bytes = 0;  // taken from the pool, without pages and views
  std::vector<std::unique_ptr<StreamView>> views;
  StreamStats stats;
  std::condition_variable work;  // wakes reading threads: pool->n_wakes or n_claimed grew
  std::uint64_t n_claimed = 0;   // reads ever begun; each lets more be read
  Status damage, trouble;        // the last of a page or the table; of reading
  bool is_troubled = false;      // no read has succeeded since `trouble`
  FileRange readable;            // bytes that were read before
  bool is_stopping = false;

  // Pages in flight belong to the thread that reads them; resident pages are constant.
  std::optional<PageStore> store;
  std::vector<std::unique_ptr<PageReader>> readers;  // one a thread
  std::vector<std::thread> threads;

  /// Errors: as of Scene::open().
  static Result<std::shared_ptr<StreamedState>> open(std::unique_ptr<ByteSource> source, const OpenOptions& options,
                                                     std::shared_ptr<StreamPoolState> pool);
  Status read_tables(const DecodeLimits& limits);
  Status make_room_for_pages(bool prefetches);
  std::uint64_t root_bytes() const { return store->cost().page + store->cost().row * file->pages()[0].count; }
  Status read_root();
  Status start_threads();
  /// Takes memory for the scene's life. Errors: limit_exceeded; Error::expected: the budget needed.
  Status take(std::uint64_t n);

  static std::uint64_t view_bytes();
  std::uint64_t least_view_bytes() const { return view_bytes() + list_bytes(kFirstDrawn); }
  static constexpr std::size_t kFirstDrawn = 256;  // pages of a first list

  // With the lock.
  const pages::Residency& residency() const { return pool->scheduler->residency(id); }
  std::uint64_t list_bytes(std::size_t n_pages) const;
  void reserve_pages(const pages::action::Read& read);
  void free_pages(const pages::action::Evict& evict);
  void remove_old_views();
  /// Sets the camera of the renderer's view. Errors: limit_exceeded.
  Result<StreamView*> post(std::uint64_t renderer, const Camera& camera, const StreamRule& rule);
  bool grow(DrawLists& lists);
  Status need(DrawLists& lists);                       // makes the first lists. Errors: limit_exceeded
  void offer(StreamView& view, bool can_grow = true);  // its list to the scheduler
  void answer_grow(StreamView& view);
  void free(DrawLists& lists);
  StreamStats stats_now() const;
  void count_seen(const StreamView& view);
  Status status() const { return pool->scheduler->is_damaged(id) ? damage : is_troubled ? trouble : Status(); }

  // For reading threads, without the lock.
  void fetch(PageReader& reader, const pages::action::Read& read);
  void extend_table(PageReader& reader, std::uint32_t group);
  void probe(PageReader& reader);
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

  std::size_t n_pages() const { return n_pages_; }
  std::span<const ScenePart> parts() const { return lists_.parts; }        ///< on the host
  std::span<const std::uint32_t> chunks() const { return lists_.chunks; }  ///< on a device, of slots()
  const DeviceSlots* slots() const { return state_->store->slots().get(); }
  const pages::Cut& cut() const { return cut_; }
  const StreamStats& stats() const { return stats_; }
  /// Call once it is drawn on a device: `bytes` of the workspace, without pictures, hold it.
  void drawn(std::uint64_t bytes);
  /// Call if the workspace is too small: the view's next frame has fewer Gaussians.
  void did_not_fit() { fitting_ = cut_.gaussians * 3 / 4; }

 private:
  StreamFrame() = default;
  std::shared_ptr<StreamedState> state_;  // null after a move
  StreamView* view_ = nullptr;
  DrawLists lists_;  // its pages are pinned
  std::size_t n_pages_ = 0;
  pages::Cut cut_;
  std::uint64_t fitting_ = 0;  // FrameEnds
  StreamStats stats_;
};

/// Waits until the view is complete: true. Errors: those that keep it from completing.
Result<bool> refine_view(StreamedState& state, std::uint64_t renderer, const Camera& camera, const StreamRule& rule,
                         double seconds);

}  // namespace rgs::detail
