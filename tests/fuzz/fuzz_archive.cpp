// fuzz_archive.cpp - arbitrary bytes behind Profile::archive's checksums: Draco's streams, entropy-coded streams and
// section ARCH.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
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

// The header is corrected, so that every input reaches the kd-tree.
void decode_draco(std::span<const std::byte> bytes) {
  if (bytes.size() < 4) return;
  std::uint16_t count;
  std::memcpy(&count, bytes.data(), sizeof count);
  const std::uint32_t n = count % 1000u + 1, max_bits = static_cast<std::uint32_t>(bytes[2]) % 28 + 1;
  const std::vector<GridPoint> one{{0, 0, 0}};
  std::vector<std::byte> stream = encode_points(one).value();
  stream.resize(31);
  const std::uint32_t bits = static_cast<std::uint32_t>(bytes[3]) % (max_bits + 1);
  std::memcpy(stream.data() + 11, &n, 4);
  std::memcpy(stream.data() + 23, &bits, 4);
  std::memcpy(stream.data() + 27, &n, 4);
  stream.insert(stream.end(), bytes.begin() + 4, bytes.end());
  std::vector<GridPoint> points(n);
  static_cast<void>(decode_points(stream, 0, max_bits, points));
}

// A stream with tables that are not fitted: every distribution is flat.
void decode_streams(std::span<const std::byte> bytes) {
  if (bytes.size() < 4) return;
  ArchiveTables t;
  const int degree = static_cast<int>(bytes[0]) & 3;
  t.n_sh = archive_sh_count(degree);
  t.parameters.opacity_levels = 64;
  t.parameters.classes.resize(static_cast<std::size_t>(bytes[1]) % rgs::kMaxArchiveClasses + 1);
  for (rgs::ArchiveClass& c : t.parameters.classes) {
    c = {1.f / 64, 1u << 20, -(1 << 23), static_cast<std::uint32_t>(bytes[2]) << 18 | 1u, 0x1p40f, 0, 0, 0, 0};
  }
  t.dc_matrix.fill(32767);
  t.dc_weights.fill(-32768);
  t.sh_centre.resize(t.n_sh);
  t.sh_matrix.assign(t.n_sh * t.n_sh, -32768);
  t.map.resize(t.contexts().count);
  for (std::size_t i = 0; i < t.map.size(); ++i) t.map[i] = static_cast<std::uint8_t>(i % 2);
  t.frequencies.assign(2 * kRansTokens, 4096 / kRansTokens);
  t.frequencies[0] += 4096 % kRansTokens;
  t.frequencies[2 * kRansTokens - 1] += 4096 % kRansTokens;
  require(t.rans.assign(t.frequencies));
  const std::size_t n = static_cast<std::size_t>(bytes[3]) % 80 + 1;
  const auto decoder = std::make_unique<ArchiveDecoder>(t);
  static_cast<void>(decoder->geometry_codes(bytes.subspan(4), 0, n));  // codes are decoded whatever the stream
  std::vector<std::byte> rows(48 * n);
  decoder->geometry(10, std::span(rows).first(16 * n));
  static_cast<void>(decoder->sh_codes(bytes.subspan(4), 0));
  rgs::ShStepSet set;
  for (auto& steps : set.step) std::ranges::fill(steps, 0.25f);
  decoder->sh(degree, 1u << 16, {&set, 1}, std::span(rows).first(rgs::sh_bytes(degree) * n));
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 1) return 0;
  const auto bytes = std::as_bytes(std::span(data, size)).subspan(1);
  switch (data[0] % 8) {
    case 0: static_cast<void>(parse_archive_tables(bytes, 0, static_cast<int>(data[0] >> 6))); break;
    case 1: decode_streams(bytes); break;
    default: decode_draco(bytes);
  }
  return 0;
}
