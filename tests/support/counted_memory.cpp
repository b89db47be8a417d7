// counted_memory.cpp - replaces glibc's malloc() and its siblings, which every other allocator of the program calls.
// SPDX-License-Identifier: Apache-2.0
#include "counted_memory.hpp"

#include <malloc.h>

#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdlib>

#include "sanitized.hpp"

#ifdef RGS_TEST_ADDRESS_SANITIZED
#include <sanitizer/allocator_interface.h>
#endif

namespace {

std::atomic<std::int64_t> g_live{0}, g_peak{0};
constexpr std::int64_t kHeader = 8;  // of glibc, besides what can be used

[[maybe_unused]] void* counted(void* memory) {
  if (memory == nullptr) return memory;
  const auto size = static_cast<std::int64_t>(::malloc_usable_size(memory)) + kHeader;
  const std::int64_t live = g_live.fetch_add(size, std::memory_order_relaxed) + size;
  std::int64_t peak = g_peak.load(std::memory_order_relaxed);
  while (peak < live && !g_peak.compare_exchange_weak(peak, live, std::memory_order_relaxed)) {
  }
  return memory;
}

[[maybe_unused]] void uncounted(void* memory) {
  if (memory == nullptr) return;
  g_live.fetch_sub(static_cast<std::int64_t>(::malloc_usable_size(memory)) + kHeader, std::memory_order_relaxed);
}

}  // namespace

namespace rgs::test {

bool counts_memory() {
  return !kSanitized;
}
bool counts_live_memory() {
#ifdef RGS_TEST_ADDRESS_SANITIZED
  return true;
#else
  return counts_memory();
#endif
}
std::int64_t live_bytes() {
#ifdef RGS_TEST_ADDRESS_SANITIZED
  return static_cast<std::int64_t>(__sanitizer_get_current_allocated_bytes());
#else
  return g_live;
#endif
}
std::int64_t peak_bytes() {
  return g_peak;
}
void reset_peak_bytes() {
  g_peak = g_live.load();
}

}  // namespace rgs::test

#ifndef RGS_TEST_SANITIZED
extern "C" {
// Under other names, because clang refuses declarations of reserved ones.
void* libc_malloc(std::size_t size) __asm__("__libc_malloc");
void* libc_calloc(std::size_t n, std::size_t size) __asm__("__libc_calloc");
void* libc_realloc(void* memory, std::size_t size) __asm__("__libc_realloc");
void* libc_memalign(std::size_t alignment, std::size_t size) __asm__("__libc_memalign");
void libc_free(void* memory) __asm__("__libc_free");

void* malloc(std::size_t size) {
  return counted(libc_malloc(size));
}
void* calloc(std::size_t n, std::size_t size) {
  return counted(libc_calloc(n, size));
}
void* realloc(void* memory, std::size_t size) {
  const std::size_t before = memory == nullptr ? 0 : ::malloc_usable_size(memory);
  void* const moved = libc_realloc(memory, size);
  if (moved == nullptr && size > 0) return moved;
  if (memory != nullptr) g_live.fetch_sub(static_cast<std::int64_t>(before) + kHeader, std::memory_order_relaxed);
  return counted(moved);
}
void* memalign(std::size_t alignment, std::size_t size) {
  return counted(libc_memalign(alignment, size));
}
void* aligned_alloc(std::size_t alignment, std::size_t size) {
  return counted(libc_memalign(alignment, size));
}
int posix_memalign(void** memory, std::size_t alignment, std::size_t size) {
  void* const made = libc_memalign(alignment, size);
  if (made == nullptr) return ENOMEM;
  *memory = counted(made);
  return 0;
}
void free(void* memory) {
  const int error = errno;
  uncounted(memory);
  libc_free(memory);
  errno = error;
}
}
#endif
