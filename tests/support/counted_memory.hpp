// counted_memory.hpp - what the whole program holds of malloc() and operator new, libraries included.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace rgs::test {

/// False where a sanitizer has the allocator: then peaks are not counted.
bool counts_memory();
/// False under a sanitizer that does not count either.
bool counts_live_memory();
std::int64_t live_bytes();
/// The most since reset_peak_bytes().
std::int64_t peak_bytes();
void reset_peak_bytes();

}  // namespace rgs::test
