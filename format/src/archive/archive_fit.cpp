// archive_fit.cpp - importance, Karhunen-Loeve transforms and clustered distributions. Sums run in one fixed order.
// SPDX-License-Identifier: Apache-2.0
#include "archive/archive_fit.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>

#include "rgs/quantize.hpp"
#include "rgs/shape_formulas.hpp"

namespace rgs::detail {
namespace {

constexpr int kClasses = 17, kMiddleClass = 8;  // of an octave of importance each
constexpr std::size_t kSample = 1u << 17;       // Gaussians that transforms are fitted to
constexpr std::size_t kMinForTransform = 512;   // fewer do not determine 45 directions

double median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>((values.size() - 1) / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// Eigenvectors of a symmetric matrix [n, n] by cyclic Jacobi rotations (Golub and Van Loan, 8.5), as columns in
// descending order of eigenvalue. Destroys `a`.
std::vector<double> eigenvectors(std::vector<double>& a, std::size_t n) {
  std::vector<double> v(n * n, 0.0);
  for (std::size_t i = 0; i < n; ++i) v[i * n + i] = 1;
  const auto rotate = [n](std::vector<double>& m, std::size_t p, std::size_t q, double c, double s, bool columns) {
    for (std::size_t k = 0; k < n; ++k) {
      double& x = columns ? m[k * n + p] : m[p * n + k];
      double& y = columns ? m[k * n + q] : m[q * n + k];
      const double old = x;
      x = c * old - s * y;
      y = s * old + c * y;
    }
  };
  constexpr int kSweeps = 12;
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    for (std::size_t p = 0; p < n; ++p) {
      for (std::size_t q = p + 1; q < n; ++q) {
        const double off = a[p * n + q], scale = std::abs(a[p * n + p]) + std::abs(a[q * n + q]);
        if (!(std::abs(off) > 1e-15 * scale)) continue;
        const double theta = (a[q * n + q] - a[p * n + p]) / (2 * off);
        const double t = (theta < 0 ? -1 : 1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        rotate(a, p, q, c, s, true);
        rotate(a, p, q, c, s, false);
        rotate(v, p, q, c, s, true);
      }
    }
  }
  std::vector<std::size_t> order(n);
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::ranges::stable_sort(order, [&](std::size_t x, std::size_t y) { return a[x * n + x] > a[y * n + y]; });
  std::vector<double> sorted(n * n);
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t k = 0; k < n; ++k) sorted[i * n + k] = v[i * n + order[k]];
  }
  return sorted;
}

struct Transform {
  std::vector<float> centre;         // [n]
  std::vector<std::int16_t> matrix;  // [n, n], columns are directions, times 2^kMatrixBits
};

// Weighted transform of columns first .. first + n - 1 of SH.
Transform fit_transform(const SplatView& splats, std::span<const double> weights, std::size_t stride, std::size_t first,
                        std::size_t n) {
  const std::size_t width = static_cast<std::size_t>(3 * sh_coefficients(splats.sh_degree));
  std::vector<double> centre(n), covariance(n * n), x(n);
  double total = 0;
  for (std::size_t i = 0, row = 0; row < splats.n; ++i, row += stride) {
    for (std::size_t k = 0; k < n; ++k)
      centre[k] += weights[i] * static_cast<double>(splats.sh[row * width + first + k]);
    total += weights[i];
  }
  for (double& value : centre) value /= total;
  for (std::size_t i = 0, row = 0; row < splats.n; ++i, row += stride) {
    for (std::size_t k = 0; k < n; ++k) x[k] = static_cast<double>(splats.sh[row * width + first + k]) - centre[k];
    for (std::size_t k = 0; k < n; ++k) {
      const double wx = weights[i] * x[k];
      for (std::size_t j = 0; j < n; ++j) covariance[k * n + j] += wx * x[j];
    }
  }
  Transform t;
  t.centre.assign(centre.begin(), centre.end());
  t.matrix.assign(n * n, 0);
  const bool enough = splats.n >= kMinForTransform;
  const std::vector<double> vectors = enough ? eigenvectors(covariance, n) : std::vector<double>();
  for (std::size_t k = 0; k < n * n; ++k) {
    const double value = enough ? vectors[k] : (k / n == k % n ? 1.0 : 0.0);
    t.matrix[k] = static_cast<std::int16_t>(std::nearbyint(value * (1 << kMatrixBits)));
  }
  return t;
}

// Smoothing by which values y = matrix * (SH - centre) of consecutive Gaussians leave the least to code, by their
// logarithms; `step` of all.
ArchiveTables::Smoothing fit_smoothing(const SplatView& splats, std::size_t first, std::span<const float> centre,
                                       std::span<const std::int16_t> matrix, double step) {
  constexpr std::array kKept{0.6, 0.72, 0.81, 0.88};
  constexpr std::size_t kRun = 2048, kRuns = 16;
  constexpr int kGains = 32;
  const std::size_t n = centre.size(), width = static_cast<std::size_t>(3 * sh_coefficients(splats.sh_degree));
  struct Sums {
    double yy = 0, ym = 0, mm = 0;  // m: the mean of those before
  };
  std::vector<Sums> sums(kKept.size() * n);
  const std::uint64_t run = std::max<std::uint64_t>(kRun, splats.n / kRuns);
  for (std::uint64_t begin = 0; begin < splats.n; begin += run) {
    std::vector<double> mean(kKept.size() * n);
    for (std::uint64_t row = begin; row < std::min(begin + kRun, splats.n); ++row) {
      const float* sh = &splats.sh[row * width + first];
      for (std::size_t k = 0; k < n; ++k) {
        double y = 0;
        for (std::size_t q = 0; q < n; ++q)
          y += static_cast<double>(matrix[q * n + k]) * static_cast<double>(sh[q] - centre[q]);
        y /= 1 << kMatrixBits;
        for (std::size_t j = 0; j < kKept.size(); ++j) {
          Sums& s = sums[j * n + k];
          double& m = mean[j * n + k];
          s.yy += y * y, s.ym += y * m, s.mm += m * m;
          m = kKept[j] * m + (1 - kKept[j]) * step * std::nearbyint(y / step);
        }
      }
    }
  }
  ArchiveTables::Smoothing best{};
  double least = std::numeric_limits<double>::max();
  for (std::size_t j = 0; j < kKept.size(); ++j) {
    for (int g = 0; g < kGains; ++g) {
      const double gain = static_cast<double>(g) / kGains;
      double bits = 0;
      for (const Sums& s : std::span(sums).subspan(j * n, n)) {
        const double floor = static_cast<double>(std::min<std::uint64_t>(kRun * kRuns, splats.n)) * step * step / 12;
        bits += std::log2(s.yy - gain * (2 * s.ym - gain * s.mm) + floor);
      }
      if (bits >= least) continue;
      least = bits;
      best = {static_cast<std::uint8_t>(std::lround(256 * gain * (1 - kKept[j]))),
              static_cast<std::uint8_t>(std::lround(256 * kKept[j]))};
    }
  }
  return best;
}

using Counts = std::array<std::uint64_t, kRansTokens>;

// Frequencies with sum kRansTotal, nonzero where a count is.
void normalise(const Counts& counts, std::uint16_t* frequencies) {
  const std::uint64_t total = std::accumulate(counts.begin(), counts.end(), std::uint64_t{0});
  std::uint32_t sum = 0;
  for (std::size_t s = 0; s < kRansTokens; ++s) {
    frequencies[s] = 0;
    if (counts[s] != 0) {
      frequencies[s] =
          static_cast<std::uint16_t>(std::max<std::uint64_t>(1, (counts[s] * kRansTotal + total / 2) / total));
    }
    sum += frequencies[s];
  }
  while (sum != kRansTotal) {  // the largest absorbs the rest: it loses least
    std::uint16_t& largest = *std::max_element(frequencies, frequencies + kRansTokens);
    if (sum < kRansTotal) {
      largest = static_cast<std::uint16_t>(largest + (kRansTotal - sum));
      sum = kRansTotal;
    } else {
      const std::uint32_t less = std::min<std::uint32_t>(sum - kRansTotal, largest / 2u);
      largest = static_cast<std::uint16_t>(largest - less);
      sum -= less;
    }
  }
}

// Lloyd's algorithm with code length as distance, in integer sums.
class Clusters {
 public:
  Clusters(std::span<const std::uint32_t> counts, std::size_t first, std::size_t end, std::size_t n)
      : counts_(counts), sums_(n) {
    std::vector<std::pair<double, std::size_t>> used;  // mean token and context
    std::uint64_t total = 0;
    for (std::size_t context = first; context < end; ++context) {
      std::uint64_t size = 0, moment = 0;
      for (std::size_t s = 0; s < kRansTokens; ++s) size += row(context)[s], moment += s * row(context)[s];
      total += size;
      if (size != 0) used.emplace_back(static_cast<double>(moment) / static_cast<double>(size), context);
    }
    std::ranges::sort(used);
    std::uint64_t before = 0;
    for (const auto& [mean, context] : used) {
      contexts_.push_back(context);
      cluster_.push_back(static_cast<std::size_t>(before * n / total));
      before += std::accumulate(row(context), row(context) + kRansTokens, std::uint64_t{0});
    }
  }

