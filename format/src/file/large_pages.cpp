// large_pages.cpp - the hint on Linux.
// SPDX-License-Identifier: Apache-2.0
#include "file/large_pages.hpp"

#include <sys/mman.h>

namespace rgs::detail {

void ask_for_large_pages([[maybe_unused]] void* memory, [[maybe_unused]] std::size_t bytes) {
#ifdef MADV_HUGEPAGE
  ::madvise(memory, bytes, MADV_HUGEPAGE);
#endif
}

}  // namespace rgs::detail
