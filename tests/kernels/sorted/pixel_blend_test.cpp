// pixel_blend_test.cpp - sorted pairs to pixels on the device, in every arithmetic, against the scalar CPU renderer.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cstring>
#include <numeric>

#include "blend_fixture.hpp"
#include "device_fixture.hpp"
#include "sorted/sort.hpp"

using namespace rgs;
using namespace rgs::test;
using math::Exp;
using math::Exponent;

namespace {

/// A frame up to its sorted pairs, by the deterministic front end.
struct SortedFrame {
  DeviceArray<cuda::ScreenSplat> splats;
  DeviceArray<std::uint32_t> gaussians, spare_gaussians;
  DeviceArray<std::uint64_t> keys, spare_keys;
  DeviceArray<cuda::TileRange> ranges;
  const std::uint32_t* sorted = nullptr;

  SortedFrame(const Scene& scene, const Camera& camera, const Arithmetic& options) {
    const DeviceAttributes attributes(scene.view().value());
    const auto n = static_cast<std::uint32_t>(scene.size());
    const auto v = view_parameters(camera, options, scene.sh_degree());
    splats = DeviceArray<cuda::ScreenSplat>(n);
    std::uint64_t n_pairs = 0;
    for (int pass = 0; pass < 2; ++pass) {  // to count, then to write
      DeviceArray<cuda::Counters> counters(1);
      counters.fill(0);
      DeviceArray<std::uint64_t> state(cuda::fused_blocks(n) + 1);
      state.fill(0);
      gaussians = DeviceArray<std::uint32_t>(n_pairs), keys = DeviceArray<std::uint64_t>(n_pairs);
      require_ok(cuda::launch_fused({attributes.get(),
                                     n,
                                     v,
                                     options.extent,
                                     splats.data(),
                                     {keys.data(), gaussians.data(), n_pairs, false},
                                     counters.data(),
                                     state.data()},
                                    nullptr));
      n_pairs = counters.download()[0].instances;
    }
    spare_gaussians = DeviceArray<std::uint32_t>(n_pairs), spare_keys = DeviceArray<std::uint64_t>(n_pairs);
    cuda::SortBuffers buffers{keys.data(), spare_keys.data(), gaussians.data(), spare_gaussians.data(), false};
    const auto bytes = cuda::sort_bytes(n_pairs, false);
    require_ok(bytes);
    const DeviceArray<std::byte> temporary(*bytes);
    require_ok(cuda::launch_sort(buffers, n_pairs, v.key.bits(), temporary.data(), *bytes, nullptr));
    const auto n_tiles = static_cast<std::uint32_t>(v.grid.columns * v.grid.rows);
    ranges = DeviceArray<cuda::TileRange>(n_tiles);
    require_ok(cuda::launch_ranges(buffers.keys, false, n_pairs, v.key.depth_bits, ranges.data(), n_tiles, nullptr));
    synchronize();
    sorted = buffers.gaussians;
  }
};

double share(std::uint64_t part, std::uint64_t whole) {
  return static_cast<double>(part) / static_cast<double>(std::max<std::uint64_t>(whole, 1));
}

/// Counts per pixel: a few pairs near a threshold may fall to either side, but not all to the same.
void check_counts(const std::string& what, const std::vector<std::uint32_t>& device,
                  const std::vector<std::uint32_t>& host) {
  std::uint64_t n_different = 0, sum_device = 0, sum_host = 0, n_unwritten = 0;
  for (std::size_t i = 0; i < host.size(); ++i) {
    n_different += device[i] != host[i];
    n_unwritten += device[i] == ~0u;
    sum_device += device[i], sum_host += host[i];
  }
  REQUIRE_MESSAGE(n_unwritten == 0, n_unwritten, " pixels without ", what);
  const std::uint64_t bias = sum_device > sum_host ? sum_device - sum_host : sum_host - sum_device;
  CHECK_MESSAGE(share(n_different, host.size()) <= 0.002, what, " differs in ", n_different, " of ", host.size(),
                " pixels");
  CHECK_MESSAGE(share(bias, sum_host) <= 1e-4, what, ": ", sum_device, " on the device, ", sum_host, " on the host");
}

/// Depths where both blended the same Gaussians; elsewhere one more Gaussian may give a depth where there was none.
void check_depths(const DeviceFrame& device, const Frame& host) {
  double worst = 0;
  std::uint64_t n_nan = 0;
  for (std::size_t i = 0; i < host.depth.size(); ++i) {
    n_nan += std::isnan(device.depth[i]);
    if (device.blended[i] != host.blended[i]) continue;
    worst = std::max(worst, std::abs(device.depth[i] - host.depth[i]) / std::max(1.0, std::abs(1.0 * host.depth[i])));
  }
  CHECK_MESSAGE(n_nan == 0, n_nan, " depths are NaN or were not written");
  CHECK_MESSAGE(worst <= 2e-3, "largest relative difference of a depth: ", worst);
}

struct Variant {
  Exponent exponent;
  Exp exp;
  int pixels_per_thread;
  bool details;
};

void check_variant(const BlendInput& input, const Variant& variant, const Frame& host, double& lowest_psnr,
                   double& largest) {
  const std::string exponents[] = {"direct", "folded"};
  const std::string exps[] = {"exact", "paper", "zero-mean"};
  CAPTURE(exponents[static_cast<int>(variant.exponent)]);
  CAPTURE(exps[static_cast<int>(variant.exp)]);
  CAPTURE(variant.pixels_per_thread);
  CAPTURE(variant.details);
  const DeviceFrame device =
      blend_on_device(input, variant.exponent, variant.exp, variant.pixels_per_thread, variant.details);
  const auto n_nan = std::count_if(device.rgb.begin(), device.rgb.end(), [](float x) { return std::isnan(x); });
  REQUIRE_MESSAGE(n_nan == 0, n_nan, " channels are NaN or were not written");
  const double quality = psnr(device.rgb, host.rgb), error = largest_difference(device.rgb, host.rgb);
  lowest_psnr = std::min(lowest_psnr, quality), largest = std::max(largest, error);
  if (variant.exp == Exp::exact) {
    CHECK(quality >= 70);
    CHECK(error <= 2.0 / 255);
    CHECK(largest_difference(device.alpha, host.alpha) <= 2.0 / 255);
  } else {
    CHECK(quality >= 65);
    CHECK(psnr(device.alpha, host.alpha) >= 65);
  }
  if (!variant.details) return;
  check_counts("evaluated", device.evaluated, host.evaluated);
  check_counts("blended", device.blended, host.blended);
  check_depths(device, host);
  CHECK(device.counters.evaluated == std::accumulate(device.evaluated.begin(), device.evaluated.end(), 0ull));
  CHECK(device.counters.blended == std::accumulate(device.blended.begin(), device.blended.end(), 0ull));
}

}  // namespace

