// inflater.hpp - Zstandard frames as the format has them: exactly one, of a size that is known.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>

#include "rgs/result.hpp"

struct ZSTD_DCtx_s;

namespace rgs::detail {

/// Keeps Zstandard's memory from one frame to the next.
class Inflater {
 public:
  /// Fills `out` from `stored`, one Zstandard frame without anything around it. Safe on untrusted bytes. Errors:
  /// corrupt_data at `offset`, the frame's place in the file; host_out_of_memory.
  Status inflate(std::span<const std::byte> stored, std::uint64_t offset, std::span<std::byte> out);

 private:
  struct Free {
    void operator()(ZSTD_DCtx_s* context) const;
  };
  std::unique_ptr<ZSTD_DCtx_s, Free> context_;
};

}  // namespace rgs::detail
