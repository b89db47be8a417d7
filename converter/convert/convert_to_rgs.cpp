// convert_to_rgs.cpp - a PLY file, or Gaussians in memory, to .rgs in two streamed passes.
//
// Pass 1 reads every row once: finds damage, bounds and ranges, and keeps the means (12 bytes a Gaussian).
// Then Morton keys replace the means and are sorted with 32-bit indices (24 bytes a Gaussian at the peak).
// Pass 2 gathers rows in that order, chunk by chunk; chunks are quantised in parallel and written in order.
// Profile::archive looks at the scene as a whole: pass 2 gathers all of it.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_pipeline.h>
#include <tbb/task_group.h>

#include <algorithm>
#include <atomic>
#include <bit>
#include <limits>
#include <memory>

#include "convert.hpp"
#include "depth_range.hpp"
#include "rgs/checksum.hpp"
#include "rgs/quantize.hpp"
#include "rgs/spatial_order.hpp"
#include "stage_clock.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kScanRows = 4096;   // a multiple of 64: blocks own whole words of the bit set
constexpr std::uint64_t kBatchRows = 8192;  // pass 2 works on this many Gaussians at a time, or one chunk if larger

struct Scanned {
  SceneScan scan;
  std::vector<std::uint64_t> kept;  // bit set over source rows
  std::vector<float> means;         // [n_source, 3]; rows that are not kept are undefined
};

Scanned scan_source(const SplatSource& source, const EncodeOptions& options, const StageObserver& observer) {
  const std::uint64_t n = source.size();
  Scanned result{SceneScan(source.sh_degree(), options), std::vector<std::uint64_t>((n + 63) / 64), {}};
  result.means.resize(3 * n);
  tbb::enumerable_thread_specific<SceneScan> scans(source.sh_degree(), options);
  tbb::parallel_for(std::uint64_t{0}, (n + kScanRows - 1) / kScanRows, [&](std::uint64_t block) {
    constexpr std::uint64_t kRowsAtOnce = 64;  // 15 KB: rows stay in the first-level cache between copy and scan
    SceneScan& scan = scans.local();
    Splat rows[kRowsAtOnce];
    const std::uint64_t end = std::min(n, (block + 1) * kScanRows);
    for (std::uint64_t first = block * kScanRows; first < end; first += kRowsAtOnce) {
      const auto part = std::span(rows).first(std::min(kRowsAtOnce, end - first));
      source.read(first, part);
      std::uint64_t bits = 0;
      for (std::size_t i = 0; i < part.size(); ++i) {
        bits |= static_cast<std::uint64_t>(scan.add(part[i])) << i;
        std::ranges::copy(part[i].mean, &result.means[3 * (first + i)]);
      }
      result.kept[first / 64] = bits;
    }
    observer.advance(end - block * kScanRows);
  });
  for (const SceneScan& scan : scans) result.scan.merge(scan);
  return result;
}

// Index of the first row that the scan did not keep or had to mend: what a refusal points at.
std::uint64_t first_damaged(const SplatSource& source, int sh_degree) {
  Splat row;
  for (std::uint64_t i = 0; i < source.size(); ++i) {
    source.read(i, {&row, 1});
    if (find_defects(row, sh_degree) != 0) return i;
  }
  return Error::kNone;
}

std::vector<std::uint32_t> kept_indices(const Scanned& scanned) {
  std::vector<std::uint32_t> indices;
  indices.reserve(scanned.scan.n_kept());
  for (std::size_t word = 0; word < scanned.kept.size(); ++word) {
    for (std::uint64_t bits = scanned.kept[word]; bits != 0; bits &= bits - 1) {
      indices.push_back(static_cast<std::uint32_t>(64 * word + static_cast<std::size_t>(std::countr_zero(bits))));
    }
  }
  return indices;
}

Status find_depth_range(EncodeOptions& encode, const ConvertOptions& options, const Scanned& scanned,
                        std::span<const std::uint32_t> indices) {
  if (!options.cameras.empty()) {
    // An even sample of the kept means; depth_range_from_cameras would not look at more.
    const std::size_t n = std::min<std::size_t>(indices.size(), 65536);
    std::vector<float> sample(3 * n);
    for (std::size_t k = 0; k < n; ++k) {
      std::copy_n(&scanned.means[3 * std::size_t{indices[k * indices.size() / n]}], 3, &sample[3 * k]);
    }
    const auto range = depth_range_from_cameras(options.cameras, sample);
    if (!range) return tl::unexpected(range.error());
    encode.depth = *range;
  }
  if (options.z_near || options.z_far) {
    DepthRange range;
    if (encode.depth) {
      range = *encode.depth;
    } else {
      const auto plan = make_plan(scanned.scan, encode);  // for the range that the extent gives
      if (!plan) return tl::unexpected(plan.error());
      range = {plan->declarations.z_near, plan->declarations.z_far};
    }
    range.z_near = options.z_near.value_or(range.z_near);
    range.z_far = options.z_far.value_or(range.z_far);
    range.source = DepthSource::by_hand;
    encode.depth = range;
  }
  return {};
}

