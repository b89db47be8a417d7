// convert_scene.cpp - a scene in memory to a file of any format.
// SPDX-License-Identifier: Apache-2.0
#include <utility>

#include "convert.hpp"
#include "rgs/splat_edit.hpp"
#include "stage_clock.hpp"

namespace rgs {
namespace {

// Formats other than .rgs: damage is dealt with first, then the file is made in memory.
Result<ConvertSummary> write_scene(LoadedScene& scene, SplatFormat format, const std::string& output_path,
                                   const ConvertOptions& options, const StageObserver& observer) {
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  auto file = AtomicFile::create(output_path, options.output);
  if (!file) return tl::unexpected(file.error());
  strip_sh(scene.cloud, options.encode.sh_degree);
  clock.begin("encode", 0, "");
  if (format != SplatFormat::ply) {
    const auto scan = clean_splats(scene.cloud, options.encode);
    if (!scan) return tl::unexpected(scan.error());
    summary.n_repaired = scan->n_repaired();
    for (std::size_t i = 0; i < kDefectKinds; ++i) summary.defects[i] = scan->defects(static_cast<Defect>(i));
  }
  WriteOptions write;
  write.colour_space = options.encode.colour_space;
  write.aa_mode = options.encode.aa_mode;
  write.keep_order = options.encode.order == Order::input;
  write.strict = options.strict;
  const auto bytes = encode_splats(scene.cloud.view(), format, write, &summary.clamped);
  if (!bytes) return tl::unexpected(bytes.error());
  clock.begin("commit", 0, "");
  if (const Status s = file->write_at(0, *bytes); !s) return tl::unexpected(s.error());
  const auto synced = file->commit();
  if (!synced) return tl::unexpected(synced.error());
  clock.end();
  summary.sync_seconds = *synced;
  summary.output_format = format_name(format);
  summary.output_bytes = bytes->size();
  summary.n_written = scene.cloud.size();
  summary.sh_degree = format == SplatFormat::splat ? 0 : scene.cloud.sh_degree;
  return summary;
}

}  // namespace

Result<ConvertSummary> convert_scene(LoadedScene&& scene, SplatFormat format, const std::string& output_path,
                                     const ConvertOptions& options, const StageObserver& observer) {
  const std::uint64_t n_filtered = scene.n_source - scene.cloud.size();
  auto summary = format == SplatFormat::rgs ? convert_to_rgs(SplatSource(scene.cloud.view(), scene.bytes, scene.xxh3),
                                                             output_path, options, observer)
                                            : write_scene(scene, format, output_path, options, observer);
  if (!summary) return summary;
  summary->source_format = scene.format;
  summary->source_bytes = scene.bytes;
  summary->n_source = scene.n_source;
  summary->n_filtered = n_filtered;
  summary->source_sh_degree = scene.source_sh_degree;
  return summary;
}

}  // namespace rgs
