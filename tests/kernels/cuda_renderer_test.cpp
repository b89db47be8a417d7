// cuda_renderer_test.cpp - whole frames on the device: against the CPU, repeated, concurrent, and at every limit.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/cuda_renderer.hpp"

#include <doctest/doctest.h>

#include <atomic>
#include <cmath>
#include <cstring>
#include <fstream>
#include <glm/common.hpp>
#include <glm/ext/matrix_transform.hpp>
#include <memory>
#include <thread>

#include "device_fixture.hpp"
#include "edit_file.hpp"
#include "golden_scenes.hpp"
#include "rgs/camera_file.hpp"
#include "scene_generator.hpp"
#include "temporary_folder.hpp"
#include "turbo/turbo_geometry.hpp"

using namespace rgs;
using namespace rgs::test;
using math::DepthOrder;
using math::Extent;
using FrontEnd = PaperSteps::FrontEnd;

namespace {

/// A CudaRenderer with a target of one size.
class Device {
 public:
  explicit Device(const Camera& camera) : camera_(camera), renderer_(make()) { resize(camera); }

  void resize(const Camera& camera) {
    camera_ = camera;
    const auto n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
    rgb_ = DeviceArray<float>(3 * n), alpha_ = DeviceArray<float>(n);
  }
  Result<FrameStats> render(const DeviceScene& scene, const RenderOptions& options, CudaStream stream = nullptr) {
    rgb_.fill(0xFF), alpha_.fill(0xFF);
    synchronize();
    return renderer_.render(scene, camera_, target(), options, stream);
  }
  std::vector<float> rgb() const { return rgb_.download(); }
  std::vector<float> alpha() const { return alpha_.download(); }
  CudaRenderer& renderer() { return renderer_; }
  DeviceTarget target() const { return {.rgb = rgb_.data(), .alpha = alpha_.data()}; }

 private:
  static CudaRenderer make() {
    auto renderer = CudaRenderer::create();
    require_ok(renderer);
    return *std::move(renderer);
  }
  Camera camera_;
  CudaRenderer renderer_;
  DeviceArray<float> rgb_, alpha_;
};

DeviceScene upload(const Scene& scene) {
  auto uploaded = DeviceScene::upload(scene.view().value());
  require_ok(uploaded);
  return *std::move(uploaded);
}
DeviceScene upload(const FileView& file) {
  auto uploaded = DeviceScene::upload(file);
  require_ok(uploaded);
  return *std::move(uploaded);
}

/// Compares bytes, NaN included; reports the first difference.
void check_same(const std::vector<float>& a, const std::vector<float>& b) {
  REQUIRE(a.size() == b.size());
  if (std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0) return;
  std::size_t n = 0, first = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    if (std::memcmp(&a[i], &b[i], sizeof(float)) != 0 && n++ == 0) first = i;
  }
  FAIL_CHECK(n, " of ", a.size(), " values differ, the first at ", first, ": ", a[first], " and ", b[first],
             ", largest difference ", largest_difference(a, b));
}

void check_error(const Result<FrameStats>& result, Errc code) {
  REQUIRE_MESSAGE(!result, "a frame was drawn with ", result ? result->instances : 0, " pairs");
  CHECK_MESSAGE(result.error().code == code, text_of(result.error()), ", found ", result.error().found);
}

/// The pipelines and three more, each deterministic.
std::vector<RenderOptions> modes() {
  RenderOptions zero_mean = paper_options();
  zero_mean.paper.exp = math::Exp::zero_mean;
  zero_mean.paper.depth_mapping = DepthMapping::logarithmic;
  RenderOptions turbo_fp32 = turbo_options();
  turbo_fp32.turbo.tensor_cores = false;
  return {baseline_options(), paper_options(), zero_mean, Arithmetic(), turbo_options(), turbo_fp32};
}
const std::string kModes[] = {"baseline", "paper", "zero-mean logarithmic", "exact, fused", "turbo", "turbo in FP32"};
constexpr std::size_t kTurbo = 4, kTurboFp32 = 5, kModeCount = 6;

bool is_turbo(const RenderOptions& o) {
  return o.pipeline == Pipeline::turbo;
}
/// Lowest PSNR against the CPU in the same arithmetic, and largest difference. Turbo continues slightly beyond the
/// definition's stop (the Gaussian that would take the transmittance below 1e-4), or stops at 2^-11, and stores
/// colours, usually opacities too, in FP16.
double lowest_psnr(const RenderOptions& o) {
  return is_turbo(o) ? 60 : steps_of(o, Backend::cuda).exp == math::Exp::exact ? 70 : 65;
}
double largest_error(const RenderOptions& o) {
  return is_turbo(o) ? 4.0 / 255 : steps_of(o, Backend::cuda).exp == math::Exp::exact ? 2.0 / 255 : 1;
}

std::uint64_t n_tiles(const RenderOptions& o, int width, int height) {
  const auto grid = is_turbo(o) ? math::tile_grid<cuda::kTurboTile>(width, height) : math::tile_grid(width, height);
  return static_cast<std::uint64_t>(grid.columns) * static_cast<std::uint64_t>(grid.rows);
}

/// Walls that fill front_camera()'s image, one behind the other.
Scene walls(int n) {
  std::vector<Splat> splats;
  for (int i = 0; i < n; ++i) {
    splats.push_back(splat_at(0, 0, 2 + 0.001 * i, 50, 0.02, static_cast<float>(i % 7) / 7));
  }
  return scene_of(cloud_of(splats));
}

Frame cpu_frame(const Scene& scene, const Camera& camera, const RenderOptions& options) {
  return render(scene, camera, options, {.backend = Backend::cpu, .simd = false});
}

}  // namespace

TEST_CASE("backends: automatic is CUDA if a device answers and the CPU if not") {
  int n = 0;
  const bool answers = cudaGetDeviceCount(&n) == cudaSuccess && n > 0;
  cudaGetLastError();
  const auto automatic = Renderer::create();
  require_ok(automatic);
  CHECK(automatic->backend() == (answers ? Backend::cuda : Backend::cpu));
  const auto cuda = Renderer::create({.backend = Backend::cuda});
  REQUIRE(cuda.has_value() == answers);
  const auto direct = CudaRenderer::create();
  REQUIRE(direct.has_value() == answers);
  const auto cpu = Renderer::create({.backend = Backend::cpu});
  require_ok(cpu);
  CHECK(cpu->backend() == Backend::cpu);
  if (answers) {
    CHECK(cuda->backend() == Backend::cuda);
    CHECK(std::string(cuda->backend_name()).starts_with("cuda "));
    MESSAGE(std::string(cuda->backend_name()));
  } else {
    CHECK(cuda.error().code == Errc::unavailable);
    CHECK(direct.error().code == Errc::unavailable);
    const Scene scene = walls(1);
    const auto frame = render(scene, front_camera(20, 20), {}, {});
    CHECK(frame.alpha[0] > 0);
  }
}

TEST_CASE("damaged files are refused, with or without a device") {
  const auto sound = CompactScene::of(golden_cloud(300, 2, 5));
  const auto code = [](std::vector<std::byte> bytes) {
    const auto file = FileView::open(bytes);
    if (!file) return file.error().code;
    const auto scene = DeviceScene::upload(*file);
    return scene ? Errc::internal : scene.error().code;
  };
  auto bytes = sound.bytes;
  bytes[section_of(bytes, "SHI8") + 100] ^= std::byte{1};
  CHECK(code(bytes) == Errc::checksum_mismatch);
  bytes = sound.bytes;
  put(bytes, section_of(bytes, "MEAN") + 24, std::uint32_t{0x7FC00000});
  fix_hashes(bytes);
  CHECK(code(bytes) == Errc::bad_value);
  bytes = sound.bytes;
  put(bytes, section_of(bytes, "CHNK") + 48 + 32, std::uint64_t{1} << 40);  // a step set far outside the table
  fix_hashes(bytes);
  CHECK(code(bytes) == Errc::bad_value);
}

