// fit_device.hpp - fit_colors() on a CUDA device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "gaussians.hpp"
#include "rgs/result.hpp"

namespace rgs::lod {

/// The device current at create(). Thread-safe.
class FitDevice {
 public:
  /// Errors: unavailable (built without CUDA, or no device answers).
  static Result<std::shared_ptr<FitDevice>> create();
  ~FitDevice();

  /// The steps of fit_colors(). Every run on a device has the same result; another device and the processor round
  /// otherwise. After a failure, and once a call has failed, `gaussians` are as they were: see status().
  void fit_colors(const Gaussians& group, Gaussians& gaussians, float pixel);
  /// The first failure: device_out_of_memory, device_failed.
  Status status() const;

 private:
  struct Impl;
  explicit FitDevice(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::lod
