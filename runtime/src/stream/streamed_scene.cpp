// streamed_scene.cpp - opens a streamed scene (tables, root, threads) and closes it.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <system_error>
#include <utility>

#include "rgs/guard_memory.hpp"
#include "rgs/scene.hpp"
#include "rgs/subject_box.hpp"
#include "stream/streamed_state.hpp"

namespace rgs {

using namespace detail;

namespace {

constexpr std::uint64_t kFirstBytes = 64 << 10;  // of a file: enough for any head
/// Sections, declarations, first bytes, threads and locks.
constexpr std::uint64_t kSceneBytes = 256 << 10;
constexpr std::uint64_t kLeastReadBytes = 256 << 10;
constexpr std::uint64_t kReadersShare = 8;  // of the budget: at most an eighth for threads
constexpr int kMostThreads = 64;

tl::unexpected<Error> too_small(std::uint64_t needed, std::uint64_t budget) {
  return make_error(Errc::limit_exceeded, Error::kNone,
                    "the memory budget does not hold the scene's tables and its coarsest page", needed, budget);
}

}  // namespace

Status StreamedState::take(std::uint64_t n) {
  const std::scoped_lock lock(pool->mutex);
  if (!pool->take(n)) return too_small(pool->held() + n, pool->budget);
  bytes += n;
  return {};
}

// Reads the head, the start of the table of pages, and what else decoding a page needs.
Status StreamedState::read_tables(const DecodeLimits& limits) {
  if (Status taken = take(kSceneBytes); !taken) return taken;
  std::vector<std::vector<std::byte>> memory;
  std::vector<FilePart> parts;
  std::uint64_t part_bytes = 0;
  const auto read = [&](const FileRange& range) -> Status {
    if (range.offset > source->size() || range.bytes > source->size() - range.offset) {
      return make_error(Errc::truncated, source->size(), "the file ends before its first page",
                        range.offset + range.bytes, source->size());
    }
    if (Status taken = take(range.bytes); !taken) return taken;
    part_bytes += range.bytes;
    memory.emplace_back(range.bytes);
    parts.push_back({range.offset, memory.back()});
    stats.bytes_read += range.bytes;
    return source->read(range.offset, memory.back());
  };
  if (Status done = read({0, std::min(kFirstBytes, source->size())}); !done) return done;
  for (;;) {
    const auto needed = PagedFile::needs(parts, limits, source->size());
    if (!needed) return tl::unexpected(needed.error());
    if (needed->empty()) break;
    for (const FileRange& range : *needed) {
      if (Status done = read(range); !done) return done;
    }
  }
  const std::uint64_t archive = names_section(parts.front().bytes, SectionType::archive) ? kMostArchiveMemory : 0;
  if (Status taken = take(archive); !taken) return taken;
  auto opened = PagedFile::open_beginning(parts, limits, source->size());
  if (!opened) return tl::unexpected(opened.error());
  // Reserves the whole table now, so that it cannot fail later. An archive's tables are reserved above.
  const std::uint64_t whole = opened->whole_memory_bytes();
  if (Status taken = take(whole - std::min(whole, archive)); !taken) return taken;
  file = *std::move(opened);
  subject = placed(subject_box(file->pages()), file->head().declarations().origin);
  if (Status reserved = file->reserve(); !reserved) return reserved;
  memory.clear();
  const std::scoped_lock lock(pool->mutex);
  const std::uint64_t given = part_bytes + archive - std::min(whole, archive);
  pool->release(given);
  bytes -= given;
  return {};
}

// Threads get a share of the budget, but at least what they need.
Status StreamedState::make_room_for_pages(bool prefetches) {
  traits = source->traits();
  const std::uint32_t n_pages = file->n_pages_in_all();
  std::shared_ptr<DeviceSlots> slots;
  if (pool->is_on_device()) {
    const std::scoped_lock lock(pool->mutex);
    auto made = pool->slots_of(SlotShape::of(*file));
    if (!made) return tl::unexpected(made.error());
    slots = *std::move(made);
  }
  const std::uint64_t tables = pages::Scheduler::scene_bytes(n_pages) + PageStore::bytes(n_pages, slots.get());
  if (Status taken = take(tables); !taken) return taken;
  store.emplace(*file, slots);
  const std::uint64_t least = PageReader::least_bytes(*file), share = pool->budget / kReadersShare;
  std::uint64_t read_bytes = std::max(least, traits.most_bytes);
  auto n = static_cast<std::uint64_t>(std::clamp(traits.reads_at_once, 1, kMostThreads));
  std::uint32_t n_staged = kStagedPages;
  const auto reader_bytes = [&] { return PageReader::bytes(*file, read_bytes, slots.get(), n_staged); };
  while (n * reader_bytes() > share) {
    if (slots != nullptr && n_staged > kLeastStagedPages) {
      n_staged /= 2;
    } else if (read_bytes / 2 >= std::max(least, kLeastReadBytes)) {
      read_bytes /= 2;
    } else if (n > 1) {
      n -= 1;
    } else {
      read_bytes = least;
      break;
    }
  }
  traits.most_bytes = read_bytes;
  if (Status taken = take(n * reader_bytes()); !taken) return taken;
  for (std::uint64_t i = 0; i < n; ++i) {
    std::optional<SlotWriter> writer;
    if (slots != nullptr) {
      auto created = SlotWriter::create(slots, n_staged);
      if (!created) return tl::unexpected(created.error());
      writer.emplace(*std::move(created));
    }
    readers.push_back(std::make_unique<PageReader>(*file, *source, read_bytes, *store, std::move(writer)));
  }
  const PageStore::Cost cost = store->cost();
  const std::scoped_lock lock(pool->mutex);
  id = pool->scheduler->add_scene({.pages = &file->pages(),
                                   .stored = &file->stored(0),
                                   .is_verified = file->is_verified(),
                                   .page_bytes = cost.page,
                                   .row_bytes = cost.row,
                                   .n_readers = static_cast<std::uint32_t>(n),
                                   .most_bytes = traits.most_bytes,
                                   .gap_bytes = traits.gap_bytes,
                                   .prefetches = prefetches});
  is_scheduled = true;
  pool->scenes.push_back(this);
  return {};
}

Status StreamedState::read_root() {
  {
    const std::scoped_lock lock(pool->mutex);
    const std::uint64_t n = root_bytes();
    if (!pool->take_for_pages(n)) {
      if (!pool->is_on_device()) return too_small(pool->held() + n, pool->budget);
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "the device's budget does not hold the scene's coarsest page", pool->device_memory + n,
                        pool->device_memory);
    }
    store->reserve(0);
    has_root = true;
  }
  Status read = readers.front()->read(0, 1);
  if (const Status there = readers.front()->finish(); read) read = there;
  stats.bytes_read += readers.front()->take_bytes_read();
  if (!read) return read;
  readable = readers.front()->last_read();
  stats.bytes_decoded += file->decoded_bytes(0);
  if (pool->is_on_device()) stats.bytes_uploaded += file->decoded_bytes(0);
  // A view cannot be drawn without lists.
  const std::scoped_lock lock(pool->mutex);
  if (!pool->take(least_view_bytes())) return too_small(pool->held() + least_view_bytes(), pool->budget);
  pool->release(least_view_bytes());
  return {};
}

