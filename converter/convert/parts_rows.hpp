// parts_rows.hpp - Gaussians of inputs by bins of the Morton curve: writes rows.K, and reads it in leaf order.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "failure.hpp"
#include "parts.hpp"
#include "rgs/spatial_order.hpp"
#include "work_file.hpp"

namespace rgs {

/// The format of leaf rows under this plan; without a file.
lod::LevelRows leaf_rows(const PartsPlan& plan);

/// Writes an input's rows in blocks of one bin each, as memory fills. Rows keep the input's order within a bin.
class RowsWriter {
 public:
  RowsWriter(WorkWriter& file, const PartsPlan& plan, std::uint64_t memory_bytes);
  /// Adds Gaussians of the input at these positions; `first` is the input's first position among all inputs.
  Status add(std::uint64_t first, std::span<const std::uint32_t> positions, std::span<const Splat> rows);
  Status finish();

 private:
  Status flush(std::size_t bin);
  WorkWriter& file_;
  lod::LevelRows rows_;
  MortonKey key_;
  std::span<const std::uint64_t> bins_;
  std::uint64_t most_waiting_, n_waiting_ = 0;   // bytes
  std::vector<std::vector<std::byte>> waiting_;  // by bin
  std::vector<std::uint64_t> blocks_;            // bin, offset, rows, hash of each
};

/// The leaves of all inputs in order, from some leaf on.
class LeafReader {
 public:
  /// Opens rows.K of all inputs. Errors: open_failed (missing, or from another plan), WorkFile's, bad_value.
  static Outcome<LeafReader> open(const PartsRun& run, const PartsJob& job, const PartsPlan& plan);
  void seek(std::uint64_t leaf);
  /// The next rows, at least one and at most `most`, valid until the next call. Errors: limit_exceeded (a bin does not
  /// fit into memory), checksum_mismatch, WorkFile's.
  Outcome<std::span<const std::byte>> next(std::uint64_t most);

 private:
  struct Block {
    std::uint32_t input;
    std::uint64_t offset, rows, xxh3;
  };
  LeafReader(const PartsRun& run, const PartsPlan& plan);
  Outcome<void> load(std::size_t bin);
  std::vector<std::string> paths_;
  std::vector<WorkFile> files_;
  std::vector<std::vector<Block>> blocks_;  // per bin, in the order of the inputs
  std::vector<std::uint64_t> first_;        // first leaf of each bin; last, the number of leaves
  MortonKey key_;
  std::uint64_t row_bytes_ = 0, most_rows_ = 0;
  std::size_t bin_ = ~std::size_t{0};  // the bin in memory, sorted
  std::vector<std::byte> rows_;
  std::uint64_t leaf_ = 0;  // the next one
  std::string folder_;
};

}  // namespace rgs
