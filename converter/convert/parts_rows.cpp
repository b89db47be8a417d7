// parts_rows.cpp - blocks of rows, with a table of blocks at the end of the file.
// SPDX-License-Identifier: Apache-2.0
#include "parts_rows.hpp"

#include <algorithm>
#include <utility>

#include "rgs/checksum.hpp"

namespace rgs {
namespace {

constexpr std::size_t kOfBlock = 4;  // numbers per block in the table
constexpr std::uint64_t kMostBlockBytes = std::uint64_t{1} << 20;

Error not_as_written() {
  return {Errc::bad_value,
          Error::kNone,
          "the table of this file contradicts itself or the plan; remove the file and run --lod-partition again for "
          "its input",
          Error::kNone,
          Error::kNone,
          0};
}

}  // namespace

lod::LevelRows leaf_rows(const PartsPlan& plan) {
  return {{}, plan.scan.sh_degree(), lod::LevelRows::Kind::of_leaves(plan.encode)};
}

RowsWriter::RowsWriter(WorkWriter& file, const PartsPlan& plan, std::uint64_t memory_bytes)
    : file_(file),
      rows_(leaf_rows(plan)),
      key_(plan.scan.robust()),
      bins_(plan.bins),
      most_waiting_(memory_bytes / 8),
      waiting_(plan.bins.size()) {}

Status RowsWriter::add(std::uint64_t first, std::span<const std::uint32_t> positions, std::span<const Splat> rows) {
  const std::vector<std::uint64_t> keys = lod::keys_of(rows, key_);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const auto bin = static_cast<std::size_t>(std::ranges::upper_bound(bins_, keys[i]) - bins_.begin()) - 1;
    std::vector<std::byte>& to = waiting_[bin];
    to.resize(to.size() + rows_.row_bytes());
    rows_.pack(rows[i], static_cast<std::uint32_t>(first + positions[i]), &to[to.size() - rows_.row_bytes()]);
    n_waiting_ += rows_.row_bytes();
    if (to.size() >= kMostBlockBytes) {
      if (Status s = flush(bin); !s) return s;
    } else if (n_waiting_ > most_waiting_) {
      // Flush the longest: a tile is in few bins, and every builder reads a table of all blocks, so blocks should be
      // long.
      const auto longest = std::ranges::max_element(waiting_, {}, [](const auto& of_bin) { return of_bin.size(); });
      if (Status s = flush(static_cast<std::size_t>(longest - waiting_.begin())); !s) return s;
    }
  }
  return {};
}

Status RowsWriter::flush(std::size_t bin) {
  std::vector<std::byte>& rows = waiting_[bin];
  if (rows.empty()) return {};
  blocks_.insert(blocks_.end(), {bin, file_.end(), rows.size() / rows_.row_bytes(), xxh3(rows)});
  n_waiting_ -= rows.size();
  const Status written = file_.append(rows);
  rows = std::vector<std::byte>();  // `= {}` would keep the memory of all bins
  return written;
}

Status RowsWriter::finish() {
  for (std::size_t bin = 0; bin < waiting_.size(); ++bin) {
    if (Status s = flush(bin); !s) return s;
  }
  return file_.finish({{"blocks", pack_numbers(std::span<const std::uint64_t>(blocks_))}});
}

LeafReader::LeafReader(const PartsRun& run, const PartsPlan& plan)
    : blocks_(plan.bins.size()),
      key_(plan.scan.robust()),
      row_bytes_(leaf_rows(plan).row_bytes()),
      folder_(run.folder) {
  most_rows_ = std::max<std::uint64_t>(1, run.memory_bytes / 4 / lod::sorting_bytes(row_bytes_));
}