void sort_morton(std::vector<std::uint32_t>& indices, std::vector<float>& means, const Box& robust) {
  const MortonKey key(robust);
  std::vector<std::uint64_t> keys(indices.size());
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, keys.size(), 16384), [&](const auto& range) {
    for (std::size_t i = range.begin(); i < range.end(); ++i) keys[i] = key(&means[3 * std::size_t{indices[i]}]);
  });
  means = {};
  const std::vector<std::size_t> starts = partition_by_key(keys, indices);
  tbb::parallel_for(std::size_t{0}, starts.size() - 1, [&](std::size_t bucket) {
    const std::size_t first = starts[bucket], count = starts[bucket + 1] - first;
    if (count > 1) sort_bucket(std::span(keys).subspan(first, count), std::span(indices).subspan(first, count));
  });
}

// One pipeline token: consecutive chunks with room for their bytes.
struct Batch {
  std::uint64_t first_chunk = 0, n_chunks = 0, first = 0, count = 0;
  std::vector<std::byte> means, geometry, sh;
  std::vector<ShStepSet> scales;  // of each chunk
  PackedFrames frames;            // Profile::packed: the batch is one frame of each section
  std::array<std::uint64_t, 3> frame_hashes{};
  EncodeCounts counts;
};

// Header and sections as they are in the file.
using Finished = std::pair<Header, std::vector<SectionEntry>>;

// Pass 2. Chunks are encoded in parallel; one thread at a time writes batches in file order. Frames of Profile::packed
// have sizes that nobody knows before: they go to where the section would begin in the worst case, and move up when all
// are there.
class ChunkStream {
 public:
  ChunkStream(const SplatSource& source, const EncodePlan& plan, std::span<const std::uint32_t> indices, bool repairing,
              AtomicFile& file)
      : source_(source), plan_(plan), indices_(indices), repairing_(repairing), file_(file) {
    chunks_.resize(plan.header.n_chunks);
    if (plan.chunk_step_sets) scales_.resize(chunks_.size());
    if (plan.profile != Profile::packed) return;
    for (std::size_t k = 0; k < kLarge.size(); ++k) frames_end_[k] = plan.find(kLarge[k])->offset;
  }

  Status run(const StageObserver& observer) {
    const std::uint64_t rows = plan_.profile == Profile::packed ? plan_.frame_rows() : kBatchRows;
    const std::uint64_t chunks_per_batch = std::max<std::uint64_t>(1, rows / plan_.header.chunk_size);
    const std::size_t tokens = static_cast<std::size_t>(tbb::this_task_arena::max_concurrency()) + 1;
    std::vector<Batch> pool(tokens);
    std::uint64_t next_chunk = 0, next_slot = 0;
    const auto take = [&](tbb::flow_control& control) -> Batch* {
      if (next_chunk >= chunks_.size() || failed_.load(std::memory_order_relaxed)) {
        control.stop();
        return nullptr;
      }
      Batch& batch = pool[next_slot++ % tokens];  // in-order output: the slot's last batch has left the pipeline
      batch.first_chunk = next_chunk;
      batch.n_chunks = std::min(chunks_per_batch, chunks_.size() - next_chunk);
      batch.first = next_chunk * plan_.header.chunk_size;
      batch.count = std::min(batch.n_chunks * plan_.header.chunk_size, plan_.header.n_gaussians - batch.first);
      next_chunk += batch.n_chunks;
      return &batch;
    };
    const auto put = [&](Batch* batch) {
      if (failed_.load(std::memory_order_relaxed)) return;
      if (Status s = write(*batch); !s) {
        status_ = s;
        failed_.store(true, std::memory_order_relaxed);
      }
      counts_.add(batch->counts);
      observer.advance(batch->count);
    };
    using tbb::filter_mode;
    tbb::parallel_pipeline(tokens, tbb::make_filter<void, Batch*>(filter_mode::serial_in_order, take) &
                                       tbb::make_filter<Batch*, Batch*>(filter_mode::parallel,
                                                                        [&](Batch* batch) {
                                                                          encode(*batch);
                                                                          return batch;
                                                                        }) &
                                       tbb::make_filter<Batch*, void>(filter_mode::serial_in_order, put));
    return status_;
  }

