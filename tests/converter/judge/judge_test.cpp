// judge_test.cpp - planted causes are found and named, with shares that add up.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <tbb/global_control.h>

#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "judge.hpp"
#include "micro_scene_fixture.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// What is found in pictures that have these causes.
judge::Judgement found(const Micro& micro, const std::vector<std::string>& causes, const char* client = nullptr) {
  judge::Rules rules = micro.rules();
  for (const std::string& key : causes) {
    REQUIRE(judge::find_cause(key) != nullptr);
    judge::find_cause(key)->apply(rules);
  }
  return judge::judge(micro.scenes(), micro.shown(rules), micro.rules(),
                      client != nullptr ? judge::find_client(client) : nullptr);
}

double sum_of_shares(const judge::Judgement& judgement) {
  double sum = 0;
  for (const judge::Step& step : judgement.steps) sum += step.share;
  return sum;
}

}  // namespace

TEST_CASE("a single cause is found in the scene that is about it") {
  const std::vector<std::pair<const char*, const char*>> planted = {{"01", "cut-2"},
                                                                    {"01", "cut-to-0"},
                                                                    {"02", "compensated"},
                                                                    {"05", "low-pass-none"},
                                                                    {"05", "low-pass-0.075"},
                                                                    {"06", "not-compensated"},
                                                                    {"07", "near-1"},
                                                                    {"08", "clip-1.2"},
                                                                    {"09", "alpha-any"},
                                                                    {"10", "alpha-full"},
                                                                    {"11", "never-stops"},
                                                                    {"12", "colour-clamped"},
                                                                    {"13", "sh-0"},
                                                                    {"14", "sh-1"},
                                                                    {"15", "sh-2"},
                                                                    {"16", "slope-unclamped"},
                                                                    {"17", "ties-reversed"},
                                                                    {"18", "by-distance"},
                                                                    {"19", "axes-ignored"},
                                                                    {"20", "fp16-world"},
                                                                    {"21", "linear-blend"},
                                                                    {"22", "over-8-bit"},
                                                                    {"23", "principal-point"},
                                                                    {"12", "encoded-twice"},
                                                                    {"22", "8-bit-opacity"},
                                                                    {"03", "cut-3"},
                                                                    {"04", "unsorted"},
                                                                    {"12", "background-white"},
                                                                    {"01", "scale-steps-255"},
                                                                    {"20", "fp32-world"}};
  for (const auto& plant : planted) {
    const std::string number = plant.first, cause = plant.second;
    CAPTURE(number);
    CAPTURE(cause);
    const judge::Judgement judgement = found(micro_fixture(number), {cause});
    REQUIRE(judgement.steps.size() == 1);
    CHECK(std::string(judgement.steps[0].cause->key) == cause);
    CHECK_FALSE(judgement.steps[0].is_known);
    CHECK(judgement.steps[0].share == 1);
    CHECK(judgement.rest == 0);
    CHECK(judgement.mse > 0);
  }
}

TEST_CASE("an order of the camera before is found where a list of cameras turns round") {
  Micro micro = micro_fixture("18");
  Camera behind = micro.scene.cameras.at(0);
  behind.name = "behind";
  // Half a turn about the y axis through (0, 0, 4).
  const glm::dmat4 turn{{-1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, -1, 0}, {0, 0, 8, 1}};
  behind.world_to_camera *= turn;
  micro.scene.cameras.push_back(behind);
  const judge::Judgement judgement = found(micro, {"stale-order"}, "spark");
  REQUIRE(judgement.steps.size() == 1);
  CHECK(std::string(judgement.steps[0].cause->key) == "stale-order");
  CHECK(judgement.steps[0].share == 1);
  CHECK(std::isinf(judgement.views.at(0).psnr));
  CHECK(judgement.views.at(1).psnr < 40);
}

TEST_CASE("shares of several causes add up to what is explained") {
  const judge::Judgement judgement = found(micro_fixture("13"), {"sh-0", "cut-2", "low-pass-none"});
  REQUIRE(judgement.steps.size() >= 2);
  CHECK(judgement.steps[0].share > judgement.steps[1].share);
  CHECK(judgement.rest <= 0.05);
  CHECK(sum_of_shares(judgement) + judgement.rounding + judgement.rest == doctest::Approx(1));
  CHECK(judgement.views.at(0).explained_psnr > judgement.views.at(0).psnr + 10);
}

TEST_CASE("what a program is known for is named in each scene") {
  for (const judge::Client& client : judge::clients()) {
    CAPTURE(std::string(client.name));
    for (const Micro& micro : micro_fixtures()) {
      CAPTURE(micro.scene.name);
      judge::Rules rules = micro.rules();
      for (const std::string_view key : client.causes) judge::find_cause(key)->apply(rules);
      const judge::Judgement judgement = judge::judge(micro.scenes(), micro.shown(rules), micro.rules(), &client);
      CHECK(judgement.named() >= 0.95);
      if (!judgement.steps.empty()) CHECK(judgement.steps[0].is_known);
      for (const judge::Step& step : judgement.steps) CHECK(std::abs(step.share) < 3);
    }
  }
}

TEST_CASE("pictures as defined differ by nothing") {
  const judge::Judgement judgement = found(micro_fixture("13"), {}, "spark");
  CHECK(judgement.mse == 0);
  CHECK(judgement.steps.empty());
  CHECK(judgement.named() == 1);
}

TEST_CASE("what no cause explains is said, rounding apart") {
  const Micro micro = micro_fixture("01");
  auto shown = micro.shown(micro.rules());
  // A square that no Gaussian draws, and steps of one level.
  for (int y = 2; y < 7; ++y)
    for (int x = 2; x < 7; ++x) shown[0].picture.at(x, y, 2) = 1;
  const judge::Judgement square = judge::judge(micro.scenes(), shown, micro.rules(), nullptr);
  CHECK(square.rest > 0.9);
  shown = micro.shown(micro.rules());
  for (std::size_t i = 0; i < shown[0].picture.pixels.size(); i += 5) {
    float& v = shown[0].picture.pixels[i];
    v += v < 0.5F ? 1.0F / 255 : -1.0F / 255;
  }
  const judge::Judgement steps = judge::judge(micro.scenes(), shown, micro.rules(), nullptr);
  CHECK(steps.steps.empty());
  CHECK(steps.rounding == 1);
  CHECK(steps.named() == 1);
}

TEST_CASE("results do not depend on the number of threads") {
  std::vector<double> found_mse;
  for (const std::size_t threads : {1U, 3U}) {
    const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
    const judge::Judgement judgement = found(micro_fixture("15"), {"sh-1", "over-8-bit"}, "babylon");
    for (const judge::Step& step : judgement.steps) found_mse.push_back(step.share);
    found_mse.push_back(judgement.rest);
  }
  REQUIRE(found_mse.size() % 2 == 0);
  for (std::size_t i = 0; i < found_mse.size() / 2; ++i) CHECK(found_mse[i] == found_mse[i + found_mse.size() / 2]);
}
