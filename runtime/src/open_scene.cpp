// open_scene.cpp - opens a scene by path or address. On its own, so that other programs do not link libcurl.
// SPDX-License-Identifier: Apache-2.0
#include <chrono>
#include <utility>

#include "rgs/file.hpp"
#include "rgs/scene.hpp"

namespace rgs {

Result<Scene> Scene::open(const std::string& path_or_url, const OpenOptions& options) {
  if (!options.pool && !is_url(path_or_url)) {
    auto file = MappedFile::open(path_or_url);
    if (!file) return tl::unexpected(file.error());
    return open(*std::move(file), options.limits);
  }
  const auto begin = std::chrono::steady_clock::now();
  auto source = open_source(path_or_url, options.url);
  if (!source) return tl::unexpected(source.error());
  OpenOptions rest = options;
  rest.url.open_seconds -= std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  return open(*std::move(source), rest);
}

}  // namespace rgs