TEST_CASE("frames follow the CPU renderer in every mode, FP32 and compact") {
  if (!device_answers()) return;
  const int n = small_sizes() ? 400 : 40000;
  const auto [width, height] = small_sizes() ? std::pair(90, 50) : std::pair(1280, 720);
  const auto cloud = cloud_of(random_splats(601, n), 3);
  const Scene fp32 = scene_of(cloud);
  const auto compact = CompactScene::of(cloud);
  Random random(602);
  const Camera camera = random_camera(random, width, height);
  Device device(camera);
  for (std::size_t m = 0; m < kModeCount; ++m) {
    RenderOptions options = modes()[m];
    options.background = {0.1F, 0.2F, 0.3F};
    for (const bool is_compact : {false, true}) {
      const Scene& scene = is_compact ? compact.scene : fp32;
      const Frame host = cpu_frame(scene, camera, options);
      const DeviceScene uploaded = is_compact ? upload(compact.file) : upload(fp32);
      CHECK(uploaded.compact() == is_compact);
      options.measure.count_pairs = is_compact;
      const auto stats = device.render(uploaded, options);
      require_ok(stats);
      const auto rgb = device.rgb();
      const double quality = psnr(rgb, host.rgb), error = largest_difference(rgb, host.rgb);
      MESSAGE(kModes[m], (is_compact ? std::string(", compact: ") : std::string(", FP32: ")), quality, " dB, at most ",
              255 * error, "/255 off the CPU, ", stats->instances, " pairs");
      CAPTURE(kModes[m]);
      CAPTURE(is_compact);
      CHECK(quality >= lowest_psnr(options));
      CHECK(error <= largest_error(options));
      CHECK(stats->gaussians == fp32.size());
      const auto close = [](std::uint64_t a, std::uint64_t b, double part) {
        return std::abs(static_cast<double>(a) - static_cast<double>(b)) <= part * static_cast<double>(b);
      };
      if (is_turbo(options)) {  // lists other tiles and skips parts of them
        CHECK_MESSAGE(close(stats->visible, host.stats.visible, 0.02), stats->visible, " and ", host.stats.visible);
        CHECK(stats->instances < host.stats.instances);
        // Cells of more than 16x8 pixels have less to skip.
        CHECK((!is_compact ||
               (stats->evaluated > 0 && (cuda::kTurboCellHeight > 8 || stats->evaluated < host.stats.evaluated))));
        continue;
      }
      CHECK_MESSAGE(close(stats->visible, host.stats.visible, 1e-4), stats->visible, " and ", host.stats.visible);
      CHECK_MESSAGE(close(stats->instances, host.stats.instances, 1e-4), stats->instances, " and ",
                    host.stats.instances);
      CHECK(stats->depth_bits == host.stats.depth_bits);
      if (!is_compact) CHECK(stats->depth_resolution == host.stats.depth_resolution);  // a file declares its box, too
      if (!is_compact) continue;
      CHECK_MESSAGE(close(stats->evaluated, host.stats.evaluated, 1e-3), stats->evaluated, " and ",
                    host.stats.evaluated);
      CHECK_MESSAGE(close(stats->blended, host.stats.blended, 1e-3), stats->blended, " and ", host.stats.blended);
    }
  }
}

TEST_CASE("lenses, fisheyes, panoramas and parallel rays follow the CPU renderer in every mode, FP32 and compact") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const auto [width, height] = small_sizes() ? std::pair(90, 50) : std::pair(640, 360);
  const auto cloud = cloud_of(random_splats(607, small_sizes() ? 400 : 20000), 3);
  const Scene fp32 = scene_of(cloud);
  const auto compact = CompactScene::of(cloud);
  const DeviceScene uploaded[] = {upload(fp32), upload(compact.file)};
  Random random(608);
  for (const auto model :
       {CameraModel::opencv, CameraModel::opencv_fisheye, CameraModel::equirectangular, CameraModel::orthographic}) {
    Camera camera = random_camera(random, width, height);
    camera.model = model;
    if (model == CameraModel::opencv) camera.distortion = {-0.2, 0.05, 0.003, -0.002, 0.01, 0.02, -0.01, 0.003};
    if (model == CameraModel::opencv_fisheye) {  // 190 degrees wide
      camera.fx = camera.fy = width / 3.3;
      camera.distortion = {0.03, -0.012, 0.004, -0.0006, 0, 0, 0, 0};
    }
    if (model == CameraModel::equirectangular) {  // the seam and a pole are among the Gaussians
      const auto back = glm::rotate(glm::dmat4(1), std::numbers::pi - 0.3, {0, 1, 0});
      camera.world_to_camera = glm::rotate(back, 0.9, {1, 0, 0});
      camera = panorama_of(camera);
    }
    if (model == CameraModel::orthographic) camera.fx = camera.fy = width / 12.0;
    Device device(camera);
    for (std::size_t m = 0; m < kModeCount; ++m) {
      const RenderOptions options = modes()[m];
      for (const bool is_compact : {false, true}) {
        const Frame host = cpu_frame(is_compact ? compact.scene : fp32, camera, options);
        require_ok(device.render(uploaded[is_compact ? 1 : 0], options));
        const double quality = psnr(device.rgb(), host.rgb), error = largest_difference(device.rgb(), host.rgb);
        MESSAGE(std::string(camera_model_name(model)), ", ", kModes[m], ": ", quality, " dB, at most ", 255 * error,
                "/255");
        CAPTURE(kModes[m]);
        CAPTURE(is_compact);
        CHECK(host.stats.visible > fp32.size() / 10);
        CHECK(quality >= lowest_psnr(options));
        CHECK(error <= largest_error(options));
      }
    }
  }
}

TEST_CASE("a scene far from the world's origin gives the same frame as near it, FP32 and compact") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const int n = small_sizes() ? 400 : 40000;
  const auto [width, height] = small_sizes() ? std::pair(90, 50) : std::pair(1280, 720);
  const glm::dvec3 place(4.2e6 + 0.3, 1.7e5, 4.8e6);
  Declarations declared;
  declared.origin = {place.x, place.y, place.z};
  const auto cloud = cloud_of(random_splats(605, n), 3);
  EncodeOptions options;
  const auto home_bytes = encode(cloud.view(), options).value();
  options.origin = declared.origin;
  const auto away_bytes = encode(cloud.view(), options).value();
  const auto away_scene = Scene::load(cloud, declared);
  require_ok(away_scene);
  // Absolute FP32 positions, multiples of 1/2, and the same near the origin.
  SplatCloud absolute = cloud, rounded = cloud;
  for (std::size_t i = 0; i < cloud.mean.size(); ++i) {
    const double centre = std::floor(declared.origin[i % 3]);
    absolute.mean[i] = static_cast<float>(centre + static_cast<double>(cloud.mean[i]));
    rounded.mean[i] = static_cast<float>(static_cast<double>(absolute.mean[i]) - centre);
  }
  struct Pair {
    const char* name;
    DeviceScene home, away;
    glm::dvec3 moved;
  };
  const Pair pairs[] = {
      {"FP32", upload(scene_of(cloud)), upload(*away_scene), place},
      {"compact", upload(FileView::open(home_bytes).value()), upload(FileView::open(away_bytes).value()), place},
      {"absolute FP32", upload(scene_of(rounded)), upload(scene_of(absolute)), glm::floor(place)}};
  CHECK(pairs[0].away.origin() == declared.origin);
  CHECK(pairs[1].away.origin() == declared.origin);
  Random random(606);
  const Camera home = random_camera(random, width, height);
  for (std::size_t m = 0; m < kModeCount; ++m) {
    for (const Pair& pair : pairs) {
      Camera away = home;
      away.world_to_camera = glm::translate(home.world_to_camera, -pair.moved);
      Device at_home(home), far_away(away);
      require_ok(at_home.render(pair.home, modes()[m]));
      require_ok(far_away.render(pair.away, modes()[m]));
      const double quality = psnr(at_home.rgb(), far_away.rgb());
      MESSAGE(kModes[m], ", ", pair.name, ": ", quality, " dB between near and far");
      CAPTURE(kModes[m]);
      CAPTURE(pair.name);
      CHECK(quality >= 80);
    }
  }
}

TEST_CASE("a scene with the statistics of trained ones follows the CPU renderer") {
  if (!device_answers()) return;
  const auto n = sized<std::uint64_t>(300000, 2000, 1000);
  std::vector<Splat> splats(n);
  SceneGenerator(3, n, 3).generate(0, splats);
  const auto cameras = parse_camera_json(scene_cameras_json(sized(1920, 96, 64), sized(1080, 54, 36)));
  require_ok(cameras);
  const auto compact = CompactScene::of(cloud_of(splats, 3));
  const DeviceScene uploaded = upload(compact.file);
  Device device(cameras->cameras[0]);
  for (std::size_t view = 0; view < sized<std::size_t>(8, 8, 1); view += 3) {
    const Camera& camera = cameras->cameras[view];
    device.resize(camera);
    for (const std::size_t m : {std::size_t{0}, std::size_t{1}, kTurbo}) {
      const RenderOptions options = modes()[m];
      const Frame host = cpu_frame(compact.scene, camera, options);
      require_ok(device.render(uploaded, options));
      const auto rgb = device.rgb();
      const double quality = psnr(rgb, host.rgb), error = largest_difference(rgb, host.rgb);
      MESSAGE("view ", view, ", ", kModes[m], ": ", quality, " dB, at most ", 255 * error, "/255 off the CPU");
      CAPTURE(view);
      CAPTURE(kModes[m]);
      CHECK(quality >= lowest_psnr(options));
      CHECK(error <= largest_error(options));
    }
  }
}