  // Tables, head, and what has to move. Returns the header and the sections as they are in the file.
  Result<Finished> finish_file() {
    const auto permutation = plan_.keep_permutation ? std::as_bytes(indices_) : std::span<const std::byte>();
    return plan_.profile == Profile::packed ? finish_as_packed(permutation) : finish_as_direct(permutation);
  }
  const EncodeCounts& counts() const { return counts_; }

 private:
  void encode(Batch& batch) {
    const std::uint64_t stride = sh_bytes(plan_.header.sh_degree);
    batch.means.resize(batch.count * kMeanBytes);
    batch.geometry.resize(batch.count * kGeometryBytes);
    batch.sh.resize(batch.count * stride);
    batch.scales.resize(batch.n_chunks);
    batch.counts = {};
    std::vector<Splat>& rows = rows_.local();
    rows.resize(std::min<std::uint64_t>(plan_.header.chunk_size, plan_.header.n_gaussians));
    for (std::uint64_t c = 0; c < batch.n_chunks; ++c) {
      const std::uint64_t first = c * plan_.header.chunk_size;
      const std::uint64_t count = std::min<std::uint64_t>(plan_.header.chunk_size, batch.count - first);
      const auto part = std::span(rows).first(count);
      source_.gather(indices_.subspan(batch.first + first, count), part);
      if (repairing_) {
        for (Splat& s : part) repair(s, find_defects(s, plan_.header.sh_degree));
      }
      ChunkOutput out;
      out.means = std::span(batch.means).subspan(first * kMeanBytes, count * kMeanBytes);
      out.geometry = std::span(batch.geometry).subspan(first * kGeometryBytes, count * kGeometryBytes);
      out.sh = std::span(batch.sh).subspan(first * stride, count * stride);
      encode_chunk(plan_, part, out);
      chunks_[batch.first_chunk + c] = out.entry;
      if (plan_.chunk_step_sets) scales_[batch.first_chunk + c] = out.scales;
      batch.scales[c] = out.scales;
      batch.counts.add(out.counts);
    }
    if (plan_.profile != Profile::packed) return;
    batch.frames = encoders_.local().encode(batch.means, batch.geometry, batch.sh, batch.scales);
    batch.frame_hashes = {xxh3(batch.frames.means), xxh3(batch.frames.geometry), xxh3(batch.frames.sh)};
  }

  Status write(const Batch& batch) {
    return plan_.profile == Profile::packed ? write_frames(batch) : write_rows(batch);
  }

  Status write_rows(const Batch& batch) {
    const auto put = [&](SectionType type, Hasher& hash, std::span<const std::byte> bytes, std::uint64_t entry_bytes) {
      hash.update(bytes);
      return file_.write_at(plan_.find(type)->offset + batch.first * entry_bytes, bytes);
    };
    if (Status s = put(SectionType::means, means_hash_, batch.means, kMeanBytes); !s) return s;
    if (Status s = put(SectionType::geometry, geometry_hash_, batch.geometry, kGeometryBytes); !s) return s;
    return put(SectionType::sh, sh_hash_, batch.sh, sh_bytes(plan_.header.sh_degree));
  }

  Status write_frames(const Batch& batch) {
    const std::array<const std::vector<std::byte>*, 3> stored = {&batch.frames.means, &batch.frames.geometry,
                                                                 &batch.frames.sh};
    const std::array<std::vector<CodedFrame>*, 3> lists = {&frames_.means, &frames_.geometry, &frames_.sh};
    for (std::size_t k = 0; k < kLarge.size(); ++k) {
      if (Status s = file_.write_at(frames_end_[k], *stored[k]); !s) return s;
      lists[k]->push_back({frames_end_[k], static_cast<std::uint32_t>(stored[k]->size()), batch.frame_hashes[k]});
      frames_end_[k] += stored[k]->size();
    }
    return {};
  }

  Result<Finished> finish_as_direct(std::span<const std::byte> permutation) {
    if (const SectionEntry* entry = plan_.find(SectionType::permutation)) {
      if (const Status s = file_.write_at(entry->offset, permutation); !s) return tl::unexpected(s.error());
    }
    const SectionHashes hashes{means_hash_.digest(), geometry_hash_.digest(), sh_hash_.digest(), xxh3(permutation)};
    for (const FilePiece& piece : finish(plan_, chunks_, scales_, counts_, hashes)) {
      if (const Status s = file_.write_at(piece.offset, piece.bytes); !s) return tl::unexpected(s.error());
    }
    return Finished{plan_.header, plan_.sections};
  }

