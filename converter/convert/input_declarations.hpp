// input_declarations.hpp - what the inputs of a conversion declare, what is asked for, and what the output declares.
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

namespace rgs {

/// Options that beat what inputs declare.
struct AskedDeclarations {
  std::optional<AaMode> aa_mode;
  std::optional<float> low_pass_px2;  ///< absent: of the input if it has this anti-aliasing, else the mode's usual one
  std::optional<ColourSpace> colour_space;
  std::optional<float> metres_per_unit;  ///< of the output
  std::optional<DepthMapping> depth_mapping;
};

/// What one input declares, in units of the output.
struct InputDeclarations {
  std::string name;      ///< for messages
  EncodeOptions stated;  ///< by keep_declarations(): absent depth: none is declared
  bool is_rgs = false;
};
/// `scale`: units of the output in a unit of the input.
InputDeclarations declared_by(const SplatFile& file, const std::string& name, double scale);
InputDeclarations declared_by(const PlyFile& ply, const std::string& name, double scale = 1);
InputDeclarations declared_by(const FileView& view, const std::string& name);

/// What a conversion has to tell of declarations, see ConvertSummary.
struct DeclaredLoss {
  std::vector<std::string> lost, notes;
};

/// Sets in `encode` what the output declares, but for axes, provenance and counts. What several inputs declare
/// differently is the first one's, with a note; the depth range is then left to the extent of the scene.
/// Errors: bad_argument (a low-pass is asked for where no anti-aliasing is declared).
Status declare_scene(EncodeOptions& encode, std::span<const InputDeclarations> inputs, const AskedDeclarations& asked,
                     std::vector<std::string>& notes);

/// `declared` with what `encode` says instead.
Declarations stated_by(const EncodeOptions& encode, Declarations declared);

/// Puts Gaussians of an .rgs that knows their positions into the order of its source.
void restore_order(SplatFile& file);

}  // namespace rgs
