// splat_cloud.cpp - accessors of the splat containers.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/splat_cloud.hpp"

#include <algorithm>
#include <cassert>

namespace rgs {

bool SplatView::consistent() const {
  if (sh_degree < 0 || sh_degree > kMaxShDegree) return false;
  const auto coefficients = static_cast<std::uint64_t>(sh_coefficients(sh_degree));
  // Divisions, not products: n may come from a file.
  return opacity_logit.size() == n && mean.size() / 3 == n && mean.size() % 3 == 0 && log_scale.size() / 3 == n &&
         log_scale.size() % 3 == 0 && rotation.size() / 4 == n && rotation.size() % 4 == 0 &&
         sh.size() / (3 * coefficients) == n && sh.size() % (3 * coefficients) == 0 &&
         (mean_rest.empty() || mean_rest.size() == mean.size());
}

Splat SplatView::splat(std::uint64_t i) const {
  assert(i < n);
  Splat s;
  std::copy_n(&mean[3 * i], 3, s.mean);
  std::copy_n(&log_scale[3 * i], 3, s.log_scale);
  std::copy_n(&rotation[4 * i], 4, s.rotation);
  s.opacity_logit = opacity_logit[i];
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(sh_degree));
  std::copy_n(&sh[floats * i], floats, s.sh);
  if (!mean_rest.empty()) std::copy_n(&mean_rest[3 * i], 3, s.mean_rest);
  return s;
}

void SplatCloud::resize(std::uint64_t n, int degree) {
  assert(degree >= 0 && degree <= kMaxShDegree);
  sh_degree = degree;
  mean.resize(3 * n);
  log_scale.resize(3 * n);
  rotation.resize(4 * n);
  opacity_logit.resize(n);
  sh.resize(static_cast<std::uint64_t>(3 * sh_coefficients(degree)) * n);
  mean_rest.clear();
}

void SplatCloud::set(std::uint64_t i, const Splat& s) {
  assert(i < size());
  std::copy_n(s.mean, 3, &mean[3 * i]);
  std::copy_n(s.log_scale, 3, &log_scale[3 * i]);
  std::copy_n(s.rotation, 4, &rotation[4 * i]);
  opacity_logit[i] = s.opacity_logit;
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(sh_degree));
  std::copy_n(s.sh, floats, &sh[floats * i]);
  if (!mean_rest.empty()) std::copy_n(s.mean_rest, 3, &mean_rest[3 * i]);
}

}  // namespace rgs
