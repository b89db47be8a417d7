// stream_levels.cpp - builds levels through scratch files: ranges of the Morton curve, groups of pages, pages coarse to
// fine.
// SPDX-License-Identifier: Apache-2.0
#include "stream_levels.hpp"

#include <tbb/blocked_range.h>
#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>
#include <tbb/spin_mutex.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cassert>
#include <cstring>
#include <utility>

#include "core_box.hpp"
#include "fit_device.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"
#include "rgs/spatial_order.hpp"

namespace rgs::lod {
namespace {

constexpr std::size_t kValues = 11;     // of a Gaussian without its harmonics
constexpr std::uint64_t kWeighing = 8;  // to weigh a Gaussian's merges is an eighth of what Quality::fast does with it

Error source_changed() {
  return {Errc::read_failed, Error::kNone, "the source changed while it was read", Error::kNone, Error::kNone, 0};
}

// Memory of a group while it is simplified: of its Gaussians, and of pictures.
std::uint64_t group_bytes(const BuildOptions& build) {
  const std::uint64_t rows = std::uint64_t{build.children} * build.page_chunks * build.chunk_size;
  const bool fits_pictures = build.quality == Quality::best && build.device == nullptr;
  return 1536 * rows + (std::uint64_t{fits_pictures ? 56U : 12U} << 20);
}

template <class F>
void each_in_parallel(std::size_t n, const F& f) {
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, n), [&f](const tbb::blocked_range<std::size_t>& range) {
    for (std::size_t i = range.begin(); i < range.end(); ++i) f(i);
  });
}

class FirstFailure {
 public:
  void note(const Status& status) {
    if (status) return;
    const tbb::spin_mutex::scoped_lock lock(mutex_);
    if (status_) status_ = status;
    failed_ = true;
  }
  bool any() const { return failed_; }
  Status status() const { return status_; }

 private:
  tbb::spin_mutex mutex_;
  std::atomic<bool> failed_{false};
  Status status_;
};

}  // namespace

Status each_at_once(std::size_t n, std::uint64_t at_once, const std::function<Status(std::size_t i)>& job) {
  FirstFailure failure;
  const auto run = [&] {
    tbb::parallel_for(
        tbb::blocked_range<std::size_t>(0, n, 1),
        [&](const tbb::blocked_range<std::size_t>& range) {
          for (std::size_t i = range.begin(); i < range.end() && !failure.any(); ++i) {
            failure.note(detail::guard_memory([&] { return job(i); }));
          }
        },
        tbb::simple_partitioner());
  };
  if (at_once >= static_cast<std::uint64_t>(tbb::this_task_arena::max_concurrency())) {
    run();
  } else {
    tbb::task_arena(static_cast<int>(at_once)).execute(run);
  }
  return failure.status();
}

std::uint64_t most_at_once(const StreamOptions& options, std::uint64_t bytes_each) {
  const auto threads = static_cast<std::uint64_t>(tbb::this_task_arena::max_concurrency());
  return std::clamp<std::uint64_t>(options.memory_bytes / 4 / bytes_each, 1, threads);
}

Status each_kept(const SplatStream& stream, int sh_degree, BadPolicy on_bad, const VisitKept& visit) {
  constexpr std::size_t kPart = 4096;
  std::vector<Splat> kept;
  std::vector<std::uint32_t> positions;
  std::vector<char> keeps;
  return stream.read([&](std::uint64_t first, std::span<const Splat> rows) -> Status {
    kept.assign(rows.begin(), rows.end());
    keeps.assign(rows.size(), 0);
    each_in_parallel((rows.size() + kPart - 1) / kPart, [&](std::size_t part) {
      SceneScan repair_scan(sh_degree, on_bad);
      for (std::size_t i = part * kPart; i < std::min(rows.size(), (part + 1) * kPart); ++i) {
        keeps[i] = static_cast<char>(repair_scan.add(kept[i]));
      }
    });
    positions.clear();
    std::size_t n = 0;
    for (std::size_t i = 0; i < rows.size(); ++i) {
      if (keeps[i] == 0) continue;
      if (n != i) kept[n] = kept[i];
      ++n;
      positions.push_back(static_cast<std::uint32_t>(first + i));
    }
    return visit(std::span<const std::uint32_t>(positions), std::span<const Splat>(kept).first(n));
  });
}

