// cut_test.cpp - levels of detail on the device: the host's cut, in its order, and the same pictures.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numeric>
#include <optional>
#include <set>

#include "common/cut.hpp"
#include "cuda/cuda_objects.hpp"
#include "cuda/page_upload.hpp"
#include "device_fixture.hpp"
#include "grid_scene.hpp"
#include "render_options.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/footprint.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "scene_of_pages.hpp"
#include "trivial_levels.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

/// A file with levels, its present part, and its leaves as a file without levels.
struct Levels {
  std::vector<std::byte> bytes, plain;

  static Levels of(const std::vector<Splat>& splats, int sh_degree, std::uint32_t chunk_size, std::uint32_t page_chunks,
                   Profile profile = Profile::direct) {
    EncodeOptions options;
    options.chunk_size = chunk_size;
    options.profile = profile;
    Levels levels;
    auto plain = encode(cloud_of(splats, sh_degree).view(), options);
    require_ok(plain);
    levels.plain = *std::move(plain);
    const auto cloud = decode(levels.plain);
    require_ok(cloud);
    options.order = Order::morton;
    require_ok(write_levels(trivial_levels(*cloud, {.chunk_size = chunk_size, .page_chunks = page_chunks}), options,
                            levels.bytes));
    return levels;
  }
  std::span<const std::byte> first_pages(std::uint32_t n) const {
    const auto file = PagedFile::open(bytes);
    require_ok(file);
    return std::span(bytes).first(n < file->n_pages() ? file->stored(n).offset : bytes.size());
  }
};

PagedFile open(std::span<const std::byte> bytes) {
  auto file = PagedFile::open(bytes);
  require_ok(file);
  return *std::move(file);
}
Scene load(std::span<const std::byte> bytes) {
  auto scene = Scene::load(bytes);
  require_ok(scene);
  return *std::move(scene);
}
template <class From>
DeviceScene upload(const From& from) {
  auto scene = DeviceScene::upload(from);
  require_ok(scene);
  return *std::move(scene);
}

/// Scenes of many pages, of one, and with most of their end missing; pages whose last chunk is not full.
const Levels& many_pages() {
  static const Levels kLevels = Levels::of(random_splats(1611, sized(40000, 6000, 3000)), 1, 32, 2);
  return kLevels;
}

cuda::CutEye random_eye(Random& random, const PagedFile& file) {
  const auto declared = file.head().declarations();
  const double away = random.log_uniform(0.1, 300);
  cuda::CutEye eye{};
  for (double& x : eye.position) x = random.uniform(-1, 1) * away;
  eye.focal_px = random.log_uniform(20, 4000);
  eye.z_near = static_cast<double>(declared.z_near);
  eye.detail_px = static_cast<float>(random.log_uniform(0.02, 50));
  return eye;
}
lod::Eye host_eye(const cuda::CutEye& e) {
  return {{e.position[0], e.position[1], e.position[2]}, e.focal_px, e.z_near};
}

/// Chunks of these pages on the device.
std::vector<std::uint32_t> chunks_of(const detail::PagePlan& plan, const std::vector<std::uint32_t>& pages) {
  std::vector<std::uint32_t> chunks;
  for (const std::uint32_t page : pages) {
    for (std::uint64_t k = plan.first_chunk[page]; k < plan.first_chunk[page + 1]; ++k) {
      chunks.push_back(static_cast<std::uint32_t>(k));
    }
  }
  return chunks;
}

std::uint32_t narrow(std::uint64_t n) {
  return static_cast<std::uint32_t>(n);
}

