// cameras_colmap.cpp - COLMAP sparse models: cameras and images, binary and text (colmap.github.io/format.html).
// SPDX-License-Identifier: Apache-2.0
//
// As in our cameras, an image's pose is world to camera with OpenCV axes (a quaternion w x y z and a translation), and
// the image plane's origin is the upper left corner of the first pixel. 2D points are skipped.
#include <algorithm>
#include <bit>
#include <charconv>
#include <cmath>
#include <cstring>
#include <glm/ext/quaternion_double.hpp>
#include <iterator>
#include <map>
#include <string_view>
#include <utility>

#include "cameras/camera_records.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

// Models in the order of their numbers in cameras.bin. A record has one or two focal lengths, the principal point and
// the coefficients, in the order of Camera::distortion.
#define RGS_UNDISTORT(model)                                        \
  "the camera of this index is of " model                           \
  "; run colmap image_undistorter and use the model in its sparse " \
  "folder"
struct Model {
  std::string_view name;
  CameraModel model;
  std::size_t n_focal, n_distortions;
  const char* refusal = "";  // empty: it is read
  constexpr std::size_t n_parameters() const { return n_focal + 2 + n_distortions; }
};
using enum CameraModel;
constexpr Model kModels[] = {
    {"SIMPLE_PINHOLE", pinhole, 1, 0},
    {"PINHOLE", pinhole, 2, 0},
    {"SIMPLE_RADIAL", opencv, 1, 1},
    {"RADIAL", opencv, 1, 2},
    {"OPENCV", opencv, 2, 4},
    {"OPENCV_FISHEYE", opencv_fisheye, 2, 4},
    {"FULL_OPENCV", opencv, 2, 8},
    {"FOV", opencv, 2, 1, RGS_UNDISTORT("model FOV, which cannot be drawn")},
    {"SIMPLE_RADIAL_FISHEYE", opencv_fisheye, 1, 1},
    {"RADIAL_FISHEYE", opencv_fisheye, 1, 2},
    {"THIN_PRISM_FISHEYE", opencv_fisheye, 2, 8, RGS_UNDISTORT("model THIN_PRISM_FISHEYE, which cannot be drawn")}};
constexpr std::size_t kMostParameters = 12;
constexpr const char* kUnknownModel = RGS_UNDISTORT("a model unknown to this program");
#undef RGS_UNDISTORT
const char* refusal_of(const Model* model) {
  return model != nullptr ? model->refusal : kUnknownModel;
}
constexpr std::uint64_t kImageBytes = 4 + 7 * 8 + 4 + 1 + 8;  // smallest record: empty name, no points

// Little-endian reader whose first failure sticks.
class Cursor {
 public:
  explicit Cursor(std::span<const std::byte> bytes) : bytes_(bytes) {}
  bool ok() const { return ok_; }
  std::uint64_t offset() const { return offset_; }
  std::uint64_t left() const { return bytes_.size() - offset_; }

  template <class T>
  T read() {
    if (!ok_ || left() < sizeof(T)) {
      ok_ = false;
      return T{};
    }
    std::uint64_t bits = 0;
    for (std::size_t i = 0; i < sizeof(T); ++i) bits |= std::to_integer<std::uint64_t>(bytes_[offset_ + i]) << (8 * i);
    offset_ += sizeof(T);
    if constexpr (std::is_same_v<T, double>) {
      return std::bit_cast<double>(bits);
    } else {
      return static_cast<T>(bits);
    }
  }

  // Text up to a zero byte, which is consumed.
  std::string text() {
    const auto rest = bytes_.subspan(offset_);
    const auto end = std::find(rest.begin(), rest.end(), std::byte{0});
    if (!ok_ || end == rest.end()) {
      ok_ = false;
      return {};
    }
    const auto length = static_cast<std::size_t>(end - rest.begin());
    offset_ += length + 1;
    return {reinterpret_cast<const char*>(rest.data()), length};
  }

