// scene_scan.hpp - facts about a scene before it is written: damage, bounds, ranges.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/first_view.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// What to do with Gaussians that cannot be drawn (see Defect).
enum class BadPolicy : std::uint8_t {
  refuse,  ///< any damaged Gaussian is an error
  drop,    ///< leave damaged Gaussians out
  repair   ///< repair what has an obvious meaning, drop the rest
};

/// Kinds of damage, each counted once per Gaussian that has it.
enum class Defect : std::uint8_t {
  mean,           ///< a coordinate is not finite                             repair: dropped
  scale,          ///< a log-scale is NaN or above 60; -inf is a scale of 0   repair: dropped
  rotation_nan,   ///< a rotation component is not finite                     repair: identity
  rotation_zero,  ///< the quaternion is zero (norm below 2^-60)              repair: identity
  opacity_nan,    ///< the logit is NaN; +-inf are opacities of 1 and 0       repair: dropped
  sh,             ///< an SH coefficient is not finite or above kShLimit      repair: 0
};
inline constexpr int kDefectKinds = 6;
/// "mean", "scale", "rotation_nan", ...
const char* defect_name(Defect defect);

/// Bit i is set if the Gaussian has Defect i; coefficients above `sh_degree` are ignored.
std::uint32_t find_defects(const Splat& splat, int sh_degree);
/// Repairs `splat` as listed at Defect; false if it must be dropped.
bool repair(Splat& splat, std::uint32_t defects);

/// Largest
/// SH
/// of each coefficient over the added Gaussians.
class ShMagnitudes {
 public:
  void add(const float* sh, int sh_degree);  ///< sh: [16, 3] as in Splat
  void merge(const ShMagnitudes& other);
  /// Largest |SH| per degree and channel.
  ShStepSet max_abs() const;
  /// The quantiser's steps for these.
  ShStepSet steps() const;

 private:
  friend class SceneScan;                // writes all of it
  std::array<std::int32_t, 48> bits_{};  // magnitudes as integers, which order alike and vectorise on any x86-64
};

/// The result of a first pass over a scene. No field depends on the order in which Gaussians are added, or on how they
/// are split between merged scans.
class SceneScan {
 public:
  /// `sh_degree` of the future file; higher coefficients do not count. `samples_view`: fills view_sample().
  explicit SceneScan(int sh_degree, BadPolicy on_bad = BadPolicy::drop, bool samples_view = false);

  /// Examines one Gaussian, repairs it under BadPolicy::repair, and returns whether it is kept.
  bool add(Splat& splat);
  void merge(const SceneScan& other);
  /// The scan of the kept Gaussians alone, as repaired.
  SceneScan of_kept() const;
  /// Serialises it for another process with this version of the library.
  std::vector<std::byte> to_bytes() const;
  /// Errors: truncated, bad_value, trailing_bytes (not from to_bytes()).
  static Result<SceneScan> from_bytes(std::span<const std::byte> bytes);

  int sh_degree() const { return sh_degree_; }
  std::uint64_t n_source() const { return n_source_; }
  std::uint64_t n_kept() const { return n_kept_; }
  std::uint64_t n_repaired() const { return n_repaired_; }
  std::uint64_t defects(Defect defect) const { return defects_[static_cast<std::size_t>(defect)]; }
  /// Of the kept Gaussians; boxes and ranges are zero without any. Log-scales and logits may be infinite.
  Box full() const { return n_kept_ == 0 ? Box() : full_; }
  /// Bounds of at least 99 of 100 means on each axis; see FORMAT.md "Robust box".
  Box robust() const;
  float min_log_scale() const { return n_kept_ == 0 ? 0 : min_log_scale_; }
  float max_log_scale() const { return n_kept_ == 0 ? 0 : max_log_scale_; }
  float min_opacity_logit() const { return n_kept_ == 0 ? 0 : min_opacity_logit_; }
  float max_opacity_logit() const { return n_kept_ == 0 ? 0 : max_opacity_logit_; }
  const ShMagnitudes& sh_magnitudes() const { return sh_magnitudes_; }
  /// Of the kept Gaussians, for choose_first_view().
  const FirstViewSample& view_sample() const { return view_sample_; }
  void drop_view_sample() { view_sample_ = {}; }

 private:
  int sh_degree_;
  BadPolicy on_bad_;
  std::uint64_t n_source_ = 0, n_kept_ = 0, n_repaired_ = 0;
  std::array<std::uint64_t, kDefectKinds> defects_{};
  Box full_;
  float min_log_scale_, max_log_scale_, min_opacity_logit_, max_opacity_logit_;
  ShMagnitudes sh_magnitudes_;
  bool samples_view_;
  FirstViewSample view_sample_;
  std::vector<std::uint64_t> histogram_;  // [3, 65536] by the top 16 bits of each coordinate, order-preserving
};

}  // namespace rgs
