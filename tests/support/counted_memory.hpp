// counted_memory.hpp - memory of the whole program from malloc() and operator new, libraries included.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace rgs::test {

/// False where a sanitizer replaces the allocator: then peaks are not counted.
bool counts_memory();
/// False under a sanitizer that counts nothing.
bool counts_live_memory();
std::int64_t live_bytes();
/// Maximum since reset_peak_bytes().
std::int64_t peak_bytes();
void reset_peak_bytes();

}  // namespace rgs::test
