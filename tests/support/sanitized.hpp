// sanitized.hpp - whether a test was built with a sanitizer, which adds memory and time.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define RGS_TEST_SANITIZED 1
#elif defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define RGS_TEST_SANITIZED 1
#endif
#endif

#if defined(__SANITIZE_ADDRESS__)
#define RGS_TEST_ADDRESS_SANITIZED 1
#elif defined(__has_feature)
#if __has_feature(address_sanitizer)
#define RGS_TEST_ADDRESS_SANITIZED 1
#endif
#endif

namespace rgs::test {

#ifdef RGS_TEST_SANITIZED
inline constexpr bool kSanitized = true;
#else
inline constexpr bool kSanitized = false;
#endif

}  // namespace rgs::test
