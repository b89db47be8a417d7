// file_upload.cpp - a ring of page-locked memory between threads that decompress and streams that copy and decode.
//
// A job is one frame index, or a piece of a section that is stored as is. A thread takes a job and a place in the ring
// and fills it (hash, Zstandard; the host does nothing else). The caller's thread, the only one to call CUDA, so that
// any context will do, queues on one of a few streams the copy to the device and the kernels that decode it to rows.
// The place is free once copied; the stream and its device memory are free once the rows are made. Decoding a
// frame's SH keeps only a few threads busy, but for long, on any device; so there are many streams, and frames are
// decoded side by side. Frames of an archive need even longer, so they are copied as they are, and decoded all at once.
//
// If the device finds damage, the host decodes the file again on its own path and returns its error, which names the
// place.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/file_upload.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstring>
#include <deque>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <thread>
#include <utility>
#include <vector>

#include "common/check_values.hpp"
#include "common/unpack.hpp"
#include "common/unpack_archive.hpp"
#include "cuda/cuda_objects.hpp"
#include "cuda/device_memory.hpp"
#include "cuda/uploader.hpp"
#include "rgs/frame_content.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kPieceBytes = std::uint64_t{1} << 20;     // of sections stored as is
constexpr std::uint64_t kRingBytes = std::uint64_t{32} << 20;     // page-locked, unless two places need more
constexpr std::uint64_t kStagingBytes = std::uint64_t{96} << 20;  // on the device, unless two streams need more
constexpr std::uint64_t kArchiveBytes = std::uint64_t{1} << 30;   // to decode an archive, unless a frame needs more
constexpr std::uint64_t kMaxStreams = 32;

constexpr std::uint64_t align(std::uint64_t bytes) {
  return (bytes + 255) / 256 * 256;
}

struct Section {
  SectionType type = SectionType::means;
  std::uint64_t row_bytes = 0;
  std::byte* place = nullptr;
  const FrameTable* table = nullptr;  // of a coded section
  std::span<const std::byte> bytes;   // of any other section
};

struct Part {
  const Section* section = nullptr;
  std::uint64_t index = 0;     // frame, or piece of kPieceBytes
  std::uint64_t at = 0;        // offset in its place
  std::uint64_t bytes = 0;     // of the content or the piece
  std::uint64_t n_steps = 0;   // SHI8: chunks of the frame
  std::uint64_t steps_at = 0;  // offset of their steps
};

struct Job {
  std::array<Part, 3> parts;
  std::size_t n_parts = 0;
  std::uint64_t bytes = 0;

  std::span<const Part> all() const { return std::span(parts).first(n_parts); }
};

// Sections whose frames, or pieces, of one index form a job.
struct Group {
  std::array<const Section*, 3> sections;
  std::size_t n_sections = 0;
  std::uint64_t n_jobs = 0;
};

struct Lane {
  OwnedStream stream;
  std::byte* memory = nullptr;  // contents on the device
  Event done;
};

struct Filled {
  Uploader::Place place;
  Job job;
};

// A queue between threads.
template <class T>
class Queue {
 public:
  void put(const T& one) {
    {
      const std::lock_guard lock(mutex_);
      waiting_.push_back(one);
    }
    given_.notify_one();
  }
  /// Wakes all waiting threads; from now on take() does not wait.
  void close() {
    {
      const std::lock_guard lock(mutex_);
      is_closed_ = true;
    }
    given_.notify_all();
  }
  /// Absent if the queue is empty, and after close().
  std::optional<T> take(bool wait) {
    std::unique_lock lock(mutex_);
    if (wait) given_.wait(lock, [this] { return is_closed_ || !waiting_.empty(); });
    if (is_closed_ || waiting_.empty()) return std::nullopt;
    const T one = waiting_.front();
    waiting_.pop_front();
    return one;
  }

 private:
  std::mutex mutex_;
  std::condition_variable given_;
  std::deque<T> waiting_;
  bool is_closed_ = false;
};

class FileUpload {
 public:
  // `is_archive`: the device decodes it, else load_direct().
  FileUpload(const FileView& file, const SectionPlaces& places, const UploadOptions& options, bool is_archive)
      : file_(file), places_(places), options_(options), is_archive_(is_archive) {}
  FileUpload(const FileUpload&) = delete;
  FileUpload& operator=(const FileUpload&) = delete;
  ~FileUpload() {
    for (const Lane& lane : lanes_) {
      if (lane.stream.get() != nullptr) cudaStreamSynchronize(lane.stream.get());
    }
    cudaStreamSynchronize(options_.stream);
  }

