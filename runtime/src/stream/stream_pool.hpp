// stream_pool.hpp - a memory budget that scenes share, and which of their pages are evicted.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <vector>

#include "stream/device_slots.hpp"
#include "stream/residency.hpp"

namespace rgs::detail {

using StreamClock = std::chrono::steady_clock;
inline constexpr StreamClock::duration kViewLives = std::chrono::seconds(1);  ///< after its last frame

struct StreamedState;
struct StreamView;

/// All memory of streamed scenes is taken from here before it is allocated. One lock guards the pool and the residency
/// of all its scenes, since a page of one may evict pages of another.
struct StreamPoolState {
  explicit StreamPoolState(std::uint64_t bytes, std::uint64_t device_bytes = 0, std::uint64_t workspace_bytes = 0)
      : budget(bytes), device_memory(device_bytes), workspace_memory(workspace_bytes) {}

  const std::uint64_t budget;         // of the host
  const std::uint64_t device_memory;  // with the workspace's; 0: pages are on the host
  const std::uint64_t workspace_memory;
  /// Constant once a scene is open; tests stop it.
  std::function<StreamClock::time_point()> now = [] { return StreamClock::now(); };
  std::mutex mutex;              // of all below, and of scenes' state where noted
  std::condition_variable news;  // wakes callers that wait for a view to complete
  std::uint64_t held = 0;
  /// On a device: the slots of all scenes, as long as there is a scene; their bytes and how many are taken.
  std::weak_ptr<DeviceSlots> slots;
  std::uint64_t slots_budget = 0, slots_held = 0;
  /// Counts whatever may make a page wanted, or make room for one.
  std::uint64_t changes = 0;
  std::uint32_t tick = 0;                 ///< of frames
  const StreamView* last_view = nullptr;  ///< last used, of all scenes
  bool waits_for_pins = false;            ///< a request would fit if no frame pinned pages
  bool lacks_room = false;                ///< a request did not fit at the last try
  int n_waiting_for_room = 0;             ///< callers in wait_for_room()
  std::vector<StreamedState*> scenes;

  enum class Room : std::uint8_t {
    taken,
    none,
    pinned,  ///< it fits once frames have ended
  };
  /// Takes `bytes` of the host; evicts groups of lower priority if that makes enough room.
  Room take(std::uint64_t bytes, const Priority& priority);
  void release(std::uint64_t bytes) { held -= bytes; }
  std::uint64_t left() const { return budget - held; }
  /// The same of the memory that pages take: the host's, or slots.
  Room take_pages(std::uint64_t bytes, const Priority& priority);
  void release_pages(std::uint64_t bytes) { (is_on_device() ? slots_held : held) -= bytes; }
  std::uint64_t left_for_pages() const { return is_on_device() ? slots_budget - slots_held : left(); }
  std::uint64_t pages_budget() const { return is_on_device() ? slots_budget : budget; }
  bool is_on_device() const { return device_memory > 0; }
  /// The slots, allocated for the first scene. Errors: those of DeviceSlots::create(); bad_argument (the pool's scenes
  /// have another shape).
  Result<std::shared_ptr<DeviceSlots>> slots_of(const SlotShape& shape);
  /// After a failed take_pages(): the bytes that it could have evicted, pinned or not; a bound for requests of lower
  /// priority.
  std::uint64_t reclaimable_bytes() const { return reclaimable_bytes_; }
  /// Something changed: wakes threads of all scenes.
  void changed();
  /// Removes old views; if there are none, waits for a read, a frame or a view other than `own` to end. False if there is
  /// none of these either: nobody will release memory.
  bool wait_for_room(std::unique_lock<std::mutex>& lock, const StreamView* own, StreamClock::time_point deadline);
  void forget(StreamedState* scene);

 private:
  struct Victim {
    StreamedState* scene;
    std::uint32_t group;
    std::uint32_t last_used;
    Priority priority;
  };
  static bool evicts_before(const Victim& a, const Victim& b);
  Room find_victims(std::uint64_t bytes, const Priority& priority);

  std::array<Victim, 256> victims_;  // the first to evict comes last
  std::size_t n_victims_ = 0;
  std::uint64_t reclaimable_bytes_ = 0;
};

/// For what cannot be done without.
inline constexpr Priority kNeeded{true, 3e38F};

}  // namespace rgs::detail
