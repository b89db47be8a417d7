// cameras_json.cpp - the JSON camera formats: a plain list, cameras.json of 3DGS training, NeRF transforms.json.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <glm/gtc/type_ptr.hpp>
#include <nlohmann/json.hpp>
#include <numbers>
#include <optional>
#include <span>
#include <string_view>
#include <utility>

#include "cameras/camera_records.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

using nlohmann::json;

// Byte at which element `index` of the cameras' array starts, for error messages: the array is the whole text or, in an
// object, the value of `key`. `text` has been parsed before, so it suffices to follow strings and nesting.
std::uint64_t element_offset(std::string_view text, std::string_view key, std::size_t index) {
  int depth = 0, array_depth = key.empty() ? 1 : 0;
  std::size_t element = 0;
  bool at_start = false;
  std::string_view last_string;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const char c = text[i];
    const bool space = c == ' ' || c == '\t' || c == '\n' || c == '\r';
    if (at_start && !space) {
      if (element == index) return i;
      at_start = false;
    }
    if (c == '"') {
      const std::size_t begin = ++i;
      while (i < text.size() && text[i] != '"') i += text[i] == '\\' ? 2U : 1U;
      if (depth == 1 && i <= text.size()) last_string = text.substr(begin, i - begin);
    } else if (c == '[' || c == '{') {
      ++depth;
      if (array_depth == 0 && c == '[' && depth == 2 && last_string == key) array_depth = 2;
      if (depth == array_depth && element == 0) at_start = true;
    } else if (c == ']' || c == '}') {
      --depth;
    } else if (c == ',' && depth == array_depth) {
      ++element;
      at_start = true;
    }
  }
  return Error::kNone;
}

// Typed access to a camera's fields. The first failure sticks; values read after it are meaningless.
class Fields {
 public:
  // Fields that `object` lacks are looked up in `defaults`.
  explicit Fields(const json& object, const json* defaults = nullptr) : object_(object), defaults_(defaults) {
    if (!object.is_object()) refuse(Errc::bad_syntax, "the camera of this index is not a JSON object");
  }

  Errc code() const { return code_; }
  const char* what() const { return what_; }
  bool ok() const { return *what_ == '\0'; }

  void refuse(Errc code, const char* what) {
    if (!ok()) return;
    code_ = code;
    what_ = what;
  }

  const json* find(const char* key) const {
    if (const auto own = object_.find(key); object_.is_object() && own != object_.end()) return &*own;
    if (defaults_ == nullptr) return nullptr;
    const auto shared = defaults_->find(key);
    return shared != defaults_->end() ? &*shared : nullptr;
  }

  std::optional<double> number(const char* key) {
    const json* value = find(key);
    if (value == nullptr) return std::nullopt;
    if (!value->is_number()) {
      refuse(Errc::bad_syntax, "the camera of this index has a text, list or null where a number belongs");
      return std::nullopt;
    }
    return value->get<double>();
  }

  double required(const char* key, const char* missing) {
    const auto value = number(key);
    if (!value) refuse(Errc::bad_syntax, missing);
    return value.value_or(0);
  }

  // Some programs write image sizes as 1920.0.
  int side(const char* key, const char* missing) {
    const double value = required(key, missing);
    if (!(value >= 1 && value <= kMaxImageSide && value == std::floor(value))) {
      refuse(Errc::bad_value, "the camera of this index has an image side that is not an integer from 1 to 65536");
      return 0;
    }
    return static_cast<int>(value);
  }

  std::string text(const char* key) {
    const json* value = find(key);
    if (value == nullptr) return {};
    if (!value->is_string()) {
      refuse(Errc::bad_syntax, "the camera of this index has a name or kind that is not a text");
      return {};
    }
    return value->get<std::string>();
  }

  // The first `rows` of up to `most_rows` lists of `columns` numbers.
  template <int rows, int columns, int most_rows = rows>
  glm::mat<columns, rows, double> matrix(const json* value, const char* malformed) {
    glm::mat<rows, columns, double> transposed(0.0);
    if (value == nullptr || !value->is_array() || value->size() < rows || value->size() > most_rows)
      refuse(Errc::bad_syntax, malformed);
    for (int r = 0; r < rows && ok(); ++r)
      list((*value)[static_cast<std::size_t>(r)], {glm::value_ptr(transposed[r]), columns}, malformed);
    return glm::transpose(transposed);
  }