TEST_CASE("every mode gives the same bytes on every run, whatever came before") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const auto [width, height] = small_sizes() ? std::pair(64, 48) : std::pair(1280, 720);
  const auto compact = CompactScene::of(cloud_of(random_splats(603, small_sizes() ? 500 : 50000), 2));
  const DeviceScene scene = upload(compact.file);
  const Camera camera = front_camera(width, height);
  Device device(camera);
  for (std::size_t m = 0; m < kModeCount; ++m) {
    CAPTURE(kModes[m]);
    require_ok(device.render(scene, modes()[m]));
    const auto rgb = device.rgb(), alpha = device.alpha();
    for (int run = 0; run < 5; ++run) {
      CAPTURE(run);
      if (run == 3)
        device.resize(front_camera(40, 40)), require_ok(device.render(scene, modes()[(m + 1) % kModeCount]));
      device.resize(camera);
      require_ok(device.render(scene, modes()[m]));
      check_same(device.rgb(), rgb);
      check_same(device.alpha(), alpha);
    }
    Device fresh(camera);
    require_ok(fresh.render(scene, modes()[m]));
    check_same(fresh.rgb(), rgb);
  }
}

TEST_CASE("the order of blocks affects only Gaussians of one depth") {
  if (!device_answers()) return;
  auto splats = random_splats(604, small_sizes() ? 500 : 30000);
  for (std::size_t i = 0; i < splats.size(); ++i) {
    splats[i * 7919 % splats.size()].mean[2] = 0.3F + 0.0004F * static_cast<float>(i);  // all different
  }
  const DeviceScene uploaded = upload(scene_of(cloud_of(splats, 1)));
  Device device(race_sizes() ? front_camera(64, 40) : front_camera(320, 200));
  RenderOptions options = Arithmetic();
  require_ok(device.render(uploaded, options));
  const auto fused = device.rgb();
  options.paper.deterministic = false;
  require_ok(device.render(uploaded, options));
  check_same(device.rgb(), fused);
  options.paper.front_end = FrontEnd::separate;
  require_ok(device.render(uploaded, options));
  check_same(device.rgb(), fused);
}

TEST_CASE("renderers on concurrent streams each give the bytes that they give alone") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  constexpr std::size_t kAtOnce = 3, kModeOf[kAtOnce] = {0, 1, kTurbo};
  const Camera camera = small_sizes() ? front_camera(64, 48) : front_camera(960, 540);
  const auto compact = CompactScene::of(cloud_of(random_splats(605, small_sizes() ? 300 : 40000), 3));
  const DeviceScene scene = upload(compact.file);  // shared
  std::vector<std::vector<float>> alone;
  for (const std::size_t m : kModeOf) {
    Device device(camera);
    require_ok(device.render(scene, modes()[m]));
    alone.push_back(device.rgb());
  }
  struct Lane {
    explicit Lane(const Camera& c) : device(c), rgb(3 * static_cast<std::size_t>(c.width * c.height)) {
      require_cuda(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
    }
    Device device;
    DeviceArray<float> rgb;
    cudaStream_t stream = nullptr;
  };
  std::vector<std::unique_ptr<Lane>> lanes;
  for (std::size_t t = 0; t < kAtOnce; ++t) lanes.push_back(std::make_unique<Lane>(camera));
  std::atomic<int> n_failed{0}, n_different{0};
  std::vector<std::thread> threads;
  for (std::size_t t = 0; t < kAtOnce; ++t) {
    threads.emplace_back([&, t] {
      Lane& lane = *lanes[t];
      std::vector<float> frame(lane.rgb.size());
      const std::size_t bytes = frame.size() * sizeof(float);
      for (int run = 0; run < (small_sizes() ? 3 : 50); ++run) {
        bool ok = cudaMemsetAsync(lane.rgb.data(), 0xFF, bytes, lane.stream) == cudaSuccess;
        ok = ok &&
             lane.device.renderer().render(scene, camera, {.rgb = lane.rgb.data()}, modes()[kModeOf[t]], lane.stream);
        ok = ok &&
             cudaMemcpyAsync(frame.data(), lane.rgb.data(), bytes, cudaMemcpyDeviceToHost, lane.stream) == cudaSuccess;
        ok = ok && cudaStreamSynchronize(lane.stream) == cudaSuccess;
        n_failed += !ok;
        n_different += ok && std::memcmp(frame.data(), alone[t].data(), bytes) != 0;
      }
    });
  }
  for (auto& thread : threads) thread.join();
  CHECK(n_failed == 0);
  CHECK(n_different == 0);
  for (const auto& lane : lanes) require_cuda(cudaStreamDestroy(lane->stream));
}

TEST_CASE("a scene may be destroyed while its frame is drawn") {
  if (!device_answers()) return;
  const Camera camera = front_camera(90, 60);
  const int n = sized(400000, 5000, 500);  // long lists: sorting them reads the scene after render() has returned
  const auto kept = CompactScene::of(cloud_of(random_splats(618, n), 0)),
             other = CompactScene::of(cloud_of(random_splats(619, n), 0));
  for (const RenderOptions& options : modes()) {
    CAPTURE(options.pipeline);
    Device device(camera);
    const DeviceScene scene = upload(kept.file);
    require_ok(device.render(scene, options));
    const auto expected = device.rgb();
    require_ok(device.render(upload(kept.file), options));
    const DeviceScene in_its_place = upload(other.file);
    check_same(expected, device.rgb());
  }
}

TEST_CASE("Renderer on CUDA equals CudaRenderer, in host memory, for one scene after the other") {
  if (!device_answers()) return;
  const Scene scenes[] = {scene_of(cloud_of(random_splats(606, sized(2000, 2000, 300)), 1)), Scene(),
                          scene_of(cloud_of(random_splats(607, 300), 3))};
  auto renderer = Renderer::create({.backend = Backend::cuda});
  require_ok(renderer);
  for (const Scene& scene : scenes) {
    // Depth and counts, which the frame has and the device's target lacks, are blended in FP32.
    for (const std::size_t m : {std::size_t{0}, kTurboFp32}) {
      const Camera camera = front_camera(m == 0 ? 120 : 31, 47);
      Frame frame = Frame::of(camera);
      const auto stats = renderer->render(scene, camera, frame.target(), modes()[m]);
      require_ok(stats);
      Device device(camera);
      const auto direct = device.render(upload(scene), modes()[m]);
      require_ok(direct);
      check_same(frame.rgb, device.rgb());
      check_same(frame.alpha, device.alpha());
      CHECK(stats->instances == direct->instances);
      CHECK(std::none_of(frame.depth.begin(), frame.depth.end(), [](float z) { return std::isnan(z); }));
      CHECK(std::none_of(frame.blended.begin(), frame.blended.end(), [](auto n) { return n == 0xDEADBEEF; }));
    }
  }
}

