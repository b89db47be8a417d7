// audit_attributes.hpp - the error of every stored attribute, streamed over both files.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "audit.hpp"
#include "audit_pairing.hpp"
#include "audit_source.hpp"
#include "rgs/decode.hpp"

namespace rgs::audit {

/// Compares each paired Gaussian of `asset` with its source. Reads both files once, in the asset's order; memory is
/// constant apart from 512 bytes per 4,096 Gaussians. Results do not depend on the number of threads. `asset` must be
/// valid, and preloaded if it is coded. Damaged Gaussians of the source are repaired first, see repair().
AttributeReport compare_attributes(const Source& source, const FileView& asset, const Pairing& pairing,
                                   tool::Progress& progress);

}  // namespace rgs::audit
