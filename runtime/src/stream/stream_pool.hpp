// stream_pool.hpp - the memory that streamed scenes share, and their scheduler behind one lock.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <vector>

#include "pages/scheduler.hpp"
#include "stream/device_slots.hpp"

namespace rgs::detail {

struct StreamedState;
struct StreamView;

/// All memory of streamed scenes is taken from here before it is allocated. One lock guards the scheduler and all that
/// its actions change.
struct StreamPoolState {
  explicit StreamPoolState(std::uint64_t bytes, std::uint64_t device_bytes = 0, std::uint64_t workspace_bytes = 0);

  const std::uint64_t budget;         // of the host
  const std::uint64_t device_memory;  // with the workspace's; 0: pages are on the host
  const std::uint64_t workspace_memory;
  /// Since the steady clock's epoch. Constant once a scene is open; tests stop it.
  std::function<pages::Time()> now;
  std::mutex mutex;              // of all below, and of scenes' state where noted
  std::condition_variable news;  // wakes callers that wait
  /// Of the host's budget, or of the slots of the first scene on a device.
  std::optional<pages::Scheduler> scheduler;
  std::uint64_t held_beside = 0;     // on the host, if pages are on a device
  std::weak_ptr<DeviceSlots> slots;  // of all scenes, as long as there is a scene
  std::vector<StreamedState*> scenes;
  std::uint64_t n_wakes = 0;   // action::Wake
  int n_waiting_for_room = 0;  // callers in wait_for_room()

  bool is_on_device() const { return device_memory > 0; }
  /// The scheduler's step. Carries out what needs no reader, and returns the action that does, WakeAt or Taken.
  std::optional<pages::Action> tell(const pages::Event& event);
  /// Takes memory of the host, or of what pages take; evicts pages if that makes enough room.
  bool take(std::uint64_t bytes);
  bool take_for_pages(std::uint64_t bytes);
  void release(std::uint64_t bytes);
  std::uint64_t held() const { return is_on_device() ? held_beside : scheduler->held(); }
  std::uint64_t left() const { return budget - held(); }
  /// The slots, allocated for the first scene. Errors: those of DeviceSlots::create(); bad_argument (the pool's scenes
  /// have another shape).
  Result<std::shared_ptr<DeviceSlots>> slots_of(const SlotShape& shape);
  /// Removes old views; if there are none, waits for a read, a frame or a view other than `own` to end. False if there
  /// is none of these either: nobody will release memory.
  bool wait_for_room(std::unique_lock<std::mutex>& lock, const StreamView* own, pages::Time deadline);
  void wake();  // idle readers of all scenes

 private:
  StreamedState& scene_of(pages::SceneId id) const;
  StreamView* view_of(pages::ViewId id) const;
};

}  // namespace rgs::detail
