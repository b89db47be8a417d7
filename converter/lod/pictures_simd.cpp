// pictures_simd.cpp - pictures of groups, compiled for each instruction set and chosen at run time.
// SPDX-License-Identifier: Apache-2.0
//
// Eight pixels of a row are one vector on every machine (the compiler splits it where registers are shorter), so that
// sums have the same bits everywhere. Gaussians are the outer loop: most cover a few pixels, and a picture stays in the
// second-level cache.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "pictures_simd.cpp"  // NOLINT
// x86 gets AVX-512, AVX2 and the portable fallback (machines before 2013), others their own.
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_SSE4)
#include <hwy/foreach_target.h>
//
#include <hwy/highway.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "key_sort.hpp"
#include "lanes_inl.hpp"
#include "pictures.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/math/sh.hpp"

#ifndef RGS_LOD_DOT_SUMS
#define RGS_LOD_DOT_SUMS
namespace rgs::lod {
// Sums over a dot's pixels: the gradients by the logarithm of alpha and by colour.
struct DotSums {
  float log_alpha, color[3];
};
}  // namespace rgs::lod
#endif

HWY_BEFORE_NAMESPACE();
namespace rgs::lod {
namespace HWY_NAMESPACE {

RGS_LOD_INLINE V alpha_of(V dx, V linear, V constant, float aa, float opacity) {
  V p = (set(aa) * dx + linear) * dx + constant;
  p = select(p < set(-30.F), set(-30.F), p);
  p = select(p > set(0.F), set(0.F), p);
  V alpha = set(opacity) * exp2(p);
  alpha = select(alpha > set(math::kAlphaMax), set(math::kAlphaMax), alpha);
  return select(alpha < set(math::kAlphaMin), set(0.F), alpha);
}

// Calls f(offset into planes, alpha) for each vector of pixels of a dot.
template <class F>
RGS_LOD_INLINE void each_vector(const Dot& dot, std::size_t stride, const F& f) {
  const float half = -0.5F * math::kLog2E;
  const float aa = half * dot.a, cc = half * dot.c, ab = -math::kLog2E * dot.b;
  const V iota{0, 1, 2, 3, 4, 5, 6, 7};
  for (int y = dot.y0; y < dot.y1; ++y) {
    const float dy = static_cast<float>(y) + 0.5F - dot.v;
    const V linear = set(ab * dy), constant = set(cc * dy * dy);
    for (int x = dot.x0; x < dot.x1; x += kLanes) {
      const V dx = iota + set(static_cast<float>(x) + 0.5F - dot.u);
      const V alpha = alpha_of(dx, linear, constant, aa, dot.opacity);
      f(static_cast<std::size_t>(y) * stride + static_cast<std::size_t>(x), alpha);
    }
  }
}

void draw(std::span<const Dot> dots, Picture& picture) {
  float* const r = picture.plane(0);
  float* const g = picture.plane(1);
  float* const b = picture.plane(2);
  float* const t = picture.plane(3);
  std::fill(r, t, 0.F);
  std::fill(t, t + picture.plane_size(), 1.F);
  for (const Dot& dot : dots) {
    const V red = set(dot.color[0]), green = set(dot.color[1]), blue = set(dot.color[2]);
    each_vector(
        dot, picture.stride(), [&](std::size_t at, V alpha) __attribute__((always_inline)) {
          const V before = load(t + at), w = alpha * before;
          store(t + at, before - w);
          store(r + at, load(r + at) + w * red);
          store(g + at, load(g + at) + w * green);
          store(b + at, load(b + at) + w * blue);
        });
  }
}

// Columns: u, v, z, xx, xy, yy, r, g, b.
void project_all(const Gaussians& g, const Frame& frame, const float (&basis)[16], float* out) {
  const std::size_t n = g.padded();
  const float s = 1 / frame.pixel;
  float du[3], dv[3];
  for (int k = 0; k < 3; ++k) du[k] = frame.axes.right[k] * s, dv[k] = frame.axes.down[k] * s;
  const float* const fw = frame.axes.forward;
  const float left = frame.left * s, top = frame.top * s;
  const int n_coefficients = sh_coefficients(g.sh_degree());
  for (std::size_t i = 0; i < n; i += kLanes) {
    const auto in = [&](int value) __attribute__((always_inline)) {
      return load(g.of(value) + i);
    };
    const auto put = [&](int column, V x) __attribute__((always_inline)) {
      store(out + static_cast<std::size_t>(column) * n + i, x);
    };
    const V x = in(kMean), y = in(kMean + 1), z = in(kMean + 2);
    put(0, set(du[0]) * x + set(du[1]) * y + set(du[2]) * z - set(left));
    put(1, set(dv[0]) * x + set(dv[1]) * y + set(dv[2]) * z - set(top));
    put(2, set(fw[0]) * x + set(fw[1]) * y + set(fw[2]) * z);
    const V qw = in(kRotation), qx = in(kRotation + 1), qy = in(kRotation + 2), qz = in(kRotation + 3);
    const V two = set(2), one = set(1);
    const V m[3][3] = {{one - two * (qy * qy + qz * qz), two * (qx * qy + qw * qz), two * (qx * qz - qw * qy)},
                       {two * (qx * qy - qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz + qw * qx)},
                       {two * (qx * qz + qw * qy), two * (qy * qz - qw * qx), one - two * (qx * qx + qy * qy)}};
    V xx = set(0), xy = set(0), yy = set(0);
    for (int k = 0; k < 3; ++k) {
      const V scale = in(kScale + k);
      const V mu = scale * (set(du[0]) * m[k][0] + set(du[1]) * m[k][1] + set(du[2]) * m[k][2]);
      const V mv = scale * (set(dv[0]) * m[k][0] + set(dv[1]) * m[k][1] + set(dv[2]) * m[k][2]);
      xx += mu * mu;
      xy += mu * mv;
      yy += mv * mv;
    }
    put(3, xx);
    put(4, xy);
    put(5, yy);
    for (int channel = 0; channel < 3; ++channel) {
      V c = set(0.5F);
      for (int k = 0; k < n_coefficients; ++k) c += set(basis[k]) * in(kSh + 3 * k + channel);
      put(6 + channel, c);
    }
  }
}

// Derives columns from those of project_all(), times `factor` to the frame's pixels: opacity, the conic's a, b, c, x0,
// x1, y0, y1; x0 = x1 if invisible.
void place_all(const float* opacities, const float* in, std::size_t n, float factor, const Frame& frame,
               const Filter& filter, float* out) {
  const V by = set(factor), by_square = set(factor * factor), low_pass = set(filter.low_pass);
  const V width = set(static_cast<float>(frame.width)), height = set(static_cast<float>(frame.height));
  const V zero = set(0), one = set(1), half = set(0.5F);
  for (std::size_t i = 0; i < n; i += kLanes) {
    const auto column = [&](int k) __attribute__((always_inline)) {
      return load(in + static_cast<std::size_t>(k) * n + i);
    };
    const auto put = [&](int k, V x) __attribute__((always_inline)) {
      store(out + static_cast<std::size_t>(k) * n + i, x);
    };
    const V u = column(0) * by, v = column(1) * by;
    const V before_xx = column(3) * by_square, xy = column(4) * by_square, before_yy = column(5) * by_square;
    const V xx = before_xx + low_pass, yy = before_yy + low_pass;
    const V det = xx * yy - xy * xy;
    V opacity = load(opacities + i);
    if (filter.compensated) {
      V ratio = (before_xx * before_yy - xy * xy) / det;
      ratio = select(ratio > set(math::kMipRatioMin), ratio, set(math::kMipRatioMin));
      opacity *= root(ratio);
    }
    I seen = (opacity >= set(math::kAlphaMin)) & (det > zero);
    const V shown = select(seen, opacity, set(math::kAlphaMin));
    const V inside = set(2) * log_of(shown * set(255)) + set(1e-4F);
    const V reach = root(select(inside > zero, inside, zero));
    const V rx = reach * root(select(seen, xx, one)), ry = reach * root(select(seen, yy, one));
    const auto clamped = [&](V x, V most) __attribute__((always_inline)) {
      x = select(x > zero, x, zero);
      return select(x < most, x, most);
    };
    // Values are >= 0: the conversion rounds down.
    const auto down = [](V x) __attribute__((always_inline)) {
      return __builtin_convertvector(__builtin_convertvector(x, I), V);
    };
    const auto up = [&](V x) __attribute__((always_inline)) {
      const V whole = down(x);
      return select(whole < x, whole + one, whole);
    };
    const V x0 = up(clamped(u - rx - half, width)), x1 = down(clamped(u + rx + half, width));
    const V y0 = up(clamped(v - ry - half, height)), y1 = down(clamped(v + ry + half, height));
    seen &= (x0 < x1) & (y0 < y1);
    put(0, opacity);
    put(1, yy / det);
    put(2, zero - xy / det);
    put(3, xx / det);
    put(4, x0);
    put(5, select(seen, x1, x0));
    put(6, y0);
    put(7, y1);
  }
}

void dot_gradients(std::span<const Dot> dots, const Picture& by, Picture& scratch, DotSums* out) {
  // scratch: 0 remainder of sum g.c behind, 3 transmittance
  float* const rest = scratch.plane(0);
  float* const t = scratch.plane(3);
  const float* const gr = by.plane(0);
  const float* const gg = by.plane(1);
  const float* const gb = by.plane(2);
  const float* const ga = by.plane(3);
  const std::size_t stride = by.stride();
  for (std::size_t i = 0; i < dots.size(); ++i) {
    const Dot& dot = dots[i];
    const V red = set(dot.color[0]), green = set(dot.color[1]), blue = set(dot.color[2]);
    V log_alpha = set(0), cr = log_alpha, cg = log_alpha, cb = log_alpha;
    each_vector(
        dot, stride, [&](std::size_t at, V alpha) __attribute__((always_inline)) {
          const V before = load(t + at), w = alpha * before;
          store(t + at, before - w);
          const V r = load(gr + at), g = load(gg + at), b = load(gb + at);
          const V value = r * red + g * green + b * blue + load(ga + at);
          const V behind = load(rest + at) - w * value;
          store(rest + at, behind);
          cr += w * r;
          cg += w * g;
          cb += w * b;
          const V by_log = alpha * (before * value - behind / (set(1) - alpha));
          log_alpha += select(alpha < set(math::kAlphaMax), by_log, set(0));
        });
    out[i] = {sum(log_alpha), {sum(cr), sum(cg), sum(cb)}};
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::lod
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::lod {

HWY_EXPORT(draw);
HWY_EXPORT(project_all);
HWY_EXPORT(place_all);
HWY_EXPORT(dot_gradients);

void Picture::resize(int width, int height) {
  width_ = width;
  height_ = height;
  stride_ = static_cast<std::size_t>((width + 7) / 8 * 8 + 8);
  plane_ = stride_ * static_cast<std::size_t>(height) + 8;
  values_.resize(4 * plane_);
}

void Picture::reset(int width, int height) {
  resize(width, height);
  std::fill(values_.begin(), values_.end(), 0.F);
}

void project(const Gaussians& g, const Frame& frame, const Filter& filter, Projection& out) {
  const std::size_t n = g.padded();
  out.values.resize(9 * n);
  out.pixel = frame.pixel;
  float* const column = out.values.data();
  const math::Vec3<float> d{frame.axes.forward[0], frame.axes.forward[1], frame.axes.forward[2]};
  const auto basis = math::sh_basis(g.sh_degree(), d);
  HWY_DYNAMIC_DISPATCH(project_all)(g, frame, basis.y, column);
  out.keys.clear();
  for (std::size_t i = 0; i < g.size(); ++i)
    out.keys.push_back(std::uint64_t{ordered_bits(column[2 * n + i])} << 32 | i);
  sort_by_key(out.keys, out.spare);
  project_again(g, frame, filter, out);
}

void project_again(const Gaussians& g, const Frame& frame, const Filter& filter, Projection& out) {
  const std::size_t n = g.padded();
  const float factor = out.pixel / frame.pixel;
  out.placed.resize(8 * n);
  HWY_DYNAMIC_DISPATCH(place_all)(g.of(kOpacity), out.values.data(), n, factor, frame, filter, out.placed.data());
  const auto value = [&](int k, std::size_t i) { return out.values[static_cast<std::size_t>(k) * n + i]; };
  const auto placed = [&](int k, std::size_t i) { return out.placed[static_cast<std::size_t>(k) * n + i]; };
  const auto pixel = [&](int k, std::size_t i) { return static_cast<std::int16_t>(placed(k, i)); };
  out.dots.clear();
  for (const std::uint64_t key : out.keys) {
    const auto i = static_cast<std::uint32_t>(key);
    if (placed(4, i) >= placed(5, i)) continue;
    Dot& dot = out.dots.emplace_back();
    dot.u = value(0, i) * factor, dot.v = value(1, i) * factor;
    dot.opacity = placed(0, i);
    dot.a = placed(1, i), dot.b = placed(2, i), dot.c = placed(3, i);
    for (int k = 0; k < 3; ++k) dot.color[k] = std::max(value(6 + k, i), 0.F);
    dot.index = i;
    dot.x0 = pixel(4, i), dot.x1 = pixel(5, i), dot.y0 = pixel(6, i), dot.y1 = pixel(7, i);
  }
}

void draw(std::span<const Dot> dots, Picture& picture) {
  HWY_DYNAMIC_DISPATCH(draw)(dots, picture);
}

void gradients(const Frame& frame, std::span<const Dot> dots, const Picture& by, const Picture& drawn, Picture& scratch,
               std::size_t n, std::vector<float>& out) {
  out.assign(static_cast<std::size_t>(kGradients) * n, 0.F);
  scratch.resize(by.width(), by.height());
  float* const rest = scratch.plane(0);
  float* const t = scratch.plane(3);
  for (std::size_t i = 0; i < by.plane_size(); ++i) {
    rest[i] = by.plane(0)[i] * drawn.plane(0)[i] + by.plane(1)[i] * drawn.plane(1)[i] +
              by.plane(2)[i] * drawn.plane(2)[i] + by.plane(3)[i] * (1 - drawn.plane(3)[i]);
    t[i] = 1;
  }
  std::vector<DotSums> sums(dots.size());
  HWY_DYNAMIC_DISPATCH(dot_gradients)(dots, by, scratch, sums.data());
  for (std::size_t j = 0; j < dots.size(); ++j) {
    const Dot& dot = dots[j];
    if (dot.x0 == 0 || dot.y0 == 0 || dot.x1 == frame.width || dot.y1 == frame.height) continue;
    const auto put = [&](int gradient, float value) {
      out[static_cast<std::size_t>(gradient) * n + dot.index] = value;
    };
    put(kByLogOpacity, sums[j].log_alpha);
    for (int k = 0; k < 3; ++k) put(kByColor + k, dot.color[k] > 0 ? sums[j].color[k] : 0);
  }
}

void box_filter(const Picture& fine, int factor, Picture& out) {
  const int width = fine.width() / factor, height = fine.height() / factor;
  out.resize(width, height);
  const float share = 1 / static_cast<float>(factor * factor);
  const auto n = static_cast<std::size_t>(width * factor);
  std::vector<float> column_sums(n);
  for (int channel = 0; channel < 4; ++channel) {
    for (int y = 0; y < height; ++y) {
      const float* row = fine.plane(channel) + static_cast<std::size_t>(y * factor) * fine.stride();
      std::copy_n(row, n, column_sums.data());
      for (int j = 1; j < factor; ++j) {
        row += fine.stride();
        for (std::size_t x = 0; x < n; ++x) column_sums[x] += row[x];
      }
      float* const to = out.plane(channel) + static_cast<std::size_t>(y) * out.stride();
      const float* from = column_sums.data();
      for (int x = 0; x < width; ++x, from += factor) {
        if (factor == 2) {
          to[x] = (from[0] + from[1]) * share;
        } else {
          float total = 0;
          for (int k = 0; k < factor; ++k) total += from[k];
          to[x] = total * share;
        }
      }
    }
  }
}

}  // namespace rgs::lod
#endif
