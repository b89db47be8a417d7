// no_console.cpp - replaces functions of libc++ that print before they abort, which would need files from JavaScript.
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