  Result<Finished> finish_as_packed(std::span<const std::byte> permutation) {
    PackedLayout layout = finish_packed(plan_, chunks_, scales_, counts_, frames_);
    for (std::size_t k = 0; k < kLarge.size(); ++k) {
      if (const Status s = move_frames(layout, kLarge[k], plan_.find(kLarge[k])->offset); !s)
        return tl::unexpected(s.error());
    }
    if (plan_.keep_permutation) {
      SectionEntry& entry = layout.find(SectionType::permutation);
      entry.xxh3 = xxh3(permutation);
      if (const Status s = file_.write_at(entry.offset, permutation); !s) return tl::unexpected(s.error());
    }
    // What is left of the places where frames were is zeros between sections or beyond the end.
    if (const Status s = file_.truncate(layout.header.file_bytes); !s) return tl::unexpected(s.error());
    layout.pieces.push_back(layout.head());
    constexpr std::array<std::byte, kSectionAlignment> kZeros{};
    for (const SectionEntry& entry : layout.sections) {
      const std::uint64_t end = entry.offset + entry.stored_bytes;
      const std::uint64_t gap = std::min((0 - end) % kSectionAlignment, layout.header.file_bytes - end);
      if (const Status s = file_.write_at(end, std::span(kZeros).first(gap)); !s) return tl::unexpected(s.error());
    }
    for (const FilePiece& piece : layout.pieces) {
      if (const Status s = file_.write_at(piece.offset, piece.bytes); !s) return tl::unexpected(s.error());
    }
    return Finished{layout.header, layout.sections};
  }

  // Frames of a section from `from` to behind their table, and the hash of all. Never downwards, so that nothing is
  // overwritten before it has moved.
  Status move_frames(PackedLayout& layout, SectionType type, std::uint64_t from) {
    SectionEntry& entry = layout.find(type);
    const auto table = layout.table(type);
    Hasher hash;
    hash.update(table);
    std::vector<std::byte> buffer(std::size_t{1} << 20);
    std::uint64_t to = entry.offset + table.size();
    for (std::uint64_t left = entry.stored_bytes - table.size(); left != 0;) {
      const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), left));
      if (Status s = file_.read_at(from, part); !s) return s;
      hash.update(part);
      if (Status s = file_.write_at(to, part); !s) return s;
      from += part.size();
      to += part.size();
      left -= part.size();
    }
    entry.xxh3 = hash.digest();
    return {};
  }

  static constexpr std::array kLarge = {SectionType::means, SectionType::geometry, SectionType::sh};

  const SplatSource& source_;
  const EncodePlan& plan_;
  std::span<const std::uint32_t> indices_;
  bool repairing_;
  AtomicFile& file_;
  std::vector<ChunkEntry> chunks_;
  std::vector<ShStepSet> scales_;
  EncodeCounts counts_;
  Hasher means_hash_, geometry_hash_, sh_hash_;
  PackedSections frames_;
  std::array<std::uint64_t, 3> frames_end_{};  // where the next frame of each section goes
  tbb::enumerable_thread_specific<PackedEncoder> encoders_{plan_};
  tbb::enumerable_thread_specific<std::vector<Splat>> rows_;
  std::atomic<bool> failed_{false};
  Status status_;
};

Result<Finished> write_archive(const SplatSource& source, const EncodePlan& plan,
                               std::span<const std::uint32_t> indices, bool repairing, AtomicFile& file,
                               EncodeCounts& counts) {
  SplatCloud cloud;
  cloud.resize(indices.size(), plan.header.sh_degree);
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, indices.size(), 1024), [&](const auto& range) {
    std::vector<Splat> rows(range.size());
    source.gather(indices.subspan(range.begin(), range.size()), rows);
    for (std::size_t i = 0; i < rows.size(); ++i) {
      if (repairing) repair(rows[i], find_defects(rows[i], plan.header.sh_degree));
      cloud.set(range.begin() + i, rows[i]);
    }
  });
  const auto bytes = encode_archive(plan, cloud.view(), indices);
  if (!bytes) {
    Error error = bytes.error();
    if (error.code == Errc::bad_value && error.found != Error::kNone) error.offset = source.row_offset(error.found);
    return tl::unexpected(error);
  }
  if (const Status s = file.write_at(0, *bytes); !s) return tl::unexpected(s.error());
  DecodeLimits limits;
  limits.max_expansion = std::uint64_t{1} << 32;  // as the encoder has opened it
  const auto view = FileView::open(*bytes, limits);
  if (!view) return tl::unexpected(view.error());
  const Declarations& d = view->declarations();
  counts = {d.n_scale_subnormal, d.n_scale_zero, d.n_opacity_zero, d.n_opacity_one};
  return Finished{view->header(), view->sections()};
}

}  // namespace

