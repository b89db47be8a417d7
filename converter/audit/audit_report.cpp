// audit_report.cpp - the page from top to bottom: verdict and worst picture first, then the evidence.
// SPDX-License-Identifier: Apache-2.0
#include "audit_report.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <span>
#include <string_view>

#include "audit_chart.hpp"
#include "audit_command.hpp"
#include "audit_gate.hpp"
#include "audit_page.hpp"
#include "audit_picture.hpp"
#include "audit_text.hpp"
#include "info_report.hpp"

namespace rgs::audit {
namespace {

using tool::format_bytes;
using tool::format_count;

// Encoded bytes of pictures; base64 adds a third. Two pictures and a map on top, maps of two more views, six crops of
// three pictures: at most 13.5 MB of text, also with photographs, which share these; strips of four from four
// distances: 1.3 MB; maps of a measure: 2.8 MB.
constexpr std::size_t kTopBytes = 3'000'000, kMapBytes = 700'000, kCropBytes = 70'000;
constexpr std::size_t kTopBytesBesidePhoto = kTopBytes * 2 / 3, kCropBytesBesidePhoto = kCropBytes * 3 / 4;
constexpr int kTopWidth = 1920, kMapWidth = 960;
constexpr std::size_t kMaps = 3, kCrops = 6, kCropsPerView = 3;
constexpr std::size_t kStripBytes = 60'000;  // of each of four pictures a distance
constexpr int kStripWidth = 480;
constexpr int kCropWidth = 120, kCropHeight = 90;
constexpr std::size_t kListedViews = 1000, kListedSections = 64;

constexpr std::array kSectionColours{"#4e79a7", "#e08a3c", "#c85c5f", "#6aa7a2", "#5e9950",
                                     "#d9b93f", "#a9789b", "#9c755f", "#8a8f96"};

const char* colour_of(const Verdict& verdict, std::span<const Condition> gate) {
  if (!holds(gate)) return "bad";
  if (verdict.depth_range_misfit || verdict.hardly_seen) return "fair";
  switch (verdict.grade) {
    case Verdict::Grade::identical:
    case Verdict::Grade::lossless:
    case Verdict::Grade::close: return "good";
    case Verdict::Grade::visible: return "fair";
    case Verdict::Grade::poor: return "bad";
    case Verdict::Grade::unrated: return "soft";
  }
  return "soft";
}

const char* badge_of(Verdict::Grade grade) {
  switch (grade) {
    case Verdict::Grade::identical: return "Identical";
    case Verdict::Grade::lossless: return "No visible loss";
    case Verdict::Grade::close: return "Very close";
    case Verdict::Grade::visible: return "Visible differences";
    case Verdict::Grade::poor: return "Heavy damage";
    case Verdict::Grade::unrated: return "Not rated";
  }
  return "";
}

// The parts of a page that depend on conditions lie between these. Names cannot contain them: all are escaped.
constexpr std::string_view kVerdictBegins = "<!-- verdict -->\n", kVerdictEnds = "<!-- end of verdict -->\n";

const char* badge(const Verdict& verdict, std::span<const Condition> gate) {
  if (!holds(gate)) return "Gate failed";
  if (verdict.hardly_seen) return "Cameras hardly see the scene";
  return verdict.depth_range_misfit ? "Depth range does not fit" : badge_of(verdict.grade);
}

std::string headline_html(const Verdict& verdict) {
  std::string text = html(verdict.headline);
  for (const char* change : {"x smaller", "x larger"})
    if (const std::size_t at = text.find(change); at != std::string::npos) text.replace(at, 1, "&times;");
  return text;
}

std::string verdict_html(const Verdict& verdict, std::span<const Condition> gate) {
  std::string text = fmt::format(
      "<p class=\"badges\"><span class=\"badge {}\">{}</span></p>\n<h1>{}.</h1>\n<p class=\"lead\">{}</p>\n",
      colour_of(verdict, gate), badge(verdict, gate), headline_html(verdict), html(verdict.detail));
  if (gate.empty()) return text;
  text += "<ul class=\"gate\" aria-label=\"Conditions\">\n";
  for (const Condition& c : gate)
    text += fmt::format("<li class=\"{}\">{} {}</li>\n", c.holds ? "good" : "bad", c.holds ? "&#10003;" : "&#10007;",
                        html(describe(c)));
  return text + "</ul>\n";
}

std::string run_html(const std::string& fingerprint) {
  return ", run <code>" + fingerprint + "</code>";
}

std::string pairing_words(PairedBy by) {
  switch (by) {
    case PairedBy::permutation: return "by the permutation that the asset carries";
    case PairedBy::order: return "in order, which the asset keeps";
    case PairedBy::means: return "by equal means, which the conversion does not change";
    case PairedBy::nearest: return "by the nearest means, as the format rounds them";
  }
  return "";
}

double levels(double mse) {
  return 255 * std::sqrt(mse);
}

class Page {
 public:
  explicit Page(const Report& report) : report_(report), verdict_(verdict(report)) {
    if (!report_.render) return;
    for (const ViewPictures& p : report_.render->pictures) maps_.push_back(difference_levels(p.source, p.asset));
    top_ = scale_top(maps_);
  }

  std::string all() {
    out_ = page_begin(report_.asset_name + " against " + report_.source_name + " - rgs-audit");
    add("<main>\n");
    head();
    numbers();
    if (has_pictures()) worst_picture();
    contents();
    if (has_pictures()) where();
    if (report_.render) views(*report_.render);
    if (report_.render && report_.render->video) video(*report_.render->video);
    if (report_.render) attribution(*report_.render);
    if (report_.distances && !report_.distances->rows.empty()) distances(*report_.distances);
    if (report_.attributes) attributes(*report_.attributes);
    sizes();
    method();
    add("</main>\n");
    return out_ + page_end();
  }

