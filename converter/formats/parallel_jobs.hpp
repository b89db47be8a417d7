// parallel_jobs.hpp - independent jobs on a few threads; oneTBB would be a dependency of the library for one format.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <future>
#include <thread>
#include <vector>

namespace rgs::detail {

/// Calls job(i) for 0 <= i < n on `threads` threads (0: as many as the machine runs at once); rethrows an exception.
template <class Job>
void run_in_parallel(std::size_t n, unsigned threads, const Job& job) {
  std::atomic<std::size_t> next = 0;
  const auto work = [&] {
    for (std::size_t i = next++; i < n; i = next++) job(i);
  };
  const std::size_t wanted = threads != 0 ? threads : std::max(1U, std::thread::hardware_concurrency());
  std::vector<std::future<void>> others;
  for (std::size_t i = 1; i < std::min(wanted, n); ++i) {
    others.push_back(std::async(std::launch::async | std::launch::deferred, work));
  }
  work();
  for (auto& other : others) other.get();
}

}  // namespace rgs::detail
