// audit_attributes.cpp - compares blocks: sums per block in a fixed order, histograms and extremes per thread.
// SPDX-License-Identifier: Apache-2.0
#include "audit_attributes.hpp"

#include <fmt/format.h>
#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <numbers>

#include "rgs/encode.hpp"
#include "rgs/quantize.hpp"

namespace rgs::audit {
namespace {

constexpr std::uint64_t kBlock = 4096;
constexpr std::size_t kAtOnce = 128;  // 30 KB of each file: fits the second-level cache
constexpr std::size_t kWorst = 8;
constexpr float kLeastScale = 0x1p-86f;  // e^-60: the unit for errors of a scale of 0

// All distributions, in the order of the report.
enum Series : std::size_t {
  kShValue = 0,    // [4, 3] by degree and channel, each coefficient
  kShLevels = 12,  // [4, 3] RMS over all directions, 8-bit levels, each Gaussian
  kColour = 24,    // all degrees, RMS over directions and channels
  kRotation,       // quaternion component
  kRotationDegrees,
  kScale,         // world units
  kScalePercent,  // of the scale
  kOpacity,
  kOpacityPercent,
  kMean,      // world units
  kMeanSize,  // of the Gaussian's largest standard deviation
  kSeries,
};

enum Worst : std::size_t { kWorstColour, kWorstRotation, kWorstScale, kWorstOpacity, kWorstMean, kWorstLists };

// Bins by the top bits of FP32: 64 per power of two, from 2^-48 (an FP32 rounding of something tiny) to 2^16.
constexpr int kLowestExponent = -48, kExponents = 64, kBinsPerOctave = 64;
constexpr std::size_t kBins = static_cast<std::size_t>(kExponents) * kBinsPerOctave;
constexpr std::uint32_t kShift = 23 - 6;
constexpr std::uint32_t kFirstBin = static_cast<std::uint32_t>(127 + kLowestExponent) << 6;

std::size_t bin_of(float error) {
  const std::uint32_t raw = std::bit_cast<std::uint32_t>(error) >> kShift;
  return std::min<std::size_t>(raw > kFirstBin ? raw - kFirstBin : 0, kBins - 1);
}
double upper_edge(std::size_t bin) {
  return static_cast<double>(std::bit_cast<float>((static_cast<std::uint32_t>(bin) + 1 + kFirstBin) << kShift));
}

struct Distribution {
  std::array<std::uint64_t, kBins> bins{};
  std::uint64_t n = 0, n_zero = 0;
  float max = 0;

  void add(float error) {
    ++n;
    if (error > 0) {
      ++bins[bin_of(error)];
      max = std::max(max, error);
    } else {
      ++n_zero;
    }
  }
  void merge(const Distribution& other) {
    for (std::size_t i = 0; i < kBins; ++i) bins[i] += other.bins[i];
    n += other.n;
    n_zero += other.n_zero;
    max = std::max(max, other.max);
  }
  double quantile(double share) const {
    const auto wanted = static_cast<std::uint64_t>(std::ceil(share * static_cast<double>(n)));
    std::uint64_t seen = n_zero;
    if (seen >= wanted) return 0;
    for (std::size_t i = 0; i < kBins; ++i) {
      seen += bins[i];
      if (seen >= wanted && i + 1 < kBins) return std::min(upper_edge(i), static_cast<double>(max));
    }
    return static_cast<double>(max);
  }
};

struct Sum {
  double errors = 0, squares = 0;
  void add(float error) {
    const double e = static_cast<double>(error);
    errors += e;
    squares += e * e;
  }
};
using BlockSums = std::array<Sum, kSeries>;

bool worse(const WorstGaussian& a, const WorstGaussian& b) {
  return a.error != b.error ? a.error > b.error : a.asset_index < b.asset_index;
}

// One thread's counts; merging does not depend on how the work was split.
struct Seen {
  std::vector<Distribution> series = std::vector<Distribution>(kSeries);
  std::array<std::vector<WorstGaussian>, kWorstLists> worst{};
  std::array<CodeUsage, 4> codes{};
  RangeCounts ranges;