 private:
  template <class... Args>
  void add(fmt::format_string<Args...> format, Args&&... args) {
    fmt::format_to(std::back_inserter(out_), format, std::forward<Args>(args)...);
  }
  bool has_pictures() const {
    return report_.render && !report_.render->pictures.empty() && std::isfinite(report_.render->worst_psnr);
  }

  void title(const char* id, const char* text) {
    add("<section aria-labelledby=\"{0}\">\n<h2 id=\"{0}\">{1}</h2>\n", id, text);
  }
  void end_section() { add("</section>\n"); }
  void table(const std::string& label) {
    add("<div class=\"wrap\" role=\"region\" tabindex=\"0\" aria-label=\"{}\"><table>\n", html(label));
  }
  void end_table() { add("</tbody></table></div>\n"); }

  // ---- summary

  void head() {
    add("<header>\n<p class=\"names\"><b>rgs-audit</b> &nbsp; {} &rarr; <b>{}</b></p>\n", html(report_.source_name),
        html(report_.asset_name));
    out_ += kVerdictBegins;
    out_ += verdict_html(verdict_, report_.gate);
    out_ += kVerdictEnds;
    if (const auto sentences = warnings(report_); !sentences.empty()) {
      add("<ul class=\"warnings fair\" aria-label=\"Warnings\">\n");
      for (const std::string& w : sentences) add("<li>{}</li>\n", html(w));
      add("</ul>\n");
    }
    add("</header>\n");
  }

  void card(const char* name, const std::string& big, const std::string& unit, const std::string& below) {
    add("<div class=\"card\"><dt>{}</dt><dd><div class=\"big\">{}<small>{}</small></div>{}</dd></div>\n", name, big,
        unit, below);
  }

  void numbers() {
    const SizeReport& s = report_.size;
    add("<dl class=\"three\">\n");
    const std::string change = tool::format_size_change(s.source_bytes, s.asset_bytes);
    const std::size_t at = change.find("x ");  // "4.87x smaller", or words alone
    const bool is_factor = at != std::string::npos;
    card("Size", is_factor ? change.substr(0, at) : "", is_factor ? "&times;" + change.substr(at + 1) : change,
         fmt::format("{} &rarr; {}; {:.1f} bytes per Gaussian", format_bytes(s.source_bytes),
                     format_bytes(s.asset_bytes), s.bytes_per_gaussian()));
    if (!report_.render) {
      add("</dl>\n");
      return;
    }
    const RenderReport& r = *report_.render;
    if (r.n_rated == 0) {
      card("Similarity to the original", "?", "", "no view shows the scene");
      add("</dl>\n");
      return;
    }
    const bool same = !std::isfinite(r.psnr);
    card("Similarity to the original", same ? "&infin;" : fmt::format("{:.1f}", r.psnr), "dB PSNR",
         same ? "every pixel is identical"
              : fmt::format("worst view {:.1f} dB; error {:.2g} of 255 levels RMS", r.worst_psnr, levels(r.mse)));
    if (r.photo) {
      card("Lost against the photographs", fmt::format("{:.3f}", std::max(0.0, *r.loss)), "dB",
           fmt::format("{} dB before, {} dB after", number(r.photo->source_psnr, 3), number(r.photo->asset_psnr, 3)));
    } else {
      card("Structure kept", fmt::format("{:.5f}", r.ssim), "SSIM",
           fmt::format("worst view {:.5f}; 1 is perfect", r.worst_ssim));
    }
    add("</dl>\n");
  }

  void worst_picture() {
    const RenderReport& r = *report_.render;
    const ViewPictures& p = r.pictures.front();
    const ViewResult& v = r.views[p.view];
    const Image &source = p.source.over(v.score.over_white), &asset = p.asset.over(v.score.over_white);
    const bool has_photo = !p.photo.pixels.empty();
    const std::size_t most = has_photo ? kTopBytesBesidePhoto : kTopBytes;
    bool lossless_a = false, lossless_b = false;
    const std::string a = picture_uri(shrunk(source, kTopWidth), most, &lossless_a);
    const std::string b = picture_uri(shrunk(asset, kTopWidth), most, &lossless_b);
    const std::string map =
        picture_uri(heat_map(shrunk_to_largest(maps_.front(), std::min(kTopWidth, source.width)), top_), kMapBytes);
    const std::string alt = html(v.name.empty() ? "view" : v.name);
    add("<figure>\n<div class=\"ab\"><img src=\"{}\" width=\"{}\" height=\"{}\" alt=\"{}, original\">", a, v.width,
        v.height, alt);
    if (has_photo)
      add("<img class=\"photo\" src=\"{}\" alt=\"{}, photograph\">", picture_uri(shrunk(p.photo, kTopWidth), most),
          alt);
    add("<img class=\"over\" src=\"{}\" alt=\"{}, asset\"><img class=\"over map\" src=\"{}\" alt=\"{}, difference\">",
        b, alt, map, alt);
    add("<input type=\"range\" min=\"0\" max=\"100\" step=\"0.5\" value=\"50\" aria-label=\"Original to the left, "
        "asset to the "
        "right of this position\"><span class=\"bar\" aria-hidden=\"true\"></span><span class=\"tag a\">Original</span>"
        "<span class=\"tag b\">Asset</span></div>\n");
    add("<label class=\"switch\"><input type=\"checkbox\"> Show the difference instead of the asset, "
        "amplified</label>\n");
    if (has_photo) {
      add("<label class=\"switch\"><input type=\"checkbox\" class=\"taken\"> Show the photograph instead of the "
          "original</label>\n");
    }
    add("<figcaption>The worst of {} views, {}: {} against the original, SSIM {:.5f}; the largest difference is {:.1f} "
        "of 255 "
        "levels, at pixel ({}, {}).{} <span class=\"screen\">Drag, or use the arrow "
        "keys.</span>{}{}</figcaption>\n</figure>\n",
        r.n_rated, alt, format_psnr(v.score.psnr), v.score.ssim, 255 * static_cast<double>(v.score.largest), v.score.x,
        v.score.y, v.score.over_white ? " Shown over white, where more differs than over black." : "",
        lossless_a && lossless_b ? "" : " Shown as JPEG.",
        source.width > kTopWidth ? fmt::format(" Scaled down to {} pixels.", kTopWidth) : "");
  }

