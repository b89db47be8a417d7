// audit_report.hpp - an audit as one HTML file.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <string>

#include "audit.hpp"

namespace rgs::audit {

inline constexpr std::size_t kMaxReportBytes = 15'000'000;

/// A self-contained page, pictures included: needs no other file and no network. At most kMaxReportBytes. Opened with
/// #self-test it tests itself and leaves the outcome in <html data-self-test="...">, "ok" or what failed.
std::string audit_html(const Report& report);

/// Whether `page` is one of audit_html(); or the one of the run with this fingerprint.
bool is_audit_page(const std::string& page);
bool is_audit_page_of(const std::string& page, const std::string& fingerprint);

/// An earlier page of the run with this fingerprint, with another gate. None if it is no such page.
std::optional<std::string> with_gate(const std::string& page, const std::string& fingerprint, const Verdict& verdict,
                                     std::span<const Condition> gate);

}  // namespace rgs::audit
