// stream_pool.hpp - the memory within which scenes with levels of detail are drawn while they are read.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>

#include "rgs/result.hpp"

namespace RGS_API rgs {

namespace detail {
struct StreamPoolState;
}  // namespace detail

struct StreamPoolOptions {
  /// Most host memory that all its scenes hold at any time, bytes: tables of pages, bytes read and decoded, and for the
  /// CPU renderer resident pages (236 bytes a Gaussian at SH degree 3). What a ByteSource holds comes on top: for
  /// open_url_source() 64 KiB, as much for each of UrlOptions::reads_at_once, and connections.
  std::uint64_t host_memory = std::uint64_t{2} << 30;
  /// For drawing on CUDA: most memory of the current device that its scenes and the renderers that draw them hold,
  /// bytes. What device_workspace leaves is for pages, 77 bytes a Gaussian at SH degree 3 of full pages, allocated as a
  /// whole when the first scene is opened and freed with the last. CUDA itself takes some hundred megabytes beside it.
  /// 0: pages are in the host's memory, and the CPU draws them.
  std::uint64_t device_memory = 0;
  /// Of it, for the workspaces and pictures of all its renderers. A view whose frame does not fit is drawn coarser, as
  /// if its finer pages were missing. 0: half.
  std::uint64_t device_workspace = 0;
};

/// A memory budget that streamed scenes share: the pages that reduce the largest error in pixels get memory first,
/// whichever scene they belong to. With device memory, all its scenes have one SH degree, chunk size and page size.
/// Copies are the same pool.
class StreamPool {
 public:
  /// Errors: bad_argument (a budget of 0, or a workspace that leaves nothing for pages).
  static Result<StreamPool> create(const StreamPoolOptions& options = {});
  std::uint64_t host_bytes() const;     ///< held now
  std::uint64_t host_memory() const;    ///< the budget
  std::uint64_t device_bytes() const;   ///< held now on the device, workspaces included
  std::uint64_t device_memory() const;  ///< its budget

 private:
  friend class Scene;
  explicit StreamPool(std::shared_ptr<detail::StreamPoolState> state);
  std::shared_ptr<detail::StreamPoolState> state_;
};

/// What a streamed scene has done since it was opened, and what is resident.
struct StreamStats {
  std::uint64_t pages_resident = 0;
  /// Pages that the view wants and that are not drawn since they are absent or the workspace has no room; damaged ones
  /// too.
  std::uint64_t pages_missing = 0;
  std::uint64_t bytes_read = 0;      ///< from disk or network, tables included
  std::uint64_t bytes_decoded = 0;   ///< of pages, in the GPU's layout
  std::uint64_t bytes_uploaded = 0;  ///< of these, to a device
  std::uint64_t bytes_evicted = 0;   ///< of decoded pages
  /// Largest error of a page in view, px: error over footprint (docs/format/FORMAT.md, "Error and cut"). At most the
  /// requested detail once nothing is missing.
  double detail_reached_px = 0;
};

}  // namespace rgs
