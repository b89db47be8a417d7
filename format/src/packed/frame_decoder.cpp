// frame_decoder.cpp - decodes a frame's byte planes to rows of 32-bit words, geometry and SH; frame_encoder.cpp has the
// reasons.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cassert>
#include <cstring>

#include "packed/frame_codec.hpp"
#include "rgs/checksum.hpp"
#include "rgs/planes.hpp"

namespace rgs::detail {
namespace {

constexpr std::size_t kHalves = kGeometryBytes / 2;
constexpr std::size_t kBlock = 1024;  // rows whose intermediate results stay in the first-level cache

}  // namespace

Result<std::span<const std::byte>> frame_bytes(const FileView& view, const CodedFrame& frame) {
  const auto stored = view.bytes().subspan(frame.offset, frame.stored_bytes);
  if (const std::uint64_t hash = xxh3(stored); hash != frame.xxh3) {
    return make_error(Errc::checksum_mismatch, frame.offset, "a frame's checksum does not match", frame.xxh3, hash);
  }
  return stored;
}

Status frame_steps(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                   std::vector<ShStepSet>& steps) {
  steps.clear();
  for (std::uint64_t i = first_chunk; i < first_chunk + n_chunks; ++i) {
    const auto set = view.chunk_steps(i);
    if (!set) return tl::unexpected(set.error());
    steps.push_back(*set);
  }
  return {};
}

FrameDecoder::FrameDecoder() : lanes_(std::make_unique<ShLanes>()) {}

Status FrameDecoder::inflate(std::span<const std::byte> stored, std::uint64_t offset, std::size_t content_bytes) {
  content_.resize(std::max(content_.size(), content_bytes));
  return inflater_.inflate(stored, offset, std::as_writable_bytes(std::span(content_).first(content_bytes)));
}

Result<std::span<const std::uint8_t>> FrameDecoder::content(std::span<const std::byte> stored, std::uint64_t offset,
                                                            std::size_t bytes) {
  if (Status s = inflate(stored, offset, bytes); !s) return tl::unexpected(s.error());
  return std::span<const std::uint8_t>(content_).first(bytes);
}

// ---- words ---------------------------------------------------------------------------------------------------------

void decode_word_planes(std::span<const std::uint8_t> content, std::uint32_t n_rows, std::uint64_t row_bytes,
                        std::span<std::byte> out) {
  assert(out.size() == n_rows * row_bytes && content.size() == out.size() && row_bytes % 4 == 0);
  std::array<std::uint32_t, kBlock> differences;
  const std::size_t n = n_rows, n_words = row_bytes / 4;
  for (std::size_t word = 0; word < n_words; ++word) {
    const std::uint8_t* plane = content.data() + 4 * word * n;
    std::byte* to = out.data() + 4 * word;
    std::uint32_t key = 0;
    for (std::size_t first = 0; first < n; first += kBlock) {
      const std::size_t count = std::min(kBlock, n - first);
      const std::uint8_t* p = plane + first;
      for (std::size_t i = 0; i < count; ++i) {
        differences[i] =
            unfold(static_cast<std::uint32_t>(p[i]) | static_cast<std::uint32_t>(p[i + n]) << 8 |
                   static_cast<std::uint32_t>(p[i + 2 * n]) << 16 | static_cast<std::uint32_t>(p[i + 3 * n]) << 24);
      }
      for (std::size_t i = 0; i < count; ++i, to += row_bytes) {
        key += differences[i];
        const std::uint32_t bits = bits_of_key(key);
        std::memcpy(to, &bits, sizeof bits);
      }
    }
  }
}

Status FrameDecoder::words(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows,
                           std::uint64_t row_bytes, std::span<std::byte> out) {
  if (Status s = inflate(stored, offset, out.size()); !s) return s;
  decode_word_planes(std::span(content_).first(out.size()), n_rows, row_bytes, out);
  return {};
}

// ---- geometry ------------------------------------------------------------------------------------------------------

void decode_geometry_planes(std::span<const std::uint8_t> content, std::uint32_t n_rows, std::span<std::byte> out) {
  assert(out.size() == n_rows * kGeometryBytes && content.size() == out.size());
  const std::size_t n = n_rows;
  std::array<std::uint16_t, kBlock> w;
  for (std::size_t first = 0; first < n; first += kBlock) {
    const std::size_t count = std::min(kBlock, n - first);
    const std::uint8_t* block = content.data() + first;
    codec_kernels().unit_w(block + 2 * n, n, static_cast<int>(count), w.data());
    for (std::size_t i = 0; i < count; ++i) {
      std::uint16_t row[kHalves];
      for (std::size_t k = 0; k < kHalves; ++k) {
        const std::uint8_t* plane = block + 2 * k * n + i;
        row[k] = static_cast<std::uint16_t>(plane[0] | plane[n] << 8);
      }
      row[0] = static_cast<std::uint16_t>(w[i] + unfold16(row[0]));
      std::memcpy(out.data() + (first + i) * kGeometryBytes, row, sizeof row);
    }
  }
}

Status FrameDecoder::geometry(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows,
                              std::span<std::byte> out) {
  if (Status s = inflate(stored, offset, out.size()); !s) return s;
  decode_geometry_planes(std::span(content_).first(out.size()), n_rows, out);
  return {};
}

// ---- SH ---------------------------------------------------------------------------------------------------------------

Status FrameDecoder::sh(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows,
                        const ShFrame& frame, std::span<std::byte> out) {
  const int n_codes = 3 * sh_coefficients(frame.degree);
  const std::size_t content_bytes = sh_weight_bytes(n_codes) + static_cast<std::size_t>(n_codes) * n_rows;
  if (Status s = inflate(stored, offset, content_bytes); !s) return s;
  decode_sh_planes(*lanes_, std::span(content_).first(content_bytes), n_rows, frame, out);
  return {};
}

}  // namespace rgs::detail
