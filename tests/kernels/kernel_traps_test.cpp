// kernel_traps_test.cpp - details that the paper omits and ports get wrong: one test for each trap of the design.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cstring>
#include <string>

#include "device_fixture.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/math/sh.hpp"
#include "sorted/blend_fixture.hpp"

using namespace rgs;
using namespace rgs::test;
using cuda::ScreenSplat;
using math::DepthOrder;
using math::Exp;
using math::Exponent;

namespace {

struct Variant {
  Exponent exponent;
  Exp exp;
  int pixels_per_thread;
  bool details;  // false with folded, approximate, 2: the paper's kernel

  std::string name() const {
    const char* const exps[] = {"exact", "paper", "zero-mean"};
    return std::string(exponent == Exponent::direct ? "direct" : "folded") + ", exp " + exps[static_cast<int>(exp)] +
           ", " + std::to_string(pixels_per_thread) + " pixels a thread" + (details ? ", details" : "");
  }
};

std::vector<Variant> variants() {
  std::vector<Variant> all;
  for (const auto exponent : {Exponent::direct, Exponent::folded}) {
    for (const auto exp : {Exp::exact, Exp::paper, Exp::zero_mean}) {
      for (const int pixels : {1, 2}) {
        for (const bool details : {false, true}) all.push_back({exponent, exp, pixels, details});
      }
    }
  }
  return all;
}
DeviceFrame blend(const HandMade& splats, const Variant& v) {
  return splats.blend(v.exponent, v.exp, v.pixels_per_thread, v.details);
}

/// 2^p as each variant defines it, in double precision.
double exp2_of(Exp exp, double p) {
  if (exp == Exp::exact) return std::exp2(p);
  const double shifted = p - static_cast<double>(exp == Exp::paper ? math::kSigmaPaper : math::kSigmaZeroMean);
  const double whole = std::floor(shifted);
  return (1 + shifted - whole) * std::exp2(whole);
}

/// log2 of a splat's density at a pixel, by the textbook formula in double precision.
double exact_power(const ScreenSplat& s, int x, int y) {
  const double dx = x - static_cast<double>(s.mean.u), dy = y - static_cast<double>(s.mean.v);
  const double power =
      -0.5 * (s.conic.a * dx * dx + 2 * static_cast<double>(s.conic.b) * dx * dy + s.conic.c * dy * dy);
  return power * 1.4426950408889634;
}
double exact_exponent(const ScreenSplat& s, int x, int y) {
  return std::log2(static_cast<double>(s.opacity)) + exact_power(s, x, y);
}
/// Opacity by variant: folded exponents include the splat's.
double exact_alpha(const ScreenSplat& s, int x, int y, const Variant& v) {
  const double alpha = v.exponent == Exponent::folded ? exp2_of(v.exp, exact_exponent(s, x, y))
                                                      : s.opacity * exp2_of(v.exp, exact_power(s, x, y));
  return std::min(0.99, alpha);
}

/// Compares alphas of an image with one splat to double precision; reports relative errors above `tolerance` with their
/// pixel. Pixels within `tolerance` of the threshold may be drawn or not.
void check_alphas(const ScreenSplat& s, int width, int height, const Variant& v, double tolerance) {
  const DeviceFrame frame = blend(HandMade(std::span(&s, 1), width, height), v);
  double worst = 0;
  std::uint64_t n_wrong = 0;
  int wrong_x = 0, wrong_y = 0;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const double exponent = exact_exponent(s, x, y), threshold = -std::log2(255.0);
      const float alpha =
          frame.alpha[static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)];
      const double drawn = exact_alpha(s, x, y, v);
      const bool near = std::abs(exponent - threshold) < 2 * tolerance;
      const bool zero = alpha == 0 && (near || exponent < threshold);
      // The stored 1 - (1 - alpha) has an error of 2^-25 of its own.
      const double error = zero ? 0 : (std::abs(alpha - drawn) - 0x1p-24) / drawn;
      const bool wrong = !(error <= tolerance) || (!near && exponent < threshold && alpha != 0);
      if (!wrong) worst = std::max(worst, error);
      if (wrong && n_wrong++ == 0) wrong_x = x, wrong_y = y;
    }
  }
  if (n_wrong == 0) return;
  FAIL_CHECK(v.name(), ": ", n_wrong, " pixels are wrong, the first is (", wrong_x, ", ", wrong_y, "): alpha ",
             frame.alpha[static_cast<std::size_t>(wrong_y * width + wrong_x)], ", expected ",
             exact_alpha(s, wrong_x, wrong_y, v), " from exponent ", exact_exponent(s, wrong_x, wrong_y), "; mean ",
             s.mean.u, " ", s.mean.v, " conic ", s.conic.a, " ", s.conic.b, " ", s.conic.c, " opacity ", s.opacity);
}

