// large_pages.hpp - memory in pages of 2 MiB, if the system has them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace rgs::detail {

inline constexpr std::size_t kLargePage = std::size_t{2} << 20;

/// A hint: first touches of memory spend most of their time on page faults. Both arguments are multiples of kLargePage.
void ask_for_large_pages(void* memory, std::size_t bytes);

}  // namespace rgs::detail
