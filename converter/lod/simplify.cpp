// simplify.cpp - from a group to its replacement: clusters, moments, colours, error.
// SPDX-License-Identifier: Apache-2.0
#include "simplify.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "clusters.hpp"
#include "fit.hpp"
#include "views.hpp"

namespace rgs::lod {
namespace {

constexpr int kMostPixels = 512;     // sides of pictures
constexpr float kPieceLength = 100;  // pixels: pictures of pieces fit into the cache
constexpr float kCoarseness = 2;     // see footprint_of()
constexpr float kLarge = 2.5F;       // pixels: longer standard deviations are measured in larger pixels
constexpr float kMostOpacity = 0.99F, kLeastOpacity = 1e-4F;
constexpr float kMostGrowth = 1.5F;  // of a merged Gaussian, see set_all()
constexpr float kMostOfFrame = 250;  // longest side of a group in fit_colors(), pixels
constexpr int kFootprints = 3;       // at which the error is measured, each twice the one before
constexpr int kClasses = 12;         // of size, each four times the one before
constexpr double kOfClass = 10;  // a class that covers less than a tenth of all is judged by this times what it covers

float longest(const Gaussians& gaussians, std::size_t i) {
  return std::max({gaussians.of(kScale)[i], gaussians.of(kScale + 1)[i], gaussians.of(kScale + 2)[i]});
}

float extent(const Gaussians& gaussians) {
  float most = 0;
  for (int k = 0; k < 3; ++k) {
    const float* const x = gaussians.of(kMean + k);
    const auto [low, high] = std::minmax_element(x, x + gaussians.size());
    most = std::max(most, *high - *low);
  }
  return most;
}

Gaussians subset(const Gaussians& gaussians, std::span<const std::uint32_t> items) {
  Gaussians out(items.size(), gaussians.sh_degree());
  for (int v = 0; v < gaussians.n_values(); ++v) {
    const float* const from = gaussians.of(v);
    float* const to = out.of(v);
    for (std::size_t i = 0; i < items.size(); ++i) to[i] = from[items[i]];
  }
  return out;
}

// Sets each cluster's moments as a Gaussian, with harmonics weighted by area; single members stay as they are.
void set_all(Gaussians& out, const Gaussians& group, const Clusters& clusters, std::span<const float> area,
             float pixel) {
  std::vector<float> share(group.size());
  std::vector<std::uint32_t> to(group.size());
  for (std::uint32_t i = 0; i < out.size(); ++i) {
    const Cluster& cluster = clusters.all[i];
    if (clusters.is_single(cluster)) {
      for (int v = 0; v < kSh; ++v) out.of(v)[i] = group.of(v)[cluster.first];
      to[cluster.first] = i, share[cluster.first] = 1;
      continue;
    }
    float total = 0;
    clusters.each_member(cluster, [&](std::uint32_t member) {
      to[member] = i;
      share[member] = area[member] + least_area(pixel);
      total += share[member];
    });
    clusters.each_member(cluster, [&](std::uint32_t member) { share[member] /= total; });
    float scale[3], rotation[4];
    principal_axes(cluster.covariance, 1e-3F * pixel, scale, rotation);
    // Of the logarithm of what opacity cannot hold, size holds seven tenths: all of it would blur edges, none would
    // leave gaps.
    const float growth = std::min(std::pow(std::max(cluster.opacity / kMostOpacity, 1.F), 0.35F), kMostGrowth);
    for (int k = 0; k < 3; ++k) {
      out.of(kMean + k)[i] = cluster.mean[k];
      out.of(kScale + k)[i] = growth * scale[k];
    }
    for (int k = 0; k < 4; ++k) out.of(kRotation + k)[i] = rotation[k];
    out.of(kOpacity)[i] = std::clamp(cluster.opacity, kLeastOpacity, kMostOpacity);
  }
  // Array by array: a Gaussian's harmonics are far apart in memory.
  for (int v = kSh; v < group.n_values(); ++v) {
    const float* const from = group.of(v);
    float* const sums = out.of(v);
    for (std::size_t i = 0; i < group.size(); ++i) sums[to[i]] += share[i] * from[i];
  }
}

// False where colours are so large that their squared differences overflow FP32.
bool is_finite(const Gaussians& gaussians) {
  for (int v = 0; v < gaussians.n_values(); ++v) {
    const float* const values = gaussians.of(v);
    if (!std::all_of(values, values + gaussians.size(), [](float x) { return std::isfinite(x); })) return false;
  }
  return true;
}

// Squared differences from the supersampled pictures at footprints pixel * 2^k, world units squared.
struct Measured {
  double of_group[kFootprints] = {}, of_result[kFootprints] = {}, covered[kFootprints] = {};
};

// Adds a piece's share; `least_pixel` is the finest pixel that suits it. Directions differ from those of the fit. One
// fine picture a direction is the truth for all footprints.
void measure(const Gaussians& group, const Gaussians& result, float pixel, float least_pixel, const FitOptions& options,
             Measured& out) {
  constexpr int kCoarsest = 1 << (kFootprints - 1);
  const float base = std::max(pixel, least_pixel);
  Projection of_group, of_result;
  Picture fine, truth, coarser, drawn;
  Measured piece;
  for (int view = 0; view < options.n_error_directions; ++view) {
    const Frame coarse =
        frame_around(group, direction(view, options.n_error_directions), base * kCoarsest, kMostPixels / 2 / kCoarsest);
    const Frame finest = finer(coarse, kCoarsest * options.error_supersampling);
    project(group, finest, kDrawn, of_group);
    fine.resize(finest.width, finest.height);
    draw(of_group.dots, fine);
    project(result, finest, kDrawn, of_result);
    for (int k = 0; k < kFootprints; ++k) {
      const Frame frame = finer(coarse, kCoarsest >> k);
      box_filter(k == 0 ? fine : truth, k == 0 ? options.error_supersampling : 2, coarser);
      std::swap(truth, coarser);
      const auto compare = [&](const Gaussians& gaussians, Projection& projection) {
        project_again(gaussians, frame, kDrawn, projection);
        drawn.resize(frame.width, frame.height);
        draw(projection.dots, drawn);
        return difference(truth, drawn);
      };
      const double area =
          static_cast<double>(frame.pixel) * static_cast<double>(frame.pixel) / options.n_error_directions;
      const Difference by_group = compare(group, of_group);
      piece.of_group[k] += area * by_group.squared;
      piece.of_result[k] += area * compare(result, of_result).squared;
      piece.covered[k] += area * by_group.covered;
    }
  }
  // Footprints below the finest use its values.
  int behind = 0;
  while (behind < kFootprints - 1 && pixel * static_cast<float>(1 << (behind + 1)) <= base) ++behind;
  for (int k = 0; k < kFootprints; ++k) {
    const int from = std::max(k - behind, 0);
    out.of_group[k] += piece.of_group[from];
    out.of_result[k] += piece.of_result[from];
    out.covered[k] += piece.covered[from];
  }
}

// Smallest footprint at which the result is good enough; interpolates linearly in logarithms.
float error_of(const Measured& m, float pixel) {
  if (std::all_of(m.of_result, m.of_result + kFootprints, [](double x) { return x <= 0; })) return 0;
  double ratio[kFootprints];
  for (int k = 0; k < kFootprints; ++k) {
    const double allowed = allowed_squared(m.of_group[k], m.covered[k]);
    ratio[k] = m.of_result[k] <= 0 ? 0 : m.of_result[k] / std::max(allowed, 1e-300);
  }
  int k = kFootprints;  // good from this one on
  while (k > 0 && ratio[k - 1] <= 1) --k;
  if (k == 0) return pixel * static_cast<float>(std::sqrt(std::max(ratio[0], 0.25)));
  if (k == kFootprints) {
    return pixel * static_cast<float>(1 << (kFootprints - 1)) * static_cast<float>(std::sqrt(ratio[kFootprints - 1]));
  }
  const double from = std::log(ratio[k - 1]), to = std::log(std::max(ratio[k], 1e-6));
  return pixel * static_cast<float>(std::exp2(k - 1 + from / (from - to)));
}

}  // namespace

float footprint_of(std::span<const float> area, std::size_t n) {
  double below = 0, above = 0;
  for (const float a : area) above += static_cast<double>(a);
  above = std::sqrt(above);
  for (int k = 0; k < 40; ++k) {
    const double middle = (below + above) / 2;
    double count = 0;
    for (const float a : area) count += std::min(1.0, static_cast<double>(a) / (middle * middle));
    (count > static_cast<double>(n) ? below : above) = middle;
  }
  return std::max(kCoarseness * static_cast<float>(above), 1e-18F);
}

Simplified simplify(const Gaussians& group, std::size_t n, const FitOptions& options) {
  const std::vector<float> area = areas(group);
  const float pixel = footprint_of(area, n);
  const Clusters clusters = merge_neighbours(group, area, n, pixel);
  Simplified out;
  out.gaussians.resize(clusters.all.size(), group.sh_degree());
  set_all(out.gaussians, group, clusters, area, pixel);
  // Not if the group needs much larger pixels to fit on a picture, which would lose quality.
  const float whole = extent(group) / kMostOfFrame;
  if (options.n_color_steps > 0 && whole < 2 * pixel) {
    Gaussians fitted = out.gaussians;
    fit_colors(group, fitted, std::max(pixel, whole), options);
    if (is_finite(fitted)) out.gaussians = std::move(fitted);
  }

  // Pieces of Gaussians of similar size, drawn in pixels that suit them.
  std::vector<std::vector<std::uint32_t>> classes(kClasses);
  for (std::uint32_t i = 0; i < out.gaussians.size(); ++i) {
    const float size = longest(out.gaussians, i) / (kLarge * pixel);
    const int of_size = size > 1 ? 1 + static_cast<int>(std::log2(std::min(size, 1e9F)) / 2) : 0;
    classes[static_cast<std::size_t>(std::min(of_size, kClasses - 1))].push_back(i);
  }
  std::vector<Measured> measured(kClasses);
  std::vector<std::uint32_t> members;
  for (std::size_t c = 0; c < classes.size(); ++c) {
    const float p = pixel * static_cast<float>(std::int64_t{1} << (2 * std::max<std::size_t>(c, 1) - 2));
    for (const auto& items : cut_by_place(out.gaussians, classes[c], kPieceLength * p)) {
      members.clear();
      for (const std::uint32_t i : items) {
        clusters.each_member(clusters.all[i], [&](std::uint32_t member) { members.push_back(member); });
      }
      if (members.size() == items.size() && options.n_color_steps == 0) continue;
      measure(subset(group, members), subset(out.gaussians, items), pixel, p, options, measured[c]);
    }
  }
  // By class: small errors of small Gaussians must not excuse those of large ones, unless these are very few.
  double covered[kFootprints] = {};
  for (const Measured& of_class : measured) {
    for (int k = 0; k < kFootprints; ++k) covered[k] += of_class.covered[k];
  }
  for (Measured& of_class : measured) {
    for (int k = 0; k < kFootprints; ++k) of_class.covered[k] = std::min(covered[k], kOfClass * of_class.covered[k]);
    out.error = std::max(out.error, error_of(of_class, pixel));
  }
  return out;
}

}  // namespace rgs::lod