TEST_CASE("concurrent pictures of several cameras, in host and device memory, equal the single ones") {
  if (!device_answers()) return;
  const Scene scene = scene_of(cloud_of(random_splats(608, sized(3000, 1000, 200)), 2));
  const std::size_t n = sized<std::size_t>(23, 9, 3);
  std::vector<Camera> cameras;
  for (std::size_t i = 0; i < n; ++i) {
    // Later cameras see more, so that workspaces grow in between.
    cameras.push_back(front_camera(61, 47));
    cameras.back().fx *= i < n / 2 ? 8 : 0.5;
  }
  constexpr std::size_t kPixels = 61 * 47;
  for (const std::size_t m : {std::size_t{0}, kTurboFp32}) {
    for (const Pipeline pipeline : {Pipeline::turbo, Pipeline::baseline}) {
      if (m != 0 && pipeline != Pipeline::turbo) continue;
      RenderOptions options = pipeline == Pipeline::turbo ? modes()[m] : baseline_options();
      options.background = {0.25F, 0.5F, 1};
      std::vector<Frame> expected;
      {
        auto renderer = Renderer::create({.backend = Backend::cuda});
        require_ok(renderer);
        for (const Camera& camera : cameras) {
          Frame frame = Frame::of(camera);
          RenderTarget target;
          target.rgb = frame.rgb, target.alpha = frame.alpha;
          const auto stats = renderer->render(scene, camera, target, options);
          require_ok(stats);
          frame.stats = *stats;
          expected.push_back(std::move(frame));
        }
      }
      auto renderer = Renderer::create({.backend = Backend::cuda});
      require_ok(renderer);
      const auto block = renderer->allocate_on_device(n * kPixels * 19);
      require_ok(block);
      for (const bool on_device : {false, true, true}) {  // the first call makes the renderers, the others reuse them
        CAPTURE(on_device);
        std::vector<float> rgb(3 * n * kPixels, -1), alpha(n * kPixels, -1);
        std::vector<std::uint8_t> codes(3 * n * kPixels, 77);
        auto* const base = static_cast<std::byte*>(block->data.get());
        PictureArrays pictures{.rgb = rgb.data(), .codes = codes.data(), .alpha = alpha.data()};
        cudaStream_t stream = nullptr;
        if (on_device) {
          require_cuda(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
          pictures = {.rgb = reinterpret_cast<float*>(base),
                      .codes = reinterpret_cast<std::uint8_t*>(base + n * kPixels * 16),
                      .alpha = reinterpret_cast<float*>(base + n * kPixels * 12),
                      .on_device = true,
                      .stream = stream};
          // Earlier work in the stream runs first: otherwise its bytes would be in the pictures.
          require_cuda(cudaMemsetAsync(base, 0x55, n * kPixels * 19, stream));
        }
        const auto stats = renderer->render_all(scene, cameras, pictures, options);
        require_ok(stats);
        REQUIRE(stats->size() == n);
        if (on_device) {
          require_cuda(cudaMemcpy(rgb.data(), pictures.rgb, rgb.size() * 4, cudaMemcpyDeviceToHost));
          require_cuda(cudaMemcpy(alpha.data(), pictures.alpha, alpha.size() * 4, cudaMemcpyDeviceToHost));
          require_cuda(cudaMemcpy(codes.data(), pictures.codes, codes.size(), cudaMemcpyDeviceToHost));
          require_cuda(cudaStreamDestroy(stream));
        }
        for (std::size_t i = 0; i < n; ++i) {
          CAPTURE(i);
          CHECK((*stats)[i].instances == expected[i].stats.instances);
          CHECK(std::ranges::equal(expected[i].rgb, std::span(rgb).subspan(3 * kPixels * i, 3 * kPixels)));
          CHECK(std::ranges::equal(expected[i].alpha, std::span(alpha).subspan(kPixels * i, kPixels)));
          std::vector<std::uint8_t> wanted(3 * kPixels);
          std::ranges::transform(expected[i].rgb, wanted.begin(), to_8bit);
          CHECK(std::ranges::equal(wanted, std::span(codes).subspan(3 * kPixels * i, 3 * kPixels)));
        }
      }
      // Codes only; and memory outside the device.
      std::vector<std::uint8_t> codes(3 * n * kPixels, 77);
      require_ok(renderer->render_all(scene, cameras, {.codes = codes.data()}, options));
      CHECK(std::ranges::equal(std::span(codes).last(3 * kPixels), [&] {
        std::vector<std::uint8_t> wanted(3 * kPixels);
        std::ranges::transform(expected.back().rgb, wanted.begin(), to_8bit);
        return wanted;
      }()));
      const auto refused = renderer->render_all(scene, cameras, {.codes = codes.data(), .on_device = true}, options);
      REQUIRE_FALSE(refused);
      CHECK(refused.error().code == Errc::bad_argument);
    }
  }
}

TEST_CASE("packed targets hold the float targets' values, converted; misaligned ones are refused") {
  if (!device_answers()) return;
  const Camera camera = front_camera(75, 33);
  const DeviceScene scene = upload(scene_of(cloud_of(random_splats(611, sized(2000, 2000, 300)), 2)));
  Device device(camera);
  for (std::size_t m = 0; m < kModeCount; ++m) {
    CAPTURE(kModes[m]);
    const DeviceArray<float> rgb(3 * 75 * 33), alpha(75 * 33);
    const DeviceArray<std::uint32_t> words(75 * 33);
    DeviceTarget target{.rgb = rgb.data(), .alpha = alpha.data(), .packed = words.data()};
    const auto stats = device.renderer().render(scene, camera, target, modes()[m]);
    require_ok(stats);
    const auto colors = rgb.download(), alphas = alpha.download();
    const auto packed = words.download();
    std::uint64_t n_wrong = 0;
    for (std::size_t i = 0; i < packed.size(); ++i) {
      n_wrong += packed[i] != math::pack_rgba8({colors[3 * i], colors[3 * i + 1], colors[3 * i + 2]}, alphas[i]);
    }
    CHECK(n_wrong == 0);
    target.packed = reinterpret_cast<std::byte*>(words.data()) + 2;
    check_error(device.renderer().render(scene, camera, target, modes()[m]), Errc::bad_argument);
    target.packed = words.data() + 1, target.format = math::PixelFormat::rgba16f;
    check_error(device.renderer().render(scene, camera, target, modes()[m]), Errc::bad_argument);
  }
}

namespace {

void check_same_counts(const FrameStats& a, const FrameStats& b) {
  CHECK(a.gaussians == b.gaussians);
  CHECK(a.visible == b.visible);
  CHECK(a.instances == b.instances);
  CHECK(a.evaluated == b.evaluated);
  CHECK(a.blended == b.blended);
}

}  // namespace

TEST_CASE("a turbo frame does not depend on earlier frames: other cameras, sizes, scenes, outputs and streams") {
  if (!device_answers()) return;
  const auto compact = CompactScene::of(cloud_of(random_splats(612, small_sizes() ? 400 : 30000), 3));
  const DeviceScene scenes[] = {upload(compact.file), upload(scene_of(cloud_of(random_splats(613, 300), 1))),
                                DeviceScene(), upload(walls(small_sizes() ? 200 : 6000))};  // more than 2^20 entries
  cudaStream_t stream = nullptr;
  require_cuda(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
  Random random(614);
  Device used(front_camera(8, 8));
  const std::pair<int, int> sizes[] = {{640, 360}, {33, 70}, {1920, 1080}, {640, 360}, {1, 1}};
  for (int turn = 0; turn < 40; ++turn) {
    CAPTURE(turn);
    auto [width, height] = sizes[turn / 3 % 5];
    if (small_sizes()) width = std::min(width, 70), height = std::min(height, 70);
    Camera camera = random_camera(random, width, height);
    if (turn % 6 == 5) camera = panorama_of(camera);
    const DeviceScene& scene = scenes[turn % 7 == 6 ? 3 : turn / 2 % 3];
    RenderOptions options = turbo_options();
    options.background = {0.3F, 0.2F, 0.1F};
    options.measure.count_pairs = turn % 5 == 4;  // kernels of another kind
    options.measure.timings = turn % 4 == 3;
    used.resize(camera);
    Device fresh(camera);
    const auto b = used.render(scene, options, turn % 2 == 0 ? stream : nullptr);
    require_ok(b);
    const auto a = fresh.render(scene, options);
    require_ok(a);
    check_same(used.rgb(), fresh.rgb());
    check_same(used.alpha(), fresh.alpha());
    check_same_counts(*b, *a);
    if (!options.measure.timings) CHECK(b->total_ms == 0);
  }
  require_cuda(cudaStreamDestroy(stream));
}

TEST_CASE("a finished asynchronous frame equals the synchronous one, even if it outgrew the workspace") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Camera camera = small_sizes() ? front_camera(64, 64) : front_camera(640, 360);
  const DeviceScene small = upload(scene_of(cloud_of(random_splats(615, 3000), 2)));
  const DeviceScene large = upload(walls(small_sizes() ? 300 : 6000));  // 1.4 million entries, of which 2^20 fit
  Device reference(camera);
  require_ok(reference.render(small, turbo_options()));
  const auto small_rgb = reference.rgb();
  const auto large_stats = reference.render(large, turbo_options());
  require_ok(large_stats);
  const auto large_rgb = reference.rgb();
  RenderOptions options = turbo_options();
  options.turbo.asynchronous = true;
  options.measure.timings = true;

  Device device(camera);
  const auto nothing = device.renderer().finish();
  require_ok(nothing);
  CHECK(nothing->gaussians == 0);
  const auto queued = device.render(large, options);
  require_ok(queued);
  CHECK(queued->gaussians == large.size());
  CHECK(queued->instances == 0);  // nobody has queried it
  const auto finished = device.renderer().finish();
  require_ok(finished);
  check_same_counts(*finished, *large_stats);
  check_same(device.rgb(), large_rgb);
  const auto again = device.renderer().finish();
  require_ok(again);
  CHECK(again->instances == finished->instances);

  // Unfinished, but followed: by a frame into another target, on another stream.
  Device other(camera);
  cudaStream_t stream = nullptr;
  require_cuda(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
  const DeviceArray<float> first(large_rgb.size()), second(small_rgb.size());
  synchronize();
  require_ok(other.renderer().render(large, camera, {.rgb = first.data()}, options, stream));
  require_ok(other.renderer().render(small, camera, {.rgb = second.data()}, options));
  require_ok(other.renderer().finish());
  check_same(first.download(), large_rgb);
  check_same(second.download(), small_rgb);
  // Frame after frame, each into its own target.
  std::vector<DeviceArray<float>> targets;
  targets.reserve(20);
  for (int k = 0; k < 20; ++k) targets.emplace_back(small_rgb.size());
  synchronize();
  for (std::size_t k = 0; k < targets.size(); ++k) {
    require_ok(other.renderer().render(k % 2 == 0 ? small : large, camera, {.rgb = targets[k].data()}, options,
                                       k % 3 == 0 ? stream : nullptr));
  }
  require_ok(other.renderer().finish());
  for (std::size_t k = 0; k < targets.size(); ++k)
    check_same(targets[k].download(), k % 2 == 0 ? small_rgb : large_rgb);
  require_cuda(cudaStreamDestroy(stream));

  Device abandoned(camera);  // destroyed while its frames are drawn
  for (int k = 0; k < 5; ++k) require_ok(abandoned.render(large, options));
}

namespace {

CudaRenderer renderer_with(std::uint32_t frames_in_flight, bool overlapping = true) {
  auto renderer = CudaRenderer::create({.frames_in_flight = frames_in_flight, .overlapping = overlapping});
  require_ok(renderer);
  return *std::move(renderer);
}

struct Stream {
  Stream() { require_cuda(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking)); }
  Stream(const Stream&) = delete;
  Stream& operator=(const Stream&) = delete;
  ~Stream() { cudaStreamDestroy(stream); }
  cudaStream_t stream = nullptr;
};

/// A frame with targets of its own, and what it must give.
struct Shot {
  Camera camera;
  std::size_t scene;
  RenderOptions options;
  DeviceArray<float> rgb, alpha;
  std::vector<float> expected_rgb, expected_alpha;
  FrameStats expected;

  void check_pixels() const {
    check_same(rgb.download(), expected_rgb);
    check_same(alpha.download(), expected_alpha);
  }
};

/// Frames of several scenes, cameras and sizes, as a renderer draws them that waits.
class Script {
 public:
  Script() {
    Random random(620);
    for (int k = 0; k < sized(24, 12, 4); ++k) {
      const auto [width, height] = k % 4 < 2       ? std::pair(33, 70)
                                   : small_sizes() ? std::pair(64, 64)
                                                   : std::pair(640, 360);
      Shot shot{random_camera(random, width, height),
                k % 6 == 1 ? 1u : k % 6 == 4 ? 2u : 0u,
                turbo_options(),
                {},
                {},
                {},
                {},
                {}};
      shot.options.background = {0.3F, 0.2F, 0.1F};
      shot.options.measure.count_pairs = k % 5 == 4;
      shot.options.measure.timings = k % 4 == 3;
      Device waiting(shot.camera);
      const auto stats = waiting.render(scenes_[shot.scene], shot.options);
      require_ok(stats);
      shot.expected_rgb = waiting.rgb(), shot.expected_alpha = waiting.alpha(), shot.expected = *stats;
      shots_.push_back(std::move(shot));
    }
  }

  /// The frames, with empty targets.
  std::vector<Shot> shots() const {
    std::vector<Shot> shots;
    for (const Shot& shot : shots_) {
      shots.push_back({shot.camera, shot.scene, shot.options, DeviceArray<float>(shot.expected_rgb.size()),
                       DeviceArray<float>(shot.expected_alpha.size()), shot.expected_rgb, shot.expected_alpha,
                       shot.expected});
    }
    synchronize();
    return shots;
  }
  void queue(const Shot& shot, CudaRenderer& renderer, cudaStream_t stream) const {
    RenderOptions options = shot.options;
    options.turbo.asynchronous = true;
    require_ok(renderer.render(scenes_[shot.scene], shot.camera, {.rgb = shot.rgb.data(), .alpha = shot.alpha.data()},
                               options, stream));
  }

 private:
  // The second has more entries than a first workspace holds.
  const DeviceScene scenes_[3] = {upload(scene_of(cloud_of(random_splats(621, sized(3000, 400, 200)), 2))),
                                  upload(walls(sized(6000, 300, 100))), DeviceScene()};
  std::vector<Shot> shots_;
};

}  // namespace

TEST_CASE("frames in flight equal those that are waited for: other cameras, sizes, scenes, streams, and as they grow") {
  if (!device_answers()) return;
  const Script script;
  const Stream streams[2];
  for (const auto& how : {std::pair(1u, true), {2u, true}, {3u, true}, {3u, false}, {8u, true}}) {
    const std::uint32_t most = how.first;
    const bool overlapping = how.second;
    CAPTURE(most);
    CAPTURE(overlapping);
    for (const bool one_stream : {false, true}) {
      CAPTURE(one_stream);
      const std::vector<Shot> shots = script.shots();
      CudaRenderer renderer = renderer_with(most, overlapping);
      std::vector<FrameStats> stats;
      const auto finish_oldest = [&] {
        const auto drawn = renderer.finish_oldest();
        require_ok(drawn);
        stats.push_back(*drawn);
      };
      for (std::size_t k = 0; k < shots.size(); ++k) {
        if (k - stats.size() == most) finish_oldest();
        script.queue(shots[k], renderer,
                     one_stream || k % 3 == 0 ? streams[0].stream
                     : k % 3 == 1             ? streams[1].stream
                                              : nullptr);
      }
      while (stats.size() < shots.size()) finish_oldest();
      finish_oldest();  // none is queued: the last one's again
      check_same_counts(stats.back(), shots.back().expected);
      for (std::size_t k = 0; k < shots.size(); ++k) {
        CAPTURE(k);
        shots[k].check_pixels();
        check_same_counts(stats[k], shots[k].expected);
        CHECK((stats[k].total_ms > 0) == shots[k].options.measure.timings);
      }
    }
  }
}

TEST_CASE("render() settles what is queued: the oldest frame if all are, every one before a frame that waits") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Script script;
  const Stream stream;
  CudaRenderer renderer = renderer_with(3);
  const std::vector<Shot> shots = script.shots();
  for (const Shot& shot : shots) script.queue(shot, renderer, stream.stream);
  require_ok(renderer.finish());
  for (const Shot& shot : shots) shot.check_pixels();
  const Camera camera = front_camera(64, 64);
  const DeviceScene scene = upload(walls(20));
  for (const RenderOptions& waits : {turbo_options(), paper_options()}) {
    Device alone(camera);
    const auto expected = alone.render(scene, waits);
    require_ok(expected);
    const std::vector<Shot> before = script.shots();
    const DeviceArray<float> rgb(3 * 64 * 64);
    synchronize();
    script.queue(before[0], renderer, stream.stream);
    script.queue(before[1], renderer, nullptr);
    const auto stats = renderer.render(scene, camera, {.rgb = rgb.data()}, waits, stream.stream);
    require_ok(stats);
    check_same_counts(*stats, *expected);
    check_same(rgb.download(), alone.rgb());
    before[0].check_pixels();
    before[1].check_pixels();
  }
}

