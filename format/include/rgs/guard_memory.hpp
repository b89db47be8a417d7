// guard_memory.hpp - where the library's exceptions end: memory that runs out becomes a value at the edge of the API.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <new>
#include <stdexcept>

#include "rgs/result.hpp"

namespace rgs::detail {

inline tl::unexpected<Error> out_of_memory() {
  return make_error(Errc::host_out_of_memory, Error::kNone, "the process gets no more memory");
}

/// f(), a Result or Status, or host_out_of_memory if it cannot allocate: around the body of every public function that
/// allocates. Where exceptions are switched off, as for WebAssembly, an allocation that fails ends the program.
template <class F>
auto guard_memory(const F& f) -> decltype(f()) {
#if defined(__cpp_exceptions)
  try {
    return f();
  } catch (const std::bad_alloc&) {
    return out_of_memory();
  } catch (const std::length_error&) {  // of a container that cannot be as large
    return out_of_memory();
  }
#else
  return f();
#endif
}

}  // namespace rgs::detail
