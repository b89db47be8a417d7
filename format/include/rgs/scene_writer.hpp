// scene_writer.hpp - writes a scene of any size to an .rgs file, in two passes over its source and on any number of
// threads.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "rgs/encode.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

class AtomicFile;
class MappedFile;

/// Where a file's bytes go: a file on disk, which the caller commits, or memory. A view: its target must outlive it.
class Sink {
 public:
  Sink(AtomicFile& file) : file_(&file) {}                    // NOLINT: a file is a sink
  Sink(std::vector<std::byte>& memory) : memory_(&memory) {}  // NOLINT: and so is memory
  /// Reserves `size` bytes, so that a full disk fails now. Errors: write_failed, host_out_of_memory.
  Status reserve(std::uint64_t size);
  /// Errors: write_failed; offset is the file's. host_out_of_memory.
  Status write_at(std::uint64_t offset, std::span<const std::byte> bytes);
  /// Reads written bytes back. Errors: read_failed.
  Status read_at(std::uint64_t offset, std::span<std::byte> bytes) const;
  /// All bytes, until they are written again; `mapped` keeps a file's. Errors: MappedFile::map()'s.
  Result<std::span<const std::byte>> view(MappedFile& mapped) const;
  /// Sets the output's size. Errors: write_failed.
  Status truncate(std::uint64_t size);

 private:
  AtomicFile* file_ = nullptr;
  std::vector<std::byte>* memory_ = nullptr;
};

/// Contents of a written file.
struct WrittenScene {
  Header header;
  Declarations declarations;
  std::vector<SectionEntry> sections;
};

/// Writes one file. The steps:
///   1. SceneScan::add() for every Gaussian of the source, in any split.                          (first pass)
///   2. The order of the kept ones, for Order::morton by sort_by_key() of MortonKey(scan.robust()).
///   3. create().
///   4. Batches, filled on threads of their own if you like, and add()ed in order.                (second pass)
///   5. finish().
/// encode() does this in a single thread. The bytes do not depend on threads. Memory: 100 bytes a chunk for tables, and
/// batches; Profile::archive about 50 bytes a Gaussian, and until its end room in the sink for all their values.
class SceneWriter {
 public:
  class Batch;

  /// `source_index` [scan.n_kept()]: positions in the source of the Gaussians in the order of writing (the archive
  /// profile chooses its own); a permutation section and errors state them. Must outlive the writer. Reserves space if
  /// the file's size is known. Errors: check_encodable()'s, Sink::reserve()'s.
  static Result<SceneWriter> create(Sink sink, const SceneScan& scan, const EncodeOptions& options,
                                    std::span<const std::uint32_t> source_index);
  SceneWriter(SceneWriter&& other) noexcept;
  ~SceneWriter();

  std::uint64_t n_batches() const;
  /// Writes a complete batch: number 0, then 1, ... Errors: Sink::write_at()'s, bad_argument (another batch is next, or
  /// this one is incomplete), read_failed (a Gaussian that the scan cannot have seen: the source changed between the
  /// passes), host_out_of_memory. After an error the file is useless, and later calls return the same error.
  Status add(const Batch& batch);
  /// Writes tables, head and end of the file after the last batch. Errors: add()'s (read_failed too), bad_argument if a
  /// batch is missing, the sink's; for Profile::archive bad_value (a value too large for the requested steps; `found`
  /// is the Gaussian's source_index) and internal (the file, decoded again, violates the bounds that it states).
  Result<WrittenScene> finish();

 private:
  struct State;
  explicit SceneWriter(std::unique_ptr<State> state);
  std::unique_ptr<State> state_;
};

/// Encodes consecutive chunks of the file:
///   for (batch.begin(i); !batch.complete(); batch.encode_chunk()) gather(batch.source_index(), batch.splats());
/// Takes a few MB, which the next begin() reuses. Batches of one writer may be filled side by side.
class SceneWriter::Batch {
 public:
  /// The writer must outlive it, but may be moved.
  explicit Batch(SceneWriter& writer);
  Batch(Batch&& other) noexcept;
  ~Batch();

  /// Starts batch `index` of n_batches(). If memory runs out the batch is complete at once, and add() reports it.
  void begin(std::uint64_t index);
  std::uint64_t n_gaussians() const;
  bool complete() const;
  /// Positions in the source of the next chunk's Gaussians, and where to put these.
  std::span<const std::uint32_t> source_index() const;
  std::span<Splat> splats();
  /// Encodes splats(), repaired as the scan does.
  void encode_chunk();

 private:
  friend class SceneWriter;
  struct State;
  SceneWriter::State* writer_;
  std::unique_ptr<State> state_;  // from the first begin()
  Status status_;
};

}  // namespace rgs
