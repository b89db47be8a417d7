// audit_video_test.cpp - the frames of a video: curves, worst seconds, and the order and sizes of frames.
// SPDX-License-Identifier: Apache-2.0
#include "audit_video.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "audit_chart.hpp"
#include "audit_scenes_fixture.hpp"
#include "audit_views.hpp"
#include "console.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::audit;
using namespace rgs::test;

namespace {

// Frames "0", "1", ... of these squared errors; a negative one is not rated.
std::vector<ViewResult> frames(const std::vector<double>& mse) {
  std::vector<ViewResult> out;
  for (const double m : mse) {
    ViewResult v{std::to_string(out.size()), 8, 8, m < 0 ? 0.0 : 1.0, {}, {}};
    v.score.mse = m;
    if (!out.empty() && m >= 0 && out.back().rated()) v.score.flicker = 100 * m;
    out.push_back(v);
  }
  return out;
}

Options moving_video(const TemporaryFolder& folder) {
  SplatCloud cloud = audit_cloud(300);
  Options options;
  options.source = write_ply(folder.file("a.ply"), cloud);
  for (float& sh : cloud.sh) sh *= 0.5F;
  options.asset = write_rgs(folder.file("a.rgs"), cloud);
  options.cameras = write_cameras(folder.file("cameras.json"), 4, 48, 36);
  options.backend = Backend::cpu;
  options.attribution = false;
  options.video = true;
  return options;
}

}  // namespace

TEST_CASE("the worst second of a video is the worst run of its frames, without unrated ones") {
  const VideoReport r = video_report(frames({0, 0.01, 0.04, -1, 0.09, 0, 0.01, 0.16}), 3);
  REQUIRE(r.frames.size() == 8);
  REQUIRE(r.curves.size() == 3);
  const Curve &psnr = r.curves[0], &flicker = r.curves[2];
  CHECK(psnr.key == "psnr");
  CHECK(psnr.values[0] == std::numeric_limits<double>::infinity());
  CHECK(psnr.values[1] == doctest::Approx(20));
  CHECK(std::isnan(psnr.values[3]));
  CHECK(psnr.worst == 7);
  CHECK(psnr.second == 2);  // 0.04, not rated, 0.09
  CHECK(psnr.second_mean == doctest::Approx(-10 * std::log10(0.065)));
  CHECK(flicker.key == "flicker");
  CHECK(std::isnan(flicker.values[4]));  // after the unrated one
  CHECK(flicker.worst == 7);
  CHECK(flicker.second == 5);
  CHECK(flicker.second_mean == doctest::Approx(17.0 / 3));
  CHECK(r.flicker.value() == doctest::Approx(22.0 / 5));
  CHECK(r.worst_flicker.value() == doctest::Approx(16));
  CHECK(r.name_of(7) == "7");

  const VideoReport whole = video_report(frames({0.01, 0.03}), 30);  // shorter than a second
  CHECK(whole.curves[0].second == 0);
  CHECK(whole.curves[0].second_mean == doctest::Approx(-10 * std::log10(0.02)));
  const VideoReport one = video_report(frames({0}), 1);
  CHECK_FALSE(one.flicker);
  CHECK(one.curves.size() == 2);
  CHECK(one.curves[0].second_mean == std::numeric_limits<double>::infinity());
}

TEST_CASE("curves of frames survive gaps and infinite values") {
  Curve curve{"psnr", "PSNR", true, {}};
  const double gap = std::numeric_limits<double>::quiet_NaN(), same = std::numeric_limits<double>::infinity();
  for (const std::vector<double>& values :
       {std::vector<double>{gap, 40, same, 30, gap, gap, 50}, {same, same}, {40}, {40, 40}}) {
    curve.values = values;
    const std::string chart = frame_curve(curve, 30, "a \"<label>\"");
    CHECK(chart.find("nan") == std::string::npos);
    CHECK(chart.find("inf") == std::string::npos);
    CHECK(chart.find("<label>") == std::string::npos);
  }
  curve.values = {gap, 40, same, 30, gap, 50};
  const std::string chart = frame_curve(curve, 2, "");
  CHECK(chart.find("d=\"M67.6 59.0h0L129.2 14.0L190.8 104.0M314.0 14.0h0\"") != std::string::npos);
}

TEST_CASE("a video's measures do not depend on batches, and equal scenes do not flicker") {
  const TemporaryFolder folder;
  Options options = moving_video(folder);
  tool::Progress quiet(tool::Progress::Mode::quiet);
  const auto in_one = run(options, quiet);
  options.picture_bytes = 1;
  options.threads = 1;
  const auto each = run(options, quiet);
  REQUIRE((in_one && each));
  CHECK(in_one->render->video->flicker.value() > 0.1);
  CHECK(in_one->render->video->frames == std::vector<std::string>{"a.png", "b.png", "c.png", "d.png"});
  CHECK(in_one->render->video->curves.back().values.size() == 4);
  for (std::size_t i = 1; i < 4; ++i)
    CHECK(in_one->render->video->curves.back().values[i] == each->render->video->curves.back().values[i]);
  const double away[] = {2.5, 3, -50, 3.5, 3};  // one looks elsewhere
  options.cameras = write_cameras(options.cameras, away, 48, 36);
  const auto broken = run(options, quiet);
  REQUIRE(broken);
  const std::vector<double>& flicker = broken->render->video->curves.back().values;
  for (std::size_t i = 0; i < 5; ++i) CHECK(std::isnan(flicker[i]) == (i != 1 && i != 4));
  options.asset = options.source;
  const auto same = run(options, quiet);
  REQUIRE(same);
  CHECK(same->render->video->worst_flicker.value() == 0);
}

TEST_CASE("a video has one size, and all cameras of a file") {
  const TemporaryFolder folder;
  Options options = moving_video(folder);
  const std::string file = read_text(options.cameras);
  std::string sizes = file, many = "[";
  sizes.replace(sizes.rfind("\"width\":48"), 10, "\"width\":40");
  for (int i = 0; i < 9; ++i) many += (i == 0 ? "" : ",") + file.substr(1, file.size() - 2);
  many.replace(many.find("\"test\""), 6, "\"train\"");
  write_text(options.cameras, many + "]");
  CHECK(choose_views(options, {}, kNoOrigin)->size() == 36);
  options.video = false;
  CHECK(choose_views(options, {}, kNoOrigin)->size() == 35);  // --split test
  write_text(options.cameras, sizes);
  CHECK(choose_views(options, {}, kNoOrigin));
  options.video = true;
  CHECK(choose_views(options, {}, kNoOrigin).error().error.code == Errc::bad_argument);
  options.size = {32, 24};
  CHECK(choose_views(options, {}, kNoOrigin));
}
