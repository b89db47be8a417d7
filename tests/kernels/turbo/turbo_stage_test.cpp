// turbo_stage_test.cpp - the turbo pipeline's lists on the device, against rgs::math on the host, and long lists.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <random>

#include "device_fixture.hpp"
#include "random_cloud.hpp"
#include "rgs/cuda_renderer.hpp"
#include "stage_reference.hpp"
#include "turbo/turbo.hpp"

using namespace rgs;
using namespace rgs::test;
using cuda::ScreenSplat;
using cuda::TurboEntry;
using cuda::TurboState;

namespace {

/// Page-locked memory for the returned numbers.
class Seen {
 public:
  Seen() { require_cuda(cudaMallocHost(reinterpret_cast<void**>(&state_), sizeof(TurboState))); }
  ~Seen() { cudaFreeHost(state_); }
  Seen(const Seen&) = delete;
  Seen& operator=(const Seen&) = delete;
  TurboState* state() { return state_; }

 private:
  TurboState* state_ = nullptr;
};

struct Lists {
  std::vector<ScreenSplat> splats;
  std::vector<std::vector<TurboEntry>> tiles;  // in order
  TurboState state;
  std::uint32_t n_units = 0, n_shares = 0;  // of long lists; units with a share of a bin
};

struct Room {
  std::uint64_t entries = 0, runs = 0, large = 0;
  std::uint64_t in_cells = 0;  // 0: for all
  bool is_sparse = false;      // ordered as if few tiles had lists
  bool in_pairs = false;       // two Gaussians a thread
};

template <class T>
std::vector<T> downloaded(const T* from, std::size_t n) {
  std::vector<T> values(n);
  if (n > 0) require_cuda(cudaMemcpy(values.data(), from, n * sizeof(T), cudaMemcpyDeviceToHost));
  return values;
}

/// Units of a long list ascend in depth, together hold the whole list, and exceed the round's size only by chance.
/// `entries` are the list's in order. Returns the number of units.
std::uint32_t check_units(const cuda::TurboLongList& list, std::uint32_t own, const std::vector<cuda::TurboUnit>& units,
                          const std::vector<TurboEntry>& scratch, const std::vector<TurboEntry>& entries) {
  std::array<std::uint32_t, cuda::kTurboCells> in_cells{};
  for (const TurboEntry entry : entries) {
    for (std::size_t c = 0; c < in_cells.size(); ++c)
      in_cells[c] += cuda::touches(entry, static_cast<std::uint32_t>(c));
  }
  CHECK(std::equal(in_cells.begin(), in_cells.end(), std::begin(list.cell_n)));
  const auto n = static_cast<std::uint32_t>(entries.size());
  std::uint32_t unit = list.first_unit;
  for (std::uint32_t begin = 0; begin < n;) {
    REQUIRE(unit < units.size());
    const std::uint32_t end = units[unit].end - list.scratch;
    REQUIRE(end > begin);
    REQUIRE(end <= n);
    const std::uint32_t n_shares = cuda::turbo_shares(end - begin);
    REQUIRE(unit + n_shares <= units.size());
    for (std::uint32_t share = 0; share < n_shares; ++share, ++unit) {
      CHECK(units[unit].begin == list.scratch + begin);
      CHECK(units[unit].end == list.scratch + end);
      CHECK(units[unit].long_list == own);
      CHECK(units[unit].share == share);
    }
    std::vector<TurboEntry> part(scratch.begin() + list.scratch + begin, scratch.begin() + list.scratch + end);
    std::sort(part.begin(), part.end());
    CHECK_MESSAGE(std::equal(part.begin(), part.end(), entries.begin() + begin), "entries ", begin, " to ", end);
    // The list is too long because of its last bin alone: of a very long list that holds one depth, or few others.
    if (n >= cuda::kTurboSampledList) {
      std::size_t most = 0, run = 0;
      for (std::size_t k = 0; k < part.size(); ++k) {
        run = k > 0 && cuda::depth_of(part[k]) == cuda::depth_of(part[k - 1]) ? run + 1 : 1;
        most = std::max(most, run);
      }
      CHECK(part.size() - most <= cuda::kTurboPart + n / 6);
    } else if (end - begin > 2 * cuda::kTurboPart) {
      const auto within = [&](TurboEntry e) { return std::clamp(cuda::depth_of(e), list.nearest, list.farthest); };
      CHECK(within(part.back()) - within(part[cuda::kTurboPart]) <=
            2 * (list.farthest - list.nearest) / cuda::kTurboBins);
    }
    begin = end;
  }
  return unit - list.first_unit;
}

/// Cells lie at their tile's rank and hold, in order, the list's entries that touch them, or nothing if there is no
/// room. Returns the number of their entries, and of cells left empty.
struct CellCount {
  std::uint64_t total = 0, refused = 0;
};
CellCount check_cells(const std::vector<cuda::TurboCell>& cells, const std::vector<std::uint32_t>& gaussians,
                      const std::vector<std::vector<TurboEntry>>& tiles, const std::vector<std::size_t>& rank_of,
                      math::TileGrid grid) {
  const auto columns = static_cast<std::size_t>(grid.columns);
  CellCount count;
  std::uint64_t n_wrong = 0;
  for (std::size_t t = 0; t < tiles.size(); ++t) {
    for (std::size_t c = 0; c < cuda::kTurboCells; ++c) {
      const cuda::TurboCell& cell = cells[cuda::kTurboCells * rank_of[t] + c];
      std::vector<std::uint32_t> expected;
      for (const TurboEntry entry : tiles[t]) {
        if (cuda::touches(entry, static_cast<std::uint32_t>(c))) expected.push_back(cuda::index_of(entry));
      }
      count.total += expected.size();
      const std::size_t row = c / cuda::kTurboCellColumns, column = c % cuda::kTurboCellColumns;
      n_wrong += cell.x != t % columns * cuda::kTurboTile + column * cuda::kTurboCellWidth ||
                 cell.y != t / columns * cuda::kTurboTile + row * cuda::kTurboCellHeight;
      if (cell.n == 0) {
        count.refused += !expected.empty();
        continue;
      }
      REQUIRE(std::uint64_t{cell.begin} + cell.n <= gaussians.size());
      const auto begin = gaussians.begin() + cell.begin;
      if (!std::equal(begin, begin + cell.n, expected.begin(), expected.end())) ++n_wrong;
    }
  }
  CHECK_MESSAGE(n_wrong == 0, n_wrong, " cells show something else than the list of their tile says");
  return count;
}

/// Emits, lists and orders within the given room. Nothing may be written beyond it, and lists that do not fit stay
/// empty.
Lists run(const cuda::Attributes& attributes, std::uint32_t n, const cuda::ViewParameters& v, const Room& room) {
  const auto n_tiles = static_cast<std::uint32_t>(v.grid.columns * v.grid.rows);
  DeviceArray<std::byte> state(TurboState::bytes(n_tiles));
  state.fill(0);
  const DeviceArray<TurboEntry> entries(room.entries), scratch(room.entries);
  const DeviceArray<cuda::TurboTileRun> runs(room.runs);
  const DeviceArray<cuda::TurboRun> tile_runs(room.runs);
  const DeviceArray<cuda::TurboLargeGaussian> large(room.large);
  const DeviceArray<cuda::TurboBox> boxes(room.large);
  const DeviceArray<cuda::TurboList> tile_lists(n_tiles);
  const DeviceArray<cuda::TurboRankedList> ranked(n_tiles);
  const DeviceArray<ScreenSplat> splats(n);
  cuda::TurboArrays arrays{};
  arrays.state = reinterpret_cast<TurboState*>(state.data());
  arrays.n_tiles = n_tiles;
  arrays.entries = entries.data(), arrays.scratch = scratch.data();
  arrays.runs = runs.data(), arrays.tile_runs = tile_runs.data();
  arrays.large_gaussians = large.data(), arrays.large_boxes = boxes.data();
  arrays.lists = tile_lists.data(), arrays.ranked = ranked.data();
  arrays.entry_capacity = room.entries, arrays.run_capacity = room.runs, arrays.large_capacity = room.large;
  arrays.cell_capacity = room.in_cells > 0 ? room.in_cells : cuda::kTurboCells * room.entries;
  const DeviceArray<std::uint32_t> cell_gaussians(arrays.cell_capacity);
  arrays.cell_gaussians = cell_gaussians.data();
  const auto sizes = cuda::TurboLongListSizes::of(room.entries, room.runs);
  const DeviceArray<std::byte> long_lists(sizes.bytes());
  sizes.lay_out(long_lists.data(), arrays);
  const DeviceArray<cuda::TurboCell> cells(std::size_t{n_tiles} * cuda::kTurboCells);
  arrays.cells = cells.data();
  Seen seen;
  require_ok(cuda::launch_turbo_emit({attributes, n, v, splats.data(), arrays, {}, room.in_pairs}, nullptr));
  require_ok(cuda::launch_turbo_lists(arrays, v.grid, seen.state(), nullptr));
  require_ok(cuda::launch_turbo_long_lists(arrays, v.grid, seen.state(), nullptr));
  require_ok(cuda::launch_turbo_units(arrays, nullptr));
  require_ok(cuda::launch_turbo_order(arrays, v.grid, seen.state(), room.is_sparse, nullptr));
  synchronize();

  Lists out;
  out.state = *seen.state();
  out.splats = splats.download();
  const auto host_entries = entries.download();
  const auto host_runs = tile_runs.download();
  const auto host_lists = tile_lists.download();
  const auto host_ranked = ranked.download();
  const auto host_state = state.download();
  runs.check_guards();
  large.check_guards();
  boxes.check_guards();
  scratch.check_guards();
  long_lists.check_guards();
  const bool fits = out.state.counters.instances <= room.entries && out.state.runs <= room.runs &&
                    out.state.n_large_gaussians <= room.large;
  out.tiles.resize(n_tiles);
  std::uint64_t n_listed = 0;
  for (std::uint32_t t = 0; t < n_tiles; ++t) {
    const auto& list = host_lists[t];
    n_listed += list.n_entries;
    if (!fits) continue;
    for (std::uint64_t r = list.begin; r < std::uint64_t{list.begin} + list.n_runs; ++r) {
      REQUIRE_MESSAGE(r < host_runs.size(), "tile ", t, " has run ", r, " of ", host_runs.size());
      const auto& run = host_runs[r];
      REQUIRE_MESSAGE(std::uint64_t{run.begin} + run.n <= host_entries.size(), "tile ", t, ", run ", r, ": entries ",
                      run.begin, " + ", run.n, " of ", host_entries.size());
      out.tiles[t].insert(out.tiles[t].end(), host_entries.begin() + run.begin,
                          host_entries.begin() + run.begin + run.n);
    }
    CHECK_MESSAGE(out.tiles[t].size() == list.n_entries, "tile ", t, ": runs of ", out.tiles[t].size(), " entries, ",
                  list.n_entries, " counted");
    std::sort(out.tiles[t].begin(), out.tiles[t].end());
  }
  CHECK(n_listed == (fits ? out.state.counters.instances : 0));

  TurboState final_state;
  std::memcpy(&final_state, host_state.data(), sizeof final_state);
  const auto host_scratch = scratch.download();
  const auto host_longs = downloaded(arrays.long_lists, sizes.lists);
  const auto host_units = downloaded(arrays.units, final_state.n_units);
  REQUIRE(final_state.n_long_lists <= sizes.lists);
  REQUIRE(final_state.n_units <= sizes.units);
  CHECK(final_state.n_slices <= sizes.slices);
  std::vector<std::size_t> rank_of(n_tiles);
  for (std::uint32_t r = 0; r < n_tiles; ++r) {
    const cuda::TurboRankedList& list = host_ranked[r];
    REQUIRE(list.tile < n_tiles);
    rank_of[list.tile] = r;
    const cuda::TurboList& own = host_lists[list.tile];
    CHECK((list.begin == own.begin && list.n_runs == own.n_runs && list.n_entries == own.n_entries));
  }
  const CellCount in_cells = check_cells(cells.download(), cell_gaussians.download(), out.tiles, rank_of, v.grid);
  CHECK(out.state.in_cells == in_cells.total);
  CHECK((in_cells.refused > 0) == (in_cells.total > arrays.cell_capacity));
  if (in_cells.refused > 0) return out;  // lists that do not fit have no units
  for (std::uint32_t t = 0; t < n_tiles && fits; ++t) {
    if (out.tiles[t].size() < cuda::kTurboRound) continue;
    REQUIRE(host_lists[t].number < final_state.n_long_lists);
    REQUIRE(rank_of[t] < final_state.n_long_lists);
    const cuda::TurboLongList& list = host_longs[host_lists[t].number];
    CHECK(list.tile == t);
    out.n_units += check_units(list, host_lists[t].number, host_units, host_scratch, out.tiles[t]);
  }
  CHECK(out.n_units == final_state.n_units);
  out.n_shares = static_cast<std::uint32_t>(
      std::count_if(host_units.begin(), host_units.end(), [](const auto& unit) { return unit.share > 0; }));

  // Every tile has one rank, and longer lists come first, class by class.
  std::vector<int> seen_tiles(n_tiles, 0);
  std::uint32_t falling = 0;
  for (std::uint32_t r = 0; r < n_tiles; ++r) {
    ++seen_tiles[host_ranked[r].tile];
    falling += r > 0 && cuda::turbo_class(host_ranked[r].n_entries) < cuda::turbo_class(host_ranked[r - 1].n_entries);
  }
  CHECK(std::all_of(seen_tiles.begin(), seen_tiles.end(), [](int count) { return count == 1; }));
  CHECK_MESSAGE(falling == 0, falling, " ranks have a longer list than the one before");
  return out;
}

/// The region without math::ellipse()'s slack for rounding, which chunk culling may ignore: it lists needles in tiles
/// where none of their pixels reaches 1/255.
math::Ellipse<float> without_slack(math::Ellipse<float> e, float cutoff) {
  const float level = std::min(e.level, -2 * cutoff), shrink = std::sqrt(level / e.level);
  e.level = level;
  e.half_width *= shrink, e.half_height *= shrink, e.shear *= shrink;
  return e;
}

/// A Gaussian's entries, by tile.
template <class F>
void for_each_entry(const math::Projected<float>& p, const math::Ellipse<float>& ellipse, std::uint64_t i,
                    math::TileGrid grid, const F& f) {
  const auto rect = math::bounding_tiles<cuda::kTurboTile>(ellipse, grid);
  if (rect.empty()) return;
  for (int row = rect.y0; row < rect.y1; ++row) {
    const auto cells = cuda::cell_rows(ellipse, row);
    for (int column = rect.x0; column < rect.x1; ++column) {
      const std::uint32_t touched = cuda::cells_of_tile(cells, column);
      if (touched == 0) continue;
      f(static_cast<std::size_t>(row * grid.columns + column),
        cuda::make_entry(cuda::turbo_depth(p.z, math::kNearPlane), static_cast<std::uint32_t>(i), touched));
    }
  }
}

/// An image of this many pixels for tiles 32 wide; of as many tiles in builds with other tiles.
Camera front_camera_of_tiles(int width, int height) {
  return front_camera(width * cuda::kTurboTile / 32, height * cuda::kTurboTile / 32);
}
Camera one_tile() {
  return front_camera(cuda::kTurboTile, cuda::kTurboTile);
}

Lists check(const cuda::Attributes& attributes, const SceneView& scene, const Camera& camera, bool in_pairs) {
  auto v = view_parameters(camera, {}, scene.sh_degree);
  v.grid = math::tile_grid<cuda::kTurboTile>(camera.width, camera.height);
  const auto n = static_cast<std::uint32_t>(scene.n);
  CAPTURE(n);
  CAPTURE(camera.width);
  CAPTURE(std::holds_alternative<cuda::CompactAttributes>(attributes));
  CAPTURE(in_pairs);
  // The renderer's way to size its room: first it counts the large Gaussians, then all entries.
  Room room{.in_pairs = in_pairs};
  room.large = run(attributes, n, v, room).state.n_large_gaussians;
  const TurboState counted = run(attributes, n, v, room).state;
  room.entries = counted.counters.instances, room.runs = counted.runs;
  const auto run_in = [&](Room other, auto Room::*changed, auto value) {
    other.*changed = value;
    (void)run(attributes, n, v, other);
  };
  if (room.entries > 0) run_in(room, &Room::entries, room.entries - 1);
  if (room.runs > 0) run_in(room, &Room::runs, room.runs - 1);
  // Atomic additions order the large Gaussians, and so decide how they share runs.
  room.runs *= 2;
  Lists lists = run(attributes, n, v, room);
  CHECK(lists.state.counters.instances == room.entries);
  run_in(room, &Room::is_sparse, true);
  if (lists.state.in_cells > 1) run_in(room, &Room::in_cells, lists.state.in_cells - 1);

  Deviations deviations;
  std::vector<std::vector<TurboEntry>> expected(lists.tiles.size());
  std::uint64_t n_missing = 0, first_missing = 0, n_visible = 0;
  for (std::uint64_t i = 0; i < scene.n; ++i) {
    const auto p = project(scene, i, v);
    const ScreenSplat& s = lists.splats[i];
    if (untouched(s)) {
      if (!p.footprint.valid) continue;
      const float cutoff = tighter(math::power_cutoff(p.footprint.opacity));
      if (cutoff >= 0) continue;
      const auto region = without_slack(math::ellipse(p.mean, p.footprint, cutoff), cutoff);
      // The last tiles reach beyond the image; Gaussians that touch them only there may be culled too.
      if (region.mean.u - region.half_width > static_cast<float>(camera.width - 1) ||
          region.mean.v - region.half_height > static_cast<float>(camera.height - 1)) {
        continue;
      }
      for_each_entry(p, region, i, v.grid, [&](std::size_t, TurboEntry) {
        if (n_missing++ == 0) first_missing = i;
      });
      continue;
    }
    compare_splat(i, s, scene, v, deviations);
    bool any = false;
    const auto ellipse = math::ellipse(p.mean, p.footprint, s.cutoff);
    for_each_entry(p, ellipse, i, v.grid, [&](std::size_t tile, TurboEntry entry) {
      expected[tile].push_back(entry);
      any = true;
    });
    n_visible += any;
  }
  CHECK_MESSAGE(deviations.first.empty(), deviations.first);
  CHECK(lists.state.counters.visible == n_visible);
  CHECK_MESSAGE(n_missing == 0, n_missing, " entries of the host belong to Gaussians that the device passed over, ",
                "the first to ", first_missing);
  std::uint64_t n_wrong = 0;
  std::size_t wrong = 0;
  for (std::size_t t = 0; t < expected.size(); ++t) {
    std::sort(expected[t].begin(), expected[t].end());
    if (lists.tiles[t] != expected[t] && n_wrong++ == 0) wrong = t;
  }
  CHECK_MESSAGE(n_wrong == 0, n_wrong, " of ", expected.size(), " lists differ; that of tile ", wrong, " has ",
                lists.tiles[wrong].size(), " entries on the device, ", expected[wrong].size(), " on the host");
  return lists;
}
Lists check(const cuda::Attributes& attributes, const SceneView& scene, const Camera& camera) {
  (void)check(attributes, scene, camera, true);
  return check(attributes, scene, camera, false);
}

/// The front end's entries by tile, against the host's. Nothing is ordered, so that images of many tiles stay cheap.
void check_emitted(const Scene& scene, const Camera& camera) {
  const SceneView view = scene.view().value();
  auto v = view_parameters(camera, {}, view.sh_degree);
  v.grid = math::tile_grid<cuda::kTurboTile>(camera.width, camera.height);
  const auto n = static_cast<std::uint32_t>(view.n);
  const auto n_tiles = static_cast<std::uint32_t>(v.grid.columns * v.grid.rows);
  CAPTURE(n_tiles);
  constexpr std::size_t kRoom = 1 << 19;
  const DeviceAttributes attributes(view);
  DeviceArray<std::byte> state(TurboState::bytes(n_tiles));
  state.fill(0);
  const DeviceArray<TurboEntry> entries(kRoom);
  const DeviceArray<cuda::TurboTileRun> runs(kRoom);
  const DeviceArray<cuda::TurboLargeGaussian> large(n);
  const DeviceArray<cuda::TurboBox> boxes(n);
  const DeviceArray<ScreenSplat> splats(n);
  cuda::TurboArrays arrays{};
  arrays.state = reinterpret_cast<TurboState*>(state.data());
  arrays.n_tiles = n_tiles;
  arrays.entries = entries.data(), arrays.runs = runs.data();
  arrays.large_gaussians = large.data(), arrays.large_boxes = boxes.data();
  arrays.entry_capacity = arrays.run_capacity = kRoom, arrays.large_capacity = n;
  require_ok(cuda::launch_turbo_emit({attributes.get(), n, v, splats.data(), arrays}, nullptr));

  TurboState counted;
  std::memcpy(&counted, state.download().data(), sizeof counted);
  REQUIRE(counted.counters.instances <= kRoom);
  REQUIRE(counted.runs <= kRoom);
  CHECK(counted.n_large_gaussians > 0);
  const auto host_entries = entries.download();
  const auto host_runs = runs.download();
  const auto host_splats = splats.download();
  std::vector<std::vector<TurboEntry>> found(n_tiles), expected(n_tiles);
  for (std::uint64_t r = 0; r < counted.runs; ++r) {
    const cuda::TurboTileRun& run = host_runs[r];
    REQUIRE(run.tile < n_tiles);
    REQUIRE(std::uint64_t{run.run.begin} + run.run.n <= counted.counters.instances);
    const auto begin = host_entries.begin() + run.run.begin;
    found[run.tile].insert(found[run.tile].end(), begin, begin + run.run.n);
  }
  std::uint64_t n_expected = 0;
  for (std::uint64_t i = 0; i < view.n; ++i) {
    if (untouched(host_splats[i])) continue;
    const auto p = project(view, i, v);
    for_each_entry(p, math::ellipse(p.mean, p.footprint, host_splats[i].cutoff), i, v.grid,
                   [&](std::size_t tile, TurboEntry entry) {
                     expected[tile].push_back(entry);
                     ++n_expected;
                   });
  }
  CHECK(n_expected > 0);
  CHECK(counted.counters.instances == n_expected);
  std::uint64_t n_wrong = 0;
  for (std::uint32_t t = 0; t < n_tiles; ++t) {
    std::sort(found[t].begin(), found[t].end());
    std::sort(expected[t].begin(), expected[t].end());
    n_wrong += found[t] != expected[t];
  }
  CHECK_MESSAGE(n_wrong == 0, n_wrong, " of ", n_tiles, " tiles have other entries than on the host");
}

}  // namespace

