// streamed_scene.hpp - a scene with levels of detail that is drawn while it is read, within a memory budget.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "rgs/byte_source.hpp"
#include "rgs/camera.hpp"
#include "rgs/decode.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"

namespace RGS_API rgs {

class Renderer;

namespace detail {
struct StreamPoolState;
struct StreamedState;
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
  friend class StreamedScene;
  explicit StreamPool(std::shared_ptr<detail::StreamPoolState> state);
  std::shared_ptr<detail::StreamPoolState> state_;
};

struct StreamOptions {
  std::optional<StreamPool> pool;  ///< absent: a pool of its own
  DecodeLimits limits = {};
  UrlOptions url = {};   ///< with a source of the caller's, open_seconds alone: from then on
  bool prefetch = true;  ///< also read what a moving camera is about to see
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

/// A file with levels of detail, partly in memory: the coarsest page always, others as cameras want them. Frames draw
/// resident pages and wait for nothing; threads of the scene read and decode wanted ones, the largest projected error
/// first. Copies share it; several renderers may draw it at once. The destructor of the last copy cancels the source
/// and waits for the threads. docs/develop/STREAMING.md.
class StreamedScene {
 public:
  /// Reads the head, the start of the table of pages and the root, and starts the threads. Errors: those of
  /// open_source() and PagedFile::open(); missing_section (a file without levels: open it as a Scene);
  /// host_out_of_memory or limit_exceeded (the pool does not hold the tables and the root; Error::expected: the bytes
  /// needed); with device memory also unavailable (no CUDA), bad_argument (the pool's scenes have another shape),
  /// device_out_of_memory, device_failed.
  static Result<StreamedScene> open(const std::string& path_or_url, const StreamOptions& options = {});
  static Result<StreamedScene> open(std::unique_ptr<ByteSource> source, const StreamOptions& options = {});

  std::uint64_t size() const;  ///< Gaussians of the leaves
  int sh_degree() const;
  const std::optional<Declarations>& declarations() const;
  const Origin& origin() const;
  /// What has gone wrong with the file, if anything: a damaged page, a server that is gone, a file that changed.
  /// Resident pages are drawn all the same, and reading continues where it can.
  Status status() const;
  /// Of all renderers; pages_missing and detail_reached_px of the last frame or refine().
  StreamStats stats() const;
  /// What views without cameras look at: subject_box() of the pages that open() knew, in the world.
  const SceneBounds& subject_bounds() const;

 private:
  friend class Renderer;
  explicit StreamedScene(std::shared_ptr<detail::StreamedState> state);
  std::shared_ptr<detail::StreamedState> state_;
};

}  // namespace rgs