  Status run();

 private:
  void plan();
  Job job_at(std::uint64_t index) const;
  Status prepare();
  Status copy_tables();
  void work();
  Status fill_next(FrameContents& contents, bool& is_done);
  Status dispatch();
  Status reclaim(bool wait);
  Status fill(const Filled& filled, FrameContents& contents) const;
  Status queue(const Filled& filled, const Lane& lane);
  Status unpack(const Part& part, const Lane& lane);
  Status unpack_archive();
  Status check_tables() const;
  Status check_values();
  void fail(const Status& status);

  const FileView& file_;
  const SectionPlaces places_;
  const UploadOptions& options_;
  const bool is_archive_;
  unsigned n_threads_ = 1;
  std::optional<DirectData> decoded_;  // of another archive
  std::array<Section, 3> sections_;
  std::vector<Group> groups_;  // the slowest first
  std::uint64_t n_jobs_ = 0;
  Uploader ring_;
  std::uint64_t largest_ = 256;  // bytes of a job; streams may be empty
  DeviceBuffer staging_;
  DeviceBuffer coded_;                     // all jobs, of an archive
  std::vector<std::uint64_t> job_begins_;  // in it
  Event ready_;                            // the device's memory is allocated
  std::vector<Lane> lanes_;
  Queue<Uploader::Place> free_places_;  // of largest_ bytes
  Queue<Filled> filled_;
  std::atomic<std::uint64_t> next_{0};
  std::atomic<bool> has_failed_{false};
  std::mutex failing_;
  Status status_;
};

// Sections with equally many rows a frame, as writers make them, share jobs.
void FileUpload::plan() {
  const Header& h = file_.header();
  using Bytes = std::span<const std::byte>;
  const auto source = [&](SectionType type, std::uint64_t row_bytes, std::byte* place, Bytes decoded) {
    const FrameTable& table = file_.frames(type);
    if (decoded_) return Section{type, row_bytes, place, nullptr, decoded};
    if (table.rows != 0) return Section{type, row_bytes, place, &table, {}};
    return Section{type, row_bytes, place, nullptr, file_.stored(type)};
  };
  const DirectData* const d = decoded_ ? &*decoded_ : nullptr;
  sections_ = {source(SectionType::sh, sh_bytes(h.sh_degree), places_[2], d != nullptr ? d->sh() : Bytes()),
               source(SectionType::geometry, kGeometryBytes, places_[1], d != nullptr ? d->geometry() : Bytes()),
               source(SectionType::means, kMeanBytes, places_[0], d != nullptr ? d->means() : Bytes())};
  for (const Section& section : sections_) {
    const bool is_coded = section.table != nullptr;
    Group* same = nullptr;
    for (Group& group : groups_) {
      const FrameTable* const table = group.sections[0]->table;
      if (is_coded && table != nullptr && table->rows == section.table->rows) same = &group;
    }
    if (same == nullptr) same = &groups_.emplace_back();
    same->sections[same->n_sections++] = &section;
    same->n_jobs = is_coded ? section.table->frames.size() : (section.bytes.size() + kPieceBytes - 1) / kPieceBytes;
  }
  for (const Group& group : groups_) n_jobs_ += group.n_jobs;
}

Job FileUpload::job_at(std::uint64_t index) const {
  std::size_t k = 0;
  while (index >= groups_[k].n_jobs) index -= groups_[k++].n_jobs;
  const std::uint64_t chunk_size = file_.header().chunk_size;
  Job job;
  for (const Section* section : std::span(groups_[k].sections).first(groups_[k].n_sections)) {
    Part& part = job.parts[job.n_parts++];
    part.section = section;
    part.index = index;
    part.at = job.bytes;
    if (section->table == nullptr) {
      part.bytes = std::min<std::uint64_t>(kPieceBytes, section->bytes.size() - index * kPieceBytes);
    } else {
      part.bytes = frame_content_bytes(file_, section->type, index);
      const std::uint64_t rows = rows_of_frame(file_, section->type, index);
      if (section->type == SectionType::sh && !is_archive_) part.n_steps = (rows + chunk_size - 1) / chunk_size;
    }
    part.steps_at = part.at + align(part.bytes);
    job.bytes = part.steps_at + align(part.n_steps * sizeof(RelativeShSteps));
  }
  return job;
}