TEST_CASE("turbo's lists match the host's, FP32 and compact, whatever the room") {
  if (!device_answers()) return;
  Random random(801);
  for (const int n : {0, 1, 255, 256, 257, 3000, 30000}) {
    if (small_sizes() && n > 300) continue;
    if (race_sizes() && n != 257) continue;
    const auto cloud = cloud_of(random_splats(static_cast<unsigned>(800 + n), n), 2);
    const Scene scene = scene_of(cloud);
    EncodeOptions options;
    options.chunk_size = n % 2 == 0 ? 32 : 256;
    const auto compact = CompactScene::of(cloud, options);
    for (const int width : {33, sized(700, 700, 200)}) {
      const Camera camera = random_camera(random, width, 200);
      check(DeviceAttributes(scene.view().value()).get(), scene.view().value(), camera);
      check(DeviceAttributes(compact.file).get(), compact.scene.view().value(), camera);
    }
  }
}

TEST_CASE("culled chunks hold nothing that the host lists") {
  if (!device_answers()) return;
  Random random(802);
  const auto cloud = cloud_of(random_splats(803, small_sizes() ? 600 : 20000));
  for (const std::uint32_t chunk_size : {32u, 256u}) {
    EncodeOptions options;
    options.chunk_size = chunk_size;
    const auto compact = CompactScene::of(cloud, options);
    const DeviceAttributes attributes(compact.file);
    for (int turn = 0; turn < sized(16, 3, 1); ++turn) {
      // From inside, in every direction and with narrow views, so that chunks cross each edge of the image.
      Camera camera = front_camera(160, 130);
      camera.fx = camera.fy = random.log_uniform(60, 800);
      camera.world_to_camera = from_row_major(rigid(random.rotation(), random.vector(-4, 4)));
      check(attributes.get(), compact.scene.view().value(), camera);
    }
  }
  SplitMix wild(804);
  for (int round = 0; round < sized(12, 2, 1); ++round) {
    const auto extreme = CompactScene::of(random_cloud(700, round % 4, wild));
    check(DeviceAttributes(extreme.file).get(), extreme.scene.view().value(), random_camera(random, 130, 70));
  }
}