struct DeviceCut {
  std::vector<std::uint32_t> chosen;  ///< [counts.chunks]
  std::vector<std::uint32_t> chunks;  ///< [capacity] those in view
  cuda::CutCounts counts, listed;
};
/// Runs both launches; `entries`: CHNK.
DeviceCut cut(std::span<const cuda::CutPage> table, const detail::PagePlan& plan, const cuda::CutEye& eye,
              std::uint32_t capacity, std::span<const std::uint32_t> entries,
              const std::optional<cuda::ViewParameters>& view = std::nullopt) {
  const auto n_chunks = static_cast<std::uint32_t>(plan.n_chunks());
  const DeviceArray<cuda::CutPage> pages(table);
  const DeviceArray<cuda::CutCounts> sums(cuda::cut_blocks(plan.n_pages)), counts(2);
  const DeviceArray<cuda::CutLimit> limit(1);
  const DeviceArray<std::uint32_t> chosen(n_chunks), chunks(capacity);
  const DeviceArray<std::uint32_t> in_view(cuda::cull_blocks(n_chunks)), chunk_table(entries);
  detail::PageLocked<cuda::CutCounts> seen;
  require_ok(seen.create());
  require_ok(cuda::launch_cut(
      {pages.data(), plan.n_pages, eye, sums.data(), counts.data(), chosen.data(), limit.data()}, nullptr));
  require_ok(cuda::launch_cull(
      {chosen.data(), counts.data(), n_chunks, chunk_table.data(), view.value_or(cuda::ViewParameters{}),
       view.has_value(), in_view.data(), counts.data() + 1, seen.get(), chunks.data(), capacity},
      nullptr));
  const auto both = counts.download();
  DeviceCut cut{chosen.download(), chunks.download(), both[0], both[1]};
  cut.chosen.resize(cut.counts.chunks);
  sums.check_guards(), in_view.check_guards(), limit.check_guards();
  CHECK(std::memcmp(&cut.listed, seen.get(), sizeof cut.listed) == 0);
  return cut;
}
/// Boxes of side 0.5 around `centers`.
std::vector<std::uint32_t> boxes_about(std::span<const std::array<float, 3>> centers) {
  std::vector<std::uint32_t> entries(12 * centers.size());
  for (std::size_t i = 0; i < centers.size(); ++i) {
    const auto& c = centers[i];
    const float entry[8] = {c[0] - 0.25F, c[1] - 0.25F, c[2] - 0.25F, 0.01F,
                            c[0] + 0.25F, c[1] + 0.25F, c[2] + 0.25F, 1};
    std::memcpy(&entries[12 * i], entry, sizeof entry);
  }
  return entries;
}

/// Draws frames with one renderer.
class Frames {
 public:
  Frames() : renderer_(make()) {}

  struct Picture {
    std::vector<float> rgb, alpha;
    FrameStats stats;
  };
  Picture draw(const DeviceScene& scene, const Camera& camera, const RenderOptions& options) {
    const auto n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
    const DeviceArray<float> rgb(3 * n), alpha(n);
    synchronize();
    const auto stats = renderer_.render(scene, camera, {.rgb = rgb.data(), .alpha = alpha.data()}, options);
    require_ok(stats);
    const auto finished = renderer_.finish();
    require_ok(finished);
    return {rgb.download(), alpha.download(), *finished};
  }
  CudaRenderer& renderer() { return renderer_; }

 private:
  static CudaRenderer make() {
    auto renderer = CudaRenderer::create();
    require_ok(renderer);
    return *std::move(renderer);
  }
  CudaRenderer renderer_;
};

bool same_bytes(const std::vector<float>& a, const std::vector<float>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

RenderOptions at_detail(RenderOptions options, float px) {
  options.detail_px = px;
  return options;
}
/// With the anti-aliasing of levels.
RenderOptions as_levels(RenderOptions options) {
  options.anti_aliasing = math::AntiAliasing::mip_splatting;
  options.low_pass = 0.1F;
  return options;
}

std::vector<RenderOptions> level_modes() {
  RenderOptions turbo_fp32 = turbo_options(), separate = paper_options(), as_it_comes = paper_options();
  turbo_fp32.turbo.tensor_cores = false;
  separate.paper.front_end = PaperSteps::FrontEnd::separate;
  as_it_comes.paper.deterministic = false;
  as_it_comes.paper.depth_order = math::DepthOrder::exact;
  if (race_sizes()) return {turbo_options(), paper_options()};
  return {turbo_options(), turbo_fp32, paper_options(), separate, as_it_comes};
}

Camera camera_at(double back, int width = 96, int height = 64) {
  Camera camera = front_camera(width, height);
  camera.world_to_camera[3][2] += back;
  return camera;
}

}  // namespace