  void list(const json& value, std::span<double> out, const char* malformed) {
    if (!value.is_array() || value.size() != out.size()) return refuse(Errc::bad_syntax, malformed);
    for (std::size_t i = 0; i < out.size(); ++i) {
      if (!value[i].is_number()) return refuse(Errc::bad_syntax, malformed);
      out[i] = value[i].get<double>();
    }
  }

 private:
  const json& object_;
  const json* defaults_;
  Errc code_ = Errc::internal;
  const char* what_ = "";
};

constexpr const char* kNoSize = "the camera of this index has no image size (width, height)";
constexpr const char* kNoFocal = "the camera of this index has no focal length (fx, fy)";

void read_intrinsics(Fields& fields, Camera& camera) {
  camera.width = fields.side("width", kNoSize);
  camera.height = fields.side("height", kNoSize);
  camera.fx = fields.required("fx", kNoFocal);
  camera.fy = fields.required("fy", kNoFocal);
  camera.cx = fields.number("cx").value_or(0.5 * camera.width);
  camera.cy = fields.number("cy").value_or(0.5 * camera.height);
  if (const std::string name = fields.text("model"); !name.empty()) {
    const auto model = find_camera_model(name);
    if (!model) {
      fields.refuse(Errc::unsupported_feature,
                    "the camera of this index has an unknown model; known are pinhole, opencv, opencv_fisheye, "
                    "equirectangular and orthographic");
    }
    camera.model = model.value_or(CameraModel::pinhole);
  }
  if (const json* k = fields.find("distortion"); k != nullptr) {
    constexpr const char* kLongest =
        "the camera of this index has a distortion that is not a list of at most 8 numbers";
    const std::size_t n = k->is_array() ? std::min(k->size(), camera.distortion.size()) : 0;
    fields.list(*k, std::span(camera.distortion).first(n), kLongest);
  }
}

// {name, split, width, height, fx, fy, cx, cy, model, distortion, world_to_camera}
void read_list_entry(Fields& fields, Camera& camera, std::optional<Split>& split) {
  constexpr const char* kShape = "the camera of this index has a world_to_camera that is not 4 rows of 4 numbers";
  camera.name = fields.text("name");
  if (const std::string declared = fields.text("split"); declared == "test" || declared == "train") {
    split = declared == "test" ? Split::test : Split::train;
  } else if (!declared.empty()) {
    fields.refuse(Errc::bad_value, "the camera of this index has a split other than train and test");
  }
  read_intrinsics(fields, camera);
  camera.world_to_camera = fields.matrix<4, 4>(fields.find("world_to_camera"), kShape);
}

// {id, img_name, width, height, position, rotation, fx, fy}, and the intrinsics above: the camera's centre and its axes
// as the matrix columns.
void read_training_entry(Fields& fields, Camera& camera) {
  camera.name = fields.text("img_name");
  read_intrinsics(fields, camera);
  const glm::dmat3 axes = fields.matrix<3, 3>(
      fields.find("rotation"), "the camera of this index has a rotation that is not 3 rows of 3 numbers");
  glm::dvec3 centre{};
  const json* place = fields.find("position");
  fields.list(place != nullptr ? *place : json(), {glm::value_ptr(centre), 3},
              "the camera of this index has a position that is not 3 numbers");
  camera.world_to_camera = detail::world_to_camera(axes, centre);
}

