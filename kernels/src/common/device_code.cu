// device_code.cu - asks the driver for one kernel; all are compiled for the same architectures.
// SPDX-License-Identifier: Apache-2.0
#include "common/device_code.hpp"

#include "common/launch.cuh"

namespace rgs::cuda {
namespace {

__global__ void any_kernel() {}

}  // namespace

Status check_device_code() {
  cudaFuncAttributes attributes{};
  const cudaError_t error = cudaFuncGetAttributes(&attributes, any_kernel);
  const char* what = nullptr;
  switch (error) {
    case cudaErrorNoKernelImageForDevice:
    case cudaErrorInvalidDeviceFunction:
      what = "this build has no code for the CUDA device: name its architecture in CMAKE_CUDA_ARCHITECTURES";
      break;
    case cudaErrorUnsupportedPtxVersion:
    case cudaErrorJitCompilerNotFound:
    case cudaErrorJitCompilationDisabled:
      what =
          "the driver cannot compile this build's code for the CUDA device: name its architecture in "
          "CMAKE_CUDA_ARCHITECTURES, or update the driver";
      break;
    default: return checked(error, "the driver does not say whether it has code for a kernel");
  }
  cudaGetLastError();  // later calls must not report it
  return make_error(Errc::unavailable, Error::kNone, what, Error::kNone, static_cast<std::uint64_t>(error));
}

}  // namespace rgs::cuda
