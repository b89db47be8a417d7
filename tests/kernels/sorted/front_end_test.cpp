// front_end_test.cpp - attributes to splats and (tile, Gaussian) pairs on the device, against rgs::math on the host.
// SPDX-License-Identifier: Apache-2.0
// The front ends are compiled without FMA contraction, like the host: everything except logarithms must match exactly.
#include "sorted/front_end.hpp"

#include <doctest/doctest.h>

#include <string>

#include "device_fixture.hpp"
#include "random_cloud.hpp"
#include "rgs/camera_file.hpp"
#include "scene_generator.hpp"
#include "sorted/sort.hpp"
#include "stage_reference.hpp"

using namespace rgs;
using namespace rgs::test;
using cuda::ScreenSplat;
using math::DepthOrder;
using math::Extent;

namespace {

enum class FrontEnd { separate, chained, atomic };
constexpr FrontEnd kFrontEnds[] = {FrontEnd::separate, FrontEnd::chained, FrontEnd::atomic};
std::string name_of(FrontEnd f) {
  return f == FrontEnd::separate ? "separate" : f == FrontEnd::chained ? "fused, deterministic" : "fused, atomic";
}

struct Pair {
  std::uint64_t key;
  std::uint32_t gaussian;
  auto operator<=>(const Pair&) const = default;
};

/// A front end's output.
struct Output {
  std::vector<ScreenSplat> splats;
  std::vector<Pair> pairs;
  std::uint64_t visible = 0;
};

/// A front end's input and the arrays that do not depend on the number of pairs.
class Stage {
 public:
  Stage(const cuda::Attributes& attributes, std::uint32_t n, const cuda::ViewParameters& view, Extent extent)
      : attributes_(attributes),
        n_(n),
        view_(view),
        extent_(extent),
        narrow_(view.key.bits() <= 32),
        splats_(n),
        counters_(1) {}

  /// Counts a run's pairs with room for none, then writes with room for all but one, then for all. Nothing may be
  /// written beyond the room.
  Output run(FrontEnd how) {
    const std::uint64_t n = launch(how, 0);
    CHECK_MESSAGE(pairs_written(0) == 0, name_of(how));
    if (n > 0) {
      CHECK(launch(how, n - 1) == n);
      CHECK_MESSAGE(pairs_written(n - 1) == n - 1, name_of(how), ": pairs written in room for all but one of ", n);
    }
    CHECK(launch(how, n) == n);
    Output out;
    out.splats = splats_.download();
    out.visible = counters_.download()[0].visible;
    const auto gaussians = gaussians_.download();
    for (std::uint64_t k = 0; k < n; ++k) out.pairs.push_back({key(k), gaussians[k]});
    return out;
  }

 private:
  cuda::PairArrays arrays(std::uint64_t capacity) {
    wide_ = DeviceArray<std::uint64_t>(narrow_ ? 0 : capacity);
    thin_ = DeviceArray<std::uint32_t>(narrow_ ? capacity : 0);
    gaussians_ = DeviceArray<std::uint32_t>(capacity);
    return {narrow_ ? static_cast<void*>(thin_.data()) : wide_.data(), gaussians_.data(), capacity, narrow_};
  }
  std::uint64_t launch(FrontEnd how, std::uint64_t capacity) {
    const auto pairs = arrays(capacity);
    splats_.fill(0xFF);
    counters_.fill(0);
    if (how != FrontEnd::separate) {
      DeviceArray<std::uint64_t> state(cuda::fused_blocks(n_) + 1);
      state.fill(0);
      require_ok(cuda::launch_fused({attributes_, n_, view_, extent_, splats_.data(), pairs, counters_.data(),
                                     how == FrontEnd::chained ? state.data() : nullptr},
                                    nullptr));
      synchronize();
      state.check_guards();
      return download(counters_).instances;
    }
    DeviceArray<std::byte> covers(n_ * cuda::cover_bytes());
    DeviceArray<std::uint32_t> tiles(n_);
    DeviceArray<std::uint64_t> sums(n_);
    require_ok(cuda::launch_project(
        {attributes_, n_, view_, extent_, splats_.data(), covers.data(), tiles.data(), counters_.data()}, nullptr));
    const auto bytes = cuda::sum_bytes(n_);
    require_ok(bytes);
    DeviceArray<std::byte> temporary(*bytes);
    require_ok(cuda::launch_sum(tiles.data(), sums.data(), n_, temporary.data(), *bytes, nullptr));
    require_ok(
        cuda::launch_duplicate({n_, view_, extent_, splats_.data(), covers.data(), sums.data(), pairs}, nullptr));
    const auto ends = sums.download();
    covers.check_guards();
    tiles.check_guards();
    temporary.check_guards();
    return n_ == 0 ? 0 : ends.back();
  }
  static cuda::Counters download(const DeviceArray<cuda::Counters>& counters) { return counters.download()[0]; }

