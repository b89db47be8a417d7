// decode.cpp - Gaussians out of an opened file.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/decode.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstring>

#include "file/layout_io.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"

namespace rgs {
namespace {

// The codes of one Gaussian, aligned, with its chunk's steps.
struct Codes {
  float mean[3];
  std::uint16_t geometry[8];
  std::int8_t sh[48];
  float step[48];  // per coefficient and channel
  int floats;      // SH values in use
  int scale_exponent;
};

void read_sh(const Codes& codes, float* sh) {
  for (int i = 0; i < codes.floats; ++i) sh[i] = dequantize_sh(codes.sh[i], codes.step[i]);
  std::fill(sh + codes.floats, sh + 48, 0.f);
}

void convert(const Codes& codes, Splat& s) {
  std::ranges::copy(codes.mean, s.mean);
  // As stored, not normalised again: see kUnitNormTolerance.
  for (int i = 0; i < 4; ++i) s.rotation[i] = float_from_half(codes.geometry[i]);
  for (int i = 0; i < 3; ++i) {
    s.log_scale[i] =
        log_from_scale(dequantize_scale(codes.geometry[4 + i], codes.scale_exponent), codes.scale_exponent);
  }
  s.opacity_logit = logit_from_opacity(float_from_half(codes.geometry[7]));
  read_sh(codes, s.sh);
}

void convert(const Codes& codes, ActivatedSplat& s) {
  std::ranges::copy(codes.mean, s.mean);
  dequantize_rotation(codes.geometry, s.rotation);
  for (int i = 0; i < 3; ++i) s.scale[i] = dequantize_scale(codes.geometry[4 + i], codes.scale_exponent);
  s.opacity = float_from_half(codes.geometry[7]);
  read_sh(codes, s.sh);
}

// Decoded rows of the Gaussians first .. first + n - 1.
struct Rows {
  std::uint64_t first, n;
  std::span<const std::byte> means, geometry, sh;
};

template <class T>
Status read_rows(const FileView& view, const Rows& rows, std::uint64_t first, std::span<T> out) {
  assert(first >= rows.first && first - rows.first <= rows.n && out.size() <= rows.n - (first - rows.first));
  const Header& h = view.header();
  const std::uint64_t stride = sh_bytes(h.sh_degree);
  Codes codes{};
  codes.floats = 3 * sh_coefficients(h.sh_degree);
  codes.scale_exponent = h.scale_exponent;
  std::uint64_t loaded = ~std::uint64_t{0};  // chunk whose steps are in `codes`
  for (std::size_t k = 0; k < out.size(); ++k) {
    const std::uint64_t i = first + k, row = i - rows.first;
    if (i / h.chunk_size != loaded) {
      loaded = i / h.chunk_size;
      const auto steps = view.chunk_steps(loaded);
      if (!steps) return tl::unexpected(steps.error());
      for (int j = 0; j < codes.floats; ++j) codes.step[j] = steps->of_value(j);
    }
    std::memcpy(codes.mean, rows.means.data() + row * kMeanBytes, kMeanBytes);
    std::memcpy(codes.geometry, rows.geometry.data() + row * kGeometryBytes, kGeometryBytes);
    std::memcpy(codes.sh, rows.sh.data() + row * stride, static_cast<std::size_t>(codes.floats));
    convert(codes, out[k]);
  }
  return {};
}

template <class T>
Status read_file(const FileView& view, std::uint64_t first, std::span<T> out) {
  assert(first <= view.header().n_gaussians && out.size() <= view.header().n_gaussians - first);
  if (out.empty()) return {};
  if (!view.coded()) {
    return read_rows(view,
                     {0, view.header().n_gaussians, view.stored(SectionType::means), view.stored(SectionType::geometry),
                      view.stored(SectionType::sh)},
                     first, out);
  }
  const std::uint64_t chunk = first / view.header().chunk_size;
  const std::uint64_t last = (first + out.size() - 1) / view.header().chunk_size;
  const auto data = read_chunks(view, chunk, last - chunk + 1, {.validate = false, .threads = 1});
  if (!data) return tl::unexpected(data.error());
  return data->read(first, out);
}

}  // namespace

Result<ChunkEntry> FileView::chunk(std::uint64_t i) const {
  assert(i < header_.n_chunks);
  auto entry = detail::parse_chunk_entry(chunk_table().subspan(i * kChunkEntryBytes, kChunkEntryBytes),
                                         place(SectionType::chunks, i));
  if (!entry) return entry;
  const std::uint64_t expected =
      std::min<std::uint64_t>(header_.chunk_size, header_.n_gaussians - i * header_.chunk_size);
  if (entry->count != expected) {
    return make_error(Errc::bad_value, place(SectionType::chunks, i, 40), "a chunk's count contradicts the header",
                      expected, entry->count);
  }
  if (entry->step_set >= header_.n_step_sets) {
    return make_error(Errc::bad_value, place(SectionType::chunks, i, 32), "a chunk's scale set does not exist",
                      header_.n_step_sets, entry->step_set);
  }
  return entry;
}

Result<ShStepSet> FileView::step_set(std::uint64_t i) const {
  assert(i < header_.n_step_sets);
  const ShStepSet set = detail::parse_step_set(step_table().subspan(i * kStepSetBytes, kStepSetBytes));
  for (std::size_t degree = 0; degree < 4; ++degree) {
    for (std::size_t c = 0; c < 3; ++c) {
      const float step = set.step[degree][c];
      const bool used = degree <= header_.sh_degree;
      const bool legal = step == 0
                             ? !std::signbit(step)
                             : used && step >= kShStepMin && step <= kShStepMax && (detail::bits_of(step) & 0x7Fu) == 0;
      if (!legal) {
        return make_error(
            Errc::bad_value, place(SectionType::sh_steps, i, (degree * 3 + c) * 4),
            "an SH step is out of range, has more than 17 significant bits, or belongs to an absent degree");
      }
    }
  }
  return set;
}

Result<ShStepSet> FileView::chunk_steps(std::uint64_t i) const {
  return chunk(i).and_then([this](const ChunkEntry& entry) { return step_set(entry.step_set); });
}

std::uint64_t FileView::source_index(std::uint64_t i) const {
  const SectionEntry* entry = find(SectionType::permutation);
  if (entry == nullptr) return i;
  const bool wide = (declarations_.n_source >> 32) != 0;
  std::uint64_t index = 0;
  std::memcpy(&index, stored(*entry).data() + i * (wide ? 8 : 4), wide ? 8 : 4);
  return index;
}

Status FileView::read(std::uint64_t first, std::span<Splat> out) const {
  return preloaded_ ? preloaded_->read(first, out) : read_file(*this, first, out);
}

Status FileView::read(std::uint64_t first, std::span<ActivatedSplat> out) const {
  return preloaded_ ? preloaded_->read(first, out) : read_file(*this, first, out);
}

Status FileView::preload(const LoadOptions& options) {
  return detail::guard_memory([&]() -> Status {
    auto data = load_direct(*this, options);
    if (!data) return tl::unexpected(data.error());
    preloaded_ = std::make_shared<const DirectData>(std::move(*data));
    return {};
  });
}

Status DirectData::read(std::uint64_t first, std::span<Splat> out) const {
  return read_rows(view_, {first_, n_, means_, geometry_, sh_}, first, out);
}

Status DirectData::read(std::uint64_t first, std::span<ActivatedSplat> out) const {
  return read_rows(view_, {first_, n_, means_, geometry_, sh_}, first, out);
}

Result<SplatCloud> decode(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<SplatCloud> {
    const auto view = FileView::open(bytes, limits);
    if (!view) return tl::unexpected(view.error());
    const auto data = load_direct(*view);
    if (!data) return tl::unexpected(data.error());
    SplatCloud cloud;
    cloud.resize(view->header().n_gaussians, view->header().sh_degree);
    std::array<Splat, 256> buffer;
    for (std::uint64_t first = 0; first < cloud.size(); first += buffer.size()) {
      const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), cloud.size() - first));
      if (const Status s = data->read(first, part); !s) return tl::unexpected(s.error());
      for (std::size_t i = 0; i < part.size(); ++i) cloud.set(first + i, part[i]);
    }
    return cloud;
  });
}

}  // namespace rgs
