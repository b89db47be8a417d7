// point_encode_absent.cpp - replaces point_encode.cpp in builds without Draco.
// SPDX-License-Identifier: Apache-2.0
#include "archive/point_codec.hpp"

namespace rgs::detail {

bool can_encode_points() {
  return false;
}

Result<std::vector<std::byte>> encode_points(std::span<const GridPoint>) {
  return make_error(Errc::unavailable, Error::kNone, "this build has no Draco");
}

}  // namespace rgs::detail
