// tie_order.hpp - launches that number a scene's Gaussians in tie order (rgs/math/tie_order.hpp), once for all frames.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/attributes.hpp"
#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Writes order [n], the Gaussians in tie order, and its inverse rank [n]: Gaussian i is number rank[i]. `temporary` has
/// tie_order_bytes(n). n < 2^31. Errors: device_failed.
struct TieOrderArguments {
  Attributes attributes;
  std::uint32_t n;
  std::uint32_t *order, *rank;
  void* temporary;
  std::uint64_t temporary_bytes;
};
Status launch_tie_order(const TieOrderArguments& arguments, Stream stream);
Result<std::uint64_t> tie_order_bytes(std::uint32_t n);

}  // namespace rgs::cuda
