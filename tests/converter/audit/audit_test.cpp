// audit_test.cpp - the parts of an audit: pairing, attribute errors, gates, pictures and charts.
// SPDX-License-Identifier: Apache-2.0
#include "audit.hpp"

#include <doctest/doctest.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <numbers>

#include "audit_attributes.hpp"
#include "audit_chart.hpp"
#include "audit_gate.hpp"
#include "audit_json.hpp"
#include "audit_page.hpp"
#include "audit_pairing.hpp"
#include "audit_picture.hpp"
#include "audit_report.hpp"
#include "audit_scenes.hpp"
#include "audit_scenes_fixture.hpp"
#include "audit_text.hpp"
#include "image_file.hpp"
#include "rgs/quantize.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::audit;
using namespace rgs::test;

namespace {

// Source and asset as an audit opens them.
struct Files {
  TemporaryFolder folder;
  PlyFile source;
  MappedFile file;
  FileView asset;

  Files(const SplatCloud& source_cloud, const SplatCloud& asset_cloud, const EncodeOptions& options = {},
        const Origin& source_origin = kNoOrigin)
      : source(PlyFile::open(write_ply(folder.file("a.ply"), source_cloud, source_origin)).value()),
        file(MappedFile::open(write_rgs(folder.file("a.rgs"), asset_cloud, options)).value()),
        asset(FileView::open(file.bytes()).value()) {
    REQUIRE(validate(asset));
  }
  AttributeReport compare() const {
    tool::Progress quiet(tool::Progress::Mode::quiet);
    return compare_attributes(source, asset, pair_gaussians(source, asset, asset.archive()).value(), quiet);
  }
};

const AttributeError& error_of(const AttributeReport& report, const std::string& key) {
  const auto found = std::find_if(report.errors.begin(), report.errors.end(), [&](auto& e) { return e.key == key; });
  REQUIRE(found != report.errors.end());
  return *found;
}

const WorstList& worst_of(const AttributeReport& report, const std::string& key) {
  const auto found = std::find_if(report.worst.begin(), report.worst.end(), [&](auto& w) { return w.key == key; });
  REQUIRE(found != report.worst.end());
  return *found;
}

bool means_agree(const Files& f, const Pairing& pairing) {
  for (std::uint64_t i = 0; i < pairing.source_of.size(); ++i) {
    if (pairing.source_of[i] == kUnpaired) return false;
    Splat a, b;
    f.source.read(pairing.source_of[i], {&a, 1});
    REQUIRE(f.asset.read(i, std::span<Splat>(&b, 1)));
    if (!std::equal(a.mean, a.mean + 3, b.mean)) return false;
  }
  return true;
}

}  // namespace

TEST_CASE("Gaussians are paired by means, by order or by permutation, also where some are missing") {
  SplatCloud cloud = audit_cloud(2000, 1);
  cloud.mean[3 * 77] = std::numeric_limits<float>::quiet_NaN();  // dropped by the encoder
  struct Case {
    EncodeOptions options;
    PairedBy by;
  };
  EncodeOptions order, permutation;
  order.order = Order::input;
  permutation.keep_permutation = true;
  for (const Case& c :
       {Case{{}, PairedBy::means}, Case{order, PairedBy::order}, Case{permutation, PairedBy::permutation}}) {
    const Files files(cloud, cloud, c.options);
    const auto pairing = pair_gaussians(files.source, files.asset, files.asset.archive());
    REQUIRE(pairing);
    CHECK(pairing->by == c.by);
    CHECK(pairing->n_paired == 1999);
    CHECK(means_agree(files, *pairing));
    CHECK(std::find(pairing->source_of.begin(), pairing->source_of.end(), 77U) == pairing->source_of.end());
    const AttributeReport report = files.compare();
    CHECK(pairing->report(2000).n_source_only == 1);
    CHECK(pairing->report(2000).n_asset_only == 0);
    CHECK(error_of(report, "rotation").meaning.max < 0.1);  // a wrong partner would be off by tens of degrees
  }
}

