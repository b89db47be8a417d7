// simplify.cpp - from a group to its replacement: clusters, moments, colours.
// SPDX-License-Identifier: Apache-2.0
#include "simplify.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>
#include <utility>
#include <vector>

#include "clusters.hpp"
#include "fit.hpp"
#include "fit_device.hpp"
#include "measure.hpp"
#include "views.hpp"

namespace rgs::lod {
namespace {

constexpr float kPieceLength = 100;  // pixels: pictures of pieces fit into the cache
constexpr float kLarge = 2.5F;       // pixels: longer standard deviations are measured in larger pixels
constexpr float kMostOpacity = 0.99F, kLeastOpacity = 1e-4F;
constexpr float kMostGrowth = 1.5F;  // of a merged Gaussian, see set_all()
constexpr float kMostOfFrame = 250;  // longest side of a group in fit_colors(), pixels
constexpr int kClasses = 12;         // of size, each four times the one before
constexpr double kOfClass = 10;  // a class that covers less than a tenth of all is judged by this times what it covers

float longest(const Gaussians& gaussians, std::size_t i) {
  return std::max({gaussians.of(kScale)[i], gaussians.of(kScale + 1)[i], gaussians.of(kScale + 2)[i]});
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

}  // namespace

Simplified simplify(const Gaussians& group, std::size_t n, Quality quality, FitDevice* device) {
  const std::vector<float> area = areas(group);
  const float pixel = footprint_of(area, n);
  const Clusters clusters = merge_neighbours(group, area, n, pixel);
  Simplified out;
  out.gaussians.resize(clusters.all.size(), group.sh_degree());
  set_all(out.gaussians, group, clusters, area, pixel);
  // Not if the group needs much larger pixels to fit on a picture, which would lose quality.
  const float whole = extent(group) / kMostOfFrame;
  if (quality == Quality::best && whole < 2 * pixel) {
    Gaussians fitted = out.gaussians;
    const float of_fit = std::max(pixel, whole);
    device != nullptr ? device->fit_colors(group, fitted, of_fit) : fit_colors(group, fitted, of_fit);
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
      if (members.size() == items.size() && quality == Quality::fast) continue;
      const Gaussians piece = subset(group, members);
      measure(piece, piece, subset(out.gaussians, items), pixel, p, measured[c]);
    }
  }
  // By class: small errors of small Gaussians must not excuse those of large ones, unless these are very few.
  double covered[kFootprints] = {};
  for (const Measured& of_class : measured) {
    for (int k = 0; k < kFootprints; ++k) covered[k] += of_class.covered[k];
  }
  for (Measured& of_class : measured) {
    for (int k = 0; k < kFootprints; ++k) of_class.covered[k] = std::min(covered[k], kOfClass * of_class.covered[k]);
    const float error = error_of(of_class, pixel);
    out.error = std::max(out.error, std::isnan(error) ? std::numeric_limits<float>::infinity() : error);
  }
  return out;
}

}  // namespace rgs::lod
