// renderer_test.cpp - frames: values, invariants, options, robustness, threads, and vectors against the definition.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/renderer.hpp"

#include <doctest/doctest.h>
#include <hwy/targets.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <glm/ext/matrix_transform.hpp>
#include <limits>
#include <numeric>
#include <thread>

#include "instruction_sets.hpp"
#include "random_cloud.hpp"
#include "renderer_fixture.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;
using math::Exp;
using math::Exponent;
using math::Extent;

namespace {

const RendererOptions kScalar{.backend = Backend::cpu, .threads = 1, .simd = false};
const RendererOptions kVector{.backend = Backend::cpu, .threads = 1, .simd = true};

/// Every Gaussian's contribution to one picture or several.
std::vector<Contribution> contributions_of(const Scene& scene, const std::vector<Camera>& cameras,
                                           const RendererOptions& how, const RenderOptions& options = {}) {
  auto renderer = Renderer::create(how);
  REQUIRE(renderer);
  std::vector<Contribution> out(scene.size());
  for (const Camera& camera : cameras) REQUIRE(renderer->render(scene, camera, {.contributions = out}, options));
  return out;
}

}  // namespace

TEST_CASE("pictures of several cameras equal the single ones, in order") {
  const Scene scene = scene_of(cloud_of(random_splats(31, 200), 2));
  auto renderer = Renderer::create(kVector);
  REQUIRE(renderer);
  std::vector<Camera> cameras;
  for (int i = 0; i < 3; ++i) {
    cameras.push_back(front_camera(19, 23));
    cameras.back().fx += i;
  }
  const RenderOptions options{.background = {0.25F, 0.5F, 1}};
  constexpr std::size_t kPixels = 19 * 23, kGuard = 5;
  constexpr float kNothing = -7;
  std::vector<float> rgb(9 * kPixels + kGuard, kNothing), alpha(3 * kPixels + kGuard, kNothing), depth = alpha;
  std::vector<std::uint8_t> codes(9 * kPixels + kGuard, 77);
  const auto stats =
      renderer->render_all(scene, cameras, {rgb.data(), codes.data(), alpha.data(), depth.data()}, options);
  REQUIRE(stats);
  REQUIRE(stats->size() == 3);
  for (std::size_t i = 0; i < 3; ++i) {
    const Frame frame = render(scene, cameras[i], options, kVector);
    CHECK((*stats)[i].instances == frame.stats.instances);
    CHECK(std::ranges::equal(frame.rgb, std::span(rgb).subspan(3 * kPixels * i, 3 * kPixels)));
    CHECK(std::ranges::equal(frame.alpha, std::span(alpha).subspan(kPixels * i, kPixels)));
    CHECK(std::ranges::equal(frame.depth, std::span(depth).subspan(kPixels * i, kPixels)));
    for (std::size_t k = 0; k < 3 * kPixels; ++k) REQUIRE(codes[3 * kPixels * i + k] == to_8bit(frame.rgb[k]));
  }
  for (const auto& array : {rgb, alpha, depth}) {
    CHECK(std::ranges::all_of(std::span(array).last(kGuard), [](float v) { return v == kNothing; }));
  }
  CHECK(std::ranges::all_of(std::span(codes).last(kGuard), [](int code) { return code == 77; }));

  // No camera, codes only.
  const std::vector<std::uint8_t> expected = codes;
  std::ranges::fill(codes, std::uint8_t{77});
  REQUIRE(renderer->render_all(scene, cameras, {.codes = codes.data()}, options));
  CHECK(codes == expected);
  CHECK(renderer->render_all(scene, {}, {.rgb = rgb.data()})->empty());

  const auto code_of = [](const auto& result) {
    REQUIRE_FALSE(result);
    return result.error().code;
  };
  CHECK(code_of(renderer->render_all(scene, cameras, {.rgb = rgb.data(), .on_device = true})) == Errc::unavailable);
  CHECK(code_of(renderer->allocate_on_device(16)) == Errc::unavailable);
  cameras[1].fy = 0;
  CHECK(code_of(renderer->render_all(scene, cameras, {.rgb = rgb.data()})) == Errc::bad_camera);
  cameras[1] = front_camera(19, 22);
  CHECK(code_of(renderer->render_all(scene, cameras, {.rgb = rgb.data()})) == Errc::bad_argument);
}

TEST_CASE("one Gaussian on the axis has the closed form's pixels") {
  const Camera camera = front_camera(33, 33);
  const Scene scene = scene_of(cloud_of(std::vector{splat_at(0, 0, 4, 0.5, 0.8, 0.75F)}));
  const Frame frame = render(scene, camera, {.background = {0.25F, 0.5F, 1}}, kScalar);
  // sigma_px^2 = (f s / z)^2 + 0.3; the mean is at 33/2 - 1/2 = 16, a pixel centre.
  const double f = 0.8 * 33, variance = f * f * 0.25 / 16 + 0.3;
  for (int x = 0; x < 33; ++x) {
    double alpha = std::min(0.99, 0.8 * std::exp(-0.5 * (x - 16) * (x - 16) / variance));
    if (alpha < 1.0 / 255) alpha = 0;
    const auto i = static_cast<std::size_t>(16 * 33 + x);
    CHECK(frame.alpha[i] == doctest::Approx(alpha).epsilon(1e-4));
    CHECK(frame.rgb[3 * i] == doctest::Approx(0.75 * alpha + 0.25 * (1 - alpha)).epsilon(1e-4));
    CHECK(frame.rgb[3 * i + 2] == doctest::Approx(0.5 * alpha + 1 - alpha).epsilon(1e-4));
    CHECK(frame.depth[i] == doctest::Approx(alpha > 0 ? 4 : 0).epsilon(1e-4));
    CHECK(frame.blended[i] == (alpha > 0 ? 1 : 0));
  }
}

