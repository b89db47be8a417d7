// audit_chart.cpp - histograms and curves as SVG paths: one element each for any number of bins.
// SPDX-License-Identifier: Apache-2.0
#include "audit_chart.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <span>

#include "svg_writer.hpp"

namespace rgs::audit {
namespace {

using tool::SvgWriter;
using Anchor = SvgWriter::Anchor;

constexpr double kWidth = 320, kTop = 14, kBase = 104, kHeight = 128, kLeft = 6, kRight = 314;

SvgWriter chart_with_axis(const std::string& label) {
  SvgWriter svg = SvgWriter::in_page(kWidth, kHeight, label);
  svg.line(kLeft, kBase + 0.5, kRight, kBase + 0.5, "axis");
  return svg;
}

void draw_columns(SvgWriter& svg, std::span<const double> heights) {
  const double step = (kRight - kLeft) / static_cast<double>(heights.size());
  std::string path;
  for (std::size_t i = 0; i < heights.size(); ++i) {
    if (heights[i] <= 0) continue;
    const double x = kLeft + step * static_cast<double>(i), y = kBase - std::max(0.8, heights[i] * (kBase - kTop));
    fmt::format_to(std::back_inserter(path), "M{:.1f} {:.0f}V{:.1f}H{:.1f}V{:.0f}Z", x, kBase, y,
                   x + std::max(0.6, step - (step > 3 ? 1 : 0)), kBase);
  }
  svg.path(path, "bars");
}

std::string power_of_ten(int exponent) {
  if (exponent >= -3 && exponent <= 3) return fmt::format("{:g}", std::pow(10, exponent));
  return fmt::format("1e{}", exponent);
}

}  // namespace

std::string error_histogram(const ErrorStatistics& e, const std::string& unit, const std::string& label) {
  const std::string described =
      fmt::format("{}: median {:.3g}, 99 % below {:.3g}, largest {:.3g} {}", label, e.p50, e.p99, e.max, unit);
  SvgWriter svg = chart_with_axis(described);
  if (e.histogram.empty()) {
    svg.text(kWidth / 2, 64, "no error", Anchor::middle);
    return svg.finish();
  }
  // Leave out the smallest thousandth: it would stretch the axis over decades of negligible errors.
  std::uint64_t all = 0, seen = 0;
  for (const std::uint64_t n : e.histogram) all += n;
  std::size_t skipped = 0;
  while ((seen += e.histogram[skipped]) * 1000 <= all) ++skipped;
  skipped -= skipped % 4;
  const int first_octave = e.first_octave + static_cast<int>(skipped / 4);
  std::vector<std::uint64_t> bins(e.histogram.begin() + static_cast<std::ptrdiff_t>(skipped), e.histogram.end());
  // At least four powers of two, so that a single value does not fill the chart.
  bins.resize(std::max<std::size_t>(16, (bins.size() + 3) / 4 * 4));
  const auto highest = static_cast<double>(*std::max_element(bins.begin(), bins.end()));
  std::vector<double> heights;
  heights.reserve(bins.size());
  for (const std::uint64_t n : bins) heights.push_back(static_cast<double>(n) / highest);
  draw_columns(svg, heights);
  const double octaves = static_cast<double>(bins.size()) / 4;
  const auto x_of = [&](double error) {
    return std::clamp(kLeft + (std::log2(error) - first_octave) / octaves * (kRight - kLeft), kLeft, kRight);
  };
  const auto decade = [](double octave) { return octave * std::log10(2.0); };
  const int first = static_cast<int>(std::ceil(decade(first_octave)));
  const int last = static_cast<int>(std::floor(decade(first_octave + octaves)));
  const int every = std::max(1, (last - first + 5) / 6);
  for (int k = first; k <= last; k += every) {
    const double x = x_of(std::pow(10, k));
    svg.line(x, kBase, x, kBase + 4, "axis");
    svg.text(std::clamp(x, 18.0, kWidth - 18), kBase + 16, power_of_ten(k), Anchor::middle);
  }
  const auto mark = [&](double value, const char* kind) {
    if (value > 0) svg.line(x_of(value), kTop - 6, x_of(value), kBase, kind);
  };
  mark(e.p50, "mark");
  mark(e.p99, "mark dashed");
  mark(e.max, "mark dotted");
  return svg.finish();
}

std::string frame_curve(const Curve& curve, int fps, const std::string& label) {
  SvgWriter svg = chart_with_axis(label);
  double low = std::numeric_limits<double>::infinity(), high = -low;
  for (const double v : curve.values)
    if (std::isfinite(v)) low = std::min(low, v), high = std::max(high, v);
  if (low > high) low = high = 0;
  if (!curve.at_least) low = 0;
  const double last = std::max(1.0, static_cast<double>(curve.values.size()) - 1);
  const auto x_of = [&](std::size_t frame) {
    return std::min(kRight, kLeft + static_cast<double>(frame) / last * (kRight - kLeft));
  };
  std::string path;
  bool drawn = false;
  for (std::size_t i = 0; i < curve.values.size(); ++i) {
    const double v = curve.values[i];
    const double share = high > low ? std::clamp((v - low) / (high - low), 0.0, 1.0) : v > high ? 1.0 : 0.0;
    if (!std::isnan(v))
      path += fmt::format("{}{:.1f} {:.1f}{}", drawn ? "L" : "M", x_of(i), kBase - share * (kBase - kTop),
                          drawn ? "" : "h0");
    drawn = !std::isnan(v);
  }
  svg.path(path, "curve");
  svg.line(x_of(curve.second), kBase + 3, x_of(curve.second + static_cast<std::size_t>(fps) - 1), kBase + 3, "second");
  svg.text(kLeft, kTop - 3, fmt::format("{:.4g}", high));
  svg.text(kLeft, kBase + 16, fmt::format("{:.4g}", low));
  svg.text(kRight, kBase + 16, fmt::format("{} frames", curve.values.size()), Anchor::end);
  return svg.finish();
}

std::string code_histogram(const CodeUsage& usage, const std::string& label) {
  SvgWriter svg = chart_with_axis(
      fmt::format("{}: {} of 255 codes are used, {:.2f} bits of entropy", label, usage.used(), usage.entropy_bits()));
  const double highest = std::log1p(static_cast<double>(*std::max_element(usage.count.begin(), usage.count.end())));
  std::vector<double> heights;
  heights.reserve(usage.count.size());
  for (const std::uint64_t n : usage.count)
    heights.push_back(highest > 0 ? std::log1p(static_cast<double>(n)) / highest : 0);
  draw_columns(svg, heights);
  svg.text(kLeft, kBase + 16, "-127");
  svg.text(kWidth / 2, kBase + 16, "0", Anchor::middle);
  svg.text(kRight, kBase + 16, "127", Anchor::end);
  return svg.finish();
}

}  // namespace rgs::audit
