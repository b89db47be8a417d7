// decode.cpp - Gaussians out of an opened file.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/decode.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstring>

#include "layout_io.hpp"
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

}  // namespace

Result<ChunkEntry> FileView::chunk(std::uint64_t i) const {
  assert(i < header_.n_chunks);
  const SectionEntry& table = *find(SectionType::chunks);
  const std::uint64_t at = i * kChunkEntryBytes;
  auto entry = detail::parse_chunk_entry(stored(table).subspan(at, kChunkEntryBytes), table.offset + at);
  if (!entry) return entry;
  const std::uint64_t expected =
      std::min<std::uint64_t>(header_.chunk_size, header_.n_gaussians - i * header_.chunk_size);
  if (entry->count != expected) {
    return fail(Errc::bad_value, table.offset + at + 40, "a chunk's count contradicts the header", expected,
                entry->count);
  }
  if (entry->scale_set >= header_.n_scale_sets) {
    return fail(Errc::bad_value, table.offset + at + 32, "a chunk's scale set does not exist", header_.n_scale_sets,
                entry->scale_set);
  }
  return entry;
}

Result<ScaleSet> FileView::scale_set(std::uint64_t i) const {
  assert(i < header_.n_scale_sets);
  const SectionEntry& table = *find(SectionType::sh_scales);
  const std::uint64_t at = i * kScaleSetBytes;
  const ScaleSet set = detail::parse_scale_set(stored(table).subspan(at, kScaleSetBytes));
  for (std::size_t degree = 0; degree < 4; ++degree) {
    for (std::size_t c = 0; c < 3; ++c) {
      const float step = set.step[degree][c];
      const bool used = degree <= header_.sh_degree;
      const bool legal = step == 0
                             ? !std::signbit(step)
                             : used && step >= kShStepMin && step <= kShStepMax && (detail::bits_of(step) & 0x7Fu) == 0;
      if (!legal) {
        return fail(Errc::bad_value, table.offset + at + (degree * 3 + c) * 4,
                    "an SH step is out of range, has more than 17 significant bits, or belongs to an absent degree");
      }
    }
  }
  return set;
}

std::uint64_t FileView::source_index(std::uint64_t i) const {
  const SectionEntry* entry = find(SectionType::permutation);
  if (entry == nullptr) return i;
  const bool wide = (declarations_.n_source >> 32) != 0;
  std::uint64_t index = 0;
  std::memcpy(&index, stored(*entry).data() + i * (wide ? 8 : 4), wide ? 8 : 4);
  return index;
}

template <class T, class Convert>
Status FileView::read_as(std::uint64_t first, std::span<T> out, Convert convert) const {
  assert(first <= header_.n_gaussians && out.size() <= header_.n_gaussians - first);
  const std::byte* means = stored(SectionType::means).data();
  const std::byte* geometry = stored(SectionType::geometry).data();
  const std::byte* sh = stored(SectionType::sh).data();
  const std::uint64_t stride = sh_bytes(header_.sh_degree);
  Codes codes{};
  codes.floats = 3 * sh_coefficients(header_.sh_degree);
  codes.scale_exponent = header_.scale_exponent;
  std::uint64_t loaded = ~std::uint64_t{0};  // chunk whose steps are in `codes`
  for (std::size_t k = 0; k < out.size(); ++k) {
    const std::uint64_t i = first + k;
    if (i / header_.chunk_size != loaded) {
      loaded = i / header_.chunk_size;
      const auto entry = chunk(loaded);
      if (!entry) return tl::unexpected(entry.error());
      const auto set = scale_set(entry->scale_set);
      if (!set) return tl::unexpected(set.error());
      for (int j = 0; j < codes.floats; ++j) codes.step[j] = set->step[sh_degree_of(j / 3)][j % 3];
    }
    std::memcpy(codes.mean, means + i * kMeanBytes, kMeanBytes);
    std::memcpy(codes.geometry, geometry + i * kGeometryBytes, kGeometryBytes);
    std::memcpy(codes.sh, sh + i * stride, static_cast<std::size_t>(codes.floats));
    convert(codes, out[k]);
  }
  return {};
}

Status FileView::read(std::uint64_t first, std::span<Splat> out) const {
  return read_as(first, out, [](const Codes& codes, Splat& s) {
    std::ranges::copy(codes.mean, s.mean);
    // As stored, not normalised again: see kUnitNormTolerance.
    for (int i = 0; i < 4; ++i) s.rotation[i] = float_from_half(codes.geometry[i]);
    for (int i = 0; i < 3; ++i) {
      s.log_scale[i] =
          log_from_scale(dequantize_scale(codes.geometry[4 + i], codes.scale_exponent), codes.scale_exponent);
    }
    s.opacity_logit = logit_from_opacity(float_from_half(codes.geometry[7]));
    read_sh(codes, s.sh);
  });
}

Status FileView::read(std::uint64_t first, std::span<ActivatedSplat> out) const {
  return read_as(first, out, [](const Codes& codes, ActivatedSplat& s) {
    std::ranges::copy(codes.mean, s.mean);
    dequantize_rotation(codes.geometry, s.rotation);
    for (int i = 0; i < 3; ++i) s.scale[i] = dequantize_scale(codes.geometry[4 + i], codes.scale_exponent);
    s.opacity = float_from_half(codes.geometry[7]);
    read_sh(codes, s.sh);
  });
}

Result<SplatCloud> decode(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const auto view = open(bytes, limits);
  if (!view) return tl::unexpected(view.error());
  if (const Status s = validate(*view); !s) return tl::unexpected(s.error());
  SplatCloud cloud;
  cloud.resize(view->header().n_gaussians, view->header().sh_degree);
  std::vector<Splat> buffer(std::min<std::uint64_t>(cloud.size(), 256));
  for (std::uint64_t first = 0; first < cloud.size(); first += buffer.size()) {
    const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), cloud.size() - first));
    if (const Status s = view->read(first, part); !s) return tl::unexpected(s.error());
    for (std::size_t i = 0; i < part.size(); ++i) cloud.set(first + i, part[i]);
  }
  return cloud;
}

}  // namespace rgs
