// device_memory_test.cpp - uploads of every kind, the caller's allocator, and growth that blocks nobody else.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <atomic>
#include <map>

#include "device_fixture.hpp"
#include "rgs/cuda_renderer.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

/// An allocator that counts its allocations and limits them to `limit`.
struct Ledger {
  std::map<void*, std::uint64_t> held;
  std::uint64_t total = 0, limit = ~std::uint64_t{0};
  int n_wrong = 0;
  CudaStream last_stream = nullptr;

  DeviceAllocator allocator() {
    return {[](void* user, std::uint64_t bytes, CudaStream stream) -> void* {
              auto& ledger = *static_cast<Ledger*>(user);
              ledger.last_stream = stream;
              void* memory = nullptr;
              if (bytes == 0 || bytes > ledger.limit - ledger.total || cudaMalloc(&memory, bytes) != cudaSuccess) {
                ledger.n_wrong += bytes == 0;
                return nullptr;
              }
              ledger.held[memory] = bytes;
              ledger.total += bytes;
              return memory;
            },
            [](void* user, void* memory, std::uint64_t bytes) {
              auto& ledger = *static_cast<Ledger*>(user);
              const auto found = ledger.held.find(memory);
              if (found == ledger.held.end() || found->second != bytes) {
                ++ledger.n_wrong;
                return;
              }
              ledger.total -= bytes;
              ledger.held.erase(found);
              cudaFree(memory);
            },
            this};
  }
};

/// A stream that no other waits for.
class TestStream {
 public:
  TestStream() { require_cuda(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking)); }
  TestStream(const TestStream&) = delete;
  TestStream& operator=(const TestStream&) = delete;
  ~TestStream() { cudaStreamDestroy(stream_); }
  cudaStream_t get() const { return stream_; }

 private:
  cudaStream_t stream_ = nullptr;
};

CudaRenderer renderer(const CudaRendererOptions& options = {}) {
  auto made = CudaRenderer::create(options);
  require_ok(made);
  return *std::move(made);
}
template <class Source>
DeviceScene upload(const Source& source, const UploadOptions& options = {}) {
  auto scene = DeviceScene::upload(source, options);
  require_ok(scene);
  return *std::move(scene);
}
std::vector<float> picture(CudaRenderer& device, const DeviceScene& scene, const Camera& camera,
                           const RenderOptions& options, CudaStream stream = nullptr) {
  const DeviceArray<float> rgb(3 * static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height));
  synchronize();
  require_ok(device.render(scene, camera, {.rgb = rgb.data()}, options, stream));
  return rgb.download();
}
std::vector<RenderOptions> pipelines() {
  return {baseline_options(), paper_options(), turbo_options()};
}
/// Walls that fill front_camera()'s image, one behind the other.
Scene walls(int n) {
  std::vector<Splat> splats;
  for (int i = 0; i < n; ++i) {
    splats.push_back(splat_at(0, 0, 2 + 0.001 * i, 50, 0.02, static_cast<float>(i % 7) / 7));
  }
  return scene_of(cloud_of(splats));
}

}  // namespace

TEST_CASE("uploads of arrays with inconsistent sizes are refused without a device") {
  const Scene scene = scene_of(cloud_of(random_splats(711, 5), 1));
  const auto code = [](const SceneView& view, const UploadOptions& options = {}) {
    const auto uploaded = DeviceScene::upload(view, options);
    return uploaded ? Errc::internal : uploaded.error().code;
  };
  for (auto SceneView::*array :
       {&SceneView::mean, &SceneView::rotation, &SceneView::scale, &SceneView::opacity, &SceneView::sh}) {
    SceneView view = scene.view().value();
    view.*array = (view.*array).first((view.*array).size() - 1);
    CHECK(code(view) == Errc::bad_argument);
    view.*array = {};
    CHECK(code(view) == Errc::bad_argument);
  }
  SceneView view = scene.view().value();
  view.n = 6;
  CHECK(code(view) == Errc::bad_argument);
  for (const int degree : {-1, 0, 2, 4}) {
    view = scene.view().value();
    view.sh_degree = degree;
    CHECK(code(view) == Errc::bad_argument);
  }
  view = scene.view().value();
  view.n = std::uint64_t{1} << 31;
  CHECK(code(view) == Errc::limit_exceeded);

  Ledger ledger;
  DeviceAllocator half = ledger.allocator();
  half.free = nullptr;
  CHECK(code(scene.view().value(), {.allocator = half}) == Errc::bad_argument);
  half = {.allocate = nullptr, .free = ledger.allocator().free};
  CHECK(code(scene.view().value(), {.allocator = half}) == Errc::bad_argument);
  CHECK(ledger.held.empty());
}

TEST_CASE("half an allocator is refused") {
  if (!device_answers()) return;
  Ledger ledger;
  DeviceAllocator half = ledger.allocator();
  half.free = nullptr;
  const auto made = CudaRenderer::create({.allocator = half});
  REQUIRE_FALSE(made);
  CHECK(made.error().code == Errc::bad_argument);
}

