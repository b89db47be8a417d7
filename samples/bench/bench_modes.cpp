// bench_modes.cpp - the configurations that rgs-bench compares.
// SPDX-License-Identifier: Apache-2.0
#include "bench_modes.hpp"

#include <algorithm>
#include <cassert>
#include <iterator>
#include <utility>

namespace rgs::bench {
namespace {

RenderOptions chosen(RenderOptions options, const ModeInput& input) {
  options.exp = input.exp.value_or(options.exp);
  options.depth_mapping = input.depth_mapping.value_or(options.depth_mapping);
  return options;
}

RenderOptions paper_of(const ModeInput& input) {
  return chosen(paper_options(input.declared), input);
}

RenderOptions turbo_fp32(const ModeInput&) {
  RenderOptions options = turbo_options();
  options.cuda.tensor_cores = false;
  return options;
}

struct Mode {
  const char* name;
  RenderOptions (*options)(const ModeInput&);
  bool compact;
};

constexpr Mode kModes[] = {
    {"baseline", [](const ModeInput&) { return baseline_options(); }, false},
    {"paper", paper_of, true},
    {"turbo", [](const ModeInput&) { return turbo_options(); }, true},
    {"turbo-fp32", turbo_fp32, true},
};

}  // namespace

std::vector<std::string> mode_names() {
  std::vector<std::string> names;
  for (const Mode& mode : kModes) names.emplace_back(mode.name);
  return names;
}

Configuration make_mode(std::string_view name, const ModeInput& input) {
  const auto* mode = std::find_if(std::begin(kModes), std::end(kModes), [&](const Mode& m) { return name == m.name; });
  assert(mode != std::end(kModes));
  return {mode->name, mode->options(input), mode->compact};
}

const char* pixel_format_name(const std::optional<math::PixelFormat>& packed) {
  return !packed ? "rgb32f" : *packed == math::PixelFormat::rgba16f ? "rgba16f" : "rgba8";
}
std::uint64_t pixel_bytes(const std::optional<math::PixelFormat>& packed) {
  return packed ? math::pixel_bytes(*packed) : 3 * sizeof(float);
}

std::vector<Configuration> ablation(const ModeInput& input) {
  const RenderOptions paper = paper_of(input);
  std::vector<Configuration> rows{make_mode("baseline", input)};
  const auto step = [&rows](const char* name, const auto& change) {
    Configuration next = rows.back();
    next.name = name;
    next.step = true;
    change(next);
    rows.push_back(std::move(next));
  };
  step("+ attributes", [](Configuration& c) { c.compact = true; });
  step("+ fused front end", [](Configuration& c) { c.options.cuda.front_end = CudaOptions::FrontEnd::fused; });
  step("+ culling", [](Configuration& c) { c.options.extent = math::Extent::ellipse; });
  step("+ 32-bit key", [&](Configuration& c) {
    c.options.depth_order = paper.depth_order;
    c.options.depth_mapping = paper.depth_mapping;
    c.options.depth_range = paper.depth_range;
  });
  step("+ folding, dual pixel", [](Configuration& c) {
    c.options.exponent = math::Exponent::folded;
    c.options.cuda.pixels_per_thread = 2;
  });
  step("+ fast exp = paper", [&](Configuration& c) { c.options = paper; });
  rows.back().step = false;
  return rows;
}

}  // namespace rgs::bench
