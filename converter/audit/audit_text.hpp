// audit_text.hpp - an audit's summary for the terminal.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "audit.hpp"

namespace rgs::audit {

/// "54.32 dB"; "identical" for infinity, "not rated" for NaN.
std::string format_psnr(double psnr);
/// Lines for a person, the verdict last. It names `report_path` if not empty.
std::string audit_text(const Report& report, const std::string& report_path);

}  // namespace rgs::audit
