// convert_scene.cpp - writes a scene in memory to a file of any format.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "console.hpp"
#include "convert.hpp"
#include "rgs/splat_edit.hpp"
#include "stage_clock.hpp"
#include "streamed_output.hpp"

namespace rgs {
namespace {

float low_pass_of(const EncodeOptions& o) {
  return o.low_pass_px2.value_or(default_low_pass_px2(o.aa_mode));
}

const char* name_of(AaMode mode) {
  return mode == AaMode::classic ? "classic" : mode == AaMode::mip_splatting ? "mip-splatting" : "undeclared";
}

// Whether the .rgs holds its Gaussians' positions in its source.
bool knows_positions(const SplatFile& file) {
  const Declarations& d = *file.declarations;
  return file.finest && (!file.source_index.empty() || (d.order == Order::input && d.n_dropped == 0));
}

// For formats other than .rgs: handles damage, then encodes the file in memory.
Result<ConvertSummary> write_scene(LoadedScene& scene, SplatFormat format, const std::string& output_path,
                                   const ConvertOptions& options, const StageObserver& observer) {
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  SceneOutput output;
  if (Status s = output.create(format, output_path, options.output, options.is_input); !s)
    return tl::unexpected(s.error());
  strip_sh(scene.cloud, options.encode.sh_degree);
  clock.begin("encode", 0, "");
  if (format != SplatFormat::ply) {
    const auto scan = clean_splats(scene.cloud, options.encode);
    if (!scan) return tl::unexpected(scan.error());
    summary.n_repaired = scan->n_repaired();
    for (std::size_t i = 0; i < kDefectKinds; ++i) summary.defects[i] = scan->defects(static_cast<Defect>(i));
  }
  WriteOptions write = write_options(options);
  write.origin = scene.origin;
  const auto rounding = position_rounding(scene.cloud.view(), format, write);
  if (!rounding) return tl::unexpected(rounding.error());
  summary.position_rounding = *rounding;
  const FormatInfo::Keeps keeps = keeps_of(format, write);
  summary.origin = keeps.origin ? scene.origin : kNoOrigin;
  if (format == SplatFormat::tileset) {
    const auto tile = write_tileset(scene.cloud.view(), write, folder_of_tiles(output_path),
                                    [&](const auto&... file) { return output.put(file...); });
    if (!tile) return tl::unexpected(tile.error());
    summary.clamped = tile->clamped;
  } else {
    const auto bytes = encode_splats(scene.cloud.view(), format, write, &summary.clamped);
    if (!bytes) return tl::unexpected(bytes.error());
    if (const Status s = output.put("", *bytes); !s) return tl::unexpected(s.error());
  }
  clock.begin("commit", 0, "");
  const auto synced = output.commit();
  if (!synced) return tl::unexpected(synced.error());
  clock.end();
  summary.sync_seconds = *synced;
  summary.output_format = format_name(format);
  summary.lost = lost_declarations(format, options.encode, keeps);
  if (format == SplatFormat::spz && !keeps.axes)
    summary.notes.push_back("the output's axes are " + axes_text(options.encode.axes) +
                            ", which the SPZ does not state (--spz-axes)");
  if (format == SplatFormat::spz && scene.origin != kNoOrigin && options.spz_version < 4)
    summary.notes.emplace_back("version 4 of SPZ keeps the origin (--spz-version 4)");
  summary.declarations.aa_mode = options.encode.aa_mode;
  summary.declarations.low_pass_px2 = low_pass_of(options.encode);
  summary.declarations.colour_space = options.encode.colour_space;
  summary.declarations.metres_per_unit = options.encode.metres_per_unit;
  summary.declarations.crs = options.encode.crs;
  summary.spz_version = format == SplatFormat::spz ? options.spz_version : 0;
  summary.output_bytes = output.bytes();
  summary.n_written = scene.cloud.size();
  summary.sh_degree = std::min(format_info(format).sh_degree, scene.cloud.sh_degree);
  return summary;
}

}  // namespace

WriteOptions write_options(const ConvertOptions& options) {
  WriteOptions write;
  write.colour_space = options.encode.colour_space;
  write.aa_mode = options.encode.aa_mode;
  write.low_pass_px2 = options.encode.low_pass_px2;
  write.metres_per_unit = options.encode.metres_per_unit;
  write.axes = options.encode.axes;
  write.keep_order = options.encode.order == Order::input;
  write.threads = options.encode.archive.threads;
  write.spz_version = options.spz_version;
  write.strict = options.strict;
  write.crs = options.encode.crs;
  return write;
}

bool keep_source(EncodeOptions& encode, LoadedScene& scene, const SplatFile& file, std::span<const std::uint64_t> kept,
                 bool edited) {
  const bool lost = file.declarations && encode.keep_permutation && scene.n_source != 0 && !knows_positions(file);
  if (file.declarations && !lost) {
    encode.n_source = file.declarations->n_source;
    encode.n_repaired = file.declarations->n_repaired;
    if (file.provenance && encode.provenance) {
      // Dropping levels changes neither the scene nor its provenance.
      const bool same = file.n_levels != 0 && file.finest && !edited && kept.size() == scene.n_source;
      const std::string through = same ? "" : " from " + encode.provenance->source_name;
      scene.xxh3 = file.provenance->source_xxh3;
      encode.provenance =
          Provenance{file.provenance->source_bytes, file.provenance->source_xxh3, file.provenance->source_name,
                     (same ? file.provenance->tool : encode.provenance->tool) + through};
      encode.provenance->tool.resize(std::min<std::size_t>(encode.provenance->tool.size(), kMaxProvenanceText));
    } else {
      encode.provenance.reset();  // of a source without a name
    }
  } else {
    encode.n_source = scene.n_source;
    encode.n_repaired = 0;
  }
  if (!encode.keep_permutation) return true;
  scene.source_index.assign(kept.begin(), kept.end());
  if (!lost && !file.source_index.empty()) {
    for (std::uint32_t& i : scene.source_index) i = file.source_index[i];
  }
  return !lost;
}

std::vector<std::string> lost_declarations(SplatFormat format, const EncodeOptions& declared,
                                           const FormatInfo::Keeps& keeps) {
  std::vector<std::string> lost;
  if (format == SplatFormat::rgs) return lost;
  const EncodeOptions usual;
  const bool has_flag = keeps.aa_mode && declared.aa_mode != AaMode::undeclared;
  if (!keeps.declarations) {
    const AaMode read_as = has_flag ? declared.aa_mode : AaMode::classic;
    if (declared.aa_mode != read_as) lost.push_back(fmt::format("anti-aliasing ({})", name_of(declared.aa_mode)));
    if (low_pass_of(declared) != default_low_pass_px2(read_as))
      lost.push_back(fmt::format("low-pass ({} px^2)", low_pass_of(declared)));
    if (declared.colour_space != ColourSpace::srgb_display)
      lost.push_back(declared.colour_space == ColourSpace::linear_display ? "colour space (linear)"
                                                                          : "colour space (undeclared)");
    if (declared.metres_per_unit != 0) lost.push_back(fmt::format("metres per unit ({})", declared.metres_per_unit));
    if (declared.axes != format_info(format).axes && !keeps.axes) lost.push_back("axes other than the format's");
    if (declared.crs != Crs() && !keeps.crs)
      lost.push_back(fmt::format("coordinate reference system ({})", tool::printable(declared.crs.text)));
  }
  if (declared.depth && declared.depth->source != DepthSource::scene_extent)
    lost.push_back(fmt::format("depth range ({} to {})", declared.depth->z_near, declared.depth->z_far));
  if (declared.cutoff_sigma != usual.cutoff_sigma || declared.alpha_threshold != usual.alpha_threshold ||
      declared.alpha_max != usual.alpha_max || declared.transmittance_min != usual.transmittance_min)
    lost.push_back("thresholds of cutoff, alpha and transmittance");
  if (declared.first_view != FirstView()) lost.emplace_back("first view");
  return lost;
}

Result<ConvertSummary> convert_scene(LoadedScene&& scene, SplatFormat format, const std::string& output_path,
                                     const ConvertOptions& options, const StageObserver& observer) {
  const std::uint64_t n_filtered = scene.n_source - scene.cloud.size();
  if (format == SplatFormat::ply && scene.origin == kNoOrigin && !scene.cloud.mean_rest.empty()) {
    scene.origin = {1, 0, 0};  // with any origin a PLY has positions in FP64
    rebase_exactly(scene.cloud.mean, scene.cloud.mean_rest, kNoOrigin, scene.origin);
  }
  ConvertOptions with_positions = options;
  with_positions.encode.source_index = scene.source_index;
  auto summary = format == SplatFormat::rgs
                     ? convert_to_rgs(SplatSource(scene.cloud.view(), scene.bytes, scene.xxh3, scene.origin),
                                      output_path, with_positions, observer)
                     : write_scene(scene, format, output_path, options, observer);
  if (!summary) return summary;
  summary->source_format = scene.format;
  summary->source_bytes = scene.bytes;
  summary->n_source = scene.n_source;
  summary->n_filtered = n_filtered;
  summary->source_sh_degree = scene.source_sh_degree;
  summary->position_rounding = std::max(summary->position_rounding, scene.position_rounding);
  summary->unused = std::move(scene.unused);
  return summary;
}

}  // namespace rgs
