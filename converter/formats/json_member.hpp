// json_member.hpp - JSON members of untrusted files, without exceptions.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json.hpp>

namespace rgs::detail {

/// The member `name`; null if there is none or `object` is no object.
inline const nlohmann::json* json_member(const nlohmann::json& object, const char* name) {
  const auto found = object.is_object() ? object.find(name) : object.end();
  return found == object.end() ? nullptr : &*found;
}

}  // namespace rgs::detail
