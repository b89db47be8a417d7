// fuzz_cameras.cpp - camera readers on arbitrary bytes: an error, or cameras that are all valid.
// SPDX-License-Identifier: Apache-2.0
//
// The first byte chooses the reader (j JSON, b COLMAP binary, t COLMAP text). A COLMAP model is two files: the next
// four bytes, little-endian, are the first one's size.
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <span>

#include "rgs/camera_file.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 1) return 0;
  const auto rest = std::as_bytes(std::span(data, size)).subspan(1);
  const auto text = [](std::span<const std::byte> bytes) {
    return std::string_view(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  };
  rgs::Result<rgs::CameraSet> set;
  if (data[0] == 'j') {
    set = rgs::parse_camera_json(text(rest));
  } else {
    if (rest.size() < 4) return 0;
    std::uint32_t first = 0;
    for (unsigned i = 0; i < 4; ++i) first |= std::uint32_t{data[1 + i]} << (8 * i);
    const auto files = rest.subspan(4);
    if (first > files.size()) return 0;
    const auto cameras = files.first(first), images = files.subspan(first);
    set = data[0] == 't' ? rgs::parse_colmap_text(text(cameras), text(images))
                         : rgs::parse_colmap_binary(cameras, images);
  }
  if (!set) {
    if (*set.error().what == '\0') std::abort();
    return 0;
  }
  if (set->cameras.empty() || set->split.size() != set->cameras.size()) std::abort();
  for (const rgs::Camera& camera : set->cameras)
    if (!rgs::validate(camera)) std::abort();
  return 0;
}
