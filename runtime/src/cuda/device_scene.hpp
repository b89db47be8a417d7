// device_scene.hpp - what a DeviceScene holds.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>

#include "cuda/cuda_objects.hpp"
#include "cuda/device_memory.hpp"
#include "rgs/cuda_renderer.hpp"
#include "sorted/front_end.hpp"

namespace rgs::detail {

struct SceneStorage {
  SceneStorage() = default;
  SceneStorage(const SceneStorage&) = delete;
  SceneStorage& operator=(const SceneStorage&) = delete;
  ~SceneStorage() {
    if (copied && copied->get() != nullptr) cudaEventSynchronize(copied->get());
  }

  std::uint64_t n = 0;
  int sh_degree = 0;
  std::optional<Declarations> declarations;
  Origin origin = kNoOrigin;
  cuda::Attributes attributes;
  DeviceBuffer memory;
  std::optional<Event> copied;  ///< the end of an upload that nobody has waited for
};

}  // namespace rgs::detail
