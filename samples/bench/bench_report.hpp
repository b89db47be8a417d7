// bench_report.hpp - the results of rgs-bench, as tables, JSON and CSV.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "bench_cost.hpp"
#include "bench_modes.hpp"
#include "bench_quality.hpp"
#include "orbit_motion.hpp"
#include "probe.hpp"
#include "rgs/renderer.hpp"

namespace rgs::bench {

/// Device facts from the CUDA runtime; 0 where it has none.
struct DeviceInfo {
  std::string name;
  int capability_major = 0, capability_minor = 0, multiprocessors = 0;
  double clock_mhz = 0, memory_clock_mhz = 0;  ///< the highest, not the current ones
  std::uint64_t memory_bytes = 0, l2_bytes = 0;
  int driver_version = 0, runtime_version = 0;  ///< of CUDA: 13000 is 13.0
};

/// A frame's time as a caller sees it: means over the cameras, in frames without the library's own events.
struct OutsideTimes {
  /// One frame at a time: medians of the clock from before render() until the stream is done, and of the caller's events
  /// around render(). Both hold all that render() does before its first kernel and after its last one.
  double eager_clock_ms = 0, eager_events_ms = 0;
  /// Frames queued back to back on a stream of the caller's, turbo's asynchronous ones: the caller's events around all of
  /// them, divided by their number.
  double queued_ms = 0;
  /// Microseconds of the host in a render() call of such frames, as many of them as the renderer has in flight without
  /// waiting; of the pipelines that wait for a number of their frame, with this wait.
  double host_us = 0;
};

/// Pages and Gaussians of a frame with levels of detail.
struct DrawnLevels {
  std::string camera;
  std::uint64_t pages = 0, gaussians = 0;
};

/// Means over the cameras; times are medians over the frames of each camera, by events on the stream, from the first
/// kernel to the last, the read-back of the pair count included. The total is that of frames without events between the
/// stages, so that the stages' times may add up to a little more.
struct Timing {
  FrameStats mean;
  OutsideTimes outside;
  int frames = 0;                         ///< fewest that one of the times of a camera comes from
  double fastest_ms = 0, slowest_ms = 0;  ///< medians of the fastest and the slowest camera
  std::uint64_t peak_bytes = 0;           ///< device memory: scene, workspace and target
  std::vector<DrawnLevels> drawn{};       ///< a camera each, above detail 0; empty otherwise
};

/// A mode at one size.
struct Measurement {
  Timing timing;
  StageCosts costs;
};

struct SizeReport {
  int width = 0, height = 0;
  std::string view = {};          ///< of --views stress; empty: the cameras as they are
  std::vector<Measurement> rows;  ///< one a mode, in the order of Report::modes
};

struct ModeReport {
  Configuration configuration;
  std::optional<Quality> quality;
};

/// Modes on an arc around what a camera looks at; steps between modes are left out.
struct OrbitReport {
  std::string camera;
  int width = 0, height = 0, frames = 0;
  double degrees = 0;          ///< from frame to frame
  double distance = 0;         ///< to the point that the arc goes around
  std::vector<OrbitRow> rows;  ///< the first is the baseline
};

/// The facts behind --views stress.
struct StressSource {
  double scene_size = 0;             ///< world units
  std::array<double, 3> dense = {};  ///< where its means are densest, in the world
};

/// Of a scene with levels of detail.
struct LevelsDrawn {
  std::uint32_t n_levels = 0, n_pages = 0;
  std::uint64_t n_stored = 0;  ///< Gaussians of all pages
  float detail_px = 0;         ///< at which all modes but baseline draw
};

struct Report {
  std::string version, date;    ///< of the program; UTC, ISO 8601
  std::string scene, source;    ///< file names
  std::uint64_t gaussians = 0;  ///< with levels of detail of the leaves
  int sh_degree = 0;
  std::optional<LevelsDrawn> levels{};
  std::size_t n_cameras = 0, n_quality_cameras = 0;
  int frames = 0;  ///< measured per camera, with `stress` at most
  DeviceInfo device;
  std::optional<cuda::DeviceRates> rates;  ///< with --roofline
  std::vector<ModeReport> modes;
  std::vector<SizeReport> sizes;
  std::optional<OrbitReport> orbit;    ///< with --orbit
  std::optional<StressSource> stress;  ///< with --views stress; modes hold paper and turbo then
};

double speedup(const SizeReport& size, std::size_t row);  ///< over the first mode; 0 where nothing was timed

/// A stress view's two times, by the events of FrameStats.
struct StressRow {
  double paper_ms = 0, turbo_ms = 0;
  double ratio() const { return turbo_ms > 0 ? paper_ms / turbo_ms : 0; }
  bool passes() const { return turbo_ms > 0 && turbo_ms <= paper_ms; }  ///< turbo is not slower
};
/// `size` has all its rows.
StressRow stress_row(const SizeReport& size, const Report& report);
/// Views that do not pass, "NAME at WIDTHxHEIGHT (TURBO ms, paper PAPER ms)"; none: the gate is passed.
std::vector<std::string> failed_views(const Report& report);

/// Schema "rgs-bench/2": docs/user/BENCH_JSON.md.
std::string report_json(const Report& report);
/// A line for each size and mode under a line of names; fields that were not measured are empty. docs/user/BENCH_JSON.md.
std::string report_csv(const Report& report);

/// Text tables, "\n" after each line. The ablation comes line by line, as rows are measured.
std::string header_text(const Report& report);
std::string size_text(const SizeReport& size, const Report& report);
std::string row_text(const SizeReport& size, std::size_t row, const Report& report);
/// The size's frame times from outside the library, after its last row.
std::string outside_text(const SizeReport& size, const Report& report);
/// Pages and Gaussians drawn by each camera, after the last row; empty at detail 0 and without levels.
std::string drawn_text(const SizeReport& size, const Report& report);
/// The head of the table of stress views, and a view's line.
std::string stress_head_text(const Report& report);
std::string stress_row_text(const SizeReport& size, const Report& report);
/// Why a row's pictures may have Gaussians in the wrong order; empty if its depth resolution is below
/// kCoarseDepthResolution.
std::string coarse_depth_text(const SizeReport& size, std::size_t row, const Report& report);
/// Time, throughput, floor and time / floor of each stage; report.rates is there.
std::string roofline_text(const SizeReport& size, const Report& report);
/// What changes from frame to frame on the arc.
std::string orbit_text(const OrbitReport& orbit);

}  // namespace rgs::bench
