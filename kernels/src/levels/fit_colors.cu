// fit_colors.cu - fits opacities and harmonics of a page of levels to averaged pictures of the group that it replaces.
// SPDX-License-Identifier: Apache-2.0
//
// Math    docs/develop/LEVELS.md, "Colours together"; the same steps as converter/lod/fit.cpp, other roundings
// In/Out  Gaussians, frames -> keys -> dots -> pictures; then, a step a frame, dots -> slopes -> opacities and harmonics
// Cost    a step reads each box once or twice for 4 pixels, each dot twice for the tiles that it touches, and moments twice
// Launch  keys, dots: a thread an item. Pictures: a warp a tile of 8 x 4 pixels. Steps: one cooperative launch of few blocks of 256,
//         since launches of many threads of the host would wait for each other; a warp a tile of 2 x 2 pixels, eight parts of which
//         share its dots, and a thread a Gaussian
// Shared  steps: 40 KiB, a batch of a tile's dots for each warp
// Order   deterministic: slopes of tiles are added as integers. What a tile adds is rounded to 2^-32
#include <cooperative_groups.h>

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "levels/fit_colors.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/math/covariance.hpp"
#include "rgs/math/sh.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 128, kStepThreads = 256;
// A step's tile is small and its dots are shared out, because lists are long where pictures are small.
constexpr int kStepTileWidth = 2, kStepTileHeight = 2, kStepPixels = kStepTileWidth * kStepTileHeight;
constexpr int kParts = 32 / kStepPixels;
constexpr std::uint32_t kBatch = 128;      // dots of a tile
constexpr std::uint32_t kMostBlocks = 32;  // of a fit, or a quarter of what the device holds: several run side by side
constexpr int kTileWidth = 8, kTileHeight = 4;
constexpr float kSlopeUnit = 4294967296.F, kMostSlope = 1e5F;  // the sum of as many tiles as a picture has fits 64 bits

__device__ float value_of(const FitGaussians& g, int value, std::uint32_t i) {
  return g.values[static_cast<std::size_t>(value) * g.stride + i];
}

__device__ float along(const float (&axis)[3], const float (&x)[3]) {
  return axis[0] * x[0] + axis[1] * x[1] + axis[2] * x[2];
}

// Bits that sort like the float.
__device__ std::uint32_t ordered(float value) {
  const std::uint32_t bits = __float_as_uint(value + 0.F);  // -0 becomes 0
  return (bits >> 31) != 0 ? ~bits : bits | 0x80000000U;
}

__device__ void place(const FitGaussians& g, std::uint32_t i, const FitFrame& frame, int factor, float low_pass,
                      FitDot& dot, FitBox& box) {
  const float by = static_cast<float>(factor) / frame.pixel;
  float mean[3], scale[3], xx = 0, xy = 0, yy = 0;
#pragma unroll
  for (int k = 0; k < 3; ++k) mean[k] = value_of(g, kFitMean + k, i), scale[k] = value_of(g, kFitScale + k, i);
  float r[9];
  math::rotation_matrix(math::Quaternion<float>{value_of(g, kFitRotation, i), value_of(g, kFitRotation + 1, i),
                                                value_of(g, kFitRotation + 2, i), value_of(g, kFitRotation + 3, i)},
                        r);
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    const float axis[3] = {r[k], r[3 + k], r[6 + k]};
    const float mu = by * scale[k] * along(frame.right, axis), mv = by * scale[k] * along(frame.down, axis);
    xx += mu * mu, xy += mu * mv, yy += mv * mv;
  }
  dot.u = by * (along(frame.right, mean) - frame.left);
  dot.v = by * (along(frame.down, mean) - frame.top);
  const float before = xx * yy - xy * xy;
  xx += low_pass, yy += low_pass;
  const float det = xx * yy - xy * xy;
  dot.opacity = value_of(g, kFitOpacity, i) * sqrtf(fmaxf(before / det, math::kMipRatioMin));
  constexpr float kHalf = -0.5F * math::kLog2E;
  dot.aa = kHalf * yy / det, dot.ab = -2 * kHalf * xy / det, dot.cc = kHalf * xx / det;
  box = {};
  if (!(dot.opacity >= math::kAlphaMin && det > 0)) return;
  const float reach = sqrtf(fmaxf(2 * logf(255 * dot.opacity) + 1e-4F, 0.F));
  const float rx = reach * sqrtf(xx), ry = reach * sqrtf(yy);
  const float width = static_cast<float>(factor * frame.width), height = static_cast<float>(factor * frame.height);
  const auto clamped = [](float a, float most) { return fminf(fmaxf(a, 0.F), most); };
  const float x0 = ceilf(clamped(dot.u - rx - 0.5F, width)), x1 = floorf(clamped(dot.u + rx + 0.5F, width));
  const float y0 = ceilf(clamped(dot.v - ry - 0.5F, height)), y1 = floorf(clamped(dot.v + ry + 0.5F, height));
  if (!(x0 < x1 && y0 < y1)) return;
  box = {static_cast<std::int16_t>(x0), static_cast<std::int16_t>(x1), static_cast<std::int16_t>(y0),
         static_cast<std::int16_t>(y1)};
  const auto basis =
      math::sh_basis(g.sh_degree, math::Vec3<float>{frame.forward[0], frame.forward[1], frame.forward[2]});
  const int n_coefficients = (g.sh_degree + 1) * (g.sh_degree + 1);
  float color[3] = {0.5F, 0.5F, 0.5F};
