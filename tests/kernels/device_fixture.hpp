// device_fixture.hpp - guarded device memory, scenes on the device, and the conditions under which tests run.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime_api.h>
#include <doctest/doctest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "renderer_fixture.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/renderer.hpp"
#include "skip.hpp"
#include "sorted/front_end.hpp"

namespace rgs::test {

/// Whether a CUDA device is available. If not, skips the case.
inline bool device_answers() {
  int n = 0;
  if (cudaGetDeviceCount(&n) == cudaSuccess && n > 0) return true;
  cudaGetLastError();
  skip("no CUDA device answers");
  return false;
}

/// Sizes of scenes and frames by RGS_TEST_SIZE; full if it is not set. `small` is for compute-sanitizer and omits
/// deliberate failures. `race` is for its racecheck, which adds tens of milliseconds per launch and slows shared memory
/// a thousandfold: it runs every path of the kernels once, with the fewest launches and threads.
enum class TestSize { full, small, race };
inline TestSize test_size() {
  const char* const value = std::getenv("RGS_TEST_SIZE");
  const std::string size = value == nullptr ? "" : value;
  if (size == "race") return TestSize::race;
  if (size == "small") return TestSize::small;
  if (!size.empty()) FAIL("RGS_TEST_SIZE is small, race or unset, not " << size);
  return TestSize::full;
}
inline bool small_sizes() {
  return test_size() != TestSize::full;
}
inline bool race_sizes() {
  return test_size() == TestSize::race;
}
template <class T>
T sized(T full, T small, T race) {
  return race_sizes() ? race : small_sizes() ? small : full;
}

inline void require_cuda(cudaError_t error) {
  REQUIRE_MESSAGE(error == cudaSuccess, "CUDA: ", std::string(cudaGetErrorString(error)));
}
inline std::string text_of(const Error& e) {
  return std::string(errc_name(e.code)) + ": " + e.what;
}
template <class Result>
void require_ok(const Result& result) {
  REQUIRE_MESSAGE(result, text_of(result.error()), ", expected ", result.error().expected, ", found ",
                  result.error().found);
}
/// Waits for the device and reports a kernel's fault.
inline void synchronize() {
  require_cuda(cudaDeviceSynchronize());
}

/// n values in device memory between guard bytes; every byte is 0xFF (NaN) until written.
template <class T>
class DeviceArray {
 public:
  DeviceArray() = default;
  explicit DeviceArray(std::size_t n) : n_(n) {
    require_cuda(cudaMalloc(reinterpret_cast<void**>(&base_), n * sizeof(T) + 2 * kGuard));
    require_cuda(cudaMemset(base_, kGuardByte, n * sizeof(T) + 2 * kGuard));
    fill(0xFF);
  }
  explicit DeviceArray(std::span<const T> values) : DeviceArray(values.size()) {
    require_cuda(cudaMemcpy(data(), values.data(), values.size_bytes(), cudaMemcpyHostToDevice));
  }
  DeviceArray(DeviceArray&& other) noexcept
      : base_(std::exchange(other.base_, nullptr)), n_(std::exchange(other.n_, 0)) {}
  DeviceArray& operator=(DeviceArray&& other) noexcept {
    std::swap(base_, other.base_);
    std::swap(n_, other.n_);
    return *this;
  }
  ~DeviceArray() { cudaFree(base_); }

  T* data() const { return base_ == nullptr ? nullptr : reinterpret_cast<T*>(base_ + kGuard); }
  std::size_t size() const { return n_; }
  void fill(int byte) { require_cuda(cudaMemset(data(), byte, n_ * sizeof(T))); }

  /// Contents, after all work of the device; fails the test if a kernel wrote beyond either end.
  std::vector<T> download() const {
    synchronize();
    std::vector<T> values(n_);
    if (n_ > 0) require_cuda(cudaMemcpy(values.data(), data(), n_ * sizeof(T), cudaMemcpyDeviceToHost));
    check_guards();
    return values;
  }
  void check_guards() const {
    std::vector<unsigned char> before(kGuard), after(kGuard);
    require_cuda(cudaMemcpy(before.data(), base_, kGuard, cudaMemcpyDeviceToHost));
    require_cuda(cudaMemcpy(after.data(), base_ + kGuard + n_ * sizeof(T), kGuard, cudaMemcpyDeviceToHost));
    const auto damaged = [](const std::vector<unsigned char>& guard) {
      return std::find_if(guard.begin(), guard.end(), [](unsigned char b) { return b != kGuardByte; }) - guard.begin();
    };
    CHECK_MESSAGE(damaged(before) == kGuard, "byte ", damaged(before) - static_cast<std::ptrdiff_t>(kGuard),
                  " before an array of ", n_, " x ", sizeof(T), " bytes was written");
    CHECK_MESSAGE(damaged(after) == kGuard, "byte ", damaged(after), " after an array of ", n_, " x ", sizeof(T),
                  " bytes was written");
  }

