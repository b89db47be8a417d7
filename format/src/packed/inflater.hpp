// inflater.hpp - decompresses exactly one Zstandard frame of a known size, as the format requires.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>

#include "rgs/result.hpp"

struct ZSTD_DCtx_s;

namespace rgs::detail {

/// Reuses Zstandard's memory from frame to frame.
class Inflater {
 public:
  /// Fills `out` from `stored`, exactly one Zstandard frame. Safe on untrusted bytes. Errors: corrupt_data at `offset`,
  /// the frame's; host_out_of_memory.
  Status inflate(std::span<const std::byte> stored, std::uint64_t offset, std::span<std::byte> out);

 private:
  struct Free {
    void operator()(ZSTD_DCtx_s* context) const;
  };
  std::unique_ptr<ZSTD_DCtx_s, Free> context_;
};

}  // namespace rgs::detail
