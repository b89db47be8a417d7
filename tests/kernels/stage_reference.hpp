// stage_reference.hpp - one Gaussian through a front end on the host, and its distance from the device's.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <string>

#include "common/frame.hpp"
#include "rgs/math/projection.hpp"
#include "rgs/math/sh.hpp"
#include "rgs/scene.hpp"

namespace rgs::test {

/// Tolerance of the device's logarithm. Everything that depends on it is checked from the device's own value.
inline constexpr std::int64_t kCutoffUlps = 2;

inline std::int64_t ulps(float a, float b) {
  if (std::isnan(a) && std::isnan(b)) return 0;
  const auto ordered = [](float v) {
    const auto bits = std::bit_cast<std::int32_t>(v);
    return static_cast<std::int64_t>(bits < 0 ? std::numeric_limits<std::int32_t>::min() - bits : bits);
  };
  return std::isnan(a) != std::isnan(b) ? std::numeric_limits<std::int32_t>::max() : std::abs(ordered(a) - ordered(b));
}

inline math::Projected<float> project(const SceneView& s, std::uint64_t i, const cuda::ViewParameters& v) {
  const float *m = &s.mean[3 * i], *q = &s.rotation[4 * i], *d = &s.scale[3 * i];
  return math::project<float>(v.view, {m[0], m[1], m[2]}, {q[0], q[1], q[2], q[3]}, {d[0], d[1], d[2]}, s.opacity[i],
                              v.low_pass, v.anti_aliasing);
}

inline math::Vec3<float> color_of(const SceneView& s, std::uint64_t i, const cuda::ViewParameters& v) {
  const float* sh = &s.sh[static_cast<std::uint64_t>(3 * sh_coefficients(s.sh_degree)) * i];
  const math::Vec3<float> mean{s.mean[3 * i], s.mean[3 * i + 1], s.mean[3 * i + 2]};
  const auto basis = math::sh_basis(v.sh_degree, math::view_direction(v.view, mean));
  return math::sh_color<float>(s.sh_degree, basis, [sh](int k) {
    return math::Vec3<float>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]};
  });
}

/// Tolerance of the device's colour: it sums in another order, and the direction's root is 2 ulp off.
inline math::Vec3<float> color_allowance(const SceneView& s, std::uint64_t i, const cuda::ViewParameters& v) {
  const math::Vec3<float> mean{s.mean[3 * i], s.mean[3 * i + 1], s.mean[3 * i + 2]};
  const auto basis = math::sh_basis(v.sh_degree, math::view_direction(v.view, mean));
  const int n = sh_coefficients(s.sh_degree);
  const float* sh = &s.sh[static_cast<std::uint64_t>(3 * n) * i];
  float sum[3] = {0.5F, 0.5F, 0.5F};
  for (int k = 0; k < n; ++k) {
    for (int c = 0; c < 3; ++c)
      sum[c] += (std::abs(basis.y[k]) + (basis.y[k] != 0 ? 1.0F : 0.0F)) * std::abs(sh[3 * k + c]);
  }
  constexpr float kRounding = 24 * 0x1p-24F;
  return {kRounding * sum[0], kRounding * sum[1], kRounding * sum[2]};
}

/// Largest distances in units in the last place, and the first Gaussian beyond the tolerance.
struct Deviations {
  std::int64_t exact = 0, cutoff = 0;
  std::string first;

  void compare(std::uint64_t i, const char* what, float device, float host, std::int64_t allowed, std::int64_t& worst) {
    const std::int64_t d = ulps(device, host);
    worst = std::max(worst, d);
    if (d > allowed) report(i, what, device, host, d);
  }
  void compare_within(std::uint64_t i, const char* what, float device, float host, float allowed) {
    if (!(std::abs(device - host) <= allowed) && device != host) report(i, what, device, host, ulps(device, host));
  }
  void report(std::uint64_t i, const char* what, float device, float host, std::int64_t d) {
    if (!first.empty()) return;
    char text[160];
    std::snprintf(text, sizeof text, "Gaussian %llu: %s is %.9g on the device, %.9g on the host (%lld ulp)",
                  static_cast<unsigned long long>(i), what, static_cast<double>(device), static_cast<double>(host),
                  static_cast<long long>(d));
    first = text;
  }
};

inline void compare_splat(std::uint64_t i, const cuda::ScreenSplat& s, const SceneView& scene,
                          const cuda::ViewParameters& v, Deviations& d) {
  const auto p = project(scene, i, v);
  const auto color = color_of(scene, i, v);
  d.compare(i, "u", s.mean.u, p.mean.u, 0, d.exact);
  d.compare(i, "v", s.mean.v, p.mean.v, 0, d.exact);
  d.compare(i, "z", s.z, p.z, 0, d.exact);
  d.compare(i, "conic.a", s.conic.a, p.footprint.conic.a, 0, d.exact);
  d.compare(i, "conic.b", s.conic.b, p.footprint.conic.b, 0, d.exact);
  d.compare(i, "conic.c", s.conic.c, p.footprint.conic.c, 0, d.exact);
  d.compare(i, "opacity", s.opacity, p.footprint.opacity, 0, d.exact);
  const auto allowed = color_allowance(scene, i, v);
  d.compare_within(i, "red", s.color.x, color.x, allowed.x);
  d.compare_within(i, "green", s.color.y, color.y, allowed.y);
  d.compare_within(i, "blue", s.color.z, color.z, allowed.z);
  d.compare(i, "cutoff", s.cutoff, math::power_cutoff(p.footprint.opacity), kCutoffUlps, d.cutoff);
  d.compare(i, "log2(opacity)", s.log2_opacity, math::kLog2AlphaMin - math::kLog2E * s.cutoff, 0, d.exact);
}

inline bool untouched(const cuda::ScreenSplat& s) {
  const auto bytes = std::bit_cast<std::array<std::uint32_t, sizeof(cuda::ScreenSplat) / 4>>(s);
  return std::all_of(bytes.begin(), bytes.end(), [](std::uint32_t w) { return w == ~0u; });
}

/// A cutoff that much nearer to 0: a Gaussian that the device does not list must have no tile with it.
inline float tighter(float cutoff) {
  for (std::int64_t k = 0; k < kCutoffUlps; ++k) cutoff = std::nextafter(cutoff, 1.0F);
  return cutoff;
}

}  // namespace rgs::test
