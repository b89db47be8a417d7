// url_source_absent.cpp - replaces url_source.cpp in builds without libcurl.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/byte_source.hpp"

namespace rgs {

Result<std::unique_ptr<ByteSource>> open_url_source(const std::string&, const UrlOptions&) {
  return make_error(Errc::unavailable, Error::kNone,
                    "this build cannot read web addresses; download the file, or build with RGS_ENABLE_HTTP=ON");
}

}  // namespace rgs