struct Picture {
  std::vector<float> rgb;
  FrameStats stats;
};
Picture draw(const DeviceScene& scene, const Camera& camera, const RenderOptions& options) {
  auto renderer = CudaRenderer::create();
  require_ok(renderer);
  const DeviceArray<float> rgb(3 * static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height));
  const auto stats = renderer->render(scene, camera, {.rgb = rgb.data()}, options);
  require_ok(stats);
  return {rgb.download(), *stats};
}
template <class Source>
DeviceScene upload(const Source& source) {
  auto scene = DeviceScene::upload(source);
  require_ok(scene);
  return *std::move(scene);
}

}  // namespace

TEST_CASE("trap 1: folded exponents stay exact at 4K, and for a big Gaussian centred 2,000 px away") {
  if (!device_answers()) return;
  const auto [width, height] = small_sizes() ? std::pair(96, 48) : std::pair(3840, 2160);
  const auto right = static_cast<float>(width), bottom = static_cast<float>(height);
  const ScreenSplat cases[] = {
      screen_splat({right - 20.3F, bottom - 11.7F}, conic_of(30, 2, 0.7), 0.9F),  // in the far corner
      screen_splat({right - 5.1F, bottom - 3.4F}, conic_of(0.55, 0.55, 0), 1),    // as small as the low-pass makes them
      screen_splat({right + 2000, bottom / 2 + 2000}, conic_of(1500, 900, 0.6), 0.95F),
      screen_splat({-2000, -1500.5F}, conic_of(1200, 1200, 0), 0.7F),
      screen_splat({right / 2, bottom + 2000}, conic_of(2500, 800, 1.2), 0.99F),
  };
  for (const ScreenSplat& s : cases) {
    for (const Variant& v : variants()) {
      if (v.exponent == Exponent::folded) check_alphas(s, width, height, v, 5e-4);
    }
  }
}

TEST_CASE("trap 2: the conic's off-diagonal counts twice") {
  if (!device_answers()) return;
  // Narrow and rotated: half or double the off-diagonal gives a clearly different ellipse.
  for (const double angle : {0.4, 2.5}) {
    const ScreenSplat s = screen_splat({40.25F, 30.5F}, conic_of(14, 3, angle), 0.8F);
    for (const Variant& v : variants()) check_alphas(s, 83, 61, v, 5e-4);
  }
}

TEST_CASE("trap 3: the exponent is tested, not the exponential: approximations draw the exact variant's pixels") {
  if (!device_answers()) return;
  std::vector<ScreenSplat> splats;
  Random random(701);
  // Faint, so that no pixel stops early and hides later ones.
  for (int i = 0; i < 100; ++i) {
    const auto at = [&random](double low, double high) { return static_cast<float>(random.uniform(low, high)); };
    splats.push_back(screen_splat({at(-20, 148), at(-20, 90)},
                                  conic_of(random.log_uniform(2, 60), random.log_uniform(1, 20), random.uniform(0, 3)),
                                  static_cast<float>(random.log_uniform(0.004, 0.05))));
  }
  const HandMade all(splats, 128, 70);
  std::vector<std::uint64_t> n_near(128 * 70, 0);
  for (int y = 0; y < 70; ++y) {
    for (int x = 0; x < 128; ++x) {
      for (const ScreenSplat& s : splats) {
        n_near[static_cast<std::size_t>(y * 128 + x)] += std::abs(exact_exponent(s, x, y) + std::log2(255.0)) < 1e-4;
      }
    }
  }
  const DeviceFrame exact = blend(all, {Exponent::direct, Exp::exact, 1, true});
  for (const Variant& v : variants()) {
    if (!v.details) continue;
    const DeviceFrame other = blend(all, v);
    std::uint64_t n_different = 0;
    for (std::size_t i = 0; i < n_near.size(); ++i) {
      n_different += other.evaluated[i] != 100;
      n_different += n_near[i] == 0 && other.blended[i] != exact.blended[i];
    }
    CHECK_MESSAGE(n_different == 0, v.name(), ": ", n_different,
                  " pixels count other Gaussians than the exact variant");
  }
}

