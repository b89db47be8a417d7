// reference_renderer.hpp - the frame on the CPU: project, order, list, blend.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <span>

#include "render_options.hpp"
#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace rgs::detail {

/// Some Gaussians, in SceneView's arrays.
struct ScenePart {
  std::uint64_t n = 0;
  const float* mean = nullptr;      ///< [n, 3]
  const float* rotation = nullptr;  ///< [n, 4]
  const float* scale = nullptr;     ///< [n, 3]
  const float* opacity = nullptr;   ///< [n]
  const float* sh = nullptr;        ///< [n, sh_coefficients(sh_degree), 3]
};
/// Gaussians first .. first + n - 1.
inline ScenePart part_of(const SceneView& scene, std::uint64_t first, std::uint64_t n) {
  const std::uint64_t sh_floats = 3 * static_cast<std::uint64_t>(sh_coefficients(scene.sh_degree));
  return {n,
          scene.mean.data() + 3 * first,
          scene.rotation.data() + 4 * first,
          scene.scale.data() + 3 * first,
          scene.opacity.data() + first,
          scene.sh.data() + sh_floats * first};
}
/// A scene in pieces, drawn as if concatenated. Fewer than 2^31 Gaussians.
struct SceneParts {
  int sh_degree = 0;
  Origin origin = kNoOrigin;
  std::span<const ScenePart> parts;
};

class ReferenceRenderer {
 public:
  ReferenceRenderer(int threads, bool simd);
  ~ReferenceRenderer();
  ReferenceRenderer(const ReferenceRenderer&) = delete;
  ReferenceRenderer& operator=(const ReferenceRenderer&) = delete;

  /// The caller has checked camera, settings and target. Errors: limit_exceeded.
  Result<FrameStats> render(const SceneParts& scene, const Camera& camera, const RenderTarget& target,
                            const FrameSettings& settings);
  const char* name() const;

 private:
  struct Workspace;
  std::unique_ptr<Workspace> workspace_;
  bool simd_;
};

}  // namespace rgs::detail
