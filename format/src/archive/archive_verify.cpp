// archive_verify.cpp - checks a file of Codec::archive against its source and the bounds that it states.
// SPDX-License-Identifier: Apache-2.0
#include "archive/archive_encode.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstring>
#include <limits>

#include "archive/archive_codec.hpp"
#include "archive/archive_errors.hpp"
#include "file/layout_io.hpp"
#include "file/workers.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

// Angle between two rotations, accurate for small ones: 2 asin of half the chord, for the nearer of q and -q.
double rotation_angle(const double a[4], const double b[4]) {
  double dot = 0, minus = 0, plus = 0;
  for (int i = 0; i < 4; ++i) {
    dot += a[i] * b[i];
    minus += (a[i] - b[i]) * (a[i] - b[i]);
    plus += (a[i] + b[i]) * (a[i] + b[i]);
  }
  return 4 * std::asin(std::min(1.0, std::sqrt(dot < 0 ? plus : minus) / 2));
}

template <class T>
void unit(const T in[4], double out[4]) {
  double length = 0;
  for (int i = 0; i < 4; ++i) length += static_cast<double>(in[i]) * static_cast<double>(in[i]);
  length = std::sqrt(length);
  for (int i = 0; i < 4; ++i) out[i] = static_cast<double>(in[i]) / length;
}

float rounded_up(double value) {
  const auto nearest = static_cast<float>(value);
  return static_cast<double>(nearest) >= value ? nearest
                                               : std::nextafter(nearest, std::numeric_limits<float>::infinity());
}

}  // namespace

SplatErrors splat_errors(const ArchiveParameters& p, int scale_exponent, int sh_degree, const Splat& source,
                         const StoredSplat& stored, const float* sh_slack) {
  SplatErrors e;
  for (std::size_t k = 0; k < 3; ++k) {
    const double x = static_cast<double>(stored.mean[k]);
    const double reach = std::max(p.half_width[k], std::abs(x - p.centre[k]));
    e.mean = std::max(e.mean, std::abs(x - static_cast<double>(source.mean[k])) / reach);
  }
  const double opacity = 1 / (1 + std::exp(-static_cast<double>(source.opacity_logit)));
  e.opacity = std::abs(static_cast<double>(float_from_half(stored.geometry[7])) - opacity);
  float components[4];
  for (int k = 0; k < 4; ++k) components[k] = float_from_half(stored.geometry[k]);
  double a[4], b[4];
  unit(source.rotation, a);
  unit(components, b);
  e.rotation = rotation_angle(a, b);
  for (std::size_t k = 0; k < 3; ++k) {
    const std::uint16_t code = stored.geometry[4 + k];
    if (code < 0x0400) continue;  // subnormal: the layout's own limit
    const double scale = static_cast<double>(dequantize_scale(code, scale_exponent));
    e.scale = std::max(e.scale, std::abs(std::log(scale) - static_cast<double>(source.log_scale[k])));
  }
  for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) {
    const double slack = sh_slack == nullptr ? 0 : static_cast<double>(sh_slack[k]);
    const double error = std::abs(static_cast<double>(stored.sh[k]) - static_cast<double>(source.sh[k])) - slack;
    double& largest = k < 3 ? e.dc : e.sh;
    largest = std::max(largest, error);
  }
  return e;
}

void ErrorMaxima::add(std::size_t class_index, const SplatErrors& e) {
  SplatErrors& c = by_class_[class_index];
  mean_ = std::max(mean_, e.mean);
  opacity_ = std::max(opacity_, e.opacity);
  c.rotation = std::max(c.rotation, e.rotation);
  c.scale = std::max(c.scale, e.scale);
  c.dc = std::max(c.dc, e.dc);
  c.sh = std::max(c.sh, e.sh);
}

void ErrorMaxima::merge(const ErrorMaxima& other) {
  for (std::size_t c = 0; c < by_class_.size(); ++c) {
    add(c, other.by_class_[c]);
  }
  mean_ = std::max(mean_, other.mean_);
  opacity_ = std::max(opacity_, other.opacity_);
}

