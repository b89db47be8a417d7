// bench_run.hpp - frames of one configuration on the GPU: times, counts, memory, and distance from a reference.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "rgs/cuda_renderer.hpp"
#include "rgs/image.hpp"

namespace rgs::bench {

/// One row of a table: how frames are made, and from which of the two forms of the scene.
struct Configuration {
  std::string name;
  RenderOptions options;
  bool compact = true;  ///< the file's attributes; false: FP32
};

/// The same Gaussians on the device in both forms.
struct DeviceScenes {
  DeviceScene fp32, compact;
  const DeviceScene& of(const Configuration& c) const { return c.compact ? compact : fp32; }
};

/// Means over the cameras; times are medians over the frames of each camera, by events on the stream, from the first
/// kernel to the last, the read-back of the pair count included.
struct Timing {
  FrameStats mean;
  double fastest_ms = 0, slowest_ms = 0;  ///< medians of the fastest and the slowest camera
  std::uint64_t peak_bytes = 0;           ///< scene, workspace and target
};
/// Renders `frames` frames per camera after ten unmeasured ones. Errors: those of CudaRenderer::render().
Result<Timing> measure(const Configuration& configuration, const DeviceScenes& scenes, std::span<const Camera> cameras,
                       int frames);

/// Pictures of a configuration, [height, width, 3].
Result<std::vector<Image>> pictures(const Configuration& configuration, const DeviceScenes& scenes,
                                    std::span<const Camera> cameras);

}  // namespace rgs::bench