// Nerfstudio's models, and instant-ngp's is_fisheye.
void read_transforms_model(Fields& fields, Camera& camera) {
  constexpr std::string_view kPerspective[] = {"",       "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL",
                                               "RADIAL", "OPENCV"};
  const std::string model = fields.text("camera_model");
  const json* const is_fisheye = fields.find("is_fisheye");
  if (is_fisheye != nullptr && !is_fisheye->is_boolean())
    fields.refuse(Errc::bad_syntax, "the camera of this index has an is_fisheye that is not true or false");
  if (model == "EQUIRECTANGULAR") {
    camera.model = CameraModel::equirectangular;
  } else if (model == "OPENCV_FISHEYE" ||
             ((model.empty() || model == "OPENCV") && is_fisheye != nullptr && *is_fisheye == true)) {
    camera.model = CameraModel::opencv_fisheye;
  } else if (std::ranges::find(kPerspective, model) != std::end(kPerspective)) {
    camera.model = CameraModel::opencv;
  } else {
    fields.refuse(Errc::unsupported_feature,
                  "the camera of this index has a camera_model that cannot be drawn; PINHOLE, OPENCV, OPENCV_FISHEYE "
                  "and EQUIRECTANGULAR can");
  }
  constexpr std::array<const char*, 5> kOpenCv{"k1", "k2", "p1", "p2", "k3"};
  constexpr std::array<const char*, 4> kFisheye{"k1", "k2", "k3", "k4"};
  const std::span<const char* const> read = camera.model == CameraModel::opencv ? std::span<const char* const>(kOpenCv)
                                            : camera.model == CameraModel::opencv_fisheye
                                                ? std::span<const char* const>(kFisheye)
                                                : std::span<const char* const>();
  // Nerfstudio prefers its list to the single numbers.
  constexpr std::array<const char*, 6> kListed{"k1", "k2", "k3", "k4", "p1", "p2"};
  std::array<double, kListed.size()> listed{};
  const json* const list = fields.find("distortion_params");
  if (list != nullptr)
    fields.list(*list, listed, "the camera of this index has distortion_params that are not 6 numbers");
  const auto coefficient = [&](const char* key) {
    if (list == nullptr) return fields.number(key).value_or(0);
    const auto at = std::ranges::find(kListed, std::string_view(key));
    return at == kListed.end() ? 0.0 : listed[static_cast<std::size_t>(at - kListed.begin())];
  };
  for (std::size_t i = 0; i < read.size(); ++i) camera.distortion[i] = coefficient(read[i]);
  for (const char* key : {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}) {
    if (std::ranges::find(read, std::string_view(key)) == read.end() && coefficient(key) != 0) {
      fields.refuse(Errc::unsupported_feature,
                    "the camera of this index has a distortion that its camera_model does not have: k1 k2 k3 p1 p2 for "
                    "OPENCV, k1 k2 k3 k4 for OPENCV_FISHEYE");
    }
  }
}

// A frame of transforms.json. Its camera axes are OpenGL's (x right, y up, z back), so two columns change sign.
void read_transforms_entry(Fields& fields, Camera& camera) {
  camera.name = fields.text("file_path");
  read_transforms_model(fields, camera);

  constexpr const char* kNoPixels =
      "the camera of this index has no image size; add \"w\" and \"h\" in pixels to the file";
  camera.width = fields.side("w", kNoPixels);
  camera.height = fields.side("h", kNoPixels);
  const bool is_panorama = camera.model == CameraModel::equirectangular;
  const auto from_angle = [&](const char* key, int side) -> std::optional<double> {
    const auto angle = fields.number(key);
    if (!angle) return std::nullopt;
    return 0.5 * side / std::tan(0.5 * *angle);
  };
  auto fx = fields.number("fl_x"), fy = fields.number("fl_y");
  if (is_panorama) {
    // Nerfstudio counts a panorama's pixels over an angle of pi.
    if (fx) *fx /= std::numbers::pi;
    if (fy) *fy /= std::numbers::pi;
    if (!fx && !fy) fx = camera.width / (2 * std::numbers::pi), fy = camera.height / std::numbers::pi;
  } else if (camera.model == CameraModel::opencv_fisheye) {
    if (!fx && !fy)
      fields.refuse(Errc::bad_syntax,
                    "the camera of this index is a fisheye without a focal length; add fl_x and fl_y");
  } else {
    if (!fx) fx = from_angle("camera_angle_x", camera.width);
    if (!fy) fy = from_angle("camera_angle_y", camera.height);
  }
  if (!fx && !fy)
    fields.refuse(Errc::bad_syntax, "the camera of this index has no focal length (fl_x, fl_y or camera_angle_x)");
  camera.fx = fx ? *fx : fy.value_or(0);
  camera.fy = fy ? *fy : camera.fx;
  camera.cx = fields.number("cx").value_or(0.5 * camera.width);
  camera.cy = fields.number("cy").value_or(0.5 * camera.height);

  constexpr const char* kShape = "the camera of this index has a transform_matrix that is not 3 or 4 rows of 4 numbers";
  const json* pose = fields.find("transform_matrix");
  const glm::dmat4x3 m = fields.matrix<3, 4, 4>(pose, kShape);
  if (fields.ok() && pose->size() > 3) {
    glm::dvec4 last{0, 0, 0, 1};
    fields.list((*pose)[3], {glm::value_ptr(last), 4}, kShape);
    if (last != glm::dvec4(0, 0, 0, 1))
      fields.refuse(Errc::bad_value, "the camera of this index has a transform_matrix whose last row is not 0 0 0 1");
  }
  camera.world_to_camera = detail::world_to_camera({m[0], -m[1], -m[2]}, m[3]);
}

