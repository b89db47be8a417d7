// archive_kernels.hpp - inner loops of the archive decoder, compiled for several instruction sets;
// docs/format/ARCHIVE.md "Rows".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "packed/codec_kernels.hpp"

namespace rgs::detail {

/// Codes of 64 Gaussians' geometry, with the steps of their classes.
struct alignas(64) GeometryLanes {
  std::int16_t rotation[3][kShLanes], scale[3][kShLanes];
  std::uint16_t opacity[kShLanes];
  std::int32_t largest[kShLanes], scale_base[kShLanes];
  std::uint32_t scale_step[kShLanes];
  float rotation_step[kShLanes];
};

struct MeanGrid {
  std::uint32_t bits = 0, cells = 0;
  double centre = 0, half_width = 0;
};

struct ArchiveKernels {
  /// Updates history [n] and sizes [n] of rows by one more code each.
  void (*note)(const std::int16_t* codes, std::size_t n, std::uint16_t* history, std::uint16_t* sizes);
  /// means[i * stride] from coordinates[i * stride].
  void (*means)(const MeanGrid& grid, const std::uint32_t* coordinates, std::size_t n, std::size_t stride,
                float* means);
  /// rows [64][8]; opacity_levels as in ARCH.
  void (*geometry)(const GeometryLanes& lanes, std::uint32_t opacity_levels, int scale_exponent, std::uint16_t* rows);
  /// pairs [64][2] from `count` codes each; `odd` may be null.
  void (*pair)(const std::int16_t* even, const std::int16_t* odd, int count, std::int16_t* pairs);
  /// DC: value [64] from the sum of matrix[m] * dc[m * stride + i] over 3 m.
  void (*dc)(const std::int16_t* matrix, const std::int32_t* dc, std::size_t stride, float centre, int count,
             float* value);
  /// Codes of SH above degree 0, planes [n_planes][stride], become values: each its code times its row's step plus what
  /// the rows before predict. state [48] goes on from call to call; at most 64 rows.
  void (*smooth)(std::int16_t* planes, std::size_t stride, int n_planes, const std::int32_t* steps, int count,
                 std::int32_t recent, std::int32_t kept, std::int32_t* state);
  /// value [n][64] = sums [n][64] * factor [64] + centre [n].
  void (*sh)(const std::int32_t* sums, const float* factor, const float* centre, int n, float* value);
  /// most [n]: at least the largest magnitude of the first `count` of value [n][64].
  void (*largest)(const float* value, int n, int count, float* most);
  /// codes [n][64] from value [n][64] with step [n].
  void (*quantize)(const float* value, const float* step, int n, std::int8_t* codes);
};

/// For this machine. All give the same bits.
const ArchiveKernels& archive_kernels();

}  // namespace rgs::detail
