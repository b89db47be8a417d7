// decode.hpp - reading .rgs files: open a view, read ranges of Gaussians, validate.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs {

/// Bounds that a caller puts on files he does not trust; more is limit_exceeded.
struct DecodeLimits {
  std::uint64_t max_file_bytes = std::uint64_t{1} << 40;
  std::uint64_t max_gaussians = std::uint64_t{1} << 33;
};

/// One Gaussian as the renderer wants it.
struct ActivatedSplat {
  float mean[3];      ///< world units
  float rotation[4];  ///< unit quaternion w, x, y, z
  float scale[3];     ///< standard deviations, world units
  float opacity;      ///< [0, 1]
  float sh[3 * 16];   ///< [16, 3] coefficient-major; unused degrees are 0
};

/// An opened file: its parsed head over the caller's bytes, which must outlive the view. Reading is thread-safe.
class FileView {
 public:
  const Header& header() const { return header_; }
  const Declarations& declarations() const { return declarations_; }
  const std::optional<Provenance>& provenance() const { return provenance_; }
  const std::vector<SectionEntry>& sections() const { return sections_; }
  std::span<const std::byte> bytes() const { return bytes_; }

  const SectionEntry* find(SectionType type) const;
  /// Stored bytes of a section; empty if the file has none of that type.
  std::span<const std::byte> stored(SectionType type) const;
  std::span<const std::byte> stored(const SectionEntry& entry) const {
    return bytes_.subspan(entry.offset, entry.stored_bytes);
  }

  /// Entry of chunk `i` < n_chunks. Errors: reserved_bits, bad_value, with the offset in the file.
  Result<ChunkEntry> chunk(std::uint64_t i) const;
  /// SH steps `i` < n_scale_sets. Errors: bad_value.
  Result<ScaleSet> scale_set(std::uint64_t i) const;
  /// Position in the source of Gaussian `i`; `i` itself if the file keeps no permutation.
  std::uint64_t source_index(std::uint64_t i) const;

  /// Gaussians first .. first + out.size() - 1 in the parameters of training. Stored opacities of 0 and 1 and scales of
  /// 0 get finite logits and logarithms that encode to the same codes again.
  /// Errors: those of chunk() and scale_set(); values are not checked otherwise, see validate().
  Status read(std::uint64_t first, std::span<Splat> out) const;
  Status read(std::uint64_t first, std::span<ActivatedSplat> out) const;

 private:
  friend Result<FileView> open(std::span<const std::byte> bytes, const DecodeLimits& limits);
  template <class T, class Convert>
  Status read_as(std::uint64_t first, std::span<T> out, Convert convert) const;

  std::span<const std::byte> bytes_;
  Header header_;
  Declarations declarations_;
  std::optional<Provenance> provenance_;
  std::vector<SectionEntry> sections_;
};

/// Parses and checks the head of a file: everything but the payload of the large sections, which is not touched, so
/// that opening a mapped file costs a few pages. Safe on untrusted bytes. Errors: truncated, bad_magic,
/// unsupported_version, reserved_bits, bad_header, bad_section, section_overlap, section_gap, trailing_bytes,
/// checksum_mismatch, missing_section, duplicate_section, unknown_required, unsupported_codec, size_mismatch,
/// limit_exceeded, bad_value; the offset says where.
Result<FileView> open(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

/// Checks the payload: every checksum, every stored value against its legal range, tables against what they describe.
/// After success read() cannot fail. Reads the whole file; takes 8 bytes a Gaussian if there is a permutation.
Status validate(const FileView& view);

/// open(), validate() and all Gaussians in memory.
Result<SplatCloud> decode(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

}  // namespace rgs
