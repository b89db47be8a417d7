// audit_pairing.hpp - pairs the Gaussians of source and asset.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
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
};

/// Pairs by the file's permutation if it has one; else in order, if the asset keeps the source's; else by equal means,
/// relative to the asset's origin, which conversion never changes (coincident Gaussians keep their order). `asset` must
/// be valid, and preloaded if it is coded. Takes at most 36 bytes a Gaussian. Errors: limit_exceeded (2^32 - 1
/// Gaussians or more).
Result<Pairing> pair_gaussians(const Source& source, const FileView& asset);

}  // namespace rgs::audit
