// device_scene.cpp - scenes into device memory: FP32 attributes, or a file's sections in their direct layout.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/device_scene.hpp"

#include <cassert>
#include <cmath>
#include <memory>
#include <span>

namespace rgs {
namespace {

using detail::device_status;

constexpr std::uint64_t kMaxGaussians = std::uint64_t{1} << 31;

Status check_size(std::uint64_t n) {
  if (n < kMaxGaussians) return {};
  return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer numbers", kMaxGaussians - 1,
                    n);
}

// Copies from pageable memory may still be on their way when they return, and streams of the caller do not wait for them.
Status wait_for_copies() {
  return device_status(cudaStreamSynchronize(nullptr), "a scene could not be copied to the device");
}

// One allocation for several arrays, each at a multiple of 256 bytes.
class Uploader {
 public:
  void add(std::span<const std::byte> bytes) { total_ += aligned(bytes.size()); }
  Status allocate(detail::DeviceBuffer& buffer) {
    if (const auto ok = buffer.reserve(total_); !ok) return ok;
    base_ = buffer.as<std::byte>();
    return {};
  }
  // Called in the order of add().
  const std::byte* copy(std::span<const std::byte> bytes, Status& status) {
    const std::byte* const place = base_;
    if (status && !bytes.empty()) {
      status = device_status(cudaMemcpy(base_, bytes.data(), bytes.size(), cudaMemcpyHostToDevice),
                             "a scene could not be copied to the device");
    }
    base_ += aligned(bytes.size());
    return place;
  }

 private:
  static std::uint64_t aligned(std::uint64_t bytes) { return (bytes + 255) / 256 * 256; }
  std::uint64_t total_ = 0;
  std::byte* base_ = nullptr;
};

}  // namespace

Result<DeviceScene> DeviceScene::upload(const SceneView& scene) {
  if (const auto ok = check_size(scene.n); !ok) return tl::unexpected(ok.error());
  auto storage = std::make_shared<Storage>();
  storage->n = scene.n;
  storage->sh_degree = scene.sh_degree;
  Uploader uploader;
  const std::span<const float> arrays[] = {scene.mean, scene.rotation, scene.scale, scene.opacity, scene.sh};
  for (const auto& array : arrays) uploader.add(std::as_bytes(array));
  Status ok = uploader.allocate(storage->memory);
  if (!ok) return tl::unexpected(ok.error());
  const float* placed[5];
  for (int k = 0; k < 5; ++k) placed[k] = reinterpret_cast<const float*>(uploader.copy(std::as_bytes(arrays[k]), ok));
  if (ok) ok = wait_for_copies();
  if (!ok) return tl::unexpected(ok.error());
  storage->attributes = cuda::Fp32Attributes{placed[0], placed[1], placed[2], placed[3], placed[4], scene.sh_degree};
  DeviceScene result;
  result.storage_ = std::move(storage);
  return result;
}

Result<DeviceScene> DeviceScene::upload(const FileView& file) {
  if (const auto ok = check_size(file.header().n_gaussians); !ok) return tl::unexpected(ok.error());
  const auto data = load_direct(file);
  if (!data) return tl::unexpected(data.error());
  return upload(*data);
}

Result<DeviceScene> DeviceScene::upload(const DirectData& data) {
  const Header& header = data.header();
  assert(data.size() == header.n_gaussians);
  if (const auto ok = check_size(data.size()); !ok) return tl::unexpected(ok.error());
  auto storage = std::make_shared<Storage>();
  storage->n = header.n_gaussians;
  storage->sh_degree = header.sh_degree;
  storage->declarations = data.file().declarations();
  Uploader uploader;
  const std::span<const std::byte> sections[] = {data.means(), data.geometry(), data.sh(), data.step_table(),
                                                 data.chunk_table()};
  for (const auto& section : sections) uploader.add(section);
  Status ok = uploader.allocate(storage->memory);
  if (!ok) return tl::unexpected(ok.error());
  const std::byte* placed[5];
  for (int k = 0; k < 5; ++k) placed[k] = uploader.copy(sections[k], ok);
  if (ok) ok = wait_for_copies();
  if (!ok) return tl::unexpected(ok.error());
  storage->attributes = cuda::CompactAttributes{
      reinterpret_cast<const float*>(placed[0]),         reinterpret_cast<const std::uint16_t*>(placed[1]),
      reinterpret_cast<const std::uint32_t*>(placed[2]), reinterpret_cast<const float*>(placed[3]),
      reinterpret_cast<const std::uint32_t*>(placed[4]), header.chunk_size,
      std::ldexp(1.0F, -header.scale_exponent),          header.sh_degree};
  DeviceScene result;
  result.storage_ = std::move(storage);
  return result;
}

std::uint64_t DeviceScene::size() const {
  return storage_ ? storage_->n : 0;
}
int DeviceScene::sh_degree() const {
  return storage_ ? storage_->sh_degree : 0;
}
bool DeviceScene::compact() const {
  return storage_ && std::holds_alternative<cuda::CompactAttributes>(storage_->attributes);
}
std::uint64_t DeviceScene::bytes() const {
  return storage_ ? storage_->memory.bytes() : 0;
}
const std::optional<Declarations>& DeviceScene::declarations() const {
  static const std::optional<Declarations> kNone;
  return storage_ ? storage_->declarations : kNone;
}

}  // namespace rgs
