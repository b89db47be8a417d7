// layout_io.cpp - serialises and parses header, section table and fixed records; docs/format/FORMAT.md has the offsets.
// SPDX-License-Identifier: Apache-2.0
#include "file/layout_io.hpp"

#include <algorithm>
#include <bit>
#include <cmath>

#include "rgs/checksum.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {

static_assert(std::endian::native == std::endian::little, "bulk attribute arrays are copied as they are on disk");

std::vector<std::byte> write_head(const Header& header, std::span<const SectionEntry> sections) {
  ByteWriter out;
  for (const unsigned char c : kMagic) out.u8(c);
  out.u16(header.version_major);
  out.u16(header.version_minor);
  out.u32(0);  // flags: none defined
  out.u64(header.file_bytes);
  out.u64(header.n_gaussians);
  out.u64(header.n_chunks);
  out.u64(header.n_step_sets);
  out.u32(header.chunk_size);
  out.u32(static_cast<std::uint32_t>(sections.size()));
  out.u8(header.sh_degree);
  out.u8(static_cast<std::uint8_t>(sh_bytes(header.sh_degree)));
  out.i16(header.scale_exponent);
  out.pad_to(kHeaderBytes);
  for (const SectionEntry& section : sections) {
    out.u32(section.type);
    out.u32(section.flags);
    out.u32(section.codec);
    out.u32(0);
    out.u64(section.offset);
    out.u64(section.stored_bytes);
    out.u64(section.decoded_bytes);
    out.u64(section.xxh3);
    out.zeros(16);
  }
  out.u64(xxh3(out.bytes()));
  return out.take();
}

std::vector<std::byte> write_declarations(const Declarations& d) {
  ByteWriter out;
  for (const Axis axis : d.axes) out.u8(static_cast<std::uint8_t>(axis));
  out.u8(static_cast<std::uint8_t>(d.colour_space));
  out.u8(static_cast<std::uint8_t>(d.sh_basis));
  out.u8(static_cast<std::uint8_t>(d.kernel));
  out.u8(static_cast<std::uint8_t>(d.aa_mode));
  out.u8(static_cast<std::uint8_t>(d.sort_metric));
  out.u8(static_cast<std::uint8_t>(d.depth_mapping));
  out.u8(static_cast<std::uint8_t>(d.depth_source));
  out.u8(static_cast<std::uint8_t>(d.order));
  out.u8(static_cast<std::uint8_t>(d.first_view.kind));
  for (const float value : {d.z_near, d.z_far, d.metres_per_unit, d.cutoff_sigma, d.alpha_threshold, d.alpha_max,
                            d.low_pass_px2, d.transmittance_min}) {
    out.f32(value);
  }
  for (const Box* box : {&d.full, &d.robust}) {
    for (const float value : box->min) out.f32(value);
    for (const float value : box->max) out.f32(value);
  }
  out.f32(d.robust_fraction);
  for (const std::uint64_t value : {d.n_source, d.n_dropped, d.n_repaired, d.n_scale_subnormal, d.n_scale_zero,
                                    d.n_opacity_zero, d.n_opacity_one}) {
    out.u64(value);
  }
  for (const double value : d.origin) out.f64(value + 0.0);  // no -0
  const FirstView& view = d.first_view;
  for (const auto* vector : {&view.position, &view.pivot, &view.up}) {
    for (const float value : *vector) out.f32(value + 0.F);
  }
  out.f32(view.horizontal_fov);
  out.pad_to(kDeclarationBytes);
  return out.take();
}

void write_chunk_entry(ByteWriter& out, const ChunkEntry& entry) {
  for (const float value : entry.means.min) out.f32(value);
  out.f32(entry.radius);
  for (const float value : entry.means.max) out.f32(value);
  out.f32(entry.max_opacity);
  out.u64(entry.step_set);
  out.u32(entry.count);
  out.u32(0);
}

void write_step_set(ByteWriter& out, const ShStepSet& set) {
  for (const auto& degree : set.step) {
    for (const float step : degree) out.f32(step);
  }
}

