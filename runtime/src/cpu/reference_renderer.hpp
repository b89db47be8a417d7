// reference_renderer.hpp - the frame on the CPU: project, order, list, blend.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "render_options.hpp"
#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace rgs::detail {

class ReferenceRenderer {
 public:
  ReferenceRenderer(int threads, bool simd);
  ~ReferenceRenderer();
  ReferenceRenderer(const ReferenceRenderer&) = delete;
  ReferenceRenderer& operator=(const ReferenceRenderer&) = delete;

  /// Camera, settings and target are valid (the caller has checked them). Errors: limit_exceeded.
  Result<FrameStats> render(const SceneView& scene, const Camera& camera, const RenderTarget& target,
                            const FrameSettings& settings);
  const char* name() const;

 private:
  struct Workspace;
  std::unique_ptr<Workspace> workspace_;
  bool simd_;
};

}  // namespace rgs::detail
