// fit_device.cpp - queues the kernels of a fit; each thread that calls has a stream and memory of its own.
// SPDX-License-Identifier: Apache-2.0
#include "fit_device.hpp"

#include <cuda_runtime_api.h>

#include <algorithm>
#include <bit>
#include <cassert>
#include <cmath>
#include <mutex>
#include <utility>
#include <vector>

#include "common/device_code.hpp"
#include "fit.hpp"
#include "levels/fit_colors.hpp"
#include "sorted/sort.hpp"

namespace rgs::lod {
namespace {

// Dots at a time: of all frames of a small group, of one frame of a large one.
constexpr std::uint64_t kDotsAtOnce = std::uint64_t{1} << 20;

Status checked(cudaError_t error) {
  if (error == cudaSuccess) return {};
  cudaGetLastError();  // later calls must not report it
  if (error == cudaErrorMemoryAllocation)
    return make_error(Errc::device_out_of_memory, Error::kNone,
                      "the device has too little memory to fit levels: use fewer --threads or --backend cpu");
  return make_error(Errc::device_failed, Error::kNone, "levels could not be fitted", Error::kNone,
                    static_cast<std::uint64_t>(error));
}

/// Memory of one fit, taken piece by piece.
class Pieces {
 public:
  explicit Pieces(std::byte* base) : base_(base) {}
  template <class T>
  T* take(std::uint64_t n) {
    T* const piece = base_ == nullptr ? nullptr : reinterpret_cast<T*>(base_ + bytes_);
    bytes_ += (n * sizeof(T) + 255) / 256 * 256;
    return piece;
  }
  std::uint64_t bytes() const { return bytes_; }

 private:
  std::byte* base_;
  std::uint64_t bytes_ = 0;
};

struct Lane {
  cudaStream_t stream = nullptr;
  cudaEvent_t done = nullptr;
  std::byte* memory = nullptr;
  std::uint64_t bytes = 0;

  Lane() = default;
  Lane(const Lane&) = delete;
  Lane& operator=(const Lane&) = delete;
  ~Lane() {
    cudaFree(memory);
    if (done != nullptr) cudaEventDestroy(done);
    if (stream != nullptr) cudaStreamDestroy(stream);
  }
  Status create() {
    // Threads sleep while the device works: others need the processors.
    const Status ok = checked(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
    return ok ? checked(cudaEventCreateWithFlags(&done, cudaEventDisableTiming | cudaEventBlockingSync)) : ok;
  }
  Status reserve(std::uint64_t wanted) {
    if (wanted <= bytes) return {};
    cudaFree(std::exchange(memory, nullptr));
    bytes = 0;
    const Status ok = checked(cudaMalloc(reinterpret_cast<void**>(&memory), wanted + wanted / 4));
    if (ok) bytes = wanted + wanted / 4;
    return ok;
  }
  Status wait() const {
    const Status ok = checked(cudaEventRecord(done, stream));
    return ok ? checked(cudaEventSynchronize(done)) : ok;
  }
};

cuda::FitFrame on_device(const Frame& frame, std::uint64_t first_pixel) {
  cuda::FitFrame out;
  std::copy_n(frame.axes.right, 3, out.right);
  std::copy_n(frame.axes.down, 3, out.down);
  std::copy_n(frame.axes.forward, 3, out.forward);
  out.left = frame.left, out.top = frame.top, out.pixel = frame.pixel;
  out.width = frame.width, out.height = frame.height;
  out.first_pixel = first_pixel;
  return out;
}

class Fit {
 public:
  Fit(const Gaussians& group, Gaussians& result, float pixel, Lane& lane)
      : group_(group), result_(result), lane_(lane), stream_(lane.stream) {
    for (const Frame& frame : fit_frames(group, pixel)) {
      frames_.push_back(on_device(frame, n_pixels_));
      n_pixels_ += static_cast<std::uint64_t>(frame.width) * static_cast<std::uint64_t>(frame.height);
      most_pixels_ = std::max(most_pixels_, static_cast<std::uint32_t>(frame.width * frame.height));
      const int width = kFitSupersampling * frame.width, height = kFitSupersampling * frame.height;
      most_tiles_ = std::max(most_tiles_, cuda::fit_tiles(width, height));
    }
    n_frames_ = static_cast<std::uint32_t>(frames_.size());
    const std::uint64_t larger = std::max(group.size(), result.size());
    at_once_ = static_cast<std::uint32_t>(std::clamp<std::uint64_t>(kDotsAtOnce / larger, 1, n_frames_));
    most_dots_ = at_once_ * larger;
  }

