// convert_to_rgs.cpp - a PLY file, or Gaussians in memory, to .rgs in two streamed passes.
//
// Pass 1 reads every row once: finds damage, bounds and ranges, and keeps the means (12 bytes a Gaussian).
// Then Morton keys replace the means and are sorted with 32-bit indices (24 bytes a Gaussian at the peak).
// Pass 2 gathers rows in that order, chunk by chunk; a SceneWriter's batches are encoded in parallel and written in order.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_pipeline.h>
#include <tbb/task_group.h>

#include <algorithm>
#include <atomic>
#include <bit>
#include <iterator>
#include <limits>

#include "convert.hpp"
#include "convert_steps.hpp"
#include "depth_range.hpp"
#include "rgs/quantize.hpp"
#include "rgs/scene_writer.hpp"
#include "rgs/spatial_order.hpp"
#include "stage_clock.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kScanRows = 4096;  // a multiple of 64: blocks own whole words of the bit set

struct Scanned {
  SceneScan scan;
  std::vector<std::uint64_t> kept;  // bit set over source rows
  std::vector<float> means;         // [n_source, 3]; undefined for rows that are not kept
};

Scanned scan_source(const SplatSource& source, const EncodeOptions& options, const StageObserver& observer) {
  const std::uint64_t n = source.size();
  const SceneScan empty(std::min(source.sh_degree(), options.sh_degree), options.on_bad, true);
  Scanned result{empty, std::vector<std::uint64_t>((n + 63) / 64), {}};
  result.means.resize(3 * n);
  tbb::enumerable_thread_specific<SceneScan> scans(empty);
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

// Index of the first row that the scan dropped or repaired, for the error of --on-bad refuse.
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

std::vector<float> sample_means(const Scanned& scanned, std::span<const std::uint32_t> indices) {
  const std::size_t n = std::min<std::size_t>(indices.size(), kDepthSample);
  std::vector<float> sample(3 * n);
  for (std::size_t k = 0; k < n; ++k) {
    std::copy_n(&scanned.means[3 * std::size_t{indices[k * indices.size() / n]}], 3, &sample[3 * k]);
  }
  return sample;
}

void sort_morton(std::vector<std::uint32_t>& indices, std::vector<float>& means, const Box& robust) {
  const MortonKey key(robust);
  std::vector<std::uint64_t> keys(indices.size());
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, keys.size(), 16384), [&](const auto& range) {
    for (std::size_t i = range.begin(); i < range.end(); ++i) keys[i] = key(&means[3 * std::size_t{indices[i]}]);
  });
  means = std::vector<float>();  // `= {}` would keep the memory
  const std::vector<std::size_t> starts = partition_by_key(keys, indices);
  tbb::parallel_for(std::size_t{0}, starts.size() - 1, [&](std::size_t bucket) {
    const std::size_t first = starts[bucket], count = starts[bucket + 1] - first;
    if (count > 1) sort_bucket(std::span(keys).subspan(first, count), std::span(indices).subspan(first, count));
  });
}

// Pass 2. Batches are encoded in parallel; one thread at a time writes them in file order.
Status encode_batches(const SplatSource& source, SceneWriter& writer, const StageObserver& observer) {
  const std::size_t tokens = static_cast<std::size_t>(tbb::this_task_arena::max_concurrency()) + 1;
  std::vector<SceneWriter::Batch> pool;
  for (std::size_t i = 0; i < tokens; ++i) pool.emplace_back(writer);
  std::uint64_t next = 0;
  std::atomic<bool> failed{false};
  Status status;
  const auto take = [&](tbb::flow_control& control) -> SceneWriter::Batch* {
    if (next >= writer.n_batches() || failed.load(std::memory_order_relaxed)) {
      control.stop();
      return nullptr;
    }
    SceneWriter::Batch& batch = pool[next % tokens];  // in-order output: the slot's last batch has left the pipeline
    batch.begin(next++);
    return &batch;
  };
  const auto encode = [&](SceneWriter::Batch* batch) {
    for (; !batch->complete(); batch->encode_chunk()) source.gather(batch->source_index(), batch->splats());
    return batch;
  };
  const auto put = [&](SceneWriter::Batch* batch) {
    if (failed.load(std::memory_order_relaxed)) return;
    status = writer.add(*batch);
    failed.store(!status, std::memory_order_relaxed);
    observer.advance(batch->n_gaussians());
  };
  using tbb::filter_mode;
  tbb::parallel_pipeline(tokens,
                         tbb::make_filter<void, SceneWriter::Batch*>(filter_mode::serial_in_order, take) &
                             tbb::make_filter<SceneWriter::Batch*, SceneWriter::Batch*>(filter_mode::parallel, encode) &
                             tbb::make_filter<SceneWriter::Batch*, void>(filter_mode::serial_in_order, put));
  return status;
}