TEST_CASE("frames in flight into one target leave the last one's picture, also if an earlier one had to be repeated") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Camera camera = small_sizes() ? front_camera(64, 64) : front_camera(640, 360);
  const DeviceScene large = upload(walls(small_sizes() ? 300 : 6000));
  const DeviceScene small = upload(scene_of(cloud_of(random_splats(622, 3000), 2)));
  Device waiting(camera);
  require_ok(waiting.render(small, turbo_options()));
  const auto expected = waiting.rgb();
  RenderOptions queued = turbo_options();
  queued.turbo.asynchronous = true;
  const Stream streams[2];
  for (const bool overlapping : {false, true}) {
    CAPTURE(overlapping);
    CudaRenderer renderer = renderer_with(3, overlapping);  // its first workspaces are too small
    const DeviceArray<float> rgb(expected.size());
    synchronize();
    for (int k = 0; k < 3; ++k) {
      require_ok(renderer.render(k == 0 ? large : small, camera, {.rgb = rgb.data()}, queued, streams[k % 2].stream));
    }
    require_ok(renderer.finish());
    check_same(rgb.download(), expected);
  }
}

TEST_CASE("overlapping frames into one target: what the caller queues on the stream after each sees its picture") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const auto [width, height] = small_sizes() ? std::pair(64, 64) : std::pair(640, 360);
  const DeviceScene scenes[] = {upload(walls(sized(6000, 300, 100))),
                                upload(scene_of(cloud_of(random_splats(623, sized(3000, 400, 200)), 2))),
                                DeviceScene()};  // after a few, tiles are filled before their Gaussians are known
  const Stream stream;
  Random random(624);
  for (const std::size_t mode : {kTurbo, kTurboFp32}) {
    CAPTURE(kModes[mode]);
    RenderOptions options = modes()[mode];
    options.background = {0.3F, 0.2F, 0.1F};
    struct Step {
      const DeviceScene& scene;
      Camera camera;
      std::vector<float> expected;
      DeviceArray<float> seen;
    };
    std::vector<Step> steps;
    steps.reserve(16);
    for (std::size_t k = 0; k < 16; ++k) {
      const DeviceScene& scene = scenes[k < 8 ? k % 3 % 2 : k < 12 ? 2 : k % 3];
      const Camera camera =
          scene.size() == scenes[0].size() ? front_camera(width, height) : random_camera(random, width, height);
      Device waiting(camera);
      require_ok(waiting.render(scene, options));
      std::vector<float> expected = waiting.rgb();
      DeviceArray<float> seen(expected.size());
      steps.push_back({scene, camera, std::move(expected), std::move(seen)});
    }
    options.turbo.asynchronous = true;
    CudaRenderer renderer = renderer_with(3);
    const DeviceArray<float> rgb(steps.front().expected.size());
    const DeviceArray<float> slow(small_sizes() ? 1 << 16 : 1 << 26);  // its clearing outlasts the next front end
    for (const bool fits : {false, true}) {  // the first time workspaces grow, and some pictures are late
      synchronize();
      for (const Step& step : steps) {
        require_ok(renderer.render(step.scene, step.camera, {.rgb = rgb.data()}, options, stream.stream));
        require_cuda(cudaMemsetAsync(slow.data(), 0, slow.size() * sizeof(float), stream.stream));
        require_cuda(cudaMemcpyAsync(step.seen.data(), rgb.data(), rgb.size() * sizeof(float), cudaMemcpyDeviceToDevice,
                                     stream.stream));
      }
      require_ok(renderer.finish());
      check_same(rgb.download(), steps.back().expected);
      if (!fits) continue;
      require_cuda(cudaStreamSynchronize(stream.stream));
      for (std::size_t k = 0; k < steps.size(); ++k) {
        CAPTURE(k);
        check_same(steps[k].seen.download(), steps[k].expected);
      }
    }
  }
}