  Status run() {
    const auto temporary = cuda::sort_bytes(most_dots_, false);
    if (!temporary) return tl::unexpected(temporary.error());
    temporary_bytes_ = *temporary;
    if (Status s = lane_.reserve(lay_out(nullptr)); !s) return s;
    lay_out(lane_.memory);
    if (Status s = upload(); !s) return s;
    for (std::uint32_t first = 0; first < n_frames_; first += at_once_) {
      if (Status s = draw_truths(first, std::min(at_once_, n_frames_ - first)); !s) return s;
    }
    for (std::uint32_t first = 0; first < n_frames_; first += at_once_) {
      if (Status s = find_order(first, std::min(at_once_, n_frames_ - first)); !s) return s;
    }
    if (Status s = make_steps(); !s) return s;
    return download();
  }

 private:
  std::uint64_t lay_out(std::byte* base) {
    Pieces pieces(base);
    const auto gaussians = [&](const Gaussians& g) {
      return cuda::FitGaussians{pieces.take<float>(static_cast<std::uint64_t>(g.n_values()) * g.padded()),
                                static_cast<std::uint32_t>(g.size()), static_cast<std::uint32_t>(g.padded()),
                                g.sh_degree()};
    };
    const auto dots = [&](std::uint64_t n) {
      cuda::FitDot* const first = pieces.take<cuda::FitDot>(n);
      return cuda::FitDots{first, pieces.take<cuda::FitBox>(n)};
    };
    const std::uint64_t n = result_.size(), stride = result_.padded(), moments = n_moments() * stride;
    from_ = gaussians(group_);
    to_ = gaussians(result_);
    on_device_ = pieces.take<cuda::FitFrame>(n_frames_);
    truths_ = pieces.take<float4>(n_pixels_);
    items_ = pieces.take<std::uint32_t>(n_frames_ * n);
    ranks_ = pieces.take<std::uint32_t>(n_frames_ * n);
    state_.means = pieces.take<float>(2 * moments);  // and squares
    state_.squares = state_.means + (base == nullptr ? 0 : moments);
    state_.logits = pieces.take<float>(stride);
    state_.slopes = pieces.take<std::uint64_t>(4 * stride);
    dots_[0] = dots(most_dots_);
    dots_[1] = dots(n);
    sort_ = {pieces.take<std::uint64_t>(most_dots_), pieces.take<std::uint64_t>(most_dots_),
             pieces.take<std::uint32_t>(most_dots_), pieces.take<std::uint32_t>(most_dots_), false};
    temporary_ = pieces.take<std::byte>(temporary_bytes_);
    return pieces.bytes();
  }

  Status upload() {
    const auto copy = [&](void* to, const void* from, std::uint64_t bytes) {
      return checked(cudaMemcpyAsync(to, from, bytes, cudaMemcpyHostToDevice, stream_));
    };
    if (Status s = copy(from_.values, group_.of(0), bytes_of(group_)); !s) return s;
    if (Status s = copy(to_.values, result_.of(0), bytes_of(result_)); !s) return s;
    return copy(on_device_, frames_.data(), n_frames_ * sizeof(cuda::FitFrame));
  }

  // Leaves items of frames first .. first + n - 1 in order, frame after frame.
  Status sort(const cuda::FitGaussians& gaussians, std::uint32_t first, std::uint32_t n) {
    auto* const keys = static_cast<std::uint64_t*>(sort_.keys);
    if (Status s = cuda::launch_fit_keys(gaussians, on_device_ + first, n, keys, sort_.gaussians, stream_); !s)
      return s;
    const int bits = 32 + static_cast<int>(std::bit_width(n - 1));
    return cuda::launch_sort(sort_, std::uint64_t{n} * gaussians.n, bits, temporary_, temporary_bytes_, stream_);
  }

  Status draw_truths(std::uint32_t first, std::uint32_t n) {
    if (Status s = sort(from_, first, n); !s) return s;
    if (Status s = cuda::launch_fit_dots(from_, on_device_ + first, n, kFitSupersampling, kDrawn.low_pass,
                                         sort_.gaussians, dots_[0], stream_);
        !s) {
      return s;
    }
    return cuda::launch_fit_truths(on_device_ + first, n, from_.n, kFitSupersampling, most_tiles_, dots_[0], truths_,
                                   stream_);
  }

  Status find_order(std::uint32_t first, std::uint32_t n) {
    if (Status s = sort(to_, first, n); !s) return s;
    const std::uint64_t begin = std::uint64_t{first} * to_.n, count = std::uint64_t{n} * to_.n;
    if (Status s = checked(cudaMemcpyAsync(items_ + begin, sort_.gaussians, count * sizeof *items_,
                                           cudaMemcpyDeviceToDevice, stream_));
        !s) {
      return s;
    }
    return cuda::launch_fit_ranks(sort_.gaussians, to_.n, n, ranks_ + begin, stream_);
  }

