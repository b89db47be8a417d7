// audit_json.hpp - an audit for programs; docs/user/AUDIT_JSON.md describes it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "audit.hpp"

namespace rgs::audit {

/// Schema "rgs-audit/2", ASCII, "\n" at the end.
std::string audit_json(const Report& report);

/// An audit that was written before, under other conditions.
struct EarlierAudit {
  std::string json;  ///< of the same measurements and these conditions
  bool changed = false;
  std::vector<Condition> gate;
  Verdict verdict;
  double seconds = 0;  ///< that it took
};
/// What the JSON file `path` says of the inputs and options that `fingerprint` stands for, with `conditions` evaluated on what
/// was measured then. Nothing if it is no such file, is damaged, or is about something else.
std::optional<EarlierAudit> earlier_audit(const std::string& path, const std::string& fingerprint,
                                          std::vector<Condition> conditions);

}  // namespace rgs::audit
