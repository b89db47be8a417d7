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

constexpr std::uint64_t kBatchRows = 4096;

// Positions in the file in the order of the source; empty if the file is in that order or does not say.
std::vector<std::uint64_t> source_order(const FileView& view) {
  if (view.find(SectionType::permutation) == nullptr) return {};
  std::vector<std::uint64_t> order(view.header().n_gaussians);
  std::iota(order.begin(), order.end(), std::uint64_t{0});
  std::ranges::sort(order, {}, [&view](std::uint64_t i) { return view.source_index(i); });
  return order;
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
  std::mutex failing;
  Status status;
  std::atomic<bool> failed{false};
  tbb::parallel_for(std::uint64_t{0}, (n + kBatchRows - 1) / kBatchRows, [&](std::uint64_t batch) {
    if (failed.load(std::memory_order_relaxed)) return;
    const std::uint64_t first = batch * kBatchRows;
    std::vector<Splat> rows(std::min(kBatchRows, n - first));
    Status s;
    if (order.empty()) {
      s = source.read(first, rows);
    } else {
      for (std::size_t i = 0; s && i < rows.size(); ++i) s = source.read(order[first + i], std::span(&rows[i], 1));
    }
    if (s) s = writer->write(first, rows);
    if (!s) {
      const std::lock_guard lock(failing);
      if (status) status = s;
      failed.store(true, std::memory_order_relaxed);
    }
    observer.advance(rows.size());
  });
  if (!status) return tl::unexpected(status.error());
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