  Status make_steps() {
    const std::uint64_t moments = n_moments() * result_.padded();
    if (Status s = checked(cudaMemsetAsync(state_.means, 0, 2 * moments * sizeof(float), stream_)); !s) return s;
    const std::uint64_t slopes = 4 * result_.padded() * sizeof(std::uint64_t);
    if (Status s = checked(cudaMemsetAsync(state_.slopes, 0, slopes, stream_)); !s) return s;
    const cuda::FitRules rules{kFitSteps,  kFitStride, kDrawn.low_pass, kFitLogitStep,  kFitDcStep,
                               kFitShStep, kFitDecay1, kFitDecay2,      kFitLeastLogit, kFitMostLogit};
    const cuda::FitViews views{on_device_, n_frames_, most_pixels_, truths_, items_, ranks_};
    return cuda::launch_fit_steps(views, to_, rules, state_, dots_, stream_);
  }

  // Opacities and harmonics are the last arrays.
  Status download() {
    static_assert(int{cuda::kFitOpacity} == int{kOpacity} && int{cuda::kFitSh} == int{kSh});
    if (Status s = lane_.wait(); !s) return s;  // a copy to memory that is not page-locked would spin
    const std::uint64_t from = std::uint64_t{kOpacity} * result_.padded();
    const Status copied =
        checked(cudaMemcpyAsync(result_.of(kOpacity), to_.values + from, bytes_of(result_) - from * sizeof(float),
                                cudaMemcpyDeviceToHost, stream_));
    return copied ? lane_.wait() : copied;
  }

  std::uint64_t n_moments() const { return static_cast<std::uint64_t>(result_.n_values() - kSh + 1); }
  static std::uint64_t bytes_of(const Gaussians& gaussians) {
    return static_cast<std::uint64_t>(gaussians.n_values()) * gaussians.padded() * sizeof(float);
  }

  const Gaussians& group_;
  Gaussians& result_;
  Lane& lane_;
  cudaStream_t stream_;
  std::vector<cuda::FitFrame> frames_;
  std::uint32_t n_frames_ = 0, at_once_ = 0, most_tiles_ = 0, most_pixels_ = 0;
  std::uint64_t n_pixels_ = 0, most_dots_ = 0, temporary_bytes_ = 0;
  // On the device.
  cuda::FitGaussians from_{}, to_{};
  cuda::FitFrame* on_device_ = nullptr;
  float4* truths_ = nullptr;
  std::uint32_t *items_ = nullptr, *ranks_ = nullptr;
  cuda::FitState state_{};
  cuda::FitDots dots_[2]{};
  cuda::SortBuffers sort_{};
  std::byte* temporary_ = nullptr;
};

}  // namespace

struct FitDevice::Impl {
  int device = 0;
  std::mutex lock;  // of what follows
  std::vector<std::unique_ptr<Lane>> idle;
  Status status;

  Result<std::unique_ptr<Lane>> take() {
    if (Status s = checked(cudaSetDevice(device)); !s) return tl::unexpected(s.error());
    {
      const std::scoped_lock held(lock);
      if (!status) return tl::unexpected(status.error());
      if (!idle.empty()) {
        std::unique_ptr<Lane> lane = std::move(idle.back());
        idle.pop_back();
        return lane;
      }
    }
    auto lane = std::make_unique<Lane>();
    if (Status s = lane->create(); !s) return tl::unexpected(s.error());
    return lane;
  }
};

FitDevice::FitDevice(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
FitDevice::~FitDevice() = default;

Result<std::shared_ptr<FitDevice>> FitDevice::create() {
  auto impl = std::make_unique<Impl>();
  if (cudaGetDevice(&impl->device) != cudaSuccess || cudaFree(nullptr) != cudaSuccess) {
    cudaGetLastError();
    return make_error(Errc::unavailable, Error::kNone, "no CUDA device answers; fit levels on the CPU");
  }
  if (Status s = cuda::check_device_code(); !s) return tl::unexpected(s.error());
  return std::shared_ptr<FitDevice>(new FitDevice(std::move(impl)));
}

void FitDevice::fit_colors(const Gaussians& group, Gaussians& gaussians, float pixel) {
  auto lane = impl_->take();
  Gaussians fitted = gaussians;
  assert(group.size() > 0 && gaussians.size() > 0);
  const Status fit = lane ? Fit(group, fitted, pixel, **lane).run() : Status(tl::unexpected(lane.error()));
  if (fit) gaussians = std::move(fitted);
  const std::scoped_lock held(impl_->lock);
  if (lane) impl_->idle.push_back(std::move(*lane));
  if (!fit && impl_->status) impl_->status = fit;
}

Status FitDevice::status() const {
  const std::scoped_lock held(impl_->lock);
  return impl_->status;
}

}  // namespace rgs::lod
