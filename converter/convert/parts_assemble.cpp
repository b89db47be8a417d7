// parts_assemble.cpp - joins ranges into one file: builds the levels above their stretches and copies their pages.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <utility>

#include "convert_steps.hpp"
#include "parts.hpp"
#include "parts_range.hpp"
#include "parts_rows.hpp"
#include "parts_scan.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/levels_writer.hpp"

namespace rgs {
namespace {

Error not_as_written() {
  return {Errc::bad_value,
          Error::kNone,
          "this file does not match the plan; remove it and run --lod-build again for its range",
          Error::kNone,
          Error::kNone,
          0};
}

struct OpenRange {
  std::string path;
  WorkFile file;
  BuiltRange built;
};

Outcome<std::vector<OpenRange>> open_ranges(const PartsRun& run, const PartsJob& job, const PartsPlan& plan,
                                            std::size_t n_stretches) {
  std::vector<OpenRange> ranges;
  for (std::size_t r = 0; r < job.n_ranges; ++r) {
    const StretchRange of = stretches_of_range(n_stretches, r, job.n_ranges);
    if (of.first == of.last) continue;
    const std::string path = run.range_path(r);
    auto found = WorkFile::find(path, WorkKind::range, plan.identity);
    if (!found) return failed(path, found.error());
    std::optional<WorkFile>& file = *found;
    if (!file) {
      return failed(
          path, {Errc::open_failed, Error::kNone, "missing, or from another plan; run --lod-build for this range first",
                 Error::kNone, Error::kNone, 0});
    }
    auto built = range_of(*file);
    if (!built) return failed(path, built.error());
    if (built->size() != of.last - of.first) return failed(path, not_as_written());
    file->forget_about();
    file->rest();
    ranges.push_back({path, std::move(*file), std::move(*built)});
  }
  return ranges;
}

Status read_hashed(WorkFile& file, const HashedBytes& part, std::vector<std::byte>& bytes) {
  if (part.bytes > file.end()) return tl::unexpected(not_as_written());
  bytes.resize(part.bytes);
  if (bytes.empty()) return {};
  if (Status s = file.read(part.offset, bytes); !s) return s;
  if (xxh3(bytes) == part.xxh3) return {};
  return make_error(Errc::checksum_mismatch, part.offset,
                    "this file is damaged; remove it and run --lod-build again for its range");
}

// Copies the records of a level, some megabytes at a time.
Status copy_records(WorkFile& file, const StretchLevel& level, LevelsWriter& writer, const StageObserver& observer) {
  constexpr std::uint64_t kAtOnce = std::uint64_t{8} << 20;
  std::uint64_t offset = level.offset;
  std::vector<std::byte> bytes;
  for (std::size_t first = 0; first < level.pages.size();) {
    std::size_t last = first;
    std::uint64_t wanted = 0;
    do {
      wanted += level.record_bytes[last++];
    } while (last < level.pages.size() && wanted < kAtOnce);
    if (wanted > file.end()) return tl::unexpected(not_as_written());
    bytes.resize(wanted);
    if (Status s = file.read(offset, bytes); !s) return s;
    offset += wanted;
    for (auto rest = std::span<const std::byte>(bytes); first < last; ++first) {
      if (Status s = writer.add(rest.first(level.record_bytes[first])); !s) return s;
      rest = rest.subspan(level.record_bytes[first]);
      observer.advance(level.pages[first].count);
    }
  }
  return {};
}

class Assembler {
 public:
  Assembler(const PartsRun& run, const PartsJob& job, const PartsPlan& plan, std::vector<OpenRange>& ranges)
      : run_(run), plan_(plan), options_(run.stream_options(job.quality)), ranges_(ranges) {}