TEST_CASE("a second workspace is added with a frame that is queued behind another, unless frames do not overlap") {
  if (!device_answers()) return;
  const Camera camera = front_camera(64, 64);
  const DeviceScene scene = upload(walls(20));
  RenderOptions queued = turbo_options();
  queued.turbo.asynchronous = true;
  Device waiting(camera);
  require_ok(waiting.render(scene, turbo_options()));
  const std::uint64_t bytes = waiting.renderer().bytes();
  for (const bool overlapping : {false, true}) {
    CAPTURE(overlapping);
    CudaRenderer renderer = renderer_with(3, overlapping);
    const DeviceTarget target = waiting.target();
    for (int k = 0; k < 3; ++k) {
      require_ok(renderer.render(scene, camera, target, queued));
      require_ok(renderer.finish());
    }
    CHECK(renderer.bytes() == bytes);
    for (int k = 0; k < 4; ++k) require_ok(renderer.render(scene, camera, target, queued));
    const auto last = renderer.finish();
    require_ok(last);
    CHECK(renderer.bytes() == (overlapping ? 2 : 1) * bytes);
    CHECK(last->bytes == renderer.bytes());
  }
}

TEST_CASE("two renderers with frames in flight on streams of their own draw side by side") {
  if (!device_answers()) return;
  const Script script;
  const Stream streams[2];
  CudaRenderer renderers[2] = {renderer_with(3), renderer_with(2)};
  const std::vector<Shot> shots[2] = {script.shots(), script.shots()};
  const std::size_t n = shots[0].size();
  for (std::size_t k = 0; k < n; ++k) {
    script.queue(shots[0][k], renderers[0], streams[0].stream);
    script.queue(shots[1][n - 1 - k], renderers[1], streams[1].stream);
  }
  for (std::size_t r = 0; r < 2; ++r) {
    CAPTURE(r);
    const auto last = renderers[r].finish();
    require_ok(last);
    check_same_counts(*last, r == 0 ? shots[r].back().expected : shots[r].front().expected);
    for (const Shot& shot : shots[r]) shot.check_pixels();
  }
}

TEST_CASE("a renderer has 1 to 16 frames in flight") {
  for (const std::uint32_t refused : {0u, 17u}) {
    const auto renderer = CudaRenderer::create({.frames_in_flight = refused});
    REQUIRE_FALSE(renderer);
    CHECK(renderer.error().code == Errc::bad_argument);
    CHECK(renderer.error().found == refused);
  }
  if (!device_answers()) return;
  CHECK(CudaRenderer::create({.frames_in_flight = 16}));
}

TEST_CASE("stage times on request: the frame's own time excludes them") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const Camera camera = front_camera(160, 90);
  const DeviceScene scene = upload(scene_of(cloud_of(random_splats(616, 3000), 1)));
  Device device(camera);
  for (RenderOptions options : modes()) {
    options.measure.timings = true;
    const auto staged = device.render(scene, options);
    require_ok(staged);
    // Between the same events, each measured to half a microsecond.
    const double stages_ms = staged->project_ms + staged->bin_ms + staged->sort_ms + staged->blend_ms;
    CHECK(std::abs(stages_ms - staged->total_ms) < 0.01);
    options.measure.stage_timings = false;
    const auto whole = device.render(scene, options);
    require_ok(whole);
    CHECK(whole->project_ms == 0);
    CHECK(whole->blend_ms == 0);
  }
}

TEST_CASE("Renderer uploads an .rgs file in its stored form, a third of the FP32 attributes") {
  if (!device_answers()) return;
  const int n = small_sizes() ? 500 : 2000000;
  const auto compact = CompactScene::of(cloud_of(random_splats(617, n), 3));
  const TemporaryFolder folder;
  const std::string path = folder.file("scene.rgs");
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(compact.bytes.data()), static_cast<std::streamsize>(compact.bytes.size()));
  const auto scene = Scene::load(path);
  require_ok(scene);
  const Camera camera = front_camera(90, 60);
  auto renderer = Renderer::create({.backend = Backend::cuda});
  require_ok(renderer);
  Frame frame = Frame::of(camera);
  const auto empty = renderer->render(Scene(), camera, frame.target(), turbo_options());
  require_ok(empty);
  const auto free_bytes = [] {
    std::size_t free = 0, total = 0;
    require_cuda(cudaMemGetInfo(&free, &total));
    return static_cast<double>(free);
  };
  const double before = free_bytes();
  const RenderOptions turbo_fp32 = modes()[kTurboFp32];  // the frame has depth, which is blended in FP32
  const auto stats = renderer->render(*scene, camera, frame.target(), turbo_fp32);
  require_ok(stats);
  const double attributes = before - free_bytes() - static_cast<double>(stats->bytes - empty->bytes);
  MESSAGE("attributes of ", n, " Gaussians: ", attributes, " bytes");
  CHECK((small_sizes() || attributes < 0.5 * 236 * n));  // 76 n, and the unused part of the pool's pages
  Device device(camera);
  require_ok(device.render(upload(compact.file), turbo_fp32));
  check_same(frame.rgb, device.rgb());
}

