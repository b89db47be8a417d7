// fuzz_interchange.cpp - arbitrary bytes, read as one format, are an error or a scene, and the scene survives writing.
// One target per reader; RGS_FUZZ_FORMAT names it.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <span>

#include "check_levels.hpp"
#include "rgs/encode.hpp"
#include "rgs/interchange.hpp"
#include "rgs/splat_edit.hpp"

namespace {

constexpr rgs::SplatFormat kFormat = rgs::SplatFormat::RGS_FUZZ_FORMAT;

void require(bool condition) {
  if (!condition) std::abort();
}

void check_writer(rgs::SplatCloud cloud) {
  rgs::EncodeOptions options;
  options.max_bad_fraction = 1;
  require(rgs::clean_splats(cloud, options).has_value());
  if (kFormat == rgs::SplatFormat::sog && cloud.size() == 0) return;  // which it cannot hold
  const auto bytes = rgs::encode_splats(cloud.view(), kFormat);
  if (!bytes) {
    require(kFormat == rgs::SplatFormat::spz && bytes.error().code == rgs::Errc::bad_value);  // a mean out of range
    return;
  }
  const auto again = rgs::read_splats(*bytes, {{}, kFormat, true});
  require(again && again->cloud.size() == cloud.size() && again->cloud.sh_degree <= cloud.sh_degree);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto bytes = std::as_bytes(std::span(data, size));
  const auto file = rgs::read_splats(bytes, {{}, kFormat, true});
  if (!file) {
    require(rgs::exit_code(file.error().code) == 4 && file.error().what[0] != '\0');
    return 0;
  }
  require(file->format == kFormat && file->cloud.view().consistent());
  require(file->cloud.size() <= 1032 * size / 16 + (1u << 20));  // every format spends at least 16 bytes unpacked
  if (kFormat == rgs::SplatFormat::rad || kFormat == rgs::SplatFormat::ssog)
    rgs::test::check_levels(bytes, "no folder", file->cloud.size());
  // Streamed SOG is written from levels.
  if (rgs::format_info(kFormat).writable && kFormat != rgs::SplatFormat::ssog) check_writer(file->cloud);
  return 0;
}
