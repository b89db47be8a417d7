// utf8_path.hpp - names as std::filesystem has them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <string_view>

#include "rgs/api.hpp"

namespace RGS_API rgs {
namespace detail {

/// A path of this name. Names are UTF-8 on Windows, where std::filesystem would take another encoding; elsewhere they are
/// bytes. libstdc++'s path.string() is UTF-8 anyway; generic_string() has only slashes, as names within scenes do.
std::filesystem::path path_of(std::string_view name);

}  // namespace detail
}  // namespace rgs
