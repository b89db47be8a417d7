// device_slots.cpp - one allocation for a pool's pages, and copies into it through page-locked memory.
// SPDX-License-Identifier: Apache-2.0
#include "stream/device_slots.hpp"

#include <array>
#include <utility>

#include "common/copy_pieces.hpp"
#include "common/device_code.hpp"
#include "cuda/cuda_objects.hpp"
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

/// Makes the pool's device current for its lifetime, then restores the one before. Sets nothing if it is current
/// already: cudaSetDevice() creates a context of hundreds of megabytes on a device without one.
class OnDevice {
 public:
  explicit OnDevice(int device) {
    status_ = device_status(cudaGetDevice(&before_), "the current device could not be read");
    if (!status_ || before_ == device) return;
    status_ = device_status(cudaSetDevice(device), kNotCurrent);
    is_changed_ = status_.has_value();
  }
  OnDevice(const OnDevice&) = delete;
  OnDevice& operator=(const OnDevice&) = delete;
  ~OnDevice() {
    if (is_changed_) cudaSetDevice(before_);
  }
  /// Errors: device_failed.
  const Status& status() const { return status_; }

  static constexpr const char* kNotCurrent = "the pool's device could not be made current";

 private:
  int before_ = 0;
  bool is_changed_ = false;
  Status status_;
};

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
  /// One send().
  struct Sent {
    Event copied;
    std::uint64_t taken = 0;  // ring.taken() at its end
  };
  static constexpr std::size_t kMostSent = 16;

  Impl(std::shared_ptr<const DeviceSlots> of, std::uint64_t bytes) : slots(std::move(of)), ring(bytes) {}
  Impl(const Impl&) = delete;
  Impl& operator=(const Impl&) = delete;
  ~Impl() {
    if (stream.get() != nullptr) cudaStreamSynchronize(stream.get());
    cudaFreeHost(memory);
  }

  Sent& sent(Ticket ticket) { return all_sent[ticket % kMostSent]; }
  Status send();
  Status wait_for_oldest();

  std::shared_ptr<const DeviceSlots> slots;
  std::byte* memory = nullptr;
  StagingRing ring;
  cuda::Pieces pieces;  // staged and not sent
  std::array<Sent, kMostSent> all_sent;
  Ticket last_sent = 0, last_done = 0;  // sends in between are in flight
  OwnedStream stream;
};

SlotWriter::SlotWriter(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
SlotWriter::SlotWriter(SlotWriter&&) noexcept = default;
SlotWriter::~SlotWriter() = default;

Result<SlotWriter> SlotWriter::create(std::shared_ptr<const DeviceSlots> slots, std::uint32_t n_staged) {
  const std::uint64_t bytes = staging_bytes(slots->plan().shape, n_staged);
  auto impl = std::make_unique<Impl>(std::move(slots), bytes);
  void* memory = nullptr;
  const OnDevice here(impl->slots->device());
  Status ok = here.status();
  if (ok) ok = device_status(cudaMallocHost(&memory, bytes), "page-locked host memory could not be allocated");
  impl->memory = static_cast<std::byte*>(memory);
  if (ok) ok = reached_by_device(memory);
  if (ok) ok = impl->stream.create();
  for (Impl::Sent& each : impl->all_sent) {
    if (ok) ok = each.copied.create();
  }
  if (!ok) return tl::unexpected(ok.error());
  return SlotWriter(std::move(impl));
}

Status SlotWriter::Impl::wait_for_oldest() {
  const StreamTimer timer(StreamStep::room);
  Sent& oldest = sent(last_done + 1);
  Status there = oldest.copied.wait();
  if (!there) return there;
  ++last_done;
  ring.release_up_to(oldest.taken);
  return {};
}

Status SlotWriter::Impl::send() {
  if (pieces.n == 0) return {};
  if (last_sent - last_done == kMostSent) {
    if (Status there = wait_for_oldest(); !there) return there;
  }
  const StreamTimer timer(StreamStep::queue);
  const Status queued = cuda::launch_copy_pieces(pieces, stream.get());
  pieces.n = 0;
  // After an error too: queued copies read staged pages.
  Sent& now = sent(last_sent + 1);
  if (Status recorded = now.copied.record(stream.get()); !recorded) return queued ? recorded : queued;
  now.taken = ring.taken();
  ++last_sent;
  return queued;
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
  auto at = impl_->ring.take(staged_bytes(bytes));
  while (!at) {
    Status room = impl_->send();
    if (room) room = impl_->wait_for_oldest();
    if (!room) return room;
    at = impl_->ring.take(staged_bytes(bytes));
  }
  const StreamTimer timer(StreamStep::stage);
  std::array<std::byte*, 5> staged;
  std::byte* section = impl_->memory + *at;
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
  return impl_->last_sent;
}

Result<bool> SlotWriter::is_done(Ticket ticket) {
  const StreamTimer timer(StreamStep::wait);
  while (impl_->last_done < ticket) {
    const Impl::Sent& oldest = impl_->sent(impl_->last_done + 1);
    const auto is_done = oldest.copied.is_done();
    if (!is_done || !*is_done) return is_done;
    ++impl_->last_done;
    impl_->ring.release_up_to(oldest.taken);
  }
  return true;
}

Status SlotWriter::finish() {
  const OnDevice here(impl_->slots->device());
  Status sent = here.status();
  if (sent) sent = impl_->send();
  const StreamTimer timer(StreamStep::wait);
  const Status done =
      device_status(cudaStreamSynchronize(impl_->stream.get()), "a page could not be copied to the device");
  impl_->pieces.n = 0;
  impl_->last_done = impl_->last_sent;
  impl_->ring.release_up_to(impl_->ring.taken());
  return sent ? done : sent;
}

}  // namespace rgs::detail
