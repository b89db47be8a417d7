// bench_cost.hpp - the least that each stage of a frame must move and compute, and how long a device needs for it.
// SPDX-License-Identifier: Apache-2.0
//
// Bytes come from sizeof of the data structures, operations from the functions of rgs::math counted by hand, both times
// what the frame's counters say. All are lower bounds of what the stages as they are must do, so that time / floor >= 1
// says how much there is to gain without another algorithm.
#pragma once

#include <array>
#include <cstdint>

#include "probe.hpp"
#include "rgs/renderer.hpp"

namespace rgs::bench {

/// As FrameStats times them. A fused front end is all projection; turbo's ordering of its lists is its sort.
enum class Stage { project, bin, sort, blend };
inline constexpr std::array kStages{Stage::project, Stage::bin, Stage::sort, Stage::blend};
const char* stage_name(Stage stage);
double stage_ms(const FrameStats& stats, Stage stage);

/// Work of a stage on one frame.
struct Cost {
  double bytes = 0;         ///< read from and written to device memory
  double l2_bytes = 0;      ///< of gathers that L2 serves, read
  double flops = 0;         ///< FP32, and FP16 outside matrix products; an FMA is two
  double operations = 0;    ///< instructions of single lanes, comparisons and selections included; an FMA is one, also
                            ///< on two FP16 numbers: they take as many issue slots as FP32
  double special = 0;       ///< of these, instructions for the special function units
  double shared_loads = 0;  ///< 16-byte words from shared memory, one for all lanes of a warp

  Cost& operator+=(const Cost& other);
  double intensity() const { return bytes > 0 ? flops / bytes : 0; }  ///< flop/B
};
using StageCosts = std::array<Cost, kStages.size()>;  ///< in the order of kStages

/// What a frame had to do: counts as in FrameStats, means over cameras if that is what they are.
struct FrameWork {
  FrameStats stats;       ///< counts with evaluated and blended; key_bits
  RenderOptions options;  ///< that the frame was made with
  int width = 0, height = 0;
  bool compact = true;             ///< the attributes of an .rgs file, or FP32
  int sh_degree = 0;               ///< stored
  std::uint64_t pixel_bytes = 12;  ///< written a pixel
};
StageCosts stage_costs(const FrameWork& work);
Cost sum(const StageCosts& costs);

/// The largest of a cost's demands, each divided by the device's rate.
struct Floor {
  double ms = 0;
  const char* limit = "";  ///< "memory", "L2", "FP32", "special", "shared"
};
Floor floor_of(const Cost& cost, const cuda::DeviceRates& rates);

}  // namespace rgs::bench
