// bench_sample_report.hpp - a report like one of rgs-bench, with realistic numbers.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <utility>

#include "bench_report.hpp"

namespace rgs::test {

inline FrameStats frame_stats(double project_ms, double bin_ms, double sort_ms, double blend_ms, std::uint64_t visible,
                              std::uint64_t instances, double evaluated, double blended, int key_bits) {
  FrameStats s;
  s.project_ms = project_ms, s.bin_ms = bin_ms, s.sort_ms = sort_ms, s.blend_ms = blend_ms;
  s.total_ms = project_ms + bin_ms + sort_ms + blend_ms;
  s.gaussians = 778812, s.visible = visible, s.instances = instances;
  s.evaluated = static_cast<std::uint64_t>(evaluated), s.blended = static_cast<std::uint64_t>(blended);
  s.key_bits = key_bits;
  return s;
}

/// Baseline, a step, and paper mode at 1920x1080 on an H100, with rates and quality.
inline bench::Report sample_report() {
  bench::Report r;
  r.version = "0.1.0", r.date = "2026-11-21T20:00:00Z";
  r.scene = "south & \"north\" <1>.rgs", r.source = "south.ply";
  r.gaussians = 778812, r.sh_degree = 3, r.n_cameras = 8, r.n_quality_cameras = 16, r.frames = 100;
  r.device.name = "NVIDIA H100 80GB HBM3";
  r.device.capability_major = 9, r.device.multiprocessors = 132;
  r.device.driver_version = r.device.runtime_version = 13000;
  r.rates = cuda::DeviceRates{2.9e12, 5.5e12, 3.3e13, 4.1e12, 5.8e10};
  const auto rows = bench::ablation({});
  const std::pair<bench::Configuration, FrameStats> measured[] = {
      {rows[0], frame_stats(0.0868, 1.0258, 1.0141, 3.7877, 630022, 14888772, 2000.5e6, 154.0e6, 45)},
      {rows[3], frame_stats(0.1255, 0.0293, 0.3183, 1.0417, 623199, 3485263, 402.8e6, 154.5e6, 45)},
      {rows[6], frame_stats(0.1235, 0.0275, 0.1966, 0.5208, 623199, 3485263, 400.5e6, 153.2e6, 32)}};
  r.sizes.push_back({1920, 1080, {}, {}});
  for (const auto& row : measured) {
    const bench::Configuration& c = row.first;
    r.modes.push_back({c, bench::Quality{51.1, 49.5, 0.9971, 0.7037F, 22.0, 0.014}});
    bench::Measurement m;
    m.timing.mean = row.second;
    m.timing.peak_bytes = 197000000;
    m.timing.frames = 100;
    m.timing.outside = {row.second.total_ms + 0.04, row.second.total_ms + 0.03, row.second.total_ms + 0.01, 27.3};
    m.costs = bench::stage_costs({row.second, c.options, 1920, 1080, c.compact, 3});
    r.sizes.front().rows.push_back(m);
  }
  return r;
}

/// Two stress views of paper and turbo; turbo is ahead in the first.
inline bench::Report stress_report() {
  bench::Report r = sample_report();
  r.modes = {{bench::make_mode("paper", {}), {}}, {bench::make_mode("turbo", {}), {}}};
  r.stress = bench::StressSource{12.5, {1, 2, 3}};
  r.n_quality_cameras = 0;
  r.rates.reset();
  r.sizes.clear();
  for (const auto& [view, turbo_ms] : {std::pair("ordinary", 0.32), {"back 300 units", 9.45}}) {
    bench::SizeReport size{1920, 1080, view, {}};
    for (const double ms : {0.875, turbo_ms}) {
      bench::Measurement m;
      m.timing.mean = frame_stats(0.1, 0.1, 0.1, ms - 0.3, 1000, 2000, 3000, 4000, 32);
      m.timing.frames = 40;
      m.timing.outside = {ms + 0.04, ms + 0.03, ms + 0.01};
      size.rows.push_back(m);
    }
    r.sizes.push_back(size);
  }
  r.sizes[1].rows[0].timing.mean.depth_resolution = 2.5e-3;
  r.sizes[1].rows[0].timing.mean.depth_bits = 19;
  return r;
}

}  // namespace rgs::test
