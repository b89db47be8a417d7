// check_error.cpp - the builder's measure, for a page and children that were read from a file.
// SPDX-License-Identifier: Apache-2.0
#include "check_error.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "clusters.hpp"
#include "gaussians.hpp"
#include "measure.hpp"

namespace rgs::lod {
namespace {

// Of the group's own squared difference and of what it covers: what rounding makes of equal Gaussians.
constexpr double kSame = 1e-3, kSameSquared = 1e-6;
constexpr float kFirst = 2;  // least footprint over the stated error
static_assert(kFirst * (1 << (kFootprints - 1)) >= kErrorTolerance);
constexpr float kMostOfFrame = 250;   // longest side of the group, pixels: measure() crops longer ones
constexpr std::size_t kOutside = 20;  // one mean of so many is outside the pictures, at each end of each axis

Gaussians near(const SplatView& splats, const float centre[3]) {
  Gaussians all = activate(splats, 0, splats.n, centre);
  std::vector<std::uint32_t> items;
  for (std::uint32_t i = 0; i < splats.n; ++i) {
    if (!is_far(splats, i, centre)) items.push_back(i);
  }
  return items.size() == splats.n ? std::move(all) : subset(all, items);
}

// Without the outermost means: pictures that held floaters would show the rest in too few pixels.
Gaussians without_outermost(const Gaussians& group) {
  const std::size_t n = group.size(), cut = n / kOutside;
  std::vector<bool> inside(n, true);
  std::vector<float> sorted(n);
  for (int k = 0; k < 3; ++k) {
    const float* const x = group.of(kMean + k);
    sorted.assign(x, x + n);
    std::ranges::sort(sorted);
    for (std::size_t i = 0; i < n; ++i) inside[i] = inside[i] && sorted[cut] <= x[i] && x[i] <= sorted[n - 1 - cut];
  }
  std::vector<std::uint32_t> items;
  for (std::uint32_t i = 0; i < n; ++i) {
    if (inside[i]) items.push_back(i);
  }
  return subset(group, items);
}

bool looks_same(const Measured& measured) {
  for (int k = 0; k < kFootprints; ++k) {
    const double apart = std::abs(measured.of_result[k] - measured.of_group[k]);
    if (!(apart <= kSame * measured.of_group[k] + kSameSquared * measured.covered[k])) return false;
  }
  return true;
}

}  // namespace

float error_against(const SplatView& children, const SplatView& page, float stated, bool may_look_same) {
  float centre[3];
  find_middle(children, 0, children.n, centre);
  const Gaussians group = near(children, centre), result = near(page, centre);
  if (group.size() <= 1) return 0;
  const Gaussians framed = without_outermost(group);
  const std::size_t n = std::min(result.size(), group.size() / 2);  // as many as there are suffice at any footprint
  // The builder's footprints, or coarser ones that reach what is refuted.
  const float least = footprint_of(areas(group), n);
  float pixel = std::max(least, std::min(kFirst * stated, kFarAway));
  const auto measured_at = [&](float footprint) {
    Measured measured;
    measure(framed, group, result, footprint, std::max(footprint, extent(framed) / kMostOfFrame), measured);
    return measured;
  };
  Measured measured = measured_at(pixel);
  if (measured.covered[0] <= 0 && pixel > least) measured = measured_at(pixel = least);  // so far away nothing shows
  if (may_look_same && looks_same(measured)) return 0;
  // A page that is good at one footprint counts as good at coarser ones. There the whole may miss by a little what its
  // classes of size, judged by themselves, do not.
  for (int k = 1; k < kFootprints; ++k) {
    const auto allowed = [&](int l) { return allowed_squared(measured.of_group[l], measured.covered[l]); };
    if (measured.of_result[k - 1] <= allowed(k - 1)) {
      measured.of_result[k] = std::min(measured.of_result[k], allowed(k));
    }
  }
  const float error = error_of(measured, pixel);
  return first_good(measured) == 0 && pixel <= kFirst * stated ? std::min(error, stated) : error;
}

}  // namespace rgs::lod
