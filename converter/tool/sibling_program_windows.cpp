// sibling_program_windows.cpp - CreateProcess().
// SPDX-License-Identifier: Apache-2.0
#define NOMINMAX
#define WIN32_LEAN_AND_MEAN
#include <io.h>
#include <windows.h>

#include <cerrno>
#include <filesystem>
#include <system_error>

#include "rgs/file.hpp"
#include "rgs/utf8_path.hpp"
#include "sibling_program.hpp"

namespace rgs::tool {
namespace {

constexpr std::size_t kLongestPath = 32768;  // of the system, in UTF-16

tl::unexpected<Error> cannot_start() {
  return make_error(Errc::internal, Error::kNone, "cannot start the program", Error::kNone, Error::kNone,
                    std::system_category().default_error_condition(static_cast<int>(::GetLastError())).value());
}

// As CommandLineToArgvW() and the C library take arguments apart: backslashes before a quote are doubled.
std::wstring quoted(const std::string& argument) {
  std::wstring out = L"\"";
  std::size_t n_backslashes = 0;
  const std::wstring wide = detail::path_of(argument).native();
  for (const wchar_t c : wide) {
    if (c == L'"') out.append(n_backslashes + 1, L'\\');
    n_backslashes = c == L'\\' ? n_backslashes + 1 : 0;
    out += c;
  }
  out.append(n_backslashes, L'\\');
  return out + L'"';
}

}  // namespace

Result<std::string> program_folder() {
  std::wstring self(kLongestPath, L'\0');
  self.resize(::GetModuleFileNameW(nullptr, self.data(), kLongestPath));
  return std::filesystem::path(self).parent_path().string();
}

Result<std::string> sibling_program(const std::string& name) {
  return program_folder().and_then([&](const std::string& folder) -> Result<std::string> {
    std::string path = folder + "/" + name + ".exe";
    if (!detail::status_of(path))
      return make_error(Errc::open_failed, Error::kNone,
                        "the program is not beside this one; install both into one folder", Error::kNone, Error::kNone,
                        errno);
    return path;
  });
}

Result<int> run_program_and_wait(const std::string& path, const std::vector<std::string>& arguments, int output) {
  std::wstring line = quoted(path);
  for (const std::string& argument : arguments) line += L" " + quoted(argument);
  const HANDLE self = ::GetCurrentProcess();
  STARTUPINFOW start{};
  start.cb = sizeof start;
  start.dwFlags = STARTF_USESTDHANDLES;
  start.hStdInput = ::GetStdHandle(STD_INPUT_HANDLE);
  start.hStdError = ::GetStdHandle(STD_ERROR_HANDLE);
  if (::DuplicateHandle(self, reinterpret_cast<HANDLE>(::_get_osfhandle(output)), self, &start.hStdOutput, 0, TRUE,
                        DUPLICATE_SAME_ACCESS) == 0)
    return cannot_start();
  PROCESS_INFORMATION process{};
  const BOOL started = ::CreateProcessW(detail::path_of(path).c_str(), line.data(), nullptr, nullptr, TRUE, 0, nullptr,
                                        nullptr, &start, &process);
  ::CloseHandle(start.hStdOutput);
  if (started == 0) return cannot_start();
  DWORD code = 0;
  const bool ended = ::WaitForSingleObject(process.hProcess, INFINITE) == WAIT_OBJECT_0 &&
                     ::GetExitCodeProcess(process.hProcess, &code);
  ::CloseHandle(process.hThread);
  ::CloseHandle(process.hProcess);
  if (!ended) return cannot_start();
  return static_cast<int>(code);
}

// Files here have names.
NameForPrograms::NameForPrograms(int fd) {
  std::wstring name(kLongestPath, L'\0');
  name.resize(::GetFinalPathNameByHandleW(reinterpret_cast<HANDLE>(::_get_osfhandle(fd)), name.data(), kLongestPath,
                                          FILE_NAME_NORMALIZED));
  path_ = std::filesystem::path(name).string();
  if (path_.empty()) errno = EIO;
}

NameForPrograms::~NameForPrograms() = default;

}  // namespace rgs::tool
