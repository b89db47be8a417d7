// fake_backend.cpp - a CUDA backend on the fake devices: reads slots like the kernels, and draws with the CPU renderer.
// Of other scenes it only says which device would draw.
// SPDX-License-Identifier: Apache-2.0
#include <cuda_runtime_api.h>

#include <array>
#include <cmath>
#include <cstring>
#include <thread>
#include <utility>
#include <vector>

#include "cpu/reference_renderer.hpp"
#include "cuda/cuda_backend.hpp"
#include "fake_cuda.hpp"
#include "page_sections.hpp"
#include "render_options.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

template <class T>
T read(const std::byte* from) {
  T value;
  std::memcpy(&value, from, sizeof value);
  return value;
}

// FP32 attributes of the drawn Gaussians.
struct Drawn {
  std::vector<float> mean, rotation, scale, opacity, sh;
};

// Row `row` of all slots, by PagedAttributes; nothing for a chunk's padding.
void add_row(const SlotDraw& draw, std::uint64_t row, Drawn& out) {
  const SlotShape& shape = draw.slots.plan().shape;
  const std::uint64_t chunk = row / shape.chunk_size;
  const auto at = [&](std::size_t k, std::uint64_t i) {
    return draw.slots.at(k, 0) + i * section_row_bytes(shape.sh_degree)[k];
  };
  const auto mean = read<std::array<float, 3>>(at(0, row));
  if (std::isnan(mean[0])) return;
  const auto geometry = read<std::array<std::uint16_t, 8>>(at(1, row));
  const std::byte* const entry = at(4, chunk);
  const auto scale_unit = read<float>(entry + 44);
  const auto set = read<std::uint32_t>(entry + 32);
  out.mean.insert(out.mean.end(), mean.begin(), mean.end());
  float q[4];
  dequantize_rotation(geometry.data(), q);
  out.rotation.insert(out.rotation.end(), q, q + 4);
  for (std::size_t k = 4; k < 7; ++k) out.scale.push_back(float_from_half(geometry[k]) * scale_unit);
  out.opacity.push_back(float_from_half(geometry[7]));
  for (int k = 0; k < 3 * sh_coefficients(shape.sh_degree); ++k) {
    const int degree = sh_degree_of(k / 3);
    const auto step = read<float>(at(3, set) + sizeof(float) * static_cast<std::size_t>(3 * degree + k % 3));
    out.sh.push_back(dequantize_sh(read<std::int8_t>(at(2, row) + k), step));
  }
}

}  // namespace

namespace {

/// The content of a workspace: it grows, and a frame that does not fit releases it.
struct FakeContent {
  FrameWorkspace& workspace;
  std::uint64_t held;
  void* memory = nullptr;

  FakeContent(FrameWorkspace& of, std::uint64_t bytes) : workspace(of), held(bytes) {
    workspace.take(held);
    cudaMalloc(&memory, held);
  }
  FakeContent(const FakeContent&) = delete;
  FakeContent& operator=(const FakeContent&) = delete;
  ~FakeContent() {
    workspace.release(held);
    cudaFree(memory);
  }
};

bool reserve(FrameWorkspace& workspace, std::uint64_t bytes) {
  if (workspace.held() >= bytes) return true;
  workspace.content.reset();
  if (workspace.fits(bytes)) workspace.content = std::make_shared<FakeContent>(workspace, bytes);
  return workspace.content != nullptr;
}

}  // namespace

struct CudaBackend::Impl {
  int device;
  ReferenceRenderer renderer{1, true};
};

