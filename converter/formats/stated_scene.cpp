// stated_scene.cpp - declarations as PLY comments and glTF extras.
// SPDX-License-Identifier: Apache-2.0
#include "stated_scene.hpp"

#include <algorithm>
#include <array>
#include <cctype>
#include <charconv>
#include <cmath>
#include <nlohmann/json.hpp>
#include <utility>

#include "decimal.hpp"
#include "json_member.hpp"

namespace rgs {
namespace {

constexpr std::array<std::pair<std::string_view, Axis>, 6> kDirections{{{"right", Axis::right},
                                                                        {"left", Axis::left},
                                                                        {"up", Axis::up},
                                                                        {"down", Axis::down},
                                                                        {"forward", Axis::forward},
                                                                        {"backward", Axis::backward}}};
constexpr Axes kUndeclaredAxes{Axis::undeclared, Axis::undeclared, Axis::undeclared};

}  // namespace

std::optional<Axes> axes_of_text(std::string_view text) {
  if (text == "undeclared") return kUndeclaredAxes;
  Axes axes{};
  unsigned spanned = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    const std::size_t comma = i < 2 ? text.find(',') : text.size();
    const std::string_view name = text.substr(0, comma);
    const auto found = std::ranges::find(kDirections, name, [](const auto& d) { return d.first; });
    if (comma == text.npos || found == kDirections.end()) return std::nullopt;
    axes[i] = found->second;
    spanned |= 1U << ((static_cast<unsigned>(axes[i]) - 1) / 2);
    text.remove_prefix(std::min(comma + 1, text.size()));
  }
  return spanned == 7 ? std::optional(axes) : std::nullopt;
}

std::string axes_text(const Axes& axes) {
  std::string text;
  for (const Axis axis : axes) {
    const auto found = std::ranges::find(kDirections, axis, [](const auto& d) { return d.second; });
    if (found == kDirections.end()) return "undeclared";
    text += (text.empty() ? "" : ",") + std::string(found->first);
  }
  return text;
}

