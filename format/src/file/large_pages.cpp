// large_pages.cpp - on Linux a hint asks for them.
// SPDX-License-Identifier: Apache-2.0
#include "file/large_pages.hpp"

#include <sys/mman.h>

#include <cstdlib>

namespace rgs::detail {

void* allocate_aligned(std::size_t alignment, std::size_t bytes) {
  void* const memory = std::aligned_alloc(alignment, bytes);
#ifdef MADV_HUGEPAGE
  if (memory != nullptr && alignment == kLargePage) ::madvise(memory, bytes, MADV_HUGEPAGE);
#endif
  return memory;
}

void free_aligned(void* memory) {
  std::free(memory);
}

}  // namespace rgs::detail
