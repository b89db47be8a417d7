// spz_axes.hpp - the option --spz-axes of every program that reads or writes SPZ.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <string>

#include "rgs/interchange.hpp"

namespace rgs::tool {

/// Adds the option; `axes` must live until the command line is parsed.
inline CLI::Option* add_spz_axes(CLI::App& app, Axes& axes) {
  return app
      .add_option_function<std::string>(
          "--spz-axes", [&axes](const std::string& name) { axes = name == "ply" ? kAxes3dgs : kAxesOpenGl; },
          "Axes of .spz files that declare none: those of a PLY, or right,up,backward [ply]")
      ->check(CLI::IsMember({"ply", "opengl"}))
      ->option_text("ply|opengl");
}

}  // namespace rgs::tool
