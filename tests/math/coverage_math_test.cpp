// coverage_math_test.cpp - tile lists against brute force over pixels.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/math/coverage.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "random_views.hpp"
#include "rgs/math/blend.hpp"
#include "turbo/turbo_geometry.hpp"

namespace cuda = rgs::cuda;
using namespace rgs::math;
using namespace rgs::test;

namespace {

Footprint<float> random_footprint(Random& random, double largest) {
  const double major = random.log_uniform(0.1, largest), minor = random.log_uniform(0.01, major);
  const double angle = random.uniform(0, 3.2), c = std::cos(angle), s = std::sin(angle);
  const Cov2<double> cov{major * major * c * c + minor * minor * s * s, (major * major - minor * minor) * c * s,
                         major * major * s * s + minor * minor * c * c};
  return footprint(Cov2<float>{static_cast<float>(cov.xx), static_cast<float>(cov.xy), static_cast<float>(cov.yy)},
                   static_cast<float>(random.uniform(0.002, 1)), kLowPass, AntiAliasing::classic);
}

bool listed(const Ellipse<float>& e, int column, int row, TileGrid grid) {
  const auto rect = bounding_tiles(e, grid);
  if (column < rect.x0 || column >= rect.x1 || row < rect.y0 || row >= rect.y1) return false;
  const auto span = tiles_in_row(e, row, grid);
  return column >= span.first && column < span.last;
}

// Minimum of d^T conic d over a rectangle of pixel centres, in double: 0 at the mean, otherwise on the border.
double smallest_form(const Footprint<float>& f, const PixelPoint<float>& mean, int x, int y, int width, int height) {
  const double det = static_cast<double>(f.cov.xx) * f.cov.yy - static_cast<double>(f.cov.xy) * f.cov.xy;
  const double a = f.cov.yy / det, b = -f.cov.xy / det, c = f.cov.xx / det;
  const double x0 = x - static_cast<double>(mean.u), x1 = x0 + width - 1;
  const double y0 = y - static_cast<double>(mean.v), y1 = y0 + height - 1;
  if (x0 <= 0 && x1 >= 0 && y0 <= 0 && y1 >= 0) return 0;
  const auto form = [&](double dx, double dy) { return a * dx * dx + 2 * b * dx * dy + c * dy * dy; };
  double best = std::numeric_limits<double>::max();
  for (const double dx : {x0, x1}) best = std::min(best, form(dx, std::clamp(-b * dx / c, y0, y1)));
  for (const double dy : {y0, y1}) best = std::min(best, form(std::clamp(-b * dy / a, x0, x1), dy));
  return best;
}

// The same for a tile.
double smallest_form(const Footprint<float>& f, const PixelPoint<float>& mean, int column, int row) {
  return smallest_form(f, mean, column * kTileSize, row * kTileSize, kTileSize, kTileSize);
}

}  // namespace

TEST_CASE("every tile with a pixel that reaches 1/255 is listed") {
  Random random(7);
  const int width = 200, height = 150;
  const auto grid = tile_grid(width, height);
  int n_reached = 0;
  for (int i = 0; i < 3000; ++i) {
    const auto f = random_footprint(random, i % 10 == 0 ? 400 : 30);
    if (!f.valid) continue;
    const PixelPoint<float> mean{static_cast<float>(random.uniform(-60, 260)),
                                 static_cast<float>(random.uniform(-60, 210))};
    const auto e = ellipse(mean, f, power_cutoff(f.opacity));
    const float cutoff = power_cutoff(f.opacity);
    for (int row = 0; row < grid.rows; ++row) {
      for (int column = 0; column < grid.columns; ++column) {
        bool reached = false;
        for (int y = row * kTileSize; y < (row + 1) * kTileSize && !reached; ++y) {
          for (int x = column * kTileSize; x < (column + 1) * kTileSize && !reached; ++x) {
            const float p = power(f.conic, mean.u - static_cast<float>(x), mean.v - static_cast<float>(y));
            reached = alpha_direct<Exp::exact>(p, f.opacity, cutoff) > 0;
          }
        }
        n_reached += reached;
        if (reached) REQUIRE(listed(e, column, row, grid));
      }
    }
  }
  CHECK(n_reached > 5000);
}

