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

/// Everything of `tables` that is not fitted to SH or to codes; `splats` has the Gaussians of the finest level, `largest_sh`
/// their magnitudes by degree and channel.
void fit_steps(const ArchiveOptions& options, const SplatView& splats, const ShStepSet& largest_sh,
               ArchiveTables& tables);

/// log2 of the importance of each of a sample of Gaussians, relative to the middle class, limited to +-8: how much they
/// are seen. Every `stride`-th.
struct Sample {
  std::size_t stride = 1;
  std::vector<double> importance;
};
Sample sample_importance(const SplatView& splats, const ArchiveParameters& parameters);

/// Centres, Karhunen-Loeve transforms of SH weighted by the root of importance, and DC's prediction.
void fit_transforms(const SplatView& splats, const Sample& sample, ArchiveTables& tables);

/// Clusters contexts of `counts` [n_contexts, kRansTokens] by their statistics, and fits frequencies.
void fit_distributions(std::span<const std::uint32_t> counts, ArchiveTables& tables);

}  // namespace rgs::detail
