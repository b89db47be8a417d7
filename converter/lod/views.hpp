// views.hpp - directions and frames of a group's pictures.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "gaussians.hpp"
#include "pictures.hpp"

namespace rgs::lod {

/// Direction i of n, evenly spread over the sphere (Fibonacci lattice), each with its own roll.
Axes3 direction(int i, int n);

/// Frame that holds the means of `gaussians` and a margin, with pixels of size `pixel`, at most `most` a side.
Frame frame_around(const Gaussians& gaussians, const Axes3& axes, float pixel, int most);
/// The same frame with pixels smaller by `factor`.
Frame finer(Frame frame, int factor);

/// Splits `items` in space until no piece is longer than `most` along an axis.
std::vector<std::vector<std::uint32_t>> cut_by_place(const Gaussians& gaussians, std::vector<std::uint32_t> items,
                                                     float most);

}  // namespace rgs::lod
