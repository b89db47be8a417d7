// subject_box.cpp - robust bounds of a scene, weighted by opacity.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/subject_box.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>

#include "rgs/decode.hpp"

namespace rgs {
namespace {

// Of an axis of the box at hand, which gets smaller with each turn.
constexpr std::size_t kBins = 1024;
// Tukey's (Exploratory Data Analysis, 1977). Of a normal distribution 0.7 % lie outside.
constexpr double kFences = 1.5;
// A floor has no thickness, and many means of a gridded scene are equal: its fences are those of a box at least this
// share as thick as the longest side.
constexpr double kThinnest = 0.25;
// Fewer have no quartiles worth the name.
constexpr std::uint64_t kFewest = 32;
// What holds less of the weight is not what the scene is about.
constexpr double kLeastShare = 1.0 / 3;
constexpr double kTail = 0.02;
// Fewer cores do not tell where Gaussians are dense: the sky stretches a core more than the subject does.
constexpr std::size_t kFewestPages = 6;
constexpr double kOpaque = 65535;

using Mean = std::array<float, 3>;

/// In FP64, where the middle of two floats and the length of any side are finite.
struct Sides {
  std::array<double, 3> low, high;
  bool operator==(const Sides&) const = default;
};

/// How opacity is distributed along each axis of a box. In whole numbers, so that the order of adding does not matter.
class Histogram {
 public:
  template <class EachMean>
  Histogram(const EachMean& each_mean, const Sides& box) : box_(box), bins_(3 * kBins) {
    std::array<double, 3> per_unit{};
    for (std::size_t k = 0; k < 3; ++k) {
      const double side = box.high[k] - box.low[k];
      per_unit[k] = side > 0 ? kBins / side : 0;
    }
    each_mean([&](const Mean& mean, float opacity) {
      std::array<std::size_t, 3> bin{};
      for (std::size_t k = 0; k < 3; ++k) {
        const auto x = static_cast<double>(mean[k]);
        if (!(x >= box.low[k] && x <= box.high[k])) return;  // also if NaN
        bin[k] = std::min(static_cast<std::size_t>((x - box.low[k]) * per_unit[k]), kBins - 1);
      }
      ++count_;
      // At least 1: a scene of invisible Gaussians has a place, too.
      const double opaque = opacity > 0 ? std::min(static_cast<double>(opacity), 1.) : 0;
      const std::uint64_t weight = 1 + static_cast<std::uint64_t>(opaque * kOpaque);
      weight_ += weight;
      for (std::size_t k = 0; k < 3; ++k) bins_[k * kBins + bin[k]] += weight;
    });
  }

  std::uint64_t count() const { return count_; }
  std::uint64_t weight() const { return weight_; }
  /// The box without this share of the weight at either end of each axis; within a bin, weight is evenly spread.
  Sides without(double share) const {
    Sides out = box_;
    const auto outside = static_cast<std::uint64_t>(share * static_cast<double>(weight_));
    for (std::size_t k = 0; k < 3; ++k) {
      // Bins from an end to where the weight is reached. Nothing is cut off an end whose first bin has it.
      const auto cut = [outside](const std::uint64_t* bin, std::ptrdiff_t next) {
        int n = 0;
        std::uint64_t before = 0;
        for (; before + *bin <= outside; bin += next, ++n) before += *bin;
        return n == 0 ? 0 : n + static_cast<double>(outside - before) / static_cast<double>(*bin);
      };
      const std::uint64_t* bins = &bins_[k * kBins];
      const double width = (box_.high[k] - box_.low[k]) / kBins;
      out.low[k] = box_.low[k] + cut(bins, 1) * width;
      out.high[k] = box_.high[k] - cut(bins + kBins - 1, -1) * width;
    }
    return out;
  }