TEST_CASE("the nearer Gaussian is in front, of equal depths the first, and opaque ones stop the pixel") {
  const Camera camera = front_camera(16, 16);
  const std::size_t centre = 8 * 16 + 8;
  const Splat red = splat_at(0, 0, 5, 5, 0.9, 1), dark = splat_at(0, 0, 3, 3, 0.9, 0);
  CHECK(render(scene_of(cloud_of(std::vector{red, dark})), camera).rgb[3 * centre] ==
        doctest::Approx(0.09).epsilon(1e-2));
  Splat twin = dark;
  twin.mean[2] = 5;
  CHECK(render(scene_of(cloud_of(std::vector{red, twin})), camera).rgb[3 * centre] ==
        doctest::Approx(0.9).epsilon(1e-2));
  CHECK(render(scene_of(cloud_of(std::vector{twin, red})), camera).rgb[3 * centre] ==
        doctest::Approx(0.09).epsilon(1e-2));
  const std::vector<Splat> wall(10, splat_at(0, 0, 5, 50, 0.999, 1));
  const Frame frame = render(scene_of(cloud_of(wall)), camera);
  // 0.01, then 0.0001 (just above or below 1e-4 by rounding); never a third.
  CHECK(frame.blended[centre] <= 2);
  CHECK(frame.evaluated[centre] == frame.blended[centre] + 1);
  CHECK(frame.alpha[centre] >= 0.99F - 1e-6F);
}

TEST_CASE("moving camera and scene together does not change the image") {
  const auto splats = random_splats(21, 400);
  Random random(22);
  const auto turn = random.rotation();
  const auto motion = rigid(turn, {0.5, -1, 2});
  Camera camera = front_camera(96, 64);
  auto flat = splats;
  for (Splat& s : flat) std::fill(s.sh + 3, s.sh + 48, 0.0F);  // colours that do not rotate
  const Frame a = render(scene_of(cloud_of(flat)), camera);
  for (Splat& s : flat) {
    const auto m = transform(motion, {s.mean[0], s.mean[1], s.mean[2]});
    const auto q = multiply(turn, {s.rotation[0], s.rotation[1], s.rotation[2], s.rotation[3]});
    s.mean[0] = static_cast<float>(m.x), s.mean[1] = static_cast<float>(m.y), s.mean[2] = static_cast<float>(m.z);
    s.rotation[0] = static_cast<float>(q.w), s.rotation[1] = static_cast<float>(q.x);
    s.rotation[2] = static_cast<float>(q.y), s.rotation[3] = static_cast<float>(q.z);
  }
  const auto back = transform(rigid({turn.w, -turn.x, -turn.y, -turn.z}, {0, 0, 0}), {0.5, -1, 2});
  camera.world_to_camera = from_row_major(rigid({turn.w, -turn.x, -turn.y, -turn.z}, {-back.x, -back.y, -back.z}));
  const Frame b = render(scene_of(cloud_of(flat)), camera);
  CHECK(psnr(a.rgb, b.rgb) > 60);
}

TEST_CASE("a scene far from the world's origin gives the same picture as near it") {
  const glm::dvec3 place(4.2e6, 1.7e5, 4.8e6);
  const Camera home = front_camera(160, 120);
  Camera away = home;
  away.world_to_camera = glm::translate(home.world_to_camera, -place);
  const auto splats = random_splats(24, 3000);
  for (const auto& how : {kScalar, kVector}) {
    // Relative to an origin.
    Declarations declared;
    declared.origin = {place.x, place.y, place.z};
    const auto scene = Scene::load(cloud_of(splats, 3), declared);
    REQUIRE(scene);
    CHECK(scene->origin() == declared.origin);
    const Frame a = render(scene_of(cloud_of(splats, 3)), home, {}, how);
    CHECK(psnr(a.rgb, render(*scene, away, {}, how).rgb) > 100);
    // Another origin: means lose their last bits, no more.
    auto beside = splats;
    for (Splat& s : beside) s.mean[0] -= 13;
    declared.origin[0] += 13;
    const auto other = Scene::load(cloud_of(beside, 3), declared);
    REQUIRE(other);
    CHECK(psnr(a.rgb, render(*other, away, {}, how).rgb) > 80);
    // Absolute FP32 positions have steps of 1/2, in both scenes.
    auto rounded = splats, absolute = splats;
    for (std::size_t i = 0; i < splats.size(); ++i) {
      for (int k = 0; k < 3; ++k) {
        absolute[i].mean[k] = static_cast<float>(place[k] + static_cast<double>(splats[i].mean[k]));
        rounded[i].mean[k] = static_cast<float>(static_cast<double>(absolute[i].mean[k]) - place[k]);
      }
    }
    const Frame b = render(scene_of(cloud_of(rounded, 3)), home, {}, how);
    CHECK(psnr(b.rgb, render(scene_of(cloud_of(absolute, 3)), away, {}, how).rgb) > 100);
  }
  for (const double bad : {std::nan(""), HUGE_VAL, 1.1e12}) {
    Declarations declared;
    declared.origin[2] = bad;
    const auto refused = Scene::load(cloud_of(splats, 3), declared);
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::bad_argument);
  }
}

