// failing_memory.cpp - replaces operator new for the whole program; the linker's --wrap does it for the C functions.
// SPDX-License-Identifier: Apache-2.0
#include "failing_memory.hpp"

#include <zstd.h>
#include <zstd_errors.h>

#include <atomic>
#include <cstdlib>
#include <new>

namespace {

std::atomic<bool> g_armed{false}, g_for_good{false}, g_failed{false};
std::atomic<std::int64_t> g_left{0};

bool fails() {
  if (!g_armed) return false;
  const std::int64_t left = g_left.fetch_sub(1);
  if (left > 0 || (left < 0 && !g_for_good)) return false;
  g_failed = true;
  return true;
}

void* allocate(std::size_t size, std::size_t alignment) {
  void* memory = nullptr;
  if (fails() || ::posix_memalign(&memory, alignment, size == 0 ? 1 : size) != 0) throw std::bad_alloc();
  return memory;
}

}  // namespace

namespace rgs::test {

void fail_after(std::int64_t n, bool for_good) {
  g_left = n;
  g_for_good = for_good;
  g_failed = false;
  g_armed = true;
}

bool stop_failing() {
  g_armed = false;
  return g_failed;
}

}  // namespace rgs::test

// All forms: a sanitizer replaces the missing ones, which would bypass these.
void* operator new(std::size_t size) {
  return allocate(size, alignof(std::max_align_t));
}
void* operator new[](std::size_t size) {
  return allocate(size, alignof(std::max_align_t));
}
void* operator new(std::size_t size, const std::nothrow_t&) noexcept {
  return fails() ? nullptr : std::malloc(size);
}
void* operator new(std::size_t size, std::align_val_t alignment) {
  return allocate(size, static_cast<std::size_t>(alignment));
}
void* operator new[](std::size_t size, std::align_val_t alignment) {
  return allocate(size, static_cast<std::size_t>(alignment));
}
void operator delete(void* memory) noexcept {
  std::free(memory);
}
void operator delete[](void* memory) noexcept {
  std::free(memory);
}
void operator delete(void* memory, const std::nothrow_t&) noexcept {
  std::free(memory);
}
void operator delete(void* memory, std::size_t) noexcept {
  std::free(memory);
}
void operator delete[](void* memory, std::size_t) noexcept {
  std::free(memory);
}
void operator delete(void* memory, std::align_val_t) noexcept {
  std::free(memory);
}
void operator delete[](void* memory, std::align_val_t) noexcept {
  std::free(memory);
}
void operator delete(void* memory, std::size_t, std::align_val_t) noexcept {
  std::free(memory);
}
void operator delete[](void* memory, std::size_t, std::align_val_t) noexcept {
  std::free(memory);
}

extern "C" {
void* __real_aligned_alloc(std::size_t alignment, std::size_t size);
void* __wrap_aligned_alloc(std::size_t alignment, std::size_t size) {
  return fails() ? nullptr : __real_aligned_alloc(alignment, size);
}
void* __real_ZSTD_createCCtx();
void* __wrap_ZSTD_createCCtx() {
  return fails() ? nullptr : __real_ZSTD_createCCtx();
}
std::size_t __real_ZSTD_compressStream2(ZSTD_CCtx* context, ZSTD_outBuffer* out, ZSTD_inBuffer* in,
                                        ZSTD_EndDirective directive);
std::size_t __wrap_ZSTD_compressStream2(ZSTD_CCtx* context, ZSTD_outBuffer* out, ZSTD_inBuffer* in,
                                        ZSTD_EndDirective directive) {
  if (fails()) return std::size_t{0} - static_cast<std::size_t>(ZSTD_error_memory_allocation);
  return __real_ZSTD_compressStream2(context, out, in, directive);
}
void* __real_ZSTD_createDCtx();
void* __wrap_ZSTD_createDCtx() {
  return fails() ? nullptr : __real_ZSTD_createDCtx();
}
}