namespace {

// Gaussians of every shape before front_camera() that cover a few tiles up to the whole image.
std::vector<Splat> large_splats(int n, Random& random) {
  std::vector<Splat> splats;
  for (int i = 0; i < n; ++i) {
    const double z = random.uniform(2, 9), reach = i % 16 == 0 ? 4 : random.log_uniform(0.02, 1);
    Splat s = splat_at(random.uniform(-0.7, 0.7) * z, random.uniform(-0.6, 0.6) * z, z, 0.3 * reach * z, 0.02,
                       static_cast<float>(random.uniform(0, 1)));
    if (i % 3 == 0) s.log_scale[0] -= 4;  // needles
    if (i % 5 == 0) s.log_scale[1] -= 3;
    splats.push_back(s);
  }
  return splats;
}

}  // namespace

TEST_CASE("Gaussians of many tiles are listed part by part, up to all tiles at 4K") {
  if (!device_answers()) return;
  Random random(806);
  std::vector<std::array<int, 3>> sizes{{40, 3840, 2160}, {600, 1920, 1080}};
  if (small_sizes()) sizes = {{600, 1920, 1080}};
  if (race_sizes()) sizes = {{60, 640, 640}};
  for (const auto& [n, width, height] : sizes) {
    const auto cloud = cloud_of(large_splats(n, random));
    const Scene scene = scene_of(cloud);
    const auto compact = CompactScene::of(cloud);
    const Camera camera = front_camera(width, height);
    check(DeviceAttributes(scene.view().value()).get(), scene.view().value(), camera);
    check(DeviceAttributes(compact.file).get(), compact.scene.view().value(), camera);
  }
}

