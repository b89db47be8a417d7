// encode_test.cpp - properties of the encoder: idempotence, order, streaming, damaged input.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/encode.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "archive_bounds.hpp"
#include "random_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/quantize.hpp"
#include "rgs/spatial_order.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr std::uint64_t kSeed = 20261121;
constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kInfinity = std::numeric_limits<float>::infinity();

SceneScan scan_of(const SplatCloud& cloud, const EncodeOptions& options, std::uint64_t first, std::uint64_t last) {
  SceneScan scan(std::min(cloud.sh_degree, options.sh_degree), options.on_bad, true);
  for (std::uint64_t i = first; i < last; ++i) {
    Splat s = cloud.view().splat(i);
    scan.add(s);
  }
  return scan;
}

// No scale of an archive is larger for want of smaller ones; docs/format/ARCHIVE.md "Scales and importance", with a
// margin for the distance, which is that of a cell.
float least_scale(const ArchiveParameters& p, const float mean[3]) {
  double distance = 0;
  for (std::size_t k = 0; k < 3; ++k) {
    const double d = static_cast<double>(mean[k]) - p.centre[k];
    distance += d * d;
  }
  return static_cast<float>(1.1 * std::exp2(p.shape.blur / 65536.0) / 8 *
                            std::sqrt(std::max(distance, p.shape.nearest)));
}

// The robust box of FORMAT.md, by sorting.
Box brute_robust_box(const SplatCloud& cloud) {
  Box box;
  const std::uint64_t n = cloud.size(), outside = n / 200;
  for (std::size_t axis = 0; axis < 3 && n != 0; ++axis) {
    std::vector<std::uint32_t> ordered;
    std::vector<float> values;
    for (std::uint64_t i = 0; i < n; ++i) {
      const float x = cloud.mean[3 * i + axis] == 0 ? 0.f : cloud.mean[3 * i + axis];
      std::uint32_t bits = 0;
      std::memcpy(&bits, &x, 4);
      ordered.push_back((bits >> 31) != 0 ? ~bits : bits ^ 0x80000000u);
      values.push_back(x);
    }
    std::ranges::sort(ordered);
    std::ranges::sort(values);
    const auto number = [](std::uint32_t order) {
      const std::uint32_t bits = (order >> 31) != 0 ? order ^ 0x80000000u : ~order;
      float x = 0;
      std::memcpy(&x, &bits, 4);
      return x;
    };
    box.min[axis] = std::max(values.front(), number(ordered[outside] & 0xFFFF0000u));
    box.max[axis] = std::min(values.back(), number(ordered[n - 1 - outside] | 0xFFFFu));
  }
  return box;
}

EncodeOptions options_of(SplitMix& random) {
  EncodeOptions options;
  options.chunk_size = random.below(2) == 0 ? 32 : 256;
  options.chunk_step_sets = random.below(2) == 0;
  options.order = random.below(2) == 0 ? Order::input : Order::morton;
  return options;
}

}  // namespace

TEST_CASE("encoding a decoded file gives the same bytes") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  for (int round = 0; round < 300; ++round) {
    CAPTURE(round);
    const std::uint64_t sizes[] = {0, 1, 31, 32, 33, 255, 256, 257, 700};
    const SplatCloud cloud = random_cloud(sizes[random.below(9)], static_cast<int>(random.below(4)), random);
    const EncodeOptions options = options_of(random);
    const auto first = encode(cloud.view(), options);
    REQUIRE(first);
    const auto decoded = decode(*first);
    REQUIRE(decoded);
    REQUIRE(decoded->size() == cloud.size());
    const auto second = encode(decoded->view(), options);
    REQUIRE(second);
    const auto difference = std::ranges::mismatch(*first, *second);
    REQUIRE(difference.in1 == first->end());
    REQUIRE(second->size() == first->size());
  }
}