#pragma unroll
  for (int k = 0; k < 16; ++k) {
    if (k >= n_coefficients) break;
#pragma unroll
    for (int c = 0; c < 3; ++c) color[c] += basis.y[k] * value_of(g, kFitSh + 3 * k + c, i);
  }
#pragma unroll
  for (int c = 0; c < 3; ++c) dot.color[c] = fmaxf(color[c], 0.F);
}

__device__ float alpha_at(const FitDot& dot, float x, float y) {
  const float dx = x - dot.u, dy = y - dot.v;
  const float power = fminf(fmaxf((dot.aa * dx + dot.ab * dy) * dx + dot.cc * dy * dy, -30.F), 0.F);
  const float alpha = fminf(dot.opacity * exp2f(power), math::kAlphaMax);
  return alpha < math::kAlphaMin ? 0.F : alpha;
}

// Calls visit(place) for each dot whose box meets the warp's tile, front to back.
template <class Visit>
__device__ void each_dot(const FitBox* boxes, std::uint32_t n, int x0, int y0, const Visit& visit) {
  for (std::uint32_t base = 0; base < n; base += 32) {
    const std::uint32_t i = base + threadIdx.x % 32;
    const FitBox box = i < n ? boxes[i] : FitBox{};
    unsigned met =
        __ballot_sync(kFullWarp, box.x0 < x0 + kTileWidth && x0 < box.x1 && box.y0 < y0 + kTileHeight && y0 < box.y1);
    for (; met != 0; met &= met - 1) visit(base + static_cast<std::uint32_t>(__ffs(static_cast<int>(met)) - 1));
  }
}

struct Pixel {
  float color[3] = {0, 0, 0};
  float transmittance = 1;
};
__device__ Pixel draw(const FitDot* dots, const FitBox* boxes, std::uint32_t n, int x0, int y0, float x, float y) {
  Pixel out;
  each_dot(boxes, n, x0, y0, [&](std::uint32_t at) {
    const FitDot& dot = dots[at];
    const float weight = alpha_at(dot, x, y) * out.transmittance;
    out.transmittance -= weight;
#pragma unroll
    for (int c = 0; c < 3; ++c) out.color[c] += weight * dot.color[c];
  });
  return out;
}

__global__ void __launch_bounds__(kThreads) keys_kernel(const FitGaussians g, const FitFrame* frames, std::uint64_t n,
                                                        std::uint64_t* keys, std::uint32_t* items) {
  const std::uint64_t at = std::uint64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (at >= n) return;
  const std::uint64_t frame = at / g.n;
  const auto i = static_cast<std::uint32_t>(at % g.n);
  const float mean[3] = {value_of(g, kFitMean, i), value_of(g, kFitMean + 1, i), value_of(g, kFitMean + 2, i)};
  keys[at] = frame << 32 | ordered(along(frames[frame].forward, mean));
  items[at] = i;
}

