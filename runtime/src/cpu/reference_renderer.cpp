// reference_renderer.cpp - the frame on the CPU: project, order, list, blend.
// SPDX-License-Identifier: Apache-2.0
//
// Gaussians are ordered by depth once; a stable counting sort by tile then gives every tile its list in that order, so
// there is no (tile, depth) key. Equal depths keep the order of the scene. The image does not depend on the number of
// threads: blocks decide who does the work, never the order in which Gaussians are listed or summed.
#include "cpu/reference_renderer.hpp"

#include <hwy/cache_control.h>
#include <tbb/info.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <span>
#include <vector>

#include "cpu/tile_blend.hpp"
#include "parallel.hpp"
#include "render_options.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/math/blend.hpp"
#include "rgs/math/camera_models.hpp"
#include "rgs/math/coverage.hpp"
#include "rgs/math/sh.hpp"

namespace rgs::detail {
namespace {

using math::TileGrid;

// Gaussians per projection block: small enough to balance threads, large enough for long lists.
constexpr std::uint64_t kBlock = 8192;

// (tile, Gaussian) pairs of a frame; 16 GiB of lists.
constexpr std::uint64_t kMaxInstances = std::numeric_limits<std::uint32_t>::max();

/// Depth key above, splat index below: a stable sort by the upper half orders by depth, then by index.
using SortItem = std::uint64_t;

// 16 bits hold a tile coordinate: image sides are at most 65536 pixels.
struct Span16 {
  std::uint16_t first, last;
};

// Visible Gaussians of a projection block: splats first .. first + n - 1 of the frame's array.
struct Block {
  std::uint64_t n = 0;
  std::uint64_t n_instances = 0;
  std::vector<Span16> spans;  // of each visible Gaussian, row by row
};

// Storage that only grows and is not touched before it is written: reserved for the worst case, resident as used.
template <class T>
class Scratch {
 public:
  T* at_least(std::uint64_t n) {
    if (n > capacity_) {
      const std::uint64_t capacity = std::max(n, capacity_ + capacity_ / 2);
      capacity_ = 0;  // stays 0 if the allocation fails
      data_.reset();
      data_ = std::make_unique_for_overwrite<T[]>(capacity);
      capacity_ = capacity;
    }
    return data_.get();
  }
  T* get() const { return data_.get(); }

 private:
  std::unique_ptr<T[]> data_;
  std::uint64_t capacity_ = 0;
};

// Finds the part of a Gaussian; indices run on over the parts.
class PartIndex {
 public:
  void build(std::span<const ScenePart> parts) {
    begin_.resize(parts.size() + 1);
    begin_[0] = 0;
    for (std::size_t i = 0; i < parts.size(); ++i) begin_[i + 1] = begin_[i] + parts[i].n;
    first_.resize(n_blocks());
    std::uint32_t part = 0;
    for (std::uint64_t b = 0; b < first_.size(); ++b) {
      while (begin_[part + 1] <= b * kBlock) ++part;
      first_[b] = part;
    }
  }
  std::uint64_t n() const { return begin_.back(); }
  std::uint64_t n_blocks() const { return (n() + kBlock - 1) / kBlock; }
  std::uint32_t part_of(std::uint64_t gaussian) const {
    std::uint32_t part = first_[gaussian / kBlock];
    while (begin_[part + 1] <= gaussian) ++part;
    return part;
  }
  std::uint64_t begin(std::uint32_t part) const { return begin_[part]; }

 private:
  std::vector<std::uint64_t> begin_;  // [parts + 1]
  std::vector<std::uint32_t> first_;  // [blocks] part of the block's first Gaussian
};

class Stopwatch {
 public:
  double lap_ms() {
    const auto now = std::chrono::steady_clock::now();
    const std::chrono::duration<double, std::milli> elapsed = now - start_;
    start_ = now;
    return elapsed.count();
  }