  void refine() {
    sum();
    std::vector<std::uint32_t> cost(sums_.size() * kRansTokens);  // 1/256 bits
    for (std::size_t d = 0; d < sums_.size(); ++d) {
      const double total = static_cast<double>(std::accumulate(sums_[d].begin(), sums_[d].end(), std::uint64_t{0}));
      for (std::size_t s = 0; s < kRansTokens; ++s) {
        const double share = static_cast<double>(sums_[d][s]) / std::max(total, 1.0);
        cost[d * kRansTokens + s] = static_cast<std::uint32_t>(256 * std::min(20.0, -std::log2(std::max(share, 1e-9))));
      }
    }
    for (std::size_t i = 0; i < contexts_.size(); ++i) {
      std::uint64_t best = ~std::uint64_t{0};
      for (std::size_t d = 0; d < sums_.size(); ++d) {
        std::uint64_t bits = 0;
        const std::uint32_t* lengths = &cost[d * kRansTokens];
        for (std::size_t s = 0; s < kRansTokens; ++s) bits += std::uint64_t{row(contexts_[i])[s]} * lengths[s];
        if (bits < best) best = bits, cluster_[i] = d;
      }
    }
  }

  void append_to(ArchiveTables& t) {
    sum();
    std::vector<std::uint8_t> index(sums_.size());
    for (std::size_t d = 0; d < sums_.size(); ++d) {
      if (std::accumulate(sums_[d].begin(), sums_[d].end(), std::uint64_t{0}) == 0) continue;
      index[d] = static_cast<std::uint8_t>(t.n_distributions());
      t.frequencies.resize(t.frequencies.size() + kRansTokens);
      normalise(sums_[d], &t.frequencies[t.frequencies.size() - kRansTokens]);
    }
    for (std::size_t i = 0; i < contexts_.size(); ++i) t.map[contexts_[i]] = index[cluster_[i]];
  }

