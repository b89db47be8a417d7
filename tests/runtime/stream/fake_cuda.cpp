// fake_cuda.cpp - streams are queues, and device memory is host memory.
// SPDX-License-Identifier: Apache-2.0
#include "fake_cuda.hpp"

#include <cuda_runtime_api.h>

#include <condition_variable>
#include <cstring>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <random>
#include <thread>
#include <vector>

#include "common/copy_pieces.hpp"
#include "common/device_code.hpp"

struct CUstream_st {
  struct Work {
    std::function<void()> run;
    std::byte* to = nullptr;  // of a copy
    std::size_t bytes = 0;
  };
  int device = 0;
  bool is_at_once = false;
  mutable std::mutex mutex;
  std::condition_variable done_one;
  std::deque<Work> queue;  // the first is running if is_busy
  bool is_busy = false;
  std::uint64_t n_queued = 0, n_done = 0;

  std::uint64_t add(Work work) {
    std::uint64_t ticket = 0;
    {
      const std::scoped_lock lock(mutex);
      queue.push_back(std::move(work));
      ticket = ++n_queued;
    }
    if (is_at_once) finish(ticket);
    return ticket;
  }
  // Each send ends with an event, which is no copy.
  int n_sent() const {
    const std::scoped_lock lock(mutex);
    int n = 0;
    for (const Work& work : queue) n += work.bytes == 0;
    return n;
  }
  // The work runs without the lock, so that sanitizers see its races.
  bool do_one() {
    std::function<void()> run;
    {
      const std::scoped_lock lock(mutex);
      if (is_busy || queue.empty()) return false;
      is_busy = true;
      run = queue.front().run;
    }
    run();
    const std::scoped_lock lock(mutex);
    queue.pop_front();
    is_busy = false;
    ++n_done;
    done_one.notify_all();
    return true;
  }
  void finish(std::uint64_t ticket) {
    for (;;) {
      {
        std::unique_lock lock(mutex);
        done_one.wait(lock, [&] { return !is_busy; });
        if (n_done >= ticket) return;
      }
      do_one();
    }
  }
};

struct CUevent_st {
  int device = 0;
  std::mutex mutex;
  CUstream_st* stream = nullptr;
  std::uint64_t ticket = 0;
};

namespace rgs::test {
namespace {

FakeCuda* the_device = nullptr;
thread_local int the_current = 0;
constexpr int kDevices = 2;
constexpr int kPoison = 0xFB;  // unwritten memory is not a number

bool overlap(const std::byte* a, std::size_t n, const std::byte* b, std::size_t m) {
  return a < b + m && b < a + n;
}

// False: it was 0 already.
bool count_down(std::atomic<int>& n) {
  for (int now = n; now > 0;) {
    if (n.compare_exchange_weak(now, now - 1)) return true;
  }
  return false;
}

void note_most(std::atomic<std::uint64_t>& most, std::uint64_t now) {
  for (std::uint64_t before = most; now > before && !most.compare_exchange_weak(before, now);) {
  }
}

}  // namespace

struct FakeCuda::Impl {
  mutable std::mutex mutex;  // of the members below
  struct Block {
    std::size_t bytes;
    int device;
  };
  using Memory = std::map<std::byte*, Block>;
  Memory device, pinned;
  std::vector<CUstream_st*> streams;
  std::uint64_t device_memory = 0;
  bool is_stopping = false, is_at_once = false;
  std::mt19937 random;
  std::thread engine;

  static const Block* find(const Memory& memory, const std::byte* from, std::size_t bytes) {
    for (const auto& [begin, block] : memory) {
      if (from >= begin && from + bytes <= begin + block.bytes) return &block;
    }
    return nullptr;
  }
  void work() {
    for (;;) {
      {
        const std::scoped_lock lock(mutex);
        if (is_stopping) return;
        // Under the lock, so that no stream is destroyed meanwhile.
        if (!streams.empty() && random() % 4 != 0) streams[random() % streams.size()]->do_one();
      }
      std::this_thread::yield();
    }
  }
};

FakeCuda::FakeCuda(Pace pace, std::uint64_t device_memory, unsigned seed) : impl(std::make_unique<Impl>()) {
  impl->device_memory = device_memory;
  impl->random.seed(seed);
  the_device = this;
  the_current = 0;
  impl->is_at_once = pace == Pace::at_once;
  if (pace == Pace::any_time) impl->engine = std::thread([this] { impl->work(); });
}

FakeCuda::~FakeCuda() {
  {
    const std::scoped_lock lock(impl->mutex);
    impl->is_stopping = true;
  }
  if (impl->engine.joinable()) impl->engine.join();
  the_device = nullptr;
}

FakeCuda* FakeCuda::current() {
  return the_device;
}

bool FakeCuda::is_written(const std::byte* from, std::size_t bytes) const {
  const std::scoped_lock lock(impl->mutex);
  for (const CUstream_st* stream : impl->streams) {
    const std::scoped_lock of_stream(stream->mutex);
    for (const CUstream_st::Work& work : stream->queue) {
      if (work.bytes != 0 && overlap(work.to, work.bytes, from, bytes)) return true;
    }
  }
  return false;
}

std::size_t FakeCuda::n_pending() const {
  const std::scoped_lock lock(impl->mutex);
  std::size_t n = 0;
  for (const CUstream_st* stream : impl->streams) {
    const std::scoped_lock of_stream(stream->mutex);
    for (const CUstream_st::Work& work : stream->queue) n += work.bytes != 0;
  }
  return n;
}

bool FakeCuda::is_allocated(const std::byte* from, std::size_t bytes) const {
  const std::scoped_lock lock(impl->mutex);
  return Impl::find(impl->device, from, bytes) != nullptr;
}

}  // namespace rgs::test

