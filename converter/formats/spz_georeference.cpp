// spz_georeference.cpp - origin and CRS as records of an SPZ.
//
// p = scale * rotation * local + origin; local is a position in RUB (right, up, backward), whatever axes the file has.
//   0 u8 version, 1   1 u8 flags: bit 0 there is an epoch, bits 1-2 encoding of the text   2 u16 bytes of the text
//   4 f64[3] origin   28 f64[4] rotation x, y, z, w   60 f64 scale   68 f64 epoch, years   76 text, not terminated
// Texts: 0 AUTHORITY:CODE, 1 PROJJSON.
// SPDX-License-Identifier: Apache-2.0
#include "spz_georeference.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <glm/gtc/quaternion.hpp>
#include <glm/matrix.hpp>
#include <limits>
#include <optional>
#include <string>
#include <string_view>

#include "quantised.hpp"
#include "rgs/splat_edit.hpp"
#include "spz_header.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint8_t kHasEpoch = 1, kProjjson = 1;
constexpr int kEncodingShift = 1;
// A record without a text is invalid. So an origin without a CRS has that of coordinates of unknown meaning.
constexpr std::string_view kNoCrs =
    R"({"type":"EngineeringCRS","name":"Undefined Cartesian SRS","datum":{"name":"Unknown engineering datum"}})";

bool is_projjson(std::string_view text) {
  return text.starts_with('{');
}

bool is_code(std::string_view text) {
  const std::size_t colon = text.find(':');
  return colon != text.npos && colon != 0 && colon + 1 != text.size() && text.find(':', colon + 1) == text.npos &&
         std::ranges::all_of(text, [](char c) { return c > ' ' && c <= '~' && c != '@'; });
}

// Undeclared axes are taken for those of a PLY, as readers of an SPZ without records take them.
Axes file_axes(const WriteOptions& options) {
  return options.axes[0] == Axis::undeclared ? kAxes3dgs : options.axes;
}

Axes crs_axes(const WriteOptions& options) {
  return options.crs.axes[0] == Axis::undeclared ? file_axes(options) : options.crs.axes;
}

// Columns: the axes of `from` in those of `to`.
glm::dmat3 turn(const Axes& from, const Axes& to) {
  glm::dmat3 matrix(0.0);
  for (int k = 0; k < 3; ++k) {
    Origin axis{};
    axis[static_cast<std::size_t>(k)] = 1;
    convert_axes(axis, from, to);
    matrix[k] = {axis[0], axis[1], axis[2]};
  }
  return matrix;
}

// The axes of the CRS if the rotation turns by quarters.
std::optional<Axes> turned_axes(const glm::dmat3& rotation) {
  constexpr double kTolerance = 1e-7;  // 0.2 mm at 2 km
  Axes axes{};
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) {
      if (std::abs(rotation[k][i]) <= kTolerance) continue;
      if (!(std::abs(std::abs(rotation[k][i]) - 1) <= kTolerance)) return std::nullopt;
      const auto along = static_cast<unsigned>(kAxesOpenGl[static_cast<std::size_t>(k)]);
      axes[static_cast<std::size_t>(i)] = static_cast<Axis>(rotation[k][i] > 0 ? along : ((along - 1) ^ 1U) + 1);
    }
  }
  if (std::ranges::find(axes, Axis::undeclared) != axes.end()) return std::nullopt;
  return axes;
}

}  // namespace

bool keeps_origin(const WriteOptions& options) {
  return options.spz_version == 4 && spz_coordinate_system(file_axes(options)) != 0 &&
         glm::determinant(turn(kAxesOpenGl, crs_axes(options))) > 0;
}

bool keeps_crs(const WriteOptions& options) {
  return keeps_origin(options) && (is_code(options.crs.text) || is_projjson(options.crs.text));
}

