// frame_encoder.cpp - encodes rows of 32-bit words, geometry and SH as byte planes, compressed by Zstandard.
//
// Means follow a space-filling curve, so consecutive coordinates differ little; as integers of the same order their
// differences are exact. A unit quaternion's w follows from x, y, z up to rounding. Each byte of a word has its own
// statistics, so bytes of one kind form a plane, with a Zstandard block, hence an entropy table, of its own.
// SPDX-License-Identifier: Apache-2.0
#include <zstd.h>

#include <algorithm>
#include <array>
#include <cassert>
#include <cstring>

#include "packed/frame_codec.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/planes.hpp"

namespace rgs::detail {
namespace {

constexpr std::size_t kBlock = 1024;  // rows whose intermediate results stay in the first-level cache

}  // namespace

void FrameEncoder::Free::operator()(ZSTD_CCtx_s* context) const {
  ZSTD_freeCCtx(context);
}

FrameEncoder::FrameEncoder(int level)
    : context_(ZSTD_createCCtx()), lanes_(std::make_unique<ShLanes>()), level_(level) {
  if (!context_) fail_allocation();
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
    const std::size_t left = ZSTD_compressStream2(context, &target, &plane, directive);
    if (ZSTD_isError(left) != 0) fail_allocation();  // only its workspace can fail
    assert(left == 0 && plane.pos == plane.size);    // the output has room for the worst case
    begin = end;
  }
  out.resize(target.pos);
  return out;
}

// `decoded_bytes`: of the frame's rows.
std::vector<std::byte> FrameEncoder::deflate(std::span<const std::size_t> plane_ends, std::size_t decoded_bytes) {
  std::vector<std::byte> best = deflate(plane_ends, false);
  if (level_ > 1) {
    std::vector<std::byte> other = deflate(plane_ends, true);
    if (other.size() < best.size()) best = std::move(other);
  }
  if (decoded_bytes / kMaxFrameExpansion < best.size()) return best;
  // Too small: a block takes at least four bytes, and one for every 2048 makes the frame large enough, including row
  // padding, which is not coded.
  constexpr std::size_t kSmallBlock = 2048;
  std::vector<std::size_t> ends;
  for (std::size_t end = kSmallBlock; end < plane_ends.back(); end += kSmallBlock) ends.push_back(end);
  ends.push_back(plane_ends.back());
  return deflate(ends, false);
}

namespace {

// Encodes rows of 32-bit words as planes at `content`, and returns their ends.
void encode_word_planes(std::span<const std::byte> rows, std::uint64_t row_bytes, std::uint8_t* content,
                        std::size_t begin, std::vector<std::size_t>& ends) {
  const std::size_t n = rows.size() / row_bytes, n_words = row_bytes / 4;
  for (std::size_t word = 0; word < n_words; ++word) {
    std::uint8_t* plane = content + begin + 4 * word * n;
    std::uint32_t before = 0;
    for (std::size_t i = 0; i < n; ++i) {
      std::uint32_t bits;
      std::memcpy(&bits, rows.data() + i * row_bytes + 4 * word, sizeof bits);
      const std::uint32_t key = ordered_key(bits), folded = fold(key - before);
      before = key;
      for (std::size_t k = 0; k < 4; ++k) plane[i + k * n] = static_cast<std::uint8_t>(folded >> (8 * k));
    }
    for (std::size_t k = 1; k <= 4; ++k) ends.push_back(begin + (4 * word + k) * n);
  }
}

void encode_geometry_planes(std::span<const std::byte> rows, std::uint8_t* content, std::size_t begin,
                            std::vector<std::size_t>& ends) {
  const std::size_t n = rows.size() / kGeometryBytes;
  std::uint8_t* planes = content + begin;
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t k = 0; k < kGeometryBytes; ++k) {
      planes[k * n + i] = static_cast<std::uint8_t>(rows[i * kGeometryBytes + k]);
    }
  }
  std::array<std::uint16_t, kBlock> w;
  for (std::size_t first = 0; first < n; first += kBlock) {
    const std::size_t count = std::min(kBlock, n - first);
    std::uint8_t* block = planes + first;
    codec_kernels().unit_w(block + 2 * n, n, static_cast<int>(count), w.data());
    for (std::size_t i = 0; i < count; ++i) {
      const std::uint16_t folded = fold16(static_cast<std::uint16_t>((block[i] | block[i + n] << 8) - w[i]));
      block[i] = static_cast<std::uint8_t>(folded);
      block[i + n] = static_cast<std::uint8_t>(folded >> 8);
    }
  }
  for (std::size_t k = 1; k <= kGeometryBytes; ++k) ends.push_back(begin + k * n);
}

}  // namespace

std::vector<std::byte> FrameEncoder::words(std::span<const std::byte> rows, std::uint64_t row_bytes) {
  content_.resize(rows.size());
  std::vector<std::size_t> ends;
  encode_word_planes(rows, row_bytes, content_.data(), 0, ends);
  return deflate(ends, rows.size());
}

std::vector<std::byte> FrameEncoder::geometry(std::span<const std::byte> rows) {
  content_.resize(rows.size());
  std::vector<std::size_t> ends;
  encode_geometry_planes(rows, content_.data(), 0, ends);
  return deflate(ends, rows.size());
}

std::vector<std::byte> FrameEncoder::sh(std::span<const std::byte> rows, const ShFrame& frame) {
  const int n_codes = 3 * sh_coefficients(frame.degree);
  const std::size_t n = rows.size() / sh_bytes(frame.degree), weights = sh_weight_bytes(n_codes);
  content_.resize(weights + static_cast<std::size_t>(n_codes) * n);
  fit_sh_weights(*lanes_, rows, frame, std::span(content_).first(weights));
  encode_sh_planes(*lanes_, rows, frame, content_);
  std::vector<std::size_t> ends{weights};
  for (int i = 0; i < n_codes; ++i) ends.push_back(ends.back() + n);
  return deflate(ends, rows.size());
}

std::vector<std::byte> FrameEncoder::page(std::span<const std::byte> steps, std::span<const std::byte> means,
                                          std::span<const std::byte> geometry, std::span<const std::byte> sh,
                                          const ShFrame& frame) {
  const int n_codes = 3 * sh_coefficients(frame.degree);
  const std::size_t n = means.size() / kMeanBytes, weights = sh_weight_bytes(n_codes);
  const std::size_t at_means = steps.size(), at_geometry = at_means + means.size(),
                    at_sh = at_geometry + geometry.size();
  content_.resize(at_sh + weights + static_cast<std::size_t>(n_codes) * n);
  std::vector<std::size_t> ends;
  encode_word_planes(steps, kStepSetBytes, content_.data(), 0, ends);
  encode_word_planes(means, kMeanBytes, content_.data(), at_means, ends);
  encode_geometry_planes(geometry, content_.data(), at_geometry, ends);
  const auto codes = std::span(content_).subspan(at_sh);
  fit_sh_weights(*lanes_, sh, frame, codes.first(weights));
  encode_sh_planes(*lanes_, sh, frame, codes);
  ends.push_back(at_sh + weights);
  for (int i = 0; i < n_codes; ++i) ends.push_back(ends.back() + n);
  return deflate(ends, steps.size() + means.size() + geometry.size() + sh.size());
}

}  // namespace rgs::detail