  // Pairs of the last run, whose unwritten bytes are all ones; checks the guards too.
  std::uint64_t pairs_written(std::uint64_t capacity) {
    host_wide_ = wide_.download(), host_thin_ = thin_.download();
    const auto gaussians = gaussians_.download();
    std::uint64_t n = 0;
    for (std::uint64_t k = 0; k < capacity; ++k) n += gaussians[k] != ~0u;
    return n;
  }
  std::uint64_t key(std::uint64_t k) {
    if (k == 0) host_wide_ = wide_.download(), host_thin_ = thin_.download();
    return narrow_ ? host_thin_[k] : host_wide_[k];
  }

  cuda::Attributes attributes_;
  std::uint32_t n_;
  cuda::ViewParameters view_;
  Extent extent_;
  bool narrow_;
  DeviceArray<ScreenSplat> splats_;
  DeviceArray<cuda::Counters> counters_;
  DeviceArray<std::uint64_t> wide_;
  DeviceArray<std::uint32_t> thin_, gaussians_;
  std::vector<std::uint64_t> host_wide_;
  std::vector<std::uint32_t> host_thin_;
};

/// Tiles that list a Gaussian, row by row.
std::vector<std::uint32_t> tiles_of(const math::Projected<float>& p, float cutoff, Extent extent, math::TileGrid grid) {
  std::vector<std::uint32_t> tiles;
  const bool square = extent == Extent::square;
  const auto ellipse = math::ellipse(p.mean, p.footprint, cutoff);
  const auto rect = square ? math::square_extent(p.mean, p.footprint.cov, grid) : math::bounding_tiles(ellipse, grid);
  if (rect.empty()) return tiles;
  for (int row = rect.y0; row < rect.y1; ++row) {
    const auto span = square ? math::TileSpan{rect.x0, rect.x1} : math::tiles_in_row(ellipse, row, grid);
    for (int x = span.first; x < span.last; ++x) tiles.push_back(static_cast<std::uint32_t>(row * grid.columns + x));
  }
  return tiles;
}

/// The key's depth; `slack` bounds the change by the device's logarithm.
std::uint32_t depth_key(const cuda::ViewParameters& v, float z, std::uint32_t& slack) {
  slack = 0;
  if (!v.key.quantized) return math::depth_bits(z);
  const std::uint32_t bin = math::quantize_depth(v.quantizer, z);
  if (v.quantizer.mapping == DepthMapping::logarithmic) {
    const float log_z = std::log(z);
    // Two ulp of the logarithm, and FP32 rounding of the difference and the product.
    slack =
        1 + (bin >> 22) +
        static_cast<std::uint32_t>(2 * v.quantizer.scale * (std::nextafter(std::abs(log_z), 1e9F) - std::abs(log_z)));
  }
  return bin;
}

/// Compares a front end's whole output with the host's.
void check(const Output& out, const SceneView& scene, const cuda::ViewParameters& v, Extent extent, FrontEnd how) {
  std::vector<std::uint8_t> listed(scene.n, 0);
  bool in_range = true;
  for (const Pair& p : out.pairs) {
    in_range = in_range && p.gaussian < scene.n;
    if (p.gaussian < scene.n) listed[p.gaussian] = 1;
  }
  REQUIRE_MESSAGE(in_range, "a pair names a Gaussian that does not exist");
  CHECK(out.visible == static_cast<std::uint64_t>(std::count(listed.begin(), listed.end(), 1)));

  Deviations deviations;
  std::vector<Pair> expected;
  std::vector<std::uint32_t> slacks;
  std::uint64_t n_missing = 0, n_touched = 0, first_missing = 0;
  for (std::uint64_t i = 0; i < scene.n; ++i) {
    const ScreenSplat& s = out.splats[i];
    if (listed[i] == 0) {
      // A cutoff one rounding larger may leave no tile; the host must confirm that it is so close.
      const auto p = project(scene, i, v);
      if (!untouched(s)) ++n_touched;
      if (!p.footprint.valid) continue;
      const float cutoff = tighter(math::power_cutoff(p.footprint.opacity));
      if (!tiles_of(p, cutoff, extent, v.grid).empty() && n_missing++ == 0) first_missing = i;
      continue;
    }
    compare_splat(i, s, scene, v, deviations);
    std::uint32_t slack = 0;
    const std::uint32_t depth = depth_key(v, s.z, slack);
    for (const std::uint32_t tile : tiles_of(project(scene, i, v), s.cutoff, extent, v.grid)) {
      expected.push_back({static_cast<std::uint64_t>(tile) << v.key.depth_bits | depth, static_cast<std::uint32_t>(i)});
      slacks.push_back(slack);
    }
  }
  CHECK_MESSAGE(deviations.first.empty(), deviations.first);
  CHECK(deviations.exact == 0);
  CHECK(deviations.cutoff <= kCutoffUlps);
  CHECK_MESSAGE(n_missing == 0, n_missing, " Gaussians that the host lists have no pair, the first is ", first_missing);
  CHECK_MESSAGE(n_touched == 0, n_touched, " splats of Gaussians without a pair were written");

  // The host's pairs are ordered by Gaussian and tile, like a deterministic front end's.
  std::vector<Pair> pairs = out.pairs;
  const bool logarithmic = v.key.quantized && v.quantizer.mapping == DepthMapping::logarithmic;
  if (how == FrontEnd::atomic) {
    std::stable_sort(pairs.begin(), pairs.end(), [&](const Pair& a, const Pair& b) {
      return std::pair(a.gaussian, a.key >> v.key.depth_bits) < std::pair(b.gaussian, b.key >> v.key.depth_bits);
    });
  }
  REQUIRE_MESSAGE(pairs.size() == expected.size(), "pairs on the device: ", pairs.size(),
                  ", on the host: ", expected.size());
  std::uint64_t n_wrong = 0, at = 0;
  for (std::uint64_t k = 0; k < pairs.size(); ++k) {
    const std::uint64_t a = pairs[k].key, b = expected[k].key;
    const bool same_tile = a >> v.key.depth_bits == b >> v.key.depth_bits;
    const bool same = pairs[k].gaussian == expected[k].gaussian &&
                      (a == b || (logarithmic && same_tile && (a > b ? a - b : b - a) <= slacks[k]));
    if (!same && n_wrong++ == 0) at = k;
  }
  if (n_wrong > 0) {
    FAIL_CHECK(n_wrong, " of ", pairs.size(), " pairs differ; at ", at, " the device has tile ",
               pairs[at].key >> v.key.depth_bits, " key ", pairs[at].key, " Gaussian ", pairs[at].gaussian,
               ", the host tile ", expected[at].key >> v.key.depth_bits, " key ", expected[at].key, " Gaussian ",
               expected[at].gaussian);
  }
}

/// Runs all front ends on one set of attributes.
void check_all(const cuda::Attributes& attributes, const SceneView& scene, const Camera& camera,
               const Arithmetic& options) {
  const auto v = view_parameters(camera, options, scene.sh_degree);
  CAPTURE(scene.n);
  CAPTURE(scene.sh_degree);
  CAPTURE(v.sh_degree);
  CAPTURE(std::holds_alternative<cuda::CompactAttributes>(attributes));
  CAPTURE(static_cast<int>(options.extent));
  CAPTURE(v.key.tile_bits);
  CAPTURE(v.key.depth_bits);
  Stage stage(attributes, static_cast<std::uint32_t>(scene.n), v, options.extent);
  for (const FrontEnd how : kFrontEnds) {
    CAPTURE(name_of(how));
    check(stage.run(how), scene, v, options.extent, how);
  }
}

/// Keys of 32 bits, of 64, and of 32 bits of depth for one tile, in turn.
Arithmetic with_key(int i, Extent extent) {
  Arithmetic o{.extent = extent};
  if (i % 2 == 0) o.depth_order = DepthOrder::quantized;
  return o;
}

}  // namespace

