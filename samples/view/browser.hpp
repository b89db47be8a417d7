// browser.hpp - the user's browser, if there is one.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

namespace rgs::view {

/// Whether the session has a screen.
bool has_screen();
/// Opens `address` by xdg-open, without a shell, and does not wait for it. False if xdg-open does not start.
bool open_browser(const std::string& address);

}  // namespace rgs::view