TEST_CASE("trap 4: the exponential by a shift equals the one by a conversion") {
  if (!device_answers()) return;
  const ScreenSplat s = screen_splat({50.3F, 40.1F}, conic_of(17, 12, 0.3), 0.98F);
  std::vector<ScreenSplat> many;
  Random random(702);
  for (int i = 0; i < 60; ++i) {
    const auto at = [&random](double low, double high) { return static_cast<float>(random.uniform(low, high)); };
    many.push_back(screen_splat({at(0, 100), at(0, 80)},
                                conic_of(random.uniform(3, 40), random.uniform(3, 30), random.uniform(0, 3)),
                                at(0.1, 0.9), {at(0, 1), at(0, 1), at(0, 1)}));
  }
  for (const auto exp : {Exp::paper, Exp::zero_mean}) {
    for (const bool one : {true, false}) {
      const HandMade splats(one ? std::span(&s, 1) : std::span<const ScreenSplat>(many), 101, 80);
      const DeviceFrame shifted = blend(splats, {Exponent::folded, exp, 2, false});
      const DeviceFrame converted = blend(splats, {Exponent::folded, exp, 1, false});
      // 2^-16 of each opacity, and sums of some dozens of them.
      const double error = largest_difference(shifted.rgb, converted.rgb), quality = psnr(shifted.rgb, converted.rgb);
      MESSAGE("by a shift, ", (one ? 1 : 60), " Gaussians: ", quality, " dB, at most ", error, " off");
      CHECK_MESSAGE(error <= (one ? 0x1p-15 : 0x1p-8), "largest difference ", error);
      CHECK_MESSAGE(quality >= (one ? 95 : 85), quality, " dB");
    }
  }
}

TEST_CASE("trap 5: exponents rounded above 0 give 0.99 at most, and opaque Gaussians end a pixel") {
  if (!device_answers()) return;
  const float top = math::kAlphaMax;
  for (const Variant& v : variants()) {
    CAPTURE(v.name());
    // At the mean the exponent is log2(1) up to rounding; needles make the rounding large.
    for (const double minor : {0.5, 0.01, 0.001}) {
      for (int k = 0; k < sized(8, 8, 1); ++k) {
        const float off = 0.0003F * static_cast<float>(k);
        const ScreenSplat s = screen_splat({7 + off, 9 - off}, conic_of(200, minor, 0.3 + 0.2 * k), 1);
        const DeviceFrame f = blend(HandMade(std::span(&s, 1), 16, 16), v);
        const auto ends = std::minmax_element(f.alpha.begin(), f.alpha.end());
        // The shift rounds the clamp up by less than 2^-16.
        CHECK_MESSAGE((*ends.first >= 0 && *ends.second <= top + 0x1p-16F), "alpha ", *ends.first, " .. ", *ends.second,
                      ", minor ", minor, ", k ", k);
      }
    }
    // An exponent above 0 is an opaque pixel, not a hole and not one that stopped before blending.
    for (const float above : {1e-6F, 0.03F, 0.5F, 4.0F}) {
      if (race_sizes() && above != 0.5F) continue;
      if (v.exponent == Exponent::direct) break;  // there the Gaussian alone exceeds 1 and is skipped
      ScreenSplat s = screen_splat({8, 8}, conic_of(1000, 1000, 0), 1);
      s.log2_opacity = above;
      const float alpha = blend(HandMade(std::span(&s, 1), 16, 16), v).alpha[8 * 16 + 8];
      const double expected = std::min(static_cast<double>(top), exp2_of(v.exp, static_cast<double>(above)));
      CHECK_MESSAGE(std::abs(alpha - expected) <= 0x1p-15, "alpha ", alpha, " instead of ", expected, " at exponent ",
                    above);
    }
    // Behind one opaque Gaussian a second is refused where alpha is 0.99: 0.01 * 0.01 < 1e-4 in FP32. At an exponent of
    // 0 the approximations stay below 0.99, so it takes a third.
    const auto flat = conic_of(1000, 1000, 0);
    const ScreenSplat walls[] = {screen_splat({8, 8}, flat, 1, {1, 0, 0}), screen_splat({8, 8}, flat, 1, {0, 1, 0}),
                                 screen_splat({8, 8}, flat, 1, {0, 0, 1})};
    const DeviceFrame f = blend(HandMade(walls, 16, 16), v);
    const double alpha = std::min(static_cast<double>(top), exp2_of(v.exp, 0));
    const double expected[3] = {alpha, v.exp == Exp::exact ? 0 : alpha * (1 - alpha), 0};
    for (std::size_t c = 0; c < 3; ++c) {
      const float found = f.rgb[3 * (8 * 16 + 8) + c];
      CHECK_MESSAGE(std::abs(found - expected[c]) <= 0x1p-15, "channel ", c, " is ", found, " instead of ",
                    expected[c]);
    }
  }
}

