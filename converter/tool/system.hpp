// system.hpp - what the programs take from the system besides files: system_posix.cpp, system_windows.cpp.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>
#include <vector>

namespace rgs::tool {

/// The name by which the program was called, without folder and .exe.
const char* program_name();
/// main()'s arguments, the program's name first; on Windows those of the process, in UTF-8.
std::vector<std::string> arguments_of(int argc, const char* const* argv);
/// Opens something for each closed standard stream, so that no file gets its number and messages are not written there; on
/// Windows makes the streams binary and consoles understand UTF-8 and escape sequences.
void prepare_standard_streams();
/// Makes a write to a closed pipe an error instead of the program's end.
void ignore_closed_pipes();
/// The text of errno `error` in any language setting.
const char* error_text(int error);
/// Raises the limit on open files to at least `n`, where there is one. On failure, opening reports the file.
void allow_open_files(std::size_t n);

}  // namespace rgs::tool