TEST_CASE("each page's own decision equals the host's traversal from the root, in its order") {
  Random random(1612);
  const Levels& levels = many_pages();
  const std::uint32_t n_pages = open(levels.bytes).n_pages();
  for (const std::uint32_t n_present : {n_pages, n_pages - 1, n_pages / 3, 1u}) {
    CAPTURE(n_present);
    const PagedFile file = open(levels.first_pages(n_present));
    const detail::PagePlan plan(file);
    const auto table = plan.table(file);
    REQUIRE(table.size() == n_present);
    for (int k = 0; k < 200; ++k) {
      cuda::CutEye eye = random_eye(random, file);
      if (k == 0) eye.detail_px = 0;
      const auto is_fine = [&](const cuda::CutPage& page) {
        return lod::is_fine_enough(page.error, eye.detail_px,
                                   lod::pixel_footprint(page.low, page.high, eye.position, eye.focal_px, eye.z_near));
      };
      std::vector<std::uint32_t> alone;
      std::uint64_t n = 0;
      for (std::uint32_t i = 0; i < n_present; ++i) {
        if (!is_fine(table[i]) || (table[i].parent != cuda::kNoCutPage && is_fine(table[table[i].parent]))) continue;
        const auto next = std::ranges::upper_bound(plan.first_chunk, table[i].first_chunk);
        alone.push_back(static_cast<std::uint32_t>(next - plan.first_chunk.begin() - 1));
        n += table[i].n;
      }
      REQUIRE(alone == lod::drawn_pages(file.pages(), host_eye(eye), eye.detail_px, n_present));
      if (k == 0) CHECK(n == plan.n_finest);
      // What each page's own decision changes from step to step of the detail.
      const lod::DetailSteps steps = lod::detail_steps(eye.detail_px);
      const auto step_of = [&](const cuda::CutPage& page) {
        return lod::first_fine_step(steps, page.error,
                                    lod::pixel_footprint(page.low, page.high, eye.position, eye.focal_px, eye.z_near));
      };
      std::array<unsigned long long, lod::kDetailSteps + 1> changes{};
      for (const cuda::CutPage& page : table) {
        const int begin = step_of(page);
        const int end = page.parent == cuda::kNoCutPage ? lod::kDetailSteps : step_of(table[page.parent]);
        if (begin >= end) continue;
        changes[static_cast<std::size_t>(begin)] += page.n;
        changes[static_cast<std::size_t>(end)] -= page.n;
      }
      for (const std::uint64_t most : {std::uint64_t{0}, plan.n_finest / 30, plan.n_finest / 3, plan.n_finest}) {
        const auto choice = lod::finest_detail(file.pages(), host_eye(eye), eye.detail_px, most, n_present);
        unsigned long long gaussians = 0;
        const int step = lod::finest_fitting_step(changes.data(), step_of(table[0]), most, gaussians);
        REQUIRE(steps.px[step] == choice.detail_px);
        REQUIRE(gaussians == choice.gaussians);
      }
    }
  }
}

TEST_CASE("the device's cut equals the host's in 200 views, of whole files and prefixes") {
  if (!device_answers()) return;
  Random random(1613);
  const Levels& levels = many_pages();
  const std::uint32_t n_pages = open(levels.bytes).n_pages();
  std::set<std::size_t> sizes;
  for (const std::uint32_t n_present : {n_pages, n_pages / 3, 1u}) {
    const PagedFile file = open(levels.first_pages(n_present));
    const detail::PagePlan plan(file);
    const auto table = plan.table(file);
    const std::vector<std::uint32_t> entries(12 * plan.n_chunks());
    for (int k = 0; k < (n_present < n_pages ? sized(40, 20, 2) : sized(200, 200, 4)); ++k) {
      cuda::CutEye eye = random_eye(random, file);
      if (k == 0) eye.detail_px = 0;
      const auto expected = lod::drawn_pages(file.pages(), host_eye(eye), eye.detail_px, n_present);
      const auto chunks = chunks_of(plan, expected);
      const DeviceCut drawn = cut(table, plan, eye, narrow(plan.n_chunks()), entries);
      REQUIRE(drawn.counts.pages == expected.size());
      REQUIRE(drawn.counts.chunks == chunks.size());
      CHECK(drawn.counts.gaussians ==
            std::accumulate(expected.begin(), expected.end(), std::uint64_t{0},
                            [&](std::uint64_t n, std::uint32_t page) { return n + file.pages()[page].count; }));
      CHECK(drawn.chosen == chunks);
      CHECK(drawn.listed.chunks == chunks.size());
      CHECK(drawn.listed.pages == expected.size());
      CHECK(drawn.listed.gaussians == drawn.counts.gaussians);
      CHECK(std::equal(chunks.begin(), chunks.end(), drawn.chunks.begin()));
      sizes.insert(chunks.size());
    }
  }
  CHECK(sizes.size() > sized(20u, 10u, 1u));  // cuts differ
}

TEST_CASE("with a limit of Gaussians the device takes the host's detail and its cut, of whole files and prefixes") {
  if (!device_answers()) return;
  Random random(1624);
  const Levels& levels = many_pages();
  const std::uint32_t n_pages = open(levels.bytes).n_pages();
  std::set<float> details;
  for (const std::uint32_t n_present : {n_pages, n_pages / 3, 1u}) {
    const PagedFile file = open(levels.first_pages(n_present));
    const detail::PagePlan plan(file);
    const auto table = plan.table(file);
    const std::vector<std::uint32_t> entries(12 * plan.n_chunks());
    for (int k = 0; k < (n_present < n_pages ? sized(20, 10, 2) : sized(100, 100, 4)); ++k) {
      cuda::CutEye eye = random_eye(random, file);
      if (k % 4 == 0) eye.detail_px = 0;
      for (const double share : {0.0, 0.02, 0.1, 0.5, 1.0}) {
        eye.max_gaussians = static_cast<std::uint64_t>(share * static_cast<double>(plan.n_finest));
        const auto choice =
            lod::finest_detail(file.pages(), host_eye(eye), eye.detail_px, eye.max_gaussians, n_present);
        const auto expected = lod::drawn_pages(file.pages(), host_eye(eye), choice.detail_px, n_present);
        const DeviceCut drawn = cut(table, plan, eye, narrow(plan.n_chunks()), entries);
        REQUIRE(drawn.counts.detail_px == choice.detail_px);
        REQUIRE(drawn.counts.gaussians == choice.gaussians);
        CHECK(drawn.counts.pages == expected.size());
        CHECK(drawn.chosen == chunks_of(plan, expected));
        CHECK(drawn.listed.detail_px == choice.detail_px);
        details.insert(choice.detail_px);
      }
    }
  }
  CHECK(details.size() > sized(50u, 30u, 4u));
}