TEST_CASE("a scan does not depend on how its input is split") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  for (int round = 0; round < 20; ++round) {
    SplatCloud cloud = random_cloud(500, 2, random);
    cloud.mean[3] = kNaN;
    const EncodeOptions options;
    const SceneScan whole = scan_of(cloud, options, 0, 500);
    const std::uint64_t a = random.below(500), b = a + random.below(500 - a);
    SceneScan parts = scan_of(cloud, options, b, 500);
    parts.merge(scan_of(cloud, options, 0, a));
    parts.merge(scan_of(cloud, options, a, b));
    CHECK(parts.n_source() == whole.n_source());
    CHECK(parts.n_kept() == whole.n_kept());
    CHECK(parts.defects(Defect::mean) == 1);
    for (const auto& [one, two] : {std::pair{parts.full(), whole.full()}, std::pair{parts.robust(), whole.robust()}}) {
      CHECK(std::memcmp(&one, &two, sizeof one) == 0);  // bits: -0 is not 0 here
    }
    CHECK(parts.min_log_scale() == whole.min_log_scale());
    CHECK(parts.max_log_scale() == whole.max_log_scale());
    CHECK(parts.min_opacity_logit() == whole.min_opacity_logit());
    CHECK(parts.max_opacity_logit() == whole.max_opacity_logit());
    const ShStepSet one = parts.sh_magnitudes().max_abs(), two = whole.sh_magnitudes().max_abs();
    CHECK(std::memcmp(&one, &two, sizeof one) == 0);
    CHECK(parts.view_sample().n() == 499);
    CHECK(parts.view_sample().rows() == whole.view_sample().rows());
  }
}

TEST_CASE("the sample for the first view does not depend on order and parts where it leaves most out") {
  SplitMix random(kSeed);
  const SplatCloud cloud = random_cloud(4 * FirstViewSample::kMost, 0, random);
  const std::uint64_t n = cloud.size(), a = n / 3, b = n / 2;
  const SceneScan whole = scan_of(cloud, {}, 0, n);
  SceneScan parts = scan_of(cloud, {}, b, n);
  parts.merge(scan_of(cloud, {}, a, b));
  const auto before = SceneScan::from_bytes(scan_of(cloud, {}, 0, a).to_bytes());
  REQUIRE(before);
  parts.merge(*before);
  FirstViewSample backwards;
  for (std::uint64_t i = n; i-- > 0;) backwards.add(cloud.view().splat(i));
  for (const FirstViewSample* sample :
       std::array{&whole.view_sample(), &parts.view_sample(), &std::as_const(backwards)}) {
    CHECK(sample->n() == n);
    CHECK(sample->rows().size() == FirstViewSample::kMost);
    CHECK(sample->rows() == whole.view_sample().rows());
  }
}

TEST_CASE("an empty scan reports zeros") {
  const SceneScan scan(3);
  CHECK(scan.full().min == std::array{0.f, 0.f, 0.f});
  CHECK(scan.robust().max == std::array{0.f, 0.f, 0.f});
  CHECK(scan.min_log_scale() == 0);
  CHECK(scan.max_opacity_logit() == 0);
}

TEST_CASE("the robust box matches the specification") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  for (const std::uint64_t n : {1u, 2u, 199u, 200u, 201u, 400u, 1999u, 5000u}) {
    CAPTURE(n);
    const SplatCloud cloud = random_cloud(n, 0, random);
    const Box box = scan_of(cloud, {}, 0, n).robust(), expected = brute_robust_box(cloud);
    CHECK(box.min == expected.min);
    CHECK(box.max == expected.max);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      std::uint64_t inside = 0;
      for (std::uint64_t i = 0; i < n; ++i) {
        const float x = cloud.mean[3 * i + axis];
        inside += x >= box.min[axis] && x <= box.max[axis];
      }
      CHECK(inside * 100 >= n * 99);
    }
  }
}

// The order of `part`, which comes in the source's order: halved at bit after bit of the keys, down to a cell.
std::vector<std::uint32_t> along_curve(const std::vector<std::uint64_t>& keys, std::vector<std::uint32_t> part,
                                       int bit) {
  if (bit < 0 || part.size() < 2 || (bit < 63 - 24 && part.size() <= 1024)) return part;
  const auto upper =
      std::stable_partition(part.begin(), part.end(), [&](std::uint32_t i) { return (keys[i] >> bit & 1) == 0; });
  std::vector<std::uint32_t> order = along_curve(keys, {part.begin(), upper}, bit - 1);
  const std::vector<std::uint32_t> rest = along_curve(keys, {upper, part.end()}, bit - 1);
  order.insert(order.end(), rest.begin(), rest.end());
  return order;
}