Result<ConvertSummary> convert_to_rgs(const SplatSource& source, const std::string& output_path,
                                      const ConvertOptions& options, const StageObserver& observer) {
  if (source.size() > std::numeric_limits<std::uint32_t>::max()) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                      std::numeric_limits<std::uint32_t>::max(), source.size());
  }
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  EncodeOptions encode = options.encode;
  // A plan of an empty scene checks the options before anything is read.
  if (const auto plan = make_plan(SceneScan(source.sh_degree(), encode), encode); !plan) {
    return tl::unexpected(plan.error());
  }
  auto file = AtomicFile::create(output_path, options.output);
  if (!file) return tl::unexpected(file.error());

  // The source's hash is one serial stream: it runs beside the first pass and the sort.
  std::uint64_t source_xxh3 = 0;
  tbb::task_group hashing;
  if (encode.provenance) hashing.run([&] { source_xxh3 = source.hash(); });
  struct WaitAtExit {
    tbb::task_group& group;
    ~WaitAtExit() { group.wait(); }
  } const wait_at_exit{hashing};

  clock.begin("scan", source.size(), "Gaussians");
  Scanned scanned = scan_source(source, encode, observer);
  if (encode.on_bad == BadPolicy::refuse && scanned.scan.n_kept() != scanned.scan.n_source()) {
    return make_error(Errc::bad_value, source.row_offset(first_damaged(source, scanned.scan.sh_degree())),
                      "a damaged Gaussian; --on-bad drop leaves such out, --on-bad repair mends them", 0,
                      scanned.scan.n_source() - scanned.scan.n_kept());
  }
  clock.begin("sort", 0, "");
  std::vector<std::uint32_t> indices = kept_indices(scanned);
  scanned.kept = {};
  if (const Status s = find_depth_range(encode, options, scanned, indices); !s) return tl::unexpected(s.error());
  if (encode.order == Order::morton) sort_morton(indices, scanned.means, scanned.scan.robust());
  scanned.means = {};
  hashing.wait();
  if (encode.provenance) encode.provenance->source_xxh3 = source_xxh3;
  const auto plan = make_plan(scanned.scan, encode);
  if (!plan) return tl::unexpected(plan.error());

  clock.begin("encode", plan->header.n_gaussians, "Gaussians");
  if (encode.profile == Profile::direct) {
    if (const Status s = file->reserve(plan->header.file_bytes); !s) return tl::unexpected(s.error());
  }
  const bool repairing = encode.on_bad == BadPolicy::repair;
  EncodeCounts counts;
  Result<Finished> finished;
  if (plan->profile == Profile::archive) {
    finished = write_archive(source, *plan, indices, repairing, *file, counts);
  } else {
    ChunkStream stream(source, *plan, indices, repairing, *file);
    if (const Status s = stream.run(observer); !s) return tl::unexpected(s.error());
    finished = stream.finish_file();
    counts = stream.counts();
  }
  if (!finished) return tl::unexpected(finished.error());
  clock.begin("commit", 0, "");
  const auto synced = file->commit();
  if (!synced) return tl::unexpected(synced.error());
  clock.end();

  const SceneScan& scan = scanned.scan;
  summary.sync_seconds = *synced;
  summary.source_format = "ply";
  summary.output_format = "rgs";
  summary.source_bytes = source.bytes();
  summary.output_bytes = finished->first.file_bytes;
  summary.n_source = scan.n_source();
  summary.n_written = scan.n_kept();
  summary.n_repaired = scan.n_repaired();
  summary.source_sh_degree = source.sh_degree();
  summary.sh_degree = scan.sh_degree();
  for (std::size_t i = 0; i < kDefectKinds; ++i) summary.defects[i] = scan.defects(static_cast<Defect>(i));
  summary.header = finished->first;
  summary.declarations = plan->declarations;
  summary.declarations.n_scale_subnormal = counts.scale_subnormal;
  summary.declarations.n_scale_zero = counts.scale_zero;
  summary.declarations.n_opacity_zero = counts.opacity_zero;
  summary.declarations.n_opacity_one = counts.opacity_one;
  summary.sections = std::move(finished->second);
  if (scan.n_kept() != 0) {
    summary.min_scale = scale_from_log(scan.min_log_scale());
    summary.max_scale = scale_from_log(scan.max_log_scale());
    summary.min_opacity = opacity_from_logit(scan.min_opacity_logit());
    summary.max_opacity = opacity_from_logit(scan.max_opacity_logit());
  }
  return summary;
}

}  // namespace rgs
