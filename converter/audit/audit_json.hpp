// audit_json.hpp - an audit for programs; docs/AUDIT_JSON.md describes it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "audit.hpp"

namespace rgs::audit {

/// Schema "rgs-audit/2", ASCII, "\n" at the end.
std::string audit_json(const Report& report);

}  // namespace rgs::audit
