// audit_pairing.hpp - pairs the Gaussians of source and asset.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "audit.hpp"
#include "audit_source.hpp"
#include "rgs/decode.hpp"

namespace rgs::audit {

inline constexpr std::uint32_t kUnpaired = 0xFFFFFFFF;

struct Pairing {
  PairedBy by = PairedBy::means;
  std::vector<std::uint32_t> source_of;  ///< [n_asset] row of the source, or kUnpaired
  std::uint64_t n_paired = 0;

  PairReport report(std::uint64_t n_source) const {
    return {by, n_paired, n_source - n_paired, source_of.size() - n_paired};
  }
};

/// Calls use(row, mean) for all rows on all threads; `mean` [3] is relative to the file's origin.
using UseMean = std::function<void(std::uint64_t row, const float* mean)>;
void for_each_mean(const Source& source, const UseMean& use);
void for_each_mean(const FileView& asset, const UseMean& use);

/// Pairs by the file's permutation if it has one; else in order, if the asset keeps the source's; else by equal means,
/// relative to the asset's origin, which conversion changes in archives alone (coincident Gaussians keep their order).
/// `archive`: of the file that `asset` is, or has the leaves of, else null: means that are not equal pair with the nearest
/// within kSameGaussian of the source's largest standard deviations, blurred as a pixel does, or within the archive's
/// bounds. `asset` must be valid, and preloaded if it is coded. Takes at most 36 bytes a Gaussian, of an archive 100.
/// Errors: limit_exceeded (2^32 - 1 Gaussians or more).
Result<Pairing> pair_gaussians(const Source& source, const FileView& asset, const ArchiveParameters* archive);
/// By the positions in `source` that `asset`, an .rgs in memory, keeps; empty if it keeps none or they do not fit.
std::optional<Pairing> pair_by_permutation(const Source& source, const Source& asset);
/// The same for an asset of another format, which may have rounded means: those that are not equal pair with the nearest
/// mean within kSameGaussian of the source's largest standard deviations. Takes at most 100 bytes a Gaussian.
Result<Pairing> pair_gaussians(const Source& source, const Source& asset);
/// The compact formats round means by less; what moved farther is another Gaussian.
inline constexpr float kSameGaussian = 3;

}  // namespace rgs::audit
