// work_file.hpp - the files by which processes that convert one scene together hand on their work.
// SPDX-License-Identifier: Apache-2.0
//
// A file appears complete or not at all (AtomicFile), and says what it was made from. Whoever opens it knows that all it says
// of itself is as it was written; its bytes, which may be many, are checked as they are read.
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

/// Writes a file: bytes one after the other, then what there is to say of them.
class WorkWriter {
 public:
  /// `basis`: identity of what it is made from; another file of this name is replaced. Errors: AtomicFile's.
  static Result<WorkWriter> create(const std::string& path, WorkKind kind, std::uint64_t basis, bool sync);
  std::uint64_t end() const { return end_; }  ///< where the next bytes go
  Status append(std::span<const std::byte> bytes);
  /// Gives the file its name.
  Status finish(const nlohmann::json& about);

 private:
  AtomicFile file_;
  WorkKind kind_ = WorkKind::job;
  std::uint64_t basis_ = 0, end_ = 0;
};

class WorkFile {
 public:
  /// Errors: open_failed; truncated, bad_magic, unsupported_version (of another version of RoofGS), bad_header,
  /// checksum_mismatch (of what it says of itself), bad_value (another kind).
  static Result<WorkFile> open(const std::string& path, WorkKind kind);
  /// The same, or none: missing, of another version of RoofGS, or made from something else.
  static Result<std::optional<WorkFile>> find(const std::string& path, WorkKind kind, std::uint64_t basis);
  WorkFile(WorkFile&& other) noexcept;
  WorkFile& operator=(WorkFile&& other) noexcept;
  ~WorkFile();

  const nlohmann::json& about() const { return about_; }
  /// Lets it go, where thousands of files wait.
  void forget_about() { about_ = {}; }
  /// Another where any byte of about() is another, and so any of the hashes in it.
  std::uint64_t identity() const { return identity_; }
  std::uint64_t basis() const { return basis_; }
  std::uint64_t end() const { return end_; }  ///< of the bytes
  /// Lets the file be closed until it is read again: of thousands that wait few need to be open.
  void rest();
  /// Errors: truncated (not inside the bytes), read_failed, open_failed.
  Status read(std::uint64_t offset, std::span<std::byte> bytes);

 private:
  WorkFile() = default;
  std::string path_;
  int fd_ = -1;
  nlohmann::json about_;
  std::uint64_t identity_ = 0, basis_ = 0, end_ = 0;
};

/// First byte of the bytes of a file.
inline constexpr std::uint64_t kWorkHeadBytes = 64;

/// Numbers as one value of about(), which a list of them would be many times as large. Errors: bad_value.
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

/// What `read` gives, or bad_value where what a file says has another shape than it should.
template <class F>
auto read_about(const F& read) -> decltype(read()) {
  try {
    return read();
  } catch (const nlohmann::json::exception&) {
    return make_error(
        Errc::bad_value, Error::kNone,
        "a table of this file is not as it was written; remove the file and run the step again that makes it");
  }
}

}  // namespace rgs
