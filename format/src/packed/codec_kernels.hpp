// codec_kernels.hpp - inner loops of the codec, compiled for several instruction sets: SH of 64 Gaussians at once.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "rgs/planes.hpp"

namespace rgs::detail {

inline constexpr int kShMaxCodes = 48;

/// Weights of a frame's predictor, times 2^15: code i has weights[i * (i - 1) / 2 + j] for the Gaussian's codes j < i,
/// and carry[i] for its own error one row before.
struct ShWeights {
  int n = 0;  ///< codes a Gaussian: 3, 12, 27, 48
  std::int16_t weights[kShMaxCodes * (kShMaxCodes - 1) / 2] = {};
  std::int16_t carry[kShMaxCodes] = {};
};

/// 64 Gaussians side by side. Code i is coefficient i / 3 in channel sh_channel(i).
struct alignas(64) ShLanes {
  std::int16_t value[kShMaxCodes][kShLanes];  ///< code times step
  std::int16_t error[kShMaxCodes][kShLanes];  ///< half the value less its prediction, of the row before
  std::int16_t step[12][kShLanes];            ///< by degree and channel: 0 to 256
  std::int16_t inverse[12][kShLanes];         ///< sh_inverse_step(step)
  std::int8_t codes[kShMaxCodes][kShLanes];   ///< in the order of a row: 3 * coefficient + channel
};

struct CodecKernels {
  /// residual [n][stride]: byte planes, of which 64 are read; writes codes, updates value and error.
  void (*decode)(ShLanes& lanes, const ShWeights& weights, const std::uint8_t* residual, std::size_t stride);
  /// The inverse.
  void (*encode)(ShLanes& lanes, const ShWeights& weights, std::uint8_t* residual, std::size_t stride);
  /// Stores rows of n codes, of `count` lanes, at rows + lane * lane_bytes.
  void (*store)(const ShLanes& lanes, int n, int count, std::int8_t* rows, std::size_t lane_bytes);
  /// w of unit quaternions as FP16 from x, y, z: byte planes xyz [6][stride], low byte first, of which `count` are
  /// read. 0 if there is none.
  void (*unit_w)(const std::uint8_t* xyz, std::size_t stride, int count, std::uint16_t* w);
  /// sums [n_out][64] of matrix [n_out][2 n_pairs] times codes: pairs [n_pairs][64][2], two numbers of each of 64
  /// Gaussians side by side. Mod 2^32.
  void (*mix)(const std::int16_t* pairs, const std::int16_t* matrix, int n_pairs, int n_out, std::int32_t* sums);
  /// same [n][n] += a a^T, lagged [n][n] += a b^T.
  void (*correlate)(const float* a, const float* b, int n, float* same, float* lagged);
};

/// For this machine. All give the same bits.
const CodecKernels& codec_kernels();

}  // namespace rgs::detail
