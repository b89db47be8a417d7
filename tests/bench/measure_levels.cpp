// measure_levels.cpp - quality of levels of detail at 1 to 8 times the distance, against the supersampled truth: prints
// the tables of docs/records/LEVELS.md.
// SPDX-License-Identifier: Apache-2.0
//
//   rgs_measure_levels SCENE CAMERAS.json [fast|best [PHOTOS|PEER]...]
//
// Views: the test cameras, of more than eight every fourth, at 1, 1/2, 1/4 and 1/8 of its size. Truth: the leaves at twice the full size, as the
// scene declares them, averaged in display values. Pages are drawn with compensated opacity and a low-pass of 0.1.
// PHOTOS: a folder with the cameras' photographs, NAME.jpg, to compare all test views with. PEER: a file with fewer
// Gaussians, made by another program from the same scene.
#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "build_levels.hpp"
#include "image_file.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/renderer.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/spatial_order.hpp"

namespace {

using rgs::Camera;
using rgs::Scene;
using rgs::SplatCloud;
using rgs::lod::Levels;
using rgs::lod::Page;

template <class T>
T value_or_stop(rgs::Result<T> result) {
  if (!result) {
    std::fprintf(stderr, "rgs_measure_levels: %s\n", result.error().what);
    std::exit(2);
  }
  return *std::move(result);
}

Camera scaled(Camera camera, double by) {
  camera.fx *= by, camera.fy *= by, camera.cx *= by, camera.cy *= by;
  camera.width = static_cast<int>(std::lround(camera.width * by));
  camera.height = static_cast<int>(std::lround(camera.height * by));
  return camera;
}

// Averages squares of factor x factor pixels; drops incomplete squares at the edges.
std::vector<float> averaged(const std::vector<float>& pixels, int full_width, int full_height, int factor) {
  const int width = full_width / factor, height = full_height / factor;
  std::vector<float> out;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < 3 * width; ++x) {
      double total = 0;
      for (int j = 0; j < factor; ++j) {
        for (int i = 0; i < factor; ++i) {
          const int column = 3 * (x / 3 * factor + i) + x % 3;
          total += static_cast<double>(pixels[static_cast<std::size_t>((y * factor + j) * 3 * full_width + column)]);
        }
      }
      out.push_back(static_cast<float>(total / (factor * factor)));
    }
  }
  return out;
}

double psnr(const std::vector<float>& pixels, const std::vector<float>& truth) {
  double squared = 0;
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    const double d = static_cast<double>(pixels[i]) - static_cast<double>(truth[i]);
    squared += d * d;
  }
  return -10 * std::log10(squared / static_cast<double>(pixels.size()));
}

class Measure {
 public:
  Measure(const Scene& leaves, std::vector<Camera> cameras) : cameras_(std::move(cameras)) {
    for (std::size_t v = 0; v < cameras_.size(); ++v) {
      const Camera large = scaled(cameras_[v], 2);
      const std::vector<float> pixels = draw(leaves, large, {});
      for (const int factor : {2, 4, 8, 16})
        truth_[{v, factor / 2}] = averaged(pixels, large.width, large.height, factor);
    }
  }
  std::vector<float> draw(const Scene& scene, const Camera& camera, const rgs::RenderOptions& options) {
    std::vector<float> pixels(static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height) * 3);
    rgs::RenderTarget target;
    target.rgb = pixels;
    value_or_stop(renderer_.render(scene, camera, target, options));
    for (float& x : pixels) x = std::clamp(x, 0.F, 1.F);
    return pixels;
  }
  const std::vector<Camera>& cameras() const { return cameras_; }
  double compare(const std::vector<float>& pixels, std::size_t view, int far) const {
    return psnr(pixels, truth_.at({view, far}));
  }
  /// Mean PSNR of a scene over all views.
  double compare(const Scene& scene, int far, const rgs::RenderOptions& options) {
    double total = 0;
    for (std::size_t v = 0; v < cameras_.size(); ++v) {
      total += compare(draw(scene, scaled(cameras_[v], 1.0 / far), options), v, far);
    }
    return total / static_cast<double>(cameras_.size());
  }

 private:
  rgs::Renderer renderer_ = value_or_stop(rgs::Renderer::create({rgs::Backend::cpu}));
  std::vector<Camera> cameras_;
  std::map<std::pair<std::size_t, int>, std::vector<float>> truth_;
};

// A page's footprint in a view, see docs/develop/LEVELS.md.
float footprint(const Page& page, const Camera& camera) {
  const auto eye = rgs::camera_centre(camera);
  return static_cast<float>(
      rgs::lod::footprint(page.core, {{eye[0], eye[1], eye[2]}, std::max(camera.fx, camera.fy), 0.2}));
}

bool is_drawn(const Levels& levels, const Page& page, const Camera& camera, float detail) {
  const auto fine = [&](const Page& p) { return p.error <= detail * footprint(p, camera); };
  return fine(page) && (page.parent == rgs::lod::kNoPage || !fine(levels.pages[page.parent]));
}