TEST_CASE("a source of doubles is paired with its asset, whatever the asset's origin") {
  const SplatCloud cloud = audit_cloud(2000, 1);
  const Origin place{4.2e6, 1.7e5, 4.8e6};
  EncodeOptions same, beside, none;
  same.origin = place;
  beside.origin = {place[0] + 0.3, place[1] - 16, place[2]};
  SplatCloud moved = cloud, rounded = cloud;
  for (std::size_t i = 0; i < cloud.mean.size(); ++i) {
    const double x = place[i % 3] + static_cast<double>(cloud.mean[i]);
    moved.mean[i] = static_cast<float>(x - beside.origin[i % 3]);
    rounded.mean[i] = static_cast<float>(x);
  }
  struct Case {
    const SplatCloud& asset;
    EncodeOptions options;
    double least, most;  // largest distance of a mean
  };
  for (const Case& c : {Case{cloud, same, 0, 0}, Case{moved, beside, 0, 2e-6}, Case{rounded, none, 0.2, 0.45}}) {
    for (const Order order : {Order::input, Order::morton}) {
      EncodeOptions options = c.options;
      options.order = order;
      const Files files(cloud, c.asset, options, place);
      REQUIRE(files.source.origin() == place);
      const AttributeReport report = files.compare();
      const double largest = error_of(report, "mean").value.max;
      CHECK(largest >= c.least);
      CHECK(largest <= c.most);
      if (order == Order::input || c.least == 0) CHECK(error_of(report, "rotation").meaning.max < 0.1);
      const WorstList& worst = worst_of(report, "rotation");
      REQUIRE_FALSE(worst.gaussians.empty());
      CHECK(std::fabs(worst.gaussians[0].mean[0] - place[0]) <= 1);
      // Mixtures lie where their means do.
      const auto pairing = pair_gaussians(files.source, files.asset, files.asset.archive());
      REQUIRE(pairing);
      CHECK(pairing->n_paired == cloud.size());
      CHECK(mixed_scene(files.source, files.asset, *pairing, Mixture::stored_sh)->origin() == place);
      CHECK(mixed_scene(files.source, files.asset, *pairing, Mixture::stored_geometry)->origin() == options.origin);
      CHECK(source_scene(files.source)->bounds.low[0] > place[0] - 1.01);
    }
  }
}

TEST_CASE("Gaussians at one position are paired in source order") {
  SplatCloud cloud = audit_cloud(300, 0);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) std::copy_n(&cloud.mean[0], 3, &cloud.mean[3 * i]);
  const Files files(cloud, cloud);
  const AttributeReport report = files.compare();
  CHECK(pair_gaussians(files.source, files.asset, files.asset.archive())->n_paired == 300);
  CHECK(error_of(report, "rotation").meaning.max < 0.1);
  CHECK(error_of(report, "opacity").meaning.max < 0.1);
}

TEST_CASE("an archive's Gaussians are paired with the nearest, as its positions in the source say") {
  SplatCloud cloud = audit_cloud(5000, 1);
  for (std::uint64_t i = 0; i < 50; ++i) {  // points, and what is hardly seen, which moves farther than it is large
    for (std::uint64_t k = 0; k < 3; ++k) cloud.log_scale[3 * i + k] = -30;
    cloud.opacity_logit[i] = i % 2 == 0 ? 4.F : -4.F;
  }
  EncodeOptions options;
  options.profile = Profile::archive;
  const Files files(cloud, cloud, options);
  const auto pairing = pair_gaussians(files.source, files.asset, files.asset.archive());
  REQUIRE(pairing);
  CHECK(pairing->by == PairedBy::nearest);
  CHECK(pairing->n_paired == 5000);
  options.keep_permutation = true;
  const Files kept(cloud, cloud, options);
  const auto truth = pair_gaussians(kept.source, kept.asset, kept.asset.archive());
  REQUIRE(truth);
  CHECK(truth->by == PairedBy::permutation);
  std::uint64_t n_wrong = 0;
  for (std::size_t i = 0; i < 5000; ++i) n_wrong += pairing->source_of[i] != truth->source_of[i];
  CHECK(n_wrong < 5);
  // Without the archive's bounds its means are only others.
  CHECK(pair_gaussians(files.source, files.asset, nullptr)->n_paired < 10);
}

