// device_target_test.cpp - frames in the caller's memory: padded rows, surfaces, and refusals.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/device_target.hpp"

#include <doctest/doctest.h>

#include <cstring>

#include "device_fixture.hpp"
#include "rgs/cuda_renderer.hpp"

using namespace rgs;
using namespace rgs::test;
using math::PixelFormat;

namespace {

std::vector<RenderOptions> pipelines() {
  RenderOptions turbo_fp32 = turbo_options();
  turbo_fp32.turbo.tensor_cores = false;
  return {baseline_options(), paper_options(), turbo_options(), turbo_fp32};
}

CudaRenderer renderer() {
  auto made = CudaRenderer::create();
  require_ok(made);
  return *std::move(made);
}
DeviceScene scene_for_targets() {
  auto scene = DeviceScene::upload(scene_of(cloud_of(random_splats(701, sized(2000, 2000, 300)), 2)).view().value());
  require_ok(scene);
  return *std::move(scene);
}

/// Rows of `row_bytes` taken from rows of `pitch` bytes; fails the test unless the padding is unchanged.
std::vector<std::byte> rows_of(const std::vector<std::byte>& pitched, std::size_t row_bytes, std::size_t pitch) {
  std::vector<std::byte> rows;
  std::size_t n_touched = 0;
  for (std::size_t begin = 0; begin < pitched.size(); begin += pitch) {
    for (std::size_t k = 0; k < pitch; ++k) {
      if (k < row_bytes) {
        rows.push_back(pitched[begin + k]);
      } else {
        n_touched += pitched[begin + k] != std::byte{0xFF};
      }
    }
  }
  CHECK_MESSAGE(n_touched == 0, n_touched, " bytes between rows were written");
  return rows;
}

}  // namespace

TEST_CASE("targets: misaligned memory, or rows shorter than the image, are refused without a device") {
  const Camera camera = front_camera(75, 33);
  alignas(8) std::byte memory[16];  // only its address matters
  auto* const floats = reinterpret_cast<float*>(memory);
  auto* const odd = reinterpret_cast<float*>(memory + 2);
  const auto code = [&](const DeviceTarget& target) {
    const auto ok = detail::validate(target, camera);
    return ok ? Errc::internal : ok.error().code;
  };
  CHECK(code({}) == Errc::internal);
  CHECK(code({.rgb = floats, .alpha = floats, .depth = floats, .packed = floats}) == Errc::internal);
  CHECK(code({.rgb = odd}) == Errc::bad_argument);
  CHECK(code({.alpha = odd}) == Errc::bad_argument);
  CHECK(code({.blended = reinterpret_cast<std::uint32_t*>(odd)}) == Errc::bad_argument);
  CHECK(code({.packed = odd}) == Errc::bad_argument);
  CHECK(code({.packed = floats + 1}) == Errc::internal);
  CHECK(code({.packed = floats + 1, .format = PixelFormat::rgba16f}) == Errc::bad_argument);
  CHECK(code({.packed = floats, .format = static_cast<PixelFormat>(2)}) == Errc::bad_argument);
  CHECK(code({.packed = floats, .surface = 1}) == Errc::bad_argument);
  CHECK(code({.surface = 1}) == Errc::internal);

  CHECK(code({.rgb = floats, .pitch = {.rgb = 75 * 12}}) == Errc::internal);
  CHECK(code({.rgb = floats, .pitch = {.rgb = 75 * 12 + 4}}) == Errc::internal);
  CHECK(code({.rgb = floats, .pitch = {.rgb = 75 * 12 - 4}}) == Errc::bad_argument);
  CHECK(code({.rgb = floats, .pitch = {.rgb = 75 * 12 + 2}}) == Errc::bad_argument);
  CHECK(code({.rgb = floats, .pitch = {.alpha = 1}}) == Errc::internal);  // of an output that is not requested
  CHECK(code({.alpha = floats, .pitch = {.alpha = 75 * 4 - 4}}) == Errc::bad_argument);
  CHECK(code({.depth = floats, .pitch = {.depth = 75 * 4 + 1}}) == Errc::bad_argument);
  auto* const bytes = reinterpret_cast<std::uint8_t*>(memory + 1);
  CHECK(code({.codes = bytes, .pitch = {.codes = 75 * 3 + 1}}) == Errc::internal);
  CHECK(code({.codes = bytes, .pitch = {.codes = 75 * 3 - 1}}) == Errc::bad_argument);
  CHECK(code({.packed = floats, .pitch = {.packed = 75 * 4 + 4}}) == Errc::internal);
  CHECK(code({.packed = floats, .format = PixelFormat::rgba16f, .pitch = {.packed = 75 * 8 + 4}}) ==
        Errc::bad_argument);
  CHECK(code({.packed = floats, .format = PixelFormat::rgba16f, .pitch = {.packed = 75 * 4}}) == Errc::bad_argument);
}

