// codec_planes.cpp - frames of 32-bit words and of geometry as byte planes, and Zstandard around all frames.
//
// Means follow a space-filling curve, so that a coordinate differs little from the one before; as integers that order
// like the numbers their differences are exact. A unit quaternion's w follows from x, y, z but for rounding. What is
// left in each byte of a word has its own statistics: bytes of one kind together form a plane, which Zstandard gets a
// block, hence an entropy table, of its own for.
// SPDX-License-Identifier: Apache-2.0
#include <zstd.h>

#include <algorithm>
#include <array>
#include <cassert>
#include <cstring>
#include <new>

#include "packed/frame_codec.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

constexpr std::size_t kHalves = kGeometryBytes / 2;
constexpr std::size_t kBlock = 1024;  // rows whose intermediate results stay in the first-level cache

// Bits of an FP32 number to an integer that orders like it, and back.
constexpr std::uint32_t ordered(std::uint32_t bits) {
  return (bits & 0x80000000u) != 0 ? ~bits : bits | 0x80000000u;
}
constexpr std::uint32_t unordered(std::uint32_t key) {
  return (key & 0x80000000u) != 0 ? key & 0x7FFFFFFFu : ~key;
}

// Small differences of either sign to small numbers, and back; mod 2^32 and 2^16.
constexpr std::uint32_t fold(std::uint32_t difference) {
  return difference << 1 ^ (0u - (difference >> 31));
}
constexpr std::uint32_t unfold(std::uint32_t folded) {
  return folded >> 1 ^ (0u - (folded & 1u));
}
constexpr std::uint16_t fold16(std::uint16_t difference) {
  return static_cast<std::uint16_t>(difference * 2u ^ (0u - (difference >> 15)));
}
constexpr std::uint16_t unfold16(std::uint16_t folded) {
  return static_cast<std::uint16_t>((folded >> 1) ^ (0u - (folded & 1u)));
}

}  // namespace

// ---- Zstandard ---------------------------------------------------------------------------------------------------

void FrameDecoder::Free::operator()(ZSTD_DCtx_s* context) const {
  ZSTD_freeDCtx(context);
}

void FrameEncoder::Free::operator()(ZSTD_CCtx_s* context) const {
  ZSTD_freeCCtx(context);
}

FrameDecoder::FrameDecoder() : context_(ZSTD_createDCtx()), lanes_(std::make_unique<ShLanes>()) {
  if (!context_) throw std::bad_alloc();
}

FrameEncoder::FrameEncoder(int level)
    : context_(ZSTD_createCCtx()), lanes_(std::make_unique<ShLanes>()), level_(level) {
  if (!context_) throw std::bad_alloc();
}

// One Zstandard frame of exactly `content_bytes`, nothing around it.
Status FrameDecoder::inflate(std::span<const std::byte> stored, std::uint64_t offset, std::size_t content_bytes) {
  content_.resize(std::max(content_.size(), content_bytes));
  constexpr std::array kMagicBytes = {std::byte{0x28}, std::byte{0xB5}, std::byte{0x2F}, std::byte{0xFD}};
  const bool one_frame = stored.size() >= kMagicBytes.size() &&  // no skippable or legacy frame
                         std::ranges::equal(stored.first(kMagicBytes.size()), kMagicBytes) &&
                         ZSTD_findFrameCompressedSize(stored.data(), stored.size()) == stored.size();
  if (!one_frame) return make_error(Errc::corrupt_data, offset, "a frame is not one Zstandard frame");
  const std::size_t found =
      ZSTD_decompressDCtx(context_.get(), content_.data(), content_bytes, stored.data(), stored.size());
  if (ZSTD_isError(found) != 0) return make_error(Errc::corrupt_data, offset, "a frame cannot be decompressed");
  if (found != content_bytes) {
    return make_error(Errc::corrupt_data, offset, "a frame's content has the wrong size", content_bytes, found);
  }
  return {};
}

// Each plane ends a block, so that entropy tables do not mix planes, unless a table would cost more than it saves.
std::vector<std::byte> FrameEncoder::deflate(std::span<const std::size_t> plane_ends, bool matches) {
  ZSTD_CCtx* context = context_.get();
  const std::size_t size = plane_ends.back();
  ZSTD_CCtx_reset(context, ZSTD_reset_session_and_parameters);
  ZSTD_CCtx_setParameter(context, ZSTD_c_compressionLevel, matches ? level_ : 1);
  if (!matches) {  // long matches only: short ones are chance and cost more than they save
    ZSTD_CCtx_setParameter(context, ZSTD_c_strategy, ZSTD_fast);
    ZSTD_CCtx_setParameter(context, ZSTD_c_minMatch, 7);
  }
  ZSTD_CCtx_setPledgedSrcSize(context, size);
  std::vector<std::byte> out(ZSTD_compressBound(size) + 16 * plane_ends.size() + 64);
  ZSTD_outBuffer target{out.data(), out.size(), 0};
  constexpr std::size_t kMinBlock = 1024;
  std::size_t begin = 0;
  for (const std::size_t& end : plane_ends) {
    const bool last = &end == &plane_ends.back();
    if (!last && end - begin < kMinBlock) continue;
    ZSTD_inBuffer plane{content_.data() + begin, end - begin, 0};
    const ZSTD_EndDirective directive = last ? ZSTD_e_end : ZSTD_e_flush;
    [[maybe_unused]] const std::size_t left = ZSTD_compressStream2(context, &target, &plane, directive);
    assert(left == 0 && plane.pos == plane.size);  // the output has room for the worst case
    begin = end;
  }
  out.resize(target.pos);
  return out;
}