TEST_CASE("sorting by key goes along the curve, and a cell keeps its order") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  for (const std::uint64_t n : {0u, 1u, 2u, 255u, 256u, 5000u}) {
    for (const std::uint64_t mask :
         {~std::uint64_t{0} >> 1, std::uint64_t{0xFF}, std::uint64_t{0x70000000000F00}, std::uint64_t{0}}) {
      std::vector<std::uint64_t> keys(n);
      for (std::uint64_t& key : keys) key = random.bits() & mask;
      std::vector<std::uint32_t> indices(n);
      std::iota(indices.begin(), indices.end(), 0u);
      const std::vector<std::uint32_t> expected = along_curve(keys, indices, 62);
      std::vector<std::uint64_t> sorted = keys;
      sort_by_key(sorted, indices);
      CHECK(indices == expected);
      CHECK(std::ranges::is_sorted(sorted, {}, [](std::uint64_t key) { return key >> (63 - 24); }));
      for (std::size_t i = 0; i < n; ++i) REQUIRE(sorted[i] == keys[indices[i]]);
    }
  }
}

TEST_CASE("Morton keys interleave cells, and positions outside contract") {
  Box box;
  box.min = {-1, -1, -1};
  box.max = {1, 1, 1};
  const MortonKey key(box);
  const auto at = [&](float x, float y, float z) {
    const float p[3] = {x, y, z};
    return key(p);
  };
  // The centre is cell 2^20 of each axis: bits 60, 61, 62. Half-width 1 is at 3/4.
  CHECK(at(0, 0, 0) == std::uint64_t{7} << 60);
  CHECK(at(1, 0, 0) == (std::uint64_t{7} << 60 | std::uint64_t{1} << 57));
  CHECK(at(0, 1, 0) == (std::uint64_t{7} << 60 | std::uint64_t{1} << 58));
  CHECK(at(0, 0, 1) == (std::uint64_t{7} << 60 | std::uint64_t{1} << 59));
  CHECK(at(-1, 0, 0) == (std::uint64_t{6} << 60 | std::uint64_t{1} << 57));
  CHECK(at(3e38f, 3e38f, 3e38f) == (std::uint64_t{1} << 63) - 1);
  CHECK(at(-3e38f, -3e38f, -3e38f) == 0);
  std::uint64_t last = 0;
  for (float x = -100; x <= 100; x += 0.25f) {  // monotonic along an axis
    const std::uint64_t now = at(x, -3e38f, -3e38f);
    CHECK(now >= last);
    last = now;
  }
  const MortonKey flat{Box{}};
  const float origin[3] = {0, 0, 0};
  CHECK(flat(origin) == std::uint64_t{7} << 60);
}

TEST_CASE("Gaussians are written in Morton order, and equal keys keep the source's order") {
  SplitMix random(kSeed);
  SplatCloud cloud = golden_cloud(600, 0, 3);
  for (std::uint64_t i = 0; i < 600; ++i) {
    for (std::uint64_t k = 0; k < 3; ++k) cloud.mean[3 * i + k] = static_cast<float>(random.below(4));
  }
  EncodeOptions options;
  options.keep_permutation = true;
  const auto bytes = encode(cloud.view(), options);
  REQUIRE(bytes);
  const auto view = FileView::open(*bytes);
  REQUIRE(view);
  const MortonKey key(view->declarations().robust);
  for (std::uint64_t i = 1; i < 600; ++i) {
    const std::uint64_t a = view->source_index(i - 1), b = view->source_index(i);
    const std::uint64_t key_a = key(&cloud.mean[3 * a]), key_b = key(&cloud.mean[3 * b]);
    REQUIRE((key_a < key_b || (key_a == key_b && a < b)));
  }
}

