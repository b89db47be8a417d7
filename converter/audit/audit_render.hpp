// audit_render.hpp - source against asset as pictures: how far apart, why, and where.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>

#include "audit.hpp"
#include "audit_pairing.hpp"
#include "audit_source.hpp"
#include "audit_views.hpp"
#include "rgs/decode.hpp"

namespace rgs::audit {

/// What is rendered against what. `rgs` and `pairing` are absent for assets of other formats, which then have no
/// attribution. All is drawn as the asset declares, but the source's own pictures as the source states, if it states
/// anything: an anti-aliasing that got lost shows.
struct RenderInputs {
  const Source* source = nullptr;
  const FileView* rgs = nullptr;
  const Pairing* pairing = nullptr;
  std::optional<Declarations> declared = {}, source_stated = {};
};

/// The image's definition by Kerbl et al. 2023 (docs/format/RENDERING.md), as steps, for its parts to be changed one by one: what
/// source and asset are compared in. Of levels of detail the leaves. `declared`: anti-aliasing and low-pass.
RenderOptions reference_arithmetic(const std::optional<Declarations>& declared);

/// Mean of PSNRs, of those that are finite: one identical view does not make a mean infinite.
double mean_psnr(std::span<const double> values);

/// Renders every view of source and asset in the reference definition (FP32, square extent, exact order and
/// exponential), and the attribution's variants. Views are taken in batches whose reference pictures fit into 512 MB,
/// and at most two scenes are in memory at a time. Fills `also` too. Variants and other files are drawn in the rated
/// views alone.
Outcome<RenderReport> compare_pictures(const RenderInputs& inputs, const Options& options,
                                       std::vector<AlsoReport>& also, tool::Progress& progress);

}  // namespace rgs::audit