TEST_CASE("unrelated files are not paired") {
  const Files files(audit_cloud(100, 0, 1), audit_cloud(100, 0, 2));
  CHECK(pair_gaussians(files.source, files.asset, files.asset.archive())->n_paired == 0);
  EncodeOptions order;
  order.order = Order::input;
  const Files ordered(audit_cloud(100, 0, 1), audit_cloud(100, 0, 2), order);
  CHECK(pair_gaussians(ordered.source, ordered.asset, nullptr)->n_paired == 0);
}

TEST_CASE("attribute errors agree with a plain computation from the decoded files") {
  const SplatCloud cloud = audit_cloud(5000, 3);
  EncodeOptions options;
  options.order = Order::input;
  const Files files(cloud, cloud, options);
  const AttributeReport report = files.compare();

  std::vector<double> green2, levels, scale, opacity, degrees, colour;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    ActivatedSplat stored;
    REQUIRE(files.asset.read(i, std::span<ActivatedSplat>(&stored, 1)));
    const Splat s = cloud.view().splat(i);
    double of_degree = 0, all = 0;
    for (int k = 0; k < 48; ++k) {
      const double e = static_cast<double>(stored.sh[k]) - static_cast<double>(s.sh[k]);
      all += e * e;
      if (k / 3 < 4 || k / 3 > 8 || k % 3 != 1) continue;
      green2.push_back(std::abs(e));
      of_degree += e * e;
    }
    levels.push_back(255 * std::sqrt(of_degree / (4 * std::numbers::pi)));
    colour.push_back(255 * std::sqrt(all / 3 / (4 * std::numbers::pi)));
    for (int k = 0; k < 3; ++k)
      scale.push_back(
          100 * std::abs(static_cast<double>(stored.scale[k]) / std::exp(static_cast<double>(s.log_scale[k])) - 1));
    opacity.push_back(100 * std::abs(static_cast<double>(stored.opacity) -
                                     1 / (1 + std::exp(-static_cast<double>(s.opacity_logit)))));
    // Angle of one rotation times the inverse of the other.
    const float *a = s.rotation, *b = stored.rotation;
    const auto product = [&](int i0, int i1, int i2, int i3, double s1, double s2, double s3) {
      return static_cast<double>(a[0]) * static_cast<double>(b[i0]) +
             s1 * static_cast<double>(a[1]) * static_cast<double>(b[i1]) +
             s2 * static_cast<double>(a[2]) * static_cast<double>(b[i2]) +
             s3 * static_cast<double>(a[3]) * static_cast<double>(b[i3]);
    };
    const double w = product(0, 1, 2, 3, 1, 1, 1), x = product(1, 0, 3, 2, -1, -1, 1),
                 y = product(2, 3, 0, 1, 1, -1, -1), z = product(3, 2, 1, 0, -1, 1, -1);
    degrees.push_back(2 * std::atan2(std::hypot(x, y, z), std::abs(w)) * 180 / std::numbers::pi);
  }
  const auto check = [](const ErrorStatistics& found, std::vector<double> errors, double epsilon) {
    std::sort(errors.begin(), errors.end());
    double sum = 0, squares = 0;
    for (const double e : errors) sum += e, squares += e * e;
    const auto n = static_cast<double>(errors.size());
    CHECK(found.n == errors.size());
    CHECK(found.max == doctest::Approx(errors.back()).epsilon(epsilon));
    CHECK(found.mean == doctest::Approx(sum / n).epsilon(epsilon));
    CHECK(found.rms == doctest::Approx(std::sqrt(squares / n)).epsilon(epsilon));
    const auto check_quantile = [&](double quantile, double share) {
      const double exact = errors[static_cast<std::size_t>(std::ceil(share * n)) - 1];
      CHECK(quantile >= exact * (1 - epsilon));
      CHECK(quantile <= exact * (1 + 1 / 63.0 + epsilon));
    };
    check_quantile(found.p50, 0.5);
    check_quantile(found.p99, 0.99);
    check_quantile(found.p999, 0.999);
  };
  check(error_of(report, "sh2.green").value, green2, 1e-5);
  check(error_of(report, "sh2.green").meaning, levels, 1e-5);
  check(report.colour.meaning, colour, 1e-5);
  check(error_of(report, "scale").meaning, scale, 2e-3);  // percent of a rounding step: a difference of nearby values
  check(error_of(report, "opacity").meaning, opacity, 2e-3);
  check(error_of(report, "rotation").meaning, degrees, 1e-3);
  CHECK(error_of(report, "mean").meaning.max == 0);
  CHECK(error_of(report, "mean").value.n_zero == cloud.size());
  std::uint64_t codes = 0;
  for (const CodeUsage& usage : report.codes) codes += usage.n();
  CHECK(codes == 48 * cloud.size());
}

