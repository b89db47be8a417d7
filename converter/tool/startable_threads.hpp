// startable_threads.hpp - finds out how many threads a process may start, by starting them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace rgs::tool {

/// How many threads can be started beside this one, up to `most`.
inline unsigned startable_threads(unsigned most) {
  std::vector<std::thread> threads;
  threads.reserve(most);
  std::mutex all_started;
  {
    const std::lock_guard hold(all_started);
    try {
      while (threads.size() < most) threads.emplace_back([&all_started] { const std::lock_guard wait(all_started); });
    } catch (const std::system_error&) {
    }
  }
  for (std::thread& thread : threads) thread.join();
  return static_cast<unsigned>(threads.size());
}

}  // namespace rgs::tool
