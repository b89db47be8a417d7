// input_declarations.cpp - how declarations pass from inputs and options to the output.
// SPDX-License-Identifier: Apache-2.0
#include "input_declarations.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

#include "console.hpp"

namespace rgs {
namespace {

const char* name_of(AaMode mode) {
  return mode == AaMode::classic ? "classic" : mode == AaMode::mip_splatting ? "mip-splatting" : "undeclared";
}
const char* name_of(ColourSpace space) {
  return space == ColourSpace::srgb_display ? "srgb" : space == ColourSpace::linear_display ? "linear" : "undeclared";
}
std::string name_of(float value) {
  return fmt::format("{:.6g}", value);
}

float low_pass_of(const EncodeOptions& o) {
  return o.low_pass_px2.value_or(default_low_pass_px2(o.aa_mode));
}

// Takes the first input's declaration, value(options) other than `none`; notes inputs that declare another.
template <class Value, class Differs>
auto first_of(std::span<const InputDeclarations> inputs, const char* what, const Value& value,
              decltype(value(EncodeOptions())) none, const Differs& differs, std::vector<std::string>* notes) {
  const InputDeclarations* taken = nullptr;
  for (const InputDeclarations& input : inputs) {
    const auto own = value(input.stated);
    if (own == none) continue;
    if (taken == nullptr) {
      taken = &input;
    } else if (notes != nullptr && differs(own, value(taken->stated))) {
      notes->push_back(fmt::format("the inputs declare different {}: {} of {} is used, {} has {}", what,
                                   name_of(value(taken->stated)), taken->name, input.name, name_of(own)));
    }
  }
  return taken == nullptr ? none : value(taken->stated);
}

bool same_depth(const EncodeOptions& a, const EncodeOptions& b) {
  if (!a.depth || !b.depth) return a.depth.has_value() == b.depth.has_value();
  return a.depth->z_near == b.depth->z_near && a.depth->z_far == b.depth->z_far && a.depth->source == b.depth->source &&
         a.depth_mapping == b.depth_mapping;
}

bool same_thresholds(const EncodeOptions& a, const EncodeOptions& b) {
  return a.cutoff_sigma == b.cutoff_sigma && a.alpha_threshold == b.alpha_threshold && a.alpha_max == b.alpha_max &&
         a.transmittance_min == b.transmittance_min;
}

void declare_depth(EncodeOptions& encode, std::span<const InputDeclarations> inputs, const AskedDeclarations& asked,
                   std::vector<std::string>& notes) {
  const EncodeOptions& first = inputs.front().stated;
  const bool agree = std::ranges::all_of(inputs, [&](const auto& i) { return same_depth(first, i.stated); });
  encode.depth.reset();
  encode.depth_mapping = EncodeOptions().depth_mapping;
  if (agree && first.depth) {
    encode.depth = first.depth;
    encode.depth_mapping = first.depth_mapping;
  } else if (std::ranges::any_of(inputs, [](const auto& i) {
               return i.stated.depth && i.stated.depth->source != DepthSource::scene_extent;
             })) {
    notes.emplace_back("the inputs declare different depth ranges: the merged scene's extent is used");
  }
  if (asked.depth_mapping && *asked.depth_mapping != encode.depth_mapping) {
    encode.depth_mapping = *asked.depth_mapping;
    // How far a range from the extent reaches depends on its mapping, so it is not taken over.
    if (encode.depth && encode.depth->source == DepthSource::scene_extent) encode.depth.reset();
  }
}

void declare_thresholds(EncodeOptions& encode, std::span<const InputDeclarations> inputs,
                        std::vector<std::string>& notes) {
  const InputDeclarations* taken = nullptr;
  for (const InputDeclarations& input : inputs) {
    if (!input.is_rgs) continue;
    if (taken == nullptr) {
      taken = &input;
    } else if (!same_thresholds(taken->stated, input.stated)) {
      notes.push_back(fmt::format("the inputs declare different thresholds: those of {} are used, not those of {}",
                                  taken->name, input.name));
    }
  }
  if (taken == nullptr) return;
  encode.cutoff_sigma = taken->stated.cutoff_sigma;
  encode.alpha_threshold = taken->stated.alpha_threshold;
  encode.alpha_max = taken->stated.alpha_max;
  encode.transmittance_min = taken->stated.transmittance_min;
}

bool moves(const Similarity& placed) {
  return placed.rotation != glm::dmat3(1) || placed.scale != 1 || placed.translation != glm::dvec3(0);
}

// Coordinates in different systems cannot be merged, so unlike other declarations these must not differ.
Status declare_crs(EncodeOptions& encode, std::span<const InputDeclarations> inputs, const AskedDeclarations& asked,
                   std::vector<std::string>& notes) {
  encode.crs = {asked.crs.value_or(""), {}};
  convert_axes(encode.crs, inputs.front().stated.axes, encode.axes);
  for (const InputDeclarations& input : inputs) {
    Crs crs = input.stated.crs;
    if (crs == Crs() || asked.crs) continue;
    convert_axes(crs, input.stated.axes, encode.axes);
    if (input.is_moved) {
      notes.push_back(fmt::format("{} is moved, so it is no longer in {} (--crs states what it is in)", input.name,
                                  tool::printable(crs.text)));
    } else if (crs.axes[0] != Axis::undeclared && encode.axes[0] == Axis::undeclared) {
      notes.push_back(
          fmt::format("{} was turned since it was in {}, which undeclared axes cannot state (--crs states "
                      "what it is in)",
                      input.name, tool::printable(crs.text)));
    } else if (encode.crs == Crs()) {
      encode.crs = std::move(crs);
    } else if (encode.crs != crs) {
      return make_error(Errc::bad_argument, Error::kNone,
                        "the inputs are in different coordinate reference systems, or their axes differ; convert them "
                        "to one, or state that of the output with --crs");
    }
  }
  return {};
}

}  // namespace

InputDeclarations declared_by(const SplatFile& file, const std::string& name, const Similarity& placed) {
  InputDeclarations input{name, keep_declarations({}, file), file.declarations.has_value(), moves(placed)};
  EncodeOptions& o = input.stated;
  const double scale = placed.scale;
  o.metres_per_unit = static_cast<float>(static_cast<double>(o.metres_per_unit) / scale);
  if (o.depth) {
    o.depth->z_near = static_cast<float>(static_cast<double>(o.depth->z_near) * scale);
    o.depth->z_far = static_cast<float>(static_cast<double>(o.depth->z_far) * scale);
  }
  return input;
}

InputDeclarations declared_by(const PlyFile& ply, const std::string& name, const Similarity& placed) {
  InputDeclarations input{name, keep_declarations({}, ply.declarations()), false, moves(placed)};
  float& metres = input.stated.metres_per_unit;
  metres = static_cast<float>(static_cast<double>(metres) / placed.scale);
  input.stated.depth.reset();  // a PLY states none
  input.stated.depth_mapping = EncodeOptions().depth_mapping;
  return input;
}

InputDeclarations declared_by(const FileView& view, const std::string& name) {
  return {name, keep_declarations({}, view.declarations()), true};
}

void declare_prj(InputDeclarations& input, const std::string& prj, const AskedDeclarations& asked,
                 std::vector<std::string>& notes) {
  if (prj.empty() || asked.crs || input.stated.crs != Crs()) return;
  input.stated.crs.text = prj;
  notes.push_back(fmt::format(
      "{} states no coordinate reference system: that of the .prj beside it is taken (--crs none ignores it)",
      tool::printable(input.name)));
}

Status declare_scene(EncodeOptions& encode, std::span<const InputDeclarations> inputs, const AskedDeclarations& asked,
                     std::vector<std::string>& notes) {
  const auto differs = [](const auto& a, const auto& b) { return a != b; };
  // Scaled by --scale: compare up to rounding.
  const auto differs_much = [](float a, float b) { return std::abs(a - b) > 1e-6F * std::max(a, b); };
  const auto unless = [&notes](bool is_asked) { return is_asked ? nullptr : &notes; };

  encode.colour_space = asked.colour_space.value_or(first_of(
      inputs, "colour spaces", [](const EncodeOptions& o) { return o.colour_space; }, ColourSpace::undeclared, differs,
      unless(asked.colour_space.has_value())));
  encode.metres_per_unit = asked.metres_per_unit.value_or(first_of(
      inputs, "metres per unit", [](const EncodeOptions& o) { return o.metres_per_unit; }, 0.F, differs_much,
      unless(asked.metres_per_unit.has_value())));
  encode.aa_mode = asked.aa_mode.value_or(first_of(
      inputs, "anti-aliasing", [](const EncodeOptions& o) { return o.aa_mode; }, AaMode::undeclared, differs,
      unless(asked.aa_mode.has_value())));
  if (asked.low_pass_px2 && encode.aa_mode == AaMode::undeclared) {
    return make_error(Errc::bad_argument, Error::kNone,
                      "the input declares no anti-aliasing, which a low-pass requires; pass --aa with --low-pass");
  }
  encode.low_pass_px2 = asked.low_pass_px2;
  if (!encode.low_pass_px2) {
    const AaMode mode = encode.aa_mode;
    const float low_pass = first_of(
        inputs, "low-pass", [mode](const EncodeOptions& o) { return o.aa_mode == mode ? low_pass_of(o) : -1.F; }, -1.F,
        differs, &notes);
    if (low_pass >= 0) encode.low_pass_px2 = low_pass;
  }
  if (Status s = declare_crs(encode, inputs, asked, notes); !s) return s;
  const InputDeclarations& first = inputs.front();
  const bool is_as_it_was = inputs.size() == 1 && !first.is_moved && first.stated.axes == encode.axes;
  encode.first_view = is_as_it_was ? first.stated.first_view : FirstView();
  declare_depth(encode, inputs, asked, notes);
  declare_thresholds(encode, inputs, notes);
  return {};
}

Declarations stated_by(const EncodeOptions& encode, Declarations declared) {
  declared.axes = encode.axes;
  declared.colour_space = encode.colour_space;
  declared.aa_mode = encode.aa_mode;
  declared.low_pass_px2 = low_pass_of(encode);
  declared.metres_per_unit = encode.metres_per_unit;
  declared.crs = encode.crs;
  return declared;
}

void restore_order(SplatFile& file) {
  if (file.source_index.size() != file.cloud.size() || file.source_index.empty()) return;
  std::vector<std::uint64_t> order(file.cloud.size());
  std::iota(order.begin(), order.end(), std::uint64_t{0});
  std::ranges::sort(order, {}, [&file](std::uint64_t i) { return file.source_index[i]; });
  SplatCloud ordered;
  ordered.resize(file.cloud.size(), file.cloud.sh_degree);
  ordered.mean_rest.resize(file.cloud.mean_rest.size());
  for (std::uint64_t i = 0; i < order.size(); ++i) ordered.set(i, file.cloud.view().splat(order[i]));
  file.cloud = std::move(ordered);
  std::ranges::sort(file.source_index);
}

}  // namespace rgs
