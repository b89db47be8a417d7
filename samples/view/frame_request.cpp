// frame_request.cpp - parses the request for a frame; unknown fields are errors.
// SPDX-License-Identifier: Apache-2.0
#include "frame_request.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <string>

#include "rgs/camera_file.hpp"

namespace rgs::view {
namespace {

using json = nlohmann::json;

constexpr int kMostLevels = 8;  // a camera's rotation has depth 4

// Reads fields of an object and keeps the first error.
class Fields {
 public:
  explicit Fields(const json& object) : object_(object) {}

  const Status& status() const { return status_; }
  void refuse(Errc code, const char* what) {
    if (status_) status_ = make_error(code, Error::kNone, what);
  }
  const json* find(const char* name) const {
    const auto found = object_.find(name);
    return found == object_.end() ? nullptr : &*found;
  }
  std::optional<int> integer(const char* name, int least, int most, const char* what) {
    const json* value = find(name);
    if (value == nullptr) return std::nullopt;
    // Compared before conversion, which would wrap.
    const bool fits = value->is_number_unsigned()  ? value->get<std::uint64_t>() <= static_cast<std::uint64_t>(most)
                      : value->is_number_integer() ? value->get<std::int64_t>() <= most
                                                   : false;
    if (!fits || value->get<std::int64_t>() < least) {
      refuse(value->is_number() ? Errc::bad_argument : Errc::bad_syntax, what);
      return std::nullopt;
    }
    return value->get<int>();
  }
  std::optional<float> number(const json& value, const char* what) {
    const float number = value.is_number() ? value.get<float>() : NAN;
    if (std::isfinite(number)) return number;
    refuse(value.is_number() ? Errc::bad_argument : Errc::bad_syntax, what);
    return std::nullopt;
  }

 private:
  const json& object_;
  Status status_;
};

bool has_only(const json& object, std::span<const char* const> names) {
  return std::ranges::all_of(object.items(), [&](const auto& item) {
    return std::ranges::any_of(names, [&](const char* name) { return item.key() == name; });
  });
}

constexpr std::array<const char*, 9> kFields{"scene",   "camera",     "width",     "height", "format",
                                             "quality", "background", "sh_degree", "detail"};
constexpr std::array<const char*, 10> kCameraFields{"id",       "img_name", "width", "height", "position",
                                                    "rotation", "fx",       "fy",    "cx",     "cy"};

Result<Camera> camera_of(Fields& fields) {
  const json* entry = fields.find("camera");
  if (entry == nullptr || !entry->is_object())
    return make_error(Errc::bad_syntax, Error::kNone, "a frame needs an object \"camera\"");
  if (!has_only(*entry, kCameraFields))
    return make_error(Errc::bad_syntax, Error::kNone,
                      "a camera has the fields id, img_name, width, height, position, rotation, fx, fy, cx and cy, and "
                      "no others");
  const auto parsed = parse_camera_json("[" + entry->dump(-1, ' ', false, json::error_handler_t::replace) + "]");
  if (!parsed) {
    Error error = parsed.error();  // its offset is in a text that the client did not send
    error.offset = Error::kNone;
    return tl::unexpected(error);
  }
  Camera camera = parsed->cameras.front();
  constexpr const char* kSide = "width and height of a frame are whole numbers from 1 to 8192";
  const int width = fields.integer("width", 1, kMostSide, kSide).value_or(camera.width);
  const int height = fields.integer("height", 1, kMostSide, kSide).value_or(camera.height);
  if (std::max(width, height) > kMostSide) fields.refuse(Errc::bad_argument, kSide);
  return resized(camera, width, height);
}

void read_options(Fields& fields, RenderOptions& options) {
  if (const json* background = fields.find("background")) {
    constexpr const char* kBackground = "background of a frame is a list of three finite numbers";
    if (!background->is_array() || background->size() != 3) return fields.refuse(Errc::bad_syntax, kBackground);
    for (std::size_t i = 0; i < 3; ++i)
      options.background[i] = fields.number((*background)[i], kBackground).value_or(0);
  }
  options.sh_degree_limit = fields.integer("sh_degree", 0, kMaxShDegree, "sh_degree of a frame is 0, 1, 2 or 3")
                                .value_or(options.sh_degree_limit);
  if (const json* detail = fields.find("detail")) {
    constexpr const char* kDetail = "detail of a frame is a number of pixels, 0 or more";
    options.detail_px = fields.number(*detail, kDetail);
    if (options.detail_px.value_or(0) < 0) fields.refuse(Errc::bad_argument, kDetail);
  }
}

}  // namespace

Result<FrameRequest> parse_frame_request(std::string_view body, std::size_t n_scenes) {
  json object;
  bool is_too_deep = false;
  try {
    // Deeper levels are dropped while parsing, because dump() takes stack for each level.
    object = json::parse(body, [&](int depth, json::parse_event_t event, const json&) {
      const bool begins = event == json::parse_event_t::object_start || event == json::parse_event_t::array_start;
      if (begins && depth >= kMostLevels) is_too_deep = true;
      return !is_too_deep;
    });
  } catch (const json::parse_error& error) {
    return make_error(Errc::bad_syntax, error.byte > 0 ? error.byte - 1 : 0, "the JSON text is not valid at this byte");
  } catch (const json::exception&) {
    return make_error(Errc::bad_argument, Error::kNone, "the JSON text has a number that is too large");
  }
  if (is_too_deep) return make_error(Errc::bad_syntax, Error::kNone, "the JSON text is nested too deeply");
  if (!object.is_object()) return make_error(Errc::bad_syntax, 0, "the request for a frame must be a JSON object");
  if (!has_only(object, kFields))
    return make_error(Errc::bad_syntax, Error::kNone,
                      "a frame has the fields scene, camera, width, height, format, quality, background, sh_degree and "
                      "detail, and no others");
  Fields fields(object);
  FrameRequest request;
  const int scene =
      fields.integer("scene", 0, static_cast<int>(n_scenes) - 1, "there is no scene of this number").value_or(0);
  request.scene = static_cast<std::size_t>(scene);
  if (const json* format = fields.find("format")) {
    if (*format == "jpeg") {
      request.format = ImageFormat::jpeg;
    } else if (*format != "png") {
      fields.refuse(Errc::bad_argument, "format of a frame is \"png\" or \"jpeg\"");
    }
  }
  request.quality =
      fields.integer("quality", 1, 100, "quality of a frame is a whole number from 1 to 100").value_or(request.quality);
  read_options(fields, request.options);
  auto camera = camera_of(fields);
  if (!fields.status()) return tl::unexpected(fields.status().error());
  if (!camera) return tl::unexpected(camera.error());
  request.camera = *std::move(camera);
  return request;
}

}  // namespace rgs::view