TEST_CASE("a change of one Gaussian is found, with its index in both files") {
  const SplatCloud cloud = audit_cloud(1500, 2);
  SplatCloud changed = cloud;
  Splat s = changed.view().splat(1234);
  s.rotation[0] = 1, s.rotation[1] = s.rotation[2] = s.rotation[3] = 0;
  changed.set(1234, s);
  SplatCloud turned = changed;
  s.rotation[0] = std::cos(0.1F), s.rotation[3] = std::sin(0.1F);  // 0.2 radians about z
  s.log_scale[1] += std::log(1.5F);
  s.opacity_logit += 1;
  s.sh[3 * 5 + 2] += 0.25F;
  turned.set(1234, s);
  const Files files(turned, changed);  // the source is the rotated one
  const AttributeReport report = files.compare();
  CHECK(error_of(report, "rotation").meaning.max == doctest::Approx(0.2 * 180 / std::numbers::pi).epsilon(1e-3));
  CHECK(error_of(report, "scale").meaning.max == doctest::Approx(100.0 / 3).epsilon(2e-3));
  CHECK(error_of(report, "sh2.blue").value.max == doctest::Approx(0.25).epsilon(0.02));
  CHECK(error_of(report, "sh2.red").value.max < 0.01);
  const auto pairing = pair_gaussians(files.source, files.asset, files.asset.archive());
  for (const char* key : {"rotation", "scale", "opacity", "colour"}) {
    const WorstList& list = worst_of(report, key);
    REQUIRE_FALSE(list.gaussians.empty());
    CHECK(list.gaussians[0].source_index == 1234);
    CHECK(pairing->source_of[list.gaussians[0].asset_index] == 1234);
    CHECK(list.gaussians[0].mean[1] == cloud.mean[3 * 1234 + 1]);
    CHECK(std::is_sorted(list.gaussians.begin(), list.gaussians.end(),
                         [](auto& a, auto& b) { return a.error > b.error; }));
  }
  CHECK(worst_of(report, "mean").gaussians.empty());
}

TEST_CASE("saturation and underflow are counted from the codes") {
  SplatCloud cloud = audit_cloud(64, 0);
  std::fill(cloud.log_scale.begin(), cloud.log_scale.end(), 0.F);
  cloud.log_scale[0] = -20;  // subnormal beside 2^7
  cloud.log_scale[5] = -30;  // flushed
  cloud.log_scale[7] = 5;
  std::fill(cloud.opacity_logit.begin(), cloud.opacity_logit.end(), 0.F);
  cloud.opacity_logit[3] = 15;
  cloud.opacity_logit[4] = -25;
  std::fill(cloud.sh.begin(), cloud.sh.end(), 0.5F);
  cloud.sh[0] = 0.001F;
  cloud.sh[3] = -1;
  const Files files(cloud, cloud);
  const AttributeReport report = files.compare();
  CHECK(report.ranges.scale_subnormal == files.asset.declarations().n_scale_subnormal);
  CHECK(report.ranges.scale_subnormal == 1);
  CHECK(report.ranges.scale_zero == 1);
  CHECK(report.ranges.opacity_one == 1);
  CHECK(report.ranges.opacity_zero == 1);
  CHECK(report.ranges.sh_flushed == 1);
  CHECK(report.ranges.sh_limit == 1 + 2 * 64);  // red: one at -1; green and blue: all at the maximum
  CHECK(report.ranges.sh_clipped == 0);
  CHECK(report.codes[0].count[0] == 1);
  CHECK(report.codes[0].count[254] == 2 * 64);
  CHECK(report.codes[0].used() == 4);
}