TEST_CASE("a file's origin is its scene's, kept or expanded") {
  SplitMix random(11);
  EncodeOptions options;
  options.origin = {4.2e6, 1.7e5, 4.8e6};
  const auto bytes = encode(random_cloud(100, 1, random).view(), options).value();
  const auto scene = Scene::load(bytes);
  REQUIRE(scene);
  CHECK(scene->origin() == options.origin);
  CHECK(scene->view()->origin == options.origin);
  CHECK(Scene().origin() == kNoOrigin);
}

TEST_CASE("vectors follow the scalar definition in every arithmetic") {
  const Scene scene = scene_of(cloud_of(random_splats(23, 1500), 3));
  const Camera camera = front_camera(203, 117);  // neither side a multiple of 16
  for (const auto exponent : {Exponent::direct, Exponent::folded}) {
    for (const auto exp : {Exp::exact, Exp::paper, Exp::zero_mean}) {
      for (const auto extent : {Extent::square, Extent::ellipse}) {
        CAPTURE(static_cast<int>(exponent));
        CAPTURE(static_cast<int>(exp));
        Arithmetic options{.background = {0.2F, 0.4F, 0.6F}, .extent = extent, .exponent = exponent, .exp = exp};
        const Frame a = render(scene, camera, options, kScalar), b = render(scene, camera, options, kVector);
        CHECK(largest_difference(a.rgb, b.rgb) <= 1.0 / 255);
        CHECK(psnr(a.rgb, b.rgb) >= 70);
        CHECK(largest_difference(a.alpha, b.alpha) <= 1.0 / 255);
        CHECK(largest_difference(a.depth, b.depth) <= 0.1);
        CHECK(a.stats.instances == b.stats.instances);
        const auto close = [](std::uint64_t x, std::uint64_t y) {
          return std::max(x, y) - std::min(x, y) <= 1 + x / 1000;
        };
        CHECK(close(a.stats.evaluated, b.stats.evaluated));
        CHECK(close(a.stats.blended, b.stats.blended));
        for (const Frame* f : {&a, &b}) {
          CHECK(f->stats.evaluated == std::accumulate(f->evaluated.begin(), f->evaluated.end(), std::uint64_t{0}));
          CHECK(f->stats.blended == std::accumulate(f->blended.begin(), f->blended.end(), std::uint64_t{0}));
        }
      }
    }
  }
}

TEST_CASE("every instruction set of the machine follows the definition") {
  const Scene scene = scene_of(cloud_of(random_splats(27, 1500), 1));
  const Camera camera = front_camera(150, 70);
  const Arithmetic options{.exponent = Exponent::folded};
  const Frame expected = render(scene, camera, options, kScalar);
  with_each_instruction_set([&] {
    const Frame frame = render(scene, camera, options, kVector);
    CAPTURE(hwy::TargetName(hwy::SupportedTargets()));
    CHECK(largest_difference(frame.rgb, expected.rgb) <= 1.0 / 255);
    CHECK(psnr(frame.rgb, expected.rgb) >= 70);
  });
}

TEST_CASE("the number of threads changes nothing, and a renderer can be reused for another scene and size") {
  const Scene scene = scene_of(cloud_of(random_splats(24, 60000), 1));
  const Camera camera = front_camera(160, 120);
  const Frame one = render(scene, camera, {}, {.threads = 1});
  auto many = Renderer::create({.threads = 4});
  REQUIRE(many);
  for (int repeat = 0; repeat < 3; ++repeat) {
    Frame frame = Frame::of(camera);
    REQUIRE(many->render(scene, camera, frame.target()));
    CHECK(frame.rgb == one.rgb);
    CHECK(frame.blended == one.blended);
    const Camera other = front_camera(40 + 100 * repeat, 30);
    Frame small = Frame::of(other);
    REQUIRE(many->render(Scene(), other, small.target()));
    CHECK(small.alpha == std::vector<float>(small.alpha.size(), 0.0F));
  }
}

