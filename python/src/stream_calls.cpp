// stream_calls.cpp - streamed scenes.
// SPDX-License-Identifier: Apache-2.0
#include <memory>

#include "calls.hpp"
#include "rgs/scene.hpp"
#include "work.hpp"

namespace rgs::python {
namespace {

Json make_pool(const Json& a) {
  return give(a,
              take(StreamPool::create({.host_memory = a.at("host_memory"), .device_memory = a.at("device_memory")})));
}

Json pool_bytes(const Json& a) {
  const auto& pool = held<StreamPool>(a, "pool");
  return {{"host", pool.host_bytes()}, {"device", pool.device_bytes()}};
}

Json open(const Json& a) {
  OpenOptions options;
  options.pool = held<StreamPool>(a, "pool");
  options.prefetch = a.at("prefetch");
  options.url.stop = held<std::shared_ptr<Work>>(a, "work")->stop();
  options.url.open_seconds = a.at("open_seconds");
  if (const auto ratio = optional<std::uint64_t>(a, "max_expansion")) options.limits.max_expansion = *ratio;
  return give_scene(a, take(Scene::open(path_of(a), options)));
}

Json stats(const Json& a) {
  const StreamStats s = scene_of(a).stats();
  return {{"pages_resident", s.pages_resident},
          {"pages_missing", s.pages_missing},
          {"bytes_read", s.bytes_read},
          {"bytes_decoded", s.bytes_decoded},
          {"bytes_uploaded", s.bytes_uploaded},
          {"bytes_evicted", s.bytes_evicted},
          {"detail_reached_px", s.detail_reached_px}};
}

Json check_stream(const Json& a) {
  take(scene_of(a).status());
  return nullptr;
}

}  // namespace

Calls stream_calls() {
  return {{"make_pool", make_pool},
          {"pool_bytes", pool_bytes},
          {"open_stream", open},
          {"stream_stats", stats},
          {"check_stream", check_stream}};
}

}  // namespace rgs::python
