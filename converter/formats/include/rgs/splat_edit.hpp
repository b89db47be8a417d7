// splat_edit.hpp - transforms, merges, filters and strips Gaussians in memory.
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
  double scale = 1;         ///< bits.
  glm::dvec3 translation{0, 0, 0};
};

/// Rotates about the fixed x, then y, then z axis, by these angles in degrees.
glm::dmat3 rotation_from_euler(const glm::dvec3& degrees);
/// From a quaternion of any norm but 0.
glm::dmat3 rotation_from_quaternion(const glm::dquat& q);
/// First `inner`, then `outer`.
Similarity compose(const Similarity& outer, const Similarity& inner);

/// Transforms means, scales, rotations and harmonics of a scene without an origin.
void transform_splats(SplatCloud& cloud, const Similarity& similarity);
/// The same for a scene with an origin, which moves in FP64. A scene without one gets the translation as its origin if
/// that is more than 64 times the median magnitude of its coordinates: FP32 means would lose more than 6 of their
void transform_splats(SplatCloud& cloud, Origin& origin, const Similarity& similarity);

/// Decides whether transform_splats() adds an origin, for callers that transform a scene in parts.
class FarMove {
 public:
  explicit FarMove(const Similarity& similarity) : similarity_(similarity) {}
  /// Means before the transform: all of the scene, split in any way.
  void add(std::span<const float> means);
  bool is_far() const;

 private:
  Similarity similarity_;
  std::uint64_t n_ = 0, n_small_ = 0;  // coordinates; those far smaller than the translation
};

/// Makes means relative to `to` instead of `from`, in FP64. Returns the largest rounding of a coordinate, world units;
/// if both are equal, changes nothing and returns 0.
double rebase_means(std::span<float> means, const Origin& from, const Origin& to);
/// The same for means with their rests (Splat::mean_rest), which get what is rounded: nothing is lost.
void rebase_exactly(std::span<float> means, std::span<float> rests, const Origin& from, const Origin& to);
/// Largest magnitude; 0 of none.
double largest_rest(std::span<const float> rests);
/// The origin of scenes with these, merged: the middle of their box; kNoOrigin without any.
Origin merged_origin(std::span<const Origin> origins);

/// Converts the scene to other axes, mirrored ones too. Exact except for harmonics when axes are exchanged. Does
/// nothing if `from` or `to` is undeclared.
void convert_axes(SplatCloud& cloud, const Axes& from, const Axes& to);
/// The same for an origin.
void convert_axes(Origin& origin, const Axes& from, const Axes& to);
/// The same for the CRS of the positions: it remembers the axes that they had.
void convert_axes(Crs& crs, const Axes& from, const Axes& to);

/// Drops the harmonics above `degree`.
void strip_sh(SplatCloud& cloud, int degree);

/// Appends `other`; the result has the larger degree, missing harmonics are 0.
void append_splats(SplatCloud& cloud, const SplatCloud& other);
/// Gaussians that follow those of other parts in a cloud.
struct ScenePart {
  std::uint64_t n = 0;
  Origin origin = kNoOrigin;
  double position_rounding = 0;  ///< largest of a coordinate until now, world units
};
/// Makes the means of all parts relative to one `origin`, the merged_origin() of those that are not empty, and adds to
/// their roundings.
void merge_parts(SplatCloud& cloud, std::span<ScenePart> parts, Origin& origin);

/// Keeps the Gaussians at `indices`, which ascend, and drops all others.
void keep_splats(SplatCloud& cloud, std::span<const std::uint64_t> indices);

/// Corners in the world, in FP64: far coordinates need more digits than FP32 has.
struct WorldBox {
  std::array<double, 3> min{0, 0, 0}, max{0, 0, 0};
};

struct SplatFilter {
  std::optional<WorldBox> crop;  ///< keeps positions inside, borders included; FP32 corners for a scene without origin
  float min_opacity = 0;         ///< keeps opacities of at least this
  std::uint64_t max_n = ~std::uint64_t{0};  ///< keeps the max_n Gaussians with the largest product of opacity and the
                                            ///< two largest scales

  bool keeps_all() const { return !crop && min_opacity <= 0 && max_n == ~std::uint64_t{0}; }
};
/// Keeps the order and returns the former positions. NaN fails both crop and opacity. Ties of max_n go to the earlier
/// Gaussian.
std::vector<std::uint64_t> filter_splats(SplatCloud& cloud, const SplatFilter& filter,
                                         const Origin& origin = kNoOrigin);

/// Applies options.on_bad and max_bad_fraction as encode() does, and returns the counts.
/// Errors: bad_value (refuse; the offset is the first damaged one's index), too_many_bad.
Result<SceneScan> clean_splats(SplatCloud& cloud, const EncodeOptions& options);

}  // namespace rgs
