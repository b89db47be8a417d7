// shape_kernels.cpp - what the codes of a frame of Codec::archive imply, step by step; compiled for each instruction set
// and dispatched at run time.
// SPDX-License-Identifier: Apache-2.0
//
// The compiler vectorises formulas for single numbers: operations are rounded one by one, so every instruction set
// gives the same bits.

// As in codec_kernels.cpp.
#define HWY_DISABLED_TARGETS (HWY_SSE4 | HWY_SVE | HWY_SVE2 | HWY_SVE_256 | HWY_SVE2_128 | HWY_RVV)
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "archive/shape_kernels.cpp"  // NOLINT
#include <hwy/foreach_target.h>
//
#include <hwy/highway.h>

#include <algorithm>
#include <cstring>

#include "archive/shape_codec.hpp"
#include "rgs/layout.hpp"
#include "rgs/quantize.hpp"

HWY_BEFORE_NAMESPACE();
namespace rgs::detail {
namespace HWY_NAMESPACE {

void find_distances(const ArchiveParameters& p, ShapeCodes& f) {
  double* __restrict distance = f.distance.data();
  const GridPoint* points = f.points.data();
  for (std::size_t i = 0; i < f.n; ++i) {
    double squared = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      const double x =
          p.half_width[k] * grid_place(grid_cell_of(points[i][k], p.mean_bits, p.mean_cells), p.mean_cells, 0.5);
      squared += x * x;
    }
    distance[i] = squared < p.shape.nearest ? p.shape.nearest : squared;
  }
}

void find_fine_steps(const ArchiveTables& t, ShapeCodes& f) {
  const ShapeParameters s = t.parameters.shape;
  const std::size_t n = f.n;
  const std::int32_t blur = f.blur(s), level = f.level;
  const std::int16_t* coarse = f.coarse.data();
  const std::int32_t* opacity = f.opacity_octaves.data();
  std::uint8_t* __restrict step = f.fine_step.data();
  for (std::size_t i = 0; i < n; ++i) {
    const std::int32_t h[3] = {blurred_octaves(blur, s.coarse_step, coarse[i], 0, 0),
                               blurred_octaves(blur, s.coarse_step, coarse[n + i], 0, 0),
                               blurred_octaves(blur, s.coarse_step, coarse[2 * n + i], 0, 0)};
    const std::int32_t finer = finer_by(s.slope, importance_of(opacity[i], h, level), s.middle);
    step[i] = static_cast<std::uint8_t>(step_index(s.fine_step - finer, kMostStep) - kLeastStep);
  }
}

// Blocks of rows pass through arrays that alias nothing, in loops that the compiler vectorises.
constexpr std::size_t kRows = 64;

void find_turn_steps(const ArchiveTables& t, ShapeCodes& f) {
  const ShapeParameters s = t.parameters.shape;
  const auto n_classes = static_cast<std::int32_t>(t.parameters.classes.size());
  const std::size_t n = f.n;
  const std::int32_t blur = f.blur(s), level = f.level;
  const double blurred = power_of_octaves(2 * blur);
  alignas(64) std::int32_t step[kRows], h[3][kRows], seen[kRows], shows[3][kRows];
  alignas(64) double v[3][kRows];
  alignas(64) std::uint8_t byte[kRows];
  for (std::size_t first = 0; first < n; first += kRows) {
    const std::size_t count = std::min(kRows, n - first);
    for (std::size_t i = 0; i < count; ++i) step[i] = step_of(f.fine_step[first + i] + kLeastStep);
    for (std::size_t k = 0; k < 3; ++k) {
      const std::int16_t *coarse = &f.coarse[k * n + first], *fine = &f.fine[k * n + first];
      for (std::size_t i = 0; i < count; ++i) {
        h[k][i] = blurred_octaves(blur, s.coarse_step, coarse[i], step[i], fine[i]);
      }
      for (std::size_t i = 0; i < count; ++i) v[k][i] = variance_of(h[k][i], blurred);
      std::copy_n(v[k], count, &f.variance[k * n + first]);
    }
    const std::int32_t* opacity = &f.opacity_octaves[first];
    for (std::size_t i = 0; i < count; ++i) {
      const std::int32_t of[3] = {h[0][i], h[1][i], h[2][i]};
      seen[i] = importance_of(opacity[i], of, level);
    }
    std::copy_n(seen, count, &f.importance[first]);
    for (std::size_t i = 0; i < count; ++i) {
      const std::int32_t nearest = ((seen[i] - s.middle + kOctave / 2) >> 16) + n_classes / 2;
      byte[i] = static_cast<std::uint8_t>(std::clamp(nearest, 0, n_classes - 1));
    }
    std::copy_n(byte, count, &f.classes[first]);
    for (std::size_t k = 0; k < 3; ++k) {
      const double *a = v[(k + 1) % 3], *b = v[(k + 2) % 3];
      for (std::size_t i = 0; i < count; ++i) shows[k][i] = turn_octaves(a[i], b[i], blurred);
      for (std::size_t i = 0; i < count; ++i) {
        const std::int32_t octaves = s.turn_step - finer_by(s.slope, seen[i], s.middle) - (shows[k][i] >> 1);
        byte[i] = static_cast<std::uint8_t>(step_index(octaves, kMostTurn) - kLeastStep);
      }
      std::copy_n(byte, count, &f.turn_step[k * n + first]);
    }
  }
}

void find_refinement(const ArchiveParameters& p, ShapeCodes& f) {
  const ShapeParameters s = p.shape;
  const std::size_t n = f.n;
  const double blurred = power_of_octaves(2 * f.blur(s));
  alignas(64) double q[4][kRows], v[3][kRows], precision[3][kRows];
  alignas(64) std::int32_t step[kRows];
  alignas(64) std::uint8_t byte[kRows];
  for (std::size_t first = 0; first < n; first += kRows) {
    const std::size_t count = std::min(kRows, n - first);
    for (std::size_t k = 0; k < 3; ++k) {
      const std::int16_t* turn = &f.turn[k * n + first];
      const std::uint8_t* turn_step = &f.turn_step[k * n + first];
      for (std::size_t i = 0; i < count; ++i) q[1 + k][i] = turn[i] * (step_of(turn_step[i] + kLeastStep) * 0x1p-16);
      std::copy_n(&f.variance[k * n + first], count, v[k]);
    }
    for (std::size_t i = 0; i < count; ++i) {
      double unit[4], out[3];
      const double of[3] = {v[0][i], v[1][i], v[2][i]};
      quaternion_of(q[1][i], q[2][i], q[3][i], unit);
      for (std::size_t k = 0; k < 4; ++k) q[k][i] = unit[k];
      world_precision(unit, of, blurred, out);
      for (std::size_t k = 0; k < 3; ++k) precision[k][i] = out[k];
    }
    for (std::size_t k = 0; k < 4; ++k) std::copy_n(q[k], count, &f.quaternion[k * n + first]);
    const double* distance = &f.distance[first];
    const std::int32_t* seen = &f.importance[first];
    for (std::size_t i = 0; i < count; ++i) {
      step[i] = s.mean_step - finer_by(s.slope, seen[i], s.middle) + (octaves_of(distance[i]) >> 1);
    }
    const GridPoint* points = &f.points[first];
    for (std::size_t k = 0; k < 3; ++k) {
      const std::int32_t cell_of = octaves_of(p.half_width[k]) - static_cast<std::int32_t>(p.mean_cells) * kOctave;
      for (std::size_t i = 0; i < count; ++i) {
        const std::int32_t octave = grid_cell_of(points[i][k], p.mean_bits, p.mean_cells).octave;
        const std::int32_t cell = cell_of + (octave > 1 ? octave - 1 : 0) * kOctave;
        byte[i] = static_cast<std::uint8_t>(refinement_bits(cell, step[i] - (octaves_of(precision[k][i]) >> 1)));
      }
      std::copy_n(byte, count, &f.refinement_bits[k * n + first]);
    }
  }
}

void write_rows(const ArchiveTables& t, const ShapeCodes& f, int scale_exponent, float* means,
                std::uint16_t* geometry) {
  const ArchiveParameters& p = t.parameters;
  const std::size_t n = f.n;
  const double unit = power_of_two(scale_exponent);
  alignas(64) float value[7][kRows];
  alignas(64) std::uint16_t half[8][kRows];
  for (std::size_t first = 0; first < n; first += kRows) {
    const std::size_t count = std::min(kRows, n - first);
    for (std::size_t k = 0; k < 3; ++k) {
      const std::uint8_t* bits = &f.refinement_bits[k * n + first];
      const std::uint16_t* parts = &f.refinement[k * n + first];
      const GridPoint* points = &f.points[first];
      for (std::size_t i = 0; i < count; ++i) {
        const double part = (parts[i] + 0.5) * power_of_two(-std::int32_t{bits[i]});
        const GridCell cell = grid_cell_of(points[i][k], p.mean_bits, p.mean_cells);
        value[k][i] = limited_mean(p.centre[k] + p.half_width[k] * grid_place(cell, p.mean_cells, part));
      }
    }
    for (std::size_t i = 0; i < count; ++i) {
      for (std::size_t k = 0; k < 3; ++k) means[3 * (first + i) + k] = value[k][i];
    }
    for (std::size_t k = 0; k < 4; ++k) {
      const double* quaternion = &f.quaternion[k * n + first];
      for (std::size_t i = 0; i < count; ++i) value[k][i] = static_cast<float>(quaternion[i]);
    }
    for (std::size_t k = 0; k < 3; ++k) {
      const double *variance = &f.variance[k * n + first], *distance = &f.distance[first];
      for (std::size_t i = 0; i < count; ++i) {
        value[4 + k][i] = static_cast<float>(std::sqrt(variance[i] * distance[i]) * unit);
      }
    }
    for (int k = 0; k < 7; ++k) {
      for (std::size_t i = 0; i < count; ++i) half[k][i] = geometry_half(k, value[k][i]);
    }
    for (std::size_t i = 0; i < count; ++i) half[7][i] = t.opacity[f.opacity[first + i]];
    for (std::size_t i = 0; i < count; ++i) {
      for (std::size_t k = 0; k < 8; ++k) geometry[8 * (first + i) + k] = half[k][i];
    }
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::detail
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::detail {
HWY_EXPORT(find_distances);
HWY_EXPORT(find_fine_steps);
HWY_EXPORT(find_turn_steps);
HWY_EXPORT(find_refinement);
HWY_EXPORT(write_rows);

void ShapeCodes::resize(std::size_t rows, int page_level) {
  n = rows;
  level = page_level;
  points.resize(n);
  for (auto* plane : {&coarse, &fine, &turn}) plane->resize(3 * n);
  for (auto* plane : {&turn_step, &refinement_bits}) plane->resize(3 * n);
  opacity.resize(n);
  opacity_octaves.resize(n);
  refinement.resize(3 * n);
  classes.resize(n);
  distance.resize(n);
  importance.resize(n);
  variance.resize(3 * n);
  quaternion.resize(4 * n);
  fine_step.resize(n);
}

void ShapeCodes::find_distances(const ArchiveParameters& p) {
  HWY_DYNAMIC_DISPATCH(find_distances)(p, *this);
}

void ShapeCodes::find_fine_steps(const ArchiveTables& t) {
  for (std::size_t i = 0; i < n; ++i) {
    opacity_octaves[i] = octaves_of(static_cast<double>(float_from_half(t.opacity[opacity[i]])));
  }
  HWY_DYNAMIC_DISPATCH(find_fine_steps)(t, *this);
}

void ShapeCodes::find_turn_steps(const ArchiveTables& t) {
  HWY_DYNAMIC_DISPATCH(find_turn_steps)(t, *this);
}

void ShapeCodes::find_refinement(const ArchiveParameters& p) {
  HWY_DYNAMIC_DISPATCH(find_refinement)(p, *this);
}

void ShapeCodes::write_rows(const ArchiveTables& t, int scale_exponent, float* means, std::uint16_t* geometry) const {
  HWY_DYNAMIC_DISPATCH(write_rows)(t, *this, scale_exponent, means, geometry);
}

}  // namespace rgs::detail
#endif  // HWY_ONCE
