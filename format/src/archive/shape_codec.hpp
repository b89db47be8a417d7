// shape_codec.hpp - means, scales, rotations and opacities of Codec::archive: what each code means follows from those
// before it, which both encoder and decoder know; docs/format/ARCHIVE.md "Codec 3".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "archive/archive_tables.hpp"
#include "archive/point_codec.hpp"
#include "rgs/shape_formulas.hpp"

namespace rgs::detail {

/// Codes of a frame's Gaussians in their order, and what they imply.
struct ShapeCodes {
  std::size_t n = 0;
  int level = 0;                              ///< of the page, which is drawn from so many times twice as far away
  std::vector<GridPoint> points;              ///< [n] cells of means
  std::vector<std::uint16_t> opacity;         ///< [n]
  std::vector<std::int16_t> coarse, fine;     ///< [3, n] of scales
  std::vector<std::int16_t> turn;             ///< [3, n] of rotations
  std::vector<std::uint16_t> refinement;      ///< [3, n] parts of cells
  std::vector<std::uint8_t> classes;          ///< [n]
  std::vector<std::int32_t> opacity_octaves;  ///< [n]
  std::vector<double> distance;               ///< [n] squared
  std::vector<std::int32_t> importance;       ///< [n]
  std::vector<double> variance, quaternion;   ///< [3, n] in squared distances, [4, n]
  std::vector<std::uint8_t> fine_step, turn_step, refinement_bits;  ///< [n], [3, n], [3, n]

  void resize(std::size_t rows, int page_level);
  /// Each after the codes that it needs: points; opacity and coarse; fine; turn.
  void find_distances(const ArchiveParameters& p);
  void find_fine_steps(const ArchiveTables& t);
  void find_turn_steps(const ArchiveTables& t);
  void find_refinement(const ArchiveParameters& p);
  /// Rows [n, 3] of MEAN and [n, 8] of GEOM.
  void write_rows(const ArchiveTables& t, int scale_exponent, float* means, std::uint16_t* geometry) const;
  /// Logarithm of what a pixel blurs, in distances.
  std::int32_t blur(const ShapeParameters& s) const { return s.blur + level * kOctave; }
  float scale(std::size_t axis, std::size_t i) const {
    return static_cast<float>(std::sqrt(variance[axis * n + i] * distance[i]));
  }
};

/// Codes points [n], at least one, sorted by tree_less() where they are written, as the counts of a tree of halved cells: of each
/// cell of several points how many lie in its lower half, by half of all first; then the lower bits of those that were
/// alone. `bits`: of each axis. False if a count is impossible.
class PointTree {
 public:
  template <class Coder>
  bool walk(std::vector<GridPoint>& points, const std::array<std::uint8_t, 3>& bits, Coder& coder) {
    const auto n = static_cast<std::uint32_t>(points.size());
    cells_.assign(1, {0, n, {}});
    left_.assign(3 * std::size_t{n}, 0);
    settle<Coder>(points, bits);
    std::array<std::uint8_t, 3> left = bits;
    for (std::uint32_t bit = std::max({bits[0], bits[1], bits[2]}); bit-- > 0;) {
      for (std::size_t axis = 0; axis < 3; ++axis) {
        if (bit >= bits[axis]) continue;
        --left[axis];
        if (!halve(points, axis, bit, coder)) return false;
        settle<Coder>(points, left);
      }
    }
    if constexpr (Coder::kReads) {
      for (const Cell& cell : cells_) std::fill_n(&points[cell.first], cell.n, cell.corner);
    }
    for (std::size_t axis = 0; axis < 3; ++axis) lower_bits(points, axis, coder);
    return true;
  }

 private:
  struct Cell {
    std::uint32_t first, n;
    GridPoint corner;
  };

  // Takes cells of one point off.
  template <class Coder>
  void settle(std::vector<GridPoint>& points, const std::array<std::uint8_t, 3>& left) {
    std::erase_if(cells_, [&](const Cell& cell) {
      if (cell.n > 1) return false;
      if constexpr (Coder::kReads) points[cell.first] = cell.corner;
      for (std::size_t axis = 0; axis < 3; ++axis) left_[axis * points.size() + cell.first] = left[axis];
      return true;
    });
  }

