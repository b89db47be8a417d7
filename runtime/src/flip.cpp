// flip.cpp - FLIP from the formulas of Andersson et al. 2020, in tasks of some rows; the sum in row order.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numbers>
#include <utility>
#include <vector>

#include "parallel.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/image_metrics.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kRows = 8;  // a task
constexpr double kQc = 0.7, kPc = 0.4, kPt = 0.95, kQf = 0.5;
constexpr double kFeatureWidth = 0.082;        // degrees: twice the standard deviation of the detectors
constexpr double kMinPpd = 1, kMaxPpd = 1000;  // filters of 1 to 136 pixels of radius
using Vec3 = std::array<double, 3>;

// Linear RGB to XYZ over the white of D65, so that white is (1, 1, 1): sRGB's primaries.
constexpr std::array<Vec3, 3> kToXyz{{{10135552.0 / 24577794, 8788810.0 / 24577794, 4435075.0 / 24577794},
                                      {2613072.0 / 12288897, 8788810.0 / 12288897, 887015.0 / 12288897},
                                      {1425312.0 / 73733382, 8788810.0 / 73733382, 70074185.0 / 73733382}}};

Vec3 times(const std::array<Vec3, 3>& m, const Vec3& v) {
  Vec3 out{};
  for (std::size_t i = 0; i < 3; ++i) out[i] = m[i][0] * v[0] + m[i][1] * v[1] + m[i][2] * v[2];
  return out;
}

struct Colours {
  std::array<Vec3, 3> to_xyz = kToXyz, to_rgb{};

  Colours() {
    for (Vec3& row : to_xyz) {
      const double white = row[0] + row[1] + row[2];
      for (double& v : row) v /= white;
    }
    const auto& m = to_xyz;
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {  // cofactors, transposed
        const std::size_t a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
        to_rgb[i][j] = m[a][c] * m[b][d] - m[a][d] * m[b][c];
      }
    }
    const double determinant = m[0][0] * to_rgb[0][0] + m[0][1] * to_rgb[1][0] + m[0][2] * to_rgb[2][0];
    for (Vec3& row : to_rgb)
      for (double& v : row) v /= determinant;
  }

  Vec3 opponent(const float* srgb) const {  // YCxCz
    Vec3 linear{};
    for (std::size_t c = 0; c < 3; ++c) {
      const double v = std::clamp(static_cast<double>(srgb[c]), 0.0, 1.0);
      linear[c] = v > 0.04045 ? std::pow((v + 0.055) / 1.055, 2.4) : v / 12.92;
    }
    const Vec3 xyz = times(to_xyz, linear);
    return {116 * xyz[1] - 16, 500 * (xyz[0] - xyz[1]), 200 * (xyz[1] - xyz[2])};
  }

  Vec3 hunt_lab(const Vec3& linear) const {  // CIELAB with Hunt's adjustment
    Vec3 f = times(to_xyz, linear);
    constexpr double kDelta = 6.0 / 29;
    for (double& v : f) v = v > kDelta * kDelta * kDelta ? std::cbrt(v) : v / (3 * kDelta * kDelta) + 4.0 / 29;
    const double l = 116 * f[1] - 16;
    return {l, 0.01 * l * 500 * (f[0] - f[1]), 0.01 * l * 200 * (f[1] - f[2])};
  }

  Vec3 shown(const Vec3& opponent) const {  // of a filtered colour, clamped to what a screen shows
    const double y = (opponent[0] + 16) / 116;
    Vec3 linear = times(to_rgb, {y + opponent[1] / 500, y, y - opponent[2] / 200});
    for (double& v : linear) v = std::clamp(v, 0.0, 1.0);
    return hunt_lab(linear);
  }
};

double hyab(const Vec3& a, const Vec3& b) {
  return std::abs(a[0] - b[0]) + std::hypot(a[1] - b[1], a[2] - b[2]);
}

using Kernel = std::vector<double>;  // of an odd number of weights

struct Kernels {
  Kernel luminance, red_green, blue_yellow_1, blue_yellow_2;
  double share_1 = 0, share_2 = 0;  // of the two Gaussians of blue-yellow; each sums to 1
  Kernel gauss, edge, point;

