// splat_edit.hpp - moving, turning, merging, filtering and stripping Gaussians in memory.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <glm/ext/quaternion_double.hpp>
#include <glm/mat3x3.hpp>
#include <glm/vec3.hpp>
#include <optional>
#include <span>
#include <vector>

#include "rgs/encode.hpp"
#include "rgs/interchange.hpp"
#include "rgs/layout.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// x -> scale * rotation * x + translation.
struct Similarity {
  glm::dmat3 rotation{1.};  ///< proper
  double scale = 1;         ///< above 0
  glm::dvec3 translation{0, 0, 0};
};

/// Turns about x, then y, then z, each by so many degrees about the fixed axis.
glm::dmat3 rotation_from_euler(const glm::dvec3& degrees);
/// From a quaternion of any norm but 0.
glm::dmat3 rotation_from_quaternion(const glm::dquat& q);
/// First `inner`, then `outer`.
Similarity compose(const Similarity& outer, const Similarity& inner);

/// Moves the scene: means, scales, rotations and harmonics. It has no origin.
void transform_splats(SplatCloud& cloud, const Similarity& similarity);
/// The same of a scene with an origin, whose place it moves in FP64. A scene without one gets the translation as its origin
/// where that is more than 64 times as large as the scene's coordinates are (the median of their magnitudes): FP32 means
/// would lose more than 6 of their 24 bits.
void transform_splats(SplatCloud& cloud, Origin& origin, const Similarity& similarity);

/// Whether transform_splats() gives a scene without an origin one, for whoever moves a scene in parts.
class FarMove {
 public:
  explicit FarMove(const Similarity& similarity) : similarity_(similarity) {}
  /// Means before they are moved, all of the scene's in any split.
  void add(std::span<const float> means);
  bool is_far() const;

 private:
  Similarity similarity_;
  std::uint64_t n_ = 0, n_small_ = 0;  // coordinates, and those that the translation is far beyond
};

/// Makes means that are relative to `from` relative to `to`, in FP64. Returns the largest rounding of a coordinate, world
/// units; nothing changes and 0 is returned if both are equal.
double rebase_splats(SplatCloud& cloud, const Origin& from, const Origin& to);

/// Re-expresses the scene in other axes, mirrored ones too. Exact but for the harmonics when axes are exchanged.
/// Does nothing where `from` or `to` is undeclared.
void convert_axes(SplatCloud& cloud, const Axes& from, const Axes& to);
/// The same of an origin.
void convert_axes(Origin& origin, const Axes& from, const Axes& to);

/// Drops the harmonics above `degree`.
void strip_sh(SplatCloud& cloud, int degree);

/// Appends `other`; the degree becomes the larger of both, missing harmonics are 0.
void append_splats(SplatCloud& cloud, const SplatCloud& other);
/// The same of scenes with origins: `cloud` keeps its own, but takes the other's if it has none. Returns what rebase_splats()
/// does.
double append_splats(SplatCloud& cloud, Origin& origin, SplatCloud&& other, const Origin& other_origin);

/// Keeps the Gaussians `indices`, which ascend, and drops all others.
void keep_splats(SplatCloud& cloud, std::span<const std::uint64_t> indices);

/// Corners in the world, where coordinates have more digits than FP32 holds.
struct WorldBox {
  std::array<double, 3> min{0, 0, 0}, max{0, 0, 0};
};

struct SplatFilter {
  std::optional<WorldBox> crop;  ///< keeps positions inside, borders included; FP32 corners for a scene without origin
  float min_opacity = 0;         ///< keeps opacities of at least this
  std::uint64_t max_n = ~std::uint64_t{0};  ///< keeps that many with the largest opacity times the two largest scales

  bool keeps_all() const { return !crop && min_opacity <= 0 && max_n == ~std::uint64_t{0}; }
};
/// What passes stays in order: its former positions are returned. NaN passes neither crop nor opacity. Ties of max_n go to
/// the earlier Gaussian.
std::vector<std::uint64_t> filter_splats(SplatCloud& cloud, const SplatFilter& filter,
                                         const Origin& origin = kNoOrigin);

/// Applies options.on_bad and max_bad_fraction as encode() does; the counts are in the result.
/// Errors: bad_value (refuse; the offset is the first damaged one's index), too_many_bad.
Result<SceneScan> clean_splats(SplatCloud& cloud, const EncodeOptions& options);

}  // namespace rgs
