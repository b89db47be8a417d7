// motion.hpp - where a moving camera is about to be.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "pages/events.hpp"

namespace rgs::pages {

/// The camera moved on by `ahead` times the motion from `before` to `now`, but at most `farthest` away and half a right angle
/// around.
Look moved_on(const Look& before, const Look& now, double ahead, double farthest);

}  // namespace rgs::pages
