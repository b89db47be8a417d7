// workspace_growth.hpp - how much memory to ask for when a frame does not fit the workspace.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>

#include "rgs/result.hpp"

namespace rgs::detail {

/// Half as much again as `held`, so that a camera that approaches a scene does not allocate in every frame, but at
/// least `needed` and at most `limit` (>= needed).
constexpr std::uint64_t with_room_to_grow(std::uint64_t needed, std::uint64_t held, std::uint64_t limit) {
  return std::min(std::max(needed, held + held / 2), limit);
}

/// reserve(true) asks for room to grow; if memory does not suffice, reserve(false) asks for what the frame needs. A
/// failed reserve() must undo whatever the next call would rely on. Errors: those of the last call.
template <class Reserve>
Status reserve_growing(const Reserve& reserve) {
  const Status ok = reserve(true);
  if (ok || ok.error().code != Errc::device_out_of_memory) return ok;
  return reserve(false);
}

}  // namespace rgs::detail
