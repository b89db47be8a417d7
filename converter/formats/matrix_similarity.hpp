// matrix_similarity.hpp - transforms of glTF's nodes and OpenUSD's prims, which are matrices, as similarities.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <glm/mat4x4.hpp>
#include <glm/matrix.hpp>
#include <optional>

#include "rgs/splat_edit.hpp"

namespace rgs::detail {

/// As rotation, uniform scale and translation; nullopt if it is anything else, or not finite.
inline std::optional<Similarity> similarity_of(const glm::dmat4& m) {
  constexpr double kTolerance = 1e-4;  // files store rounded decimals
  const auto is_one = [](double x) { return std::abs(x - 1) <= kTolerance; };
  double length[3];
  for (int k = 0; k < 3; ++k) length[k] = std::hypot(m[k].x, m[k].y, m[k].z);
  if (!(length[0] > 0) || !is_one(length[1] / length[0]) || !is_one(length[2] / length[0])) return std::nullopt;
  const Similarity s{glm::dmat3(m) / length[0], length[0], glm::dvec3(m[3])};
  if (!is_one(glm::determinant(s.rotation)) || !std::isfinite(s.translation.x + s.translation.y + s.translation.z))
    return std::nullopt;
  return s;
}

}  // namespace rgs::detail
