// audit_gate.cpp - conditions and verdict.
// SPDX-License-Identifier: Apache-2.0
#include "audit_gate.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <limits>
#include <optional>
#include <string_view>
#include <utility>

#include "audit_text.hpp"

namespace rgs::audit {
namespace {

using Needs = ConditionKind::Needs;
constexpr std::array<ConditionKind, 33> kKinds{{
    {"psnr", "mean PSNR of the views, dB", true, Needs::pictures},
    {"worst-psnr", "PSNR of the worst view, dB", true, Needs::pictures},
    {"ssim", "mean SSIM of the views", true, Needs::pictures},
    {"worst-ssim", "SSIM of the worst view", true, Needs::pictures},
    {"together-psnr", "mean PSNR including the fast renderer's arithmetic, dB", true, Needs::attribution},
    {"largest", "largest difference of any pixel, 8-bit levels", false, Needs::pictures},
    {"rated-views", "views that show enough of the scene to be rated", true, Needs::pictures},
    {"loss", "PSNR lost against the photographs, dB", false, Needs::photos},
    {"depth", "mean error of the depths of the worst view, over the source's", false, Needs::depth},
    {"flip", "mean FLIP of the views, 0 to 1", false, Needs::pictures},
    {"worst-flip", "FLIP of the worst view", false, Needs::pictures},
    {"ms-ssim", "mean MS-SSIM of the views", true, Needs::pictures},
    {"worst-ms-ssim", "MS-SSIM of the worst view", true, Needs::pictures},
    {"gmsd", "mean GMSD of the views", false, Needs::pictures},
    {"worst-gmsd", "GMSD of the worst view", false, Needs::pictures},
    {"flicker", "mean flicker of a video's frames, 8-bit levels RMS", false, Needs::video},
    {"worst-flicker", "flicker of the worst frame", false, Needs::video},
    {"ratio", "size of the source over the asset's", true, Needs::nothing},
    {"bytes-per-gaussian", "of the asset's file", false, Needs::nothing},
    {"gpu-bytes-per-gaussian", "resident on the GPU", false, Needs::nothing},
    {"dropped", "Gaussians of the source that the asset lacks", false, Needs::nothing},
    {"added", "Gaussians of the asset that the source lacks", false, Needs::nothing},
    {"contradictions", "declarations that contradict the source's and change the picture", false, Needs::nothing},
    {"unseen", "Gaussians in no rated view, of the source or of the asset, whichever has more", false, Needs::pictures},
    {"levels-psnr-1x", "mean PSNR of levels of detail against the truth, dB", true, Needs::distances},
    {"levels-psnr-2x", "the same from twice as far", true, Needs::distances},
    {"levels-psnr-4x", "from four times as far", true, Needs::distances},
    {"levels-psnr-8x", "from eight times as far", true, Needs::distances},
    {"levels-loss", "dB that levels lose in any view at any distance; 6 unless stated", false, Needs::distances},
    {"levels-drawn-1x", "share of the Gaussians that levels draw", false, Needs::distances},
    {"levels-drawn-2x", "the same from twice as far", false, Needs::distances},
    {"levels-drawn-4x", "from four times as far", false, Needs::distances},
    {"levels-drawn-8x", "from eight times as far", false, Needs::distances},
}};

const ConditionKind* kind_of(const std::string& name) {
  const auto found = std::find_if(kKinds.begin(), kKinds.end(), [&](const ConditionKind& k) { return name == k.name; });
  return found == kKinds.end() ? nullptr : &*found;
}

// The place in kMeasures of what a condition is on, or beyond its end.
std::size_t measure_of(std::string_view condition) {
  if (condition.starts_with("worst-")) condition.remove_prefix(6);
  return static_cast<std::size_t>(std::ranges::find(kMeasures, condition, &Measure::name) - kMeasures.begin());
}

double distance_value(const std::string& name, const DistanceReport& report) {
  if (name == "levels-loss") return report.worst().loss;
  const FarRow* row = report.at(name[name.size() - 2] - '0');
  if (row == nullptr) return std::numeric_limits<double>::quiet_NaN();
  return name.starts_with("levels-drawn") ? row->drawn : row->score(FarScene::levels).psnr;
}

// NaN for what was not measured: every comparison with it fails.
double found_value(const std::string& name, const Report& report) {
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  if (name == "ratio") return report.size.ratio();
  if (name == "bytes-per-gaussian") return report.size.bytes_per_gaussian();
  if (name == "gpu-bytes-per-gaussian")
    return report.size.gpu_bytes == 0 ? kNone : report.size.gpu_bytes_per_gaussian();
  if (name == "dropped") return static_cast<double>(report.pairs.n_source_only);
  if (name == "contradictions") return static_cast<double>(report.n_contradictions());
  if (name == "added") return static_cast<double>(report.pairs.n_asset_only);
  if (kind_of(name)->needs == Needs::distances)
    return report.distances ? distance_value(name, *report.distances) : kNone;
  if (!report.render) return kNone;
  const RenderReport& r = *report.render;
  if (name == "rated-views") return static_cast<double>(r.n_rated);
  if (name == "unseen") return static_cast<double>(std::max(r.source_unseen, r.asset_unseen));
  if (name == "psnr") return r.psnr;
  if (name == "worst-psnr") return r.worst_psnr;
  if (name == "ssim") return r.ssim;
  if (name == "worst-ssim") return r.worst_ssim;
  if (name == "largest") return 255 * static_cast<double>(r.largest);
  if (name == "loss") return r.loss.value_or(kNone);
  if (name == "depth") return r.depth ? r.depth->error : kNone;
  if (name == "flicker") return r.video ? r.video->flicker.value_or(kNone) : kNone;
  if (name == "worst-flicker") return r.video ? r.video->worst_flicker.value_or(kNone) : kNone;
  if (const auto i = measure_of(name); i < kMeasures.size())
    return (name == kMeasures[i].name ? r.measures : r.worst_measures)[i].value_or(kNone);
  for (const AttributionRow& row : r.attribution)
    if (name == "together-psnr" && row.key == "together")
      return r.level_psnr ? std::min(row.psnr, r.level_psnr->levels) : row.psnr;
  return kNone;
}

// PSNR and SSIM average over a picture and hide a few bad pixels, so the largest difference also limits the grades
// without visible loss. A pixel 16 of 255 levels off disappears in any texture, one 64 off is a spot. On south: the
// default conversion stays below 7, archive below 48, SPZ reaches 111.
constexpr float kLosslessLargest = 16.F / 255, kCloseLargest = 64.F / 255;
// FLIP, where it is measured, limits all grades. Fine noise has 0.05 at 43 dB, 0.08 at 37 and 0.15 at 30, so these limits
// hold back only what eyes see better than PSNR does, such as a shift of colours.
constexpr double kLosslessFlip = 0.05, kCloseFlip = 0.1, kVisibleFlip = 0.2;

Verdict::Grade grade_of_views(const Report& report) {
  using Grade = Verdict::Grade;
  const RenderReport& r = *report.render;
  if (r.n_rated == 0) return Grade::unrated;
  if (report.n_contradictions() != 0) return r.worst_psnr >= 30 ? Grade::visible : Grade::poor;
  const bool same_gaussians = report.pairs.n_source_only + report.pairs.n_asset_only == 0;
  if (r.worst_psnr == std::numeric_limits<double>::infinity() && same_gaussians) return Grade::identical;
  // 8-bit rounding alone leaves 58.9 dB; at 50 dB the RMS error is 0.8 levels, at 40 dB 2.6, at 30 dB 8.
  const double flip = r.worst_measures[kFlip].value_or(0);
  const auto reaches = [&](double psnr, double ssim, float largest, double most_flip) {
    return r.worst_psnr >= psnr && r.worst_ssim >= ssim && r.largest <= largest && flip <= most_flip;
  };
  if (reaches(48, 0.99, kLosslessLargest, kLosslessFlip)) return Grade::lossless;
  if (reaches(40, 0.97, kCloseLargest, kCloseFlip)) return Grade::close;
  if (r.worst_psnr >= 30 && flip <= kVisibleFlip) return Grade::visible;
  return Grade::poor;
}

// Levels that lose too much from afar, if any.
std::optional<DistanceReport::Worst> bad_levels(const Report& report) {
  auto worst = report.distances ? report.distances->worst() : DistanceReport::Worst();
  return worst.loss > kLevelsLossDb ? std::optional(std::move(worst)) : std::nullopt;
}

Verdict::Grade grade(const Report& report) {
  using Grade = Verdict::Grade;
  const Grade of_views = grade_of_views(report);
  const auto bad = bad_levels(report);
  return bad ? std::max(of_views, bad->psnr >= 30 ? Grade::visible : Grade::poor) : of_views;
}

// The quantised sort key, if it alone does visible damage: depths outside the declared range share its end bins.
const AttributionRow* misfit_key(const Report& report) {
  if (!report.render || !report.declarations) return nullptr;
  for (const AttributionRow& row : report.render->attribution)
    if (row.key == "key" && row.worst < 35) return &row;
  return nullptr;
}

const char* words(Verdict::Grade grade) {
  switch (grade) {
    case Verdict::Grade::identical: return "identical to the original";
    case Verdict::Grade::lossless: return "no visible loss";
    case Verdict::Grade::close: return "differences visible on a close look";
    case Verdict::Grade::visible: return "visible differences";
    case Verdict::Grade::poor: return "heavy damage";
    case Verdict::Grade::unrated: return "not rated";
  }
  return "";
}

}  // namespace

std::span<const ConditionKind> condition_kinds() {
  return kKinds;
}

tl::expected<std::vector<Condition>, std::string> parse_conditions(const std::string& text) {
  std::vector<Condition> out;
  for (std::size_t start = 0; start <= text.size();) {
    const std::size_t comma = std::min(text.find(',', start), text.size());
    const std::string part = text.substr(start, comma - start);
    start = comma + 1;
    const std::size_t equals = part.find('=');
    const ConditionKind* kind = kind_of(part.substr(0, equals));
    if (kind == nullptr) {
      std::string names;
      for (const ConditionKind& k : kKinds) names += std::string(names.empty() ? "" : ", ") + k.name;
      return tl::unexpected("--fail-below has no condition '" + part.substr(0, equals) + "', but " + names);
    }
    Condition condition{kind->name, 0, 0, kind->at_least, false};
    const char* first = equals == std::string::npos ? part.data() + part.size() : part.data() + equals + 1;
    const auto [end, error] = std::from_chars(first, part.data() + part.size(), condition.limit);
    if (error != std::errc() || end != part.data() + part.size() || !std::isfinite(condition.limit))
      return tl::unexpected(fmt::format("--fail-below takes conditions such as {}=50, not '{}'", kind->name, part));
    out.push_back(std::move(condition));
  }
  return out;
}

void imply(std::span<const Condition> conditions, Options& options) {
  for (const Condition& c : conditions)
    if (const auto i = measure_of(c.name); i < kMeasures.size()) options.measures[i] = true;
}

std::string unmeasurable(std::span<const Condition> conditions, const Options& options) {
  for (const Condition& c : conditions) {
    const Needs needs = kind_of(c.name)->needs;
    if (needs == Needs::photos && options.photos.empty()) return "the condition '" + c.name + "' needs --photos";
    if (needs != Needs::nothing && !options.render)
      return "the condition '" + c.name + "' needs pictures; drop --no-render";
    if (needs == Needs::attribution && !options.attribution)
      return "the condition '" + c.name + "' needs the attribution; drop --no-attribution";
    if (needs == Needs::depth && !options.depth) return "the condition '" + c.name + "' needs --depth";
    if (needs == Needs::video && !options.video) return "the condition '" + c.name + "' needs --video";
    if (needs == Needs::distances && !options.distances)
      return "the condition '" + c.name + "' needs the levels of detail; drop --no-distances";
  }
  return {};
}

Measured measured(const Report& report) {
  Measured out;
  for (const ConditionKind& kind : kKinds)
    if (const double found = found_value(kind.name, report); !std::isnan(found)) out.emplace(kind.name, found);
  return out;
}

std::vector<Condition> evaluate(std::vector<Condition> conditions, const Measured& measured) {
  const auto found = [&](const char* name) {
    const auto at = measured.find(name);
    return at == measured.end() ? std::numeric_limits<double>::quiet_NaN() : at->second;
  };
  for (Condition& c : conditions) {
    c.found = found(c.name.c_str());
    c.holds = c.at_least ? c.found >= c.limit : c.found <= c.limit;
  }
  // Conditions with unrated pictures must fail: cameras that see nothing must not pass on sizes alone.
  if (!conditions.empty() && found("rated-views") == 0) conditions.push_back({"rated-views", 1, 0, true, false});
  // Nor may what the views' pictures do not show: declarations, and levels that are drawn from afar.
  for (const auto& [name, limit] : {std::pair("contradictions", 0.0), std::pair("levels-loss", kLevelsLossDb)}) {
    const bool stated = std::ranges::find(conditions, name, &Condition::name) != conditions.end();
    if (!conditions.empty() && !stated && found(name) > limit)
      conditions.push_back({name, limit, found(name), false, false});
  }
  return conditions;
}

void evaluate(std::vector<Condition> conditions, Report& report) {
  report.gate = evaluate(std::move(conditions), measured(report));
}

bool holds(std::span<const Condition> gate) {
  return std::ranges::all_of(gate, [](const Condition& c) { return c.holds; });
}

std::string failed_conditions(std::span<const Condition> gate) {
  std::string text;
  for (const Condition& c : gate)
    if (!c.holds) text += (text.empty() ? "" : "; ") + describe(c);
  return text;
}

std::string headline_of(const std::string& finding, std::span<const Condition> gate) {
  return holds(gate) ? finding : "Gate failed: " + failed_conditions(gate) + ". " + finding;
}

std::string describe(const Condition& c) {
  if (std::isnan(c.found))
    return fmt::format("{} not measured, wanted {} {:g}", c.name, c.at_least ? ">=" : "<=", c.limit);
  const char* sign = c.holds ? (c.at_least ? ">=" : "<=") : (c.at_least ? "<" : ">");
  return fmt::format("{} {:.5g} {} {:g}", c.name, c.found, sign, c.limit);
}

Verdict verdict(const Report& report) {
  Verdict out;
  const std::string size = tool::format_size_change(report.size.source_bytes, report.size.asset_bytes);
  if (!report.render) {
    out.finding = fmt::format("{}; not rendered, so {}", size, words(out.grade));
  } else {
    const RenderReport& r = *report.render;
    out.grade = grade(report);
    out.finding = fmt::format("{}, {}", size, words(out.grade));
    if (out.grade == Verdict::Grade::unrated) {
      out.finding += ": no view shows the scene";
    } else if (std::isfinite(r.worst_psnr)) {
      out.detail = fmt::format(
          "Pictures differ by {:.3g} of 255 levels RMS: {:.1f} dB on average, {:.1f} dB in the worst of {} views. The "
          "largest difference of a pixel is {:.1f} levels.",
          255 * std::sqrt(r.mse), r.psnr, r.worst_psnr, r.n_rated, 255 * static_cast<double>(r.largest));
      if (const auto flip = r.worst_measures[kFlip]) out.detail += fmt::format(" FLIP reaches {:.3f}.", *flip);
    } else {
      out.detail = fmt::format("{} views are identical in every bit.", r.n_rated);
    }
    if (r.level_psnr && out.grade != Verdict::Grade::unrated)
      out.detail += fmt::format(" Each view is rated as its worse drawing: leaves {}, at the default detail {}.",
                                format_psnr(r.level_psnr->leaves), format_psnr(r.level_psnr->levels));
    if (const auto bad = bad_levels(report)) {
      out.finding += fmt::format(", with levels of detail that lose {:.1f} dB", bad->loss);
      out.detail += fmt::format(" The levels of detail fall to {:.1f} dB from {} times as far in {}.", bad->psnr,
                                bad->far, bad->view.empty() ? "a view" : "view " + bad->view);
    }
    const auto n_blind = static_cast<std::size_t>(
        std::count_if(r.views.begin(), r.views.end(), [](const ViewResult& v) { return v.hardly_sees(); }));
    out.hardly_seen = out.grade != Verdict::Grade::unrated &&
                      (2 * n_blind > r.views.size() || report.seen_share() < kHardlySeenShare);
    if (out.hardly_seen) out.finding += ", but the cameras hardly see the scene";
    if (r.depth)
      out.detail += fmt::format(
          " Depths differ by {:.2g} % on average in the worst view, where both draw at least half of a pixel.",
          100 * r.depth->error);
    if (r.loss && *r.loss > 0.0005) {
      out.detail += fmt::format(" Against the photographs {:.3f} dB are lost.", *r.loss);
    } else if (r.loss) {
      out.detail += " Against the photographs nothing is lost.";
    }
  }
  const auto add = [&out](const std::string& sentence) { out.detail += (out.detail.empty() ? "" : " ") + sentence; };
  if (report.pairs.n_source_only != 0)
    add(fmt::format("{} Gaussians of the source are missing from the asset.",
                    tool::format_count(report.pairs.n_source_only)));
  if (report.pairs.n_asset_only != 0)
    add(fmt::format("{} Gaussians of the asset are not in the source.", tool::format_count(report.pairs.n_asset_only)));
  if (const AttributionRow* key = misfit_key(report)) {
    out.depth_range_misfit = true;
    out.finding += ", but its depth range does not fit these views";
    add(
        fmt::format("A renderer that sorts by the declared range of depths, {:.4g} to {:.4g}, falls to {:.1f} dB; "
                    "convert with --cameras, or with --near and --far.",
                    report.declarations->z_near, report.declarations->z_far, key->worst));
  }
  if (report.made_from_source == false) add("The asset names another file as its source.");
  for (const DeclaredDifference& d : report.declared_differences) {
    if (d.changes_picture) out.finding += fmt::format(", but its {} contradicts the source's", d.name);
    add(fmt::format("The source states the {} as {}; the asset: {}.", d.name, d.source, d.asset));
  }
  out.headline = headline_of(out.finding, report.gate);
  return out;
}

std::vector<std::string> warnings(const Report& report) {
  std::vector<std::string> out;
  const float metres = report.declarations ? report.declarations->metres_per_unit : 0;
  if (report.source_rounding * (metres > 0 ? static_cast<double>(metres) : 1) > 1e-3)
    out.push_back(fmt::format(
        "FP32 rounds the source's positions by up to {:.3g} world units; the asset is compared with the rounded ones.",
        report.source_rounding));
  if (!report.render || report.render->views.empty()) return out;
  const RenderReport& r = *report.render;
  const std::size_t n_views = r.views.size();
  if (r.n_rated == 0) {
    out.push_back(
        fmt::format("0 of {} views show the scene on {:g} % of their pixels, so nothing is rated: are these its "
                    "cameras?",
                    n_views, 100 * kRatedShare));
    return out;
  }
  if (r.n_rated < n_views)
    out.push_back(fmt::format(
        "{} of {} views show the scene on less than {:g} % of their pixels; they are not rated and not in any mean.",
        n_views - r.n_rated, n_views, 100 * kRatedShare));
  const auto n_little = static_cast<std::size_t>(
      std::count_if(r.views.begin(), r.views.end(), [](const ViewResult& v) { return v.rated() && v.hardly_sees(); }));
  if (n_little != 0)
    out.push_back(fmt::format(
        "{} of {} views show the scene on less than {:g} % of their pixels; the rest is equal background, which raises "
        "PSNR by 10 dB and more.",
        n_little, n_views, 100 * kHardlySeenShare));
  if (report.seen_share() < kHardlySeenShare)
    out.push_back(fmt::format(
        "Only {:.1f} % of the {}'s Gaussians lie in a rated view; the others are not compared.",
        100 * report.seen_share(),
        r.source_unseen * report.size.n_asset >= r.asset_unseen * report.size.n_source ? "source" : "asset"));
  return out;
}

}  // namespace rgs::audit
