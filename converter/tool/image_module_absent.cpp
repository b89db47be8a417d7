// image_module_absent.cpp - replaces image_module.cpp on Windows, for which no OpenImageIO is built.
// SPDX-License-Identifier: Apache-2.0
#include "image_codec.hpp"

namespace rgs {

Result<const ImageCodec*> load_image_module() {
  return make_error(Errc::unavailable, Error::kNone, "on Windows pictures are PNG and JPEG only");
}

}  // namespace rgs