TEST_CASE("blocks leave Gaussians beyond their room to the tiles") {
  if (!device_answers()) return;
  Random random(808);
  std::vector<Splat> splats;
  for (int i = 0; i < sized(700, 700, 260); ++i) {  // about 30 tiles each at 1080p, more than a block's room
    const double z = random.uniform(2, 9);
    splats.push_back(splat_at(random.uniform(-0.6, 0.6) * z, random.uniform(-0.6, 0.6) * z, z, 0.04 * z, 0.02));
  }
  const Scene wide = scene_of(cloud_of(splats));
  check(DeviceAttributes(wide.view().value()).get(), wide.view().value(), front_camera_of_tiles(1920, 1080));
}

TEST_CASE("blocks leave Gaussians that lie too far apart to the tiles") {
  if (!device_answers()) return;
  Random random(813);
  std::vector<Splat> splats;
  for (int i = 0; i < sized(700, 700, 260); ++i) {
    const double z = random.uniform(2, 9);
    splats.push_back(splat_at(random.uniform(-0.6, 0.6) * z, random.uniform(-0.6, 0.6) * z, z, 3e-4 * z, 0.02));
  }
  const Scene sparse = scene_of(cloud_of(splats));  // 79,524 tiles: more than a block's candidates can address
  const Camera camera = front_camera_of_tiles(9000, 9000);
  check_emitted(sparse, camera);
  if (!small_sizes()) check(DeviceAttributes(sparse.view().value()).get(), sparse.view().value(), camera);
}