  void contents() {
    add("<nav aria-label=\"Contents\">");
    if (has_pictures()) add("<a href=\"#where\">Where it differs</a>");
    if (report_.render) add("<a href=\"#views\">Views</a>");
    if (report_.render && report_.render->video) add("<a href=\"#video\">Video</a>");
    if (report_.render && !report_.render->attribution.empty()) add("<a href=\"#steps\">Which step costs what</a>");
    if (report_.distances && !report_.distances->rows.empty()) add("<a href=\"#distances\">From afar</a>");
    if (report_.attributes) add("<a href=\"#attributes\">Attributes</a><a href=\"#worst\">Worst Gaussians</a>");
    add("<a href=\"#size\">Size</a><a href=\"#method\">Method</a></nav>\n");
  }

  // ---- pictures

  void scale_bar() {
    add("<div class=\"scale\"><span>0</span><svg role=\"img\" aria-label=\"Colour scale\"><defs><linearGradient "
        "id=\"heat\">");
    for (int i = 0; i <= 10; ++i) {
      const Colour c = heat(static_cast<float>(i) / 10);
      add("<stop offset=\"{}%\" stop-color=\"rgb({:.0f},{:.0f},{:.0f})\"/>", 10 * i, 255 * c.r, 255 * c.g, 255 * c.b);
    }
    add("</linearGradient></defs><rect width=\"100%\" height=\"100%\" fill=\"url(#heat)\"/></svg><span>{:.3g} of 255 "
        "levels, white above</span></div>\n",
        top_);
  }

  void where() {
    const RenderReport& r = *report_.render;
    title("where", "Where it differs");
    add("<p>The largest difference of the three channels over black and over white, pixel by pixel, amplified {:.0f} "
        "times, on one scale for all pictures. Maps clamp values to 0..1, as a screen does; the numbers do not.</p>\n",
        255 / static_cast<double>(top_));
    scale_bar();
    add("<div class=\"grid\">\n");
    for (std::size_t i = 0; i < std::min(kMaps, maps_.size()); ++i) {
      const ViewResult& v = r.views[r.pictures[i].view];
      add("<figure><img src=\"{}\" alt=\"Difference map of {}\"><figcaption>{}: {}, {:.2g} levels RMS, largest {:.1f}"
          "</figcaption></figure>\n",
          picture_uri(heat_map(shrunk_to_largest(maps_[i], kMapWidth), top_), kMapBytes), html(v.name), html(v.name),
          format_psnr(v.score.psnr), levels(v.score.mse), 255 * static_cast<double>(v.score.largest));
    }
    add("</div>\n");
    for (std::size_t which = 0; which < kMeasures.size(); ++which)
      if (r.measures[which]) measure_maps(r, which);
    add("<h3>The worst regions, pixel for pixel</h3>\n<div class=\"grid wide\">\n");
    for (const Region& region : worst_regions(maps_, kCropWidth, kCropHeight, kCrops, kCropsPerView)) crop(region);
    add("</div>\n");
    end_section();
  }

  void measure_maps(const RenderReport& r, std::size_t which) {
    const Measure& m = kMeasures[which];
    add("<h3>{}</h3>\n<p>{}, in the same colours from 0 to 1.</p>\n<div class=\"grid\">\n", m.title, m.shows);
    for (std::size_t i = 0; i < std::min(kMaps, r.pictures.size()); ++i) {
      const ViewPictures& p = r.pictures[i];
      const std::string name = html(r.views[p.view].name);
      Image map;
      const auto value = measure(which, p.source, p.asset, &map);
      if (!value) continue;
      add("<figure><img src=\"{}\" alt=\"{} map of {}\"><figcaption>{}: {:.6f}</figcaption></figure>\n",
          picture_uri(heat_map(shrunk(map, kMapWidth), 1), kMapBytes), m.title, name, name, *value);
    }
    add("</div>\n");
  }

  void crop(const Region& r) {
    const ViewPictures& p = report_.render->pictures[r.pictures];
    const ViewResult& v = report_.render->views[p.view];
    const std::string name = html(v.name);
    const auto part = [&](const Image& image) { return cropped(image, r.x, r.y, r.width, r.height); };
    const bool has_photo = !p.photo.pixels.empty();
    const std::size_t most = has_photo ? kCropBytesBesidePhoto : kCropBytes;
    add("<figure><div class=\"{}\">", has_photo ? "quad" : "triple");
    const auto one = [&](const Image& image, const char* what) {
      add("<div><img src=\"{}\" alt=\"{} of {} at {}, {}\"><span>{}</span></div>", picture_uri(image, most), what, name,
          r.x, r.y, what);
    };
    one(part(p.source.over(v.score.over_white)), "Original");
    one(part(p.asset.over(v.score.over_white)), "Asset");
    if (has_photo) one(part(p.photo), "Photograph");
    one(heat_map(part(maps_[r.pictures]), top_), "Difference");
    add("</div><figcaption>{}, {} x {} pixels at ({}, {}): {:.2g} levels RMS</figcaption></figure>\n", name, r.width,
        r.height, r.x, r.y, r.rms);
  }

