// audit_encoding.hpp - links in HTML pages.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace rgs::audit {

/// "./" and the file's name, every byte but letters, digits and "-._~" as %HH: a link to a file beside the page. `name`
/// is a file name, not a path.
std::string link_to_file(std::string_view name);

}  // namespace rgs::audit
