// audit_render.cpp - renders scene by scene over a batch of views, so that few scenes and pictures are in memory.
// SPDX-License-Identifier: Apache-2.0
#include "audit_render.hpp"

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <functional>
#include <limits>
#include <numeric>
#include <optional>
#include <utility>

#include "audit_picture.hpp"
#include "audit_scenes.hpp"
#include "audit_search.hpp"
#include "audit_video.hpp"
#include "rgs/ablation.hpp"
#include "rgs/camera_view.hpp"
#include "rgs/image_metrics.hpp"
#include "scene_file.hpp"

namespace rgs::audit {
namespace {

constexpr std::uint64_t kKeptBytes = std::uint64_t{512} << 20;  // pictures of the worst views
constexpr std::size_t kKeptViews = 6;
constexpr double kSearchSide = 160;  // pixels of a searched view, the longer side

std::uint64_t picture_bytes(const Camera& camera) {
  return 7 * sizeof(float) * static_cast<std::uint64_t>(camera.width) * static_cast<std::uint64_t>(camera.height);
}

RenderOptions with_key(RenderOptions options) {
  options.paper.depth_order = math::DepthOrder::quantized;
  return options;
}
RenderOptions with_exp(RenderOptions options) {
  options.paper.exp = math::Exp::zero_mean;
  return options;
}
RenderOptions with_lists(RenderOptions options) {
  options.paper.extent = math::Extent::ellipse;
  options.paper.exponent = math::Exponent::folded;
  return options;
}

Image clamped(const Image& image) {
  Image out = image;
  for (float& v : out.pixels) v = std::clamp(v, 0.0F, 1.0F);
  return out;
}

// Share of the pixels that Gaussians touch, however faintly.
double drawn_share(std::span<const float> alpha) {
  const auto n = std::count_if(alpha.begin(), alpha.end(), [](float a) { return a > 0; });
  return static_cast<double>(n) / static_cast<double>(alpha.size());
}

Image minus(const Image& a, const Image& b) {
  Image out = a;
  for (std::size_t i = 0; i < out.pixels.size(); ++i) out.pixels[i] -= b.pixels[i];
  return out;
}

std::optional<double> worse(const std::optional<double>& a, const std::optional<double>& b, bool at_least) {
  return !a || (b && (at_least ? *b < *a : *b > *a)) ? b : a;
}

struct Series {
  std::string key, name;
  std::vector<double> psnr{}, mse{}, loss{};
  void add(double view_psnr, double view_mse, double view_loss) {
    psnr.push_back(view_psnr);
    mse.push_back(view_mse);
    loss.push_back(view_loss);
  }
};

class PictureAudit {
 public:
  PictureAudit(const RenderInputs& inputs, const Options& options, tool::Progress& progress)
      : inputs_(inputs), options_(options), progress_(progress) {}

  Outcome<RenderReport> run(std::span<AlsoReport> also) {
    const auto start = std::chrono::steady_clock::now();
    RendererOptions how;
    how.backend = options_.backend;
    how.threads = options_.threads;
    auto renderer = Renderer::create(how);
    if (!renderer) return make_error("", renderer.error());
    renderer_.emplace(std::move(*renderer));
    report_.backend = renderer_->backend_name();
    report_.automatic_views = options_.cameras.empty();
    if (auto ok = load_source(); !ok) return tl::unexpected(ok.error());
    FirstView first;
    if (report_.automatic_views) {
      const auto view = first_view(scene_, up());
      if (!view) return make_error(options_.source, view.error());
      first = *view;
    }
    auto views = choose_views(options_, first, scene_.origin());
    if (!views) return tl::unexpected(views.error());
    if (report_.automatic_views && options_.worst > 0) {
      auto found = search();
      if (!found) return tl::unexpected(found.error());
      views->insert(views->end(), found->begin(), found->end());
    }
    views_ = std::move(*views);
    also_ = also;
    also_sums_.resize(also.size());
    plan_attribution();
    if (auto ok = draw("rendering"); !ok) return tl::unexpected(ok.error());
    summarise();
    report_.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    return std::move(report_);
  }

 private:
  using Done = Outcome<void>;

  // ---- scenes and variants

  bool attribute() const { return options_.attribution && inputs_.rgs != nullptr && mixable(); }
  bool mixable() const { return inputs_.pairing->n_paired == inputs_.pairing->source_of.size(); }

