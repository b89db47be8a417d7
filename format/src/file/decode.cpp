// decode.cpp - reads Gaussians from an opened file.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/decode.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstring>

#include "file/layout_io.hpp"
#include "file/read_rows.hpp"
#include "file/value_checks.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"

namespace rgs {

namespace detail {

RowReader::RowReader(int sh_degree, int scale_exponent, const RowArrays& arrays)
    : arrays_(arrays),
      stride_(sh_bytes(sh_degree)),
      floats_(3 * sh_coefficients(sh_degree)),
      scale_exponent_(scale_exponent) {}

void RowReader::use(const ShStepSet& steps) {
  for (int i = 0; i < floats_; ++i) step_[i] = steps.of_value(i);
}

void RowReader::load(std::uint64_t row) {
  std::memcpy(mean_, arrays_.means.data() + row * kMeanBytes, kMeanBytes);
  std::memcpy(geometry_, arrays_.geometry.data() + row * kGeometryBytes, kGeometryBytes);
  std::memcpy(sh_, arrays_.sh.data() + row * stride_, static_cast<std::size_t>(floats_));
}

void RowReader::read_sh(float* sh) const {
  for (int i = 0; i < floats_; ++i) sh[i] = dequantize_sh(sh_[i], step_[i]);
  std::fill(sh + floats_, sh + 48, 0.f);
}

void RowReader::read(std::uint64_t row, Splat& s) {
  load(row);
  std::ranges::copy(mean_, s.mean);
  // Not normalised again: see kUnitNormTolerance.
  for (int i = 0; i < 4; ++i) s.rotation[i] = float_from_half(geometry_[i]);
  for (int i = 0; i < 3; ++i) {
    s.log_scale[i] = log_from_scale(dequantize_scale(geometry_[4 + i], scale_exponent_), scale_exponent_);
  }
  s.opacity_logit = logit_from_opacity(float_from_half(geometry_[7]));
  read_sh(s.sh);
}

void RowReader::read(std::uint64_t row, ActivatedSplat& s) {
  load(row);
  std::ranges::copy(mean_, s.mean);
  dequantize_rotation(geometry_, s.rotation);
  for (int i = 0; i < 3; ++i) s.scale[i] = dequantize_scale(geometry_[4 + i], scale_exponent_);
  s.opacity = float_from_half(geometry_[7]);
  read_sh(s.sh);
}

}  // namespace detail

namespace {

// Decoded rows of the Gaussians first .. first + n - 1.
struct Rows {
  std::uint64_t first, n;
  std::span<const std::byte> means, geometry, sh;
};

template <class T>
Status read_rows(const FileView& view, const Rows& rows, std::uint64_t first, std::span<T> out) {
  assert(first >= rows.first && first - rows.first <= rows.n && out.size() <= rows.n - (first - rows.first));
  const Header& h = view.header();
  detail::RowReader reader(h.sh_degree, h.scale_exponent, {rows.means, rows.geometry, rows.sh});
  std::uint64_t loaded = ~std::uint64_t{0};  // chunk of the current steps
  for (std::size_t k = 0; k < out.size(); ++k) {
    const std::uint64_t i = first + k;
    if (i / h.chunk_size != loaded) {
      loaded = i / h.chunk_size;
      const auto steps = view.chunk_steps(loaded);
      if (!steps) return tl::unexpected(steps.error());
      reader.use(*steps);
    }
    reader.read(i - rows.first, out[k]);
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

Status detail::check_step_set(const ShStepSet& set, int sh_degree, std::uint64_t offset, bool coded) {
  for (std::size_t degree = 0; degree < 4; ++degree) {
    for (std::size_t c = 0; c < 3; ++c) {
      const float step = set.step[degree][c];
      const bool used = static_cast<int>(degree) <= sh_degree;
      const bool legal = step == 0
                             ? !std::signbit(step)
                             : used && step >= kShStepMin && step <= kShStepMax && (detail::bits_of(step) & 0x7Fu) == 0;
      if (!legal) {
        return make_error(
            Errc::bad_value, offset + (coded ? 0 : (degree * 3 + c) * 4),
            "an SH step is out of range, has more than 17 significant bits, or belongs to an absent degree");
      }
    }
  }
  return {};
}

Result<ShStepSet> FileView::step_set(std::uint64_t i) const {
  assert(i < header_.n_step_sets);
  const ShStepSet set = detail::parse_step_set(step_table().subspan(i * kStepSetBytes, kStepSetBytes));
  const bool coded = frames(SectionType::sh_steps).rows != 0;
  const Status legal = detail::check_step_set(set, header_.sh_degree, place(SectionType::sh_steps, i), coded);
  if (!legal) return tl::unexpected(legal.error());
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

// Makes all checks of validate(), and returns the leaves.
static Result<SplatCloud> decode_levels(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto file = PagedFile::open(bytes, limits);
  if (!file) return tl::unexpected(file.error());
  if (const Status s = validate(*file); !s) return tl::unexpected(s.error());
  if (!file->complete()) {
    return make_error(Errc::pages_missing, bytes.size(),
                      "the end of the file is missing, and with it some of the scene's own Gaussians");
  }
  return read_pages(*file, lod::pages_of_level(file->pages(), 0), {.validate = false});
}

Result<SplatCloud> decode(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<SplatCloud> {
    if (has_levels(bytes)) return decode_levels(bytes, limits);
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
