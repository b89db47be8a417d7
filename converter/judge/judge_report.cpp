// judge_report.cpp - the same facts in four forms.
// SPDX-License-Identifier: Apache-2.0
#include "judge_report.hpp"

#include <fmt/format.h>

#include <array>
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <utility>

#include "audit_page.hpp"
#include "audit_picture.hpp"
#include "console.hpp"
#include "image_file.hpp"
#include "rgs/version.hpp"
#include "text_lines.hpp"

namespace rgs::judge {
namespace {

using Json = nlohmann::ordered_json;

std::string decibels(double psnr) {
  return std::isfinite(psnr) ? fmt::format("{:.1f} dB", psnr) : "equal";
}

// Without the sign that makes -0.0 of a small number.
std::string signed_levels(double bias) {
  return std::abs(bias) < 0.005 ? "0.00" : fmt::format("{:+.2f}", bias);
}

std::string summary(const Report& r) {
  if (r.found.mse <= 0) return r.client + " draws the scene as defined";
  return fmt::format("{} differs from the definition: {}; {:.1f}% of the squared error is named", r.client,
                     decibels(r.found.psnr()), 100 * r.found.named());
}

class Text : private tool::TextLines {
 public:
  std::string all(const Report& r) {
    line("{}", tool::printable(summary(r)));
    if (!r.found.steps.empty()) line("  {:>7} {:>9} {:>7}  {}", "share", "then", "levels", "because it");
    for (const Step& s : r.found.steps)
      line("  {:>6.1f}% {:>9} {:>7}  {}{}", 100 * s.share, decibels(s.psnr), signed_levels(s.bias), s.cause->sentence,
           s.is_known ? "" : " (found by trying)");
    if (r.found.mse > 0) {
      line("  {:>6.1f}% {:>17}  differs by a level at most, as rounding does", 100 * r.found.rounding, "");
      line("  {:>6.1f}% {:>17}  not named", 100 * r.found.rest, "");
    }
    for (const View& v : r.found.views)
      line("  {}: {}, explained {}", tool::printable(v.name), decibels(v.psnr), decibels(v.explained_psnr));
    return take();
  }
};

struct Pictures {
  std::array<Image, kPictures.size()> images;
  float top = 0;  // of the maps, levels
};

Pictures pictures_of(const View& view, const Image& shown) {
  Pictures p;
  const auto levels = [&shown](const Image& image) { return audit::difference_levels({image, image}, {shown, shown}); };
  const Image map = levels(view.definition);
  p.top = audit::scale_top({&map, 1});
  p.images = {view.definition, shown, view.explained, audit::heat_map(map, p.top)};
  return p;
}

}  // namespace

std::string text(const Report& report) {
  return Text().all(report);
}

std::string json(const Report& r) {
  const auto finite = [](double v) { return std::isfinite(v) ? Json(v) : Json(); };
  Json causes = Json::array(), views = Json::array();
  for (const Step& s : r.found.steps)
    causes.push_back({{"key", s.cause->key},
                      {"sentence", s.cause->sentence},
                      {"known", s.is_known},
                      {"share", s.share},
                      {"psnr", finite(s.psnr)},
                      {"bias", s.bias}});
  for (const View& v : r.found.views)
    views.push_back({{"name", v.name}, {"psnr", finite(v.psnr)}, {"explained_psnr", finite(v.explained_psnr)}});
  const Json document = {{"schema", "rgs-judge/1"},
                         {"tool", "rgs-judge " RGS_VERSION},
                         {"scene", r.scene},
                         {"gaussians", r.gaussians},
                         {"client", r.client},
                         {"version", r.version},
                         {"browser", r.browser},
                         {"mse", r.found.mse},
                         {"psnr", finite(r.found.psnr())},
                         {"rounding", r.found.rounding},
                         {"named", r.found.named()},
                         {"causes", std::move(causes)},
                         {"views", std::move(views)}};
  return document.dump(2, ' ', true, Json::error_handler_t::replace) + "\n";
}

std::string page(const Report& r) {
  using audit::html;
  std::string out = audit::page_begin("Why " + r.client + " differs");
  out += fmt::format("<h1>{}</h1>\n<p class=\"names\"><b>{}</b>, {} Gaussians; {} {} {}</p>\n", html(summary(r)),
                     html(r.scene), tool::format_count(r.gaussians), html(r.client), html(r.version), html(r.browser));
  if (!r.found.steps.empty()) {
    out +=
        "<h2>Causes</h2>\n<div class=\"wrap\"><table><thead><tr><th class=\"left\">It</th><th>share of the squared "
        "error"
        "</th><th>PSNR with this cause and those above</th><th>mean change, levels of 255</th></tr></thead><tbody>\n";
    for (const Step& s : r.found.steps)
      out += fmt::format("<tr><td>{}{}</td><td>{:.1f}%</td><td>{}</td><td>{}</td></tr>\n", html(s.cause->sentence),
                         s.is_known ? "" : " <span class=\"soft\">(found by trying)</span>", 100 * s.share,
                         decibels(s.psnr), signed_levels(s.bias));
    out += fmt::format(
        "<tr><td>differs by a level at most, as rounding does</td><td>{:.1f}%</td><td></td><td></td></tr>\n"
        "<tr class=\"sum\"><td>not named</td><td>{:.1f}%</td><td></td><td></td></tr>\n</tbody></table></div>\n",
        100 * r.found.rounding, 100 * r.found.rest);
  }
  out += "<h2>Pictures</h2>\n";
  constexpr std::array kCaptions{"definition", "the program", "drawn by the rules above", "difference"};
  for (std::size_t i = 0; i < r.found.views.size(); ++i) {
    const View& view = r.found.views[i];
    const Pictures p = pictures_of(view, r.shown[i].picture);
    out += "<figure><div class=\"quad\">";
    for (std::size_t k = 0; k < p.images.size(); ++k)
      out += fmt::format("<span><img alt=\"{} of {}\" src=\"{}\">{}</span>", kCaptions[k], html(view.name),
                         audit::picture_uri(audit::shrunk(p.images[k], 960), 400'000), kCaptions[k]);
    out += fmt::format(
        "</div><figcaption>{}: {}, explained {}. Differences from 0 (black) to {:.0f} levels (yellow)."
        "</figcaption></figure>\n",
        html(view.name), decibels(view.psnr), decibels(view.explained_psnr), p.top);
  }
  return out + audit::page_end();
}

audit::Outcome<void> write_pictures(const std::vector<std::string>& paths, const Report& r, bool overwrite) {
  ImageFileOptions options;
  options.file.overwrite = overwrite;
  for (std::size_t i = 0; i < r.found.views.size(); ++i) {
    const Pictures p = pictures_of(r.found.views[i], r.shown[i].picture);
    for (std::size_t k = 0; k < kPictures.size(); ++k) {
      const std::string& path = paths[i * kPictures.size() + k];
      if (const Status ok = write_image(path, p.images[k], options); !ok) return audit::make_error(path, ok.error());
    }
  }
  return {};
}

}  // namespace rgs::judge
