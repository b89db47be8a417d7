// render_options_test.cpp - how options, declarations and backend determine a frame's settings.
// SPDX-License-Identifier: Apache-2.0
#include "render_options.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <limits>
#include <string>

#include "renderer_fixture.hpp"
#include "rgs/encode.hpp"
#include "rgs/math/blend.hpp"
#include "rgs/math/coverage.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;
using detail::FrameSettings;
using detail::resolve;
using math::AntiAliasing;
using math::DepthOrder;
using math::Exp;
using math::Exponent;
using math::Extent;

namespace {

constexpr Pipeline kPipelines[] = {Pipeline::automatic, Pipeline::baseline, Pipeline::paper, Pipeline::turbo};
constexpr Backend kBackends[] = {Backend::cpu, Backend::cuda};

FrameSettings settings_of(const RenderOptions& options, const std::optional<Declarations>& declared = std::nullopt,
                          Backend backend = Backend::cpu) {
  const auto settings = resolve(options, declared, backend);
  REQUIRE(settings);
  return *settings;
}

Errc refusal(const RenderOptions& options, Backend backend = Backend::cpu) {
  const auto settings = resolve(options, std::nullopt, backend);
  return settings ? Errc::internal : settings.error().code;
}

}  // namespace

TEST_CASE("each pipeline has its arithmetic, and turbo is CUDA's default") {
  struct Row {
    Pipeline pipeline;
    Backend backend;
    Extent extent;
    DepthOrder order;
    Exponent exponent;
    Exp exp;
    bool turbo;
  };
  using enum Pipeline;
  const auto cpu = Backend::cpu, cuda = Backend::cuda;
  const auto exact = DepthOrder::exact, quantized = DepthOrder::quantized;
  const Row rows[] = {
      {automatic, cpu, Extent::ellipse, exact, Exponent::direct, Exp::exact, false},
      {automatic, cuda, Extent::ellipse, exact, Exponent::folded, Exp::exact, true},
      {baseline, cpu, Extent::square, exact, Exponent::direct, Exp::exact, false},
      {baseline, cuda, Extent::square, exact, Exponent::direct, Exp::exact, false},
      {paper, cpu, Extent::ellipse, quantized, Exponent::folded, Exp::paper, false},
      {paper, cuda, Extent::ellipse, quantized, Exponent::folded, Exp::paper, false},
      {turbo, cpu, Extent::ellipse, exact, Exponent::folded, Exp::exact, false},
      {turbo, cuda, Extent::ellipse, exact, Exponent::folded, Exp::exact, true},
  };
  for (const Row& row : rows) {
    CAPTURE(static_cast<int>(row.pipeline));
    CAPTURE(static_cast<int>(row.backend));
    const FrameSettings s = settings_of({.pipeline = row.pipeline}, std::nullopt, row.backend);
    CHECK(s.extent == row.extent);
    CHECK(s.depth_order == row.order);
    CHECK(s.exponent == row.exponent);
    CHECK(s.exp == row.exp);
    CHECK(s.cuda.turbo == row.turbo);
    CHECK(s.cuda.tensor_cores == row.turbo);
    const bool is_original = row.pipeline == baseline;
    CHECK(s.cuda.front_end == (is_original ? PaperSteps::FrontEnd::separate : PaperSteps::FrontEnd::fused));
    CHECK(s.cuda.pixels_per_thread == (is_original ? 1 : 2));
  }
}

