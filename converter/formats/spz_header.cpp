// spz_header.cpp - the framing of Niantic's .spz.
//
// Sources: the format's README (github.com/nianticlabs/spz) for versions 2 and 3 and for extensions; version 4's framing
// from files:
//   0 "NGSP"  4 u32 version  8 u32 n  12 u8 SH degree  13 u8 fractional bits  14 u8 flags
//   15 u8 streams, 6, without SH 5 (versions 2, 3: reserved)   16 u32 offset of the stream table   20 zeros up to 32
//   [extensions]   table: u64 stored bytes, u64 decoded bytes of each stream; then the streams without gaps
// Versions 2 and 3: the first 16 bytes, the streams, [extensions], all in one gzip member.
// Extensions, if flag 2 is set: records of u32 type (vendor << 16 | number), u32 bytes, so many bytes.
// SPDX-License-Identifier: Apache-2.0
#include "spz_header.hpp"

#include <algorithm>
#include <iterator>
#include <utility>

#include "quantised.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint32_t kSafeOrbitCamera = 0xADBE0002;
constexpr std::uint64_t kSafeOrbitBytes = 12;
constexpr std::size_t kMostUnused = 64;

// By the value of Adobe's extension, from 1. 0 is "unspecified", which the reference library reads as no extension.
using enum Axis;
constexpr Axes kCoordinateSystems[] = {
    {left, down, backward}, {right, down, backward}, {left, up, backward}, {right, up, backward},
    {left, down, forward},  {right, down, forward},  {left, up, forward},  {right, up, forward},
    {left, forward, down},  {right, forward, down},  {left, forward, up},  {right, forward, up},
    {left, backward, down}, {right, backward, down}, {left, backward, up}, {right, backward, up}};

Result<SpzLayout> layout_v4(std::span<const std::byte> bytes, const DecodeLimits& limits, std::uint64_t file_bytes,
                            bool skip_unknown) {
  if (bytes.size() < kSpzHeaderBytesV4) {
    return make_error(Errc::truncated, bytes.size(), "the file ends inside its header", kSpzHeaderBytesV4,
                      bytes.size());
  }
  const auto header = parse_spz_header(bytes, limits, file_bytes, false);
  if (!header) return tl::unexpected(header.error());
  const std::uint64_t n_streams = header->n_streams();
  if (load_u8(bytes, 15) != n_streams) {
    return make_error(Errc::bad_header, 15, "the number of streams is not that of its SH degree", n_streams,
                      load_u8(bytes, 15));
  }
  if (std::ranges::any_of(bytes.subspan(20, 12), [](std::byte b) { return b != std::byte{0}; })) {
    return make_error(Errc::reserved_bits, 20, "reserved bytes are not zero");
  }
  const std::uint64_t table = load<std::uint32_t>(bytes, 16);
  if (table < kSpzHeaderBytesV4 || table > bytes.size() || bytes.size() - table < 16 * n_streams) {
    return make_error(Errc::bad_header, 16, "the stream table lies outside the file", Error::kNone, table);
  }
  if (table != kSpzHeaderBytesV4 && !header->has_extensions()) {
    return make_error(Errc::section_gap, kSpzHeaderBytesV4, "bytes between header and stream table", kSpzHeaderBytesV4,
                      table);
  }
  auto extensions =
      parse_spz_extensions(bytes.first(table).subspan(kSpzHeaderBytesV4), kSpzHeaderBytesV4, skip_unknown);
  if (!extensions) return tl::unexpected(extensions.error());
  SpzLayout layout{*header, std::move(*extensions), {}};
  const auto sizes = header->sizes();
  std::uint64_t at = table + 16 * n_streams;
  for (std::uint64_t i = 0; i < n_streams; ++i) {
    const std::uint64_t entry = table + 16 * i;
    const auto stored = load<std::uint64_t>(bytes, entry), decoded = load<std::uint64_t>(bytes, entry + 8);
    if (decoded != sizes[i]) {
      return make_error(Errc::size_mismatch, entry + 8, "a stream's size contradicts the number of Gaussians", sizes[i],
                        decoded);
    }
    if (stored > bytes.size() - at) {
      return make_error(Errc::truncated, entry, "a stream ends past the end of the file", bytes.size() - at, stored);
    }
    layout.streams.push_back({at, stored, decoded});
    at += stored;
  }
  if (at != bytes.size()) return make_error(Errc::trailing_bytes, at, "bytes after the last stream");
  return layout;
}

}  // namespace

