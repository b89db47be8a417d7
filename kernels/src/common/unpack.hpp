// unpack.hpp - launches that decode contents of coded frames (Codec::planes) to rows on the device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/planes.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Contents have frame_content_bytes() and may hold anything: any content gives some rows. All may fail with
/// device_failed.

/// content: 12 planes of n_rows bytes -> MEAN rows [n_rows, 3]. n_rows > 0.
Status launch_unpack_means(const std::uint8_t* content, std::uint32_t n_rows, float* rows, Stream stream);
/// content: 16 planes -> GEOM rows [n_rows, 8], 16-byte aligned.
Status launch_unpack_geometry(const std::uint8_t* content, std::uint32_t n_rows, std::uint16_t* rows, Stream stream);

struct UnpackShArguments {
  const std::uint8_t* content;   ///< weights, then a plane of n_rows bytes for each code
  const RelativeShSteps* steps;  ///< [ceil(n_rows / chunk_size)]
  std::uint32_t n_rows;          ///< > 0
  std::uint32_t chunk_size;
  int sh_degree;
  std::uint32_t* rows;  ///< SHI8 [n_rows, sh_bytes / 4]
};
Status launch_unpack_sh(const UnpackShArguments& arguments, Stream stream);

}  // namespace rgs::cuda
