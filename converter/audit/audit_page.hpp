// audit_page.hpp - the frame of the reports' HTML pages: style, script and text that is safe in them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace rgs::audit {

/// Untrusted text for element content and quoted attributes: control characters and bytes that are not UTF-8 are shown
/// as \xHH, the characters that HTML gives a meaning are escaped.
std::string html(std::string_view text);

/// The page from doctype to <body>, and its end. Loads nothing: the policy in the head forbids it, and admits by their
/// hashes the one style and the one script of the page. So style attributes have no effect: use classes, or attributes of
/// SVG. `title` is escaped.
std::string page_begin(std::string_view title);
std::string page_end();

}  // namespace rgs::audit