  void skip(std::uint64_t n) {
    ok_ = ok_ && n <= left();
    if (ok_) offset_ += n;
  }

 private:
  std::span<const std::byte> bytes_;
  std::uint64_t offset_ = 0;
  bool ok_ = true;
};

// Lens and image size of a COLMAP camera; the pose is filled in by its images.
using Lenses = std::map<std::uint32_t, Camera>;

bool set_lens(Camera& camera, const Model& model, std::uint64_t width, std::uint64_t height,
              std::span<const double> parameters) {
  if (width > kMaxImageSide || height > kMaxImageSide) return false;
  camera.width = static_cast<int>(width);
  camera.height = static_cast<int>(height);
  camera.fx = parameters[0];
  camera.fy = parameters[model.n_focal - 1];
  camera.cx = parameters[model.n_focal];
  camera.cy = parameters[model.n_focal + 1];
  camera.model = model.model;
  std::ranges::copy(parameters.subspan(model.n_focal + 2), camera.distortion.begin());
  detail::simplify(camera);
  return validate(camera).has_value();  // the pose is still the identity
}

// Divides by the squared norm instead of normalising first; a zero or non-finite quaternion then fails validation.
glm::dmat3 rotation_of(const glm::dquat& q) {
  const double w = q.w, x = q.x, y = q.y, z = q.z, s = 2 / (w * w + x * x + y * y + z * z);
  return {1 - s * (y * y + z * z), s * (x * y + w * z),     s * (x * z - w * y),  //
          s * (x * y - w * z),     1 - s * (x * x + z * z), s * (y * z + w * x),  //
          s * (x * z + w * y),     s * (y * z - w * x),     1 - s * (x * x + y * y)};
}

Result<CameraSet> finish(std::vector<Camera> cameras) {
  if (cameras.empty()) return make_error(Errc::bad_value, Error::kNone, "the COLMAP model has no images");
  CameraSet set;
  set.source = CameraSet::Source::colmap;
  set.cameras = std::move(cameras);
  std::stable_sort(set.cameras.begin(), set.cameras.end(),
                   [](const Camera& a, const Camera& b) { return a.name < b.name; });
  detail::split_by_name(set);
  return set;
}

Result<Lenses> binary_lenses(std::span<const std::byte> bytes) {
  constexpr std::uint64_t kSmallest = 4 + 4 + 8 + 8 + 3 * 8;
  Cursor in(bytes);
  const auto n = in.read<std::uint64_t>();
  if (!in.ok()) return make_error(Errc::truncated, bytes.size(), "cameras.bin: no count", 8, bytes.size());
  if (n > in.left() / kSmallest)
    return make_error(Errc::truncated, 0, "cameras.bin: it announces more cameras than it can hold", n,
                      in.left() / kSmallest);
  Lenses lenses;
  for (std::uint64_t i = 0; i < n; ++i) {
    const std::uint64_t start = in.offset();
    const auto id = in.read<std::uint32_t>(), number = in.read<std::uint32_t>();
    const auto width = in.read<std::uint64_t>(), height = in.read<std::uint64_t>();
    const Model* const model = number < std::size(kModels) ? &kModels[number] : nullptr;
    if (const char* const refusal = refusal_of(model); in.ok() && *refusal != '\0')
      return make_error(Errc::unsupported_feature, start, refusal, Error::kNone, i);
    double parameters[kMostParameters] = {};
    const std::size_t n_parameters = in.ok() ? model->n_parameters() : 0;
    for (std::size_t k = 0; k < n_parameters; ++k) parameters[k] = in.read<double>();
    if (!in.ok()) return make_error(Errc::truncated, bytes.size(), "cameras.bin: ends inside a camera");
    Camera camera;
    if (!set_lens(camera, *model, width, height, std::span(parameters).first(n_parameters)))
      return make_error(Errc::bad_value, start,
                        "cameras.bin: the camera of this index has an impossible size, focal length or distortion",
                        Error::kNone, i);
    if (!lenses.emplace(id, camera).second)
      return make_error(Errc::bad_value, start, "cameras.bin: this camera id is used twice", Error::kNone, id);
  }
  if (in.left() != 0) return make_error(Errc::trailing_bytes, in.offset(), "cameras.bin: bytes after the last camera");
  return lenses;
}

