// convert_to_ply.cpp - converts .rgs to PLY, batch by batch on all threads.
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

constexpr std::uint64_t kBatchRows = 4096;

// File positions in source order, from a validated permutation.
std::vector<std::uint64_t> source_order(const FileView& view) {
  std::vector<std::uint64_t> order(view.header().n_gaussians);
  std::iota(order.begin(), order.end(), std::uint64_t{0});
  std::ranges::sort(order, {}, [&view](std::uint64_t i) { return view.source_index(i); });
  return order;
}

// Writes rows first .. first + count - 1 of the PLY in batches on all threads; read(first, rows) reads them.
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

// In file order: rows decoded for validation are written at once.
Status write_in_file_order(const FileView& source, PlyWriter& writer, const StageObserver& observer) {
  auto validation = Validation::begin(source);
  if (!validation) return tl::unexpected(validation.error());
  const std::uint64_t n_chunks = source.header().n_chunks, piece = validation->chunks_at_a_time();
  for (std::uint64_t chunk = 0; chunk < n_chunks; chunk += piece) {
    const auto data = read_chunks(source, chunk, std::min(piece, n_chunks - chunk), {.validate = false});
    if (!data) return tl::unexpected(data.error());
    if (Status s = validation->check(*data); !s) return s;
    const auto read = [&data](std::uint64_t begin, std::span<Splat> rows) { return data->read(begin, rows); };
    if (Status s = write_batches(data->first(), data->size(), writer, observer, read); !s) return s;
  }
  return validation->finish();
}

// In source order, which is known only after the permutation is validated: gathers rows.
Status write_in_source_order(const FileView& source, PlyWriter& writer, const StageObserver& observer) {
  if (Status s = validate(source); !s) return s;
  const auto data = load_direct(source, {.validate = false});
  if (!data) return tl::unexpected(data.error());
  const std::vector<std::uint64_t> order = source_order(source);
  return write_batches(0, order.size(), writer, observer, [&](std::uint64_t begin, std::span<Splat> rows) -> Status {
    for (std::size_t i = 0; i < rows.size(); ++i) {
      if (Status s = data->read(order[begin + i], rows.subspan(i, 1)); !s) return s;
    }
    return {};
  });
}

}  // namespace

Result<ConvertSummary> convert_rgs_to_ply(const FileView& source, const std::string& output_path,
                                          const AtomicFile::Options& output, const StageObserver& observer,
                                          const std::optional<Declarations>& stated) {
  ConvertSummary summary;
  summary.declarations = stated.value_or(source.declarations());
  StageClock clock(observer, summary.seconds);
  const std::uint64_t n = source.header().n_gaussians;
  const int degree = source.header().sh_degree;
  summary.declarations.origin = source.declarations().origin;
  auto writer = PlyWriter::create(output_path, n, degree, output, summary.declarations);
  if (!writer) return tl::unexpected(writer.error());

  clock.begin("decode", n, "Gaussians");
  const bool permuted = source.find(SectionType::permutation) != nullptr;
  const Status written = (permuted ? write_in_source_order : write_in_file_order)(source, *writer, observer);
  if (!written) return tl::unexpected(written.error());
  clock.begin("commit", 0, "");
  const auto synced = writer->commit();
  if (!synced) return tl::unexpected(synced.error());
  clock.end();

  summary.sync_seconds = *synced;
  summary.source_format = "rgs";
  summary.output_format = "ply";
  summary.source_bytes = source.bytes().size();
  summary.origin = summary.declarations.origin;
  summary.output_bytes = ply_header(n, degree, summary.declarations).size() + n * ply_row_bytes(degree, summary.origin);
  summary.n_source = summary.n_written = n;
  summary.source_sh_degree = summary.sh_degree = degree;
  summary.header = source.header();
  summary.lost = lost_declarations(SplatFormat::ply, keep_declarations({}, summary.declarations),
                                   format_info(SplatFormat::ply).keeps);
  summary.sections = source.sections();
  return summary;
}

}  // namespace rgs