TEST_CASE("the low-pass is declared as requested, else from the anti-aliasing") {
  const SplatCloud cloud = golden_cloud(3, 0, 3);
  const auto declared = [&cloud](AaMode mode, std::optional<float> low_pass) {
    EncodeOptions options;
    options.aa_mode = mode, options.low_pass_px2 = low_pass;
    const auto bytes = encode(cloud.view(), options);
    REQUIRE(bytes);
    return FileView::open(*bytes)->declarations().low_pass_px2;
  };
  CHECK(declared(AaMode::classic, {}) == 0.3f);
  CHECK(declared(AaMode::undeclared, {}) == 0.3f);
  CHECK(declared(AaMode::mip_splatting, {}) == 0.1f);
  CHECK(declared(AaMode::mip_splatting, 0.3f) == 0.3f);
  CHECK(declared(AaMode::classic, 0.f) == 0.f);
}

TEST_CASE("a scene that was loaded and filtered keeps its file's declarations") {
  EncodeOptions first;
  first.axes = {Axis::right, Axis::up, Axis::backward};
  first.colour_space = ColourSpace::linear_display;
  first.aa_mode = AaMode::mip_splatting;
  first.low_pass_px2 = 0.2f;
  first.metres_per_unit = 0.5f;
  first.cutoff_sigma = 2.5f, first.alpha_threshold = 0.01f, first.alpha_max = 0.999f, first.transmittance_min = 0.001f;
  first.depth = DepthRange{0.5f, 32.f, DepthSource::cameras};
  first.depth_mapping = DepthMapping::linear;
  first.keep_permutation = true;
  SplatCloud cloud = golden_cloud(300, 1, 3);
  cloud.mean[5] = kNaN;  // dropped
  const auto bytes = encode(cloud.view(), first);
  REQUIRE(bytes);
  const auto view = FileView::open(*bytes);
  REQUIRE(view);
  const Declarations d = view->declarations();
  CHECK(d.low_pass_px2 == 0.2f);
  CHECK(d.cutoff_sigma == 2.5f);
  CHECK(d.alpha_threshold == 0.01f);
  CHECK(d.alpha_max == 0.999f);
  CHECK(d.transmittance_min == 0.001f);

  const SplatCloud loaded = decode(*bytes).value();
  SplatCloud half;
  half.resize(150, 1);
  std::vector<std::uint32_t> source_index;
  for (std::uint64_t i = 0; i < 150; ++i) {
    half.set(i, loaded.view().splat(2 * i));
    source_index.push_back(static_cast<std::uint32_t>(view->source_index(2 * i)));
  }
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    EncodeOptions again = keep_declarations({}, d);
    again.profile = profile;
    again.keep_permutation = true;
    CHECK(encode(half.view(), again).error().code == Errc::bad_argument);  // without the sources' indices
    again.source_index = source_index;
    const auto kept = encode(half.view(), again);
    REQUIRE(kept);
    const auto kept_view = FileView::open(*kept);
    REQUIRE(kept_view);
    REQUIRE(validate(*kept_view));
    Declarations e = kept_view->declarations();
    CHECK(e.n_source == 300);
    CHECK(e.n_dropped == 150);
    CHECK(e.axes == d.axes);
    CHECK(e.colour_space == d.colour_space);
    CHECK(e.aa_mode == d.aa_mode);
    CHECK(e.low_pass_px2 == d.low_pass_px2);
    CHECK(e.metres_per_unit == d.metres_per_unit);
    CHECK(e.z_near == d.z_near);
    CHECK(e.z_far == d.z_far);
    CHECK(e.depth_source == d.depth_source);
    CHECK(e.depth_mapping == d.depth_mapping);
    CHECK(e.cutoff_sigma == d.cutoff_sigma);
    CHECK(e.alpha_threshold == d.alpha_threshold);
    CHECK(e.alpha_max == d.alpha_max);
    CHECK(e.transmittance_min == d.transmittance_min);
    for (std::uint64_t i = 0; i < 150; ++i) {
      ActivatedSplat s;
      REQUIRE(kept_view->read(i, {&s, 1}));
      const std::uint64_t source = kept_view->source_index(i);
      if (profile != Profile::archive) {
        CHECK(s.mean[0] == cloud.mean[3 * source]);
        continue;
      }
      const auto given = static_cast<std::uint64_t>(std::ranges::find(source_index, source) - source_index.begin());
      REQUIRE(given < 150);
      const ShStepSet steps = kept_view->chunk_steps(i / kept_view->header().chunk_size).value();
      const auto step = [&steps](int k) { return steps.of_value(k); };
      CHECK(is_within(StatedBounds(*kept), 0, 1, half.view().splat(given), s, step));
    }
  }
  // Positions that no file can have.
  EncodeOptions wrong = keep_declarations({}, d);
  wrong.keep_permutation = true;
  const auto refused = [&](const std::vector<std::uint32_t>& positions) {
    wrong.source_index = positions;
    return encode(half.view(), wrong).error().code;
  };
  std::vector<std::uint32_t> twice = source_index, beyond = source_index, few = source_index;
  twice[1] = twice[0], beyond[7] = 300, few.pop_back();
  CHECK(refused(twice) == Errc::bad_argument);
  CHECK(refused(beyond) == Errc::bad_argument);
  CHECK(refused(few) == Errc::bad_argument);
  // More Gaussians than the source: two scenes in one. They are their own source.
  const auto more = encode(loaded.view(), [&] {
    EncodeOptions o = keep_declarations({}, d);
    o.n_source = 10;
    return o;
  }());
  REQUIRE(more);
  CHECK(FileView::open(*more)->declarations().n_source == loaded.size());
}

