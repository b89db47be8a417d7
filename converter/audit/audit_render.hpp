// audit_render.hpp - compares pictures of source and asset: how much they differ, why, and where.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>

#include "audit.hpp"
#include "audit_pairing.hpp"
#include "audit_source.hpp"
#include "audit_views.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::audit {

/// Inputs of the comparison. Assets of formats other than .rgs come as `other`; they get no attribution. All is drawn as
/// the asset declares, except the source's own pictures if the source declares something: a lost anti-aliasing shows.
struct RenderInputs {
  const Source* source = nullptr;
  const FileView* rgs = nullptr;
  const Source* other = nullptr;
  const Pairing* pairing = nullptr;
  const PagedFile* levels = nullptr;  ///< the asset's file; `rgs` is then its leaves
  std::optional<Declarations> declared = {}, source_stated = {};
};

/// The image of Kerbl et al. 2023 (docs/format/RENDERING.md) in separate steps, which can be changed one by one: the
/// arithmetic in which source and asset are compared. Levels of detail: the leaves. `declared`: anti-aliasing and
/// low-pass.
RenderOptions reference_arithmetic(const std::optional<Declarations>& declared);

/// The same with what levels of detail are drawn with: compensated opacities and their low-pass. Draws files without
/// levels too, to compare with.
RenderOptions levels_arithmetic(float detail_px);

/// Mean of the finite PSNRs: one identical view does not make the mean infinite.
double mean_psnr(std::span<const double> values);

/// Renders every view of source and asset by the reference definition (FP32, square extent, exact order and
/// exponential; levels of detail as LevelPsnr says), and the attribution's variants. Views are taken in
/// batches by Options::picture_bytes, and at most two scenes are in memory at a time. Fills `also` too. Variants and
/// other files are drawn in the rated views alone.
Outcome<RenderReport> compare_pictures(const RenderInputs& inputs, const Options& options,
                                       std::vector<AlsoReport>& also, tool::Progress& progress);

}  // namespace rgs::audit
