// codec_sh.cpp - lossless prediction of SH codes.
//
// SH coefficients of a Gaussian, of its channels and of neighbours are correlated. A code is predicted, in steps of its
// chunk, as a linear combination of the Gaussian's earlier codes, plus a share of the error that the same combination
// made on the row before; least squares fit the weights of each frame, which are stored with it. Residuals take 31.4
// bytes a Gaussian, codes 41.5 (docs/records/EXPERIMENTS.md).
//
// To suit vectors, 64 lanes walk the frame: lane l visits rows l * S to (l + 1) * S - 1, all lanes in step; the
// remaining rows, fewer than 64, are one more step.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstring>

#include "packed/frame_codec.hpp"

namespace rgs::detail {
namespace {

// Walks the frame's rows in lanes. Calls visit(first_position, first_row, row_distance, n_lanes), where lane l has row
// first_row + l * row_distance, with steps, and at the start errors of 0, in place.
template <class Visit>
void walk(ShLanes& lanes, std::uint32_t n_rows, const ShFrame& frame, const Visit& visit) {
  const std::vector<RelativeShSteps> steps = relative_sh_steps(frame);
  std::memset(lanes.error, 0, sizeof lanes.error);
  std::memset(lanes.codes, 0, sizeof lanes.codes);
  const auto set_steps = [&](std::uint32_t first, std::uint32_t distance, std::uint32_t count) {
    std::uint32_t unchanged = n_rows;
    for (std::uint32_t lane = 0; lane < count; ++lane) {
      const std::uint32_t row = first + lane * distance, chunk = row / frame.chunk_rows;
      for (std::size_t k = 0; k < 12; ++k) {
        lanes.step[k][lane] = steps[chunk].step[k];
        lanes.inverse[k][lane] = sh_inverse_step(steps[chunk].step[k]);
      }
      unchanged = std::min(unchanged, (chunk + 1) * frame.chunk_rows - row);
    }
    return unchanged;
  };
  constexpr std::uint32_t kLanes = kShLanes;
  const std::uint32_t rows_a_lane = n_rows / kLanes;
  std::uint32_t unchanged = 0;
  for (std::uint32_t i = 0; i < rows_a_lane; ++i, --unchanged) {
    if (unchanged == 0) unchanged = set_steps(i, rows_a_lane, kLanes);
    visit(i * kLanes, i, rows_a_lane, kLanes);
  }
  const std::uint32_t rest = n_rows % kLanes, first = n_rows - rest;
  if (rest != 0) {
    set_steps(first, 1, rest);
    visit(first, first, 1u, rest);
  }
}

ShWeights unpack(std::span<const std::uint8_t> bytes, int n_codes) {
  ShWeights w;
  w.n = n_codes;
  const auto widened = [](std::uint8_t byte) {
    return static_cast<std::int16_t>(static_cast<std::int8_t>(byte) * 256);
  };
  const std::size_t n = sh_weight_bytes(n_codes) - static_cast<std::size_t>(n_codes);
  for (std::size_t i = 0; i < n; ++i) w.weights[i] = widened(bytes[i]);
  for (std::size_t i = 0; i < static_cast<std::size_t>(n_codes); ++i) w.carry[i] = widened(bytes[n + i]);
  return w;
}

void load_codes(ShLanes& lanes, int n_codes, const std::byte* rows, std::size_t lane_bytes, std::uint32_t count) {
  for (std::uint32_t lane = 0; lane < count; ++lane) {
    const auto* row = reinterpret_cast<const std::int8_t*>(rows + lane * lane_bytes);
    for (int code = 0; code < n_codes; ++code) lanes.codes[code][lane] = row[code];
  }
}

std::uint8_t weight_byte(double weight) {
  return static_cast<std::uint8_t>(
      static_cast<std::int8_t>(std::nearbyint(128 * std::clamp(weight, -127. / 128, 127. / 128))));
}

// Correlations of values, in units of their chunk's step, within a row and with the row before.
struct Correlation {
  std::vector<float> same, lagged;  // [n, n]
};

Correlation correlate_codes(ShLanes& lanes, std::span<const std::byte> rows, const ShFrame& frame, int n_codes) {
  const auto n = static_cast<std::size_t>(n_codes);
  Correlation c{std::vector<float>(n * n), std::vector<float>(n * n)};
  const std::size_t row_bytes = sh_bytes(frame.degree);
  std::vector<float> now(n), before(n * kShLanes);
  const std::size_t unit = static_cast<std::size_t>(3 * frame.degree + 1);
  walk(lanes, static_cast<std::uint32_t>(rows.size() / row_bytes), frame,
       [&](std::uint32_t, std::uint32_t first, std::uint32_t distance, std::uint32_t count) {
         if (count < kShLanes) return;
         for (std::uint32_t lane = 0; lane < count; ++lane) {
           const auto* row = reinterpret_cast<const std::int8_t*>(rows.data() + (first + lane * distance) * row_bytes);
           for (std::size_t i = 0; i < n; ++i) {
             const std::size_t channel = static_cast<std::size_t>(sh_channel(static_cast<int>(i)));
             const std::size_t set = 3 * static_cast<std::size_t>(sh_degree_of(static_cast<int>(i / 3))) + channel;
             const int value = row[i - i % 3 + channel] * lanes.step[set][lane];
             now[i] = static_cast<float>(value) * static_cast<float>(lanes.inverse[unit][lane]) * 0x1p-16f;
           }
           float* last = &before[lane * n];
           codec_kernels().correlate(now.data(), last, n_codes, c.same.data(), c.lagged.data());
           std::ranges::copy(now, last);
         }
       });
  return c;
}

// Lower triangle of the Cholesky factor of the matrix, with a little added to its diagonal so that it exists. If codes
// are fully dependent, as in a chunk of equal Gaussians, FP32 rounding exceeds that little: entries are limited to
// twice their possible magnitude, or they would grow from row to row without bound.
std::vector<double> cholesky(const std::vector<float>& matrix, std::size_t n) {
  double trace = 0;
  for (std::size_t i = 0; i < n; ++i) trace += static_cast<double>(matrix[i * n + i]);
  const double ridge = 1e-6 * trace / static_cast<double>(n) + 1e-3;
  std::vector<double> l(n * n);
  for (std::size_t i = 0; i < n; ++i) {
    const double largest = 2 * std::sqrt(static_cast<double>(matrix[i * n + i]) + ridge);
    for (std::size_t j = 0; j <= i; ++j) {
      double sum = static_cast<double>(matrix[i * n + j]) + (i == j ? ridge : 0);
      for (std::size_t k = 0; k < j; ++k) sum -= l[i * n + k] * l[j * n + k];
      l[i * n + j] = i == j ? std::sqrt(std::max(sum, ridge)) : std::clamp(sum / l[j * n + j], -largest, largest);
    }
  }
  return l;
}

// x^T M x for x of length `n` in a matrix of row length `stride`.
double quadratic(const std::vector<float>& matrix, std::size_t stride, std::span<const double> x) {
  double sum = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    double row = 0;
    for (std::size_t j = 0; j < x.size(); ++j) row += static_cast<double>(matrix[i * stride + j]) * x[j];
    sum += x[i] * row;
  }
  return sum;
}

}  // namespace