void ErrorMaxima::state(ArchiveParameters& p) const {
  p.bound_mean = rounded_up(mean_);
  p.bound_opacity = rounded_up(opacity_);
  for (std::size_t c = 0; c < by_class_.size(); ++c) {
    p.classes[c].bound_rotation = rounded_up(by_class_[c].rotation);
    p.classes[c].bound_scale = rounded_up(by_class_[c].scale);
    p.classes[c].bound_dc = rounded_up(by_class_[c].dc);
    p.classes[c].bound_sh = rounded_up(by_class_[c].sh);
  }
}

bool within_bounds(const ArchiveParameters& p, std::size_t class_index, const SplatErrors& e) {
  const ArchiveClass& c = p.classes[class_index];
  const auto holds = [](double error, float bound) { return error <= static_cast<double>(bound); };
  return holds(e.mean, p.bound_mean) && holds(e.opacity, p.bound_opacity) && holds(e.rotation, c.bound_rotation) &&
         holds(e.scale, c.bound_scale) && holds(e.dc, c.bound_dc) && holds(e.sh, c.bound_sh);
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

// Verifies frame `index` of `data`, the whole file.
Status verify_frame(const DirectData& data, const SplatView& splats, std::span<const std::uint32_t> order,
                    std::uint64_t index, ArchiveDecoder& decoder) {
  const FileView& view = data.file();
  const Header& h = view.header();
  const FrameTable& frames = view.frames(SectionType::geometry);
  const CodedFrame& frame = frames.frames[index];
  const std::uint64_t first = index * frames.rows, end = std::min(h.n_gaussians, first + frames.rows);
  const auto stored_bytes = view.bytes().subspan(frame.offset, frame.stored_bytes);
  if (Status s = decoder.geometry_codes(stored_bytes, frame.offset, end - first); !s) return s;
  float step[48] = {}, slack[48] = {};
  std::uint64_t loaded = ~std::uint64_t{0};  // chunk of the current steps
  for (std::uint64_t i = first; i < end; ++i) {
    if (i / h.chunk_size != loaded) {
      loaded = i / h.chunk_size;
      const auto steps = view.chunk_steps(loaded);
      if (!steps) return tl::unexpected(steps.error());
      for (int k = 0; k < 3 * sh_coefficients(h.sh_degree); ++k) {
        step[k] = steps->of_value(k);
        slack[k] = sh_slack(step[k]);
      }
    }
    const StoredSplat stored = stored_splat(data.means(), data.geometry(), data.sh(), i, h.sh_degree, step);
    const Splat source = splats.splat(order[i]);
    const auto errors = splat_errors(*view.archive(), h.scale_exponent, h.sh_degree, source, stored, slack);
    if (!within_bounds(*view.archive(), decoder.codes().classes[i - first], errors)) {
      return outside(i);
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
  ByteReader in(stored_bytes);
  const std::uint32_t mean_bytes = in.u32(), geometry_bytes = in.u32();
  if (Status s = decoder.geometry_codes(stored_bytes.subspan(8 + mean_bytes, geometry_bytes), 0, rows->n); !s) return s;
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
    const auto errors =
        splat_errors(*head.archive(), rows->scale_exponent, h.sh_degree, splats.splat(order[index]), stored, slack);
    if (!within_bounds(*head.archive(), decoder.codes().classes[i], errors)) return outside(index);
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
  const auto data = load_direct(*view, {.validate = true, .threads = threads});
  if (!data) return tl::unexpected(data.error());
  const std::uint64_t n_frames = view->frames(SectionType::geometry).frames.size();
  std::vector<ArchiveDecoder> decoders;
  for (unsigned i = worker_count(n_frames, threads); i > 0; --i) {
    decoders.emplace_back(*archive_tables(*view));
  }
  return run_jobs(n_frames, threads, [&](unsigned worker, std::uint64_t index) {
    return verify_frame(*data, splats, order, index, decoders[worker]);
  });
}

}  // namespace rgs::detail
