// cut_stage.cpp - room for what a frame draws of a scene with levels of detail, and the launches that choose it.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/cut_stage.hpp"

#include <algorithm>

#include "cuda/workspace_growth.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kFirstRows = std::uint64_t{1} << 16;  // before a frame has shown how many there are

std::uint32_t n_all_rows(const SceneStorage& scene) {
  return static_cast<std::uint32_t>(scene.n_rows());
}

}  // namespace

// Chunks that there is memory for.
std::uint64_t CutStage::held(const SceneStorage& scene) const {
  const std::uint64_t rows = std::min(order_.bytes(), rank_.bytes()) / sizeof(std::uint32_t);
  return std::min(chunks_.bytes() / sizeof(std::uint32_t), rows / scene.pages->chunk_size);
}

std::uint64_t CutStage::bytes() const {
  std::uint64_t sum = 0;
  for (const DeviceBuffer* b : {&sums_, &chunks_, &places_, &bits_, &bit_sums_, &order_, &rank_}) sum += b->bytes();
  return sum;
}

Status CutStage::reserve(const SceneStorage& scene, std::uint64_t n_chunks, std::uint64_t max_chunks,
                         const Reserve& reserve) {
  const ScenePages& pages = *scene.pages;
  const std::uint64_t word = sizeof(std::uint32_t), limit = std::min(max_chunks, pages.n_chunks);
  Status ok = reserve(sums_, (std::uint64_t{cuda::cut_blocks(pages.n_pages)} + 1) * sizeof(cuda::CutCounts));
  if (ok) ok = reserve(places_, pages.n_chunks * word);
  if (ok) ok = reserve(bits_, cuda::drawn_ties_words(n_all_rows(scene)) * word);
  if (ok) ok = reserve(bit_sums_, cuda::drawn_ties_blocks(n_all_rows(scene)) * word);
  const std::uint64_t before = held(scene);
  const std::uint64_t guess = std::max<std::uint64_t>(kFirstRows / pages.chunk_size, 1);
  const std::uint64_t least = std::min(n_chunks != 0 ? n_chunks : before != 0 ? before : guess, limit);
  if (ok && before < least) {
    ok = reserve_growing([&](bool is_generous) {
      const std::uint64_t n = is_generous ? with_room_to_grow(least, before, limit) : least;
      Status grown = reserve(chunks_, n * word);
      for (DeviceBuffer* b : {&order_, &rank_}) {
        if (grown) grown = reserve(*b, n * pages.chunk_size * word);
      }
      if (!grown) chunks_ = {}, order_ = {}, rank_ = {};  // what has grown would keep the memory that the others need
      return grown;
    });
  }
  capacity_ = ok ? std::min(held(scene), limit) : 0;
  return ok;
}

cuda::DrawnChunks CutStage::drawn(const SceneStorage& scene) const {
  return {chunks_.as<std::uint32_t>(), sums_.as<cuda::CutCounts>() + cuda::cut_blocks(scene.pages->n_pages),
          static_cast<std::uint32_t>(capacity_)};
}

Status CutStage::launch(const SceneStorage& scene, const cuda::CutEye& eye, bool by_row, CudaStream stream) const {
  const ScenePages& pages = *scene.pages;
  auto* const sums = sums_.as<cuda::CutCounts>();
  const cuda::DrawnChunks list = drawn(scene);
  const Status ok = cuda::launch_cut(
      {pages.table.as<cuda::CutPage>(), pages.n_pages, eye, sums, sums + cuda::cut_blocks(pages.n_pages), seen_.get(),
       chunks_.as<std::uint32_t>(), list.capacity, places_.as<std::uint32_t>()},
      stream);
  if (!ok) return ok;
  return cuda::launch_drawn_ties({list, places_.as<std::uint32_t>(), pages.chunk_size, scene.tie_order(),
                                  n_all_rows(scene), bits_.as<std::uint32_t>(), bit_sums_.as<std::uint32_t>(),
                                  order_.as<std::uint32_t>(), by_row ? nullptr : rank_.as<std::uint32_t>()},
                                 stream);
}

}  // namespace rgs::detail
