// open_streamed_scene.cpp - opens a streamed scene by path or address. On its own, so that other programs do not link libcurl.
// SPDX-License-Identifier: Apache-2.0
#include <chrono>
#include <utility>

#include "rgs/streamed_scene.hpp"

namespace rgs {

Result<StreamedScene> StreamedScene::open(const std::string& path_or_url, const StreamOptions& options) {
  const auto begin = std::chrono::steady_clock::now();
  auto source = open_source(path_or_url, options.url);
  if (!source) return tl::unexpected(source.error());
  StreamOptions rest = options;
  rest.url.open_seconds -= std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  return open(*std::move(source), rest);
}

}  // namespace rgs
