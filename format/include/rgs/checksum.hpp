// checksum.hpp - XXH3-64 (seed 0), whole or in pieces.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "rgs/api.hpp"

namespace RGS_API rgs {

std::uint64_t xxh3(std::span<const std::byte> bytes);

/// Hash of a stream fed in order.
class Hasher {
 public:
  Hasher();
  void update(std::span<const std::byte> bytes);
  std::uint64_t digest() const;

 private:
  alignas(64) std::array<std::byte, 1024> state_;  // xxHash's, in place to avoid an allocation
};

}  // namespace rgs
