// audit_json.cpp - schema "rgs-audit/3".
// SPDX-License-Identifier: Apache-2.0
#include "audit_json.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <span>
#include <utility>

#include "audit_gate.hpp"
#include "info_report.hpp"
#include "rgs/file.hpp"

namespace rgs::audit {
namespace {

using Json = nlohmann::ordered_json;

constexpr const char* kSchema = "rgs-audit/3";

// JSON has no infinity: null, as the schema says for each field. Unrated values are absent, which differs from
// infinity.
Json number(double value) {
  return std::isfinite(value) ? Json(value) : Json();
}
Json optional(const std::optional<double>& value) {
  return value ? number(*value) : Json();
}
Json hex(std::uint64_t hash) {
  return fmt::format("{:016x}", hash);
}

using Grade = Verdict::Grade;
constexpr std::array<std::pair<Grade, const char*>, 6> kGrades{{{Grade::identical, "identical"},
                                                                {Grade::lossless, "no_visible_loss"},
                                                                {Grade::close, "close"},
                                                                {Grade::visible, "visible"},
                                                                {Grade::poor, "poor"},
                                                                {Grade::unrated, "unrated"}}};

const char* name_of(Grade grade) {
  return std::ranges::find(kGrades, grade, &std::pair<Grade, const char*>::first)->second;
}

// null is infinite as elsewhere; negative infinity becomes the lowest number.
Json json(const Measured& found) {
  Json out = Json::object();
  for (const auto& [name, value] : found)
    out[name] =
        value == -std::numeric_limits<double>::infinity() ? Json(std::numeric_limits<double>::lowest()) : number(value);
  return out;
}

Json json(std::span<const Condition> gate) {
  Json conditions = Json::array();
  for (const Condition& c : gate)
    conditions.push_back({{"name", c.name},
                          {"limit", c.limit},
                          {"sense", c.at_least ? "at_least" : "at_most"},
                          {"found", number(c.found)},
                          {"measured", !std::isnan(c.found)},
                          {"holds", c.holds}});
  return {{"holds", holds(gate)}, {"conditions", std::move(conditions)}};
}

// ASCII only, bytes that are not UTF-8 become U+FFFD: names cannot control a terminal.
std::string dump(const Json& j) {
  return j.dump(2, ' ', true, Json::error_handler_t::replace) + "\n";
}

Json json(const SizeReport& s) {
  Json sections = Json::array();
  for (const SectionSize& section : s.sections)
    sections.push_back(
        {{"type", section.type}, {"stored_bytes", section.stored_bytes}, {"decoded_bytes", section.decoded_bytes}});
  return {{"source_bytes", s.source_bytes},
          {"asset_bytes", s.asset_bytes},
          {"ratio", s.ratio()},
          {"bytes_per_gaussian", s.bytes_per_gaussian()},
          {"gpu_bytes", s.gpu_bytes},
          {"gpu_bytes_per_gaussian", s.gpu_bytes_per_gaussian()},
          {"gpu_bytes_fp32", s.gpu_bytes_fp32},
          {"levels", s.levels ? Json{{"levels", s.levels->n_levels},
                                     {"pages", s.levels->n_pages},
                                     {"gaussians", s.levels->n_gaussians}}
                              : Json()},
          {"sections", std::move(sections)}};
}

Json json(const ErrorStatistics& e) {
  return {{"n", e.n},
          {"n_zero", e.n_zero},
          {"max", number(e.max)},
          {"mean", number(e.mean)},
          {"rms", number(e.rms)},
          {"p50", e.p50},
          {"p99", e.p99},
          {"p99_9", e.p999},
          {"histogram", {{"low", e.first_octave}, {"bins", e.histogram}}}};
}

Json json(const AttributeError& e) {
  return {{"key", e.key},
          {"value", json(e.value)},
          {"value_unit", e.unit},
          {"meaning", json(e.meaning)},
          {"meaning_unit", e.meaning_unit}};
}

Json json(const AttributeReport& a) {
  Json errors = Json::array(), worst = Json::object(), codes = Json::array();
  for (const AttributeError& e : a.errors) errors.push_back(json(e));
  for (const WorstList& list : a.worst) {
    Json gaussians = Json::array();
    for (const WorstGaussian& g : list.gaussians)
      gaussians.push_back({{"error", g.error},
                           {"asset_index", g.asset_index},
                           {"source_index", g.source_index},
                           {"mean", {g.mean[0], g.mean[1], g.mean[2]}}});
    worst[list.key] = std::move(gaussians);
  }
  for (const CodeUsage& c : a.codes)
    codes.push_back({{"used", c.used()}, {"entropy_bits", c.entropy_bits()}, {"count", c.count}});
  const RangeCounts& r = a.ranges;
  return {{"colour", json(a.colour.meaning)},
          {"errors", std::move(errors)},
          {"ranges",
           {{"sh_clipped", r.sh_clipped},
            {"sh_limit", r.sh_limit},
            {"sh_flushed", r.sh_flushed},
            {"scale_subnormal", r.scale_subnormal},
            {"scale_zero", r.scale_zero},
            {"opacity_zero", r.opacity_zero},
            {"opacity_one", r.opacity_one}}},
          {"sh_codes", std::move(codes)},
          {"worst", std::move(worst)},
          {"seconds", a.seconds}};
}

Json json(const PhotoScore& p) {
  return {{"source_psnr", number(p.source_psnr)},
          {"asset_psnr", number(p.asset_psnr)},
          {"loss", number(p.loss())},
          {"source_ssim", p.source_ssim},
          {"asset_ssim", p.asset_ssim}};
}

Json json(const DepthScore& d) {
  return {{"error", d.error}, {"largest", d.largest}, {"compared", d.compared}};
}

Json json(const VideoReport& r) {
  Json frames = Json::array(), seconds = Json::object();
  for (const std::string& name : r.frames) frames.push_back({{"name", name}});
  for (const Curve& c : r.curves) {
    seconds[c.key] = {{"first", c.second}, {"mean", number(c.second_mean)}};
    for (std::size_t i = 0; i < c.values.size(); ++i)
      if (!std::isnan(c.values[i])) frames[i][c.key] = number(c.values[i]);
  }
  Json out{{"fps", r.fps}, {"worst_seconds", std::move(seconds)}, {"frames", std::move(frames)}};
  if (r.flicker) {
    out["flicker"] = *r.flicker;
    out["worst_flicker"] = *r.worst_flicker;
    out["worst_flicker_frame"] = r.curves.back().worst;
  }
  return out;
}

Json json(const RenderReport& r) {
  Json views = Json::array(), attribution = Json::array();
  for (const ViewResult& v : r.views) {
    Json view{{"name", v.name},
              {"width", v.width},
              {"height", v.height},
              {"rated", v.rated()},
              {"hardly_sees", v.hardly_sees()},
              {"drawn", v.drawn}};
    if (v.rated()) {
      view["psnr"] = number(v.score.psnr);
      view["mse"] = v.score.mse;
      view["ssim"] = v.score.ssim;
      view["largest"] = {{"difference", v.score.largest}, {"x", v.score.x}, {"y", v.score.y}};
      view["background"] = v.score.over_white ? "white" : "black";
      for (std::size_t i = 0; i < kMeasures.size(); ++i)
        if (v.score.measures[i]) view[kMeasures[i].key] = *v.score.measures[i];
      if (v.score.depth) view["depth"] = json(*v.score.depth);
    }
    for (const auto& [name, score] : {std::pair("leaves", &v.leaves), std::pair("levels", &v.levels)})
      if (*score)
        view[name] = {{"psnr", number((*score)->psnr)}, {"ssim", (*score)->ssim}, {"largest", (*score)->largest}};
    if (v.photo) view["photo"] = json(*v.photo);
    views.push_back(std::move(view));
  }
  for (const AttributionRow& row : r.attribution)
    attribution.push_back({{"key", row.key},
                           {"psnr", number(row.psnr)},
                           {"worst_psnr", number(row.worst)},
                           {"mse", row.mse},
                           {"share", row.share},
                           {"loss", optional(row.loss)}});
  Json out{{"backend", r.backend},
           {"automatic_views", r.automatic_views},
           {"n_searched", r.n_searched},
           {"n_views", r.views.size()},
           {"n_rated", r.n_rated},
           {"drawn", r.drawn},
           {"source_unseen", r.source_unseen},
           {"asset_unseen", r.asset_unseen}};
  if (r.n_rated != 0) {
    out["psnr"] = number(r.psnr);
    out["worst_psnr"] = number(r.worst_psnr);
    out["mse"] = r.mse;
    out["ssim"] = r.ssim;
    out["worst_ssim"] = r.worst_ssim;
    out["largest"] = r.largest;
  }
  if (r.level_psnr)
    out["level_psnr"] = {{"leaves", number(r.level_psnr->leaves)}, {"levels", number(r.level_psnr->levels)}};
  for (std::size_t i = 0; i < kMeasures.size(); ++i) {
    if (!r.measures[i]) continue;
    out[kMeasures[i].key] = *r.measures[i];
    out[std::string("worst_") + kMeasures[i].key] = *r.worst_measures[i];
  }
  if (r.depth) out["depth"] = json(*r.depth);
  if (r.video) out["video"] = json(*r.video);
  out["photos"] = r.photo ? json(*r.photo) : Json();
  out["n_undrawable"] = r.n_undrawable;
  out["attribution"] = std::move(attribution);
  out["views"] = std::move(views);
  out["seconds"] = r.seconds;
  if (!r.attribution_note.empty()) out["attribution_note"] = r.attribution_note;
  return out;
}

constexpr std::array<const char*, kFarScenes> kFarKeys{"leaves", "compensated", "levels"};

Json json(const DistanceReport& r) {
  Json rows = Json::array();
  for (const FarRow& row : r.rows) {
    Json out{{"far", row.far}, {"drawn", row.drawn}};
    for (std::size_t k = 0; k < kFarScenes; ++k) {
      const FarScore& s = row.scores[k];
      out[kFarKeys[k]] = {{"psnr", number(s.psnr)},
                          {"worst_psnr", number(s.worst_psnr)},
                          {"ssim", s.ssim},
                          {"worst_ssim", s.worst_ssim}};
    }
    Json views = Json::array();
    for (const FarView& v : row.views) {
      Json view{{"name", v.name}, {"width", v.width}, {"height", v.height}, {"drawn", v.drawn}};
      for (std::size_t k = 0; k < kFarScenes; ++k)
        view[kFarKeys[k]] = {{"psnr", number(v.psnr[k])}, {"ssim", v.ssim[k]}};
      views.push_back(std::move(view));
    }
    out["views"] = std::move(views);
    rows.push_back(std::move(out));
  }
  Json out{{"detail_px", r.detail_px}, {"rows", std::move(rows)}, {"seconds", r.seconds}};
  if (!r.rows.empty()) out["loss"] = number(r.worst().loss);
  if (!r.note.empty()) out["note"] = r.note;
  return out;
}

}  // namespace

const char* name_of(PairedBy by) {
  switch (by) {
    case PairedBy::permutation: return "permutation";
    case PairedBy::order: return "order";
    case PairedBy::means: return "means";
    case PairedBy::nearest: return "nearest";
  }
  return "";
}

std::string audit_json(const Report& report) {
  const Verdict v = verdict(report);
  Json j{{"schema", kSchema},
         {"tool", report.tool},
         {"fingerprint", report.fingerprint},
         {"source",
          {{"name", report.source_name},
           {"format", report.source_format},
           {"bytes", report.size.source_bytes},
           {"xxh3", hex(report.source_xxh3)},
           {"gaussians", report.size.n_source},
           {"sh_degree", report.size.source_sh_degree}}},
         {"asset",
          {{"name", report.asset_name},
           {"format", report.asset_format},
           {"bytes", report.size.asset_bytes},
           {"xxh3", hex(report.asset_xxh3)},
           {"gaussians", report.size.n_asset},
           {"sh_degree", report.size.asset_sh_degree},
           {"made_from_source", report.made_from_source ? Json(*report.made_from_source) : Json()}}},
         {"verdict",
          {{"grade", name_of(v.grade)},
           {"depth_range_misfit", v.depth_range_misfit},
           {"hardly_seen", v.hardly_seen},
           {"headline", v.headline},
           {"finding", v.finding},
           {"detail", v.detail}}},
         {"warnings", warnings(report)},
         {"size", json(report.size)}};
  j["gaussians"] = {{"paired_by", name_of(report.pairs.by)},
                    {"paired", report.pairs.n_paired},
                    {"dropped", report.pairs.n_source_only},
                    {"added", report.pairs.n_asset_only}};
  Json differences = Json::array();
  for (const DeclaredDifference& d : report.declared_differences)
    differences.push_back(
        {{"key", d.key}, {"source", d.source}, {"asset", d.asset}, {"changes_picture", d.changes_picture}});
  j["declared_differences"] = std::move(differences);
  if (report.attributes) j["attributes"] = json(*report.attributes);
  if (report.render) j["rendered"] = json(*report.render);
  if (report.distances) j["distances"] = json(*report.distances);
  Json also = Json::array();
  for (const AlsoReport& a : report.also)
    also.push_back({{"path", a.path},
                    {"bytes", a.bytes},
                    {"gaussians", a.n_gaussians == 0 ? Json() : Json(a.n_gaussians)},
                    {"measured", a.psnr.has_value()},
                    {"psnr", optional(a.psnr)},
                    {"worst_psnr", optional(a.worst_psnr)},
                    {"ssim", optional(a.ssim)},
                    {"loss", optional(a.loss)},
                    {"note", a.note}});
  j["also"] = std::move(also);
  j["measured"] = json(measured(report));
  j["gate"] = json(report.gate);
  j["seconds"] = report.seconds;
  return dump(j);
}

std::optional<EarlierAudit> earlier_audit(const std::string& path, const std::string& fingerprint,
                                          std::vector<Condition> conditions) {
  const auto file = MappedFile::open(path);
  if (!file) return {};
  const auto bytes = file->bytes();
  const char* text = reinterpret_cast<const char*>(bytes.data());
  EarlierAudit out;
  try {
    Json j = Json::parse(text, text + bytes.size());
    if (j.at("schema") != kSchema || j.at("fingerprint") != fingerprint) return {};
    Measured found;
    for (const auto& [name, value] : j.at("measured").items())
      found[name] = value.is_null() ? std::numeric_limits<double>::infinity() : value.get<double>();
    out.gate = evaluate(std::move(conditions), found);
    Json& said = j.at("verdict");
    const auto grade =
        std::ranges::find_if(kGrades, [&](const auto& known) { return said.at("grade") == known.second; });
    if (grade == kGrades.end()) return {};
    Verdict& v = out.verdict;
    v.grade = grade->first;
    v.depth_range_misfit = said.at("depth_range_misfit").get<bool>();
    v.hardly_seen = said.at("hardly_seen").get<bool>();
    v.finding = said.at("finding").get<std::string>();
    v.detail = said.at("detail").get<std::string>();
    v.headline = headline_of(v.finding, out.gate);
    said["headline"] = v.headline;
    j.at("gate") = json(out.gate);
    out.seconds = j.at("seconds").get<double>();
    out.json = dump(j);
    out.changed = out.json != std::string_view(text, bytes.size());
    return out;
  } catch (const Json::exception&) {
    return {};  // damaged, or of another program
  }
}

}  // namespace rgs::audit
