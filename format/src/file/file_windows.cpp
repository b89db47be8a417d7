// file_windows.cpp - mapped input and all-or-nothing output on Windows.
// SPDX-License-Identifier: Apache-2.0
// Paths are UTF-8. Whatever is open may be read and renamed by others. Nobody can shorten a file that is mapped; if its disk
// or network fails, the program ends without a message.
#define _CRT_RAND_S  // rand_s()
#define NOMINMAX
#define WIN32_LEAN_AND_MEAN
#include <fcntl.h>
#include <io.h>
#include <malloc.h>
#include <unistd.h>
#include <windows.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <cwchar>
#include <system_error>
#include <utility>

#include "file/large_pages.hpp"
#include "rgs/file.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs {
namespace {

constexpr DWORD kShareAll = FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE;
constexpr std::size_t kLongestPath = 32768;  // of the system, in UTF-16

// Sets errno by the system's last error: EIO where it has no like.
void set_errno() {
  const auto like = std::system_category().default_error_condition(static_cast<int>(::GetLastError()));
  errno = like.category() == std::generic_category() ? like.value() : EIO;
}

tl::unexpected<Error> system_error(Errc code, const char* what) {
  set_errno();
  return make_error(code, Error::kNone, what, Error::kNone, Error::kNone, errno);
}

// The full path with the prefix that lifts the limit of 260 characters.
std::wstring wide(const std::string& path) {
  const std::filesystem::path given = detail::path_of(path);
  std::wstring full(kLongestPath, L'\0');
  full.resize(::GetFullPathNameW(given.c_str(), static_cast<DWORD>(full.size()), full.data(), nullptr));
  if (full.starts_with(L"\\\\?\\") || full.starts_with(L"\\\\.\\")) return full;
  return full.starts_with(L"\\\\") ? L"\\\\?\\UNC" + full.substr(1) : L"\\\\?\\" + full;
}

HANDLE handle_of(int fd) {
  return reinterpret_cast<HANDLE>(::_get_osfhandle(fd));
}

// A descriptor that owns the handle and no other process inherits; -1 and errno on failure.
int descriptor_of(HANDLE handle) {
  if (handle == INVALID_HANDLE_VALUE) {
    set_errno();
    return -1;
  }
  const int fd = ::_open_osfhandle(reinterpret_cast<intptr_t>(handle), _O_BINARY | _O_NOINHERIT);
  if (fd < 0) ::CloseHandle(handle);
  return fd;
}

// Calls `make` with other letters for the Xs at the end of `name` until it has no reason but an existing file to fail.
// Returns its result: -1 and errno if it failed.
template <class Make>
int with_new_name(std::string& name, const Make& make) {
  constexpr char kLetters[] = "abcdefghijklmnopqrstuvwxyz012345";
  constexpr int kAttempts = 100;
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    unsigned random = 0;
    if (::rand_s(&random) != 0) return -1;
    for (std::size_t i = 1; i <= 6; ++i, random >>= 5) name[name.size() - i] = kLetters[random & 31u];
    const int made = make();
    if (made >= 0 || errno != EEXIST) return made;
  }
  return -1;
}

int create_new(const std::string& path, DWORD flags) {
  return descriptor_of(::CreateFileW(wide(path).c_str(), GENERIC_READ | GENERIC_WRITE | DELETE, kShareAll, nullptr,
                                     CREATE_NEW, flags, nullptr));
}

// All bytes by ::WriteFile or ::ReadFile; `ended` where it moves none. Returns 0, errno or that.
template <class Call, class Byte>
int transfer(Call call, int fd, std::uint64_t& offset, std::span<Byte> bytes, int ended) {
  constexpr std::size_t kMost = std::size_t{1} << 30;
  while (!bytes.empty()) {
    OVERLAPPED at{};
    at.Offset = static_cast<DWORD>(offset);
    at.OffsetHigh = static_cast<DWORD>(offset >> 32);
    DWORD n = 0;
    const auto size = static_cast<DWORD>(std::min(bytes.size(), kMost));
    if (call(handle_of(fd), bytes.data(), size, &n, &at) == 0 && ::GetLastError() != ERROR_HANDLE_EOF) {
      set_errno();
      return errno;
    }
    if (n == 0) return ended;
    bytes = bytes.subspan(n);
    offset += n;
  }
  return 0;
}

