// judge_report.hpp - a judgement as text, JSON, pictures and a page.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "audit.hpp"
#include "judge.hpp"

namespace rgs::judge {

struct Report {
  std::string scene;
  std::uint64_t gaussians = 0;
  std::string client;            ///< its name, or where its pictures are from
  std::string version, browser;  ///< may be empty
  std::vector<Shown> shown;
  Judgement found;
};

std::string text(const Report& report);
/// Schema "rgs-judge/1", docs/user/JUDGE.md; ASCII, "\n" at the end.
std::string json(const Report& report);
/// The page: causes, and the pictures of each view.
std::string page(const Report& report);
/// Pictures of a view: by the definition, by the program, by the rules that were found, and how the first two differ.
inline constexpr std::array kPictures{"definition", "client", "explained", "difference"};
/// As PNG, kPictures of each view; `paths` are theirs, of picture_paths().
audit::Outcome<void> write_pictures(const std::vector<std::string>& paths, const Report& report, bool overwrite);

}  // namespace rgs::judge
