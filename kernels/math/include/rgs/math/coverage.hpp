// coverage.hpp - which tiles list a Gaussian.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>
#include <type_traits>

#include "rgs/hd.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/math/covariance.hpp"
#include "rgs/math/options.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

/// Tiles of an image. `Size` below is the side of a square tile; the definition's is kTileSize.
struct TileGrid {
  int columns, rows;
};

template <int Size = kTileSize>
RGS_HD constexpr TileGrid tile_grid(int width, int height) {
  return {(width + Size - 1) / Size, (height + Size - 1) / Size};
}

/// Tiles x0 <= x < x1, y0 <= y < y1.
struct TileRect {
  int x0, y0, x1, y1;
  RGS_HD constexpr bool empty() const { return x0 >= x1 || y0 >= y1; }
};

/// Tiles first <= x < last of one tile row.
struct TileSpan {
  int first, last;
};

namespace detail {

// Truncates a tile coordinate to 0..limit. Clamps first, because converting a huge or NaN float is undefined.
template <class T>
RGS_HD inline int tile_index(T t, int limit) {
  return static_cast<int>(clamp(t, T(0), static_cast<T>(limit)));
}

// Square root of max(x, 2^-100) for finite x. With that limit the device needs no branch for other numbers, and the
// estimate with one Newton step rounds correctly, as the compiler's sqrt() does.
template <class T>
RGS_HD inline T root(T x) {
  x = max(x, T(0x1p-100));
#if defined(__CUDA_ARCH__)
  if constexpr (std::is_same_v<T, float>) {
    float inverse;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(x));
    const float estimate = __fmul_rn(x, inverse);
    return __fmaf_rn(__fmaf_rn(-estimate, estimate, x), __fmul_rn(0.5F, inverse), estimate);
  }
#endif
  return std::sqrt(x);
}

// Floor and ceiling of 0 <= x < 2^22. The sum's last bit is 1, and its rounding mode is chosen: on the device one
// addition instead of a conversion, at a quarter of its rate, and corrections.
template <class T>
RGS_HD inline int floor_index(T x) {
#if defined(__CUDA_ARCH__)
  if constexpr (std::is_same_v<T, float>) return __float_as_int(__fadd_rd(x, 8388608.0F)) - 0x4B000000;
#endif
  return static_cast<int>(x);
}
template <class T>
RGS_HD inline int ceil_index(T x) {
#if defined(__CUDA_ARCH__)
  if constexpr (std::is_same_v<T, float>) return __float_as_int(__fadd_ru(x, 8388608.0F)) - 0x4B000000;
#endif
  const int floor = static_cast<int>(x);
  return floor + (x > static_cast<T>(floor) ? 1 : 0);
}

// Tiles with a pixel centre in [low, high] along one axis; tile t has the centres Size t .. Size t + Size - 1.
template <int Size, class T>
RGS_HD inline TileSpan tiles_between(T low, T high, int limit) {
  const T inverse_tile = T(1) / T(Size), end = static_cast<T>(limit);
  const T last = high * inverse_tile;
  return {ceil_index(clamp((low - T(Size - 1)) * inverse_tile, T(0), end)),
          last < T(0) ? 0 : floor_index(clamp(last + T(1), T(0), end))};
}

}  // namespace detail

/// The original extent: tiles touched by the square of half side ceil(3 sigma_max) around the mean. Rounded exactly as
/// in the original, whose square reaches a pixel further right and down.
template <class T>
RGS_HD inline TileRect square_extent(const PixelPoint<T>& mean, const Cov2<T>& cov, TileGrid grid) {
  const T mid = T(0.5) * (cov.xx + cov.yy);
  const T lambda_max = mid + std::sqrt(max(T(kEigenFloor), mid * mid - determinant(cov)));
  const T radius = std::ceil(T(kSquareSigmas) * std::sqrt(lambda_max));
  const T tile = T(kTileSize);
  return {detail::tile_index((mean.u - radius) / tile, grid.columns),
          detail::tile_index((mean.v - radius) / tile, grid.rows),
          detail::tile_index((mean.u + radius + tile - T(1)) / tile, grid.columns),
          detail::tile_index((mean.v + radius + tile - T(1)) / tile, grid.rows)};
}

/// Smallest exponent that counts: -ln(255 opacity).
template <class T>
RGS_HD inline T power_cutoff(T opacity) {
  return -std::log(opacity / T(kAlphaMin));
}

