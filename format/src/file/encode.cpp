// encode.cpp - plan, chunks and tables of an .rgs file.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/encode.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>

#include "file/byte_writer.hpp"
#include "file/checked.hpp"
#include "file/layout_io.hpp"
#include "packed/packed.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"
#include "rgs/spatial_order.hpp"

namespace rgs {
namespace {

Status check_options(const EncodeOptions& o) {
  const auto bad = [](const char* what) { return make_error(Errc::bad_argument, Error::kNone, what); };
  if (o.chunk_size < kMinChunkSize || o.chunk_size > kMaxChunkSize || o.chunk_size % 32 != 0) {
    return bad("the chunk size must be a multiple of 32 from 32 to 65536");
  }
  if (o.level < 1 || o.level > kMaxLevel) return bad("the level must be 1 to 19");
  if (o.profile == Profile::archive) {
    const ArchiveOptions& a = o.archive;
    if (a.mean_cells < 4 || a.mean_cells > 20) return bad("archive: mean cells must be 2^4 to 2^20");
    if (!(a.sh_step >= 0x1p-20f && a.sh_step <= 0x1p20f)) return bad("archive: the SH step must be 2^-20 to 2^20");
    if (!(a.dc_step >= 0x1p-10f && a.dc_step <= 0x1p6f)) return bad("archive: the DC step must be 2^-10 to 64");
    if (!(a.rotation_step >= 0x1p-10f && a.rotation_step <= 0.5f))
      return bad("archive: the rotation step must be 2^-10 to 0.5");
    if (!(a.scale_step >= 0x1p-10f && a.scale_step <= 2.f)) return bad("archive: the scale step must be 2^-10 to 2");
    if (a.opacity_levels < 1 || a.opacity_levels > 4096) return bad("archive: opacity levels must be 1 to 4096");
    if (!(a.slope >= 0 && a.slope <= 1)) return bad("archive: the slope must be 0 to 1");
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
  if (!(o.metres_per_unit >= 0 && std::isfinite(o.metres_per_unit))) return bad("metres per unit must not be negative");
  if (o.provenance &&
      (o.provenance->source_name.size() > kMaxProvenanceText || o.provenance->tool.size() > kMaxProvenanceText)) {
    return bad("provenance texts are limited to 4096 bytes");
  }
  return {};
}

// Range of the sort key when nobody gave one: from the near plane of 3DGS to the diagonal of the robust box, which is
// what a camera at one end of the scene sees. Cameras may also stand far outside, and what lies beyond the range loses its
// order (a crop seen from several diagonals away: 18 dB). With logarithmic bins ten diagonals cost half a bit, so they are
// taken; linear ones would grow ten times as wide.
DepthRange depth_from_extent(const Box& robust, DepthMapping mapping) {
  double squared = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    const double side = static_cast<double>(robust.max[i]) - static_cast<double>(robust.min[i]);
    squared += side * side;
  }
  const double reach = mapping == DepthMapping::logarithmic ? 10 * std::sqrt(squared) : std::sqrt(squared);
  return {0.2f, std::max(static_cast<float>(std::min(reach, 1e30)), 1.f), DepthSource::scene_extent};
}

SectionEntry section(SectionType type, std::uint64_t bytes, std::uint32_t flags = kSectionMustUnderstand) {
  SectionEntry entry;
  entry.type = static_cast<std::uint32_t>(type);
  entry.flags = flags;
  entry.stored_bytes = entry.decoded_bytes = bytes;
  return entry;
}

// All that the file is made of. The permutation has 4 bytes a Gaussian: encode() takes less than 2^32.
struct Encoded {
  std::span<const std::byte> means, geometry, sh, permutation;
  std::span<const ChunkEntry> chunks;
  std::span<const ShStepSet> scales;  // of each chunk
  EncodeCounts counts;
};

void put(std::vector<std::byte>& file, std::uint64_t offset, std::span<const std::byte> bytes) {
  std::ranges::copy(bytes, file.begin() + static_cast<std::ptrdiff_t>(offset));
}

std::vector<std::byte> assemble_direct(const EncodePlan& plan, const Encoded& e) {
  std::vector<std::byte> file(plan.header.file_bytes);
  put(file, plan.find(SectionType::means)->offset, e.means);
  put(file, plan.find(SectionType::geometry)->offset, e.geometry);
  put(file, plan.find(SectionType::sh)->offset, e.sh);
  if (plan.keep_permutation) put(file, plan.find(SectionType::permutation)->offset, e.permutation);
  const SectionHashes hashes{xxh3(e.means), xxh3(e.geometry), xxh3(e.sh), xxh3(e.permutation)};
  for (const FilePiece& piece : finish(plan, e.chunks, e.scales, e.counts, hashes))
    put(file, piece.offset, piece.bytes);
  return file;
}

std::vector<std::byte> assemble_packed(const EncodePlan& plan, const Encoded& e) {
  PackedEncoder encoder(plan);
  detail::FramedFile file;
  const std::uint64_t n = plan.header.n_gaussians, stride = sh_bytes(plan.header.sh_degree), rows = plan.frame_rows();
  for (std::uint64_t first = 0; first < n; first += rows) {
    const std::uint64_t count = std::min(rows, n - first), chunk = first / plan.header.chunk_size;
    const std::uint64_t n_chunks = (count + plan.header.chunk_size - 1) / plan.header.chunk_size;
    const PackedFrames frames =
        encoder.encode(e.means.subspan(first * kMeanBytes, count * kMeanBytes),
                       e.geometry.subspan(first * kGeometryBytes, count * kGeometryBytes),
                       e.sh.subspan(first * stride, count * stride), e.scales.subspan(chunk, n_chunks));
    file.means.append(frames.means);
    file.geometry.append(frames.geometry);
    file.sh.append(frames.sh);
  }
  file.permutation = e.permutation;
  file.chunks = e.chunks;
  file.scales = e.scales;
  file.counts = e.counts;
  return assemble_frames(plan, std::move(file));
}

template <class T>
void store(std::byte*& out, const T& value) {
  std::memcpy(out, &value, sizeof value);
  out += sizeof value;
}

}  // namespace

const SectionEntry* EncodePlan::find(SectionType type) const {
  for (const SectionEntry& entry : sections) {
    if (entry.type == static_cast<std::uint32_t>(type)) return &entry;
  }
  return nullptr;
}

std::uint32_t EncodePlan::frame_rows() const {
  // The smaller, the better weights and tables suit; below this they cost more than they save (docs/PROFILES.md).
  constexpr std::uint32_t kPackedRows = 16384, kArchiveRows = 32768;
  const std::uint32_t rows = profile == Profile::archive ? kArchiveRows : kPackedRows;
  return std::max(1u, rows / header.chunk_size) * header.chunk_size;
}

Result<EncodePlan> make_plan(const SceneScan& scan, const EncodeOptions& options) {
  if (const Status status = check_options(options); !status) return tl::unexpected(status.error());
  const std::uint64_t damaged = scan.n_source() - scan.n_kept() + scan.n_repaired();
  if (options.on_bad == BadPolicy::refuse && damaged != 0) {
    return make_error(Errc::bad_value, Error::kNone,
                      "the scene has damaged Gaussians; allow dropping or repairing them", 0, damaged);
  }
  if (options.on_bad == BadPolicy::drop &&
      static_cast<double>(damaged) > options.max_bad_fraction * static_cast<double>(scan.n_source())) {
    return make_error(Errc::too_many_bad, Error::kNone,
                      "more damaged Gaussians than may be dropped without being told to; choose a policy explicitly",
                      static_cast<std::uint64_t>(options.max_bad_fraction * static_cast<double>(scan.n_source())),
                      damaged);
  }

  EncodePlan plan;
  const std::uint64_t n = scan.n_kept();
  Header& h = plan.header;
  h.n_gaussians = n;
  h.chunk_size = options.chunk_size;
  h.n_chunks = n / h.chunk_size + (n % h.chunk_size != 0 ? 1 : 0);
  h.n_step_sets = options.chunk_step_sets ? h.n_chunks : std::min<std::uint64_t>(h.n_chunks, 1);
  h.sh_degree = static_cast<std::uint8_t>(scan.sh_degree());
  h.scale_exponent = n == 0 ? std::int16_t{0}
                            : static_cast<std::int16_t>(choose_scale_exponent(scale_from_log(scan.min_log_scale()),
                                                                              scale_from_log(scan.max_log_scale())));

  Declarations& d = plan.declarations;
  d.axes = options.axes;
  d.colour_space = options.colour_space;
  d.aa_mode = options.aa_mode;
  d.order = options.order;
  d.metres_per_unit = options.metres_per_unit;
  d.full = scan.full();
  d.robust = scan.robust();
  const DepthRange depth = options.depth.value_or(depth_from_extent(d.robust, options.depth_mapping));
  d.z_near = depth.z_near;
  d.z_far = depth.z_far;
  d.depth_source = depth.source;
  d.depth_mapping = options.depth_mapping;
  d.n_source = scan.n_source();
  d.n_dropped = scan.n_source() - n;
  d.n_repaired = scan.n_repaired();
  // What the reader would refuse is not written: axes that do not span space, numbers that are no enumerators.
  if (const auto legal = detail::parse_declarations(detail::write_declarations(d), 0); !legal) {
    return make_error(Errc::bad_argument, Error::kNone, legal.error().what);
  }

  // A scene of nothing has nothing to fit steps to.
  plan.profile = options.profile == Profile::archive && n == 0 ? Profile::packed : options.profile;
  plan.archive = options.archive;
  plan.level = options.level;
  plan.provenance = options.provenance;
  plan.chunk_step_sets = options.chunk_step_sets;
  plan.keep_permutation = options.keep_permutation;
  plan.permutation_entry_bytes = !options.keep_permutation ? 0 : (scan.n_source() >> 32) != 0 ? 8 : 4;
  const ShStepSet max_abs = scan.sh_magnitudes().max_abs();
  for (std::size_t degree = 0; degree < 4; ++degree) {
    for (std::size_t c = 0; c < 3; ++c) plan.file_scales.step[degree][c] = sh_step(max_abs.step[degree][c]);
  }

  // Small sections first: a client that fetches by chunk needs them before it can ask for anything else.
  plan.sections = {section(SectionType::declarations, kDeclarationBytes),
                   section(SectionType::sh_steps, h.n_step_sets * kStepSetBytes),
                   section(SectionType::chunks, h.n_chunks * kChunkEntryBytes),
                   section(SectionType::means, n * kMeanBytes),
                   section(SectionType::geometry, n * kGeometryBytes),
                   section(SectionType::sh, n * sh_bytes(h.sh_degree))};
  if (plan.profile == Profile::archive) plan.sections.push_back(section(SectionType::archive, 0));
  if (options.keep_permutation) {
    plan.sections.push_back(section(SectionType::permutation, n * plan.permutation_entry_bytes, 0));
  }
  if (options.provenance) {
    const std::uint64_t texts = options.provenance->source_name.size() + options.provenance->tool.size();
    plan.sections.push_back(section(SectionType::provenance, 24 + texts, 0));
  }
  h.n_sections = static_cast<std::uint32_t>(plan.sections.size());
  std::uint64_t end = kHeaderBytes + h.n_sections * kSectionEntryBytes + kHeadChecksumBytes;
  for (SectionEntry& entry : plan.sections) {
    if (plan.profile == Profile::packed && coded_type(static_cast<SectionType>(entry.type))) {
      entry.stored_bytes = detail::coded_bound(entry.decoded_bytes, n / plan.frame_rows() + 1);
    }
    entry.offset = detail::align_up(end, kSectionAlignment);
    end = entry.offset + entry.stored_bytes;
  }
  h.file_bytes = end;
  return plan;
}

void EncodeCounts::add(const EncodeCounts& other) {
  scale_subnormal += other.scale_subnormal;
  scale_zero += other.scale_zero;
  opacity_zero += other.opacity_zero;
  opacity_one += other.opacity_one;
}

void encode_chunk(const EncodePlan& plan, std::span<const Splat> splats, ChunkOutput& out) {
  const int degree = plan.header.sh_degree;
  const int exponent = plan.header.scale_exponent;
  const auto floats = static_cast<std::size_t>(3 * sh_coefficients(degree));
  const std::size_t stride = sh_bytes(degree);
  assert(!splats.empty() && splats.size() <= plan.header.chunk_size);
  assert(out.means.size() == splats.size() * kMeanBytes && out.geometry.size() == splats.size() * kGeometryBytes &&
         out.sh.size() == splats.size() * stride);

  out.scales = plan.file_scales;
  if (plan.chunk_step_sets) {
    ShMagnitudes magnitudes;
    for (const Splat& s : splats) magnitudes.add(s.sh, degree);
    out.scales = magnitudes.max_abs();
    for (auto& steps : out.scales.step) {
      for (float& step : steps) step = sh_step(step);
    }
  }
  float steps[48];  // per coefficient and channel, so that the loop below has no look-up
  for (std::size_t i = 0; i < floats; ++i) steps[i] = out.scales.of_value(static_cast<int>(i));

  ChunkEntry& entry = out.entry;
  entry = {};
  entry.count = static_cast<std::uint32_t>(splats.size());
  for (std::size_t i = 0; i < 3; ++i) entry.means.min[i] = entry.means.max[i] = splats[0].mean[i] + 0.f;
  out.counts = {};
  std::uint16_t largest_scale = 0, largest_opacity = 0;  // FP16 bits of non-negative numbers order as the numbers do

  std::byte* mean_out = out.means.data();
  std::byte* geometry_out = out.geometry.data();
  auto* sh_out = reinterpret_cast<std::int8_t*>(out.sh.data());
  for (const Splat& s : splats) {
    for (std::size_t i = 0; i < 3; ++i) {
      const float mean = s.mean[i] + 0.f;  // boxes hold no -0
      entry.means.min[i] = std::min(entry.means.min[i], mean);
      entry.means.max[i] = std::max(entry.means.max[i], mean);
      store(mean_out, s.mean[i]);
    }
    std::uint16_t codes[8];
    quantize_rotation(s.rotation, codes);
    for (std::size_t i = 0; i < 3; ++i) {
      const std::uint16_t code = quantize_scale(scale_from_log(s.log_scale[i]), exponent);
      out.counts.scale_zero += code == 0;
      out.counts.scale_subnormal += code != 0 && code < 0x0400;
      largest_scale = std::max(largest_scale, code);
      codes[4 + i] = code;
    }
    codes[7] = half_from_float(opacity_from_logit(s.opacity_logit));
    out.counts.opacity_zero += codes[7] == 0;
    out.counts.opacity_one += codes[7] == 0x3C00;
    largest_opacity = std::max(largest_opacity, codes[7]);
    store(geometry_out, codes);
    for (std::size_t i = 0; i < floats; ++i) sh_out[i] = quantize_sh(s.sh[i], steps[i]);
    for (std::size_t i = floats; i < stride; ++i) sh_out[i] = 0;
    sh_out += stride;
  }
  entry.radius = 3.f * dequantize_scale(largest_scale, exponent);  // exact: 11-bit times 2-bit significand
  entry.max_opacity = float_from_half(largest_opacity);
}

namespace detail {

std::vector<std::byte> small_section(const EncodePlan& plan, SectionType type, std::span<const ChunkEntry> chunks,
                                     std::span<const ShStepSet> scales, const EncodeCounts& counts) {
  assert(chunks.size() == plan.header.n_chunks && (!plan.chunk_step_sets || scales.size() == chunks.size()));
  ByteWriter out;
  switch (type) {
    case SectionType::declarations: {
      Declarations d = plan.declarations;
      d.n_scale_subnormal = counts.scale_subnormal;
      d.n_scale_zero = counts.scale_zero;
      d.n_opacity_zero = counts.opacity_zero;
      d.n_opacity_one = counts.opacity_one;
      return write_declarations(d);
    }
    case SectionType::sh_steps:
      if (plan.chunk_step_sets) {
        for (const ShStepSet& set : scales) write_step_set(out, set);
      } else if (!chunks.empty()) {
        write_step_set(out, plan.file_scales);
      }
      return out.take();
    case SectionType::chunks:
      for (std::size_t i = 0; i < chunks.size(); ++i) {
        ChunkEntry chunk = chunks[i];
        chunk.step_set = plan.chunk_step_sets ? i : 0;
        write_chunk_entry(out, chunk);
      }
      return out.take();
    case SectionType::provenance: return write_provenance(*plan.provenance);
    default: return {};
  }
}

}  // namespace detail

std::vector<FilePiece> finish(const EncodePlan& plan, std::span<const ChunkEntry> chunks,
                              std::span<const ShStepSet> scales, const EncodeCounts& counts,
                              const SectionHashes& hashes) {
  assert(plan.profile == Profile::direct);
  std::vector<SectionEntry> sections = plan.sections;
  std::vector<FilePiece> pieces;
  for (SectionEntry& entry : sections) {
    switch (static_cast<SectionType>(entry.type)) {
      case SectionType::means: entry.xxh3 = hashes.means; break;
      case SectionType::geometry: entry.xxh3 = hashes.geometry; break;
      case SectionType::sh: entry.xxh3 = hashes.sh; break;
      case SectionType::permutation: entry.xxh3 = hashes.permutation; break;
      default: {
        auto bytes = detail::small_section(plan, static_cast<SectionType>(entry.type), chunks, scales, counts);
        assert(bytes.size() == entry.stored_bytes);
        entry.xxh3 = xxh3(bytes);
        pieces.push_back({entry.offset, std::move(bytes)});
      }
    }
  }
  pieces.push_back({0, detail::write_head(plan.header, sections)});
  return pieces;
}

static Result<std::vector<std::byte>> encode_scene(const SplatView& splats, const EncodeOptions& options) {
  if (!splats.consistent())
    return make_error(Errc::bad_argument, Error::kNone, "the sizes of the splat arrays disagree");
  if (splats.n > std::numeric_limits<std::uint32_t>::max()) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians in one call");
  }
  SceneScan scan(splats.sh_degree, options);
  std::vector<std::uint32_t> indices;
  indices.reserve(splats.n);
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    Splat s = splats.splat(i);
    if (scan.add(s)) {
      indices.push_back(static_cast<std::uint32_t>(i));
    } else if (options.on_bad == BadPolicy::refuse) {
      return make_error(Errc::bad_value, i, "a damaged Gaussian at this index; allow dropping or repairing");
    }
  }
  const auto plan = make_plan(scan, options);
  if (!plan) return tl::unexpected(plan.error());
  if (options.order == Order::morton) {
    const MortonKey key(plan->declarations.robust);
    std::vector<std::uint64_t> keys(indices.size());
    for (std::size_t i = 0; i < indices.size(); ++i) keys[i] = key(&splats.mean[3 * std::size_t{indices[i]}]);
    sort_by_key(keys, indices);
  }

  if (plan->profile == Profile::archive) {
    SplatCloud sorted;
    sorted.resize(indices.size(), plan->header.sh_degree);
    for (std::size_t i = 0; i < indices.size(); ++i) {
      Splat s = splats.splat(indices[i]);
      if (options.on_bad == BadPolicy::repair) repair(s, find_defects(s, plan->header.sh_degree));
      sorted.set(i, s);
    }
    return encode_archive(*plan, sorted.view(), indices);
  }

  // Rows of each section, one after the other.
  const std::uint64_t n = plan->header.n_gaussians, stride = sh_bytes(plan->header.sh_degree);
  std::vector<std::byte> means(n * kMeanBytes), geometry(n * kGeometryBytes), sh(n * stride);
  std::vector<ChunkEntry> chunks(plan->header.n_chunks);
  std::vector<ShStepSet> scales(chunks.size());
  std::vector<Splat> buffer(std::min<std::uint64_t>(plan->header.chunk_size, n));
  EncodeCounts counts;
  for (std::size_t c = 0; c < chunks.size(); ++c) {
    const std::uint64_t first = c * plan->header.chunk_size;
    const std::uint64_t count = std::min<std::uint64_t>(plan->header.chunk_size, n - first);
    for (std::uint64_t i = 0; i < count; ++i) {
      buffer[i] = splats.splat(indices[first + i]);
      if (options.on_bad == BadPolicy::repair) repair(buffer[i], find_defects(buffer[i], plan->header.sh_degree));
    }
    ChunkOutput out;
    out.means = std::span(means).subspan(first * kMeanBytes, count * kMeanBytes);
    out.geometry = std::span(geometry).subspan(first * kGeometryBytes, count * kGeometryBytes);
    out.sh = std::span(sh).subspan(first * stride, count * stride);
    encode_chunk(*plan, std::span(buffer).first(count), out);
    chunks[c] = out.entry;
    scales[c] = out.scales;
    counts.add(out.counts);
  }
  const Encoded encoded{means, geometry, sh, std::as_bytes(std::span(indices)), chunks, scales, counts};
  return plan->profile == Profile::packed ? assemble_packed(*plan, encoded) : assemble_direct(*plan, encoded);
}

Result<std::vector<std::byte>> encode(const SplatView& splats, const EncodeOptions& options) {
  return detail::guard_memory([&] { return encode_scene(splats, options); });
}

}  // namespace rgs
