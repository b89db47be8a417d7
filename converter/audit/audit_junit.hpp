// audit_junit.hpp - the outcome of audits as JUnit XML, which CI systems read.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>
#include <string_view>

#include "audit_folder.hpp"

namespace rgs::audit {

/// A test suite for each scene, a test case for each of its conditions: a condition that does not hold is a failure. A
/// scene without a result is one test case with an error, one without conditions a test case that passes. UTF-8; names
/// are escaped as on a terminal, so that every document is well-formed.
std::string junit_xml(std::span<const FolderRow> rows);
/// Whether the text begins as such a document, which another may replace.
bool is_junit_of_audit(std::string_view text);

}  // namespace rgs::audit