TEST_CASE("large Gaussians are listed by regions of every size") {
  if (!device_answers()) return;
  // launch_turbo_large_gaussians() enlarges its regions where an image has more tiles than this, and than four times as
  // many.
  int device = 0, n_multiprocessors = 0;
  require_cuda(cudaGetDevice(&device));
  require_cuda(cudaDeviceGetAttribute(&n_multiprocessors, cudaDevAttrMultiProcessorCount, device));
  constexpr std::uint32_t kRegionTiles = 2 * cuda::kTurboStripTiles;
  const std::uint32_t most_tiles = std::bit_floor(4 * static_cast<std::uint32_t>(n_multiprocessors)) * kRegionTiles;
  const int side = static_cast<int>(std::sqrt(most_tiles));
  for (const int tiles : {side, 2 * side, 2 * side + 2}) {
    const int pixels = tiles * cuda::kTurboTile;
    const Camera camera = front_camera(pixels, pixels);
    Random random(814);
    std::vector<Splat> splats;
    const double z = 4, pixel = z / camera.fx;
    for (int i = 0; i < 160; ++i) {  // ten tiles wide, in one region or at its edges: more than one batch of a region
      const double scale = 1.5 * cuda::kTurboTile * pixel;
      splats.push_back(splat_at(random.uniform(-60, 60) * pixel, random.uniform(-60, 60) * pixel, z, scale, 0.5));
    }
    for (int i = 0; i < 4; ++i) splats.push_back(splat_at(random.uniform(-1, 1), 0, z, 3, 0.5));  // all tiles
    check_emitted(scene_of(cloud_of(splats)), camera);
  }
}

