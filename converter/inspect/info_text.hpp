// info_text.hpp - the report of rgs-info for people.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "info_report.hpp"

namespace rgs::tool {

/// Aligned lines of at most about 125 columns. Text from the file is escaped. `ascii`: nothing but ASCII.
/// The error is not part of the text: it belongs to standard error.
std::string info_text(const InfoReport& report, bool ascii);

}  // namespace rgs::tool