 private:
  const std::uint32_t* row(std::size_t context) const { return &counts_[context * kRansTokens]; }
  void sum() {
    for (Counts& counts : sums_) counts.fill(0);
    for (std::size_t i = 0; i < contexts_.size(); ++i) {
      for (std::size_t s = 0; s < kRansTokens; ++s) sums_[cluster_[i]][s] += row(contexts_[i])[s];
    }
  }

  std::span<const std::uint32_t> counts_;
  std::vector<std::size_t> contexts_, cluster_;
  std::vector<Counts> sums_;
};

}  // namespace

void fit_grid(const Box& robust, const Box& full, ArchiveParameters& p) {
  for (std::size_t k = 0; k < 3; ++k) {
    const double low = static_cast<double>(robust.min[k]), high = static_cast<double>(robust.max[k]);
    p.centre[k] = (low + high) / 2;
    const double reach =
        std::max(static_cast<double>(full.max[k]) - p.centre[k], p.centre[k] - static_cast<double>(full.min[k]));
    // At most 100 octaves outside, within the range of coordinates. Half a cell of the minimum vanishes in FP32: an
    // axis with equal means decodes exactly.
    p.half_width[k] = std::max({(high - low) / 2, std::ldexp(reach, -100), 0x1p-200});
  }
}