TEST_CASE("stripped SH degrees are errors, and the largest legal coefficients do not overflow") {
  const SplatCloud cloud = audit_cloud(400, 3);
  EncodeOptions options;
  options.sh_degree = 1;
  const AttributeReport report = Files(cloud, cloud, options).compare();
  CHECK(error_of(report, "sh3.red").value.max > 0.15);
  CHECK(error_of(report, "sh1.red").value.max < 0.01);
  CHECK(report.codes.size() == 2);
  SplatCloud large = audit_cloud(100, 1);
  large.sh[7] = 127 * kShStepMax;
  const AttributeReport extreme = Files(large, large).compare();
  CHECK(std::isfinite(error_of(extreme, "sh1.green").meaning.rms));
  CHECK(std::isfinite(extreme.colour.meaning.max));
}

TEST_CASE("attribute errors do not depend on the number of threads") {
  const SplatCloud cloud = audit_cloud(20000, 1);
  const Files files(cloud, cloud);
  const auto text = [&] {
    Report report;
    report.attributes = files.compare();
    return audit_json(report);
  };
  const std::string many = text();
  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  CHECK(text() == many);
}

TEST_CASE("gates are parsed, refused, evaluated and named") {
  auto conditions = parse_conditions("psnr=50,largest=3,bytes-per-gaussian=60");
  REQUIRE(conditions);
  REQUIRE(conditions->size() == 3);
  CHECK((*conditions)[0].at_least);
  CHECK_FALSE((*conditions)[1].at_least);
  for (const char* wrong :
       {"", "psnr", "psnr=", "psnr=x", "psnr=50,", "psnr=50x", "speed=1", "psnr=inf", "psnr=nan", "=5"})
    CHECK_FALSE(parse_conditions(wrong));
  CHECK(parse_conditions("speed=1").error().find("speed") != std::string::npos);

  Report report;
  report.size.asset_bytes = 7000;
  report.size.n_asset = 100;
  report.render.emplace();
  report.render->n_rated = 1;
  report.render->psnr = 49.5;
  report.render->largest = 2.F / 255;
  evaluate(*conditions, report);
  CHECK_FALSE(report.gate[0].holds);
  CHECK(report.gate[1].holds);
  CHECK_FALSE(report.gate[2].holds);
  CHECK_FALSE(report.gate_holds());
  CHECK(describe(report.gate[0]) == "psnr 49.5 < 50");
  CHECK(describe(report.gate[2]) == "bytes-per-gaussian 70 > 60");
  CHECK(verdict(report).headline.find("psnr 49.5 < 50") != std::string::npos);
  report.render->psnr = std::numeric_limits<double>::infinity();
  evaluate(*parse_conditions("psnr=50"), report);
  CHECK(report.gate_holds());
  evaluate(*parse_conditions("loss=1"), report);  // no photographs: an unmeasured gate fails
  CHECK_FALSE(report.gate_holds());

  Options options;
  CHECK(unmeasurable(*parse_conditions("loss=0.1"), options).find("--photos") != std::string::npos);
  options.render = false;
  CHECK_FALSE(unmeasurable(*parse_conditions("ssim=0.9"), options).empty());
  CHECK(unmeasurable(*parse_conditions("ratio=3"), options).empty());
}