TEST_CASE("frames with a limit of Gaussians have the CPU's detail and pages, in all modes, queued and in batches") {
  if (!device_answers()) return;
  const Levels& levels = many_pages();
  const DeviceScene on_device = upload(open(levels.bytes));
  const Scene scene = load(levels.bytes);
  Frames frames;
  for (const double back : {0.0, 30.0}) {
    const Camera camera = camera_at(back);
    for (const RenderOptions& mode : level_modes()) {
      for (const std::uint64_t most : {std::uint64_t{1}, scene.size() / 20, scene.size() / 3, scene.size()}) {
        for (const bool queued : {false, true}) {
          RenderOptions options = at_detail(mode, 0.05F);
          options.max_gaussians = most;
          options.turbo.asynchronous = queued;
          const auto drawn = frames.draw(on_device, camera, options);
          const Frame host = render(scene, camera, options, {.backend = Backend::cpu});
          CHECK(drawn.stats.detail_px == host.stats.detail_px);
          CHECK(drawn.stats.pages == host.stats.pages);
          CHECK(drawn.stats.gaussians == host.stats.gaussians);
          const auto same = frames.draw(on_device, camera, at_detail(mode, host.stats.detail_px));
          if (mode.paper.deterministic) CHECK(same_bytes(drawn.rgb, same.rgb));
        }
      }
    }
  }
  auto renderer = Renderer::create({.backend = Backend::cuda});
  require_ok(renderer);
  const std::vector<Camera> cameras{camera_at(0), camera_at(10), camera_at(30)};
  std::vector<float> rgb(3 * 3 * 96 * 64);
  PictureArrays pictures;
  pictures.rgb = rgb.data();
  RenderOptions options = at_detail(turbo_options(), 0.05F);
  options.max_gaussians = scene.size() / 10;
  const auto stats = renderer->render_all(scene, cameras, pictures, options);
  require_ok(stats);
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    const Frame host = render(scene, cameras[i], options, {.backend = Backend::cpu});
    CHECK((*stats)[i].detail_px == host.stats.detail_px);
    CHECK((*stats)[i].gaussians == host.stats.gaussians);
  }
}

TEST_CASE("chunks outside the view are dropped, the others keep their order; an overfull list is counted") {
  if (!device_answers()) return;
  const PagedFile file = open(many_pages().bytes);
  const detail::PagePlan plan(file);
  const auto table = plan.table(file);
  Random random(1622);
  std::vector<std::array<float, 3>> centers(plan.n_chunks());
  for (auto& c : centers) {
    for (float& x : c) x = static_cast<float>(random.uniform(-20, 20));
  }
  const auto entries = boxes_about(centers);
  const Camera camera = front_camera(320, 200);  // looks along +z
  const auto view = view_parameters(camera, Arithmetic(), 0);
  const cuda::CutEye leaves{{0, 0, 0}, 100, 0.2, 0};
  const DeviceCut drawn = cut(table, plan, leaves, narrow(plan.n_chunks()), entries, view);
  std::size_t at = 0;
  for (const std::uint32_t chunk : drawn.chosen) {
    const auto& c = centers[chunk];
    const bool listed = at < drawn.listed.chunks && drawn.chunks[at] == chunk;
    at += listed ? 1 : 0;
    // Clearly inside, and clearly outside: 160/256 and 100/256 are the slopes of the image's edges.
    const float x = std::abs(c[0]), y = std::abs(c[1]), z = c[2];
    if (z > 1 && x < 0.6F * z && y < 0.36F * z) CHECK(listed);
    if (z < -1 || (z > 0 && (x > 0.7F * z + 1 || y > 0.5F * z + 1))) CHECK(!listed);
  }
  CHECK(at == drawn.listed.chunks);
  CHECK(at > 0);
  CHECK(at < drawn.chosen.size() / 2);
  CHECK(drawn.listed.pages == drawn.counts.pages);
  const DeviceCut full = cut(table, plan, leaves, 3, entries);
  CHECK(full.listed.chunks == full.chosen.size());
  CHECK(std::equal(full.chunks.begin(), full.chunks.end(), full.chosen.begin()));
}

