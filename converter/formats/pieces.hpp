// pieces.hpp - hands the Gaussians of a file to ReadOptions::visit while they are read.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>

#include "rgs/interchange.hpp"

namespace rgs::detail {

inline constexpr std::uint64_t kPieceRows = 65536;

/// Hands file.cloud over and empties it; without ReadOptions::visit keeps it. Errors: those of visit.
inline Status hand_over(SplatFile& file, const ReadOptions& options) {
  if (!options.visit || file.cloud.size() == 0) return {};
  const int degree = file.cloud.sh_degree;
  const Status visited = options.visit(file);
  file.cloud.resize(0, degree);
  return visited;
}

/// The same for these rows.
inline Status hand_over(std::span<const Splat> rows, int sh_degree, SplatFile& file, const ReadOptions& options) {
  file.cloud.resize(rows.size(), sh_degree);
  const auto has_rest = [](const Splat& s) { return std::ranges::any_of(s.mean_rest, [](float x) { return x != 0; }); };
  if (std::ranges::any_of(rows, has_rest)) file.cloud.mean_rest.resize(file.cloud.mean.size());
  for (std::size_t i = 0; i < rows.size(); ++i) file.cloud.set(i, rows[i]);
  return hand_over(file, options);
}

/// Receives n Gaussians one by one: into file.cloud, or into pieces of kPieceRows that are handed over.
class PieceFiller {
 public:
  PieceFiller(SplatFile& file, std::uint64_t n, int degree, const ReadOptions& options)
      : file_(&file), options_(&options), left_(n) {
    next(degree);
  }
  /// Errors: those of visit.
  Status add(const Splat& splat) {
    file_->cloud.set(filled_++, splat);
    if (!options_->visit || filled_ < file_->cloud.size()) return {};
    const Status s = hand_over(*file_, *options_);
    next(file_->cloud.sh_degree);
    return s;
  }

 private:
  void next(int degree) {
    const std::uint64_t n = options_->visit ? std::min(kPieceRows, left_) : left_;
    file_->cloud.resize(n, degree);
    left_ -= n;
    filled_ = 0;
  }

  SplatFile* file_;
  const ReadOptions* options_;
  std::uint64_t left_, filled_ = 0;
};

}  // namespace rgs::detail