TEST_CASE("nothing visible: no Gaussians, all behind the camera, all beside it") {
  if (!device_answers()) return;
  const Camera camera = front_camera(50, 20);
  Device device(camera);
  for (RenderOptions options : modes()) {
    options.background = {0.1F, 0.2F, 0.3F};
    for (const double z : {0.0, -5.0, 0.2, 5.0}) {
      if (race_sizes() && z != 5.0) continue;
      const Scene scene =
          z == 0 ? Scene() : scene_of(cloud_of(std::vector(300, splat_at(z > 1 ? 1000 : 0, 0, z, 0.1, 0.9))));
      const auto stats = device.render(z == 0 ? DeviceScene() : upload(scene), options);
      require_ok(stats);
      CHECK(stats->visible == 0);
      CHECK(stats->instances == 0);
      const auto rgb = device.rgb(), alpha = device.alpha();
      CHECK(std::all_of(alpha.begin(), alpha.end(), [](float a) { return a == 0; }));
      for (std::size_t i = 0; i < rgb.size(); ++i) REQUIRE(rgb[i] == options.background[i % 3]);
    }
  }
  const auto empty = CompactScene::of(golden_cloud(0, 2, 1));
  require_ok(device.render(upload(empty.file), paper_options()));
  CHECK(device.alpha()[7] == 0);
}

TEST_CASE("one Gaussian over all tiles, from one pixel to 8K") {
  if (!device_answers()) return;
  const Scene scene = walls(1);
  const DeviceScene uploaded = upload(scene);
  std::vector<std::pair<int, int>> sizes{{1, 1}, {16, 16}, {17, 1}, {1, 40}, {640, 360}, {7680, 4320}};
  if (small_sizes()) sizes.pop_back();
  if (race_sizes()) sizes = {{17, 1}, {320, 320}};  // 100 of turbo's tiles: a large Gaussian
  for (const auto& size : sizes) {
    const int width = size.first, height = size.second;
    Camera camera = front_camera(width, height);
    camera.fx = camera.fy = 0.8 * std::max(width, height);
    Device device(camera);
    for (std::size_t m = 0; m < kModeCount; ++m) {
      const auto stats = device.render(uploaded, modes()[m]);
      require_ok(stats);
      CHECK(stats->instances == n_tiles(modes()[m], width, height));
      const auto alpha = device.alpha();
      const auto ends = std::minmax_element(alpha.begin(), alpha.end());
      CHECK_MESSAGE((*ends.first > 0.019 && *ends.second < 0.0209), kModes[m], " at ", width, "x", height, ": alpha ",
                    *ends.first, " .. ", *ends.second);
    }
  }
}

TEST_CASE("more pairs than the workspace holds: the frame equals that of a sufficient workspace") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const int n = small_sizes() ? 1200 : 6000;  // the first workspace has room for 2^20 pairs
  const Scene scene = walls(n), tiny = walls(3);
  const Camera camera = front_camera(640, 360);
  for (std::size_t m = 0; m < kModeCount; ++m) {
    CAPTURE(kModes[m]);
    Device device(camera);
    const DeviceScene large = upload(scene), small = upload(tiny);
    require_ok(device.render(small, modes()[m]));
    const auto small_rgb = device.rgb();
    const std::uint64_t before = device.renderer().bytes();
    const auto stats = device.render(large, modes()[m]);
    require_ok(stats);
    const std::uint64_t n_pairs = static_cast<std::uint64_t>(n) * n_tiles(modes()[m], 640, 360);
    CHECK(stats->instances == n_pairs);
    const auto rgb = device.rgb();
    CHECK((n_pairs <= 1 << 20 || device.renderer().bytes() > before));
    CHECK(stats->bytes == device.renderer().bytes());
    const std::uint64_t after = device.renderer().bytes();
    require_ok(device.render(large, modes()[m]));
    check_same(device.rgb(), rgb);
    require_ok(device.render(small, modes()[m]));
    check_same(device.rgb(), small_rgb);
    CHECK_MESSAGE(device.renderer().bytes() == after, "a frame that fits allocates");
    const Frame host = cpu_frame(scene, camera, modes()[m]);
    const double quality = psnr(rgb, host.rgb);
    CHECK_MESSAGE(quality >= lowest_psnr(modes()[m]), quality, " dB");
    RenderOptions unordered = modes()[m];  // depths differ, so that blocks in any order give the same
    unordered.paper.deterministic = false;
    Device other(camera);
    require_ok(other.render(large, unordered));
    check_same(other.rgb(), rgb);
  }
}

TEST_CASE("cells of many Gaussians are blended in segments: the picture is the CPU's, the same on every run") {
  if (!device_answers()) return;
  // Much thinner than a pixel, so that one in a hundred of a cell's Gaussians meets a given pixel; transmittance then
  // lasts for some segments, for all, or only for the first. With the fewest, a single cell has five segments: waves of
  // one and two, and two of a wave of four.
  const int n = sized(200000, 12000, 6000);
  const Camera camera = race_sizes() ? front_camera(16, 8) : front_camera(90, 50);
  const double reach_x = sized(10.8, 10.8, 8.0), reach_y = sized(7.2, 7.2, 4.0);  // px
  for (const auto& kind : {std::pair(0.5, false), {0.02, false}, {0.0045, false}, {0.02, true}, {0.0045, true}}) {
    const double opacity = kind.first;
    const bool needles = kind.second;
    CAPTURE(opacity);
    CAPTURE(needles);
    Random random(41);
    std::vector<Splat> splats;
    for (int i = 0; i < n; ++i) {
      const double z = random.uniform(40, 60), unit = z / camera.fx;
      const double x = random.uniform(-reach_x, reach_x) * unit, y = random.uniform(-reach_y, reach_y) * unit;
      splats.push_back(splat_at(x, y, z, 1e-3, opacity, static_cast<float>(random.uniform(0, 1))));
      if (!needles) continue;
      const double half_turn = random.uniform(0, 1.6);
      splats.back().log_scale[0] = static_cast<float>(std::log(4 * unit));  // 4 px
      splats.back().rotation[0] = static_cast<float>(std::cos(half_turn));
      splats.back().rotation[3] = static_cast<float>(std::sin(half_turn));
    }
    const Scene scene = scene_of(cloud_of(splats));
    const DeviceScene uploaded = upload(scene);
    Device device(camera);
    for (const std::size_t m : {kTurbo, kTurboFp32}) {
      CAPTURE(kModes[m]);
      require_ok(device.render(uploaded, modes()[m]));
      const auto rgb = device.rgb(), alpha = device.alpha();
      const Frame host = cpu_frame(scene, camera, modes()[m]);
      const double quality = psnr(rgb, host.rgb), error = largest_difference(rgb, host.rgb);
      MESSAGE(kModes[m], ", opacity ", opacity, ": ", quality, " dB, at most ", 255 * error, "/255 off the CPU");
      CHECK(quality >= lowest_psnr(modes()[m]));
      CHECK(error <= largest_error(modes()[m]));
      for (int run = 0; run < sized(10, 10, 1); ++run) {
        require_ok(device.render(uploaded, modes()[m]));
        check_same(device.rgb(), rgb);
        check_same(device.alpha(), alpha);
      }
    }
  }
}

TEST_CASE("above 2^31 pairs: limit_exceeded, and the renderer continues") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  const Scene many = walls(70000), few = walls(5);
  const DeviceScene uploaded = upload(many), small = upload(few);
  const Camera camera = front_camera(7680, 4320);
  Device device(camera);
  for (std::size_t m = 0; m < kModeCount; ++m) {
    CAPTURE(kModes[m]);
    require_ok(device.render(small, modes()[m]));
    const auto alpha = device.alpha();
    const auto result = device.render(uploaded, modes()[m]);
    check_error(result, Errc::limit_exceeded);
    CHECK(result.error().found == std::uint64_t{70000} * n_tiles(modes()[m], 7680, 4320));
    require_ok(device.render(small, modes()[m]));
    check_same(device.alpha(), alpha);
  }
  RenderOptions atomic = paper_options();
  check_error(device.render(uploaded, atomic), Errc::limit_exceeded);

  // The call that settles the frame tells the error, once; the frame after it ends without a picture.
  RenderOptions queued = turbo_options();
  require_ok(device.render(small, queued));
  const auto alpha = device.alpha();
  queued.turbo.asynchronous = true;
  CudaRenderer renderer = renderer_with(3);
  const DeviceTarget target = device.target();
  for (const bool by_render : {false, true}) {
    CAPTURE(by_render);
    require_ok(renderer.render(small, camera, target, queued));
    require_ok(renderer.render(uploaded, camera, target, queued));
    require_ok(renderer.render(small, camera, target, queued));
    if (by_render) {
      require_ok(renderer.render(small, camera, target, queued));  // settles the first
      check_error(renderer.render(small, camera, target, queued), Errc::limit_exceeded);
    } else {
      require_ok(renderer.finish_oldest());
      check_error(renderer.finish_oldest(), Errc::limit_exceeded);
    }
    const auto after = renderer.finish();
    require_ok(after);
    CHECK(after->instances == 0);
    require_ok(renderer.render(small, camera, target, queued));
    require_ok(renderer.finish());
    check_same(device.alpha(), alpha);
  }
}

