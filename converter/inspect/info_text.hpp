// info_text.hpp - the report of rgs-info for people.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "info_report.hpp"

namespace rgs::tool {

/// Aligned lines of at most about 125 columns. Text from the file is escaped. `ascii`: only ASCII. Excludes the error,
/// which belongs on standard error.
std::string info_text(const InfoReport& report, bool ascii);

}  // namespace rgs::tool