std::vector<std::byte> write_provenance(const Provenance& p) {
  ByteWriter out;
  out.u64(p.source_bytes);
  out.u64(p.source_xxh3);
  out.u32(static_cast<std::uint32_t>(p.source_name.size()));
  out.u32(static_cast<std::uint32_t>(p.tool.size()));
  out.text(p.source_name);
  out.text(p.tool);
  return out.take();
}

std::vector<std::byte> write_crs(const Crs& crs) {
  ByteWriter out;
  for (const Axis axis : crs.axes) out.u8(static_cast<std::uint8_t>(axis));
  out.u8(0);
  out.text(crs.text);
  return out.take();
}

Result<Header> parse_header(std::span<const std::byte> bytes) {
  ByteReader in(bytes);
  // A prefix of the magic is a truncated file; anything else is another format.
  const std::size_t n = std::min(bytes.size(), kMagic.size());
  for (std::size_t i = 0; i < n; ++i) {
    if (bytes[i] != std::byte{kMagic[i]}) return make_error(Errc::bad_magic, i, "not an .rgs file (wrong magic bytes)");
  }
  if (bytes.size() < kHeaderBytes) {
    return make_error(Errc::truncated, bytes.size(),
                      bytes.empty() ? "the file is empty" : "the file ends inside its header", kHeaderBytes,
                      bytes.size());
  }
  in.zeros(8);
  Header h;
  h.version_major = in.u16();
  h.version_minor = in.u16();
  if (h.version_major != kVersionMajor) {
    return make_error(Errc::unsupported_version, 8, "major version not known to this program; update it", kVersionMajor,
                      h.version_major);
  }
  if (in.u32() != 0) return make_error(Errc::reserved_bits, 12, "reserved header flags are set");
  h.file_bytes = in.u64();
  h.n_gaussians = in.u64();
  h.n_chunks = in.u64();
  h.n_step_sets = in.u64();
  h.chunk_size = in.u32();
  h.n_sections = in.u32();
  h.sh_degree = in.u8();
  const std::uint8_t stored_sh_bytes = in.u8();
  h.scale_exponent = in.i16();
  if (!in.zeros(kHeaderBytes - 60)) return make_error(Errc::reserved_bits, 60, "reserved header bytes are not zero");

  if (h.chunk_size < kMinChunkSize || h.chunk_size > kMaxChunkSize || h.chunk_size % 32 != 0) {
    return make_error(Errc::bad_header, 48, "chunk size is not a multiple of 32 from 32 to 2^16", Error::kNone,
                      h.chunk_size);
  }
  const std::uint64_t n_chunks = h.n_gaussians / h.chunk_size + (h.n_gaussians % h.chunk_size != 0 ? 1 : 0);
  if (h.n_chunks != n_chunks) {
    return make_error(Errc::bad_header, 32, "chunk count contradicts Gaussian count and chunk size", n_chunks,
                      h.n_chunks);
  }
  if (h.n_step_sets > h.n_chunks || (h.n_step_sets == 0) != (h.n_chunks == 0)) {
    return make_error(Errc::bad_header, 40, "number of SH scale sets is not between 1 and the number of chunks",
                      h.n_chunks, h.n_step_sets);
  }
  if (h.n_sections == 0 || h.n_sections > kMaxSections) {
    return make_error(Errc::bad_header, 52, "section count is not between 1 and 1024", Error::kNone, h.n_sections);
  }
  const std::uint64_t head_bytes = kHeaderBytes + h.n_sections * kSectionEntryBytes + kHeadChecksumBytes;
  if (h.file_bytes < head_bytes) {
    return make_error(Errc::bad_header, 52, "the section table does not fit into the file", h.file_bytes, head_bytes);
  }
  if (h.sh_degree > kMaxShDegree)
    return make_error(Errc::bad_header, 56, "SH degree above 3", kMaxShDegree, h.sh_degree);
  if (stored_sh_bytes != sh_bytes(h.sh_degree)) {
    return make_error(Errc::bad_header, 57, "SH bytes per Gaussian contradict the SH degree", sh_bytes(h.sh_degree),
                      stored_sh_bytes);
  }
  if (h.scale_exponent < -kMaxScaleExponent || h.scale_exponent > kMaxScaleExponent) {
    return make_error(Errc::bad_header, 58, "scale exponent is not between -110 and 110");
  }
  return h;
}

