// views.hpp - from where a group is looked at.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "gaussians.hpp"
#include "pictures.hpp"

namespace rgs::lod {

/// Direction i of n that are spread evenly over the sphere (Fibonacci's lattice), with a roll of its own.
Axes3 direction(int i, int n);

/// Frame of pixels of that size that holds the means of `gaussians` and a margin, at most `most` pixels a side.
Frame frame_around(const Gaussians& gaussians, const Axes3& axes, float pixel, int most);
/// The same frame in pixels of 1 / factor of the size.
Frame finer(Frame frame, int factor);

/// Indices of Gaussians near each other: `items` cut by place until no piece is longer than `most` along an axis.
std::vector<std::vector<std::uint32_t>> cut_by_place(const Gaussians& gaussians, std::vector<std::uint32_t> items,
                                                     float most);

}  // namespace rgs::lod
