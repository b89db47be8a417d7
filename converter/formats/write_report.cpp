// write_report.cpp - the value ranges of formats, and how many Gaussians exceed them.
// SPDX-License-Identifier: Apache-2.0
#include "write_report.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <span>
#include <utility>

#include "compressed_ply.hpp"
#include "ksplat.hpp"
#include "quantised.hpp"
#include "rad.hpp"
#include "rgs/quantize.hpp"
#include "sog.hpp"
#include "spz.hpp"
#include "spz_codes.hpp"

namespace rgs::detail {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

// Values from `low` to `high` have codes; up to `rounding` beyond them the nearest code is as near as within the range.
struct Range {
  double low = -kInfinity, high = kInfinity, rounding = 0;
  double infinite = 0;  // infinities count as this

  bool is_open() const { return low == -kInfinity && high == kInfinity; }
  double excess(double value) const { return std::max(low - value, value - high); }
  bool operator==(const Range&) const = default;
};

struct Ranges {
  Range log_scale, opacity_logit, sh_dc;
  Range sh[kMaxShDegree];  // of degrees 1, 2, 3
};

Ranges ranges_of(SplatFormat format) {
  Ranges r;
  if (holds_spz(format)) {
    r.log_scale = {-10, 255 / 16.0 - 10, 1 / 32.0, static_cast<double>(kMaxLogScale)};
    r.sh_dc = {-0.5 / kSpzColourScale, 0.5 / kSpzColourScale, 0.5 / 255 / kSpzColourScale};
    r.sh[0] = {-1, 127 / 128.0, 1 / 32.0};
    r.sh[1] = r.sh[2] = {-1, 127 / 128.0, 1 / 16.0};
  } else if (format == SplatFormat::splat) {
    r.sh_dc = {-0.5 / kSh0, 0.5 / kSh0, 0.5 / 255 / kSh0};
    std::ranges::fill(r.sh, Range{0, 0, 0});
  } else if (format == SplatFormat::ksplat) {
    constexpr double kHalf = static_cast<double>(kMaxKsplatHalf);
    const double smallest = std::log(static_cast<double>(kMinKsplatScale));
    r.log_scale = {smallest, std::log(kHalf), 1e-6, -smallest};  // a flat Gaussian's -inf is the smallest
    r.sh_dc = {-0.5 / kSh0, 0.5 / kSh0, 0.5 / 255 / kSh0};
    std::fill_n(r.sh, kKsplatShDegree, Range{-kHalf, kHalf, kHalf / 0x1p12});
    std::fill(r.sh + kKsplatShDegree, std::end(r.sh), Range{0, 0, 0});
  } else if (format == SplatFormat::compressed_ply) {
    r.log_scale = {-kMaxCompressedLogScale, kMaxCompressedLogScale, 0, static_cast<double>(kMaxLogScale)};
    std::ranges::fill(r.sh, Range{-4, 4, 1 / 64.0});
  } else if (format == SplatFormat::sog) {
    r.sh_dc = {-static_cast<double>(kMaxSogHarmonic), static_cast<double>(kMaxSogHarmonic)};
    std::ranges::fill(r.sh, r.sh_dc);
  } else if (format == SplatFormat::rad) {
    const auto dc = [](float colour) { return static_cast<double>(dc_from_colour(static_cast<double>(colour))); };
    r.log_scale = {static_cast<double>(kMinRadLogScale), static_cast<double>(kMaxRadLogScale), 1e-6, 0};
    r.sh_dc = {dc(kMinRadColour), dc(kMaxRadColour), 1e-6};
    std::ranges::fill(r.sh, Range{-static_cast<double>(kMaxRadSh), static_cast<double>(kMaxRadSh), 1e-6});
  } else if (format == SplatFormat::glb || format == SplatFormat::usda || format == SplatFormat::usdz) {
    r.opacity_logit = {-103.97, 17.328679, 0, 0};  // beyond these it is 0 or 1 as a 32-bit float; infinite, exactly
  }
  return r;
}

struct Segment {
  std::uint64_t first = 0, count = 0;
  Range range;
};

// Counts rows of `values` [n, each] that exceed the range of any segment.
Clamped count_beyond(std::span<const float> values, std::uint64_t each, std::span<const Segment> segments) {
  Clamped clamped;
  // Nearly all Gaussians are within: comparing the largest magnitude first vectorises.
  std::array<std::int32_t, kMaxShDegree> within{};
  for (std::size_t s = 0; s < segments.size(); ++s) {
    const Range& range = segments[s].range;
    within[s] = magnitude_bits(static_cast<float>((std::min(-range.low, range.high) + range.rounding) * (1 - 1e-6)));
  }
  for (std::uint64_t row = 0; row < values.size(); row += each) {
    double excess = 0;  // beyond rounding
    for (std::size_t s = 0; s < segments.size(); ++s) {
      const auto part = values.subspan(row + segments[s].first, segments[s].count);
      std::int32_t largest = 0;
      for (const float value : part) largest = std::max(largest, magnitude_bits(value));
      if (largest <= within[s]) continue;
      const Range& range = segments[s].range;
      const auto note = [&](double beyond) { excess = beyond > range.rounding ? std::max(excess, beyond) : excess; };
      const float magnitude = float_of(static_cast<std::uint32_t>(largest));
      if (range.low == -range.high && std::isfinite(magnitude)) {
        note(static_cast<double>(magnitude) - range.high);
        continue;
      }
      for (const float value : part) {
        note(range.excess(std::isinf(value) ? std::copysign(range.infinite, value) : static_cast<double>(value)));
      }
    }
    if (excess <= 0) continue;
    ++clamped.n;
    clamped.largest = std::max(clamped.largest, excess);
  }
  return clamped;
}

Clamped count_beyond(std::span<const float> values, std::uint64_t each, std::uint64_t count, const Range& range) {
  if (range.is_open()) return {};
  const Segment segment{0, count, range};
  return count_beyond(values, each, {&segment, 1});
}

Clamped count_beyond_sh(const SplatView& splats, const Ranges& ranges) {
  if (splats.sh_degree == 0 || ranges.sh[0].is_open()) return {};
  std::array<Segment, kMaxShDegree> segments;
  std::size_t n = 0;
  for (int degree = 1; degree <= splats.sh_degree; ++degree) {
    const auto first = static_cast<std::uint64_t>(3 * sh_coefficients(degree - 1));
    const auto end = static_cast<std::uint64_t>(3 * sh_coefficients(degree));
    if (n > 0 && segments[n - 1].range == ranges.sh[degree - 1]) {
      segments[n - 1].count += end - first;
    } else {
      segments[n++] = {first, end - first, ranges.sh[degree - 1]};
    }
  }
  return count_beyond(splats.sh, static_cast<std::uint64_t>(3 * sh_coefficients(splats.sh_degree)),
                      std::span(segments).first(n));
}

// SPZ's fixed point has as many fractional bits as the farthest mean leaves; with fewer than the default, steps are
// coarser.
Clamped count_coarse_means(const SplatView& splats) {
  const auto bits = choose_fractional_bits(splats);
  Clamped clamped;
  if (!bits || *bits == kSpzFractionalBits) return clamped;
  const double usual = std::ldexp(0.5, -kSpzFractionalBits);
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    double moved = 0;
    for (std::uint64_t k = 0; k < 3; ++k) {
      const auto mean = static_cast<double>(splats.mean[3 * i + k]);
      moved = std::max(moved, std::abs(std::ldexp(std::floor(std::ldexp(mean, *bits) + 0.5), -*bits) - mean));
    }
    if (moved <= usual) continue;
    ++clamped.n;
    clamped.largest = std::max(clamped.largest, moved);
  }
  return clamped;
}

}  // namespace