__global__ void __launch_bounds__(kThreads)
    dots_kernel(const FitGaussians g, const FitFrame* frames, std::uint64_t n, int factor, float low_pass,
                const std::uint32_t* items, const FitDots out) {
  const std::uint64_t at = std::uint64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (at >= n) return;
  FitDot dot;
  FitBox box;
  place(g, items[at], frames[at / g.n], factor, low_pass, dot, box);
  out.dots[at] = dot;
  out.boxes[at] = box;
}

__global__ void __launch_bounds__(kThreads)
    truths_kernel(const FitFrame* frames, std::uint32_t n, int factor, const FitDots in, float4* pictures) {
  const FitFrame& frame = frames[blockIdx.y];
  const int width = factor * frame.width, height = factor * frame.height;
  const int tiles_across = (width + kTileWidth - 1) / kTileWidth;
  const int tile = static_cast<int>((blockIdx.x * kThreads + threadIdx.x) / 32),
            lane = static_cast<int>(threadIdx.x % 32);
  const int x0 = tile % tiles_across * kTileWidth, y0 = tile / tiles_across * kTileHeight;
  if (y0 >= height) return;
  const int x = x0 + lane % kTileWidth, y = y0 + lane / kTileWidth;
  const std::size_t first = std::size_t{blockIdx.y} * n;
  Pixel pixel =
      draw(in.dots + first, in.boxes + first, n, x0, y0, static_cast<float>(x) + 0.5F, static_cast<float>(y) + 0.5F);
  // Lanes of a coarse pixel differ in the lowest bits of x and of y.
  for (int step = 1; step < factor; step *= 2) {
    for (const int lanes : {step, step * kTileWidth}) {
#pragma unroll
      for (float& c : pixel.color) c += __shfl_xor_sync(kFullWarp, c, lanes);
      pixel.transmittance += __shfl_xor_sync(kFullWarp, pixel.transmittance, lanes);
    }
  }
  if (x % factor != 0 || y % factor != 0 || x >= width || y >= height) return;
  const float share = 1 / static_cast<float>(factor * factor);
  pictures[frame.first_pixel + static_cast<std::uint64_t>(y / factor) * static_cast<std::uint64_t>(frame.width) +
           static_cast<std::uint64_t>(x / factor)] =
      make_float4(share * pixel.color[0], share * pixel.color[1], share * pixel.color[2], share * pixel.transmittance);
}

__global__ void __launch_bounds__(kThreads)
    ranks_kernel(const std::uint32_t* items, std::uint32_t n, std::uint64_t n_all, std::uint32_t* ranks) {
  const std::uint64_t at = std::uint64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (at < n_all) ranks[at / n * n + items[at]] = static_cast<std::uint32_t>(at % n);
}

// What a step draws: a frame, its picture, and the Gaussians in its order.
struct View {
  const FitFrame& frame;
  const float4* picture;
  const std::uint32_t *items, *ranks;
  FitDot* dots;
  FitBox* boxes;
};

__device__ View view_of(const FitViews& views, const FitDots (&dots)[2], std::uint32_t n, int step, int stride) {
  const std::uint32_t frame = static_cast<std::uint32_t>(step * stride) % views.n_frames;
  const std::size_t first = std::size_t{frame} * n;
  return {views.frames[frame], views.pictures + views.frames[frame].first_pixel,
          views.items + first, views.ranks + first,
          dots[step % 2].dots, dots[step % 2].boxes};
}

__device__ void place_in(const View& view, const FitGaussians& g, std::uint32_t i, float low_pass) {
  FitDot dot;
  FitBox box;
  place(g, i, view.frame, 1, low_pass, dot, box);
  view.dots[view.ranks[i]] = dot;
  view.boxes[view.ranks[i]] = box;
}

// Dots of a tile, front to back, and their places among all.
struct Batch {
  std::uint32_t places[kBatch];
  FitDot dots[kBatch];
};

