// convert_summary.hpp - a conversion's summary as text and as JSON.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "convert.hpp"

namespace rgs {

/// Lines for a person, "\n" after each.
std::string summary_text(const ConvertSummary& summary);
/// Schema "rgs-convert/1": docs/user/CONVERT_JSON.md.
std::string summary_json(const ConvertSummary& summary);

}  // namespace rgs
