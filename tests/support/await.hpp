// await.hpp - waits for what other threads and programs do.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <thread>

namespace rgs::test {

/// Returns once the condition holds, however long that takes: ctest ends a test that hangs.
template <class Condition>
void await(const Condition& condition) {
  while (!condition()) std::this_thread::sleep_for(std::chrono::milliseconds(1));
}

}  // namespace rgs::test
