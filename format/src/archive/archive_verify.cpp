// archive_verify.cpp - checks a file of Codec::archive against its source and the bounds that it states.
// SPDX-License-Identifier: Apache-2.0
#include "archive/archive_encode.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstring>
#include <limits>

#include "archive/archive_codec.hpp"
#include "archive/archive_errors.hpp"
#include "file/layout_io.hpp"
#include "file/value_checks.hpp"
#include "file/workers.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/decode.hpp"
#include "rgs/frame_content.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

using Matrix = std::array<std::array<double, 3>, 3>;

// Of a quaternion that need not be normalised.
Matrix rotation_matrix(const double q[4]) {
  double squared = 0;
  for (int k = 0; k < 4; ++k) squared += q[k] * q[k];
  const double u = 2 / squared, w = q[0], x = q[1], y = q[2], z = q[3];
  return {{{1 - u * (y * y + z * z), u * (x * y - w * z), u * (x * z + w * y)},
           {u * (x * y + w * z), 1 - u * (x * x + z * z), u * (y * z - w * x)},
           {u * (x * z - w * y), u * (y * z + w * x), 1 - u * (x * x + y * y)}}};
}

constexpr std::array kErrors = {&SplatErrors::mean, &SplatErrors::covariance, &SplatErrors::opacity, &SplatErrors::dc,
                                &SplatErrors::sh};

float rounded_up(double value) {
  const auto nearest = static_cast<float>(value);
  return static_cast<double>(nearest) >= value ? nearest
                                               : std::nextafter(nearest, std::numeric_limits<float>::infinity());
}

}  // namespace

SplatErrors splat_errors(const ArchiveParameters& p, int scale_exponent, int level, int sh_degree, const Splat& source,
                         const StoredSplat& stored, const float* sh_slack) {
  SplatErrors e;
  double q[4], of_source[4], scale[3], scale_of_source[3], error[3], distance = 0;
  for (int k = 0; k < 4; ++k) {
    q[k] = static_cast<double>(float_from_half(stored.geometry[k]));
    of_source[k] = static_cast<double>(source.rotation[k]);
  }
  for (std::size_t k = 0; k < 3; ++k) {
    scale[k] = static_cast<double>(dequantize_scale(stored.geometry[4 + k], scale_exponent));
    scale_of_source[k] = std::exp(static_cast<double>(source.log_scale[k]));
    const double x = static_cast<double>(stored.mean[k]), d = x - p.centre[k];
    error[k] = x - static_cast<double>(source.mean[k]);
    distance += d * d;
  }
  const double blur = std::exp2(2.0 * p.shape.blur / kOctave + 2 * level) * std::max(distance, p.shape.nearest);
  const Matrix axes = rotation_matrix(q), source_axes = rotation_matrix(of_source);
  // The blur leaves the Gaussian its axes, along which A only scales: nothing cancels, however long and thin it is.
  double unit[3];
  Matrix root{};  // A times a root of the source's covariance
  for (std::size_t i = 0; i < 3; ++i) {
    unit[i] = 1 / std::sqrt(scale[i] * scale[i] + blur);
    double moved = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      moved += axes[k][i] * error[k];
      for (std::size_t j = 0; j < 3; ++j) root[i][j] += unit[i] * axes[k][i] * source_axes[k][j] * scale_of_source[j];
    }
    e.mean += moved * unit[i] * (moved * unit[i]);
  }
  e.mean = std::sqrt(e.mean);
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      double change = i == j ? scale[i] * unit[i] * (scale[i] * unit[i]) : 0;
      for (std::size_t k = 0; k < 3; ++k) change -= root[i][k] * root[j][k];
      e.covariance += change * change;
    }
  }
  e.covariance = std::sqrt(e.covariance);
  const double opacity = 1 / (1 + std::exp(-static_cast<double>(source.opacity_logit)));
  e.opacity = std::abs(std::sqrt(static_cast<double>(float_from_half(stored.geometry[7]))) - std::sqrt(opacity));
  for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) {
    const double slack = sh_slack == nullptr ? 0 : static_cast<double>(sh_slack[k]);
    const double of_sh = std::abs(static_cast<double>(stored.sh[k]) - static_cast<double>(source.sh[k])) - slack;
    double& largest = k < 3 ? e.dc : e.sh;
    largest = std::max(largest, of_sh);
  }
  return e;
}

void ErrorMaxima::add(std::size_t class_index, const SplatErrors& e) {
  SplatErrors& c = by_class_[class_index];
  for (double SplatErrors::*error : kErrors) c.*error = std::max(c.*error, e.*error);
}

void ErrorMaxima::merge(const ErrorMaxima& other) {
  for (std::size_t c = 0; c < by_class_.size(); ++c) add(c, other.by_class_[c]);
}

