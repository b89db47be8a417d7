// audit_page.hpp - the frame of the reports' HTML pages: style, script and safe text.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace rgs::audit {

/// Untrusted text for element content and quoted attributes: control characters and bytes that are not UTF-8 become
/// \xHH, special characters of HTML are escaped.
std::string html(std::string_view text);

/// The page from doctype to <body>, and its end. It loads nothing: its policy forbids that and admits the page's one
/// style and one script by their hashes. Style attributes therefore have no effect: use classes, or attributes of SVG.
/// `title` is escaped.
std::string page_begin(std::string_view title);
std::string page_end();

}  // namespace rgs::audit