TEST_CASE("a scene uploaded on a stream, waited for or not, is complete; also one that is destroyed at once") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Camera camera = front_camera(120, 70);
  const auto compact = CompactScene::of(cloud_of(random_splats(712, small_sizes() ? 300 : 60000), 3));
  const auto data = load_direct(compact.file);
  require_ok(data);
  CudaRenderer device = renderer();
  for (const RenderOptions& options : pipelines()) {
    const auto fp32 = picture(device, upload(compact.scene.view().value()), camera, options);
    const auto file = picture(device, upload(compact.file), camera, options);
    for (const bool asynchronous : {false, true}) {
      CAPTURE(asynchronous);
      const TestStream copies, frames;
      const UploadOptions how{.stream = copies.get(), .asynchronous = asynchronous};
      // The copies start after much other work, and only the frame itself waits for them.
      const DeviceArray<std::byte> other(std::size_t{small_sizes() ? 1U : 256U} << 20);
      const auto late = [&](const auto& source) {
        const DeviceArray<float> rgb(fp32.size());
        synchronize();
        for (int k = 0; k < (small_sizes() ? 2 : 200); ++k)
          require_cuda(cudaMemsetAsync(other.data(), k, other.size(), copies.get()));
        const DeviceScene scene = upload(source, how);
        require_ok(device.render(scene, camera, {.rgb = rgb.data()}, options, frames.get()));
        return rgb.download();
      };
      CHECK(late(compact.scene.view().value()) == fp32);
      CHECK(late(*data) == file);
      CHECK(late(compact.file) == file);
      for (int k = 0; k < 5; ++k) upload(*data, how);
      synchronize();
    }
  }
}

TEST_CASE("some chunks of a file on the device hold their Gaussians") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Camera camera = front_camera(120, 70);
  EncodeOptions encoding;
  encoding.chunk_size = 32;
  const auto compact = CompactScene::of(cloud_of(random_splats(713, 1000), 3), encoding);  // the last chunk is short
  const std::uint64_t n_chunks = compact.file.header().n_chunks;
  REQUIRE(n_chunks == 32);
  const SceneView all = compact.scene.view().value();
  CudaRenderer device = renderer();
  for (const auto& [first, n] : {std::pair<std::uint64_t, std::uint64_t>{0, 32}, {0, 5}, {7, 12}, {20, 12}, {31, 1}}) {
    CAPTURE(first);
    const auto data = read_chunks(compact.file, first, n);
    require_ok(data);
    const DeviceScene part = upload(*data);
    CHECK(part.size() == data->size());
    CHECK(part.compact());
    CHECK(part.declarations().has_value());
    const auto cut = [&](std::span<const float> values, std::uint64_t floats) {
      return values.subspan(data->first() * floats, data->size() * floats);
    };
    const DeviceScene same = upload(SceneView{data->size(), 3, cut(all.mean, 3), cut(all.rotation, 4),
                                              cut(all.scale, 3), cut(all.opacity, 1), cut(all.sh, 48)});
    for (const RenderOptions& options : pipelines()) {
      const double quality = psnr(picture(device, part, camera, options), picture(device, same, camera, options));
      CHECK_MESSAGE(quality >= 70, quality, " dB");
    }
  }
}

TEST_CASE("a caller's allocator provides all memory and gets it all back, and its refusal is out of memory") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Camera camera = small_sizes() ? front_camera(64, 48) : front_camera(640, 360);
  const Scene tiny = walls(3), more = walls(small_sizes() ? 300 : 6000);
  for (const RenderOptions& options : pipelines()) {
    CudaRenderer plain = renderer();
    const auto expected_small = picture(plain, upload(tiny.view().value()), camera, options);
    const auto expected_large = picture(plain, upload(more.view().value()), camera, options);
    Ledger ledger, scenes;
    {
      const TestStream stream;
      const DeviceScene small = upload(tiny.view().value(), {.allocator = scenes.allocator()});
      const DeviceScene large = upload(more.view().value(), {.stream = stream.get(), .allocator = scenes.allocator()});
      CHECK(scenes.total == small.bytes() + large.bytes());
      CHECK(scenes.last_stream == stream.get());
      CudaRenderer device = renderer({.allocator = ledger.allocator()});
      CHECK(picture(device, small, camera, options, stream.get()) == expected_small);
      CHECK(ledger.last_stream == stream.get());
      CHECK(ledger.total == device.bytes());

      ledger.limit = ledger.total;
      const auto refused = device.render(large, camera, {}, options);
      REQUIRE_FALSE(refused);
      CHECK(refused.error().code == Errc::device_out_of_memory);
      CHECK(refused.error().expected > 0);
      CHECK(ledger.total == device.bytes());
      CHECK(picture(device, small, camera, options) == expected_small);

      ledger.limit = ~std::uint64_t{0};
      CHECK(picture(device, large, camera, options) == expected_large);
      CHECK(picture(device, small, camera, options) == expected_small);
      CHECK(ledger.total == device.bytes());
    }
    CHECK(ledger.held.empty());
    CHECK(scenes.held.empty());
    CHECK(ledger.n_wrong == 0);
    CHECK(scenes.n_wrong == 0);
  }
}