void ErrorMaxima::state(ArchiveParameters& p) const {
  double opacity = 0;
  for (std::size_t c = 0; c < by_class_.size(); ++c) {
    const SplatErrors& e = by_class_[c];
    opacity = std::max(opacity, e.opacity);
    p.classes[c].bound_mean = rounded_up(e.mean);
    p.classes[c].bound_covariance = rounded_up(e.covariance);
    p.classes[c].bound_dc = rounded_up(e.dc);
    p.classes[c].bound_sh = rounded_up(e.sh);
  }
  p.bound_opacity = rounded_up(opacity);
}

bool within_bounds(const ArchiveParameters& p, std::size_t class_index, const SplatErrors& e) {
  const ArchiveClass& c = p.classes[class_index];
  const auto holds = [](double error, float bound) { return error <= static_cast<double>(bound); };
  return holds(e.mean, c.bound_mean) && holds(e.covariance, c.bound_covariance) && holds(e.opacity, p.bound_opacity) &&
         holds(e.dc, c.bound_dc) && holds(e.sh, c.bound_sh);
}

namespace {

// Half a step, rounding of the coded value, and values too small for any step.
float sh_slack(float step) {
  return step * (0.5f + 0x1p-16f) + kShFlush;
}

// Decoded row `row`, with the steps of its chunk.
StoredSplat stored_splat(std::span<const std::byte> means, std::span<const std::byte> geometry,
                         std::span<const std::byte> sh, std::uint64_t row, int sh_degree, const float step[48]) {
  StoredSplat stored{};
  std::memcpy(stored.mean, means.data() + row * kMeanBytes, kMeanBytes);
  std::memcpy(stored.geometry, geometry.data() + row * kGeometryBytes, kGeometryBytes);
  const auto* codes = reinterpret_cast<const std::int8_t*>(sh.data() + row * sh_bytes(sh_degree));
  for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) stored.sh[k] = dequantize_sh(codes[k], step[k]);
  return stored;
}

Status outside(std::uint64_t index) {
  return make_error(Errc::internal, index, "a decoded Gaussian is outside the bounds that its archive states");
}

// What a thread needs to verify one frame at a time.
struct FrameVerifier {
  explicit FrameVerifier(const FileView& view) : decoder(*archive_tables(view)) {}
  ArchiveDecoder decoder;
  std::vector<std::byte> means, geometry, sh;
  std::vector<ShStepSet> steps;  // of the frame's chunks
  ValueTotals totals;            // of all its frames
};

// Decodes and verifies frame `index` of the file.
Status verify_frame(const FileView& view, const SplatView& splats, std::span<const std::uint32_t> order,
                    std::uint64_t index, FrameVerifier& v) {
  const Header& h = view.header();
  const std::uint64_t rows = view.frames(SectionType::geometry).rows;
  const std::uint64_t first = index * rows, n = std::min(h.n_gaussians - first, rows);
  FrameStreams streams;
  for (const auto& [type, stream] : {std::pair(SectionType::means, &streams.means),
                                     {SectionType::geometry, &streams.geometry},
                                     {SectionType::sh, &streams.sh}}) {
    const CodedFrame& frame = view.frames(type).frames[index];
    const auto bytes = frame_bytes(view, frame);
    if (!bytes) return tl::unexpected(bytes.error());
    *stream = {*bytes, frame.offset};
  }
  const std::uint64_t first_chunk = first / h.chunk_size, n_chunks = chunks_of(n, h.chunk_size);
  if (Status s = frame_steps(view, first_chunk, n_chunks, v.steps); !s) return s;
  if (Status s = v.decoder.codes(streams, n); !s) return s;
  v.means.resize(n * kMeanBytes);
  v.geometry.resize(n * kGeometryBytes);
  v.sh.resize(n * sh_bytes(h.sh_degree));
  v.decoder.rows(h.scale_exponent, v.means, v.geometry);
  v.decoder.sh(h.sh_degree, h.chunk_size, v.steps, v.sh);
  for (std::uint64_t chunk = 0; chunk < n_chunks; ++chunk) {
    const auto entry = view.chunk(first_chunk + chunk);
    if (!entry) return tl::unexpected(entry.error());
    const std::uint64_t at = chunk * h.chunk_size, end = std::min<std::uint64_t>(n, at + h.chunk_size);
    const auto place = [&](SectionType type, std::uint64_t i, std::uint64_t byte) {
      return view.place(type, type == SectionType::chunks ? first_chunk + chunk : first + at + i, byte);
    };
    const ChunkRows decoded{&v.means[at * kMeanBytes],
                            &v.geometry[at * kGeometryBytes],
                            &v.sh[at * sh_bytes(h.sh_degree)],
                            h.sh_degree,
                            h.scale_exponent,
                            place};
    if (Status s = check_chunk_rows(decoded, *entry, v.steps[chunk], v.totals); !s) return s;
    float step[48] = {}, slack[48] = {};
    for (int k = 0; k < 3 * sh_coefficients(h.sh_degree); ++k) {
      step[k] = v.steps[chunk].of_value(k);
      slack[k] = sh_slack(step[k]);
    }
    for (std::uint64_t i = at; i < end; ++i) {
      const StoredSplat stored = stored_splat(v.means, v.geometry, v.sh, i, h.sh_degree, step);
      const auto errors = splat_errors(*view.archive(), h.scale_exponent, 0, h.sh_degree,
                                       splats.splat(order[first + i]), stored, slack);
      if (!within_bounds(*view.archive(), v.decoder.classes()[i], errors)) return outside(first + i);
    }
  }
  return {};
}