std::vector<std::uint64_t> keys_of(std::span<const Splat> rows, const MortonKey& key) {
  std::vector<std::uint64_t> keys(rows.size());
  each_in_parallel(rows.size(), [&](std::size_t i) { keys[i] = key(rows[i].mean); });
  return keys;
}

void sort_rows(std::vector<std::byte>& rows, std::uint64_t row_bytes, const MortonKey& key) {
  const std::uint64_t n = rows.size() / row_bytes;
  std::vector<std::uint64_t> keys(n);
  std::vector<std::uint32_t> indices(n);
  each_in_parallel(n, [&](std::size_t i) {
    float mean[3];
    std::memcpy(mean, &rows[i * row_bytes], sizeof mean);
    keys[i] = key(mean);
    indices[i] = static_cast<std::uint32_t>(i);
  });
  const std::vector<std::size_t> starts = partition_by_key(keys, indices);
  each_in_parallel(starts.size() - 1, [&](std::size_t bucket) {
    const std::size_t begin = starts[bucket], count = starts[bucket + 1] - begin;
    if (count > 1) sort_bucket(std::span(keys).subspan(begin, count), std::span(indices).subspan(begin, count));
  });
  keys = std::vector<std::uint64_t>();  // `= {}` would keep the memory
  std::vector<std::byte> sorted(rows.size());
  each_in_parallel(
      n, [&](std::size_t i) { std::memcpy(&sorted[i * row_bytes], &rows[indices[i] * row_bytes], row_bytes); });
  rows = std::move(sorted);
}

void add_to_chunks(const LevelRows& leaves, std::uint64_t first, std::span<const std::byte> rows,
                   std::uint64_t chunk_size, std::vector<ChunkBoxes>& chunks) {
  const std::uint64_t row_bytes = leaves.row_bytes(), last = first + rows.size() / row_bytes;
  const std::uint64_t first_chunk = first / chunk_size;
  each_in_parallel((last + chunk_size - 1) / chunk_size - first_chunk, [&](std::size_t k) {
    const std::uint64_t begin = std::max(first, (first_chunk + k) * chunk_size);
    const std::uint64_t end = std::min(last, (first_chunk + k + 1) * chunk_size);
    SplatCloud part;
    leaves.unpack(rows.subspan((begin - first) * row_bytes, (end - begin) * row_bytes), part);
    chunks[first_chunk + k].add(chunk_boxes(part.view(), 0, end - begin));
  });
}

