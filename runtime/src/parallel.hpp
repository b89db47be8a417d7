// parallel.hpp - loops over index ranges on oneTBB's threads.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/partitioner.h>

#include <atomic>
#include <cstdint>

namespace rgs::detail {

/// Calls f(begin, end) for ranges of at most `grain` that partition [0, n), on the threads of the current arena, and
/// returns when all are done. f sees what the caller wrote before; the caller then sees what f wrote.
template <class F>
void parallel_ranges(std::uint64_t n, std::uint64_t grain, const F& f) {
  // oneTBB guarantees that order. It is repeated here for ThreadSanitizer, since distributions ship the library without
  // instrumentation; it costs one atomic addition a range.
  std::atomic<bool> begun{false};
  std::atomic<std::uint64_t> n_done{0};  // a second variable: one would order the ranges among themselves
  begun.store(true, std::memory_order_release);
  using Range = tbb::blocked_range<std::uint64_t>;
  const auto body = [&begun, &n_done, &f](const Range& range) {
    (void)begun.load(std::memory_order_acquire);
    f(range.begin(), range.end());
    n_done.fetch_add(1, std::memory_order_release);
  };
  tbb::parallel_for(Range(0, n, grain), body, tbb::simple_partitioner());
  (void)n_done.load(std::memory_order_acquire);
}

/// Calls f(i) for 0 <= i < n; each call is a task.
template <class F>
void parallel_blocks(std::uint64_t n, const F& f) {
  parallel_ranges(n, 1, [&f](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) f(i);
  });
}

}  // namespace rgs::detail
