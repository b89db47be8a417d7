// jpeg.cpp - libjpeg-turbo's TurboJPEG.
// SPDX-License-Identifier: Apache-2.0
#include "jpeg.hpp"

#include <turbojpeg.h>

#include <algorithm>

namespace rgs::view {

JpegEncoder::JpegEncoder() : turbo_(tjInitCompress(), tjDestroy) {}

Result<std::string> JpegEncoder::encode(std::span<const std::uint8_t> rgb, int width, int height, int quality) {
  bytes_.resize(std::max<std::size_t>(bytes_.size(), tjBufSize(width, height, TJSAMP_420)));
  auto* bytes = bytes_.data();
  unsigned long size = bytes_.size();
  if (turbo_ == nullptr || tjCompress2(turbo_.get(), rgb.data(), width, 0, height, TJPF_RGB, &bytes, &size, TJSAMP_420,
                                       quality, TJFLAG_NOREALLOC) != 0)
    return make_error(Errc::internal, Error::kNone, "the picture cannot be encoded as JPEG");
  return std::string(bytes_.begin(), bytes_.begin() + static_cast<std::ptrdiff_t>(size));
}

}  // namespace rgs::view