FirstView choose_view(const EncodeOptions& encode, std::span<const Camera> cameras, const FirstViewSample& sample) {
  constexpr std::size_t kMostViews = 64;
  const auto list = [](const glm::dvec3& v) { return std::array{v.x, v.y, v.z}; };
  std::vector<Camera> pinholes;  // a first view is one; with a lens, cameras see nearly the same
  std::ranges::copy_if(cameras, std::back_inserter(pinholes), [](const Camera& camera) {
    return camera.model == CameraModel::pinhole || camera.model == CameraModel::opencv;
  });
  std::vector<CandidateView> views(std::min(pinholes.size(), kMostViews));
  for (std::size_t i = 0; i < views.size(); ++i) {
    const Camera& camera = pinholes[i * pinholes.size() / views.size()];
    const glm::dvec3 at = camera_centre(camera) - glm::dvec3(encode.origin[0], encode.origin[1], encode.origin[2]);
    views[i] = {list(at), list(camera_axis(camera, 2)), list(-camera_axis(camera, 1)), camera.width / (2 * camera.fx),
                camera.height / (2 * camera.fy)};
  }
  Declarations declared;
  declared.axes = encode.axes;
  const glm::dvec3 up = cameras.empty() ? declared_up(declared) : mean_up(cameras);
  return choose_first_view(sample, list(up), pinholes.empty(), views);
}

Result<WrittenScene> write_plain(const SplatSource& source, AtomicFile& file, const SceneScan& scan,
                                 const EncodeOptions& encode, std::span<const std::uint32_t> indices, StageClock& clock,
                                 const StageObserver& observer) {
  // Profile::archive starts only once all Gaussians are present, so progress is unknown.
  clock.begin("encode", encode.profile == Profile::archive ? 0 : scan.n_kept(), "Gaussians");
  auto writer = SceneWriter::create(file, scan, encode, indices);
  if (!writer) return tl::unexpected(writer.error());
  if (const Status s = encode_batches(source, *writer, observer); !s) return tl::unexpected(s.error());
  return writer->finish();
}

// Lets pages of a mapped file leave memory once read; does nothing for other sources.
class ReadOnce {
 public:
  ReadOnce(std::span<const std::byte> bytes, const std::vector<const MappedFile*>& files) {
    for (const MappedFile* file : files) {
      if (!bytes.empty() && file->bytes().data() == bytes.data()) file_ = file;
    }
  }
  void done(std::uint64_t first, std::uint64_t end) const {
    if (file_ != nullptr && first <= end && end <= file_->bytes().size()) {
      file_->advise(MappedFile::Access::done, first, end - first);
    }
  }

 private:
  const MappedFile* file_ = nullptr;
};

lod::SplatStream stream_of(const SplatSource& source, const ReadOnce& memory) {
  return {source.size(), source.sh_degree(), [&source, memory](const lod::SplatStream::Visit& visit) -> Status {
            constexpr std::uint64_t kRows = 65536, kPart = 1024;
            std::vector<Splat> rows;
            for (std::uint64_t first = 0; first < source.size(); first += kRows) {
              rows.resize(std::min(kRows, source.size() - first));
              tbb::parallel_for(std::uint64_t{0}, (rows.size() + kPart - 1) / kPart, [&](std::uint64_t part) {
                const std::uint64_t n = std::min(kPart, rows.size() - part * kPart);
                source.read(first + part * kPart, std::span(rows).subspan(part * kPart, n));
              });
              memory.done(source.row_offset(first), source.row_offset(first + rows.size() - 1));
              if (Status s = visit(first, rows); !s) return s;
            }
            return {};
          }};
}

