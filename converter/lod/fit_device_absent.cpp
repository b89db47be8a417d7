// fit_device_absent.cpp - fits of builds without CUDA.
// SPDX-License-Identifier: Apache-2.0
#include "fit_device.hpp"

namespace rgs::lod {

struct FitDevice::Impl {};
FitDevice::FitDevice(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
FitDevice::~FitDevice() = default;

Result<std::shared_ptr<FitDevice>> FitDevice::create() {
  return make_error(Errc::unavailable, Error::kNone, "this program is built without CUDA; fit levels on the CPU");
}
void FitDevice::fit_colors(const Gaussians&, Gaussians&, float) {}
Status FitDevice::status() const {
  return {};
}

}  // namespace rgs::lod