  void plan_attribution() {
    if (!options_.attribution) {
      report_.attribution_note = "not requested";
    } else if (inputs_.rgs == nullptr) {
      report_.attribution_note = "only .rgs files record how they were made";
    } else if (!mixable()) {
      report_.attribution_note = "Gaussians of the asset have no partner in the source";
    }
    if (!attribute()) return;
    if (inputs_.pairing->n_paired != inputs_.source->size()) variants_.push_back({"left_out", "Gaussians dropped"});
    variants_.push_back({"sh", "SH as INT8"});
    variants_.push_back({"geometry", "Geometry as FP16"});
    variants_.push_back({"conversion", "SH and geometry: the conversion"});
    variants_.push_back({"key", "Sort key quantised"});
    variants_.push_back({"exp", "Fast exponential"});
    variants_.push_back({"lists", "Tile lists by ellipse, folded exponent"});
    variants_.push_back({"together", "All together"});
    if (!options_.compare_scales) return;
    variants_.push_back({"file_scales", "SH as INT8, one scale set for the file"});
    variants_.push_back({"chunk_scales", "SH as INT8, one scale set per 256"});
  }

  std::uint64_t frames_per_view() const {
    std::uint64_t n =
        2 + (variants_.empty() ? 0 : variants_.size() - 1) + (draws_levels() ? 1 : 0) + (has_levels() ? 1 : 0);
    for (const AlsoReport& a : also_)
      if (a.note.empty()) n += a.has_levels ? 2 : 1;
    return n;
  }

  bool has_levels() const { return inputs_.levels != nullptr; }
  bool draws_levels() const {
    return has_levels() || std::ranges::any_of(also_, [](const AlsoReport& a) { return a.has_levels; });
  }

  glm::dvec3 up() const { return inputs_.declared ? declared_up(*inputs_.declared) : kWorldUp; }

  Done load_source() {
    auto source = source_scene(*inputs_.source);
    if (!source) return make_error(options_.source, source.error());
    scene_ = std::move(source->scene);
    is_source_ = true;
    bounds_ = source->bounds;
    report_.n_undrawable = source->n_left_out;
    return {};
  }

  // ---- views