Status FileUpload::prepare() {
  std::uint64_t total = 0;
  for (std::uint64_t i = 0; i < n_jobs_; ++i) {
    job_begins_.push_back(total);
    const std::uint64_t bytes = job_at(i).bytes;
    largest_ = std::max(largest_, bytes);
    total += bytes;
  }
  const bool is_coded = std::ranges::any_of(sections_, [](const Section& s) { return s.table != nullptr; });
  if (n_jobs_ == 0) return {};
  constexpr std::uint64_t kWorthThreads = std::uint64_t{1} << 20;
  const unsigned machine = std::max(1u, std::thread::hardware_concurrency());
  n_threads_ = total < kWorthThreads ? 1 : static_cast<unsigned>(std::min<std::uint64_t>(machine, n_jobs_));

  const auto limited = [&](std::uint64_t bytes, std::uint64_t most) {
    const std::uint64_t fitting = std::clamp<std::uint64_t>(bytes / largest_, 2, most);
    return static_cast<std::size_t>(std::min<std::uint64_t>(fitting, n_jobs_));
  };
  // One place for each thread and some to copy. Locking pages takes time, so a small file gets a small ring.
  const std::uint64_t useful = std::min<std::uint64_t>(n_threads_ + n_threads_ / 2 + 1, n_jobs_ / 4);
  const std::size_t n_places = limited(kRingBytes, std::max<std::uint64_t>(useful, 2));
  n_threads_ = std::min(n_threads_, static_cast<unsigned>(n_places));
  lanes_ = std::vector<Lane>(limited(kStagingBytes, kMaxStreams));
  Status ok = ring_.create(n_places * largest_, n_places);
  if (ok && is_coded) {
    const auto memory = DeviceMemory::create(options_.allocator);
    if (!memory) return tl::unexpected(memory.error());
    ok = (is_archive_ ? coded_ : staging_)
             .reserve(is_archive_ ? total : lanes_.size() * largest_, *memory, options_.stream);
  }
  // The caller's allocator may return memory that is valid only once its stream gets there.
  if (ok) ok = ready_.create();
  if (ok) ok = ready_.record(options_.stream);
  if (ok) ok = reclaim(false);
  for (std::size_t i = 0; i < lanes_.size() && ok; ++i) {
    if (is_coded && !is_archive_) lanes_[i].memory = staging_.as<std::byte>() + i * largest_;
    ok = lanes_[i].stream.create();
    if (ok) ok = lanes_[i].done.create();
    if (ok) ok = ready_.hold(lanes_[i].stream.get());
  }
  return ok;
}

// SHSC and CHNK, which FileView::open() has decoded.
Status FileUpload::copy_tables() {
  const std::pair<std::byte*, std::span<const std::byte>> tables[] = {{places_[3], file_.step_table()},
                                                                      {places_[4], file_.chunk_table()}};
  for (const auto& [place, bytes] : tables) {
    if (bytes.empty()) continue;
    const Status ok =
        device_status(cudaMemcpyAsync(place, bytes.data(), bytes.size(), cudaMemcpyHostToDevice, options_.stream),
                      "a scene could not be copied to the device");
    if (!ok) return ok;
  }
  return {};
}

void FileUpload::fail(const Status& status) {
  {
    const std::lock_guard lock(failing_);
    if (!has_failed_) status_ = status;
    has_failed_ = true;
  }
  free_places_.close();
  filled_.close();
}

// A thread that fills places. The very first job is the check of the tables.
void FileUpload::work() {
  const Status worked = guard_memory([&]() -> Status {
    FrameContents contents;
    for (bool is_done = false; !is_done && !has_failed_;) {
      if (Status s = fill_next(contents, is_done); !s) return s;
    }
    return {};
  });
  if (!worked) fail(worked);
}

Status FileUpload::fill_next(FrameContents& contents, bool& is_done) {
  const std::uint64_t i = next_++;
  is_done = i > n_jobs_;
  if (is_done) return {};
  if (i == 0) return check_tables();
  const auto place = free_places_.take(true);
  if (!place) return {};  // another thread has failed
  const Filled filled{*place, job_at(i - 1)};
  if (Status s = fill(filled, contents); !s) return s;
  filled_.put(filled);
  return {};
}

// Gives threads the places that are free; waits for the oldest copy if `wait`.
Status FileUpload::reclaim(bool wait) {
  const Status ok = ring_.release(wait);
  while (const auto place = ring_.take(largest_)) free_places_.put(*place);
  return ok;
}

