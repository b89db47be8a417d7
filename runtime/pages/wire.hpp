// wire.hpp - a scheduler of one scene behind plain numbers, for drivers in other languages. docs/develop/PAGES.md.
//
// A record is a code and then its fields, all of them FP64. What comes in is the driver's own: it is not checked.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "pages/scheduler.hpp"

namespace rgs::pages {

/// Of the record of a page: level, parent (-1: none), first child, children, first Gaussian, Gaussians, error, bounds
/// (min x, y, z, max x, y, z), core, offset, stored bytes, step sets, scale exponent.
inline constexpr std::size_t kPageNumbers = 23;
void put_page(const lod::Page& page, const StoredPage& stored, std::vector<double>& numbers);

/// Codes of events, and their fields: those of pages::event, but for the scene.
enum class WireEvent : std::uint8_t {
  /// view, position x, y, z, focal px, z near, detail px, most Gaussians (infinity: any), width; and if that is not 0
  /// height, fx, fy, cx, cy, low-pass px^2, rotation [9] world to camera, as in math::View
  looks,
  frame,       ///< view
  frame_ends,  ///< view: its oldest frame
  idle,
  done,
  arrived,  ///< group
  failed,   ///< first, n, fault
  probed,   ///< is there
  take,     ///< bytes
  release,  ///< bytes
  /// group, table is verified, first page, n, records of the pages [n, kPageNumbers], those that stay unknown included
  table_grew,
  table_failed,  ///< fault
};
/// Codes of actions, and their fields: those of pages::action, but for the scene.
enum class WireAction : std::uint8_t {
  read,  ///< first, n
  probe,
  evict,    ///< group
  draw,     ///< view, n, pages [n]
  taken,    ///< is taken
  wake_at,  ///< time
  wake,
  read_table,  ///< group; lod::kNoPage: any
};

class Wire {
 public:
  /// `setup`: budget beside the root, bytes a page, bytes a Gaussian, readers, most bytes of a read, most bytes between
  /// its parts, prefetches. `pages` [n, kPageNumbers]: all pages, of which unknown ones have neither parent nor Gaussians.
  Wire(std::span<const double> setup, std::span<const double> pages);
  ViewId add_view();
  /// `now`: nanoseconds. The actions are valid until the next step.
  std::span<const double> step(std::span<const double> events, double now);
  /// Projected error of a page for the camera that a view had last, px.
  double error_px(ViewId view, std::uint32_t page) const;
  /// Groups that the view's last frame wanted and that are in flight or can be requested, now or after a pause.
  double n_wanted(ViewId view) const {
    return scheduler_.is_at_rest(scene_) ? 0 : static_cast<double>(scheduler_.last_cut(view).wanted);
  }
  /// Groups that are too damaged to be read again; a table that is counts as one.
  std::uint32_t n_quarantined() const {
    const Residency& residency = scheduler_.residency(scene_);
    return residency.n_quarantined() + residency.is_broken();
  }

 private:
  struct Frame {
    std::vector<std::uint32_t> pages;
    std::uint64_t gaussians;
  };
  struct View {
    std::vector<std::uint32_t> list;
    std::vector<Frame> frames;  // that have not ended
  };
  bool knows_all() const;
  void tell(const Event& event);
  void begin_frame(ViewId view);

  std::vector<lod::Page> pages_;
  std::vector<StoredPage> stored_;
  Scheduler scheduler_;
  SceneId scene_ = 0;
  std::vector<View> views_;
  Time now_{};
  bool must_grow_ = false;
  std::vector<double> actions_;
};

}  // namespace rgs::pages