namespace detail {
namespace {

constexpr std::string_view kRenderMode = "splatrendermode", kPostshot = "antialiased ", kOurs = "rgs_";
constexpr const char* kExtras = "rgs";

std::string_view trimmed(std::string_view text) {
  constexpr std::string_view kBlank = " \t\r\v\f";
  const std::size_t first = text.find_first_not_of(kBlank);
  if (first == text.npos) return {};
  return text.substr(first, text.find_last_not_of(kBlank) + 1 - first);
}

std::string lower(std::string_view text) {
  std::string out(text);
  std::ranges::transform(out, out.begin(), [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return out;
}

std::optional<float> number(std::string_view text) {
  float value = 0;
  const auto [end, error] = from_decimal(text, value);
  if (error != std::errc() || end != text.data() + text.size() || !std::isfinite(value) || value < 0) return {};
  return value;
}

// The shortest decimals that read back as the same float.
std::string text_of(float value) {
  std::array<char, 32> digits;
  return {digits.data(), std::to_chars(digits.data(), digits.data() + digits.size(), value).ptr};
}

// The same decimals as a JSON number, a double.
double decimal_of(float value) {
  const std::string text = text_of(value);
  double decimal = 0;
  from_decimal(text, decimal);
  return decimal;
}

bool read_value(std::string_view key, std::string_view value, StatedScene& scene) {
  if (key == "low_pass_px2") {
    scene.low_pass_px2 = number(value);
    return scene.low_pass_px2.has_value();
  }
  if (key == "metres_per_unit") {
    const auto metres = number(value);
    scene.metres_per_unit = metres.value_or(0);
    return metres.has_value();
  }
  if (key == "axes") {
    const auto axes = axes_of_text(value);
    scene.axes = axes.value_or(scene.axes);
    return axes.has_value();
  }
  if (key == "crs") {
    scene.crs.text = value;
    return value.empty() || is_crs_text(value);  // blanks of a comment are trimmed
  }
  if (key == "crs_axes") {
    const auto axes = axes_of_text(value);
    scene.crs.axes = axes.value_or(kUndeclaredAxes);
    return axes.has_value();
  }
  if (key == "colour_space") {
    if (value != "srgb" && value != "linear" && value != "undeclared") return false;
    scene.colour_space = value == "srgb"     ? ColourSpace::srgb_display
                         : value == "linear" ? ColourSpace::linear_display
                                             : ColourSpace::undeclared;
    return true;
  }
  if (key == "anti_aliasing") {
    if (value != "classic" && value != "mip-splatting" && value != "undeclared") return false;
    scene.aa_mode = value == "classic"         ? AaMode::classic
                    : value == "mip-splatting" ? AaMode::mip_splatting
                                               : AaMode::undeclared;
    return true;
  }
  return true;  // a key of a later version
}

bool is_usual_low_pass(const StatedScene& s) {
  return !s.low_pass_px2 || *s.low_pass_px2 == default_low_pass_px2(s.aa_mode);
}

// Axes mean something only with a text, and if the scene's are declared.
Crs sound_crs(const StatedScene& s) {
  if (s.crs.text.empty()) return {};
  return {s.crs.text, s.axes == kUndeclaredAxes ? kUndeclaredAxes : s.crs.axes};
}

}  // namespace

Declarations StatedScene::declarations() const {
  Declarations d;
  d.axes = axes;
  d.colour_space = colour_space;
  d.aa_mode = aa_mode;
  d.low_pass_px2 = low_pass_px2.value_or(default_low_pass_px2(aa_mode));
  d.metres_per_unit = metres_per_unit;
  d.origin = origin;
  d.crs = sound_crs(*this);
  return d;
}

void StatedScene::copy_to(SplatFile& file) const {
  file.axes = axes;
  file.colour_space = colour_space;
  file.aa_mode = aa_mode;
  file.low_pass_px2 = low_pass_px2;
  file.metres_per_unit = metres_per_unit;
  file.origin = origin;
  file.crs = sound_crs(*this);
}

StatedScene stated_scene(const Declarations& d) {
  return {d.axes, d.colour_space, d.aa_mode, d.low_pass_px2, d.metres_per_unit, d.origin, d.crs};
}

StatedScene stated_scene(const WriteOptions& o) {
  return {o.axes, o.colour_space, o.aa_mode, o.low_pass_px2, o.metres_per_unit, o.origin, o.crs};
}

bool read_comment(std::string_view text, StatedScene& scene) {
  const std::string comment = lower(trimmed(text));
  if (comment.starts_with(kRenderMode)) {
    std::string_view mode = trimmed(std::string_view(comment).substr(kRenderMode.size()));
    if (mode.starts_with(':')) mode = trimmed(mode.substr(1));  // some writers omit the colon
    if (mode == "mip" || mode == "default") scene.aa_mode = mode == "mip" ? AaMode::mip_splatting : AaMode::classic;
  } else if (comment.starts_with(kPostshot)) {
    const std::string_view flag = trimmed(std::string_view(comment).substr(kPostshot.size()));
    if (flag == "1" || flag == "0") scene.aa_mode = flag == "1" ? AaMode::mip_splatting : AaMode::classic;
  } else if (comment.starts_with(kOurs)) {
    const std::string_view rest = std::string_view(comment).substr(kOurs.size());
    const std::size_t colon = rest.find(':');
    if (colon == rest.npos) return true;
    const std::string_view key = trimmed(rest.substr(0, colon));
    // A code or WKT keeps its case.
    const std::string_view value = key == "crs" ? trimmed(text).substr(kOurs.size()) : rest;
    return read_value(key, trimmed(value.substr(colon + 1)), scene);
  }
  return true;
}

std::string comment_lines(const StatedScene& s) {
  std::string lines;
  const auto ours = [&lines](const char* key, const std::string& value) {
    lines += std::string("comment ") + std::string(kOurs) + key + ": " + value + "\n";
  };
  if (s.aa_mode == AaMode::mip_splatting) lines += "comment SplatRenderMode: mip\n";
  if (s.aa_mode == AaMode::undeclared) ours("anti_aliasing", "undeclared");
  if (!is_usual_low_pass(s)) ours("low_pass_px2", text_of(*s.low_pass_px2));
  if (s.colour_space == ColourSpace::linear_display) ours("colour_space", "linear");
  if (s.colour_space == ColourSpace::undeclared) ours("colour_space", "undeclared");
  if (s.metres_per_unit != 0) ours("metres_per_unit", text_of(s.metres_per_unit));
  if (s.axes != kAxes3dgs) ours("axes", axes_text(s.axes));
  if (s.crs != Crs()) ours("crs", s.crs.text);
  if (s.crs.axes != kUndeclaredAxes) ours("crs_axes", axes_text(s.crs.axes));
  return lines;
}

bool read_extras(const nlohmann::json& extras, StatedScene& scene) {
  const nlohmann::json* ours = json_member(extras, kExtras);
  if (ours == nullptr || !ours->is_object()) return true;
  for (const auto& [key, value] : ours->items()) {
    if (value.is_number()) {
      if (!read_value(key, text_of(value.get<float>()), scene)) return false;
    } else if (value.is_string()) {
      if (!read_value(key, value.get_ref<const std::string&>(), scene)) return false;
    } else if (!read_value(key, "", scene)) {
      return false;
    }
  }
  return true;
}

nlohmann::ordered_json extras_of(const StatedScene& s) {
  nlohmann::ordered_json ours;
  if (s.aa_mode == AaMode::mip_splatting) ours["anti_aliasing"] = "mip-splatting";
  if (s.aa_mode == AaMode::undeclared) ours["anti_aliasing"] = "undeclared";
  if (!is_usual_low_pass(s)) ours["low_pass_px2"] = decimal_of(*s.low_pass_px2);
  if (s.colour_space == ColourSpace::undeclared) ours["colour_space"] = "undeclared";
  if (s.metres_per_unit != 0) ours["metres_per_unit"] = decimal_of(s.metres_per_unit);
  if (s.axes == kUndeclaredAxes) ours["axes"] = "undeclared";
  if (s.crs != Crs()) ours["crs"] = s.crs.text;
  if (s.crs.axes != kUndeclaredAxes) ours["crs_axes"] = axes_text(s.crs.axes);
  if (ours.is_null()) return nullptr;
  return {{kExtras, std::move(ours)}};
}

}  // namespace detail
}  // namespace rgs
