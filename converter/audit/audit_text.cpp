// audit_text.cpp - the terminal's summary: sizes, attributes, pictures, attribution, gate, verdict.
// SPDX-License-Identifier: Apache-2.0
#include "audit_text.hpp"

#include <fmt/format.h>

#include <cmath>

#include "audit_gate.hpp"
#include "info_escape.hpp"
#include "text_lines.hpp"

namespace rgs::audit {
namespace {

using tool::format_bytes;
using tool::format_count;

class Text : private tool::TextLines {
 public:
  explicit Text(const Report& report) : report_(report) {}

  std::string all(const std::string& report_path) {
    sizes();
    gaussians(report_.pairs);
    if (report_.attributes) attributes(*report_.attributes);
    if (report_.render) pictures(*report_.render);
    if (report_.distances) distances(*report_.distances);
    for (const AlsoReport& a : report_.also) also(a);
    for (const Condition& c : report_.gate) line("  {}      {}", c.holds ? "holds " : "FAILED", describe(c));
    for (const std::string& w : warnings(report_)) line("  warning     {}", w);
    const Verdict v = verdict(report_);
    line("{}. {}", v.headline, v.detail);
    if (!report_path.empty()) line("report: {}", escape(report_path));
    return take();
  }

 private:
  void sizes() {
    const SizeReport& s = report_.size;
    line("{} ({}) -> {} ({}): {}, {:.2f} bytes per Gaussian", escape(report_.source_name), format_bytes(s.source_bytes),
         escape(report_.asset_name), format_bytes(s.asset_bytes),
         tool::format_size_change(s.source_bytes, s.asset_bytes), s.bytes_per_gaussian());
    if (s.gpu_bytes != 0)
      line("  on the GPU  {}, {:.2f} bytes per Gaussian; FP32 attributes {}", format_bytes(s.gpu_bytes),
           s.gpu_bytes_per_gaussian(), format_bytes(s.gpu_bytes_fp32));
    if (s.levels)
      line("  levels      {}, with {} Gaussians in {} pages in all; the finest is compared with the source",
           s.levels->n_levels, format_count(s.levels->n_gaussians), format_count(s.levels->n_pages));
  }

  void gaussians(const PairReport& p) {
    line("  paired      {} Gaussians, by {}; only in the source {}, only in the asset {}", format_count(p.n_paired),
         p.by == PairedBy::permutation ? "the file's permutation"
         : p.by == PairedBy::order     ? "order"
         : p.by == PairedBy::means     ? "equal means"
                                       : "the nearest means",
         format_count(p.n_source_only), format_count(p.n_asset_only));
  }

  void attributes(const AttributeReport& a) {
    line("  {:<18}{:>11}{:>11}{:>11}{:>11}", "error", "RMS", "99 %", "99.9 %", "largest");
    row(a.colour);
    for (const AttributeError& e : a.errors)
      if (!e.key.starts_with("sh")) row(e);
    const RangeCounts& r = a.ranges;
    line("  limits      SH clipped {}, flushed to 0 {}; scales subnormal {}, 0 {}; opacities became 0 {}, 1 {}",
         format_count(r.sh_clipped), format_count(r.sh_flushed), format_count(r.scale_subnormal),
         format_count(r.scale_zero), format_count(r.opacity_zero), format_count(r.opacity_one));
  }

  void row(const AttributeError& e) {
    line("    {:<16}{:>11.4g}{:>11.4g}{:>11.4g}{:>11.4g} {}", e.key, e.meaning.rms, e.meaning.p99, e.meaning.p999,
         e.meaning.max, e.meaning_unit);
  }

