// audit_distances.cpp - levels of detail at a distance: truth, all Gaussians, and the pages that a view chooses.
// SPDX-License-Identifier: Apache-2.0
#include "audit_distances.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <limits>
#include <utility>

#include "audit_picture.hpp"
#include "audit_scenes.hpp"
#include "rgs/image_metrics.hpp"

namespace rgs::audit {
namespace {

constexpr int kSupersampling = 2;

// The same view with `by` / `per` times as many pixels a side; drops partial pixels at the right and lower edges, as
// box_filtered() does.
Camera scaled(Camera camera, int by, int per) {
  const double scale = static_cast<double>(by) / per;
  camera.fx *= scale, camera.fy *= scale, camera.cx *= scale, camera.cy *= scale;
  camera.width = camera.width * by / per;
  camera.height = camera.height * by / per;
  return camera;
}

Image box_filtered(const Image& image, int factor) {
  Image out = Image::make(image.width / factor, image.height / factor, image.channels);
  for (int y = 0; y < out.height; ++y) {
    for (int x = 0; x < out.width; ++x) {
      for (int c = 0; c < image.channels; ++c) {
        double sum = 0;
        for (int j = 0; j < factor; ++j)
          for (int i = 0; i < factor; ++i) sum += static_cast<double>(image.at(x * factor + i, y * factor + j, c));
        out.at(x, y, c) = static_cast<float>(sum / (factor * factor));
      }
    }
  }
  return out;
}

std::uint64_t truth_bytes(const Camera& camera) {
  return 2 * 4 * 3 * sizeof(float) * static_cast<std::uint64_t>(camera.width) *
         static_cast<std::uint64_t>(camera.height) / 3;  // 1 + 1/4 + 1/16 + ...
}

class DistanceAudit {
 public:
  DistanceAudit(const RenderInputs& inputs, const Options& options, std::span<const Camera> cameras,
                tool::Progress& progress)
      : inputs_(inputs), options_(options), cameras_(cameras), progress_(progress) {}

  Outcome<DistanceReport> run() {
    const auto start = std::chrono::steady_clock::now();
    report_.detail_px = kDefaultDetailPx;
    choose_distances();
    if (report_.rows.empty()) return std::move(report_);
    auto renderer = Renderer::create({.backend = options_.backend, .threads = options_.threads});
    if (!renderer) return make_error("", renderer.error());
    renderer_.emplace(std::move(*renderer));
    progress_.begin("levels", cameras_.size() * (1 + kFarScenes * report_.rows.size()), "frames");
    for (std::size_t first = 0; first < cameras_.size();) {
      std::size_t end = first;
      for (std::uint64_t bytes = 0; end < cameras_.size(); ++end) {
        bytes += truth_bytes(cameras_[end]);
        if (end > first && bytes > options_.picture_bytes) break;
      }
      if (auto ok = batch(first, end); !ok) return tl::unexpected(ok.error());
      first = end;
    }
    progress_.finish();
    summarise();
    report_.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    return std::move(report_);
  }

 private:
  using Done = Outcome<void>;

  void choose_distances() {
    int least = std::numeric_limits<int>::max(), most = 0;
    for (const Camera& camera : cameras_) {
      least = std::min({least, camera.width, camera.height});
      most = std::max({most, camera.width, camera.height});
    }
    if (cameras_.empty()) {
      report_.note = "no view shows the scene";
    } else if (most * kSupersampling > kMaxImageSide) {
      report_.note = fmt::format("the truth would be more than {} pixels wide", kMaxImageSide);
    } else {
      for (int far = 1; least / far >= kLeastSide; far *= 2) report_.rows.push_back({far});
      if (report_.rows.size() < kDistances.size())
        report_.note = fmt::format("farther away, views are less than {} pixels wide or high", kLeastSide);
    }
    report_.pictures.resize(report_.rows.size());
  }

  // Views [first, end): all pictures of the source, then all of the asset, so that only one of them is in memory.
  Done batch(std::size_t first, std::size_t end) {
    std::vector<std::vector<Picture>> truths;  // [view][row]
    {
      auto source = source_scene(*inputs_.source);
      if (!source) return make_error(options_.source, source.error());
      const RenderOptions as_source =
          reference_arithmetic(inputs_.source_stated ? inputs_.source_stated : inputs_.declared);
      for (std::size_t i = first; i < end; ++i) {
        auto large = render(source->scene, scaled(cameras_[i], kSupersampling, 1), as_source);
        if (!large) return tl::unexpected(large.error());
        std::vector<Picture>& truth = truths.emplace_back();
        for (const FarRow& row : report_.rows)
          truth.push_back({box_filtered(large->picture.black, kSupersampling * row.far),
                           box_filtered(large->picture.white, kSupersampling * row.far)});
      }
    }
    const auto scene = Scene::load(options_.asset, options_.read.limits);
    if (!scene) return make_error(options_.asset, scene.error());
    // By content, not by view: the renderer caches the last pages.
    for (std::size_t i = first; i < end; ++i) {
      for (std::size_t row = 0; row < report_.rows.size(); ++row) {
        if (auto ok = compare(*scene, i, row, std::move(truths[i - first][row])); !ok) return ok;
      }
    }
    return {};
  }