TEST_CASE("pairs have the host's order: tile, depth, index") {
  if (!device_answers()) return;
  const Scene scene = scene_of(cloud_of(random_splats(401, small_sizes() ? 300 : 5000)));
  const Camera camera = front_camera(320, 180);
  const SortedFrame frame(scene, camera, {});
  const auto ranges = frame.ranges.download();
  const auto splats = frame.splats.download();
  std::vector<std::uint32_t> sorted(frame.gaussians.size());
  require_cuda(cudaMemcpy(sorted.data(), frame.sorted, sorted.size() * 4, cudaMemcpyDeviceToHost));
  std::uint64_t n_pairs = 0, n_wrong = 0;
  for (const auto& range : ranges) {
    n_pairs += range.end - range.begin;
    for (std::uint32_t k = range.begin + 1; k < range.end; ++k) {
      const std::uint32_t a = sorted[k - 1], b = sorted[k];
      n_wrong += splats[a].z > splats[b].z || (splats[a].z == splats[b].z && a >= b);
    }
  }
  CHECK(n_pairs == sorted.size());
  CHECK(n_wrong == 0);
}

TEST_CASE("every arithmetic, thread layout and set of outputs draws the scalar renderer's pixels") {
  if (!device_answers()) return;
  struct Size {
    int width, height, n;
  };
  std::vector<Size> sizes{{1, 1, 400},  {15, 17, 400},    {16, 16, 1000},
                          {33, 1, 300}, {640, 360, 6000}, {1920, 1080, 20000}};
  if (small_sizes()) sizes = {{1, 1, 200}, {15, 17, 200}, {50, 34, 300}};
  auto reference = Renderer::create({.backend = Backend::cpu, .simd = false});
  require_ok(reference);
  Random random(402);
  for (const Size& size : sizes) {
    const Camera camera = random_camera(random, size.width, size.height);
    const Scene scene = scene_of(cloud_of(random_splats(static_cast<unsigned>(500 + size.width), size.n), 2));
    CAPTURE(size.width);
    CAPTURE(size.height);
    const auto extent = size.width % 2 == 0 ? math::Extent::ellipse : math::Extent::square;
    const SortedFrame frame(scene, camera, {.extent = extent});
    const BlendInput input{frame.ranges.data(), frame.sorted, frame.splats.data(),
                           size.width,          size.height,  {0.2F, 0.5F, 0.8F}};
    for (const auto exponent : {Exponent::direct, Exponent::folded}) {
      for (const auto exp : {Exp::exact, Exp::paper, Exp::zero_mean}) {
        Frame host = Frame::of(camera);
        const Arithmetic options{.background = {0.2F, 0.5F, 0.8F}, .extent = extent, .exponent = exponent, .exp = exp};
        require_ok(reference->render(scene, camera, host.target(), options));
        double lowest = 1e9, largest = 0;
        for (const int pixels : {1, 2}) {
          for (const bool details : {false, true}) {
            check_variant(input, {exponent, exp, pixels, details}, host, lowest, largest);
          }
        }
        MESSAGE(size.width, "x", size.height, std::string(exponent == Exponent::direct ? " direct" : " folded"),
                " exp ", static_cast<int>(exp), ": at least ", lowest, " dB, at most ", 255 * largest,
                "/255 off the host");
      }
    }
    frame.splats.check_guards();
  }
}

