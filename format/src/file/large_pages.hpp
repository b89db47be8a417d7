// large_pages.hpp - memory in pages of 2 MiB, if the system has them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace rgs::detail {

inline constexpr std::size_t kLargePage = std::size_t{2} << 20;

/// Uninitialised memory; null if it runs out. `bytes` is a multiple of `alignment`. With an alignment of kLargePage the
/// system is asked for large pages: first touches of memory spend most of their time on page faults.
void* allocate_aligned(std::size_t alignment, std::size_t bytes);
void free_aligned(void* memory);

}  // namespace rgs::detail
