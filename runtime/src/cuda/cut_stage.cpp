// cut_stage.cpp - memory for a frame's cut of a scene with levels of detail, and the launches that compute it.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/cut_stage.hpp"

#include <algorithm>
#include <variant>

#include "common/tie_order.hpp"
#include "cuda/workspace_growth.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kFirstRows = std::uint64_t{1} << 16;  // before a frame has shown how many it draws

std::uint32_t n_all_rows(const SceneStorage& scene) {
  return static_cast<std::uint32_t>(scene.n_rows());
}

}  // namespace

// Chunks that the buffers have room for.
std::uint64_t CutStage::held(const SceneStorage& scene, Order order, const DeviceBuffer& splats) const {
  std::uint64_t rows = splats.bytes() / sizeof(cuda::ScreenSplat);
  if (order != Order::none) rows = std::min(rows, std::min(order_.bytes(), rank_.bytes()) / sizeof(std::uint32_t));
  return std::min(chunks_.bytes() / sizeof(std::uint32_t), rows / scene.pages->chunk_size);
}

std::uint64_t CutStage::bytes() const {
  std::uint64_t sum = 0;
  for (const DeviceBuffer* b :
       {&counts_, &chosen_, &in_view_, &chunks_, &places_, &bits_, &bit_sums_, &order_, &rank_, &sort_})
    sum += b->bytes();
  return sum;
}

Status CutStage::reserve(const SceneStorage& scene, std::uint64_t n_chunks, std::uint64_t max_chunks, Order order,
                         DeviceBuffer& splats, const Reserve& reserve) {
  const ScenePages& pages = *scene.pages;
  const std::uint64_t word = sizeof(std::uint32_t), limit = std::min(max_chunks, pages.n_chunks);
  const auto n_all = static_cast<std::uint32_t>(pages.n_chunks);
  const std::uint32_t n_blocks = pages.chosen ? 0 : cuda::cut_blocks(pages.n_pages);
  Status ok = reserve(counts_, (std::uint64_t{2} + n_blocks) * sizeof(cuda::CutCounts));
  if (pages.chosen) {
    n_chunks = std::max<std::uint64_t>(pages.chosen->chunks.size(), 1);
  } else {
    if (ok) ok = reserve(chosen_, pages.n_chunks * word);
    if (ok) ok = reserve(in_view_, cuda::cull_blocks(n_all) * word);
    if (ok) ok = reserve(places_, pages.n_chunks * word);
    if (ok) ok = reserve(bits_, cuda::drawn_ties_words(n_all_rows(scene)) * word);
    if (ok) ok = reserve(bit_sums_, cuda::drawn_ties_blocks(n_all_rows(scene)) * word);
  }
  const bool sorts = pages.chosen && order != Order::none;
  const auto reserve_sort = [&](std::uint64_t chunks) -> Status {
    const auto bytes = cuda::tie_order_bytes(static_cast<std::uint32_t>(chunks * pages.chunk_size));
    return bytes ? reserve(sort_, *bytes) : Status(tl::unexpected(bytes.error()));
  };
  // Grown buffers would hold memory that the others need.
  const auto forget = [&] { chunks_ = {}, order_ = {}, rank_ = {}, sort_ = {}, splats = {}; };
  const std::uint64_t before = held(scene, order, splats);
  const std::uint64_t guess = std::max<std::uint64_t>(kFirstRows / pages.chunk_size, 1);
  const std::uint64_t least = std::min(n_chunks != 0 ? n_chunks : before != 0 ? before : guess, limit);
  if (ok && before < least) {
    ok = reserve_growing([&](bool is_generous) {
      const std::uint64_t n = is_generous ? with_room_to_grow(least, before, limit) : least;
      Status grown = reserve(chunks_, n * word);
      for (DeviceBuffer* b : {&order_, &rank_}) {
        if (grown && order != Order::none) grown = reserve(*b, n * pages.chunk_size * word);
      }
      if (grown) grown = reserve(splats, n * pages.chunk_size * sizeof(cuda::ScreenSplat));
      if (grown && sorts) grown = reserve_sort(n);
      if (!grown) forget();
      return grown;
    });
  }
  capacity_ = ok ? std::min(held(scene, order, splats), limit) : 0;
  if (!ok || !sorts) return ok;
  // Frames of other scenes, or without this order, may have grown the rest alone.
  ok = reserve_sort(capacity_);
  if (!ok) {
    forget();
    capacity_ = 0;
  }
  return ok;
}