TEST_CASE("refusals: cameras and options") {
  if (!device_answers()) return;
  Device device(front_camera(8, 8));
  const DeviceScene scene = upload(walls(1));
  Camera bad = front_camera(8, 8);
  bad.fx = std::numeric_limits<double>::quiet_NaN();
  check_error(device.renderer().render(scene, bad, {}), Errc::bad_camera);
  check_error(device.render(scene, {.near_plane = -1}), Errc::bad_argument);
  check_error(device.render(scene, Arithmetic{.depth_bits = 33}), Errc::bad_argument);
  check_error(device.render(scene, {.pipeline = Pipeline::paper, .paper = {.pixels_per_thread = 3}}),
              Errc::bad_argument);
  require_ok(device.render(scene, {}));
  require_ok(device.renderer().render(scene, front_camera(8, 8), {}));  // a frame without outputs
}

namespace {

/// Occupies the device's memory except about `left` bytes, until destroyed.
class Hog {
 public:
  explicit Hog(std::size_t left) {
    std::size_t free = 0, total = 0;
    require_cuda(cudaMemGetInfo(&free, &total));
    for (std::size_t size = free; size >= std::size_t{1} << 20;) {
      void* memory = nullptr;
      if (size + left <= free && cudaMalloc(&memory, size) == cudaSuccess) {
        memory_.push_back(memory);
        require_cuda(cudaMemGetInfo(&free, &total));
      } else {
        cudaGetLastError();
        size /= 2;
      }
    }
  }
  ~Hog() {
    for (void* memory : memory_) cudaFree(memory);
  }
  Hog(const Hog&) = delete;
  Hog& operator=(const Hog&) = delete;

 private:
  std::vector<void*> memory_;
};

}  // namespace

TEST_CASE("device out of memory: an error, never a wrong picture, and a working renderer afterwards") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  const Camera camera = front_camera(640, 360);
  const Scene scene = walls(30000), tiny = walls(3);  // 7 million pairs and more: at least 150 MB
  const DeviceScene large = upload(scene), small = upload(tiny);
  for (std::size_t m = 0; m < kModeCount; ++m) {
    CAPTURE(kModes[m]);
    Device fresh(camera);
    require_ok(fresh.render(large, modes()[m]));
    const auto expected = fresh.rgb();
    require_ok(fresh.render(small, modes()[m]));
    const auto small_rgb = fresh.rgb();

    Device device(camera);
    // With more or less memory left, different arrays of the workspace are the first that do not fit.
    int n_refused = 0;
    for (const std::size_t megabytes : {1u, 3u, 4u, 5u, 8u, 30u, 90u, 150u, 170u, 250u, 280u, 300u, 390u, 500u}) {
      CAPTURE(megabytes);
      auto renderer = CudaRenderer::create();
      require_ok(renderer);
      device.renderer() = *std::move(renderer);
      require_ok(device.render(small, modes()[m]));
      {
        const Hog hog(megabytes << 20);
        const auto result = device.render(large, modes()[m]);
        if (result) {
          check_same(device.rgb(), expected);
        } else {
          ++n_refused;
          check_error(result, Errc::device_out_of_memory);
          CHECK(result.error().expected > 0);
          CHECK(result.error().expected < std::uint64_t{1} << 32);
        }
        // The workspace may be smaller than before: again an error or the right picture.
        const auto again = device.render(small, modes()[m]);
        if (again) {
          check_same(device.rgb(), small_rgb);
        } else {
          check_error(again, Errc::device_out_of_memory);
        }
      }
      require_ok(device.render(small, modes()[m]));
      check_same(device.rgb(), small_rgb);
    }
    CHECK(n_refused >= 6);
    require_ok(device.render(large, modes()[m]));
    check_same(device.rgb(), expected);
  }
  const Hog hog(std::size_t{1} << 20);
  auto renderer = Renderer::create({.backend = Backend::cuda});
  if (renderer) {
    Frame frame = Frame::of(camera);
    const auto stats = renderer->render(scene, camera, frame.target(), modes()[0]);
    REQUIRE_FALSE(stats);
    CHECK(stats.error().code == Errc::device_out_of_memory);
  } else {
    CHECK(renderer.error().code != Errc::unavailable);
  }
  const auto refused = DeviceScene::upload(scene_of(cloud_of(random_splats(608, 200000), 3)).view().value());
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::device_out_of_memory);
}

TEST_CASE("with little memory, the workspace grows by the frame's need and not by half") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  const Camera camera = front_camera(640, 360);
  for (const std::size_t m : {std::size_t{0}, std::size_t{1}, kTurbo}) {
    CAPTURE(kModes[m]);
    const int n = m == kTurbo ? 20000 : 6000;  // about 5 million pairs
    const Scene first = walls(n), more = walls(n + n / 10);
    const DeviceScene fits = upload(first), outgrows = upload(more);
    Device fresh(camera);
    require_ok(fresh.render(outgrows, modes()[m]));
    const auto expected = fresh.rgb();
    Device device(camera);
    require_ok(device.render(fits, modes()[m]));
    const std::uint64_t before = device.renderer().bytes();
    {
      const Hog hog(before / 4);
      require_ok(device.render(outgrows, modes()[m]));
      check_same(device.rgb(), expected);
      CHECK(device.renderer().bytes() > before);
      CHECK(device.renderer().bytes() < before + before / 4);
    }
    require_ok(device.render(outgrows, modes()[m]));
    check_same(device.rgb(), expected);
  }
}

TEST_CASE("if the first workspace does not fit, a small one is tried") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  const Camera camera = front_camera(640, 360);
  std::vector<Splat> splats(1200000, splat_at(0, 0, -5, 0.01, 0.5));  // behind the camera
  for (std::size_t i = 0; i < 100; ++i)
    splats[12000 * i] = splat_at(0.02 * static_cast<double>(i) - 1, 0, 4, 0.05, 0.5);
  const DeviceScene scene = upload(scene_of(cloud_of(splats)));
  Device fresh(camera);
  require_ok(fresh.render(scene, modes()[kTurbo]));
  const std::uint64_t guess = fresh.renderer().bytes(), left = guess - (std::uint64_t{40} << 20);
  Device device(camera);
  const Hog hog(left);
  require_ok(device.render(scene, modes()[kTurbo]));
  check_same(device.rgb(), fresh.rgb());
  CHECK(device.renderer().bytes() < left);
}

TEST_CASE("device memory returns to its start once everything is destroyed") {
  if (!device_answers()) return;
  // compute-sanitizer's own memory varies; its leak check covers this.
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  const auto use_everything = [] {
    const auto compact = CompactScene::of(cloud_of(random_splats(609, 3000), 3));
    const DeviceScene scenes[] = {upload(compact.file), upload(compact.scene), DeviceScene()};
    for (const int width : {300, 64}) {
      Device device(front_camera(width, 200));
      for (const DeviceScene& scene : scenes) {
        for (const RenderOptions& options : modes()) require_ok(device.render(scene, options));
      }
      CudaRenderer moved = std::move(device.renderer());
      device.renderer() = std::move(moved);
    }
    Frame frame = Frame::of(front_camera(50, 50));
    auto renderer = Renderer::create({.backend = Backend::cuda});
    require_ok(renderer);
    require_ok(renderer->render(compact.scene, front_camera(50, 50), frame.target()));
    synchronize();
  };
  const auto free_bytes = [] {
    std::size_t free = 0, total = 0;
    require_cuda(cudaMemGetInfo(&free, &total));
    return static_cast<std::int64_t>(free);
  };
  use_everything();  // loads the kernels, which stay
  const std::int64_t before = free_bytes();
  for (int run = 0; run < 20; ++run) use_everything();
  const std::int64_t after = free_bytes();
  // The driver allocates pages of 2 MiB, one of which it may keep.
  CHECK_MESSAGE(before - after <= 2 << 20, (before - after), " bytes are not released");
}
