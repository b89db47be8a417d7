// info_json.cpp - the report of rgs-info for programs; docs/user/INFO_JSON.md describes it.
// SPDX-License-Identifier: Apache-2.0
#include "info_json.hpp"

#include <fmt/format.h>

#include <cmath>
#include <cstdlib>
#include <nlohmann/json.hpp>

#include "console.hpp"

namespace rgs::tool {
namespace {

using Json = nlohmann::ordered_json;

// The double nearest to the shortest decimal of an FP32 number: prints as 0.2, not 0.20000000298, and rounds back.
Json number(float value) {
  return std::strtod(fmt::format("{}", value).c_str(), nullptr);
}

Json numbers(const auto& values) {
  Json array = Json::array();
  for (const float value : values) array.push_back(number(value));
  return array;
}

Json hex(std::uint64_t hash) {
  return fmt::format("{:016x}", hash);
}

Json json(const Box& box) {
  return {{"min", numbers(box.min)}, {"max", numbers(box.max)}};
}

Json json(const Spread& s) {
  return {{"min", number(s.min)}, {"median", number(s.median)}, {"max", number(s.max)}};
}

Json json(const Distribution& d) {
  Json j = json(d.spread);
  j["n"] = d.n;
  j["n_zero"] = d.n_zero;
  j["histogram"] = {{"axis", d.logarithmic ? "log10" : "linear"}, {"low", d.low}, {"high", d.high}, {"bins", d.bins}};
  return j;
}

Json json(const Header& h) {
  return {{"version", {h.version_major, h.version_minor}},
          {"n_gaussians", h.n_gaussians},
          {"sh_degree", h.sh_degree},
          {"chunk_size", h.chunk_size},
          {"n_chunks", h.n_chunks},
          {"n_scale_sets", h.n_step_sets},
          {"n_sections", h.n_sections},
          {"scale_exponent", h.scale_exponent}};
}

Json json(const Declarations& d) {
  Json axes = Json::array();
  for (const Axis axis : d.axes) axes.push_back(name_of(axis).id);
  const auto right = right_handed(d.axes);
  Json crs;
  if (d.crs != Crs()) {
    crs["text"] = d.crs.text;
    for (const Axis axis : d.crs.axes) crs["axes"].push_back(name_of(axis).id);
  }
  Json first_view;
  if (const FirstView& v = d.first_view; v != FirstView()) {
    first_view = {{"from", v.kind == ViewKind::inside ? "inside" : "outside"},
                  {"position", numbers(v.position)},
                  {"pivot", numbers(v.pivot)},
                  {"up", numbers(v.up)},
                  {"horizontal_fov", number(v.horizontal_fov)}};
  }
  return {{"axes", axes},
          {"handedness", right ? Json(*right ? "right" : "left") : Json()},
          {"metres_per_unit", d.metres_per_unit > 0 ? number(d.metres_per_unit) : Json()},
          {"colour_space", name_of(d.colour_space).id},
          {"sh_basis", name_of(d.sh_basis).id},
          {"kernel",
           {{"type", name_of(d.kernel).id},
            {"cutoff_sigma", number(d.cutoff_sigma)},
            {"alpha_threshold", number(d.alpha_threshold)},
            {"alpha_max", number(d.alpha_max)},
            {"transmittance_min", number(d.transmittance_min)}}},
          {"aa_mode", name_of(d.aa_mode).id},
          {"low_pass_px2", number(d.low_pass_px2)},
          {"sort_metric", name_of(d.sort_metric).id},
          {"order", name_of(d.order).id},
          {"depth",
           {{"near", number(d.z_near)},
            {"far", number(d.z_far)},
            {"mapping", name_of(d.depth_mapping).id},
            {"source", name_of(d.depth_source).id}}},
          {"origin", d.origin},
          {"first_view", first_view},
          {"crs", crs},
          {"full_box", json(d.full)},
          {"robust_box", json(d.robust)},
          {"robust_fraction", number(d.robust_fraction)},
          {"counts",
           {{"source", d.n_source},
            {"dropped", d.n_dropped},
            {"repaired", d.n_repaired},
            {"scale_subnormal", d.n_scale_subnormal},
            {"scale_zero", d.n_scale_zero},
            {"opacity_zero", d.n_opacity_zero},
            {"opacity_one", d.n_opacity_one}}}};
}

Json json(const Provenance& p) {
  return {{"source_name", p.source_name},
          {"source_bytes", p.source_bytes},
          {"source_xxh3", hex(p.source_xxh3)},
          {"tool", p.tool}};
}

Json json(const ArchiveParameters& p) {
  const bool draco = p.codec == Codec::archive_draco;
  Json classes = Json::array();
  for (const ArchiveClass& c : p.classes) {
    Json& j = classes.emplace_back(Json{{"dc_step", dc_step(c)},
                                        {"sh_step", number(c.sh_step)},
                                        {"bound_dc", number(c.bound_dc)},
                                        {"bound_sh", number(c.bound_sh)}});
    if (draco) {
      j["rotation_step"] = number(c.rotation_step);
      j["scale_step"] = scale_step(c);
      j["bound_rotation"] = number(c.bound_rotation);
      j["bound_scale"] = number(c.bound_scale);
    } else {
      j["bound_mean"] = number(c.bound_mean);
      j["bound_covariance"] = number(c.bound_covariance);
    }
  }
  Json j{{"profile", archive_name(p)},
         {"codec", static_cast<std::uint32_t>(p.codec)},
         {"mean_cells", p.mean_cells},
         {"centre", p.centre},
         {"half_width", p.half_width},
         {"opacity_levels", p.opacity_levels},
         {"bound_opacity", number(p.bound_opacity)},
         {"classes", std::move(classes)}};
  if (draco) {
    j["rotation_step"] = number(p.rotation_step);
    j["scale_step"] = number(p.scale_step);
    j["dc_step"] = number(p.dc_step);
    j["sh_step"] = number(p.sh_step);
    j["slope"] = number(p.slope);
    j["class_octaves"] = number(p.class_octaves);
    j["bound_mean"] = number(p.bound_mean);
  } else {
    j["step"] = number(p.step);
    j["nearest"] = std::sqrt(p.shape.nearest);
    j["blur"] = std::exp2(p.shape.blur / 65536.0);
  }
  return j;
}

Json sections(const InfoReport& report) {
  Json array = Json::array();
  for (std::size_t i = 0; i < report.view->sections().size(); ++i) {
    const SectionEntry& s = report.view->sections()[i];
    Json j{{"type", four_characters(s.type)},
           {"known", *describe(static_cast<SectionType>(s.type)) != '\0'},
           {"must_understand", (s.flags & kSectionMustUnderstand) != 0},
           {"codec", codec_name(s)},
           {"offset", s.offset},
           {"stored_bytes", s.stored_bytes},
           {"decoded_bytes", s.decoded_bytes},
           {"bytes_per_gaussian", bytes_per_gaussian(s.stored_bytes, report.view->header())},
           {"share", static_cast<double>(s.stored_bytes) / static_cast<double>(report.view->header().file_bytes)},
           {"xxh3", hex(s.xxh3)}};
    const FrameTable& frames = report.view->frames(static_cast<SectionType>(s.type));
    if (frames.rows != 0) j["frames"] = {{"n", frames.frames.size()}, {"rows", frames.rows}};
    if (!is_present(report, s)) {
      j["incomplete"] = true;
    } else if (!report.hashes.empty()) {
      j["xxh3_found"] = hex(report.hashes[i]);
    }
    array.push_back(std::move(j));
  }
  return array;
}

const char* codec_of_pages(const PagedFile& file) {
  return file.codec() == Codec::none ? "none" : file.codec() == Codec::planes ? "planes" : "archive";
}

Json json(const LevelsCheck& check, const PagedFile& file) {
  Json refuted = Json::array();
  for (const RefutedPage& r : check.refuted) {
    const lod::Page& page = file.pages()[r.page];
    refuted.push_back({{"page", r.page},
                       {"level", page.level},
                       {"offset", record_offset(file, r.page)},
                       {"error", number(page.error)},
                       {"measured_error", number(r.measured)}});
  }
  return {{"share", check.share},
          {"pages", check.n_inner},
          {"pages_checked", check.n_checked},
          {"tolerance", number(check.tolerance)},
          {"refuted", std::move(refuted)}};
}

Json levels(const InfoReport& report) {
  const PagedFile& file = *report.paged;
  Json array = Json::array();
  for (std::size_t i = 0; i < report.levels.size(); ++i) {
    const LevelReport& level = report.levels[i];
    array.push_back({{"level", i},
                     {"pages", level.n_pages},
                     {"pages_present", level.n_present},
                     {"gaussians", level.n_gaussians},
                     {"stored_bytes", level.stored_bytes},
                     {"min_error", number(level.min_error)},
                     {"max_error", number(level.max_error)}});
  }
  Json j = {{"n_levels", file.n_levels()},
            {"n_pages", file.n_pages()},
            {"pages_present", file.n_present()},
            {"complete", file.complete()},
            {"page_chunks", file.page_chunks()},
            {"n_gaussians", file.n_stored()},
            {"codec", codec_of_pages(file)},
            {"quality_db", file.quality_db() > 0 ? number(file.quality_db()) : Json()},
            {"pages_with_origins", file.n_pages_with_origins()},
            {"levels", std::move(array)}};
  if (report.levels_check) j["check"] = json(*report.levels_check, file);
  return j;
}

Json page(const PagedFile& file, std::uint32_t i) {
  const lod::Page& p = file.pages()[i];
  const StoredPage& stored = file.stored(i);
  return {{"index", i},
          {"level", p.level},
          {"parent", p.parent == lod::kNoPage ? Json() : Json(p.parent)},
          {"first_child", p.n_children == 0 ? Json() : Json(p.first_child)},
          {"n_children", p.n_children},
          {"n", p.count},
          {"error", number(p.error)},
          {"box", json(p.bounds)},
          {"core", json(p.core)},
          {"offset", stored.offset},
          {"stored_bytes", stored.stored_bytes},
          {"decoded_bytes", file.decoded_bytes(i)},
          {"xxh3", hex(stored.xxh3)},
          {"n_scale_sets", stored.n_step_sets},
          {"scale_exponent", stored.scale_exponent},
          {"present", i < file.n_present()}};
}

Json size(const InfoReport& report) {
  const Header& h = report.view->header();
  const std::uint64_t ply = ply_bytes(h);
  return {{"bytes_per_gaussian", bytes_per_gaussian(h.file_bytes, h)},
          {"ply_bytes", ply},
          {"ratio_to_ply", static_cast<double>(ply) / static_cast<double>(h.file_bytes)}};
}

Json json(const StepSpreads& steps, const Header& h) {
  Json degrees = Json::array();
  for (std::size_t degree = 0; degree <= h.sh_degree && h.n_step_sets != 0; ++degree) {
    Json channels = Json::array();
    for (const Spread& s : steps[degree]) channels.push_back(json(s));
    degrees.push_back(std::move(channels));
  }
  return degrees;
}

Json json(const ValueStatistics& v) {
  Json sh = Json::array();
  for (const ShCodes& s : v.sh) {
    sh.push_back({{"n", s.n},
                  {"n_zero", s.n_zero},
                  {"n_limit", s.n_limit},
                  {"entropy_bits", s.entropy_bits},
                  {"min", numbers(s.min)},
                  {"max", numbers(s.max)},
                  {"histogram", {{"axis", "linear"}, {"low", 0}, {"high", 128}, {"bins", s.bins}}}});
  }
  return {{"first", v.first},       {"n", v.n}, {"n_illegal", v.n_illegal}, {"opacity", json(v.opacity)},
          {"scale", json(v.scale)}, {"sh", sh}};
}

Json json(const ChunkReport& c, const InfoReport& report) {
  const FileView& view = *report.view;
  const Header& h = view.header();
  Json steps = Json::array();
  for (std::size_t degree = 0; degree <= h.sh_degree; ++degree) steps.push_back(numbers(c.steps.step[degree]));
  const auto place = [&view](SectionType type, std::uint64_t first, std::uint64_t count, std::uint64_t row) {
    const StoredRows rows = stored_rows(view, type, first, count, row);
    Json j{{"offset", rows.offset}, {"bytes", rows.bytes}};
    if (rows.frame) j["frame"] = *rows.frame;
    return j;
  };
  Json stored;
  if (report.paged) {
    const std::uint32_t i = leaf_of_row(*report.paged, c.first);
    const StoredPage& p = report.paged->stored(i);
    stored["PAGE"] = {{"offset", p.offset}, {"bytes", p.stored_bytes}, {"page", i}};
  } else {
    stored = {{"CHNK", place(SectionType::chunks, c.index, 1, kChunkEntryBytes)},
              {"SHSC", place(SectionType::sh_steps, c.entry.step_set, 1, kStepSetBytes)},
              {"MEAN", place(SectionType::means, c.first, c.entry.count, kMeanBytes)},
              {"GEOM", place(SectionType::geometry, c.first, c.entry.count, kGeometryBytes)},
              {"SHI8", place(SectionType::sh, c.first, c.entry.count, sh_bytes(h.sh_degree))}};
  }
  return {{"index", c.index},
          {"first", c.first},
          {"n", c.entry.count},
          {"box", json(c.entry.means)},
          {"radius", number(c.entry.radius)},
          {"max_opacity", number(c.entry.max_opacity)},
          {"scale_set", c.entry.step_set},
          {"sh_steps", steps},
          {"stored", std::move(stored)}};
}

Json json(const Error& error) {
  const auto optional = [](std::uint64_t value) { return value == Error::kNone ? Json() : Json(value); };
  const bool hash = error.code == Errc::checksum_mismatch;
  return {{"code", errc_name(error.code)},
          {"exit_code", exit_code(error.code)},
          {"offset", optional(error.offset)},
          {"what", error.what},
          {"expected", hash ? hex(error.expected) : optional(error.expected)},
          {"found", hash ? hex(error.found) : optional(error.found)},
          {"text", describe(error)}};
}

}  // namespace

std::string info_json(const InfoReport& report) {
  Json j{{"schema", "rgs-info/1"}, {"file", {{"path", report.path}, {"bytes", report.file_bytes}}}};
  if (report.view) {
    const FileView& view = *report.view;
    j["header"] = json(view.header());
    j["size"] = size(report);
    j["declarations"] = json(view.declarations());
    j["provenance"] = view.provenance() ? json(*view.provenance()) : Json();
    j["sections"] = sections(report);
    if (report.paged) j["levels"] = levels(report);
    if (report.page_asked && report.paged && *report.page_asked < report.paged->n_pages()) {
      j["page"] = page(*report.paged, static_cast<std::uint32_t>(*report.page_asked));
    }
    if (view.archive() != nullptr) j["archive"] = json(*view.archive());
    if (report.steps) j["sh_steps"] = json(*report.steps, report.leaves ? report.leaves->header() : view.header());
    if (report.chunks) {
      j["chunks"] = {{"diagonal", json(report.chunks->diagonal)},
                     {"radius", json(report.chunks->radius)},
                     {"max_opacity", json(report.chunks->max_opacity)}};
    }
    if (report.chunk) j["chunk"] = json(*report.chunk, report);
    if (report.values) j["values"] = json(*report.values);
    if (!report.hashes.empty()) j["verified"] = report.verified;
  }
  if (report.error) j["error"] = json(*report.error);
  // ASCII only, bytes that are not UTF-8 become U+FFFD: text of the file cannot control a terminal.
  return j.dump(2, ' ', true, Json::error_handler_t::replace) + "\n";
}

}  // namespace rgs::tool
