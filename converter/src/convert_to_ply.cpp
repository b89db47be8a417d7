// convert_to_ply.cpp - .rgs to PLY, batch by batch on all threads.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/parallel_for.h>

#include <algorithm>
#include <atomic>
#include <mutex>
#include <numeric>

#include "convert.hpp"
#include "stage_clock.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kBatchRows = 4096;      // of files that are stored as is
constexpr std::uint64_t kCodedRows = 1u << 19;  // decoded at a time from others

// Positions in the file in the order of the source; empty if the file is in that order or does not say.
std::vector<std::uint64_t> source_order(const FileView& view) {
  if (view.find(SectionType::permutation) == nullptr) return {};
  std::vector<std::uint64_t> order(view.header().n_gaussians);
  std::iota(order.begin(), order.end(), std::uint64_t{0});
  std::ranges::sort(order, {}, [&view](std::uint64_t i) { return view.source_index(i); });
  return order;
}

// Rows first .. first + count - 1 of the PLY in batches on all threads; read(first, rows) reads them.
template <class Read>
Status write_batches(std::uint64_t first, std::uint64_t count, PlyWriter& writer, const StageObserver& observer,
                     const Read& read) {
  std::mutex failing;
  Status status;
  std::atomic<bool> failed{false};
  tbb::parallel_for(std::uint64_t{0}, (count + kBatchRows - 1) / kBatchRows, [&](std::uint64_t batch) {
    if (failed.load(std::memory_order_relaxed)) return;
    const std::uint64_t begin = first + batch * kBatchRows;
    std::vector<Splat> rows(std::min(kBatchRows, first + count - begin));
    Status s = read(begin, std::span(rows));
    if (s) s = writer.write(begin, rows);
    if (!s) {
      const std::lock_guard lock(failing);
      if (status) status = s;
      failed.store(true, std::memory_order_relaxed);
    }
    observer.advance(rows.size());
  });
  return status;
}

// In the order of the file a few frames are decoded at a time; in that of the source rows come from everywhere, and all
// that is coded is decoded first.
Status write_rows(const FileView& source, std::span<const std::uint64_t> order, PlyWriter& writer,
                  const StageObserver& observer) {
  const Header& h = source.header();
  const std::uint64_t piece = source.coded() && order.empty() ? std::max<std::uint64_t>(1, kCodedRows / h.chunk_size)
                                                              : std::max<std::uint64_t>(1, h.n_chunks);
  for (std::uint64_t chunk = 0; chunk < h.n_chunks; chunk += piece) {
    const auto data = read_chunks(source, chunk, std::min(piece, h.n_chunks - chunk), {.validate = false});
    if (!data) return tl::unexpected(data.error());
    const Status s = write_batches(data->first(), data->size(), writer, observer,
                                   [&](std::uint64_t begin, std::span<Splat> rows) -> Status {
                                     if (order.empty()) return data->read(begin, rows);
                                     for (std::size_t i = 0; i < rows.size(); ++i) {
                                       if (Status read = data->read(order[begin + i], rows.subspan(i, 1)); !read)
                                         return read;
                                     }
                                     return {};
                                   });
    if (!s) return s;
  }
  return {};
}

}  // namespace

Result<ConvertSummary> convert_rgs_to_ply(const FileView& source, const std::string& output_path,
                                          AtomicFile::Options output, const StageObserver& observer) {
  ConvertSummary summary;
  StageClock clock(observer, summary.seconds);
  clock.begin("validate", 0, "");
  if (const Status s = validate(source); !s) return tl::unexpected(s.error());
  const std::uint64_t n = source.header().n_gaussians;
  const int degree = source.header().sh_degree;
  auto writer = PlyWriter::create(output_path, n, degree, output);
  if (!writer) return tl::unexpected(writer.error());
  const std::vector<std::uint64_t> order = source_order(source);

  clock.begin("decode", n, "Gaussians");
  if (const Status s = write_rows(source, order, *writer, observer); !s) return tl::unexpected(s.error());
  clock.begin("commit", 0, "");
  const auto synced = writer->commit();
  if (!synced) return tl::unexpected(synced.error());
  clock.end();

  summary.sync_seconds = *synced;
  summary.source_format = "rgs";
  summary.output_format = "ply";
  summary.source_bytes = source.bytes().size();
  summary.output_bytes = ply_header(n, degree).size() + n * ply_row_bytes(degree);
  summary.n_source = summary.n_written = n;
  summary.source_sh_degree = summary.sh_degree = degree;
  summary.header = source.header();
  summary.declarations = source.declarations();
  summary.sections = source.sections();
  return summary;
}

}  // namespace rgs
