// device_slots.cpp - one allocation for a pool's pages, and copies into it through page-locked memory.
// SPDX-License-Identifier: Apache-2.0
#include "stream/device_slots.hpp"

#include <array>
#include <utility>

#include "common/copy_pieces.hpp"
#include "common/device_code.hpp"
#include "cuda/cuda_objects.hpp"
#include "cuda/uploader.hpp"
#include "page_sections.hpp"
#include "rgs/splat_cloud.hpp"
#include "stream/stream_times.hpp"

namespace rgs::detail {
namespace {

// Pieces are whole rows, and of Gaussians whole chunks, whose size is a multiple of kMinChunkSize.
constexpr bool pieces_are_whole() {
  for (int degree = 0; degree <= kMaxShDegree; ++degree) {
    const auto row = section_row_bytes(degree);
    for (std::size_t k = 0; k < row.size(); ++k) {
      if ((k < 3 ? kMinChunkSize : 1) * row[k] % cuda::Pieces::kAlignment != 0) return false;
    }
  }
  return true;
}
static_assert(pieces_are_whole());

}  // namespace

Result<std::shared_ptr<DeviceSlots>> DeviceSlots::create(const SlotShape& shape, std::uint64_t device_memory,
                                                         std::uint64_t workspace_memory) {
  const auto plan = plan_slots(shape, device_memory);
  if (!plan) return tl::unexpected(plan.error());
  const std::shared_ptr<DeviceSlots> slots(new DeviceSlots);
  slots->plan_ = *plan;
  slots->workspace_ = std::make_unique<FrameWorkspace>(workspace_memory);
  int n_devices = 0;
  if (cudaGetDeviceCount(&n_devices) != cudaSuccess || n_devices == 0 ||
      cudaGetDevice(&slots->device_) != cudaSuccess) {
    cudaGetLastError();
    return make_error(Errc::unavailable, Error::kNone, "no CUDA device answers, so a pool cannot have device memory");
  }
  if (const Status ok = cuda::check_device_code(); !ok) return tl::unexpected(ok.error());
  void* memory = nullptr;
  const cudaError_t error = cudaMalloc(&memory, plan->bytes);
  if (error == cudaErrorMemoryAllocation) {
    cudaGetLastError();
    return make_error(Errc::device_out_of_memory, Error::kNone,
                      "the device has less free memory than the pool's budget", plan->bytes);
  }
  if (Status ok = device_status(error, "device memory cannot be allocated"); !ok) return tl::unexpected(ok.error());
  slots->memory_ = static_cast<std::byte*>(memory);
  slots->free_.reserve(plan->n_slots);
  for (std::uint32_t slot = plan->n_slots; slot-- > 0;) slots->free_.push_back(slot);
  return slots;
}

DeviceSlots::~DeviceSlots() {
  if (memory_ == nullptr) return;
  const OnDevice here(device_);
  workspace_.reset();
  if (here.status()) cudaFree(memory_);
}

// If it fails, each write() reports it.
void DeviceSlots::stay_on_device() const {
  static_cast<void>(device_status(cudaSetDevice(device_), OnDevice::kNotCurrent));
}

struct SlotWriter::Impl {
  static constexpr std::size_t kMostSent = 16;

  explicit Impl(std::shared_ptr<const DeviceSlots> of) : slots(std::move(of)) {}
  Impl(const Impl&) = delete;
  Impl& operator=(const Impl&) = delete;

  Status send();
  Result<std::byte*> take(std::uint64_t bytes);

  std::shared_ptr<const DeviceSlots> slots;
  OwnedStream stream;
  Uploader ring;        // waits for what the stream does, so freed before it
  cuda::Pieces pieces;  // staged and not sent
  Ticket last = 0;      // their ticket, or that of the last send
};

SlotWriter::SlotWriter(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
SlotWriter::SlotWriter(SlotWriter&&) noexcept = default;
SlotWriter::~SlotWriter() = default;

Result<SlotWriter> SlotWriter::create(std::shared_ptr<const DeviceSlots> slots, std::uint32_t n_staged) {
  auto impl = std::make_unique<Impl>(std::move(slots));
  const OnDevice here(impl->slots->device());
  Status ok = here.status();
  if (ok) ok = impl->ring.create(staging_bytes(impl->slots->plan().shape, n_staged), Impl::kMostSent);
  if (ok) ok = impl->stream.create();
  if (!ok) return tl::unexpected(ok.error());
  return SlotWriter(std::move(impl));
}

Status SlotWriter::Impl::send() {
  if (pieces.n == 0) return {};
  const StreamTimer timer(StreamStep::queue);
  const Status queued = cuda::launch_copy_pieces(pieces, stream.get());
  pieces.n = 0;
  // After an error too: queued copies read staged pages.
  const Status sent = ring.send(last, stream.get());
  return queued ? sent : queued;
}

Result<std::byte*> SlotWriter::Impl::take(std::uint64_t bytes) {
  for (;;) {
    if (const auto place = ring.take(bytes, pieces.n > 0)) {
      last = place->ticket;
      return place->memory;
    }
    Status room = send();
    const StreamTimer timer(StreamStep::room);
    if (room) room = ring.release(true);
    if (!room) return tl::unexpected(room.error());
  }
}

Status SlotWriter::write(const PageRows& page, std::uint32_t slot) {
  const SlotPlan& plan = impl_->slots->plan();
  const auto rows = section_rows(page.n, page.steps.size() / kStepSetBytes, plan.shape.chunk_size);
  std::array<std::uint64_t, 5> bytes = section_row_bytes(plan.shape.sh_degree);
  for (std::size_t k = 0; k < bytes.size(); ++k) bytes[k] *= rows[k];
  const OnDevice here(impl_->slots->device());
  if (!here.status()) return here.status();
  if (impl_->pieces.n + bytes.size() > cuda::Pieces::kMost) {
    if (Status sent = impl_->send(); !sent) return sent;
  }
  const auto taken = impl_->take(staged_bytes(bytes));
  if (!taken) return tl::unexpected(taken.error());
  const StreamTimer timer(StreamStep::stage);
  std::array<std::byte*, 5> staged;
  std::byte* section = *taken;
  for (std::size_t k = 0; k < bytes.size(); ++k) {
    staged[k] = section;
    section += staged_section_bytes(bytes[k]);
    impl_->pieces.add(impl_->slots->at(k, slot), staged[k], bytes[k]);
  }
  write_page_sections(page, plan.shape.chunk_size, std::uint64_t{slot} * plan.shape.page_chunks, staged);
  return {};
}

Result<SlotWriter::Ticket> SlotWriter::send() {
  const OnDevice here(impl_->slots->device());
  Status ok = here.status();
  if (ok) ok = impl_->send();
  if (!ok) return tl::unexpected(ok.error());
  return impl_->last;
}

Result<bool> SlotWriter::is_done(Ticket ticket) {
  const StreamTimer timer(StreamStep::wait);
  if (impl_->ring.is_done(ticket)) return true;
  if (const Status ok = impl_->ring.release(false); !ok) return tl::unexpected(ok.error());
  return impl_->ring.is_done(ticket);
}

Status SlotWriter::finish() {
  const OnDevice here(impl_->slots->device());
  Status sent = here.status();
  if (sent) sent = impl_->send();
  const StreamTimer timer(StreamStep::wait);
  const Status done =
      device_status(cudaStreamSynchronize(impl_->stream.get()), "a page could not be copied to the device");
  impl_->pieces.n = 0;
  impl_->ring.reset();
  return sent ? done : sent;
}

}  // namespace rgs::detail
