// levels_writer.hpp - writes a scene with its levels of detail to an .rgs file.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "rgs/encode.hpp"
#include "rgs/page.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/scene_writer.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// Writes one file, pages coarse to fine, with only the current page in memory, but for Profile::archive. The steps:
///   1. SceneScan::add() for every Gaussian of the source.
///   2. The tree of pages: counts, errors, parents. Leaves are the source's Gaussians in the order of a file without
///      levels (EncodeOptions::order), in whole chunks.
///   3. create().
///   4. Pages 0, 1, ...: encoded by a LevelsWriter::Encoder, on a thread of its own if you like, and add()ed in order.
///   5. finish().
/// write_levels() does this for levels in memory. The bytes do not depend on threads. Memory: 190 bytes a page, and
/// encoders; Profile::archive as SceneWriter.
class LevelsWriter {
 public:
  class Encoder;

  /// `leaves`: the scan of the source. `pages`: see lod::check_pages(); boxes may be smaller than they must be, since
  /// the written ones are recomputed from what is stored. With EncodeOptions::keep_permutation, options.source_index [n
  /// leaves] (or none: 0, 1, 2, ...) holds each leaf Gaussian's position in the source, in the order of the leaves.
  /// quality_db: see lod::Levels. Errors: check_encodable()'s, bad_argument (no Gaussians; pages that are no tree, have
  /// other leaves than the scan, or exceed lod::kMaxPageRows, kMaxArchiveRows with Profile::archive; one set of SH steps
  /// for the file with Profile::archive).
  static Result<LevelsWriter> create(Sink sink, const SceneScan& leaves, const EncodeOptions& options,
                                     std::vector<lod::Page> pages, float quality_db = 0);
  LevelsWriter(LevelsWriter&& other) noexcept;
  ~LevelsWriter();

  const std::vector<lod::Page>& pages() const;
  /// Writes an encoded page: 0, then 1, ... Errors: those of Encoder::encode(), Sink::write_at(), bad_argument (another
  /// page is next). After an error the file is useless, and later calls return the same error.
  Status add(const Encoder& page);
  /// The same for a page from a PageEncoder with the same scan and options, here or in another process. Errors also:
  /// truncated, checksum_mismatch (the record is damaged).
  Status add(std::span<const std::byte> record);
  /// Writes tables, head and end of the file after the last page. Errors: as SceneWriter::finish().
  Result<WrittenScene> finish();

 private:
  struct State;
  explicit LevelsWriter(std::unique_ptr<State> state);
  std::unique_ptr<State> state_;
};

/// Encodes one page at a time, reusing its memory. Encoders of one writer may run side by side.
class LevelsWriter::Encoder {
 public:
  /// The writer must outlive it, but may be moved.
  explicit Encoder(LevelsWriter& writer);
  Encoder(Encoder&& other) noexcept;
  ~Encoder();

  /// `splats`: the Gaussians of page `page`. Errors: bad_argument (not the page's number), bad_value (one above the
  /// leaves is damaged, see find_defects(); offset is its index in the page), read_failed (a leaf is damaged: the
  /// source changed), host_out_of_memory.
  Status encode(std::uint32_t page, const SplatView& splats);

 private:
  friend class LevelsWriter;
  struct State;
  LevelsWriter::State* writer_;
  std::unique_ptr<State> state_;
  Status status_;
};

/// Encodes pages without a writer, or in another process, as records for LevelsWriter::add(). Records are valid for
/// this version of the library alone. Those of Profile::archive, which codes all pages together, hold all values.
class PageEncoder {
 public:
  /// `leaves` and `options`: as for LevelsWriter::create(). Errors: check_encodable()'s, bad_argument (one set of SH
  /// steps for the file with Profile::archive).
  static Result<PageEncoder> create(const SceneScan& leaves, const EncodeOptions& options);
  PageEncoder(PageEncoder&& other) noexcept;
  ~PageEncoder();

  /// Uses the page's level, count and error. The record is valid until the next call. Errors: those of
  /// LevelsWriter::Encoder::encode().
  Result<std::span<const std::byte>> encode(const lod::Page& page, const SplatView& splats);

 private:
  struct State;
  explicit PageEncoder(std::unique_ptr<State> state);
  std::unique_ptr<State> state_;
};

/// The file for `levels`, whose leaves are sound (see find_defects()) and in the order of options.order, on `threads`
/// threads (0: as many as the machine runs at once). options.n_source and n_repaired state what was dropped or repaired
/// before. Errors: LevelsWriter's.
Result<WrittenScene> write_levels(const lod::Levels& levels, const EncodeOptions& options, Sink sink,
                                  unsigned threads = 0);

}  // namespace rgs