Result<CameraSet> read_all(std::string_view text, const json& root) {
  CameraSet set;
  std::string_view key;
  const json* list = &root;
  if (root.is_object()) {
    key = "frames";
    const auto frames = root.find("frames");
    if (frames == root.end())
      return make_error(Errc::bad_syntax, 0, "JSON without cameras: expected a list, or an object with \"frames\"");
    list = &*frames;
    set.source = CameraSet::Source::transforms;
  }
  if (!list->is_array()) return make_error(Errc::bad_syntax, 0, "JSON without cameras: expected a list of them");
  if (list->empty()) return make_error(Errc::bad_value, 0, "the list of cameras is empty");
  if (root.is_array() && list->front().is_object() && !list->front().contains("world_to_camera")) {
    if (!list->front().contains("rotation") || !list->front().contains("position"))
      return make_error(Errc::bad_syntax, element_offset(text, key, 0),
                        "cameras need world_to_camera, or position and rotation as 3DGS training writes them");
    set.source = CameraSet::Source::training;
  }

  std::size_t n_declared = 0;
  for (std::size_t i = 0; i < list->size(); ++i) {
    Fields fields((*list)[i], root.is_object() ? &root : nullptr);
    Camera camera;
    std::optional<Split> split;
    if (fields.ok()) {
      switch (set.source) {
        case CameraSet::Source::list: read_list_entry(fields, camera, split); break;
        case CameraSet::Source::training: read_training_entry(fields, camera); break;
        default: read_transforms_entry(fields, camera); break;
      }
    }
    if (!fields.ok()) return make_error(fields.code(), element_offset(text, key, i), fields.what(), Error::kNone, i);
    detail::simplify(camera);
    if (!validate(camera))
      return tl::unexpected(detail::validate_record(camera, element_offset(text, key, i), i).error());
    if (split) ++n_declared;
    set.split.push_back(split.value_or(Split::train));
    set.cameras.push_back(std::move(camera));
  }
  set.split_declared = n_declared > 0;
  if (n_declared == 0) detail::split_by_name(set);
  return set;
}

}  // namespace

Result<CameraSet> parse_camera_json(std::string_view text) {
  return detail::guard_memory([&]() -> Result<CameraSet> {
    json root;
    try {
      root = json::parse(text.begin(), text.end());
    } catch (const json::parse_error& error) {
      // The library counts bytes from 1 and reports the last one it read.
      const std::uint64_t offset = error.byte > 0 ? error.byte - 1 : 0;
      if (offset >= text.size()) return make_error(Errc::truncated, text.size(), "the JSON text ends early");
      return make_error(Errc::bad_syntax, offset, "the JSON text cannot be parsed here");
    } catch (const json::exception&) {
      return make_error(Errc::bad_value, Error::kNone, "the JSON text has a number that is too large");
    }
    return read_all(text, root);
  });
}

}  // namespace rgs