cuda::DrawnChunks CutStage::drawn() const {
  return {chunks_.as<std::uint32_t>(), counts_.as<cuda::CutCounts>() + 1, static_cast<std::uint32_t>(capacity_)};
}

cuda::ChosenRows CutStage::rows(const SceneStorage& scene) const {
  return {std::get<cuda::PagedAttributes>(scene.attributes), chunks_.as<std::uint32_t>()};
}

// Copies the list to the device and sorts its rows in tie order if wanted: slots hold other rows from frame to frame,
// so there is no order of all rows to take it from. Draws nothing if the list does not fit.
Status CutStage::launch_chosen(const SceneStorage& scene, Order order, CudaStream stream) const {
  const ChosenChunks& chosen = *scene.pages->chosen;
  const bool has_room = chosen.chunks.size() <= capacity_;
  *seen_.get() = chosen.counts;
  Status ok = device_status(cudaMemcpyAsync(counts_.as<cuda::CutCounts>() + 1, seen_.get(), sizeof(cuda::CutCounts),
                                            cudaMemcpyHostToDevice, stream),
                            "the number of drawn chunks could not be copied to the device");
  if (!ok || !has_room || chosen.chunks.empty()) return ok;
  ok = device_status(cudaMemcpyAsync(chunks_.as<void>(), chosen.chunks.data(), chosen.chunks.size_bytes(),
                                     cudaMemcpyHostToDevice, stream),
                     "the list of drawn chunks could not be copied to the device");
  if (!ok || order == Order::none) return ok;
  return cuda::launch_chosen_ties(
      {rows(scene), static_cast<std::uint32_t>(chosen.chunks.size()), order_.as<std::uint32_t>(),
       order == Order::of_rows ? nullptr : rank_.as<std::uint32_t>(), sort_.as<void>(), sort_.bytes()},
      stream);
}

Status CutStage::launch(const SceneStorage& scene, const Choice& choice, CudaStream stream) const {
  const ScenePages& pages = *scene.pages;
  if (pages.chosen) return launch_chosen(scene, choice.order, stream);
  auto* const counts = counts_.as<cuda::CutCounts>();
  auto* const chosen = chosen_.as<std::uint32_t>();
  auto* const places = places_.as<std::uint32_t>();
  Status ok = cuda::launch_cut({pages.table.as<cuda::CutPage>(), pages.n_pages, choice.eye, counts + 2, counts, chosen},
                               stream);
  if (ok) {
    ok = cuda::launch_cull(
        {chosen, counts, static_cast<std::uint32_t>(pages.n_chunks),
         std::get<cuda::PagedAttributes>(scene.attributes).chunks, choice.view, choice.by_view,
         in_view_.as<std::uint32_t>(), counts + 1, seen_.get(), chunks_.as<std::uint32_t>(), drawn().capacity, places},
        stream);
  }
  if (!ok) return ok;
  return cuda::launch_drawn_ties({drawn(), places, pages.chunk_size, scene.tie_order(), n_all_rows(scene),
                                  bits_.as<std::uint32_t>(), bit_sums_.as<std::uint32_t>(), order_.as<std::uint32_t>(),
                                  choice.order == Order::of_rows ? nullptr : rank_.as<std::uint32_t>()},
                                 stream);
}

}  // namespace rgs::detail
