// subject_box.hpp - the box of what a scene is about, for views of scenes without cameras.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "rgs/layout.hpp"
#include "rgs/page.hpp"

namespace RGS_API rgs {

class FileView;

/// Where Gaussians are dense and opaque: what lies far outside the quartiles of the means `mean` [n, 3], weighted by
/// `opacity` [n], does not count (Tukey's fences, 1977, until nothing more lies outside), nor do 2 % of the rest at
/// either end of an axis. The order of the Gaussians does not matter, and quantised means and opacities move the box by
/// as little as themselves. Means that are not finite do not count. No means: the unit box around 0.
Box subject_box(std::span<const float> mean, std::span<const float> opacity);
/// The same from tables alone, for files that are read in parts: every chunk, or the finest of the known pages, is
/// spread over its box. Differs by a few percent of the box's longest side, of a few tens of pages by more than half of it.
/// Of fewer than six pages it is the core of the coarsest.
Box subject_box(const FileView& file);
Box subject_box(std::span<const lod::Page> pages);

}  // namespace rgs