TEST_CASE("each kind of damage is detected, then refused, dropped or repaired") {
  struct Damage {
    Defect kind;
    bool repairable;
    void (*apply)(Splat&);
  };
  const Damage damages[] = {
      {Defect::mean, false, [](Splat& s) { s.mean[2] = kNaN; }},
      {Defect::mean, false, [](Splat& s) { s.mean[0] = -kInfinity; }},
      {Defect::scale, false, [](Splat& s) { s.log_scale[0] = kNaN; }},
      {Defect::scale, false, [](Splat& s) { s.log_scale[1] = kInfinity; }},
      {Defect::scale, false, [](Splat& s) { s.log_scale[2] = 60.01f; }},
      {Defect::rotation_nan, true, [](Splat& s) { s.rotation[3] = kNaN; }},
      {Defect::rotation_nan, true, [](Splat& s) { s.rotation[0] = kInfinity; }},
      {Defect::rotation_zero, true, [](Splat& s) { std::fill(s.rotation, s.rotation + 4, 0.f); }},
      {Defect::rotation_zero, true, [](Splat& s) { std::fill(s.rotation, s.rotation + 4, 0x1p-63f); }},
      {Defect::opacity_nan, false, [](Splat& s) { s.opacity_logit = kNaN; }},
      {Defect::sh, true, [](Splat& s) { s.sh[11] = kNaN; }},
      {Defect::sh, true, [](Splat& s) { s.sh[0] = 0x1p100f; }},
  };
  for (const Damage& damage : damages) {
    CAPTURE(defect_name(damage.kind));
    SplatCloud cloud = golden_cloud(200, 1, 4);
    Splat s = cloud.view().splat(77);
    damage.apply(s);
    CHECK(find_defects(s, 1) == 1u << static_cast<unsigned>(damage.kind));
    cloud.set(77, s);
    EncodeOptions options;
    options.on_bad = BadPolicy::refuse;
    const auto refused = encode(cloud.view(), options);
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::bad_value);
    CHECK(refused.error().offset == 77);
    for (const BadPolicy policy : {BadPolicy::drop, BadPolicy::repair}) {
      const bool kept = policy == BadPolicy::repair && damage.repairable;
      options.on_bad = policy;
      const auto bytes = encode(cloud.view(), options);
      REQUIRE(bytes);
      const auto view = FileView::open(*bytes);
      REQUIRE(view);
      CHECK(validate(*view));
      CHECK(view->header().n_gaussians == (kept ? 200 : 199));
      CHECK(view->declarations().n_source == 200);
      CHECK(view->declarations().n_dropped == (kept ? 0 : 1));
      CHECK(view->declarations().n_repaired == (kept ? 1 : 0));
      SceneScan scan = scan_of(cloud, options, 0, 200);
      for (int kind = 0; kind < kDefectKinds; ++kind) {
        CHECK(scan.defects(static_cast<Defect>(kind)) == (static_cast<Defect>(kind) == damage.kind ? 1 : 0));
      }
    }
  }
}

