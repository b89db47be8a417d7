// streamed_scene.hpp - a scene with levels of detail that is drawn while it is read, within a memory budget.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "rgs/byte_source.hpp"
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
  /// Most that all its scenes hold in the host's memory at any time, bytes: tables of pages, bytes that are read and decoded, and, for the
  /// CPU renderer, pages that are there (236 bytes a Gaussian at SH degree 3). What a ByteSource holds of its own comes on top: of
  /// open_url_source() 64 KiB and as much for each of UrlOptions::reads_at_once, besides connections.
  std::uint64_t host_memory = std::uint64_t{2} << 30;
  /// For drawing on CUDA: memory of the current device that its scenes' pages take, allocated as a whole when the first scene is opened and given
  /// back with the last; 77 bytes a Gaussian at SH degree 3, of pages that are full. The renderers' workspaces come on top. 0: pages are in the host's memory, where the
  /// CPU draws them.
  std::uint64_t device_memory = 0;
};

/// A memory budget that streamed scenes share: what shows the largest error in pixels gets room first, whichever scene it is of. With memory of a
/// device, its scenes have one SH degree, chunk size and page size. Copies are the same pool.
class StreamPool {
 public:
  /// Errors: bad_argument (a budget of 0).
  static Result<StreamPool> create(const StreamPoolOptions& options = {});
  std::uint64_t host_bytes() const;     ///< held now
  std::uint64_t host_memory() const;    ///< the budget
  std::uint64_t device_bytes() const;   ///< held now on the device
  std::uint64_t device_memory() const;  ///< the budget there

 private:
  friend class StreamedScene;
  explicit StreamPool(std::shared_ptr<detail::StreamPoolState> state);
  std::shared_ptr<detail::StreamPoolState> state_;
};

struct StreamOptions {
  std::optional<StreamPool> pool;  ///< absent: one of its own
  DecodeLimits limits = {};
  UrlOptions url = {};
  bool prefetch = true;  ///< also what the camera is about to see, where it moves
};

/// What a streamed scene has done since it was opened, and what is there now.
struct StreamStats {
  std::uint64_t pages_resident = 0;
  std::uint64_t pages_missing =
      0;                         ///< that the view wants and are not drawn, since they are not there; damaged ones too
  std::uint64_t bytes_read = 0;  ///< from disk or network, tables included
  std::uint64_t bytes_decoded = 0;   ///< of pages as a GPU reads them
  std::uint64_t bytes_uploaded = 0;  ///< of these, to a device
  std::uint64_t bytes_evicted = 0;   ///< of decoded pages that gave room to others
  /// Largest error of a page drawn in view, px: error over footprint (docs/format/FORMAT.md, "Error and cut"). At most the detail asked
  /// for once nothing is missing.
  double detail_reached_px = 0;
};

/// A file with levels of detail of which a part is in memory: the coarsest pages always, others as cameras need them. Frames draw what is there and
/// wait for nothing; threads of the scene read and decode what is missing, the largest projected error first. Copies share it; several renderers
/// may draw it at once. The last copy that goes cancels the source and waits for the threads. docs/develop/STREAMING.md.
class StreamedScene {
 public:
  /// Reads the head, the beginning of the table of pages and the root, and starts the threads. Errors: those of open_source() and
  /// PagedFile::open(); missing_section (a file without levels: open it as a Scene); host_out_of_memory or limit_exceeded (the pool does not hold the
  /// tables and the root: Error::expected says how many bytes it takes); of a pool with memory of a device also unavailable (no CUDA),
  /// bad_argument (the scenes in it are of another shape), device_out_of_memory, device_failed.
  static Result<StreamedScene> open(const std::string& path_or_url, const StreamOptions& options = {});
  static Result<StreamedScene> open(std::unique_ptr<ByteSource> source, const StreamOptions& options = {});

  std::uint64_t size() const;  ///< Gaussians of the leaves
  int sh_degree() const;
  const std::optional<Declarations>& declarations() const;
  const Origin& origin() const;
  /// What has gone wrong with the file, if anything has: a page that is damaged, a server that is gone, a file that changed. What is there is drawn all
  /// the same, and reading goes on where that makes sense.
  Status status() const;
  /// Of all renderers; pages_missing and detail_reached_px of the last frame, or of the last look of a refine().
  StreamStats stats() const;

 private:
  friend class Renderer;
  explicit StreamedScene(std::shared_ptr<detail::StreamedState> state);
  std::shared_ptr<detail::StreamedState> state_;
};

}  // namespace rgs
