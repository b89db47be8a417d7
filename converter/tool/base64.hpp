// base64.hpp - base64 (RFC 4648, section 4). Programs that use it link OpenSSL::Crypto.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <openssl/evp.h>

#include <cstddef>
#include <span>
#include <string>

namespace rgs::tool {

/// At most 2^30 bytes.
inline std::string base64(std::span<const std::byte> bytes) {
  std::string text((bytes.size() + 2) / 3 * 4, '\0');
  EVP_EncodeBlock(reinterpret_cast<unsigned char*>(text.data()), reinterpret_cast<const unsigned char*>(bytes.data()),
                  static_cast<int>(bytes.size()));
  return text;
}

}  // namespace rgs::tool