TEST_CASE("trap 5: needles whose exponents are all rounding leave every pixel between transparent and opaque") {
  if (!device_answers()) return;
  // Thousands of pixels long, as thin as the low-pass makes them, and askew, so that terms of 1e7 and more cancel.
  std::vector<Splat> splats;
  Random random(707);
  for (int i = 0; i < 40; ++i) {
    Splat s = splat_at(random.uniform(-2, 2), random.uniform(-1, 1), random.uniform(1, 5), 1e-6, 0.6 + 0.0098 * i);
    s.log_scale[0] = static_cast<float>(std::log(random.log_uniform(1, 60)));
    const double half = random.uniform(0, 1.5);
    s.rotation[0] = static_cast<float>(std::cos(half)), s.rotation[3] = static_cast<float>(std::sin(half));
    splats.push_back(s);
  }
  const auto compact = CompactScene::of(cloud_of(splats));
  const DeviceScene scene = upload(compact.file);
  const Camera camera = small_sizes() ? front_camera(150, 80) : front_camera(3840, 2160);
  for (const RenderOptions& options :
       {baseline_options(), paper_options(), turbo_options(), RenderOptions(Arithmetic())}) {
    auto renderer = CudaRenderer::create();
    require_ok(renderer);
    const auto n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
    const DeviceArray<float> rgb(3 * n), alpha(n);
    require_ok(renderer->render(scene, camera, {.rgb = rgb.data(), .alpha = alpha.data()}, options));
    const auto count_outside = [](const std::vector<float>& values) {
      return std::count_if(values.begin(), values.end(), [](float x) { return !(x >= 0 && x <= 1.001F); });
    };
    const auto alphas = alpha.download(), colors = rgb.download();
    CAPTURE(static_cast<int>(options.pipeline));
    CAPTURE(static_cast<int>(options.paper.exp));
    CHECK_MESSAGE(count_outside(alphas) == 0, count_outside(alphas), " alphas are below 0 or above 1, the largest is ",
                  *std::max_element(alphas.begin(), alphas.end()));
    CHECK_MESSAGE(count_outside(colors) == 0, count_outside(colors), " channels are below 0 or above 1");
  }
}

TEST_CASE("trap 6: 32 varying bits are sorted, no constant ones") {
  if (!device_answers()) return;
  const DeviceScene scene = upload(scene_of(cloud_of(random_splats(703, 3000), 1)).view().value());
  struct Case {
    int width, height, tile_bits;
  };
  for (const Case& c : {Case{1, 1, 0}, {16, 16, 0}, {17, 16, 1}, {640, 360, 10}, {1920, 1080, 13}, {3840, 2160, 15}}) {
    if (small_sizes() && c.width > 20) continue;
    CAPTURE(c.width);
    const auto f = draw(scene, front_camera(c.width, c.height), paper_options());
    CHECK(f.stats.key_bits == 32);
    CHECK(f.stats.depth_bits == 32 - c.tile_bits);
    CHECK(draw(scene, front_camera(c.width, c.height), baseline_options()).stats.key_bits == 32 + c.tile_bits);
  }
}