 private:
  Sides box_;
  std::uint64_t count_ = 0, weight_ = 0;
  std::vector<std::uint64_t> bins_;  // [3, kBins]
};

/// What of the histogram's box lies within the fences of its quartiles.
Sides fenced(const Histogram& histogram, const Sides& box) {
  const Sides quartiles = histogram.without(0.25);
  double longest = 0;
  for (std::size_t k = 0; k < 3; ++k) longest = std::max(longest, quartiles.high[k] - quartiles.low[k]);
  Sides out;
  for (std::size_t k = 0; k < 3; ++k) {
    const double margin = kFences * std::max(quartiles.high[k] - quartiles.low[k], kThinnest * longest);
    out.low[k] = std::max(box.low[k], quartiles.low[k] - margin);
    out.high[k] = std::min(box.high[k], quartiles.high[k] + margin);
  }
  return out;
}

/// `each_mean` calls what it is given with every mean and its opacity.
template <class EachMean>
Box box_of(const EachMean& each_mean) {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  Sides box{{kInfinity, kInfinity, kInfinity}, {-kInfinity, -kInfinity, -kInfinity}};
  each_mean([&](const Mean& mean, float) {
    if (!std::isfinite(mean[0]) || !std::isfinite(mean[1]) || !std::isfinite(mean[2])) return;
    for (std::size_t k = 0; k < 3; ++k) {
      box.low[k] = std::min(box.low[k], static_cast<double>(mean[k]));
      box.high[k] = std::max(box.high[k], static_cast<double>(mean[k]));
    }
  });
  if (box.low[0] > box.high[0]) return {{-0.5F, -0.5F, -0.5F}, {0.5F, 0.5F, 0.5F}};
  Histogram histogram(each_mean, box);
  const double least = kLeastShare * static_cast<double>(histogram.weight());
  for (;;) {
    const Sides inner = fenced(histogram, box);
    if (inner == box) break;
    Histogram fewer(each_mean, inner);
    if (fewer.count() < kFewest || static_cast<double>(fewer.weight()) < least) break;
    box = inner;
    histogram = std::move(fewer);
  }
  const Sides kept = histogram.without(kTail);
  Box out;
  for (std::size_t k = 0; k < 3; ++k) {
    out.min[k] = static_cast<float>(kept.low[k]);
    out.max[k] = static_cast<float>(kept.high[k]);
  }
  return out;
}

constexpr float kMostGaussians = 65536.F * lod::kMaxChildren;  // of a page, and of its children

/// Means that stand for Gaussians evenly spread over a box.
template <class Use>
void spread(const Box& box, float opacity, const Use& use) {
  constexpr int kSide = 4;
  for (int i = 0; i < kSide * kSide * kSide; ++i) {
    Mean mean;
    for (std::size_t k = 0; k < 3; ++k) {
      const int step = k == 0 ? i % kSide : k == 1 ? i / kSide % kSide : i / kSide / kSide;
      const float share = (static_cast<float>(step) + 0.5F) / kSide;
      mean[k] = box.min[k] * (1 - share) + box.max[k] * share;
    }
    use(mean, opacity);
  }
}

}  // namespace

Box subject_box(std::span<const float> mean, std::span<const float> opacity) {
  return box_of([&](const auto& use) {
    for (std::size_t i = 0; i < opacity.size(); ++i)
      use(Mean{mean[3 * i], mean[3 * i + 1], mean[3 * i + 2]}, opacity[i]);
  });
}

Box subject_box(const FileView& file) {
  return box_of([&](const auto& use) {
    for (std::uint64_t i = 0; i < file.header().n_chunks; ++i) {
      if (const auto chunk = file.chunk(i)) spread(chunk->means, chunk->max_opacity, use);
    }
  });
}

Box subject_box(std::span<const lod::Page> pages) {
  if (!pages.empty() && pages.size() < kFewestPages) return pages.front().core;
  return box_of([&](const auto& use) {
    for (const lod::Page& page : pages) {
      if (page.n_children > 0 && page.first_child < pages.size()) continue;
      // Leaves are about as full as their parents.
      const float n = static_cast<float>(page.count) * static_cast<float>(std::max(page.n_children, 1U));
      spread(page.core, n / kMostGaussians, use);
    }
  });
}

}  // namespace rgs
