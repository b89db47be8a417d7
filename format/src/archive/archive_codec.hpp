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
#include "archive/shape_codec.hpp"
#include "packed/codec_kernels.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Codes of a frame's SH: planes of n numbers, one after the other.
struct ColourCodes {
  std::size_t n = 0;
  std::vector<std::uint8_t> classes;  ///< [n]
  std::vector<std::int16_t> dc, sh;   ///< [3, n], [n_sh, n]

  void resize(std::size_t n_rows, std::size_t n_sh);
};

/// Of geometry with Codec::archive_draco.
struct GeometryCodes {
  std::size_t n = 0;
  std::vector<std::uint8_t> classes;            ///< [n]
  std::vector<std::uint16_t> opacity, largest;  ///< [n]
  std::vector<std::int16_t> rotation, scale;    ///< [3, n]

  void resize(std::size_t n_rows);
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

/// Passes every plane of GEOM of Codec::archive_draco with its contexts to coder.plane(), in stream order.
template <class Coder>
void walk_geometry(GeometryCodes& f, const ArchiveTables& t, Coder& coder) {
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

/// Those of SHI8, once classes are known.
template <class Coder>
void walk_sh(ColourCodes& f, const ArchiveTables& t, CodeSizes& sizes, Coder& coder) {
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

/// (2 g + S) div (2 S) of docs/format/ARCHIVE.md "Rows of SHI8 of codec 2": the predicted code after two values.
std::int64_t expected_dc(const std::int16_t weights[2], std::int64_t before, std::int64_t before_that,
                         std::int64_t step);
/// Codes of SH above degree 0 become values, in units of the file. Codec::archive.
void smooth_sh(const ArchiveTables& t, ColourCodes& f);
/// DC values [3, n] in 1/65536.
void dc_values(const ArchiveTables& t, const ColourCodes& f, std::vector<std::int32_t>& values);

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
void sh_block(const ArchiveTables& t, std::span<const std::int16_t> matrix, const ColourCodes& f,
              std::span<const std::int32_t> dc, std::size_t first, std::size_t count, ShBlock& block);

/// The streams of a frame's MEAN, GEOM and SHI8, and their offsets in the file.
struct FrameStreams {
  struct Stream {
    std::span<const std::byte> bytes;
    std::uint64_t offset = 0;
  };
  Stream means, geometry, sh;
  bool one = false;  ///< a page of Codec::archive, all in `means`
};

/// Decodes frames, one at a time. Safe on untrusted bytes. Errors: corrupt_data at the stream's offset.
class ArchiveDecoder {
 public:
  explicit ArchiveDecoder(const ArchiveTables& tables) : tables_(tables), matrix_(paired_matrix(tables)) {}
  /// The first step: all codes. Of a page: its level and corner, which is added to the cells of means.
  Status codes(const FrameStreams& streams, std::size_t n, int level = 0, const GridPoint& corner = {});
  /// Rows [n, 12] of MEAN and [n, 16] of GEOM.
  void rows(int scale_exponent, std::span<std::byte> means, std::span<std::byte> geometry);
  /// Rows [n, sh_bytes] of SHI8; steps of each chunk of chunk_rows in the frame.
  void sh(int sh_degree, std::uint32_t chunk_rows, std::span<const ShStepSet> chunk_steps, std::span<std::byte> out);

  /// The same if chunks take the steps that their values need, which are written to `steps` [n_chunks, 48] bytes.
  void sh_and_steps(int sh_degree, std::uint32_t chunk_rows, std::span<std::byte> steps, std::span<std::byte> out);

  std::span<const std::uint8_t> classes() const { return colours_.classes; }

 private:
  Status tree_codes(FrameStreams::Stream means, RansReader& reader);
  void draco_geometry(int scale_exponent, std::span<std::byte> out);
  void store_block(std::size_t first, std::size_t count, std::size_t stride, std::span<std::byte> out);

  const ArchiveTables& tables_;
  std::vector<std::int16_t> matrix_;
  ColourCodes colours_;
  CodeSizes sizes_;
  ShapeCodes shapes_;  // archive_draco: points alone
  PointTree tree_;
  GeometryCodes geometry_;  // archive_draco
  std::vector<float> means_;
  std::vector<std::uint16_t> geometry_rows_;
  std::vector<std::int32_t> dc_;
  std::vector<float> values_;  // of a chunk's blocks, one after the other
  ShBlock block_{};            // zeros, since computations include the unused lanes of a short block
  GeometryLanes lanes_{};      // likewise
};

}  // namespace rgs::detail
