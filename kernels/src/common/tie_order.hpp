// tie_order.hpp - launches that number a scene's Gaussians in tie order (rgs/math/tie_order.hpp), once for all frames.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/attributes.hpp"
#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Writes rank [n]: rank[i] is the place of Gaussian i in tie order, 0 .. n - 1. `temporary` has tie_order_bytes(n) and is
/// aligned to 256 bytes. n < 2^31. Errors: device_failed.
struct TieOrderArguments {
  Attributes attributes;
  std::uint32_t n;
  std::uint32_t* rank;
  void* temporary;
  std::uint64_t temporary_bytes;
};
Status launch_tie_order(const TieOrderArguments& arguments, Stream stream);
Result<std::uint64_t> tie_order_bytes(std::uint32_t n);

/// Writes inverse [n] of a permutation [n]: inverse[permutation[k]] = k. Errors: device_failed.
Status launch_inverse(const std::uint32_t* permutation, std::uint32_t n, std::uint32_t* inverse, Stream stream);

}  // namespace rgs::cuda
