// copy_pieces.hpp - the launch that copies pieces of page-locked memory to the device, all at once.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cassert>
#include <cstddef>
#include <cstdint>

#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// The copies of one launch, as a kernel's parameter.
struct Pieces {
  static constexpr std::uint32_t kMost = 64;
  /// Of each piece's addresses on host and device, and of its size.
  static constexpr std::size_t kAlignment = 16;

  const void* from[kMost];  ///< page-locked memory that the device reads under the host's addresses
  void* to[kMost];
  std::uint32_t bytes[kMost];
  std::uint32_t n = 0;

  /// n < kMost.
  void add(void* at, const void* source, std::size_t size) {
    assert(n < kMost);
    to[n] = at, from[n] = source, bytes[n] = static_cast<std::uint32_t>(size);
    ++n;
  }
};

/// Pieces do not overlap; n > 0. Errors: device_failed.
Status launch_copy_pieces(const Pieces& pieces, Stream stream);

}  // namespace rgs::cuda