TEST_CASE(
    "anti-aliasing and low-pass: the option, else the scene's declaration, else classic; 0.3, Mip-Splatting 0.1") {
  const auto declared = [](AaMode mode, float low_pass) {
    Declarations d;
    d.aa_mode = mode, d.low_pass_px2 = low_pass;
    return d;
  };
  struct Row {
    std::optional<Declarations> declared;
    std::optional<AntiAliasing> asked;
    std::optional<float> asked_low_pass;
    AntiAliasing expected;
    float expected_low_pass;
  };
  const auto classic = AntiAliasing::classic, mip = AntiAliasing::mip_splatting;
  const Row rows[] = {
      {{}, {}, {}, classic, 0.3F},
      {{}, mip, {}, mip, 0.1F},
      {{}, {}, 0.1F, classic, 0.1F},
      {declared(AaMode::classic, 0.3F), {}, {}, classic, 0.3F},
      {declared(AaMode::classic, 0.2F), {}, {}, classic, 0.2F},
      {declared(AaMode::classic, 0.2F), mip, 0.0F, mip, 0.0F},
      {declared(AaMode::mip_splatting, 0.3F), {}, {}, mip, 0.3F},
      {declared(AaMode::mip_splatting, 0.1F), {}, {}, mip, 0.1F},
      {declared(AaMode::mip_splatting, 0.1F), classic, {}, classic, 0.3F},
      {declared(AaMode::mip_splatting, 0.2F), mip, {}, mip, 0.2F},
      {declared(AaMode::classic, 0.2F), mip, {}, mip, 0.1F},
      {declared(AaMode::undeclared, 0.2F), mip, {}, mip, 0.1F},
      {declared(AaMode::mip_splatting, 0.1F), {}, 0.5F, mip, 0.5F},
      {declared(AaMode::undeclared, 0.1F), {}, {}, classic, 0.3F},
      {declared(AaMode::undeclared, 0.1F), mip, 0.2F, mip, 0.2F},
  };
  for (const Row& row : rows) {
    CAPTURE(&row - rows);
    for (const Pipeline pipeline : kPipelines) {
      for (const Backend backend : kBackends) {
        const RenderOptions options{.low_pass = row.asked_low_pass, .anti_aliasing = row.asked, .pipeline = pipeline};
        const FrameSettings s = settings_of(options, row.declared, backend);
        CHECK(s.anti_aliasing == row.expected);
        CHECK(s.low_pass == row.expected_low_pass);
        // Resolved settings resolve to themselves.
        const FrameSettings again =
            settings_of(with_declarations(options, row.declared), declared(AaMode::mip_splatting, 7), backend);
        CHECK(again.anti_aliasing == row.expected);
        CHECK(again.low_pass == row.expected_low_pass);
      }
    }
  }
}

TEST_CASE("the paper's key takes range and mapping from the options, else the scene, else the paper") {
  Declarations d;
  d.depth_mapping = DepthMapping::logarithmic;
  d.z_near = 1, d.z_far = 9;
  FrameSettings s = settings_of({.pipeline = Pipeline::paper});
  CHECK(s.depth_mapping == DepthMapping::linear);
  CHECK(s.depth_range == std::array{0.2F, 100.0F});
  s = settings_of({.pipeline = Pipeline::paper}, d);
  CHECK(s.depth_mapping == DepthMapping::logarithmic);
  CHECK(s.depth_range == std::array{1.0F, 9.0F});
  const PaperSteps steps{.depth_mapping = DepthMapping::linear, .depth_bits = 12, .depth_range = {{2, 3}}};
  s = settings_of({.pipeline = Pipeline::paper, .paper = steps}, d);
  CHECK(s.depth_mapping == DepthMapping::linear);
  CHECK(s.depth_range == std::array{2.0F, 3.0F});
  CHECK(s.depth_bits == 12);
}

namespace {

// Relative width of `z`'s bin, searched in the key: FP32 depths of one key are consecutive.
double width_of_bin(const math::DepthQuantizer& q, float z) {
  const std::uint32_t key = math::quantize_depth(q, z);
  const auto end = [&](float from, float step) {
    float low = from;
    while (math::quantize_depth(q, low * step) == key) low *= step;
    float high = low * step;
    for (int k = 0; k < 60; ++k) {
      const float middle = 0.5F * (low + high);
      (math::quantize_depth(q, middle) == key ? low : high) = middle;
    }
    return static_cast<double>(low);
  };
  const double first = end(z, 1 - 1e-6F);
  return (end(z, 1 + 1e-6F) - first) / first;
}

}  // namespace

TEST_CASE("the depth resolution is the width of the key's widest bin") {
  struct Row {
    int width, height, bits;  // 0: none requested
    DepthMapping mapping;
    std::array<float, 2> range;
    int expected_bits;
    double expected;
  };
  const auto linear = DepthMapping::linear, log = DepthMapping::logarithmic;
  const Row rows[] = {
      // (far - near) / (2^bits - 1) / near, and (far / near)^(1 / (2^bits - 1)) - 1.
      {1920, 1080, 0, linear, {0.2F, 100}, 19, 9.518e-4},  {1920, 1080, 0, log, {0.2F, 100}, 19, 1.1853e-5},
      {3840, 2160, 0, linear, {0.2F, 100}, 17, 3.8071e-3}, {3840, 2160, 0, log, {0.2F, 100}, 17, 4.7414e-5},
      {1920, 1080, 15, log, {0.2F, 100}, 15, 1.8968e-4},   {1920, 1080, 12, linear, {2, 3}, 12, 1.2210e-4},
      {1920, 1080, 0, log, {0.2F, 193}, 19, 1.3108e-5},    {7680, 4320, 0, log, {0.2F, 100}, 0, 0},
  };
  for (const Row& row : rows) {
    CAPTURE(&row - rows);
    const FrameSettings s =
        settings_of({.pipeline = Pipeline::paper,
                     .paper = {.depth_mapping = row.mapping, .depth_bits = row.bits, .depth_range = row.range}});
    const Camera camera = front_camera(row.width, row.height);
    const auto grid = math::tile_grid(row.width, row.height);
    const auto key =
        math::key_layout(s.depth_order, s.depth_bits, static_cast<std::uint32_t>(grid.columns * grid.rows));
    const int bits = key.quantized ? key.depth_bits : 0;
    CHECK(bits == row.expected_bits);
    const double resolution = detail::depth_resolution(s, bits, camera, std::nullopt);
    CHECK(resolution == doctest::Approx(row.expected).epsilon(1e-4));
    if (bits == 0) continue;
    const auto q = math::make_depth_quantizer(row.mapping, bits, row.range[0], row.range[1]);
    double widest = 0;
    // From the second bin on: all depths before the range share the first.
    for (auto z = static_cast<float>(row.range[0] * (1 + 1.5 * resolution)); z < row.range[1] * 0.99F; z *= 1.05F) {
      widest = std::max(widest, width_of_bin(q, z));
    }
    CHECK(widest == doctest::Approx(resolution).epsilon(0.05));  // FP32 logarithms round the edges of narrow bins
  }
}

