// picture_batch.cpp - draws pictures of several cameras with several renderers in turn.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/picture_batch.hpp"

#include <algorithm>
#include <cstdint>
#include <optional>
#include <utility>

#include "render_options.hpp"

namespace rgs::detail {
namespace {

constexpr std::size_t kLanes = 8;
// Device memory of pictures that are copied to the host together.
constexpr std::uint64_t kStagedBytes = std::uint64_t{64} << 20;

Status check_place(const void* data) {
  if (data == nullptr) return {};
  int device = 0;
  cudaPointerAttributes attributes{};
  Status ok = device_status(cudaGetDevice(&device), "the current device could not be read");
  if (ok) ok = device_status(cudaPointerGetAttributes(&attributes, data), "an output's memory could not be inspected");
  if (!ok) return ok;
  const bool is_on_device = attributes.type == cudaMemoryTypeManaged ||
                            (attributes.type == cudaMemoryTypeDevice && attributes.device == device);
  if (is_on_device) return {};
  return make_error(Errc::bad_argument, Error::kNone, "an output is not in the memory of the renderer's device");
}

}  // namespace

Result<std::vector<FrameStats>> PictureBatch::render(const DeviceScene& scene, std::span<const Camera> cameras,
                                                     const PictureArrays& pictures, const RenderOptions& options) {
  if (cameras.empty()) return std::vector<FrameStats>();
  return pictures.on_device ? render_on_device(scene, cameras, pictures, options)
                            : render_to_host(scene, cameras, pictures, options);
}

Status PictureBatch::add_lane() {
  auto lane = std::make_unique<Lane>();
  if (Status ok = lane->stream.create(); !ok) return ok;
  if (lanes_.empty()) {
    lane->renderer = &first_;
  } else {
    auto renderer = CudaRenderer::create({.frames_in_flight = kFramesInFlight, .overlapping = false});
    if (!renderer) return tl::unexpected(renderer.error());
    lane->own = std::make_unique<CudaRenderer>(*std::move(renderer));
    lane->renderer = lane->own.get();
  }
  lanes_.push_back(std::move(lane));
  return {};
}

Result<std::vector<FrameStats>> PictureBatch::render_on_device(const DeviceScene& scene,
                                                               std::span<const Camera> cameras,
                                                               const PictureArrays& pictures,
                                                               const RenderOptions& options) {
  Status ok;
  for (const void* data : {static_cast<const void*>(pictures.rgb), static_cast<const void*>(pictures.codes),
                           static_cast<const void*>(pictures.alpha), static_cast<const void*>(pictures.depth)}) {
    if (ok) ok = check_place(data);
  }
  Event begun;
  if (ok) ok = begun.create();
  if (ok) ok = begun.record(pictures.stream);
  if (ok && lanes_.empty()) ok = add_lane();
  if (!ok) return tl::unexpected(ok.error());

  RenderOptions how = options;
  how.measure.timings = true;
  how.measure.stage_timings = cameras.size() == 1;
  how.turbo.asynchronous = cameras.size() > 1;
  const std::uint64_t n_pixels = pixels_of(cameras.front());
  std::vector<FrameStats> stats(cameras.size());
  const auto draw_by = [&](std::size_t n_lanes, std::size_t first) {
    std::vector<Lane*> lanes;
    for (std::size_t i = 0; i < n_lanes; ++i) lanes.push_back(lanes_[i].get());
    Status done;
    for (Lane* const lane : lanes) {
      if (done) done = begun.hold(lane->stream.get());
    }
    std::vector<FrameStats> drawn;
    if (done) done = draw(scene, cameras.subspan(first), pictures_from(pictures, first, n_pixels), how, lanes, drawn);
    std::ranges::copy(drawn, stats.begin() + static_cast<std::ptrdiff_t>(first));
    return done;
  };
  // The first one shows how much memory a renderer takes.
  std::size_t n_drawn = 0;
  if (cameras.size() > 1 && lanes_.size() == 1) {
    const std::span<const Camera> all = std::exchange(cameras, cameras.first(1));
    ok = draw_by(1, 0);
    cameras = all;
    if (!ok) return tl::unexpected(ok.error());
    n_drawn = 1;
    const std::size_t n_lanes = std::min(kLanes, 1 + room_for(first_.bytes()));
    while (ok && lanes_.size() < n_lanes) ok = add_lane();
    if (!ok) lanes_.resize(1);  // one is enough
  }
  ok = draw_by(std::min(lanes_.size(), cameras.size()), n_drawn);
  if (!ok && ok.error().code == Errc::device_out_of_memory && lanes_.size() > 1) {
    lanes_.resize(1);
    ok = draw_by(1, n_drawn);
  }
  if (!ok) return tl::unexpected(ok.error());
  return stats;
}

// No lane is running on return.
Status PictureBatch::draw(const DeviceScene& scene, std::span<const Camera> cameras, const PictureArrays& pictures,
                          const RenderOptions& options, std::span<Lane* const> lanes, std::vector<FrameStats>& stats) {
  const std::uint64_t n_pixels = pixels_of(cameras.front());
  Status ok;
  const auto keep = [&ok](const Status& status) {
    if (ok && !status) ok = status;
  };
  stats.resize(cameras.size());
  const auto finish = [&](std::size_t i) {
    const auto drawn = lanes[i % lanes.size()]->renderer->finish_oldest();
    drawn ? void(stats[i] = *drawn) : keep(tl::unexpected(drawn.error()));
  };
  const auto settings = resolve(options, scene.declarations(), Backend::cuda);
  const bool is_queued = settings && settings->cuda.asynchronous;
  const std::size_t most = lanes.size() * (is_queued ? kFramesInFlight : 1);
  std::size_t n_queued = 0;
  for (; n_queued < cameras.size(); ++n_queued) {
    if (n_queued >= most) finish(n_queued - most);
    if (!ok) break;
    const Lane& lane = *lanes[n_queued % lanes.size()];
    const PictureArrays place = pictures_from(pictures, n_queued, n_pixels);
    DeviceTarget target;
    target.rgb = place.rgb;
    target.alpha = place.alpha;
    target.depth = place.depth;
    target.codes = place.codes;
    const auto queued = lane.renderer->render(scene, cameras[n_queued], target, options, lane.stream.get());
    if (!queued) {
      keep(tl::unexpected(queued.error()));
      break;
    }
  }
  for (std::size_t i = n_queued - std::min(n_queued, most); i < n_queued; ++i) finish(i);
  for (Lane* const lane : lanes)
    keep(device_status(cudaStreamSynchronize(lane->stream.get()), "pictures could not be made"));
  return ok;
}

Result<std::vector<FrameStats>> PictureBatch::render_to_host(const DeviceScene& scene, std::span<const Camera> cameras,
                                                             const PictureArrays& pictures,
                                                             const RenderOptions& options) {
  const std::uint64_t n_pixels = pixels_of(cameras.front());
  struct Way {
    DeviceBuffer& buffer;
    void* to;
    std::uint64_t bytes;  // of a picture
  };
  const Way ways[] = {{rgb_, pictures.rgb, n_pixels * 12},
                      {codes_, pictures.codes, n_pixels * 3},
                      {alpha_, pictures.alpha, n_pixels * 4},
                      {depth_, pictures.depth, n_pixels * 4}};
  std::uint64_t picture_bytes = 1;
  for (const Way& way : ways) picture_bytes += way.to == nullptr ? 0 : way.bytes;
  const auto most = static_cast<std::size_t>(std::max<std::uint64_t>(kStagedBytes / picture_bytes, 1));
  PictureArrays staged;
  staged.on_device = true;
  std::vector<FrameStats> stats;
  for (std::size_t first = 0; first < cameras.size(); first += most) {
    const auto part = cameras.subspan(first, std::min(most, cameras.size() - first));
    Status ok;
    for (const Way& way : ways) {
      if (ok && way.to != nullptr) ok = way.buffer.reserve(part.size() * way.bytes, memory_, nullptr);
    }
    if (!ok) return tl::unexpected(ok.error());
    const auto staged_in = [](const Way& way, auto*& data) {
      if (way.to != nullptr) data = way.buffer.as<std::remove_reference_t<decltype(*data)>>();
    };
    staged_in(ways[0], staged.rgb);
    staged_in(ways[1], staged.codes);
    staged_in(ways[2], staged.alpha);
    staged_in(ways[3], staged.depth);
    const auto drawn = render_on_device(scene, part, staged, options);
    if (!drawn) return drawn;
    stats.insert(stats.end(), drawn->begin(), drawn->end());
    for (const Way& way : ways) {
      if (ok && way.to != nullptr) {
        ok = copy_to_host(static_cast<std::byte*>(way.to) + first * way.bytes, way.buffer.as<void>(),
                          part.size() * way.bytes, lanes_.front()->stream,
                          "pictures could not be copied from the device");
      }
    }
    if (!ok) return tl::unexpected(ok.error());
  }
  return stats;
}

}  // namespace rgs::detail