TEST_CASE("contributions are the definition's weights and add up to what pixels no longer transmit") {
  const Scene scene = scene_of(cloud_of(random_splats(31, 3000), 0));
  const Camera camera = front_camera(203, 117);  // tiles beyond the edge
  for (const RendererOptions& how : {kScalar, kVector}) {
    const auto all = contributions_of(scene, {camera}, how);
    double sum = 0, opaque = 0;
    for (const Contribution& c : all) sum += c.weight();
    for (const float alpha : render(scene, camera, {}, how).alpha) opaque += alpha;
    CHECK(sum == doctest::Approx(opaque).epsilon(1e-5));
    // Removing a Gaussian's colour removes its weight, times that colour, from the picture.
    const auto most = std::ranges::max_element(all, {}, &Contribution::sum) - all.begin();
    auto splats = random_splats(31, 3000);
    for (Splat& s : splats) std::fill(s.sh, s.sh + 48, -0.5F / 0.28209479F);
    splats[static_cast<std::size_t>(most)].sh[0] = 0.5F / 0.28209479F;  // red 1, all others black
    const Frame alone = render(scene_of(cloud_of(splats, 0)), camera, {}, how);
    double red = 0;
    float brightest = 0;
    for (std::size_t i = 0; i < alone.rgb.size(); i += 3) {
      red += alone.rgb[i];
      brightest = std::max(brightest, alone.rgb[i]);
    }
    const Contribution& c = all[static_cast<std::size_t>(most)];
    CHECK(c.weight() == doctest::Approx(red).epsilon(1e-4));
    CHECK(c.largest == doctest::Approx(brightest).epsilon(1e-5));
  }
}

TEST_CASE("contributions: equal bits for any number of threads, sums over frames, 0 for invisible Gaussians") {
  auto splats = random_splats(32, 3000);
  splats[7].mean[2] = -5;  // behind every camera
  const Scene scene = scene_of(cloud_of(splats, 1));
  const std::vector<Camera> views{front_camera(160, 120), front_camera(97, 64)};
  const auto bits = [](const std::vector<Contribution>& all) {
    std::vector<std::pair<std::uint64_t, float>> out;
    for (const Contribution& c : all) out.emplace_back(c.sum, c.largest);
    return out;
  };
  const auto one = contributions_of(scene, views, {.backend = Backend::cpu, .threads = 1});
  for (const int threads : {2, 4}) {
    CHECK(bits(contributions_of(scene, views, {.backend = Backend::cpu, .threads = threads})) == bits(one));
  }
  CHECK(one[7].sum == 0);
  CHECK(one[7].largest == 0);
  const auto first = contributions_of(scene, {views[0]}, kVector),
             second = contributions_of(scene, {views[1]}, kVector);
  std::size_t n_in_both = 0;
  for (std::size_t i = 0; i < one.size(); ++i) {
    CHECK(one[i].sum == first[i].sum + second[i].sum);
    CHECK(one[i].largest == std::max(first[i].largest, second[i].largest));
    if (first[i].sum > 0 && second[i].sum > 0) ++n_in_both;
  }
  CHECK(n_in_both > 100);
  // Counting beside the picture does not change it.
  Frame frame = Frame::of(views[0]);
  auto renderer = Renderer::create(kVector);
  REQUIRE(renderer);
  std::vector<Contribution> counted(scene.size());
  RenderTarget target = frame.target();
  target.contributions = counted;
  REQUIRE(renderer->render(scene, views[0], target));
  CHECK(frame.rgb == render(scene, views[0], {}, kVector).rgb);
  CHECK(bits(counted) == bits(first));
}

TEST_CASE("contributions: vectors follow the definition in every arithmetic") {
  const Scene scene = scene_of(cloud_of(random_splats(33, 1500), 0));
  const Camera camera = front_camera(203, 117);
  for (const auto exponent : {Exponent::direct, Exponent::folded}) {
    for (const auto exp : {Exp::exact, Exp::paper, Exp::zero_mean}) {
      const Arithmetic options{.exponent = exponent, .exp = exp};
      const auto a = contributions_of(scene, {camera}, kScalar, options),
                 b = contributions_of(scene, {camera}, kVector, options);
      double worst = 0;
      for (std::size_t i = 0; i < a.size(); ++i) {
        // A pair at the threshold of 1/255, or beyond a pixel that stopped one pair earlier, counts on one side only.
        const double difference = std::abs(a[i].weight() - b[i].weight());
        worst = std::max(worst, difference / (a[i].weight() + 10));
      }
      CHECK(worst <= 1e-3);
    }
  }
}

TEST_CASE("several renderers share a scene") {
  const Scene scene = scene_of(cloud_of(random_splats(25, 5000), 2));
  const Camera camera = front_camera(96, 96);
  const Frame expected = render(scene, camera);
  std::vector<Frame> frames(3, Frame::of(camera));
  std::vector<std::thread> threads;
  for (Frame& frame : frames) {
    threads.emplace_back([&scene, &camera, &frame] {
      auto renderer = Renderer::create({.threads = 2});
      if (renderer) (void)renderer->render(scene, camera, frame.target());
    });
  }
  for (std::thread& t : threads) t.join();
  for (const Frame& frame : frames) CHECK(frame.rgb == expected.rgb);
}

