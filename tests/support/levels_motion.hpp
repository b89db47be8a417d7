// levels_motion.hpp - a scene with levels of detail along a camera path, against the truth.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "orbit_motion.hpp"
#include "rgs/renderer.hpp"

namespace rgs::test {

/// One way of drawing along the path.
struct MotionRow {
  bench::OrbitRow whole;             ///< over all frames; `added` is not filled in
  std::vector<bench::Change> steps;  ///< from each frame to the next
  double drawn = 0;                  ///< drawn share of the Gaussians, mean over the frames
  int n_changes = 0;                 ///< of that share, from frame to frame
};

/// Truth: all Gaussians as the scene declares, at `supersampling` times the size, averaged, values clamped to 0..1.
class LevelsMotion {
 public:
  LevelsMotion(const Scene& scene, int supersampling, int threads = 0)
      : scene_(scene), supersampling_(supersampling), renderer_(Renderer::create({Backend::cpu, threads}).value()) {}

  Result<MotionRow> truth(std::span<const Camera> path) {
    return follow("truth", path, [this](const Camera& camera, std::uint64_t& n) -> Result<Image> {
      Camera large = camera;
      large.width *= supersampling_, large.height *= supersampling_;
      large.fx *= supersampling_, large.fy *= supersampling_, large.cx *= supersampling_, large.cy *= supersampling_;
      RenderOptions options;
      options.detail_px = 0;
      auto picture = draw(large, options, n);
      if (!picture) return picture;
      return averaged(*picture);
    });
  }
  Result<MotionRow> levels(std::span<const Camera> path, float detail_px) {
    return levels(path, std::vector<float>(path.size(), detail_px));
  }
  /// `detail_px` [frames].
  Result<MotionRow> levels(std::span<const Camera> path, const std::vector<float>& detail_px) {
    std::size_t frame = 0;
    return follow("levels", path, [&](const Camera& camera, std::uint64_t& n) {
      RenderOptions options;
      options.detail_px = detail_px[frame++];
      return draw(camera, options, n);
    });
  }
  /// All Gaussians, drawn like levels: the steps that remain when no page changes.
  Result<MotionRow> leaves(std::span<const Camera> path) {
    return follow("leaves", path, [this](const Camera& camera, std::uint64_t& n) {
      RenderOptions options;
      options.detail_px = 0;
      options.anti_aliasing = math::AntiAliasing::mip_splatting;
      options.low_pass = default_low_pass_px2(AaMode::mip_splatting);
      return draw(camera, options, n);
    });
  }

 private:
  template <class Draw>
  Result<MotionRow> follow(const std::string& name, std::span<const Camera> path, const Draw& draw_one) {
    MotionRow row;
    bench::MotionMeter whole;
    std::vector<float> last;
    std::uint64_t n_before = 0;
    for (const Camera& camera : path) {
      std::uint64_t n = 0;
      auto picture = draw_one(camera, n);
      if (!picture) return tl::unexpected(picture.error());
      whole.add(picture->pixels);
      if (!last.empty()) {
        row.n_changes += n != n_before ? 1 : 0;
        bench::MotionMeter pair;
        pair.add(last);
        pair.add(picture->pixels);
        row.steps.push_back(pair.step());
      }
      last = std::move(picture->pixels);
      n_before = n;
      row.drawn += static_cast<double>(n) / static_cast<double>(scene_.size()) / static_cast<double>(path.size());
    }
    row.whole = {name, whole.step(), whole.second(), {}};
    return row;
  }

  Result<Image> draw(const Camera& camera, const RenderOptions& options, std::uint64_t& n) {
    Image image = Image::make(camera.width, camera.height, 3);
    const auto stats = renderer_.render(scene_, camera, {.rgb = image.pixels}, options);
    if (!stats) return tl::unexpected(stats.error());
    n = stats->gaussians;
    for (float& v : image.pixels) v = std::clamp(v, 0.0F, 1.0F);
    return image;
  }

  Image averaged(const Image& large) const {
    Image out = Image::make(large.width / supersampling_, large.height / supersampling_, 3);
    const float share = 1 / static_cast<float>(supersampling_ * supersampling_);
    for (int y = 0; y < large.height; ++y)
      for (int x = 0; x < large.width; ++x)
        for (int c = 0; c < 3; ++c) out.at(x / supersampling_, y / supersampling_, c) += share * large.at(x, y, c);
    return out;
  }

  Scene scene_;
  int supersampling_;
  Renderer renderer_;
};

}  // namespace rgs::test
