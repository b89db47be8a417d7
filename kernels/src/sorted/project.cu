// project.cu - the original's front end: one kernel projects, another writes (tile, Gaussian) pairs; one thread a
// Gaussian.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp; docs/format/RENDERING.md "A Gaussian on the image"
// In/Out  attributes -> splats [n], covers [n], tiles [n]; then covers, sums of tiles -> pairs
// Cost    project: 236 B (FP32) or 76 B (compact) read, 48 + 16 or 44 + 4 B written; about 500 flops: memory-bound
//         duplicate: 12 or 8 B written a pair, uncoalesced: each thread writes its own run
// Launch  256 threads, ceil(n / 256) blocks
// Order   deterministic: pairs lie in the order of the Gaussians, which a stable sort keeps for equal depths. Compiled
//         without contraction to FMA, so that positions, covers and depths of pinholes equal the CPU's to the bit.
#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/drawn_rows.cuh"
#include "common/launch.cuh"
#include "common/load_splat.cuh"
#include "common/project_splat.cuh"
#include "sorted/cover.cuh"
#include "sorted/front_end.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;

template <class A, math::Extent E, bool kAnyModel>
__global__ void __launch_bounds__(kThreads)
    project_kernel(A attributes, std::uint32_t n, ViewParameters v, ScreenSplat* splats, Cover<E>* covers,
                   std::uint32_t* tiles, Counters* counters, DrawnChunks drawn) {
  const std::uint32_t i = blockIdx.x * kThreads + threadIdx.x;
  std::uint32_t n_tiles = 0;
  if (i < n) {
    const std::uint32_t row = row_of(attributes, drawn, gaussian_of<kAnyModel>(v, i));
    const math::Vec3<float> mean = load_mean(attributes.mean, row);
    auto p = project_splat<kAnyModel>(attributes, row, v, mean);
    if (p.footprint.valid) {
      const float cutoff = math::power_cutoff(p.footprint.opacity);
      const auto columns = place_copy<kAnyModel, math::kTileSize>(v, i, p);
      const auto cover = Cover<E>::of(p, cutoff, v.grid, columns);
      for (std::uint32_t r = 0; r < cover.n_rows(); ++r) {
        const auto span = cover.tiles(cover.first_row() + static_cast<int>(r), v.grid);
        n_tiles += static_cast<std::uint32_t>(span.last - span.first);
      }
      if (n_tiles > 0) {
        covers[i] = cover;
        splats[i] = screen_splat(p, cutoff, color_of<kAnyModel>(attributes, row, v.view, mean, v.sh_degree));
      }
    }
    tiles[i] = n_tiles;
  }
  const int visible = __syncthreads_count(n_tiles > 0);
  if (threadIdx.x == 0 && visible > 0) {
    atomic_add(counters->visible, static_cast<std::uint64_t>(visible));
  }
}

template <math::Extent E, class Key>
__global__ void __launch_bounds__(kThreads)
    duplicate_kernel(std::uint32_t n, ViewParameters v, const ScreenSplat* splats, const Cover<E>* covers,
                     const std::uint64_t* pair_end, PairArrays pairs) {
  const std::uint32_t i = blockIdx.x * kThreads + threadIdx.x;
  if (i >= n) return;
  std::uint64_t at = i == 0 ? 0 : pair_end[i - 1];
  if (at == pair_end[i]) return;
  const Cover<E> cover = covers[i];
  const std::uint32_t depth = depth_key(v, splats[i].z);
  Key* const keys = static_cast<Key*>(pairs.keys);
  for (std::uint32_t r = 0; r < cover.n_rows(); ++r) {
    const int row = cover.first_row() + static_cast<int>(r);
    const auto span = cover.tiles(row, v.grid);
    for (int x = span.first; x < span.last && at < pairs.capacity; ++x, ++at) {
      keys[at] = make_key<Key>(v, static_cast<std::uint32_t>(row * v.grid.columns + x), depth);
      pairs.gaussians[at] = i;
    }
  }
}

template <class A, math::Extent E>
void run_project(const A& attributes, const ProjectArguments& a, Stream stream) {
  with_model(a.view.view, [&](auto any_model) {
    project_kernel<A, E, any_model()><<<blocks_for(a.n, kThreads), kThreads, 0, stream>>>(
        attributes, a.n, a.view, a.splats, static_cast<Cover<E>*>(a.covers), a.tiles, a.counters, a.drawn);
  });
}

template <math::Extent E, class Key>
void run_duplicate(const DuplicateArguments& a, Stream stream) {
  duplicate_kernel<E, Key><<<blocks_for(a.n, kThreads), kThreads, 0, stream>>>(
      a.n, a.view, a.splats, static_cast<const Cover<E>*>(a.covers), a.pair_end, a.pairs);
}

}  // namespace

std::uint64_t cover_bytes() {
  return sizeof(Cover<math::Extent::ellipse>);
}

Status launch_project(const ProjectArguments& a, Stream stream) {
  if (a.n == 0) return {};
  std::visit(
      [&](const auto& attributes) {
        using A = std::decay_t<decltype(attributes)>;
        a.extent == math::Extent::square ? run_project<A, math::Extent::square>(attributes, a, stream)
                                         : run_project<A, math::Extent::ellipse>(attributes, a, stream);
      },
      a.attributes);
  return launched("the projection kernel could not be launched");
}

Status launch_duplicate(const DuplicateArguments& a, Stream stream) {
  if (a.n == 0) return {};
  const bool square = a.extent == math::Extent::square;
  if (a.pairs.narrow_keys) {
    square ? run_duplicate<math::Extent::square, std::uint32_t>(a, stream)
           : run_duplicate<math::Extent::ellipse, std::uint32_t>(a, stream);
  } else {
    square ? run_duplicate<math::Extent::square, std::uint64_t>(a, stream)
           : run_duplicate<math::Extent::ellipse, std::uint64_t>(a, stream);
  }
  return launched("the duplication kernel could not be launched");
}

}  // namespace rgs::cuda