TEST_CASE("a scene outside the depth range has the resolution of the end bin that it shares") {
  const FrameSettings s = settings_of({.pipeline = Pipeline::paper, .paper = {.depth_range = {{0.5F, 20}}}});
  const double within = detail::depth_resolution(s, 19, front_camera(64, 48), std::nullopt);
  Declarations d;
  Camera camera = front_camera(64, 48);
  camera.world_to_camera = glm::dmat4(1.);
  const auto at = [&](double ahead) {
    camera.world_to_camera[3] = {0, 0, ahead, 1};
    return detail::depth_resolution(s, 19, camera, d);
  };
  CHECK(at(300) == within);  // no box is declared
  d.robust = {{-1, -1, -3}, {1, 1, 5}};
  CHECK(at(10) == within);
  CHECK(at(18) == within);  // its middle at 19
  CHECK(at(20) == doctest::Approx(25.0 / 20 - 1));
  CHECK(at(300) == doctest::Approx(305.0 / 20 - 1));
  CHECK(at(-0.7) == doctest::Approx(0.5 / 0.2 - 1));  // its middle at 0.3, its front before the near plane
  CHECK(at(-2) == within);                            // mostly behind the camera
  // The world's origin belongs to the box.
  d.origin = {0, 0, 1000};
  CHECK(at(-990) == within);
  CHECK(at(0) == doctest::Approx(1005.0 / 20 - 1));
}

TEST_CASE("frames report their depth resolution, and 0 for exact order") {
  const SplatCloud cloud = cloud_of(random_splats(73, 300), 1);
  const Camera camera = front_camera(192, 128);  // 96 tiles: 25 bits
  const RendererOptions cpu{.backend = Backend::cpu};
  const Scene scene = scene_of(cloud);
  CHECK(render(scene, camera, {.pipeline = Pipeline::paper}, cpu).stats.depth_resolution ==
        doctest::Approx(99.8 / (std::exp2(25) - 1) / 0.2));
  CHECK(render(scene, camera, {.pipeline = Pipeline::baseline}, cpu).stats.depth_resolution == 0);
  CHECK(render(scene, camera, {}, cpu).stats.depth_resolution == 0);
  Declarations d;
  d.robust = {{-1, -1, 7}, {1, 1, 9}};
  d.z_far = 1;
  const auto far = Scene::load(cloud, d);
  REQUIRE(far);
  CHECK(render(*far, camera, {.pipeline = Pipeline::paper}, cpu).stats.depth_resolution > 1);
}