TEST_CASE("front ends agree with the host at every size of the grid, FP32 and compact") {
  if (!device_answers()) return;
  std::vector<int> sizes{0, 1, 255, 256, 257, 10000};
  if (small_sizes()) sizes.back() = 600;
  if (race_sizes()) sizes = {1, 257};
  Random random(101);
  int turn = 0;
  for (const int n : sizes) {
    const auto cloud = cloud_of(random_splats(static_cast<unsigned>(200 + n), n), 3);
    const Camera camera = random_camera(random, 200, 120);
    const Scene scene = scene_of(cloud);
    const DeviceAttributes fp32(scene.view().value());
    const auto compact = CompactScene::of(cloud);
    const DeviceAttributes packed(compact.file);
    for (const auto extent : {Extent::square, Extent::ellipse}) {
      check_all(fp32.get(), scene.view().value(), camera, with_key(turn++, extent));
      check_all(packed.get(), compact.scene.view().value(), camera, with_key(turn++ / 2, extent));
    }
  }
}

TEST_CASE("front ends agree with the host on 300,000 Gaussians of a scene") {
  if (!device_answers()) return;
  const auto n = sized<std::uint64_t>(300000, 3000, 1000);
  std::vector<Splat> splats(n);
  SceneGenerator(7, n, 3).generate(0, splats);
  const auto cloud = cloud_of(splats, 3);
  const auto cameras = parse_camera_json(scene_cameras_json(640, 360));
  require_ok(cameras);
  const auto compact = CompactScene::of(cloud);
  const Scene scene = scene_of(cloud);
  check_all(DeviceAttributes(scene.view().value()).get(), scene.view().value(), cameras->cameras[0],
            with_key(1, Extent::square));
  check_all(DeviceAttributes(compact.file).get(), compact.scene.view().value(), cameras->cameras[3],
            with_key(0, Extent::ellipse));
}