  // The worst of the searched views, compared in small pictures that draw the pages of large ones.
  Outcome<std::vector<View>> search() {
    const ViewFormat format = view_format(options_);
    const std::span<const lod::Page> pages =
        has_levels() ? std::span(inputs_.levels->pages()) : std::span<const lod::Page>();
    const auto candidates = searched_views(bounds_, up(), format, pages);
    const double scale = std::min(1.0, kSearchSide / std::max(format.width, format.height));
    const auto small = [scale](int side) { return std::max(1, static_cast<int>(scale * side)); };
    for (const Camera& c : candidates) views_.push_back({resized(c, small(format.width), small(format.height)), {}});
    detail_px_ = kDefaultDetailPx * static_cast<float>(scale);
    is_search_ = true;
    if (auto ok = draw("searching"); !ok) return tl::unexpected(ok.error());
    is_search_ = false;
    const std::vector<ViewResult> results = std::exchange(report_.views, {});
    report_.n_searched = results.size();
    report_.pictures.clear();
    detail_px_ = kDefaultDetailPx;
    std::vector<std::size_t> order(results.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::erase_if(order, [&](std::size_t i) { return !results[i].rated() || std::isinf(results[i].score.psnr); });
    std::ranges::stable_sort(order, {}, [&](std::size_t i) { return results[i].score.psnr; });
    order.resize(std::min(order.size(), static_cast<std::size_t>(options_.worst)));
    std::vector<View> worst;
    worst.reserve(order.size());
    for (const std::size_t i : order) worst.push_back({candidates[i], {}});
    return worst;
  }

  // Compares views_ into report_.views, in their order.
  Done draw(const char* stage) {
    rated_.assign(views_.size(), 0);
    progress_.begin(stage, views_.size() * frames_per_view(), "frames");
    for (std::size_t first = 0; first < views_.size();) {
      std::size_t end = first;
      for (std::uint64_t bytes = 0; end < views_.size(); ++end) {
        bytes += (draws_levels() ? 2 : 1) * picture_bytes(views_[end].camera);
        if (end > first && bytes > options_.picture_bytes) break;
      }
      if (auto ok = batch(first, end); !ok) return ok;
      first = end;
    }
    progress_.finish();
    return {};
  }

  // ---- one batch of views [first, end)

  Done batch(std::size_t first, std::size_t end) {
    const RenderOptions exact = reference_arithmetic(inputs_.declared);
    if (!is_source_)
      if (auto ok = load_source(); !ok) return ok;
    const RenderOptions as_source = inputs_.source_stated ? reference_arithmetic(inputs_.source_stated) : exact;
    references_.clear();
    level_references_.clear();
    reference_drawn_.clear();
    for (std::size_t i = first; i < end; ++i) {
      auto image = render(i, as_source, &reference_drawn_.emplace_back());
      if (!image) return tl::unexpected(image.error());
      references_.push_back(std::move(*image));
      if (!draws_levels()) continue;
      image = render(i, levels_arithmetic(0));
      if (!image) return tl::unexpected(image.error());
      level_references_.push_back(std::move(*image));
    }
    scene_ = Scene();
    is_source_ = false;
    if (auto ok = asset(first, end, exact); !ok) return ok;
    if (auto ok = mixtures(first, end, exact); !ok) return ok;
    for (AlsoReport& other : also_)
      if (auto ok = also(other, first, end, exact); !ok) return ok;
    return {};
  }

  Done asset(std::size_t first, std::size_t end, const RenderOptions& exact) {
    if (inputs_.rgs != nullptr && !has_levels()) {
      auto scene = Scene::load(*inputs_.rgs);
      if (!scene) return make_error(options_.asset, scene.error());
      scene_ = std::move(*scene);
    } else {
      auto file = load_scene_file(options_.asset, options_.read, inputs_.source->declarations().axes);
      if (!file) return make_error(options_.asset, file.error());
      scene_ = std::move(file->scene);
    }
    for (std::size_t i = first; i < end; ++i) {
      double drawn = 0, levels_drawn = 0;
      auto image = render(i, exact, &drawn);
      if (!image) return tl::unexpected(image.error());
      std::optional<Picture> levels;
      if (has_levels()) {
        auto as_drawn = render(i, levels_arithmetic(detail_px_), &levels_drawn);
        if (!as_drawn) return tl::unexpected(as_drawn.error());
        levels = std::move(*as_drawn);
      }
      drawn = std::max({drawn, levels_drawn, reference_drawn_[i - first]});
      if (auto ok = score(i, first, drawn, std::move(*image), std::move(levels)); !ok) return ok;
    }
    if (Series* together = find("together")) {
      const RenderOptions paper = with_lists(with_exp(with_key(exact)));
      if (auto ok = render_variant(*together, first, end, paper); !ok) return ok;
    }
    return {};
  }

  Done mixtures(std::size_t first, std::size_t end, const RenderOptions& exact) {
    if (variants_.empty()) return {};
    struct Step {
      Mixture mixture;
      const char* key;
      RenderOptions options;
    };
    const Step steps[] = {{Mixture::stored_sh, "sh", exact},
                          {Mixture::stored_geometry, "geometry", exact},
                          {Mixture::source, "left_out", exact},
                          {Mixture::source, "key", with_key(exact)},
                          {Mixture::source, "exp", with_exp(exact)},
                          {Mixture::source, "lists", with_lists(exact)},
                          {Mixture::file_scales, "file_scales", exact},
                          {Mixture::chunk_step_sets, "chunk_scales", exact}};
    std::optional<Mixture> loaded;
    for (const Step& step : steps) {
      Series* series = find(step.key);
      if (series == nullptr) continue;
      if (loaded != step.mixture) {
        scene_ = Scene();  // before the next one is made
        auto scene = mixed_scene(*inputs_.source, *inputs_.rgs, *inputs_.pairing, step.mixture);
        if (!scene) return make_error(options_.source, scene.error());
        scene_ = std::move(*scene);
        loaded = step.mixture;
      }
      if (auto ok = render_variant(*series, first, end, step.options); !ok) return ok;
    }
    scene_ = Scene();
    return {};
  }

  Done also(AlsoReport& other, std::size_t first, std::size_t end, const RenderOptions& exact) {
    if (!other.note.empty()) return {};
    auto file = load_scene_file(other.path, options_.read, inputs_.source->declarations().axes);
    if (!file) {
      other.note = file.error().code == Errc::bad_magic ? "no reader for this format" : file.error().what;
      return {};
    }
    scene_ = std::move(file->scene);
    other.bytes = file->file_bytes;
    other.n_gaussians = scene_.size();
    auto& sums = also_sums_[static_cast<std::size_t>(&other - also_.data())];
    for (std::size_t i = first; i < end; ++i) {
      if (!is_rated(i)) continue;
      Score worse;
      double most_lost = 0;
      for (const bool as_levels : {false, true}) {
        if (as_levels && !other.has_levels) continue;
        const auto image = render(i, as_levels ? levels_arithmetic(detail_px_) : exact);
        if (!image) return tl::unexpected(image.error());
        const Picture& reference = (as_levels ? level_references_ : references_)[i - first];
        const auto score = compare(i, reference, *image);
        if (!score) return tl::unexpected(score.error());
        const auto loss = photo_loss(views_[i], reference.black, image->black);
        if (!loss) return tl::unexpected(loss.error());
        worse = as_levels ? worse_of(worse, *score) : *score;
        most_lost = as_levels ? std::max(most_lost, *loss) : *loss;
      }
      sums.psnr.push_back(worse.psnr);
      sums.ssim += worse.ssim;
      sums.loss += most_lost;
    }
    scene_ = Scene();
    return {};
  }

  // ---- pictures and scores

  // Sets `drawn`, if requested, to the share of pixels on which the scene draws.
  Outcome<Picture> render(std::size_t view, const RenderOptions& how, double* drawn = nullptr) {
    const Camera& camera = views_[view].camera;
    Image image = Image::make(camera.width, camera.height, 3);
    alpha_.resize(image.pixels.size() / 3);
    Image depth;
    if (options_.depth) depth = Image::make(camera.width, camera.height, 1);
    const auto stats =
        renderer_->render(scene_, camera, {.rgb = image.pixels, .alpha = alpha_, .depth = depth.pixels}, how);
    if (!stats) return make_error("view " + camera.name, stats.error());
    if (drawn != nullptr) *drawn = drawn_share(alpha_);
    progress_.advance(1);
    Picture picture = over_backgrounds(std::move(image), alpha_);
    picture.depth = std::move(depth);
    return picture;
  }

  // Whether the view is rated; if not, its variants are skipped.
  bool is_rated(std::size_t view) {
    if (rated_[view] == 0) progress_.advance(1);
    return rated_[view] != 0;
  }

  // Gaussians of a file whose means lie in no rated view.
  template <class File>
  std::uint64_t n_unseen(const File& file, const Origin& origin) const {
    std::atomic<std::uint64_t> n = 0;
    std::vector<math::View<double>> views;
    views.reserve(report_.cameras.size());
    for (const Camera& c : report_.cameras)
      views.push_back(view_of(c, kNoOrigin, static_cast<double>(math::kNearPlane), 0.0));
    for_each_mean(file, [&](std::uint64_t, const float* mean) {
      const glm::dvec3 offset(mean[0], mean[1], mean[2]);
      const glm::dvec3 mean_world = glm::dvec3(origin[0], origin[1], origin[2]) + offset;
      if (std::ranges::none_of(views, [&](const auto& view) { return see(view, mean_world).is_in_picture; })) ++n;
    });
    return n;
  }

  Done render_variant(Series& series, std::size_t first, std::size_t end, const RenderOptions& how) {
    for (std::size_t i = first; i < end; ++i) {
      if (!is_rated(i)) continue;
      const auto image = render(i, how);
      if (!image) return tl::unexpected(image.error());
      const auto d = difference(references_[i - first], *image);
      if (!d) return make_error("view " + views_[i].camera.name, d.error());
      const auto loss = photo_loss(views_[i], references_[i - first].black, image->black);
      if (!loss) return tl::unexpected(loss.error());
      series.add(d->psnr, d->mse, *loss);
    }
    return {};
  }

  // A frame of a video passes `before`, the error of the frame before; it becomes this one's.
  Outcome<Score> compare(std::size_t view, const Picture& reference, const Picture& image, const Chosen& measures = {},
                         Picture* before = nullptr) const {
    const Camera& camera = views_[view].camera;
    const auto d = difference(reference, image);
    const auto s = ssim(reference, image);
    if (!d || !s) return make_error("view " + camera.name, d ? s.error() : d.error());
    Values values;
    for (std::size_t i = 0; i < kMeasures.size(); ++i) {
      if (!measures[i]) continue;
      const auto value = measure(i, reference, image);
      if (!value) return make_error("view " + camera.name, value.error());
      values[i] = *value;
    }
    std::optional<double> flicker;
    if (before != nullptr) {
      Picture error{minus(image.black, reference.black), minus(image.white, reference.white)};
      if (!before->black.pixels.empty()) {
        // The change of the error is the difference of the changes.
        const auto change = difference(*before, error);
        if (!change) return make_error("view " + camera.name, change.error());
        flicker = 255 * std::sqrt(change->mse);
      }
      *before = std::move(error);
    }
    const auto pixel = static_cast<int>(d->largest_index / 3);
    return Score{d->mse,
                 d->psnr,
                 *s,
                 d->largest,
                 pixel % camera.width,
                 pixel / camera.width,
                 shows_more_over_white(reference, image),
                 depth_difference(reference, image),
                 values,
                 flicker};
  }

  static bool less_wrong(const std::optional<DepthScore>& a, const std::optional<DepthScore>& b) {
    return b && (!a || a->error < b->error);
  }

  static Score worse_of(const Score& a, const Score& b) {
    Score out = a.psnr <= b.psnr ? a : b;
    const Score& spot = a.largest >= b.largest ? a : b;
    out.ssim = std::min(a.ssim, b.ssim);
    for (std::size_t i = 0; i < kMeasures.size(); ++i)
      out.measures[i] = worse(a.measures[i], b.measures[i], kMeasures[i].at_least);
    out.flicker = worse(a.flicker, b.flicker, false);
    out.largest = spot.largest, out.x = spot.x, out.y = spot.y;
    out.depth = less_wrong(a.depth, b.depth) ? b.depth : a.depth;
    return out;
  }

  // `levels`: the asset at the default detail.
  Done score(std::size_t view, std::size_t first, double drawn, Picture image, std::optional<Picture> levels) {
    const Camera& camera = views_[view].camera;
    const Picture* reference = &references_[view - first];
    ViewResult result{camera.name, camera.width, camera.height, drawn, {}, {}};
    rated_[view] = result.rated() ? 1 : 0;
    if (!result.rated()) {
      report_.views.push_back(std::move(result));
      errors_ = {};
      return {};
    }
    const Chosen measures = is_search_ ? Chosen() : options_.measures;
    const auto score = compare(view, *reference, image, measures, options_.video ? &errors_[0] : nullptr);
    if (!score) return tl::unexpected(score.error());
    result.score = *score;
    Image photo;
    if (!views_[view].photo.empty()) {
      auto read = read_photo(views_[view]);
      if (!read) return tl::unexpected(read.error());
      photo = *std::move(read);
      const auto photo_score = compare_to_photo(views_[view], photo, reference->black, image.black);
      if (!photo_score) return tl::unexpected(photo_score.error());
      result.photo = *photo_score;
    }
    if (Series* conversion = find("conversion"))
      conversion->add(score->psnr, score->mse, result.photo ? result.photo->loss() : 0);
    if (levels) {
      const Picture& level_reference = level_references_[view - first];
      const auto as_drawn = compare(view, level_reference, *levels, measures, options_.video ? &errors_[1] : nullptr);
      if (!as_drawn) return tl::unexpected(as_drawn.error());
      result.leaves = *score;
      result.levels = *as_drawn;
      result.score = worse_of(*score, *as_drawn);
      if (result.photo) {
        const auto photo_score = compare_to_photo(views_[view], photo, level_reference.black, levels->black);
        if (!photo_score) return tl::unexpected(photo_score.error());
        if (photo_score->loss() > result.photo->loss()) result.photo = *photo_score;
      }
      if (as_drawn->psnr < score->psnr) {
        reference = &level_reference;
        image = std::move(*levels);
      }
    }
    report_.views.push_back(std::move(result));
    keep({view, *reference, std::move(image), std::move(photo)});
    return {};
  }

  // Against photographs as 3DGS evaluates: clamped to a photograph's range.
  static Outcome<PhotoScore> compare_to_photo(const View& view, const Image& photo, const Image& reference,
                                              const Image& image) {
    PhotoScore score;
    for (const bool of_source : {true, false}) {
      const Image shown = clamped(of_source ? reference : image);
      const auto d = difference(photo, shown);
      const auto s = ssim(photo, shown);
      if (!d || !s) return make_error(view.photo, d ? s.error() : d.error());
      (of_source ? score.source_psnr : score.asset_psnr) = d->psnr;
      (of_source ? score.source_ssim : score.asset_ssim) = *s;
    }
    return score;
  }

  // Loss of `image` against the photograph, dB; 0 without one.
  static Outcome<double> photo_loss(const View& view, const Image& reference, const Image& image) {
    if (view.photo.empty()) return 0;
    const auto photo = read_photo(view);
    if (!photo) return tl::unexpected(photo.error());
    const auto before = difference(*photo, clamped(reference)), after = difference(*photo, clamped(image));
    if (!before || !after) return make_error(view.photo, before ? after.error() : before.error());
    return before->psnr == after->psnr ? 0 : before->psnr - after->psnr;
  }

  // Keeps the worst views, up to a number and a size.
  void keep(ViewPictures pictures) {
    const auto psnr = [this](const ViewPictures& p) { return report_.views[p.view].score.psnr; };
    auto& kept = report_.pictures;
    const auto worse = [&](const ViewPictures& a, const ViewPictures& b) { return psnr(a) < psnr(b); };
    const std::uint64_t n_pictures = pictures.photo.pixels.empty() ? 2 : 3;  // a photograph takes half
    const std::uint64_t bytes = n_pictures * picture_bytes(views_[pictures.view].camera);
    const std::size_t most = std::clamp<std::size_t>(kKeptBytes / bytes, 1, kKeptViews);
    kept.insert(std::upper_bound(kept.begin(), kept.end(), pictures, worse), std::move(pictures));
    if (kept.size() > most) kept.resize(most);
  }

  Series* find(const std::string& key) {
    const auto found = std::find_if(variants_.begin(), variants_.end(), [&](const Series& s) { return s.key == key; });
    return found == variants_.end() ? nullptr : &*found;
  }

  void summarise() {
    summarise_views();
    report_.source_unseen = n_unseen(*inputs_.source, inputs_.source->origin());
    report_.asset_unseen = inputs_.rgs != nullptr ? n_unseen(*inputs_.rgs, inputs_.rgs->declarations().origin)
                                                  : n_unseen(*inputs_.other, inputs_.other->origin());
    if (report_.n_rated == 0) {
      if (!variants_.empty()) report_.attribution_note = "no view shows the scene";
      for (AlsoReport& a : also_)
        if (a.note.empty()) a.note = "no view shows the scene";
      return;
    }
    double all = 0;
    if (const Series* together = find("together")) all = mean(together->mse);
    for (const Series& s : variants_) {
      AttributionRow row{s.key, s.name, mean_psnr(s.psnr), *std::min_element(s.psnr.begin(), s.psnr.end()),
                         mean(s.mse)};
      row.share = all > 0 ? row.mse / all : 0;
      if (!options_.photos.empty()) row.loss = mean(s.loss);
      report_.attribution.push_back(std::move(row));
    }
    for (std::size_t i = 0; i < also_.size(); ++i) {
      const AlsoSums& sums = also_sums_[i];
      if (sums.psnr.empty() || !also_[i].note.empty()) continue;
      const auto n = static_cast<double>(sums.psnr.size());
      also_[i].psnr = mean_psnr(sums.psnr);
      also_[i].worst_psnr = *std::min_element(sums.psnr.begin(), sums.psnr.end());
      also_[i].ssim = sums.ssim / n;
      if (!options_.photos.empty()) also_[i].loss = sums.loss / n;
    }
  }

  void summarise_views() {
    auto& views = report_.views;
    std::vector<double> psnr, leaves, levels;
    PhotoScore photo;
    double ssim_sum = 0, mse_sum = 0, drawn = 0;
    for (const ViewResult& v : views) {
      drawn += v.drawn;
      if (v.rated()) ++report_.n_rated;
    }
    report_.drawn = drawn / static_cast<double>(views.size());
    if (report_.n_rated == 0) return;
    report_.worst_psnr = std::numeric_limits<double>::infinity();
    report_.worst_ssim = 1;
    report_.largest = 0;
    const auto n = static_cast<double>(report_.n_rated);
    for (const ViewResult& v : views) {
      if (!v.rated()) continue;
      psnr.push_back(v.score.psnr);
      if (v.levels) leaves.push_back(v.leaves->psnr), levels.push_back(v.levels->psnr);
      ssim_sum += v.score.ssim;
      mse_sum += v.score.mse;
      report_.worst_psnr = std::min(report_.worst_psnr, v.score.psnr);
      report_.worst_ssim = std::min(report_.worst_ssim, v.score.ssim);
      for (std::size_t i = 0; i < kMeasures.size(); ++i) {
        if (!v.score.measures[i]) continue;
        report_.measures[i] = report_.measures[i].value_or(0) + *v.score.measures[i];
        report_.worst_measures[i] = worse(report_.worst_measures[i], v.score.measures[i], kMeasures[i].at_least);
      }
      report_.largest = std::max(report_.largest, v.score.largest);
      if (less_wrong(report_.depth, v.score.depth)) report_.depth = v.score.depth;
      if (!v.photo) continue;
      photo.source_psnr += v.photo->source_psnr / n;
      photo.asset_psnr += v.photo->asset_psnr / n;
      photo.source_ssim += v.photo->source_ssim / n;
      photo.asset_ssim += v.photo->asset_ssim / n;
    }
    report_.psnr = mean_psnr(psnr);
    if (!levels.empty()) report_.level_psnr = {mean_psnr(leaves), mean_psnr(levels)};
    report_.ssim = ssim_sum / n;
    for (auto& sum : report_.measures)
      if (sum) *sum /= n;
    report_.mse = mse_sum / n;
    if (!options_.photos.empty()) {
      report_.photo = photo;
      report_.loss = photo.loss();
    }
    if (options_.video) report_.video = video_report(views, options_.fps);
    // Rated views first, worst first; pictures keep pointing at their views.
    std::vector<std::size_t> order(views.size()), place(views.size());
    for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
    std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
      if (views[a].rated() != views[b].rated()) return views[a].rated();
      return views[a].score.psnr < views[b].score.psnr;
    });
    std::vector<ViewResult> sorted;
    for (std::size_t i = 0; i < order.size(); ++i) {
      sorted.push_back(std::move(views[order[i]]));
      place[order[i]] = i;
      if (sorted.back().rated()) report_.cameras.push_back(views_[order[i]].camera);
    }
    views = std::move(sorted);
    for (ViewPictures& p : report_.pictures) p.view = place[p.view];
  }