// Calls visit(n) for each batch of the tile's dots; by all lanes. Returns the number of batches.
template <class Visit>
__device__ int each_batch(const View& view, std::uint32_t n, int x0, int y0, Batch& batch, const Visit& visit) {
  constexpr int kAhead = 4;  // boxes are far away: some are read before they are needed
  const unsigned lane = threadIdx.x % 32;
  std::uint32_t listed = 0;
  int batches = 0;
  for (std::uint32_t base = 0; base < n; base += 32 * kAhead) {
    FitBox boxes[kAhead];
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      const std::uint32_t i = base + 32 * static_cast<std::uint32_t>(k) + lane;
      boxes[k] = i < n ? view.boxes[i] : FitBox{};
    }
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      const FitBox& box = boxes[k];
      const bool meets = box.x0 < x0 + kStepTileWidth && x0 < box.x1 && box.y0 < y0 + kStepTileHeight && y0 < box.y1;
      const unsigned met = __ballot_sync(kFullWarp, meets);
      const std::uint32_t i = base + 32 * static_cast<std::uint32_t>(k) + lane;
      if (meets) batch.places[listed + static_cast<std::uint32_t>(__popc(met & ((1U << lane) - 1)))] = i;
      listed += static_cast<std::uint32_t>(__popc(met));
      const bool is_last = k == kAhead - 1 && base + 32 * kAhead >= n;
      if (listed <= kBatch - 32 && !(is_last && listed > 0)) continue;
      __syncwarp();
      for (std::uint32_t j = lane; j < listed; j += 32) batch.dots[j] = view.dots[batch.places[j]];
      __syncwarp();
      visit(listed);
      __syncwarp();
      listed = 0;
      ++batches;
    }
  }
  return batches;
}

// Of the dots of a part, and of all parts before it: colour through what is in front, and what remains.
struct Through {
  float value, transmittance;
};
// Composes the parts before the lane's own; `all`: of all parts.
__device__ Through before_part(Through part, Through& all) {
  const int part_of_lane = static_cast<int>(threadIdx.x % 32 / kStepPixels);
  Through before{0, 1};
  all = {0, 1};
#pragma unroll
  for (int k = 0; k < kParts; ++k) {
    const int lane = k * kStepPixels + static_cast<int>(threadIdx.x % kStepPixels);
    const float value = __shfl_sync(kFullWarp, part.value, lane);
    const float transmittance = __shfl_sync(kFullWarp, part.transmittance, lane);
    if (k == part_of_lane) before = all;
    all.value += all.transmittance * value;
    all.transmittance *= transmittance;
  }
  return before;
}