TEST_CASE("packed pixels are the float ones, converted as on the host, with them and alone") {
  if (!device_answers()) return;
  const int width = 83, height = 41;
  const auto n = static_cast<std::size_t>(width * height);
  Random random(403);
  std::vector<cuda::ScreenSplat> splats;
  for (int i = 0; i < sized(300, 300, 40); ++i) {  // colours from 0 to beyond FP16's range
    const auto conic = conic_of(random.log_uniform(0.7, 40), random.log_uniform(0.7, 40), random.uniform(0, 3));
    splats.push_back(
        screen_splat({static_cast<float>(random.uniform(0, width)), static_cast<float>(random.uniform(0, height))},
                     conic, static_cast<float>(random.uniform(0.01, 1)),
                     {static_cast<float>(random.uniform(0, 1.2)), static_cast<float>(random.log_uniform(1e-9, 1)),
                      static_cast<float>(random.log_uniform(1e-3, i % 10 == 0 ? 1e6 : 1.5))}));
  }
  const HandMade lists(splats, width, height);
  std::uint64_t n_variants = 0;
  for (const auto exponent : {Exponent::direct, Exponent::folded}) {
    for (const auto exp : {Exp::exact, Exp::paper, Exp::zero_mean}) {
      for (const int pixels : {1, 2}) {
        for (const bool details : {false, true}) {
          for (const auto format : {math::PixelFormat::rgba8, math::PixelFormat::rgba16f}) {
            const DeviceArray<float> rgb(3 * n), alpha(n), depth(n);
            const DeviceArray<std::byte> beside(n * math::pixel_bytes(format)), alone(n * math::pixel_bytes(format));
            const auto blend = [&](cuda::PixelArrays target) {
              target.depth = details ? depth.data() : nullptr;
              target.format = format;
              require_ok(cuda::launch_blend({lists.input().ranges,
                                             lists.input().gaussians,
                                             lists.input().splats,
                                             math::tile_grid(width, height),
                                             width,
                                             height,
                                             {0.1F, -0.2F, 0.7F},
                                             target.with_pitches(width),
                                             nullptr,
                                             exponent,
                                             exp,
                                             pixels},
                                            nullptr));
            };
            blend({{.rgb = rgb.data(), .alpha = alpha.data(), .packed = beside.data()}});
            blend({{.packed = alone.data()}});
            const auto colors = rgb.download(), alphas = alpha.download();
            const auto packed = beside.download();
            CHECK(alone.download() == packed);
            std::uint64_t n_wrong = 0;
            for (std::size_t i = 0; i < n; ++i) {
              const math::Vec3<float> color{colors[3 * i], colors[3 * i + 1], colors[3 * i + 2]};
              if (format == math::PixelFormat::rgba8) {
                const std::uint32_t expected = math::pack_rgba8(color, alphas[i]);
                n_wrong += std::memcmp(&expected, packed.data() + 4 * i, 4) != 0;
              } else {
                const std::uint64_t expected = math::pack_rgba16f(color, alphas[i]);
                n_wrong += std::memcmp(&expected, packed.data() + 8 * i, 8) != 0;
              }
            }
            CHECK_MESSAGE(n_wrong == 0, n_wrong, " of ", n, " packed pixels are not the float ones, exponent ",
                          static_cast<int>(exponent), ", exp ", static_cast<int>(exp), ", ", pixels, " a thread");
            ++n_variants;
          }
        }
      }
    }
  }
  CHECK(n_variants == 48);
}