namespace {

// Maps rows to ranges; within a range they keep the source's order.
struct Ranges {
  std::vector<std::uint32_t> of_cell;  // empty: source order, or a single range
  std::vector<std::uint64_t> first;    // [ranges + 1]
  std::uint64_t rows_each = 0;         // without cells
  int cell_bits = 0;
};

Result<Ranges> cut_ranges(const SplatStream& stream, const SceneScan& scan, const EncodeOptions& encode,
                          std::uint64_t most_rows, const StreamOptions& options) {
  const std::uint64_t n = scan.n_kept();
  Ranges ranges;
  if (encode.order == Order::input || n <= most_rows) {
    ranges.rows_each = most_rows;
    for (std::uint64_t first = 0; first < n; first += most_rows) ranges.first.push_back(first);
    ranges.first.push_back(n);
    return ranges;
  }
  options.begin("cut", stream.n, "Gaussians");
  ranges.cell_bits = std::min(kCellKeyBits, static_cast<int>(std::bit_width(options.memory_bytes / 128)) - 1);
  std::vector<std::uint32_t> counts(std::size_t{1} << ranges.cell_bits);
  const MortonKey key(scan.robust());
  const Status counted = each_kept(stream, scan.sh_degree(), encode.on_bad,
                                   [&](std::span<const std::uint32_t>, std::span<const Splat> rows) {
                                     for (const std::uint64_t k : keys_of(rows, key))
                                       ++counts[k >> (63 - ranges.cell_bits)];
                                     options.advance(rows.size());
                                     return Status();
                                   });
  if (!counted) return tl::unexpected(counted.error());
  ranges.first.push_back(0);
  std::uint64_t end = 0, total = 0;
  for (std::uint32_t& count : counts) {
    const std::uint64_t of_cell = count;
    if (end > ranges.first.back() && end + of_cell > ranges.first.back() + most_rows) ranges.first.push_back(end);
    if (of_cell > most_rows) {
      return make_error(Errc::limit_exceeded, Error::kNone,
                        "too many Gaussians are adjacent on the Morton curve to sort them in this memory; "
                        "raise --memory",
                        most_rows, of_cell);
    }
    count = static_cast<std::uint32_t>(ranges.first.size() - 1);
    end += of_cell;
    total += of_cell;
  }
  if (total != n) return tl::unexpected(source_changed());
  ranges.first.push_back(n);
  ranges.of_cell = std::move(counts);
  return ranges;
}

// Writes the rows of each range to their offsets in the scratch file.
Status distribute(const SplatStream& stream, const SceneScan& scan, const EncodeOptions& encode, const Ranges& ranges,
                  const StreamOptions& options, LevelRows& leaves) {
  const std::size_t n_ranges = ranges.first.size() - 1;
  const std::uint64_t row_bytes = leaves.row_bytes();
  const std::uint64_t rows_at_once =
      std::clamp<std::uint64_t>(options.memory_bytes / 8 / n_ranges, 4096, std::uint64_t{1} << 20) / row_bytes + 1;
  std::vector<std::vector<std::byte>> waiting(n_ranges);
  std::vector<std::uint64_t> next(ranges.first.begin(), ranges.first.end() - 1);
  const auto flush = [&](std::size_t r) -> Status {
    const std::uint64_t n = waiting[r].size() / row_bytes;
    if (n > ranges.first[r + 1] - next[r]) return tl::unexpected(source_changed());
    const Status written = leaves.file().write(next[r] * row_bytes, waiting[r]);
    next[r] += n;
    waiting[r].clear();
    return written;
  };
  const MortonKey key(scan.robust());
  std::uint64_t n_seen = 0;
  options.begin("place", scan.n_kept(), "Gaussians");
  Status status = each_kept(stream, scan.sh_degree(), encode.on_bad,
                            [&](std::span<const std::uint32_t> positions, std::span<const Splat> rows) -> Status {
                              std::vector<std::uint64_t> keys;
                              if (!ranges.of_cell.empty()) keys = keys_of(rows, key);
                              for (std::size_t i = 0; i < rows.size(); ++i, ++n_seen) {
                                const std::uint64_t r = keys.empty()
                                                            ? n_seen / ranges.rows_each
                                                            : ranges.of_cell[keys[i] >> (63 - ranges.cell_bits)];
                                if (r >= n_ranges) return tl::unexpected(source_changed());
                                std::vector<std::byte>& to = waiting[r];
                                to.resize(to.size() + row_bytes);
                                leaves.pack(rows[i], positions[i], &to[to.size() - row_bytes]);
                                if (to.size() < rows_at_once * row_bytes) continue;
                                if (Status s = flush(r); !s) return s;
                              }
                              options.advance(rows.size());
                              return {};
                            });
  for (std::size_t r = 0; r < n_ranges && status; ++r) {
    status = flush(r);
    if (status && next[r] != ranges.first[r + 1]) status = tl::unexpected(source_changed());
  }
  return status;
}

// Sorts the rows of one range and adds them to the boxes of chunks and to positions.
Status sort_range(std::uint64_t first, std::uint64_t last, const SceneScan& scan, const EncodeOptions& encode,
                  StreamedLevels& out) {
  LevelRows& leaves = out.rows.front();
  const std::uint64_t n = last - first, row_bytes = leaves.row_bytes();
  std::vector<std::byte> rows(n * row_bytes);
  if (Status s = leaves.file().read(first * row_bytes, rows); !s) return s;
  if (encode.order == Order::morton) {
    sort_rows(rows, row_bytes, MortonKey(scan.robust()));
    if (Status s = leaves.file().write(first * row_bytes, rows); !s) return s;
  }
  if (encode.keep_permutation) {
    for (std::uint64_t i = 0; i < n; ++i) out.positions[first + i] = leaves.position(&rows[i * row_bytes]);
  }
  add_to_chunks(leaves, first, rows, encode.chunk_size, out.chunks);
  return {};
}

}  // namespace