  // Joins the pages of all stretches, and builds those above them.
  Outcome<void> build_tops() {
    const std::size_t n_levels = levels_per_stretch();
    pages_.resize(n_levels);
    std::uint64_t n_tops = 0;
    for (OpenRange& range : ranges_) {
      for (const BuiltStretch& stretch : range.built) {
        if (stretch.levels.size() != n_levels) return failed(range.path, not_as_written());
        for (const lod::Page& page : stretch.levels.back().pages) n_tops += page.count;
      }
    }
    tops_.on_disk = n_tops * lod::LevelRows({}, plan_.scan.sh_degree(), lod::LevelRows::Kind::of_upper()).row_bytes() >
                    options_.memory_bytes / 8;
    auto scratch = lod::scratch_file(tops_.on_disk, options_);
    if (!scratch) return failed(run_.scratch, scratch.error());
    lod::LevelRows rows(std::move(*scratch), plan_.scan.sh_degree(), lod::LevelRows::Kind::of_upper());
    std::uint64_t n_rows = 0;
    for (OpenRange& range : ranges_) {
      for (const BuiltStretch& stretch : range.built) {
        if (auto s = add_stretch(range, stretch, rows, n_rows); !s) return s;
      }
      range.file.rest();
    }
    std::uint64_t n_leaves = 0;
    for (const lod::Page& page : pages_.front()) n_leaves += page.count;
    if (n_leaves != plan_.scan.n_kept()) return failed(run_.folder, not_as_written());
    tops_.rows.push_back(std::move(rows));
    tops_.pages.push_back(pages_.back());
    tops_.n_leaves = n_leaves;
    run_.observer.begin("levels", n_rows + n_rows / 3, "Gaussians");
    const auto n = static_cast<std::uint32_t>(pages_.back().size());
    if (const Status s = lod::build_above(plan_.encode, options_, {0, n}, tops_); !s)
      return failed(run_.scratch, s.error());
    for (std::size_t i = 1; i < tops_.pages.size(); ++i) pages_.push_back(tops_.pages[i]);
    n_built_ = tops_.pages.size() - 1;
    run_.observer.finish();
    return {};
  }

  Outcome<WrittenScene> write(AtomicFile& file, const std::string& output_path) {
    auto writer = LevelsWriter::create(
        file, plan_.scan.of_kept(), lod::file_options(plan_.scan, plan_.encode, positions_), lod::join_levels(pages_));
    if (!writer) return failed(output_path, writer.error());
    run_.observer.begin("write", n_stored(), "Gaussians");
    if (const Status s = encode_tops(*writer); !s) return failed(output_path, s.error());
    for (std::size_t level = pages_.size() - n_built_; level-- > 0;) {
      for (OpenRange& range : ranges_) {
        for (const BuiltStretch& stretch : range.built) {
          const Status copied = copy_records(range.file, stretch.levels[level], *writer, run_.observer);
          if (!copied) {
            const Errc code = copied.error().code;
            return failed(code == Errc::write_failed ? output_path : range.path, copied.error());
          }
        }
        range.file.rest();
      }
    }
    auto written = writer->finish();  // an archive is encoded here
    if (!written) return failed(output_path, of_source(written.error(), positions_));
    run_.observer.finish();
    return std::move(*written);
  }

  std::uint64_t n_stored() const {
    std::uint64_t n = 0;
    for (const auto& level : pages_) {
      for (const lod::Page& page : level) n += page.count;
    }
    return n;
  }
  const std::vector<std::vector<lod::Page>>& pages() const { return pages_; }

 private:
  // The number of levels of a stretch, the same for all.
  std::size_t levels_per_stretch() const {
    for (const OpenRange& range : ranges_) {
      if (!range.built.empty()) return range.built.front().levels.size();
    }
    return 1;
  }

  Outcome<void> add_stretch(OpenRange& range, const BuiltStretch& stretch, lod::LevelRows& rows,
                            std::uint64_t& n_rows) {
    std::vector<std::byte> bytes;
    for (std::size_t level = stretch.levels.size(); level-- > 0;) {
      const auto below = level == 0 ? 0 : static_cast<std::uint32_t>(pages_[level - 1].size());
      std::uint64_t first = level + 1 == stretch.levels.size() ? n_rows : 0;
      for (lod::Page page : stretch.levels[level].pages) {
        if (level > 0) page.first_child += below;
        page.first = first;
        first += page.count;
        pages_[level].push_back(page);
      }
    }
    if (const Status s = read_hashed(range.file, stretch.tops, bytes); !s) return failed(range.path, s.error());
    std::uint64_t n = 0;
    for (const lod::Page& page : stretch.levels.back().pages) n += page.count;
    const bool is_root = stretch.levels.back().pages.size() == 1 && bytes.empty();
    if (!is_root && bytes.size() != n * rows.row_bytes()) return failed(range.path, not_as_written());
    if (const Status s = rows.file().write(n_rows * rows.row_bytes(), bytes); !s)
      return failed(run_.scratch, s.error());
    n_rows += n;
    if (!plan_.encode.keep_permutation) return {};
    if (const Status s = read_hashed(range.file, stretch.positions, bytes); !s) return failed(range.path, s.error());
    if (bytes.size() % sizeof(std::uint32_t) != 0) return failed(range.path, not_as_written());
    const std::size_t before = positions_.size();
    positions_.resize(before + bytes.size() / sizeof(std::uint32_t));
    std::ranges::copy(bytes, std::as_writable_bytes(std::span(positions_).subspan(before)).begin());
    return {};
  }