 private:
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace

struct ReferenceRenderer::Workspace {
  // oneTBB prints a warning if asked for more threads than the machine has.
  explicit Workspace(int threads)
      : arena(threads > 0 ? std::min(threads, tbb::info::default_concurrency()) : tbb::task_arena::automatic) {}

  void project(const SceneParts& scene, const math::View<float>& view, const FrameSettings& settings);
  void sort_by_depth();
  void list_by_tile();
  template <class BlendTile>
  void blend(const math::View<float>& view, const RenderTarget& target, const FrameSettings& settings,
             const BlendTile& blend_tile, FrameStats& stats);

  // Parts of the visible Gaussians for a parallel counting sort with `bins` bins: four a thread, so that a late thread
  // delays little, and at most 32 MiB of histograms.
  std::uint64_t parts(std::uint64_t bins) const {
    const std::uint64_t wanted = 4 * static_cast<std::uint64_t>(arena.max_concurrency());
    return std::clamp<std::uint64_t>(std::min(n_visible / kBlock, (std::uint64_t{1} << 22) / bins), 1, wanted);
  }
  std::uint64_t n_tiles() const {
    return static_cast<std::uint64_t>(grid.columns) * static_cast<std::uint64_t>(grid.rows);
  }
  std::span<const Span16> rows_of(std::uint32_t splat) const {
    const ScreenSplat& s = splats.get()[splat];
    return std::span(blocks[splat / block_splats].spans).subspan(s.spans, s.n_rows);
  }