  RenderOptions options_of(FarScene what) const {
    return what == FarScene::leaves ? reference_arithmetic(inputs_.declared)
                                    : levels_arithmetic(what == FarScene::levels ? report_.detail_px : 0.0F);
  }

  Done compare(const Scene& scene, std::size_t view, std::size_t row, Picture truth) {
    FarRow& r = report_.rows[row];
    const Camera camera = scaled(cameras_[view], 1, r.far);
    FarView result{camera.name, camera.width, camera.height};
    std::array<Picture, kFarScenes> images;
    for (std::size_t k = 0; k < kFarScenes; ++k) {
      auto frame = render(scene, camera, options_of(static_cast<FarScene>(k)));
      if (!frame) return tl::unexpected(frame.error());
      images[k] = std::move(frame->picture);
      const auto d = difference(truth, images[k]);
      const auto s = ssim(truth, images[k]);
      if (!d || !s) return make_error("view " + camera.name, d ? s.error() : d.error());
      result.psnr[k] = d->psnr;
      result.ssim[k] = *s;
      if (static_cast<FarScene>(k) == FarScene::levels)
        result.drawn = static_cast<double>(frame->n_gaussians) / static_cast<double>(scene.size());
    }
    keep(row, result, std::move(truth), std::move(images));
    r.views.push_back(std::move(result));
    return {};
  }

  void keep(std::size_t row, const FarView& result, Picture truth, std::array<Picture, kFarScenes> images) {
    constexpr auto kLevels = static_cast<std::size_t>(FarScene::levels);
    FarPictures& kept = report_.pictures[row];
    const FarRow& r = report_.rows[row];
    if (!r.views.empty() && r.views[kept.view].psnr[kLevels] <= result.psnr[kLevels]) return;
    const bool over_white = shows_more_over_white(truth, images[kLevels]);
    kept = {row,
            r.views.size(),
            std::move(truth),
            std::move(images[static_cast<std::size_t>(FarScene::leaves)]),
            std::move(images[kLevels]),
            over_white};
  }

  void summarise() {
    for (FarRow& row : report_.rows) {
      const auto n = static_cast<double>(row.views.size());
      for (std::size_t k = 0; k < kFarScenes; ++k) {
        std::vector<double> psnr;
        FarScore& score = row.scores[k];
        score.worst_ssim = 1;
        for (const FarView& view : row.views) {
          psnr.push_back(view.psnr[k]);
          score.ssim += view.ssim[k] / n;
          score.worst_ssim = std::min(score.worst_ssim, view.ssim[k]);
        }
        score.psnr = mean_psnr(psnr);
        score.worst_psnr = *std::min_element(psnr.begin(), psnr.end());
      }
      for (const FarView& view : row.views) row.drawn += view.drawn / n;
    }
  }

  struct Frame {
    Picture picture;
    std::uint64_t n_gaussians = 0;
  };

  // Clamped to what a screen can show.
  Outcome<Frame> render(const Scene& scene, const Camera& camera, const RenderOptions& how) {
    Image image = Image::make(camera.width, camera.height, 3);
    std::vector<float> alpha(image.pixels.size() / 3);
    const auto stats = renderer_->render(scene, camera, {.rgb = image.pixels, .alpha = alpha}, how);
    if (!stats) return make_error("view " + camera.name, stats.error());
    Frame frame{over_backgrounds(std::move(image), alpha), stats->gaussians};
    for (Image* over : {&frame.picture.black, &frame.picture.white})
      for (float& v : over->pixels) v = std::clamp(v, 0.0F, 1.0F);
    progress_.advance(1);
    return frame;
  }

  const RenderInputs& inputs_;
  const Options& options_;
  std::span<const Camera> cameras_;
  tool::Progress& progress_;
  std::optional<Renderer> renderer_;
  DistanceReport report_;
};

}  // namespace

const FarRow* DistanceReport::at(int far) const {
  const auto found = std::find_if(rows.begin(), rows.end(), [far](const FarRow& row) { return row.far == far; });
  return found == rows.end() ? nullptr : &*found;
}

double FarView::loss() const {
  const auto of = [this](FarScene what) { return psnr[static_cast<std::size_t>(what)]; };
  return std::min(kEnoughDb, of(FarScene::compensated)) - std::min(kEnoughDb, of(FarScene::levels));
}

DistanceReport::Worst DistanceReport::worst() const {
  Worst out;
  for (const FarRow& row : rows)
    for (const FarView& view : row.views)
      if (const double loss = view.loss(); !(loss <= out.loss))
        out = {loss, view.psnr[static_cast<std::size_t>(FarScene::levels)], row.far, view.name};
  return out;
}

Outcome<DistanceReport> compare_distances(const RenderInputs& inputs, const Options& options,
                                          std::span<const Camera> cameras, tool::Progress& progress) {
  return DistanceAudit(inputs, options, cameras, progress).run();
}

}  // namespace rgs::audit