TEST_CASE("each option has its effect") {
  const Scene scene = scene_of(cloud_of(random_splats(26, 3000), 3));
  const Camera camera = front_camera(192, 128);
  const Frame base = render(scene, camera);
  const auto with = [&](const Arithmetic& options) { return render(scene, camera, options); };

  const Frame square = with({.extent = Extent::square});
  CHECK(square.stats.instances > base.stats.instances);
  CHECK(psnr(square.rgb, base.rgb) > 50);  // the tails between 3 and 3.33 sigma
  CHECK(psnr(with({.exponent = Exponent::folded}).rgb, base.rgb) > 70);
  const double paper = psnr(with({.exp = Exp::paper}).rgb, base.rgb);
  CHECK(paper > 40);
  CHECK(paper < 70);
  CHECK(psnr(with({.exponent = Exponent::folded, .exp = Exp::zero_mean}).rgb, base.rgb) > 40);

  const Frame fine = with({.depth_order = math::DepthOrder::quantized, .depth_bits = 24, .depth_range = {0.2F, 20}});
  const Frame coarse = with({.depth_order = math::DepthOrder::quantized, .depth_bits = 4, .depth_range = {0.2F, 20}});
  CHECK(psnr(fine.rgb, base.rgb) > psnr(coarse.rgb, base.rgb) + 10);
  CHECK(with({.depth_order = math::DepthOrder::quantized}).stats.depth_bits == 32 - 7);  // 12 x 8 tiles
  const Frame log = with({.depth_order = math::DepthOrder::quantized, .depth_mapping = DepthMapping::logarithmic});
  CHECK(psnr(log.rgb, base.rgb) > 60);

  CHECK(with({.sh_degree_limit = 0}).rgb != base.rgb);
  CHECK(with({.near_plane = 5}).stats.visible < base.stats.visible);
  CHECK(with({.far_plane = 5}).stats.visible < base.stats.visible);
  const Frame mip = with({.anti_aliasing = math::AntiAliasing::mip_splatting});
  CHECK(std::accumulate(mip.alpha.begin(), mip.alpha.end(), 0.0) <
        std::accumulate(base.alpha.begin(), base.alpha.end(), 0.0));
  CHECK(with({.low_pass = 2}).rgb != base.rgb);

  std::vector<float> over = base.rgb;
  for (std::size_t i = 0; i < over.size(); ++i) over[i] += 0.5F * (1 - base.alpha[i / 3]);
  CHECK(largest_difference(with({.background = {0.5F, 0.5F, 0.5F}}).rgb, over) < 1e-6);
}

TEST_CASE("alpha and opacity stay in range for opacity 0 and 1") {
  const float inf_logit = 100;
  for (const float l : {-inf_logit, inf_logit}) {
    Splat s = splat_at(0, 0, 4, 1, 0.5);
    s.opacity_logit = l;
    const Scene scene = scene_of(cloud_of(std::vector(20, s)));
    CHECK((scene.view().value().opacity[0] == (l > 0 ? 1.0F : scene.view().value().opacity[0]) &&
           scene.view().value().opacity[0] >= 0));
    for (const auto exponent : {Exponent::direct, Exponent::folded}) {
      for (const bool simd : {false, true}) {
        const Frame f = render(scene, front_camera(40, 40), Arithmetic{.extent = Extent::square, .exponent = exponent},
                               {.simd = simd});
        for (const float a : f.alpha) CHECK((a >= 0 && a <= 1));
        CHECK(f.alpha[20 * 40 + 20] == doctest::Approx(l > 0 ? 0.9999 : 0).epsilon(0.01));
      }
    }
  }
}

TEST_CASE("nothing visible: an empty scene, everything behind the camera, everything beside it") {
  const Camera camera = front_camera(50, 20);
  for (const double z : {-5.0, 0.2, 5.0}) {
    const Scene scene = scene_of(cloud_of(std::vector{splat_at(z > 1 ? 1000 : 0, 0, z, 0.1, 0.9)}));
    const Frame frame = render(scene, camera, {.background = {0.1F, 0.2F, 0.3F}});
    CHECK(frame.stats.visible == 0);
    CHECK(frame.rgb[3 * 500 + 1] == 0.2F);
    CHECK(std::all_of(frame.depth.begin(), frame.depth.end(), [](float v) { return v == 0; }));
  }
  CHECK(render(Scene(), camera).stats.instances == 0);
}

TEST_CASE("images of one pixel and of 8K, the latter under one Gaussian") {
  const Scene scene = scene_of(cloud_of(std::vector{splat_at(0, 0, 1, 1000, 0.5)}));
  const Frame dot = render(scene, front_camera(1, 1));
  CHECK(dot.alpha[0] == doctest::Approx(0.5).epsilon(1e-3));
  for (const auto extent : {Extent::square, Extent::ellipse}) {
    const Camera camera = front_camera(7680, 4320);
    std::vector<float> alpha(7680 * 4320, NAN);
    auto renderer = Renderer::create();
    const auto stats = renderer->render(scene, camera, {.alpha = alpha}, Arithmetic{.extent = extent});
    REQUIRE(stats);
    CHECK(stats->instances == 480 * 270);
    CHECK(alpha.front() == doctest::Approx(0.5).epsilon(1e-3));
    CHECK(alpha.back() == doctest::Approx(0.5).epsilon(1e-3));
  }
}

