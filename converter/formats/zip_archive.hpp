// zip_archive.hpp - zip archives in memory.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/result.hpp"

struct zip;

namespace rgs::detail {

class ZipArchive {
 public:
  /// `bytes` must outlive it. Errors: bad_header.
  static Result<ZipArchive> open(std::span<const std::byte> bytes);

  std::vector<std::string> names() const;
  /// The first name with that ending; empty if there is none.
  std::string name_ending(std::string_view ending) const;
  bool holds(const std::string& name) const;
  /// A whole entry. Errors: missing_section with the text `missing`, limit_exceeded, checksum_mismatch.
  Result<std::vector<std::byte>> read(const std::string& name, const DecodeLimits& limits, const char* missing) const;

 private:
  struct Discard {
    void operator()(zip* archive) const;
  };
  ZipArchive(zip* archive, std::uint64_t bytes) : archive_(archive), bytes_(bytes) {}
  std::unique_ptr<zip, Discard> archive_;
  std::uint64_t bytes_;
};

/// An archive of these entries, by name, stored without compression, each at a multiple of `alignment` bytes.
/// Deterministic.
std::vector<std::byte> zip_stored(std::span<const std::pair<std::string, std::vector<std::byte>>> entries,
                                  std::uint64_t alignment = 1);

}  // namespace rgs::detail