// Adds the slopes of a tile; by a warp, each part of which takes a part of the dots.
__device__ void add_slopes(const View& view, int tile, const FitGaussians& g, Batch& batch, std::uint64_t* slopes) {
  const FitFrame& frame = view.frame;
  const int tiles_across = (frame.width + kStepTileWidth - 1) / kStepTileWidth;
  const int pixel = static_cast<int>(threadIdx.x % kStepPixels);
  const std::uint32_t part = threadIdx.x % 32 / kStepPixels;
  const int x0 = tile % tiles_across * kStepTileWidth, y0 = tile / tiles_across * kStepTileHeight;
  const int at_x = x0 + pixel % kStepTileWidth, at_y = y0 + pixel / kStepTileWidth;
  const float x = static_cast<float>(at_x) + 0.5F, y = static_cast<float>(at_y) + 0.5F;
  const auto each_of_part = [part](std::uint32_t listed, const auto& visit) {
    for (std::uint32_t i = part * listed / kParts; i < (part + 1) * listed / kParts; ++i) visit(i);
  };
  float drawn[3] = {0, 0, 0}, transmittance = 1;
  std::uint32_t last = 0;
  const int batches = each_batch(view, g.n, x0, y0, batch, [&](std::uint32_t listed) {
    float color[3] = {0, 0, 0}, left = 1;
    last = listed;
    each_of_part(listed, [&](std::uint32_t i) {
      const FitDot& dot = batch.dots[i];
      const float weight = alpha_at(dot, x, y) * left;
      left -= weight;
#pragma unroll
      for (int c = 0; c < 3; ++c) color[c] += weight * dot.color[c];
    });
    Through all{};
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      before_part({color[c], left}, all);
      drawn[c] += transmittance * all.value;
    }
    transmittance *= all.transmittance;
  });
  // Of the squared difference over all backgrounds b in [0, 1]: the mean of (dc + dt b)^2 is dc^2 + dc dt + dt^2 / 3.
  float by_color[3] = {0, 0, 0}, by_covered = 0, rest = 0;
  if (at_x < frame.width && at_y < frame.height) {
    const float4 truth = view.picture[static_cast<std::size_t>(at_y) * static_cast<std::size_t>(frame.width) +
                                      static_cast<std::size_t>(at_x)];
    const float of_truth[3] = {truth.x, truth.y, truth.z}, dt = transmittance - truth.w;
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      const float dc = drawn[c] - of_truth[c];
      by_color[c] = 2 * dc + dt;
      by_covered -= dc + 2.F / 3 * dt;
      rest += by_color[c] * drawn[c];
    }
    rest += by_covered * (1 - transmittance);
  }
  const auto value_of_dot = [&](const FitDot& dot) {
    return by_covered + by_color[0] * dot.color[0] + by_color[1] * dot.color[1] + by_color[2] * dot.color[2];
  };
  transmittance = 1;
  const auto add = [&](std::uint32_t listed) {
    Through of_part{0, 1}, all;
    each_of_part(listed, [&](std::uint32_t i) {
      const FitDot& dot = batch.dots[i];
      const float weight = alpha_at(dot, x, y) * of_part.transmittance;
      of_part.transmittance -= weight;
      of_part.value += weight * value_of_dot(dot);
    });
    const Through before = before_part(of_part, all);
    float left = transmittance * before.transmittance, behind = rest - transmittance * before.value;
    rest -= transmittance * all.value;
    transmittance *= all.transmittance;
    // All parts make as many turns, since lanes of a warp exchange sums.
    const std::uint32_t first = part * listed / kParts, end = (part + 1) * listed / kParts;
    for (std::uint32_t turn = 0; turn < (listed + kParts - 1) / kParts; ++turn) {
      const bool is_dot = first + turn < end;
      const std::uint32_t at = is_dot ? first + turn : 0;
      const FitDot& dot = batch.dots[at];
      const float alpha = is_dot ? alpha_at(dot, x, y) : 0, weight = alpha * left, value = value_of_dot(dot);
      behind -= weight * value;
      const float by_log = alpha < math::kAlphaMax ? alpha * (left * value - behind / (1 - alpha)) : 0;
      left -= weight;
      float sums[4] = {by_log, weight * by_color[0], weight * by_color[1], weight * by_color[2]};
#pragma unroll
      for (float& sum : sums) {
#pragma unroll
        for (int step = 1; step < kStepPixels; step *= 2) sum += __shfl_xor_sync(kFullWarp, sum, step);
      }
      static_assert(kStepPixels == 4);  // each lane of a part adds a sum
      const float mine = pixel == 0 ? sums[0] : pixel == 1 ? sums[1] : pixel == 2 ? sums[2] : sums[3];
      if (mine == 0) continue;
      const std::uint32_t i = view.items[batch.places[at]];
      if (!isfinite(mine)) {
        g.values[static_cast<std::size_t>(kFitSh) * g.stride + i] = NAN;  // the caller drops such fits
      } else {
        const float slope = fminf(fmaxf(mine, -kMostSlope), kMostSlope) * kSlopeUnit;
        atomic_add(slopes[static_cast<std::size_t>(pixel) * g.stride + i],
                   static_cast<std::uint64_t>(__float2ll_rn(slope)));
      }
    }
  };
  // The only batch is still there.
  if (batches == 1) add(last);
  if (batches > 1) each_batch(view, g.n, x0, y0, batch, add);
  __syncwarp();  // before the next tile's batch
}