TEST_CASE("targets: a pitch of 0 means rows without padding") {
  float pixel = 0;
  const auto arrays = detail::arrays_of({.rgb = &pixel, .format = PixelFormat::rgba16f, .pitch = {.depth = 4096}},
                                        front_camera(75, 33));
  CHECK(arrays.pitch.rgb == 75 * 12);
  CHECK(arrays.pitch.alpha == 75 * 4);
  CHECK(arrays.pitch.depth == 4096);
  CHECK(arrays.pitch.evaluated == 75 * 4);
  CHECK(arrays.pitch.blended == 75 * 4);
  CHECK(arrays.pitch.packed == 75 * 8);
  CHECK(arrays.pitch.codes == 75 * 3);
}

TEST_CASE("targets: colours alone equal colours with alpha, also in a frame that follows a nearly empty one") {
  if (!device_answers()) return;
  const DeviceScene full = scene_for_targets();
  const auto upload = [](const std::vector<Splat>& splats) {
    auto scene = DeviceScene::upload(scene_of(cloud_of(splats)).view().value());
    require_ok(scene);
    return *std::move(scene);
  };
  const DeviceScene speck = upload({splat_at(0.3, 0.2, 5, 0.02, 0.9)});  // in one tile or two
  // With so many turbo tiles a speck leaves the frame nearly empty; with and without incomplete tiles at the borders.
  const std::pair<int, int> sizes[] = {{256, 192}, {250, 190}, {257, 191}};
  for (const auto& [width, height] : sizes) {
    CAPTURE(width);
    const Camera camera = front_camera(width, height);
    const auto n = static_cast<std::size_t>(3 * width) * static_cast<std::size_t>(height);
    for (RenderOptions options : pipelines()) {
      if (race_sizes() && (width != 250 || options.pipeline != Pipeline::turbo)) continue;
      options.background = {0.3F, 0.2F, 0.1F};
      CudaRenderer used = renderer();
      const DeviceScene none;
      for (const DeviceScene* scene : {&none, &speck, &speck, &full, &none, &full}) {
        const DeviceArray<float> alone(n), colors(n), alphas(n / 3);
        require_ok(used.render(*scene, camera, {.rgb = alone.data()}, options));
        CudaRenderer fresh = renderer();
        require_ok(fresh.render(*scene, camera, {.rgb = colors.data(), .alpha = alphas.data()}, options));
        CHECK(alone.download() == colors.download());
        require_ok(used.render(*scene, camera, {.rgb = alone.data(), .alpha = alphas.data()}, options));
        CHECK(alone.download() == colors.download());
      }
    }
  }
}

TEST_CASE("targets: padded rows hold the bytes of unpadded ones, and the padding is unchanged") {
  if (!device_answers()) return;
  constexpr std::size_t kWidth = 75, kHeight = 33;  // no multiple of a tile
  const Camera camera = front_camera(kWidth, kHeight);
  const DeviceScene scene = scene_for_targets();
  CudaRenderer device = renderer();
  for (const RenderOptions& options : pipelines()) {
    for (const bool details : {false, true}) {  // with their own kernels
      for (const auto format : {PixelFormat::rgba8, PixelFormat::rgba16f}) {
        if (race_sizes() && (details || format != PixelFormat::rgba8)) continue;  // kernels that other cases cover
        const RowPitches pitch{.rgb = kWidth * 12 + 4,
                               .alpha = kWidth * 4 + 20,
                               .depth = kWidth * 4 + 4,
                               .evaluated = kWidth * 4 + 8,
                               .blended = kWidth * 4 + 400,
                               .packed = kWidth * math::pixel_bytes(format) + 8,
                               .codes = kWidth * 3 + 1};
        const auto draw = [&](const RowPitches& pitches) {
          const auto rows = [&](std::uint64_t p, std::size_t tight) {
            return DeviceArray<std::byte>(kHeight * (p == 0 ? tight : p));
          };
          const auto rgb = rows(pitches.rgb, kWidth * 12), alpha = rows(pitches.alpha, kWidth * 4);
          const auto depth = rows(pitches.depth, kWidth * 4), evaluated = rows(pitches.evaluated, kWidth * 4);
          const auto blended = rows(pitches.blended, kWidth * 4), codes = rows(pitches.codes, kWidth * 3);
          const auto packed = rows(pitches.packed, kWidth * math::pixel_bytes(format));
          DeviceTarget target{.rgb = reinterpret_cast<float*>(rgb.data()),
                              .alpha = reinterpret_cast<float*>(alpha.data()),
                              .codes = reinterpret_cast<std::uint8_t*>(codes.data()),
                              .packed = packed.data(),
                              .format = format,
                              .pitch = pitches};
          if (details) {
            target.depth = reinterpret_cast<float*>(depth.data());
            target.evaluated = reinterpret_cast<std::uint32_t*>(evaluated.data());
            target.blended = reinterpret_cast<std::uint32_t*>(blended.data());
          }
          require_ok(device.render(scene, camera, target, options));
          return std::vector{rgb.download(),     alpha.download(),  depth.download(), evaluated.download(),
                             blended.download(), packed.download(), codes.download()};
        };
        const auto tight = draw({}), pitched = draw(pitch);
        const std::size_t row_bytes[] = {kWidth * 12, kWidth * 4, kWidth * 4,
                                         kWidth * 4,  kWidth * 4, kWidth * math::pixel_bytes(format),
                                         kWidth * 3};
        const std::uint64_t pitches[] = {pitch.rgb,     pitch.alpha,  pitch.depth, pitch.evaluated,
                                         pitch.blended, pitch.packed, pitch.codes};
        for (std::size_t k = 0; k < tight.size(); ++k) {
          CAPTURE(k);
          CHECK(rows_of(pitched[k], row_bytes[k], pitches[k]) == tight[k]);
        }
        CHECK(tight[0][3] != std::byte{0xFF});
        std::size_t n_wrong = 0;
        for (std::size_t k = 0; k < tight[6].size(); ++k) {
          float value = 0;
          std::memcpy(&value, tight[0].data() + sizeof(float) * k, sizeof(float));
          n_wrong += std::to_integer<std::uint8_t>(tight[6][k]) != to_8bit(value);
        }
        CHECK(n_wrong == 0);
      }
    }
  }
}