TEST_CASE("degenerate Gaussians draw something finite or nothing") {
  std::vector<Splat> splats;
  for (const float a : {-200.0F, -20.0F, 0.0F, 20.0F, 60.0F, 200.0F}) {
    for (const float b : {-200.0F, -20.0F, 0.0F, 20.0F, 60.0F, 200.0F}) {
      Splat s = splat_at(0.1, 0.05, 2, 1, 0.7);
      s.log_scale[0] = a, s.log_scale[1] = b, s.log_scale[2] = -5;
      s.rotation[0] = a > 0 ? 0.0F : 1e-30F, s.rotation[1] = 0;  // no direction, or one that underflows
      splats.push_back(s);
      s.mean[0] = 1e30F;
      splats.push_back(s);
      s.mean[0] = 0, s.mean[2] = 0.2000001F;
      splats.push_back(s);
    }
  }
  const Scene scene = scene_of(cloud_of(splats));
  for (const auto extent : {Extent::square, Extent::ellipse}) {
    for (const auto exponent : {Exponent::direct, Exponent::folded}) {
      for (const bool simd : {false, true}) {
        const Frame f = render(scene, front_camera(64, 64),
                               Arithmetic{.low_pass = 0, .extent = extent, .exponent = exponent}, {.simd = simd});
        CHECK(std::all_of(f.rgb.begin(), f.rgb.end(), [](float v) { return v >= 0 && v <= 1.01F; }));
        CHECK(std::all_of(f.depth.begin(), f.depth.end(), [](float v) { return std::isfinite(v); }));
      }
    }
  }
}

namespace {

std::string write_scene(const TemporaryFolder& folder, const SplatCloud& cloud, Profile profile = Profile::direct) {
  EncodeOptions options;
  options.profile = profile;
  const auto bytes = encode(cloud.view(), options);
  REQUIRE(bytes);
  std::string path = folder.file("scene.rgs");
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes->data()), static_cast<std::streamsize>(bytes->size()));
  return path;
}

bool same_arrays(const SceneView& a, const SceneView& b) {
  return a.n == b.n && a.sh_degree == b.sh_degree && std::ranges::equal(a.mean, b.mean) &&
         std::ranges::equal(a.rotation, b.rotation) && std::ranges::equal(a.scale, b.scale) &&
         std::ranges::equal(a.opacity, b.opacity) && std::ranges::equal(a.sh, b.sh);
}

}  // namespace

TEST_CASE("a scene keeps the file that it was loaded from, and its copies share it") {
  const TemporaryFolder folder;
  const SplatCloud cloud = cloud_of(random_splats(61, 100), 1);
  const auto bytes = encode(cloud.view());
  REQUIRE(bytes);
  Scene copy;
  {
    const std::string path = write_scene(folder, cloud);
    const auto scene = Scene::load(path);
    REQUIRE(scene);
    copy = *scene;
    std::filesystem::remove(path);
  }
  REQUIRE(copy.has_file());
  for (int time = 0; time < 2; ++time) {
    const auto data = copy.direct();
    REQUIRE(data);
    CHECK(std::ranges::equal(data->file().bytes(), *bytes));
  }
  const auto borrowed = Scene::load(*bytes);  // the caller's memory may be freed
  REQUIRE(borrowed);
  CHECK_FALSE(borrowed->has_file());
  CHECK(same_arrays(copy.view().value(), borrowed->view().value()));
  CHECK_FALSE(scene_of(cloud).has_file());
  CHECK_FALSE(Scene().has_file());
  CHECK(Scene().view().value().n == 0);
}

TEST_CASE("a file's arrays are made on first use, once for all copies and threads") {
  const TemporaryFolder folder;
  const int n = 50000;
  for (const Profile profile : {Profile::direct, Profile::packed}) {
    CAPTURE(static_cast<int>(profile));
    const auto scene = Scene::load(write_scene(folder, cloud_of(random_splats(62, n), 3), profile));
    REQUIRE(scene);
    CHECK(scene->size() == n);
    CHECK(scene->sh_degree() == 3);
    CHECK(scene->declarations().has_value());
    CHECK(scene->bytes() == (profile == Profile::direct ? 0 : 76 * n));  // coded sections are decoded for validation
    std::vector<Scene> copies(8, *scene);
    std::vector<SceneView> views(8);
    std::vector<std::thread> threads;
    for (std::size_t i = 0; i < 8; ++i) threads.emplace_back([&, i] { views[i] = copies[i].view().value(); });
    for (std::thread& thread : threads) thread.join();
    for (const SceneView& view : views) CHECK(view.mean.data() == views[0].mean.data());
    CHECK(scene->view().value().sh.data() == views[0].sh.data());
    CHECK(scene->bytes() == 236 * n);  // and the decoded sections are freed
    // The file's own attributes remain available and give the same arrays.
    const auto data = scene->direct();
    REQUIRE(data);
    CHECK(data->size() == n);
    CHECK(scene->bytes() == 236 * n);
    std::vector<ActivatedSplat> last(1);
    REQUIRE(data->read(n - 1, last));
    CHECK(std::equal(last[0].sh, last[0].sh + 48, views[0].sh.end() - 48));
  }
}

