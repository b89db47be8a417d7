// complexity.hpp - how the time of something grows with its input: by the ratio of two sizes, never by seconds.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sys/resource.h>

#include <algorithm>
#include <cstdint>
#include <limits>

namespace rgs::test {

/// User CPU time of this process so far, all threads together: other programs on the machine do not count.
inline double user_seconds() {
  rusage usage{};
  ::getrusage(RUSAGE_SELF, &usage);
  return static_cast<double>(usage.ru_utime.tv_sec) + 1e-6 * static_cast<double>(usage.ru_utime.tv_usec);
}

/// `prepare(n)` makes an input of size n, `work(input)` is what is timed. Returns the time of 4n over that of n, each the
/// least of five: about 4 where time is linear, 16 where it is quadratic. Short work is repeated until it takes 20 ms, so
/// that the clock's grain does not show.
template <class Prepare, class Work>
double growth(std::uint64_t n, const Prepare& prepare, const Work& work) {
  constexpr double kLeastSeconds = 0.02;
  const auto small = prepare(n), large = prepare(4 * n);
  const auto seconds = [&work](const auto& input, std::uint64_t times) {
    const double start = user_seconds();
    for (std::uint64_t i = 0; i < times; ++i) work(input);
    return user_seconds() - start;
  };
  std::uint64_t times = 1;
  while (seconds(small, times) < kLeastSeconds && times < (std::uint64_t{1} << 20)) times *= 2;
  double least_small = std::numeric_limits<double>::infinity(), least_large = least_small;
  for (int i = 0; i < 4; ++i) {
    least_small = std::min(least_small, seconds(small, times) / static_cast<double>(times));
    const std::uint64_t times_large = std::max<std::uint64_t>(times / 4, 1);
    least_large = std::min(least_large, seconds(large, times_large) / static_cast<double>(times_large));
  }
  return least_large / least_small;
}

/// Between linear (4; 4.5 with a logarithm) and quadratic (16), with room for caches that no longer suffice.
inline constexpr double kLinearGrowth = 9;

}  // namespace rgs::test
