// frame_request.hpp - the picture that a page asks the server for.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string_view>

#include "image_file.hpp"
#include "rgs/camera.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::view {

inline constexpr int kMostSide = 8192;  ///< pixels; a frame's floating-point pixels then take 0.8 GB
inline constexpr int kDefaultJpegQuality = 85;

struct FrameRequest {
  std::size_t scene = 0;
  Camera camera;  ///< of the picture's size
  RenderOptions options;
  ImageFormat format = ImageFormat::png;  ///< or jpeg
  int quality = kDefaultJpegQuality;      ///< of JPEG, 1..100
};

/// From the JSON object that docs/user/VIEW.md describes. Errors: bad_syntax (no JSON object, with the byte; no such field, a value of another
/// type), bad_argument (a value out of its range, no such scene); those of parse_camera_json().
Result<FrameRequest> parse_frame_request(std::string_view body, std::size_t n_scenes);

}  // namespace rgs::view