TEST_CASE("a frame with more entries than room is drawn again, with room for large Gaussians' entries") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  Random random(807);
  auto splats = large_splats(2000, random);
  for (Splat& s : splats) s.log_scale[0] += 3, s.log_scale[1] += 3, s.log_scale[2] += 3;
  const Scene scene = scene_of(cloud_of(splats));
  const Camera camera = front_camera_of_tiles(1920, 1080);
  FrameStats stats;
  const auto draw = [&](const RenderOptions& options) {
    return render(scene, camera, options, {.backend = Backend::cuda});
  };
  const Frame turbo = draw(turbo_options());
  CHECK(turbo.stats.instances > 1u << 20);  // the renderer's initial room
  CHECK(psnr(turbo.rgb, draw(Arithmetic{.exponent = math::Exponent::folded}).rgb) >= 60);
}

namespace {

// Faint Gaussians before front_camera() of any size, so that no pixel stops early: half of them at one depth, the
// others at seven more and anywhere. With `far`: close behind it, except a few so distant that one bin of depth holds
// all the others.
std::vector<Splat> crowd(int n, bool far) {
  std::vector<Splat> splats;
  Random random(805);
  for (int i = 0; i < n; ++i) {
    const double close = far ? random.uniform(4, 4.1) : i % 4 == 1 ? 2 + i % 7 : random.uniform(2, 9);
    const double z = i % 2 == 0 ? 4 : far && i % 64 == 1 ? 1e12 : close;
    Splat s = splat_at(random.uniform(-0.6, 0.6) * z, random.uniform(-0.6, 0.6) * z, z, 0.02 * z, 0.03,
                       static_cast<float>(random.uniform(0, 1)));
    s.sh[1] = static_cast<float>(random.uniform(-1.7, 1.7));
    splats.push_back(s);
  }
  return splats;
}

}  // namespace

TEST_CASE("long lists are moved to scratch memory and ordered in units of ascending depth") {
  if (!device_answers()) return;
  std::vector<int> sizes{300, 1023, 1024, 1025, 2047, 2048, 2049, 5000, small_sizes() ? 12000 : 200000};
  if (race_sizes()) sizes = {2048, 5000};
  for (const int n : sizes) {
    for (const bool far : {false, true}) {
      CAPTURE(n);
      CAPTURE(far);
      const Scene scene = scene_of(cloud_of(crowd(n, far)));
      const Lists lists = check(DeviceAttributes(scene.view().value()).get(), scene.view().value(), one_tile());
      REQUIRE(lists.tiles.size() == 1);
      CHECK((lists.n_units > 0) == (lists.tiles[0].size() >= cuda::kTurboRound));
      if (n > 4000) CHECK(lists.n_units > 0);
      if (n > 4000 && far) CHECK(lists.n_shares > 0);
    }
  }
}

TEST_CASE("a few distant Gaussians do not crowd the rest of a very long list into a few bins") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  Random random(813);
  std::vector<Splat> splats;
  for (std::uint32_t i = 0; i < cuda::kTurboSampledList + 4000; ++i) {
    const double z = i % 400 == 0 ? std::exp(random.uniform(std::log(5), std::log(1e4))) : random.uniform(4, 4.4);
    splats.push_back(splat_at(random.uniform(-0.4, 0.4) * z, random.uniform(-0.4, 0.4) * z, z, 0.01 * z, 0.3));
  }
  const Scene scene = scene_of(cloud_of(splats));
  const Lists lists = check(DeviceAttributes(scene.view().value()).get(), scene.view().value(), one_tile());
  REQUIRE(lists.tiles[0].size() >= cuda::kTurboSampledList);
  // Bins of equal width would make 69. The sample follows the order of runs, which atomic additions decide: rarely, a
  // bin more is left too large.
  CHECK(lists.n_shares <= 8);
}

TEST_CASE("a list with more entries of one depth than a sample distinguishes is ordered in rounds") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  Random random(811);
  std::vector<Splat> splats;
  for (int i = 0; i < 1200000; ++i) {  // 1,024 shares of two samples each
    splats.push_back(splat_at(random.uniform(-2, 2), random.uniform(-2, 2), 4, 0.02, 0.03));
  }
  const Scene scene = scene_of(cloud_of(splats));
  CHECK(check(DeviceAttributes(scene.view().value()).get(), scene.view().value(), one_tile()).n_units > 1000);
}

