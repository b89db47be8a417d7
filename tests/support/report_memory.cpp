// report_memory.cpp - preloaded into a program with counted_memory.cpp: writes the peak to the file RGS_PEAK_FILE.
// SPDX-License-Identifier: Apache-2.0
#include <cstdio>
#include <cstdlib>

#include "counted_memory.hpp"

[[gnu::destructor]] static void report_memory() {
  const char* const path = std::getenv("RGS_PEAK_FILE");
  if (path == nullptr) return;
  const auto peak = static_cast<long long>(rgs::test::peak_bytes());
  if (std::FILE* const file = std::fopen(path, "w")) {
    std::fprintf(file, "%lld\n", peak);
    std::fclose(file);
  }
}
