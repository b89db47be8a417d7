// version.hpp - the version of libraries and programs; CMake reads it. Promises: CONTRIBUTING.md, "Versions and ABI".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#define RGS_VERSION_MAJOR 0
#define RGS_VERSION_MINOR 1
#define RGS_VERSION_PATCH 0

#define RGS_STRING_DETAIL(text) #text
#define RGS_DOTTED_DETAIL(a, b, c) RGS_STRING_DETAIL(a) "." RGS_STRING_DETAIL(b) "." RGS_STRING_DETAIL(c)
/// "MAJOR.MINOR.PATCH"
#define RGS_VERSION RGS_DOTTED_DETAIL(RGS_VERSION_MAJOR, RGS_VERSION_MINOR, RGS_VERSION_PATCH)