namespace {

/// Whether units of so many shares deal a part's entries out in the order of the entries.
void check_units(const std::vector<TurboEntry>& part, std::uint32_t n_shares, int dropped = 0) {
  const auto n = static_cast<std::uint32_t>(part.size());
  std::vector<TurboEntry> in_order = part;
  std::sort(in_order.begin(), in_order.end());
  std::vector<std::uint32_t> expected;
  cuda::TurboLongList list{};
  for (std::uint32_t c = 0; c < cuda::kTurboCells; ++c) {
    list.cell_begin[c] = static_cast<std::uint32_t>(expected.size());
    for (const TurboEntry entry : in_order) {
      if (cuda::touches(entry, c)) expected.push_back(cuda::index_of(entry, dropped));
    }
  }
  std::vector<cuda::TurboUnit> units;
  for (std::uint32_t share = 0; share < n_shares; ++share) units.push_back({0, n, 0, share});
  TurboState begun{};
  begun.n_units = n_shares, begun.dropped = dropped;

  const DeviceArray<TurboState> state{std::span<const TurboState>(&begun, 1)};
  const DeviceArray<TurboEntry> scratch{std::span<const TurboEntry>(part)};
  const DeviceArray<cuda::TurboLongList> lists{std::span<const cuda::TurboLongList>(&list, 1)};
  const DeviceArray<cuda::TurboUnit> device_units{std::span<const cuda::TurboUnit>(units)};
  DeviceArray<std::uint32_t> unit_cells(std::size_t{n_shares} * cuda::kTurboCells);
  unit_cells.fill(0);
  const DeviceArray<std::uint32_t> gaussians(expected.size());
  cuda::TurboArrays arrays{};
  arrays.n_tiles = 1;
  arrays.state = state.data(), arrays.scratch = scratch.data(), arrays.long_lists = lists.data();
  arrays.units = device_units.data(), arrays.unit_cells = unit_cells.data();
  arrays.cell_gaussians = gaussians.data(), arrays.cell_capacity = expected.size();
  require_ok(cuda::launch_turbo_units(arrays, nullptr));
  CHECK(gaussians.download() == expected);
  unit_cells.check_guards();
}

}  // namespace

TEST_CASE("entries hold depths in their order and all indices, whatever the near plane") {
  for (const float near_plane : {0.0F, 1e-6F, 0.2F, 100.0F}) {
    CAPTURE(near_plane);
    std::uint32_t before = 0;
    for (float z = std::max(near_plane, 1e-6F); z < 1e11F * std::max(near_plane, 1.0F); z *= 1.07F) {
      for (const float next : {std::nextafter(z, INFINITY), std::nextafter(std::nextafter(z, INFINITY), INFINITY)}) {
        const std::uint32_t depth = cuda::turbo_depth(next, near_plane);
        REQUIRE(depth > before);
        before = depth;
      }
    }
    CHECK(cuda::turbo_depth(INFINITY, near_plane) == (1u << cuda::kTurboDepthBits) - 1);
  }
  for (const std::uint32_t n : {1u, 1u << 27, (1u << 27) + 1, 1u << 28, 100u << 24, ~0u >> 1}) {
    CAPTURE(n);
    const int dropped = cuda::turbo_dropped_bits(n);
    CHECK(dropped <= 4);
    CHECK(n <= std::uint64_t{1} << (cuda::kTurboIndexBits + dropped));
    CHECK((dropped == 0 || n > std::uint64_t{1} << (cuda::kTurboIndexBits + dropped - 1)));
    const TurboEntry last = cuda::make_entry(12345u << dropped, n - 1, 0xFF, dropped);
    CHECK(cuda::index_of(last, dropped) == n - 1);
    CHECK(cuda::depth_of(last, dropped) == 12345);
    CHECK(last < cuda::make_entry(12346u << dropped, 0, 0, dropped));
  }
}

TEST_CASE("a share that the sample makes too large is ordered in rounds") {
  if (!device_answers()) return;
  // The sample takes every second entry of this part. These are its first half in order, so that the last of four
  // shares gets the whole second half, too.
  constexpr std::uint32_t kRound = cuda::kTurboRound, kEntries = 2 * kRound, kUnits = 4;
  static_assert(cuda::turbo_shares(kEntries) == kUnits);
  for (const bool one_depth : {true, false}) {
    CAPTURE(one_depth);
    SplitMix random(812);
    std::vector<TurboEntry> part;
    for (std::uint32_t k = 0; k < kEntries; ++k) {
      const std::uint32_t index = k / 2 * 7919 % kRound + (k % 2 == 0 ? 0 : kRound);
      const auto cells = static_cast<std::uint32_t>(random.below(1u << cuda::kTurboCells));
      part.push_back(cuda::make_entry(cuda::turbo_depth(4, 0.2F) + (one_depth ? 0 : index), index, cells));
    }
    check_units(part, kUnits);
  }
}

TEST_CASE("units order equal depths by index, in a round and in more") {
  if (!device_answers()) return;
  for (const std::uint32_t n : {cuda::kTurboRound, 3 * cuda::kTurboRound - 5}) {
    // Depths of one, of a few, of a thousand Gaussians, and one depth of all; near each other, and far apart.
    for (const std::uint32_t each : {1u, 5u, 1000u, n}) {
      for (const std::uint32_t apart : {1u, 1u << 16}) {
        // Indices of more bits than 27 take bits of the depth.
        const int dropped = apart == 1 ? 0 : 4;
        CAPTURE(n);
        CAPTURE(each);
        CAPTURE(apart);
        SplitMix random(813);
        std::vector<TurboEntry> part;
        for (std::uint32_t k = 0; k < n; ++k) {
          const auto cells = static_cast<std::uint32_t>(random.below(1u << cuda::kTurboCells));
          const std::uint32_t index = (k + 1) * 340007 & ((1u << (cuda::kTurboIndexBits + dropped)) - 1);
          part.push_back(cuda::make_entry(cuda::turbo_depth(4, 0.2F) + k / each * apart, index, cells, dropped));
        }
        std::shuffle(part.begin(), part.end(), std::mt19937(814));
        check_units(part, cuda::turbo_shares(n), dropped);
      }
    }
  }
}

