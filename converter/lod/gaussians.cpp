// gaussians.cpp - converts between parameters of training and activated arrays.
// SPDX-License-Identifier: Apache-2.0
#include "gaussians.hpp"

#include <algorithm>
#include <cmath>

#include "rgs/quantize.hpp"

namespace rgs::lod {
namespace {

constexpr float kMostHalf = 65504;
constexpr float kLogFar = 20.723F;  // of kFarAway

}  // namespace

void Gaussians::resize(std::size_t n, int sh_degree) {
  n_ = n;
  stride_ = (n + 7) / 8 * 8;
  sh_degree_ = sh_degree;
  values_.assign(stride_ * static_cast<std::size_t>(n_values()), 0.F);
  for (std::size_t i = n; i < stride_; ++i) {
    of(kRotation)[i] = 1;
    for (int k = 0; k < 3; ++k) of(kScale + k)[i] = 1;
  }
}

Gaussians activate(const SplatView& splats, std::uint64_t first, std::uint64_t n, const float centre[3],
                   int most_degree) {
  Gaussians out(n, std::min(splats.sh_degree, most_degree));
  for (std::size_t i = 0; i < n; ++i) {
    const std::size_t j = first + i;
    double norm = 0;
    for (std::size_t k = 0; k < 4; ++k) {
      const auto q = static_cast<double>(splats.rotation[4 * j + k]);
      norm += q * q;
    }
    const double factor = norm > 0 ? 1 / std::sqrt(norm) : 0;
    for (int k = 0; k < 4; ++k) {
      const auto q = static_cast<double>(splats.rotation[4 * j + static_cast<std::size_t>(k)]);
      out.of(kRotation + k)[i] = norm > 0 ? static_cast<float>(q * factor) : k == 0 ? 1.F : 0.F;
    }
    for (int k = 0; k < 3; ++k) {
      const std::size_t at = 3 * j + static_cast<std::size_t>(k);
      out.of(kMean + k)[i] = splats.mean[at] - centre[k];
      out.of(kScale + k)[i] = std::exp(splats.log_scale[at]);
    }
    out.of(kOpacity)[i] = 1 / (1 + std::exp(-splats.opacity_logit[j]));
  }
  // A cache line of each array at a time.
  constexpr std::size_t kBlock = 16;
  const auto n_sh = static_cast<std::size_t>(3 * sh_coefficients(splats.sh_degree));
  for (std::size_t begin = 0; begin < n; begin += kBlock) {
    const std::size_t end = std::min<std::size_t>(begin + kBlock, n);
    for (int v = kSh; v < out.n_values(); ++v) {
      const float* const from = &splats.sh[n_sh * first + static_cast<std::size_t>(v - kSh)];
      for (std::size_t i = begin; i < end; ++i) out.of(v)[i] = from[n_sh * i];
    }
  }
  return out;
}

void append(const Gaussians& gaussians, const float centre[3], SplatCloud& out) {
  const std::size_t before = out.size();
  out.resize(before + gaussians.size(), gaussians.sh_degree());
  const auto n_sh = static_cast<std::size_t>(3 * sh_coefficients(gaussians.sh_degree()));
  for (std::size_t i = 0; i < gaussians.size(); ++i) {
    const std::size_t j = before + i;
    for (int k = 0; k < 3; ++k) {
      const std::size_t at = 3 * j + static_cast<std::size_t>(k);
      out.mean[at] = gaussians.of(kMean + k)[i] + centre[k];
      out.log_scale[at] = std::log(std::max(gaussians.of(kScale + k)[i], 1e-30F));
    }
    for (int k = 0; k < 4; ++k) out.rotation[4 * j + static_cast<std::size_t>(k)] = gaussians.of(kRotation + k)[i];
    // Finite logits and logarithms, like those read from a file.
    const float opacity = std::clamp(gaussians.of(kOpacity)[i], 1e-7F, 1 - 1e-7F);
    out.opacity_logit[j] = std::log(opacity / (1 - opacity));
    for (std::size_t k = 0; k < n_sh; ++k) {
      const float value = std::clamp(gaussians.of(kSh + static_cast<int>(k))[i], -kMostHalf, kMostHalf);
      out.sh[n_sh * j + k] = float_from_half(half_from_float(value));
    }
  }
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

float extent(const Gaussians& gaussians) {
  float most = 0;
  for (int k = 0; k < 3; ++k) {
    const float* const x = gaussians.of(kMean + k);
    const auto [low, high] = std::minmax_element(x, x + gaussians.size());
    most = std::max(most, *high - *low);
  }
  return most;
}

bool is_far(const SplatView& splats, std::uint64_t i, const float centre[3]) {
  for (std::size_t k = 0; k < 3; ++k) {
    const float apart = splats.mean[3 * i + k] - centre[k];
    if (!(std::abs(apart) <= kFarAway) || splats.log_scale[3 * i + k] > kLogFar) return true;
  }
  return false;
}

void find_middle(const SplatView& splats, std::uint64_t from, std::uint64_t n, float middle[3]) {
  std::vector<float> values(n);
  for (std::size_t k = 0; k < 3; ++k) {
    for (std::uint64_t i = 0; i < n; ++i) values[i] = splats.mean[3 * (from + i) + k];
    const auto median = values.begin() + static_cast<std::ptrdiff_t>(n / 2);
    std::ranges::nth_element(values, median);
    middle[k] = *median;
  }
}

}  // namespace rgs::lod
