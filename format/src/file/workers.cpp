// workers.cpp - runs independent jobs on a few threads.
// SPDX-License-Identifier: Apache-2.0
#include "file/workers.hpp"

#include <algorithm>
#include <atomic>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace rgs::detail {

unsigned worker_count(std::uint64_t n, unsigned threads) {
  const unsigned wanted = threads != 0 ? threads : std::max(1u, std::thread::hardware_concurrency());
  return static_cast<unsigned>(std::min<std::uint64_t>(wanted, std::max<std::uint64_t>(n, 1)));
}

Status run_jobs(std::uint64_t n, unsigned threads, const std::function<Status(unsigned worker, std::uint64_t i)>& job) {
  std::atomic<std::uint64_t> next{0}, end{n};
  std::mutex failing;
  std::uint64_t failed_at = n;
  Status status;
  std::exception_ptr exception;
  // Jobs are handed out in order, so all jobs below a failure have started before it lowers the end.
  const auto work = [&](unsigned worker) {
    try {
      for (std::uint64_t i = next++; i < end; i = next++) {
        const Status s = job(worker, i);
        if (s) continue;
        const std::lock_guard lock(failing);
        if (i < failed_at) {
          failed_at = i;
          status = s;
          end = i;
        }
      }
    } catch (...) {
      const std::lock_guard lock(failing);
      exception = std::current_exception();
      end = 0;
    }
  };
  std::vector<std::thread> others;
  const unsigned count = worker_count(n, threads);
  others.reserve(count);
  try {
    for (unsigned worker = 1; worker < count; ++worker) others.emplace_back(work, worker);
  } catch (...) {  // no more threads, or no memory for one: the existing ones do the work
  }
  work(0);
  for (std::thread& thread : others) thread.join();
  if (exception) std::rethrow_exception(exception);
  return status;
}

}  // namespace rgs::detail
