// batch_state.hpp - records what each output in a folder was made from, for conversions of many scenes
// (docs/user/BATCH.md).
// SPDX-License-Identifier: Apache-2.0
//
// An append-only file of JSON lines in the output folder: a killed program leaves at most one cut-off line, which
// readers skip. A shard writes its own file and reads those of all.
#pragma once

#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs {

/// An output and what it was made from. Equal contents decide; equal stamps avoid reading them.
struct BatchRecord {
  std::string output;         ///< relative to the output folder
  std::string tool, options;  ///< program and version; hash of all options that affect the output
  std::string input_name;     ///< file name of the input, which an .rgs keeps
  std::string input_path;     ///< full path of the input that owns the output
  std::string input, made;    ///< size and hash of the contents, see describe_contents()
  std::string input_stamp, made_stamp;
  std::string summary;  ///< of the conversion, JSON

  /// Whether scene and options equal those of `other`; ignores stamps.
  bool same_work(const BatchRecord& other) const {
    return tool == other.tool && options == other.options && input_name == other.input_name;
  }
};

/// Size, times and inode of each file, which change if it is written to or replaced. Empty if a file is missing.
std::string stamp_of(std::span<const std::string> files);
/// "SIZE XXH3" of the files' concatenated bytes and their sizes. Errors: those of MappedFile::open().
Result<std::string> describe_contents(std::span<const std::string> files);

class BatchState {
 public:
  /// Opens or creates the state in `folder`, which must exist; `shard` is "" or "I-of-N". Errors: open_failed, also if
  /// another process has it open; read_failed.
  static Result<BatchState> open(const std::string& folder, const std::string& shard);
  BatchState(BatchState&& other) noexcept;
  BatchState& operator=(BatchState&&) = delete;
  ~BatchState();

  /// The state file of a shard in `folder`, then any others.
  static std::vector<std::string> files(const std::string& folder, const std::string& shard);

  /// All records of an output, in no order; empty if it is not ours.
  std::span<const BatchRecord> find(const std::string& output) const;
  /// Whether a conversion to `output` began and its end is not recorded: of `input_path`, or of any input.
  bool was_begun(const std::string& output, const std::string& input_path) const;
  bool was_begun(const std::string& output) const;
  /// Whether another program may be working on this folder: another shard's state is locked, or locks do not work.
  bool others_may_work() const;
  /// Records that a conversion of `input_path` to `output` begins and may replace what it leaves there; on disk before
  /// it returns, if `sync`. Errors: write_failed.
  Status begin(const std::string& output, const std::string& input_path, bool sync);
  /// Records that it ended without an output. Errors: write_failed.
  Status cancel(const std::string& output);
  /// Records that it is done. Errors: write_failed: the scene will be converted again.
  Status add(BatchRecord record);

  const std::string& path() const { return path_; }
  /// For a child process, which must not hold the file open.
  void forget();

 private:
  BatchState() = default;
  void read(const std::string& path, std::string_view text);
  Status append(std::string line);

  struct Known {
    std::vector<BatchRecord> records;
    std::map<std::string, std::string> begun;  // the input's path, by the state file that records the begin
  };
  std::map<std::string, Known> known_;
  std::string folder_, path_;
  int fd_ = -1;
  bool locked_ = false;
  bool line_open_ = false;  // the file's last line has no end
};

}  // namespace rgs