bool set_size(int fd, std::uint64_t size) {
  FILE_END_OF_FILE_INFO end{};
  end.EndOfFile.QuadPart = static_cast<LONGLONG>(size);
  return ::SetFileInformationByHandle(handle_of(fd), FileEndOfFileInfo, &end, sizeof end) != 0;
}

// 100 ns since 1601 as seconds and nanoseconds, for comparisons.
std::array<std::int64_t, 2> time_of(LARGE_INTEGER time) {
  return {time.QuadPart / 10'000'000, time.QuadPart % 10'000'000 * 100};
}

// Unfinished temporaries, for the handler of Ctrl-C. state: 0 free, 1 being filled, 2 live.
struct Slot {
  std::atomic<int> state{0};
  wchar_t path[kLongestPath];
};
constexpr int kSlots = 32;
Slot g_slots[kSlots];

int claim_slot(const std::wstring& path) {
  for (int i = 0; path.size() < kLongestPath && i < kSlots; ++i) {
    int expected = 0;
    if (!g_slots[i].state.compare_exchange_strong(expected, 1)) continue;
    std::wmemcpy(g_slots[i].path, path.c_str(), path.size() + 1);
    g_slots[i].state.store(2, std::memory_order_release);
    return i;
  }
  return -1;
}

void release_slot(int slot) {
  if (slot >= 0) g_slots[slot].state.store(0, std::memory_order_release);
}

// For Ctrl-C, Ctrl-Break and a console that closes. What is open is deleted when it is closed.
BOOL WINAPI remove_temporaries(DWORD) {
  for (Slot& slot : g_slots) {
    if (slot.state.load(std::memory_order_acquire) == 2) ::DeleteFileW(slot.path);
  }
  return FALSE;  // the system's handler ends the process
}

}  // namespace

int detail::open_scratch(const std::string& asked) {
  std::string name = asked;
  if (name.empty()) {
    std::wstring folder(MAX_PATH + 1, L'\0');
    folder.resize(::GetTempPathW(static_cast<DWORD>(folder.size()), folder.data()));
    name = std::filesystem::path(folder).string();
  }
  name += "/rgs-scratch-XXXXXX";
  return with_new_name(name, [&] { return create_new(name, FILE_ATTRIBUTE_TEMPORARY | FILE_FLAG_DELETE_ON_CLOSE); });
}

bool detail::make_scratch_folder(std::string& name) {
  return with_new_name(name, [&] {
           if (::CreateDirectoryW(wide(name).c_str(), nullptr) != 0) return 0;
           set_errno();
           return -1;
         }) == 0;
}

int detail::open_to_read(const std::string& path, bool) {
  // FILE_FLAG_BACKUP_SEMANTICS opens folders too, which map() rejects by name.
  return descriptor_of(::CreateFileW(wide(path).c_str(), GENERIC_READ, kShareAll, nullptr, OPEN_EXISTING,
                                     FILE_FLAG_BACKUP_SEMANTICS, nullptr));
}

// What is not UTF-8 becomes U+FFFD.
std::filesystem::path detail::path_of(std::string_view name) {
  const int bytes = static_cast<int>(name.size());
  std::wstring wide(static_cast<std::size_t>(::MultiByteToWideChar(CP_UTF8, 0, name.data(), bytes, nullptr, 0)), L'\0');
  ::MultiByteToWideChar(CP_UTF8, 0, name.data(), bytes, wide.data(), static_cast<int>(wide.size()));
  return wide;
}

std::optional<detail::FileStatus> detail::status_of(int fd) {
  const HANDLE handle = handle_of(fd);
  FileStatus status;
  if (handle != INVALID_HANDLE_VALUE && ::GetFileType(handle) != FILE_TYPE_DISK) return status;
  BY_HANDLE_FILE_INFORMATION info{};
  FILE_BASIC_INFO basic{};
  if (::GetFileInformationByHandle(handle, &info) == 0 ||
      ::GetFileInformationByHandleEx(handle, FileBasicInfo, &basic, sizeof basic) == 0) {
    set_errno();
    return std::nullopt;
  }
  const bool is_folder = (info.dwFileAttributes & FILE_ATTRIBUTE_DIRECTORY) != 0;
  status.kind = is_folder ? FileStatus::Kind::folder : FileStatus::Kind::regular;
  status.device = info.dwVolumeSerialNumber;
  status.inode = std::uint64_t{info.nFileIndexHigh} << 32 | info.nFileIndexLow;
  status.bytes = std::uint64_t{info.nFileSizeHigh} << 32 | info.nFileSizeLow;
  status.n_names = info.nNumberOfLinks;
  // Not basic.ChangeTime: indexers and virus scanners move it.
  status.modified = time_of(basic.LastWriteTime);
  return status;
}