TEST_CASE("the ellipse meets every listed tile, up to rounding") {
  Random random(8);
  const auto grid = tile_grid(400, 300);
  int n_listed = 0;
  for (int i = 0; i < 3000; ++i) {
    const auto f = random_footprint(random, 60);
    if (!f.valid) continue;
    const PixelPoint<float> mean{static_cast<float>(random.uniform(-60, 460)),
                                 static_cast<float>(random.uniform(-60, 360))};
    const auto e = ellipse(mean, f, power_cutoff(f.opacity));
    const double level = 2 * std::log(255.0 * f.opacity);
    for (int row = 0; row < grid.rows; ++row) {
      for (int column = 0; column < grid.columns; ++column) {
        if (!listed(e, column, row, grid)) continue;
        ++n_listed;
        // 2e-3 px of slack at a gradient of the form of at most 2 sqrt(level) / 0.55 per px.
        REQUIRE(smallest_form(f, mean, column, row) <= level + 0.05);
      }
    }
  }
  CHECK(n_listed > 10000);
}

TEST_CASE("the cells are those that the ellipse meets, up to rounding") {
  Random random(9);
  const auto grid = tile_grid<cuda::kTurboTile>(400, 160);
  int n_touched = 0, n_missed = 0, n_superfluous = 0;
  for (int i = 0; i < 8000; ++i) {
    const auto f = random_footprint(random, i % 10 == 0 ? 200 : 20);
    const PixelPoint<float> mean{static_cast<float>(random.uniform(-60, 460)),
                                 static_cast<float>(random.uniform(-60, 220))};
    const float cutoff = power_cutoff(f.opacity);
    const auto e = ellipse(mean, f, cutoff);
    // Single precision does not determine needles' conics well enough to predict the effect of rounding.
    if (!f.valid || !(e.level >= 0) || f.cov.xx * f.conic.a > 1000) continue;
    for (int row = 0; row < grid.rows; ++row) {
      const auto rows = cuda::cell_rows(e, row);
      for (int column = 0; column < grid.columns; ++column) {
        const std::uint32_t cells = cuda::cells_of_tile(rows, column);
        for (int bit = 0; bit < cuda::kTurboCells; ++bit) {
          const auto corner = cuda::cell_corner(grid, static_cast<std::uint32_t>(row * grid.columns + column),
                                                static_cast<std::uint32_t>(bit));
          const double form = smallest_form(f, mean, static_cast<int>(corner.x), static_cast<int>(corner.y),
                                            cuda::kTurboCellWidth, cuda::kTurboCellHeight);
          const bool touched = (cells >> bit & 1) != 0;
          n_touched += touched;
          n_missed += !touched && form <= -2 * static_cast<double>(cutoff);
          n_superfluous += touched && std::sqrt(form) > std::sqrt(static_cast<double>(e.level)) + 0.01;
        }
      }
    }
  }
  CHECK(n_touched > 10000);
  CHECK(n_missed == 0);
  CHECK(n_superfluous == 0);
}

TEST_CASE("a strip's cells are those of each of its tiles, wherever it starts") {
  Random random(10);
  for (int i = 0; i < 300; ++i) {
    const auto f = random_footprint(random, 100);
    const auto e = ellipse({static_cast<float>(random.uniform(0, 400)), static_cast<float>(random.uniform(0, 60))}, f,
                           power_cutoff(f.opacity));
    if (!f.valid || !(e.level >= 0)) continue;
    const auto rows = cuda::cell_rows(e, 1);
    for (int column = 0; column < 10; ++column) {
      for (int k = 0; k < cuda::kTurboStripTiles; ++k) {
        CHECK(cuda::cells_in_strip(cuda::cells_of_strip(rows, column), k) == cuda::cells_of_tile(rows, column + k));
      }
    }
  }
}

