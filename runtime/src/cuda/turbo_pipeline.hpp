// turbo_pipeline.hpp - the turbo pipeline: lists per tile, queued without reading a number back.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "cuda/frame_graph.hpp"
#include "cuda/frame_state.hpp"
#include "turbo/turbo.hpp"

namespace rgs::detail {

/// All functions may fail with device_out_of_memory (a workspace that did not grow still fits earlier frames, or is
/// empty) or device_failed.
class TurboPipeline {
 public:
  explicit TurboPipeline(FrameState& state) : state_(state) {}
  Status create();

  /// Enqueues a frame. Waits only to grow the workspace.
  Status queue(const Frame& frame);
  /// Entries of the oldest frame that is not settled. If they did not fit, lists or cells were left empty and the frame
  /// is repeated; the same for a cut that outgrew its room. Above kMaxPairs it was not drawn. Waits for the end of an
  /// asynchronous frame, and of another, which is the only one, until it has counted.
  Result<Settled> settle(const Frame& frame);
  std::uint64_t bytes() const;  ///< workspace held

 private:
  Status reserve_tiles(const Frame& frame);
  Status reserve_lists(std::uint64_t n_entries, std::uint64_t n_runs, std::uint64_t n_large, std::uint64_t n_in_cells,
                       const Frame& frame);
  std::uint64_t entry_capacity() const;
  std::uint64_t run_capacity() const;
  std::uint64_t cell_capacity() const;
  cuda::TurboLongListSizes long_sizes() const { return cuda::TurboLongListSizes::of(entry_capacity(), run_capacity()); }
  cuda::TurboArrays arrays_for(const Frame& frame) const;
  bool fills(const cuda::TurboBlendArguments& arguments) const;
  Status fill(const Frame& frame, const cuda::TurboBlendArguments& arguments);
  Status order_and_blend(const Frame& frame, const cuda::TurboBlendArguments& arguments, bool is_tensor);
  Status launch(const Frame& frame);
  Status launch_graph(const Frame& frame);

  FrameState& state_;
  Event counted_, counted_long_;  // both: the frame, if not asynchronous, has counted its pairs
  OwnedStream beside_;  // runs what starts at `begun_` and ends at `filled_`, and long lists: `listed_`, `done_long_`
  Event begun_, filled_, listed_, done_long_;
  RunnableGraph graph_;
  struct LastFrame {
    std::uint64_t runs = 0;
    std::uint32_t n_tiles = 0;
  } last_;  // that was settled
  DeviceBuffer turbo_state_, entries_, scratch_, runs_, tile_runs_, large_, lists_, ranked_;
  DeviceBuffer long_lists_, cells_, cell_gaussians_, long_cells_;
};

}  // namespace rgs::detail