CudaBackend::CudaBackend(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
CudaBackend::CudaBackend(CudaBackend&&) noexcept = default;
CudaBackend::~CudaBackend() = default;

Result<CudaBackend> CudaBackend::create(std::optional<int> device) {
  if (test::FakeCuda::current() == nullptr)
    return make_error(Errc::unavailable, Error::kNone, "the test has no device now");
  return CudaBackend(std::unique_ptr<Impl>(new Impl{device.value_or(0)}));
}
Status CudaBackend::prepare(const Scene&) {
  return make_error(Errc::unavailable, Error::kNone, "the test's device draws streamed scenes alone");
}
Result<FrameStats> CudaBackend::render(const Scene&, const Camera&, const RenderTarget&, const RenderOptions&) {
  return make_error(Errc::unavailable, Error::kNone, "the test's device draws streamed scenes alone");
}

// Drawn pages are read slowly: nobody may write them meanwhile.
Result<FrameStats> CudaBackend::render(const SlotDraw& draw, const Camera& camera, const RenderTarget& target,
                                       const RenderOptions& options) {
  test::FakeCuda& cuda = *test::FakeCuda::current();
  const std::scoped_lock lock(draw.slots.workspace().drawing);
  if (cuda.workspace_bytes > 0 && !reserve(draw.slots.workspace(), cuda.workspace_bytes * draw.gaussians)) {
    ++cuda.n_unfit;
    return make_error(Errc::device_out_of_memory, Error::kNone, "the test's workspace is too small",
                      cuda.workspace_bytes * draw.gaussians);
  }
  const SlotShape& shape = draw.slots.plan().shape;
  Drawn drawn;
  for (const std::uint32_t chunk : draw.chunks) {
    const std::uint64_t first = std::uint64_t{chunk} * shape.chunk_size;
    for (const std::size_t k : {0u, 1u, 2u, 4u}) {
      const std::uint64_t row_bytes = section_row_bytes(shape.sh_degree)[k];
      const std::byte* const from = draw.slots.at(k, 0) + (k == 4 ? chunk : first) * row_bytes;
      const std::uint64_t bytes = (k == 4 ? 1 : shape.chunk_size) * row_bytes;
      if (!cuda.is_allocated(from, bytes) || cuda.is_written(from, bytes)) ++cuda.n_faults;
    }
    for (std::uint64_t j = 0; j < shape.chunk_size; ++j) add_row(draw, first + j, drawn);
    std::this_thread::yield();
  }
  if (drawn.opacity.size() != draw.gaussians) ++cuda.n_faults;
  const auto detail = drawn_detail(options, true);
  if (!detail) return tl::unexpected(detail.error());
  const auto settings = resolve(with_levels(options, *detail), draw.declarations, Backend::cpu);
  if (!settings) return tl::unexpected(settings.error());
  const std::array parts{ScenePart{draw.gaussians, drawn.mean.data(), drawn.rotation.data(), drawn.scale.data(),
                                   drawn.opacity.data(), drawn.sh.data()}};
  auto stats = impl_->renderer.render({shape.sh_degree, draw.declarations.origin, parts}, camera, target, *settings);
  if (stats) stats->bytes = draw.slots.workspace().held();
  return stats;
}
// Writes a camera's focal length into the first code of its picture.
Result<std::vector<FrameStats>> CudaBackend::render_all(const Scene&, std::span<const Camera> cameras,
                                                        const PictureArrays& pictures, const RenderOptions&) {
  std::vector<FrameStats> stats(cameras.size());
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    const auto focal_px = static_cast<std::uint8_t>(cameras[i].fx);
    if (cameras[i].name == "fails")
      return make_error(Errc::device_failed, Error::kNone, "the test's camera fails", Error::kNone, focal_px);
    *pictures_from(pictures, i, pixels_of(cameras[i])).codes = focal_px;
    stats[i].gaussians = static_cast<std::uint64_t>(impl_->device);
  }
  return stats;
}
Result<DeviceBlock> CudaBackend::allocate(std::uint64_t) const {
  return make_error(Errc::unavailable, Error::kNone, "the test's device draws streamed scenes alone");
}
const char* CudaBackend::name() const {
  return "cuda of the tests";
}

}  // namespace rgs::detail
