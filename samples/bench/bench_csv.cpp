// bench_csv.cpp - a report as comma-separated values (RFC 4180, but with "\n").
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <cmath>
#include <type_traits>

#include "bench_report.hpp"
#include "console.hpp"

namespace rgs::bench {
namespace {

std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) out += c == '"' ? "\"\"" : std::string(1, c);
  return out + "\"";
}

// A line, and the line of names beside it, so that they cannot come apart.
class Line {
 public:
  void text(const std::string& name, const std::string& value) { field(name, quoted(tool::printable(value))); }
  template <class T>
  void number(const std::string& name, T value) {
    if constexpr (std::is_floating_point_v<T>) {
      field(name, std::isfinite(value) ? fmt::format("{:.7g}", value) : value > 0 ? "inf" : "nan");
    } else {
      field(name, fmt::format("{}", value));
    }
  }
  void number(const std::string& name, const std::optional<double>& value) {
    value ? number(name, *value) : field(name, "");
  }
  const std::string& names() const { return names_; }
  const std::string& values() const { return values_; }

 private:
  void field(const std::string& name, const std::string& value) {
    if (!names_.empty()) names_ += ',', values_ += ',';
    names_ += name;
    values_ += value;
  }
  std::string names_, values_;
};

void add_quality(Line& line, const std::optional<Quality>& quality) {
  const auto member = [&](double Quality::*field) {
    return quality ? std::optional<double>((*quality).*field) : std::nullopt;
  };
  line.number("psnr", member(&Quality::psnr));
  line.number("worst_psnr", member(&Quality::worst_psnr));
  line.number("ssim", member(&Quality::ssim));
  line.number("largest_difference",
              quality ? std::optional<double>(static_cast<double>(quality->largest)) : std::nullopt);
  line.number("photo_psnr", quality ? quality->photo_psnr : std::nullopt);
  line.number("photo_loss", quality ? quality->photo_loss : std::nullopt);
}

void add_stage(Line& line, Stage stage, const Cost& cost, double ms, const std::optional<cuda::DeviceRates>& rates) {
  const std::string name = stage_name(stage);
  line.number(name + "_ms", ms);
  line.number(name + "_bytes", cost.bytes);
  line.number(name + "_flops", cost.flops);
  line.number(name + "_operations", cost.operations);
  line.number(name + "_floor_ms", rates ? std::optional<double>(floor_of(cost, *rates).ms) : std::nullopt);
}

Line row_line(const Report& report, const SizeReport& size, std::size_t row) {
  const Measurement& m = size.rows[row];
  const FrameStats& s = m.timing.mean;
  Line line;
  line.text("device", report.device.name);
  line.text("date", report.date);
  line.text("scene", report.scene);
  line.text("view", size.view);
  line.number("width", size.width);
  line.number("height", size.height);
  line.text("mode", report.modes[row].configuration.name);
  line.number("total_ms", s.total_ms);
  line.number("eager_clock_ms", m.timing.outside.eager_clock_ms);
  line.number("eager_events_ms", m.timing.outside.eager_events_ms);
  line.number("queued_ms", m.timing.outside.queued_ms);
  line.number("host_us", m.timing.outside.host_us);
  line.number("fastest_camera_ms", m.timing.fastest_ms);
  line.number("slowest_camera_ms", m.timing.slowest_ms);
  line.number("speedup", speedup(size, row));
  line.number("gaussians", s.gaussians);
  line.number("pages", m.timing.drawn.empty() ? std::nullopt : std::optional<double>(s.pages));
  line.number("visible", s.visible);
  line.number("instances", s.instances);
  line.number("evaluated", s.evaluated);
  line.number("blended", s.blended);
  line.number("key_bits", s.key_bits);
  line.number("depth_resolution", s.depth_resolution);
  line.number("bytes", sum(m.costs).bytes);
  line.number("peak_bytes", m.timing.peak_bytes);
  for (std::size_t k = 0; k < kStages.size(); ++k) {
    add_stage(line, kStages[k], m.costs[k], stage_ms(s, kStages[k]), report.rates);
  }
  add_quality(line, report.modes[row].quality);
  return line;
}

}  // namespace

std::string report_csv(const Report& report) {
  std::string names, lines;
  for (const SizeReport& size : report.sizes) {
    for (std::size_t row = 0; row < size.rows.size(); ++row) {
      const Line line = row_line(report, size, row);
      names = line.names();
      lines += line.values() + "\n";
    }
  }
  return names + "\n" + lines;
}

}  // namespace rgs::bench
