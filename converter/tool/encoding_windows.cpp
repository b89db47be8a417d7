// encoding_windows.cpp - base64 and SHA-256 by Windows itself.
// SPDX-License-Identifier: Apache-2.0
#define NOMINMAX
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
// After windows.h:
#include <bcrypt.h>
#include <wincrypt.h>

#include "encoding.hpp"

namespace rgs::tool {

std::string base64(std::span<const std::byte> bytes) {
  std::string text((bytes.size() + 2) / 3 * 4 + 1, '\0');
  auto size = static_cast<DWORD>(text.size());  // with a zero at the end, then without
  ::CryptBinaryToStringA(reinterpret_cast<const BYTE*>(bytes.data()), static_cast<DWORD>(bytes.size()),
                         CRYPT_STRING_BASE64 | CRYPT_STRING_NOCRLF, text.data(), &size);
  text.pop_back();
  return text;
}

std::array<std::byte, 32> sha256(std::string_view text) {
  std::array<std::byte, 32> digest{};
  BCRYPT_ALG_HANDLE algorithm = nullptr;
  ::BCryptOpenAlgorithmProvider(&algorithm, BCRYPT_SHA256_ALGORITHM, nullptr, 0);
  ::BCryptHash(algorithm, nullptr, 0, reinterpret_cast<UCHAR*>(const_cast<char*>(text.data())),
               static_cast<ULONG>(text.size()), reinterpret_cast<UCHAR*>(digest.data()),
               static_cast<ULONG>(digest.size()));
  ::BCryptCloseAlgorithmProvider(algorithm, 0);
  return digest;
}

}  // namespace rgs::tool