TEST_CASE("repair follows its documentation") {
  Splat s;
  s.rotation[2] = kNaN;
  s.sh[5] = -kInfinity;
  s.sh[6] = 3.f;
  REQUIRE(repair(s, find_defects(s, 3)));
  CHECK(std::to_array(s.rotation) == std::array{1.f, 0.f, 0.f, 0.f});
  CHECK(s.sh[5] == 0.f);
  CHECK(s.sh[6] == 3.f);
  CHECK(find_defects(s, 3) == 0);
}

TEST_CASE("infinite logits are opacities of 1 and 0, and a log-scale of -inf is a scale of 0, in every profile") {
  SplatCloud cloud = golden_cloud(600, 1, 9);
  constexpr std::uint64_t kOpaque = 17, kClear = 300, kFlat = 599, kPoint = 5;
  cloud.opacity_logit[kOpaque] = kInfinity;
  cloud.opacity_logit[kClear] = -kInfinity;
  cloud.log_scale[3 * kFlat + 1] = -kInfinity;
  for (std::size_t k = 0; k < 3; ++k) cloud.log_scale[3 * kPoint + k] = -kInfinity;
  CHECK(find_defects(cloud.view().splat(kOpaque), 1) == 0);
  CHECK(find_defects(cloud.view().splat(kFlat), 1) == 0);
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    EncodeOptions options;
    options.profile = profile;
    options.on_bad = BadPolicy::refuse;
    options.keep_permutation = true;
    const auto bytes = encode(cloud.view(), options);
    REQUIRE(bytes);
    const auto view = FileView::open(*bytes);
    REQUIRE(view);
    CHECK(validate(*view));
    CHECK(view->header().n_gaussians == 600);
    std::vector<ActivatedSplat> stored(600);
    std::vector<Splat> trained(600);
    REQUIRE(view->read(0, std::span(stored)));
    REQUIRE(view->read(0, std::span(trained)));
    for (std::uint64_t i = 0; i < 600; ++i) {
      const std::uint64_t source = view->source_index(i);
      const bool flat = source == kFlat || source == kPoint;
      if (source == kOpaque) CHECK(stored[i].opacity == 1);
      // The archive stores it as a quarter of a level, which is not drawn either.
      if (source == kClear) CHECK(stored[i].opacity <= (profile == Profile::archive ? 1.f / 255 : 0.f));
      // The archive stores it as an eighth of what a pixel blurs, which adds 1/64 to the variance that is seen.
      const float least = profile == Profile::archive ? least_scale(*view->archive(), stored[i].mean) : 0;
      if (flat) CHECK(stored[i].scale[1] <= least);
      if (source == kPoint) CHECK((stored[i].scale[0] <= least && stored[i].scale[2] <= least));
      if (!flat) CHECK(stored[i].scale[1] > 0);
      CHECK(std::isfinite(trained[i].opacity_logit));
      CHECK(std::isfinite(trained[i].log_scale[1]));
    }
    if (profile == Profile::archive) continue;
    CHECK(view->declarations().n_scale_zero == 4);
    // Decoded values encode to the same codes.
    const auto again = decode(*bytes);
    REQUIRE(again);
    const auto second = encode(again->view(), options);
    REQUIRE(second);
    const auto reopened = FileView::open(*second);
    REQUIRE(reopened);
    CHECK(reopened->header().scale_exponent == view->header().scale_exponent);
    const auto a = load_direct(*view), b = load_direct(*reopened);
    REQUIRE(a);
    REQUIRE(b);
    CHECK(std::ranges::equal(a->geometry(), b->geometry()));
  }
}

