// splat_records.cpp - .splat, the records of github.com/antimatter15/splat:
//   0 f32 mean [3]   12 f32 scale [3], activated   24 u8 red, green, blue, opacity   28 u8 rotation w, x, y, z
// A rotation code is 128 + 128 * component.
// SPDX-License-Identifier: Apache-2.0
#include "splat_records.hpp"

#include <algorithm>
#include <cmath>

#include "pieces.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kRecordBytes = 32;

bool has_sound_numbers(std::span<const std::byte> record) {
  for (std::uint64_t i = 0; i < 6; ++i) {
    const float value = load<float>(record, 4 * i);
    if (!std::isfinite(value) || (i >= 3 && value < 0)) return false;
  }
  return true;
}

// Zeros, which are common in other files, decode to a quaternion of length 2.
bool has_unit_rotation(std::span<const std::byte> record) {
  int squared = 0;
  for (std::uint64_t i = 28; i < 32; ++i) squared += (load_u8(record, i) - 128) * (load_u8(record, i) - 128);
  return squared > 128 * 128 / 2 && squared < 128 * 128 * 2;
}

// Encodes a unit quaternion with w >= 0, so that only w = 1 is clamped to 255.
void encode_rotation(const float* q, std::span<std::byte> out) {
  double squared = 0;
  for (int i = 0; i < 4; ++i) squared += static_cast<double>(q[i]) * static_cast<double>(q[i]);
  const double factor = squared > 0 ? (q[0] < 0 ? -1 : 1) / std::sqrt(squared) : 0;
  for (std::size_t i = 0; i < 4; ++i) {
    const double code = std::floor(128 + 128 * factor * static_cast<double>(q[i]) + 0.5);
    out[i] = static_cast<std::byte>(static_cast<std::uint8_t>(std::clamp(code, 0.0, 255.0)));
  }
}

}  // namespace

bool looks_like_splat_records(std::span<const std::byte> bytes) {
  if (bytes.empty() || bytes.size() % kRecordBytes != 0) return false;
  // Letters are sound numbers and, of the right length, nearly unit rotations.
  const auto is_text = [](std::byte b) { return (b >= std::byte{' '} && b <= std::byte{'~'}) || b == std::byte{'\n'}; };
  if (std::ranges::all_of(bytes.first(std::min<std::size_t>(bytes.size(), 256)), is_text)) return false;
  const std::uint64_t n = bytes.size() / kRecordBytes, sampled = std::min<std::uint64_t>(n, 256);
  std::uint64_t n_unit = 0;
  for (std::uint64_t i = 0; i < sampled; ++i) {
    for (const std::uint64_t at : {i, n - 1 - i}) {
      const auto record = bytes.subspan(kRecordBytes * at, kRecordBytes);
      if (!has_sound_numbers(record)) return false;
      n_unit += has_unit_rotation(record) ? 1u : 0u;
    }
  }
  return n_unit >= sampled;  // half of the sample: some scenes have Gaussians without a rotation
}

Result<SplatFile> decode_splat_records(std::span<const std::byte> bytes, const ReadOptions& options) {
  const std::uint64_t n = bytes.size() / kRecordBytes;
  if (bytes.size() % kRecordBytes != 0) {
    return make_error(Errc::truncated, n * kRecordBytes, "the last record of the .splat file is cut off", kRecordBytes,
                      bytes.size() % kRecordBytes);
  }
  if (n > options.limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", options.limits.max_gaussians,
                      n);
  }
  SplatFile file;
  file.format = SplatFormat::splat;
  file.bytes = bytes.size();
  PieceFiller filler(file, n, 0, options);
  for (std::uint64_t i = 0; i < n; ++i) {
    const auto record = bytes.subspan(kRecordBytes * i, kRecordBytes);
    Splat s;
    for (std::uint64_t k = 0; k < 3; ++k) {
      s.mean[k] = load<float>(record, 4 * k);
      s.log_scale[k] = log_from_scale(load<float>(record, 12 + 4 * k), 0);
      s.sh[k] = dc_from_colour(load_u8(record, 24 + k) / 255.0);
    }
    s.opacity_logit = logit_from_opacity(static_cast<float>(load_u8(record, 27)) / 255.F);
    for (std::uint64_t k = 0; k < 4; ++k) s.rotation[k] = static_cast<float>(load_u8(record, 28 + k) - 128) / 128.F;
    if (const Status filled = filler.add(s); !filled) return tl::unexpected(filled.error());
  }
  return file;
}

Result<std::vector<std::byte>> encode_splat_records(const SplatView& splats, const WriteOptions&) {
  std::vector<std::byte> file(splats.n * kRecordBytes);
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    const Splat s = splats.splat(i);
    const auto record = std::span(file).subspan(kRecordBytes * i, kRecordBytes);
    for (std::uint64_t k = 0; k < 3; ++k) {
      store(record, 4 * k, s.mean[k]);
      store(record, 12 + 4 * k, scale_from_log(s.log_scale[k]));
      record[24 + k] = static_cast<std::byte>(unit_code(colour_from_dc(s.sh[k]), 255));
    }
    record[27] = static_cast<std::byte>(unit_code(static_cast<double>(opacity_from_logit(s.opacity_logit)), 255));
    encode_rotation(s.rotation, record.subspan(28));
  }
  return file;
}

}  // namespace rgs::detail
