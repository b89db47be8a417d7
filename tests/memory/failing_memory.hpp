// failing_memory.hpp - allocations that fail on demand: operator new, aligned_alloc() and Zstandard's contexts.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <cstdint>
#include <fstream>
#include <iterator>
#include <span>
#include <string>
#include <vector>

#include "checkout.hpp"
#include "rgs/checksum.hpp"
#include "rgs/result.hpp"

namespace rgs::test {

/// The next `n` allocations of any thread succeed; then the next one fails, or all do.
void fail_after(std::int64_t n, bool for_good);
/// All succeed again. Returns whether any failed.
bool stop_failing();

/// Calls f() repeatedly: each allocation fails in turn, alone and with all that follow; from the 64th on, only some do.
/// f returns a hash of its result, or its error. Each time it must be the undisturbed hash or host_out_of_memory.
/// Returns the number of allocations. Not for code with nlohmann's JSON (camera JSON, glb, SOG), which allocates in
/// destructors, where a failure ends the program.
template <class F>
std::int64_t fail_each_allocation(const F& f) {
  const Result<std::uint64_t> undisturbed = f();
  REQUIRE(undisturbed);
  std::int64_t n_refused = 0;
  for (std::int64_t n = 0;; n += 1 + n / 64) {
    bool failed = false;
    for (const bool for_good : {false, true}) {
      fail_after(n, for_good);
      const Result<std::uint64_t> made = f();
      failed = stop_failing();
      CAPTURE(n);
      CAPTURE(for_good);
      if (made) {
        REQUIRE(*made == *undisturbed);
      } else {
        REQUIRE(failed);
        REQUIRE(made.error().code == Errc::host_out_of_memory);
        ++n_refused;
      }
    }
    if (!failed) {
      CHECK(n_refused > 0);
      return n;
    }
  }
}

inline std::uint64_t hash_of(std::span<const std::byte> bytes) {
  return xxh3(bytes);
}
template <class T>
std::uint64_t hash_of(const std::vector<T>& values) {
  return xxh3(std::as_bytes(std::span(values)));
}

inline std::vector<std::byte> file_bytes(const std::string& path) {
  std::ifstream in(source_dir() + "/tests/" + path, std::ios::binary);
  const std::string text{std::istreambuf_iterator<char>(in), {}};
  REQUIRE_FALSE(text.empty());
  const auto bytes = std::as_bytes(std::span(text));
  return {bytes.begin(), bytes.end()};
}

}  // namespace rgs::test
