// camera_file.hpp - reads the cameras of capture and training programs; formats: docs/user/CAMERAS.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/result.hpp"

namespace RGS_API rgs {

/// Whether a photograph was trained on or is held out for evaluation.
enum class Split : std::uint8_t { train, test };

struct CameraSet {
  enum class Source : std::uint8_t {
    list,        ///< JSON list with world_to_camera
    training,    ///< cameras.json of 3DGS training: position and camera-to-world rotation
    transforms,  ///< NeRF transforms.json, OpenGL axes
    colmap,      ///< COLMAP sparse model, binary or text
  };
  Source source = Source::list;
  std::vector<Camera> cameras;  ///< in file order; COLMAP's sorted by name
  std::vector<Split> split;     ///< one per camera
  /// Whether the file assigns any camera; the others are then for training. Otherwise every eighth camera in name
  /// order, the first included, is a test camera, as in the evaluations of 3DGS and Mip-NeRF 360.
  bool split_declared = false;
};

/// Reads the cameras of a JSON file or of a folder with a COLMAP sparse model (the folder itself, its `sparse/0` or its
/// `sparse`; binary files are preferred to text). The content decides the format, not the name. Returns at least one
/// camera, all valid (see validate()). Errors: open_failed, read_failed; bad_syntax (byte offset), truncated, bad_value
/// (byte offset of the camera, its index in Error::found), trailing_bytes, unsupported_feature (a camera
/// model that cannot be drawn: undistort first), limit_exceeded (JSON above 256 MiB).
Result<CameraSet> read_camera_set(const std::string& path);
/// The cameras alone.
Result<std::vector<Camera>> read_cameras(const std::string& path);

/// The same from memory; takes a small multiple of the input's size.
Result<CameraSet> parse_camera_json(std::string_view text);
Result<CameraSet> parse_colmap_binary(std::span<const std::byte> cameras_bin, std::span<const std::byte> images_bin);
Result<CameraSet> parse_colmap_text(std::string_view cameras_txt, std::string_view images_txt);

}  // namespace rgs