// On the caller's thread: queues filled places. If it is the only thread, it also fills them.
Status FileUpload::dispatch() {
  FrameContents contents;
  bool is_done = false;
  if (n_threads_ == 1) {
    if (Status s = fill_next(contents, is_done); !s) return s;  // the tables
  }
  for (std::uint64_t n_queued = 0; n_queued < n_jobs_ && !has_failed_;) {
    if (n_threads_ == 1) {
      if (Status s = reclaim(n_queued >= 2); !s) return s;  // there are two places or more
      if (Status s = fill_next(contents, is_done); !s) return s;
    }
    // With nothing to queue, waits for a copy, or else for a thread that fills a place.
    const auto filled = filled_.take(!ring_.can_wait());
    Status ok;
    if (filled) {
      const Lane& lane = lanes_[n_queued++ % lanes_.size()];
      ok = lane.done.wait();
      if (ok) ok = queue(*filled, lane);
    }
    if (ok) ok = reclaim(!filled);
    if (!ok) return ok;
  }
  return {};
}

Status FileUpload::fill(const Filled& filled, FrameContents& contents) const {
  std::byte* const memory = filled.place.memory;
  for (const Part& part : filled.job.all()) {
    const std::span to(memory + part.at, part.bytes);
    const Section& section = *part.section;
    if (section.table == nullptr) {
      std::memcpy(to.data(), section.bytes.data() + part.index * kPieceBytes, part.bytes);
      continue;
    }
    if (Status s = contents.read(file_, section.type, part.index, to); !s) return s;
    if (part.n_steps == 0) continue;
    const auto steps = relative_sh_steps(file_, part.index);
    if (!steps) return tl::unexpected(steps.error());
    std::memcpy(memory + part.steps_at, steps->data(), steps->size() * sizeof(RelativeShSteps));
  }
  return {};
}

Status FileUpload::queue(const Filled& filled, const Lane& lane) {
  const Job& job = filled.job;
  const Part& first = job.parts[0];
  const bool is_coded = first.section->table != nullptr;
  std::byte* const to = is_archive_ ? coded_.as<std::byte>() + job_begins_[first.index]
                        : is_coded  ? lane.memory
                                    : first.section->place + first.index * kPieceBytes;
  Status ok = device_status(cudaMemcpyAsync(to, filled.place.memory, is_coded ? job.bytes : first.bytes,
                                            cudaMemcpyHostToDevice, lane.stream.get()),
                            "a scene could not be copied to the device");
  if (ok) ok = ring_.send(filled.place.ticket, lane.stream.get());
  for (const Part& part : job.all()) {
    if (ok && is_coded && !is_archive_) ok = unpack(part, lane);
  }
  if (ok) ok = lane.done.record(lane.stream.get());
  return ok;
}

Status FileUpload::unpack(const Part& part, const Lane& lane) {
  const Section& section = *part.section;
  const auto* const content = reinterpret_cast<const std::uint8_t*>(lane.memory + part.at);
  const std::uint32_t n_rows = rows_of_frame(file_, section.type, part.index);
  std::byte* const rows = section.place + part.index * section.table->rows * section.row_bytes;
  switch (section.type) {
    case SectionType::means:
      return cuda::launch_unpack_means(content, n_rows, reinterpret_cast<float*>(rows), lane.stream.get());
    case SectionType::geometry:
      return cuda::launch_unpack_geometry(content, n_rows, reinterpret_cast<std::uint16_t*>(rows), lane.stream.get());
    default:
      return cuda::launch_unpack_sh(
          {content, reinterpret_cast<const RelativeShSteps*>(lane.memory + part.steps_at), n_rows,
           file_.header().chunk_size, file_.header().sh_degree, reinterpret_cast<std::uint32_t*>(rows)},
          lane.stream.get());
  }
}

