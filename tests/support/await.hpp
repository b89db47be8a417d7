// await.hpp - waits for other threads and programs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <thread>

namespace rgs::test {

/// Returns once the condition holds, without a limit: ctest ends a test that hangs.
template <class Condition>
void await(const Condition& condition) {
  while (!condition()) std::this_thread::sleep_for(std::chrono::milliseconds(1));
}

}  // namespace rgs::test
