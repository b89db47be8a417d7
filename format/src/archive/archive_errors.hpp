// archive_errors.hpp - errors of decoded Gaussians against their source, which ARCH states and verify_archive() checks.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "rgs/layout.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

/// A Gaussian as stored: the row of GEOM, and SH before or after quantisation for SHI8.
struct StoredSplat {
  float mean[3];
  std::uint16_t geometry[8];
  float sh[48];
};

/// docs/format/ARCHIVE.md, "Bounds".
struct SplatErrors {
  double mean = 0, covariance = 0;  ///< both where the Gaussian, blurred, is a unit sphere
  double opacity = 0;               ///< of its square root
  double dc = 0, sh = 0;
};
/// `level`: of the page. `sh_slack` [48] is subtracted from each coefficient's error.
SplatErrors splat_errors(const ArchiveParameters& p, int scale_exponent, int level, int sh_degree, const Splat& source,
                         const StoredSplat& stored, const float* sh_slack = nullptr);

/// Largest errors of a scene, by class where bounds are.
class ErrorMaxima {
 public:
  explicit ErrorMaxima(std::size_t n_classes) : by_class_(n_classes) {}
  void add(std::size_t class_index, const SplatErrors& errors);
  void merge(const ErrorMaxima& other);
  /// Writes them as the bounds of `p`, rounded up.
  void state(ArchiveParameters& p) const;

 private:
  std::vector<SplatErrors> by_class_;
};

/// Whether all errors are within the class's bounds in `p`.
bool within_bounds(const ArchiveParameters& p, std::size_t class_index, const SplatErrors& errors);

}  // namespace rgs::detail