TEST_CASE(
    "colours match to the rounding of their sums in every degree and limit, FP32 and with steps per chunk and per "
    "file") {
  if (!device_answers()) return;
  const int n = small_sizes() ? 300 : 5000;
  Random random(102);
  for (int degree = 0; degree <= 3; ++degree) {
    const auto cloud = cloud_of(random_splats(static_cast<unsigned>(300 + degree), n), degree);
    const Scene scene = scene_of(cloud);
    const DeviceAttributes fp32(scene.view().value());
    for (int limit = 0; limit <= 3; ++limit) {
      if (race_sizes() && limit != degree) continue;
      const Camera camera = random_camera(random, 96, 64);
      check_all(fp32.get(), scene.view().value(), camera, {.sh_degree_limit = limit});
    }
    for (const std::uint32_t chunk_size : {32u, 256u, 4096u}) {
      for (const bool chunk_step_sets : {true, false}) {
        if (race_sizes() && (chunk_size > 32 || !chunk_step_sets)) continue;  // with the same kernels
        CAPTURE(chunk_size);
        CAPTURE(chunk_step_sets);
        EncodeOptions options;
        options.chunk_size = chunk_size, options.chunk_step_sets = chunk_step_sets;
        const auto compact = CompactScene::of(cloud, options);
        const Camera camera = random_camera(random, 96, 64);
        check_all(DeviceAttributes(compact.file).get(), compact.scene.view().value(), camera,
                  {.sh_degree_limit = static_cast<int>(chunk_size) % 5 == 1 ? 1 : 3});
      }
    }
  }
}