namespace {

// Where all steps are those below.
constexpr double kImportance = -22;
// Found by equal slopes of error and bytes (docs/records/EXPERIMENTS.md): logarithms to base 2 but for those of
// opacity and SH. kBlur is relative to the largest scale of most Gaussians.
constexpr double kBlur = -1.75, kCoarse = 0.8, kFine = -3.1, kTurn = -4.1, kMean = -3.55, kCells = 2.1, kSlope = 0.65;
constexpr double kOpacityLevels = 63, kDc = 0.1, kSh = 0.1, kShSlope = 0.68;

std::int32_t fixed(double octaves) {
  return static_cast<std::int32_t>(std::lround(octaves * kOctave));
}

double opacity_of(const SplatView& splats, std::size_t i) {
  return 1 / (1 + std::exp(-static_cast<double>(splats.opacity_logit[i])));
}

double squared_distance(const SplatView& splats, const ArchiveParameters& p, std::size_t i) {
  double squared = 0;
  for (std::size_t k = 0; k < 3; ++k) {
    const double d = static_cast<double>(splats.mean[3 * i + k]) - p.centre[k];
    squared += d * d;
  }
  return squared;
}

// Finer steps of SH show in no code of SHI8, and leave no codes for large values where Gaussians fill the view.
double least_step(float largest) {
  return std::clamp(static_cast<double>(largest) / 2000, 0x1p-11, 0x1p-6);
}

std::size_t stride_of(const SplatView& splats) {
  return static_cast<std::size_t>((splats.n + kSample - 1) / kSample);
}

// log2 of what a pixel blurs, in distances: scenes are made of Gaussians that show.
double blur_of(const SplatView& splats, const ArchiveParameters& p) {
  std::vector<double> sizes;
  for (std::size_t i = 0; i < splats.n; i += stride_of(splats)) {
    const float* scale = &splats.log_scale[3 * i];
    const double largest = static_cast<double>(*std::max_element(scale, scale + 3)) * std::numbers::log2e;
    sizes.push_back(largest - std::log2(std::max(squared_distance(splats, p, i), p.shape.nearest)) / 2);
  }
  return std::clamp(median(std::move(sizes)) + kBlur, -40.0, 0.0);
}

// log2 of importance.
std::vector<double> importance(const SplatView& splats, const ArchiveParameters& p) {
  std::vector<double> out;
  const double blur = static_cast<double>(p.shape.blur) / kOctave;
  for (std::size_t i = 0; i < splats.n; i += stride_of(splats)) {
    const double distance = std::max(squared_distance(splats, p, i), p.shape.nearest);
    double h[3];
    for (std::size_t k = 0; k < 3; ++k) {
      const double square = std::exp(2 * static_cast<double>(splats.log_scale[3 * i + k])) / distance;
      h[k] = std::log2(square + std::exp2(2 * blur)) / 2;
    }
    const double area = h[0] + h[1] + h[2] - std::min({h[0], h[1], h[2]});
    out.push_back(2 * std::log2(std::max(opacity_of(splats, i), 1e-4)) + area);
  }
  return out;
}

}  // namespace