 private:
  static constexpr std::size_t kGuard = 256;  // keeps cudaMalloc's alignment
  static constexpr unsigned char kGuardByte = 0xA5;
  std::byte* base_ = nullptr;
  std::size_t n_ = 0;
};

/// Attributes in device memory, in the launchers' form.
class DeviceAttributes {
 public:
  explicit DeviceAttributes(const SceneView& s)
      : attributes_(cuda::Fp32Attributes{copy<float>(std::as_bytes(s.mean)), copy<float>(std::as_bytes(s.rotation)),
                                         copy<float>(std::as_bytes(s.scale)), copy<float>(std::as_bytes(s.opacity)),
                                         copy<float>(std::as_bytes(s.sh)), s.sh_degree}) {}
  explicit DeviceAttributes(const FileView& file) : DeviceAttributes(load_direct(file).value()) {}
  explicit DeviceAttributes(const DirectData& file)
      : attributes_(cuda::CompactAttributes{copy<float>(file.means()), copy<std::uint16_t>(file.geometry()),
                                            copy<std::uint32_t>(file.sh()), copy<float>(file.step_table()),
                                            copy<std::uint32_t>(file.chunk_table()), file.header().chunk_size,
                                            std::ldexp(1.0F, -file.header().scale_exponent), file.header().sh_degree}) {
  }

  const cuda::Attributes& get() const { return attributes_; }

 private:
  template <class T>
  const T* copy(std::span<const std::byte> bytes) {
    memory_.emplace_back(bytes);
    return reinterpret_cast<const T*>(memory_.back().data());
  }
  std::vector<DeviceArray<std::byte>> memory_;  // before attributes_, whose constructor fills it
  cuda::Attributes attributes_;
};

/// A scene both as an .rgs file and decoded on the host, equal for each Gaussian.
struct CompactScene {
  std::vector<std::byte> bytes;
  FileView file;
  Scene scene;

  static CompactScene of(const SplatCloud& cloud, const EncodeOptions& options = {}) {
    CompactScene c;
    auto bytes = encode(cloud.view(), options);
    require_ok(bytes);
    c.bytes = *std::move(bytes);
    auto file = FileView::open(c.bytes);
    require_ok(file);
    c.file = *std::move(file);
    auto scene = Scene::load(c.file);
    require_ok(scene);
    c.scene = *std::move(scene);
    return c;
  }
};

/// front_camera() moved and rotated, with its principal point off the centre.
inline Camera random_camera(Random& random, int width, int height) {
  Camera camera = front_camera(width, height);
  camera.fx *= random.uniform(0.7, 1.4);
  camera.fy = camera.fx * random.uniform(0.9, 1.1);
  camera.cx += random.uniform(-0.1, 0.1) * width;
  camera.cy += random.uniform(-0.1, 0.1) * height;
  const double angle = random.uniform(-0.4, 0.4), x = random.uniform(-1, 1), y = random.uniform(-1, 1);
  const double z = random.uniform(-1, 1), length = std::sqrt(x * x + y * y + z * z), s = std::sin(angle / 2) / length;
  camera.world_to_camera =
      from_row_major(rigid({std::cos(angle / 2), s * x, s * y, s * z},
                           {random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.5)}));
  return camera;
}

/// CudaRenderer's kernel parameters for a view.
inline cuda::ViewParameters view_parameters(const Camera& camera, const Arithmetic& options, int sh_degree) {
  Matrix4 m;
  std::ranges::copy(row_major(camera.world_to_camera), m);
  cuda::ViewParameters v{};
  v.view = math::make_view<float>(m, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                                  options.near_plane, options.far_plane);
  v.grid = math::tile_grid(camera.width, camera.height);
  v.low_pass = options.low_pass;
  v.anti_aliasing = options.anti_aliasing;
  v.sh_degree = std::min(sh_degree, options.sh_degree_limit);
  v.key = math::key_layout(options.depth_order, options.depth_bits,
                           static_cast<std::uint32_t>(v.grid.columns * v.grid.rows));
  if (v.key.quantized) {
    v.quantizer = math::make_depth_quantizer(options.depth_mapping, v.key.depth_bits, options.depth_range[0],
                                             options.depth_range[1]);
  }
  return v;
}

}  // namespace rgs::test
