// memory_files.cpp - replaces file.cpp and file_posix.cpp of format/src/file: outputs and scratch files are blocks of memory.
// SPDX-License-Identifier: Apache-2.0
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "rgs/file.hpp"

namespace rgs {
namespace {

constexpr std::size_t kBlock = std::size_t{1} << 20;

/// Blocks that were never written take no memory, and read as zeros.
struct Blocks {
  std::uint64_t size = 0;
  std::vector<std::unique_ptr<std::byte[]>> blocks;

  /// Calls visit(block, first byte in it, position in the range, bytes) for the blocks of a range.
  template <class Visit>
  void each(std::uint64_t offset, std::size_t bytes, const Visit& visit) {
    for (std::size_t done = 0; done < bytes;) {
      const auto at = static_cast<std::size_t>((offset + done) % kBlock);
      const std::size_t n = std::min(kBlock - at, bytes - done);
      visit(blocks[static_cast<std::size_t>((offset + done) / kBlock)], at, done, n);
      done += n;
    }
  }
  void resize(std::uint64_t to) {
    size = to;
    blocks.resize(static_cast<std::size_t>((to + kBlock - 1) / kBlock));
  }
  void write(std::uint64_t offset, std::span<const std::byte> bytes) {
    if (offset + bytes.size() > size) resize(offset + bytes.size());
    each(offset, bytes.size(), [&](auto& block, std::size_t at, std::size_t from, std::size_t n) {
      if (!block) block = std::make_unique<std::byte[]>(kBlock);
      std::copy_n(&bytes[from], n, &block[at]);
    });
  }
  std::size_t read(std::uint64_t offset, std::span<std::byte> bytes) {
    const auto count = static_cast<std::size_t>(std::min<std::uint64_t>(bytes.size(), size - std::min(offset, size)));
    each(offset, count, [&](auto& block, std::size_t at, std::size_t to, std::size_t n) {
      block ? std::copy_n(&block[at], n, &bytes[to]) : std::fill_n(&bytes[to], n, std::byte{});
    });
    return count;
  }
};

std::vector<std::unique_ptr<Blocks>> files;  // by descriptor, less kFirst
constexpr int kFirst = 3;

int open_blocks() {
  files.push_back(std::make_unique<Blocks>());
  return kFirst + static_cast<int>(files.size()) - 1;
}
Blocks& of(int descriptor) {
  return *files[static_cast<std::size_t>(descriptor - kFirst)];
}

}  // namespace

Result<MappedFile> MappedFile::map(int fd) {
  MappedFile file;
  file.size_ = static_cast<std::size_t>(of(fd).size);
  const std::span<std::byte> memory(new std::byte[std::max<std::size_t>(file.size_, 1)], file.size_);
  of(fd).read(0, memory);
  file.data_ = memory.data();
  return file;
}
MappedFile::MappedFile(MappedFile&& other) noexcept
    : data_(std::exchange(other.data_, nullptr)), size_(std::exchange(other.size_, 0)) {}
MappedFile& MappedFile::operator=(MappedFile&& other) noexcept {
  std::swap(data_, other.data_);
  std::swap(size_, other.size_);
  return *this;
}
MappedFile::~MappedFile() {
  delete[] data_;
}
Status MappedFile::check_unchanged() const {
  return {};
}
void MappedFile::advise(Access, std::uint64_t, std::uint64_t) const {}

Result<AtomicFile> AtomicFile::create(const std::string&, const Options& options) {
  AtomicFile file;
  file.options_ = options;
  file.fd_ = open_blocks();
  return file;
}
AtomicFile::AtomicFile(AtomicFile&& other) noexcept
    : options_(std::move(other.options_)), fd_(std::exchange(other.fd_, -1)) {}
AtomicFile& AtomicFile::operator=(AtomicFile&& other) noexcept {
  std::swap(options_, other.options_);
  std::swap(fd_, other.fd_);
  return *this;
}
AtomicFile::~AtomicFile() {
  if (fd_ >= 0) ::close(fd_);
}
Status AtomicFile::reserve(std::uint64_t size) {
  return truncate(size);
}
Status AtomicFile::write_at(std::uint64_t offset, std::span<const std::byte> bytes) {
  of(fd_).write(offset, bytes);
  return {};
}
Status AtomicFile::read_at(std::uint64_t offset, std::span<std::byte> bytes) const {
  of(fd_).read(offset, bytes);
  return {};
}
Status AtomicFile::truncate(std::uint64_t size) {
  of(fd_).resize(size);
  return {};
}
Result<double> AtomicFile::commit() {
  if (options_.hold != nullptr) *options_.hold = std::move(*this);
  return 0;
}

int detail::open_scratch(const std::string&) {
  return open_blocks();
}
int detail::write_at(int fd, std::uint64_t& offset, std::span<const std::byte> bytes) {
  of(fd).write(offset, bytes);
  offset += bytes.size();
  return 0;
}
int detail::read_at(int fd, std::uint64_t& offset, std::span<std::byte> bytes) {
  const std::size_t n = of(fd).read(offset, bytes);
  offset += n;
  return n == bytes.size() ? 0 : kFileEnded;
}
// There are no names.
int detail::open_to_read(const std::string&, bool) {
  return -1;
}
std::optional<detail::FileStatus> detail::status_of(int) {
  return std::nullopt;
}

}  // namespace rgs

// They replace the C library's, which would need files and an environment from JavaScript.
extern "C" int close(int fd) {
  rgs::files[static_cast<std::size_t>(fd - rgs::kFirst)] = {};
  return 0;
}
extern "C" char* getenv(const char*) {
  return nullptr;
}
