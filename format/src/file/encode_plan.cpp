// encode_plan.cpp - turns options and a scene's scan into the shape of its file and its small sections.
// SPDX-License-Identifier: Apache-2.0
#include "file/encode_plan.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <utility>

#include "file/layout_io.hpp"
#include "file/repeated_index.hpp"
#include "packed/packed.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"

namespace rgs {
namespace {

Status check_options(const EncodeOptions& o) {
  const auto bad = [](const char* what) { return make_error(Errc::bad_argument, Error::kNone, what); };
  if (o.chunk_size < kMinChunkSize || o.chunk_size > kMaxChunkSize || o.chunk_size % 32 != 0) {
    return bad("the chunk size must be a multiple of 32 from 32 to 65536");
  }
  if (o.level < 1 || o.level > kMaxLevel) return bad("the level must be 1 to 19");
  if (o.profile == Profile::archive) {
    if (o.chunk_size > kMaxArchiveRows) return bad("archive: the chunk size must be at most 32768");
    if (!(o.archive.step >= 0x1p-4f && o.archive.step <= 0x1p6f)) return bad("archive: the step must be 1/16 to 64");
    if (o.order == Order::input) {
      return bad("archive orders Gaussians itself: store their positions (keep_permutation) to find them again");
    }
  }
  if (o.sh_degree < 0 || o.sh_degree > kMaxShDegree) return bad("the SH degree must be 0 to 3");
  if (o.depth) {
    const DepthRange& d = *o.depth;
    if (!(d.z_near > 0 && d.z_near < d.z_far && std::isfinite(d.z_far))) {
      return bad("the depth range must be 0 < near < far");
    }
  }
  if (!(o.metres_per_unit >= 0 && std::isfinite(o.metres_per_unit)))
    return bad("metres per unit are negative or not finite");
  if (o.provenance &&
      (o.provenance->source_name.size() > kMaxProvenanceText || o.provenance->tool.size() > kMaxProvenanceText)) {
    return bad("provenance texts are limited to 4096 bytes");
  }
  if (o.crs != Crs()) {
    const auto written = detail::write_crs(o.crs);
    if (const auto legal = detail::parse_crs(written, 0, o.axes); !legal) return bad(legal.error().what);
  }
  return {};
}

// Damage beyond what the options allow.
Status check_damage(const SceneScan& scan, const EncodeOptions& options) {
  const std::uint64_t damaged = scan.n_source() - scan.n_kept() + scan.n_repaired();
  if (options.on_bad == BadPolicy::refuse && damaged != 0) {
    return make_error(Errc::bad_value, Error::kNone,
                      "the scene has damaged Gaussians; allow dropping or repairing them", 0, damaged);
  }
  const double allowed = options.max_bad_fraction * static_cast<double>(scan.n_source());
  if (options.on_bad == BadPolicy::drop && static_cast<double>(damaged) > allowed) {
    return make_error(Errc::too_many_bad, Error::kNone,
                      "more damaged Gaussians than are dropped by default; choose a policy explicitly",
                      static_cast<std::uint64_t>(allowed), damaged);
  }
  return {};
}

Declarations declare(const SceneScan& scan, const EncodeOptions& options) {
  Declarations d;
  d.axes = options.axes;
  d.colour_space = options.colour_space;
  d.aa_mode = options.aa_mode;
  d.low_pass_px2 = options.low_pass_px2.value_or(default_low_pass_px2(options.aa_mode));
  d.order = options.order;
  d.metres_per_unit = options.metres_per_unit;
  d.origin = options.origin;
  d.crs = options.crs;
  d.first_view = options.first_view;
  d.cutoff_sigma = options.cutoff_sigma;
  d.alpha_threshold = options.alpha_threshold;
  d.alpha_max = options.alpha_max;
  d.transmittance_min = options.transmittance_min;
  d.full = scan.full();
  d.robust = scan.robust();
  const DepthRange depth = options.depth.value_or(depth_range_from_extent(d.robust, options.depth_mapping));
  d.z_near = depth.z_near;
  d.z_far = depth.z_far;
  d.depth_source = depth.source;
  d.depth_mapping = options.depth_mapping;
  d.n_source = std::max(scan.n_source(), options.n_source);
  d.n_dropped = d.n_source - scan.n_kept();
  d.n_repaired = scan.n_repaired() + options.n_repaired;
  return d;
}

// Checks what validate() would find in the permutation, and what it could not find.
Status check_positions(std::uint64_t n_given, const EncodeOptions& options) {
  if (!options.keep_permutation) return {};
  const auto bad = [](const char* what) { return make_error(Errc::bad_argument, Error::kNone, what); };
  const std::uint64_t n_source = std::max(n_given, options.n_source);
  if (options.source_index.empty()) {
    if (options.n_source == 0 || n_given == 0) return {};
    return bad(
        "keep_permutation: give each Gaussian's position in the source by source_index, or set n_source to 0 to number "
        "the given ones");
  }
  if (options.source_index.size() != n_given) return bad("source_index needs one position for each Gaussian");
  if (n_source >> 32 != 0) return bad("positions in a source of 2^32 Gaussians or more are not supported");
  const auto& index = options.source_index;
  if (std::ranges::max(index) >= n_source) return bad("source_index names a Gaussian beyond n_source");
  if (detail::has_repeated_index(n_given, n_source, [&index](std::uint64_t i) { return index[i]; })) {
    return bad("source_index names a Gaussian twice");
  }
  return {};
}

SectionEntry section(SectionType type, std::uint64_t bytes, std::uint32_t flags = kSectionMustUnderstand) {
  SectionEntry entry;
  entry.type = static_cast<std::uint32_t>(type);
  entry.flags = flags;
  entry.stored_bytes = entry.decoded_bytes = bytes;
  return entry;
}

}  // namespace

EncodeOptions keep_declarations(EncodeOptions options, const Declarations& declared) {
  options.axes = declared.axes;
  options.colour_space = declared.colour_space;
  options.aa_mode = declared.aa_mode;
  options.low_pass_px2 = declared.low_pass_px2;
  options.metres_per_unit = declared.metres_per_unit;
  options.origin = declared.origin;
  options.crs = declared.crs;
  options.first_view = declared.first_view;
  options.depth = DepthRange{declared.z_near, declared.z_far, declared.depth_source};
  options.depth_mapping = declared.depth_mapping;
  options.cutoff_sigma = declared.cutoff_sigma;
  options.alpha_threshold = declared.alpha_threshold;
  options.alpha_max = declared.alpha_max;
  options.transmittance_min = declared.transmittance_min;
  options.n_source = declared.n_source;
  options.n_repaired = declared.n_repaired;
  return options;
}

// The diagonal of the robust box is what a camera at one end of the scene sees. But cameras may stand far outside, and
// beyond the range order is lost (a crop seen from several diagonals away: 18 dB). Ten diagonals cost logarithmic bins
// half a bit, but would make linear ones ten times as wide.
DepthRange depth_range_from_extent(const Box& robust, DepthMapping mapping) {
  double squared = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    const double side = static_cast<double>(robust.max[i]) - static_cast<double>(robust.min[i]);
    squared += side * side;
  }
  const double reach = mapping == DepthMapping::logarithmic ? 10 * std::sqrt(squared) : std::sqrt(squared);
  return {0.2f, std::max(static_cast<float>(std::min(reach, 1e30)), 1.f), DepthSource::scene_extent};
}

