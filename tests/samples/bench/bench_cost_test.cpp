// bench_cost_test.cpp - the cost model against figures computed by hand, and the floors that follow.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cstddef>
#include <cstdint>
#include <string>

#include "bench_cost.hpp"
#include "bench_modes.hpp"
#include "bench_sample_report.hpp"

namespace {

using namespace rgs::bench;
using rgs::math::Exp;

// One full screen of one tile: 256 pixels, and 10 Gaussians, of which 4 are visible with 3 pairs.
FrameWork small_work(const Configuration& c) {
  FrameWork w;
  w.stats.gaussians = 10, w.stats.visible = 4, w.stats.instances = 3;
  w.stats.evaluated = 512, w.stats.blended = 100;
  w.stats.key_bits = rgs::steps_of(c.options, rgs::Backend::cuda).depth_order == rgs::math::DepthOrder::exact ? 45 : 32;
  w.options = c.options;
  w.width = w.height = 16;
  w.compact = c.compact;
  w.sh_degree = 3;
  return w;
}

const Cost& of(const StageCosts& costs, Stage stage) {
  return costs[static_cast<std::size_t>(stage)];
}

}  // namespace

TEST_CASE("bytes of the baseline's stages") {
  const StageCosts costs = stage_costs(small_work(make_mode("baseline", {})));
  // Means of 10; rotation, scale, opacity and 48 coefficients of 4, their splats and rectangles; 10 tile counts.
  CHECK(of(costs, Stage::project).bytes == 10 * 12 + 4 * (32 + 192 + 48 + 16) + 10 * 4);
  // Sum: 10 x (4 read, 8 written). Duplication: sums, 4 x (rectangle, a sector for z), 3 pairs of 12. Ranges: 3 keys of
  // 8, one range twice.
  CHECK(of(costs, Stage::bin).bytes == 10 * 12 + 10 * 8 + 4 * (16 + 32) + 3 * 12 + 3 * 8 + 2 * 8);
  // 45 bits: 6 passes that read and write 12 B a pair, and 8 B for the histograms.
  CHECK(of(costs, Stage::sort).bytes == 3 * (8 + 2 * 6 * 12));
  // 512 / 256 = 2 staged: splats and indices; a range; 256 pixels.
  CHECK(of(costs, Stage::blend).bytes == 2 * 48 + 2 * 4 + 8 + 256 * 12);
  CHECK(of(costs, Stage::blend).l2_bytes == 2 * (48 + 4));
  CHECK(sum(costs).bytes == of(costs, Stage::project).bytes + of(costs, Stage::bin).bytes +
                                of(costs, Stage::sort).bytes + of(costs, Stage::blend).bytes);
}

TEST_CASE("bytes of the paper's stages") {
  const StageCosts costs = stage_costs(small_work(make_mode("paper", {})));
  CHECK(of(costs, Stage::project).bytes == 10 * 12 + 4 * (16 + 48 + 48) + 3 * 8);  // pairs of 8
  CHECK(of(costs, Stage::bin).bytes == 3 * 4 + 2 * 8);
  CHECK(of(costs, Stage::sort).bytes == 3 * (4 + 2 * 4 * 8));
}

TEST_CASE("bytes and operations of turbo's stages") {
  FrameWork w = small_work(make_mode("turbo", {}));
  const StageCosts costs = stage_costs(w);
  CHECK(of(costs, Stage::project).bytes == 4 * (12 + 16 + 48 + 48) + 3 * 8);
  // One tile of 32x32: its counts; its list written and read, then written again at the tile's rank.
  CHECK(of(costs, Stage::bin).bytes == 8 + 3 * 16);
  // Three entries; 512 / 128 = 4 Gaussians in cells; the tile's list and its eight cells.
  CHECK(of(costs, Stage::sort).bytes == 3 * 8 + 4 * 4 + 16 + 8 * 16);
  const Cost& blend = of(costs, Stage::blend);
  CHECK(blend.bytes == 4 * 48 + 4 * 4 + 8 * 16 + 256 * 12);
  CHECK(blend.l2_bytes == 4 * (48 + 4));
  CHECK(blend.shared_loads == 512 / 1024.0 * 3);
  CHECK(blend.special == 512);  // an exponential per pair, blended or not
  // 16 pairs of a lane: 38 packed instructions, 7 products and 2 selections over the chains, and the exponentials.
  CHECK(blend.operations == 512 * (47 / 16.0 + 1));
  CHECK(blend.flops == 512 * 5.625);
  // An entry is in at least one cell.
  w.stats.evaluated = 0;
  CHECK(of(stage_costs(w), Stage::sort).bytes == of(costs, Stage::sort).bytes - 4);
  w.stats.evaluated = 512;
  // In FP32: a warp, two words; the exponential outside any branch.
  w.options.turbo.tensor_cores = false;
  const Cost fp32 = of(stage_costs(w), Stage::blend);
  CHECK(fp32.bytes == blend.bytes);
  CHECK(fp32.shared_loads == 4 * 2);
  CHECK(fp32.flops == 512 * 13.5);
  CHECK(fp32.operations == 512 * 10.75);
  CHECK(fp32.special == 512);
  // The other kernels draw scenes too large for it.
  w.stats.gaussians = std::uint64_t{1} << 25;
  w.stats.key_bits = 45;
  CHECK(of(stage_costs(w), Stage::sort).bytes > 0);
}