// In 1/256 of the frame's largest of the degree. 127 * 256 still fits 16 bits.
std::vector<RelativeShSteps> relative_sh_steps(const ShFrame& frame) {
  std::vector<RelativeShSteps> all(frame.chunk_steps.size());
  for (std::size_t degree = 0; degree < 4; ++degree) {
    float largest = 0;
    for (const ShStepSet& set : frame.chunk_steps)
      largest = std::max({largest, set.step[degree][0], set.step[degree][1], set.step[degree][2]});
    for (std::size_t chunk = 0; chunk < all.size(); ++chunk) {
      for (std::size_t c = 0; c < 3; ++c) {
        const float share = largest > 0 ? frame.chunk_steps[chunk].step[degree][c] / largest : 0.f;
        all[chunk].step[3 * degree + c] = static_cast<std::int16_t>(std::nearbyint(256.f * share));
      }
    }
  }
  return all;
}

void fit_sh_weights(ShLanes& lanes, std::span<const std::byte> rows, const ShFrame& frame,
                    std::span<std::uint8_t> weights) {
  const auto n = static_cast<std::size_t>(3 * sh_coefficients(frame.degree));
  const Correlation c = correlate_codes(lanes, rows, frame, static_cast<int>(n));
  const std::vector<double> l = cholesky(c.same, n);
  std::uint8_t* out = weights.data();
  std::vector<double> x;
  for (std::size_t i = 0; i < n; ++i) {
    // Row i of the factor gives the best combination of the codes before i: L[:i,:i]^T x = L[i,:i].
    x.assign(i + 1, 0);
    for (std::size_t j = i; j-- > 0;) {
      double sum = l[i * n + j];
      for (std::size_t k = j + 1; k < i; ++k) sum -= l[k * n + j] * x[k];
      x[j] = sum / l[j * n + j];
    }
    for (std::size_t j = 0; j < i; ++j) {
      *out = weight_byte(x[j]);
      x[j] = -static_cast<double>(static_cast<std::int8_t>(*out++)) / 128;
    }
    x[i] = 1;
    const double energy = quadratic(c.same, n, x);
    weights[n * (n - 1) / 2 + i] = weight_byte(energy > 0 ? quadratic(c.lagged, n, x) / energy : 0);
  }
}

