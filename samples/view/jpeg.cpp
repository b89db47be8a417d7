// jpeg.cpp - libjpeg-turbo's TurboJPEG.
// SPDX-License-Identifier: Apache-2.0
#include "jpeg.hpp"

#include <turbojpeg.h>

#include <memory>

namespace rgs::view {

Result<std::string> encode_jpeg(std::span<const std::uint8_t> rgb, int width, int height, int quality) {
  const std::unique_ptr<void, int (*)(tjhandle)> encoder(tjInitCompress(), tjDestroy);
  std::string file(tjBufSize(width, height, TJSAMP_420), '\0');
  auto* bytes = reinterpret_cast<unsigned char*>(file.data());
  unsigned long size = file.size();
  if (encoder == nullptr || tjCompress2(encoder.get(), rgb.data(), width, 0, height, TJPF_RGB, &bytes, &size,
                                        TJSAMP_420, quality, TJFLAG_NOREALLOC) != 0)
    return make_error(Errc::internal, Error::kNone, "the picture cannot be encoded as JPEG");
  file.resize(size);
  return file;
}

}  // namespace rgs::view
