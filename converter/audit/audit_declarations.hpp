// audit_declarations.hpp - compares what source and asset state of the scene.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "audit.hpp"
#include "audit_source.hpp"

namespace rgs::audit {

/// All declarations of the asset that differ from the source's. Left out: a unit that either does not know; counts,
/// boxes and order, which describe the file; the depth range unless both are .rgs files, since no other format states
/// it. What a file does not state has its default (docs/user/INTERCHANGE.md).
std::vector<DeclaredDifference> compare_declarations(const Source& source, const Declarations& asset, bool rgs_asset);

}  // namespace rgs::audit