TEST_CASE("scales of 0 and near 0 are stored exactly") {
  for (const float log_scale : {-kInfinity, -61.f, -80.f, -200.f}) {
    CAPTURE(log_scale);
    SplatCloud cloud = golden_cloud(70, 0, 9);
    std::ranges::fill(cloud.log_scale, log_scale);
    for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
      EncodeOptions options;
      options.profile = profile;
      options.on_bad = BadPolicy::refuse;
      const auto bytes = encode(cloud.view(), options);
      REQUIRE(bytes);
      const auto view = FileView::open(*bytes);
      REQUIRE(view);
      CHECK(validate(*view));
      std::vector<ActivatedSplat> stored(70);
      REQUIRE(view->read(0, std::span(stored)));
      for (const ActivatedSplat& s : stored) {
        CHECK(s.scale[0] <= (profile == Profile::archive ? least_scale(*view->archive(), s.mean) : 0x1p-86f));
      }
      if (profile == Profile::archive) continue;
      const double wanted = std::exp(static_cast<double>(log_scale));
      CHECK(std::abs(static_cast<double>(stored[0].scale[2]) - wanted) <= std::max(wanted * 0x1p-11, 0x1p-134));
      const auto again = decode(*bytes);
      REQUIRE(again);
      const auto second = encode(again->view(), options);
      REQUIRE(second);
      CHECK(FileView::open(*second)->header().scale_exponent == view->header().scale_exponent);
      CHECK(std::ranges::equal(load_direct(*FileView::open(*second))->geometry(), load_direct(*view)->geometry()));
    }
  }
}

TEST_CASE("coefficients above the kept degree are ignored") {
  SplatCloud cloud = golden_cloud(10, 3, 5);
  for (std::uint64_t i = 0; i < 10; ++i) cloud.sh[48 * i + 40] = kNaN;
  EncodeOptions options;
  options.on_bad = BadPolicy::refuse;
  CHECK_FALSE(encode(cloud.view(), options));
  options.sh_degree = 2;
  const auto bytes = encode(cloud.view(), options);
  REQUIRE(bytes);
  CHECK(FileView::open(*bytes)->header().sh_degree == 2);
}

TEST_CASE("more than one damaged Gaussian in a hundred is an error unless a policy was chosen") {
  SplatCloud cloud = golden_cloud(200, 0, 6);
  cloud.mean[0] = cloud.mean[3] = kNaN;
  CHECK(encode(cloud.view()));  // 2 of 200
  cloud.mean[6] = kNaN;
  const auto refused = encode(cloud.view());
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::too_many_bad);
  CHECK(refused.error().expected == 2);
  CHECK(refused.error().found == 3);
  EncodeOptions options;
  options.max_bad_fraction = 1;
  CHECK(FileView::open(*encode(cloud.view(), options))->header().n_gaussians == 197);
  options = {};
  options.on_bad = BadPolicy::repair;
  CHECK(FileView::open(*encode(cloud.view(), options))->header().n_gaussians == 197);
}

TEST_CASE("options that no file can state are refused") {
  const SplatCloud cloud = golden_cloud(3, 0, 7);
  const auto code = [&](auto change) {
    EncodeOptions options;
    change(options);
    const auto bytes = encode(cloud.view(), options);
    return bytes ? Errc::internal : bytes.error().code;
  };
  for (const std::uint32_t size : {0u, 16u, 33u, kMaxChunkSize + 32}) {
    CHECK(code([&](EncodeOptions& o) { o.chunk_size = size; }) == Errc::bad_argument);
  }
  CHECK(code([](EncodeOptions& o) { o.sh_degree = 4; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.sh_degree = -1; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.depth = DepthRange{0, 1}; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.depth = DepthRange{2, 1}; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.depth = DepthRange{1, kInfinity}; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.depth = DepthRange{kNaN, 1}; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.metres_per_unit = kNaN; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.low_pass_px2 = -0.1f; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.low_pass_px2 = kInfinity; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.alpha_max = kNaN; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.cutoff_sigma = -1; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.axes[1] = Axis::left; }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) { o.aa_mode = static_cast<AaMode>(9); }) == Errc::bad_argument);
  CHECK(code([](EncodeOptions& o) {
          o.provenance = Provenance{0, 0, std::string(4097, 'a'), ""};
        }) == Errc::bad_argument);
  SplatView view = cloud.view();
  view.n = 4;
  CHECK(encode(view).error().code == Errc::bad_argument);
}