  explicit Kernels(double ppd) {
    const auto csf_radius = static_cast<int>(std::ceil(3 * std::sqrt(0.04 / 2) / std::numbers::pi * ppd));
    // exp(-pi^2 x^2 / b): returns its sum before normalisation
    const auto csf = [&](double b, Kernel& out) {
      double sum = 0;
      for (int x = -csf_radius; x <= csf_radius; ++x) {
        const double at = std::numbers::pi * x / ppd;
        out.push_back(std::exp(-at * at / b));
        sum += out.back();
      }
      for (double& w : out) w /= sum;
      return sum;
    };
    csf(0.0047, luminance);
    csf(0.0053, red_green);
    const double sum_1 = csf(0.04, blue_yellow_1), sum_2 = csf(0.025, blue_yellow_2);
    const double mass_1 = 34.1 * std::sqrt(std::numbers::pi / 0.04) * sum_1 * sum_1;
    const double mass_2 = 13.5 * std::sqrt(std::numbers::pi / 0.025) * sum_2 * sum_2;
    share_1 = mass_1 / (mass_1 + mass_2), share_2 = mass_2 / (mass_1 + mass_2);

    const double sd = 0.5 * kFeatureWidth * ppd;
    const auto radius = static_cast<int>(std::ceil(3 * sd));
    for (int x = -radius; x <= radius; ++x) {
      const double g = std::exp(-x * x / (2 * sd * sd));
      gauss.push_back(g);
      edge.push_back(-x * g);
      point.push_back((x * x / (sd * sd) - 1) * g);
    }
    double sum = 0;
    for (const double w : gauss) sum += w;
    for (double& w : gauss) w /= sum;
    for (Kernel* k : {&edge, &point}) {  // the positive weights sum to 1, the negative ones to -1
      double positive = 0, negative = 0;
      for (const double w : *k) (w > 0 ? positive : negative) += std::abs(w);
      for (double& w : *k) w /= w > 0 ? positive : negative > 0 ? negative : 1;
    }
  }
};

struct Planes {
  std::size_t width = 0, height = 0;
  std::array<std::vector<double>, 3> opponent;
};

// One row of one picture, filtered: vertically first, then along the row. Beyond the edge the edge's pixel repeats.
class FilteredRow {
 public:
  FilteredRow(const Planes& planes, const Kernels& kernels)
      : planes_(planes), k_(kernels), margin_(std::max(kernels.luminance.size(), kernels.gauss.size()) / 2) {
    padded_.resize(planes.width + 2 * margin_);
    for (auto& line : lines_) line.resize(planes.width);
  }

  void compute(std::size_t y) {
    pass(0, y, k_.luminance, k_.luminance, lines_[0]);
    pass(1, y, k_.red_green, k_.red_green, lines_[1]);
    pass(2, y, k_.blue_yellow_1, k_.blue_yellow_1, lines_[2]);
    pass(2, y, k_.blue_yellow_2, k_.blue_yellow_2, lines_[3]);
    pass(0, y, k_.gauss, k_.edge, lines_[4]);
    pass(0, y, k_.edge, k_.gauss, lines_[5]);
    pass(0, y, k_.gauss, k_.point, lines_[6]);
    pass(0, y, k_.point, k_.gauss, lines_[7]);
  }

  Vec3 colour(std::size_t x) const {
    return {lines_[0][x], lines_[1][x], k_.share_1 * lines_[2][x] + k_.share_2 * lines_[3][x]};
  }
  double edge(std::size_t x) const { return std::hypot(lines_[4][x], lines_[5][x]) / 116; }
  double point(std::size_t x) const { return std::hypot(lines_[6][x], lines_[7][x]) / 116; }

