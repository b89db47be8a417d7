// audit_report.hpp - an audit as one HTML file.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

#include "audit.hpp"

namespace rgs::audit {

inline constexpr std::size_t kMaxReportBytes = 15'000'000;

/// A page with everything in it, pictures too: no other file and no network is needed. At most kMaxReportBytes.
/// Opened with #self-test it tries itself and leaves the outcome in <html data-self-test="...">, "ok" or what failed.
std::string audit_html(const Report& report);

}  // namespace rgs::audit
