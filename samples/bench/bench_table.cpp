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
