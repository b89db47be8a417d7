// gsplat_arrays.cpp - checks arrays and makes Gaussians of them.
// SPDX-License-Identifier: Apache-2.0
#include "gsplat_arrays.hpp"

#include <cmath>

#include "origin_of.hpp"
#include "quantised.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

constexpr struct {
  std::uint64_t channels;
  const char* wrong;
} kShapes[] = {{3, "means is not [n, 3]"},
               {3, "scales is not [n, 3], as many as means"},
               {4, "quats is not [n, 4], as many as means"},
               {1, "opacities is not [n] or [n, 1], as many as means"},
               {3, "sh0 is not [n, 1, 3] or [n, 3], as many as means"},
               {3, "shN is not [n, k, 3] with k = 0, 3, 8 or 15, as many as means"}};

// 0 to 3, or -1.
int degree_of(std::uint64_t coefficients_above_0) {
  for (int degree = 0; degree <= kMaxShDegree; ++degree)
    if (coefficients_above_0 + 1 == static_cast<std::uint64_t>(sh_coefficients(degree))) return degree;
  return -1;
}

}  // namespace

double Array::at(std::uint64_t i, std::uint64_t row, std::uint64_t channel) const {
  const std::uint64_t byte = first + item_bytes * (i * stride[0] + row * stride[1] + channel * stride[2]);
  switch (item_bytes) {
    case 2: return static_cast<double>(float_from_half(load<std::uint16_t>(bytes, byte)));
    case 4: return static_cast<double>(load<float>(bytes, byte));
    default: return load<double>(bytes, byte);
  }
}

Status check_array(std::size_t p, const Arrays& arrays, const DecodeLimits& limits) {
  const auto& shape = arrays[p].shape;
  const std::uint64_t n = arrays[kMeans].shape[0];
  const bool fits = p == kHigherSh ? arrays[p].n_dims == 3 && degree_of(shape[1]) >= 0 : shape[1] == 1;
  if (!fits || shape[2] != kShapes[p].channels || shape[0] != n)
    return make_error(Errc::bad_header, 0, kShapes[p].wrong, p == kMeans ? Error::kNone : n, shape[0]);
  if (n > limits.max_gaussians)
    return make_error(Errc::limit_exceeded, 0, "more Gaussians than the caller allows", limits.max_gaussians, n);
  return {};
}

Result<SplatFile> scene_of(const Arrays& arrays, std::uint64_t stored, const DecodeLimits& limits) {
  const Array &means = arrays[kMeans], &shn = arrays[kHigherSh];
  const std::uint64_t n = means.shape[0], above_0 = shn.shape[1];
  if (const Status s = check_expansion(4 * (14 + 3 * above_0) * n, stored, 0, limits); !s)
    return tl::unexpected(s.error());
  SplatFile file;
  file.cloud.resize(n, degree_of(above_0));
  if (means.item_bytes == 8)
    file.origin = origin_of(n, [&means](std::uint64_t i) {
      return std::array{means.at(i, 0, 0), means.at(i, 0, 1), means.at(i, 0, 2)};
    });
  const auto number = [&](Parameter p, std::uint64_t i, std::uint64_t channel) {
    return static_cast<float>(arrays[p].at(i, 0, channel));
  };
  for (std::uint64_t i = 0; i < n; ++i) {
    Splat s;
    for (std::uint64_t k = 0; k < 3; ++k) {
      const double x = means.at(i, 0, k) - file.origin[k];
      s.mean[k] = static_cast<float>(x);
      const double error = std::fabs(static_cast<double>(s.mean[k]) - x);
      if (error > file.position_rounding && std::isfinite(error)) file.position_rounding = error;
      s.log_scale[k] = number(kScales, i, k);
      s.sh[k] = number(kConstantSh, i, k);
      for (std::uint64_t row = 0; row < above_0; ++row) s.sh[3 * (row + 1) + k] = static_cast<float>(shn.at(i, row, k));
    }
    for (std::uint64_t k = 0; k < 4; ++k) s.rotation[k] = number(kQuats, i, k);
    s.opacity_logit = number(kOpacities, i, 0);
    file.cloud.set(i, s);
  }
  return file;
}

}  // namespace rgs::detail