  static double mean(const std::vector<double>& values) {
    double sum = 0;
    for (const double v : values) sum += v;
    return values.empty() ? 0 : sum / static_cast<double>(values.size());
  }

  struct AlsoSums {
    std::vector<double> psnr;
    double ssim = 0, loss = 0;
  };

  const RenderInputs& inputs_;
  const Options& options_;
  tool::Progress& progress_;
  std::optional<Renderer> renderer_;
  Scene scene_;             // the one being rendered
  bool is_source_ = false;  // scene_
  bool is_search_ = false;  // which needs no further measures
  SceneBounds bounds_;
  std::vector<View> views_;
  std::vector<std::uint8_t> rated_;  // [views], of those drawn so far
  std::vector<Picture> references_;  // of the batch
  std::vector<Picture> level_references_;
  std::vector<double> reference_drawn_;  // of the batch
  std::array<Picture, 2> errors_;        // of a video's last frame: the asset's pictures, and of its levels
  std::vector<float> alpha_;             // of the last frame
  std::vector<Series> variants_;
  std::span<AlsoReport> also_;
  std::vector<AlsoSums> also_sums_;  // [also_]
  float detail_px_ = kDefaultDetailPx;
  RenderReport report_;
};

}  // namespace

RenderOptions reference_arithmetic(const std::optional<Declarations>& declared) {
  RenderOptions options{.pipeline = Pipeline::paper};
  options.paper = steps_of({.pipeline = Pipeline::baseline}, Backend::cpu);
  options.detail_px = 0.0F;
  return with_declarations(options, declared);
}

RenderOptions levels_arithmetic(float detail_px) {
  RenderOptions options = reference_arithmetic(Declarations());
  options.anti_aliasing = math::AntiAliasing::mip_splatting;
  options.low_pass = default_low_pass_px2(AaMode::mip_splatting);
  options.detail_px = detail_px;
  return options;
}

double mean_psnr(std::span<const double> values) {
  double sum = 0;
  std::size_t n = 0;
  for (const double v : values)
    if (std::isfinite(v)) sum += v, ++n;
  return n == 0 ? std::numeric_limits<double>::infinity() : sum / static_cast<double>(n);
}

Outcome<RenderReport> compare_pictures(const RenderInputs& inputs, const Options& options,
                                       std::vector<AlsoReport>& also, tool::Progress& progress) {
  return PictureAudit(inputs, options, progress).run(also);
}

}  // namespace rgs::audit