double drawn_of(const Levels& levels, const Camera& camera, float detail) {
  double n = 0;
  for (const Page& page : levels.pages) n += is_drawn(levels, page, camera, detail) ? page.count : 0;
  return n;
}

Scene cut(const Levels& levels, const Camera& camera, float detail, std::array<std::uint64_t, 8>& by_level) {
  SplatCloud out;
  out.resize(0, levels.splats.sh_degree);
  const auto n_sh = static_cast<std::ptrdiff_t>(3 * rgs::sh_coefficients(out.sh_degree));
  for (const Page& page : levels.pages) {
    if (!is_drawn(levels, page, camera, detail)) continue;
    by_level[std::min<std::uint32_t>(page.level, 7)] += page.count;
    const auto copy = [&page](const std::vector<float>& from, std::ptrdiff_t width, std::vector<float>& to) {
      const auto first = static_cast<std::ptrdiff_t>(page.first), n = static_cast<std::ptrdiff_t>(page.count);
      to.insert(to.end(), from.begin() + first * width, from.begin() + (first + n) * width);
    };
    copy(levels.splats.mean, 3, out.mean);
    copy(levels.splats.log_scale, 3, out.log_scale);
    copy(levels.splats.rotation, 4, out.rotation);
    copy(levels.splats.opacity_logit, 1, out.opacity_logit);
    copy(levels.splats.sh, n_sh, out.sh);
  }
  return value_or_stop(Scene::load(std::move(out)));
}

Scene level(const Levels& levels, std::uint32_t wanted) {
  SplatCloud out;
  std::vector<rgs::Splat> rows;
  for (const Page& page : levels.pages) {
    if (page.level != wanted) continue;
    for (std::uint64_t i = page.first; i < page.first + page.count; ++i) rows.push_back(levels.splats.view().splat(i));
  }
  out.resize(rows.size(), levels.splats.sh_degree);
  for (std::size_t i = 0; i < rows.size(); ++i) out.set(i, rows[i]);
  return value_or_stop(Scene::load(std::move(out)));
}

