// device_scene.hpp - what a DeviceScene holds.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <vector>

#include "common/cut.hpp"
#include "cuda/cuda_objects.hpp"
#include "cuda/device_memory.hpp"
#include "rgs/cuda_renderer.hpp"
#include "sorted/front_end.hpp"

namespace rgs::detail {

/// For a streamed scene: resident chunks that the host has chosen to draw.
struct ChosenChunks {
  std::span<const std::uint32_t> chunks;  ///< on the host; constant until the frame is drawn
  cuda::CutCounts counts;
};

/// Pages of a scene with levels of detail; its attributes are cuda::PagedAttributes.
struct ScenePages {
  DeviceBuffer table;  ///< cuda::CutPage [n_pages]
  std::uint32_t n_pages = 0;
  std::uint32_t chunk_size = 0;
  std::uint64_t n_chunks = 0;  ///< of all pages
  /// Replaces the table, from which the device chooses.
  std::optional<ChosenChunks> chosen;
};

struct SceneStorage {
  SceneStorage() = default;
  SceneStorage(const SceneStorage&) = delete;
  SceneStorage& operator=(const SceneStorage&) = delete;
  ~SceneStorage() {
    if (copied && copied->get() != nullptr) cudaEventSynchronize(copied->get());
    for (const auto& frame : frames_) {
      if (const auto last = frame.lock()) cudaEventSynchronize(last->get());
    }
  }

  std::uint64_t n = 0;  ///< Gaussians; with levels, the finest ones
  int sh_degree = 0;
  std::optional<ScenePages> pages;
  std::optional<Declarations> declarations;
  Origin origin = kNoOrigin;
  cuda::Attributes attributes;
  DeviceBuffer memory;
  std::optional<Event> copied;  ///< the end of an upload that nobody has waited for

  /// Device memory held.
  std::uint64_t bytes() const { return memory.bytes() + (pages ? pages->table.bytes() : 0); }
  /// A frame that ends with `finished` draws the scene, so freeing it waits for that. Thread-safe.
  void drawn_by(const std::shared_ptr<Event>& finished) const {
    const std::scoped_lock lock(mutex_);
    std::erase_if(frames_, [](const auto& frame) { return frame.expired(); });  // a destroyed renderer has waited
    for (const auto& frame : frames_) {
      if (frame.lock() == finished) return;
    }
    frames_.emplace_back(finished);
  }

 private:
  mutable std::mutex mutex_;  // of what follows
  mutable std::vector<std::weak_ptr<Event>> frames_;
};

}  // namespace rgs::detail
