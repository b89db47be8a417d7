// frame_maker.hpp - frames of the scenes that are looked at, by this project's renderer.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "frame_request.hpp"
#include "rgs/decode.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"
#include "rgs/streamed_scene.hpp"

namespace rgs::view {

struct FrameSettings {
  Backend backend = Backend::cpu;  ///< cpu or cuda
  int threads = 0;                 ///< of the CPU; 0: all
  /// Where one is given, files with levels of detail are drawn from as much as fits in it; all else is drawn from memory.
  std::optional<StreamPoolOptions> budget = std::nullopt;
  DecodeLimits limits = {};
};

/// An error, and the scene that it is of; empty if it is of none.
struct SceneError {
  std::string path;
  Error error;
};

struct Frame {
  std::string file;  ///< PNG or JPEG
  double render_ms = 0, encode_ms = 0;
  std::optional<StreamStats> stream;       ///< of a streamed scene
  std::optional<Error> stream_error = {};  ///< what keeps it from being complete
};

class FrameMaker {
 public:
  /// Opens the scenes and brings them to where they are drawn. Errors: those of Renderer::create(), open_scene_file(), StreamedScene::open()
  /// and Renderer::prepare(); bad_argument where a budget is given for no file with levels.
  static tl::expected<FrameMaker, SceneError> create(const std::vector<std::string>& paths,
                                                     const FrameSettings& settings);
  FrameMaker(FrameMaker&&) noexcept;
  FrameMaker& operator=(FrameMaker&&) noexcept;
  ~FrameMaker();

  Backend backend() const;  ///< cpu or cuda
  std::size_t n_scenes() const;
  /// Any thread may call it; frames are drawn one after the other, and encoded beside the next. A PNG has the pixels that rgs-render writes.
  /// Errors: those of Renderer::render(); read_failed where a scene's file has changed.
  Result<Frame> make(const FrameRequest& request);

 private:
  struct Impl;
  explicit FrameMaker(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::view
