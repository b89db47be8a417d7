// archive_target_test.cpp - the search for an archive's step, on curves instead of files.
// SPDX-License-Identifier: Apache-2.0
#include "archive_target.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <functional>

using namespace rgs;

namespace {

// PSNR or bytes of a step.
using Curve = std::function<double(double)>;

std::vector<ArchivePass> search(const ArchiveTarget& target, const Curve& psnr, const Curve& bytes,
                                std::uint64_t n = 1000) {
  std::vector<ArchivePass> passes;
  while (const auto step = next_step(target, passes, n)) {
    REQUIRE(passes.size() < kMaxArchivePasses);
    REQUIRE((*step >= 0x1p-4F && *step <= 0x1p6F));
    passes.push_back({*step, static_cast<std::uint64_t>(bytes(*step)), psnr(*step)});
  }
  return passes;
}
double power(double step) {
  return 10'500 * std::pow(step, -0.51);
}

}  // namespace

TEST_CASE("a scene like the model's is done after one pass") {
  const Curve psnr = [](double step) { return 45.2 - 7.5 * std::log(step); };
  const auto by_psnr = search({.psnr = 40, .bytes = {}}, psnr, power);
  REQUIRE(by_psnr.size() == 1);
  CHECK(*by_psnr[0].psnr >= 40);
  const auto by_size = search({.psnr = {}, .bytes = 5000}, psnr, power);
  REQUIRE(by_size.size() == 1);
  CHECK(by_size[0].bytes <= 5000);
}

TEST_CASE("the secant finds the step where a scene is far from the model") {
  for (const double wanted : {30.0, 37.5, 45.0, 50.0}) {
    for (const double offset : {-8.0, -3.0, 3.0, 8.0}) {
      for (const double slope : {4.0, 11.0}) {
        CAPTURE(wanted);
        CAPTURE(offset);
        CAPTURE(slope);
        // Slightly bent.
        const Curve psnr = [&](double step) {
          const double x = std::log(step);
          return 45.2 + offset - slope * x - 0.1 * x * x;
        };
        if (psnr(0x1p-4) < wanted + 1 || psnr(0x1p6) > wanted) continue;  // at no step
        const auto passes = search({.psnr = wanted, .bytes = {}}, psnr, power);
        const ArchivePass* kept = kept_pass({.psnr = wanted, .bytes = {}}, passes);
        REQUIRE(kept != nullptr);
        CHECK(*kept->psnr >= wanted);
        CHECK(*kept->psnr < wanted + 1.5);
      }
    }
  }
  for (const std::uint64_t wanted : {3000U, 6000U, 20'000U}) {
    for (const double head : {0.0, 1500.0}) {
      for (const double factor : {0.5, 2.0}) {
        CAPTURE(wanted);
        CAPTURE(head);
        CAPTURE(factor);
        if (head + factor * power(0x1p6) > static_cast<double>(wanted)) continue;  // at no step
        const auto passes = search(
            {.psnr = {}, .bytes = wanted}, [](double) { return 40; },
            [&](double step) { return head + factor * power(step); });
        const ArchivePass* kept = kept_pass({.psnr = {}, .bytes = wanted}, passes);
        REQUIRE(kept != nullptr);
        CHECK(kept->bytes <= wanted);
        CHECK(static_cast<double>(kept->bytes) > 0.85 * static_cast<double>(wanted));
      }
    }
  }
}

TEST_CASE("the last of three passes aims on the safe side if none has reached the target") {
  const ArchiveTarget target{.psnr = 40, .bytes = {}};
  const std::vector<ArchivePass> missed{{3, 100, 38.0}, {2, 120, 39.9}}, reached{{3, 100, 38.0}, {1.9F, 120, 40.5}};
  const auto line = [](const std::vector<ArchivePass>& p, double step) {
    const double slope = (*p[1].psnr - *p[0].psnr) / std::log(double{p[1].step} / p[0].step);
    return *p[1].psnr + slope * std::log(step / p[1].step);
  };
  CHECK(line(missed, next_step(target, missed, 0).value()) == doctest::Approx(40.5 + 0.05 * 0.1));
  CHECK(line(reached, next_step(target, reached, 0).value()) == doctest::Approx(40.1 + 0.05 * 0.5));
}

TEST_CASE("a search ends at either end of the steps, and keeps nothing that misses the target") {
  const ArchiveTarget psnr{.psnr = 90, .bytes = {}}, size{.psnr = {}, .bytes = 10};
  const Curve flat = [](double) { return 50; };
  auto passes = search(psnr, flat, power);
  REQUIRE(passes.size() == 1);
  CHECK(passes[0].step == 0x1p-4F);
  CHECK(kept_pass(psnr, passes) == nullptr);
  passes = search(size, flat, power);
  REQUIRE(passes.size() == 1);
  CHECK(passes[0].step == 0x1p6F);
  CHECK(kept_pass(size, passes) == nullptr);
  // Identical pictures: as coarse as can be.
  passes = search(
      {.psnr = 40, .bytes = {}}, [](double) { return INFINITY; }, power);
  CHECK(passes.back().step == 0x1p6F);
  // A size without a known count starts at step 1.
  CHECK(next_step(size, {}, 0) == 1.0F);
}

TEST_CASE("the smallest file that reaches the PSNR is kept, and the finest that is small enough") {
  const std::vector<ArchivePass> passes{{1, 300, 45.0}, {2, 200, 40.0}, {3, 150, 39.0}};
  CHECK(kept_pass({.psnr = 40, .bytes = {}}, passes) == &passes[1]);
  CHECK(kept_pass({.psnr = 41, .bytes = {}}, passes) == &passes[0]);
  CHECK(kept_pass({.psnr = {}, .bytes = 200}, passes) == &passes[1]);
  CHECK(kept_pass({.psnr = {}, .bytes = 149}, passes) == nullptr);
}
