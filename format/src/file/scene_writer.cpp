// scene_writer.cpp - encodes batches of chunks into the sections of a file.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene_writer.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstring>
#include <optional>
#include <utility>

#include "archive/archive_encode.hpp"
#include "archive/archive_rows.hpp"
#include "file/chunk_summary.hpp"
#include "file/encode_plan.hpp"
#include "file/encode_rows.hpp"
#include "file/section_writer.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kDirectRows = 8192;  // Gaussians a batch, or one chunk if larger
constexpr std::array kLarge = {SectionType::means, SectionType::geometry, SectionType::sh};

// Whether the union of the chunks' boxes is `full`.
bool same_box(std::span<const ChunkEntry> chunks, const Box& full) {
  if (chunks.empty()) return true;
  Box box = chunks.front().means;
  for (const ChunkEntry& chunk : chunks) {
    for (std::size_t k = 0; k < 3; ++k) {
      box.min[k] = std::min(box.min[k], chunk.means.min[k]);
      box.max[k] = std::max(box.max[k], chunk.means.max[k]);
    }
  }
  return box.min == full.min && box.max == full.max;
}

}  // namespace

struct SceneWriter::State {
  State(Sink to, detail::EncodePlan planned) : plan(std::move(planned)), file(to, plan.sections, plan.n_frames()) {}

  detail::EncodePlan plan;
  detail::SectionWriter file;
  detail::SceneTables tables;
  std::optional<detail::ArchiveRows> rows;  // Profile::archive; batches fill their parts side by side
  std::uint64_t batch_rows = 0;
  std::uint64_t n_added = 0;  // batches
  Status status;              // of the first add() that failed; the file is then useless
};

struct SceneWriter::Batch::State {
  std::uint64_t first = 0, n = 0;  // of the batch
  std::uint64_t done = 0;          // Gaussians encoded
  std::vector<Splat> splats;       // of the next chunk
  std::vector<ChunkEntry> chunks;
  std::vector<ShStepSet> steps;
  ValueCounts counts;
  std::array<std::vector<std::byte>, kLarge.size()> rows, frames;
  std::array<std::uint64_t, kLarge.size()> frame_hashes{};
  std::optional<detail::FrameEncoder> encoder;
};

SceneWriter::SceneWriter(std::unique_ptr<State> state) : state_(std::move(state)) {}
SceneWriter::SceneWriter(SceneWriter&& other) noexcept = default;
SceneWriter::~SceneWriter() = default;

Result<SceneWriter> SceneWriter::create(Sink sink, const SceneScan& scan, const EncodeOptions& options,
                                        std::span<const std::uint32_t> source_index) {
  assert(source_index.size() == scan.n_kept());
  return detail::guard_memory([&]() -> Result<SceneWriter> {
    auto plan = detail::make_plan(scan, options);
    if (!plan) return tl::unexpected(plan.error());
    auto state = std::make_unique<State>(sink, std::move(*plan));
    const Header& h = state->plan.header;
    state->tables.source_index = source_index;
    if (state->plan.options.profile == Profile::direct) {
      state->batch_rows = std::max<std::uint64_t>(1, kDirectRows / h.chunk_size) * h.chunk_size;
      if (const Status s = sink.reserve(state->file.largest_file_bytes()); !s) return tl::unexpected(s.error());
    } else {
      state->batch_rows = state->plan.frame_rows();
    }
    if (state->plan.options.profile == Profile::archive) {
      auto rows = detail::ArchiveRows::create(sink, h.n_gaussians, h.sh_degree);
      if (!rows) return tl::unexpected(rows.error());
      state->rows = *std::move(rows);
    }
    return SceneWriter(std::move(state));
  });
}

std::uint64_t SceneWriter::n_batches() const {
  return (state_->plan.header.n_gaussians + state_->batch_rows - 1) / state_->batch_rows;
}

Status SceneWriter::add(const Batch& batch) {
  Status& status = state_->status;
  if (!status) return status;
  if (!batch.status_) return status = batch.status_;
  if (!batch.state_ || batch.writer_ != state_.get() || !batch.complete() ||
      batch.state_->first != state_->n_added * state_->batch_rows) {
    return status = make_error(Errc::bad_argument, Error::kNone, "not the next batch of this writer, or not complete");
  }
  ++state_->n_added;
  if (state_->plan.options.profile == Profile::archive) return {};
  const Batch::State& b = *batch.state_;
  detail::SceneTables& tables = state_->tables;
  const auto& bytes = state_->plan.options.profile == Profile::packed ? b.frames : b.rows;
  return status = detail::guard_memory([&]() -> Status {
           for (std::size_t k = 0; k < kLarge.size(); ++k) {
             if (Status s = state_->file.grow(kLarge[k], bytes[k], b.frame_hashes[k]); !s) return s;
           }
           tables.chunks.insert(tables.chunks.end(), b.chunks.begin(), b.chunks.end());
           tables.steps.insert(tables.steps.end(), b.steps.begin(), b.steps.end());
           tables.counts.add(b.counts);
           return {};
         });
}

