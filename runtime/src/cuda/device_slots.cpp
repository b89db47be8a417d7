// device_slots.cpp - one allocation for the pages of a pool, and copies into it through page-locked memory.
// SPDX-License-Identifier: Apache-2.0
#include "stream/device_slots.hpp"

#include <array>
#include <utility>

#include "cuda/cuda_objects.hpp"
#include "page_sections.hpp"
#include "stream/stream_times.hpp"

namespace rgs::detail {
namespace {

/// The pool's device is the current one of a thread as long as this lives, then the one that was before. Where the thread has it
/// already nothing is set: cudaSetDevice() makes a context, of hundreds of megabytes, on a device that has none.
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

Result<std::shared_ptr<DeviceSlots>> DeviceSlots::create(const SlotShape& shape, std::uint64_t device_memory) {
  const auto plan = plan_slots(shape, device_memory);
  if (!plan) return tl::unexpected(plan.error());
  const std::shared_ptr<DeviceSlots> slots(new DeviceSlots);
  slots->plan_ = *plan;
  int n_devices = 0;
  if (cudaGetDeviceCount(&n_devices) != cudaSuccess || n_devices == 0 ||
      cudaGetDevice(&slots->device_) != cudaSuccess) {
    cudaGetLastError();
    return make_error(Errc::unavailable, Error::kNone,
                      "no CUDA device answers, so that a pool cannot have a device's memory");
  }
  void* memory = nullptr;
  const cudaError_t error = cudaMalloc(&memory, plan->bytes);
  if (error == cudaErrorMemoryAllocation) {
    cudaGetLastError();
    return make_error(Errc::device_out_of_memory, Error::kNone,
                      "the device has not as much memory left as the pool's budget", plan->bytes);
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
  if (here.status()) cudaFree(memory_);
}

// If it fails, each write() says so.
void DeviceSlots::stay_on_device() const {
  static_cast<void>(device_status(cudaSetDevice(device_), OnDevice::kNotCurrent));
}

struct SlotWriter::Impl {
  struct Staged {
    std::array<std::byte*, 5> at{};
    Event copied;
  };

  explicit Impl(std::shared_ptr<const DeviceSlots> of) : slots(std::move(of)) {}
  Impl(const Impl&) = delete;
  Impl& operator=(const Impl&) = delete;
  ~Impl() {
    if (stream.get() != nullptr) cudaStreamSynchronize(stream.get());
    cudaFreeHost(memory);
  }

  std::shared_ptr<const DeviceSlots> slots;
  std::byte* memory = nullptr;
  std::array<Staged, kStagedPages> staged;
  std::size_t next = 0;
  OwnedStream stream;
};

SlotWriter::SlotWriter(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
SlotWriter::SlotWriter(SlotWriter&&) noexcept = default;
SlotWriter::~SlotWriter() = default;

Result<SlotWriter> SlotWriter::create(std::shared_ptr<const DeviceSlots> slots) {
  auto impl = std::make_unique<Impl>(std::move(slots));
  const SlotShape& shape = impl->slots->plan().shape;
  void* memory = nullptr;
  const OnDevice here(impl->slots->device());
  Status ok = here.status();
  if (ok) {
    ok = device_status(cudaMallocHost(&memory, staging_bytes(shape)), "page-locked host memory could not be allocated");
  }
  impl->memory = static_cast<std::byte*>(memory);
  if (ok) ok = impl->stream.create();
  std::byte* at = impl->memory;
  for (Impl::Staged& each : impl->staged) {
    if (ok) ok = each.copied.create();
    for (std::size_t k = 0; k < each.at.size(); ++k) {
      each.at[k] = at;
      at += staged_section_bytes(shape, k);
    }
  }
  if (!ok) return tl::unexpected(ok.error());
  return SlotWriter(std::move(impl));
}

Status SlotWriter::write(const PageRows& page, std::uint32_t slot) {
  const SlotPlan& plan = impl_->slots->plan();
  Impl::Staged& staged = impl_->staged[impl_->next];
  impl_->next = (impl_->next + 1) % impl_->staged.size();
  const OnDevice here(impl_->slots->device());
  Status ok = here.status();
  StreamTimer timer(StreamStep::room);
  if (ok) ok = staged.copied.wait();
  if (!ok) return ok;
  timer.next(StreamStep::stage);
  write_page_sections(page, plan.shape.chunk_size, std::uint64_t{slot} * plan.shape.page_chunks, staged.at);
  const auto rows = section_rows(page.n, page.steps.size() / kStepSetBytes, plan.shape.chunk_size);
  const auto row_bytes = section_row_bytes(plan.shape.sh_degree);
  timer.next(StreamStep::queue);
  for (std::size_t k = 0; k < rows.size(); ++k) {
    if (!ok) break;
    ok = device_status(cudaMemcpyAsync(impl_->slots->at(k, slot), staged.at[k], rows[k] * row_bytes[k],
                                       cudaMemcpyHostToDevice, impl_->stream.get()),
                       "a page could not be copied to the device");
  }
  // After an error, too: what was queued reads the staged page.
  const Status recorded = staged.copied.record(impl_->stream.get());
  return ok ? recorded : ok;
}

Status SlotWriter::finish() {
  const OnDevice here(impl_->slots->device());
  const StreamTimer timer(StreamStep::wait);
  const Status done =
      device_status(cudaStreamSynchronize(impl_->stream.get()), "a page could not be copied to the device");
  return here.status() ? done : here.status();
}

}  // namespace rgs::detail
