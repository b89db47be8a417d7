// audit_command.hpp - shell commands for a report's readers to copy.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

#include "audit.hpp"

namespace rgs::audit {

/// `text` as one word of a POSIX shell; empty if it is empty, cannot be typed or would look different (control
/// characters, right-to-left marks, bytes that are not UTF-8, backslashes).
std::string shell_word(std::string_view text);

/// rgs-view with an audit's source, asset and cameras as named; empty if one of them has no shell_word().
std::string view_command(const Options& options);
/// The argument that starts at a camera: " --view=NAME"; empty if the name has no shell_word().
std::string view_argument(std::string_view camera_name);

}  // namespace rgs::audit
