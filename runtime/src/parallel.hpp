// parallel.hpp - loops over index ranges on oneTBB's threads.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <atomic>
#include <cstdint>

namespace rgs::detail {

/// Calls f(begin, end) for ranges that cut [0, n), about `grain` long, on the threads of the current arena; returns
/// when all are done. What the caller wrote before is seen by f, and what f wrote is seen by the caller after.
template <class F>
void parallel_ranges(std::uint64_t n, std::uint64_t grain, const F& f) {
  // oneTBB guarantees that order by itself. It is stated once more in terms that ThreadSanitizer sees, because
  // distributions ship the library without instrumentation; the cost is one atomic addition per range.
  std::atomic<std::uint64_t> order{0};
  order.store(1, std::memory_order_release);
  using Range = tbb::blocked_range<std::uint64_t>;
  tbb::parallel_for(Range(0, n, grain), [&order, &f](const Range& range) {
    (void)order.load(std::memory_order_acquire);
    f(range.begin(), range.end());
    order.fetch_add(1, std::memory_order_release);
  });
  (void)order.load(std::memory_order_acquire);
}

/// Calls f(i) for 0 <= i < n; each call is worth a task of its own.
template <class F>
void parallel_blocks(std::uint64_t n, const F& f) {
  parallel_ranges(n, 1, [&f](std::uint64_t begin, std::uint64_t end) {
    for (std::uint64_t i = begin; i < end; ++i) f(i);
  });
}

}  // namespace rgs::detail
