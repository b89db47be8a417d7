// frame_maker.hpp - draws reference pictures of the scenes.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "frame_request.hpp"
#include "rgs/interchange.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"
#include "rgs/stream_pool.hpp"

namespace rgs::view {

struct FrameSettings {
  Backend backend = Backend::cpu;  ///< cpu or cuda
  int threads = 0;                 ///< CPU threads; 0: all
  /// If given, files with levels of detail are streamed within it; other files are loaded whole.
  std::optional<StreamPoolOptions> budget = std::nullopt;
  ReadOptions read = {};
};

/// An error, and the path of its scene; empty if it concerns no scene.
struct SceneError {
  std::string path;
  Error error;
};

struct Frame {
  std::string file;  ///< PNG or JPEG
  double render_ms = 0, encode_ms = 0;
  std::optional<StreamStats> stream;       ///< if the scene is streamed
  std::optional<Error> stream_error = {};  ///< why pages are missing
};

class FrameMaker {
 public:
  /// Opens and prepares the scenes. Errors: those of Renderer::create(), open_scene_file(), Scene::open() and
  /// Renderer::prepare(); bad_argument (a budget, but no file with levels of detail).
  static tl::expected<FrameMaker, SceneError> create(const std::vector<std::string>& paths,
                                                     const FrameSettings& settings);
  FrameMaker(FrameMaker&&) noexcept;
  FrameMaker& operator=(FrameMaker&&) noexcept;
  ~FrameMaker();

  Backend backend() const;  ///< cpu or cuda
  std::size_t n_scenes() const;
  /// Thread-safe. Frames are drawn one after the other; a PNG has the pixels of rgs-render. Errors: those of Renderer::render();
  /// read_failed (a scene's file has changed).
  Result<Frame> make(const FrameRequest& request);

 private:
  struct Impl;
  explicit FrameMaker(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::view