using rgs::test::FakeCuda;

namespace {

cudaError_t allocate(void** memory, std::size_t bytes, bool is_pinned) {
  FakeCuda& cuda = *FakeCuda::current();
  const std::scoped_lock lock(cuda.impl->mutex);
  auto& held = is_pinned ? cuda.pinned_bytes : cuda.device_bytes;
  if (!is_pinned && held + bytes > cuda.impl->device_memory) return cudaErrorMemoryAllocation;
  auto* const made = static_cast<std::byte*>(::operator new (bytes, std::align_val_t{256}));
  std::memset(made, rgs::test::kPoison, bytes);
  int current = 0;
  cudaGetDevice(&current);
  (is_pinned ? cuda.impl->pinned : cuda.impl->device)[made] = {bytes, current};
  held += bytes;
  rgs::test::note_most(is_pinned ? cuda.most_pinned_bytes : cuda.most_device_bytes, held);
  if (!is_pinned) ++cuda.n_allocations, cuda.n_on_second += current == 1;
  *memory = made;
  return cudaSuccess;
}

cudaError_t release(void* memory, bool is_pinned) {
  if (memory == nullptr) return cudaSuccess;
  FakeCuda& cuda = *FakeCuda::current();
  auto* const from = static_cast<std::byte*>(memory);
  const std::size_t bytes = [&] {
    const std::scoped_lock lock(cuda.impl->mutex);
    auto& all = is_pinned ? cuda.impl->pinned : cuda.impl->device;
    const auto found = all.find(from);
    if (found == all.end()) return std::size_t{0};
    const std::size_t size = found->second.bytes;
    all.erase(found);
    return size;
  }();
  if (bytes == 0 || (!is_pinned && cuda.is_written(from, bytes))) ++cuda.n_faults;
  (is_pinned ? cuda.pinned_bytes : cuda.device_bytes) -= bytes;
  ::operator delete (memory, std::align_val_t{256});
  return cudaSuccess;
}

}  // namespace

cudaError_t cudaGetLastError() {
  return cudaSuccess;
}
cudaError_t cudaGetDeviceCount(int* n) {
  *n = FakeCuda::current() != nullptr ? rgs::test::kDevices : 0;
  return cudaSuccess;
}
cudaError_t cudaGetDevice(int* device) {
  *device = rgs::test::the_current;
  return cudaSuccess;
}
cudaError_t cudaSetDevice(int device) {
  if (device < 0 || device >= rgs::test::kDevices) return cudaErrorInvalidValue;
  if (FakeCuda* const cuda = FakeCuda::current()) ++cuda->n_set_device;
  rgs::test::the_current = device;
  return cudaSuccess;
}
cudaError_t cudaMalloc(void** memory, std::size_t bytes) {
  return allocate(memory, bytes, false);
}
cudaError_t cudaFree(void* memory) {
  return release(memory, false);
}
cudaError_t cudaMallocHost(void** memory, std::size_t bytes) {
  return allocate(memory, bytes, true);
}
cudaError_t cudaHostAlloc(void** memory, std::size_t bytes, unsigned) {
  return allocate(memory, bytes, true);
}
cudaError_t cudaFreeHost(void* memory) {
  return release(memory, true);
}
cudaError_t cudaHostGetDevicePointer(void** on_device, void* memory, unsigned) {
  *on_device = memory;
  return cudaSuccess;
}

cudaError_t cudaMemcpyAsync(void* to, const void* from, std::size_t bytes, cudaMemcpyKind kind, cudaStream_t stream) {
  FakeCuda& cuda = *FakeCuda::current();
  if (cuda.fails_next > 0 && !rgs::test::count_down(cuda.passes_next) && rgs::test::count_down(cuda.fails_next)) {
    cuda.n_sent_at_failure = stream->n_sent();
    return cudaErrorUnknown;
  }
  auto* const target = static_cast<std::byte*>(to);
  const auto* const source = static_cast<const std::byte*>(from);
  // Copies to a slot must not overlap, even where stream order allows it: the scheduler alone knows what is in flight.
  bool is_sound = kind == cudaMemcpyHostToDevice && cuda.is_allocated(target, bytes) && !cuda.is_written(target, bytes);
  {
    const std::scoped_lock lock(cuda.impl->mutex);
    is_sound = is_sound && FakeCuda::Impl::find(cuda.impl->pinned, source, bytes) != nullptr &&
               FakeCuda::Impl::find(cuda.impl->device, target, bytes)->device == stream->device;
  }
  if (!is_sound) {
    ++cuda.n_faults;
    return cudaErrorInvalidValue;
  }
  stream->add({[target, source, bytes] { std::memcpy(target, source, bytes); }, target, bytes});
  return cudaSuccess;
}