Result<SectionEntry> parse_section_entry(std::span<const std::byte> bytes, std::uint64_t offset) {
  ByteReader in(bytes, offset);
  SectionEntry s;
  s.type = in.u32();
  s.flags = in.u32();
  s.codec = in.u32();
  const std::uint32_t reserved = in.u32();
  s.offset = in.u64();
  s.stored_bytes = in.u64();
  s.decoded_bytes = in.u64();
  s.xxh3 = in.u64();
  const bool zero = in.zeros(16);
  if (!in.ok()) return make_error(Errc::truncated, offset, "the file ends inside its section table");
  if ((s.flags & ~kSectionMustUnderstand) != 0) {
    return make_error(Errc::reserved_bits, offset + 4, "reserved section flags are set");
  }
  if (reserved != 0) return make_error(Errc::reserved_bits, offset + 12, "a reserved section field is not zero");
  if (!zero) return make_error(Errc::reserved_bits, offset + 48, "reserved section bytes are not zero");
  return s;
}

namespace {

// Reads an enumerator stored as one byte with values low..high.
template <class Enum>
bool read_enum(ByteReader& in, Enum& out, int low, int high) {
  const int value = in.u8();
  out = static_cast<Enum>(value);
  return value >= low && value <= high;
}

Status read_axes(ByteReader& in, std::array<Axis, 3>& axes) {
  const auto bad = [&in](std::uint64_t back, const char* what) {
    return make_error(Errc::bad_value, in.offset() - back, what);
  };
  for (Axis& axis : axes) {
    if (!read_enum(in, axis, 0, 6)) return bad(1, "axis direction is not 0 to 6");
  }
  // Three declared axes must be different directions; (a - 1) / 2 is the pair left-right, up-down, ...
  if (std::ranges::count(axes, Axis::undeclared) != 0) {
    if (std::ranges::count(axes, Axis::undeclared) != 3) return bad(3, "either all axes are declared or none");
    return {};
  }
  unsigned seen = 0;
  for (const Axis axis : axes) seen |= 1u << ((static_cast<unsigned>(axis) - 1) / 2);
  if (seen != 7) return bad(3, "declared axes do not span space");
  return {};
}

// Bytes of the character at the beginning of `text`, UTF-8 without overlong forms and surrogates (The Unicode Standard,
// table 3-7); 0 if it is another byte, or a control character.
std::size_t character_bytes(std::string_view text) {
  const auto byte = [text](std::size_t i) { return std::uint32_t{static_cast<unsigned char>(text[i])}; };
  const std::uint32_t lead = byte(0);
  if (lead < 0x80) return lead < 0x20 || lead == 0x7F ? 0 : 1;
  const std::size_t bytes = lead < 0xC2 || lead > 0xF4 ? 0 : lead < 0xE0 ? 2 : lead < 0xF0 ? 3 : 4;
  if (bytes == 0 || text.size() < bytes) return 0;
  std::uint32_t code = lead & (0x7Fu >> bytes);
  for (std::size_t i = 1; i < bytes; ++i) {
    if ((byte(i) & 0xC0) != 0x80) return 0;
    code = code << 6 | (byte(i) & 0x3F);
  }
  const std::uint32_t least = bytes == 2 ? 0xA0 : bytes == 3 ? 0x800 : 0x10000;  // 0x80 to 0x9F are controls
  return code < least || (code >= 0xD800 && code < 0xE000) || code > 0x10FFFF ? 0 : bytes;
}

// Bytes of sound characters at the beginning.
std::size_t sound_bytes(std::string_view text) {
  std::size_t at = 0;
  while (at < text.size()) {
    const std::size_t bytes = character_bytes(text.substr(at));
    if (bytes == 0) break;
    at += bytes;
  }
  return at;
}

bool ordered(const Box& box) {
  for (std::size_t i = 0; i < 3; ++i) {
    if (!std::isfinite(box.min[i]) || !std::isfinite(box.max[i]) || box.min[i] > box.max[i]) return false;
  }
  return true;
}

// All but its kind, which is not none.
Status read_first_view(ByteReader& in, FirstView& view) {
  const auto bad = [&in](std::uint64_t back, const char* what) {
    return make_error(Errc::bad_value, in.offset() - back, what);
  };
  for (auto* place : {&view.position, &view.pivot}) {
    for (float& value : *place) {
      value = in.f32();
      if (!(std::fabs(static_cast<double>(value)) <= kMaxOrigin))
        return bad(4, "the first view's position or pivot is not finite or beyond 10^12");
    }
  }
  if (view.position == view.pivot) return bad(24, "the first view's position and pivot are the same");
  double squared = 0;
  for (float& value : view.up) {
    value = in.f32();
    squared += static_cast<double>(value) * static_cast<double>(value);
  }
  if (!(std::fabs(squared - 1) <= 1e-3)) return bad(12, "the first view's up is no unit vector");
  view.horizontal_fov = in.f32();
  if (!(view.horizontal_fov >= 1 && view.horizontal_fov <= 179))
    return bad(4, "the first view is not 1 to 179 degrees wide");
  return {};
}

}  // namespace