Result<ScratchFile> scratch_file(bool on_disk, const StreamOptions& options) {
  return on_disk ? ScratchFile::create(options.scratch) : ScratchFile();
}

std::uint64_t LevelRows::row_bytes() const {
  const auto n_sh = static_cast<std::uint64_t>(3 * sh_coefficients(sh_degree_));
  return 4 * kValues + (kind_.is_upper ? 2 : 4) * n_sh + (kind_.has_rests ? 12 : 0) + (kind_.has_positions ? 4 : 0);
}

void LevelRows::pack(const Splat& splat, std::uint32_t position, std::byte* row) const {
  const auto put = [&row](const void* from, std::size_t bytes) {
    std::memcpy(row, from, bytes);
    row += bytes;
  };
  put(splat.mean, 12);
  put(splat.log_scale, 12);
  put(splat.rotation, 16);
  put(&splat.opacity_logit, 4);
  const int n_sh = 3 * sh_coefficients(sh_degree_);
  if (!kind_.is_upper) {
    put(splat.sh, 4 * static_cast<std::size_t>(n_sh));
  } else {
    for (int k = 0; k < n_sh; ++k) {
      const std::uint16_t half = half_from_float(splat.sh[k]);
      put(&half, 2);
    }
  }
  if (kind_.has_rests) put(splat.mean_rest, 12);
  if (kind_.has_positions) put(&position, 4);
}

void LevelRows::unpack(std::span<const std::byte> rows, SplatCloud& out) const {
  const std::uint64_t n = rows.size() / row_bytes();
  const auto n_sh = static_cast<std::size_t>(3 * sh_coefficients(sh_degree_));
  out.resize(n, sh_degree_);
  if (kind_.has_rests) out.mean_rest.resize(3 * n);
  for (std::uint64_t i = 0; i < n; ++i) {
    const std::byte* row = &rows[i * row_bytes()];
    const auto take = [&row](void* to, std::size_t bytes) {
      std::memcpy(to, row, bytes);
      row += bytes;
    };
    take(&out.mean[3 * i], 12);
    take(&out.log_scale[3 * i], 12);
    take(&out.rotation[4 * i], 16);
    take(&out.opacity_logit[i], 4);
    if (!kind_.is_upper) {
      take(&out.sh[n_sh * i], 4 * n_sh);
    } else {
      for (std::size_t k = 0; k < n_sh; ++k) {
        std::uint16_t half;
        take(&half, 2);
        out.sh[n_sh * i + k] = float_from_half(half);
      }
    }
    if (kind_.has_rests) take(&out.mean_rest[3 * i], 12);
  }
}

std::uint32_t LevelRows::position(const std::byte* row) const {
  std::uint32_t position;
  std::memcpy(&position, row + row_bytes() - 4, 4);
  return position;
}

Status LevelRows::write(std::uint64_t first, const SplatView& splats) {
  std::vector<std::byte> rows(splats.n * row_bytes());
  for (std::uint64_t i = 0; i < splats.n; ++i) pack(splats.splat(i), 0, &rows[i * row_bytes()]);
  return file_.write(first * row_bytes(), rows);
}

