// calls.hpp - what the package roofgs calls: functions of a JSON object, by their names. The public API is
// python/roofgs.
// SPDX-License-Identifier: Apache-2.0
//
// Addresses are numbers, a handle is the address of a pointer to its value, and file names, which need not be text, are
// lists of bytes. Python keeps alive what an address or a handle is of, and holds no lock of its own during a call.
#pragma once

#include <any>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace rgs::python {

using Json = nlohmann::ordered_json;
using Calls = std::vector<std::pair<const char*, Json (*)(const Json&)>>;
Calls camera_calls();
Calls scene_calls();
Calls stream_calls();
Calls render_calls();

/// An error on its way to Python, where it becomes a roofgs.Error.
struct Failure {
  Error error;
};

template <class T>
T take(Result<T>&& result) {
  if (!result) throw Failure{result.error()};
  if constexpr (!std::is_void_v<T>) return *std::move(result);
}
[[noreturn]] inline void refuse(Errc code, const char* what) {
  throw Failure{{.code = code, .what = what}};
}

template <class T>
T* address(const Json& a, const char* name) {
  return reinterpret_cast<T*>(a.at(name).get<std::uintptr_t>());
}

/// Gives a value to the handle `into`, which exists before it, so that no exception in Python can lose it.
template <class T>
Json give(const Json& a, T value) {
  *address<void*>(a, "into") = new std::any(std::move(value));  // Python frees it by roofgs_free()
  return nullptr;
}
/// The value of a handle.
template <class T>
T& held(const Json& a, const char* name) {
  T* const value = std::any_cast<T>(static_cast<std::any*>(*address<void*>(a, name)));
  if (value == nullptr) refuse(Errc::internal, "a handle is of another kind");
  return *value;
}
template <class T>
std::optional<T> optional(const Json& a, const char* name) {
  const Json& value = a.at(name);
  return value.is_null() ? std::nullopt : std::optional(value.get<T>());
}
inline std::string path_of(const Json& a) {
  const auto bytes = a.at("path").get<std::vector<std::uint8_t>>();
  return {bytes.begin(), bytes.end()};
}
inline Json numbers(const glm::dvec3& v) {
  return {v.x, v.y, v.z};
}

/// A scene, which `close` may end while other calls use copies. Errors: bad_argument (it has been closed).
Scene scene_of(const Json& a);
Json give_scene(const Json& a, Scene scene);

/// `n` cameras of the array `cameras`, FP64 [n, 31]: width, height, fx, fy, cx, cy, world_to_camera by rows, model,
/// distortion. Without names.
std::vector<Camera> cameras_of(const Json& a);

}  // namespace rgs::python