  void views(const RenderReport& r) {
    title("views", "Views");
    add("<p>Worst first. Both sides are rendered by the original 3DGS definition in FP32 and compared in floating "
        "point, so that all differences come from the asset.{}{}</p>\n",
        r.level_psnr ? " Levels of detail are drawn twice, the leaves like a file without levels, and at the default "
                       "detail beside all of the original with equally compensated opacities: the worse drawing counts."
                     : "",
        !r.automatic_views ? ""
        : r.n_searched == 0
            ? " No cameras were given: these views lie on a circle around the scene, where no photograph "
              "may have been taken."
            : fmt::format(" No cameras were given: these views lie on a circle around the scene, or are "
                          "the worst that were found among {} around, behind and inside it, where no "
                          "photograph may have been taken.",
                          r.n_searched));
    view_command(r);
    const bool photos = r.photo.has_value();
    const bool one_size = std::all_of(r.views.begin(), r.views.end(), [&](const ViewResult& v) {
      return v.width == r.views.front().width && v.height == r.views.front().height;
    });
    table("Views");
    add("<thead><tr><th>View{}</th><th>PSNR, dB</th><th>Error, levels RMS</th><th>SSIM</th>{}<th>Largest, levels</th>"
        "<th>Drawn, % of the pixels</th>{}</tr></thead><tbody>\n",
        one_size && !r.views.empty() ? fmt::format(" ({} x {})", r.views.front().width, r.views.front().height) : "",
        measure_cells([&](std::size_t i) { return fmt::format("<th>{}</th>", kMeasures[i].title); }),
        photos ? "<th>Original to photo, dB</th><th>Asset to photo, dB</th><th>Lost, dB</th>" : "");
    const double highest = levels(r.n_rated == 0 ? 0 : r.views.front().score.mse);
    for (std::size_t i = 0; i < std::min(kListedViews, r.views.size()); ++i)
      view_row(r.views[i], highest, !one_size, photos);
    if (r.n_rated != 0) {
      add("<tr class=\"sum\"><td>{} rated views</td><td>mean {}</td><td>mean {:.3f}</td><td>mean {:.6f}</td>{}<td>max "
          "{:.1f}</td><td></td>",
          r.n_rated, number(r.psnr, 2), levels(r.mse), r.ssim,
          measure_cells([&](std::size_t i) { return fmt::format("<td>mean {:.6f}</td>", *r.measures[i]); }),
          255 * static_cast<double>(r.largest));
      if (photos)
        add("<td>mean {}</td><td>mean {}</td><td>mean {}</td>", number(r.photo->source_psnr, 3),
            number(r.photo->asset_psnr, 3), number(r.photo->loss(), 4));
      add("</tr>\n");
    }
    end_table();
    if (r.views.size() > kListedViews) add("<p class=\"note\">The JSON output lists all views.</p>\n");
    if (r.n_undrawable != 0)
      add("<p class=\"note\">{} damaged Gaussians of the source cannot be drawn and are missing from the "
          "reference.</p>\n",
          format_count(r.n_undrawable));
    end_section();
  }

  // The script appends a view's argument to the command.
  void view_command(const RenderReport& r) {
    if (report_.view_command.empty()) return;
    const std::string command = html(report_.view_command);
    add("<p>To look at both sides in a browser: <code id=\"look\" data-command=\"{0}\">{0}</code>{1}</p>\n", command,
        r.automatic_views ? "" : ". A view's button adds it to the command and copies both.");
  }

  std::string copy_button(const ViewResult& v) const {
    const std::string argument =
        report_.view_command.empty() || report_.render->automatic_views ? std::string() : view_argument(v.name);
    if (argument.empty()) return {};
    const std::string name = html(v.name);
    return fmt::format(
        " <button type=\"button\" class=\"copy\" data-view=\"{}\" aria-label=\"Copy the command for {}\">copy</button>",
        html(argument), name);
  }

  // One cell for each measure that was asked for.
  template <class Cell>
  std::string measure_cells(const Cell& cell) const {
    std::string text;
    for (std::size_t i = 0; i < kMeasures.size(); ++i)
      if (report_.render->measures[i]) text += cell(i);
    return text;
  }

  static std::string meter(double share) {
    return fmt::format("<svg class=\"meter\" aria-hidden=\"true\"><rect width=\"{:.0f}%\" height=\"100%\"/></svg>",
                       100 * std::clamp(share, 0.0, 1.0));
  }

  void view_row(const ViewResult& v, double highest, bool with_size, bool photos) {
    const double rms = levels(v.score.mse);
    add("<tr><td>{}{}{}</td>", html(v.name),
        with_size ? fmt::format(" <span class=\"soft\">{} x {}</span>", v.width, v.height) : "", copy_button(v));
    if (v.rated()) {
      add("<td>{}</td><td>{}<b>{:.3f}</b></td><td>{:.6f}</td>{}<td>{:.1f}</td>", number(v.score.psnr, 2),
          meter(highest > 0 ? rms / highest : 0), rms, v.score.ssim,
          measure_cells([&](std::size_t i) { return fmt::format("<td>{:.6f}</td>", *v.score.measures[i]); }),
          255 * static_cast<double>(v.score.largest));
    } else {
      add("<td colspan=\"{}\" class=\"fair\">not rated: almost nothing is drawn</td>",
          4 + std::ranges::count_if(report_.render->measures, [](const auto& m) { return m.has_value(); }));
    }
    add("<td{}>{:.1f}</td>", v.hardly_sees() ? " class=\"fair\"" : "", 100 * v.drawn);
    if (!v.rated() && photos) add("<td colspan=\"3\"></td>");
    if (v.photo)
      add("<td>{}</td><td>{}</td><td>{}</td>", number(v.photo->source_psnr, 3), number(v.photo->asset_psnr, 3),
          number(v.photo->loss(), 4));
    add("</tr>\n");
  }

