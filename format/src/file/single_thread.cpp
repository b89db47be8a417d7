// single_thread.cpp - replaces workers.cpp and large_pages.cpp on platforms without threads: runs every job on the
// caller's thread.
// SPDX-License-Identifier: Apache-2.0
#include <cstdlib>

#include "file/large_pages.hpp"
#include "file/workers.hpp"

namespace rgs::detail {

unsigned worker_count(std::uint64_t, unsigned) {
  return 1;
}

Status run_jobs(std::uint64_t n, unsigned, const std::function<Status(unsigned worker, std::uint64_t i)>& job) {
  for (std::uint64_t i = 0; i < n; ++i) {
    if (Status s = job(0, i); !s) return s;
  }
  return {};
}

void* allocate_aligned(std::size_t alignment, std::size_t bytes) {
  return std::aligned_alloc(alignment, bytes);
}

void free_aligned(void* memory) {
  std::free(memory);
}

}  // namespace rgs::detail