TEST_CASE("lists longer than a round are still ordered, equal depths in the order of the scene") {
  if (!device_answers()) return;
  for (const bool far : {false, true}) {
    CAPTURE(far);
    const auto splats = crowd(sized(80000, 5000, 3000), far);
    const int size = small_sizes() ? 32 : 64;
    const auto render_with = [&](std::span<const Splat> list, const RenderOptions& options, Backend backend) {
      return render(scene_of(cloud_of(list)), front_camera(size, size), options, {.backend = backend, .simd = false});
    };
    const Frame host = render_with(splats, turbo_options(), Backend::cpu);
    const Frame device = render_with(splats, turbo_options(), Backend::cuda);
    const double quality = psnr(device.rgb, host.rgb);
    MESSAGE("long lists: ", quality, " dB, at most ", 255 * largest_difference(device.rgb, host.rgb),
            "/255 off the CPU");
    CHECK(quality >= 65);
    CHECK(largest_difference(device.rgb, host.rgb) <= 2.0 / 255);
    if (!far) CHECK(largest_difference(device.depth, host.depth) <= 0.01);
    auto reversed = splats;
    std::reverse(reversed.begin(), reversed.end());
    CHECK(psnr(render_with(reversed, turbo_options(), Backend::cuda).rgb,
               render_with(reversed, turbo_options(), Backend::cpu).rgb) >= 65);
  }
}

TEST_CASE("a depth beyond FP32 does not spread to pixels that its Gaussian does not touch") {
  if (!device_answers()) return;
  Random random(809);
  auto splats = random_splats(810, 300);
  for (Splat& s : splats) {
    if (&s - splats.data() < 3) s.mean[0] = s.mean[1] = s.mean[2] = 3e38F;  // 5e38 in front of the camera
  }
  Camera camera = front_camera(64, 64);
  const double a = 1 / std::sqrt(2.0), b = 1 / std::sqrt(3.0), c = 1 / std::sqrt(6.0);
  camera.world_to_camera = from_row_major({a, -a, 0, 0, c, c, -2 * c, 0, b, b, b, 4, 0, 0, 0, 1});
  const Scene scene = scene_of(cloud_of(splats));
  const Frame host = render(scene, camera, turbo_options(), {.backend = Backend::cpu, .simd = false});
  const Frame device = render(scene, camera, turbo_options(), {.backend = Backend::cuda});
  int n_infinite = 0, n_wrong = 0;
  for (std::size_t k = 0; k < host.depth.size(); ++k) {
    n_infinite += !std::isfinite(host.depth[k]);
    n_wrong += std::isfinite(host.depth[k]) && !(std::abs(device.depth[k] - host.depth[k]) <= 0.01F);
  }
  CHECK(n_infinite > 0);
  CHECK(n_infinite < 64 * 64 / 2);
  CHECK(n_wrong == 0);
}

namespace {

/// Blocks of the largest launch that launch(stream) enqueues, without running it.
template <class Launch>
unsigned largest_grid(const Launch& launch) {
  cudaStream_t stream = nullptr;
  cudaGraph_t graph = nullptr;
  require_cuda(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
  require_cuda(cudaStreamBeginCapture(stream, cudaStreamCaptureModeRelaxed));
  require_ok(launch(stream));
  require_cuda(cudaStreamEndCapture(stream, &graph));
  std::size_t n = 0;
  require_cuda(cudaGraphGetNodes(graph, nullptr, &n));
  std::vector<cudaGraphNode_t> nodes(n);
  require_cuda(cudaGraphGetNodes(graph, nodes.data(), &n));
  unsigned largest = 0;
  for (cudaGraphNode_t node : nodes) {
    cudaKernelNodeParams parameters{};
    require_cuda(cudaGraphKernelNodeGetParams(node, &parameters));
    largest = std::max(largest, parameters.gridDim.x);
  }
  require_cuda(cudaGraphDestroy(graph));
  require_cuda(cudaStreamDestroy(stream));
  return largest;
}

}  // namespace

TEST_CASE("kernels that learn their amount of work on the device fill it with blocks") {
  if (!device_answers()) return;
  int device = 0, n_multiprocessors = 0;
  require_cuda(cudaGetDevice(&device));
  require_cuda(cudaDeviceGetAttribute(&n_multiprocessors, cudaDevAttrMultiProcessorCount, device));
  const auto wanted = static_cast<unsigned>(n_multiprocessors);
  cuda::TurboArrays arrays{};
  arrays.n_tiles = 1;
  for (int turn = 0; turn < 2; ++turn) {  // queried, then kept
    const unsigned runs = largest_grid([&](auto on) { return cuda::launch_turbo_lists(arrays, {1, 1}, nullptr, on); });
    const unsigned slices = largest_grid([&](auto on) {
      return cuda::launch_turbo_long_lists(arrays, {1, 1}, nullptr, on);
    });
    const unsigned units = largest_grid([&](auto on) { return cuda::launch_turbo_units(arrays, on); });
    MESSAGE("blocks for runs, slices and units: ", runs, ", ", slices, ", ", units, " on ", wanted, " multiprocessors");
    for (const unsigned blocks : {runs, slices, units}) {
      CHECK(blocks >= wanted);
      CHECK(blocks % wanted == 0);
    }
  }
}
