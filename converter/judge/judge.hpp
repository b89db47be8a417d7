// judge.hpp - splits the difference of a program's pictures from the definition among causes.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "causes.hpp"
#include "rgs/image.hpp"
#include "rgs/renderer.hpp"
#include "rules.hpp"

namespace rgs::judge {

/// A scene as the definition reads it, and its Gaussians in the file's own axes.
struct Scenes {
  SceneView defined, stored;
};

/// A picture by the program, [height, width, 3], and the camera that it was drawn by.
struct Shown {
  Camera camera;
  Image picture;
};

/// A cause that was found. Causes act on what the ones before left, so their order matters to their shares.
struct Step {
  const Cause* cause = nullptr;
  bool is_known = false;  ///< from the program's sources; otherwise found by trying
  double share = 0;       ///< of the squared error; below 0 where causes make up for each other
  double psnr = 0;        ///< of the program's pictures from those drawn by all rules so far
  double bias = 0;        ///< mean change of a channel by this cause, in levels of 255
};

struct View {
  std::string name;
  Image definition, explained;  ///< drawn by the definition, and by all rules that were found
  double psnr = 0, explained_psnr = 0;
};

struct Judgement {
  double mse = 0;       ///< of all pixels and channels, 0..1 clamped, in 8 bits if the program's pictures are
  double rounding = 0;  ///< share of it that is left and in differences of at most one level of 255
  double rest = 0;      ///< share that is in larger ones: not named
  std::vector<Step> steps;
  std::vector<View> views;

  double psnr() const;
  double named() const { return 1 - rest; }
};

/// The rules of the definition for a scene with these declarations.
Rules definition(const std::optional<Declarations>& declared, float near_plane);

/// Adopts causes one after another, each time the one that leaves the least squared error as far as trials tell: first
/// those of `client` (may be null), all at once where none of them helps alone; then, while more than 5% is unexplained
/// but for rounding, any. Causes that explain less than a thousandth are not adopted alone. The same for any number of
/// threads. `shown` has at least one picture, each of its camera's size and without NaN.
Judgement judge(const Scenes& scenes, std::span<const Shown> shown, const Rules& rules, const Client* client);

}  // namespace rgs::judge
