// frame_state.hpp - a frame, and what a renderer's two pipelines share.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
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
#include "sorted/front_end.hpp"

namespace rgs::detail {

/// CUB counts pairs with 31 bits.
inline constexpr std::uint64_t kMaxPairs = std::numeric_limits<std::int32_t>::max();
/// Pairs that the workspace holds before a frame has shown how many there are.
inline constexpr std::uint64_t kFirstPairs = std::uint64_t{1} << 20;

/// Ends of the stages, as FrameStats names them.
enum Mark { kStart, kProjected, kDuplicated, kSorted, kRanged, kBlended, kMarks };

/// A frame to draw, with all that repeating it takes.
struct Frame {
  std::shared_ptr<const SceneStorage> scene;  ///< null: no Gaussians
  int width, height;                          ///< px
  cuda::PixelArrays target;
  cuda::ViewParameters view;
  FrameSettings settings;
  CudaStream stream;
  double depth_resolution;  ///< for FrameStats
  bool is_turbo;
  std::optional<cuda::CutEye> cut;  ///< of a scene with levels of detail

  std::uint64_t n() const { return scene ? scene->n : 0; }
  cuda::Attributes attributes() const { return scene ? scene->attributes : cuda::Attributes(); }
  std::uint32_t n_tiles() const { return static_cast<std::uint32_t>(view.grid.columns * view.grid.rows); }
  math::Vec3<float> background() const {
    return {settings.background[0], settings.background[1], settings.background[2]};
  }
};

/// A renderer's frames run in order, so one of each serves all of them. All functions may fail with device_failed.
struct FrameState {
  /// Numbers that the host waits for.
  struct HostCounters {
    cuda::Counters counters;
    std::uint64_t pairs;  ///< of the separate front end: its last sum
  };

  Status create() {
    Status ok = host.create();
    if (ok) ok = cut.create();
    for (Event& event : marks) {
      if (ok) ok = event.create(cudaEventDefault);
    }
    return ok ? finished->create() : ok;
  }

  /// Waits for the last frame, which may run on another stream, and for the scene's upload.
  Status begin(const Frame& f) const {
    if (f.scene) f.scene->drawn_by(finished);
    const Status ok = finished->hold(f.stream);
    return ok && f.scene && f.scene->copied ? f.scene->copied->hold(f.stream) : ok;
  }
  /// Call after every begin(), also after errors: marks the end of the frame's use of the workspace.
  Status end(const Frame& f) const { return finished->record(f.stream); }

  Status mark(Mark m, const Frame& f, CudaStream on) const {
    const bool is_stage = m != kStart && m != kBlended;
    if (!f.settings.cuda.timings || (is_stage && !f.settings.cuda.stage_timings)) return {};
    return marks[m].record(on);
  }
  Status fetch(void* to, const void* from, std::uint64_t size, CudaStream stream) const {
    return device_status(cudaMemcpyAsync(to, from, size, cudaMemcpyDeviceToHost, stream),
                         "counters could not be copied from the device");
  }
  Status wait(CudaStream stream) const { return device_status(cudaStreamSynchronize(stream), "a kernel failed"); }

  /// DeviceBuffer::reserve() of a part of the workspace. Launches of this frame must not use it any more; waits for the
  /// frame before if the buffer grows. Errors: also those of DeviceMemory::allocate().
  Status reserve(DeviceBuffer& buffer, std::uint64_t bytes, CudaStream stream) const {
    if (bytes <= buffer.bytes()) return {};
    const Status ok = finished->wait();
    return ok ? buffer.reserve(bytes, memory, stream) : ok;
  }

  /// Makes room for the frame's cut, if any: for at least `n_chunks`, or for what earlier frames drew if that is 0.
  /// Errors: those of the other reserve().
  Status reserve_cut(const Frame& f, std::uint64_t n_chunks = 0) {
    if (!f.cut) return {};
    return cut.reserve(*f.scene, n_chunks, splats,
                       [&](DeviceBuffer& buffer, std::uint64_t bytes) { return reserve(buffer, bytes, f.stream); });
  }
  Status launch_cut(const Frame& f) const {
    return cut.launch(*f.scene, {*f.cut, f.view, f.settings.extent == math::Extent::ellipse}, f.stream);
  }
  cuda::DrawnChunks drawn(const Frame& f) const { return f.cut ? cut.drawn() : cuda::DrawnChunks{}; }
  /// Gaussians that the front end must have room for.
  std::uint64_t n_drawn(const Frame& f) const { return f.cut ? cut.capacity() * f.scene->pages->chunk_size : f.n(); }

  std::shared_ptr<const DeviceMemory> memory;
  CutStage cut;
  std::array<Event, kMarks> marks;
  /// The last frame no longer uses the workspace or its scene.
  std::shared_ptr<Event> finished = std::make_shared<Event>();
  PageLocked<HostCounters> host;
  DeviceBuffer splats;  ///< [n]
};

}  // namespace rgs::detail
