// archive_codec.hpp - frames of Codec::archive: codes of Gaussians, their contexts, and the rows that they decode to;
// docs/format/ARCHIVE.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "archive/archive_kernels.hpp"
#include "archive/archive_tables.hpp"
#include "archive/point_codec.hpp"
#include "packed/codec_kernels.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Codes of a frame's Gaussians: planes of n numbers, one after the other.
struct FrameCodes {
  std::size_t n = 0;
  std::vector<std::uint8_t> classes, largest;  ///< [n]
  std::vector<std::uint16_t> opacity;          ///< [n]
  std::vector<std::int16_t> rotation, scale;   ///< [3, n]
  std::vector<std::int16_t> dc, sh;            ///< [3, n], [n_sh, n]

  void resize(std::size_t n_rows, std::size_t n_sh);
};

/// Magnitudes of each row's codes so far: the context of the next plane.
class CodeSizes {
 public:
  void reset(std::size_t n);
  void note(const std::int16_t* codes);
  std::size_t operator[](std::size_t i) const { return sizes_[i]; }

 private:
  std::vector<std::uint16_t> history_, sizes_;  // sizes: 0 to 7
};

constexpr std::size_t scale_bucket(std::int16_t code) {
  return static_cast<std::size_t>(std::clamp((code >> 2) + 8, 0, 15));
}

/// Passes every plane of GEOM with its contexts to coder.plane(), in stream order.
template <class Coder>
void walk_geometry(FrameCodes& f, const ArchiveTables& t, Coder& coder) {
  const std::size_t n = f.n, n_classes = t.parameters.classes.size();
  const std::uint32_t levels = t.parameters.opacity_levels;
  const ArchiveContexts at = t.contexts();
  const std::uint8_t* c = f.classes.data();
  coder.plane(n, f.classes.data(), static_cast<std::uint32_t>(n_classes - 1),
              [c](std::size_t i) { return i == 0 ? std::size_t{0} : std::size_t{c[i - 1]}; });
  coder.plane(n, f.opacity.data(), levels, [&](std::size_t i) { return at.opacity + c[i]; });
  coder.plane(n, f.largest.data(), 3, [&](std::size_t) { return at.largest; });
  for (std::size_t j = 0; j < 3; ++j) {
    coder.plane(n, &f.rotation[j * n], 0,
                [&](std::size_t i) { return at.rotation + (j * n_classes + c[i]) * 4 + f.largest[i]; });
  }
  std::int16_t *s0 = f.scale.data(), *s1 = s0 + n, *s2 = s1 + n;
  const auto by_opacity = [&](std::size_t i) {
    return std::size_t{c[i]} * 8 + std::size_t{f.opacity[i]} * 8 / (levels + 1);
  };
  coder.plane(n, s0, 0, [&](std::size_t i) { return at.scale0 + by_opacity(i); });
  coder.plane(n, s1, 0, [&](std::size_t i) { return at.scale1 + by_opacity(i) * 16 + scale_bucket(s0[i]); });
  coder.plane(n, s2, 0, [&](std::size_t i) {
    return at.scale2 + (std::size_t{c[i]} * 16 + scale_bucket(s0[i])) * 16 + scale_bucket(s1[i]);
  });
}

/// The same for SHI8, once classes are known.
template <class Coder>
void walk_sh(FrameCodes& f, const ArchiveTables& t, CodeSizes& sizes, Coder& coder) {
  const std::size_t n = f.n, n_classes = t.parameters.classes.size();
  const ArchiveContexts at = t.contexts();
  const auto planes = [&](std::vector<std::int16_t>& codes, std::size_t count, std::size_t first_context) {
    sizes.reset(n);
    for (std::size_t k = 0; k < count; ++k) {
      const std::size_t first = first_context + k * n_classes * 8;
      coder.plane(n, &codes[k * n], 0, [&](std::size_t i) { return first + std::size_t{f.classes[i]} * 8 + sizes[i]; });
      sizes.note(&codes[k * n]);
    }
  };
  planes(f.dc, 3, at.dc);
  planes(f.sh, t.n_sh, at.sh);
}

