// checksum.hpp - XXH3-64 (seed 0), whole or in pieces.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
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
  struct Free {
    void operator()(void* state) const;
  };
  std::unique_ptr<void, Free> state_;
};

}  // namespace rgs