/// The region in which a Gaussian reaches alpha >= 1/255, an ellipse around its mean.
template <class T>
struct Ellipse {
  PixelPoint<T> mean;
  T level;         ///< the ellipse is d^T cov^-1 d <= level; negative: no pixel reaches 1/255
  T half_width;    ///< sqrt(level cov.xx), px
  T half_height;   ///< sqrt(level cov.yy), px
  T slope;         ///< cov.xy / cov.yy: x of the chord's middle per y
  T shear;         ///< y at which x is largest, relative to the mean
  T variance_x_y;  ///< det / cov.yy, the variance of x at a given y
  T inverse_yy;    ///< 1 / cov.yy
};

/// o exp(-q/2) >= 1/255 where q <= 2 ln(255 o) (Hanson et al. 2025, "Speedy-Splat", eq. 12); Gaussians with opacity
/// under 1/255 vanish. `cutoff` is power_cutoff(f.opacity), -ln(255 o). The level is raised by the largest rounding
/// error of q in a pixel: its terms a dx^2 and c dy^2 reach level / (1 - rho^2) and cancel. So tiles are never missed,
/// and rarely listed needlessly.
template <class T>
RGS_HD inline Ellipse<T> ellipse(const PixelPoint<T>& mean, const Footprint<T>& f, T cutoff) {
  Ellipse<T> e{mean, T(-1), 0, 0, 0, 0, 0, 0};
  if (!(cutoff <= T(0))) return e;
  const T rounding = T(8) * T(6e-8) * (f.cov.xx * f.conic.a);
  e.level = T(-2) * cutoff * (T(1) + rounding) + T(1e-4);
  e.half_width = std::sqrt(e.level * f.cov.xx);
  e.half_height = std::sqrt(e.level * f.cov.yy);
  e.inverse_yy = T(1) / f.cov.yy;
  e.slope = f.cov.xy * e.inverse_yy;
  e.shear = f.cov.xy * e.half_width / f.cov.xx;
  e.variance_x_y = determinant(f.cov) * e.inverse_yy;
  return e;
}

/// Tile rows, and a bound on the columns, that the ellipse touches: SnugBox.
template <int Size = kTileSize, class T>
RGS_HD inline TileRect bounding_tiles(const Ellipse<T>& e, TileGrid grid) {
  if (!(e.level >= T(0))) return {0, 0, 0, 0};
  const TileSpan x = detail::tiles_between<Size>(e.mean.u - e.half_width, e.mean.u + e.half_width, grid.columns);
  const TileSpan y = detail::tiles_between<Size>(e.mean.v - e.half_height, e.mean.v + e.half_height, grid.rows);
  return {x.first, y.first, x.last, y.last};
}

/// Range of x of the ellipse within y_low <= y <= y_high (px), all relative to the mean. The range must touch the
/// ellipse.
template <class T>
struct Chord {
  T low, high;
};
template <class T>
RGS_HD inline Chord<T> chord(const Ellipse<T>& e, T y_low, T y_high) {
  // The right boundary x(y) = slope y + sqrt((level - y^2 / cov.yy) variance_x_y) is concave with its top at `shear`,
  // so its maximum over a range is at the clamped top; the left boundary is its point reflection.
  const T y_right = clamp(e.shear, y_low, y_high), y_left = clamp(-e.shear, y_low, y_high);
  const T right = e.level - y_right * y_right * e.inverse_yy, left = e.level - y_left * y_left * e.inverse_yy;
  return {e.slope * y_left - detail::root(left * e.variance_x_y),
          e.slope * y_right + detail::root(right * e.variance_x_y)};
}

/// Tiles of row `row` (one of bounding_tiles()) with a point of the ellipse between their outermost pixel centres.
/// Exact: ellipse and row are convex, so every tile in their intersection's x range meets it (AccuTile, Hanson et al.
/// 2025, in one chord a row).
template <int Size = kTileSize, class T>
RGS_HD inline TileSpan tiles_in_row(const Ellipse<T>& e, int row, TileGrid grid) {
  const T y = static_cast<T>(row * Size) - e.mean.v;
  const T y_low = max(y, -e.half_height), y_high = min(y + T(Size - 1), e.half_height);
  const Chord<T> c = chord(e, y_low, y_high);
  const T slack = T(1e-3) + T(1e-6) * e.half_width;  // for rounding of the chord's ends, px
  return detail::tiles_between<Size>(e.mean.u + c.low - slack, e.mean.u + c.high + slack, grid.columns);
}

}  // namespace rgs::math
