// batch_state.hpp - what a folder of outputs was made from: the memory of conversions of many scenes (docs/user/BATCH.md).
// SPDX-License-Identifier: Apache-2.0
//
// A file of JSON lines in the folder of the outputs, only ever appended to: a program that is killed leaves at most one
// line cut off, which is read as none. A shard writes a file of its own and reads those of all.
#pragma once

#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs {

/// What an output was made from and what it was. Equal contents decide; equal stamps save reading them.
struct BatchRecord {
  std::string output;         ///< relative to the folder of the outputs
  std::string tool, options;  ///< the program and its version; hash of all options that show in the output
  std::string input_name;     ///< file name of the input, which an .rgs keeps
  std::string input_path;     ///< full path of the input whose output this is
  std::string input, made;    ///< size and hash of the contents, see describe_contents()
  std::string input_stamp, made_stamp;
  std::string summary;  ///< of the conversion, JSON

  /// Whether it is of the same scene and options as `other`, apart from stamps.
  bool same_work(const BatchRecord& other) const {
    return tool == other.tool && options == other.options && input_name == other.input_name;
  }
};

/// Size, times and inode of each file, which change when it is written to or replaced. Empty if one is not there.
std::string stamp_of(std::span<const std::string> files);
/// "SIZE XXH3" of the files' bytes, one after the other, with their sizes. Errors: those of MappedFile::open().
Result<std::string> describe_contents(std::span<const std::string> files);

class BatchState {
 public:
  /// Opens or makes the state in `folder`, which must exist; `shard` is "" or "I-of-N". Errors: open_failed, also if another
  /// process has it open; read_failed.
  static Result<BatchState> open(const std::string& folder, const std::string& shard);
  BatchState(BatchState&& other) noexcept;
  BatchState& operator=(BatchState&&) = delete;
  ~BatchState();

  /// The state of a shard in `folder`, then those of others that are there.
  static std::vector<std::string> files(const std::string& folder, const std::string& shard);

  /// All that is known of an output, in no order; empty if it is none of ours.
  std::span<const BatchRecord> find(const std::string& output) const;
  /// Whether a conversion to `output` began and nobody knows how it ended: one of `input_path`, or of any input.
  bool was_begun(const std::string& output, const std::string& input_path) const;
  bool was_begun(const std::string& output) const;
  /// Whether another program may be working on this folder: it has a state of another shard locked, or locks say nothing.
  bool others_work() const;
  /// Says that a conversion of `input_path` to `output` begins, so that whatever is there later is its to replace; on disk
  /// before it returns, if `sync`. Errors: write_failed.
  Status begin(const std::string& output, const std::string& input_path, bool sync);
  /// Says that it ended without an output. Errors: write_failed.
  Status cancel(const std::string& output);
  /// Says that it is done. Errors: write_failed: the scene will be converted again.
  Status add(BatchRecord record);

  const std::string& path() const { return path_; }
  /// In a child process, which shall not hold the file open.
  void forget();

 private:
  BatchState() = default;
  void read(const std::string& path, std::string_view text);
  Status append(std::string line);

  struct Known {
    std::vector<BatchRecord> records;
    std::map<std::string, std::string> begun;  // by the file that says so: the input's path
  };
  std::map<std::string, Known> known_;
  std::string folder_, path_;
  int fd_ = -1;
  bool locked_ = false;
  bool line_open_ = false;  // the file's last line has no end
};

}  // namespace rgs
