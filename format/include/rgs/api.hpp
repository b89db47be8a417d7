// api.hpp - `namespace RGS_API rgs {` in a public header exports its declarations from shared libraries.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#define RGS_API [[gnu::visibility("default")]]
