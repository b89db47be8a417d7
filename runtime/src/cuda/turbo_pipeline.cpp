// turbo_pipeline.cpp - launches of the turbo pipeline, its workspace, and the later check of whether a frame fitted.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/turbo_pipeline.hpp"

#include <algorithm>
#include <vector>

#include "cuda/workspace_growth.hpp"

namespace rgs::detail {
namespace {

// Below this, coefficients of exponents may leave the range of FP16.
constexpr float kTensorLowPass = 0.1F;

constexpr std::uint64_t kLargeBytes = sizeof(cuda::TurboLargeGaussian) + sizeof(cuda::TurboBox);

}  // namespace

Status TurboPipeline::create() {
  Status ok;
  for (Event* event : {&counted_, &counted_long_, &begun_, &filled_, &listed_, &done_long_}) {
    if (ok) ok = event->create();
  }
  int least = 0, greatest = 0;
  if (ok) {
    ok = device_status(cudaDeviceGetStreamPriorityRange(&least, &greatest),
                       "the device's stream priorities could not be read");
  }
  // High priority: its work takes longest, and its blocks become ready after the others are queued.
  return ok ? beside_.create(greatest) : ok;
}

std::uint64_t TurboPipeline::bytes() const {
  std::uint64_t sum = 0;
  for (const DeviceBuffer* b : {&turbo_state_, &entries_, &scratch_, &runs_, &tile_runs_, &large_, &lists_, &ranked_,
                                &long_lists_, &cells_, &cell_gaussians_, &long_cells_}) {
    sum += b->bytes();
  }
  return sum;
}

// Makes room for so many entries, runs and large Gaussians, and if memory allows for more of those that do not fit.
Status TurboPipeline::reserve_lists(std::uint64_t n_entries, std::uint64_t n_runs, std::uint64_t n_large,
                                    std::uint64_t n_in_cells, const Frame& f) {
  struct Need {
    DeviceBuffer& buffer;
    std::uint64_t n, size;
    std::uint64_t held() const { return buffer.bytes() / size; }
  };
  std::vector<Need> needs;
  for (const Need& need :
       {Need{entries_, n_entries, sizeof(cuda::TurboEntry)}, Need{scratch_, n_entries, sizeof(cuda::TurboEntry)},
        Need{runs_, n_runs, sizeof(cuda::TurboTileRun)}, Need{tile_runs_, n_runs, sizeof(cuda::TurboRun)},
        Need{large_, n_large, kLargeBytes}, Need{cell_gaussians_, n_in_cells, sizeof(std::uint32_t)}}) {
    if (need.n > need.held()) needs.push_back(need);
  }
  return reserve_growing([&](bool is_generous) {
    Status ok;
    for (const Need& need : needs) {
      const std::uint64_t n = is_generous ? with_room_to_grow(need.n, need.held(), kMaxPairs) : need.n;
      if (ok) ok = state_.reserve(need.buffer, n * need.size, f);
    }
    if (ok) ok = state_.reserve(long_lists_, long_sizes().bytes(), f);
    if (ok) ok = state_.reserve(long_cells_, cuda::TurboLongCellSizes::of(cell_capacity()).bytes(), f);
    for (const Need& need : needs) {
      if (!ok) need.buffer = {};  // grown buffers would hold memory that the others need
    }
    return ok;
  });
}

// Makes room for what is known before the frame; guesses the rest for the first frame.
Status TurboPipeline::reserve_tiles(const Frame& f) {
  Status ok = state_.reserve_cut(f);
  if (!ok) return ok;
  const std::uint64_t n = state_.n_splats(f), n_tiles = f.n_tiles();
  const auto reserve = [&](DeviceBuffer& b, std::uint64_t bytes) { return state_.reserve(b, bytes, f); };
  ok = reserve(state_.splats, n * sizeof(cuda::ScreenSplat));
  if (ok) ok = reserve(turbo_state_, cuda::TurboState::bytes(f.n_tiles()));
  if (ok) ok = reserve(lists_, n_tiles * sizeof(cuda::TurboList));
  if (ok) ok = reserve(ranked_, n_tiles * sizeof(cuda::TurboRankedList));
  if (ok) ok = reserve(cells_, n_tiles * cuda::kTurboCells * sizeof(cuda::TurboCell));
  if (!ok || entries_.bytes() > 0) return ok;
  return reserve_growing([&](bool is_generous) {
    const std::uint64_t first = is_generous ? std::max(kFirstPairs, 2 * n) : kFirstPairs;
    return reserve_lists(first, first / 4, first / 32, 3 * first, f);
  });
}

std::uint64_t TurboPipeline::entry_capacity() const {
  return std::min(entries_.bytes(), scratch_.bytes()) / sizeof(cuda::TurboEntry);
}
std::uint64_t TurboPipeline::run_capacity() const {
  return std::min(runs_.bytes() / sizeof(cuda::TurboTileRun), tile_runs_.bytes() / sizeof(cuda::TurboRun));
}
std::uint64_t TurboPipeline::cell_capacity() const {
  return cell_gaussians_.bytes() / sizeof(std::uint32_t);
}

cuda::TurboArrays TurboPipeline::arrays_for(const Frame& f) const {
  cuda::TurboArrays a{};
  a.n_tiles = f.n_tiles();
  a.state = turbo_state_.as<cuda::TurboState>();
  a.entries = entries_.as<cuda::TurboEntry>();
  a.runs = runs_.as<cuda::TurboTileRun>();
  a.tile_runs = tile_runs_.as<cuda::TurboRun>();
  a.lists = lists_.as<cuda::TurboList>();
  a.ranked = ranked_.as<cuda::TurboRankedList>();
  a.scratch = scratch_.as<cuda::TurboEntry>();
  a.large_gaussians = large_.as<cuda::TurboLargeGaussian>();
  a.entry_capacity = entry_capacity();
  a.run_capacity = run_capacity();
  a.large_capacity = large_.bytes() / kLargeBytes;
  a.large_boxes = reinterpret_cast<cuda::TurboBox*>(a.large_gaussians + a.large_capacity);
  long_sizes().lay_out(long_lists_.as<void>(), a);
  a.cells = cells_.as<cuda::TurboCell>();
  a.cell_gaussians = cell_gaussians_.as<std::uint32_t>();
  a.cell_capacity = cell_capacity();
  cuda::TurboLongCellSizes::of(cell_capacity()).lay_out(long_cells_.as<void>(), a);
  return a;
}

// Whether the last frame was nearly empty; then this one probably is, and is filled before its Gaussians are known.
bool TurboPipeline::fills(const cuda::TurboBlendArguments& a) const {
  return a.arrays.n_tiles == last_.n_tiles && last_.runs < cuda::sparse_tiles(last_.n_tiles);
}

// Runs beside the stages before blending, which read and compute, and leave write bandwidth.
Status TurboPipeline::fill(const Frame& f, const cuda::TurboBlendArguments& a) {
  Status ok = begun_.record(f.stream);
  if (ok) ok = begun_.hold(beside_.get());
  if (ok) ok = state_.hold_for_target(f, beside_.get());
  if (ok) ok = cuda::launch_turbo_fill(a, beside_.get());
  const Status recorded = filled_.record(beside_.get());
  return ok ? recorded : ok;
}

// Long lists are few and take several steps, so they run beside the others.
Status TurboPipeline::order_and_blend(const Frame& f, const cuda::TurboBlendArguments& a, bool is_tensor) {
  auto* const on = f.stream;
  Status ok = listed_.record(on);
  if (ok) ok = listed_.hold(beside_.get());
  if (!ok) return ok;
  const bool is_waited_for = !f.settings.cuda.asynchronous;
  ok = cuda::launch_turbo_long_lists(a.arrays, a.grid, &f.seen().turbo, beside_.get());
  if (ok && is_waited_for) ok = counted_long_.record(beside_.get());
  if (ok) ok = cuda::launch_turbo_units(a.arrays, beside_.get());
  if (ok && is_tensor) ok = state_.hold_for_target(f, beside_.get());
  if (ok && is_tensor) ok = cuda::launch_turbo_tensor_long(a, beside_.get());
  // Joined after errors too: the next frame waits for `on` alone.
  Status joined = done_long_.record(beside_.get());
  if (ok) ok = cuda::launch_turbo_order(a.arrays, a.grid, &f.seen().turbo, a.is_filled, on);
  if (ok && is_waited_for) ok = counted_.record(on);
  for (const Mark m : {kSorted, kRanged}) {
    if (ok) ok = state_.mark(m, f, on);
  }
  if (ok) ok = state_.hold_for_target(f, on);
  if (ok && is_tensor) ok = cuda::launch_turbo_tensor(a, on);
  if (joined) joined = done_long_.hold(on);
  if (ok) ok = joined;
  if (!ok) return ok;
  return is_tensor ? cuda::launch_turbo_segments(a, on) : cuda::launch_turbo_blend(a, on);
}

// Queues the frame's kernels without waiting.
Status TurboPipeline::launch(const Frame& f) {
  const cuda::TurboArrays arrays = arrays_for(f);
  cuda::TurboBlendArguments a{
      arrays,   state_.splats.as<cuda::ScreenSplat>(), f.view.grid, f.width, f.height, f.background(),
      f.target, f.settings.cuda.count_pairs,           false};
  const bool is_tensor = f.settings.cuda.tensor_cores && f.settings.low_pass >= kTensorLowPass && !a.has_details();
  a.is_filled = is_tensor && fills(a);
  f.readback->room = {state_.cut.capacity(), arrays.entry_capacity, arrays.run_capacity, arrays.large_capacity,
                      arrays.cell_capacity};
  auto* const on = f.stream;
  Status ok = state_.mark(kStart, f, on);
  if (ok && a.is_filled) ok = fill(f, a);
  if (ok) {
    ok = device_status(cudaMemsetAsync(arrays.state, 0, cuda::TurboState::bytes(arrays.n_tiles), on),
                       "the frame's state could not be cleared");
  }
  if (ok && f.cut) ok = state_.launch_cut(f);
  if (ok) {
    ok = cuda::launch_turbo_emit({f.attributes(), static_cast<std::uint32_t>(state_.n_splats(f)), f.view,
                                  state_.splats.as<cuda::ScreenSplat>(), arrays, state_.drawn(f)},
                                 on);
  }
  if (ok) ok = state_.mark(kProjected, f, on);
  if (ok) ok = cuda::launch_turbo_lists(arrays, f.view.grid, &f.seen().turbo, on);
  if (ok) ok = state_.mark(kDuplicated, f, on);
  // After errors too: the next frame waits for `on` alone.
  if (const Status joined = a.is_filled ? filled_.hold(on) : Status(); ok) ok = joined;
  if (ok) ok = order_and_blend(f, a, is_tensor);
  if (ok) ok = state_.mark(kBlended, f, on);
  return ok ? state_.fetch_counted(f, &arrays.state->counters) : ok;
}

// The same as one graph, which takes the host less time than a dozen launches.
Status TurboPipeline::launch_graph(const Frame& f) {
  Frame captured = f;
  captured.stream = state_.own.get();
  captured.is_graph = true;
  Status ok = device_status(cudaStreamBeginCapture(captured.stream, cudaStreamCaptureModeThreadLocal),
                            "a frame could not be captured");
  if (!ok) return ok;
  ok = launch(captured);
  Graph graph;
  const Status ended =
      device_status(cudaStreamEndCapture(captured.stream, graph.put()), "a frame could not be captured");
  if (ok) ok = ended;
  return ok ? graph_.launch(graph, state_.stream_of(f)) : ok;
}

Status TurboPipeline::queue(const Frame& f) {
  Status ok = state_.begin(f);
  if (!ok) return ok;
  ok = reserve_tiles(f);
  // A graph begins later, which a caller that waits would notice.
  if (ok) ok = f.settings.cuda.asynchronous ? launch_graph(f) : launch(f);
  const Status ended = state_.end(f);
  return ok ? ended : ok;
}

Result<Settled> TurboPipeline::settle(const Frame& f) {
  for (bool is_repeated = false;; is_repeated = true) {
    Status ok;
    if (f.settings.cuda.asynchronous) {
      ok = f.readback->finished->wait();
    } else {
      ok = counted_.wait();
      if (ok) ok = counted_long_.wait();
    }
    if (!ok) return tl::unexpected(ok.error());
    const cuda::TurboState& seen = f.seen().turbo;
    const Readback::Room& room = f.readback->room;
    const std::uint64_t n = seen.counters.instances, n_chunks = f.cut ? f.seen().cut.chunks : 0;
    const bool cut_fits = n_chunks <= room.chunks;
    const bool all_large =
        seen.n_large_gaussians <= room.large_gaussians;  // otherwise the entries of the others are not counted
    if (cut_fits) {
      const bool all_listed = all_large && n <= room.entries && seen.runs <= room.runs;
      f.seen().counters = seen.counters;
      if (std::max(n, seen.in_cells) > kMaxPairs) return Settled{std::max(n, seen.in_cells), is_repeated};
      if (all_listed && seen.in_cells <= room.in_cells) {
        last_ = {seen.runs, f.n_tiles()};
        return Settled{n, is_repeated};
      }
    }
    if (ok = state_.order.finished->wait(); !ok)
      return tl::unexpected(ok.error());  // later frames are queued again, too
    // Counts without all large Gaussians are too low to size memory by.
    ok = !cut_fits   ? state_.reserve_cut(f, n_chunks)
         : all_large ? reserve_lists(n, seen.runs, 0, seen.in_cells, f)
                     : reserve_lists(0, 0, seen.n_large_gaussians, 0, f);
    if (ok) ok = queue(f);
    if (!ok) return tl::unexpected(ok.error());
  }
}

}  // namespace rgs::detail
