// convert_arguments.hpp - parses values of rgs-convert's options.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "rgs/interchange.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs {

// All errors are bad_argument.

/// "right,down,forward" or the name of a usual frame: 3dgs, opengl, gltf, undeclared.
Result<Axes> parse_axes(const std::string& text);
/// `translate`: "x,y,z". `rotate`: "x,y,z" in degrees (see rotation_from_euler) or a quaternion "w,x,y,z". `scale`: a
/// factor above 0. An empty text means identity.
Result<Similarity> parse_similarity(const std::string& translate, const std::string& rotate, const std::string& scale);
/// "x,y,z,X,Y,Z": two corners.
Result<WorldBox> parse_box(const std::string& text);

}  // namespace rgs