std::uint64_t hash_once(std::span<const std::byte> bytes, const ReadOnce& memory) {
  constexpr std::uint64_t kPart = std::uint64_t{16} << 20;
  Hasher hash;
  for (std::uint64_t first = 0; first < bytes.size(); first += kPart) {
    const std::uint64_t n = std::min<std::uint64_t>(kPart, bytes.size() - first);
    hash.update(bytes.subspan(first, n));
    memory.done(first, first + n);
  }
  return hash.digest();
}

StreamFacts facts_of(const SplatSource& source, const ReadOnce& memory) {
  return {source.bytes(),
          source.origin(),
          [&source, memory] { return source.source().empty() ? source.hash() : hash_once(source.source(), memory); },
          [&source] {
            return MeanRounding{0, source.position_rounding()};
          },
          [&source](std::uint64_t i) { return source.row_offset(i); },
          {}};
}

}  // namespace

Status check_count(std::uint64_t n) {
  if (n <= std::numeric_limits<std::uint32_t>::max()) return {};
  return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                    std::numeric_limits<std::uint32_t>::max(), n);
}

double max_rounding(const EncodeOptions& encode, bool allowed) {
  if (allowed) return std::numeric_limits<double>::infinity();
  return 1e-3 / (encode.metres_per_unit > 0 ? static_cast<double>(encode.metres_per_unit) : 1);
}

Status check_rounding(double position_rounding, double max_rounding) {
  if (position_rounding <= max_rounding) return {};
  return make_error(
      Errc::unsupported_feature, Error::kNone,
      "FP32 rounds positions this far from the scene's one origin too much, in micrometres; pass --lod, split "
      "the scene, or pass --allow-rounding",
      1000, static_cast<std::uint64_t>(std::ceil(std::min(1e3 * position_rounding / max_rounding, 1e18))));
}

Result<double> choose_page_origins(EncodeOptions& encode, MeanRounding rounding, bool allow_rounding) {
  const double millimetre = max_rounding(encode, false);
  encode.page_origins = encode.profile != Profile::archive && rounding.rest > millimetre / 4;
  const double left = rounding.lost + (encode.page_origins ? millimetre / 4 : rounding.rest);
  return check_rounding(left, max_rounding(encode, allow_rounding)).map([left] { return left; });
}

Status find_views(EncodeOptions& encode, const ConvertOptions& options, SceneScan& scan,
                  std::span<const float> sample) {
  if (!options.cameras.empty() || encode.first_view == FirstView())
    encode.first_view = choose_view(encode, options.cameras, scan.view_sample());
  scan.drop_view_sample();
  if (!options.cameras.empty()) {
    const auto range = depth_range_from_cameras(options.cameras, sample, encode.origin);
    if (!range) return tl::unexpected(range.error());
    encode.depth = *range;
  }
  if (options.z_near || options.z_far) {
    DepthRange range = encode.depth.value_or(depth_range_from_extent(scan.robust(), encode.depth_mapping));
    range.z_near = options.z_near.value_or(range.z_near);
    range.z_far = options.z_far.value_or(range.z_far);
    range.source = DepthSource::by_hand;
    encode.depth = range;
  }
  return {};
}

tl::unexpected<Error> damaged_gaussian(std::uint64_t offset, const SceneScan& scan) {
  return make_error(Errc::bad_value, offset, "a damaged Gaussian; pass --on-bad drop or --on-bad repair", 0,
                    scan.n_source() - scan.n_kept());
}

tl::unexpected<Error> nothing_for_levels() {
  return make_error(Errc::bad_argument, Error::kNone,
                    "a scene without Gaussians has no levels of detail; convert it without --lod");
}

Status check_archive_memory(const EncodeOptions& encode, std::uint64_t n_leaves, std::uint64_t memory_bytes) {
  // What LevelsWriter takes, with those above the leaves.
  const std::uint64_t archive_bytes = 80 * n_leaves;
  if (encode.profile != Profile::archive || archive_bytes <= memory_bytes) return {};
  return make_error(Errc::limit_exceeded, Error::kNone,
                    "archive with levels takes 80 bytes of memory a Gaussian; raise --memory to so many, or choose "
                    "--profile packed",
                    memory_bytes, archive_bytes);
}

