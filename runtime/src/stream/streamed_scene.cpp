// streamed_scene.cpp - opens a streamed scene: its tables, its root, its threads; and ends it.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/streamed_scene.hpp"

#include <algorithm>
#include <system_error>
#include <utility>

#include "rgs/guard_memory.hpp"
#include "stream/streamed_state.hpp"

namespace rgs {

using namespace detail;

namespace {

constexpr std::uint64_t kFirstBytes = 64 << 10;  // of a file; enough for the head of any
constexpr std::uint64_t kRecordBytes = 112;      // of a page, in the file's table
constexpr std::uint64_t kPageBytes = sizeof(lod::Page) + sizeof(StoredPage);
/// Sections, declarations, an archive's tables, what threads and locks take.
constexpr std::uint64_t kSceneBytes = 256 << 10;
constexpr std::uint64_t kLeastReadBytes = 256 << 10;
constexpr std::uint64_t kReadersShare = 8;  // of the budget, that threads may take
constexpr int kMostThreads = 64;

tl::unexpected<Error> too_small(std::uint64_t needed, std::uint64_t budget) {
  return make_error(Errc::limit_exceeded, Error::kNone,
                    "the memory budget does not hold the scene's tables and its coarsest page", needed, budget);
}

}  // namespace

Status StreamedState::take(std::uint64_t n) {
  const std::scoped_lock lock(pool->mutex);
  if (pool->take(n, kNeeded) != StreamPoolState::Room::taken) return too_small(pool->held + n, pool->budget);
  bytes += n;
  return {};
}

// Reads twice as much until the tables are there: where they end is said by nothing before them.
Status StreamedState::read_tables(const DecodeLimits& limits) {
  if (Status taken = take(kSceneBytes); !taken) return taken;
  for (std::uint64_t n = std::min(kFirstBytes, source->size());; n = std::min(2 * n, source->size())) {
    if (Status taken = take(n); !taken) return taken;
    std::vector<std::byte> longer(n);
    std::ranges::copy(head, longer.begin());
    const std::uint64_t before = head.size();
    if (Status read = source->read(before, std::span(longer).subspan(before)); !read) return read;
    stats.bytes_read += n - before;
    head = std::move(longer);
    const std::uint64_t most_pages = n / kRecordBytes * kPageBytes;
    if (Status taken = take(most_pages); !taken) return taken;
    auto opened = PagedFile::open(head, limits);
    {
      const std::scoped_lock lock(pool->mutex);
      const std::uint64_t given = before + most_pages - (opened ? opened->n_pages() * kPageBytes : 0);
      pool->give(given);
      bytes -= given;
    }
    if (opened) {
      file = *std::move(opened);
      declarations = file->head().declarations();
      return {};
    }
    const bool is_short = opened.error().code == Errc::truncated && n < source->size();
    if (is_short && has_levels(head)) continue;
    if (is_short) {
      return make_error(
          Errc::missing_section, Error::kNone,
          "the file has no levels of detail, by which it could be streamed: rgs-convert --lod makes them");
    }
    return tl::unexpected(opened.error());
  }
}

// Threads take a share of the budget at most, and what is needed at least.
Status StreamedState::make_room_for_pages() {
  traits = source->traits();
  const std::uint64_t needed = Residency::bytes(file->pages()) + file->n_pages() * sizeof(blocks[0]);
  if (Status taken = take(needed); !taken) return taken;
  residency.emplace(file->pages());
  blocks.resize(file->n_pages());
  const std::uint64_t least = PageReader::largest_stored(*file), share = pool->budget / kReadersShare;
  std::uint64_t read_bytes = std::max(least, traits.most_bytes);
  auto n = static_cast<std::uint64_t>(std::clamp(traits.reads_at_once, 1, kMostThreads));
  while (n > 1 && n * PageReader::bytes(*file, read_bytes) > share) {
    if (read_bytes / 2 >= std::max(least, kLeastReadBytes)) {
      read_bytes /= 2;
    } else {
      n -= 1;
    }
  }
  if (PageReader::bytes(*file, read_bytes) > share) read_bytes = least;
  traits.most_bytes = read_bytes;
  if (Status taken = take(n * PageReader::bytes(*file, read_bytes)); !taken) return taken;
  for (std::uint64_t i = 0; i < n; ++i) readers.push_back(std::make_unique<PageReader>(*file, *source, read_bytes));
  return {};
}

Status StreamedState::read_root() {
  if (Status taken = take(page_bytes(0)); !taken) return taken;
  auto block = readers.front()->read(0, 1);
  stats.bytes_read += readers.front()->take_bytes_read();
  if (!block) return tl::unexpected(block.error());
  blocks[0] = *std::move(block);
  stats.bytes_decoded += file->decoded_bytes(0);
  // Without lists a view cannot be drawn.
  const std::scoped_lock lock(pool->mutex);
  if (pool->take(least_view_bytes(), kNeeded) != StreamPoolState::Room::taken)
    return too_small(pool->held + least_view_bytes(), pool->budget);
  pool->give(least_view_bytes());
  return {};
}

Status StreamedState::start_threads() {
  {
    const std::scoped_lock lock(pool->mutex);
    pool->scenes.push_back(this);
  }
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
                                                           const StreamOptions& options,
                                                           std::shared_ptr<StreamPoolState> pool) {
  auto state = std::make_shared<StreamedState>();
  state->pool = std::move(pool);
  state->source = std::move(source);
  state->prefetches = options.prefetch;
  Status ok = state->read_tables(options.limits);
  if (ok) ok = state->make_room_for_pages();
  if (ok) ok = state->read_root();
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
  // Others may use the room as soon as the lock is gone: nothing is left in it by then.
  std::uint64_t given = bytes;
  for (const auto& view : views) {
    given += view->bytes;
    if (pool->last_view == view.get()) pool->last_view = nullptr;
  }
  for (std::uint32_t group = 0; residency && group < residency->n_groups(); ++group) {
    if (residency->state(group) == Residency::State::resident) given += group_bytes(group);
  }
  views.clear(), readers.clear();
  blocks = decltype(blocks)();
  residency.reset(), file.reset();
  head = decltype(head)();
  pool->give(given);
  pool->forget(this);
}

StreamPool::StreamPool(std::shared_ptr<StreamPoolState> state) : state_(std::move(state)) {}

Result<StreamPool> StreamPool::create(const StreamPoolOptions& options) {
  return guard_memory([&]() -> Result<StreamPool> {
    if (options.host_memory == 0) {
      return make_error(Errc::bad_argument, Error::kNone, "a memory budget of 0 bytes holds no scene");
    }
    return StreamPool(std::make_shared<StreamPoolState>(options.host_memory));
  });
}

std::uint64_t StreamPool::host_bytes() const {
  const std::scoped_lock lock(state_->mutex);
  return state_->held;
}
std::uint64_t StreamPool::host_memory() const {
  return state_->budget;
}

StreamedScene::StreamedScene(std::shared_ptr<StreamedState> state) : state_(std::move(state)) {}

Result<StreamedScene> StreamedScene::open(std::unique_ptr<ByteSource> source, const StreamOptions& options) {
  return guard_memory([&]() -> Result<StreamedScene> {
    if (source == nullptr) return make_error(Errc::bad_argument, Error::kNone, "there is no source");
    std::optional<StreamPool> pool = options.pool;
    if (!pool) {
      auto own = StreamPool::create();
      if (!own) return tl::unexpected(own.error());
      pool = *std::move(own);
    }
    auto state = StreamedState::open(std::move(source), options, pool->state_);
    if (!state) return tl::unexpected(state.error());
    return StreamedScene(*std::move(state));
  });
}

Result<StreamedScene> StreamedScene::open(const std::string& path_or_url, const StreamOptions& options) {
  auto source = open_source(path_or_url, options.url);
  if (!source) return tl::unexpected(source.error());
  return open(*std::move(source), options);
}

std::uint64_t StreamedScene::size() const {
  return state_->file->head().header().n_gaussians;
}
int StreamedScene::sh_degree() const {
  return state_->file->head().header().sh_degree;
}
const std::optional<Declarations>& StreamedScene::declarations() const {
  return state_->declarations;
}
const Origin& StreamedScene::origin() const {
  return state_->declarations->origin;
}

Status StreamedScene::status() const {
  const std::scoped_lock lock(state_->pool->mutex);
  return state_->status();
}
StreamStats StreamedScene::stats() const {
  const std::scoped_lock lock(state_->pool->mutex);
  return state_->stats_now();
}

}  // namespace rgs