TEST_CASE("pages on the device equal the host's decoding, each from its own first chunk, in every profile") {
  if (!device_answers()) return;
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    // Four batches of pages that are decoded together.
    const int n = profile == Profile::direct ? sized(700000, 3000, 500) : sized(30000, 3000, 500);
    const Levels levels = Levels::of(random_splats(1623, n), 2, 64, 3, profile);
    const PagedFile file = open(levels.bytes);
    const detail::PagePlan plan(file);
    const auto bytes = plan.section_bytes(2);
    std::array<DeviceArray<std::byte>, 5> memory;
    detail::SectionPlaces places{};
    for (std::size_t k = 0; k < 5; ++k) memory[k] = DeviceArray<std::byte>(bytes[k]), places[k] = memory[k].data();
    require_ok(detail::upload_pages(file, plan, places, nullptr));
    std::array<std::vector<std::byte>, 5> found;
    for (std::size_t k = 0; k < 5; ++k) found[k] = memory[k].download();
    const auto is_at = [&](std::size_t k, std::uint64_t at, std::span<const std::byte> expected) {
      return std::equal(expected.begin(), expected.end(), found[k].begin() + static_cast<std::ptrdiff_t>(at));
    };
    PageDecoder decoder(file);
    std::vector<std::byte> decoded(file.largest_decoded_bytes());
    std::uint64_t n_padding = 0;
    for (std::uint32_t page = 0; page < file.n_pages(); ++page) {
      CAPTURE(page);
      const auto rows = decoder.decode(page, file.bytes(page), std::span(decoded).first(file.decoded_bytes(page)));
      require_ok(rows);
      const std::uint64_t first_chunk = plan.first_chunk[page], first_row = first_chunk * plan.chunk_size;
      const std::uint64_t end_row = plan.first_chunk[page + 1] * plan.chunk_size, set = plan.first_set[page];
      REQUIRE(is_at(0, first_row * kMeanBytes, rows->means));
      REQUIRE(is_at(1, first_row * kGeometryBytes, rows->geometry));
      REQUIRE(is_at(2, first_row * sh_bytes(2), rows->sh));
      REQUIRE(is_at(3, set * kStepSetBytes, rows->steps));
      for (std::uint64_t row = first_row + rows->n; row < end_row; ++row, ++n_padding) {
        float mean[3];
        std::memcpy(mean, &found[0][row * kMeanBytes], sizeof mean);
        REQUIRE((std::isnan(mean[0]) && std::isnan(mean[1]) && std::isnan(mean[2])));
      }
      for (std::uint64_t c = first_chunk; c < plan.first_chunk[page + 1]; ++c) {
        const std::uint64_t at = c * kChunkEntryBytes;
        REQUIRE(is_at(4, at, rows->chunks.subspan((c - first_chunk) * kChunkEntryBytes, 32)));
        std::uint64_t step_set;
        float scale_unit;
        std::memcpy(&step_set, &found[4][at + 32], sizeof step_set);
        std::memcpy(&scale_unit, &found[4][at + 44], sizeof scale_unit);
        CHECK(step_set == set + (file.stored(page).n_step_sets == 1 ? 0 : c - first_chunk));
        CHECK(scale_unit == std::ldexp(1.0F, -rows->scale_exponent));
      }
    }
    CHECK(n_padding == plan.n_rows() - file.n_stored());
    CHECK(n_padding > 0);
  }
}