std::array<std::uint64_t, kSpzStreams> SpzHeader::sizes() const {
  const std::uint64_t count = n, rest = static_cast<std::uint64_t>(sh_coefficients(sh_degree)) - 1;
  return {9 * count, count, 3 * count, 3 * count, (version == 2 ? 3 : 4) * count, 3 * rest * count};
}

std::uint64_t SpzHeader::decoded_bytes() const {
  std::uint64_t sum = 0;
  for (const std::uint64_t size : sizes()) sum += size;
  return sum;
}

Result<SpzHeader> parse_spz_header(std::span<const std::byte> bytes, const DecodeLimits& limits,
                                   std::uint64_t file_bytes, bool in_gzip) {
  if (load<std::uint32_t>(bytes, 0) != kSpzMagic) return make_error(Errc::bad_magic, 0, "is not an SPZ file");
  SpzHeader h;
  h.version = load<std::uint32_t>(bytes, 4);
  h.n = load<std::uint32_t>(bytes, 8);
  h.sh_degree = load_u8(bytes, 12);
  h.fractional_bits = load_u8(bytes, 13);
  h.flags = load_u8(bytes, 14);
  if (h.version < 2 || h.version > 4) {
    return make_error(Errc::unsupported_version, 4, "an SPZ version other than 2, 3 and 4", Error::kNone, h.version);
  }
  if (h.sh_degree > kMaxShDegree) {
    return make_error(Errc::unsupported_feature, 12, "the SH degree is not 0 to 3", kMaxShDegree, h.sh_degree);
  }
  if (h.fractional_bits > 24)
    return make_error(Errc::bad_header, 13, "more than 24 fractional bits", 24, h.fractional_bits);
  if ((h.flags & ~(kSpzAntialiased | kSpzHasExtensions)) != 0) {
    return make_error(Errc::reserved_bits, 14, "an unknown flag is set", 0, h.flags);
  }
  if (h.n > limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 8, "more Gaussians than the caller allows", limits.max_gaussians, h.n);
  }
  if (const Status s = check_expansion(h.decoded_bytes(), file_bytes, 8, limits); !s) return tl::unexpected(s.error());
  if (in_gzip && h.version > 3)
    return make_error(Errc::bad_header, 4, "SPZ of version 4 inside a gzip stream", 3, h.version);
  if (in_gzip && load_u8(bytes, 15) != 0) return make_error(Errc::reserved_bits, 15, "a reserved byte is not zero");
  if (!in_gzip && h.version < 4)
    return make_error(Errc::bad_header, 4, "SPZ below version 4 without gzip", 4, h.version);
  return h;
}

