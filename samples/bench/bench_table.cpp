// bench_table.cpp - a report as text for a terminal.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include "bench_report.hpp"
#include "console.hpp"

namespace rgs::bench {
namespace {

std::string millions(std::uint64_t count) {
  return fmt::format("{:.2f}M", static_cast<double>(count) * 1e-6);
}
std::string megabytes(double bytes) {
  return tool::format_bytes(static_cast<std::uint64_t>(bytes));
}
std::string version_text(int cuda) {
  return cuda == 0 ? "?" : fmt::format("{}.{}", cuda / 1000, cuda % 1000 / 10);
}

bool has_quality(const Report& report) {
  return !report.modes.empty() && report.modes.front().quality.has_value();
}
bool has_photos(const Report& report) {
  return has_quality(report) && report.modes.front().quality->photo_psnr.has_value();
}

std::string rates_text(const cuda::DeviceRates& r) {
  return fmt::format(
      "measured: copy {:.0f} GB/s, L2 {:.0f} GB/s, FP32 {:.1f} TFLOP/s, ex2 {:.2f} T/s, shared 128-bit loads {:.1f} "
      "G/s\n",
      r.copy_bytes * 1e-9, r.l2_bytes * 1e-9, 2 * r.fp32 * 1e-12, r.special * 1e-12, r.shared_loads * 1e-9);
}

}  // namespace

double speedup(const SizeReport& size, std::size_t row) {
  const double ms = size.rows[row].timing.mean.total_ms;
  return ms > 0 ? size.rows.front().timing.mean.total_ms / ms : 0;
}

std::string header_text(const Report& report) {
  const DeviceInfo& d = report.device;
  std::string text =
      fmt::format("{}, sm_{}{}, {} multiprocessors, CUDA {} on driver {}; rgs-bench {}, {}\n", d.name,
                  d.capability_major, d.capability_minor, d.multiprocessors, version_text(d.runtime_version),
                  version_text(d.driver_version), report.version, report.date);
  text += fmt::format("{}: {} Gaussians, SH degree {}", tool::printable(report.scene),
                      tool::format_count(report.gaussians), report.sh_degree);
  if (const auto& l = report.levels)
    text += fmt::format("; {} levels, {} Gaussians in {} pages, drawn at detail {:g}", l->n_levels,
                        tool::format_count(l->n_stored), tool::format_count(l->n_pages), l->detail_px);
  if (report.n_quality_cameras > 0) text += fmt::format("; quality at {} cameras", report.n_quality_cameras);
  text += "\n";
  if (report.rates) text += rates_text(*report.rates);
  return text;
}

std::string size_text(const SizeReport& size, const Report& report) {
  std::string text = fmt::format("\n{}x{}  {} cameras, {} frames each; ms\n", size.width, size.height, report.n_cameras,
                                 report.frames);
  text += fmt::format("{:<22}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>10}{:>9}{:>9}{:>9}", "", "project", "bin",
                      "sort", "blend", "total", "speed", "visible", "pairs", "eval", "blended", "moved", "peak");
  if (has_quality(report)) text += fmt::format("{:>7}{:>8}{:>8}", "PSNR", "SSIM", "max");
  if (has_photos(report)) text += fmt::format("{:>8}", "loss");
  return text + "\n";
}

std::string row_text(const SizeReport& size, std::size_t row, const Report& report) {
  const Timing& t = size.rows[row].timing;
  const FrameStats& s = t.mean;
  std::string text =
      fmt::format("{:<22}{:8.4f}{:8.4f}{:8.4f}{:8.4f}{:8.4f}{:7.2f}x{:>8}{:>8}{:>10}{:>9}{:>9}{:>9}",
                  report.modes[row].configuration.name, s.project_ms, s.bin_ms, s.sort_ms, s.blend_ms, s.total_ms,
                  speedup(size, row), millions(s.visible), millions(s.instances), millions(s.evaluated),
                  millions(s.blended), megabytes(sum(size.rows[row].costs).bytes), tool::format_bytes(t.peak_bytes));
  if (const auto& q = report.modes[row].quality) {
    text += fmt::format("{:7.2f}{:8.5f}{:8.4f}", q->psnr, q->ssim, q->largest);
    if (q->photo_loss) text += fmt::format("{:8.4f}", *q->photo_loss);
  }
  return text + "\n";
}

std::string outside_text(const SizeReport& size, const Report& report) {
  std::string text =
      fmt::format("\n{}x{}  as a caller's clock and events see it; ms, host: us\n", size.width, size.height);
  text += fmt::format("{:<22}{:>10}{:>14}{:>15}{:>10}{:>10}\n", "", "total", "eager, clock", "eager, events", "queued",
                      "host");
  for (std::size_t row = 0; row < size.rows.size(); ++row) {
    const Timing& t = size.rows[row].timing;
    text += fmt::format("{:<22}{:10.4f}{:14.4f}{:15.4f}{:10.4f}{:10.1f}\n", report.modes[row].configuration.name,
                        t.mean.total_ms, t.outside.eager_clock_ms, t.outside.eager_events_ms, t.outside.queued_ms,
                        t.outside.host_us);
  }
  return text;
}

std::string drawn_text(const SizeReport& size, const Report& report) {
  const std::vector<DrawnLevels>* drawn = nullptr;  // the same pages in every mode
  for (const Measurement& m : size.rows)
    if (!m.timing.drawn.empty()) drawn = &m.timing.drawn;
  if (drawn == nullptr) return {};
  std::string text = fmt::format("\n{}x{}  drawn at detail {:g}\n{:<22}{:>10}{:>14}{:>10}\n", size.width, size.height,
                                 report.levels->detail_px, "", "pages", "Gaussians", "share");
  for (const DrawnLevels& view : *drawn)
    text += fmt::format("{:<22}{:>10}{:>14}{:>8.1f} %\n", tool::printable(view.camera), tool::format_count(view.pages),
                        tool::format_count(view.gaussians),
                        100 * static_cast<double>(view.gaussians) / static_cast<double>(report.gaussians));
  return text;
}

StressRow stress_row(const SizeReport& size, const Report& report) {
  StressRow found;
  for (std::size_t row = 0; row < size.rows.size(); ++row) {
    const std::string& mode = report.modes[row].configuration.name;
    if (mode == "paper") found.paper_ms = size.rows[row].timing.mean.total_ms;
    if (mode == "turbo") found.turbo_ms = size.rows[row].timing.mean.total_ms;
  }
  return found;
}

std::vector<std::string> failed_views(const Report& report) {
  std::vector<std::string> failed;
  for (const SizeReport& size : report.sizes) {
    if (size.view.empty()) continue;
    const StressRow row = stress_row(size, report);
    if (row.passes()) continue;
    failed.push_back(fmt::format("{} at {}x{} ({:.4f} ms, paper {:.4f} ms)", size.view, size.width, size.height,
                                 row.turbo_ms, row.paper_ms));
  }
  return failed;
}

std::string stress_head_text(const Report& report) {
  std::string text = fmt::format(
      "\nstress views, {} cameras, up to {} frames each; the scene's size is {:.4g} units; ms, queued: a caller's "
      "events\n",
      report.n_cameras, report.frames, report.stress->scene_size);
  text += fmt::format("{:<26}{:>12}", "view", "size");
  for (const ModeReport& mode : report.modes) text += fmt::format("{:>12}", mode.configuration.name);
  text += fmt::format("{:>9}", "ratio");
  for (const ModeReport& mode : report.modes) text += fmt::format("{:>19}", mode.configuration.name + " queued");
  return text + "\n";
}

std::string stress_row_text(const SizeReport& size, const Report& report) {
  const StressRow row = stress_row(size, report);
  std::string text = fmt::format("{:<26}{:>12}", size.view, fmt::format("{}x{}", size.width, size.height));
  for (const Measurement& m : size.rows) text += fmt::format("{:12.4f}", m.timing.mean.total_ms);
  text += fmt::format("{:8.2f}x", row.ratio());
  for (const Measurement& m : size.rows) text += fmt::format("{:19.4f}", m.timing.outside.queued_ms);
  return text + (row.passes() ? "\n" : "  slower\n");
}

std::string coarse_depth_text(const SizeReport& size, std::size_t row, const Report& report) {
  const FrameStats& s = size.rows[row].timing.mean;
  if (s.depth_resolution < kCoarseDepthResolution) return {};
  return fmt::format(
      "rgs-bench: {}{}{}x{}, {}: the depth key of {} bits resolves {:.2g} of the depth, coarser "
      "than "
      "{:g}: Gaussians may be drawn out of order (docs/format/RENDERING.md, \"Depth resolution\")\n",
      size.view, size.view.empty() ? "" : " at ", size.width, size.height, report.modes[row].configuration.name,
      s.depth_bits, s.depth_resolution, kCoarseDepthResolution);
}

std::string roofline_text(const SizeReport& size, const Report& report) {
  std::string text = fmt::format("\n{}x{}  stages against their floors\n", size.width, size.height);
  text += fmt::format("{:<22}{:<8}{:>9}{:>9}{:>9}{:>9}{:>8}{:>9}  {:<8}{:>7}\n", "", "", "ms", "moved", "GB/s",
                      "GFLOP/s", "flop/B", "floor ms", "limit", "ratio");
  for (std::size_t row = 0; row < size.rows.size(); ++row) {
    const Measurement& m = size.rows[row];
    double floors = 0;
    const auto line = [&](const std::string& name, const char* stage, double ms, const Cost& cost, double floor_ms,
                          const char* limit) {
      const double per_second = ms > 0 ? 1e3 / ms : 0;
      text += fmt::format("{:<22}{:<8}{:9.4f}{:>9}{:9.0f}{:9.0f}{:8.2f}{:9.4f}  {:<8}{:6.2f}x\n", name, stage, ms,
                          megabytes(cost.bytes), cost.bytes * per_second * 1e-9, cost.flops * per_second * 1e-9,
                          cost.intensity(), floor_ms, limit, floor_ms > 0 ? ms / floor_ms : 0);
    };
    for (std::size_t k = 0; k < kStages.size(); ++k) {
      const Floor floor = floor_of(m.costs[k], *report.rates);
      floors += floor.ms;
      line(k == 0 ? report.modes[row].configuration.name : "", stage_name(kStages[k]),
           stage_ms(m.timing.mean, kStages[k]), m.costs[k], floor.ms, floor.limit);
    }
    line("", "total", m.timing.mean.total_ms, sum(m.costs), floors, "");
  }
  return text;
}

std::string orbit_text(const OrbitReport& o) {
  std::string text = fmt::format("\n{} frames on an arc, {} degrees each, around the point {:.4g} ahead of {}, {}x{}\n",
                                 o.frames, o.degrees, o.distance, o.camera, o.width, o.height);
  text += fmt::format("{:<22}{:>27}{:>27}{:>27}{:>11}\n", "1/255", "step from frame to frame", "second difference",
                      "step added to the first", "unsteady");
  text += fmt::format("{:<22}", "");
  for (int column = 0; column < 3; ++column) text += fmt::format("{:>9}{:>9}{:>9}", "mean", "99.9 %", "worst");
  text += "\n";
  for (const OrbitRow& row : o.rows) {
    text += fmt::format("{:<22}", row.mode);
    for (const Change& c : {row.step, row.second, row.added}) {
      text += fmt::format("{:9.3f}{:9.2f}{:9.2f}", 255 * c.mean, 255 * c.p999, 255 * c.worst_p999);
    }
    text += fmt::format("{:10.3f}x\n", unsteadiness(row, o.rows.front()));
  }
  return text;
}

}  // namespace rgs::bench