TEST_CASE("front ends follow every option of the projection and the key") {
  if (!device_answers()) return;
  const auto splats = random_splats(103, small_sizes() ? 300 : 3000);
  const auto cloud = cloud_of(splats, 1);
  const Scene scene = scene_of(cloud);
  const DeviceAttributes fp32(scene.view().value());
  const auto compact = CompactScene::of(cloud);
  const DeviceAttributes packed(compact.file);
  Random random(104);
  const Arithmetic cases[] = {
      {.low_pass = 0},
      {.low_pass = 0.1F, .anti_aliasing = math::AntiAliasing::mip_splatting},
      {.near_plane = 2, .far_plane = 7, .extent = Extent::square},
      {.depth_order = DepthOrder::quantized, .depth_bits = 1},
      {.depth_order = DepthOrder::quantized, .depth_bits = 15, .depth_range = {2, 3}},
      {.depth_order = DepthOrder::quantized, .depth_bits = 32},
      {.depth_order = DepthOrder::quantized, .depth_mapping = DepthMapping::logarithmic},
      {.depth_order = DepthOrder::quantized, .depth_mapping = DepthMapping::logarithmic, .depth_bits = 30},
  };
  for (const Arithmetic& options : std::span(cases).first(race_sizes() ? 3 : std::size(cases))) {
    const Camera camera = random_camera(random, 150, 110);
    check_all(fp32.get(), scene.view().value(), camera, options);
    check_all(packed.get(), compact.scene.view().value(), camera, options);
  }
  // One tile needs no tile bits: a narrow key holds 32 of depth, quantised or not.
  for (const auto order : {DepthOrder::exact, DepthOrder::quantized}) {
    for (const int side : {1, 16}) {
      if (race_sizes() && side > 1) continue;
      const Camera camera = random_camera(random, side, side);
      const auto v = view_parameters(camera, {.depth_order = order}, 1);
      CHECK(v.key.bits() == 32);
      check_all(fp32.get(), scene.view().value(), camera, {.depth_order = order});
    }
  }
}

TEST_CASE("front ends agree on Gaussians over the whole range of numbers") {
  if (!device_answers()) return;
  SplitMix random(105);
  Random views(106);
  for (int round = 0; round < sized(20, 3, 2); ++round) {
    const auto cloud = random_cloud(700, round % 4, random);
    const Camera camera = random_camera(views, 130, 70);
    const Scene scene = scene_of(cloud);
    CAPTURE(round);
    const auto extent = round % 2 == 0 ? Extent::square : Extent::ellipse;
    check_all(DeviceAttributes(scene.view().value()).get(), scene.view().value(), camera, {.extent = extent});
    const auto compact = CompactScene::of(cloud);
    check_all(DeviceAttributes(compact.file).get(), compact.scene.view().value(), camera, {.extent = extent});
  }
}

TEST_CASE("sums of tile counts exceed 32 bits") {
  if (!device_answers()) return;
  for (const std::uint32_t n : {1u, 255u, 257u, 5000u, 300000u}) {
    if (small_sizes() && n > 5000) continue;
    std::vector<std::uint32_t> tiles(n);
    SplitMix random(n);
    for (auto& t : tiles) t = static_cast<std::uint32_t>(random.below(random.below(3) == 0 ? 1u << 24 : 40u));
    const DeviceArray<std::uint32_t> from{std::span<const std::uint32_t>(tiles)};
    DeviceArray<std::uint64_t> to(n);
    const auto bytes = cuda::sum_bytes(n);
    require_ok(bytes);
    DeviceArray<std::byte> temporary(*bytes);
    require_ok(cuda::launch_sum(from.data(), to.data(), n, temporary.data(), *bytes, nullptr));
    const auto sums = to.download();
    std::uint64_t sum = 0, n_wrong = 0;
    for (std::uint32_t i = 0; i < n; ++i) n_wrong += sums[i] != (sum += tiles[i]);
    CHECK_MESSAGE(n_wrong == 0, n_wrong, " of ", n, " sums differ; the last is ", sums.back(), " instead of ", sum);
  }
}
