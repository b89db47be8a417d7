// workers.hpp - runs independent jobs on a few threads. Not on oneTBB, which runtime and converter use: it would be a
// dependency of the format library for one loop whose jobs are whole frames, that starts its threads once a file and,
// unlike tbb::parallel_for, returns the failure of the lowest job. single_thread.cpp is the version without threads.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>

#include "rgs/result.hpp"

namespace rgs::detail {

/// Threads for work on `bytes` when `threads` are allowed: one if starting others costs more than it saves.
constexpr unsigned threads_for(std::uint64_t bytes, unsigned threads) {
  return bytes < (std::uint64_t{1} << 20) ? 1 : threads;
}

/// Threads that run_jobs() uses for `n` jobs; 0: as many as the machine runs at once.
unsigned worker_count(std::uint64_t n, unsigned threads);

/// Calls job(worker, i) for 0 <= i < n, 0 <= worker < worker_count(n, threads); one worker is one thread. Returns the
/// failure of the lowest i, in whatever order they run: jobs below it are never skipped. An exception ends the loop and
/// is rethrown here.
Status run_jobs(std::uint64_t n, unsigned threads, const std::function<Status(unsigned worker, std::uint64_t i)>& job);

}  // namespace rgs::detail
