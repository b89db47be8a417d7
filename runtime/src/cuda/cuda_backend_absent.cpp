// cuda_backend_absent.cpp - the CUDA backend of builds without CUDA.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/cuda_backend.hpp"

namespace rgs::detail {

struct CudaBackend::Impl {};
CudaBackend::CudaBackend(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
CudaBackend::CudaBackend(CudaBackend&&) noexcept = default;
CudaBackend::~CudaBackend() = default;

Result<CudaBackend> CudaBackend::create(std::optional<int>) {
  return make_error(Errc::unavailable, Error::kNone, "this build has no CUDA renderer; use the CPU backend");
}
Status CudaBackend::prepare(const Scene&) {
  return make_error(Errc::unavailable, Error::kNone, "this build has no CUDA renderer; use the CPU backend");
}
Result<FrameStats> CudaBackend::render(const Scene&, const Camera&, const RenderTarget&, const RenderOptions&) {
  return make_error(Errc::unavailable, Error::kNone, "this build has no CUDA renderer; use the CPU backend");
}
Result<FrameStats> CudaBackend::render(const SlotDraw&, const Camera&, const RenderTarget&, const RenderOptions&) {
  return make_error(Errc::unavailable, Error::kNone, "this build has no CUDA renderer; use the CPU backend");
}
Result<std::vector<FrameStats>> CudaBackend::render_all(const Scene&, std::span<const Camera>, const PictureArrays&,
                                                        const RenderOptions&) {
  return make_error(Errc::unavailable, Error::kNone, "this build has no CUDA renderer; use the CPU backend");
}
Result<DeviceBlock> CudaBackend::allocate(std::uint64_t) const {
  return make_error(Errc::unavailable, Error::kNone, "this build has no CUDA renderer; use the CPU backend");
}
const char* CudaBackend::name() const {
  return "";
}

}  // namespace rgs::detail
