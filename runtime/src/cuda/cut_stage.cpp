// cut_stage.cpp - memory for a frame's cut of a scene with levels of detail, and the launches that compute it.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/cut_stage.hpp"

#include <algorithm>
#include <variant>

#include "cuda/workspace_growth.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kFirstRows = std::uint64_t{1} << 16;  // before a frame has shown how many it draws

}  // namespace

// Chunks that the buffers have room for.
std::uint64_t CutStage::held(const DeviceBuffer& splats, std::uint64_t splat_bytes) const {
  return std::min(chunks_.bytes() / sizeof(std::uint32_t), splats.bytes() / splat_bytes);
}

std::uint64_t CutStage::bytes() const {
  std::uint64_t sum = 0;
  for (const DeviceBuffer* b : {&counts_, &limit_, &chosen_, &in_view_, &chunks_}) sum += b->bytes();
  return sum;
}

Status CutStage::reserve(const SceneStorage& scene, std::uint64_t n_chunks, DeviceBuffer& splats,
                         std::uint64_t chunk_splats, const Reserve& reserve) {
  if (const auto ok = check_splats(n_chunks * chunk_splats); !ok) return ok;
  const ScenePages& pages = *scene.pages;
  const std::uint64_t splat_bytes = chunk_splats * sizeof(cuda::ScreenSplat);  // of a chunk
  const std::uint64_t word = sizeof(std::uint32_t);
  const std::uint64_t limit = std::min(pages.n_chunks, kMaxSplats / chunk_splats);
  const std::uint32_t n_blocks = pages.chosen ? 0 : cuda::cut_blocks(pages.n_pages);
  Status ok = reserve(counts_, (std::uint64_t{2} + n_blocks) * sizeof(cuda::CutCounts));
  if (ok && !pages.chosen) ok = reserve(limit_, sizeof(cuda::CutLimit));
  if (ok) ok = reserve(chosen_, pages.n_chunks * word);
  if (ok) ok = reserve(in_view_, cuda::cull_blocks(static_cast<std::uint32_t>(pages.n_chunks)) * word);
  const std::uint64_t before = held(splats, splat_bytes);
  const std::uint64_t guess = std::max<std::uint64_t>(kFirstRows / pages.chunk_size, 1);
  const std::uint64_t least = std::min(n_chunks != 0 ? n_chunks : before != 0 ? before : guess, limit);
  if (ok && before < least) {
    ok = reserve_growing([&](bool is_generous) {
      const std::uint64_t n = is_generous ? with_room_to_grow(least, before, limit) : least;
      Status grown = reserve(chunks_, n * word);
      if (grown) grown = reserve(splats, n * splat_bytes);
      if (!grown) chunks_ = {}, splats = {};  // grown buffers would hold memory that the others need
      return grown;
    });
  }
  capacity_ = ok ? std::min(held(splats, splat_bytes), limit) : 0;
  return ok;
}

cuda::DrawnChunks CutStage::drawn() const {
  return {chunks_.as<std::uint32_t>(), counts_.as<cuda::CutCounts>() + 1, static_cast<std::uint32_t>(capacity_)};
}

// The chunks of the cut's pages: chosen on the device, or copied from the host.
Status CutStage::launch_choice(const SceneStorage& scene, const Choice& choice, CudaStream stream) const {
  const ScenePages& pages = *scene.pages;
  auto* const counts = counts_.as<cuda::CutCounts>();
  auto* const chosen = chosen_.as<std::uint32_t>();
  if (!pages.chosen) {
    return cuda::launch_cut({pages.table.as<cuda::CutPage>(), pages.n_pages, choice.eye, counts + 2, counts, chosen,
                             limit_.as<cuda::CutLimit>()},
                            stream);
  }
  *choice.seen = pages.chosen->counts;
  const Status ok =
      device_status(cudaMemcpyAsync(counts, choice.seen, sizeof(cuda::CutCounts), cudaMemcpyHostToDevice, stream),
                    "the number of chosen chunks could not be copied to the device");
  if (!ok) return ok;
  return device_status(cudaMemcpyAsync(chosen, pages.chosen->chunks.data(), pages.chosen->chunks.size_bytes(),
                                       cudaMemcpyHostToDevice, stream),
                       "the list of chosen chunks could not be copied to the device");
}

Status CutStage::launch(const SceneStorage& scene, const Choice& choice, CudaStream stream) const {
  const Status ok = launch_choice(scene, choice, stream);
  if (!ok) return ok;
  auto* const counts = counts_.as<cuda::CutCounts>();
  return cuda::launch_cull(
      {chosen_.as<std::uint32_t>(), counts, static_cast<std::uint32_t>(scene.pages->n_chunks),
       std::get<cuda::PagedAttributes>(scene.attributes).chunks, choice.view, choice.by_view,
       in_view_.as<std::uint32_t>(), counts + 1, choice.seen, chunks_.as<std::uint32_t>(), drawn().capacity},
      stream);
}

}  // namespace rgs::detail
