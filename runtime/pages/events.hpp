// events.hpp - what a scheduler is told, and what it asks for. docs/develop/PAGES.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <cstdint>
#include <limits>
#include <span>
#include <variant>

#include "rgs/math/camera.hpp"
#include "rgs/page.hpp"

namespace rgs::pages {

/// Since an epoch of the caller's; never goes back.
using Time = std::chrono::nanoseconds;
inline constexpr Time kNever = Time::max();

inline constexpr std::uint64_t kNoLimit = std::numeric_limits<std::uint64_t>::max();

using SceneId = std::uint32_t;
using ViewId = std::uint32_t;

/// A camera, and what its picture asks for.
struct Look {
  lod::Eye eye;
  math::View<float> view{};  ///< the same camera, for what it can see; ViewVolume
  float low_pass = 0;        ///< of the picture, px^2
  float detail_px = 0;
  /// Of the cut, in and out of view: it is coarser than detail_px if that has more (lod::finest_detail()).
  std::uint64_t most_gaussians = kNoLimit;
};

/// What a view draws of the resident pages.
struct Cut {
  bool fits = true;  ///< all of them were taken
  std::uint64_t gaussians = 0;
  /// Pages that the view wants and that are not drawn: absent, or finer than what fits.
  std::uint64_t missing = 0;
  std::uint64_t damaged = 0;    ///< of these, damaged or beyond a broken table
  std::uint64_t in_flight = 0;  ///< groups that the view wants
  std::uint64_t wanted = 0;     ///< the same, with those that can be requested
  double reached_px = 0;        ///< largest projected error
  float detail_px = 0;          ///< at which it was drawn: the look's, or coarser where that does not fit
  /// With Look::most_gaussians: of the cut of known pages that they allow, in and out of view.
  std::uint64_t allowed_gaussians = 0;
};

namespace event {

/// The view's camera; before Frame and Waits.
struct Looks {
  ViewId view;
  Look look;
};
/// Memory for the list of pages that the view's next frame draws. `can_grow`: Grow may be answered by a longer one.
struct Lists {
  ViewId view;
  std::span<std::uint32_t> pages;
  bool can_grow;
};
/// A frame begins: Draw, or Grow and nothing else. Its pages are pinned until FrameEnds.
struct Frame {
  ViewId view;
};
struct FrameEnds {
  ViewId view;
  std::span<const std::uint32_t> pages;
  std::uint64_t gaussians;  ///< Cut::gaussians
  /// Gaussians that fit the renderer's memory, as far as this frame shows: fewer than it has if it did not fit.
  std::uint64_t fitting;
};
/// A caller waits until the view is complete, or its time is up: Refined.
struct Waits {
  ViewId view;
  Time deadline;
};
struct WaitEnds {
  ViewId view;
};
/// One of the scene's readers has nothing to do: Read, ReadTable, Probe, or nothing, perhaps with WakeAt.
struct Idle {
  SceneId scene;
};
/// A reader has ended what it was asked to do.
struct Done {
  SceneId scene;
};
/// A group is decoded and placed.
struct Arrived {
  SceneId scene;
  std::uint32_t group;
};
enum class Fault : std::uint8_t {
  lost,      ///< bytes, memory or a device are missing for now
  checksum,  ///< another answer may have the right bytes
  damaged,   ///< the file is
};
/// Groups first .. first + n - 1 of a read are not placed.
struct Failed {
  SceneId scene;
  std::uint32_t first, n;
  Fault fault;
};
/// Pages of the group, and perhaps of those behind it, are known, and the table is verified if these were the last.
struct TableGrew {
  SceneId scene;
  std::uint32_t group;
  bool is_verified;
};
struct TableFailed {
  SceneId scene;
  Fault fault;
};
struct Probed {
  SceneId scene;
  bool is_there;  ///< the bytes could be read again
};
/// Nothing but that time has passed.
struct Tick {};
/// Of the budget, for other things than pages: Taken.
struct Take {
  std::uint64_t bytes;
};
struct Release {
  std::uint64_t bytes;
};

}  // namespace event

using Event = std::variant<event::Looks, event::Lists, event::Frame, event::FrameEnds, event::Waits, event::WaitEnds,
                           event::Idle, event::Done, event::Arrived, event::Failed, event::TableGrew,
                           event::TableFailed, event::Probed, event::Tick, event::Take, event::Release>;

namespace action {

/// Read, decode and place groups first .. first + n - 1. Their memory is taken.
struct Read {
  SceneId scene;
  std::uint32_t first, n;
};
/// Read more of the table of pages, from the group's first unknown page on; lod::kNoPage: from the first of all.
struct ReadTable {
  SceneId scene;
  std::uint32_t group;
};
/// Read again what could be read before: does the source fail, or a range of it?
struct Probe {
  SceneId scene;
};
/// The group's pages leave: free their memory. Nothing draws or places them.
struct Evict {
  SceneId scene;
  std::uint32_t group;
  bool was_placed;  ///< false: its read failed
};
/// The first n pages of the view's list, in the order of leaves: Scheduler::last_cut().
struct Draw {
  ViewId view;
  std::uint32_t n;
};
/// The list of pages is too short: send a longer one, or one that cannot grow, and Frame again.
struct Grow {
  ViewId view;
};
enum class Verdict : std::uint8_t {
  complete,
  incomplete,  ///< out of time or room
  lost,        ///< reads fail
  damaged,
};
struct Refined {
  ViewId view;
  Verdict verdict;
};
struct Taken {
  bool is_taken;
};
/// Idle readers of the scene should ask again at that time.
struct WakeAt {
  SceneId scene;
  Time at;
};
/// Idle readers of all scenes should ask again.
struct Wake {};

}  // namespace action

using Action = std::variant<action::Read, action::ReadTable, action::Probe, action::Evict, action::Draw, action::Grow,
                            action::Refined, action::Taken, action::WakeAt, action::Wake>;

}  // namespace rgs::pages
