// audit_command.hpp - commands that a report gives its readers to copy.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

#include "audit.hpp"

namespace rgs::audit {

/// `text` as one word of a POSIX shell; empty for no text and for what cannot be typed or would show as something else (control
/// characters, turned writing, bytes that are not UTF-8, backslashes).
std::string shell_word(std::string_view text);

/// rgs-view with an audit's source, asset and cameras, as they were named; empty where one of them has no shell_word().
std::string view_command(const Options& options);
/// What it takes besides to begin at a camera: " --view=NAME"; empty where the name has no shell_word().
std::string view_argument(std::string_view camera_name);

}  // namespace rgs::audit