// ---- what codes stand for --------------------------------------------------------------------------------------------

/// Mean on one axis from its coordinate.
float grid_mean(const ArchiveParameters& p, std::size_t axis, std::uint32_t coordinate);
/// log2 of a scale in 1/65536, limited as the format prescribes; and the scale without `exponent`.
std::int32_t scale_octaves(const ArchiveClass& c, std::int16_t code);
struct OctaveScale {
  float significand;  ///< about 1 to 2
  int exponent;
};
OctaveScale scale_of_octaves(std::int32_t octaves);
void geometry_row(const ArchiveParameters& p, const FrameCodes& f, std::size_t i, int scale_exponent,
                  std::uint16_t row[8]);
/// (2 g + S) div (2 S) of docs/format/ARCHIVE.md "DC": the predicted code after two values.
std::int64_t expected_dc(const std::int16_t weights[2], std::int64_t before, std::int64_t before_that,
                         std::int64_t step);
/// DC values [3, n] in 1/65536.
void dc_values(const ArchiveTables& t, const FrameCodes& f, std::vector<std::int32_t>& values);

/// SH of 64 consecutive Gaussians: value [48][64], coefficient-major as in a row.
struct alignas(64) ShBlock {
  std::int16_t pairs[(kShMaxCodes / 2) * kShLanes * 2];
  std::int32_t sums[kShMaxCodes][kShLanes];
  float value[kShMaxCodes][kShLanes];
  float factor[kShLanes];
  ShLanes lanes;
};
/// Matrix of t with rows padded to an even length, for sh_block().
std::vector<std::int16_t> paired_matrix(const ArchiveTables& t);
/// Values of rows first .. first + count - 1, count <= 64.
void sh_block(const ArchiveTables& t, std::span<const std::int16_t> matrix, const FrameCodes& f,
              std::span<const std::int32_t> dc, std::size_t first, std::size_t count, ShBlock& block);

/// Decodes frames, one at a time. Safe on untrusted bytes. Errors: corrupt_data at `offset`, the frame's.
class ArchiveDecoder {
 public:
  explicit ArchiveDecoder(const ArchiveTables& tables) : tables_(tables), matrix_(paired_matrix(tables)) {}
  /// Rows [n, 12] of MEAN; `corner` is added to coordinates.
  Status means(std::span<const std::byte> stored, std::uint64_t offset, std::size_t n, std::span<std::byte> out,
               const GridPoint& corner = {});
  /// Codes of GEOM; call before the others.
  Status geometry_codes(std::span<const std::byte> stored, std::uint64_t offset, std::size_t n);
  /// Rows [n, 16] of GEOM.
  void geometry(int scale_exponent, std::span<std::byte> out);
  Status sh_codes(std::span<const std::byte> stored, std::uint64_t offset);
  /// Rows [n, sh_bytes] of SHI8; steps of each chunk of chunk_rows in the frame.
  void sh(int sh_degree, std::uint32_t chunk_rows, std::span<const ShStepSet> chunk_steps, std::span<std::byte> out);

  /// The same if chunks take the steps that their values need, which are written to `steps` [n_chunks, 48] bytes.
  void sh_and_steps(int sh_degree, std::uint32_t chunk_rows, std::span<std::byte> steps, std::span<std::byte> out);

  /// For codes that are known already.
  FrameCodes& codes() { return codes_; }

 private:
  const ArchiveTables& tables_;
  std::vector<std::int16_t> matrix_;
  FrameCodes codes_;
  CodeSizes sizes_;
  std::vector<GridPoint> points_;
  std::vector<float> means_;
  std::vector<std::int32_t> dc_;
  void store_block(std::size_t first, std::size_t count, std::size_t stride, std::span<std::byte> out);
  std::vector<float> values_;  // of a chunk's blocks, one after the other
  ShBlock block_{};            // zeros, since computations include the unused lanes of a short block
  GeometryLanes lanes_{};      // likewise
};

}  // namespace rgs::detail