TEST_CASE("trap 6: at 8K too few bits of depth cause exact order, which is reported") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  const DeviceScene scene = upload(scene_of(cloud_of(random_splats(703, 3000), 1)).view().value());
  const Camera eight_k = front_camera(7680, 4320);  // 129,600 tiles: 17 bits, which leave 15
  RenderOptions options = paper_options();
  const auto fallen_back = draw(scene, eight_k, options);
  CHECK(fallen_back.stats.depth_bits == 0);
  CHECK(fallen_back.stats.key_bits == 17 + 32);
  CHECK(fallen_back.stats.depth_resolution == 0);
  options.paper.depth_order = DepthOrder::exact;
  CHECK(draw(scene, eight_k, options).rgb == fallen_back.rgb);
  options.paper.depth_order = DepthOrder::quantized;
  options.paper.depth_bits = 15;  // on request they are used
  const auto coarse = draw(scene, eight_k, options);
  CHECK(coarse.stats.depth_bits == 15);
  CHECK(coarse.stats.key_bits == 32);
}

TEST_CASE("trap 7: Gaussians of one depth are drawn in the order of the scene") {
  if (!device_answers()) return;
  auto splats = random_splats(704, small_sizes() ? 600 : 20000);
  for (Splat& s : splats) {
    for (float& x : s.mean) x *= 3 / std::max(0.5F, std::abs(s.mean[2]));
    s.mean[2] = 3;
  }
  const Scene scene = scene_of(cloud_of(splats, 1));
  const Camera camera = race_sizes() ? front_camera(64, 40) : front_camera(320, 200);
  const DeviceScene uploaded = upload(scene.view().value());
  for (const auto order : {DepthOrder::exact, DepthOrder::quantized}) {
    RenderOptions options = Arithmetic{.depth_order = order};
    const Frame host = render(scene, camera, options, {.backend = Backend::cpu, .simd = false});
    const auto first = draw(uploaded, camera, options);
    CHECK(psnr(first.rgb, host.rgb) >= 70);
    CHECK(largest_difference(first.rgb, host.rgb) <= 2.0 / 255);
    for (int run = 0; run < sized(4, 4, 1); ++run) CHECK(draw(uploaded, camera, options).rgb == first.rgb);
    options.paper.front_end = PaperSteps::FrontEnd::separate;
    CHECK(draw(uploaded, camera, options).rgb == first.rgb);
    const auto turbo = draw(uploaded, camera, turbo_options());
    CHECK(psnr(turbo.rgb, host.rgb) >= 60);
    for (int run = 0; run < 4; ++run) CHECK(draw(uploaded, camera, turbo_options()).rgb == turbo.rgb);
    auto reversed = splats;
    std::reverse(reversed.begin(), reversed.end());
    const Scene backwards = scene_of(cloud_of(reversed, 1));
    const DeviceScene uploaded_backwards = upload(backwards.view().value());
    const Frame other = render(backwards, camera, options, {.backend = Backend::cpu, .simd = false});
    CHECK(psnr(other.rgb, host.rgb) < 60);  // so the test detects order
    CHECK(psnr(draw(uploaded_backwards, camera, options).rgb, other.rgb) >= 70);
    CHECK(psnr(draw(uploaded_backwards, camera, turbo_options()).rgb, other.rgb) >= 60);
  }
}

TEST_CASE("trap 8: with steps per chunk an outlier's SH does not coarsen the rest of the scene") {
  if (!device_answers()) return;
  auto splats = random_splats(705, 4000);
  splats[17].sh[0] = 60, splats[17].mean[2] = 30, splats[17].mean[0] = 500;  // bright and far off to the side
  const auto cloud = cloud_of(splats, 3);
  const Camera camera = race_sizes() ? front_camera(80, 50) : front_camera(320, 200);
  const auto exact = draw(upload(scene_of(cloud).view().value()), camera, Arithmetic());
  double quality[2];
  for (const bool per_chunk : {false, true}) {
    EncodeOptions options;
    options.chunk_step_sets = per_chunk;
    const auto compact = CompactScene::of(cloud, options);
    quality[per_chunk] = psnr(draw(upload(compact.file), camera, Arithmetic()).rgb, exact.rgb);
  }
  MESSAGE("one set of steps: ", quality[0], " dB, one per chunk: ", quality[1], " dB");
  CHECK(quality[1] > quality[0] + 6);
}