Result<Declarations> parse_declarations(std::span<const std::byte> bytes, std::uint64_t offset, std::uint16_t minor) {
  if (bytes.size() != kDeclarationBytes) {
    return make_error(Errc::size_mismatch, offset, "declarations have the wrong size", kDeclarationBytes, bytes.size());
  }
  ByteReader in(bytes, offset);
  Declarations d;
  const auto bad = [&in](std::uint64_t back, const char* what) {
    return make_error(Errc::bad_value, in.offset() - back, what);
  };
  if (const Status axes = read_axes(in, d.axes); !axes) return tl::unexpected(axes.error());
  if (!read_enum(in, d.colour_space, 0, 2)) return bad(1, "colour space is not 0 to 2");
  if (!read_enum(in, d.sh_basis, 1, 1)) return bad(1, "SH basis is not 1");
  if (!read_enum(in, d.kernel, 1, 1)) return bad(1, "kernel is not 1");
  if (!read_enum(in, d.aa_mode, 0, 2)) return bad(1, "anti-aliasing mode is not 0 to 2");
  if (!read_enum(in, d.sort_metric, 1, 1)) return bad(1, "sort metric is not 1");
  if (!read_enum(in, d.depth_mapping, 1, 2)) return bad(1, "depth mapping is not 1 or 2");
  if (!read_enum(in, d.depth_source, 1, 3)) return bad(1, "depth source is not 1 to 3");
  if (!read_enum(in, d.order, 1, 2)) return bad(1, "order is not 1 or 2");
  if (minor >= 5) {
    if (!read_enum(in, d.first_view.kind, 0, 2)) return bad(1, "the kind of the first view is not 0 to 2");
  } else if (in.u8() != 0) {
    return make_error(Errc::reserved_bits, in.offset() - 1, "a reserved declaration byte is not zero");
  }
  for (float* value : {&d.z_near, &d.z_far, &d.metres_per_unit, &d.cutoff_sigma, &d.alpha_threshold, &d.alpha_max,
                       &d.low_pass_px2, &d.transmittance_min}) {
    *value = in.f32();
    if (!std::isfinite(*value) || *value < 0) return bad(4, "a declared constant is negative or not finite");
  }
  if (!(d.z_near > 0 && d.z_near < d.z_far)) {
    return make_error(Errc::bad_value, offset + 12, "depth range is not 0 < near < far");
  }
  for (Box* box : {&d.full, &d.robust}) {
    for (float& value : box->min) value = in.f32();
    for (float& value : box->max) value = in.f32();
    if (!ordered(*box)) return bad(24, "a declared box is not finite or has min > max");
  }
  d.robust_fraction = in.f32();
  if (!(d.robust_fraction >= 0 && d.robust_fraction <= 1)) return bad(4, "robust fraction is not between 0 and 1");
  for (std::uint64_t* value : {&d.n_source, &d.n_dropped, &d.n_repaired, &d.n_scale_subnormal, &d.n_scale_zero,
                               &d.n_opacity_zero, &d.n_opacity_one}) {
    *value = in.u64();
  }
  for (std::size_t i = 0; minor >= 3 && i < 3; ++i) {
    d.origin[i] = in.f64();
    if (!(std::fabs(d.origin[i]) <= kMaxOrigin)) return bad(8, "the origin is not finite or beyond 10^12");
  }
  if (d.first_view.kind != ViewKind::none) {
    if (const Status view = read_first_view(in, d.first_view); !view) return tl::unexpected(view.error());
  }
  const std::uint64_t reserved = in.offset();
  if (!in.zeros(in.remaining()))
    return make_error(Errc::reserved_bits, reserved, "reserved declaration bytes are not zero");
  return d;
}

