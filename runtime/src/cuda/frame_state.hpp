// frame_state.hpp - a frame, the order of frames, and what a workspace's two pipelines share.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>

#include "common/frame.hpp"
#include "cuda/cuda_objects.hpp"
#include "cuda/cut_stage.hpp"
#include "cuda/device_memory.hpp"
#include "cuda/device_scene.hpp"
#include "render_options.hpp"
#include "rgs/math/camera_models.hpp"
#include "sorted/front_end.hpp"
#include "turbo/turbo.hpp"

namespace rgs::detail {

/// CUB counts pairs with 31 bits.
inline constexpr std::uint64_t kMaxPairs = std::numeric_limits<std::int32_t>::max();
/// Pairs that the workspace holds before a frame has shown how many there are.
inline constexpr std::uint64_t kFirstPairs = std::uint64_t{1} << 20;

/// Ends of the stages, as FrameStats names them.
enum Mark { kStart, kProjected, kDuplicated, kSorted, kRanged, kBlended, kMarks };

/// What the host reads back of a frame, and the events by which it knows that it may. Frames in flight have one each.
struct Readback {
  struct Seen {
    cuda::TurboState turbo;
    cuda::CutCounts cut;
    cuda::Counters counters;
    cuda::Counters counted;  ///< at the end of a frame that counts pairs
    std::uint64_t pairs;     ///< of the separate front end: its last sum
  };
  /// What the turbo pipeline had room for when the frame was queued.
  struct Room {
    std::uint64_t chunks, entries, runs, large_gaussians, in_cells;
  };

  /// Errors: device_failed; unavailable (no unified addressing).
  Status create() {
    Status ok = seen.create();
    for (Event& event : marks) {
      if (ok) ok = event.create(cudaEventDefault);
    }
    if (ok) ok = target_free.create();
    return ok ? finished->create() : ok;
  }

  PageLocked<Seen> seen;
  Room room{};
  std::array<Event, kMarks> marks;
  Event target_free;  ///< what precedes an overlapping frame on the caller's stream is done
  /// Its last frame no longer uses the workspace, its scene or its target.
  std::shared_ptr<Event> finished = std::make_shared<Event>();
};

/// A frame to draw, with all that repeating it takes.
struct Frame {
  std::shared_ptr<const SceneStorage> scene;  ///< null: no Gaussians
  int width, height;                          ///< px
  cuda::PixelArrays target;
  cuda::ViewParameters view;
  FrameSettings settings;
  CudaStream stream;        ///< the caller's
  double depth_resolution;  ///< for FrameStats
  bool is_turbo;
  std::optional<cuda::CutEye> cut;  ///< of a scene with levels of detail
  Readback* readback;
  /// Overlaps with the frame before: runs in this workspace, or in the only one left, on its stream.
  /// Absent: in the first one, on `stream`.
  std::optional<std::size_t> turn = std::nullopt;
  bool is_graph = false;  ///< its launches are collected in a graph

  std::uint64_t n() const { return scene ? scene->n : 0; }
  std::uint64_t n_splats() const { return n() * math::n_copies(view.view); }
  std::uint64_t n_splats(std::uint64_t n_chunks) const {  ///< of chunks of the cut
    return n_chunks * scene->pages->chunk_size * math::n_copies(view.view);
  }
  cuda::Attributes attributes() const { return scene ? scene->attributes : cuda::Attributes(); }
  std::uint32_t n_tiles() const { return static_cast<std::uint32_t>(view.grid.columns * view.grid.rows); }
  math::Vec3<float> background() const {
    return {settings.background[0], settings.background[1], settings.background[2]};
  }
  Readback::Seen& seen() const { return *readback->seen.get(); }
};

/// What a settled frame drew.
struct Settled {
  std::uint64_t pairs;
  bool is_repeated;  ///< it was queued again, behind the frames that follow it
};

/// A renderer's frames end in order, also on several streams and in two workspaces.
struct FrameOrder {
  std::shared_ptr<Event> finished;  ///< Readback::finished of the last frame; before the first, one never recorded
  /// The last frame's stream if the caller has promised that it still lives: what is queued there follows the frame.
  std::optional<CudaStream> ordered_by = std::nullopt;
};

/// A workspace's frames run in order, so one of each serves all of them. All functions may fail with device_failed.
struct FrameState {
  /// The frame waits for the workspace's last one and for the scene's upload, and before it writes its target for the
  /// renderer's last frame, which may run on another stream.
  Status begin(const Frame& f) const {
    if (f.scene) f.scene->drawn_by(f.readback->finished);
    Status ok = f.stream == order.ordered_by ? Status() : order.finished->hold(f.stream);
    if (ok && f.turn) ok = f.readback->target_free.record(f.stream);
    if (ok && f.turn) ok = finished->hold(own.get());
    return ok && f.scene && f.scene->copied ? f.scene->copied->hold(stream_of(f)) : ok;
  }
  /// Call on each stream of the frame's before the first launch that writes the target.
  Status hold_for_target(const Frame& f, CudaStream on) const {
    return f.turn ? f.readback->target_free.hold(on, cudaEventWaitExternal) : Status();
  }
  /// Call after every begin(), also after errors: marks the end of the frame's use of the workspace, which all that
  /// the caller queues on its stream from now on follows.
  Status end(const Frame& f) {
    finished = order.finished = f.readback->finished;
    order.ordered_by.reset();
    // One handle is a different stream for each of the caller's threads.
    if (f.settings.cuda.asynchronous && f.stream != cudaStreamPerThread) order.ordered_by = f.stream;
    const Status ok = finished->record(stream_of(f));
    return ok && f.turn ? finished->hold(f.stream) : ok;
  }
  CudaStream stream_of(const Frame& f) const { return f.turn ? own.get() : f.stream; }
  /// Blocks the host until the device uses nothing of the workspace; ignores errors.
  void wait_for_all() const { cudaEventSynchronize(finished->get()); }

