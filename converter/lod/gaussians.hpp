// gaussians.hpp - activated Gaussians, an array per parameter, for the builder of levels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/splat_cloud.hpp"

namespace rgs::lod {

/// Indices of the arrays. Harmonics follow from kSh, coefficients before channels.
enum Value : int { kMean = 0, kScale = 3, kRotation = 6, kOpacity = 10, kSh = 11 };

/// n Gaussians: arrays [n] of 11 parameters and 3 (degree + 1)^2 harmonics. Scales and opacity are activated, rotations
/// unit quaternions w, x, y, z. Each array is padded to a multiple of 8 with invisible Gaussians.
class Gaussians {
 public:
  Gaussians() = default;
  Gaussians(std::size_t n, int sh_degree) { resize(n, sh_degree); }
  void resize(std::size_t n, int sh_degree);

  std::size_t size() const { return n_; }
  std::size_t padded() const { return stride_; }
  int sh_degree() const { return sh_degree_; }
  int n_values() const { return kSh + 3 * sh_coefficients(sh_degree_); }
  float* of(int value) { return values_.data() + static_cast<std::size_t>(value) * stride_; }
  const float* of(int value) const { return values_.data() + static_cast<std::size_t>(value) * stride_; }

 private:
  std::size_t n_ = 0, stride_ = 0;
  int sh_degree_ = 0;
  std::vector<float> values_;
};

/// activate() converts parameters of training, with means relative to `centre` and harmonics up to `most_degree`;
/// append() converts back. It rounds harmonics to FP16: a file has 8 bits of them, and scratch files shrink by a third.
Gaussians activate(const SplatView& splats, std::uint64_t first, std::uint64_t n, const float centre[3],
                   int most_degree = kMaxShDegree);
void append(const Gaussians& gaussians, const float centre[3], SplatCloud& out);

/// Rows `items`, in this order.
Gaussians subset(const Gaussians& gaussians, std::span<const std::uint32_t> items);
/// Longest side of the box of the means.
float extent(const Gaussians& gaussians);

/// World units. Farther or larger Gaussians are not simplified: costs are fourth powers, and FP32 ends at 3.4e38.
inline constexpr float kFarAway = 1e9F;
/// Whether Gaussian `i` is farther than kFarAway from `centre` on an axis, or larger.
bool is_far(const SplatView& splats, std::uint64_t i, const float centre[3]);
/// Median of the means of Gaussians from .. from + n - 1 on each axis, n > 0.
void find_middle(const SplatView& splats, std::uint64_t from, std::uint64_t n, float middle[3]);

}  // namespace rgs::lod