Error of_source(Error error, std::span<const std::uint32_t> positions) {
  if (error.code != Errc::bad_value) return error;
  error.offset = Error::kNone;  // in a page
  error.found = error.found < positions.size() ? positions[error.found] : Error::kNone;
  return error;
}

Result<double> commit_scene(AtomicFile& file, const WrittenScene& written, const ConvertOptions& options,
                            StageClock& clock) {
  const Declarations& counts = written.declarations;
  if (const std::uint64_t n = counts.n_scale_subnormal + counts.n_scale_zero; options.strict && n != 0) {
    return make_error(Errc::bad_value, Error::kNone,
                      "scales are so far below the scene's largest that FP16 flushes or coarsens them; drop --strict "
                      "to store them so",
                      0, n);
  }
  clock.begin("commit", 0, "");
  const auto synced = file.commit();
  clock.end();
  return synced;
}

void summarise(ConvertSummary& summary, const SceneScan& scan, WrittenScene&& written) {
  summary.source_format = "ply";
  summary.output_format = "rgs";
  summary.output_bytes = written.header.file_bytes;
  summary.n_source = scan.n_source();
  summary.n_written = scan.n_kept();
  summary.n_repaired = scan.n_repaired();
  summary.sh_degree = scan.sh_degree();
  for (std::size_t i = 0; i < kDefectKinds; ++i) summary.defects[i] = scan.defects(static_cast<Defect>(i));
  summary.header = written.header;
  summary.declarations = written.declarations;
  summary.sections = std::move(written.sections);
  if (scan.n_kept() == 0) return;
  summary.min_scale = scale_from_log(scan.min_log_scale());
  summary.max_scale = scale_from_log(scan.max_log_scale());
  summary.min_opacity = opacity_from_logit(scan.min_opacity_logit());
  summary.max_opacity = opacity_from_logit(scan.max_opacity_logit());
}

Result<ConvertSummary> convert_to_rgs(const SplatSource& source, const std::string& output_path,
                                      const ConvertOptions& options, const StageObserver& observer) {
  if (const Status s = check_count(source.size()); !s) return tl::unexpected(s.error());
  if (options.levels) {
    const ReadOnce memory(source.source(), options.output.inputs);
    return convert_to_levels(stream_of(source, memory), facts_of(source, memory), output_path, options, observer);
  }
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  EncodeOptions encode = options.encode;
  encode.origin = source.origin();
  if (const Status s = check_encodable(SceneScan(0), encode); !s) return tl::unexpected(s.error());
  auto file = AtomicFile::create(output_path, options.output);
  if (!file) return tl::unexpected(file.error());

  // The source's hash is one serial stream: computed beside the first pass and the sort.
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
    return damaged_gaussian(source.row_offset(first_damaged(source, scanned.scan.sh_degree())), scanned.scan);
  }
  const double most = max_rounding(options.encode, options.allow_rounding);
  if (Status s = check_rounding(source.position_rounding(), most); !s) return tl::unexpected(s.error());
  clock.begin("sort", 0, "");
  std::vector<std::uint32_t> indices = kept_indices(scanned);
  scanned.kept = std::vector<std::uint64_t>();
  std::vector<float> sample;
  if (!options.cameras.empty()) sample = sample_means(scanned, indices);
  if (const Status s = find_views(encode, options, scanned.scan, sample); !s) return tl::unexpected(s.error());
  if (encode.order == Order::morton) sort_morton(indices, scanned.means, scanned.scan.robust());
  scanned.means = std::vector<float>();
  hashing.wait();
  if (encode.provenance) encode.provenance->source_xxh3 = source_xxh3;

  auto written = write_plain(source, *file, scanned.scan, encode, indices, clock, observer);
  if (!written) {
    Error error = written.error();
    if (error.code == Errc::bad_value && error.found != Error::kNone) error.offset = source.row_offset(error.found);
    return tl::unexpected(error);
  }
  const auto synced = commit_scene(*file, *written, options, clock);
  if (!synced) return tl::unexpected(synced.error());
  summary.sync_seconds = *synced;
  summarise(summary, scanned.scan, std::move(*written));
  summary.position_rounding = source.position_rounding();
  summary.source_bytes = source.bytes();
  summary.source_sh_degree = source.sh_degree();
  summary.origin = encode.origin;
  return summary;
}