Result<WrittenScene> SceneWriter::finish() {
  if (!state_->status) return tl::unexpected(state_->status.error());
  if (state_->n_added != n_batches()) {
    return make_error(Errc::bad_argument, Error::kNone, "batches are missing", n_batches(), state_->n_added);
  }
  return detail::guard_memory([&]() -> Result<WrittenScene> {
    if (state_->plan.options.profile == Profile::archive) {
      const auto splats = state_->rows->view();
      if (!splats) return tl::unexpected(splats.error());
      std::vector<std::byte> file;
      auto written = detail::write_archive(file, state_->plan, *splats, state_->tables.source_index);
      if (!written) return written;
      if (Status s = state_->rows->replace(file); !s) return tl::unexpected(s.error());
      return written;
    }
    if (!same_box(state_->tables.chunks, state_->plan.declarations.full))
      return tl::unexpected(detail::source_changed().error());
    return detail::finish_file(state_->file, state_->plan, state_->tables);
  });
}

SceneWriter::Batch::Batch(SceneWriter& writer) : writer_(writer.state_.get()) {}
SceneWriter::Batch::Batch(Batch&& other) noexcept = default;
SceneWriter::Batch::~Batch() = default;

void SceneWriter::Batch::begin(std::uint64_t index) {
  status_ = detail::guard_memory([&]() -> Status {
    const detail::EncodePlan& plan = writer_->plan;
    const Header& h = plan.header;
    if (!state_) state_ = std::make_unique<State>();
    State& b = *state_;
    if (plan.options.profile == Profile::packed && !b.encoder) b.encoder.emplace(plan.options.level);
    b.first = index * writer_->batch_rows;
    assert(b.first < h.n_gaussians);
    b.n = std::min(writer_->batch_rows, h.n_gaussians - b.first);
    b.done = 0;
    b.chunks.clear();
    b.steps.clear();
    b.counts = {};
    b.splats.resize(std::min<std::uint64_t>(h.chunk_size, b.n));
    if (plan.options.profile == Profile::archive) return {};
    b.rows[0].resize(b.n * kMeanBytes);
    b.rows[1].resize(b.n * kGeometryBytes);
    b.rows[2].resize(b.n * sh_bytes(h.sh_degree));
    return {};
  });
}

std::uint64_t SceneWriter::Batch::n_gaussians() const {
  return status_ && state_ ? state_->n : 0;
}

bool SceneWriter::Batch::complete() const {
  return !status_ || !state_ || state_->done == state_->n;
}

std::span<const std::uint32_t> SceneWriter::Batch::source_index() const {
  const State& b = *state_;
  return writer_->tables.source_index.subspan(b.first + b.done, std::min<std::uint64_t>(b.splats.size(), b.n - b.done));
}

std::span<Splat> SceneWriter::Batch::splats() {
  return std::span(state_->splats).first(source_index().size());
}

void SceneWriter::Batch::encode_chunk() {
  status_ = detail::guard_memory([&]() -> Status {
    State& b = *state_;
    const detail::EncodePlan& plan = writer_->plan;
    const int degree = plan.header.sh_degree;
    const std::span<Splat> chunk = splats();
    // The scan has seen or made every Gaussian sound. One that is not by now would make a file that no reader opens, or
    // cannot be quantised.
    for (Splat& s : chunk) {
      const std::uint32_t defects = find_defects(s, degree);
      if (defects != 0 && !(plan.mends && repair(s, defects))) return detail::source_changed();
    }
    if (plan.options.profile == Profile::archive) {
      const std::uint64_t first = b.first + b.done;
      b.done += chunk.size();
      return writer_->rows->set(first, chunk);
    }
    b.steps.push_back(plan.file_steps);
    if (plan.options.chunk_step_sets) {
      ShMagnitudes magnitudes;
      for (const Splat& s : chunk) magnitudes.add(s.sh, degree);
      b.steps.back() = magnitudes.steps();
    }
    b.chunks.push_back(detail::encode_rows(chunk, plan.header, b.steps.back(), &b.rows[0][b.done * kMeanBytes],
                                           &b.rows[1][b.done * kGeometryBytes], &b.rows[2][b.done * sh_bytes(degree)],
                                           b.counts));
    // A scale above the scan's largest overflows FP16.
    if (!std::isfinite(b.chunks.back().radius)) return detail::source_changed();
    b.done += chunk.size();
    if (!complete() || !b.encoder) return {};
    b.frames = {b.encoder->words(b.rows[0], kMeanBytes), b.encoder->geometry(b.rows[1]),
                b.encoder->sh(b.rows[2], {degree, plan.header.chunk_size, b.steps})};
    std::ranges::transform(b.frames, b.frame_hashes.begin(), [](const auto& frame) { return xxh3(frame); });
    return {};
  });
}

}  // namespace rgs
