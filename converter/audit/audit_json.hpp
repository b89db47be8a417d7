// audit_json.hpp - an audit for programs; docs/user/AUDIT_JSON.md describes it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "audit.hpp"

namespace rgs::audit {

/// Schema "rgs-audit/3", ASCII, "\n" at the end.
std::string audit_json(const Report& report);

/// "permutation", "order", "means", "nearest".
const char* name_of(PairedBy by);

/// An earlier audit, under the current conditions.
struct EarlierAudit {
  std::string json;  ///< the same measurements with these conditions
  bool changed = false;
  std::vector<Condition> gate;
  Verdict verdict;
  double seconds = 0;  ///< of the earlier audit
};
/// The result in the JSON file `path` for the inputs and options of `fingerprint`, with `conditions` evaluated on its
/// measurements. None if it is no such file, is damaged, or has another fingerprint.
std::optional<EarlierAudit> earlier_audit(const std::string& path, const std::string& fingerprint,
                                          std::vector<Condition> conditions);

}  // namespace rgs::audit
