// first_view.hpp - the view from which a scene is seen first, found without cameras or as the best of them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/layout.hpp"

namespace RGS_API rgs {

/// Of the Gaussians that are added, those whose means have the smallest hashes: the same ones in whatever order, and
/// by however many samples that are merged then. At most 4 MB.
class FirstViewSample {
 public:
  static constexpr std::size_t kMost = 32768;
  struct Row {
    std::uint64_t key = 0;  ///< hash of the mean
    std::array<float, 3> mean{}, scale{};
    std::array<float, 4> rotation{};  ///< w, x, y, z; need not be normalised
    float opacity = 0;
    auto operator<=>(const Row&) const = default;  // NOLINT(modernize-use-nullptr): of clang-tidy 14
  };

  /// Values that are not finite count, but are not taken. `mean` and `scale` [3], `rotation` [4].
  void add(const float* mean, const float* scale, const float* rotation, float opacity);
  /// The same before activation.
  void add(const Splat& splat);
  void merge(const FirstViewSample& other);
  /// Counts `n` that are not taken.
  void count(std::uint64_t n) { n_ += n; }
  /// Of those added.
  std::uint64_t n() const { return n_; }
  /// At most kMost, in ascending order.
  std::vector<Row> rows() const;

 private:
  void take(const Row& row);
  void keep_least();

  std::uint64_t n_ = 0, most_ = ~std::uint64_t{0};
  std::vector<Row> rows_;  // fewer than 2 kMost
};

/// A camera to choose from: unit directions, position relative to the scene's origin, tangents of half the fields of view.
struct CandidateView {
  std::array<double, 3> position, forward, up;
  double tan_x = 0, tan_y = 0;
};

/// The view with the best picture of `candidates` or, without any, of many around the subject and inside the scene: it
/// shows much of the scene, large, sharp and with nothing before it. `up`: unit direction of the scene's up; the floor or
/// ground, where there clearly is one, corrects it by up to 30 degrees if `finds_up`. Depends on the sample alone: no
/// logarithms or angles, whose last bits differ between C libraries, but for the width of a candidate. ViewKind::none
/// without visible Gaussians, or if no file can state the view.
FirstView choose_first_view(const FirstViewSample& sample, const std::array<double, 3>& up, bool finds_up,
                            std::span<const CandidateView> candidates = {});

}  // namespace rgs