rgs::Status rgs::cuda::check_device_code() {
  if (FakeCuda::current()->device_without_code != rgs::test::the_current) return {};
  return make_error(Errc::unavailable, Error::kNone, "the test's build has no code for this device");
}

// In any order: here the last comes first.
rgs::Status rgs::cuda::launch_copy_pieces(const Pieces& pieces, Stream stream) {
  FakeCuda& cuda = *FakeCuda::current();
  ++cuda.n_batches;
  if (pieces.n == 0 || pieces.n > Pieces::kMost || stream->device != rgs::test::the_current) ++cuda.n_faults;
  for (std::uint32_t i = pieces.n; i-- > 0;) {
    const auto is_whole = [](const void* at) { return reinterpret_cast<std::uintptr_t>(at) % Pieces::kAlignment == 0; };
    if (pieces.bytes[i] == 0 || pieces.bytes[i] % Pieces::kAlignment != 0 || !is_whole(pieces.from[i]) ||
        !is_whole(pieces.to[i])) {
      ++cuda.n_faults;
    }
    const cudaError_t error =
        cudaMemcpyAsync(pieces.to[i], pieces.from[i], pieces.bytes[i], cudaMemcpyHostToDevice, stream);
    if (error != cudaSuccess) {
      return make_error(Errc::device_failed, Error::kNone, "pages could not be copied to the device", Error::kNone,
                        static_cast<std::uint64_t>(error));
    }
  }
  return {};
}

cudaError_t cudaStreamCreateWithPriority(cudaStream_t* stream, unsigned, int) {
  *stream = new CUstream_st;
  (*stream)->device = rgs::test::the_current;
  (*stream)->is_at_once = FakeCuda::current()->impl->is_at_once;
  const std::scoped_lock lock(FakeCuda::current()->impl->mutex);
  FakeCuda::current()->impl->streams.push_back(*stream);
  return cudaSuccess;
}
// Queued work still runs.
cudaError_t cudaStreamDestroy(cudaStream_t stream) {
  {
    const std::scoped_lock lock(FakeCuda::current()->impl->mutex);
    std::erase(FakeCuda::current()->impl->streams, stream);
  }
  cudaStreamSynchronize(stream);
  delete stream;
  return cudaSuccess;
}
cudaError_t cudaStreamSynchronize(cudaStream_t stream) {
  std::uint64_t ticket = 0;
  {
    const std::scoped_lock lock(stream->mutex);
    ticket = stream->n_queued;
  }
  const int n_sent = stream->n_sent();
  stream->finish(ticket);
  FakeCuda* const cuda = FakeCuda::current();
  if (cuda == nullptr || cuda->sync_fails_next == 0 || rgs::test::count_down(cuda->sync_passes_next) ||
      !rgs::test::count_down(cuda->sync_fails_next)) {
    return cudaSuccess;
  }
  cuda->n_sent_at_failure = n_sent;
  return cudaErrorUnknown;
}
cudaError_t cudaStreamWaitEvent(cudaStream_t stream, cudaEvent_t event, unsigned) {
  stream->add({[event] { cudaEventSynchronize(event); }});
  return cudaSuccess;
}
cudaError_t cudaEventCreateWithFlags(cudaEvent_t* event, unsigned) {
  *event = new CUevent_st;
  (*event)->device = rgs::test::the_current;
  return cudaSuccess;
}
cudaError_t cudaEventDestroy(cudaEvent_t event) {
  delete event;
  return cudaSuccess;
}
cudaError_t cudaEventRecord(cudaEvent_t event, cudaStream_t stream) {
  if (event->device != stream->device) {
    ++FakeCuda::current()->n_faults;
    return cudaErrorInvalidValue;
  }
  const std::scoped_lock lock(event->mutex);
  event->stream = stream;
  event->ticket = stream->add({[] {}});
  return cudaSuccess;
}
cudaError_t cudaEventQuery(cudaEvent_t event) {
  FakeCuda& cuda = *FakeCuda::current();
  if (rgs::test::count_down(cuda.query_fails_next)) return cudaErrorUnknown;
  const std::scoped_lock lock(event->mutex);
  if (event->stream == nullptr) return cudaSuccess;
  const std::scoped_lock of_stream(event->stream->mutex);
  const bool is_done = event->stream->n_done >= event->ticket;
  ++(is_done ? cuda.n_seen_done : cuda.n_seen_at_work);
  return is_done ? cudaSuccess : cudaErrorNotReady;
}
cudaError_t cudaEventSynchronize(cudaEvent_t event) {
  CUstream_st* stream = nullptr;
  std::uint64_t ticket = 0;
  {
    const std::scoped_lock lock(event->mutex);
    stream = event->stream, ticket = event->ticket;
  }
  if (stream != nullptr) stream->finish(ticket);
  return cudaSuccess;
}