Status StreamedState::start_threads() {
  try {
    for (const auto& reader : readers) threads.emplace_back([this, &reader] { work_until_stopped(*reader); });
  } catch (const std::system_error& failed) {
    if (threads.empty()) {
      return make_error(Errc::host_out_of_memory, Error::kNone, "no thread could be started to read the scene",
                        Error::kNone, Error::kNone, failed.code().value());
    }
  }
  return {};
}

Result<std::shared_ptr<StreamedState>> StreamedState::open(std::unique_ptr<ByteSource> source,
                                                           const OpenOptions& options,
                                                           std::shared_ptr<StreamPoolState> pool) {
  auto state = std::make_shared<StreamedState>();
  state->pool = std::move(pool);
  state->source = std::move(source);
  state->source->set_limit(options.url.open_seconds);
  Status ok = state->read_tables(options.limits);
  if (ok) ok = state->make_room_for_pages(options.prefetch);
  if (ok) ok = state->read_root();
  state->source->set_limit(std::numeric_limits<double>::infinity());
  if (ok) ok = state->start_threads();
  if (!ok) return tl::unexpected(ok.error());
  return state;
}

StreamedState::~StreamedState() {
  {
    const std::scoped_lock lock(pool->mutex);
    is_stopping = true;
    work.notify_all();
  }
  source->cancel();
  for (std::thread& thread : threads) thread.join();
  const std::scoped_lock lock(pool->mutex);
  // Others may use the memory once the lock is released, so everything is freed before.
  std::uint64_t given = bytes;
  for (const auto& view : views) given += view_bytes() + view->lists.bytes;
  views.clear(), readers.clear();
  const std::uint64_t root = has_root ? root_bytes() : 0;
  store.reset();
  if (is_scheduled) {
    std::erase(pool->scenes, this);
    pool->scheduler->remove_scene(id);
  }
  file.reset();
  if (root > 0) pool->tell(pages::event::Release{root});
  pool->release(given);
  pool->wake();
  pool->news.notify_all();
}