TEST_CASE("the device draws a cut like the same pages as a scene of FP32 arrays") {
  if (!device_answers()) return;
  const Levels& levels = many_pages();
  const Scene scene = load(levels.bytes);
  const DeviceScene on_device = upload(*scene.levels());
  CHECK(on_device.has_levels());
  CHECK(on_device.compact());
  CHECK(on_device.size() == scene.size());
  Frames frames, gathered;
  std::set<std::uint64_t> pages;
  std::vector<std::pair<double, float>> views{{0, 0.05F}, {0, 1}, {4, 0.3F}, {20, 0.2F}, {60, 0.1F}, {400, 1}};
  if (race_sizes()) views = {{4, 0.3F}};
  for (const auto& [back, detail_px] : views) {
    const Camera camera = camera_at(back);
    const auto chosen = drawn_pages(scene, camera, detail_px);
    require_ok(chosen);
    const auto as_scene = scene_of_pages(scene, *chosen);
    require_ok(as_scene);
    const DeviceScene expected_scene = upload(as_scene->view().value());
    for (const RenderOptions& mode : level_modes()) {
      CAPTURE(back);
      CAPTURE(detail_px);
      const auto drawn = frames.draw(on_device, camera, at_detail(mode, detail_px));
      // With declarations, which arrays lack.
      const auto expected =
          gathered.draw(expected_scene, camera, with_declarations(as_levels(mode), scene.declarations()));
      CHECK(drawn.stats.pages == chosen->size());
      CHECK(drawn.stats.gaussians == as_scene->size());
      CHECK(drawn.stats.visible == expected.stats.visible);
      CHECK(drawn.stats.instances == expected.stats.instances);
      // Only colours are decoded in another order of operations; FP16 keeps 2^-11 of them.
      if (!mode.paper.deterministic) continue;
      CHECK(same_bytes(drawn.alpha, expected.alpha));
      const bool is_tensor = mode.pipeline == Pipeline::turbo && mode.turbo.tensor_cores;
      CHECK_MESSAGE(largest_difference(drawn.rgb, expected.rgb) <= (is_tensor ? 0x1p-9 : 2e-5),
                    largest_difference(drawn.rgb, expected.rgb));
      pages.insert(drawn.stats.pages);
    }
  }
  if (!race_sizes()) CHECK(pages.size() >= (small_sizes() ? 3 : 4));
}

TEST_CASE("at detail 0 the picture equals that of the file without levels, in every mode and profile") {
  if (!device_answers()) return;
  for (const Profile profile : {Profile::direct, Profile::packed}) {
    if (race_sizes() && profile != Profile::direct) continue;
    for (const std::uint32_t chunk_size : {32u, 256u}) {
      if (race_sizes() && chunk_size != 32) continue;
      const Levels levels = Levels::of(random_splats(1615, sized(20000, 3000, 1000)), 3, chunk_size, 3, profile);
      const auto plain = FileView::open(levels.plain);
      require_ok(plain);
      const DeviceScene with = upload(open(levels.bytes)), without = upload(*plain);
      CHECK(!without.has_levels());
      CHECK(with.size() == without.size());
      auto modes = level_modes();
      if (!race_sizes()) modes.push_back(baseline_options());
      for (const RenderOptions& mode : modes) {
        Frames a, b;
        const Camera camera = camera_at(0.5);
        const auto drawn = a.draw(with, camera, at_detail(mode, 0)), expected = b.draw(without, camera, mode);
        CHECK(drawn.stats.visible == expected.stats.visible);
        CHECK(drawn.stats.instances == expected.stats.instances);
        if (!mode.paper.deterministic) continue;
        CHECK(same_bytes(drawn.rgb, expected.rgb));
        CHECK(same_bytes(drawn.alpha, expected.alpha));
        CHECK(drawn.stats.gaussians == expected.stats.gaussians);
        CHECK(drawn.stats.pages == 0);
      }
    }
  }
}

TEST_CASE("equal depths of a scene with levels are drawn in the order of leaves") {
  if (!device_answers()) return;
  // Gaussians on a grid: many share a depth.
  const Levels levels = Levels::of(grid_splats(1616, sized(12000, 6000, 1500)), 3, 32, 2);
  const Scene scene = load(levels.bytes);
  const DeviceScene on_device = upload(*scene.levels());
  Frames frames, gathered;
  for (const double back : {0.0, 10.0}) {
    if (race_sizes() && back != 0) continue;
    const Camera camera = camera_at(back, 64, 48);
    const auto chosen = drawn_pages(scene, camera, 0.05F);
    require_ok(chosen);
    const auto as_scene = scene_of_pages(scene, *chosen);
    require_ok(as_scene);
    const DeviceScene expected_scene = upload(as_scene->view().value());
    for (const RenderOptions& mode : {turbo_options(), paper_options()}) {
      CAPTURE(back);
      const auto drawn = frames.draw(on_device, camera, at_detail(mode, 0.05F));
      const auto expected =
          gathered.draw(expected_scene, camera, with_declarations(as_levels(mode), scene.declarations()));
      CHECK(same_bytes(drawn.alpha, expected.alpha));
      CHECK_MESSAGE(largest_difference(drawn.rgb, expected.rgb) <= 0x1p-9, largest_difference(drawn.rgb, expected.rgb));
    }
  }
}

