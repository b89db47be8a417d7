// complexity.hpp - how the time of something grows with its input: by the ratio of two sizes, never by seconds.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <time.h>

#include <algorithm>
#include <cstdint>
#include <limits>

namespace rgs::test {

/// CPU time of this process so far, all threads together: other programs on the machine do not count. With the system's
/// part: Linux divides the two by what the clock's ticks happened to see, and the user's part of 51 ms has been 31.
inline double cpu_seconds() {
  timespec now{};
  ::clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

/// How many times as large the larger input is. Four times would tell 4 from 16, and inputs that leave a cache can take twice
/// as long.
inline constexpr std::uint64_t kGrowthFactor = 16;

/// `prepare(n)` makes an input of size n, `work(input)` is what is timed. Returns the time of 16n over that of n, each the
/// least of several: about 16 where time is linear, 256 where it is quadratic. Short work is repeated until it takes 20 ms.
/// What disturbs adds time and never takes any away, so a ratio of twice the linear one is measured again.
template <class Prepare, class Work>
double growth(std::uint64_t n, const Prepare& prepare, const Work& work) {
  constexpr double kLeastSeconds = 0.02;
  constexpr int kRounds = 3, kMostRounds = 9;
  const auto small = prepare(n), large = prepare(kGrowthFactor * n);
  const auto seconds = [&work](const auto& input, std::uint64_t times) {
    const double start = cpu_seconds();
    for (std::uint64_t i = 0; i < times; ++i) work(input);
    return (cpu_seconds() - start) / static_cast<double>(times);
  };
  std::uint64_t times = 1;
  while (seconds(small, times) * static_cast<double>(times) < kLeastSeconds && times < (std::uint64_t{1} << 20)) {
    times *= 2;
  }
  double least_small = std::numeric_limits<double>::infinity(), least_large = least_small;
  for (int i = 0; i < kRounds || (i < kMostRounds && least_large > 2 * kGrowthFactor * least_small); ++i) {
    least_small = std::min(least_small, seconds(small, times));
    least_large = std::min(least_large, seconds(large, std::max<std::uint64_t>(times / kGrowthFactor, 1)));
  }
  return least_large / least_small;
}

/// Half way between linear and quadratic, as powers go.
inline constexpr double kLinearGrowth = 64;

}  // namespace rgs::test
