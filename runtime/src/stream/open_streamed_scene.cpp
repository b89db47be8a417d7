// open_streamed_scene.cpp - opens a streamed scene by path or address. On its own, so that other programs do not link libcurl.
// SPDX-License-Identifier: Apache-2.0
#include <utility>

#include "rgs/streamed_scene.hpp"

namespace rgs {

Result<StreamedScene> StreamedScene::open(const std::string& path_or_url, const StreamOptions& options) {
  auto source = open_source(path_or_url, options.url);
  if (!source) return tl::unexpected(source.error());
  return open(*std::move(source), options);
}

}  // namespace rgs