Status verify_page(const PagedFile& file, const SplatView& splats, std::span<const std::uint32_t> order,
                   std::uint32_t page, PageDecoder& pages, ArchiveDecoder& decoder, std::vector<std::byte>& memory) {
  const FileView& head = file.head();
  const Header& h = head.header();
  const auto stored_bytes = file.bytes(page);
  memory.resize(file.decoded_bytes(page));
  const auto rows = pages.decode(page, stored_bytes, memory);
  if (!rows) return tl::unexpected(rows.error());
  if (Status s = check_page_values(file, page, *rows); !s) return s;
  const auto level = static_cast<int>(file.pages()[page].level);
  if (Status s = decoder.codes({{stored_bytes, 0}, {}, {}, true}, rows->n, level, file.stored(page).corner); !s)
    return s;
  float step[48] = {}, slack[48] = {};
  for (std::uint32_t i = 0; i < rows->n; ++i) {
    if (i % h.chunk_size == 0) {
      const ShStepSet steps = parse_step_set(rows->steps.subspan(i / h.chunk_size * kStepSetBytes, kStepSetBytes));
      for (int k = 0; k < 3 * sh_coefficients(h.sh_degree); ++k) {
        step[k] = steps.of_value(k);
        slack[k] = sh_slack(step[k]);
      }
    }
    const StoredSplat stored = stored_splat(rows->means, rows->geometry, rows->sh, i, h.sh_degree, step);
    const std::uint64_t index = file.pages()[page].first + i;
    const auto errors = splat_errors(*head.archive(), rows->scale_exponent, level, h.sh_degree,
                                     splats.splat(order[index]), stored, slack);
    if (!within_bounds(*head.archive(), decoder.classes()[i], errors)) return outside(index);
  }
  return {};
}

}  // namespace

Status verify_archive_levels(std::span<const std::byte> bytes, const SplatView& splats,
                             std::span<const std::uint32_t> order, unsigned threads) {
  assert(order.size() == splats.n);
  const auto file = PagedFile::open(bytes);
  if (!file) return tl::unexpected(file.error());
  if (file->head().archive() == nullptr || file->n_stored() != splats.n) {
    return make_error(Errc::internal, Error::kNone, "not an archive of these Gaussians");
  }
  std::vector<ArchiveDecoder> decoders;
  std::vector<PageDecoder> pages;
  const unsigned n_workers = worker_count(file->n_pages(), threads);
  for (unsigned i = 0; i < n_workers; ++i) {
    decoders.emplace_back(*archive_tables(file->head()));
    pages.emplace_back(*file);
  }
  std::vector<std::vector<std::byte>> memory(n_workers);
  return run_jobs(file->n_pages(), threads, [&](unsigned worker, std::uint64_t page) {
    return verify_page(*file, splats, order, static_cast<std::uint32_t>(page), pages[worker], decoders[worker],
                       memory[worker]);
  });
}

Status verify_archive(std::span<const std::byte> file, const SplatView& splats, std::span<const std::uint32_t> order,
                      unsigned threads) {
  assert(order.size() == splats.n);
  const auto view = FileView::open(file);
  if (!view) return tl::unexpected(view.error());
  if (view->archive() == nullptr || view->header().n_gaussians != splats.n) {
    return make_error(Errc::internal, Error::kNone, "not an archive of these Gaussians");
  }
  if (Status s = validate_tables(*view, threads); !s) return s;
  const std::uint64_t n_frames = view->frames(SectionType::geometry).frames.size();
  std::vector<FrameVerifier> verifiers;
  for (unsigned i = worker_count(n_frames, threads); i > 0; --i) verifiers.emplace_back(*view);
  const Status verified = run_jobs(n_frames, threads, [&](unsigned worker, std::uint64_t index) {
    return verify_frame(*view, splats, order, index, verifiers[worker]);
  });
  if (!verified) return verified;
  ValueTotals totals;
  for (const FrameVerifier& v : verifiers) totals.add(v.totals);
  return check_declarations(*view, totals);
}

}  // namespace rgs::detail
