// simplify.cpp - from a group to its replacement: visible areas, clusters, moments, coverage, fit, error.
// SPDX-License-Identifier: Apache-2.0
#include "simplify.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <span>
#include <utility>
#include <vector>

#include "clusters.hpp"
#include "fit.hpp"
#include "views.hpp"

namespace rgs::lod {
namespace {

constexpr int kViews = 5;            // directions that measure visible areas
constexpr int kMostPixels = 512;     // sides of their pictures
constexpr float kPieceLength = 100;  // pixels: pictures of pieces fit into the cache
constexpr float kCoarseness = 2;     // pixels per Gaussian: see footprint_of()
constexpr float kLarge = 2.5F;       // pixels; a Gaussian with a longer standard deviation stays alone
constexpr float kMostKept = 0.6F;    // share of the result that may stay alone
constexpr int kCoverageRounds = 3;
constexpr float kMostOpacity = 0.98F, kLeastOpacity = 1e-4F;
constexpr float kMostOfFrame = 250;  // longest side of a group in fit_colors(), pixels
constexpr int kFootprints = 3;       // at which the error is measured, each twice the one before
constexpr int kClasses = 12;         // of size, each four times the one before

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

std::vector<std::uint32_t> all_of(const Gaussians& gaussians) {
  std::vector<std::uint32_t> out(gaussians.size());
  std::iota(out.begin(), out.end(), 0U);
  return out;
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

bool is_cut(const Dot& dot, const Frame& frame) {
  return dot.x0 == 0 || dot.y0 == 0 || dot.x1 == frame.width || dot.y1 == frame.height;
}

// Visible area of each Gaussian within the group, averaged over directions, world units squared. Pictures are as fine
// as the Gaussians are small; large ones, which do not fit on them, count as half hidden.
std::vector<float> visible_areas(const Gaussians& group) {
  std::vector<float> unhidden(group.size()), out(group.size()), sums;
  double total = 0;
  for (std::size_t i = 0; i < group.size(); ++i) {
    unhidden[i] = group.of(kOpacity)[i] * mean_cross_section(covariance(group, i));
    total += static_cast<double>(unhidden[i]);
  }
  const float pixel = 0.7F * static_cast<float>(std::sqrt(total / static_cast<double>(group.size())));
  if (!(pixel > 0) || !std::isfinite(pixel)) return out;
  Projection projection;
  Picture picture;
  for (const auto& piece : cut_by_place(group, all_of(group), 0.5F * static_cast<float>(kMostPixels) * pixel)) {
    const Gaussians part = subset(group, piece);
    sums.assign(part.padded(), 0.F);
    for (int view = 0; view < kViews; ++view) {
      const Frame frame = frame_around(part, direction(view, kViews), pixel, kMostPixels);
      project(part, frame, kDrawn, projection, Colors::unwanted);
      picture.resize(frame.width, frame.height);
      contributions(projection.dots, picture, sums);
    }
    for (std::size_t i = 0; i < piece.size(); ++i) out[piece[i]] = sums[i] * pixel * pixel / static_cast<float>(kViews);
  }
  for (std::size_t i = 0; i < group.size(); ++i) {
    if (longest(group, i) > 20 * pixel) out[i] = std::max(out[i], 0.5F * unhidden[i]);
  }
  return out;
}

// Footprint at which `n` Gaussians suffice: kCoarseness times the pixel at which they count n, each Gaussian counting its
// visible share of a pixel, at most 1.
float footprint_of(std::span<const float> visible, std::size_t n) {
  double below = 0, above = 0;
  for (const float area : visible) above += static_cast<double>(area);
  above = std::sqrt(above);
  for (int k = 0; k < 40; ++k) {
    const double middle = (below + above) / 2;
    double count = 0;
    for (const float area : visible) count += std::min(1.0, static_cast<double>(area) / (middle * middle));
    (count > static_cast<double>(n) ? below : above) = middle;
  }
  return std::max(kCoarseness * static_cast<float>(above), 1e-18F);
}

// Gaussians that stay alone because they would be told apart, up to kMostKept of the result.
std::vector<char> kept_alone(const Gaussians& group, std::span<const float> visible, std::size_t n, float pixel) {
  std::vector<std::uint32_t> large;
  for (std::uint32_t i = 0; i < group.size(); ++i) {
    if (longest(group, i) > kLarge * pixel) large.push_back(i);
  }
  std::sort(large.begin(), large.end(), [&](std::uint32_t a, std::uint32_t b) {
    return visible[a] != visible[b] ? visible[a] > visible[b] : a < b;
  });
  large.resize(std::min(large.size(), static_cast<std::size_t>(kMostKept * static_cast<float>(n))));
  std::vector<char> out(group.size(), 0);
  for (const std::uint32_t i : large) out[i] = 1;
  return out;
}

// Sets each cluster's moments as a Gaussian, with harmonics weighted by visible area; single members stay as they are.
void set_all(Gaussians& out, const Gaussians& group, const Clusters& clusters, std::span<const float> visible,
             float pixel) {
  const float least = 1e-6F * pixel * pixel;
  std::vector<float> share(group.size());
  std::vector<std::uint32_t> to(group.size());
  for (std::uint32_t i = 0; i < out.size(); ++i) {
    const Cluster& cluster = clusters.all[i];
    float total = 0;
    clusters.each_member(cluster, [&](std::uint32_t member) { total += visible[member] + least; });
    clusters.each_member(cluster, [&](std::uint32_t member) {
      to[member] = i;
      share[member] = clusters.is_single(cluster) ? 1 : (visible[member] + least) / total;
    });
    if (clusters.is_single(cluster)) {
      for (int v = 0; v < kSh; ++v) out.of(v)[i] = group.of(v)[cluster.first];
      continue;
    }
    float scale[3], rotation[4];
    principal_axes(cluster.covariance, 1e-3F * pixel, scale, rotation);
    for (int k = 0; k < 3; ++k) {
      out.of(kMean + k)[i] = cluster.mean[k];
      out.of(kScale + k)[i] = scale[k];
    }
    for (int k = 0; k < 4; ++k) out.of(kRotation + k)[i] = rotation[k];
    const float section = std::max(mean_cross_section(cluster.covariance), 1e-30F);
    out.of(kOpacity)[i] = std::clamp(cluster.weight / section, kLeastOpacity, kMostOpacity);
  }
  // Array by array: a Gaussian's harmonics are far apart in memory.
  for (int v = kSh; v < group.n_values(); ++v) {
    const float* const from = group.of(v);
    float* const sums = out.of(v);
    for (std::size_t i = 0; i < group.size(); ++i) sums[to[i]] += share[i] * from[i];
  }
}

// Adjusts opacities until each Gaussian's visible area is that of what it replaces; grows it where opacity does not
// suffice. `wanted`: world units squared; below 0 to leave a Gaussian as it is.
void restore_coverage(Gaussians& gaussians, std::span<const float> wanted, float pixel) {
  Projection projection;
  Picture picture;
  std::vector<float> seen;
  std::vector<char> incomplete(gaussians.size(), 0);
  const float fine = pixel;
  for (int round = 0; round < kCoverageRounds; ++round) {
    seen.assign(gaussians.padded(), 0.F);
    for (int view = 0; view < kViews; ++view) {
      const Frame frame = frame_around(gaussians, direction(view, kViews), fine, kMostPixels);
      project(gaussians, frame, kDrawn, projection, Colors::unwanted);
      picture.resize(frame.width, frame.height);
      contributions(projection.dots, picture, seen);
      for (const Dot& dot : projection.dots) {
        if (is_cut(dot, frame)) incomplete[dot.index] = 1;
      }
    }
    for (std::size_t i = 0; i < gaussians.size(); ++i) {
      const float area = seen[i] * fine * fine / static_cast<float>(kViews);
      if (wanted[i] < 0 || incomplete[i] != 0 || area < 0.02F * wanted[i]) continue;
      float& opacity = gaussians.of(kOpacity)[i];
      const float better = opacity * std::clamp(wanted[i] / std::max(area, 1e-5F * pixel * pixel), 0.5F, 2.F);
      if (better > kMostOpacity) {
        const float growth = std::min(std::sqrt(better / kMostOpacity), 1.15F);
        for (int k = 0; k < 3; ++k) gaussians.of(kScale + k)[i] *= growth;
      }
      opacity = std::clamp(better, kLeastOpacity, kMostOpacity);
    }
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

// Smallest footprint at which the result is good enough for a group that covers `covered`; interpolates linearly in
// logarithms.
float error_of(const Measured& m, std::span<const double> covered, float pixel) {
  if (std::all_of(m.of_result, m.of_result + kFootprints, [](double x) { return x <= 0; })) return 0;
  double ratio[kFootprints];
  for (int k = 0; k < kFootprints; ++k) {
    const double allowed = allowed_squared(m.of_group[k], covered[static_cast<std::size_t>(k)]);
    ratio[k] = m.of_result[k] <= 0 ? 0 : m.of_result[k] / std::max(allowed, 1e-300);
  }
  int k = kFootprints;  // good from this one on
  while (k > 0 && ratio[k - 1] <= 1) --k;
  if (k == 0) return pixel * static_cast<float>(std::sqrt(std::max(ratio[0], 0.0625)));
  if (k == kFootprints) {
    return pixel * static_cast<float>(1 << (kFootprints - 1)) * static_cast<float>(std::sqrt(ratio[kFootprints - 1]));
  }
  const double from = std::log(ratio[k - 1]), to = std::log(std::max(ratio[k], 1e-6));
  return pixel * static_cast<float>(std::exp2(k - 1 + from / (from - to)));
}

}  // namespace

double allowed_squared(double of_group, double covered) {
  const double inexact = kInexactSquared * covered;
  const double share = of_group <= inexact ? 1 : std::pow(inexact / of_group, kGrowthOfInexact);
  return std::max(kAllowed * share * of_group, kAllowedSquared * covered);
}

Simplified simplify(const Gaussians& group, std::size_t n, const FitOptions& options) {
  const std::vector<float> visible = visible_areas(group);
  const float pixel = footprint_of(visible, n);
  const Clusters clusters = merge_neighbours(group, visible, kept_alone(group, visible, n, pixel), n, pixel);
  Simplified out;
  out.gaussians.resize(clusters.all.size(), group.sh_degree());
  set_all(out.gaussians, group, clusters, visible, pixel);

  // Pieces of Gaussians of similar size, drawn in pixels that suit them.
  std::vector<std::vector<std::uint32_t>> classes(kClasses);
  for (std::uint32_t i = 0; i < out.gaussians.size(); ++i) {
    const float size = longest(out.gaussians, i) / (kLarge * pixel);
    const int of_size = size > 1 ? 1 + static_cast<int>(std::log2(std::min(size, 1e9F)) / 2) : 0;
    classes[static_cast<std::size_t>(std::min(of_size, kClasses - 1))].push_back(i);
  }
  struct Piece {
    std::size_t of_class;
    float pixel;
    std::vector<std::uint32_t> items, members;  // indices into the result and the group
  };
  std::vector<Piece> pieces;
  std::vector<float> wanted;
  for (std::size_t c = 0; c < classes.size(); ++c) {
    const float p = pixel * static_cast<float>(std::int64_t{1} << (2 * std::max<std::size_t>(c, 1) - 2));
    for (auto& items : cut_by_place(out.gaussians, classes[c], kPieceLength * p)) {
      Piece piece{c, p, std::move(items), {}};
      wanted.clear();
      for (const std::uint32_t i : piece.items) {
        const Cluster& cluster = clusters.all[i];
        wanted.push_back(clusters.is_single(cluster) ? -1 : cluster.weight);
        clusters.each_member(cluster, [&](std::uint32_t member) { piece.members.push_back(member); });
      }
      const bool merged = piece.members.size() > piece.items.size();
      if (merged || options.n_color_steps > 0) pieces.push_back(piece);
      if (!merged) continue;
      Gaussians part = subset(out.gaussians, piece.items);
      restore_coverage(part, wanted, p);
      if (options.n_steps > 0 && c == 0) {
        Gaussians fitted = part;
        fit(subset(group, piece.members), fitted, p, options);
        if (is_finite(fitted)) part = std::move(fitted);
      }
      for (std::size_t i = 0; i < piece.items.size(); ++i) out.gaussians.copy(piece.items[i], part, i);
    }
  }
  // Fit all together: pieces and classes hide each other, and losses of those not fitted show. Not if the group needs
  // much larger pixels to fit on a picture, which would lose quality.
  const float whole = extent(group) / kMostOfFrame;
  if (options.n_color_steps > 0 && whole < 2 * pixel) {
    Gaussians fitted = out.gaussians;
    fit_colors(group, fitted, std::max(pixel, whole), options);
    if (is_finite(fitted)) out.gaussians = std::move(fitted);
  }
  std::vector<Measured> measured(kClasses);
  for (const Piece& piece : pieces) {
    measure(subset(group, piece.members), subset(out.gaussians, piece.items), pixel, piece.pixel, options,
            measured[piece.of_class]);
  }
  // By class: small errors of small Gaussians must not excuse those of large ones.
  double covered[kFootprints] = {};
  for (const Measured& of_class : measured) {
    for (int k = 0; k < kFootprints; ++k) covered[k] += of_class.covered[k];
  }
  for (const Measured& of_class : measured) out.error = std::max(out.error, error_of(of_class, covered, pixel));
  return out;
}

}  // namespace rgs::lod