TEST_CASE(
    "targets: a surface gets the same pixels as packed memory; a small surface or one of other elements is refused") {
  if (!device_answers()) return;
  constexpr std::size_t kWidth = 75, kHeight = 33;
  const Camera camera = front_camera(kWidth, kHeight);
  const DeviceScene scene = scene_for_targets();
  CudaRenderer device = renderer();
  for (const auto format : {PixelFormat::rgba8, PixelFormat::rgba16f}) {
    if (race_sizes() && format != PixelFormat::rgba8) continue;  // the same kernels
    const bool is_bytes = format == PixelFormat::rgba8;
    const auto channels = is_bytes ? cudaCreateChannelDesc(8, 8, 8, 8, cudaChannelFormatKindUnsigned)
                                   : cudaCreateChannelDesc(16, 16, 16, 16, cudaChannelFormatKindFloat);
    const std::size_t bytes = math::pixel_bytes(format), array_width = kWidth + 5, array_height = kHeight + 2;
    cudaArray_t array = nullptr;
    require_cuda(cudaMallocArray(&array, &channels, array_width, array_height, cudaArraySurfaceLoadStore));
    cudaResourceDesc resource{};
    resource.resType = cudaResourceTypeArray;
    resource.res.array.array = array;
    cudaSurfaceObject_t surface = 0;
    require_cuda(cudaCreateSurfaceObject(&surface, &resource));
    for (const RenderOptions& options : pipelines()) {
      std::vector<std::byte> all(array_width * array_height * bytes, std::byte{0xFF});
      require_cuda(cudaMemcpy2DToArray(array, 0, 0, all.data(), array_width * bytes, array_width * bytes, array_height,
                                       cudaMemcpyHostToDevice));
      const DeviceArray<std::byte> packed(kWidth * kHeight * bytes);
      const DeviceArray<float> rgb(3 * kWidth * kHeight), beside(3 * kWidth * kHeight);
      require_ok(device.render(scene, camera, {.rgb = rgb.data(), .packed = packed.data(), .format = format}, options));
      require_ok(device.render(scene, camera, {.rgb = beside.data(), .format = format, .surface = surface}, options));
      const auto expected = packed.download();
      CHECK(rgb.download() == beside.download());
      require_cuda(cudaMemcpy2DFromArray(all.data(), array_width * bytes, array, 0, 0, array_width * bytes,
                                         array_height, cudaMemcpyDeviceToHost));
      auto rows = rows_of(all, kWidth * bytes, array_width * bytes);
      CHECK(std::all_of(rows.begin() + static_cast<std::ptrdiff_t>(expected.size()), rows.end(),
                        [](std::byte b) { return b == std::byte{0xFF}; }));  // the array's remaining rows
      rows.resize(expected.size());
      CHECK(rows == expected);
    }
    const auto refused = [&](const Camera& view, const DeviceTarget& target) {
      const auto stats = device.render(scene, view, target);
      return !stats && stats.error().code == Errc::bad_argument;
    };
    CHECK(refused(front_camera(81, 33), {.format = format, .surface = surface}));
    CHECK(refused(front_camera(75, 36), {.format = format, .surface = surface}));
    CHECK(refused(camera, {.format = is_bytes ? PixelFormat::rgba16f : PixelFormat::rgba8, .surface = surface}));
    require_cuda(cudaDestroySurfaceObject(surface));
    require_cuda(cudaFreeArray(array));
  }
}