void fit_steps(const ArchiveOptions& o, const SplatView& splats, const ShStepSet& largest_sh, ArchiveTables& t) {
  ArchiveParameters& p = t.parameters;
  const double step = static_cast<double>(o.step), coarser = std::log2(step);
  p.step = o.step;
  // A cell holds few Gaussians; what is finer depends on each of them.
  p.mean_cells = static_cast<std::uint32_t>(
      std::clamp(std::lround(std::log2(static_cast<double>(splats.n)) / 2 + kCells - coarser / 2), 4L, 18L));
  std::vector<double> distances;
  for (std::size_t i = 0; i < splats.n; i += stride_of(splats)) distances.push_back(squared_distance(splats, p, i));
  ShapeParameters& s = p.shape;
  s.nearest = std::max(median(std::move(distances)), 1e-60);
  s.blur = fixed(blur_of(splats, p));
  s.coarse_step = fixed(kCoarse);
  const double middle = std::round(std::clamp(median(importance(splats, p)), -60.0, 60.0));
  s.middle = fixed(middle);
  s.slope = fixed(kSlope);
  const double finer = kSlope / 2 * (middle - kImportance);
  s.fine_step = fixed(kFine + coarser - finer);
  s.turn_step = fixed(kTurn + coarser - finer);
  s.mean_step = fixed(kMean + coarser - finer);
  p.opacity_levels = static_cast<std::uint32_t>(std::clamp(std::lround(kOpacityLevels / step), 4L, 1000L));
  t.opacity.clear();
  for (std::uint32_t level = 0; level <= p.opacity_levels; ++level) {
    const double root = std::max(static_cast<double>(level), 0.35) / p.opacity_levels;
    t.opacity.push_back(half_from_float(static_cast<float>(root * root)));
  }
  const float largest_dc = *std::max_element(largest_sh.step[0], std::end(largest_sh.step[0])),
              largest = *std::max_element(largest_sh.step[1], std::end(largest_sh.step[3]));
  p.classes.resize(kClasses);
  for (int c = 0; c < kClasses; ++c) {
    const double factor = step * std::exp2(-kShSlope / 2 * (middle + (c - kMiddleClass) - kImportance));
    ArchiveClass& out = p.classes[static_cast<std::size_t>(c)];
    out.dc_step = static_cast<std::uint32_t>(
        std::clamp(std::nearbyint(std::max(kDc * factor, least_step(largest_dc)) * 65536), 1.0, 0x1p26));
    out.sh_step = static_cast<float>(std::max(kSh * factor, least_step(largest)));
  }
  // Small enough for the finest steps, if that leaves room for the largest values.
  t.sh_unit = std::clamp(largest / 8000, p.classes.back().sh_step / 8, p.classes[kMiddleClass].sh_step / 4);
  for (ArchiveClass& c : p.classes) {
    c.sh_units = static_cast<std::uint32_t>(std::clamp(std::nearbyint(c.sh_step / t.sh_unit), 1.f, 32768.f));
    c.sh_step = static_cast<float>(c.sh_units) * t.sh_unit;
  }
}

Sample sample_importance(const SplatView& splats, const ArchiveParameters& p) {
  Sample out{stride_of(splats), importance(splats, p)};
  for (double& x : out.importance) x = std::clamp(x - p.shape.middle / static_cast<double>(kOctave), -8.0, 8.0);
  return out;
}

void fit_transforms(const SplatView& splats, const Sample& sample, ArchiveTables& t) {
  const std::size_t stride = sample.stride;
  std::vector<double> weights;
  for (const double importance : sample.importance) weights.push_back(std::exp2(importance / 2));
  const Transform dc = fit_transform(splats, weights, stride, 0, 3);
  std::ranges::copy(dc.centre, t.dc_centre.begin());
  std::ranges::copy(dc.matrix, t.dc_matrix.begin());
  const ArchiveClass& middle = t.parameters.classes[kMiddleClass];
  t.dc_smoothing = fit_smoothing(splats, 0, t.dc_centre, t.dc_matrix, middle.dc_step / 65536.0);
  if (t.n_sh == 0) return;
  Transform sh = fit_transform(splats, weights, stride, 3, t.n_sh);
  t.sh_centre = std::move(sh.centre);
  t.sh_matrix = std::move(sh.matrix);
  t.sh_smoothing = fit_smoothing(splats, 3, t.sh_centre, t.sh_matrix, static_cast<double>(middle.sh_step));
}

// GEOM and SHI8 have separate distributions, so that the tables of either fit in the cache.
void fit_distributions(std::span<const std::uint32_t> counts, ArchiveTables& t) {
  constexpr std::size_t kGeometry = 96, kColours = 64, kRefinements = 6;
  const ArchiveContexts at = t.contexts();
  t.map.assign(at.count, 0);
  t.frequencies.clear();
  for (const auto& [first, end, n] :
       {std::array{std::size_t{0}, at.dc, kGeometry}, std::array{at.dc, at.count, kColours}}) {
    Clusters clusters(counts, first, end, n);
    for (std::size_t i = 0; i < kRefinements; ++i) clusters.refine();
    clusters.append_to(t);
  }
}

}  // namespace rgs::detail
