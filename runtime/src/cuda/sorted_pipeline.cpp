// sorted_pipeline.cpp - launches of the sorted pipeline, its workspace, and the one number it reads back.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/sorted_pipeline.hpp"

#include <algorithm>

#include "cuda/workspace_growth.hpp"
#include "sorted/blend.hpp"
#include "sorted/front_end.hpp"

namespace rgs::detail {
namespace {

bool has_narrow_keys(const Frame& f) {
  return f.view.key.bits() <= 32;
}
bool is_separate(const Frame& f) {
  return f.settings.cuda.front_end == PaperSteps::FrontEnd::separate;
}

}  // namespace

std::uint64_t SortedPipeline::bytes() const {
  std::uint64_t sum = 0;
  for (const DeviceBuffer* b : {&counters_, &covers_, &tiles_, &sums_, &sum_temporary_, &block_state_, &keys_,
                                &spare_keys_, &gaussians_, &spare_gaussians_, &sort_temporary_, &ranges_}) {
    sum += b->bytes();
  }
  return sum;
}

// How many splats are drawn and, with a cut, of which Gaussians.
Status SortedPipeline::choose(const Frame& f) {
  n_ = f.n_splats();
  if (!f.cut) return {};
  Status ok = state_.reserve_cut(f);
  for (;;) {
    if (ok) ok = state_.launch_cut(f);
    if (ok) ok = state_.wait(f.stream);
    if (!ok) return ok;
    const std::uint64_t n_chunks = f.seen().cut.chunks;
    n_ = f.n_splats(n_chunks);
    if (n_chunks <= state_.cut.capacity()) return {};
    ok = state_.reserve_cut(f, n_chunks);
  }
}

Status SortedPipeline::reserve_scene(const Frame& f) {
  const std::uint64_t n = state_.n_splats(f);  // with room for a growing cut
  const auto reserve = [&](DeviceBuffer& b, std::uint64_t bytes) { return state_.reserve(b, bytes, f); };
  Status ok = reserve(counters_, sizeof(cuda::Counters));
  if (ok) ok = reserve(state_.splats, n * sizeof(cuda::ScreenSplat));
  if (ok && f.settings.cuda.deterministic && !is_separate(f)) {
    ok = reserve(block_state_, (cuda::fused_blocks(static_cast<std::uint32_t>(n)) + 1) * sizeof(std::uint64_t));
  }
  if (ok && is_separate(f)) {
    const auto temporary = cuda::sum_bytes(static_cast<std::uint32_t>(n));
    if (!temporary) return tl::unexpected(temporary.error());
    ok = reserve(covers_, n * cuda::cover_bytes());
    if (ok) ok = reserve(tiles_, n * sizeof(std::uint32_t));
    if (ok) ok = reserve(sums_, n * sizeof(std::uint64_t));
    if (ok) ok = reserve(sum_temporary_, *temporary);
  }
  if (ok && pair_arrays(f).capacity == 0) {
    ok = reserve_pairs(f, kFirstPairs, std::clamp(4 * n, kFirstPairs, kMaxPairs));
  }
  return ok ? reserve(ranges_, f.n_tiles() * sizeof(cuda::TileRange)) : ok;
}

// Makes room to sort `generous` pairs, or `needed` ones if that is too much memory.
Status SortedPipeline::reserve_pairs(const Frame& f, std::uint64_t needed, std::uint64_t generous) {
  const std::uint64_t key_bytes = has_narrow_keys(f) ? 4 : 8;
  return reserve_growing([&](bool is_generous) -> Status {
    const std::uint64_t wanted = is_generous ? generous : needed;
    // For either key width, since the next frame may use the other.
    const auto narrow = cuda::sort_bytes(wanted, true), wide = cuda::sort_bytes(wanted, false);
    if (!narrow) return tl::unexpected(narrow.error());
    if (!wide) return tl::unexpected(wide.error());
    Status ok = state_.reserve(sort_temporary_, std::max(*narrow, *wide), f);
    for (DeviceBuffer* b : {&keys_, &spare_keys_}) {
      if (ok) ok = state_.reserve(*b, wanted * key_bytes, f);
    }
    for (DeviceBuffer* b : {&gaussians_, &spare_gaussians_}) {
      if (ok) ok = state_.reserve(*b, wanted * sizeof(std::uint32_t), f);
    }
    if (ok) return {};
    // All or nothing: the next frame would not notice that some arrays did not grow.
    for (DeviceBuffer* b : {&keys_, &spare_keys_, &gaussians_, &spare_gaussians_, &sort_temporary_}) *b = {};
    return ok;
  });
}

cuda::PairArrays SortedPipeline::pair_arrays(const Frame& f) const {
  const bool narrow = has_narrow_keys(f);
  const std::uint64_t capacity = std::min({gaussians_.bytes() / 4, keys_.bytes() / (narrow ? 4 : 8), kMaxPairs});
  return {keys_.as<void>(), gaussians_.as<std::uint32_t>(), capacity, narrow};
}

// The fused front end: one kernel, repeated if its pairs did not fit.
Status SortedPipeline::count_and_write(const Frame& f) {
  for (;;) {
    Status ok = device_status(cudaMemsetAsync(counters_.as<void>(), 0, sizeof(cuda::Counters), f.stream),
                              "counters could not be cleared");
    if (ok && f.settings.cuda.deterministic) {
      ok = device_status(cudaMemsetAsync(block_state_.as<void>(), 0, block_state_.bytes(), f.stream),
                         "the scan's state could not be cleared");
    }
    const cuda::PairArrays pairs = pair_arrays(f);
    if (ok) {
      ok = cuda::launch_fused(
          {f.attributes(), static_cast<std::uint32_t>(n_), f.view, f.settings.extent,
           state_.splats.as<cuda::ScreenSplat>(), pairs, counters_.as<cuda::Counters>(),
           f.settings.cuda.deterministic ? block_state_.as<std::uint64_t>() : nullptr, state_.drawn(f)},
          f.stream);
    }
    if (ok) ok = state_.mark(kProjected, f, f.stream);
    if (ok) ok = state_.fetch(&f.seen().counters, counters_.as<void>(), sizeof(cuda::Counters), f.stream);
    if (ok) ok = state_.wait(f.stream);
    if (!ok) return ok;
    n_pairs_ = f.seen().counters.instances;
    if (n_pairs_ > kMaxPairs || n_pairs_ <= pairs.capacity) return ok;
    ok = reserve_pairs(f, n_pairs_, with_room_to_grow(n_pairs_, pairs.capacity, kMaxPairs));
    if (!ok) return ok;
  }
}

// The original's front end: count each Gaussian's pairs, sum, write them.
Status SortedPipeline::count_then_write(const Frame& f) {
  const auto n = static_cast<std::uint32_t>(n_);
  Status ok = device_status(cudaMemsetAsync(counters_.as<void>(), 0, sizeof(cuda::Counters), f.stream),
                            "counters could not be cleared");
  if (ok) {
    ok = cuda::launch_project(
        {f.attributes(), n, f.view, f.settings.extent, state_.splats.as<cuda::ScreenSplat>(), covers_.as<void>(),
         tiles_.as<std::uint32_t>(), counters_.as<cuda::Counters>(), state_.drawn(f)},
        f.stream);
  }
  if (ok) ok = state_.mark(kProjected, f, f.stream);
  if (ok) {
    ok = cuda::launch_sum(tiles_.as<std::uint32_t>(), sums_.as<std::uint64_t>(), n, sum_temporary_.as<void>(),
                          sum_temporary_.bytes(), f.stream);
  }
  Readback::Seen& host = f.seen();
  if (ok) ok = state_.fetch(&host.counters, counters_.as<void>(), sizeof(cuda::Counters), f.stream);
  if (ok && n > 0) {
    ok = state_.fetch(&host.pairs, sums_.as<std::uint64_t>() + n - 1, sizeof(std::uint64_t), f.stream);
  }
  if (ok) ok = state_.wait(f.stream);
  if (!ok) return ok;
  n_pairs_ = n == 0 ? 0 : host.pairs;
  if (n_pairs_ > kMaxPairs) return ok;
  const std::uint64_t capacity = pair_arrays(f).capacity;
  if (n_pairs_ > capacity) ok = reserve_pairs(f, n_pairs_, with_room_to_grow(n_pairs_, capacity, kMaxPairs));
  if (!ok) return ok;
  return cuda::launch_duplicate({n, f.view, f.settings.extent, state_.splats.as<cuda::ScreenSplat>(),
                                 covers_.as<void>(), sums_.as<std::uint64_t>(), pair_arrays(f)},
                                f.stream);
}

Status SortedPipeline::order(const Frame& f, cuda::SortBuffers& sorted) {
  const bool narrow = has_narrow_keys(f);
  sorted = {keys_.as<void>(), spare_keys_.as<void>(), gaussians_.as<std::uint32_t>(),
            spare_gaussians_.as<std::uint32_t>(), narrow};
  Status ok = state_.mark(kDuplicated, f, f.stream);
  if (ok) {
    ok = cuda::launch_sort(sorted, n_pairs_, f.view.key.bits(), sort_temporary_.as<void>(), sort_temporary_.bytes(),
                           f.stream);
  }
  if (ok) ok = state_.mark(kSorted, f, f.stream);
  if (ok) {
    ok = cuda::launch_ranges(sorted.keys, narrow, n_pairs_, f.view.key.depth_bits, ranges_.as<cuda::TileRange>(),
                             f.n_tiles(), f.stream);
  }
  return ok ? state_.mark(kRanged, f, f.stream) : ok;
}

Status SortedPipeline::draw(const Frame& f) {
  Status ok = f.cut ? state_.mark(kStart, f, f.stream) : Status();
  if (ok) ok = choose(f);
  if (ok) ok = reserve_scene(f);
  if (ok && !f.cut) ok = state_.mark(kStart, f, f.stream);
  if (ok) ok = is_separate(f) ? count_then_write(f) : count_and_write(f);
  if (!ok || n_pairs_ > kMaxPairs) return ok;
  cuda::SortBuffers sorted{};
  ok = order(f, sorted);
  if (ok) {
    ok = cuda::launch_blend(
        {ranges_.as<cuda::TileRange>(), sorted.gaussians, state_.splats.as<cuda::ScreenSplat>(), f.view.grid, f.width,
         f.height, f.background(), f.target, f.settings.cuda.count_pairs ? counters_.as<cuda::Counters>() : nullptr,
         f.settings.exponent, f.settings.exp, f.settings.cuda.pixels_per_thread},
        f.stream);
  }
  if (ok) ok = state_.mark(kBlended, f, f.stream);
  return ok ? state_.fetch_counted(f, counters_.as<cuda::Counters>()) : ok;
}

Status SortedPipeline::queue(const Frame& f) {
  Status ok = state_.begin(f);
  if (!ok) return ok;
  ok = draw(f);
  const Status ended = state_.end(f);
  return ok ? ended : ok;
}

}  // namespace rgs::detail
