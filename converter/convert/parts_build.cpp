// parts_build.cpp - builds one range of stretches: sorted leaves, levels, pages as stored.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <bit>
#include <utility>

#include "parts.hpp"
#include "parts_range.hpp"
#include "parts_rows.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/levels_writer.hpp"

namespace rgs {
namespace {

constexpr std::size_t kPageWords = 18;

std::vector<std::uint32_t> words_of(const StretchLevel& level) {
  std::vector<std::uint32_t> words;
  for (std::size_t i = 0; i < level.pages.size(); ++i) {
    const lod::Page& page = level.pages[i];
    words.insert(words.end(), {page.level, page.first_child, page.n_children, page.count});
    for (const Box* box : {&page.bounds, &page.core}) {
      for (const float x : box->min) words.push_back(std::bit_cast<std::uint32_t>(x));
      for (const float x : box->max) words.push_back(std::bit_cast<std::uint32_t>(x));
    }
    words.push_back(std::bit_cast<std::uint32_t>(page.error));
    words.push_back(level.record_bytes[i]);
  }
  return words;
}

// Pages of a shape that can form a tree; the writer validates it.
std::optional<StretchLevel> level_of(std::span<const std::uint32_t> words, std::uint32_t number) {
  StretchLevel level;
  if (words.empty() || words.size() % kPageWords != 0) return std::nullopt;
  std::uint64_t first = 0;
  for (; !words.empty(); words = words.subspan(kPageWords)) {
    lod::Page page;
    page.level = words[0];
    page.first_child = words[1];
    page.n_children = words[2];
    page.count = words[3];
    std::size_t next = 4;
    for (Box* box : {&page.bounds, &page.core}) {
      for (float& x : box->min) x = std::bit_cast<float>(words[next++]);
      for (float& x : box->max) x = std::bit_cast<float>(words[next++]);
    }
    page.error = std::bit_cast<float>(words[next++]);
    page.first = first;
    first += page.count;
    if (page.level != number || page.count == 0) return std::nullopt;
    level.pages.push_back(page);
    level.record_bytes.push_back(words[next]);
  }
  return level;
}

nlohmann::json hashed_json(const HashedBytes& part) {
  return nlohmann::json::array({part.offset, part.bytes, part.xxh3});
}

HashedBytes hashed_of(const nlohmann::json& list) {
  return {list.at(0), list.at(1), list.at(2)};
}

Error not_as_written() {
  return {Errc::bad_value,
          Error::kNone,
          "a table of this file is damaged; remove the file and run --lod-build again for its range",
          Error::kNone,
          Error::kNone,
          0};
}

// An error of the file, or of the scratch folder.
Failure of_file(const PartsRun& run, const std::string& path, const Error& error) {
  if (!lod::concerns_scratch(error)) return {path, error};
  return {run.scratch.empty() ? "." : run.scratch, error};
}

class RangeBuilder {
 public:
  RangeBuilder(const PartsRun& run, const PartsJob& job, const PartsPlan& plan, LeafReader& leaves, WorkWriter& file)
      : plan_(plan), options_(run.stream_options(job.quality)), leaves_(leaves), file_(file) {}

  Status prepare() {
    EncodeOptions pages = plan_.encode;  // pages do not hold positions
    pages.keep_permutation = false;
    pages.n_source = pages.n_repaired = 0;
    for (std::uint64_t i = 0; i < 8 * lod::most_at_once(options_, 8 * lod::kPageBytes); ++i) {
      auto encoder = PageEncoder::create(plan_.scan.of_kept(), pages);
      if (!encoder) return tl::unexpected(encoder.error());
      encoders_.push_back(std::move(*encoder));
    }
    return {};
  }

  // Adds leaves first .. last - 1. `failure`: the error of a file that is read.
  Status add_stretch(std::uint64_t first, std::uint64_t last, BuiltStretch& out, std::optional<Failure>& failure) {
    lod::StreamedLevels levels;
    if (Status s = take_leaves(first, last, levels, failure); !s) return s;
    const lod::BuildOptions build = lod::build_options(plan_.encode, options_);
    if (Status s = lod::build_upper(plan_.encode, options_, levels, build.stretch_levels); !s) return s;
    out.levels.resize(levels.pages.size());
    for (std::size_t i = levels.pages.size(); i-- > 0;) {
      out.levels[i].pages = std::move(levels.pages[i]);
      if (Status s = encode_level(levels.rows[i], out.levels[i]); !s) return s;
    }
    if (out.levels.back().pages.size() > 1) {
      std::uint64_t n = 0;
      for (const lod::Page& page : out.levels.back().pages) n += page.count;
      std::vector<std::byte> rows(n * levels.rows.back().row_bytes());
      if (Status s = levels.rows.back().file().read(0, rows); !s) return s;
      if (Status s = append(rows, out.tops); !s) return s;
    }
    return append(std::as_bytes(std::span(levels.positions)), out.positions);
  }