  static std::string number(double value, int digits) {
    return std::isfinite(value) ? fmt::format("{:.{}f}", value, digits) : "&infin;";
  }

  void video(const VideoReport& r) {
    title("video", "Video");
    add("<p>The views in the order of their cameras, as frames of a video of {} frames a second; a bar marks the worst "
        "second. Flicker is how much the asset's change since the frame before differs from the "
        "original's.</p>\n<div class=\"grid\">\n",
        r.fps);
    const auto shown = [](double v) { return std::isfinite(v) ? fmt::format("{:.5g}", v) : "&infin;"; };
    for (const Curve& c : r.curves) {
      add("<div class=\"panel\"><h3>{}</h3><p class=\"soft\">worst frame {} at {}, worst second {} from "
          "{}</p>{}</div>\n",
          c.name, shown(c.values[c.worst]), html(r.name_of(c.worst)), shown(c.second_mean), html(r.name_of(c.second)),
          frame_curve(c, r.fps, c.name + " of each frame"));
    }
    add("</div>\n");
    end_section();
  }

  // ---- steps

  void attribution(const RenderReport& r) {
    if (r.attribution.empty()) {
      if (r.attribution_note != "not requested")
        add("<p class=\"note\">No attribution of the loss to steps: {}.</p>\n", html(r.attribution_note));
      return;
    }
    title("steps", "Which step costs what");
    add("<p>Each step alone, with all others exact, against the original. The first rows are losses of storage, the "
        "next those of a fast renderer, the last is all together. Shares are of the squared error of all together; "
        "they need not add up to 100 %, because errors add up or cancel.</p>\n");
    table("Attribution of the loss");
    const bool photos = r.photo.has_value();
    add("<thead><tr><th>Step</th><th>PSNR, dB</th><th>Worst view, dB</th><th>Error, levels RMS</th><th>Share of the "
        "squared "
        "error</th>{}</tr></thead><tbody>\n",
        photos ? "<th>Lost to photos, dB</th>" : "");
    const char* group = "";
    for (const AttributionRow& row : r.attribution) {
      const char* belongs = group_of(row.key);
      if (std::string_view(belongs) != group && *belongs != '\0')
        add("<tr class=\"group\"><td colspan=\"{}\">{}</td></tr>\n", photos ? 6 : 5, belongs);
      group = belongs;
      add("<tr{}><td>{}</td><td>{}</td><td>{}</td><td>{:.3f}</td><td>{}<b>{:.1f} %</b></td>",
          row.key == "together" ? " class=\"sum\"" : "", html(row.name), number(row.psnr, 2), number(row.worst, 2),
          levels(row.mse), meter(row.share), 100 * row.share);
      if (photos) add("<td>{}</td>", number(row.loss.value_or(0), 4));
      add("</tr>\n");
    }
    end_table();
    if (const auto& d = report_.declarations)
      add("<p class=\"note\">The sort key spreads depths from {:.4g} to {:.4g} over its bins, {}, as the file "
          "declares. The fast "
          "exponential is the bit construction of Schraudolph with zero mean error.</p>\n",
          d->z_near, d->z_far, tool::name_of(d->depth_mapping).words);
    end_section();
  }

  static const char* group_of(const std::string& key) {
    if (key == "together") return "";
    if (key.ends_with("scales")) return "For comparison: SH step sizes, requantised from the source";
    return key == "key" || key == "exp" || key == "lists" ? "Drawn by a fast renderer" : "Stored in the asset";
  }

  // ---- levels of detail

  void distances(const DistanceReport& r) {
    title("distances", "Levels of detail at a distance");
    add("<p>The rated views from up to {} times as far, in pictures as many times smaller. The truth is the original "
        "as drawn above, at twice the size of the nearest view, averaged over squares of pixels. Levels are drawn at a "
        "detail of {:g} pixel; {} Gaussians in {} levels are stored.</p>\n",
        r.rows.back().far, r.detail_px, format_count(report_.size.levels->n_gaussians), report_.size.levels->n_levels);
    table("Levels of detail by distance");
    add("<thead><tr><th>As far</th><th>All Gaussians as declared, dB</th><th>SSIM</th><th>All, compensated, dB</th>"
        "<th>SSIM</th><th>Levels, dB</th><th>Worst view, dB</th><th>SSIM</th><th>Gaussians drawn</th></tr></thead>"
        "<tbody>\n");
    for (const FarRow& row : r.rows) {
      const FarScore &all = row.score(FarScene::leaves), &compensated = row.score(FarScene::compensated),
                     &levels = row.score(FarScene::levels);
      add("<tr><td>{}&times;</td><td>{}</td><td>{:.5f}</td><td>{}</td><td>{:.5f}</td><td><b>{}</b></td><td>{}</td>"
          "<td>{:.5f}</td><td>{}<b>{:.1f} %</b></td></tr>\n",
          row.far, number(all.psnr, 2), all.ssim, number(compensated.psnr, 2), compensated.ssim, number(levels.psnr, 2),
          number(levels.worst_psnr, 2), levels.ssim, meter(row.drawn), 100 * row.drawn);
    }
    end_table();
    if (!r.note.empty()) add("<p class=\"note\">Some distances are missing: {}.</p>\n", html(r.note));
    std::vector<Image> maps;
    for (const FarPictures& p : r.pictures) maps.push_back(difference_levels(p.truth, p.levels));
    const float top = scale_top(maps);
    add("<p class=\"note\">Below, for each distance, the view with the worst levels. Differences between truth and "
        "levels share one colour scale, from 0 to {:.3g} of 255 levels.</p>\n",
        top);
    add("<div class=\"strips\">\n");
    for (std::size_t i = 0; i < r.pictures.size(); ++i) strip(r, r.pictures[i], heat_map(maps[i], top));
    add("</div>\n");
    end_section();
  }