  tbb::task_arena arena;
  TileGrid grid{0, 0};
  math::DepthQuantizer quantizer{};
  bool quantized = false;
  PartIndex part_index;
  std::vector<Block> blocks;
  std::uint64_t block_splats = kBlock;    // room for the copies of a block's Gaussians
  Scratch<ScreenSplat> splats;            // [blocks, block_splats], the visible ones of a block at its start
  Scratch<SortItem> order, spare;         // [n_visible]
  std::vector<std::uint64_t> counts;      // histograms of the two sorts
  std::vector<std::uint64_t> tile_begin;  // [n_tiles + 1] into `instances`
  Scratch<std::uint32_t> instances;
  std::uint64_t n_visible = 0, n_instances = 0;
};

namespace {

// Tile rows that may list a Gaussian, none if no row does; appends their ranges within `columns` to `spans`.
void append_spans(const math::Projected<float>& p, math::Extent extent, TileGrid grid, math::TileSpan columns,
                  const math::Ellipse<float>& ellipse, std::vector<Span16>& spans, ScreenSplat& splat,
                  std::uint64_t& n_instances) {
  const bool is_square = extent == math::Extent::square;
  const math::TileRect rect =
      is_square ? math::square_extent(p.mean, p.footprint.cov, grid) : math::bounding_tiles(ellipse, grid);
  splat.spans = static_cast<std::uint32_t>(spans.size());
  splat.first_row = static_cast<std::uint16_t>(rect.y0);
  bool any = false;
  for (int row = rect.y0; row < rect.y1; ++row) {
    const math::TileSpan span = is_square ? math::TileSpan{rect.x0, rect.x1} : math::tiles_in_row(ellipse, row, grid);
    const int first = std::max(span.first, columns.first), last = std::max(first, std::min(span.last, columns.last));
    spans.push_back({static_cast<std::uint16_t>(first), static_cast<std::uint16_t>(last)});
    n_instances += static_cast<std::uint64_t>(last - first);
    any = any || first < last;
  }
  if (!any) spans.resize(splat.spans);
  splat.n_rows = static_cast<std::uint16_t>(spans.size() - splat.spans);
}

math::Vec3<float> color_of(const float* sh, const math::View<float>& view, const math::Vec3<float>& mean, int degree) {
  return math::sh_color<float>(degree, math::sh_basis(degree, math::direction_by_model(view, mean)), [sh](int k) {
    return math::Vec3<float>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]};
  });
}

}  // namespace

void ReferenceRenderer::Workspace::project(const SceneParts& scene, const math::View<float>& view,
                                           const FrameSettings& settings) {
  part_index.build(scene.parts);
  const std::uint64_t n_blocks = part_index.n_blocks();
  blocks.resize(n_blocks);
  const std::uint32_t n_copies = math::n_copies(view);
  block_splats = n_copies * kBlock;
  ScreenSplat* const all = splats.at_least(n_blocks * block_splats);
  const int degree = std::min(scene.sh_degree, settings.sh_degree_limit);
  constexpr std::uint64_t kAhead = 4;
  const auto sh_floats = static_cast<std::uint64_t>(3 * sh_coefficients(scene.sh_degree));
  std::atomic<std::uint64_t> n_listed{0};
  parallel_blocks(n_blocks, [&](std::uint64_t b) {
    Block& block = blocks[b];
    block.n = block.n_instances = 0;
    block.spans.clear();
    if (n_listed.load(std::memory_order_relaxed) > kMaxInstances) return;  // the frame fails anyway
    ScreenSplat* out = all + b * block_splats;
    const std::uint64_t end = std::min(part_index.n(), (b + 1) * kBlock);
    std::uint64_t first = b * kBlock;
    for (std::uint32_t p = part_index.part_of(first); first < end; ++p) {
      const ScenePart& part = scene.parts[p];
      const std::uint64_t begin = part_index.begin(p), part_end = std::min(end - begin, part.n);
      for (std::uint64_t i = first - begin; i < part_end; ++i) {
        // Harmonics are most of the bytes: prefetched while earlier Gaussians' geometry is computed.
        if (const std::uint64_t next = i + kAhead; next < part.n) {
          for (std::uint64_t k = 0; k < sh_floats; k += 16) hwy::Prefetch(&part.sh[next * sh_floats + k]);
        }
        const float* m = &part.mean[3 * i];
        const float* r = &part.rotation[4 * i];
        const float* s = &part.scale[3 * i];
        const math::Vec3<float> mean{m[0], m[1], m[2]};
        const auto gaussian = math::project_by_model<float>(view, mean, {r[0], r[1], r[2], r[3]}, {s[0], s[1], s[2]},
                                                            part.opacity[i], settings.low_pass, settings.anti_aliasing);
        if (!gaussian.footprint.valid) continue;
        const float cutoff = math::power_cutoff(gaussian.footprint.opacity);
        for (std::uint32_t copy = 0; copy < n_copies; ++copy) {
          auto projected = gaussian;
          const math::TileSpan columns = math::place_copy<math::kTileSize>(view, copy, grid, projected);
          const auto ellipse = math::ellipse(projected.mean, projected.footprint, cutoff);
          append_spans(projected, settings.extent, grid, columns, ellipse, block.spans, *out, block.n_instances);
          if (out->n_rows == 0) continue;
          out->mean = projected.mean;
          out->conic = projected.footprint.conic;
          out->opacity = projected.footprint.opacity;
          out->cutoff = cutoff;
          out->log2_opacity = math::kLog2AlphaMin - math::kLog2E * cutoff;
          out->z = projected.z;
          out->color = color_of(&part.sh[sh_floats * i], view, mean, degree);
          out->gaussian = static_cast<std::uint32_t>(begin + i);
          ++out;
          ++block.n;
        }
      }
      first = begin + part_end;
    }
    n_listed.fetch_add(block.n_instances, std::memory_order_relaxed);
  });
  n_visible = n_instances = 0;
  for (const Block& block : blocks) n_visible += block.n, n_instances += block.n_instances;
}

// Least-significant-digit radix sort of (depth key, splat), 11 bits a pass, parallel over contiguous parts; skips
// digits in which all keys agree.
void ReferenceRenderer::Workspace::sort_by_depth() {
  constexpr int kDigitBits = 11;
  constexpr std::uint64_t kDigits = std::uint64_t{1} << kDigitBits;
  SortItem* from = order.at_least(n_visible);
  SortItem* to = spare.at_least(n_visible);

  std::vector<std::uint64_t> first(blocks.size() + 1, 0);
  for (std::size_t b = 0; b < blocks.size(); ++b) first[b + 1] = first[b] + blocks[b].n;
  parallel_blocks(blocks.size(), [&](std::uint64_t b) {
    for (std::uint64_t i = 0; i < blocks[b].n; ++i) {
      const std::uint64_t index = b * block_splats + i;
      const float z = splats.get()[index].z;
      const std::uint32_t key = quantized ? math::quantize_depth(quantizer, z) : math::depth_bits(z);
      from[first[b] + i] = static_cast<SortItem>(key) << 32 | index;
    }
  });

  const std::uint64_t n_parts = parts(kDigits);
  const auto part_begin = [&](std::uint64_t part) { return n_visible * part / n_parts; };
  for (int shift = 32; shift < 64; shift += kDigitBits) {
    const auto digit = [shift](SortItem item) { return (item >> shift) & (kDigits - 1); };
    counts.assign(n_parts * kDigits, 0);
    parallel_blocks(n_parts, [&](std::uint64_t part) {
      std::uint64_t* const histogram = &counts[part * kDigits];
      for (std::uint64_t i = part_begin(part); i < part_begin(part + 1); ++i) ++histogram[digit(from[i])];
    });
    std::uint64_t sum = 0;
    bool constant = false;
    for (std::uint64_t d = 0; d < kDigits; ++d) {
      const std::uint64_t before = sum;
      for (std::uint64_t part = 0; part < n_parts; ++part) {
        const std::uint64_t n = counts[part * kDigits + d];
        counts[part * kDigits + d] = sum;
        sum += n;
      }
      constant = constant || sum - before == n_visible;
    }
    if (constant) continue;
    parallel_blocks(n_parts, [&](std::uint64_t part) {
      std::uint64_t* const next = &counts[part * kDigits];
      for (std::uint64_t i = part_begin(part); i < part_begin(part + 1); ++i) to[next[digit(from[i])]++] = from[i];
    });
    std::swap(from, to);
  }
  if (from != order.get()) std::swap(order, spare);
}

// Stable counting sort of all (tile, Gaussian) pairs by tile, in depth order.
void ReferenceRenderer::Workspace::list_by_tile() {
  constexpr std::uint64_t kAhead = 12;
  const std::uint64_t tiles = n_tiles(), columns = static_cast<std::uint64_t>(grid.columns);
  const std::uint64_t n_parts = parts(tiles);
  const auto part_begin = [&](std::uint64_t part) { return n_visible * part / n_parts; };
  const auto for_each_tile = [&](std::uint64_t part, const auto& f) {
    const std::uint64_t end = part_begin(part + 1);
    for (std::uint64_t i = part_begin(part); i < end; ++i) {
      // Depth order is not memory order: prefetches the splat, then its spans.
      if (i + 2 * kAhead < end) hwy::Prefetch(&splats.get()[static_cast<std::uint32_t>(order.get()[i + 2 * kAhead])]);
      if (i + kAhead < end) hwy::Prefetch(rows_of(static_cast<std::uint32_t>(order.get()[i + kAhead])).data());
      const auto index = static_cast<std::uint32_t>(order.get()[i]);
      std::uint64_t row = static_cast<std::uint64_t>(splats.get()[index].first_row) * columns;
      for (const Span16 span : rows_of(index)) {
        for (std::uint64_t tile = row + span.first; tile < row + span.last; ++tile) f(tile, index);
        row += columns;
      }
    }
  };
  counts.assign(n_parts * tiles, 0);
  parallel_blocks(n_parts, [&](std::uint64_t part) {
    std::uint64_t* const histogram = &counts[part * tiles];
    for_each_tile(part, [histogram](std::uint64_t tile, std::uint32_t) { ++histogram[tile]; });
  });
  tile_begin.resize(tiles + 1);
  std::uint64_t sum = 0;
  for (std::uint64_t tile = 0; tile < tiles; ++tile) {
    tile_begin[tile] = sum;
    for (std::uint64_t part = 0; part < n_parts; ++part) {
      const std::uint64_t n = counts[part * tiles + tile];
      counts[part * tiles + tile] = sum;
      sum += n;
    }
  }
  tile_begin[tiles] = sum;
  std::uint32_t* const out = instances.at_least(n_instances);
  parallel_blocks(n_parts, [&](std::uint64_t part) {
    std::uint64_t* const next = &counts[part * tiles];
    for_each_tile(part, [next, out](std::uint64_t tile, std::uint32_t index) { out[next[tile]++] = index; });
  });
}

namespace {

// Writes a tile's pixels to the wanted outputs.
void store_tile(const TileJob& job, const TilePixels& pixels, int width, const math::Vec3<float>& background,
                const RenderTarget& target) {
  for (int y = 0; y < job.height; ++y) {
    for (int x = 0; x < job.width; ++x) {
      const auto i = static_cast<std::size_t>(y * math::kTileSize + x);
      const auto o =
          static_cast<std::size_t>(job.y + y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(job.x + x);
      const math::Pixel<float> pixel{pixels.r[i], pixels.g[i], pixels.b[i], pixels.depth[i], pixels.transmittance[i]};
      if (!target.rgb.empty()) {
        const auto c = math::resolve(pixel, background);
        target.rgb[3 * o] = c.x, target.rgb[3 * o + 1] = c.y, target.rgb[3 * o + 2] = c.z;
      }
      if (!target.alpha.empty()) target.alpha[o] = 1 - pixel.transmittance;
      if (!target.depth.empty()) target.depth[o] = math::expected_depth(pixel);
      if (!target.evaluated.empty()) target.evaluated[o] = pixels.evaluated[i];
      if (!target.blended.empty()) target.blended[o] = pixels.blended[i];
    }
  }
}

// Adds a tile's contributions. Each weight is rounded to a multiple of the unit once; integer sums and maxima do not
// depend on the order of the threads.
void add_contributions(const TileJob& job, std::span<Contribution> contributions) {
  for (std::size_t k = 0; k < job.list.size(); ++k) {
    const TileWeight& w = job.weights[k];
    if (w.largest <= 0) continue;
    Contribution& c = contributions[job.splats[job.list[k]].gaussian];
    const auto units = static_cast<std::uint64_t>(std::llround(static_cast<double>(w.sum) / Contribution::kUnit));
    std::atomic_ref(c.sum).fetch_add(units, std::memory_order_relaxed);
    const std::atomic_ref largest(c.largest);
    float seen = largest.load(std::memory_order_relaxed);
    while (seen < w.largest && !largest.compare_exchange_weak(seen, w.largest, std::memory_order_relaxed)) {
    }
  }
}

}  // namespace

template <class BlendTile>
void ReferenceRenderer::Workspace::blend(const math::View<float>& view, const RenderTarget& target,
                                         const FrameSettings& settings, const BlendTile& blend_tile,
                                         FrameStats& stats) {
  const math::Vec3<float> background{settings.background[0], settings.background[1], settings.background[2]};
  std::atomic<std::uint64_t> evaluated{0}, blended{0};
  parallel_blocks(n_tiles(), [&](std::uint64_t tile) {
    TileJob job;
    job.list = {instances.get() + tile_begin[tile], static_cast<std::size_t>(tile_begin[tile + 1] - tile_begin[tile])};
    job.splats = splats.get();
    job.x = static_cast<int>(tile % static_cast<std::uint64_t>(grid.columns)) * math::kTileSize;
    job.y = static_cast<int>(tile / static_cast<std::uint64_t>(grid.columns)) * math::kTileSize;
    job.width = std::min(math::kTileSize, view.width - job.x);
    job.height = std::min(math::kTileSize, view.height - job.y);
    job.exponent = settings.exponent;
    job.exp = settings.exp;
    job.details = !target.depth.empty() || !target.blended.empty() || !target.contributions.empty();
    std::vector<TileWeight> weights(target.contributions.empty() ? 0 : job.list.size());
    job.weights = weights.empty() ? nullptr : weights.data();
    TilePixels pixels;
    const std::uint64_t tile_blended = blend_tile(job, pixels);
    if (job.weights != nullptr) add_contributions(job, target.contributions);
    store_tile(job, pixels, view.width, background, target);
    std::uint64_t tile_evaluated = 0;
    for (int y = 0; y < job.height; ++y) {
      for (int x = 0; x < job.width; ++x) {
        tile_evaluated += pixels.evaluated[y * math::kTileSize + x];
      }
    }
    evaluated.fetch_add(tile_evaluated, std::memory_order_relaxed);
    blended.fetch_add(tile_blended, std::memory_order_relaxed);
  });
  stats.evaluated = evaluated;
  stats.blended = blended;
}

ReferenceRenderer::ReferenceRenderer(int threads, bool simd)
    : workspace_(std::make_unique<Workspace>(threads)), simd_(simd) {}
ReferenceRenderer::~ReferenceRenderer() = default;

const char* ReferenceRenderer::name() const {
  return simd_ ? simd_target_name() : "scalar";
}

Result<FrameStats> ReferenceRenderer::render(const SceneParts& scene, const Camera& camera, const RenderTarget& target,
                                             const FrameSettings& settings) {
  FrameStats stats;
  Workspace& w = *workspace_;
  w.grid = math::tile_grid(camera.width, camera.height);
  const auto key = math::key_layout(settings.depth_order, settings.depth_bits, static_cast<std::uint32_t>(w.n_tiles()));
  w.quantized = key.quantized;
  if (w.quantized) {
    stats.depth_bits = key.depth_bits;
    w.quantizer = math::make_depth_quantizer(settings.depth_mapping, stats.depth_bits, settings.depth_range[0],
                                             settings.depth_range[1]);
  }
  const auto view = make_view(camera, scene.origin, settings);
  bool fits = true;
  const auto draw = [&] {
    Stopwatch total, stage;
    w.project(scene, view, settings);
    stats.project_ms = stage.lap_ms();
    fits = w.n_instances <= kMaxInstances;
    if (!fits) return;
    w.sort_by_depth();
    stats.sort_ms = stage.lap_ms();
    w.list_by_tile();
    stats.bin_ms = stage.lap_ms();
    w.blend(view, target, settings, simd_ ? blend_tile_simd : blend_tile_scalar, stats);
    stats.blend_ms = stage.lap_ms();
    stats.total_ms = total.lap_ms();
  };
  const Status drawn = guard_memory([&]() -> Status {
    w.arena.execute(draw);
    return {};
  });
  if (!drawn) return tl::unexpected(drawn.error());
  if (!fits) {
    return make_error(Errc::limit_exceeded, Error::kNone, "too many (tile, Gaussian) pairs in one frame", kMaxInstances,
                      w.n_instances);
  }
  stats.gaussians = w.part_index.n();
  stats.visible = w.n_visible;
  stats.instances = w.n_instances;
  stats.bytes = w.n_visible * (sizeof(ScreenSplat) + 2 * sizeof(SortItem)) + w.n_instances * sizeof(std::uint32_t) +
                (w.counts.size() + w.tile_begin.size()) * sizeof(std::uint64_t);
  for (const Block& block : w.blocks) stats.bytes += block.spans.size() * sizeof(Span16);
  return stats;
}

}  // namespace rgs::detail