struct Step {
  float rate, unbias, unbias_square;
};
__device__ void move(const View& view, const FitGaussians& g, std::uint32_t i, const Step& step, const FitRules& rules,
                     const FitState& state) {
  const std::uint32_t rank = view.ranks[i];
  const FitBox box = view.boxes[rank];
  const bool inside =
      box.x0 < box.x1 && box.x0 > 0 && box.y0 > 0 && box.x1 < view.frame.width && box.y1 < view.frame.height;
  float slopes[4];
#pragma unroll
  for (int k = 0; k < 4; ++k) {
    std::uint64_t& sum = state.slopes[static_cast<std::size_t>(k) * g.stride + i];
    const bool counts = inside && (k == 0 || view.dots[rank].color[k - 1] > 0);
    slopes[k] = counts ? static_cast<float>(static_cast<std::int64_t>(sum)) / kSlopeUnit : 0;
    sum = 0;
  }
  const auto at = [&](int value) { return static_cast<std::size_t>(value) * g.stride + i; };
  // Updates both moments and returns the change.
  const auto change = [&](float& mean, float& square, float slope, float size) {
    mean = rules.decay1 * mean + (1 - rules.decay1) * slope;
    square = rules.decay2 * square + (1 - rules.decay2) * slope * slope;
    return -step.rate * size * mean * step.unbias * rsqrtf(fmaxf(square * step.unbias_square, 1e-24F));
  };
  float& opacity = g.values[at(kFitOpacity)];
  float& logit = state.logits[i];
  const float by_logit = change(state.means[i], state.squares[i], slopes[0] * (1 - opacity), rules.logit_step);
  logit = fminf(fmaxf(logit + by_logit, rules.least_logit), rules.most_logit);
  opacity = 1 / (1 + expf(-logit));
  const auto basis = math::sh_basis(
      g.sh_degree, math::Vec3<float>{view.frame.forward[0], view.frame.forward[1], view.frame.forward[2]});
  const int n_harmonics = 3 * (g.sh_degree + 1) * (g.sh_degree + 1);
  constexpr int kFew = 12;  // memory is far away: a few values are read before any is written
#pragma unroll
  for (int first = 0; first < 48; first += kFew) {
    float means[kFew], squares[kFew], values[kFew];
#pragma unroll
    for (int k = 0; k < kFew; ++k) {
      if (first + k >= n_harmonics) break;
      means[k] = state.means[at(1 + first + k)];
      squares[k] = state.squares[at(1 + first + k)];
      values[k] = g.values[at(kFitSh + first + k)];
    }
#pragma unroll
    for (int k = 0; k < kFew; ++k) {
      if (first + k >= n_harmonics) break;
      values[k] += change(means[k], squares[k], basis.y[(first + k) / 3] * slopes[1 + (first + k) % 3],
                          first + k < 3 ? rules.dc_step : rules.sh_step);
      state.means[at(1 + first + k)] = means[k];
      state.squares[at(1 + first + k)] = squares[k];
      g.values[at(kFitSh + first + k)] = values[k];
    }
  }
}