  void strip(const DistanceReport& r, const FarPictures& p, const Image& map) {
    const FarRow& row = r.rows[p.row];
    const FarView& v = row.views[p.view];
    add("<figure><div class=\"quad\">");
    const auto one = [&](const Image& image, const char* what) {
      add("<div><img src=\"{}\" alt=\"{}, {} times as far, {}\"><span>{}</span></div>",
          picture_uri(shrunk(image, kStripWidth), kStripBytes), html(v.name), row.far, what, what);
    };
    one(p.truth.over(p.over_white), "Truth");
    one(p.leaves.over(p.over_white), "All Gaussians");
    one(p.levels.over(p.over_white), "Levels");
    one(map, "Difference");
    add("</div><figcaption>{}&times; as far, {}, {} x {} pixels: all Gaussians as declared {}, levels {} from {:.1f} % "
        "of "
        "them</figcaption></figure>\n",
        row.far, html(v.name), v.width, v.height, format_psnr(v.psnr[static_cast<std::size_t>(FarScene::leaves)]),
        format_psnr(v.psnr[static_cast<std::size_t>(FarScene::levels)]), 100 * v.drawn);
  }

  // ---- attributes

  void attributes(const AttributeReport& a) {
    title("attributes", "Attributes");
    error_table("Errors by meaning");
    error_row(a.colour.name, a.colour.meaning_unit, a.colour.meaning);
    for (const AttributeError& e : a.errors)
      if (!is_sh(e)) error_row(e.name, e.meaning_unit, e.meaning);
    for (const AttributeError& e : a.errors)
      if (is_sh(e)) error_row(e.name, e.meaning_unit, e.meaning);
    end_table();
    add("<details><summary>The same in stored values</summary>\n");
    error_table("Errors in stored values");
    for (const AttributeError& e : a.errors) error_row(e.name, e.unit.empty() ? "coefficient" : e.unit, e.value);
    end_table();
    add("</details>\n");
    add("<p class=\"note\">Errors are absolute. A colour error is the RMS over all viewing directions of a Gaussian, "
        "before blending; percentiles are at most 1.6 % too high.</p>\n");
    histograms(a);
    limits(a);
    end_section();
    worst_gaussians(a);
  }

  // The same number of digits in a column; an exact 0 has none.
  static std::string three_digits(double value) { return value == 0 ? "0" : fmt::format("{:#.3g}", value); }

  static bool is_sh(const AttributeError& e) { return e.key.starts_with("sh"); }

  void error_table(const char* label) {
    table(label);
    add("<thead><tr><th>Attribute</th><th class=\"left\">Error in</th><th>RMS</th><th>Mean</th><th>Median</th><th>99 "
        "%</th>"
        "<th>99.9 %</th><th>Largest</th></tr></thead><tbody>\n");
  }

  void error_row(const std::string& name, const std::string& unit, const ErrorStatistics& e) {
    add("<tr><td>{}</td><td class=\"left soft\">{}</td>", html(name), html(unit));
    for (const double v : {e.rms, e.mean, e.p50, e.p99, e.p999, e.max}) add("<td>{}</td>", three_digits(v));
    add("</tr>\n");
  }

  void histogram(const std::string& name, const std::string& unit, const ErrorStatistics& e) {
    add("<div class=\"panel\"><h3>{}</h3><p class=\"soft\">{}{}</p>{}</div>\n", html(name), html(unit),
        e.n_zero == 0 ? ""
                      : fmt::format("; {:.1f} % exact", 100 * static_cast<double>(e.n_zero) / static_cast<double>(e.n)),
        error_histogram(e, unit, name));
  }

  void histograms(const AttributeReport& a) {
    add("<h3>Distribution of errors</h3>\n<p class=\"note\">Logarithmic axes. Lines: median, 99 % (dashed), largest "
        "(dotted).</p>\n");
    add("<div class=\"grid\">\n");
    histogram(a.colour.name, a.colour.meaning_unit, a.colour.meaning);
    for (const AttributeError& e : a.errors)
      if (!is_sh(e)) histogram(e.name, e.meaning_unit, e.meaning);
    for (const AttributeError& e : a.errors)
      if (is_sh(e) && e.key.ends_with("green")) histogram(e.name, e.meaning_unit, e.meaning);
    add("</div>\n<h3>Use of the 255 SH codes</h3>\n<p class=\"note\">Height by the logarithm of the count. Unused "
        "codes waste precision.</p>\n<div class=\"grid narrow\">\n");
    for (std::size_t d = 0; d < a.codes.size(); ++d) {
      const CodeUsage& c = a.codes[d];
      const std::string name = fmt::format("SH degree {}", d);
      add("<div class=\"panel\"><h3>{}</h3><p class=\"soft\">{} of 255 codes used, {:.2f} bits of "
          "entropy</p>{}</div>\n",
          name, c.used(), c.entropy_bits(), code_histogram(c, name));
    }
    add("</div>\n");
  }