TEST_CASE("a scene of one page, and a prefix of a file, are drawn as on the CPU") {
  if (!device_answers()) return;
  const Levels one = Levels::of(random_splats(1617, 50), 2, 32, 4);
  REQUIRE(open(one.bytes).n_pages() == 1);
  const Levels& many = many_pages();
  const std::uint32_t n_pages = open(many.bytes).n_pages();
  auto renderer = Renderer::create({.backend = Backend::cuda});
  require_ok(renderer);
  const std::vector<std::span<const std::byte>> files{one.bytes, many.first_pages(1), many.first_pages(n_pages / 3),
                                                      many.first_pages(n_pages - 1)};
  for (const auto& bytes : std::span(files).first(race_sizes() ? 1 : files.size())) {
    const Scene scene = load(bytes);
    for (const float detail_px : {0.0F, 1.0F}) {
      CAPTURE(scene.levels()->n_present());
      CAPTURE(detail_px);
      for (const Camera& camera : {camera_at(8), panorama_of(camera_at(-4))}) {
        Frame frame = Frame::of(camera);
        const auto stats = renderer->render(scene, camera, frame.target(), at_detail(turbo_options(), detail_px));
        require_ok(stats);
        const Frame host = render(scene, camera, at_detail(turbo_options(), detail_px), {.backend = Backend::cpu});
        CHECK(psnr(frame.rgb, host.rgb) >= 60);
        CHECK(stats->pages == host.stats.pages);
        CHECK(stats->gaussians == host.stats.gaussians);
      }
    }
  }
}

TEST_CASE("no frame affects the next: other views, details, pipelines, scenes") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  // More rows than the initial capacity.
  const Levels levels = Levels::of(random_splats(1618, 200000), 0, 256, 4);
  const DeviceScene scene = upload(open(levels.bytes)), small = upload(open(many_pages().bytes));
  const DeviceScene fp32 = upload(scene_of(cloud_of(random_splats(1619, 500), 0)).view().value());
  Frames frames;
  Random random(1620);
  for (int k = 0; k < 40; ++k) {
    CAPTURE(k);
    Camera camera = camera_at(random.log_uniform(0.01, 300));
    if (k % 9 == 4) camera = panorama_of(camera);
    const float detail_px = k % 7 == 6 ? 0 : static_cast<float>(random.log_uniform(0.05, 5));
    RenderOptions options = at_detail(k % 5 == 4 ? paper_options() : turbo_options(), detail_px);
    options.turbo.asynchronous = k % 3 == 0;
    const DeviceScene& drawn = k % 8 == 3 ? small : k % 8 == 5 ? fp32 : scene;
    const auto picture = frames.draw(drawn, camera, options);
    Frames fresh;
    options.turbo.asynchronous = false;
    const auto expected = fresh.draw(drawn, camera, options);
    CHECK(same_bytes(picture.rgb, expected.rgb));
    CHECK(same_bytes(picture.alpha, expected.alpha));
    CHECK(picture.stats.pages == expected.stats.pages);
    CHECK(picture.stats.gaussians == expected.stats.gaussians);
    CHECK(picture.stats.instances == expected.stats.instances);
  }
}

TEST_CASE("frames in flight with levels of detail equal those that are waited for, also as their cuts grow") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  // More rows than the initial capacity.
  const Levels levels = Levels::of(random_splats(1625, 200000), 0, 256, 4);
  const DeviceScene scene = upload(open(levels.bytes)), small = upload(open(many_pages().bytes));
  const DeviceScene fp32 = upload(scene_of(cloud_of(random_splats(1627, 500), 0)).view().value());  // frames overlap
  struct Shot {
    const DeviceScene& scene;
    Camera camera;
    RenderOptions options;
    Frames::Picture expected;
    DeviceArray<float> rgb, alpha;
  };
  for (const std::uint32_t most : {1u, 3u, 8u}) {
    CAPTURE(most);
    std::vector<Shot> shots;
    Random random(1626);
    for (int k = 0; k < 24; ++k) {
      const DeviceScene& drawn = k % 8 == 3 ? small : k % 8 > 4 ? fp32 : scene;
      const Camera camera = k % 3 == 1 ? camera_at(0.5) : camera_at(random.log_uniform(0.01, 300), 70, 33);
      const auto detail_px = static_cast<float>(random.log_uniform(0.05, 5));
      RenderOptions options = at_detail(turbo_options(), k % 7 == 1 ? 0 : detail_px);
      if (k % 5 == 2 && drawn.has_levels()) options.max_gaussians = drawn.size() / 20;
      Frames waiting;
      Frames::Picture expected = waiting.draw(drawn, camera, options);
      DeviceArray<float> rgb(expected.rgb.size()), alpha(expected.alpha.size());
      options.turbo.asynchronous = true;
      shots.push_back({drawn, camera, options, std::move(expected), std::move(rgb), std::move(alpha)});
    }
    synchronize();
    auto renderer = CudaRenderer::create({.frames_in_flight = most});
    require_ok(renderer);
    std::vector<FrameStats> stats;
    const auto finish_oldest = [&] {
      const auto drawn = renderer->finish_oldest();
      require_ok(drawn);
      stats.push_back(*drawn);
    };
    for (std::size_t k = 0; k < shots.size(); ++k) {
      const Shot& shot = shots[k];
      if (k - stats.size() == most) finish_oldest();
      require_ok(renderer->render(shot.scene, shot.camera, {.rgb = shot.rgb.data(), .alpha = shot.alpha.data()},
                                  shot.options));
    }
    while (stats.size() < shots.size()) finish_oldest();
    for (std::size_t k = 0; k < shots.size(); ++k) {
      CAPTURE(k);
      const Frames::Picture& expected = shots[k].expected;
      CHECK(same_bytes(shots[k].rgb.download(), expected.rgb));
      CHECK(same_bytes(shots[k].alpha.download(), expected.alpha));
      CHECK(stats[k].pages == expected.stats.pages);
      CHECK(stats[k].gaussians == expected.stats.gaussians);
      CHECK(stats[k].detail_px == expected.stats.detail_px);
      CHECK(stats[k].instances == expected.stats.instances);
      CHECK(stats[k].visible == expected.stats.visible);
    }
  }
}