TEST_CASE("steps apply to paper alone, turbo's options to turbo alone") {
  const PaperSteps steps{.extent = Extent::square,
                         .depth_bits = 99,
                         .depth_range = {{5, 5}},
                         .exponent = Exponent::direct,
                         .exp = Exp::zero_mean,
                         .front_end = PaperSteps::FrontEnd::separate,
                         .pixels_per_thread = 7,
                         .deterministic = false};
  const TurboOptions turbo{.tensor_cores = false, .asynchronous = true};
  for (const Backend backend : kBackends) {
    for (const Pipeline pipeline : kPipelines) {
      CAPTURE(static_cast<int>(pipeline));
      if (pipeline == Pipeline::paper) {
        CHECK(refusal({.pipeline = pipeline, .paper = steps}, backend) == Errc::bad_argument);
      } else {
        const FrameSettings plain = settings_of({.pipeline = pipeline}, std::nullopt, backend),
                            s = settings_of({.pipeline = pipeline, .paper = steps}, std::nullopt, backend);
        CHECK(s.extent == plain.extent);
        CHECK(s.depth_bits == plain.depth_bits);
        CHECK(s.depth_range == plain.depth_range);
        CHECK(s.exponent == plain.exponent);
        CHECK(s.exp == plain.exp);
        CHECK(s.cuda.front_end == plain.cuda.front_end);
        CHECK(s.cuda.pixels_per_thread == plain.cuda.pixels_per_thread);
        // Turbo's guarantees also hold for scenes that the paper's kernels draw for it.
        CHECK(s.cuda.deterministic);
        CHECK(plain.cuda.deterministic);
      }
      const FrameSettings s = settings_of({.pipeline = pipeline, .turbo = turbo}, std::nullopt, backend);
      CHECK_FALSE(s.cuda.tensor_cores);
      CHECK(s.cuda.asynchronous == s.cuda.turbo);
    }
  }
  // An ablation starts at baseline.
  RenderOptions start{.pipeline = Pipeline::paper};
  start.paper = steps_of({.pipeline = Pipeline::baseline}, Backend::cuda);
  const Scene scene = scene_of(cloud_of(random_splats(71, 500), 1));
  const Camera camera = front_camera(64, 48);
  const RendererOptions cpu{.backend = Backend::cpu};
  CHECK(render(scene, camera, start, cpu).rgb == render(scene, camera, baseline_options(), cpu).rgb);
  CHECK(render(scene, camera, {}, cpu).rgb == render(scene, camera, Arithmetic(), cpu).rgb);
}

TEST_CASE("invalid option values are refused") {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  CHECK(refusal({}) == Errc::internal);  // accepted
  CHECK(refusal({.pipeline = static_cast<Pipeline>(4)}) == Errc::bad_argument);
  CHECK(refusal({.low_pass = nan}) == Errc::bad_argument);
  CHECK(refusal({.low_pass = -0.1F}) == Errc::bad_argument);
  CHECK(refusal({.anti_aliasing = static_cast<AntiAliasing>(2)}) == Errc::bad_argument);
  const auto with = [](PaperSteps steps) { return RenderOptions{.pipeline = Pipeline::paper, .paper = steps}; };
  CHECK(refusal(with({})) == Errc::internal);
  CHECK(refusal(with({.extent = static_cast<Extent>(2)})) == Errc::bad_argument);
  CHECK(refusal(with({.depth_mapping = static_cast<DepthMapping>(0)})) == Errc::bad_argument);
  CHECK(refusal(with({.depth_bits = 33})) == Errc::bad_argument);
  CHECK(refusal(with({.depth_range = {{0, 1}}})) == Errc::bad_argument);
  CHECK(refusal(with({.depth_range = {{1, nan}}})) == Errc::bad_argument);
  CHECK(refusal(with({.pixels_per_thread = 3})) == Errc::bad_argument);
}

TEST_CASE("a scene's declarations determine its picture: a file's, or those passed to load()") {
  Declarations mip;
  mip.aa_mode = AaMode::mip_splatting;
  mip.low_pass_px2 = 0.1F;
  const SplatCloud cloud = cloud_of(random_splats(72, 2000), 1);
  const auto plain = Scene::load(cloud), declared = Scene::load(cloud, mip);
  REQUIRE(plain);
  REQUIRE(declared);
  const Camera camera = front_camera(96, 64);
  const RendererOptions cpu{.backend = Backend::cpu};
  const RenderOptions asked{.low_pass = 0.1F, .anti_aliasing = AntiAliasing::mip_splatting};
  const auto rgb = render(*declared, camera, {}, cpu).rgb;
  CHECK(rgb == render(*plain, camera, asked, cpu).rgb);
  CHECK(rgb != render(*plain, camera, {}, cpu).rgb);
  CHECK(rgb == render(*plain, camera, with_declarations({}, declared->declarations()), cpu).rgb);
  // A file on disk, drawn by a program that ignores declarations: samples/minimal.
  const TemporaryFolder folder;
  EncodeOptions file_options;
  file_options.aa_mode = AaMode::mip_splatting;
  const auto bytes = encode(cloud.view(), file_options);
  REQUIRE(bytes);
  std::ofstream(folder.file("mip.rgs"), std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes->data()), static_cast<std::streamsize>(bytes->size()));
  const auto from_file = Scene::load(folder.file("mip.rgs"));
  REQUIRE(from_file);
  const auto drawn = render(*from_file, camera, {}, cpu).rgb;
  CHECK(drawn == render(*from_file, camera, asked, cpu).rgb);
  CHECK(drawn != render(*from_file, camera, {.low_pass = 0.3F, .anti_aliasing = AntiAliasing::classic}, cpu).rgb);
  const RenderOptions classic{.low_pass = 0.3F, .anti_aliasing = AntiAliasing::classic};
  CHECK(render(*declared, camera, classic, cpu).rgb == render(*plain, camera, {}, cpu).rgb);
}
