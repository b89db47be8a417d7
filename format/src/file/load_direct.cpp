// load_direct.cpp - chunks in the GPU's layout: borrowed from the file, or decoded on all threads.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cassert>
#include <cstdlib>
#include <limits>

#include "archive/archive_codec.hpp"
#include "file/checked.hpp"
#include "file/large_pages.hpp"
#include "file/value_checks.hpp"
#include "file/workers.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

// Frames of one section with part of the range, and where their rows go.
struct CodedPart {
  SectionType type = SectionType::means;
  const FrameTable* table = nullptr;
  std::uint64_t row_bytes = 0;
  std::uint64_t first_frame = 0, n_frames = 0;
  std::uint64_t first = 0, end = 0;  // rows in these frames
  std::byte* rows = nullptr;         // [end - first, row_bytes]
};

// Uninitialised, aligned for vector loads; null if memory runs out.
std::byte* allocate(std::uint64_t bytes) {
  const std::uint64_t alignment = bytes >= 2 * detail::kLargePage ? detail::kLargePage : 64;
  if (bytes > std::numeric_limits<std::size_t>::max() - alignment) return nullptr;
  const auto size = static_cast<std::size_t>(detail::align_up(std::max<std::uint64_t>(bytes, 1), alignment));
  return static_cast<std::byte*>(detail::allocate_aligned(static_cast<std::size_t>(alignment), size));
}

struct Worker {
  detail::FrameDecoder decoder;
  std::vector<ShStepSet> steps;
};

Status decode_frame(const FileView& view, const CodedPart& part, std::uint64_t index, Worker& worker) {
  const CodedFrame& frame = part.table->frames[index];
  const auto bytes = detail::frame_bytes(view, frame);
  if (!bytes) return tl::unexpected(bytes.error());
  const auto stored = *bytes;
  const std::uint64_t first = index * part.table->rows;
  const auto count = static_cast<std::uint32_t>(std::min<std::uint64_t>(part.table->rows, part.end - first));
  const std::span rows(part.rows + (first - part.first) * part.row_bytes, count * part.row_bytes);
  switch (part.type) {
    case SectionType::geometry: return worker.decoder.geometry(stored, frame.offset, count, rows);
    case SectionType::sh: {
      const std::uint32_t chunk_rows = view.header().chunk_size;
      if (Status s = detail::frame_steps(view, first / chunk_rows, (count + chunk_rows - 1) / chunk_rows, worker.steps);
          !s)
        return s;
      return worker.decoder.sh(stored, frame.offset, count, {view.header().sh_degree, chunk_rows, worker.steps}, rows);
    }
    default: return worker.decoder.words(stored, frame.offset, count, part.row_bytes, rows);
  }
}

// Decodes the frames of one index of all three sections; `parts` as listed by read_chunks().
Status decode_archive_frame(const FileView& view, std::span<const CodedPart> parts, std::uint64_t index,
                            detail::ArchiveDecoder& decoder) {
  const CodedPart &sh = parts[0], &geometry = parts[1], &means = parts[2];
  const std::uint64_t first = index * sh.table->rows;
  const std::size_t count = std::min<std::uint64_t>(sh.table->rows, sh.end - first);
  const auto rows = [&](const CodedPart& part) {
    return std::span(part.rows + (first - part.first) * part.row_bytes, count * part.row_bytes);
  };
  detail::FrameStreams streams;
  for (const auto& [part, stream] :
       {std::pair(&means, &streams.means), {&geometry, &streams.geometry}, {&sh, &streams.sh}}) {
    const CodedFrame& frame = part->table->frames[index];
    const auto bytes = detail::frame_bytes(view, frame);
    if (!bytes) return tl::unexpected(bytes.error());
    *stream = {*bytes, frame.offset};
  }
  if (Status s = decoder.codes(streams, count); !s) return s;
  decoder.rows(view.header().scale_exponent, rows(means), rows(geometry));
  const std::uint32_t chunk_rows = view.header().chunk_size;
  std::vector<ShStepSet> steps;
  if (Status s = detail::frame_steps(view, first / chunk_rows, (count + chunk_rows - 1) / chunk_rows, steps); !s)
    return s;
  decoder.sh(view.header().sh_degree, chunk_rows, steps, rows(sh));
  return {};
}