TEST_CASE("overlapping frames go on in one workspace where there is no memory for two") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Camera camera = small_sizes() ? front_camera(64, 48) : front_camera(640, 360);
  const DeviceScene small = upload(walls(3).view().value());
  const DeviceScene large = upload(walls(small_sizes() ? 300 : 6000).view().value());
  RenderOptions queued = turbo_options();
  queued.turbo.asynchronous = true;
  CudaRenderer plain = renderer();
  const auto expected_small = picture(plain, small, camera, turbo_options());
  const std::uint64_t bytes = plain.bytes();
  const auto expected_large = picture(plain, large, camera, turbo_options());
  const std::uint64_t enough = std::max(2 * bytes, plain.bytes());  // for one that draws both
  const TestStream stream;
  struct Queue {
    std::uint64_t limit;
    std::vector<bool> is_large;
  };
  // No room for a second one; for two until the first or the second, or both, have to grow.
  for (const Queue& queue :
       {Queue{bytes, {false, false, false, false}}, Queue{enough, {false, false, true, false, false}},
        Queue{enough, {false, false, false, true, false}}, Queue{enough, {false, true, true, false, false}}}) {
    CAPTURE(queue.limit);
    Ledger ledger;
    ledger.limit = queue.limit;
    {
      CudaRenderer device = renderer({.allocator = ledger.allocator()});
      std::vector<DeviceArray<float>> targets;
      targets.reserve(queue.is_large.size());
      for (std::size_t k = 0; k < queue.is_large.size(); ++k) targets.emplace_back(expected_small.size());
      synchronize();
      for (std::size_t k = 0; k < targets.size(); ++k) {
        require_ok(
            device.render(queue.is_large[k] ? large : small, camera, {.rgb = targets[k].data()}, queued, stream.get()));
      }
      require_ok(device.finish());
      for (std::size_t k = 0; k < targets.size(); ++k)
        CHECK(targets[k].download() == (queue.is_large[k] ? expected_large : expected_small));
      CHECK(ledger.total == device.bytes());
      ledger.limit = enough;
      CHECK(picture(device, large, camera, turbo_options(), stream.get()) == expected_large);
    }
    CHECK(ledger.held.empty());
    CHECK(ledger.n_wrong == 0);
  }
}

TEST_CASE("the first frame releases an asynchronous upload's temporary memory") {
  if (!device_answers()) return;
  const Camera camera = front_camera(64, 48);
  const Scene scene = walls(3000);
  Ledger waited, queued;
  const DeviceScene expected = upload(scene.view().value(), {.allocator = waited.allocator()});
  CHECK(waited.total == expected.bytes());
  {
    const TestStream stream;
    CudaRenderer device = renderer();
    const DeviceScene late =
        upload(scene.view().value(), {.stream = stream.get(), .asynchronous = true, .allocator = queued.allocator()});
    CHECK(queued.total == late.bytes());
    synchronize();
    const auto rgb = picture(device, late, camera, turbo_options());
    CHECK(queued.total == late.bytes());
    CHECK(late.bytes() == expected.bytes());
    CHECK(rgb == picture(device, expected, camera, turbo_options()));
  }
  CHECK(queued.held.empty());
  CHECK(queued.n_wrong == 0);
}

TEST_CASE("a workspace grows while another stream is busy, without waiting for it") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set: compute-sanitizer may wait for all streams");
  int device_index = 0, has_pools = 0;
  require_cuda(cudaGetDevice(&device_index));
  require_cuda(cudaDeviceGetAttribute(&has_pools, cudaDevAttrMemoryPoolsSupported, device_index));
  if (has_pools == 0) return skip("the device has no memory pools: cudaFree() waits for all streams");
  const Camera camera = front_camera(640, 360);
  const DeviceScene small = upload(walls(3).view().value()), large = upload(walls(6000).view().value());
  for (const RenderOptions& options : pipelines()) {
    CudaRenderer plain = renderer();
    picture(plain, small, camera, options);
    const auto expected = picture(plain, large, camera, options);  // its kernels are loaded now

    // A callback that blocks its stream until the frame is drawn; a frame that waits for it never is.
    struct Gate {
      std::atomic<bool> is_open{false};
    } gate;
    const TestStream busy, frames;
    const DeviceArray<float> rgb(expected.size());
    CudaRenderer device = renderer();
    require_ok(device.render(small, camera, {.rgb = rgb.data()}, options, frames.get()));
    const std::uint64_t before = device.bytes();
    synchronize();
    require_cuda(cudaLaunchHostFunc(
        busy.get(), [](void* user) { static_cast<Gate*>(user)->is_open.wait(false); }, &gate));
    const auto stats = device.render(large, camera, {.rgb = rgb.data()}, options, frames.get());
    const bool is_done = cudaStreamSynchronize(frames.get()) == cudaSuccess;
    gate.is_open = true;
    gate.is_open.notify_one();
    require_ok(stats);
    CHECK(is_done);
    CHECK(device.bytes() > before);
    CHECK(rgb.download() == expected);
  }
}
