// inflater.cpp - Zstandard's library after a check of the frame's extent.
// SPDX-License-Identifier: Apache-2.0
#include "packed/inflater.hpp"

#include <zstd.h>
#include <zstd_errors.h>

#include <algorithm>
#include <array>

#include "rgs/guard_memory.hpp"

namespace rgs::detail {

void Inflater::Free::operator()(ZSTD_DCtx_s* context) const {
  ZSTD_freeDCtx(context);
}

Status Inflater::inflate(std::span<const std::byte> stored, std::uint64_t offset, std::span<std::byte> out) {
  if (!context_) context_.reset(ZSTD_createDCtx());
  if (!context_) return out_of_memory();
  constexpr std::array kMagicBytes = {std::byte{0x28}, std::byte{0xB5}, std::byte{0x2F}, std::byte{0xFD}};
  const bool one_frame = stored.size() >= kMagicBytes.size() &&  // no skippable or legacy frame
                         std::ranges::equal(stored.first(kMagicBytes.size()), kMagicBytes) &&
                         ZSTD_findFrameCompressedSize(stored.data(), stored.size()) == stored.size();
  if (!one_frame) return make_error(Errc::corrupt_data, offset, "a frame is not one Zstandard frame");
  const std::size_t found = ZSTD_decompressDCtx(context_.get(), out.data(), out.size(), stored.data(), stored.size());
  if (ZSTD_getErrorCode(found) == ZSTD_error_memory_allocation) return out_of_memory();
  if (ZSTD_isError(found) != 0) return make_error(Errc::corrupt_data, offset, "a frame cannot be decompressed");
  if (found != out.size()) {
    return make_error(Errc::corrupt_data, offset, "a frame's content has the wrong size", out.size(), found);
  }
  return {};
}

}  // namespace rgs::detail
