// frame_request.hpp - a request for a reference picture.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string_view>

#include "image_file.hpp"
#include "rgs/camera.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::view {

inline constexpr int kMostSide = 8192;  ///< pixels; a frame of this size takes 0.8 GB
inline constexpr int kDefaultJpegQuality = 85;

struct FrameRequest {
  std::size_t scene = 0;
  Camera camera;  ///< in the picture's size
  RenderOptions options;
  ImageFormat format = ImageFormat::png;  ///< or jpeg
  int quality = kDefaultJpegQuality;      ///< for JPEG, 1..100
};

/// Parses the JSON object of docs/user/VIEW.md, "Frames". Errors: bad_syntax (not a JSON object, an unknown field, a value of the wrong
/// type), bad_argument (a value out of range, no such scene); those of parse_camera_json().
Result<FrameRequest> parse_frame_request(std::string_view body, std::size_t n_scenes);

}  // namespace rgs::view
