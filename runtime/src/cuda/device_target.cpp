// device_target.cpp - checks of a target before a frame.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/device_target.hpp"

#include <cstdint>

#include "cuda/cuda_objects.hpp"

namespace rgs::detail {
namespace {

tl::unexpected<Error> refuse(const char* what, std::uint64_t expected = Error::kNone,
                             std::uint64_t found = Error::kNone) {
  return make_error(Errc::bad_argument, Error::kNone, what, expected, found);
}

struct Output {
  const void* data;
  std::uint64_t pitch, word_bytes, pixel_bytes;
};

}  // namespace

Status validate(const DeviceTarget& t, const Camera& camera) {
  if (t.format > math::PixelFormat::rgba16f) return refuse("the pixel format is unknown");
  if (t.surface != 0 && t.packed != nullptr)
    return refuse("packed pixels are written to memory or to a surface, not to both");
  const std::uint64_t packed_bytes = math::pixel_bytes(t.format);
  for (const Output& o :
       {Output{t.rgb, t.pitch.rgb, 4, 12}, Output{t.alpha, t.pitch.alpha, 4, 4}, Output{t.depth, t.pitch.depth, 4, 4},
        Output{t.evaluated, t.pitch.evaluated, 4, 4}, Output{t.blended, t.pitch.blended, 4, 4},
        Output{t.packed, t.pitch.packed, packed_bytes, packed_bytes}, Output{t.codes, t.pitch.codes, 1, 3}}) {
    if (o.data == nullptr) continue;
    if (reinterpret_cast<std::uintptr_t>(o.data) % o.word_bytes != 0) {
      return refuse("an output is not aligned to its elements", o.word_bytes);
    }
    if (o.pitch == 0) continue;
    const std::uint64_t row_bytes = static_cast<std::uint64_t>(camera.width) * o.pixel_bytes;
    if (o.pitch < row_bytes) return refuse("an output's pitch is smaller than its rows", row_bytes, o.pitch);
    if (o.pitch % o.word_bytes != 0) {
      return refuse("an output's pitch is not a multiple of its element's size", o.word_bytes, o.pitch);
    }
  }
  return {};
}

Status validate_surface(const DeviceTarget& t, const Camera& camera) {
  if (t.surface == 0) return {};
  cudaResourceDesc resource{};
  if (cudaGetSurfaceObjectResourceDesc(&resource, t.surface) != cudaSuccess ||
      resource.resType != cudaResourceTypeArray) {
    cudaGetLastError();
    return refuse("a target's surface is not one of the current device");
  }
  cudaChannelFormatDesc channels{};
  cudaExtent extent{};
  const Status ok = device_status(cudaArrayGetInfo(&channels, &extent, nullptr, resource.res.array.array),
                                  "a surface's array could not be read");
  if (!ok) return ok;
  if (extent.width < static_cast<std::size_t>(camera.width) ||
      extent.height < static_cast<std::size_t>(camera.height) || extent.depth != 0) {
    return refuse("a target's surface is not a two-dimensional array that holds the image");
  }
  const auto element_bytes = static_cast<std::uint64_t>(channels.x + channels.y + channels.z + channels.w) / 8;
  if (element_bytes != math::pixel_bytes(t.format)) {
    return refuse("a surface's elements are not as large as the pixel format's", math::pixel_bytes(t.format),
                  element_bytes);
  }
  return {};
}

cuda::PixelArrays arrays_of(const DeviceTarget& t, const Camera& camera) {
  const cuda::PixelArrays arrays{
      {t.rgb, t.alpha, t.depth, t.evaluated, t.blended, t.packed, t.format, t.codes},
      t.surface,
      {t.pitch.rgb, t.pitch.alpha, t.pitch.depth, t.pitch.evaluated, t.pitch.blended, t.pitch.packed, t.pitch.codes}};
  return arrays.with_pitches(camera.width);
}

}  // namespace rgs::detail