Status check_encodable(const SceneScan& scan, const EncodeOptions& options) {
  return detail::guard_memory([&]() -> Status {
    if (const Status s = check_options(options); !s) return s;
    if (const Status s = check_damage(scan, options); !s) return s;
    // Writes nothing that a reader rejects: axes that do not span space, unknown enumerators.
    const auto written = detail::write_declarations(declare(scan, options));
    if (const auto legal = detail::parse_declarations(written, 0, kVersionMinor); !legal) {
      return make_error(Errc::bad_argument, Error::kNone, legal.error().what);
    }
    return {};
  });
}

namespace detail {

std::uint32_t EncodePlan::frame_rows() const {
  // Smaller frames get better weights and tables; below this they cost more than they save (docs/records/EXPERIMENTS.md).
  constexpr std::uint32_t kPackedRows = 16384;
  const std::uint32_t rows = options.profile == Profile::archive ? archive_rows : kPackedRows;
  return std::max(1u, rows / header.chunk_size) * header.chunk_size;
}

Result<EncodePlan> make_plan(const SceneScan& scan, const EncodeOptions& options) {
  if (const Status s = check_encodable(scan, options); !s) return tl::unexpected(s.error());
  if (const Status s = check_positions(scan.n_source(), options); !s) return tl::unexpected(s.error());
  EncodePlan plan;
  const std::uint64_t n = scan.n_kept();
  plan.options = options;
  if (options.crs.axes == options.axes) plan.options.crs.axes = {};
  plan.mends = scan.n_repaired() != 0;
  if (n == 0 && options.profile == Profile::archive) plan.options.profile = Profile::packed;
  const Profile profile = plan.options.profile;
  Header& h = plan.header;
  h.version_minor = profile == Profile::direct ? 0 : profile == Profile::packed ? 1 : 5;
  if (options.origin != kNoOrigin) h.version_minor = std::max<std::uint16_t>(h.version_minor, 3);
  if (options.crs != Crs() || options.first_view != FirstView()) h.version_minor = 5;
  h.n_gaussians = n;
  h.chunk_size = options.chunk_size;
  h.n_chunks = n / h.chunk_size + (n % h.chunk_size != 0 ? 1 : 0);
  h.n_step_sets = options.chunk_step_sets ? h.n_chunks : std::min<std::uint64_t>(h.n_chunks, 1);
  h.sh_degree = static_cast<std::uint8_t>(scan.sh_degree());
  h.scale_exponent = n == 0 ? std::int16_t{0}
                            : static_cast<std::int16_t>(choose_scale_exponent(scale_from_log(scan.min_log_scale()),
                                                                              scale_from_log(scan.max_log_scale())));
  plan.declarations = declare(scan, plan.options);
  plan.file_steps = scan.sh_magnitudes().steps();
  plan.largest_sh = scan.sh_magnitudes().max_abs();

  // Small sections first: a client that fetches chunks needs them before anything else.
  plan.sections = {section(SectionType::declarations, kDeclarationBytes),
                   section(SectionType::sh_steps, h.n_step_sets * kStepSetBytes),
                   section(SectionType::chunks, h.n_chunks * kChunkEntryBytes),
                   section(SectionType::means, n * kMeanBytes),
                   section(SectionType::geometry, n * kGeometryBytes),
                   section(SectionType::sh, n * sh_bytes(h.sh_degree))};
  if (profile == Profile::archive) plan.sections.push_back(section(SectionType::archive, 0));
  if (options.keep_permutation) plan.sections.push_back(section(SectionType::permutation, n * 4, 0));
  if (options.provenance) {
    const std::uint64_t texts = options.provenance->source_name.size() + options.provenance->tool.size();
    plan.sections.push_back(section(SectionType::provenance, 24 + texts, 0));
  }
  if (options.crs != Crs()) plan.sections.push_back(section(SectionType::crs, write_crs(options.crs).size(), 0));
  for (SectionEntry& entry : plan.sections) {
    if (profile == Profile::direct || !archive_type(static_cast<SectionType>(entry.type))) continue;
    entry.codec = static_cast<std::uint32_t>(profile == Profile::packed ? Codec::planes : Codec::archive);
    entry.stored_bytes = coded_bound(entry.decoded_bytes, plan.n_frames());
  }
  return plan;
}

std::vector<std::uint32_t> positions_in_source(std::span<const std::uint32_t> given, const EncodeOptions& options) {
  if (!options.keep_permutation) return {};
  std::vector<std::uint32_t> positions(given.begin(), given.end());
  if (!options.source_index.empty())
    std::ranges::transform(given, positions.begin(), [&options](std::uint32_t i) { return options.source_index[i]; });
  return positions;
}

Result<WrittenScene> finish_file(SectionWriter& file, const EncodePlan& plan, const SceneTables& tables) {
  assert(tables.chunks.size() == plan.header.n_chunks && tables.steps.size() == tables.chunks.size());
  const bool chunk_sets = plan.options.chunk_step_sets;
  WrittenScene written{plan.header, plan.declarations, {}};
  Declarations& d = written.declarations;
  d.n_scale_subnormal = tables.counts.scale_subnormal;
  d.n_scale_zero = tables.counts.scale_zero;
  d.n_opacity_zero = tables.counts.opacity_zero;
  d.n_opacity_one = tables.counts.opacity_one;
  const std::vector<std::uint32_t> positions = positions_in_source(tables.source_index, plan.options);
  ByteWriter steps, chunks;
  for (std::size_t i = 0; i < tables.chunks.size(); ++i) {
    if (chunk_sets || i == 0) write_step_set(steps, chunk_sets ? tables.steps[i] : plan.file_steps);
    ChunkEntry chunk = tables.chunks[i];
    chunk.step_set = chunk_sets ? i : 0;
    write_chunk_entry(chunks, chunk);
  }
  const auto place_table = [&](SectionType type, std::vector<std::byte> records) {
    if (plan.options.profile == Profile::direct) return file.place(type, records);
    const StoredTable stored = code_table(std::move(records), plan.options.level);
    return file.place(type, stored.bytes, stored.codec);
  };
  for (const SectionEntry& entry : plan.sections) {
    const auto type = static_cast<SectionType>(entry.type);
    Status s;
    switch (type) {
      case SectionType::declarations: s = file.place(type, write_declarations(d)); break;
      case SectionType::sh_steps: s = place_table(type, steps.take()); break;
      case SectionType::chunks: s = place_table(type, chunks.take()); break;
      case SectionType::means:
      case SectionType::geometry:
      case SectionType::sh: s = file.place_grown(type, plan.frame_rows()); break;
      case SectionType::archive: s = file.place(type, tables.archive); break;
      case SectionType::permutation: s = file.place(type, std::as_bytes(std::span(positions))); break;
      case SectionType::provenance: s = file.place(type, write_provenance(*plan.options.provenance)); break;
      case SectionType::crs: s = file.place(type, write_crs(plan.options.crs)); break;
      case SectionType::levels:
      case SectionType::pages: break;  // LevelsWriter's
    }
    if (!s) return tl::unexpected(s.error());
  }
  auto sections = file.finish(written.header);
  if (!sections) return tl::unexpected(sections.error());
  written.sections = std::move(*sections);
  return written;
}

}  // namespace detail

}  // namespace rgs
