// device_scene.hpp - what a DeviceScene holds.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>

#include "cuda/device_buffer.hpp"
#include "rgs/cuda_renderer.hpp"
#include "sorted/front_end.hpp"

namespace rgs {

struct DeviceScene::Storage {
  std::uint64_t n = 0;
  int sh_degree = 0;
  std::optional<Declarations> declarations;
  cuda::Attributes attributes;
  detail::DeviceBuffer memory;
};

}  // namespace rgs