  void rank(Worst list, float error, std::uint64_t asset_index, std::uint64_t source_index,
            const std::array<double, 3>& mean) {
    auto& top = worst[list];
    if (!(error > 0) || (top.size() == kWorst && static_cast<double>(error) < top.back().error)) return;
    const WorstGaussian entry{static_cast<double>(error), asset_index, source_index, mean};
    top.insert(std::upper_bound(top.begin(), top.end(), entry, worse), entry);
    if (top.size() > kWorst) top.pop_back();
  }
  void merge(const Seen& other) {
    for (std::size_t i = 0; i < kSeries; ++i) series[i].merge(other.series[i]);
    for (std::size_t i = 0; i < kWorstLists; ++i) {
      worst[i].insert(worst[i].end(), other.worst[i].begin(), other.worst[i].end());
      std::sort(worst[i].begin(), worst[i].end(), worse);
      if (worst[i].size() > kWorst) worst[i].resize(kWorst);
    }
    for (std::size_t d = 0; d < codes.size(); ++d)
      for (std::size_t i = 0; i < codes[d].count.size(); ++i) codes[d].count[i] += other.codes[d].count[i];
    ranges.sh_clipped += other.ranges.sh_clipped;
    ranges.sh_limit += other.ranges.sh_limit;
    ranges.sh_flushed += other.ranges.sh_flushed;
    ranges.scale_subnormal += other.ranges.scale_subnormal;
    ranges.scale_zero += other.ranges.scale_zero;
    ranges.opacity_zero += other.ranges.opacity_zero;
    ranges.opacity_one += other.ranges.opacity_one;
  }
};

// Angle in degrees between two rotations, and the largest difference of a component; q and -q are one rotation. The
// half-angle form is exact where acos of the product has lost all digits.
struct RotationError {
  float degrees = 0, component = 0;
};
RotationError rotation_error(const float* source, const float* stored) {
  double length = 0, dot = 0;
  for (int i = 0; i < 4; ++i) {
    length += static_cast<double>(source[i]) * static_cast<double>(source[i]);
    dot += static_cast<double>(source[i]) * static_cast<double>(stored[i]);
  }
  const double factor = (dot < 0 ? -1 : 1) / std::sqrt(length);
  double apart = 0, together = 0, component = 0;
  for (int i = 0; i < 4; ++i) {
    const double a = factor * static_cast<double>(source[i]), b = static_cast<double>(stored[i]);
    apart += (a - b) * (a - b);
    together += (a + b) * (a + b);
    component = std::max(component, std::abs(a - b));
  }
  const double radians = 4 * std::atan(std::sqrt(apart / together));
  return {static_cast<float>(radians * 180 / std::numbers::pi), static_cast<float>(component)};
}

class Comparison {
 public:
  Comparison(const FileView& asset, int source_degree, const Origin& source_origin)
      : source_origin_(source_origin),
        asset_origin_(asset.declarations().origin),
        asset_degree_(asset.header().sh_degree),
        floats_(3 * static_cast<std::size_t>(sh_coefficients(std::max(source_degree, asset_degree_)))),
        stored_floats_(3 * static_cast<std::size_t>(sh_coefficients(asset_degree_))),
        smallest_normal_(std::ldexp(kHalfMinNormal, -asset.header().scale_exponent)) {}

  void set_steps(const ShStepSet& set) {
    for (std::size_t i = 0; i < floats_; ++i) {
      step_[i] = set.of_value(static_cast<int>(i));
      inverse_step_[i] = step_[i] > 0 ? 1 / step_[i] : 0;
    }
  }