 private:
  void pass(std::size_t channel, std::size_t y, const Kernel& down, const Kernel& along, std::vector<double>& out) {
    const std::size_t width = planes_.width;
    double* const line = &padded_[margin_];
    std::fill_n(line, width, 0);
    const std::size_t radius = down.size() / 2;
    for (std::size_t i = 0; i < down.size(); ++i) {
      const std::size_t row = std::min(std::max(y + i, radius) - radius, planes_.height - 1);
      const double* const in = &planes_.opponent[channel][row * width];
      for (std::size_t x = 0; x < width; ++x) line[x] += down[i] * in[x];
    }
    std::fill_n(padded_.begin(), margin_, line[0]);
    std::fill_n(line + width, margin_, line[width - 1]);
    std::fill(out.begin(), out.end(), 0);
    const double* const first = line - along.size() / 2;
    for (std::size_t i = 0; i < along.size(); ++i)
      for (std::size_t x = 0; x < width; ++x) out[x] += along[i] * first[x + i];
  }

  const Planes& planes_;
  const Kernels& k_;
  std::size_t margin_;
  std::vector<double> padded_;
  std::array<std::vector<double>, 8> lines_;
};

Planes opponent_planes(const Image& image, const Colours& colours) {
  Planes out{static_cast<std::size_t>(image.width), static_cast<std::size_t>(image.height), {}};
  for (auto& plane : out.opponent) plane.resize(out.width * out.height);
  detail::parallel_ranges(out.height, kRows, [&](std::uint64_t begin, std::uint64_t end) {
    for (std::size_t i = begin * out.width; i < end * out.width; ++i) {
      const Vec3 v = colours.opponent(&image.pixels[3 * i]);
      for (std::size_t c = 0; c < 3; ++c) out.opponent[c][i] = v[c];
    }
  });
  return out;
}

double flip_of(double colour, double cmax, double feature) {
  const double knee = kPc * cmax;
  const double of_colour = colour < knee ? kPt / knee * colour : kPt + (colour - knee) / (cmax - knee) * (1 - kPt);
  const double of_feature = std::pow(std::min(feature / std::numbers::sqrt2, 1.0), kQf);
  return std::pow(std::clamp(of_colour, 0.0, 1.0), 1 - of_feature);
}

}  // namespace

Result<double> flip(const Image& a, const Image& b, double pixels_per_degree, Image* map) {
  return detail::guard_memory([&]() -> Result<double> {
    if (const auto ok = difference(a, b); !ok) return tl::unexpected(ok.error());  // sizes, and finite values
    if (a.channels != 3) return make_error(Errc::bad_argument, Error::kNone, "FLIP compares pictures of 3 channels");
    if (!(pixels_per_degree >= kMinPpd && pixels_per_degree <= kMaxPpd))
      return make_error(Errc::bad_argument, Error::kNone, "FLIP takes 1 to 1000 pixels per degree");
    const Colours colours;
    const Kernels kernels(pixels_per_degree);
    const double cmax = std::pow(hyab(colours.hunt_lab({0, 1, 0}), colours.hunt_lab({0, 0, 1})), kQc);
    const Planes planes_a = opponent_planes(a, colours), planes_b = opponent_planes(b, colours);
    Image out;
    if (map != nullptr) out = Image::make(a.width, a.height, 1);
    std::vector<double> rows(planes_a.height);
    detail::parallel_ranges(rows.size(), kRows, [&](std::uint64_t begin, std::uint64_t end) {
      FilteredRow row_a(planes_a, kernels), row_b(planes_b, kernels);
      for (std::size_t y = begin; y < end; ++y) {
        row_a.compute(y);
        row_b.compute(y);
        for (std::size_t x = 0; x < planes_a.width; ++x) {
          const double colour = hyab(colours.shown(row_a.colour(x)), colours.shown(row_b.colour(x)));
          const double feature =
              std::max(std::abs(row_a.edge(x) - row_b.edge(x)), std::abs(row_a.point(x) - row_b.point(x)));
          const double value = flip_of(std::pow(colour, kQc), cmax, feature);
          rows[y] += value;
          if (map != nullptr) out.pixels[y * planes_a.width + x] = static_cast<float>(value);
        }
      }
    });
    double sum = 0;
    for (const double row : rows) sum += row;
    if (map != nullptr) *map = std::move(out);
    return sum / static_cast<double>(planes_a.width * planes_a.height);
  });
}

}  // namespace rgs
