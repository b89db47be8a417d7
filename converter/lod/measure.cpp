// measure.cpp - compares pictures of a group and of its replacement at several footprints.
// SPDX-License-Identifier: Apache-2.0
#include "measure.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "fit.hpp"
#include "pictures.hpp"
#include "views.hpp"

namespace rgs::lod {
namespace {

constexpr int kMostPixels = 512;   // sides of pictures
constexpr int kDirections = 3;     // other than those of the fit
constexpr int kSupersampling = 2;  // of the truth: with it the error is within 4% of that with four
constexpr float kCoarseness = 2;   // pixels per Gaussian: see footprint_of()

// Of the squared difference to the one allowed; at most 1 is good enough.
double ratio(const Measured& measured, int k) {
  if (measured.of_result[k] <= 0) return 0;
  return measured.of_result[k] / std::max(allowed_squared(measured.of_group[k], measured.covered[k]), 1e-300);
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

// One fine picture a direction is the truth for all footprints.
void measure(const Gaussians& framed, const Gaussians& group, const Gaussians& result, float pixel, float least_pixel,
             Measured& out) {
  constexpr int kCoarsest = 1 << (kFootprints - 1);
  const float base = std::max(pixel, least_pixel);
  Projection of_group, of_result;
  Picture fine, truth, coarser, drawn;
  Measured piece;
  for (int view = 0; view < kDirections; ++view) {
    const Frame coarse =
        frame_around(framed, direction(view, kDirections), base * kCoarsest, kMostPixels / 2 / kCoarsest);
    const Frame finest = finer(coarse, kCoarsest * kSupersampling);
    project(group, finest, kDrawn, of_group);
    fine.resize(finest.width, finest.height);
    draw(of_group.dots, fine);
    project(result, finest, kDrawn, of_result);
    for (int k = 0; k < kFootprints; ++k) {
      const Frame frame = finer(coarse, kCoarsest >> k);
      box_filter(k == 0 ? fine : truth, k == 0 ? kSupersampling : 2, coarser);
      std::swap(truth, coarser);
      const auto compare = [&](const Gaussians& gaussians, Projection& projection) {
        project_again(gaussians, frame, kDrawn, projection);
        drawn.resize(frame.width, frame.height);
        draw(projection.dots, drawn);
        return difference(truth, drawn);
      };
      const double area = static_cast<double>(frame.pixel) * static_cast<double>(frame.pixel) / kDirections;
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

int first_good(const Measured& measured) {
  int k = kFootprints;
  while (k > 0 && ratio(measured, k - 1) <= 1) --k;
  return k;
}

float error_of(const Measured& measured, float pixel) {
  if (std::all_of(measured.of_result, measured.of_result + kFootprints, [](double x) { return x <= 0; })) return 0;
  const int k = first_good(measured);
  if (k == 0) return pixel * static_cast<float>(std::sqrt(std::max(ratio(measured, 0), 0.25)));
  if (k == kFootprints) {
    return pixel * static_cast<float>(1 << (kFootprints - 1)) *
           static_cast<float>(std::sqrt(ratio(measured, kFootprints - 1)));
  }
  const double from = std::log(ratio(measured, k - 1)), to = std::log(std::max(ratio(measured, k), 1e-6));
  return pixel * static_cast<float>(std::exp2(k - 1 + from / (from - to)));
}

}  // namespace rgs::lod