WriteReport measure_clamping(const SplatView& splats, SplatFormat format) {
  const Ranges ranges = ranges_of(format);
  WriteReport report;
  if (holds_spz(format)) report.mean = count_coarse_means(splats);
  report.log_scale = count_beyond(splats.log_scale, 3, 3, ranges.log_scale);
  report.opacity_logit = count_beyond(splats.opacity_logit, 1, 1, ranges.opacity_logit);
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(splats.sh_degree));
  report.sh_dc = count_beyond(splats.sh, floats, 3, ranges.sh_dc);
  report.sh = count_beyond_sh(splats, ranges);
  return report;
}

Status refuse_clamping(const WriteReport& report) {
  const std::pair<const Clamped&, const char*> kinds[] = {
      {report.mean, "the format stores means this far out in coarser steps; move the scene or drop --strict"},
      {report.log_scale, "scales are beyond the format's range; drop --strict to clamp them"},
      {report.opacity_logit, "opacities are 0 or 1 in the format's numbers; drop --strict to round them"},
      {report.sh_dc, "colours (f_dc) are beyond the format's range; drop --strict to clamp them"},
      {report.sh, "harmonics (f_rest) are beyond the format's range; drop --strict to clamp or drop them"}};
  for (const auto& [clamped, what] : kinds) {
    if (clamped.n != 0) return make_error(Errc::bad_value, Error::kNone, what, 0, clamped.n);
  }
  return {};
}

void add_report(WriteReport& report, const WriteReport& more) {
  for (Clamped WriteReport::*of : {&WriteReport::mean, &WriteReport::log_scale, &WriteReport::opacity_logit,
                                   &WriteReport::sh_dc, &WriteReport::sh}) {
    (report.*of).n += (more.*of).n;
    (report.*of).largest = std::max((report.*of).largest, (more.*of).largest);
  }
}

}  // namespace rgs::detail