std::optional<detail::FileStatus> detail::status_of(const std::string& path) {
  const int fd = descriptor_of(::CreateFileW(wide(path).c_str(), FILE_READ_ATTRIBUTES, kShareAll, nullptr,
                                             OPEN_EXISTING, FILE_FLAG_BACKUP_SEMANTICS, nullptr));
  if (fd < 0) return std::nullopt;
  const auto status = status_of(fd);
  const int error = errno;
  ::close(fd);
  errno = error;
  return status;
}

int detail::write_at(int fd, std::uint64_t& offset, std::span<const std::byte> bytes) {
  return transfer(::WriteFile, fd, offset, bytes, ENOSPC);
}

int detail::read_at(int fd, std::uint64_t& offset, std::span<std::byte> bytes) {
  return transfer(::ReadFile, fd, offset, bytes, kFileEnded);
}

void* detail::allocate_aligned(std::size_t alignment, std::size_t bytes) {
  return ::_aligned_malloc(bytes, alignment);
}

void detail::free_aligned(void* memory) {
  ::_aligned_free(memory);
}

std::string follow_links(const std::string& path) {
  const std::wstring name = wide(path);
  const DWORD attributes = ::GetFileAttributesW(name.c_str());
  if (attributes == INVALID_FILE_ATTRIBUTES || (attributes & FILE_ATTRIBUTE_REPARSE_POINT) == 0) return path;
  const HANDLE target = ::CreateFileW(name.c_str(), FILE_READ_ATTRIBUTES, kShareAll, nullptr, OPEN_EXISTING,
                                      FILE_FLAG_BACKUP_SEMANTICS, nullptr);
  if (target == INVALID_HANDLE_VALUE) return path;
  std::wstring final_name(kLongestPath, L'\0');
  final_name.resize(::GetFinalPathNameByHandleW(target, final_name.data(), kLongestPath, FILE_NAME_NORMALIZED));
  ::CloseHandle(target);
  if (final_name.empty()) return path;
  // std::filesystem knows neither prefix.
  if (final_name.starts_with(L"\\\\?\\UNC\\")) final_name.replace(0, 7, L"\\");
  if (final_name.starts_with(L"\\\\?\\")) final_name.erase(0, 4);
  return std::filesystem::path(final_name).string();
}

Result<MappedFile> MappedFile::map(int fd) {
  const auto status = detail::status_of_regular(fd);
  if (!status) return tl::unexpected(status.error());
  MappedFile file;
  HANDLE own = INVALID_HANDLE_VALUE;
  const HANDLE process = ::GetCurrentProcess();
  if (::DuplicateHandle(process, handle_of(fd), process, &own, 0, FALSE, DUPLICATE_SAME_ACCESS) == 0)
    return system_error(Errc::open_failed, "cannot keep the file open");
  file.fd_ = descriptor_of(own);
  if (file.fd_ < 0)
    return make_error(Errc::open_failed, Error::kNone, "cannot keep the file open", Error::kNone, Error::kNone, errno);
  file.size_ = static_cast<std::size_t>(status->bytes);
  file.stamp_ = *status;
  if (file.size_ == 0) return file;  // a mapping has at least one byte
  const HANDLE mapping = ::CreateFileMappingW(own, nullptr, PAGE_READONLY, 0, 0, nullptr);
  if (mapping == nullptr) return system_error(Errc::read_failed, "cannot map the file");
  const void* const data = ::MapViewOfFile(mapping, FILE_MAP_READ, 0, 0, 0);
  if (data == nullptr) set_errno();
  const int error = errno;
  ::CloseHandle(mapping);
  if (data == nullptr)
    return make_error(Errc::read_failed, Error::kNone, "cannot map the file", Error::kNone, Error::kNone, error);
  file.data_ = static_cast<const std::byte*>(data);
  return file;
}

MappedFile::~MappedFile() {
  if (data_ != nullptr) ::UnmapViewOfFile(data_);
  if (fd_ >= 0) ::close(fd_);
}

