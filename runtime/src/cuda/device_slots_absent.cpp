// device_slots_absent.cpp - slots in builds without CUDA: none.
// SPDX-License-Identifier: Apache-2.0
#include <utility>

#include "stream/device_slots.hpp"

namespace rgs::detail {
namespace {

tl::unexpected<Error> not_built() {
  return make_error(Errc::unavailable, Error::kNone, "this build has no CUDA, so a pool cannot have device memory");
}

}  // namespace

Result<std::shared_ptr<DeviceSlots>> DeviceSlots::create(const SlotShape&, std::uint64_t, std::uint64_t) {
  return not_built();
}
DeviceSlots::~DeviceSlots() = default;
void DeviceSlots::stay_on_device() const {}

struct SlotWriter::Impl {};
SlotWriter::SlotWriter(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
SlotWriter::SlotWriter(SlotWriter&&) noexcept = default;
SlotWriter::~SlotWriter() = default;
// NOLINTNEXTLINE(performance-unnecessary-value-param): the signature of CUDA builds
Result<SlotWriter> SlotWriter::create(std::shared_ptr<const DeviceSlots>, std::uint32_t) {
  return not_built();
}
Status SlotWriter::write(const PageRows&, std::uint32_t) {
  return not_built();
}
Result<SlotWriter::Ticket> SlotWriter::send() {
  return not_built();
}
Result<bool> SlotWriter::is_done(Ticket) {
  return not_built();
}
Status SlotWriter::finish() {
  return not_built();
}

}  // namespace rgs::detail