Status LevelRows::read(std::uint64_t first, std::uint64_t n, SplatCloud& out) const {
  std::vector<std::byte> rows(n * row_bytes());
  if (Status s = file_.read(first * row_bytes(), rows); !s) return s;
  unpack(rows, out);
  return {};
}

std::uint64_t StreamedLevels::n_stored() const {
  std::uint64_t n = 0;
  for (const auto& level : pages) {
    for (const Page& page : level) n += page.count;
  }
  return n;
}

Status scan_stream(const SplatStream& stream, const StreamOptions& options, SceneScan& scan,
                   std::uint64_t& first_damaged) {
  return detail::guard_memory([&]() -> Status {
    constexpr std::size_t kPart = 4096;
    const SceneScan empty = scan;
    tbb::enumerable_thread_specific<SceneScan> scans(empty);
    std::atomic<std::uint64_t> damaged{Error::kNone};
    const Status status = stream.read([&](std::uint64_t first, std::span<const Splat> rows) -> Status {
      each_in_parallel((rows.size() + kPart - 1) / kPart, [&](std::size_t part) {
        SceneScan& local = scans.local();
        for (std::size_t i = part * kPart; i < std::min(rows.size(), (part + 1) * kPart); ++i) {
          Splat row = rows[i];
          const std::uint64_t n_repaired = local.n_repaired();
          if (local.add(row) && local.n_repaired() == n_repaired) continue;
          std::uint64_t seen = damaged.load();
          while (first + i < seen && !damaged.compare_exchange_weak(seen, first + i)) continue;
        }
      });
      options.advance(rows.size());
      return {};
    });
    for (const SceneScan& local : scans) scan.merge(local);
    first_damaged = damaged;
    return status;
  });
}

Status sample_means(const SplatStream& stream, const StreamOptions& options, const SceneScan& scan, BadPolicy on_bad,
                    std::uint64_t most, std::vector<float>& means) {
  return detail::guard_memory([&]() -> Status {
    const std::uint64_t n = scan.n_kept(), wanted = std::min(n, most);
    std::uint64_t seen = 0, taken = 0;
    return each_kept(stream, scan.sh_degree(), on_bad,
                     [&](std::span<const std::uint32_t>, std::span<const Splat> rows) -> Status {
                       for (; taken < wanted && taken * n / wanted < seen + rows.size(); ++taken) {
                         const Splat& row = rows[taken * n / wanted - seen];
                         means.insert(means.end(), row.mean, row.mean + 3);
                       }
                       seen += rows.size();
                       options.advance(rows.size());
                       return {};
                     });
  });
}

Status order_leaves(const SplatStream& stream, const SceneScan& scan, const EncodeOptions& encode,
                    const StreamOptions& options, StreamedLevels& out) {
  return detail::guard_memory([&]() -> Status {
    const auto kind = LevelRows::Kind::of_leaves(encode);
    const std::uint64_t row_bytes = LevelRows({}, scan.sh_degree(), kind).row_bytes();
    out = {};
    out.n_leaves = scan.n_kept();
    out.on_disk = out.n_leaves * row_bytes > options.memory_bytes / 4;
    auto file = scratch_file(out.on_disk, options);
    if (!file) return tl::unexpected(file.error());
    LevelRows& leaves = out.rows.emplace_back(std::move(*file), scan.sh_degree(), kind);
    if (!out.on_disk) {  // allocate at once, do not grow
      if (Status s = leaves.file().write(out.n_leaves * row_bytes - 1, std::array<std::byte, 1>{}); !s) return s;
    }
    // A range is in memory twice while it is sorted, with keys.
    const std::uint64_t most_rows = options.memory_bytes / 4 / (2 * row_bytes + 24);
    auto ranges = cut_ranges(stream, scan, encode, most_rows, options);
    if (!ranges) return tl::unexpected(ranges.error());
    if (Status s = distribute(stream, scan, encode, *ranges, options, leaves); !s) return s;
    ranges->of_cell = std::vector<std::uint32_t>();
    out.chunks.resize((scan.n_kept() + encode.chunk_size - 1) / encode.chunk_size);
    if (encode.keep_permutation) out.positions.resize(scan.n_kept());
    options.begin("sort", scan.n_kept(), "Gaussians");
    for (std::size_t r = 0; r + 1 < ranges->first.size(); ++r) {
      if (Status s = sort_range(ranges->first[r], ranges->first[r + 1], scan, encode, out); !s) return s;
      options.advance(ranges->first[r + 1] - ranges->first[r]);
    }
    return {};
  });
}