TEST_CASE("the verdict follows the worst view and says what is missing") {
  Report report;
  report.size.source_bytes = 300;
  report.size.asset_bytes = 100;
  CHECK(verdict(report).grade == Verdict::Grade::unrated);
  report.render.emplace();
  RenderReport& r = *report.render;
  CHECK(verdict(report).grade == Verdict::Grade::unrated);  // pictures, but no view shows the scene
  CHECK(verdict(report).headline == "3.00x smaller, not rated: no view shows the scene");
  r.n_rated = 1;
  r.mse = 1e-6, r.largest = 0, r.worst_ssim = r.ssim = 1;
  r.worst_psnr = r.psnr = std::numeric_limits<double>::infinity();
  CHECK(verdict(report).grade == Verdict::Grade::identical);
  CHECK(verdict(report).headline.starts_with("3.00x smaller"));
  r.psnr = 60;
  const auto grade_at = [&](double worst) {
    r.worst_psnr = worst;
    return verdict(report).grade;
  };
  CHECK(grade_at(55) == Verdict::Grade::lossless);
  CHECK(grade_at(45) == Verdict::Grade::close);
  CHECK(grade_at(35) == Verdict::Grade::visible);
  CHECK(grade_at(25) == Verdict::Grade::poor);
  const auto grade_with = [&](float levels) {
    r.largest = levels / 255;
    return grade_at(55);
  };
  CHECK(grade_with(15.9F) == Verdict::Grade::lossless);
  CHECK(grade_with(16.1F) == Verdict::Grade::close);
  CHECK(grade_with(63.9F) == Verdict::Grade::close);
  CHECK(grade_with(87.8F) == Verdict::Grade::visible);
  CHECK(grade_with(1000) == Verdict::Grade::visible);  // one pixel is no heavy damage
  CHECK(grade_with(std::numeric_limits<float>::quiet_NaN()) == Verdict::Grade::visible);
  CHECK(verdict(report).detail.find("largest difference of a pixel") != std::string::npos);
  r.largest = 0;
  const auto grade_seen = [&](double flip) {
    r.worst_measures[kFlip] = flip;
    return grade_at(55);
  };
  CHECK(grade_seen(0.05) == Verdict::Grade::lossless);
  CHECK(grade_seen(0.051) == Verdict::Grade::close);
  CHECK(grade_seen(0.101) == Verdict::Grade::visible);
  CHECK(grade_seen(0.201) == Verdict::Grade::poor);
  CHECK(verdict(report).detail.find("FLIP reaches 0.201.") != std::string::npos);
  r.worst_measures[kFlip].reset();
  r.worst_ssim = 0.9;
  CHECK(verdict(report).grade == Verdict::Grade::visible);
  CHECK_FALSE(verdict(report).depth_range_misfit);
  report.declarations.emplace();
  report.render->attribution = {{"key", "Sort key quantised", 40, 26.1, 1e-3}};
  CHECK(verdict(report).depth_range_misfit);
  CHECK(verdict(report).detail.find("0.2 to 100, falls to 26.1 dB; convert with --cameras") != std::string::npos);
  report.made_from_source = false;
  report.pairs.n_source_only = 1234;
  CHECK(verdict(report).detail.find("1,234 Gaussians of the source are missing from the asset") != std::string::npos);
  CHECK(verdict(report).detail.find("another file") != std::string::npos);
}

TEST_CASE("a file of equal or larger size is not called smaller") {
  Report report;
  const auto headline = [&](std::uint64_t source, std::uint64_t asset) {
    report.size.source_bytes = source;
    report.size.asset_bytes = asset;
    return verdict(report).headline;
  };
  CHECK(headline(300, 100).starts_with("3.00x smaller;"));
  CHECK(headline(60, 100).starts_with("1.67x larger;"));
  CHECK(headline(100, 100).starts_with("same size;"));
  CHECK(headline(1000, 1001).starts_with("nearly the same size;"));
  CHECK(headline(1000, 0).starts_with("empty;"));
  CHECK(headline(0, 9).starts_with("larger than nothing;"));
  report.size.source_bytes = 60, report.size.asset_bytes = 100;
  CHECK(audit_text(report, "").find("1.67x larger") != std::string::npos);
  CHECK(audit_html(report).find("1.67&times; larger") != std::string::npos);
  CHECK(audit_html(report).find("smaller") == std::string::npos);
  report.size.source_bytes = 100;
  CHECK(audit_html(report).find("<small>same size</small>") != std::string::npos);
}