__global__ void __launch_bounds__(kStepThreads, resident_before_90(2))
    steps_kernel(const __grid_constant__ FitViews views, const __grid_constant__ FitGaussians g,
                 const __grid_constant__ FitRules rules, const __grid_constant__ FitState state, const FitDots even,
                 const FitDots odd) {
  const cooperative_groups::grid_group grid = cooperative_groups::this_grid();
  __shared__ Batch batches[kStepThreads / 32];
  const FitDots dots[2] = {even, odd};
  // Warps of a block are far apart, so that few Gaussians keep all blocks busy.
  const std::uint32_t warp = threadIdx.x / 32 * gridDim.x + blockIdx.x, warps = gridDim.x * (kStepThreads / 32);
  const std::uint32_t thread = 32 * warp + threadIdx.x % 32, threads = 32 * warps;
  const auto view = [&](int step) { return view_of(views, dots, g.n, step, rules.stride); };
  for (std::uint32_t i = thread; i < g.n; i += threads) {
    const float opacity = fminf(fmaxf(value_of(g, kFitOpacity, i), 1.02e-4F), 0.99F);
    state.logits[i] = logf(opacity / (1 - opacity));
    place_in(view(0), g, i, rules.low_pass);
  }
  grid.sync();
  for (int at = 0; at < rules.steps; ++at) {
    const View now = view(at), next = view(at + 1);
    const std::uint32_t tiles =
        static_cast<std::uint32_t>((now.frame.width + kStepTileWidth - 1) / kStepTileWidth *
                                   ((now.frame.height + kStepTileHeight - 1) / kStepTileHeight));
    for (std::uint32_t tile = warp; tile < tiles; tile += warps)
      add_slopes(now, static_cast<int>(tile), g, batches[threadIdx.x / 32], state.slopes);
    grid.sync();
    const auto taken = static_cast<float>(at + 1);
    const Step step{powf(0.1F, static_cast<float>(at) / static_cast<float>(rules.steps)),
                    1 / (1 - powf(rules.decay1, taken)), 1 / (1 - powf(rules.decay2, taken))};
    for (std::uint32_t i = thread; i < g.n; i += threads) {
      move(now, g, i, step, rules, state);
      if (at + 1 < rules.steps) place_in(next, g, i, rules.low_pass);
    }
    grid.sync();
  }
}

}  // namespace

Status launch_fit_keys(const FitGaussians& gaussians, const FitFrame* frames, std::uint32_t n_frames,
                       std::uint64_t* keys, std::uint32_t* items, Stream stream) {
  const std::uint64_t n = std::uint64_t{n_frames} * gaussians.n;
  keys_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(gaussians, frames, n, keys, items);
  return launched("depths of a group could not be found");
}

Status launch_fit_dots(const FitGaussians& gaussians, const FitFrame* frames, std::uint32_t n_frames, int factor,
                       float low_pass, const std::uint32_t* items, const FitDots& dots, Stream stream) {
  const std::uint64_t n = std::uint64_t{n_frames} * gaussians.n;
  dots_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(gaussians, frames, n, factor, low_pass, items, dots);
  return launched("a group could not be projected");
}

Status launch_fit_truths(const FitFrame* frames, std::uint32_t n_frames, std::uint32_t n, int factor,
                         std::uint32_t most_tiles, const FitDots& dots, float4* pictures, Stream stream) {
  truths_kernel<<<dim3(blocks_for(32 * std::uint64_t{most_tiles}, kThreads), n_frames), kThreads, 0, stream>>>(
      frames, n, factor, dots, pictures);
  return launched("pictures of a group could not be drawn");
}

Status launch_fit_ranks(const std::uint32_t* items, std::uint32_t n, std::uint32_t n_frames, std::uint32_t* ranks,
                        Stream stream) {
  const std::uint64_t n_all = std::uint64_t{n_frames} * n;
  ranks_kernel<<<blocks_for(n_all, kThreads), kThreads, 0, stream>>>(items, n, n_all, ranks);
  return launched("the order of a page's Gaussians could not be kept");
}

Status launch_fit_steps(const FitViews& views, const FitGaussians& gaussians, const FitRules& rules,
                        const FitState& state, const FitDots (&dots)[2], Stream stream) {
  const auto held = resident_grid<steps_kernel>(kStepThreads);
  if (!held) return tl::unexpected(held.error());
  const std::uint32_t wanted = blocks_for(std::uint64_t{views.most_pixels} / kStepPixels * 32, kStepThreads);
  const std::uint32_t blocks = std::clamp(wanted, 1U, std::clamp(*held / 4, 1U, kMostBlocks));
  FitViews v = views;
  FitGaussians g = gaussians;
  FitRules r = rules;
  FitState s = state;
  FitDots even = dots[0], odd = dots[1];
  void* arguments[] = {&v, &g, &r, &s, &even, &odd};
  return checked(cudaLaunchCooperativeKernel(reinterpret_cast<const void*>(steps_kernel), dim3(blocks),
                                             dim3(kStepThreads), arguments, 0, stream),
                 "a page's colours could not be fitted");
}

}  // namespace rgs::cuda
