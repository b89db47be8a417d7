// fuzz_archive.cpp - arbitrary bytes behind the checksums of both archive codecs: Draco's streams, entropy-coded streams
// and section ARCH.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <span>
#include <vector>

#include "archive/archive_codec.hpp"
#include "archive/point_codec.hpp"

namespace {

using namespace rgs::detail;

void require(bool condition) {
  if (!condition) std::abort();
}

// A Draco stream of n points without its kd-tree.
std::vector<std::byte> point_head(std::uint32_t n, std::uint32_t bits) {
  constexpr char kDraco[] = "DRACO\2\3\0\1\0\0", kAttribute[] = "\1\1\0\6\3\0\0\6";
  std::vector<std::byte> head(31);
  std::memcpy(head.data(), kDraco, 11);
  std::memcpy(head.data() + 11, &n, 4);
  std::memcpy(head.data() + 15, kAttribute, 8);
  std::memcpy(head.data() + 23, &bits, 4);
  std::memcpy(head.data() + 27, &n, 4);
  return head;
}

// The head is correct, so that every input reaches the kd-tree.
void decode_draco(std::span<const std::byte> bytes) {
  if (bytes.size() < 4) return;
  std::uint16_t count;
  std::memcpy(&count, bytes.data(), sizeof count);
  const std::uint32_t n = count % 1000u + 1, max_bits = static_cast<std::uint32_t>(bytes[2]) % 28 + 1;
  std::vector<std::byte> stream = point_head(n, static_cast<std::uint32_t>(bytes[3]) % (max_bits + 1));
  stream.insert(stream.end(), bytes.begin() + 4, bytes.end());
  std::vector<GridPoint> points(n);
  static_cast<void>(decode_points(stream, 0, max_bits, points));
}

// Tables that are not fitted: every distribution is flat. Four bytes choose the rest.
ArchiveTables flat_tables(rgs::Codec codec, std::span<const std::byte> bytes) {
  ArchiveTables t;
  t.n_sh = archive_sh_count(static_cast<int>(bytes[0]) & 3);
  rgs::ArchiveParameters& p = t.parameters;
  p.codec = codec;
  p.mean_cells = 19;
  p.mean_bits = 28;
  p.opacity_levels = 64;
  p.classes.resize(static_cast<std::size_t>(bytes[1]) % rgs::kMaxArchiveClasses + 1);
  for (rgs::ArchiveClass& c : p.classes) {
    c.rotation_step = 1.f / 64;
    c.scale_step = 1u << 20;
    c.scale_base = -(1 << 23);
    c.dc_step = static_cast<std::uint32_t>(bytes[2]) << 18 | 1u;
    c.sh_step = 0x1p40f;
    c.sh_units = static_cast<std::uint32_t>(bytes[2]) << 7 | 1u;
  }
  // Steps of every size, and their ends.
  const auto octaves = [](std::byte b) { return (static_cast<std::int32_t>(b) - 128) * (1 << 17); };
  p.shape = {.nearest = std::ldexp(1.0, static_cast<int>(bytes[2]) * 5 - 1000),
             .blur = octaves(bytes[1]) / 4,
             .coarse_step = (1 << 20) - static_cast<std::int32_t>(bytes[0]) * 4000,
             .fine_step = octaves(bytes[0]),
             .turn_step = octaves(bytes[1]),
             .mean_step = octaves(bytes[2]),
             .middle = octaves(bytes[3]),
             .slope = static_cast<std::int32_t>(bytes[3]) << 8};
  t.opacity.assign(p.opacity_levels + 1, 0x3C00);
  t.opacity[0] = 1;
  t.dc_matrix.fill(32767);
  t.dc_weights.fill(-32768);
  t.sh_unit = 0x1p40f;
  t.dc_smoothing = {1, 254};
  t.sh_smoothing = {static_cast<std::uint8_t>(bytes[3]), static_cast<std::uint8_t>(255 - static_cast<int>(bytes[3]))};
  t.sh_centre.resize(t.n_sh);
  t.sh_matrix.assign(t.n_sh * t.n_sh, -32768);
  t.map.resize(t.contexts().count);
  for (std::size_t i = 0; i < t.map.size(); ++i) t.map[i] = static_cast<std::uint8_t>(i % 2);
  t.frequencies.assign(2 * kRansTokens, 4096 / kRansTokens);
  t.frequencies[0] += 4096 % kRansTokens;
  t.frequencies[2 * kRansTokens - 1] += 4096 % kRansTokens;
  require(t.rans.assign(t.frequencies));
  return t;
}

void decode_rows(ArchiveDecoder& decoder, int degree, std::size_t n) {
  std::vector<std::byte> means(12 * n), rows(48 * n);
  decoder.rows(10, means, std::span(rows).first(16 * n));
  for (std::size_t i = 0; i < 3 * n; ++i) {
    float mean;
    std::memcpy(&mean, means.data() + 4 * i, sizeof mean);
    require(std::isfinite(mean));
  }
  rgs::ShStepSet set;
  for (auto& steps : set.step) std::ranges::fill(steps, 0.25f);
  decoder.sh(degree, 1u << 16, {&set, 1}, std::span(rows).first(rgs::sh_bytes(degree) * n));
}

// A page: codes are decoded whatever the stream, if its points are.
void decode_page(std::span<const std::byte> bytes) {
  if (bytes.size() < 8) return;
  const ArchiveTables t = flat_tables(rgs::Codec::archive, bytes);
  const std::size_t n = static_cast<std::size_t>(bytes[3]) % 80 + 1;
  std::vector<std::byte> stream(bytes.begin() + 4, bytes.end());
  for (std::size_t k = 0; k < 3; ++k) stream[k] = static_cast<std::byte>(static_cast<unsigned>(stream[k]) % 29);
  stream[3] = {};
  const auto decoder = std::make_unique<ArchiveDecoder>(t);
  static_cast<void>(decoder->codes({{stream, 0}, {}, {}}, n, static_cast<int>(bytes[0]) >> 2));
  decode_rows(*decoder, static_cast<int>(bytes[0]) & 3, n);
}

// Frames of Codec::archive_draco: the bytes are those of GEOM, or of SHI8 behind others of zeros.
void decode_frames(std::span<const std::byte> bytes) {
  if (bytes.size() < 4) return;
  const ArchiveTables t = flat_tables(rgs::Codec::archive_draco, bytes);
  const std::size_t n = static_cast<std::size_t>(bytes[3]) % 80 + 1;
  // Points of no bits: 33 streams of one byte, three of one word, all zeros but for their lengths.
  std::vector<std::byte> points = point_head(static_cast<std::uint32_t>(n), 0);
  for (int k = 0; k < 33; ++k) points.insert(points.end(), {std::byte{}, std::byte{1}, std::byte{}});
  for (int k = 0; k < 3; ++k) {
    points.push_back(std::byte{4});
    points.resize(points.size() + 7);
  }
  RansWriter writer(t.frequencies, t.map);
  GeometryCodes zeros;
  zeros.resize(n);
  walk_geometry(zeros, t, writer);
  const std::vector<std::byte> geometry = writer.finish();
  const auto rest = bytes.subspan(4);
  const bool of_geometry = (static_cast<unsigned>(bytes[0]) & 4) != 0;
  const auto decoder = std::make_unique<ArchiveDecoder>(t);
  static_cast<void>(decoder->codes({{points, 0}, {of_geometry ? rest : std::span(geometry), 0}, {rest, 0}}, n));
  decode_rows(*decoder, static_cast<int>(bytes[0]) & 3, n);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 1) return 0;
  const auto bytes = std::as_bytes(std::span(data, size)).subspan(1);
  const int degree = data[0] >> 6;
  switch (data[0] % 8) {
    case 0: static_cast<void>(parse_archive_tables(bytes, 0, rgs::Codec::archive, degree)); break;
    case 1: decode_frames(bytes); break;
    case 2: decode_page(bytes); break;
    case 3: static_cast<void>(parse_archive_tables(bytes, 0, rgs::Codec::archive_draco, degree)); break;
    default: decode_draco(bytes);
  }
  return 0;
}
