// workers.hpp - independent jobs on a few threads. Not on oneTBB, which runtime and converter use: the format library
// would take a dependency along wherever it goes, for one loop whose jobs are whole frames, that starts its threads once
// a file and, unlike tbb::parallel_for, returns the failure of the lowest job. single_thread.cpp does without threads.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>

#include "rgs/result.hpp"

namespace rgs::detail {

/// Threads for work on `bytes` when `threads` are allowed: one while starting others would take longer than they save.
constexpr unsigned threads_for(std::uint64_t bytes, unsigned threads) {
  return bytes < (std::uint64_t{1} << 20) ? 1 : threads;
}

/// How many threads run_jobs() will use for `n` jobs; 0 asks for as many as the machine runs at once.
unsigned worker_count(std::uint64_t n, unsigned threads);

/// Calls job(worker, i) for 0 <= i < n, 0 <= worker < worker_count(n, threads); one worker is one thread. The failure
/// of the lowest i is returned, whatever the order in which they run: jobs below it are never skipped. An exception
/// ends the loop and is thrown again here.
Status run_jobs(std::uint64_t n, unsigned threads, const std::function<Status(unsigned worker, std::uint64_t i)>& job);

}  // namespace rgs::detail