  Status mark(Mark m, const Frame& f, CudaStream on) const {
    const bool is_stage = m != kStart && m != kBlended;
    if (!f.settings.cuda.timings || (is_stage && !f.settings.cuda.stage_timings)) return {};
    const Event& event = f.readback->marks[m];
    if (!f.is_graph) return event.record(on);
    // Not a part of the graph's order, but recorded when it runs.
    return device_status(cudaEventRecordWithFlags(event.get(), on, cudaEventRecordExternal),
                         "an event could not be recorded");
  }
  Status fetch(void* to, const void* from, std::uint64_t size, CudaStream stream) const {
    return device_status(cudaMemcpyAsync(to, from, size, cudaMemcpyDeviceToHost, stream),
                         "counters could not be copied from the device");
  }
  /// Call at the frame's end: `counters`, in device memory, hold the pairs that it counted.
  Status fetch_counted(const Frame& f, const cuda::Counters* counters) const {
    if (!f.settings.cuda.count_pairs) return {};
    return fetch(&f.seen().counted, counters, sizeof(cuda::Counters), f.stream);
  }
  Status wait(CudaStream stream) const { return device_status(cudaStreamSynchronize(stream), "a kernel failed"); }

  /// DeviceBuffer::reserve() of a part of the workspace. Launches of this frame must not use it any more; waits for the
  /// frame before if the buffer grows. Errors: also those of DeviceMemory::allocate().
  Status reserve(DeviceBuffer& buffer, std::uint64_t bytes, const Frame& f) const {
    if (bytes <= buffer.bytes()) return {};
    const Status ok = finished->wait();
    return ok ? buffer.reserve(bytes, memory, stream_of(f)) : ok;
  }

  /// Makes room for the frame's cut, if any: for at least `n_chunks`, or for what earlier frames drew if that is 0.
  /// Errors: those of the other reserve().
  Status reserve_cut(const Frame& f, std::uint64_t n_chunks = 0) {
    if (!f.cut) return {};
    return cut.reserve(*f.scene, n_chunks, splats, f.n_splats(1),
                       [&](DeviceBuffer& buffer, std::uint64_t bytes) { return reserve(buffer, bytes, f); });
  }
  Status launch_cut(const Frame& f) const {
    return cut.launch(*f.scene, {*f.cut, f.view, f.settings.extent == math::Extent::ellipse, &f.seen().cut}, f.stream);
  }
  cuda::DrawnChunks drawn(const Frame& f) const { return f.cut ? cut.drawn() : cuda::DrawnChunks{}; }
  /// Splats that the front end must have room for.
  std::uint64_t n_splats(const Frame& f) const { return f.cut ? f.n_splats(cut.capacity()) : f.n_splats(); }

  FrameOrder& order;
  std::shared_ptr<const DeviceMemory> memory;
  std::shared_ptr<Event> finished;  ///< as in `order`, of the workspace's last frame
  OwnedStream own = {};             ///< collects graphs, and runs overlapping frames
  CutStage cut = {};
  DeviceBuffer splats = {};  ///< [n_splats()]
};

}  // namespace rgs::detail