Status decode_parts(const FileView& view, std::span<const CodedPart> parts, unsigned threads) {
  std::uint64_t n_jobs = 0;
  for (const CodedPart& part : parts) n_jobs += part.n_frames;
  std::vector<Worker> workers(detail::worker_count(n_jobs, threads));
  return detail::run_jobs(n_jobs, threads, [&](unsigned worker, std::uint64_t job) {
    std::size_t k = 0;
    while (job >= parts[k].n_frames) job -= parts[k++].n_frames;
    return decode_frame(view, parts[k], parts[k].first_frame + job, workers[worker]);
  });
}

Status decode_archive(const FileView& view, std::span<const CodedPart> parts, unsigned threads) {
  const std::uint64_t n_jobs = parts[0].n_frames;
  std::vector<detail::ArchiveDecoder> decoders;
  for (unsigned i = detail::worker_count(n_jobs, threads); i > 0; --i) {
    decoders.emplace_back(*detail::archive_tables(view));
  }
  return detail::run_jobs(n_jobs, threads, [&](unsigned worker, std::uint64_t job) {
    return decode_archive_frame(view, parts, parts[0].first_frame + job, decoders[worker]);
  });
}

}  // namespace

void DirectData::Free::operator()(std::byte* memory) const {
  detail::free_aligned(memory);
}

Result<DirectData> read_chunks(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                               const LoadOptions& options) {
  return detail::guard_memory([&] { return DirectData::load(view, first_chunk, n_chunks, options); });
}

Result<DirectData> DirectData::load(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                                    const LoadOptions& options) {
  const Header& h = view.header();
  assert(first_chunk <= h.n_chunks && n_chunks <= h.n_chunks - first_chunk);
  DirectData data;
  data.view_ = view;
  data.first_chunk_ = first_chunk;
  data.n_chunks_ = n_chunks;
  data.first_ = std::min(first_chunk * h.chunk_size, h.n_gaussians);
  data.n_ = std::min((first_chunk + n_chunks) * h.chunk_size, h.n_gaussians) - data.first_;

  // Largest first, so that the longest job does not start last.
  struct Section {
    SectionType type;
    std::uint64_t row_bytes;
    std::span<const std::byte>* rows;
  };
  const std::array sections = {Section{SectionType::sh, sh_bytes(h.sh_degree), &data.sh_},
                               Section{SectionType::geometry, kGeometryBytes, &data.geometry_},
                               Section{SectionType::means, kMeanBytes, &data.means_}};
  std::vector<CodedPart> parts;
  data.memory_.reserve(sections.size());
  for (const Section& s : sections) {
    const FrameTable& table = view.frames(s.type);
    if (table.rows == 0) {
      *s.rows = view.stored(s.type).subspan(data.first_ * s.row_bytes, data.n_ * s.row_bytes);
      continue;
    }
    if (data.n_ == 0) continue;
    CodedPart part{s.type, &table, s.row_bytes, data.first_ / table.rows};
    part.n_frames = (data.first_ + data.n_ - 1) / table.rows + 1 - part.first_frame;
    part.first = part.first_frame * table.rows;
    part.end = std::min((part.first_frame + part.n_frames) * table.rows, h.n_gaussians);
    part.rows = data.memory_.emplace_back(allocate((part.end - part.first) * s.row_bytes)).get();
    if (part.rows == nullptr) return detail::out_of_memory();
    *s.rows = std::span(part.rows + (data.first_ - part.first) * s.row_bytes, data.n_ * s.row_bytes);
    parts.push_back(part);
  }
  if (!parts.empty()) {
    const unsigned threads =
        detail::threads_for(data.n_ * (kMeanBytes + kGeometryBytes + sh_bytes(h.sh_degree)), options.threads);
    const Status decoded =
        view.archive() != nullptr ? decode_archive(view, parts, threads) : decode_parts(view, parts, threads);
    if (!decoded) return tl::unexpected(decoded.error());
  }
  if (options.validate) {
    if (const Status s = detail::check_values(data, options.threads); !s) return tl::unexpected(s.error());
  }
  return data;
}

Result<DirectData> load_direct(const FileView& view, const LoadOptions& options) {
  return detail::guard_memory([&]() -> Result<DirectData> {
    auto data = read_chunks(view, 0, view.header().n_chunks, {false, options.threads});
    if (data && options.validate) {
      if (const Status s = detail::check_file(*data, options.threads); !s) return tl::unexpected(s.error());
    }
    return data;
  });
}

}  // namespace rgs
