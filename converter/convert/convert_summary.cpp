// convert_summary.cpp - a conversion's summary as text and as JSON.
// SPDX-License-Identifier: Apache-2.0
#include "convert_summary.hpp"

#include <fmt/format.h>

#include <nlohmann/json.hpp>
#include <string>

#include "console.hpp"

namespace rgs {
namespace {

const char* depth_source_name(DepthSource source) {
  switch (source) {
    case DepthSource::cameras: return "cameras";
    case DepthSource::scene_extent: return "scene extent";
    case DepthSource::by_hand: return "by hand";
  }
  return "unknown";
}

const char* depth_mapping_name(DepthMapping mapping) {
  return mapping == DepthMapping::linear ? "linear" : "log";
}

const char* aa_name(AaMode mode) {
  return mode == AaMode::classic ? "classic" : mode == AaMode::mip_splatting ? "mip-splatting" : "undeclared";
}

// The shortest decimals of this float, as a JSON number.
double decimal_of(float value) {
  return std::stod(fmt::format("{}", value));
}

const char* colour_name(ColourSpace space) {
  return space == ColourSpace::srgb_display ? "srgb" : space == ColourSpace::linear_display ? "linear" : "undeclared";
}

// Each profile has its own codec for means, or pages.
const char* profile_name(const std::vector<SectionEntry>& sections) {
  for (const SectionEntry& section : sections) {
    const auto type = static_cast<SectionType>(section.type);
    if (type != SectionType::means && type != SectionType::pages) continue;
    const auto codec = static_cast<Codec>(section.codec);
    return codec == Codec::none ? "direct" : codec == Codec::planes ? "packed" : "archive";
  }
  return "unknown";
}

double per_gaussian(std::uint64_t bytes, std::uint64_t n) {
  return n == 0 ? 0 : static_cast<double>(bytes) / static_cast<double>(n);
}

double total_seconds(const ConvertSummary& s) {
  double sum = 0;
  for (const auto& [stage, seconds] : s.seconds) sum += seconds;
  return sum;
}

// One line for each attribute that was clamped to a format's range.
std::string clamped_text(const WriteReport& clamped, const std::string& format) {
  const bool no_sh = format == format_name(SplatFormat::splat) || format == format_name(SplatFormat::ksplat);
  const struct {
    const Clamped& of;
    const char* what;
    const char* unit;
  } kinds[] = {{clamped.mean, "means in coarser steps, because some are far out", " units"},
               {clamped.log_scale, "log-scales beyond its range", ""},
               {clamped.opacity_logit, "opacities that are 0 or 1 in its numbers; logits beyond them", ""},
               {clamped.sh_dc, "colours (f_dc) beyond its range", ""},
               {clamped.sh, no_sh ? "harmonics (f_rest) dropped" : "harmonics (f_rest) beyond its range", ""}};
  std::string text;
  for (const auto& kind : kinds) {
    if (kind.of.n == 0) continue;
    text += fmt::format("  {:<11}{}: {} Gaussians, by up to {:.3g}{}\n", text.empty() ? "clamped" : "", kind.what,
                        tool::format_count(kind.of.n), kind.of.largest, kind.unit);
  }
  return text;
}

nlohmann::ordered_json clamped_json(const WriteReport& clamped) {
  const auto one = [](const Clamped& c) { return nlohmann::ordered_json{{"gaussians", c.n}, {"largest", c.largest}}; };
  return {{"mean", one(clamped.mean)},
          {"log_scale", one(clamped.log_scale)},
          {"opacity_logit", one(clamped.opacity_logit)},
          {"sh_dc", one(clamped.sh_dc)},
          {"sh", one(clamped.sh)}};
}

std::string type_name(std::uint32_t type) {
  std::string name;
  for (int i = 0; i < 4; ++i) name += static_cast<char>(type >> (8 * i) & 255);
  return name;
}

}  // namespace

void note_rounding(ConvertSummary& summary) {
  EncodeOptions declared;
  declared.metres_per_unit = summary.declarations.metres_per_unit;
  if (summary.position_rounding > max_rounding(declared, false))
    summary.notes.push_back(
        fmt::format("positions are rounded by up to {:.3g} world units, which is more than a millimetre",
                    summary.position_rounding));
}

std::string summary_text(const ConvertSummary& s) {
  using tool::format_bytes;
  using tool::format_count;
  std::string text;
  const auto line = [&text]<class... T>(fmt::format_string<T...> format, T&&... args) {
    text += fmt::format(format, std::forward<T>(args)...) + "\n";
  };
  line("{} ({}, {}) -> {} ({}): {}, {:.1f} bytes per Gaussian", tool::printable(s.source_name), s.source_format,
       format_bytes(s.source_bytes), s.output_format, format_bytes(s.output_bytes),
       tool::format_size_change(s.source_bytes, s.output_bytes), per_gaussian(s.output_bytes, s.n_written));
  line("  Gaussians  {} read, {} written, {} dropped, {} repaired{}", format_count(s.n_source),
       format_count(s.n_written), format_count(s.n_source - s.n_filtered - s.n_written), format_count(s.n_repaired),
       s.n_filtered == 0 ? "" : fmt::format(", {} filtered out", format_count(s.n_filtered)));
  for (std::size_t i = 0; i < kDefectKinds; ++i) {
    if (s.defects[i] != 0)
      line("             damaged {}: {}", defect_name(static_cast<Defect>(i)), format_count(s.defects[i]));
  }
  if (s.sh_degree == s.source_sh_degree) {
    line("  SH degree  {}", s.sh_degree);
  } else {
    line("  SH degree  {} of {} kept", s.sh_degree, s.source_sh_degree);
  }
  if (s.origin != kNoOrigin) {
    line("  origin     {}, {}, {}; means are FP32 relative to it", s.origin[0], s.origin[1], s.origin[2]);
  }
  if (const Crs& crs = s.declarations.crs; crs != Crs()) line("  CRS        {}", tool::printable(crs.text));
  if (s.position_rounding > 0) line("  positions  rounded by up to {:.3g} world units", s.position_rounding);
  if (s.spz_version != 0) line("  version    {}", s.spz_version);
  for (const std::string& what : s.unused) line("  not kept   {}", what);
  if (s.n_regions != 0) {
    line("  levels     {}, with {} Gaussians in {} {} in all", s.n_levels, format_count(s.n_stored),
         format_count(s.n_regions), s.output_format == format_name(SplatFormat::tileset) ? "tiles" : "regions");
  }
  if (s.output_format == "rad" && s.n_levels != 0)
    line("  levels     {}, with {} Gaussians in all", s.n_levels, format_count(s.n_stored));
  if (s.output_format == "rgs") {
    const Declarations& d = s.declarations;
    if (s.n_pages != 0) {
      line("  levels     {}, with {} Gaussians in {} pages in all", s.n_levels, format_count(s.n_stored),
           format_count(s.n_pages));
    }
    line("  sections   {}", profile_name(s.sections));
    for (const SectionEntry& section : s.sections) {
      line("    {}  {:>10}  {:6.2f} bytes per Gaussian", type_name(section.type), format_bytes(section.stored_bytes),
           per_gaussian(section.stored_bytes, s.n_written));
    }
    line("  chunks     {} of {}, {} SH scale set{}", format_count(s.header.n_chunks), s.header.chunk_size,
         format_count(s.header.n_step_sets), s.header.n_step_sets == 1 ? "" : "s");
    line("  scale      {:.3g} to {:.3g}, stored times 2^{}", s.min_scale, s.max_scale, s.header.scale_exponent);
    line("  opacity    {:.3g} to {:.3g}", s.min_opacity, s.max_opacity);
    line("  depth key  {:.4g} to {:.4g}, {}, from {}", d.z_near, d.z_far, depth_mapping_name(d.depth_mapping),
         depth_source_name(d.depth_source));
    if (d.n_scale_subnormal + d.n_scale_zero + d.n_opacity_zero + d.n_opacity_one != 0) {
      line("  limits     scales below FP16's normal range {}, flushed to 0 {}; opacities rounded to 0 {}, to 1 {}",
           format_count(d.n_scale_subnormal), format_count(d.n_scale_zero), format_count(d.n_opacity_zero),
           format_count(d.n_opacity_one));
    }
  }
  text += clamped_text(s.clamped, s.output_format);
  const Declarations& declared = s.declarations;
  if (const Declarations usual; declared.aa_mode != usual.aa_mode || declared.low_pass_px2 != usual.low_pass_px2 ||
                                declared.metres_per_unit != usual.metres_per_unit) {
    line("  declared   anti-aliasing {}, low-pass {} px^2{}", aa_name(declared.aa_mode), declared.low_pass_px2,
         declared.metres_per_unit == 0 ? "" : fmt::format(", {} m per unit", declared.metres_per_unit));
  }
  if (!s.lost.empty()) line("  lost       not in the {} file: {}", s.output_format, fmt::join(s.lost, ", "));
  for (const std::string& note : s.notes) line("  note       {}", note);
  if (s.search) {
    line("  target     {}", s.search->target.psnr ? fmt::format("at least {} dB", *s.search->target.psnr)
                                                  : fmt::format("at most {}", format_bytes(*s.search->target.bytes)));
    for (const ArchivePass& p : s.search->passes) {
      line("    step {:<8.4g} {:>10}{}{}", p.step, format_bytes(p.bytes),
           p.psnr ? fmt::format("  {:.2f} dB", *p.psnr) : "",
           &p == &s.search->passes[s.search->kept] ? "  written" : "");
    }
  }
  std::string stages;
  for (const auto& [stage, seconds] : s.seconds) {
    stages += fmt::format("{}{} {}", stages.empty() ? "" : ", ", stage, tool::format_seconds(seconds));
  }
  line("  time       {} ({}; of this syncing {})", tool::format_seconds(total_seconds(s)), stages,
       tool::format_seconds(s.sync_seconds));
  return text;
}

std::string summary_json(const ConvertSummary& s) {
  using nlohmann::ordered_json;
  ordered_json json;
  json["schema"] = "rgs-convert/1";
  json["source"] = {{"name", s.source_name},
                    {"format", s.source_format},
                    {"bytes", s.source_bytes},
                    {"gaussians", s.n_source},
                    {"sh_degree", s.source_sh_degree}};
  json["output"] = {{"format", s.output_format},
                    {"bytes", s.output_bytes},
                    {"gaussians", s.n_written},
                    {"sh_degree", s.sh_degree},
                    {"bytes_per_gaussian", per_gaussian(s.output_bytes, s.n_written)}};
  json["source"]["unused"] = s.unused;
  if (s.spz_version != 0) json["output"]["spz_version"] = s.spz_version;
  ordered_json damaged = ordered_json::object();
  for (std::size_t i = 0; i < kDefectKinds; ++i) damaged[defect_name(static_cast<Defect>(i))] = s.defects[i];
  json["filtered"] = s.n_filtered;
  json["dropped"] = s.n_source - s.n_filtered - s.n_written;
  json["repaired"] = s.n_repaired;
  json["damaged"] = std::move(damaged);
  json["origin"] = s.origin;
  json["position_rounding"] = s.position_rounding;
  json["declared"] = {{"anti_aliasing", aa_name(s.declarations.aa_mode)},
                      {"low_pass_px2", decimal_of(s.declarations.low_pass_px2)},
                      {"colour_space", colour_name(s.declarations.colour_space)},
                      {"metres_per_unit", decimal_of(s.declarations.metres_per_unit)},
                      {"crs", s.declarations.crs.text}};
  json["lost"] = s.lost;
  json["notes"] = s.notes;
  if (s.n_regions != 0) json["levels"] = {{"levels", s.n_levels}, {"regions", s.n_regions}, {"gaussians", s.n_stored}};
  if (s.output_format == "rad" && s.n_levels != 0) json["levels"] = {{"levels", s.n_levels}, {"gaussians", s.n_stored}};
  if (s.output_format == "rgs") {
    const Declarations& d = s.declarations;
    ordered_json sections = ordered_json::array();
    for (const SectionEntry& section : s.sections) {
      sections.push_back({{"type", type_name(section.type)},
                          {"stored_bytes", section.stored_bytes},
                          {"decoded_bytes", section.decoded_bytes}});
    }
    json["profile"] = profile_name(s.sections);
    if (s.n_pages != 0) {
      json["levels"] = {{"levels", s.n_levels}, {"pages", s.n_pages}, {"gaussians", s.n_stored}};
    }
    json["sections"] = std::move(sections);
    json["chunks"] = {
        {"size", s.header.chunk_size}, {"count", s.header.n_chunks}, {"scale_sets", s.header.n_step_sets}};
    json["scale"] = {{"min", s.min_scale},
                     {"max", s.max_scale},
                     {"exponent", s.header.scale_exponent},
                     {"subnormal", d.n_scale_subnormal},
                     {"zero", d.n_scale_zero}};
    json["opacity"] = {
        {"min", s.min_opacity}, {"max", s.max_opacity}, {"zero", d.n_opacity_zero}, {"one", d.n_opacity_one}};
    json["depth"] = {{"near", d.z_near},
                     {"far", d.z_far},
                     {"mapping", depth_mapping_name(d.depth_mapping)},
                     {"source", depth_source_name(d.depth_source)}};
  }
  if (s.search) {
    ordered_json passes = ordered_json::array();
    for (const ArchivePass& p : s.search->passes) {
      passes.push_back({{"step", decimal_of(p.step)}, {"bytes", p.bytes}});
      if (p.psnr) passes.back()["psnr"] = *p.psnr;
    }
    json["target"] = {{"step", decimal_of(s.search->passes[s.search->kept].step)}, {"passes", std::move(passes)}};
    if (s.search->target.psnr) json["target"]["psnr"] = *s.search->target.psnr;
    if (s.search->target.bytes) json["target"]["bytes"] = *s.search->target.bytes;
  }
  if (s.output_format != "rgs") json["clamped"] = clamped_json(s.clamped);
  ordered_json seconds = ordered_json::object();
  for (const auto& [stage, value] : s.seconds) seconds[stage] = value;
  seconds["sync"] = s.sync_seconds;
  seconds["total"] = total_seconds(s);
  json["seconds"] = std::move(seconds);
  // File names need not be UTF-8; JSON must be.
  return json.dump(2, ' ', true, ordered_json::error_handler_t::replace) + "\n";
}

}  // namespace rgs
