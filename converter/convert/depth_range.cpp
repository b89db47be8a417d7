// depth_range.cpp - depth range from the near plane to a percentile of visible depth.
// SPDX-License-Identifier: Apache-2.0
#include "depth_range.hpp"

#include <algorithm>
#include <vector>

#include "rgs/camera_view.hpp"

namespace rgs {
namespace {

constexpr std::size_t kMaxCameras = 64;
constexpr std::size_t kMaxMeans = 65536;
constexpr double kNearPlane = 0.2;  // of the original 3DGS rasteriser
constexpr double kMargin = 0.1;     // cameras between and around the given ones see a little nearer and farther

}  // namespace

Result<DepthRange> depth_range_from_cameras(std::span<const Camera> cameras, std::span<const float> mean,
                                            const Origin& origin) {
  const auto points = as_points(mean);
  const glm::dvec3 centre(origin[0], origin[1], origin[2]);
  const std::size_t n = points.size();
  const std::size_t n_cameras = std::min(cameras.size(), kMaxCameras);
  const std::size_t n_means = std::min(n, kMaxMeans);
  std::vector<float> depths;
  for (std::size_t c = 0; c < n_cameras; ++c) {
    const Camera& camera = cameras[c * cameras.size() / n_cameras];
    if (const Status s = validate(camera); !s) return tl::unexpected(s.error());
    const auto view = view_of(camera, kNoOrigin, kNearPlane, 0.0);
    for (std::size_t k = 0; k < n_means; ++k) {
      const SeenPoint p = see(view, centre + glm::dvec3(points[k * n / n_means]));
      if (p.is_in_picture) depths.push_back(static_cast<float>(p.depth));
    }
  }
  if (depths.empty()) {
    return make_error(Errc::bad_argument, Error::kNone,
                      "no camera sees any Gaussian: do the cameras belong to this scene?");
  }
  const auto percentile = [&depths](std::size_t per_mille) {
    const auto at = depths.begin() + static_cast<std::ptrdiff_t>((depths.size() - 1) * per_mille / 1000);
    std::nth_element(depths.begin(), at, depths.end());
    return static_cast<double>(*at);
  };
  const double high = percentile(999);
  DepthRange range;
  // No percentile at the near end: the few Gaussians right in front of a camera cover much of its image, and those
  // below the range lose their order (one test view of 16 fell to 24 dB), while bins down to the near plane are few.
  range.z_near = static_cast<float>(kNearPlane);
  range.z_far = static_cast<float>(high * (1 + kMargin));
  range.source = DepthSource::cameras;
  return range;
}

}  // namespace rgs