StreamPool::StreamPool(std::shared_ptr<StreamPoolState> state) : state_(std::move(state)) {}

Result<StreamPool> StreamPool::create(const StreamPoolOptions& options) {
  return guard_memory([&]() -> Result<StreamPool> {
    if (options.host_memory == 0) {
      return make_error(Errc::bad_argument, Error::kNone, "a memory budget of 0 bytes holds no scene");
    }
    const std::uint64_t on_device = options.device_memory;
    const std::uint64_t workspace = options.device_workspace != 0 ? options.device_workspace : on_device / 2;
    if (workspace > 0 && workspace >= on_device) {
      return make_error(Errc::bad_argument, Error::kNone, "the renderers' workspace leaves no device memory for pages",
                        on_device, workspace);
    }
    return StreamPool(std::make_shared<StreamPoolState>(options.host_memory, on_device, workspace));
  });
}

std::uint64_t StreamPool::host_bytes() const {
  const std::scoped_lock lock(state_->mutex);
  return state_->held();
}
std::uint64_t StreamPool::host_memory() const {
  return state_->budget;
}
std::uint64_t StreamPool::device_bytes() const {
  const std::scoped_lock lock(state_->mutex);
  const auto slots = state_->slots.lock();
  return slots ? slots->plan().bytes + slots->workspace().held() : 0;
}
std::uint64_t StreamPool::device_memory() const {
  return state_->device_memory;
}

namespace {

Result<Scene> read_whole(ByteSource& source, const OpenOptions& options) {
  source.set_limit(options.url.open_seconds);
  std::vector<std::byte> bytes(source.size());
  const std::uint64_t most = source.traits().most_bytes;
  for (std::uint64_t at = 0; at < bytes.size(); at += most) {
    const auto part = std::span(bytes).subspan(at, std::min<std::uint64_t>(most, bytes.size() - at));
    if (Status read = source.read(at, part); !read) return tl::unexpected(read.error());
  }
  return Scene::load(bytes, options.limits);
}

}  // namespace

Result<Scene> Scene::open(std::unique_ptr<ByteSource> source, const OpenOptions& options) {
  return guard_memory([&]() -> Result<Scene> {
    if (source == nullptr) return make_error(Errc::bad_argument, Error::kNone, "the source is null");
    if (!options.pool) return read_whole(*source, options);
    auto state = StreamedState::open(std::move(source), options, options.pool->state_);
    if (!state) return tl::unexpected(state.error());
    return Scene(*std::move(state));
  });
}

Status Scene::status() const {
  if (!is_streamed()) return {};
  const std::scoped_lock lock(streamed()->pool->mutex);
  return streamed()->status();
}
StreamStats Scene::stats() const {
  if (!is_streamed()) return {};
  const std::scoped_lock lock(streamed()->pool->mutex);
  return streamed()->stats_now();
}

}  // namespace rgs
