// complexity.hpp - growth of work with its input: the ratio of instruction counts at two sizes, counted by valgrind, so
// that neither the machine's speed nor its load matters.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>
#include <unistd.h>
#if __has_include(<valgrind/callgrind.h>)
#include <valgrind/callgrind.h>
#else  // the cases fail and say what to install
#define RUNNING_ON_VALGRIND 0
#define CALLGRIND_START_INSTRUMENTATION
#define CALLGRIND_STOP_INSTRUMENTATION
#define CALLGRIND_DUMP_STATS
#endif

#include <cstdint>
#include <fstream>
#include <string>

// In place of libhwy's own, which its initializer calls: valgrind lacks an instruction of that on some processors.
namespace hwy::platform {
[[gnu::used, gnu::visibility("default")]] inline std::uint64_t TimerResolution() {
  return 1;
}
}  // namespace hwy::platform

namespace rgs::test {

/// Ratio of the two input sizes. Four would hardly separate n log n from n squared.
inline constexpr std::uint64_t kGrowthFactor = 16;

/// Halfway between linear and quadratic, by exponent.
inline constexpr double kLinearGrowth = 64;

/// `prepare(n)` makes an input of size n. Counts the instructions of `work(input)`, not of prepare(). Returns the count
/// at 16n over that at n: about 16 for linear work, 256 for quadratic. For cases named "growth: ...", which ctest runs
/// by tests/support/count_work.sh.
template <class Prepare, class Work>
double growth(std::uint64_t n, const Prepare& prepare, const Work& work) {
  REQUIRE_MESSAGE(RUNNING_ON_VALGRIND,
                  "run it by tests/support/count_work.sh, and build with Debian's valgrind installed");
  const auto instructions = [&](std::uint64_t size) {
    const auto input = prepare(size);
    CALLGRIND_START_INSTRUMENTATION;
    work(input);
    CALLGRIND_STOP_INSTRUMENTATION;
    CALLGRIND_DUMP_STATS;  // and restart at 0
    static int n_dumps = 0;
    std::ifstream dump("callgrind.out." + std::to_string(::getpid()) + "." + std::to_string(++n_dumps));
    double total = 0;
    for (std::string line; std::getline(dump, line);) {
      if (line.starts_with("totals: ")) total = std::stod(line.substr(8));
    }
    REQUIRE(total > 0);
    return total;
  };
  const double small = instructions(n);
  return instructions(kGrowthFactor * n) / small;
}

}  // namespace rgs::test