TEST_CASE("outputs that are not requested are not written, and empty tiles show the background") {
  if (!device_answers()) return;
  const DeviceArray<cuda::TileRange> ranges(6);
  require_cuda(cudaMemset(ranges.data(), 0, 6 * sizeof(cuda::TileRange)));
  const DeviceArray<std::uint32_t> gaussians(0);
  const DeviceArray<cuda::ScreenSplat> splats(0);
  const BlendInput input{ranges.data(), gaussians.data(), splats.data(), 41, 20, {0.25F, 0.5F, 1}};
  for (const auto exponent : {Exponent::direct, Exponent::folded}) {
    for (const auto exp : {Exp::exact, Exp::paper}) {
      for (const int pixels : {1, 2}) {
        const DeviceFrame f = blend_on_device(input, exponent, exp, pixels, true);
        for (std::size_t i = 0; i < 41 * 20; ++i) {
          REQUIRE(f.rgb[3 * i] == 0.25F);
          REQUIRE(f.rgb[3 * i + 2] == 1.0F);
          REQUIRE(f.alpha[i] == 0.0F);
          REQUIRE(f.depth[i] == 0.0F);
          REQUIRE(f.evaluated[i] == 0);
        }
        for (int wanted = 0; wanted < 5; ++wanted) {
          const DeviceFrame one = blend_on_device(input, exponent, exp, pixels, false, 1 << wanted);
          CAPTURE(wanted);
          const auto touched = [](const auto& v) {
            return !v.empty() && std::any_of(v.begin(), v.end(), [](auto x) {
              std::uint32_t bits;
              std::memcpy(&bits, &x, sizeof bits);
              return bits != ~0u;
            });
          };
          CHECK(touched(one.rgb) == (wanted == 0));
          CHECK(touched(one.alpha) == (wanted == 1));
          CHECK(touched(one.depth) == (wanted == 2));
          CHECK(touched(one.evaluated) == (wanted == 3));
          CHECK(touched(one.blended) == (wanted == 4));
        }
      }
    }
  }
}
