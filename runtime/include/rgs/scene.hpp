// scene.hpp - Gaussians ready to be rendered.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>

#include "rgs/decode.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

class MappedFile;
class PagedFile;

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

/// Gaussians to be drawn, which never change. Of a file with levels of detail (docs/format/FORMAT.md) they are the leaves, or, if its end
/// is missing, the finest that is there. Copies share them; reading is thread-safe. The CPU draws FP32 arrays of
/// activated attributes, the GPU an .rgs file's attributes as they lie in it: each is made when it is first asked for.
class Scene {
 public:
  Scene() = default;  ///< no Gaussians

  /// Activates training parameters: scale = exp(log_scale), opacity = sigmoid(logit), rotation normalised (all zero
  /// becomes the identity). Infinite logits are opacities of 1 and 0, a log-scale of -inf is a scale of 0. `declared` is
  /// what is known of them otherwise: their origin, and the rest for with_declarations() (renderer.hpp).
  /// Errors: bad_argument (sizes that contradict each other, an illegal declaration), limit_exceeded (2^31 Gaussians or
  /// more), bad_value (a NaN or another infinity; Error::offset is the index of the Gaussian).
  static Result<Scene> load(const SplatView& splats, const std::optional<Declarations>& declared = std::nullopt);
  static Result<Scene> load(const SplatCloud& splats, const std::optional<Declarations>& declared = std::nullopt) {
    return load(splats.view(), declared);
  }
  /// The same in place, without a copy of the attributes.
  static Result<Scene> load(SplatCloud&& splats, const std::optional<Declarations>& declared = std::nullopt);
  /// A copy of attributes that are activated already. Rotations whose squared norm is farther from 1 than a file's may be
  /// (kUnitNormTolerance) are normalised. The origin is that of `declared`, not the view's. Errors: those above; bad_value also for a
  /// scale below 0 and an opacity outside 0..1.
  static Result<Scene> load(const SceneView& activated, const std::optional<Declarations>& declared = std::nullopt);
  /// An .rgs file: opened, validated (see validate()) and decoded on all threads. Errors: those of FileView::open(),
  /// validate() and MappedFile::open(), limit_exceeded. These make the FP32 arrays, for the caller's bytes may go.
  static Result<Scene> load(const FileView& file);
  static Result<Scene> load(std::span<const std::byte> bytes, const DecodeLimits& limits = {});
  /// These keep the file mapped for as long as the scene lives: a GPU gets the attributes as they lie in it, 76 bytes a
  /// Gaussian at SH degree 3 in place of 236, and nothing else is made of them. It must not be changed in place;
  /// replacing it does no harm.
  static Result<Scene> load(const std::string& path, const DecodeLimits& limits = {});
  static Result<Scene> load(MappedFile&& file, const DecodeLimits& limits = {});
  /// The same without reading more of the file than its head. Whoever needs the Gaussians first decodes and validates them:
  /// Renderer::prepare() and render(), which let a GPU do it, view() and direct(). They return the errors of validate()
  /// then. Errors: those of FileView::open() and MappedFile::open(), limit_exceeded.
  static Result<Scene> open(const std::string& path, const DecodeLimits& limits = {});
  static Result<Scene> open(MappedFile&& file, const DecodeLimits& limits = {});

  std::uint64_t size() const;
  int sh_degree() const;
  /// What the .rgs file declares (depth range, anti-aliasing, ...), or what load() was told; absent if neither.
  const std::optional<Declarations>& declarations() const;
  /// That its means are relative to, in the world of its cameras; kNoOrigin without declarations.
  const Origin& origin() const;
  /// Memory held by attributes: FP32 arrays, if they are made by now, and what is decoded of a coded file until view()
  /// or direct() first needs it. A mapped file is not counted.
  std::uint64_t bytes() const;
  /// Equal for copies of one load, different for every load: lets a renderer keep what it made of a scene.
  std::uint64_t identity() const;

  /// The FP32 arrays, 236 bytes a Gaussian at SH degree 3, which the first call makes of a kept file on all threads; others
  /// wait for it. Errors: host_out_of_memory; the scene is what it was then.
  Result<SceneView> view() const;
  /// Whether the scene keeps the .rgs file that it came from, and that is one without levels of detail.
  bool has_file() const;
  /// That file; null without one. It lives as long as the scene.
  const FileView* file() const;
  /// Whether the host has validated it: load(), or the first view() or direct() of a scene from open().
  bool is_validated() const;
  /// Whether what load() has decoded of a coded file waits for the first view() or direct().
  bool is_decoded() const;
  /// The file with levels of detail that the scene came from, which it keeps; null otherwise. It lives as long as the scene.
  const PagedFile* levels() const;
  /// The Gaussians of these pages of levels(), one page after the other, as a scene of their own with the same declarations. The
  /// first call decodes and validates all pages on all threads, and keeps them: 236 bytes a Gaussian at SH degree 3.
  /// Errors: bad_argument (no levels, or no such page), those of read_pages().
  Result<Scene> pages(std::span<const std::uint32_t> pages) const;
  /// The attributes as they lie in the kept file, where there is one (has_file()); they must not outlive the scene. The
  /// first call gives away what load() decoded, others decode it again: nobody holds what nobody uses. Errors: those of
  /// load_direct(), which validates if that has not been done; bad_argument without a file.
  Result<DirectData> direct() const;

 private:
  struct Storage;
  static Result<Scene> open_levels(MappedFile&& file, const DecodeLimits& limits);
  static Scene adopt(SplatCloud activated, const std::optional<Declarations>& declared);

  std::shared_ptr<const Storage> storage_;
};

}  // namespace rgs
