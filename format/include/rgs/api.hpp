// api.hpp - marks what shared libraries export: `namespace RGS_API rgs {` in a public header exports what it declares.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#define RGS_API [[gnu::visibility("default")]]