TEST_CASE("trap 9: coefficients lie before channels in device memory, in every degree") {
  if (!device_answers()) return;
  for (int degree = 0; degree <= 3; ++degree) {
    const int n = 3 * sh_coefficients(degree);
    std::vector<Splat> splats(static_cast<std::size_t>(n), splat_at(0, 0, 3, 1, 0.5));
    for (int k = 0; k < n; ++k) {
      Splat& s = splats[static_cast<std::size_t>(k)];
      s.mean[0] = 0.7F, s.mean[1] = -0.4F;  // a direction where no basis function vanishes
      s.sh[0] = 0;
      s.sh[k] = -0.25F;
    }
    const auto cloud = cloud_of(splats, degree);
    EncodeOptions encode_options;
    encode_options.order = Order::input;
    const auto compact = CompactScene::of(cloud, encode_options);
    const Scene scene = scene_of(cloud);
    for (const bool is_compact : {false, true}) {
      const auto attributes = is_compact ? DeviceAttributes(compact.file) : DeviceAttributes(scene.view().value());
      const auto v = view_parameters(front_camera(64, 64), {}, degree);
      DeviceArray<ScreenSplat> device(splats.size());
      DeviceArray<std::byte> covers(splats.size() * cuda::cover_bytes());
      DeviceArray<std::uint32_t> tiles(splats.size());
      DeviceArray<cuda::Counters> counters(1);
      require_ok(cuda::launch_project({attributes.get(), static_cast<std::uint32_t>(n), v, math::Extent::ellipse,
                                       device.data(), covers.data(), tiles.data(), counters.data()},
                                      nullptr));
      const auto found = device.download();
      const auto basis = math::sh_basis(degree, math::view_direction(v.view, {0.7F, -0.4F, 3.0F}));
      for (int k = 0; k < n; ++k) {
        const auto& c = found[static_cast<std::size_t>(k)].color;
        const float channels[3] = {c.x, c.y, c.z};
        for (int j = 0; j < 3; ++j) {
          const float expected = 0.5F + (j == k % 3 ? -0.25F * basis.y[k / 3] : 0.0F);
          CHECK_MESSAGE(std::abs(channels[j] - expected) <= 1e-5F, std::string(is_compact ? "compact" : "FP32"),
                        ", degree ", degree, ", coefficient ", k / 3, " of channel ", k % 3, ": channel ", j, " is ",
                        channels[j], " instead of ", expected);
        }
      }
    }
  }
}

TEST_CASE("trap 10: activated FP16 scales keep small Gaussians' size to 2^-11") {
  if (!device_answers()) return;
  std::vector<Splat> splats;
  Random random(706);
  for (int i = 0; i < 2000; ++i) {
    splats.push_back(splat_at(random.uniform(-0.1, 0.1), random.uniform(-0.1, 0.1), 0.5,
                              std::exp(random.uniform(-10.5, -9.5)), 0.9));
  }
  const auto cloud = cloud_of(splats);
  EncodeOptions options;
  options.order = Order::input;
  const auto compact = CompactScene::of(cloud, options);
  const Scene scene = scene_of(cloud);
  const auto v = view_parameters(front_camera(1000, 1000), {.low_pass = 0}, 0);
  const auto project = [&](const DeviceAttributes& attributes) {
    DeviceArray<ScreenSplat> device(splats.size());
    DeviceArray<std::byte> covers(splats.size() * cuda::cover_bytes());
    DeviceArray<std::uint32_t> tiles(splats.size());
    DeviceArray<cuda::Counters> counters(1);
    require_ok(cuda::launch_project({attributes.get(), static_cast<std::uint32_t>(splats.size()), v,
                                     math::Extent::square, device.data(), covers.data(), tiles.data(), counters.data()},
                                    nullptr));
    return device.download();
  };
  const auto fp32 = project(DeviceAttributes(scene.view().value())), fp16 = project(DeviceAttributes(compact.file));
  double worst = 0;
  for (std::size_t i = 0; i < splats.size(); ++i) {
    worst = std::max(worst, std::abs(std::sqrt(1.0 * fp32[i].conic.a / fp16[i].conic.a) - 1));
  }
  MESSAGE("largest relative error of a size: ", worst);
  CHECK(worst <= 0x1p-11 + 1e-5);  // FP16 log-scales would be off by 2^-7 here: 0.4%
}
