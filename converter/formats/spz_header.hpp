// spz_header.hpp - where the streams of Niantic's .spz are, and what its extensions declare. web/reader compiles it too.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/interchange.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

inline constexpr std::uint32_t kSpzMagic = 0x5053474E;
inline constexpr std::uint64_t kSpzHeaderBytes = 16, kSpzHeaderBytesV4 = 32, kSpzStreams = 6;
inline constexpr std::uint64_t kSpzMostExtensionBytes = std::uint64_t{16} << 20;                  // of a gzip stream
inline constexpr std::uint32_t kSpzCoordinateSystem = 0xADBE0003, kSpzGeoreference = 0x4E530001;  // types of extensions
inline constexpr std::uint64_t kSpzGeoreferenceBytes = 76;                                        // without its text
inline constexpr std::uint8_t kSpzAntialiased = 1, kSpzHasExtensions = 2;

struct SpzHeader {
  std::uint32_t version = 0, n = 0;
  std::uint8_t sh_degree = 0, fractional_bits = 0, flags = 0;

  bool is_antialiased() const { return (flags & kSpzAntialiased) != 0; }
  bool has_extensions() const { return (flags & kSpzHasExtensions) != 0; }
  std::uint64_t n_streams() const { return sh_degree == 0 ? kSpzStreams - 1 : kSpzStreams; }  ///< of version 4
  std::array<std::uint64_t, kSpzStreams> sizes() const;                                       ///< decoded bytes
  std::uint64_t decoded_bytes() const;                                                        ///< of all streams
};

struct SpzExtensions {
  struct Record {
    std::uint32_t type, bytes;
    const char* name;
    std::uint64_t at;  ///< of the payload in the records
  };
  std::optional<Axes> axes;  ///< declared, or implied by a georeference
  std::vector<Record> unused;
};

struct SpzLayout {
  struct Stream {
    std::uint64_t offset, stored_bytes, decoded_bytes;
  };
  SpzHeader header;
  SpzExtensions extensions;
  std::vector<Stream> streams;  ///< [n_streams()] of version 4, else [kSpzStreams]
};

/// The first 16 bytes, which are common to all versions; `in_gzip`: they come from a gzip stream. Offsets of errors are
/// those of the unpacked header. Errors: bad_magic, unsupported_version, unsupported_feature, bad_header, reserved_bits,
/// limit_exceeded.
Result<SpzHeader> parse_spz_header(std::span<const std::byte> bytes, const DecodeLimits& limits,
                                   std::uint64_t file_bytes, bool in_gzip);

/// The value of the coordinate system's record for these axes; 0: there is none.
std::uint32_t spz_coordinate_system(const Axes& axes);

/// `begin`: offset of the records in the file, or in the content of its gzip stream. Errors: truncated, bad_header,
/// bad_value; unsupported_feature for unknown types, unless they are to be skipped.
Result<SpzExtensions> parse_spz_extensions(std::span<const std::byte> records, std::uint64_t begin, bool skip_unknown);

/// A whole file of version 4, or the content of a gzip stream, in which streams are as they are decoded. Errors: those of
/// the two above; truncated, section_gap, size_mismatch, trailing_bytes.
Result<SpzLayout> spz_layout(std::span<const std::byte> bytes, const DecodeLimits& limits, std::uint64_t file_bytes,
                             bool in_gzip, bool skip_unknown = false);

}  // namespace rgs::detail