TEST_CASE("long needles whose conic cancels in single precision lose no tile") {
  Random random(9);
  const int width = 3840, height = 2160;
  const auto grid = tile_grid(width, height);
  for (int i = 0; i < 40; ++i) {
    const double major = random.uniform(200, 1500), angle = random.uniform(0.1, 1.4);
    const double c = std::cos(angle), s = std::sin(angle), v = major * major;
    const auto f = footprint(
        Cov2<float>{static_cast<float>(v * c * c), static_cast<float>(v * c * s), static_cast<float>(v * s * s)}, 1.0F,
        kLowPass, AntiAliasing::classic);
    if (!f.valid) continue;
    const PixelPoint<float> mean{static_cast<float>(random.uniform(0, width)),
                                 static_cast<float>(random.uniform(0, height))};
    const auto e = ellipse(mean, f, power_cutoff(f.opacity));
    const float cutoff = power_cutoff(f.opacity);
    for (int y = 0; y < height; ++y) {
      // Only pixels near the axis; the others are far below the threshold.
      const double axis = mean.u + (y - static_cast<double>(mean.v)) * c / s;
      for (int x = static_cast<int>(std::clamp(axis - 8, 0.0, width - 1.0));
           x < std::min(width, static_cast<int>(std::max(axis + 8, 0.0))); ++x) {
        const float p = power(f.conic, mean.u - static_cast<float>(x), mean.v - static_cast<float>(y));
        if (alpha_direct<Exp::exact>(p, f.opacity, cutoff) > 0) REQUIRE(listed(e, x / kTileSize, y / kTileSize, grid));
      }
    }
  }
}

TEST_CASE("the square extent rounds like the original") {
  Random random(10);
  const TileGrid grid{40, 30};
  for (int i = 0; i < 5000; ++i) {
    const auto f = random_footprint(random, 100);
    const PixelPoint<float> mean{static_cast<float>(random.uniform(-300, 900)),
                                 static_cast<float>(random.uniform(-300, 700))};
    const double mid = 0.5 * (static_cast<double>(f.cov.xx) + f.cov.yy);
    const double det = static_cast<double>(f.cov.xx) * f.cov.yy - static_cast<double>(f.cov.xy) * f.cov.xy;
    const double reach = 3 * std::sqrt(mid + std::sqrt(std::max(0.1, mid * mid - det)));
    if (std::abs(reach - std::round(reach)) < 1e-3) continue;  // rounding may go either way
    const float radius = static_cast<float>(std::ceil(reach));
    const auto rect = square_extent(mean, f.cov, grid);
    CHECK(rect.x0 == std::clamp(static_cast<int>((mean.u - radius) / 16), 0, 40));
    CHECK(rect.y0 == std::clamp(static_cast<int>((mean.v - radius) / 16), 0, 30));
    CHECK(rect.x1 == std::clamp(static_cast<int>((mean.u + radius + 15) / 16), 0, 40));
    CHECK(rect.y1 == std::clamp(static_cast<int>((mean.v + radius + 15) / 16), 0, 30));
  }
}

TEST_CASE("extents of extreme Gaussians are defined") {
  const TileGrid grid{480, 270};
  const auto huge = footprint(Cov2<float>{1e15F, 0, 1e15F}, 1.0F, kLowPass, AntiAliasing::classic);
  REQUIRE(huge.valid);
  const auto all = square_extent(PixelPoint<float>{3000, -1e9F}, huge.cov, grid);
  CHECK((all.x1 == 480 && all.x0 == 0));
  const auto e = ellipse(PixelPoint<float>{-1e5F, 1e5F}, huge, power_cutoff(huge.opacity));
  const auto rect = bounding_tiles(e, grid);
  CHECK((rect.x0 == 0 && rect.y0 == 0 && rect.x1 == 480 && rect.y1 == 270));
  CHECK(tiles_in_row(e, 100, grid).last == 480);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  CHECK(square_extent(PixelPoint<float>{nan, nan}, huge.cov, grid).empty());
  CHECK(bounding_tiles(ellipse(PixelPoint<float>{nan, nan}, huge, power_cutoff(huge.opacity)), grid).empty());
  auto dim = huge;
  dim.opacity = 1.0F / 256;
  CHECK(bounding_tiles(ellipse(PixelPoint<float>{0, 0}, dim, power_cutoff(dim.opacity)), grid).empty());
  dim.opacity = 0;
  CHECK(bounding_tiles(ellipse(PixelPoint<float>{0, 0}, dim, power_cutoff(dim.opacity)), grid).empty());
}
