// uploader.hpp - page-locked memory on its way to the device, a ring with tickets: take, fill, send, done.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "cuda/cuda_objects.hpp"
#include "stream/slot_plan.hpp"

namespace rgs::detail {

/// Memory is taken for a sending, filled by any thread, and free again once the device has done what was queued for it,
/// in the order of tickets. One thread calls all functions.
class Uploader {
 public:
  /// Numbers a sending. Later ones are larger.
  using Ticket = std::uint64_t;
  struct Place {
    std::byte* memory;
    Ticket ticket;
  };

  Uploader() = default;
  Uploader(const Uploader&) = delete;
  Uploader& operator=(const Uploader&) = delete;
  ~Uploader();  ///< waits for what was sent

  /// `most_sendings`: that are not done at once. Errors: device_failed; unavailable (kernels do not reach the memory).
  Status create(std::uint64_t bytes, std::size_t most_sendings);
  /// `n` contiguous bytes, at most the whole ring, of a sending of their own, or of the last one if it `joins`; that one
  /// is not sent. Absent until older sendings are done.
  std::optional<Place> take(std::uint64_t n, bool joins = false);
  /// All that reads the sending's memory is queued on `stream`. Errors: device_failed.
  Status send(Ticket ticket, cudaStream_t stream);
  /// Whether the oldest sending that is not done was sent, so that release(true) ends.
  bool can_wait() const { return first_ != next_ && sending(first_).is_sent; }
  /// Finds out what is done; waits for the oldest if `waits` and it was sent. Errors: device_failed.
  Status release(bool waits);
  /// As far as release() has found out.
  bool is_done(Ticket ticket) const { return ticket < first_; }
  /// The streams are idle: all is done, sent or not.
  void reset();

 private:
  struct Sending {
    Event done;
    std::uint64_t taken = 0;  // ring_.taken() at its end
    bool is_sent = false;
  };
  Sending& sending(Ticket ticket) { return sendings_[ticket % sendings_.size()]; }
  const Sending& sending(Ticket ticket) const { return sendings_[ticket % sendings_.size()]; }
  void release_first();

  std::byte* memory_ = nullptr;
  std::uint64_t bytes_ = 0;
  StagingRing ring_{0};
  std::vector<Sending> sendings_;
  Ticket first_ = 1, next_ = 1;  // those in between are not done
};

}  // namespace rgs::detail
