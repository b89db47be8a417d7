// gsplat_arrays.hpp - the parameters of gsplat's training as arrays, from NumPy or PyTorch.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// An array [n, rows, channels] of floats; of fewer dimensions, [n] or [n, channels].
struct Array {
  std::vector<std::byte> bytes;
  std::uint64_t first = 0;  ///< byte of the first number
  std::uint64_t item_bytes = 4, n_dims = 0;
  std::array<std::uint64_t, 3> shape{}, stride{};  ///< strides in numbers

  double at(std::uint64_t i, std::uint64_t row, std::uint64_t channel) const;
};

enum Parameter : std::size_t { kMeans, kScales, kQuats, kOpacities, kConstantSh, kHigherSh };
inline constexpr std::array<const char*, 6> kParameterNames{"means", "scales", "quats", "opacities", "sh0", "shN"};
using Arrays = std::array<Array, kParameterNames.size()>;

/// Whether the array of that parameter has its shape; that of the means must be there already. Errors: bad_header,
/// limit_exceeded.
Status check_array(std::size_t parameter, const Arrays& arrays, const DecodeLimits& limits);

/// The scene of checked arrays, which a file of `stored` bytes holds. Without higher harmonics it has degree 0. Means
/// that FP32 cannot hold get an origin. Errors: limit_exceeded.
Result<SplatFile> scene_of(const Arrays& arrays, std::uint64_t stored, const DecodeLimits& limits);

}  // namespace rgs::detail
