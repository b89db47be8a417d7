// scene.hpp - Gaussians ready to be rendered.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

class MappedFile;

/// Read-only view of N activated Gaussians, structure of arrays, in the scene's world frame.
struct SceneView {
  std::uint64_t n = 0;
  int sh_degree = 0;                ///< 0..3
  std::span<const float> mean;      ///< [n, 3] world units
  std::span<const float> rotation;  ///< [n, 4] unit quaternions w, x, y, z
  std::span<const float> scale;     ///< [n, 3] standard deviations along the local axes, world units
  std::span<const float> opacity;   ///< [n] 0..1
  std::span<const float> sh;        ///< [n, sh_coefficients(sh_degree), 3]
};

/// A scene in memory: attributes are activated once, at load, and never change. Copyable and movable; reading is
/// thread-safe.
class Scene {
 public:
  Scene() = default;  ///< no Gaussians

  /// Activates training parameters: scale = exp(log_scale), opacity = sigmoid(logit), rotation normalised (all zero
  /// becomes the identity). Errors: bad_argument (sizes that contradict each other), limit_exceeded (2^31 Gaussians
  /// or more), bad_value (a non-finite attribute; Error::offset is the index of the Gaussian).
  static Result<Scene> load(const SplatView& splats);
  static Result<Scene> load(const SplatCloud& splats) { return load(splats.view()); }
  /// The same in place, without a copy of the attributes.
  static Result<Scene> load(SplatCloud&& splats);
  /// An .rgs file: opened, validated (see validate()) and decoded on all threads. Errors: those of FileView::open(), validate()
  /// and MappedFile::open(), limit_exceeded.
  static Result<Scene> load(const FileView& file);
  static Result<Scene> load(std::span<const std::byte> bytes);
  /// These keep the file mapped for as long as the scene lives, so that a GPU gets its attributes as they lie in it: 76
  /// bytes a Gaussian at SH degree 3 in place of 236. It must not be changed in place; replacing it does no harm.
  static Result<Scene> load(const std::string& path);
  static Result<Scene> load(MappedFile&& file);

  std::uint64_t size() const { return opacity_.size(); }
  int sh_degree() const { return sh_degree_; }
  /// What the .rgs file declares (depth range, anti-aliasing, ...); absent for scenes from training parameters.
  const std::optional<Declarations>& declarations() const { return declarations_; }
  std::uint64_t bytes() const;                    ///< memory held by the attributes
  std::span<const std::byte> file_bytes() const;  ///< of the .rgs file that the scene keeps; empty if it keeps none
  /// Equal for copies of one load, different for every load: lets a renderer keep what it made of a scene.
  std::uint64_t identity() const { return identity_; }
  SceneView view() const { return {size(), sh_degree_, mean_, rotation_, scale_, opacity_, sh_}; }

 private:
  static Scene adopt(SplatCloud splats);

  std::uint64_t identity_ = 0;
  int sh_degree_ = 0;
  std::optional<Declarations> declarations_;
  std::vector<float> mean_, rotation_, scale_, opacity_, sh_;
  std::shared_ptr<const MappedFile> file_;
};

}  // namespace rgs
