// bench_plot.cpp - roofs, points and bars of a report.
// SPDX-License-Identifier: Apache-2.0
#include "bench_plot.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "svg_writer.hpp"

namespace rgs::bench {
namespace {

using tool::SvgWriter;
using Anchor = SvgWriter::Anchor;

constexpr double kWidth = 980, kHeader = 60, kPanelHeight = 400;
constexpr double kPlotLeft = 70, kPlotWidth = 470, kPlotTop = 36, kPlotHeight = 310;
constexpr double kBarLeft = 620, kBarWidth = 160, kBarHeight = 13, kBarGap = 4, kGroupGap = 14;
constexpr std::size_t kColors = 4;

// A logarithmic axis of whole decades onto px.
struct Axis {
  double low, high;  // exponents of ten
  double from, to;   // px
  double at(double value) const { return from + (std::log10(value) - low) / (high - low) * (to - from); }
};

Axis axis_over(double smallest, double largest, double from, double to) {
  const double low = std::floor(std::log10(smallest)), high = std::ceil(std::log10(largest));
  return {low, std::max(high, low + 1), from, to};
}

struct Point {
  double intensity, gflops;  // flop/B, GFLOP/s
  std::string label;
  std::size_t series;
};

std::string series_style(std::size_t series) {
  return fmt::format("s{}", series % kColors);
}

std::vector<std::size_t> drawn_rows(const Report& report) {
  std::vector<std::size_t> rows;
  for (std::size_t row = 0; row < report.modes.size(); ++row) {
    if (!report.modes[row].configuration.step) rows.push_back(row);
  }
  return rows;
}

std::vector<Point> points_of(const Report& report, const SizeReport& size) {
  std::vector<Point> points;
  const auto rows = drawn_rows(report);
  for (std::size_t series = 0; series < rows.size(); ++series) {
    const Measurement& m = size.rows[rows[series]];
    for (std::size_t k = 0; k < kStages.size(); ++k) {
      const double ms = stage_ms(m.timing.mean, kStages[k]);
      if (ms > 0 && m.costs[k].flops > 0) {
        points.push_back({m.costs[k].intensity(), m.costs[k].flops / ms * 1e-6, stage_name(kStages[k]), series});
      }
    }
  }
  return points;
}

std::string power_of_ten(double exponent) {
  const double value = std::pow(10.0, exponent);
  return value >= 1e6 || value < 1e-3 ? fmt::format("1e{:.0f}", exponent) : fmt::format("{:g}", value);
}

void draw_grid(SvgWriter& svg, const Axis& x, const Axis& y) {
  for (double e = x.low; e <= x.high; ++e) {
    const double at = x.at(std::pow(10.0, e));
    svg.line(at, y.from, at, y.to, "grid");
    svg.text(at, y.from + 16, power_of_ten(e), Anchor::middle, "small");
  }
  for (double e = y.low; e <= y.high; ++e) {
    const double at = y.at(std::pow(10.0, e));
    svg.line(x.from, at, x.to, at, "grid");
    svg.text(x.from - 6, at + 4, power_of_ten(e), Anchor::end, "small");
  }
  svg.text((x.from + x.to) / 2, y.from + 34, "intensity, flop a byte of device memory", Anchor::middle);
  svg.text_upwards(x.from - 48, (y.from + y.to) / 2, "GFLOP/s");
}

// A bandwidth (GB/s) up to the FP32 roof, labelled above or below; where it would leave the plot it is cut off.
void draw_slope(SvgWriter& svg, const Axis& x, const Axis& y, double gigabytes, double peak, const char* style,
                bool label_above, const std::string& label) {
  const double first = std::max(std::pow(10.0, x.low), std::pow(10.0, y.low) / gigabytes);
  const double knee = std::min(peak / gigabytes, std::pow(10.0, x.high));
  if (first >= knee) return;
  svg.line(x.at(first), y.at(first * gigabytes), x.at(knee), y.at(knee * gigabytes), style);
  const double middle = std::sqrt(first * knee);
  svg.text(x.at(middle) + (label_above ? -8 : 10), y.at(middle * gigabytes) + 4, label,
           label_above ? Anchor::end : Anchor::start, "small");
}

void draw_roofline(SvgWriter& svg, const Report& report, const SizeReport& size, double top) {
  const cuda::DeviceRates& rates = *report.rates;
  const double peak = 2e-9 * rates.fp32, copy = 1e-9 * rates.copy_bytes, l2 = 1e-9 * rates.l2_bytes;
  const std::vector<Point> points = points_of(report, size);
  double left = 0.2, right = 10 * peak / copy, bottom = 0.3 * peak;
  for (const Point& p : points) {
    left = std::min(left, p.intensity), right = std::max(right, p.intensity), bottom = std::min(bottom, p.gflops);
  }
  const Axis x = axis_over(left, right, kPlotLeft, kPlotLeft + kPlotWidth);
  const Axis y = axis_over(0.5 * bottom, 1.5 * peak, top + kPlotTop + kPlotHeight, top + kPlotTop);
  draw_grid(svg, x, y);
  draw_slope(svg, x, y, copy, peak, "roof", false, fmt::format("memory {:.0f} GB/s", copy));
  draw_slope(svg, x, y, l2, peak, "roof dashed", true, fmt::format("L2 {:.0f} GB/s", l2));
  svg.line(x.at(std::min(peak / l2, std::pow(10.0, x.high))), y.at(peak), x.to, y.at(peak), "roof");
  svg.text(x.to, y.at(peak) - 6, fmt::format("FP32 FMA {:.1f} TFLOP/s", 1e-3 * peak), Anchor::end, "small");
  for (const Point& p : points) {
    const double px = x.at(p.intensity), py = y.at(p.gflops);
    svg.circle(px, py, 5, series_style(p.series));
    // Away from the roofs, and where two modes lie close, away from each other.
    const bool below = p.series % 2 == 0;
    svg.text(below ? px : px + 9, below ? py + 18 : py + 4, p.label, below ? Anchor::middle : Anchor::start,
             "small " + series_style(p.series));
  }
}

void draw_bars(SvgWriter& svg, const Report& report, const SizeReport& size, double top) {
  const auto rows = drawn_rows(report);
  double y = top + kPlotTop;
  svg.text(kBarLeft, y - 8, "floor / time", Anchor::start, "small");
  for (std::size_t k = 0; k < kStages.size(); ++k) {
    const double height = static_cast<double>(rows.size()) * (kBarHeight + kBarGap);
    svg.text(kBarLeft - 8, y + height / 2 + 2, stage_name(kStages[k]), Anchor::end);
    for (std::size_t series = 0; series < rows.size(); ++series) {
      const Measurement& m = size.rows[rows[series]];
      const double ms = stage_ms(m.timing.mean, kStages[k]);
      const Floor floor = floor_of(m.costs[k], *report.rates);
      const double part = ms > 0 ? floor.ms / ms : 0;
      svg.rectangle(kBarLeft, y, kBarWidth, kBarHeight, "track");
      svg.rectangle(kBarLeft, y, kBarWidth * std::min(part, 1.0), kBarHeight, series_style(series));
      svg.text(kBarLeft + kBarWidth + 6, y + kBarHeight - 3,
               fmt::format("{:.0f}% {} of {:.3f} ms", 100 * part, floor.limit, ms), Anchor::start, "small");
      y += kBarHeight + kBarGap;
    }
    y += kGroupGap;
  }
}

}  // namespace

std::string roofline_svg(const Report& report) {
  const double height = kHeader + kPanelHeight * static_cast<double>(report.sizes.size());
  SvgWriter svg(kWidth, height, "Roofline of " + report.device.name);
  svg.text(kPlotLeft, 22, report.device.name + ", " + report.scene + ", " + report.date, Anchor::start, "title");
  double x = kPlotLeft;
  const auto rows = drawn_rows(report);
  for (std::size_t series = 0; series < rows.size(); ++series) {
    const std::string& name = report.modes[rows[series]].configuration.name;
    svg.circle(x + 5, 42, 5, series_style(series));
    svg.text(x + 16, 46, name);
    x += 40 + 7 * static_cast<double>(name.size());
  }
  double top = kHeader;
  for (const SizeReport& size : report.sizes) {
    svg.text(kPlotLeft, top + 16, fmt::format("{}x{}", size.width, size.height), Anchor::start, "title");
    draw_roofline(svg, report, size, top);
    draw_bars(svg, report, size, top);
    top += kPanelHeight;
  }
  return svg.finish();
}

}  // namespace rgs::bench
