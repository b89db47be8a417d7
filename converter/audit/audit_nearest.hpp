// audit_nearest.hpp - takes the nearest of many points, each once.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

namespace rgs::audit {

using Point = std::array<float, 3>;

/// Points in a k-d tree (Bentley 1975). 21 bytes a point.
class NearestPoints {
 public:
  /// Finite points, fewer than 2^32.
  explicit NearestPoints(const std::vector<Point>& points);
  /// Index of the nearest point within `radius` of `p` that was not taken yet; takes it.
  std::optional<std::uint32_t> take(const Point& p, float radius);

 private:
  struct Node {  // of rows [begin, end): the point in their middle, which divides the others along `axis`
    Point point;
    std::uint32_t index = 0, n_left = 0;  // n_left: rows of [begin, end) that are not taken
  };
  void build(std::size_t begin, std::size_t end);
  void search(std::size_t begin, std::size_t end, const Point& p);

  std::vector<Node> rows_;
  std::vector<std::uint8_t> axis_, taken_;  // [n], one byte each
  float best_ = 0;                          // squared distance of the nearest so far
  std::optional<std::size_t> found_;
};

}  // namespace rgs::audit
