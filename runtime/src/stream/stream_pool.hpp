// stream_pool.hpp - a memory budget, and which pages of its scenes give room to others.
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

struct StreamedState;
struct StreamView;

/// What every streamed scene holds is taken from here before it is allocated. One lock for the pool and all that its scenes know of their
/// pages: room for one is found among the pages of all.
struct StreamPoolState {
  explicit StreamPoolState(std::uint64_t bytes, std::uint64_t device_bytes = 0)
      : budget(bytes), device_memory(device_bytes) {}

  const std::uint64_t budget;                                       // of the host
  const std::uint64_t device_memory;                                // 0: pages are on the host
  std::function<StreamClock::time_point()> now = StreamClock::now;  // constant once a scene is open; tests stop it
  std::mutex mutex;              // of all below, and of scenes' state where they say so
  std::condition_variable news;  // for those who wait until a view is complete
  std::uint64_t held = 0;
  /// Where pages are on a device: the slots of all scenes, as long as there are scenes; room and what of it is taken.
  std::weak_ptr<DeviceSlots> slots;
  std::uint64_t slots_budget = 0, slots_held = 0;
  /// Grows with whatever may make a page wanted, or give room to one that had none.
  std::uint64_t changes = 0;
  std::uint32_t tick = 0;                 ///< of frames
  const StreamView* last_view = nullptr;  ///< that a frame or a caller has seen, of all scenes
  bool waits_for_pins = false;            ///< something would have room if no frame were at work
  bool lacks_room = false;                ///< something had none when it was last looked for
  std::vector<StreamedState*> scenes;

  enum class Room : std::uint8_t {
    taken,
    none,
    pinned,  ///< some, once frames at work are done
  };
  /// Takes `bytes` of the host for what is worth so much; evicts pages that are worth less, if they are there and that is enough.
  Room take(std::uint64_t bytes, const Worth& worth);
  void give(std::uint64_t bytes) { held -= bytes; }
  std::uint64_t left() const { return budget - held; }
  /// The same where pages are: of the host, or of slots.
  Room take_pages(std::uint64_t bytes, const Worth& worth);
  void give_pages(std::uint64_t bytes) { (is_on_device() ? slots_held : held) -= bytes; }
  std::uint64_t left_for_pages() const { return is_on_device() ? slots_budget - slots_held : left(); }
  std::uint64_t pages_budget() const { return is_on_device() ? slots_budget : budget; }
  bool is_on_device() const { return device_memory > 0; }
  /// The slots, made for the first scene. Errors: those of DeviceSlots::create(); bad_argument (those that are there are of another shape).
  Result<std::shared_ptr<DeviceSlots>> slots_of(const SlotShape& shape);
  /// After a take_pages() that took nothing: what would have gone for it, pinned or not. Not more goes for what is worth less.
  std::uint64_t could_go() const { return could_go_; }
  /// Something changed, for this scene and, with it, for those that wait for room.
  void changed();
  /// A scene leaves.
  void forget(StreamedState* scene);

 private:
  struct Victim {
    StreamedState* scene;
    std::uint32_t group;
    std::uint32_t last_used;
    Worth worth;
  };
  static bool goes_before(const Victim& a, const Victim& b);
  Room look_for_victims(std::uint64_t bytes, const Worth& worth);

  std::array<Victim, 256> victims_;  // those that go first come last
  std::size_t n_victims_ = 0;
  std::uint64_t could_go_ = 0;
};

/// Worth of what has to be there.
inline constexpr Worth kNeeded{true, 3e38F};

}  // namespace rgs::detail
