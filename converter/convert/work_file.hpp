// work_file.hpp - files through which processes that convert one scene pass on their work.
// SPDX-License-Identifier: Apache-2.0
//
// A file appears complete or not at all (AtomicFile), and states what it was made from. Opening checks its description;
// its bytes, which may be many, are checked as they are read.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/result.hpp"

namespace rgs {

enum class WorkKind : std::uint64_t { job = 1, scan, plan, rows, range };

/// Writes a file: bytes in order, then their description.
class WorkWriter {
 public:
  /// `basis`: identity of its sources. Replaces an existing file. Errors: AtomicFile's.
  static Result<WorkWriter> create(const std::string& path, WorkKind kind, std::uint64_t basis, bool sync);
  std::uint64_t end() const { return end_; }  ///< offset of the next bytes
  Status append(std::span<const std::byte> bytes);
  /// Writes the description and renames the file into place.
  Status finish(const nlohmann::json& about);

 private:
  AtomicFile file_;
  WorkKind kind_ = WorkKind::job;
  std::uint64_t basis_ = 0, end_ = 0;
};

class WorkFile {
 public:
  /// Errors: open_failed; truncated, bad_magic, unsupported_version (another version of RoofGS), bad_header,
  /// checksum_mismatch (of the description), bad_value (another kind).
  static Result<WorkFile> open(const std::string& path, WorkKind kind);
  /// The same, or none: missing, from another version of RoofGS, or from other sources.
  static Result<std::optional<WorkFile>> find(const std::string& path, WorkKind kind, std::uint64_t basis);
  WorkFile(WorkFile&& other) noexcept;
  WorkFile& operator=(WorkFile&& other) noexcept;
  ~WorkFile();

  const nlohmann::json& about() const { return about_; }
  /// Frees the description, for when thousands of files wait.
  void forget_about() { about_ = {}; }
  /// Changes with any byte of about(), and so with the hashes in it.
  std::uint64_t identity() const { return identity_; }
  std::uint64_t basis() const { return basis_; }
  std::uint64_t end() const { return end_; }  ///< of the bytes
  /// Closes the file until the next read(): of thousands that wait, few need to be open.
  void rest();
  /// Errors: truncated (beyond the bytes), read_failed, open_failed.
  Status read(std::uint64_t offset, std::span<std::byte> bytes);

 private:
  WorkFile() = default;
  std::string path_;
  int fd_ = -1;
  nlohmann::json about_;
  std::uint64_t identity_ = 0, basis_ = 0, end_ = 0;
};

/// Offset of the bytes in the file.
inline constexpr std::uint64_t kWorkHeadBytes = 64;

/// Numbers packed into one value of about(); a JSON list would be many times as large. Errors: bad_value.
template <class T>
nlohmann::json pack_numbers(std::span<const T> numbers) {
  const auto* const bytes = reinterpret_cast<const std::uint8_t*>(numbers.data());
  return nlohmann::json::binary(std::vector<std::uint8_t>(bytes, bytes + numbers.size_bytes()));
}
Status unpack_bytes(const nlohmann::json& packed, std::size_t size_each, std::vector<std::uint8_t>& bytes);
template <class T>
Result<std::vector<T>> unpack_numbers(const nlohmann::json& packed) {
  std::vector<std::uint8_t> bytes;
  if (Status s = unpack_bytes(packed, sizeof(T), bytes); !s) return tl::unexpected(s.error());
  std::vector<T> numbers(bytes.size() / sizeof(T));
  std::ranges::copy(bytes, reinterpret_cast<std::uint8_t*>(numbers.data()));
  return numbers;
}

/// The result of `read`, or bad_value if the description has an unexpected shape.
template <class F>
auto read_about(const F& read) -> decltype(read()) {
  try {
    return read();
  } catch (const nlohmann::json::exception&) {
    return make_error(Errc::bad_value, Error::kNone,
                      "a table of this file is damaged; remove the file and run its step again");
  }
}

}  // namespace rgs