TEST_CASE("a scene from a file is drawn to the same bytes whether its arrays are made at load or at the first frame") {
  const TemporaryFolder folder;
  const std::string path = write_scene(folder, cloud_of(random_splats(63, 20000), 2), Profile::packed);
  const auto file = MappedFile::open(path);
  REQUIRE(file);
  const auto eager = Scene::load(file->bytes()), lazy = Scene::load(path);
  REQUIRE(eager);
  REQUIRE(lazy);
  CHECK(eager->bytes() == eager->size() * 4 * (11 + 27));
  const auto decoded = decode(file->bytes());  // training parameters, activated
  REQUIRE(decoded);
  const Camera camera = front_camera(203, 117);
  std::vector<Frame> frames(4);
  std::vector<std::thread> threads;
  for (Frame& frame : frames) {
    threads.emplace_back([&] {
      frame = Frame::of(camera);
      (void)Renderer::create({.backend = Backend::cpu, .threads = 2})->render(*lazy, camera, frame.target());
    });
  }
  for (std::thread& thread : threads) thread.join();
  const Frame expected = render(*eager, camera, {}, kVector);
  for (const Frame& frame : frames) {
    CHECK(frame.rgb == expected.rgb);
    CHECK(frame.depth == expected.depth);
    CHECK(frame.blended == expected.blended);
  }
  CHECK(psnr(render(scene_of(*decoded), camera, {}, kVector).rgb, expected.rgb) > 80);  // logarithms and back
}

TEST_CASE("the first user of an opened scene validates it") {
  const TemporaryFolder folder;
  const int n = 3000;
  const std::string path = write_scene(folder, cloud_of(random_splats(64, n), 1), Profile::packed);
  const auto loaded = Scene::load(path), opened = Scene::open(path);
  REQUIRE(loaded);
  REQUIRE(opened);
  CHECK(loaded->is_validated());
  CHECK(loaded->is_decoded());
  CHECK_FALSE(opened->is_validated());
  CHECK_FALSE(opened->is_decoded());
  CHECK(opened->size() == n);
  CHECK(opened->sh_degree() == 1);
  CHECK(opened->declarations().has_value());
  CHECK(opened->bytes() == 0);
  REQUIRE(opened->file() != nullptr);
  CHECK(opened->file()->header().n_gaussians == n);
  CHECK(scene_of(cloud_of(random_splats(64, 2))).file() == nullptr);
  CHECK(Scene().file() == nullptr);
  CHECK_FALSE(Scene().is_decoded());
  CHECK(same_arrays(opened->view().value(), loaded->view().value()));
  CHECK(opened->is_validated());

  auto renderer = Renderer::create({.backend = Backend::cpu, .threads = 1});
  REQUIRE(renderer);
  const auto other = Scene::open(path);
  REQUIRE(other);
  REQUIRE(renderer->prepare(*other));
  CHECK(other->is_validated());
  CHECK(other->bytes() == loaded->bytes());
  CHECK(renderer->prepare(Scene()));

  const auto file = MappedFile::open(path);
  REQUIRE(file);
  std::vector<std::byte> damaged(file->bytes().begin(), file->bytes().end());
  damaged[damaged.size() - 100] ^= std::byte{1};
  const std::string damaged_path = folder.file("damaged.rgs");
  std::ofstream(damaged_path, std::ios::binary)
      .write(reinterpret_cast<const char*>(damaged.data()), static_cast<std::streamsize>(damaged.size()));
  const auto expected = Scene::load(damaged_path);
  REQUIRE_FALSE(expected);
  const auto scene = Scene::open(damaged_path);
  REQUIRE(scene);
  const auto check_refused = [&](const auto& result) {
    REQUIRE_FALSE(result);
    CHECK(result.error().code == expected.error().code);
    CHECK(result.error().offset == expected.error().offset);
  };
  for (int time = 0; time < 2; ++time) {
    check_refused(scene->view());
    check_refused(scene->direct());
    check_refused(renderer->prepare(*scene));
    const Camera camera = front_camera(20, 10);
    Frame frame = Frame::of(camera);
    check_refused(renderer->render(*scene, camera, frame.target()));
  }
  CHECK_FALSE(scene->is_validated());
  damaged.resize(100);
  std::ofstream(damaged_path, std::ios::binary | std::ios::trunc)
      .write(reinterpret_cast<const char*>(damaged.data()), static_cast<std::streamsize>(damaged.size()));
  REQUIRE_FALSE(Scene::open(damaged_path));
  CHECK(Scene::open(damaged_path).error().code == Errc::truncated);
}

TEST_CASE("a packed file loads as the direct file's scene") {
  SplitMix random{21};
  const SplatCloud cloud = random_cloud(20000, 3, random);
  EncodeOptions options;
  const auto direct = encode(cloud.view(), options);
  options.profile = Profile::packed;
  const auto packed = encode(cloud.view(), options);
  REQUIRE(direct);
  REQUIRE(packed);
  const auto a = Scene::load(*direct), b = Scene::load(*packed);
  REQUIRE(a);
  REQUIRE(b);
  CHECK(same_arrays(a->view().value(), b->view().value()));
  std::vector<std::byte> damaged = *packed;
  damaged[damaged.size() - 100] ^= std::byte{1};
  REQUIRE_FALSE(Scene::load(damaged));
  CHECK(Scene::load(damaged).error().code == Errc::checksum_mismatch);
}

