// reject_maker.hpp - collects files with one defect, for tests/golden/reject.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "edit_file.hpp"
#include "rgs/result.hpp"

namespace rgs::test {

struct RejectCase {
  std::string name;  ///< tests/golden/reject/NAME.rgs
  Errc code;
  std::uint64_t offset;
  Bytes bytes;
};

namespace detail {

/// Collects defects of one valid file.
class RejectMaker {
 public:
  RejectMaker(std::vector<RejectCase>& cases, Bytes file) : cases_(cases), file_(std::move(file)) {}

  const Bytes& file() const { return file_; }
  std::uint64_t entry(std::string_view type) const { return entry_of(file_, type); }
  std::uint64_t section(std::string_view type) const { return section_of(file_, type); }

  /// `change(bytes)` makes the defect; the hashes are then corrected.
  template <class Change>
  void change(const std::string& name, Errc code, std::uint64_t offset, Change change, Hashes hashes = Hashes::all) {
    Bytes bytes = file_;
    change(bytes);
    fix_hashes(bytes, hashes);
    cases_.push_back({name, code, offset, std::move(bytes)});
  }
  template <class T>
  void set(const std::string& name, Errc code, std::uint64_t offset, std::uint64_t at, T value) {
    change(name, code, offset, [&](Bytes& b) { put(b, at, value); });
  }
  /// The usual case: the error names the changed field.
  template <class T>
  void set(const std::string& name, Errc code, std::uint64_t at, T value) {
    set(name, code, at, at, value);
  }
  /// Flips a bit and leaves the hashes wrong.
  void flip(const std::string& name, Errc code, std::uint64_t offset, std::uint64_t at) {
    cases_.push_back({name, code, offset, file_});
    cases_.back().bytes[at] ^= std::byte{0x10};
  }
  /// Both sizes of a section in its entry.
  void resize(const std::string& name, std::string_view type, std::uint64_t size) {
    change(name, Errc::size_mismatch, entry(type) + 32, [&](Bytes& b) {
      put(b, entry(type) + 24, size);
      put(b, entry(type) + 32, size);
    });
  }

 private:
  std::vector<RejectCase>& cases_;
  Bytes file_;
};

}  // namespace detail
}  // namespace rgs::test