// Text split into lines and these into words, with their byte offsets.
class Lines {
 public:
  explicit Lines(std::string_view text) : text_(text) {}
  // The next line without its end; false at the end of the text.
  bool next() {
    if (end_ == text_.size() && (started_ || text_.empty())) return false;
    begin_ = started_ ? end_ + 1 : 0;
    started_ = true;
    if (begin_ > text_.size()) return false;
    end_ = std::min(text_.find('\n', begin_), text_.size());
    word_ = begin_;
    return true;
  }
  // The next line that is neither empty nor a comment.
  bool next_record() {
    while (next()) {
      const std::size_t first = text_.substr(begin_, end_ - begin_).find_first_not_of(" \t\r");
      if (first != std::string_view::npos && text_[begin_ + first] != '#') return true;
    }
    return false;
  }
  std::uint64_t line_offset() const { return begin_; }
  std::uint64_t word_offset() const { return word_; }

  std::string_view word() {
    skip_spaces();
    const std::size_t from = word_;
    while (word_ < end_ && !is_space(text_[word_])) ++word_;
    return text_.substr(from, word_ - from);
  }
  // The rest of the line without spaces around it.
  std::string_view rest() {
    skip_spaces();
    std::size_t last = end_;
    while (last > word_ && is_space(text_[last - 1])) --last;
    return text_.substr(word_, last - word_);
  }
  template <class T>
  bool number(T& out) {
    const std::string_view w = word();
    const auto [end, error] = std::from_chars(w.data(), w.data() + w.size(), out);
    return !w.empty() && error == std::errc() && end == w.data() + w.size();
  }

 private:
  static bool is_space(char c) { return c == ' ' || c == '\t' || c == '\r'; }
  void skip_spaces() {
    while (word_ < end_ && is_space(text_[word_])) ++word_;
  }
  std::string_view text_;
  std::size_t begin_ = 0, end_ = 0, word_ = 0;
  bool started_ = false;
};

Result<Lenses> text_lenses(std::string_view text) {
  Lenses lenses;
  Lines in(text);
  for (std::uint64_t i = 0; in.next_record(); ++i) {
    std::uint32_t id = 0;
    if (!in.number(id)) return make_error(Errc::bad_syntax, in.word_offset(), "cameras.txt: expected a camera id");
    const std::string_view name = in.word();
    if (name.empty())
      return make_error(Errc::unsupported_feature, in.line_offset(), "cameras.txt: a camera without a model");
    const auto* const model = std::ranges::find(kModels, name, &Model::name);
    if (const char* const refusal = refusal_of(model != std::end(kModels) ? model : nullptr); *refusal != '\0')
      return make_error(Errc::unsupported_feature, in.line_offset(), refusal, Error::kNone, i);
    std::uint64_t width = 0, height = 0;
    double parameters[kMostParameters] = {};
    const std::size_t n_parameters = model->n_parameters();
    bool ok = in.number(width) && in.number(height);
    for (std::size_t k = 0; k < n_parameters; ++k) ok = ok && in.number(parameters[k]);
    if (!ok || !in.rest().empty())
      return make_error(Errc::bad_syntax, in.word_offset(),
                        "cameras.txt: expected WIDTH HEIGHT and the model's parameters");
    Camera camera;
    if (!set_lens(camera, *model, width, height, std::span(parameters).first(n_parameters)))
      return make_error(Errc::bad_value, in.line_offset(),
                        "cameras.txt: the camera of this index has an impossible size, focal length or distortion",
                        Error::kNone, i);
    if (!lenses.emplace(id, camera).second)
      return make_error(Errc::bad_value, in.line_offset(), "cameras.txt: this camera id is used twice", Error::kNone,
                        id);
  }
  return lenses;
}

}  // namespace