  void pictures(const RenderReport& r) {
    const std::string views =
        fmt::format("{}{} views{}", r.n_rated == r.views.size() ? "" : fmt::format("{} of ", r.n_rated), r.views.size(),
                    !r.automatic_views  ? ""
                    : r.n_searched == 0 ? " around the scene"
                                        : fmt::format(" around the scene and the worst of {}", r.n_searched));
    if (r.n_rated == 0) {
      line("  pictures    {} show the scene", views);
    } else {
      line("  pictures    {}: {} on average, worst {}; SSIM {:.6f}, worst {:.6f}; largest difference {:.1f}/255", views,
           format_psnr(r.psnr), format_psnr(r.worst_psnr), r.ssim, r.worst_ssim, 255 * static_cast<double>(r.largest));
    }
    for (std::size_t i = 0; i < kMeasures.size(); ++i)
      if (r.measures[i])
        line("  {:<12}{:.6f} on average, worst {:.6f}; {}", kMeasures[i].title, *r.measures[i], *r.worst_measures[i],
             kMeasures[i].scale);
    if (r.video) video(*r.video);
    line("  unseen      in no rated view: {} Gaussians of the source, {} of the asset", format_count(r.source_unseen),
         format_count(r.asset_unseen));
    if (r.level_psnr)
      line("  of these    the worse drawing of each: leaves {}, at the default detail {}",
           format_psnr(r.level_psnr->leaves), format_psnr(r.level_psnr->levels));
    if (r.photo)
      line("  photos      source {:.3f} dB, asset {:.3f} dB: loss {:.4f} dB; SSIM {:.5f}, {:.5f}", r.photo->source_psnr,
           r.photo->asset_psnr, r.photo->loss(), r.photo->source_ssim, r.photo->asset_ssim);
    if (r.n_undrawable != 0)
      line("  reference   {} damaged Gaussians of the source are missing", format_count(r.n_undrawable));
    for (const AttributionRow& a : r.attribution)
      line("    {:<40}{:>12}  {:6.2f} % of the squared error", a.name, format_psnr(a.psnr), 100 * a.share);
    if (!r.attribution_note.empty()) line("  attribution none: {}", r.attribution_note);
  }

  void video(const VideoReport& r) {
    line("  video       {} frames, {} a second{}", r.frames.size(), r.fps,
         r.flicker ? fmt::format("; flicker {:.4g} of 255 levels RMS on average", *r.flicker) : "");
    for (const Curve& c : r.curves) {
      const auto shown = [&](double v) { return c.key == "psnr" ? format_psnr(v) : fmt::format("{:.6g}", v); };
      line("    {:<10}worst second {} from {}; worst frame {} at {}", c.name, shown(c.second_mean),
           escape(r.name_of(c.second)), shown(c.values[c.worst]), escape(r.name_of(c.worst)));
    }
  }

  void distances(const DistanceReport& r) {
    if (!r.rows.empty())
      line("  from afar   {:>12}{:>14}{:>14}   of the Gaussians, against the truth", "all", "compensated", "levels");
    for (const FarRow& row : r.rows)
      line("    {}x        {:>12}{:>14}{:>14}   {:.1f} %", row.far, format_psnr(row.score(FarScene::leaves).psnr),
           format_psnr(row.score(FarScene::compensated).psnr), format_psnr(row.score(FarScene::levels).psnr),
           100 * row.drawn);
    if (!r.note.empty()) line("  from afar   not all distances: {}", r.note);
  }

  void also(const AlsoReport& a) {
    const std::string quality = a.psnr ? fmt::format("{}, worst {}", format_psnr(*a.psnr), format_psnr(*a.worst_psnr))
                                       : "not measured: " + a.note;
    line("  also        {} ({}): {}", escape(a.path), format_bytes(a.bytes), quality);
  }

  static std::string escape(const std::string& text) { return tool::escape_untrusted(text, false, 4096); }

  const Report& report_;
};

}  // namespace

std::string format_psnr(double psnr) {
  if (std::isnan(psnr)) return "not rated";
  return std::isfinite(psnr) ? fmt::format("{:.2f} dB", psnr) : "identical";
}

std::string audit_text(const Report& report, const std::string& report_path) {
  return Text(report).all(report_path);
}

}  // namespace rgs::audit
