// frame_codec.hpp - encodes rows of a section as one coded frame, and decodes it; docs/format/FORMAT.md "Coded
// sections".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "packed/codec_kernels.hpp"
#include "packed/inflater.hpp"
#include "rgs/decode.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"

struct ZSTD_CCtx_s;

namespace rgs::detail {

/// What the SH codec needs to know of the frame's chunks.
struct ShFrame {
  int degree = 0;
  std::uint32_t chunk_rows = 0;            ///< Gaussians a chunk; a frame starts with a chunk
  std::span<const ShStepSet> chunk_steps;  ///< of each chunk in the frame
};

/// Stored bytes of a frame after a check of their hash. Errors: checksum_mismatch.
Result<std::span<const std::byte>> frame_bytes(const FileView& view, const CodedFrame& frame);
/// SH steps of the chunks of a frame. Errors: those of FileView::chunk_steps().
Status frame_steps(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                   std::vector<ShStepSet>& steps);

/// Decodes frames, one at a time; memory grows to that of the largest frame. Safe on untrusted bytes: whatever decodes
/// without corrupt_data fills `out` with some rows. Errors: corrupt_data at `offset`, the frame's.
class FrameDecoder {
 public:
  FrameDecoder();
  /// Rows of 32-bit words. `out` [n_rows, row_bytes].
  Status words(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows, std::uint64_t row_bytes,
               std::span<std::byte> out);
  /// GEOM. `out` [n_rows, 16].
  Status geometry(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows,
                  std::span<std::byte> out);
  /// SHI8. `out` [n_rows, sh_bytes].
  Status sh(std::span<const std::byte> stored, std::uint64_t offset, std::uint32_t n_rows, const ShFrame& frame,
            std::span<std::byte> out);

  /// Content of a frame with more than one kind of rows; valid until the next call.
  Result<std::span<const std::uint8_t>> content(std::span<const std::byte> stored, std::uint64_t offset,
                                                std::size_t bytes);
  ShLanes& lanes() { return *lanes_; }

 private:
  Status inflate(std::span<const std::byte> stored, std::uint64_t offset, std::size_t content_bytes);
  Inflater inflater_;
  std::unique_ptr<ShLanes> lanes_;
  std::vector<std::uint8_t> content_;
};

/// A frame's rows take at most so many times its stored bytes: less than DecodeLimits::max_expansion, so that every
/// file can be read, even one of a million equal Gaussians.
inline constexpr std::size_t kMaxFrameExpansion = 1024;

/// Encodes frames, one at a time. Deterministic.
class FrameEncoder {
 public:
  /// `level` 1 to kMaxLevel: 1 codes byte planes by entropy alone; above, Zstandard's matches of that level are tried
  /// too, and the smaller result is kept.
  explicit FrameEncoder(int level);
  std::vector<std::byte> words(std::span<const std::byte> rows, std::uint64_t row_bytes);
  std::vector<std::byte> geometry(std::span<const std::byte> rows);
  std::vector<std::byte> sh(std::span<const std::byte> rows, const ShFrame& frame);
  /// A page of a file with levels: all its rows in one frame. `steps` [n_sets, 48], the rest as above.
  std::vector<std::byte> page(std::span<const std::byte> steps, std::span<const std::byte> means,
                              std::span<const std::byte> geometry, std::span<const std::byte> sh, const ShFrame& frame);

 private:
  std::vector<std::byte> deflate(std::span<const std::size_t> plane_ends, std::size_t decoded_bytes);
  std::vector<std::byte> deflate(std::span<const std::size_t> plane_ends, bool matches);
  struct Free {
    void operator()(ZSTD_CCtx_s* context) const;
  };
  std::unique_ptr<ZSTD_CCtx_s, Free> context_;
  std::unique_ptr<ShLanes> lanes_;
  std::vector<std::uint8_t> content_;
  int level_;
};

/// Decodes a content's planes to rows: of 32-bit words, of GEOM.
void decode_word_planes(std::span<const std::uint8_t> content, std::uint32_t n_rows, std::uint64_t row_bytes,
                        std::span<std::byte> out);
void decode_geometry_planes(std::span<const std::uint8_t> content, std::uint32_t n_rows, std::span<std::byte> out);

// ---- the SH predictor (codec_sh.cpp) ------------------------------------------------------------------------------

std::vector<RelativeShSteps> relative_sh_steps(const ShFrame& frame);
/// Fits the frame's weights, in the form in which its content starts with them.
void fit_sh_weights(ShLanes& lanes, std::span<const std::byte> rows, const ShFrame& frame,
                    std::span<std::uint8_t> weights);
/// content: weights, then 3 (degree + 1)^2 planes of n_rows residuals.
void decode_sh_planes(ShLanes& lanes, std::span<const std::uint8_t> content, std::uint32_t n_rows, const ShFrame& frame,
                      std::span<std::byte> rows);
void encode_sh_planes(ShLanes& lanes, std::span<const std::byte> rows, const ShFrame& frame,
                      std::span<std::uint8_t> content);

}  // namespace rgs::detail