TEST_CASE("an origin is declared by version 1.3 or later, and only where there is one") {
  const SplatCloud cloud = golden_cloud(300, 1, 7);
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    EncodeOptions options;
    options.profile = profile;
    const auto plain = encode(cloud.view(), options).value();
    options.origin = {0.0, -0.0, 0.0};
    CHECK(encode(cloud.view(), options).value() == plain);
    const bool archive = profile == Profile::archive;  // whose version is later
    CHECK((FileView::open(plain)->header().version_minor < 3) == !archive);
    options.origin = {4.2e6 + 0.1, -kMaxOrigin, -0.0};
    const auto far = encode(cloud.view(), options).value();
    const auto view = FileView::open(far);
    REQUIRE(view);
    REQUIRE(validate(*view));
    CHECK(view->header().version_minor == (archive ? 5 : 3));
    CHECK(view->declarations().origin == options.origin);
    CHECK_FALSE(std::signbit(view->declarations().origin[2]));
    // Everything else equals the scene's own: means are relative.
    CHECK(view->declarations().full.min == FileView::open(plain)->declarations().full.min);
    CHECK(decode(far)->mean == decode(plain)->mean);
  }
  for (const double bad : {std::nan(""), HUGE_VAL, -1.0000001e12}) {
    EncodeOptions options;
    options.origin[1] = bad;
    const auto refused = encode(cloud.view(), options);
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::bad_argument);
  }
}

TEST_CASE("a scan survives serialisation, and no other bytes are accepted") {
  SceneScan scan(2, BadPolicy::repair, true);
  for (int i = 0; i < 500; ++i) {
    Splat s;
    for (int k = 0; k < 3; ++k) s.mean[k] = static_cast<float>((i * 37 + k * 11) % 101) - 40.F;
    for (int k = 0; k < 27; ++k) s.sh[k] = 0.01F * static_cast<float>(i % 7 - k);
    s.log_scale[0] = i == 3 ? -std::numeric_limits<float>::infinity() : -1;
    if (i % 50 == 0) s.rotation[1] = std::numeric_limits<float>::quiet_NaN();
    if (i % 99 == 0) s.opacity_logit = std::numeric_limits<float>::quiet_NaN();
    scan.add(s);
  }
  const std::vector<std::byte> bytes = scan.to_bytes();
  const auto back = SceneScan::from_bytes(bytes);
  REQUIRE(back);
  CHECK(back->to_bytes() == bytes);
  CHECK(back->n_source() == 500);
  CHECK(back->n_kept() == scan.n_kept());
  CHECK(back->n_repaired() == scan.n_repaired());
  CHECK(back->defects(Defect::opacity_nan) == scan.defects(Defect::opacity_nan));
  CHECK(back->robust().min == scan.robust().min);
  CHECK(back->full().max == scan.full().max);
  CHECK(back->min_log_scale() == scan.min_log_scale());
  CHECK(back->view_sample().rows() == scan.view_sample().rows());
  const std::size_t sample_bytes = 16 + 44 * scan.view_sample().rows().size();
  // Every prefix, and trailing bytes; a count that would send the search for the robust box out of its bins.
  for (std::size_t n = 0; n < bytes.size(); n += n < 400 ? 1 : 101) {
    const std::vector<std::byte> prefix(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(n));
    REQUIRE_FALSE(SceneScan::from_bytes(prefix));
  }
  std::vector<std::byte> changed = bytes;
  changed.push_back(std::byte{0});
  CHECK(SceneScan::from_bytes(changed).error().code == Errc::trailing_bytes);
  changed = bytes;
  changed[changed.size() - sample_bytes - 8] ^= std::byte{1};  // the last bin's count
  CHECK(SceneScan::from_bytes(changed).error().code == Errc::bad_value);
  for (const std::size_t count : {0U, 8U}) {
    changed = bytes;
    changed[changed.size() - sample_bytes + count + 2] ^= std::byte{1};  // Gaussians offered to the sample, and in it
    CHECK(SceneScan::from_bytes(changed).error().code == Errc::bad_value);
  }
  changed = bytes;
  changed[0] = std::byte{4};
  CHECK(SceneScan::from_bytes(changed).error().code == Errc::bad_value);
}
