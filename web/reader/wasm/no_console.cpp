// no_console.cpp - stand-ins for what libc++ ends a program with: it would print first, and so ask JavaScript for files.
// SPDX-License-Identifier: Apache-2.0
#include <__verbose_abort>

extern "C" [[noreturn]] void abort_message(const char*, ...) {
  __builtin_trap();
}

_LIBCPP_BEGIN_NAMESPACE_STD
void __libcpp_verbose_abort(const char*, ...) {
  __builtin_trap();
}
_LIBCPP_END_NAMESPACE_STD