 private:
  Status take_leaves(std::uint64_t first, std::uint64_t last, lod::StreamedLevels& levels,
                     std::optional<Failure>& failure) {
    lod::LevelRows rows = leaf_rows(plan_);
    const std::uint64_t row_bytes = rows.row_bytes(), n = last - first;
    levels.n_leaves = n;
    levels.on_disk = n * row_bytes > options_.memory_bytes / 4;
    auto scratch = lod::scratch_file(levels.on_disk, options_);
    if (!scratch) return tl::unexpected(scratch.error());
    if (!levels.on_disk) {  // allocate at once, do not grow
      if (Status s = scratch->write(n * row_bytes - 1, std::array<std::byte, 1>{}); !s) return s;
    }
    rows.file() = std::move(*scratch);
    levels.chunks.resize((n + plan_.encode.chunk_size - 1) / plan_.encode.chunk_size);
    leaves_.seek(first);
    for (std::uint64_t at = 0; at < n;) {
      const auto part = leaves_.next(n - at);
      if (!part) {
        failure = part.error();
        return tl::unexpected(part.error().error);
      }
      if (Status s = rows.file().write(at * row_bytes, *part); !s) return s;
      lod::add_to_chunks(rows, at, *part, plan_.encode.chunk_size, levels.chunks);
      for (std::uint64_t i = 0; plan_.encode.keep_permutation && i < part->size(); i += row_bytes) {
        levels.positions.push_back(rows.position(&(*part)[i]));
      }
      at += part->size() / row_bytes;
    }
    levels.rows.push_back(std::move(rows));
    return {};
  }

  Status encode_level(const lod::LevelRows& rows, StretchLevel& level) {
    level.offset = file_.end();
    std::vector<std::span<const std::byte>> records(encoders_.size());
    for (std::size_t first = 0; first < level.pages.size(); first += encoders_.size()) {
      const std::size_t n = std::min(encoders_.size(), level.pages.size() - first);
      const Status encoded = lod::each_at_once(n, n, [&](std::size_t i) -> Status {
        const lod::Page& page = level.pages[first + i];
        SplatCloud splats;
        if (Status s = rows.read(page.first, page.count, splats); !s) return s;
        const auto record = encoders_[i].encode(page, splats.view());
        if (!record) return tl::unexpected(record.error());
        records[i] = *record;
        return {};
      });
      if (!encoded) return encoded;
      for (std::size_t i = 0; i < n; ++i) {
        level.record_bytes.push_back(static_cast<std::uint32_t>(records[i].size()));
        if (Status s = file_.append(records[i]); !s) return s;
      }
    }
    return {};
  }

  Status append(std::span<const std::byte> bytes, HashedBytes& out) {
    out = {file_.end(), bytes.size(), xxh3(bytes)};
    return file_.append(bytes);
  }

  const PartsPlan& plan_;
  lod::StreamOptions options_;
  LeafReader& leaves_;
  WorkWriter& file_;
  std::vector<PageEncoder> encoders_;
};

}  // namespace

nlohmann::json about_range(const BuiltRange& range) {
  nlohmann::json stretches = nlohmann::json::array();
  for (const BuiltStretch& stretch : range) {
    nlohmann::json levels = nlohmann::json::array();
    for (const StretchLevel& level : stretch.levels) {
      const std::vector<std::uint32_t> words = words_of(level);
      levels.push_back({{"offset", level.offset}, {"pages", pack_numbers(std::span<const std::uint32_t>(words))}});
    }
    stretches.push_back({{"levels", std::move(levels)},
                         {"tops", hashed_json(stretch.tops)},
                         {"positions", hashed_json(stretch.positions)}});
  }
  return {{"stretches", std::move(stretches)}};
}

Result<BuiltRange> range_of(const WorkFile& file) {
  return read_about([&]() -> Result<BuiltRange> {
    BuiltRange range;
    for (const nlohmann::json& s : file.about().at("stretches")) {
      BuiltStretch& stretch = range.emplace_back();
      for (const nlohmann::json& l : s.at("levels")) {
        const auto words = unpack_numbers<std::uint32_t>(l.at("pages"));
        if (!words) return tl::unexpected(words.error());
        auto level = level_of(*words, static_cast<std::uint32_t>(stretch.levels.size()));
        if (!level) return tl::unexpected(not_as_written());
        level->offset = l.at("offset");
        stretch.levels.push_back(std::move(*level));
      }
      stretch.tops = hashed_of(s.at("tops"));
      stretch.positions = hashed_of(s.at("positions"));
      if (stretch.levels.empty()) return tl::unexpected(not_as_written());
    }
    return range;
  });
}

Done build_range(const PartsRun& run, const PartsJob& job, const PartsPlan& plan, std::size_t range) {
  const std::string path = run.range_path(range);
  const std::vector<std::uint64_t> begins = stretches_of(run, job, plan);
  const StretchRange of = stretches_of_range(begins.size() - 1, range, job.n_ranges);
  if (of.first == of.last) return false;
  if (const auto old = WorkFile::find(path, WorkKind::range, plan.identity); old && *old) return false;
  auto leaves = LeafReader::open(run, job, plan);
  if (!leaves) return tl::unexpected(leaves.error());
  auto writer = WorkWriter::create(path, WorkKind::range, plan.identity, run.sync);
  if (!writer) return failed(path, writer.error());
  run.observer.begin("build", begins[of.last] - begins[of.first] + (begins[of.last] - begins[of.first]) / 3,
                     "Gaussians");
  RangeBuilder builder(run, job, plan, *leaves, *writer);
  BuiltRange built;
  std::optional<Failure> failure;
  const Status status = detail::guard_memory([&]() -> Status {
    if (Status s = builder.prepare(); !s) return s;
    for (std::size_t i = of.first; i < of.last; ++i) {
      if (Status s = builder.add_stretch(begins[i], begins[i + 1], built.emplace_back(), failure); !s) return s;
    }
    return writer->finish(about_range(built));
  });
  if (failure) return tl::unexpected(*failure);
  if (!status) return tl::unexpected(of_file(run, path, status.error()));
  run.observer.finish();
  return true;
}

}  // namespace rgs