TEST_CASE("difference maps keep single bad pixels, and the worst regions lie apart") {
  Image a = Image::make(200, 120, 3), b = a;
  for (float& v : b.pixels) v = 0.5F / 255;
  for (int y = 60; y < 80; ++y)
    for (int x = 100; x < 130; ++x) b.at(x, y, 1) = 8.F / 255;
  b.at(3, 110, 2) = -0.5F;  // below what a screen shows
  b.at(7, 5, 0) = 1;
  const Image levels = difference_levels({a, a}, {b, b});
  CHECK(levels.at(7, 5, 0) == 255);
  CHECK(levels.at(3, 110, 0) == doctest::Approx(0.5));
  CHECK(levels.at(110, 70, 0) == doctest::Approx(8));
  const Image small = shrunk_to_largest(levels, 50);
  CHECK(small.width == 50);
  CHECK(small.height == 30);
  CHECK(small.at(1, 1, 0) == 255);
  CHECK(shrunk(levels, 50).at(1, 1, 0) < 20);
  const float top = scale_top({&levels, 1});
  CHECK(top >= 8);
  CHECK(top <= 20);
  CHECK(heat(0).r < 0.01F);
  CHECK(heat(2).g == 1);
  CHECK(heat(0.7F).r > heat(0.3F).r);
  const auto regions = worst_regions({&levels, 1}, 24, 18, 4, 4);
  REQUIRE(regions.size() == 4);
  CHECK(regions[0].x <= 7);
  CHECK(regions[0].y == 0);
  CHECK(regions[1].x + 24 > 100);
  CHECK(regions[1].x < 130);
  for (std::size_t i = 0; i < regions.size(); ++i)
    for (std::size_t k = 0; k < i; ++k)
      CHECK((regions[i].x + 24 <= regions[k].x || regions[k].x + 24 <= regions[i].x ||
             regions[i].y + 18 <= regions[k].y || regions[k].y + 18 <= regions[i].y));
  CHECK(worst_regions({&levels, 1}, 24, 18, 4, 2).size() == 2);
  const Image black = Image::make(40, 40, 1);
  CHECK(worst_regions({&black, 1}, 24, 18, 4, 4).empty());
  const Image sliver = Image::make(1, 1, 1);
  CHECK(worst_regions({&sliver, 1}, 24, 18, 4, 4).empty());
}

TEST_CASE("pictures are lossless data while they fit, and smaller otherwise") {
  SplitMix random(9);
  Image noise = Image::make(160, 120, 3);
  for (float& v : noise.pixels) v = random.dyadic(0, 1);
  bool lossless = false;
  const std::string png = picture_uri(noise, 1'000'000, &lossless);
  CHECK(lossless);
  CHECK(png.starts_with("data:image/png;base64,iVBORw0KGgo"));
  const auto encoded = encode_image(noise, ImageFormat::png);
  CHECK(png.size() == std::string("data:image/png;base64,").size() + (encoded->size() + 2) / 3 * 4);
  const std::string jpeg = picture_uri(noise, 9000, &lossless);
  CHECK_FALSE(lossless);
  CHECK(jpeg.starts_with("data:image/jpeg;base64,/9j/"));
  CHECK(jpeg.size() < 9000 * 4 / 3 + 40);
}

TEST_CASE("charts and pages survive any content") {
  ErrorStatistics none;
  CHECK(error_histogram(none, "levels", "Mean").find("no error") != std::string::npos);
  ErrorStatistics one{10, 0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, -1, {10}};
  const std::string chart = error_histogram(one, "<b>", "a \"quoted\" <label>");
  CHECK(chart.find("<b>") == std::string::npos);
  CHECK(chart.find("&quot;quoted&quot; &lt;label&gt;") != std::string::npos);
  CHECK(chart.find("nan") == std::string::npos);
  CHECK(chart.find("inf") == std::string::npos);
  CodeUsage usage;
  CHECK(code_histogram(usage, "SH").find("0 of 255") != std::string::npos);
  CHECK(html("<script>alert('x') & \"y\"</script>\x1b[31m\xff") ==
        "&lt;script&gt;alert(&#39;x&#39;) &amp; &quot;y&quot;&lt;/script&gt;\\u{1b}[31m\\xff");
}

TEST_CASE("views compared in several batches score as in one") {
  TemporaryFolder folder;
  SplatCloud cloud = audit_cloud(300);
  Options options;
  options.source = write_ply(folder.file("a.ply"), cloud);
  for (float& sh : cloud.sh) sh *= 0.5F;
  options.asset = write_rgs(folder.file("a.rgs"), cloud);
  options.cameras = write_cameras(folder.file("cameras.json"), 3, 48, 36);
  options.backend = Backend::cpu;
  options.attribution = false;
  tool::Progress quiet(tool::Progress::Mode::quiet);
  const auto in_one = run(options, quiet);
  options.picture_bytes = 1;
  const auto each = run(options, quiet);
  REQUIRE((in_one && each));
  CHECK(in_one->render->worst_psnr < 30);
  for (std::size_t i = 0; i < 3; ++i) CHECK(in_one->render->views[i].score.psnr == each->render->views[i].score.psnr);
}
