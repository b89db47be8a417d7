// convert_arguments.cpp - parses values of rgs-convert's options.
// SPDX-License-Identifier: Apache-2.0
#include "convert_arguments.hpp"

#include <charconv>
#include <cmath>
#include <map>
#include <string_view>
#include <vector>

namespace rgs {
namespace {

std::vector<std::string_view> split(std::string_view text) {
  std::vector<std::string_view> parts;
  for (;;) {
    const std::size_t comma = text.find(',');
    parts.push_back(text.substr(0, comma));
    if (comma == text.npos) return parts;
    text.remove_prefix(comma + 1);
  }
}

// Finite numbers separated by commas; empty if the text is anything else.
std::vector<double> numbers(const std::string& text) {
  std::vector<double> values;
  for (const std::string_view part : split(text)) {
    double value = 0;
    const auto [end, error] = std::from_chars(part.data(), part.data() + part.size(), value);
    if (error != std::errc() || end != part.data() + part.size() || !std::isfinite(value)) return {};
    values.push_back(value);
  }
  return values;
}

tl::unexpected<Error> refuse(const char* what) {
  return make_error(Errc::bad_argument, Error::kNone, what);
}

}  // namespace

Result<Axes> parse_axes(const std::string& text) {
  static const std::map<std::string, Axes> kFrames = {
      {"3dgs", kAxes3dgs}, {"opengl", kAxesOpenGl}, {"gltf", kAxesGltf}};
  if (const auto frame = kFrames.find(text); frame != kFrames.end()) return frame->second;
  if (const auto axes = axes_of_text(text)) return *axes;
  return refuse("axes are 3dgs, opengl, gltf, undeclared or three directions that span space, e.g. right,down,forward");
}

Result<Similarity> parse_similarity(const std::string& translate, const std::string& rotate, const std::string& scale) {
  Similarity similarity;
  if (!translate.empty()) {
    const std::vector<double> t = numbers(translate);
    if (t.size() != 3) return refuse("--translate takes three numbers, e.g. 1,0,-2.5");
    similarity.translation = {t[0], t[1], t[2]};
  }
  if (!rotate.empty()) {
    const std::vector<double> r = numbers(rotate);
    if (r.size() == 3) {
      similarity.rotation = rotation_from_euler({r[0], r[1], r[2]});
    } else if (r.size() == 4 && std::hypot(std::hypot(r[0], r[1]), std::hypot(r[2], r[3])) > 1e-30) {
      similarity.rotation = rotation_from_quaternion({r[0], r[1], r[2], r[3]});
    } else {
      return refuse("--rotate takes degrees about x,y,z, or a quaternion w,x,y,z other than 0");
    }
  }
  if (!scale.empty()) {
    const std::vector<double> s = numbers(scale);
    if (s.size() != 1 || !(s[0] > 0)) return refuse("--scale takes one factor above 0");
    similarity.scale = s[0];
  }
  return similarity;
}

Result<WorldBox> parse_box(const std::string& text) {
  const std::vector<double> v = numbers(text);
  if (v.size() != 6 || !(v[0] <= v[3] && v[1] <= v[4] && v[2] <= v[5])) {
    return refuse("--crop takes two corners, the smaller first: x,y,z,X,Y,Z");
  }
  return WorldBox{{v[0], v[1], v[2]}, {v[3], v[4], v[5]}};
}

}  // namespace rgs