  void limits(const AttributeReport& a) {
    const RangeCounts& r = a.ranges;
    add("<h3>What the number formats could not hold</h3>\n");
    table("Saturation and underflow");
    add("<thead><tr><th>Event</th><th>Count</th><th class=\"left\">Meaning</th></tr></thead><tbody>\n");
    const auto row = [&](const char* name, std::uint64_t n, const char* meaning) {
      add("<tr><td>{}</td><td>{}</td><td class=\"left soft\">{}</td></tr>\n", name, format_count(n), meaning);
    };
    row("SH clipped", r.sh_clipped, "more than half a step beyond the largest code: lost");
    row("SH at the largest code", r.sh_limit, "&plusmn;127; the largest value of every step set, so always some");
    row("SH flushed to 0", r.sh_flushed, "smaller than half a step, not 0 in the source");
    row("Scale subnormal", r.scale_subnormal, "below the normal range of FP16: fewer digits");
    row("Scale flushed to 0", r.scale_zero, "too small for FP16: lost");
    row("Opacity became 0", r.opacity_zero, "invisible now, faint in the source");
    row("Opacity became 1", r.opacity_one, "rounded up; renderers stop at 0.99 anyway");
    end_table();
  }

  void worst_gaussians(const AttributeReport& a) {
    title("worst", "Worst Gaussians");
    add("<p>Indices count from 0 in each file.</p>\n<div class=\"grid\">\n");
    for (const WorstList& list : a.worst) {
      if (list.gaussians.empty()) {
        add("<div class=\"panel\"><h3>{}</h3><p class=\"soft\">exact in every Gaussian</p></div>\n", html(list.name));
        continue;
      }
      add("<div class=\"panel\"><h3>{}</h3><p class=\"soft\">error in {}</p><table><thead><tr><th>In the "
          "source</th><th>In the "
          "asset</th><th>Error</th></tr></thead><tbody>\n",
          html(list.name), html(list.unit));
      for (const WorstGaussian& g : list.gaussians)
        add("<tr title=\"at {:.4g}, {:.4g}, {:.4g}\"><td>{}</td><td>{}</td><td>{}</td></tr>\n", g.mean[0], g.mean[1],
            g.mean[2], format_count(g.source_index), format_count(g.asset_index), three_digits(g.error));
      add("</tbody></table></div>\n");
    }
    add("</div>\n");
    end_section();
  }

  // ---- size

  void sizes() {
    const SizeReport& s = report_.size;
    title("size", "Size");
    if (!s.sections.empty()) sections(s);
    table("Files");
    add("<thead><tr><th>File</th><th>Bytes</th><th>Bytes per Gaussian</th><th>Ratio to the source</th><th>PSNR, "
        "dB</th><th>Worst, "
        "dB</th><th>SSIM</th></tr></thead><tbody>\n");
    file_row(report_.source_name, s.source_bytes, s.n_source, "<td colspan=\"3\" class=\"soft\">the reference</td>");
    std::string quality = "<td colspan=\"3\" class=\"soft\">not rendered</td>";
    if (const auto& r = report_.render)
      quality = r->n_rated == 0 ? "<td colspan=\"3\" class=\"soft\">not rated</td>"
                                : fmt::format("<td>{}</td><td>{}</td><td>{:.6f}</td>", number(r->psnr, 2),
                                              number(r->worst_psnr, 2), r->ssim);
    file_row(report_.asset_name, s.asset_bytes, s.n_asset, quality);
    for (const AlsoReport& a : report_.also) {
      const std::string measured = a.psnr ? fmt::format("<td>{}</td><td>{}</td><td>{:.6f}</td>", number(*a.psnr, 2),
                                                        number(*a.worst_psnr, 2), *a.ssim)
                                          : fmt::format("<td colspan=\"3\" class=\"soft\">{}</td>", html(a.note));
      file_row(a.path.substr(a.path.find_last_of('/') + 1), a.bytes, a.n_gaussians != 0 ? a.n_gaussians : s.n_source,
               measured);
    }
    end_table();
    gaussians();
    if (s.gpu_bytes != 0)
      add("<p>On the GPU the asset takes {} ({:.1f} bytes per Gaussian), as FP32 attributes {}.</p>\n",
          format_bytes(s.gpu_bytes), s.gpu_bytes_per_gaussian(), format_bytes(s.gpu_bytes_fp32));
    end_section();
  }

  void gaussians() {
    const PairReport& p = report_.pairs;
    add("<p>{} Gaussians paired {}. {}", format_count(p.n_paired), pairing_words(p.by),
        p.n_source_only + p.n_asset_only == 0
            ? std::string("None is missing or added.")
            : fmt::format("<b class=\"bad\">{} are only in the source, {} only in the asset.</b>",
                          format_count(p.n_source_only), format_count(p.n_asset_only)));
    if (const auto& r = report_.render)
      add(" {} of the source and {} of the asset lie in no rated view.", format_count(r->source_unseen),
          format_count(r->asset_unseen));
    add("</p>\n");
  }

  void file_row(const std::string& name, std::uint64_t bytes, std::uint64_t n, const std::string& quality) {
    add("<tr><td>{}</td><td>{}</td><td>{:.2f}</td><td>{:.2f}</td>{}</tr>\n", html(name), format_count(bytes),
        n == 0 ? 0 : static_cast<double>(bytes) / static_cast<double>(n),
        bytes == 0 ? 0 : static_cast<double>(report_.size.source_bytes) / static_cast<double>(bytes), quality);
  }