BuildOptions build_options(const EncodeOptions& encode, const StreamOptions& options) {
  BuildOptions build = options.build;
  build.chunk_size = encode.chunk_size;
  const std::uint32_t most = encode.profile == Profile::archive ? kMaxArchiveRows : kMaxPageRows;
  build.page_chunks = std::clamp(most / build.chunk_size, 1U, build.page_chunks);  // fewer large chunks
  return build;
}

Status build_upper(const EncodeOptions& encode, const StreamOptions& options, StreamedLevels& out, std::uint32_t last) {
  return detail::guard_memory([&]() -> Status {
    std::vector<std::uint32_t> stretches;
    out.pages.assign(1, cut_leaf_pages(out.chunks, out.n_leaves, build_options(encode, options), stretches));
    out.chunks = std::vector<ChunkBoxes>();
    if (std::vector<Page>& leaves = out.pages.front(); leaves.size() == 1) {
      SplatCloud splats;
      if (Status s = out.rows.front().read(0, out.n_leaves, splats); !s) return s;
      leaves[0].core = core_of(splats.view(), 0, out.n_leaves);
    }
    options.begin("levels", out.n_leaves + out.n_leaves / 3, "Gaussians");
    return build_above(encode, options, std::move(stretches), out, last);
  });
}

Status build_above(const EncodeOptions& encode, const StreamOptions& options, std::vector<std::uint32_t> stretches,
                   StreamedLevels& out, std::uint32_t last) {
  return detail::guard_memory([&]() -> Status {
    const BuildOptions build = build_options(encode, options);
    const int sh_degree = out.rows.back().sh_degree();
    const std::uint64_t at_once = most_at_once(options, group_bytes(build)), batch = 32 * at_once;
    std::vector<SplatCloud> parts(batch);
    while (out.pages.back().size() > 1 && out.pages.back().front().level < last) {
      std::vector<Page>& below = out.pages.back();
      const LevelRows& from = out.rows.back();
      std::vector<MergeCosts> costs(below.size());
      const Status looked = each_at_once(below.size(), at_once, [&](std::size_t i) -> Status {
        SplatCloud splats;
        if (Status s = from.read(below[i].first, below[i].count, splats); !s) return s;
        if (below[i].level == 0) below[i].core = core_of(splats.view(), 0, below[i].count);
        costs[i] = merge_costs(splats.view(), 0, below[i].count);
        options.advance(below[i].count / kWeighing);
        return {};
      });
      if (!looked) return looked;
      const std::vector<Group> groups = group_stretches(below, costs, stretches, build);
      const std::uint64_t n_groups = groups.size();
      std::vector<Page> pages(n_groups);
      auto file = scratch_file(out.on_disk, options);
      if (!file) return tl::unexpected(file.error());
      LevelRows to(std::move(*file), sh_degree, LevelRows::Kind::of_upper());
      std::uint64_t n_above = 0;
      for (std::uint64_t first = 0; first < n_groups; first += batch) {
        const std::uint64_t n = std::min(batch, n_groups - first);
        const Status built = each_at_once(n, at_once, [&](std::size_t k) -> Status {
          const auto [first_child, end_child, wanted] = groups[first + k];
          std::vector<Page> children(below.begin() + first_child, below.begin() + end_child);
          const std::uint64_t begin = children.front().first, end = children.back().first + children.back().count;
          SplatCloud splats;
          if (Status s = from.read(begin, end - begin, splats); !s) return s;
          for (Page& page : children) page.first -= begin;
          parts[k].resize(0, sh_degree);
          Page& page = pages[first + k];
          page = build_page(splats.view(), children, {0, end_child - first_child, wanted}, build, parts[k]);
          if (build.device != nullptr) {
            if (Status s = build.device->status(); !s) return s;
          }
          page.first_child = first_child;
          for (const Page& child : children) options.advance(child.count - child.count / kWeighing);
          return {};
        });
        if (!built) return built;
        for (std::uint64_t k = 0; k < n; ++k) {
          pages[first + k].first = n_above;
          n_above += pages[first + k].count;
        }
        // The last one first: in memory, only a write behind the end must be alone.
        const auto write = [&](std::size_t k) { return to.write(pages[first + k].first, parts[k].view()); };
        if (Status s = write(n - 1); !s) return s;
        if (Status s = each_at_once(n - 1, at_once, write); !s) return s;
      }
      out.rows.push_back(std::move(to));
      out.pages.push_back(std::move(pages));
    }
    return {};
  });
}