// A type does not say whether a reader may skip it, and the axes show that extensions can change what the streams mean.
// So only known ones are skipped, unless the caller takes the risk.
Result<SpzExtensions> parse_spz_extensions(std::span<const std::byte> records, std::uint64_t begin, bool skip_unknown) {
  SpzExtensions out;
  bool is_georeferenced = false;
  for (std::uint64_t at = 0; at < records.size();) {
    const std::uint64_t offset = begin + at, rest = records.size() - at;
    if (rest < 8) return make_error(Errc::truncated, offset, "the extensions end inside a record", 8, rest);
    const auto type = load<std::uint32_t>(records, at);
    // The reference library's first builds wrote this record without its length.
    if (type == kSafeOrbitCamera && rest == 4 + kSafeOrbitBytes) {
      out.unused.push_back({type, kSafeOrbitBytes, "safe orbit camera", at + 4});
      break;
    }
    const auto bytes = load<std::uint32_t>(records, at + 4);
    const bool known = type == kSafeOrbitCamera || type == kSpzCoordinateSystem || type == kSpzGeoreference;
    if (!known && !skip_unknown) {
      return make_error(Errc::unsupported_feature, offset,
                        "an SPZ extension of unknown type, which may change what the file means; rgs-convert "
                        "--skip-unknown-extensions reads past it",
                        Error::kNone, type);
    }
    if (bytes > rest - 8) {
      return make_error(Errc::truncated, offset + 4, "an extension is longer than the bytes left for extensions",
                        rest - 8, bytes);
    }
    if (type == kSpzCoordinateSystem) {
      if (bytes != 4) {
        return make_error(Errc::bad_header, offset + 4, "the coordinate system extension is not 4 bytes", 4, bytes);
      }
      const auto value = load<std::uint32_t>(records, at + 8);
      if (value > std::size(kCoordinateSystems)) {
        return make_error(Errc::bad_value, offset + 8, "no such coordinate system", std::size(kCoordinateSystems),
                          value);
      }
      if (out.axes) return make_error(Errc::bad_header, offset, "a second coordinate system");
      if (value != 0) out.axes = kCoordinateSystems[value - 1];
    } else if (type == kSafeOrbitCamera && bytes != kSafeOrbitBytes) {
      return make_error(Errc::bad_header, offset + 4, "the safe orbit extension is not 12 bytes", kSafeOrbitBytes,
                        bytes);
    } else if (out.unused.size() == kMostUnused) {
      return make_error(Errc::limit_exceeded, offset, "more extensions than any writer has", kMostUnused);
    } else {
      out.unused.push_back({type, bytes,
                            type == kSafeOrbitCamera   ? "safe orbit camera"
                            : type == kSpzGeoreference ? "georeference"
                                                       : "unknown",
                            at + 8});
      // It starts from right, up, backward, the description's axes, so whoever writes it means those.
      is_georeferenced = is_georeferenced ||
                         (type == kSpzGeoreference && bytes >= kSpzGeoreferenceBytes && load_u8(records, at + 8) == 1);
    }
    at += 8 + std::uint64_t{bytes};
  }
  if (!out.axes && is_georeferenced) out.axes = kAxesOpenGl;
  return out;
}

std::uint32_t spz_coordinate_system(const Axes& axes) {
  const auto* const found = std::ranges::find(kCoordinateSystems, axes);
  return found == std::end(kCoordinateSystems) ? 0 : static_cast<std::uint32_t>(found - kCoordinateSystems) + 1;
}

Result<SpzLayout> spz_layout(std::span<const std::byte> bytes, const DecodeLimits& limits, std::uint64_t file_bytes,
                             bool in_gzip, bool skip_unknown) {
  if (!in_gzip) return layout_v4(bytes, limits, file_bytes, skip_unknown);
  if (bytes.size() < kSpzHeaderBytes) {
    return make_error(Errc::truncated, bytes.size(), "the file ends inside its header", kSpzHeaderBytes, bytes.size());
  }
  const auto header = parse_spz_header(bytes, limits, file_bytes, true);
  if (!header) return tl::unexpected(header.error());
  SpzLayout layout{*header, {}, {}};
  std::uint64_t at = kSpzHeaderBytes;
  if (bytes.size() - at < header->decoded_bytes()) {
    return make_error(Errc::truncated, bytes.size(), "the compressed data end early", at + header->decoded_bytes(),
                      bytes.size());
  }
  for (const std::uint64_t size : header->sizes()) {
    layout.streams.push_back({at, size, size});
    at += size;
  }
  if (at < bytes.size() && !header->has_extensions())
    return make_error(Errc::trailing_bytes, at, "the compressed data hold more than the header says");
  auto extensions = parse_spz_extensions(bytes.subspan(at), at, skip_unknown);
  if (!extensions) return tl::unexpected(extensions.error());
  layout.extensions = std::move(*extensions);
  return layout;
}

}  // namespace rgs::detail