Outcome<LeafReader> LeafReader::open(const PartsRun& run, const PartsJob& job, const PartsPlan& plan) {
  LeafReader reader(run, plan);
  for (std::size_t i = 0; i < job.inputs.size(); ++i) {
    const std::string path = run.rows_path(i);
    auto found = WorkFile::find(path, WorkKind::rows, plan.identity);
    if (!found) return failed(path, found.error());
    std::optional<WorkFile>& file = *found;
    if (!file) {
      return failed(path, {Errc::open_failed, Error::kNone,
                           "missing, or from another plan; run --lod-partition for this input first", Error::kNone,
                           Error::kNone, 0});
    }
    const auto read = read_about([&]() -> Status {
      const auto table = unpack_numbers<std::uint64_t>(file->about().at("blocks"));
      if (!table) return tl::unexpected(table.error());
      if (table->size() % kOfBlock != 0) return tl::unexpected(not_as_written());
      std::uint64_t end = kWorkHeadBytes;
      for (std::size_t k = 0; k < table->size(); k += kOfBlock) {
        const std::uint64_t bin = (*table)[k], offset = (*table)[k + 1], rows = (*table)[k + 2];
        if (bin >= reader.blocks_.size() || offset != end || rows == 0 ||
            rows > (file->end() - end) / reader.row_bytes_) {
          return tl::unexpected(not_as_written());
        }
        reader.blocks_[bin].push_back({static_cast<std::uint32_t>(i), offset, rows, (*table)[k + 3]});
        end += rows * reader.row_bytes_;
      }
      if (end != file->end()) return tl::unexpected(not_as_written());
      return {};
    });
    if (!read) return failed(path, read.error());
    file->forget_about();
    file->rest();
    reader.files_.push_back(std::move(*file));
    reader.paths_.push_back(path);
  }
  reader.first_.push_back(0);
  for (const std::vector<Block>& of_bin : reader.blocks_) {
    std::uint64_t n = 0;
    for (const Block& block : of_bin) n += block.rows;
    reader.first_.push_back(reader.first_.back() + n);
  }
  if (reader.first_.back() != plan.scan.n_kept()) {
    return failed(run.folder, {Errc::read_failed, Error::kNone,
                               "an input changed between scan and placing; begin again with --overwrite",
                               plan.scan.n_kept(), reader.first_.back(), 0});
  }
  return reader;
}

void LeafReader::seek(std::uint64_t leaf) {
  leaf_ = leaf;
}

Outcome<void> LeafReader::load(std::size_t bin) {
  const std::uint64_t n = first_[bin + 1] - first_[bin];
  if (n > most_rows_) {
    return failed(folder_, {Errc::limit_exceeded, Error::kNone,
                            "more Gaussians are adjacent on the Morton curve than can be sorted in this memory; "
                            "raise --memory",
                            most_rows_, n, 0});
  }
  rows_.resize(n * row_bytes_);
  std::uint64_t end = 0;
  for (const Block& block : blocks_[bin]) {
    const auto part = std::span(rows_).subspan(end, block.rows * row_bytes_);
    WorkFile& file = files_[block.input];
    if (const Status s = file.read(block.offset, part); !s) return failed(paths_[block.input], s.error());
    if (xxh3(part) != block.xxh3) {
      return failed(paths_[block.input],
                    {Errc::checksum_mismatch, block.offset,
                     "rows are damaged; remove the file and run --lod-partition again for its input", Error::kNone,
                     Error::kNone, 0});
    }
    end += part.size();
  }
  for (const Block& block : blocks_[bin]) files_[block.input].rest();
  lod::sort_rows(rows_, row_bytes_, key_);
  bin_ = bin;
  return {};
}

Outcome<std::span<const std::byte>> LeafReader::next(std::uint64_t most) {
  const auto bin = static_cast<std::size_t>(std::ranges::upper_bound(first_, leaf_) - first_.begin()) - 1;
  if (bin != bin_) {
    if (const auto loaded = load(bin); !loaded) return tl::unexpected(loaded.error());
  }
  const std::uint64_t n = std::min(most, first_[bin + 1] - leaf_);
  const auto rows = std::span<const std::byte>(rows_).subspan((leaf_ - first_[bin]) * row_bytes_, n * row_bytes_);
  leaf_ += n;
  return rows;
}

}  // namespace rgs
