// scene.hpp - Gaussians ready to be rendered.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>

#include "rgs/byte_source.hpp"
#include "rgs/camera.hpp"
#include "rgs/decode.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"
#include "rgs/stream_pool.hpp"

namespace RGS_API rgs {

class MappedFile;
class PagedFile;
namespace detail {
struct StreamedState;
}  // namespace detail

/// Read-only view of N activated Gaussians, structure of arrays, in the scene's axes.
struct SceneView {
  std::uint64_t n = 0;
  int sh_degree = 0;                ///< 0..3
  std::span<const float> mean;      ///< [n, 3] relative to `origin`, world units
  std::span<const float> rotation;  ///< [n, 4] unit quaternions w, x, y, z
  std::span<const float> scale;     ///< [n, 3] standard deviations along the local axes, world units
  std::span<const float> opacity;   ///< [n] 0..1
  std::span<const float> sh;        ///< [n, sh_coefficients(sh_degree), 3]
  Origin origin = kNoOrigin;        ///< in the world
};

struct OpenOptions {
  /// Streams the scene, which must have levels of detail, within this memory. Absent: the whole file.
  std::optional<StreamPool> pool;
  DecodeLimits limits = {};
  UrlOptions url = {};   ///< with a source of the caller's, open_seconds alone: from then on
  bool prefetch = true;  ///< of a streamed scene, also read what a moving camera is about to see
};

/// Immutable Gaussians to draw. Of a file with levels of detail (docs/format/FORMAT.md) they are the leaves or, if its
/// end is missing, the finest pages in it. Copies share them; thread-safe to read. The CPU draws FP32 arrays of
/// activated attributes, the GPU the attributes as stored in an .rgs file: each is made on first use.
///
/// A streamed scene is partly in memory: the coarsest page always, others as cameras want them. Frames draw resident
/// pages and wait for nothing; threads of the scene read and decode wanted ones, the largest projected error first. The
/// destructor of the last copy cancels the source and waits for the threads. docs/develop/STREAMING.md.
class Scene {
 public:
  Scene() = default;  ///< no Gaussians

  /// Activates training parameters: scale = exp(log_scale), opacity = sigmoid(logit), rotation normalised (all zero
  /// becomes the identity). Infinite logits are opacities of 1 and 0, a log-scale of -inf is a scale of 0. `declared`:
  /// the origin, and what with_declarations() (renderer.hpp) uses. Errors: bad_argument (sizes that contradict each
  /// other, an illegal declaration), limit_exceeded (2^31 Gaussians or more), bad_value (a NaN or another infinity;
  /// Error::offset is the index of the Gaussian).
  static Result<Scene> load(const SplatView& splats, const std::optional<Declarations>& declared = std::nullopt);
  static Result<Scene> load(const SplatCloud& splats, const std::optional<Declarations>& declared = std::nullopt) {
    return load(splats.view(), declared);
  }
  /// The same without copying the attributes.
  static Result<Scene> load(SplatCloud&& splats, const std::optional<Declarations>& declared = std::nullopt);
  /// Copies activated attributes. Rotations whose squared norm differs from 1 by more than a file's may
  /// (kUnitNormTolerance) are normalised. The origin is that of `declared`, not the view's. Errors: those above;
  /// bad_value also for a scale below 0 and an opacity outside 0..1.
  static Result<Scene> load(const SceneView& activated, const std::optional<Declarations>& declared = std::nullopt);
  /// An .rgs file: opened, validated (see validate()) and decoded on all threads. Errors: those of FileView::open(),
  /// validate() and MappedFile::open(), limit_exceeded. These two make the FP32 arrays, since the caller may free its
  /// bytes.
  static Result<Scene> load(const FileView& file);
  static Result<Scene> load(std::span<const std::byte> bytes, const DecodeLimits& limits = {});
  /// These keep the file mapped while the scene lives: a GPU takes the attributes as stored, 76 bytes a Gaussian at SH
  /// degree 3 instead of 236, and nothing else is made of them. The file must not be changed in place; it may be
  /// replaced.
  static Result<Scene> load(const std::string& path, const DecodeLimits& limits = {});
  static Result<Scene> load(MappedFile&& file, const DecodeLimits& limits = {});
  /// The same, but reads only the file's head. The first to need the Gaussians decodes and validates them:
  /// Renderer::prepare() and render(), which have the GPU do it, view() and direct(). These then return the errors of
  /// validate(). Errors: those of FileView::open() and MappedFile::open(), limit_exceeded.
  static Result<Scene> open(MappedFile&& file, const DecodeLimits& limits = {});
  /// The same of a path; what an http(s) address names is read whole and validated. With OpenOptions::pool the scene is
  /// streamed: reads the head, the start of the table of pages and the root, and starts the threads. Errors: also those
  /// of open_source(); of streamed scenes those of PagedFile::open(), missing_section (a file without levels: open it
  /// without a pool), host_out_of_memory or limit_exceeded (the pool does not hold the tables and the root;
  /// Error::expected: the bytes needed); with device memory also unavailable (no CUDA), bad_argument (the pool's scenes
  /// have another shape), device_out_of_memory, device_failed.
  static Result<Scene> open(const std::string& path_or_url, const OpenOptions& options = {});
  static Result<Scene> open(std::unique_ptr<ByteSource> source, const OpenOptions& options = {});

