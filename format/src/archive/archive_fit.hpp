// archive_fit.hpp - what the archive encoder fits to a scene: importance, transforms, distributions.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "archive/archive_tables.hpp"
#include "rgs/encode.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

/// The contracted grid of means: centre and half width of the robust box, such that every mean of `full` has a cell.
void fit_grid(const Box& robust, const Box& full, ArchiveParameters& parameters);

/// log2 of opacity^2 s1 s2 / max(d, d50)^2, relative to its median: s1, s2 the two larger scales, d the distance to the
/// grid's centre, d50 its median; a measure of how much a Gaussian is seen. Limited to +-8. `farther` [n], or empty:
/// octaves to subtract from the area of Gaussians that are drawn from farther away. Medians are over the rows from
/// first_median on.
std::vector<float> importance(const SplatView& splats, const ArchiveParameters& parameters,
                              std::span<const float> farther = {}, std::uint64_t first_median = 0);

/// Classes of `octaves` of importance each, limited to +-8 octaves, and the middle one.
struct Classes {
  std::vector<std::uint8_t> of;  ///< [n]
  int count = 1, middle = 0;
};
Classes fit_classes(std::span<const float> importance, float octaves);

/// Steps of each class from the options; scale_base: the mean of its log2(scale).
void fit_steps(const ArchiveOptions& options, const SplatView& splats, const Classes& classes, float octaves,
               ArchiveParameters& parameters);

/// Centres, Karhunen-Loeve transforms of SH weighted by the root of importance, and DC's prediction.
void fit_transforms(const SplatView& splats, std::span<const float> importance, ArchiveTables& tables);

/// Clusters contexts of `counts` [n_contexts, kRansTokens] by their statistics, and fits frequencies.
void fit_distributions(std::span<const std::uint32_t> counts, ArchiveTables& tables);

}  // namespace rgs::detail