// In the order of a file, in which levels are built.
SplatCloud sorted(const rgs::SplatView& splats) {
  rgs::SceneScan scan(splats.sh_degree);
  std::vector<std::uint32_t> rows;
  for (std::uint32_t i = 0; i < splats.n; ++i) {
    rgs::Splat splat = splats.splat(i);
    if (scan.add(splat)) rows.push_back(i);
  }
  const rgs::MortonKey key(scan.robust());
  std::vector<std::uint64_t> keys;
  keys.reserve(rows.size());
  for (const std::uint32_t row : rows) keys.push_back(key(&splats.mean[3 * std::size_t{row}]));
  rgs::sort_by_key(keys, rows);
  SplatCloud out;
  out.resize(rows.size(), splats.sh_degree);
  for (std::size_t i = 0; i < rows.size(); ++i) out.set(i, splats.splat(rows[i]));
  return out;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 3)
    return std::fprintf(stderr, "usage: rgs_measure_levels SCENE CAMERAS.json [fast|best [PHOTOS|PEER]...]\n"), 2;
  auto file = value_or_stop(rgs::read_splats(argv[1]));
  file.cloud = sorted(file.cloud.view());
  const auto set = value_or_stop(rgs::read_camera_set(argv[2]));
  rgs::lod::BuildOptions options;
  if (argc > 3 && std::string(argv[3]) == "best") options.quality = rgs::lod::Quality::best;
  std::vector<Camera> cameras;
  const int every = std::ranges::count(set.split, rgs::Split::test) > 8 ? 4 : 1;
  for (std::size_t i = 0, test = 0; i < set.cameras.size(); ++i) {
    if (set.split[i] == rgs::Split::test && static_cast<int>(test++) % every == 0) cameras.push_back(set.cameras[i]);
  }
  const Scene leaves = value_or_stop(Scene::load(file.cloud, file.declarations));
  Measure measure(leaves, cameras);
  const auto start = std::chrono::steady_clock::now();
  const Levels levels = rgs::lod::build_levels(file.cloud.view(), options);
  const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - start;
  std::printf("built in %.1f s: %zu pages, %.3f Gaussians stored a source Gaussian\n", taken.count(),
              levels.pages.size(), static_cast<double>(levels.splats.size()) / static_cast<double>(leaves.size()));
  rgs::RenderOptions mip;
  mip.anti_aliasing = rgs::math::AntiAliasing::mip_splatting;
  mip.low_pass = 0.1F;
  const auto n = static_cast<double>(leaves.size());
  for (std::uint32_t l = 0; l <= levels.pages.front().level; ++l) {
    std::vector<float> errors;
    for (const Page& page : levels.pages) {
      if (page.level == l) errors.push_back(page.error);
    }
    std::sort(errors.begin(), errors.end());
    const Scene scene = l == 0 ? leaves : level(levels, l);
    std::printf("level %u: %zu pages, %.4f of the Gaussians, error %.3g (%.3g to %.3g);", l, errors.size(),
                static_cast<double>(scene.size()) / n, static_cast<double>(errors[errors.size() / 2]),
                static_cast<double>(errors.front()), static_cast<double>(errors.back()));
    if (l < 4) {
      for (const int far : {1, 2, 4, 8}) std::printf(" %.2f", measure.compare(scene, far, mip));
    }
    std::printf("\n");
    std::fflush(stdout);
  }
  std::printf("leaves as declared:");
  for (const int far : {1, 2, 4, 8}) std::printf(" %.2f", measure.compare(leaves, far, {}));
  std::printf("\n");
  for (const float detail : {0.5F, 1.F, 2.F, 4.F}) {
    for (const int far : {1, 2, 4, 8}) {
      double db = 0, drawn = 0;
      std::array<std::uint64_t, 8> by_level{};
      for (std::size_t v = 0; v < cameras.size(); ++v) {
        const Camera camera = scaled(cameras[v], 1.0 / far);
        const Scene scene = cut(levels, camera, detail, by_level);
        drawn += static_cast<double>(scene.size());
        db += measure.compare(measure.draw(scene, camera, mip), v, far);
      }
      const auto views = static_cast<double>(cameras.size());
      std::printf("detail %g, %dx: %.2f dB, %.3f of the Gaussians; of levels", static_cast<double>(detail), far,
                  db / views, drawn / views / n);
      for (const std::uint64_t count : by_level) std::printf(" %.3f", static_cast<double>(count) / views / n);
      std::printf("\n");
      std::fflush(stdout);
    }
  }
  // The detail at which the views draw at most a given share of all Gaussians, on average.
  for (const auto& [far, share] : {std::pair{4, 0.25}, std::pair{8, 0.125}}) {
    float least = 1.F / 16, most = 64;
    std::array<std::uint64_t, 8> by_level{};
    const auto drawn_at = [&, far = far](float detail) {
      double drawn = 0;
      for (const Camera& camera : cameras) drawn += drawn_of(levels, scaled(camera, 1.0 / far), detail);
      return drawn / static_cast<double>(cameras.size()) / n;
    };
    for (int k = 0; k < 20; ++k) {
      const float middle = std::sqrt(least * most);
      (drawn_at(middle) > share ? least : most) = middle;
    }
    double db = 0;
    for (std::size_t v = 0; v < cameras.size(); ++v) {
      const Camera camera = scaled(cameras[v], 1.0 / far);
      db += measure.compare(measure.draw(cut(levels, camera, most, by_level), camera, mip), v, far);
    }
    std::printf("at most %g of the Gaussians, %dx: detail %.2f, %.2f dB, %.3f\n", share, far, static_cast<double>(most),
                db / static_cast<double>(cameras.size()), drawn_at(most));
    std::fflush(stdout);
  }
  for (int arg = 4; arg < argc; ++arg) {
    if (!std::filesystem::is_directory(argv[arg])) {
      const Scene peer =
          value_or_stop(Scene::load(value_or_stop(rgs::read_splats(argv[arg])).cloud, file.declarations));
      std::printf("%s: %.4f of the Gaussians;", argv[arg], static_cast<double>(peer.size()) / n);
      for (const int far : {1, 2, 4, 8}) std::printf(" %.2f", measure.compare(peer, far, mip));
      std::printf("\n");
      continue;
    }
    // From afar, the averaged photograph is the truth.
    for (const int far : {1, 2, 4, 8}) {
      double db[4] = {};
      int n_views = 0;
      for (std::size_t i = 0; i < set.cameras.size(); ++i) {
        if (set.split[i] != rgs::Split::test) continue;
        const rgs::Image photo =
            value_or_stop(rgs::read_image(std::string(argv[arg]) + "/" + set.cameras[i].name + ".jpg"));
        const std::vector<float> truth = averaged(photo.pixels, photo.width, photo.height, far);
        const Camera camera = scaled(set.cameras[i], 1.0 / far);
        rgs::RenderOptions wide = mip;
        wide.low_pass = 0.3F;
        std::array<std::uint64_t, 8> by_level{};
        db[0] += psnr(measure.draw(leaves, camera, {}), truth);
        db[1] += psnr(measure.draw(leaves, camera, wide), truth);
        db[2] += psnr(measure.draw(leaves, camera, mip), truth);
        db[3] += psnr(measure.draw(cut(levels, camera, 1, by_level), camera, mip), truth);
        ++n_views;
      }
      std::printf("photographs, %dx: as declared %.3f, mip 0.3 %.3f, mip 0.1 %.3f, detail 1 %.3f dB\n", far,
                  db[0] / n_views, db[1] / n_views, db[2] / n_views, db[3] / n_views);
      std::fflush(stdout);
    }
  }
  return 0;
}
