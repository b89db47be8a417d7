// bench_modes.cpp - the configurations that rgs-bench compares.
// SPDX-License-Identifier: Apache-2.0
#include "bench_modes.hpp"
#include "rgs/ablation.hpp"

#include <algorithm>
#include <cassert>
#include <iterator>
#include <utility>

namespace rgs::bench {
namespace {

struct Mode {
  const char* name;
  Pipeline pipeline;
  bool tensor_cores;
  bool compact;
};

constexpr Mode kModes[] = {
    {"baseline", Pipeline::baseline, true, false},
    {"paper", Pipeline::paper, true, true},
    {"turbo", Pipeline::turbo, true, true},
    {"turbo-fp32", Pipeline::turbo, false, true},
};

}  // namespace

std::vector<std::string> mode_names() {
  std::vector<std::string> names;
  for (const Mode& mode : kModes) names.emplace_back(mode.name);
  return names;
}

std::vector<std::string> compared_modes(std::span<const std::string> asked, bool is_stress, bool all_gaussians) {
  const bool with_baseline = !is_stress || std::ranges::find(asked, "baseline") != asked.end();
  std::vector<std::string> modes;
  if (with_baseline && all_gaussians) modes.emplace_back("baseline");
  if (is_stress) {
    modes.insert(modes.end(), {"paper", "turbo"});
  } else if (!all_gaussians) {
    modes.emplace_back("paper");
  }
  for (const std::string& mode : asked) {
    if (mode == "baseline" && !all_gaussians) continue;
    if (std::ranges::find(modes, mode) == modes.end()) modes.push_back(mode);
  }
  return modes;
}

Configuration make_mode(std::string_view name, const ModeInput& input) {
  const auto* mode = std::find_if(std::begin(kModes), std::end(kModes), [&](const Mode& m) { return name == m.name; });
  assert(mode != std::end(kModes));
  RenderOptions options{.pipeline = mode->pipeline, .turbo = {.tensor_cores = mode->tensor_cores}};
  options.paper.exp = input.exp.value_or(options.paper.exp);
  options.paper.depth_mapping = input.depth_mapping;
  if (mode->pipeline == Pipeline::baseline) {
    options.detail_px = 0.0F;
  } else if (input.detail_px) {
    options.detail_px = input.detail_px;
    if (*input.detail_px > 0) {  // as renderers draw levels, whatever is declared
      options.anti_aliasing = math::AntiAliasing::mip_splatting;
      options.low_pass = default_low_pass_px2(AaMode::mip_splatting);
    }
  }
  // Both forms of the scene as the file declares, which FP32 attributes do not.
  return {mode->name, with_declarations(options, input.declared), mode->compact};
}

const char* pixel_format_name(const std::optional<math::PixelFormat>& packed) {
  return !packed ? "rgb32f" : *packed == math::PixelFormat::rgba16f ? "rgba16f" : "rgba8";
}
std::uint64_t pixel_bytes(const std::optional<math::PixelFormat>& packed) {
  return packed ? math::pixel_bytes(*packed) : 3 * sizeof(float);
}

bool reads_fp32(std::span<const Configuration> rows) {
  return std::ranges::any_of(rows, [](const Configuration& row) { return !row.compact; });
}

std::vector<Configuration> ablation(const ModeInput& input) {
  const RenderOptions paper = make_mode("paper", input).options;
  std::vector<Configuration> rows{make_mode("baseline", input)};
  const auto step = [&rows](const char* name, const auto& change) {
    Configuration next = rows.back();
    next.name = name;
    next.step = true;
    change(next);
    rows.push_back(std::move(next));
  };
  step("+ attributes", [](Configuration& c) {
    c.options.paper = steps_of(c.options, Backend::cuda);
    c.options.pipeline = Pipeline::paper;
    c.compact = true;
  });
  step("+ fused front end", [](Configuration& c) { c.options.paper.front_end = PaperSteps::FrontEnd::fused; });
  step("+ culling", [](Configuration& c) { c.options.paper.extent = math::Extent::ellipse; });
  step("+ 32-bit key", [&](Configuration& c) {
    c.options.paper.depth_order = paper.paper.depth_order;
    c.options.paper.depth_mapping = paper.paper.depth_mapping;
    c.options.paper.depth_range = paper.paper.depth_range;
  });
  step("+ folding, dual pixel", [](Configuration& c) {
    c.options.paper.exponent = math::Exponent::folded;
    c.options.paper.pixels_per_thread = 2;
  });
  step("+ fast exp = paper", [&](Configuration& c) { c.options = paper; });
  rows.back().step = false;
  return rows;
}

}  // namespace rgs::bench
