// convert_levels.cpp - writes the levels of an .rgs as a streamed SOG, a tileset or a .rad.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "convert.hpp"
#include "stage_clock.hpp"
#include "streamed_output.hpp"

namespace rgs {

Result<ConvertSummary> convert_levels(const PagedFile& source, SplatFormat format, const std::string& output_path,
                                      const ConvertOptions& options, const StageObserver& observer) {
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  SceneOutput output;
  if (const Status s = output.create(format, output_path, options.output, options.is_input); !s)
    return tl::unexpected(s.error());
  const EncodeOptions& encode = options.encode;
  WriteOptions write = write_options(options);
  write.origin = source.head().declarations().origin;
  if (source.n_pages_with_origins() != 0 && format != SplatFormat::tileset && !options.allow_rounding)
    return make_error(
        Errc::unsupported_feature, source.head().find(SectionType::levels)->offset,
        "its pages have origins of their own, without which FP32 rounds positions by more than a millimetre; "
        "write a PLY or tileset, or pass --allow-rounding");
  clock.begin("encode", 0, "");
  const PutFile put = [&](const std::string& name, std::span<const std::byte> bytes) {
    return output.put(name, bytes);
  };
  const auto written = format == SplatFormat::ssog ? write_streamed_sog(source, write, encode.sh_degree, put)
                       : format == SplatFormat::rad
                           ? write_rad(source, write, encode.sh_degree, put)
                           : write_tileset(source, write, encode.sh_degree, folder_of_tiles(output_path), put);
  if (!written) return tl::unexpected(written.error());
  clock.begin("commit", 0, "");
  const auto synced = output.commit();
  if (!synced) return tl::unexpected(synced.error());
  clock.end();
  summary.sync_seconds = *synced;
  summary.source_format = format_name(SplatFormat::rgs);
  summary.output_format = format_name(format);
  summary.source_bytes = source.head().bytes().size();
  summary.output_bytes = output.bytes();
  summary.n_source = summary.n_written = source.head().header().n_gaussians;
  summary.source_sh_degree = source.head().header().sh_degree;
  summary.sh_degree = std::min(summary.source_sh_degree, encode.sh_degree);
  const FormatInfo::Keeps keeps = keeps_of(format, write);
  if (keeps.origin) summary.origin = write.origin;
  summary.n_levels = written->n_levels;
  summary.n_regions = written->n_regions;
  summary.n_stored = written->n_stored;
  summary.clamped = written->clamped;
  summary.position_rounding = written->position_rounding;
  summary.declarations = source.head().declarations();
  EncodeOptions turned = encode;
  if (encode.axes[0] != Axis::undeclared) turned.axes = format_info(format).axes;
  summary.lost = lost_declarations(format, turned, keeps);
  return summary;
}

}  // namespace rgs