  void sections(const SizeReport& s) {
    add("<svg class=\"stack\" role=\"img\" aria-label=\"Sections of the asset by size; the table below has the "
        "numbers\">");
    double left = 0;
    for (std::size_t i = 0; i < std::min(kListedSections, s.sections.size()); ++i) {
      const double share = 100 * static_cast<double>(s.sections[i].stored_bytes) / static_cast<double>(s.asset_bytes);
      add("<rect x=\"{:.3f}%\" width=\"{:.3f}%\" height=\"100%\" fill=\"{}\"/>", left, share,
          kSectionColours[i % kSectionColours.size()]);
      left += share;
    }
    add("</svg>\n");
    table("Sections of the asset");
    add("<thead><tr><th>Section</th><th class=\"left\">Content</th><th>Stored, bytes</th><th>Decoded, "
        "bytes</th><th>Per "
        "Gaussian</th><th>Share</th></tr></thead><tbody>\n");
    std::uint64_t stored = 0;
    for (std::size_t i = 0; i < std::min(kListedSections, s.sections.size()); ++i) {
      const SectionSize& section = s.sections[i];
      stored += section.stored_bytes;
      add("<tr><td><svg class=\"key\" aria-hidden=\"true\"><rect width=\"100%\" height=\"100%\" "
          "fill=\"{}\"/></svg><code>{}</code></td><td "
          "class=\"left\">{}</td><td>{}</td>"
          "<td>{}</td><td>{:.2f}</td><td>{:.2f} %</td></tr>\n",
          kSectionColours[i % kSectionColours.size()], html(section.type),
          section.content.empty() ? "unknown" : html(section.content), format_count(section.stored_bytes),
          format_count(section.decoded_bytes),
          s.n_asset == 0 ? 0 : static_cast<double>(section.stored_bytes) / static_cast<double>(s.n_asset),
          100 * static_cast<double>(section.stored_bytes) / static_cast<double>(s.asset_bytes));
    }
    const std::uint64_t rest = s.asset_bytes - std::min(stored, s.asset_bytes);
    add("<tr><td></td><td class=\"left\">header, table, padding</td><td>{}</td><td></td><td></td><td>{:.2f} "
        "%</td></tr>\n",
        format_count(rest), 100 * static_cast<double>(rest) / static_cast<double>(s.asset_bytes));
    end_table();
  }

  // ---- how it was measured

  void fact(const char* name, const std::string& text) { add("<dt>{}</dt><dd>{}</dd>\n", name, text); }

  void method() {
    title("method", "Method");
    add("<dl class=\"facts\">\n");
    fact("Source",
         fmt::format("{}: {} bytes, {} Gaussians, SH degree {}, XXH3 <code>{:016x}</code>", html(report_.source_name),
                     format_count(report_.size.source_bytes), format_count(report_.size.n_source),
                     report_.size.source_sh_degree, report_.source_xxh3));
    fact("Asset", fmt::format("{}: {} bytes, {} Gaussians, SH degree {}, XXH3 <code>{:016x}</code>",
                              html(report_.asset_name), format_count(report_.size.asset_bytes),
                              format_count(report_.size.n_asset), report_.size.asset_sh_degree, report_.asset_xxh3));
    fact("Source check", !report_.made_from_source ? "the asset does not state its source"
                         : *report_.made_from_source
                             ? "the asset names this source: name, size and hash agree"
                             : "<b class=\"bad\">the asset names another file as its source</b>");
    if (report_.render) {
      fact("Reference",
           "the source in FP32 by the original 3DGS definition: square extent of 3 sigma, exact depth order, exact "
           "exponential; the asset is drawn with the same arithmetic");
      fact("PSNR",
           "-10 log10 of the mean squared difference of floating-point values with peak 1, neither clamped nor rounded "
           "to 8 bits, over the background that shows more in each channel of each pixel; means are over the rated "
           "views that differ");
      fact("Rated", fmt::format("views in which source or asset draws on at least {:g} % of the pixels; below {:g} % "
                                "they are flagged, because equal background raises PSNR",
                                100 * kRatedShare, 100 * kHardlySeenShare));
      fact("SSIM",
           "as in 3DGS: 11 x 11 Gaussian window, sigma 1.5, zero padding; the lower one over black and over white");
      for (std::size_t i = 0; i < kMeasures.size(); ++i)
        if (report_.render->measures[i])
          fact(kMeasures[i].title, fmt::format("{}: {}; the {} one over black and over white", kMeasures[i].method,
                                               kMeasures[i].scale, kMeasures[i].at_least ? "lower" : "higher"));
      if (report_.render->video)
        fact("Flicker",
             "RMS, in levels of 255, of the asset's change from frame to frame minus the source's, over the background "
             "that shows more in each channel of each pixel; a second's PSNR is that of its mean squared error");
      if (report_.render->photo)
        fact("Photographs",
             "values over black clamped to 0..1, PSNR and SSIM against the photograph; lost is the source's PSNR minus "
             "the "
             "asset's");
      fact("Renderer", html(report_.render->backend));
    }
    fact("Tool", html(report_.tool) + (report_.fingerprint.empty() ? "" : run_html(report_.fingerprint)));
    add("</dl>\n");
    end_section();
  }

  const Report& report_;
  Verdict verdict_;
  std::vector<Image> maps_;  // levels of report_.render->pictures
  float top_ = 1;
  std::string out_;
};

}  // namespace

std::string audit_html(const Report& report) {
  return Page(report).all();
}

bool is_audit_page(const std::string& page) {
  const std::size_t begin = page.find(kVerdictBegins);
  return begin != page.npos && page.find(kVerdictEnds, begin) != page.npos;
}

bool is_audit_page_of(const std::string& page, const std::string& fingerprint) {
  return is_audit_page(page) && page.find(run_html(fingerprint)) != page.npos;
}

std::optional<std::string> with_gate(const std::string& page, const std::string& fingerprint, const Verdict& verdict,
                                     std::span<const Condition> gate) {
  const std::size_t begin = page.find(kVerdictBegins), end = page.find(kVerdictEnds);
  if (begin == page.npos || end == page.npos || end < begin || page.find(run_html(fingerprint)) == page.npos) return {};
  return page.substr(0, begin + kVerdictBegins.size()) + verdict_html(verdict, gate) + page.substr(end);
}

}  // namespace rgs::audit