Result<ChunkEntry> parse_chunk_entry(std::span<const std::byte> bytes, std::uint64_t offset) {
  ByteReader in(bytes, offset);
  ChunkEntry e;
  for (float& value : e.means.min) value = in.f32();
  e.radius = in.f32();
  for (float& value : e.means.max) value = in.f32();
  e.max_opacity = in.f32();
  e.step_set = in.u64();
  e.count = in.u32();
  const std::uint32_t reserved = in.u32();
  if (!in.ok()) return make_error(Errc::truncated, offset, "the chunk table ends inside an entry");
  if (reserved != 0) return make_error(Errc::reserved_bits, offset + 44, "a reserved chunk field is not zero");
  if (!ordered(e.means)) return make_error(Errc::bad_value, offset, "a chunk's box is not finite or has min > max");
  if (!std::isfinite(e.radius) || e.radius < 0) {
    return make_error(Errc::bad_value, offset + 12, "a chunk's radius is negative or not finite");
  }
  if (!(e.max_opacity >= 0 && e.max_opacity <= 1)) {
    return make_error(Errc::bad_value, offset + 28, "a chunk's largest opacity is not between 0 and 1");
  }
  return e;
}

ShStepSet parse_step_set(std::span<const std::byte> bytes) {
  ByteReader in(bytes);
  ShStepSet set;
  for (auto& degree : set.step) {
    for (float& step : degree) step = in.f32();
  }
  return set;
}

Result<Provenance> parse_provenance(std::span<const std::byte> bytes, std::uint64_t offset) {
  ByteReader in(bytes, offset);
  Provenance p;
  p.source_bytes = in.u64();
  p.source_xxh3 = in.u64();
  const std::uint32_t name = in.u32();
  const std::uint32_t tool = in.u32();
  if (!in.ok())
    return make_error(Errc::size_mismatch, offset, "provenance is shorter than its fixed part", 24, bytes.size());
  if (name > kMaxProvenanceText)
    return make_error(Errc::limit_exceeded, offset + 16, "source name is longer than 4096 bytes");
  if (tool > kMaxProvenanceText)
    return make_error(Errc::limit_exceeded, offset + 20, "tool name is longer than 4096 bytes");
  if (in.remaining() != std::uint64_t{name} + tool) {
    return make_error(Errc::size_mismatch, offset, "provenance size contradicts its text lengths",
                      24 + std::uint64_t{name} + tool, bytes.size());
  }
  p.source_name = in.text(name);
  p.tool = in.text(tool);
  return p;
}

Result<Crs> parse_crs(std::span<const std::byte> bytes, std::uint64_t offset, const std::array<Axis, 3>& axes) {
  ByteReader in(bytes, offset);
  Crs crs;
  if (const Status s = read_axes(in, crs.axes); !s) return tl::unexpected(s.error());
  if (in.u8() != 0) return make_error(Errc::reserved_bits, offset + 3, "a reserved byte is not zero");
  if (crs.axes[0] != Axis::undeclared && axes[0] == Axis::undeclared) {
    return make_error(Errc::bad_value, offset, "the coordinate reference system has axes, but the scene declares none");
  }
  crs.text = in.text(in.remaining());
  if (const std::size_t sound = sound_bytes(crs.text); sound != crs.text.size()) {
    return make_error(Errc::bad_value, offset + kCrsHeadBytes + sound,
                      "the coordinate reference system's text is not UTF-8, or has a control character");
  }
  if (!is_crs_text(crs.text)) {
    return make_error(Errc::bad_value, offset + kCrsHeadBytes,
                      "the coordinate reference system's text is empty or longer than 16,384 bytes");
  }
  return crs;
}

}  // namespace rgs::detail

namespace rgs {

bool is_crs_text(std::string_view text) {
  return !text.empty() && text.size() <= kMaxCrsText && detail::sound_bytes(text) == text.size();
}

}  // namespace rgs
