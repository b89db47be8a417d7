// system_windows.cpp - names and streams on Windows.
// SPDX-License-Identifier: Apache-2.0
#define NOMINMAX
#define WIN32_LEAN_AND_MEAN
#include <fcntl.h>
#include <io.h>
#include <windows.h>
// After windows.h:
#include <shellapi.h>

#include <cstdlib>
#include <cstring>
#include <filesystem>

#include "system.hpp"

namespace rgs::tool {

const char* program_name() {
  static const std::string name = [] {
    std::wstring path(32768, L'\0');
    path.resize(::GetModuleFileNameW(nullptr, path.data(), static_cast<DWORD>(path.size())));
    return std::filesystem::path(path).stem().string();
  }();
  return name.c_str();
}

std::vector<std::string> arguments_of(int, const char* const*) {
  std::vector<std::string> arguments;
  int n = 0;
  wchar_t** const given = ::CommandLineToArgvW(::GetCommandLineW(), &n);
  for (int i = 0; given != nullptr && i < n; ++i) {
    // With its zero.
    std::string& text = arguments.emplace_back(
        static_cast<std::size_t>(::WideCharToMultiByte(CP_UTF8, 0, given[i], -1, nullptr, 0, nullptr, nullptr)), '\0');
    ::WideCharToMultiByte(CP_UTF8, 0, given[i], -1, text.data(), static_cast<int>(text.size()), nullptr, nullptr);
    text.pop_back();
  }
  ::LocalFree(given);
  return arguments;
}

void prepare_standard_streams() {
  for (const int fd : {0, 1, 2}) ::_setmode(fd, _O_BINARY);
  static const UINT before = ::GetConsoleOutputCP();  // the console is the user's afterwards
  ::SetConsoleOutputCP(CP_UTF8);
  std::atexit([] { ::SetConsoleOutputCP(before); });
  DWORD mode = 0;
  const HANDLE messages = ::GetStdHandle(STD_ERROR_HANDLE);
  if (::GetConsoleMode(messages, &mode) != 0) ::SetConsoleMode(messages, mode | ENABLE_VIRTUAL_TERMINAL_PROCESSING);
}

void ignore_closed_pipes() {}

const char* error_text(int error) {
  return std::strerror(error);
}

void allow_open_files(std::size_t) {}

}  // namespace rgs::tool
