// audit_nearest.cpp - a balanced k-d tree in one array, with counts of what is left.
// SPDX-License-Identifier: Apache-2.0
#include "audit_nearest.hpp"

#include <tbb/parallel_invoke.h>

#include <algorithm>

namespace rgs::audit {
namespace {

constexpr std::size_t kSerial = 10'000;  // rows that are not worth another task

}  // namespace

NearestPoints::NearestPoints(const std::vector<Point>& points)
    : rows_(points.size()), axis_(points.size()), taken_(points.size()) {
  for (std::size_t i = 0; i < points.size(); ++i) rows_[i] = {points[i], static_cast<std::uint32_t>(i)};
  build(0, rows_.size());
}

void NearestPoints::build(std::size_t begin, std::size_t end) {
  if (begin == end) return;
  Point low = rows_[begin].point, high = low;
  for (std::size_t i = begin; i < end; ++i) {
    for (std::size_t k = 0; k < 3; ++k) {
      low[k] = std::min(low[k], rows_[i].point[k]);
      high[k] = std::max(high[k], rows_[i].point[k]);
    }
  }
  std::size_t axis = 0;
  for (const std::size_t k : {1U, 2U})
    if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
  const std::size_t middle = begin + (end - begin) / 2;
  const auto row = [this](std::size_t i) { return rows_.begin() + static_cast<std::ptrdiff_t>(i); };
  std::nth_element(row(begin), row(middle), row(end),
                   [axis](const Node& a, const Node& b) { return a.point[axis] < b.point[axis]; });
  axis_[middle] = static_cast<std::uint8_t>(axis);
  rows_[middle].n_left = static_cast<std::uint32_t>(end - begin);
  const auto lower = [&] { build(begin, middle); };
  const auto upper = [&] { build(middle + 1, end); };
  if (end - begin < kSerial) return lower(), upper();
  tbb::parallel_invoke(lower, upper);
}

void NearestPoints::search(std::size_t begin, std::size_t end, const Point& p) {
  if (begin == end) return;
  const std::size_t middle = begin + (end - begin) / 2;
  const Node& node = rows_[middle];
  if (node.n_left == 0) return;
  float squared = 0;
  for (std::size_t k = 0; k < 3; ++k) squared += (p[k] - node.point[k]) * (p[k] - node.point[k]);
  if (taken_[middle] == 0 && (squared < best_ || (!found_ && squared == best_))) best_ = squared, found_ = middle;
  const float beyond = p[axis_[middle]] - node.point[axis_[middle]];
  const auto lower = [&] { search(begin, middle, p); };
  const auto upper = [&] { search(middle + 1, end, p); };
  beyond < 0 ? lower() : upper();
  if (beyond * beyond <= best_) beyond < 0 ? upper() : lower();
}

std::optional<std::uint32_t> NearestPoints::take(const Point& p, float radius) {
  best_ = radius * radius;
  found_.reset();
  search(0, rows_.size(), p);
  if (!found_) return {};
  taken_[*found_] = 1;
  for (std::size_t begin = 0, end = rows_.size();;) {
    const std::size_t middle = begin + (end - begin) / 2;
    --rows_[middle].n_left;
    if (*found_ == middle) return rows_[middle].index;
    *found_ < middle ? end = middle : begin = middle + 1;
  }
}

}  // namespace rgs::audit