void MappedFile::advise(Access, std::uint64_t, std::uint64_t) const {}

Result<AtomicFile> AtomicFile::begin(const std::string& name, const Options& options) {
  AtomicFile file;
  file.options_ = options;
  if (name == "-") {
    file.path_ = name;
    file.fd_ = detail::open_scratch({});
    if (file.fd_ >= 0) return file;
    return make_error(Errc::write_failed, Error::kNone, "cannot create a temporary file; set TMP to a writable folder",
                      Error::kNone, Error::kNone, errno);
  }
  file.path_ = follow_links(name);
  if (const auto old = detail::status_of(file.path_)) {
    if (old->kind == detail::FileStatus::Kind::folder)
      return make_error(Errc::output_unusable, Error::kNone, "the output is a directory");
    if (old->kind != detail::FileStatus::Kind::regular)
      return make_error(Errc::output_unusable, Error::kNone, "the output is not a regular file");
    if (!options.overwrite) {
      return make_error(Errc::output_exists, Error::kNone, "the output exists already; pass --overwrite to replace it");
    }
    if ((::GetFileAttributesW(wide(file.path_).c_str()) & FILE_ATTRIBUTE_READONLY) != 0)
      return make_error(Errc::output_unusable, Error::kNone, "the output is read-only");
  }
  std::string temporary = file.path_ + ".tmp-XXXXXX";
  file.fd_ = with_new_name(temporary, [&] { return create_new(temporary, FILE_ATTRIBUTE_NORMAL); });
  if (file.fd_ < 0) {
    return make_error(Errc::write_failed, Error::kNone, "cannot create a file in the output's folder", Error::kNone,
                      Error::kNone, errno);
  }
  file.take_name(std::move(temporary));
  return file;
}

void AtomicFile::take_name(std::string name) {
  temporary_ = std::move(name);
  slot_ = claim_slot(wide(temporary_));
}

void AtomicFile::discard() {
  if (fd_ >= 0) ::close(std::exchange(fd_, -1));
  if (!temporary_.empty()) ::DeleteFileW(wide(temporary_).c_str());
  temporary_.clear();
  release_slot(std::exchange(slot_, -1));
}

Status AtomicFile::reserve(std::uint64_t size) {
  const auto status = detail::status_of(fd_);
  if (status && status->bytes >= size) return {};
  if (status && set_size(fd_, size)) return {};
  if (status) set_errno();
  return make_error(Errc::write_failed, Error::kNone, "cannot reserve space for the output", size, Error::kNone, errno);
}

Status AtomicFile::truncate(std::uint64_t size) {
  if (set_size(fd_, size)) return {};
  return system_error(Errc::write_failed, "cannot set the size of the output");
}

Result<double> AtomicFile::finish() {
  const auto start = std::chrono::steady_clock::now();
  if (options_.sync && ::FlushFileBuffers(handle_of(fd_)) == 0)
    return system_error(Errc::write_failed, "cannot sync the output");
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  if (::close(std::exchange(fd_, -1)) != 0)
    return make_error(Errc::write_failed, Error::kNone, "cannot close the output", Error::kNone, Error::kNone, errno);
  const std::wstring from = wide(temporary_), to = wide(path_);
  // ReplaceFileW() replaces what others have open, and keeps its rights; only an existing file can be replaced.
  if (!options_.overwrite ||
      ::ReplaceFileW(to.c_str(), from.c_str(), nullptr, REPLACEFILE_IGNORE_MERGE_ERRORS | REPLACEFILE_IGNORE_ACL_ERRORS,
                     nullptr, nullptr) == 0) {
    const DWORD replace = options_.overwrite ? MOVEFILE_REPLACE_EXISTING : 0;
    if (::MoveFileExW(from.c_str(), to.c_str(), MOVEFILE_WRITE_THROUGH | replace) == 0) {
      set_errno();
      if (errno == EEXIST) {
        return make_error(Errc::output_exists, Error::kNone,
                          "the output appeared meanwhile; pass --overwrite to replace it");
      }
      return make_error(Errc::write_failed, Error::kNone, "cannot give the output its name", Error::kNone, Error::kNone,
                        errno);
    }
  }
  temporary_.clear();
  release_slot(std::exchange(slot_, -1));
  return seconds;
}

void remove_temporaries_on_signal() {
  ::SetConsoleCtrlHandler(remove_temporaries, TRUE);
}

}  // namespace rgs
