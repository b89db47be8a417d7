// counted_memory.cpp - replaces glibc's malloc() and its siblings, which every other allocator of the program calls.
// SPDX-License-Identifier: Apache-2.0
#include "counted_memory.hpp"

#include <malloc.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>

#include "sanitized.hpp"

#ifdef RGS_TEST_ADDRESS_SANITIZED
#include <sanitizer/allocator_interface.h>
#endif

namespace {

std::atomic<std::int64_t> g_live{0}, g_peak{0};

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
}

namespace {

// Precedes the caller's memory. Requested bytes count, because what an allocator adds is its own affair.
struct alignas(16) Head {
  std::size_t size, offset;  // of the caller's memory in libc's
};

Head& head_of(void* memory) {
  return static_cast<Head*>(memory)[-1];
}

void* base_of(void* memory) {
  return static_cast<std::byte*>(memory) - head_of(memory).offset;
}

bool has_room(std::size_t size) {
  static const char* const limit = std::getenv("RGS_MOST_BYTES");
  static const std::int64_t most = limit == nullptr ? std::numeric_limits<std::int64_t>::max() : std::atoll(limit);
  if (size <= static_cast<std::size_t>(std::max<std::int64_t>(0, most - g_live))) return true;
  errno = ENOMEM;
  return false;
}

void* counted(void* base, std::size_t size, std::size_t offset) {
  if (base == nullptr) return nullptr;
  void* const memory = static_cast<std::byte*>(base) + offset;
  head_of(memory) = {size, offset};
  const auto added = static_cast<std::int64_t>(size);
  const std::int64_t live = g_live.fetch_add(added, std::memory_order_relaxed) + added;
  std::int64_t peak = g_peak.load(std::memory_order_relaxed);
  while (peak < live && !g_peak.compare_exchange_weak(peak, live, std::memory_order_relaxed)) {
  }
  return memory;
}

void uncounted(std::size_t size) {
  g_live.fetch_sub(static_cast<std::int64_t>(size), std::memory_order_relaxed);
}

}  // namespace

extern "C" {
void* malloc(std::size_t size) {
  return has_room(size) ? counted(libc_malloc(size + sizeof(Head)), size, sizeof(Head)) : nullptr;
}
void* calloc(std::size_t n, std::size_t size) {
  if (size > 0 && n > (PTRDIFF_MAX - sizeof(Head)) / size) {
    errno = ENOMEM;
    return nullptr;
  }
  return has_room(n * size) ? counted(libc_calloc(1, n * size + sizeof(Head)), n * size, sizeof(Head)) : nullptr;
}
void* realloc(void* memory, std::size_t size) {
  if (memory == nullptr) return malloc(size);
  const auto [before, offset] = head_of(memory);
  if (size > before && !has_room(size - before)) return nullptr;
  if (offset != sizeof(Head)) {
    void* const moved = malloc(size);
    if (moved != nullptr) std::memcpy(moved, memory, std::min(before, size));
    if (moved != nullptr) free(memory);
    return moved;
  }
  void* const moved = libc_realloc(base_of(memory), size + sizeof(Head));
  if (moved == nullptr) return nullptr;
  uncounted(before);
  return counted(moved, size, sizeof(Head));
}
void* memalign(std::size_t alignment, std::size_t size) {
  const std::size_t offset = std::max(alignment, sizeof(Head));
  return has_room(size) ? counted(libc_memalign(offset, size + offset), size, offset) : nullptr;
}
void* aligned_alloc(std::size_t alignment, std::size_t size) {
  return memalign(alignment, size);
}
int posix_memalign(void** memory, std::size_t alignment, std::size_t size) {
  void* const made = memalign(alignment, size);
  if (made == nullptr) return ENOMEM;
  *memory = made;
  return 0;
}
std::size_t malloc_usable_size(void* memory) {
  return memory == nullptr ? 0 : head_of(memory).size;
}
void free(void* memory) {
  if (memory == nullptr) return;
  const int error = errno;
  uncounted(head_of(memory).size);
  libc_free(base_of(memory));
  errno = error;
}
}
#endif