  std::uint64_t size() const;
  int sh_degree() const;
  /// What the .rgs file declares (depth range, anti-aliasing, ...), or load()'s `declared`; absent if neither.
  const std::optional<Declarations>& declarations() const;
  /// Origin of its means in the world of its cameras; kNoOrigin without declarations.
  const Origin& origin() const;
  /// Memory held by attributes: FP32 arrays, once made, and the decoded content of a coded file until view() or
  /// direct() first needs it. A mapped file does not count, nor what a streamed scene holds of its pool.
  std::uint64_t bytes() const;
  /// Equal for copies of one load, different for every load: a key for what renderers make of a scene.
  std::uint64_t identity() const;

  /// The FP32 arrays, 236 bytes a Gaussian at SH degree 3. The first call makes them of a kept file on all threads;
  /// others wait for it. Errors: host_out_of_memory, which leaves the scene unchanged; bad_argument (it is streamed).
  Result<SceneView> view() const;
  /// Whether the scene keeps the .rgs file that it came from, one without levels of detail.
  bool has_file() const;
  /// That file, which lives as long as the scene; null without one.
  const FileView* file() const;
  /// Whether the host has validated it: load(), or the first view() or direct() of a scene from open().
  bool is_validated() const;
  /// Whether content that load() decoded of a coded file is held for the first view() or direct().
  bool is_decoded() const;
  /// The file with levels of detail that the scene came from, which lives as long as the scene; otherwise null.
  const PagedFile* levels() const;
  /// The FP32 arrays of all present pages of levels(), page i from Gaussian lod::Page::first on. The first call decodes
  /// and validates them on all threads; view() has the leaves of the same arrays. Errors: bad_argument (no levels),
  /// those of read_pages().
  Result<SceneView> all_pages() const;
  /// The attributes as stored in the kept file (has_file()); must not outlive the scene. The first call hands over what
  /// load() decoded, later ones decode again, so that nothing unused is held. Errors: those of load_direct(), which
  /// validates if that has not been done; bad_argument without a file.
  Result<DirectData> direct() const;

  bool is_streamed() const { return streamed() != nullptr; }
  /// What has gone wrong with a streamed file, if anything: a damaged page, a server that is gone, a file that changed.
  /// Resident pages are drawn all the same, and reading continues where it can.
  Status status() const;
  /// Of all renderers; pages_missing and detail_reached_px of the last frame or refine(). Of other scenes, nothing.
  StreamStats stats() const;

 private:
  friend class Renderer;
  friend Result<SceneBounds> subject_bounds(const Scene& scene);
  struct Storage;
  explicit Scene(std::shared_ptr<detail::StreamedState> state);
  const std::shared_ptr<detail::StreamedState>& streamed() const;
  static Result<Scene> open_levels(MappedFile&& file, const DecodeLimits& limits);
  static Scene adopt(SplatCloud activated, const std::optional<Declarations>& declared);

  std::shared_ptr<const Storage> storage_;
};

/// subject_box() of its Gaussians, in the world: what views without cameras look at. Reads all of them; of a streamed
/// scene, the boxes of the pages that open() knew. Errors: those of read_chunks() and Scene::view().
Result<SceneBounds> subject_bounds(const Scene& scene);

}  // namespace rgs
