// browser.hpp - the user's browser, if there is one.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

namespace rgs::view {

/// Whether the session has a screen on which a browser could open.
bool has_screen();
/// Has xdg-open open `address`, without a shell and without waiting. False if it cannot be started.
bool open_browser(const std::string& address);

}  // namespace rgs::view
