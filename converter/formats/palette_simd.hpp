// palette_simd.hpp - the costly parts of fitting a palette, eight floats at a time.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace rgs::detail {

/// Rows of floats, padded with zeros to a multiple of eight.
struct Rows {
  std::size_t width = 0;
  std::vector<float> values;

  Rows() = default;
  Rows(std::size_t n, std::size_t width_) : width(width_), values(n * width_) {}
  std::size_t size() const { return values.size() / width; }
  float* operator[](std::size_t i) { return values.data() + i * width; }
  const float* operator[](std::size_t i) const { return values.data() + i * width; }
};

/// Sum of weight * row over `members`.
void add_rows(const Rows& rows, std::span<const float> weights, std::span<const std::uint32_t> members, float* sum);
/// Sum of weight * |row - centre|^2 by coordinate.
void add_squares(const Rows& rows, std::span<const float> weights, std::span<const std::uint32_t> members,
                 const float* centre, float* sum);
/// projected[i] = members[i]'s row times `direction`.
void project_rows(const Rows& rows, std::span<const std::uint32_t> members, const float* direction, float* projected);

/// Entries in groups that are searched together, and lie close to one another.
inline constexpr std::size_t kPanel = 16, kPanels = 4, kGroup = kPanel * kPanels;
struct EntryGroups {
  const Rows& values;               ///< [entry][width]
  std::vector<float> panels;        ///< the same, [group][kPanels][width][kPanel]
  std::vector<float> half_squares;  ///< [entry]; huge after the last
  std::size_t n_near = 0;           ///< at most kNear
  std::vector<std::uint32_t> near;  ///< [group][n_near], the group itself first

  std::span<const std::uint32_t> near_to(std::size_t group) const {
    return std::span(near).subspan(group * n_near, n_near);
  }
};

/// Labels `members`, whose entries now are in `group`, with their nearest in the groups near to it. Of equals always
/// the same.
void search_groups(const Rows& rows, std::span<const std::uint32_t> members, const EntryGroups& entries,
                   std::size_t group, std::span<std::uint32_t> labels);

}  // namespace rgs::detail