TEST_CASE("a scene of activated attributes equals its source, and damage is refused with its index") {
  SplitMix random(3);
  const Scene scene = scene_of(random_cloud(50, 2, random));
  const SceneView view = scene.view().value();
  const auto again = Scene::load(view);
  REQUIRE(again);
  CHECK(same_arrays(again->view().value(), view));
  CHECK(again->view()->mean.data() != view.mean.data());
  Declarations declared;
  declared.origin = {1e7, 2, 3};
  CHECK(Scene::load(view, declared)->view()->origin == declared.origin);

  std::vector<float> rotation(view.rotation.begin(), view.rotation.end());
  for (float& q : rotation) q *= 3;
  std::fill_n(&rotation[4], 4, 0.F);
  SceneView turned = view;
  turned.rotation = rotation;
  const auto normalised = Scene::load(turned);
  REQUIRE(normalised);
  CHECK(normalised->view()->rotation[0] == doctest::Approx(view.rotation[0]));
  CHECK(normalised->view()->rotation[4] == 1);

  const auto refused = [&](auto SceneView::*attribute, std::size_t i, float value) {
    const std::span<const float> given = view.*attribute;
    std::vector<float> values(given.begin(), given.end());
    values[i] = value;
    SceneView damaged = view;
    damaged.*attribute = values;
    const auto result = Scene::load(damaged);
    return result ? Error() : result.error();
  };
  CHECK(refused(&SceneView::mean, 3 * 7 + 1, NAN).offset == 7);
  CHECK(refused(&SceneView::scale, 3 * 8, -1e-9F).offset == 8);
  CHECK(refused(&SceneView::scale, 3 * 8, INFINITY).offset == 8);
  CHECK(refused(&SceneView::opacity, 9, 1.001F).offset == 9);
  CHECK(refused(&SceneView::opacity, 9, NAN).code == Errc::bad_value);
  CHECK(refused(&SceneView::rotation, 40, INFINITY).offset == 10);
  CHECK(refused(&SceneView::sh, 0, NAN).offset == 0);
  SceneView short_view = view;
  short_view.opacity = view.opacity.first(49);
  CHECK(Scene::load(short_view).error().code == Errc::bad_argument);
}

TEST_CASE("refusals: cameras, options, targets, scenes, backends") {
  const Scene scene = scene_of(cloud_of(std::vector{splat_at(0, 0, 4, 1, 0.5)}));
  auto renderer = Renderer::create();
  REQUIRE(renderer);
  const Camera good = front_camera(8, 8);
  std::vector<float> alpha(64);
  const auto code = [&](const Camera& camera, const RenderOptions& options = {}) {
    const auto result = renderer->render(scene, camera, {.alpha = alpha}, options);
    return result ? Errc::internal : result.error().code;
  };
  CHECK(code(good) == Errc::internal);  // accepted
  const double nan = std::numeric_limits<double>::quiet_NaN();
  Camera bad = good;
  bad.fx = nan;
  CHECK(code(bad) == Errc::bad_camera);
  bad = good, bad.world_to_camera[3].x = nan;
  CHECK(code(bad) == Errc::bad_camera);
  bad = good, bad.width = 0;
  CHECK(code(bad) == Errc::bad_camera);
  CHECK(code(good, {.near_plane = -1}) == Errc::bad_argument);
  CHECK(code(good, {.far_plane = 0.1F}) == Errc::bad_argument);
  CHECK(code(good, {.sh_degree_limit = 4}) == Errc::bad_argument);
  CHECK(code(good, {.low_pass = NAN}) == Errc::bad_argument);
  CHECK(code(good, Arithmetic{.depth_bits = 33}) == Errc::bad_argument);
  CHECK(code(good, Arithmetic{.depth_range = {5, 5}}) == Errc::bad_argument);
  CHECK(code(good, {.background = {NAN, 0, 0}}) == Errc::bad_argument);
  alpha.resize(63);
  CHECK(code(good) == Errc::bad_argument);
  std::vector<Contribution> two(2);  // of a scene of one
  CHECK(renderer->render(scene, good, {.contributions = two}).error().code == Errc::bad_argument);

  auto cloud = cloud_of(std::vector(5, splat_at(0, 0, 4, 1, 0.5)));
  cloud.mean[3 * 3 + 1] = NAN;
  const auto refused = Scene::load(cloud);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::bad_value);
  CHECK(refused.error().offset == 3);
  cloud.mean.pop_back();
  CHECK(Scene::load(cloud).error().code == Errc::bad_argument);
  CHECK(Renderer::create({.threads = -1}).error().code == Errc::bad_argument);
  CHECK(Renderer::create({.backend = Backend::cpu, .devices = {0}}).error().code == Errc::bad_argument);
  CHECK(Renderer::create({.devices = {0, -1}}).error().code == Errc::bad_argument);
  // Never the CPU instead.
  const auto first = Renderer::create({.devices = {0}});
  CHECK((first ? first->backend() == Backend::cuda : first.error().code == Errc::unavailable));
}
