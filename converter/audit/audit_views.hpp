// audit_views.hpp - the views that an audit renders, and their photographs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "audit.hpp"
#include "rgs/image.hpp"
#include "rgs/scene_first_view.hpp"

namespace rgs::audit {

struct View {
  Camera camera;
  std::string photo;  ///< file; empty without photographs
};

/// Of views without cameras.
ViewFormat view_format(const Options& options);

/// The requested views: cameras of the file at their own size or options.size, or options.views automatic ones around
/// `first`. With options.photos every view has a photograph of the camera's size.
/// Errors: those of read_camera_set(); bad_argument (no camera of the split; frames of several sizes; photographs that
/// are missing or of another size, each named in the subject); read errors of the photographs.
Outcome<std::vector<View>> choose_views(const Options& options, const FirstView& first, const Origin& origin);

/// A photograph as RGB.
Outcome<Image> read_photo(const View& view);

}  // namespace rgs::audit