Result<ConvertSummary> convert_to_levels(const lod::SplatStream& stream, const StreamFacts& facts,
                                         const std::string& output_path, const ConvertOptions& options,
                                         const StageObserver& observer) {
  if (const Status s = check_count(stream.n); !s) return tl::unexpected(s.error());
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  EncodeOptions encode = options.encode;
  encode.origin = facts.origin;
  if (const Status s = check_encodable(SceneScan(0), encode); !s) return tl::unexpected(s.error());
  auto file = AtomicFile::create(output_path, options.output);
  if (!file) return tl::unexpected(file.error());
  lod::StreamOptions stages;
  stages.build = options.build;
  stages.build.quality = options.levels.value_or(lod::Quality::fast);
  stages.memory_bytes = options.memory_bytes;
  stages.scratch = options.scratch;
  stages.begin = [&clock](const char* stage, std::uint64_t total, const char* unit) {
    clock.begin(stage, total, unit);
  };
  stages.advance = [&observer](std::uint64_t units) { observer.advance(units); };

  clock.begin("scan", stream.n, "Gaussians");
  SceneScan scan(std::min(stream.sh_degree, encode.sh_degree), encode.on_bad, true);
  std::uint64_t first_damaged = Error::kNone;
  if (const Status s = lod::scan_stream(stream, stages, scan, first_damaged); !s) return tl::unexpected(s.error());
  if (encode.on_bad == BadPolicy::refuse && scan.n_kept() != scan.n_source()) {
    return damaged_gaussian(facts.row_offset(first_damaged), scan);
  }
  if (const Status s = check_encodable(scan, encode); !s) return tl::unexpected(s.error());
  if (scan.n_kept() == 0) {
    return nothing_for_levels();
  }
  const auto rounding = choose_page_origins(encode, facts.rounding(), options.allow_rounding);
  if (!rounding) return tl::unexpected(rounding.error());
  summary.position_rounding = *rounding;
  if (const Status s = check_archive_memory(encode, scan.n_kept(), options.memory_bytes); !s)
    return tl::unexpected(s.error());
  std::vector<float> sample;
  if (!options.cameras.empty()) {
    clock.begin("sample", stream.n, "Gaussians");
    if (const Status s = lod::sample_means(stream, stages, scan, encode.on_bad, kDepthSample, sample); !s)
      return tl::unexpected(s.error());
  }
  if (const Status s = find_views(encode, options, scan, sample); !s) return tl::unexpected(s.error());
  if (encode.provenance) {
    clock.begin("hash", 0, "");
    encode.provenance->source_xxh3 = facts.hash();
  }
  lod::StreamedLevels levels;
  if (facts.arrange) {
    if (const Status s = facts.arrange(scan, encode, stages, levels); !s) return tl::unexpected(s.error());
  } else {
    if (const Status s = lod::order_leaves(stream, scan, encode, stages, levels); !s) return tl::unexpected(s.error());
    if (const Status s = lod::build_upper(encode, stages, levels); !s) return tl::unexpected(s.error());
  }
  auto written = lod::write_tree(levels, scan, encode, stages, *file);
  if (!written) return tl::unexpected(of_source(written.error(), levels.positions));
  const auto synced = commit_scene(*file, *written, options, clock);
  if (!synced) return tl::unexpected(synced.error());
  summary.sync_seconds = *synced;
  summarise(summary, scan, std::move(*written));
  summary.source_bytes = facts.bytes;
  summary.source_sh_degree = stream.sh_degree;
  summary.origin = encode.origin;
  summary.n_levels = static_cast<std::uint32_t>(levels.pages.size());
  for (const auto& level : levels.pages) summary.n_pages += static_cast<std::uint32_t>(level.size());
  summary.n_stored = levels.n_stored();
  return summary;
}

}  // namespace rgs