void decode_sh_planes(ShLanes& lanes, std::span<const std::uint8_t> content, std::uint32_t n_rows, const ShFrame& frame,
                      std::span<std::byte> rows) {
  const int n_codes = 3 * sh_coefficients(frame.degree);
  const std::size_t row_bytes = sh_bytes(frame.degree);
  assert(rows.size() == n_rows * row_bytes);
  const ShWeights weights = unpack(content, n_codes);
  const std::uint8_t* planes = content.data() + sh_weight_bytes(n_codes);
  if (row_bytes != static_cast<std::size_t>(n_codes)) std::ranges::fill(rows, std::byte{0});  // padding
  walk(lanes, n_rows, frame,
       [&](std::uint32_t position, std::uint32_t first, std::uint32_t distance, std::uint32_t count) {
         std::array<std::array<std::uint8_t, kShLanes>, kShMaxCodes> last;
         if (count == kShLanes) {
           codec_kernels().decode(lanes, weights, planes + position, n_rows);
         } else {  // defines lanes without a row
           for (std::size_t i = 0; i < static_cast<std::size_t>(n_codes); ++i) {
             std::ranges::fill(std::copy_n(planes + position + i * n_rows, count, last[i].begin()), last[i].end(),
                               std::uint8_t{0});
           }
           codec_kernels().decode(lanes, weights, last[0].data(), kShLanes);
         }
         codec_kernels().store(lanes, n_codes, static_cast<int>(count),
                               reinterpret_cast<std::int8_t*>(rows.data() + first * row_bytes), distance * row_bytes);
       });
}

void encode_sh_planes(ShLanes& lanes, std::span<const std::byte> rows, const ShFrame& frame,
                      std::span<std::uint8_t> content) {
  const int n_codes = 3 * sh_coefficients(frame.degree);
  const std::size_t row_bytes = sh_bytes(frame.degree);
  const auto n_rows = static_cast<std::uint32_t>(rows.size() / row_bytes);
  const ShWeights weights = unpack(content, n_codes);
  std::uint8_t* planes = content.data() + sh_weight_bytes(n_codes);
  walk(lanes, n_rows, frame,
       [&](std::uint32_t position, std::uint32_t first, std::uint32_t distance, std::uint32_t count) {
         load_codes(lanes, n_codes, rows.data() + first * row_bytes, distance * row_bytes, count);
         if (count == kShLanes) {
           codec_kernels().encode(lanes, weights, planes + position, n_rows);
           return;
         }
         std::array<std::array<std::uint8_t, kShLanes>, kShMaxCodes> last;
         codec_kernels().encode(lanes, weights, last[0].data(), kShLanes);
         for (std::size_t i = 0; i < static_cast<std::size_t>(n_codes); ++i) {
           std::copy_n(last[i].begin(), count, planes + position + i * n_rows);
         }
       });
}

}  // namespace rgs::detail