TEST_CASE("harmonics are read as stored and computed as requested") {
  FrameWork w = small_work(make_mode("paper", {}));
  const Cost full = of(stage_costs(w), Stage::project);
  w.options.sh_degree_limit = 0;
  const Cost limited = of(stage_costs(w), Stage::project);
  CHECK(limited.bytes == full.bytes);
  // Without direction 10, basis 48, and 3 flops for each of the 45 higher coefficients.
  CHECK(full.flops - limited.flops == 4 * (10 + 48 + 3 * 45));
  w.sh_degree = 0;  // 3 codes in one word
  CHECK(of(stage_costs(w), Stage::project).bytes == full.bytes - 4 * (48 - 4));
}

TEST_CASE("operations of a pair") {
  const auto blend = [](Exp exp, rgs::math::Exponent exponent, int pixels, double evaluated, double blended) {
    FrameWork w = small_work(make_mode("paper", {}));
    w.options.paper.exp = exp, w.options.paper.exponent = exponent, w.options.paper.pixels_per_thread = pixels;
    w.stats.evaluated = static_cast<std::uint64_t>(evaluated), w.stats.blended = static_cast<std::uint64_t>(blended);
    return of(stage_costs(w), Stage::blend);
  };
  using rgs::math::Exponent;
  // Two pixels: 5 FMA and 2 FMA + 1 addition, then a maximum and a test.
  const Cost dual = blend(Exp::paper, Exponent::folded, 2, 2, 0);
  CHECK(dual.flops == 15);
  CHECK(dual.operations == 8 + 2);
  CHECK(dual.special == 0);
  CHECK(dual.shared_loads == doctest::Approx(2 * 24.0 / 64 / 16));
  // One pixel: 5 FMA and a test.
  CHECK(blend(Exp::paper, Exponent::folded, 1, 1, 0).operations == 6);
  // The exact exponential follows the test where the exponent is folded, and precedes it where it is not.
  CHECK(blend(Exp::exact, Exponent::folded, 2, 100, 7).special == 7);
  CHECK(blend(Exp::exact, Exponent::direct, 1, 100, 7).special == 100);
  CHECK(blend(Exp::paper, Exponent::folded, 2, 100, 7).special == 0);
  CHECK(blend(Exp::zero_mean, Exponent::direct, 1, 100, 7).special == 7);  // the conversion
  // Blending: 1 - alpha, times T, weight, three FMA.
  CHECK(blend(Exp::exact, Exponent::direct, 1, 0, 1).flops == 9);
  CHECK(blend(Exp::paper, Exponent::folded, 2, 0, 1).flops == 9);
}

TEST_CASE("each step of the ablation lowers its target") {
  const auto report = rgs::test::sample_report();
  const auto& rows = report.sizes[0].rows;
  const StageCosts &baseline = rows[0].costs, &culled = rows[1].costs, &paper = rows[2].costs;
  CHECK(sum(culled).bytes < sum(baseline).bytes / 2);
  CHECK(of(paper, Stage::sort).bytes < 0.5 * of(culled, Stage::sort).bytes);
  CHECK(of(paper, Stage::blend).operations < 0.5 * of(culled, Stage::blend).operations);
}

TEST_CASE("the paper's intensities") {
  // Section III: 400 to 800 flop on 236 B for a Gaussian's projection; ours writes its result as well.
  const auto report = rgs::test::sample_report();
  const Cost& project = of(report.sizes[0].rows[0].costs, Stage::project);
  const double flops = project.flops / 630022;
  CHECK(flops > 300);
  CHECK(flops < 800);
  CHECK(project.intensity() < 3.4);
  CHECK(of(report.sizes[0].rows[0].costs, Stage::blend).intensity() > 82);
}

TEST_CASE("the floor is the largest demand") {
  const rgs::cuda::DeviceRates rates{1e12, 4e12, 2e13, 1e12, 1e10};
  Cost cost;
  CHECK(floor_of(cost, rates).ms == 0);
  cost.bytes = 1e9;
  CHECK(floor_of(cost, rates).ms == doctest::Approx(1));
  CHECK(floor_of(cost, rates).limit == std::string("memory"));
  cost.operations = 4e10;
  CHECK(floor_of(cost, rates).ms == doctest::Approx(2));
  CHECK(floor_of(cost, rates).limit == std::string("FP32"));
  cost.special = 3e9;
  CHECK(floor_of(cost, rates).limit == std::string("special"));
  cost.l2_bytes = 16e9;
  CHECK(floor_of(cost, rates).limit == std::string("L2"));
  cost.shared_loads = 5e7;
  CHECK(floor_of(cost, rates).limit == std::string("shared"));
  CHECK(floor_of(cost, rates).ms == doctest::Approx(5));
}
