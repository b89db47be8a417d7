// cameras_fixture.hpp - small camera files in every format, written by the tests.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <memory>
#include <span>
#include <string>
#include <string_view>

namespace rgs::test {

/// One camera of the list format: 90 degrees around y (looks along world +x), centre (1, 2, 3).
inline std::string list_camera(const std::string& name, const std::string& split) {
  return R"({"name":")" + name + R"(","split":")" + split +
         R"(","width":640,"height":480,"fx":500.5,"fy":501.5,"cx":320,"cy":240,)"
         R"("world_to_camera":[[0,0,-1,3],[0,1,0,-2],[1,0,0,-1],[0,0,0,1]]})";
}
inline std::string camera_list() {
  return "[" + list_camera("a", "test") + ",\n " + list_camera("b", "train") + "]\n";
}

/// The same camera in the form of 3DGS training programs: columns of `rotation` are the camera's axes.
inline std::string training_camera(const std::string& name) {
  return R"({"id":0,"img_name":")" + name +
         R"(","width":640,"height":480,"position":[1,2,3],"rotation":[[0,0,1],[0,1,0],[-1,0,0]],)"
         R"("fy":501.5,"fx":500.5})";
}
inline std::string training_list() {
  return "[" + training_camera("a") + "," + training_camera("b") + "]";
}

/// The same camera in OpenGL axes: second and third column negated.
inline std::string transforms() {
  return R"({"fl_x":500.5,"fl_y":501.5,"cx":320,"cy":240,"w":640,"h":480.0,"k1":0,"applied_transform":[[1,0,0,0]],
"frames":[{"file_path":"a","transform_matrix":[[0,0,-1,1],[0,-1,0,2],[-1,0,0,3],[0,0,0,1]]},
{"file_path":"b","transform_matrix":[[0,0,-1,1],[0,-1,0,2],[-1,0,0,3]]}]})";
}

/// Little-endian bytes, assembled field by field.
class Bytes {
 public:
  template <class T>
  Bytes& put(T value) {
    char raw[sizeof(T)];
    std::memcpy(raw, &value, sizeof(T));
    data_.append(raw, sizeof(T));
    return *this;
  }
  Bytes& text(const std::string& value) {
    data_.append(value.c_str(), value.size() + 1);
    return *this;
  }
  const std::string& str() const { return data_; }

 private:
  static_assert(std::endian::native == std::endian::little);
  std::string data_;
};

inline std::string colmap_cameras_bin() {
  Bytes b;
  b.put(std::uint64_t{2});
  b.put(std::uint32_t{7}).put(std::int32_t{1}).put(std::uint64_t{640}).put(std::uint64_t{480});
  for (const double p : {500.5, 501.5, 320.0, 240.0}) b.put(p);
  b.put(std::uint32_t{9}).put(std::int32_t{0}).put(std::uint64_t{32}).put(std::uint64_t{16});
  for (const double p : {20.0, 16.0, 8.0}) b.put(p);
  return b.str();
}

inline void put_image(Bytes& b, const std::string& name, std::uint32_t camera, std::uint64_t n_points) {
  b.put(std::uint32_t{1});
  // Twice the unit quaternion of the rotation above (-90 degrees around y): readers normalise.
  for (const double x : {std::sqrt(2.0), 0.0, -std::sqrt(2.0), 0.0, 3.0, -2.0, -1.0}) b.put(x);
  b.put(camera).text(name).put(n_points);
  for (std::uint64_t i = 0; i < n_points; ++i) b.put(1.5).put(2.5).put(std::int64_t{-1});
}

inline std::string colmap_images_bin() {
  Bytes b;
  b.put(std::uint64_t{2});
  put_image(b, "b.jpg", 9, 0);
  put_image(b, "a.jpg", 7, 2);
  return b.str();
}

inline std::string colmap_cameras_txt() {
  return "# Camera list\n\n7 PINHOLE 640 480 500.5 501.5 320 240\r\n9 SIMPLE_PINHOLE 32 16 20 16 8\n";
}
inline std::string colmap_images_txt() {
  return "# Image list\n1 1.4142135623730951 0 -1.4142135623730951 0 3 -2 -1 9 b.jpg\n\n"
         "2 1.4142135623730951 0 -1.4142135623730951 0 3 -2 -1 7 a.jpg\n1.5 2.5 -1 1.5 2.5 -1\n";
}

/// A heap copy of the first `size` bytes without slack, so that AddressSanitizer detects any overread.
class ExactCopy {
 public:
  ExactCopy(const std::string& source, std::size_t size) : data_(new std::byte[size]), size_(size) {
    if (size > 0) std::memcpy(data_.get(), source.data(), size);
  }
  explicit ExactCopy(const std::string& source) : ExactCopy(source, source.size()) {}
  std::span<const std::byte> bytes() const { return {data_.get(), size_}; }
  std::string_view text() const { return {reinterpret_cast<const char*>(data_.get()), size_}; }

 private:
  std::unique_ptr<std::byte[]> data_;
  std::size_t size_;
};

}  // namespace rgs::test