  template <class Coder>
  bool halve(std::vector<GridPoint>& points, std::size_t axis, std::uint32_t bit, Coder& coder) {
    numbers_.resize(cells_.size());
    if constexpr (!Coder::kReads) {
      for (std::size_t i = 0; i < cells_.size(); ++i) {
        const auto first = points.begin() + cells_[i].first, last = first + cells_[i].n;
        const auto low =
            std::partition_point(first, last, [&](const GridPoint& p) { return (p[axis] >> bit & 1u) == 0; }) - first;
        numbers_[i] = static_cast<std::uint16_t>(
            fold_code(static_cast<std::int16_t>(low - static_cast<std::ptrdiff_t>(cells_[i].n / 2))));
      }
    }
    coder.plane(cells_.size(), numbers_.data(), 0xFFFF, [this](std::size_t i) { return tree_context(cells_[i].n); });
    halves_.clear();
    for (std::size_t i = 0; i < cells_.size(); ++i) {
      const Cell& cell = cells_[i];
      const std::uint32_t low = cell.n / 2 + static_cast<std::uint32_t>(std::int32_t{unfold_code(numbers_[i])});
      if (low > cell.n) return false;
      if (low > 0) halves_.push_back({cell.first, low, cell.corner});
      if (low < cell.n) {
        halves_.push_back({cell.first + low, cell.n - low, cell.corner});
        halves_.back().corner[axis] += 1u << bit;
      }
    }
    cells_.swap(halves_);
    return true;
  }

  // The bits below those of the cell in which a point was alone, highest first.
  template <class Coder>
  void lower_bits(std::vector<GridPoint>& points, std::size_t axis, Coder& coder) {
    const std::size_t n = points.size();
    std::uint8_t* const left = &left_[axis * n];
    numbers_.resize(n);
    widths_.resize(n);
    for (bool more = true; more;) {
      more = false;
      for (std::size_t i = 0; i < n; ++i) {
        widths_[i] = std::min(left[i], kMostRawBits);
        left[i] = static_cast<std::uint8_t>(left[i] - widths_[i]);
        more |= left[i] > 0;
        if constexpr (!Coder::kReads) {
          numbers_[i] = static_cast<std::uint16_t>(points[i][axis] >> left[i] & ((1u << widths_[i]) - 1));
        }
      }
      coder.bits(n, numbers_.data(), widths_.data());
      if constexpr (Coder::kReads) {
        for (std::size_t i = 0; i < n; ++i) points[i][axis] += std::uint32_t{numbers_[i]} << left[i];
      }
    }
  }

  std::vector<Cell> cells_, halves_;
  std::vector<std::uint16_t> numbers_;
  std::vector<std::uint8_t> left_, widths_;
};

/// The tree's order: by the highest bit in which two points differ on any axis; x before y before z.
inline bool tree_less(const GridPoint& a, const GridPoint& b) {
  std::size_t axis = 0;
  for (std::size_t k = 1; k < 3; ++k) {
    if (std::bit_width(a[k] ^ b[k]) > std::bit_width(a[axis] ^ b[axis])) axis = k;
  }
  return a[axis] < b[axis];
}

/// Passes every plane of GEOM with its contexts to the coder, in stream order; points and distances are known.
template <class Coder>
void walk_shapes(ShapeCodes& f, const ArchiveTables& t, Coder& coder) {
  const std::size_t n = f.n;
  const std::uint32_t levels = t.parameters.opacity_levels;
  const ArchiveContexts at = t.contexts();
  const auto seen = [&](std::size_t i) { return std::size_t{f.opacity[i]} * 16 / (levels + 1); };
  const auto bucket = [](std::int16_t code) { return static_cast<std::size_t>(std::clamp<int>(code, 0, 15)); };
  coder.plane(n, f.opacity.data(), levels, [&](std::size_t) { return at.opacity; });
  std::int16_t *c0 = f.coarse.data(), *c1 = c0 + n, *c2 = c1 + n;
  coder.plane(n, c0, 0, [&](std::size_t i) { return at.coarse + seen(i); });
  coder.plane(n, c1, 0, [&](std::size_t i) { return at.coarse + 16 + seen(i) * 16 + bucket(c0[i]); });
  coder.plane(n, c2, 0,
              [&](std::size_t i) { return at.coarse + 272 + (seen(i) * 16 + bucket(c0[i])) * 16 + bucket(c1[i]); });
  f.find_fine_steps(t);
  for (std::size_t k = 0; k < 3; ++k) {
    coder.plane(n, &f.fine[k * n], 0, [&](std::size_t i) { return at.fine + k * kStepContexts + f.fine_step[i]; });
  }
  f.find_turn_steps(t);
  for (std::size_t k = 0; k < 3; ++k) {
    coder.plane(n, &f.turn[k * n], 0,
                [&](std::size_t i) { return at.turn + k * kStepContexts + f.turn_step[k * n + i]; });
  }
  f.find_refinement(t.parameters);
  for (std::size_t k = 0; k < 3; ++k) coder.bits(n, &f.refinement[k * n], &f.refinement_bits[k * n]);
}

}  // namespace rgs::detail