  /// `logarithms`: of `stored`, if the source was read through these too. Equal ones are equal values.
  void add(const Splat& source, const ActivatedSplat& stored, const Splat* logarithms, std::uint64_t asset_index,
           std::uint64_t source_index, BlockSums& sums, Seen& seen) const {
    const auto note = [&](std::size_t series, float error) {
      sums[series].add(error);
      seen.series[series].add(error);
    };
    const float colour = add_sh(source.sh, stored.sh, seen, note);
    note(kColour, colour);

    const bool same_rotation = logarithms != nullptr && std::ranges::equal(source.rotation, logarithms->rotation);
    const RotationError rotation = same_rotation ? RotationError() : rotation_error(source.rotation, stored.rotation);
    note(kRotation, rotation.component);
    note(kRotationDegrees, rotation.degrees);

    float largest_percent = 0, largest_scale = 0;
    for (int i = 0; i < 3; ++i) {
      const bool same = logarithms != nullptr && logarithms->log_scale[i] == source.log_scale[i];
      const float scale = same ? stored.scale[i] : scale_from_log(source.log_scale[i]);
      const float error = std::abs(stored.scale[i] - scale);
      const float percent = 100 * error / std::max(scale, kLeastScale);
      note(kScale, error);
      note(kScalePercent, percent);
      largest_percent = std::max(largest_percent, percent);
      largest_scale = std::max(largest_scale, scale);
      seen.ranges.scale_zero += stored.scale[i] == 0;
      seen.ranges.scale_subnormal += stored.scale[i] > 0 && stored.scale[i] < smallest_normal_;
    }

    const bool same_opacity = logarithms != nullptr && logarithms->opacity_logit == source.opacity_logit;
    const float opacity = same_opacity ? stored.opacity : opacity_from_logit(source.opacity_logit);
    const float opacity_error = std::abs(stored.opacity - opacity);
    note(kOpacity, opacity_error);
    note(kOpacityPercent, 100 * opacity_error);
    seen.ranges.opacity_zero += stored.opacity == 0 && opacity > 0;
    seen.ranges.opacity_one += stored.opacity == 1 && opacity < 1;

    double squared = 0;
    std::array<double, 3> mean;
    for (std::size_t i = 0; i < 3; ++i) {
      mean[i] = source_origin_[i] + static_cast<double>(source.mean[i]);
      // Subtract origins first: they are usually equal, and then nothing is rounded.
      const double d = (asset_origin_[i] - source_origin_[i]) +
                       (static_cast<double>(stored.mean[i]) - static_cast<double>(source.mean[i]));
      squared += d * d;
    }
    const auto moved = static_cast<float>(std::sqrt(squared));
    const float moved_size = moved / std::max(largest_scale, kLeastScale);
    note(kMean, moved);
    note(kMeanSize, moved_size);

    seen.rank(kWorstColour, colour, asset_index, source_index, mean);
    seen.rank(kWorstRotation, rotation.degrees, asset_index, source_index, mean);
    seen.rank(kWorstScale, largest_percent, asset_index, source_index, mean);
    seen.rank(kWorstOpacity, 100 * opacity_error, asset_index, source_index, mean);
    seen.rank(kWorstMean, moved_size, asset_index, source_index, mean);
  }

 private:
  // Returns the colour error. Harmonics are orthonormal on the sphere (Parseval): the mean over all directions of the
  // squared colour error is exactly the sum of the squared coefficient errors over 4 pi.
  template <class Note>
  float add_sh(const float* source, const float* stored, Seen& seen, const Note& note) const {
    std::array<double, 12> squares{};  // FP32 would overflow for the largest legal coefficients
    for (std::size_t i = 0; i < floats_; ++i) {
      const auto degree = static_cast<std::size_t>(sh_degree_of(static_cast<int>(i / 3))), channel = i % 3;
      const float error = std::abs(stored[i] - source[i]);
      squares[3 * degree + channel] += static_cast<double>(error) * static_cast<double>(error);
      note(kShValue + 3 * degree + channel, error);
    }
    for (std::size_t i = 0; i < stored_floats_; ++i) {
      const auto degree = static_cast<std::size_t>(sh_degree_of(static_cast<int>(i / 3)));
      const auto code = static_cast<int>(std::lrint(stored[i] * inverse_step_[i]));
      ++seen.codes[degree].count[static_cast<std::size_t>(std::clamp(code, -kShCodeMax, kShCodeMax) + kShCodeMax)];
      seen.ranges.sh_limit += std::abs(code) == kShCodeMax;
      seen.ranges.sh_flushed += code == 0 && source[i] != 0;
      seen.ranges.sh_clipped += std::abs(source[i]) > 127.5F * step_[i] && step_[i] > 0;
    }
    double all = 0;
    const std::size_t n = floats_ == 3 ? 3 : floats_ == 12 ? 6 : floats_ == 27 ? 9 : 12;
    for (std::size_t i = 0; i < n; ++i) {
      note(kShLevels + i, static_cast<float>(kLevels * std::sqrt(squares[i])));
      all += squares[i];
    }
    return static_cast<float>(kLevels * std::sqrt(all / 3));
  }

