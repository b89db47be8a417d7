// tie_order.hpp - launches that sort a scene's Gaussians in tie order (rgs/math/tie_order.hpp), once for all frames.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/attributes.hpp"
#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Writes order [n], the Gaussians in tie order, and its inverse rank [n]: Gaussian order[rank[i]] is i. `temporary`
/// has tie_order_bytes(n). n < 2^31. Errors: device_failed.
struct TieOrderArguments {
  Attributes attributes;
  std::uint32_t n;
  std::uint32_t *order, *rank;
  void* temporary;
  std::uint64_t temporary_bytes;
};
Status launch_tie_order(const TieOrderArguments& arguments, Stream stream);
/// For both launches.
Result<std::uint64_t> tie_order_bytes(std::uint32_t n);

/// Rows of some chunks: row j of chunk chunks[k] is drawn row k chunk_size + j.
struct ChosenRows {
  PagedAttributes attributes;
  const std::uint32_t* chunks;
};

/// The same for these rows. Errors: device_failed.
struct ChosenTiesArguments {
  ChosenRows rows;
  std::uint32_t n_chunks;  ///< n_chunks * chunk_size < 2^31
  /// [n_chunks * chunk_size] drawn rows in tie order, and their ranks in `rank`; if `rank` is null, rows of the scene.
  std::uint32_t *order, *rank;
  void* temporary;
  std::uint64_t temporary_bytes;  ///< tie_order_bytes()
};
Status launch_chosen_ties(const ChosenTiesArguments& arguments, Stream stream);

}  // namespace rgs::cuda
