// causes.hpp - what makes pictures of one scene differ, in words and as a change of the rules; which program has what.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string_view>
#include <vector>

#include "rules.hpp"

namespace rgs::judge {

struct Cause {
  std::string_view key;       ///< "low-pass-none"
  std::string_view sentence;  ///< "adds no low-pass", after the program's name
  void (*apply)(Rules& rules);
};

/// All that can be found in a program of which nothing is known.
std::span<const Cause> all_causes();
/// Null: there is none of this key.
const Cause* find_cause(std::string_view key);

/// A program whose sources say how it draws: docs/develop/CLIENTS.md.
struct Client {
  std::string_view key, name;
  std::vector<std::string_view> causes;
};
std::span<const Client> clients();
const Client* find_client(std::string_view key);

}  // namespace rgs::judge