  static constexpr double kLevels = 255 * 0.28209479177387814;  // 8-bit levels over sqrt(4 pi)
  Origin source_origin_, asset_origin_;
  int asset_degree_;
  std::size_t floats_, stored_floats_;
  float smallest_normal_;
  std::array<float, 48> step_{}, inverse_step_{};
};

ErrorStatistics statistics(const Distribution& d, const Sum& sum) {
  ErrorStatistics out;
  out.n = d.n;
  out.n_zero = d.n_zero;
  if (d.n == 0) return out;
  const auto n = static_cast<double>(d.n);
  out.max = static_cast<double>(d.max);
  out.mean = sum.errors / n;
  out.rms = std::sqrt(sum.squares / n);
  out.p50 = d.quantile(0.5);
  out.p99 = d.quantile(0.99);
  out.p999 = d.quantile(0.999);
  constexpr std::size_t kWidth = kBinsPerOctave / 4;
  std::vector<std::uint64_t> bins(kBins / kWidth);
  for (std::size_t i = 0; i < kBins; ++i) bins[i / kWidth] += d.bins[i];
  std::size_t first = 0, last = bins.size();
  while (first < last && bins[first] == 0) ++first;
  while (last > first && bins[last - 1] == 0) --last;
  first -= first % 4;  // a whole power of two
  out.first_octave = kLowestExponent + static_cast<int>(first / 4);
  if (last > first)
    out.histogram.assign(bins.begin() + static_cast<std::ptrdiff_t>(first),
                         bins.begin() + static_cast<std::ptrdiff_t>(last));
  return out;
}

AttributeReport summarise(const Seen& seen, const BlockSums& sums, int degree, int asset_degree) {
  AttributeReport report;
  const auto of = [&](std::size_t series) { return statistics(seen.series[series], sums[series]); };
  constexpr std::array kChannels{"red", "green", "blue"};
  for (std::size_t d = 0; d <= static_cast<std::size_t>(degree); ++d) {
    for (std::size_t c = 0; c < 3; ++c)
      report.errors.push_back({fmt::format("sh{}.{}", d, kChannels[c]),
                               fmt::format("SH degree {}, {}", d, kChannels[c]), "", "8-bit levels",
                               of(kShValue + 3 * d + c), of(kShLevels + 3 * d + c)});
  }
  report.colour = {"colour", "Colour, all SH together", "8-bit levels", "8-bit levels", of(kColour), of(kColour)};
  report.errors.push_back(
      {"rotation", "Rotation", "quaternion component", "degrees", of(kRotation), of(kRotationDegrees)});
  report.errors.push_back({"scale", "Scale", "world units", "% of the scale", of(kScale), of(kScalePercent)});
  report.errors.push_back({"opacity", "Opacity", "0 to 1", "% points", of(kOpacity), of(kOpacityPercent)});
  report.errors.push_back({"mean", "Mean", "world units", "of own size", of(kMean), of(kMeanSize)});
  report.worst = {{"colour", "Colour", "8-bit levels", seen.worst[kWorstColour]},
                  {"rotation", "Rotation", "degrees", seen.worst[kWorstRotation]},
                  {"scale", "Scale", "%", seen.worst[kWorstScale]},
                  {"opacity", "Opacity", "% points", seen.worst[kWorstOpacity]},
                  {"mean", "Mean", "of own size", seen.worst[kWorstMean]}};
  report.codes.assign(seen.codes.begin(), seen.codes.begin() + asset_degree + 1);
  report.ranges = seen.ranges;
  return report;
}

}  // namespace

std::uint64_t CodeUsage::n() const {
  std::uint64_t sum = 0;
  for (const std::uint64_t c : count) sum += c;
  return sum;
}
int CodeUsage::used() const {
  return static_cast<int>(std::count_if(count.begin(), count.end(), [](std::uint64_t c) { return c != 0; }));
}
double CodeUsage::entropy_bits() const {
  const auto all = static_cast<double>(n());
  double bits = 0;
  for (const std::uint64_t c : count)
    if (c != 0) bits -= static_cast<double>(c) / all * std::log2(static_cast<double>(c) / all);
  return bits;
}

AttributeReport compare_attributes(const Source& source, const FileView& asset, const Pairing& pairing,
                                   tool::Progress& progress) {
  const std::uint64_t n = pairing.source_of.size(), n_blocks = (n + kBlock - 1) / kBlock;
  const std::uint32_t chunk_size = asset.header().chunk_size;
  progress.begin("attributes", n, "Gaussians");
  std::vector<BlockSums> sums(n_blocks);
  tbb::enumerable_thread_specific<Seen> threads;
  tbb::parallel_for(std::uint64_t{0}, n_blocks, [&](std::uint64_t block) {
    Seen& seen = threads.local();
    Comparison comparison(asset, source.sh_degree(), source.origin());
    std::uint64_t chunk = ~std::uint64_t{0};
    std::array<Splat, kAtOnce> wanted, logarithms;
    const bool is_rgs = source.format() == SplatFormat::rgs;
    std::array<ActivatedSplat, kAtOnce> stored;
    std::array<std::uint32_t, kAtOnce> rows{};
    const std::uint64_t end = std::min(n, (block + 1) * kBlock);
    for (std::uint64_t first = block * kBlock; first < end; first += kAtOnce) {
      const auto count = static_cast<std::size_t>(std::min<std::uint64_t>(kAtOnce, end - first));
      for (std::size_t i = 0; i < count; ++i) {
        const std::uint32_t row = pairing.source_of[first + i];
        rows[i] = row == kUnpaired ? 0 : row;
      }
      if (source.size() != 0) source.gather(std::span(rows).first(count), std::span(wanted).first(count));
      (void)asset.read(first, std::span(stored).first(count));  // the file is valid
      if (is_rgs) (void)asset.read(first, std::span(logarithms).first(count));
      for (std::size_t i = 0; i < count; ++i) {
        if (pairing.source_of[first + i] == kUnpaired) continue;
        if ((first + i) / chunk_size != chunk) {
          chunk = (first + i) / chunk_size;
          comparison.set_steps(asset.chunk_steps(chunk).value());
        }
        const std::uint32_t defects = find_defects(wanted[i], source.sh_degree());
        if (defects != 0 && !repair(wanted[i], defects)) continue;
        comparison.add(wanted[i], stored[i], is_rgs ? &logarithms[i] : nullptr, first + i, rows[i], sums[block], seen);
      }
    }
    progress.advance(end - block * kBlock);
  });
  Seen seen;
  for (const Seen& part : threads) seen.merge(part);
  BlockSums total{};
  for (const BlockSums& part : sums) {
    for (std::size_t i = 0; i < kSeries; ++i) {
      total[i].errors += part[i].errors;
      total[i].squares += part[i].squares;
    }
  }
  const int degree = std::max(source.sh_degree(), static_cast<int>(asset.header().sh_degree));
  AttributeReport report = summarise(seen, total, degree, asset.header().sh_degree);
  progress.finish();
  return report;
}

}  // namespace rgs::audit
