// counted_memory.hpp - what the whole program holds of malloc() and operator new, libraries included.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace rgs::test {

/// False where a sanitizer has the allocator: then nothing is counted.
bool counts_memory();
std::int64_t live_bytes();
/// The most since reset_peak_bytes().
std::int64_t peak_bytes();
void reset_peak_bytes();

}  // namespace rgs::test