Result<CameraSet> parse_colmap_binary(std::span<const std::byte> cameras_bin, std::span<const std::byte> images_bin) {
  return detail::guard_memory([&]() -> Result<CameraSet> {
    const auto lenses = binary_lenses(cameras_bin);
    if (!lenses) return tl::unexpected(lenses.error());
    Cursor in(images_bin);
    const auto n = in.read<std::uint64_t>();
    if (!in.ok()) return make_error(Errc::truncated, images_bin.size(), "images.bin: no count", 8, images_bin.size());
    if (n > in.left() / kImageBytes)
      return make_error(Errc::truncated, 0, "images.bin: it announces more images than it can hold", n,
                        in.left() / kImageBytes);
    std::vector<Camera> cameras;
    for (std::uint64_t i = 0; i < n; ++i) {
      const std::uint64_t start = in.offset();
      in.read<std::uint32_t>();  // image id
      glm::dquat q;
      glm::dvec3 t;
      for (double* x : {&q.w, &q.x, &q.y, &q.z, &t.x, &t.y, &t.z}) *x = in.read<double>();
      const auto id = in.read<std::uint32_t>();
      std::string name = in.text();
      const auto n_points = in.read<std::uint64_t>();
      constexpr std::uint64_t kPointBytes = 24;
      if (!in.ok() || n_points > in.left() / kPointBytes)
        return make_error(Errc::truncated, images_bin.size(), "images.bin: ends inside an image");
      in.skip(n_points * kPointBytes);
      const auto lens = lenses->find(id);
      if (lens == lenses->end())
        return make_error(Errc::bad_value, start, "images.bin: an image of a camera that cameras.bin does not have",
                          Error::kNone, id);
      Camera camera = lens->second;
      camera.name = std::move(name);
      camera.world_to_camera = detail::rigid_motion(rotation_of(q), t);
      if (const auto valid = detail::validate_record(camera, start, i); !valid) return tl::unexpected(valid.error());
      cameras.push_back(std::move(camera));
    }
    if (in.left() != 0) return make_error(Errc::trailing_bytes, in.offset(), "images.bin: bytes after the last image");
    return finish(std::move(cameras));
  });
}

Result<CameraSet> parse_colmap_text(std::string_view cameras_txt, std::string_view images_txt) {
  return detail::guard_memory([&]() -> Result<CameraSet> {
    const auto lenses = text_lenses(cameras_txt);
    if (!lenses) return tl::unexpected(lenses.error());
    std::vector<Camera> cameras;
    Lines in(images_txt);
    for (std::uint64_t i = 0; in.next_record(); ++i) {
      const std::uint64_t start = in.line_offset();
      std::uint32_t image_id = 0, id = 0;
      glm::dquat q{};
      glm::dvec3 t{};
      bool ok = in.number(image_id);
      for (double* x : {&q.w, &q.x, &q.y, &q.z, &t.x, &t.y, &t.z}) ok = ok && in.number(*x);
      ok = ok && in.number(id);
      if (!ok)
        return make_error(Errc::bad_syntax, in.word_offset(),
                          "images.txt: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME");
      const std::string name(in.rest());
      const auto lens = lenses->find(id);
      if (lens == lenses->end())
        return make_error(Errc::bad_value, start, "images.txt: an image of a camera that cameras.txt does not have",
                          Error::kNone, id);
      Camera camera = lens->second;
      camera.name = name;
      camera.world_to_camera = detail::rigid_motion(rotation_of(q), t);
      if (const auto valid = detail::validate_record(camera, start, i); !valid) return tl::unexpected(valid.error());
      cameras.push_back(std::move(camera));
      in.next();  // 2D points of the image; the line is empty if there are none
    }
    return finish(std::move(cameras));
  });
}

}  // namespace rgs
