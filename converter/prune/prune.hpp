// prune.hpp - chooses which Gaussians to keep by their contributions to pictures: docs/user/PRUNING.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "rgs/image.hpp"
#include "rgs/result.hpp"

namespace rgs::prune {

/// A Gaussian's score: its weight summed over all pixels, or the largest in any pixel.
enum class Score : std::uint8_t { sum, max };
double score(const Contribution& contribution, Score score);

/// How many to keep: a share of all, rounded, or a number.
struct Keep {
  double share = 1;                    ///< 0..1
  std::optional<std::uint64_t> count;  ///< replaces the share
  std::uint64_t of(std::uint64_t n) const;
};
/// Parses "20%", "100000", "100k". bad_argument for anything else, and above 100%.
Result<Keep> parse_keep(std::string_view text);

/// Indices, ascending, of the `n_kept` Gaussians of highest score; the earlier ones among equals.
std::vector<std::uint64_t> highest(std::span<const Contribution> contributions, Score by, std::uint64_t n_kept);
/// Indices, ascending, of Gaussians that score `least` or more.
std::vector<std::uint64_t> at_least(std::span<const Contribution> contributions, Score by, double least);

/// What a choice keeps of the scene.
struct Outcome {
  std::uint64_t n_kept = 0, n_unseen = 0;  ///< Gaussians kept; Gaussians without any contribution, kept or not
  double weight_share = 0;                 ///< share of the summed weight that is kept; 1 if that is 0
  double lowest_score = 0;                 ///< of those kept; 0 if none is
};
Outcome outcome(std::span<const Contribution> contributions, Score by, std::span<const std::uint64_t> kept);

/// The contributions as a NumPy file: float64 [n, 2], C order; sum, largest.
std::vector<std::byte> scores_npy(std::span<const Contribution> contributions);

}  // namespace rgs::prune
