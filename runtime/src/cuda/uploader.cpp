// uploader.cpp - the ring of page-locked memory and the ends of its sendings.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/uploader.hpp"

#include <cassert>

namespace rgs::detail {

Uploader::~Uploader() {
  for (const Sending& each : sendings_) {
    if (each.is_sent) cudaEventSynchronize(each.done.get());
  }
  cudaFreeHost(memory_);
}

Status Uploader::create(std::uint64_t bytes, std::size_t most_sendings) {
  bytes_ = bytes;
  ring_ = StagingRing(bytes);
  sendings_ = std::vector<Sending>(most_sendings);
  void* memory = nullptr;
  Status ok = device_status(cudaMallocHost(&memory, bytes), "page-locked host memory could not be allocated");
  memory_ = static_cast<std::byte*>(memory);
  if (ok) ok = reached_by_device(memory);
  for (Sending& each : sendings_) {
    if (ok) ok = each.done.create();
  }
  return ok;
}

std::optional<Uploader::Place> Uploader::take(std::uint64_t n, bool joins) {
  assert(n <= bytes_ && (!joins || first_ != next_));
  if (!joins && next_ - first_ == sendings_.size()) return std::nullopt;
  const auto at = ring_.take(n);
  if (!at) return std::nullopt;
  if (!joins) sending(next_++).is_sent = false;
  sending(next_ - 1).taken = ring_.taken();
  return Place{memory_ + *at, next_ - 1};
}

Status Uploader::send(Ticket ticket, cudaStream_t stream) {
  sending(ticket).is_sent = true;
  Status ok = sending(ticket).done.record(stream);
  if (!ok) cudaStreamSynchronize(stream);  // nothing else says when it is done
  return ok;
}

void Uploader::release_first() {
  Sending& done = sending(first_++);
  done.is_sent = false;
  ring_.release_up_to(done.taken);
}

Status Uploader::release(bool waits) {
  if (waits && can_wait()) {
    if (const Status done = sending(first_).done.wait(); !done) return done;
    release_first();
  }
  while (can_wait()) {
    const auto is_done = sending(first_).done.is_done();
    if (!is_done) return tl::unexpected(is_done.error());
    if (!*is_done) return {};
    release_first();
  }
  return {};
}

void Uploader::reset() {
  while (first_ != next_) release_first();
}

}  // namespace rgs::detail