// Once the device has all frames and the tables are checked.
Status FileUpload::unpack_archive() {
  const Header& h = file_.header();
  cuda::UnpackArchiveArguments a{};
  std::vector<std::byte> block;
  a.rules = archive_rules(file_, block);
  std::vector<cuda::ArchiveFrame> frames;
  for (std::uint64_t i = 0; i < n_jobs_; ++i) {
    const auto stream = [&](const Part& part) -> cuda::ArchiveFrame::Stream {
      return {job_begins_[i] + part.at, static_cast<std::uint32_t>(part.bytes)};  // as in the frame table
    };
    const Job job = job_at(i);
    frames.push_back({stream(job.parts[2]), stream(job.parts[1]), stream(job.parts[0])});
  }
  a.frame_rows = file_.frames(SectionType::sh).rows;
  const std::uint64_t of_frame = cuda::archive_frame_bytes(a.frame_rows, h.sh_degree);
  constexpr std::uint64_t kMostBlocks = 65535;  // on the second axis of a grid
  std::uint64_t n_at_once = std::clamp<std::uint64_t>(kArchiveBytes / of_frame, 1, std::min(n_jobs_, kMostBlocks));
  const std::uint64_t frames_at = align(block.size()), count_at = frames_at + align(frames.size() * sizeof frames[0]),
                      memory_at = count_at + align(sizeof(std::uint32_t));
  const auto memory = DeviceMemory::create(options_.allocator);
  if (!memory) return tl::unexpected(memory.error());
  DeviceBuffer buffer;
  Status ok = buffer.reserve(memory_at + n_at_once * of_frame, *memory, options_.stream);
  while (!ok && ok.error().code == Errc::device_out_of_memory && n_at_once > 1) {
    n_at_once = (n_at_once + 1) / 2;
    ok = buffer.reserve(memory_at + n_at_once * of_frame, *memory, options_.stream);
  }
  if (!ok) return ok;
  std::byte* const to = buffer.as<std::byte>();
  a.block = to;
  a.coded = coded_.as<std::byte>();
  a.frames = reinterpret_cast<const cuda::ArchiveFrame*>(to + frames_at);
  a.n_damaged = reinterpret_cast<std::uint32_t*>(to + count_at);
  a.memory = to + memory_at;
  a.n_at_once = static_cast<std::uint32_t>(n_at_once);
  a.n = static_cast<std::uint32_t>(h.n_gaussians);
  a.scale_exponent = h.scale_exponent;
  a.mean = reinterpret_cast<float*>(places_[0]);
  a.geometry = reinterpret_cast<std::uint16_t*>(places_[1]);
  a.sh = reinterpret_cast<std::uint32_t*>(places_[2]);
  a.sh_steps = reinterpret_cast<const float*>(places_[3]);
  a.chunks = reinterpret_cast<const std::uint32_t*>(places_[4]);
  a.chunk_size = h.chunk_size;
  a.sh_degree = h.sh_degree;
  const auto copy = [&](void* place, const void* from, std::size_t bytes, cudaMemcpyKind kind) {
    return device_status(cudaMemcpyAsync(place, from, bytes, kind, options_.stream), "an archive could not be copied");
  };
  std::uint32_t n_damaged = 0;
  ok = copy(to, block.data(), block.size(), cudaMemcpyHostToDevice);
  if (ok) ok = copy(to + frames_at, frames.data(), frames.size() * sizeof frames[0], cudaMemcpyHostToDevice);
  if (ok) ok = copy(a.n_damaged, &n_damaged, sizeof n_damaged, cudaMemcpyHostToDevice);
  if (ok) ok = cuda::launch_unpack_archive(a, options_.stream);
  if (ok) ok = copy(&n_damaged, a.n_damaged, sizeof n_damaged, cudaMemcpyDeviceToHost);
  const Status done = device_status(cudaStreamSynchronize(options_.stream), "an archive could not be decoded");
  if (ok) ok = done;
  if (ok && n_damaged != 0) ok = make_error(Errc::corrupt_data, Error::kNone, "the device found damaged streams");
  return ok;
}

// Values that kernels use as an index are always checked.
Status FileUpload::check_tables() const {
  if (options_.validate && !decoded_) return validate_tables(file_);
  for (std::uint64_t i = 0; i < file_.header().n_chunks; ++i) {
    if (const auto entry = file_.chunk(i); !entry) return tl::unexpected(entry.error());
  }
  return {};
}

// On the device, once it has everything and the tables are checked.
Status FileUpload::check_values() {
  const Header& h = file_.header();
  cuda::CheckedValues found{};
  if (h.n_gaussians != 0) {
    const auto memory = DeviceMemory::create(options_.allocator);
    if (!memory) return tl::unexpected(memory.error());
    DeviceBuffer buffer;
    Status ok = buffer.reserve(sizeof found, *memory, options_.stream);
    if (!ok) return ok;
    auto* const values = buffer.as<cuda::CheckedValues>();
    ok = device_status(cudaMemsetAsync(values, 0, sizeof found, options_.stream), "memory could not be cleared");
    if (ok) {
      ok = cuda::launch_check_values(compact_attributes(h, places_), static_cast<std::uint32_t>(h.n_gaussians), values,
                                     options_.stream);
    }
    if (ok) {
      ok = device_status(cudaMemcpyAsync(&found, values, sizeof found, cudaMemcpyDeviceToHost, options_.stream),
                         "what a check has found could not be read");
    }
    const Status done = device_status(cudaStreamSynchronize(options_.stream), "a scene could not be checked");
    if (ok) ok = done;
    if (!ok) return ok;
  }
  if (found.n_damaged != 0) return make_error(Errc::bad_value, Error::kNone, "the device found damaged values");
  return validate_declarations(file_, found.counts);
}

