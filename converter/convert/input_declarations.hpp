// input_declarations.hpp - combines what inputs declare and what options ask for into the output's declarations.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/interchange.hpp"
#include "rgs/ply.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs {

/// Options that override the inputs' declarations.
struct AskedDeclarations {
  std::optional<AaMode> aa_mode;
  std::optional<float> low_pass_px2;  ///< absent: the input's if it has this anti-aliasing, else the mode's default
  std::optional<ColourSpace> colour_space;
  std::optional<float> metres_per_unit;  ///< of the output
  std::optional<DepthMapping> depth_mapping;
  std::optional<std::string> crs;  ///< of the inputs' axes, the output's positions; empty: none
};

/// The declarations of one input, in units of the output.
struct InputDeclarations {
  std::string name;      ///< for messages
  EncodeOptions stated;  ///< from keep_declarations(); no depth: none declared
  bool is_rgs = false;
  bool is_moved = false;  ///< placed elsewhere than in its coordinates
};
/// `placed`: from the input, turned to the output's axes, to the output.
InputDeclarations declared_by(const SplatFile& file, const std::string& name, const Similarity& placed);
InputDeclarations declared_by(const PlyFile& ply, const std::string& name, const Similarity& placed = {});
InputDeclarations declared_by(const FileView& view, const std::string& name);
/// Takes the coordinate reference system of the .prj beside it, unless the input states one or one is asked for.
void declare_prj(InputDeclarations& input, const std::string& prj, const AskedDeclarations& asked,
                 std::vector<std::string>& notes);

/// Losses and notes about declarations, for ConvertSummary.
struct DeclaredLoss {
  std::vector<std::string> lost, notes;
};

/// Sets the output's declarations in `encode`, except axes, provenance and counts. Where inputs differ, the first one's
/// are taken, with a note, and the scene's extent gives the depth range.
/// Errors: bad_argument (a low-pass is asked for but no anti-aliasing is declared; several CRS). `encode.axes` must be set.
Status declare_scene(EncodeOptions& encode, std::span<const InputDeclarations> inputs, const AskedDeclarations& asked,
                     std::vector<std::string>& notes);

/// `declared`, overridden by `encode`.
Declarations stated_by(const EncodeOptions& encode, Declarations declared);

/// Sorts Gaussians of an .rgs that knows their positions into source order.
void restore_order(SplatFile& file);

}  // namespace rgs