std::vector<std::byte> FrameEncoder::deflate(std::span<const std::size_t> plane_ends) {
  std::vector<std::byte> best = deflate(plane_ends, false);
  if (level_ > 1) {
    std::vector<std::byte> other = deflate(plane_ends, true);
    if (other.size() < best.size()) best = std::move(other);
  }
  return best;
}

// ---- words ---------------------------------------------------------------------------------------------------------

Status FrameDecoder::words(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows,
                           std::uint64_t row_bytes, std::span<std::byte> out) {
  assert(out.size() == n_rows * row_bytes && row_bytes % 4 == 0);
  if (Status s = inflate(stored, offset, out.size()); !s) return s;
  std::array<std::uint32_t, kBlock> differences;
  const std::size_t n = n_rows, n_words = row_bytes / 4;
  for (std::size_t word = 0; word < n_words; ++word) {
    const std::uint8_t* plane = content_.data() + 4 * word * n;
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
        const std::uint32_t bits = unordered(key);
        std::memcpy(to, &bits, sizeof bits);
      }
    }
  }
  return {};
}

std::vector<std::byte> FrameEncoder::words(std::span<const std::byte> rows, std::uint64_t row_bytes) {
  const std::size_t n = rows.size() / row_bytes, n_words = row_bytes / 4;
  content_.resize(rows.size());
  std::vector<std::size_t> ends;
  for (std::size_t word = 0; word < n_words; ++word) {
    std::uint8_t* plane = content_.data() + 4 * word * n;
    std::uint32_t before = 0;
    for (std::size_t i = 0; i < n; ++i) {
      std::uint32_t bits;
      std::memcpy(&bits, rows.data() + i * row_bytes + 4 * word, sizeof bits);
      const std::uint32_t key = ordered(bits), folded = fold(key - before);
      before = key;
      for (std::size_t k = 0; k < 4; ++k) plane[i + k * n] = static_cast<std::uint8_t>(folded >> (8 * k));
    }
    for (std::size_t k = 1; k <= 4; ++k) ends.push_back((4 * word + k) * n);
  }
  return deflate(ends);
}

// ---- geometry ------------------------------------------------------------------------------------------------------

Status FrameDecoder::geometry(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows,
                              std::span<std::byte> out) {
  assert(out.size() == n_rows * kGeometryBytes);
  if (Status s = inflate(stored, offset, out.size()); !s) return s;
  const std::size_t n = n_rows;
  std::array<std::uint16_t, kBlock> w;
  for (std::size_t first = 0; first < n; first += kBlock) {
    const std::size_t count = std::min(kBlock, n - first);
    const std::uint8_t* block = content_.data() + first;
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
  return {};
}

std::vector<std::byte> FrameEncoder::geometry(std::span<const std::byte> rows) {
  const std::size_t n = rows.size() / kGeometryBytes;
  content_.resize(rows.size());
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t k = 0; k < kGeometryBytes; ++k) {
      content_[k * n + i] = static_cast<std::uint8_t>(rows[i * kGeometryBytes + k]);
    }
  }
  std::array<std::uint16_t, kBlock> w;
  for (std::size_t first = 0; first < n; first += kBlock) {
    const std::size_t count = std::min(kBlock, n - first);
    std::uint8_t* block = content_.data() + first;
    codec_kernels().unit_w(block + 2 * n, n, static_cast<int>(count), w.data());
    for (std::size_t i = 0; i < count; ++i) {
      const std::uint16_t folded = fold16(static_cast<std::uint16_t>((block[i] | block[i + n] << 8) - w[i]));
      block[i] = static_cast<std::uint8_t>(folded);
      block[i + n] = static_cast<std::uint8_t>(folded >> 8);
    }
  }
  std::array<std::size_t, kGeometryBytes> ends;
  for (std::size_t k = 0; k < ends.size(); ++k) ends[k] = (k + 1) * n;
  return deflate(ends);
}

// ---- SH
// --------------------------------------------------------------------------------------------------------------

Status FrameDecoder::sh(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows,
                        const ShFrame& frame, std::span<std::byte> out) {
  const int n_codes = 3 * sh_coefficients(frame.degree);
  const std::size_t content_bytes = sh_weight_bytes(n_codes) + static_cast<std::size_t>(n_codes) * n_rows;
  if (Status s = inflate(stored, offset, content_bytes); !s) return s;
  decode_sh_planes(*lanes_, std::span(content_).first(content_bytes), n_rows, frame, out);
  return {};
}

std::vector<std::byte> FrameEncoder::sh(std::span<const std::byte> rows, const ShFrame& frame) {
  const int n_codes = 3 * sh_coefficients(frame.degree);
  const std::size_t n = rows.size() / sh_bytes(frame.degree), weights = sh_weight_bytes(n_codes);
  content_.resize(weights + static_cast<std::size_t>(n_codes) * n);
  fit_sh_weights(*lanes_, rows, frame, std::span(content_).first(weights));
  encode_sh_planes(*lanes_, rows, frame, content_);
  std::vector<std::size_t> ends{weights};
  for (int i = 0; i < n_codes; ++i) ends.push_back(ends.back() + n);
  return deflate(ends);
}

}  // namespace rgs::detail