EncodeOptions file_options(const SceneScan& scan, const EncodeOptions& encode,
                           std::span<const std::uint32_t> positions) {
  EncodeOptions options = encode;
  if (encode.keep_permutation) options.source_index = positions;
  options.n_source = std::max(encode.n_source, scan.n_source());
  options.n_repaired += scan.n_repaired();
  return options;
}

Result<WrittenScene> write_tree(const StreamedLevels& levels, const SceneScan& scan, const EncodeOptions& encode,
                                const StreamOptions& options, Sink sink) {
  return detail::guard_memory([&]() -> Result<WrittenScene> {
    std::vector<std::uint32_t> positions;
    if (!encode.source_index.empty()) {
      positions = levels.positions;
      for (std::uint32_t& position : positions) position = encode.source_index[position];
    }
    const EncodeOptions with_positions = file_options(
        scan, encode,
        encode.source_index.empty() ? std::span(levels.positions) : std::span<const std::uint32_t>(positions));
    std::vector<std::uint64_t> firsts;  // of a page within its level
    for (std::size_t level = levels.pages.size(); level-- > 0;) {
      for (const Page& page : levels.pages[level]) firsts.push_back(page.first);
    }
    auto writer = LevelsWriter::create(sink, scan.of_kept(), with_positions, join_levels(levels.pages));
    if (!writer) return tl::unexpected(writer.error());
    options.begin("encode", levels.n_stored(), "Gaussians");
    const std::uint64_t n_pages = firsts.size(), at_once = 8 * most_at_once(options, 8 * kPageBytes);
    std::vector<LevelsWriter::Encoder> encoders;
    for (std::uint64_t i = 0; i < at_once; ++i) encoders.emplace_back(*writer);
    for (std::uint64_t first = 0; first < n_pages; first += at_once) {
      const std::uint64_t n = std::min(at_once, n_pages - first);
      const Status encoded = each_at_once(n, at_once, [&](std::size_t i) -> Status {
        const Page& page = writer->pages()[first + i];
        SplatCloud splats;
        if (Status s = levels.rows[page.level].read(firsts[first + i], page.count, splats); !s) return s;
        return encoders[i].encode(static_cast<std::uint32_t>(first + i), splats.view());
      });
      if (!encoded) return tl::unexpected(encoded.error());
      for (std::uint64_t i = 0; i < n; ++i) {
        if (const Status s = writer->add(encoders[i]); !s) return tl::unexpected(s.error());
        options.advance(writer->pages()[first + i].count);
      }
    }
    return writer->finish();
  });
}

}  // namespace rgs::lod
