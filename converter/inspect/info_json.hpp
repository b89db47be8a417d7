// info_json.hpp - the report of rgs-info for programs; docs/user/INFO_JSON.md describes it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "info_report.hpp"

namespace rgs::tool {

/// One ASCII document of schema "rgs-info/1" and a line feed.
std::string info_json(const InfoReport& report);

}  // namespace rgs::tool
