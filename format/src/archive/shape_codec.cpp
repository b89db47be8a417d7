// shape_codec.cpp - what the codes of a frame of Codec::archive imply, step by step.
// SPDX-License-Identifier: Apache-2.0
#include "archive/shape_codec.hpp"

#include "rgs/quantize.hpp"

namespace rgs::detail {

void ShapeCodes::resize(std::size_t rows, int page_level) {
  n = rows;
  level = page_level;
  points.resize(n);
  for (auto* plane : {&coarse, &fine, &turn}) plane->resize(3 * n);
  for (auto* plane : {&turn_step, &refinement_bits}) plane->resize(3 * n);
  opacity.resize(n);
  refinement.resize(3 * n);
  classes.resize(n);
  distance.resize(n);
  importance.resize(n);
  variance.resize(3 * n);
  quaternion.resize(4 * n);
  fine_step.resize(n);
}

void ShapeCodes::find_distances(const ArchiveParameters& p) {
  for (std::size_t i = 0; i < n; ++i) {
    double squared = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      const double x =
          p.half_width[k] * grid_place(grid_cell_of(points[i][k], p.mean_bits, p.mean_cells), p.mean_cells, 0.5);
      squared += x * x;
    }
    distance[i] = squared < p.shape.nearest ? p.shape.nearest : squared;
  }
}

// A level has a quarter of the Gaussians with four times the area, and is drawn where that area looks a quarter as
// large; another half octave, since they only approximate the scene.
std::int32_t ShapeCodes::importance_of(const ArchiveTables& t, std::size_t i, const std::int32_t blurred[3]) const {
  const std::int32_t opacity_octaves = octaves_of(static_cast<double>(float_from_half(t.opacity[opacity[i]])));
  return 2 * opacity_octaves + area_octaves(blurred) - level * (kOctave / 2 * 5);
}

void ShapeCodes::find_fine_steps(const ArchiveTables& t) {
  const ShapeParameters& s = t.parameters.shape;
  for (std::size_t i = 0; i < n; ++i) {
    std::int32_t h[3];
    for (std::size_t k = 0; k < 3; ++k) h[k] = blurred_octaves(blur(s), s.coarse_step, coarse[k * n + i], 0, 0);
    const std::int32_t seen = importance_of(t, i, h);
    fine_step[i] =
        static_cast<std::uint8_t>(step_index(s.fine_step - finer_by(s.slope, seen, s.middle), kMostStep) - kLeastStep);
  }
}

void ShapeCodes::find_turn_steps(const ArchiveTables& t) {
  const ShapeParameters& s = t.parameters.shape;
  const auto n_classes = static_cast<std::int32_t>(t.parameters.classes.size());
  const double blurred = power_of_octaves(2 * blur(s));
  for (std::size_t i = 0; i < n; ++i) {
    std::int32_t h[3];
    double v[3];
    const std::int32_t step = step_of(fine_step[i] + kLeastStep);
    for (std::size_t k = 0; k < 3; ++k) {
      h[k] = blurred_octaves(blur(s), s.coarse_step, coarse[k * n + i], step, fine[k * n + i]);
      v[k] = variance[k * n + i] = variance_of(h[k], blurred);
    }
    const std::int32_t seen = importance[i] = importance_of(t, i, h);
    const std::int32_t nearest_class = ((seen - s.middle + kOctave / 2) >> 16) + n_classes / 2;
    classes[i] = static_cast<std::uint8_t>(std::clamp(nearest_class, 0, n_classes - 1));
    const std::int32_t finer = finer_by(s.slope, seen, s.middle);
    for (std::size_t k = 0; k < 3; ++k) {
      const std::int32_t shows = octaves_of(turn_sensitivity(v[(k + 1) % 3], v[(k + 2) % 3], blurred));
      turn_step[k * n + i] =
          static_cast<std::uint8_t>(step_index(s.turn_step - finer - (shows >> 1), kMostTurn) - kLeastStep);
    }
  }
}

void ShapeCodes::find_refinement(const ArchiveParameters& p) {
  const ShapeParameters& s = p.shape;
  const double blurred = power_of_octaves(2 * blur(s));
  std::int32_t half_width[3];
  for (std::size_t k = 0; k < 3; ++k) half_width[k] = octaves_of(p.half_width[k]);
  for (std::size_t i = 0; i < n; ++i) {
    double q[4], v[3], precision[3], c[3];
    for (std::size_t k = 0; k < 3; ++k) {
      v[k] = variance[k * n + i];
      c[k] = turn[k * n + i] * (step_of(turn_step[k * n + i] + kLeastStep) * 0x1p-16);
    }
    quaternion_of(c[0], c[1], c[2], q);
    for (std::size_t k = 0; k < 4; ++k) quaternion[k * n + i] = q[k];
    world_precision(q, v, blurred, precision);
    const std::int32_t step = s.mean_step - finer_by(s.slope, importance[i], s.middle) + (octaves_of(distance[i]) >> 1);
    for (std::size_t k = 0; k < 3; ++k) {
      const std::int32_t octave = grid_cell_of(points[i][k], p.mean_bits, p.mean_cells).octave;
      const std::int32_t cell =
          half_width[k] + (std::max(octave - 1, 0) - static_cast<std::int32_t>(p.mean_cells)) * kOctave;
      refinement_bits[k * n + i] =
          static_cast<std::uint8_t>(rgs::detail::refinement_bits(cell, step - (octaves_of(precision[k]) >> 1)));
    }
  }
}

std::array<float, 3> ShapeCodes::mean(const ArchiveParameters& p, std::size_t i) const {
  std::array<float, 3> out;
  for (std::size_t k = 0; k < 3; ++k) {
    const double part = (refinement[k * n + i] + 0.5) * power_of_two(-std::int32_t{refinement_bits[k * n + i]});
    const GridCell cell = grid_cell_of(points[i][k], p.mean_bits, p.mean_cells);
    out[k] = limited_mean(p.centre[k] + p.half_width[k] * grid_place(cell, p.mean_cells, part));
  }
  return out;
}

void ShapeCodes::geometry_row(const ArchiveTables& t, int scale_exponent, std::size_t i, std::uint16_t row[8]) const {
  for (int k = 0; k < 4; ++k) {
    row[k] = geometry_half(k, static_cast<float>(quaternion[static_cast<std::size_t>(k) * n + i]));
  }
  const double unit = power_of_two(scale_exponent);
  for (int k = 0; k < 3; ++k) {
    const double variance_here = variance[static_cast<std::size_t>(k) * n + i] * distance[i];
    row[4 + k] = geometry_half(4 + k, static_cast<float>(std::sqrt(variance_here) * unit));
  }
  row[7] = t.opacity[opacity[i]];
}

}  // namespace rgs::detail
