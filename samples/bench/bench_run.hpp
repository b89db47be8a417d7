// bench_run.hpp - frames of one configuration on the GPU: times, counts, memory, pictures; and what GPU it is.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <limits>
#include <span>
#include <vector>

#include "bench_modes.hpp"
#include "bench_report.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/image.hpp"

namespace rgs::bench {

/// The same Gaussians on the device in both forms, as far as they are drawn.
struct DeviceScenes {
  DeviceScene fp32, compact;
  const DeviceScene& of(const Configuration& c) const { return c.compact ? compact : fp32; }
};

/// How long a measurement may go on.
struct Effort {
  int frames = 100;  ///< for each time of each camera, at most
  /// For all of a row, about: a frame that takes longer is still measured once for each time.
  double seconds = std::numeric_limits<double>::infinity();
};

/// Renders frames of each camera after ten unmeasured ones, or fewer if `effort` has no time for more: some for the times
/// of the stages, as many for the total, as many one at a time and as many back to back for the times from outside.
/// Errors: those of CudaRenderer::render().
Result<Timing> measure(const Configuration& configuration, const DeviceScenes& scenes, std::span<const Camera> cameras,
                       const Effort& effort);

/// Pictures of a configuration, FP32 [height, width, 3].
Result<std::vector<Image>> pictures(const Configuration& configuration, const DeviceScenes& scenes,
                                    std::span<const Camera> cameras);

/// `frames` frames of every mode, steps between modes left out, on an arc around what `camera` looks at in the first one;
/// `degrees` from one to the next. Errors: those of CudaRenderer::render().
Result<OrbitReport> orbit(std::span<const Configuration> modes, const DeviceScenes& scenes, const Camera& camera,
                          double degrees, int frames);

/// The current device. Errors: unavailable.
Result<DeviceInfo> device_info();

}  // namespace rgs::bench
