// convert_to_rad.cpp - writes the levels of an .rgs as the tree of a .rad.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "convert.hpp"
#include "stage_clock.hpp"

namespace rgs {

Result<ConvertSummary> convert_to_rad(const PagedFile& source, const std::string& output_path,
                                      const ConvertOptions& options, const StageObserver& observer) {
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  auto output = AtomicFile::create(output_path, options.output);
  if (!output) return tl::unexpected(output.error());
  const EncodeOptions& encode = options.encode;
  WriteOptions write;
  write.axes = encode.axes;
  write.threads = encode.archive.threads;
  write.strict = options.strict;
  write.origin = source.head().declarations().origin;
  clock.begin("encode", 0, "");
  RadReport written;
  const auto bytes = encode_rad_with_levels(source, write, encode.sh_degree, &written);
  if (!bytes) return tl::unexpected(bytes.error());
  clock.begin("commit", 0, "");
  if (const Status s = output->write_at(0, *bytes); !s) return tl::unexpected(s.error());
  const auto synced = output->commit();
  if (!synced) return tl::unexpected(synced.error());
  clock.end();
  summary.sync_seconds = *synced;
  summary.source_format = format_name(SplatFormat::rgs);
  summary.output_format = format_name(SplatFormat::rad);
  summary.source_bytes = source.head().bytes().size();
  summary.output_bytes = bytes->size();
  summary.n_source = summary.n_written = source.head().header().n_gaussians;
  summary.source_sh_degree = source.head().header().sh_degree;
  summary.sh_degree = std::min(summary.source_sh_degree, encode.sh_degree);
  summary.n_levels = written.n_levels;
  summary.n_stored = written.n_stored;
  summary.clamped = written.clamped;
  summary.position_rounding = written.position_rounding;
  summary.declarations = source.head().declarations();
  EncodeOptions turned = encode;
  if (encode.axes[0] != Axis::undeclared) turned.axes = kAxes3dgs;
  summary.lost = lost_declarations(SplatFormat::rad, turned);
  return summary;
}

}  // namespace rgs