  Status encode_tops(LevelsWriter& writer) {
    LevelsWriter::Encoder encoder(writer);
    std::uint32_t next = 0;
    for (std::size_t level = tops_.pages.size(); level-- > 1;) {
      for (const lod::Page& page : tops_.pages[level]) {
        SplatCloud splats;
        if (Status s = tops_.rows[level].read(page.first, page.count, splats); !s) return s;
        if (Status s = encoder.encode(next++, splats.view()); !s) return s;
        if (Status s = writer.add(encoder); !s) return s;
        run_.observer.advance(page.count);
      }
    }
    return {};
  }

  const PartsRun& run_;
  const PartsPlan& plan_;
  lod::StreamOptions options_;
  std::vector<OpenRange>& ranges_;
  std::vector<std::vector<lod::Page>> pages_;  // per level, leaves first
  lod::StreamedLevels tops_;                   // from the stretches' last level up
  std::size_t n_built_ = 0;                    // levels above it
  std::vector<std::uint32_t> positions_;
};

}  // namespace

Outcome<ConvertSummary> assemble_parts(const PartsRun& run, const PartsJob& job, const PartsPlan& plan,
                                       const std::string& output_path, const AtomicFile::Options& output) {
  if (const Status s = check_archive_memory(plan.encode, plan.scan.n_kept(), run.memory_bytes); !s)
    return failed(output_path, s.error());
  auto file = AtomicFile::create(output_path, output);
  if (!file) return failed(output_path, file.error());
  auto ranges = open_ranges(run, job, plan, stretches_of(run, job, plan).size() - 1);
  if (!ranges) return tl::unexpected(ranges.error());
  ConvertSummary summary;
  StageClock clock(run.observer, summary.seconds);
  PartsRun timed = run;
  timed.observer.begin = [&clock](const char* stage, std::uint64_t total, const char* unit) {
    clock.begin(stage, total, unit);
  };
  timed.observer.finish = [&clock] { clock.end(); };
  Assembler assembler(timed, job, plan, *ranges);
  if (const auto built = assembler.build_tops(); !built) return tl::unexpected(built.error());
  auto written = assembler.write(*file, output_path);
  if (!written) return tl::unexpected(written.error());
  ConvertOptions options;
  options.strict = job.strict;
  const auto synced = commit_scene(*file, *written, options, clock);
  if (!synced) return failed(output_path, synced.error());
  summary.sync_seconds = *synced;
  summarise(summary, plan.scan, std::move(*written));
  summary.source_format = job.source_format;
  summary.source_name = plan.encode.provenance ? plan.encode.provenance->source_name : "";
  summary.source_bytes = plan.encode.provenance ? plan.encode.provenance->source_bytes : 0;
  summary.source_sh_degree = job.sh_degree;
  summary.origin = plan.encode.origin;
  summary.n_levels = static_cast<std::uint32_t>(assembler.pages().size());
  for (const auto& level : assembler.pages()) summary.n_pages += static_cast<std::uint32_t>(level.size());
  summary.n_stored = assembler.n_stored();
  summary.unused = job.unused;
  summary.notes = job.notes;
  MeanRounding rounding;
  for (std::size_t i = 0; i < job.inputs.size(); ++i) {
    if (const auto scanned = find_scan(run, job, i); scanned && *scanned) rounding.add((*scanned)->rounding);
  }
  EncodeOptions encode = plan.encode;
  summary.position_rounding = choose_page_origins(encode, rounding, job.allow_rounding).value_or(0);  // it was planned
  note_rounding(summary);
  return summary;
}

}  // namespace rgs
