// work_file.cpp - a header of eight numbers, bytes, and CBOR that describes them.
// SPDX-License-Identifier: Apache-2.0
#include "work_file.hpp"

#include <unistd.h>

#include <bit>
#include <cerrno>
#include <cstring>
#include <utility>

#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/version.hpp"

namespace rgs {
namespace {

static_assert(std::endian::native == std::endian::little, "numbers are stored as they are in memory");

// The header: kMagic, kind, hash of the version, basis, then offset, size and hash of the CBOR, and the hash of these
// seven.
using Head = std::array<std::uint64_t, kWorkHeadBytes / 8>;
constexpr std::uint64_t kMagic = 0x316B726F77736772;  // "rgswork1"

// What all files of a folder agree on: the program's version, and the order of leaves.
std::uint64_t version_hash() {
  return xxh3(std::as_bytes(std::span(std::string_view(RGS_VERSION ", cells of the curve"))));
}

std::uint64_t hash_of(const Head& head) {
  return xxh3(std::as_bytes(std::span(head).first(7)));
}

Error damaged(Errc code) {
  return {code, Error::kNone, "damaged; remove the file and run its step again", Error::kNone, Error::kNone, 0};
}

}  // namespace

Result<WorkWriter> WorkWriter::create(const std::string& path, WorkKind kind, std::uint64_t basis, bool sync) {
  auto file = AtomicFile::create(path, {.overwrite = true, .sync = sync});
  if (!file) return tl::unexpected(file.error());
  WorkWriter writer;
  writer.file_ = std::move(*file);
  writer.kind_ = kind;
  writer.basis_ = basis;
  writer.end_ = kWorkHeadBytes;
  return writer;
}

Status WorkWriter::append(std::span<const std::byte> bytes) {
  if (Status s = file_.write_at(end_, bytes); !s) return s;
  end_ += bytes.size();
  return {};
}

Status WorkWriter::finish(const nlohmann::json& about) {
  return detail::guard_memory([&]() -> Status {
    const std::vector<std::uint8_t> text = nlohmann::json::to_cbor(about);
    const auto said = std::as_bytes(std::span(text));
    if (Status s = file_.write_at(end_, said); !s) return s;
    Head head{kMagic, static_cast<std::uint64_t>(kind_), version_hash(), basis_, end_, said.size(), xxh3(said), 0};
    head.back() = hash_of(head);
    if (Status s = file_.write_at(0, std::as_bytes(std::span(head))); !s) return s;
    const auto committed = file_.commit();
    return committed ? Status() : tl::unexpected(committed.error());
  });
}

WorkFile::WorkFile(WorkFile&& other) noexcept
    : path_(std::move(other.path_)),
      fd_(std::exchange(other.fd_, -1)),
      about_(std::move(other.about_)),
      identity_(other.identity_),
      basis_(other.basis_),
      end_(other.end_) {}

WorkFile& WorkFile::operator=(WorkFile&& other) noexcept {
  std::swap(path_, other.path_);
  std::swap(fd_, other.fd_);
  std::swap(about_, other.about_);
  std::swap(identity_, other.identity_);
  std::swap(basis_, other.basis_);
  std::swap(end_, other.end_);
  return *this;
}

WorkFile::~WorkFile() {
  rest();
}

void WorkFile::rest() {
  if (fd_ >= 0) ::close(std::exchange(fd_, -1));
}

Status WorkFile::read(std::uint64_t offset, std::span<std::byte> bytes) {
  if (offset > end_ || bytes.size() > end_ - offset) return tl::unexpected(damaged(Errc::truncated));
  if (fd_ < 0) {
    fd_ = detail::open_to_read(path_);
    if (fd_ < 0) {
      return make_error(Errc::open_failed, Error::kNone, "cannot open the file", Error::kNone, Error::kNone, errno);
    }
  }
  const int error = detail::read_at(fd_, offset, bytes);
  if (error == 0) return {};
  if (error == detail::kFileEnded) return tl::unexpected(damaged(Errc::truncated));
  return make_error(Errc::read_failed, offset, "cannot read the file", Error::kNone, Error::kNone, error);
}

Result<WorkFile> WorkFile::open(const std::string& path, WorkKind kind) {
  return detail::guard_memory([&]() -> Result<WorkFile> {
    WorkFile file;
    file.path_ = path;
    file.end_ = kWorkHeadBytes;
    Head head;
    if (Status s = file.read(0, std::as_writable_bytes(std::span(head))); !s) return tl::unexpected(s.error());
    if (head[0] != kMagic) return make_error(Errc::bad_magic, 0, "not a work file");
    if (head[7] != hash_of(head)) return tl::unexpected(damaged(Errc::checksum_mismatch));
    if (head[2] != version_hash()) {
      return make_error(Errc::unsupported_version, 16,
                        "made by another version of RoofGS; use that version, or begin again with --overwrite");
    }
    if (head[1] != static_cast<std::uint64_t>(kind)) {
      return make_error(Errc::bad_value, 8, "not the kind of file that its name says", static_cast<std::uint64_t>(kind),
                        head[1]);
    }
    constexpr std::uint64_t kMost = std::uint64_t{1} << 40;
    const std::uint64_t end = head[4], bytes = head[5];
    if (end < kWorkHeadBytes || bytes > kMost || end > ~std::uint64_t{0} - bytes) {
      return tl::unexpected(damaged(Errc::bad_header));
    }
    const auto status = detail::status_of(file.fd_);
    if (!status || status->bytes != end + bytes) return tl::unexpected(damaged(Errc::truncated));
    std::vector<std::byte> said(bytes);
    file.end_ = end + bytes;
    if (Status s = file.read(end, said); !s) return tl::unexpected(s.error());
    file.end_ = end;
    if (xxh3(said) != head[6]) return tl::unexpected(damaged(Errc::checksum_mismatch));
    const auto* const text = reinterpret_cast<const std::uint8_t*>(said.data());
    file.about_ = nlohmann::json::from_cbor(text, text + said.size(), true, false);
    if (!file.about_.is_object()) return tl::unexpected(damaged(Errc::bad_value));
    file.identity_ = head[7];
    file.basis_ = head[3];
    return file;
  });
}

Result<std::optional<WorkFile>> WorkFile::find(const std::string& path, WorkKind kind, std::uint64_t basis) {
  auto file = open(path, kind);
  if (file) return file->basis() == basis ? std::optional(std::move(*file)) : std::nullopt;
  const Error& error = file.error();
  const bool is_missing = error.code == Errc::open_failed && error.system == ENOENT;
  if (is_missing || error.code == Errc::unsupported_version) return std::nullopt;
  return tl::unexpected(error);
}

Status unpack_bytes(const nlohmann::json& packed, std::size_t size_each, std::vector<std::uint8_t>& bytes) {
  return read_about([&]() -> Status {
    bytes = packed.get_binary();
    if (bytes.size() % size_each == 0) return {};
    return tl::unexpected(damaged(Errc::bad_value));
  });
}

}  // namespace rgs