Status FileUpload::run() {
  using Clock = std::chrono::steady_clock;
  const auto start = Clock::now();
  UploadTimes times;
  const auto since_start = [&] { return std::chrono::duration<double, std::milli>(Clock::now() - start).count(); };

  if (file_.archive() != nullptr && !is_archive_) {
    auto data = load_direct(file_, {options_.validate, 0});
    if (!data) return tl::unexpected(data.error());
    decoded_ = std::move(*data);
  }
  const double decoded_ms = since_start();
  plan();
  Status ok = prepare();
  if (ok) ok = copy_tables();
  if (!ok) return ok;
  times.setup_ms = since_start() - decoded_ms;

  std::vector<std::thread> threads;
  threads.reserve(n_threads_);
  if (n_threads_ > 1) {
    try {
      while (threads.size() < n_threads_) threads.emplace_back([this] { work(); });
    } catch (...) {  // no more threads, or no memory for one: the existing ones do the work
    }
    if (threads.empty()) n_threads_ = 1;
  }
  if (const Status queued = guard_memory([this] { return dispatch(); }); !queued) fail(queued);
  for (std::thread& thread : threads) thread.join();
  times.host_ms = since_start() - times.setup_ms;

  for (const Lane& lane : lanes_) {
    const Status done = device_status(cudaStreamSynchronize(lane.stream.get()), "a scene could not be decoded");
    if (!done) fail(done);
  }
  const Status copied =
      device_status(cudaStreamSynchronize(options_.stream), "a scene could not be copied to the device");
  if (!copied) fail(copied);
  if (!status_) return status_;
  if (is_archive_) ok = unpack_archive();
  if (ok && options_.validate && !decoded_) ok = check_values();
  times.device_ms = since_start() - times.host_ms - times.setup_ms;
  if (ok && options_.times != nullptr) *options_.times = times;
  return ok;
}

// An archive with frames as small as writers make them: those of a hostile file would need as much page-locked memory.
bool device_decodes(const FileView& file) {
  if (file.archive() == nullptr || file.archive()->codec != Codec::archive) return false;
  const auto is_small = [](const CodedFrame& frame) { return frame.stored_bytes <= kRingBytes / 8; };
  return file.header().n_gaussians != 0 &&
         std::ranges::all_of(std::array{SectionType::means, SectionType::geometry, SectionType::sh},
                             [&](SectionType type) { return std::ranges::all_of(file.frames(type).frames, is_small); });
}

// Whether the device or this process is to blame, not the file.
bool is_of_machine(Errc code) {
  return code == Errc::host_out_of_memory || code == Errc::device_out_of_memory || code == Errc::device_failed ||
         code == Errc::unavailable || code == Errc::bad_argument;
}

}  // namespace

cuda::CompactAttributes compact_attributes(const Header& header, const SectionPlaces& places) {
  return {reinterpret_cast<const float*>(places[0]),         reinterpret_cast<const std::uint16_t*>(places[1]),
          reinterpret_cast<const std::uint32_t*>(places[2]), reinterpret_cast<const float*>(places[3]),
          reinterpret_cast<const std::uint32_t*>(places[4]), header.chunk_size,
          std::ldexp(1.0F, -header.scale_exponent),          header.sh_degree};
}

Status upload_file(const FileView& file, const SectionPlaces& places, const UploadOptions& options) {
  const bool is_archive = device_decodes(file);
  Status uploaded = FileUpload(file, places, options, is_archive).run();
  if (is_archive && !uploaded && uploaded.error().code == Errc::device_out_of_memory) {
    uploaded = FileUpload(file, places, options, false).run();
  }
  if (uploaded || is_of_machine(uploaded.error().code)) return uploaded;
  const auto data = load_direct(file, {options.validate, 0});
  if (!data) return tl::unexpected(data.error());
  // Without validation load_direct() does not check all tables; trust an error that has an offset.
  if (uploaded.error().offset != Error::kNone) return uploaded;
  return make_error(Errc::device_failed, Error::kNone, "the device reports damage that the host does not find");
}

}  // namespace rgs::detail