TEST_CASE("with little memory a cut is refused as out of memory or drawn right, and the renderer goes on") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  struct Budget {
    std::uint64_t left = 0;
    DeviceAllocator allocator() {
      return {[](void* user, std::uint64_t bytes, CudaStream) -> void* {
                auto& budget = *static_cast<Budget*>(user);
                void* memory = nullptr;
                if (bytes > budget.left || cudaMalloc(&memory, bytes) != cudaSuccess) return nullptr;
                budget.left -= bytes;
                return memory;
              },
              [](void* user, void* memory, std::uint64_t bytes) {
                static_cast<Budget*>(user)->left += bytes;
                cudaFree(memory);
              },
              this};
    }
  } budget;
  const Levels levels = Levels::of(random_splats(1624, sized(200000, 90000, 0)), 0, 256, 4);
  const DeviceScene scene = upload(open(levels.bytes));
  const Camera camera = camera_at(0.5);
  for (const RenderOptions& mode : {turbo_options(), paper_options()}) {
    const RenderOptions options = at_detail(mode, 0);  // more than a frame's initial capacity
    Frames fresh;
    const auto expected = fresh.draw(scene, camera, options);
    auto renderer = CudaRenderer::create({.allocator = budget.allocator()});
    require_ok(renderer);
    const DeviceArray<float> rgb(expected.rgb.size());
    int n_refused = 0;
    bool drawn = false;
    for (std::uint64_t bytes = std::uint64_t{1} << 16; bytes < std::uint64_t{1} << 32 && !drawn; bytes += bytes / 4) {
      budget.left = bytes - std::min(bytes, renderer->bytes());
      const auto stats = renderer->render(scene, camera, {.rgb = rgb.data()}, options);
      drawn = stats.has_value();
      if (drawn) continue;
      ++n_refused;
      REQUIRE_MESSAGE(stats.error().code == Errc::device_out_of_memory, text_of(stats.error()));
    }
    CHECK(drawn);
    CHECK(n_refused > 3);
    CHECK(same_bytes(rgb.download(), expected.rgb));
  }
}

TEST_CASE(
    "an invalid detail, baseline above 0 and a file without pages are refused; damage is reported as by the host") {
  if (!device_answers()) return;
  const Levels levels = Levels::of(random_splats(1621, 500), 1, 32, 2);
  const PagedFile file = open(levels.bytes);
  const DeviceScene scene = upload(file);
  auto renderer = CudaRenderer::create();
  require_ok(renderer);
  const Camera camera = camera_at(1);
  const DeviceArray<float> rgb(3 * 96 * 64);
  for (const RenderOptions& options :
       {at_detail(turbo_options(), -1), at_detail(turbo_options(), NAN), at_detail(baseline_options(), 1)}) {
    const auto refused = renderer->render(scene, camera, {.rgb = rgb.data()}, options);
    REQUIRE(!refused);
    CHECK(refused.error().code == Errc::bad_argument);
  }
  CHECK(renderer->render(scene, camera, {.rgb = rgb.data()}, baseline_options()));
  const auto nothing = DeviceScene::upload(open(levels.first_pages(0)));
  REQUIRE(!nothing);
  CHECK(nothing.error().code == Errc::pages_missing);
  std::vector<std::byte> damaged = levels.bytes;
  damaged[file.stored(file.n_pages() / 2).offset + 5] ^= std::byte{1};
  const PagedFile of_damaged = open(damaged);
  const auto refused = DeviceScene::upload(of_damaged);
  REQUIRE(!refused);
  const auto on_host = Scene::load(damaged);
  REQUIRE(!on_host);
  CHECK(refused.error().code == Errc::checksum_mismatch);
}