std::vector<std::byte> georeference_records(const WriteOptions& options) {
  const bool has_crs = keeps_crs(options);
  if (!keeps_origin(options) || (options.origin == kNoOrigin && !has_crs)) return {};
  const std::string_view text = has_crs ? std::string_view(options.crs.text) : kNoCrs;
  const glm::dquat q = glm::quat_cast(turn(kAxesOpenGl, crs_axes(options)));
  Origin origin = options.origin;
  convert_axes(origin, file_axes(options), crs_axes(options));
  std::vector<std::byte> records;
  const auto put = [&records](const auto&... values) {
    const auto add = [&records](const auto& value) {
      const auto bytes = std::as_bytes(std::span(&value, 1));
      records.insert(records.end(), bytes.begin(), bytes.end());
    };
    (add(values), ...);
  };
  put(kSpzCoordinateSystem, std::uint32_t{4}, spz_coordinate_system(file_axes(options)));
  put(kSpzGeoreference, static_cast<std::uint32_t>(kSpzGeoreferenceBytes + text.size()), std::uint8_t{1},
      static_cast<std::uint8_t>(is_projjson(text) ? kProjjson << kEncodingShift : 0),
      static_cast<std::uint16_t>(text.size()), origin[0], origin[1], origin[2], q.x, q.y, q.z, q.w, 1.0,
      std::numeric_limits<double>::quiet_NaN());
  const auto bytes = std::as_bytes(std::span(text));
  records.insert(records.end(), bytes.begin(), bytes.end());
  return records;
}

bool apply_georeference(std::span<const std::byte> payload, SplatFile& file) {
  if (payload.size() < kSpzGeoreferenceBytes || load_u8(payload, 0) != 1) return false;
  const std::uint32_t flags = load_u8(payload, 1), n_text = load<std::uint16_t>(payload, 2);
  if (n_text > payload.size() - kSpzGeoreferenceBytes) return false;
  std::string text(reinterpret_cast<const char*>(payload.data()) + kSpzGeoreferenceBytes, n_text);
  const bool is_json = (flags >> kEncodingShift & 3) == kProjjson;
  // Lines of JSON break where blanks may be.
  if (is_json)
    std::ranges::replace_if(
        text, [](char c) { return c == '\n' || c == '\r' || c == '\t'; }, ' ');
  if (!is_crs_text(text) || !(is_json ? is_projjson(text) : (flags >> kEncodingShift & 3) == 0 && is_code(text)))
    return false;
  std::array<double, 9> v{};  // origin, rotation, scale, epoch
  for (std::size_t i = 0; i < v.size(); ++i) v[i] = load<double>(payload, 4 + 8 * i);
  const double norm = std::hypot(std::hypot(v[3], v[4]), std::hypot(v[5], v[6])), scale = v[7], epoch = v[8];
  if (!std::ranges::all_of(std::span(v).first(3), [](double x) { return std::abs(x) <= kMaxOrigin; }) ||
      !(std::abs(norm - 1) <= 1e-6) || !(scale > 0) || !std::isfinite(scale))
    return false;

  Origin origin{v[0] + 0.0, v[1] + 0.0, v[2] + 0.0};
  const glm::dmat3 rotation = rotation_from_quaternion({v[6], v[3], v[4], v[5]});
  const auto axes = turned_axes(rotation);
  if (axes && scale == 1) {
    convert_axes(origin, *axes, file.axes);
    file.origin = origin;
    file.crs.axes = *axes == file.axes ? Axes{} : *axes;
  } else {
    convert_axes(file.cloud, file.axes, kAxesOpenGl);
    transform_splats(file.cloud, file.origin, {rotation, scale, {origin[0], origin[1], origin[2]}});
    file.axes = Axes{};
    file.unused.emplace_back(
        "the axes of the SPZ, which its georeference turns to those of a coordinate reference system");
  }
  file.crs = text == kNoCrs ? Crs() : Crs{std::move(text), file.crs.axes};
  if ((flags & kHasEpoch) != 0 && std::isfinite(epoch)) {
    std::array<char, 64> note;
    std::snprintf(note.data(), note.size(), "epoch of the coordinate reference system (%.10g)", epoch);
    file.unused.emplace_back(note.data());
  }
  return true;
}

}  // namespace rgs::detail
