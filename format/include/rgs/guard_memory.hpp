// guard_memory.hpp - turns exceptions of failed allocations into values at the edge of the API.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <new>
#include <stdexcept>

#include "rgs/result.hpp"

namespace rgs::detail {

inline tl::unexpected<Error> out_of_memory() {
  return make_error(Errc::host_out_of_memory, Error::kNone, "memory has run out");
}

/// Ends as a failed allocation does.
[[noreturn]] inline void fail_allocation() {
#if defined(__cpp_exceptions)
  throw std::bad_alloc();
#else
  if (const std::new_handler handler = std::get_new_handler(); handler != nullptr) handler();
  std::abort();
#endif
}

/// f(), a Result or Status, or host_out_of_memory if an allocation fails: wraps the body of every public function that
/// allocates. Without exceptions, as for WebAssembly, a failed allocation ends the program.
template <class F>
auto guard_memory(const F& f) -> decltype(f()) {
#if defined(__cpp_exceptions)
  try {
    return f();
  } catch (const std::bad_alloc&) {
    return out_of_memory();
  } catch (const std::length_error&) {  // a container cannot be this large
    return out_of_memory();
  }
#else
  return f();
#endif
}

}  // namespace rgs::detail
