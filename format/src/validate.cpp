// validate.cpp - the payload of a file against its specification.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstring>

#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/quantize.hpp"

namespace rgs {
namespace {

// Stored quaternions have a squared norm within 2^-8 of 1: twice what the encoder lets through unnormalised.
constexpr double kNormTolerance = 0x1p-8;

Status check_geometry(const std::uint16_t codes[8], std::uint64_t offset, EncodeCounts& counts,
                      std::uint16_t& largest_scale, std::uint16_t& largest_opacity) {
  double squared = 0;  // exact: squares of FP16 numbers and their sums fit into 53 bits
  for (int i = 0; i < 4; ++i) {
    const double component = static_cast<double>(float_from_half(codes[i]));
    squared += component * component;
  }
  if (!(std::abs(squared - 1.0) <= kNormTolerance)) {
    return fail(Errc::bad_value, offset, "a rotation is not a unit quaternion");
  }
  if ((codes[0] & 0x8000u) != 0) return fail(Errc::bad_value, offset, "a rotation's w has its sign bit set");
  for (int i = 4; i < 7; ++i) {
    if (codes[i] >= 0x7C00u) {
      return fail(Errc::bad_value, offset + 2 * static_cast<std::uint64_t>(i), "a scale is negative or not finite");
    }
    counts.scale_zero += codes[i] == 0;
    counts.scale_subnormal += codes[i] != 0 && codes[i] < 0x0400;
    largest_scale = std::max(largest_scale, codes[i]);
  }
  if (codes[7] > 0x3C00u) return fail(Errc::bad_value, offset + 14, "an opacity is not between 0 and 1");
  counts.opacity_zero += codes[7] == 0;
  counts.opacity_one += codes[7] == 0x3C00u;
  largest_opacity = std::max(largest_opacity, codes[7]);
  return {};
}

Status check_sh(const std::int8_t* codes, std::uint64_t offset, const ScaleSet& steps, int degree) {
  const int floats = 3 * sh_coefficients(degree);
  for (int i = 0; i < floats; ++i) {
    if (codes[i] == -128) {
      return fail(Errc::bad_value, offset + static_cast<std::uint64_t>(i), "an SH code is -128, which is not used");
    }
    if (codes[i] != 0 && steps.step[sh_degree_of(i / 3)][i % 3] == 0) {
      return fail(Errc::bad_value, offset + static_cast<std::uint64_t>(i), "an SH code is not 0 though its step is 0");
    }
  }
  for (int i = floats; i < static_cast<int>(sh_bytes(degree)); ++i) {
    if (codes[i] != 0) {
      return fail(Errc::reserved_bits, offset + static_cast<std::uint64_t>(i), "SH padding is not zero");
    }
  }
  return {};
}

Status check_chunk(const FileView& view, std::uint64_t index, EncodeCounts& counts) {
  const auto entry = view.chunk(index);
  if (!entry) return tl::unexpected(entry.error());
  const auto steps = view.scale_set(entry->scale_set);
  if (!steps) return tl::unexpected(steps.error());

  const Header& h = view.header();
  const std::uint64_t first = index * h.chunk_size;
  const SectionEntry& means = *view.find(SectionType::means);
  const SectionEntry& geometry = *view.find(SectionType::geometry);
  const SectionEntry& sh = *view.find(SectionType::sh);
  Box box;
  std::uint16_t largest_scale = 0, largest_opacity = 0;
  for (std::uint64_t i = first; i < first + entry->count; ++i) {
    float mean[3];
    std::memcpy(mean, view.stored(means).data() + i * kMeanBytes, kMeanBytes);
    for (std::size_t k = 0; k < 3; ++k) {
      if (!std::isfinite(mean[k])) {
        return fail(Errc::bad_value, means.offset + i * kMeanBytes + 4 * k, "a mean is not finite");
      }
      box.min[k] = i == first ? mean[k] : std::min(box.min[k], mean[k]);
      box.max[k] = i == first ? mean[k] : std::max(box.max[k], mean[k]);
    }
    std::uint16_t codes[8];
    std::memcpy(codes, view.stored(geometry).data() + i * kGeometryBytes, kGeometryBytes);
    const std::uint64_t geometry_at = geometry.offset + i * kGeometryBytes;
    if (const Status s = check_geometry(codes, geometry_at, counts, largest_scale, largest_opacity); !s) return s;
    const std::uint64_t sh_at = i * sh_bytes(h.sh_degree);
    const auto* sh_codes = reinterpret_cast<const std::int8_t*>(view.stored(sh).data() + sh_at);
    if (const Status s = check_sh(sh_codes, sh.offset + sh_at, *steps, h.sh_degree); !s) return s;
  }

  const std::uint64_t at = view.find(SectionType::chunks)->offset + index * kChunkEntryBytes;
  if (box.min != entry->means.min || box.max != entry->means.max) {
    return fail(Errc::bad_value, at, "a chunk's box is not that of its means");
  }
  if (entry->radius != 3.f * dequantize_scale(largest_scale, h.scale_exponent)) {
    return fail(Errc::bad_value, at + 12, "a chunk's radius is not three times its largest scale");
  }
  if (entry->max_opacity != float_from_half(largest_opacity)) {
    return fail(Errc::bad_value, at + 28, "a chunk's largest opacity is not that of its Gaussians");
  }
  return {};
}

Status check_permutation(const FileView& view) {
  const SectionEntry* entry = view.find(SectionType::permutation);
  if (entry == nullptr) return {};
  const std::uint64_t n = view.header().n_gaussians;
  std::vector<std::uint64_t> indices(n);
  const std::uint64_t entry_bytes = n == 0 ? 0 : entry->stored_bytes / n;
  const std::uint64_t n_source = view.declarations().n_source;
  for (std::uint64_t i = 0; i < n; ++i) {
    indices[i] = view.source_index(i);
    if (indices[i] >= n_source) {
      return fail(Errc::bad_value, entry->offset + i * entry_bytes,
                  "the permutation names a Gaussian beyond the source", n_source, indices[i]);
    }
  }
  std::ranges::sort(indices);
  if (std::ranges::adjacent_find(indices) != indices.end()) {
    return fail(Errc::bad_value, entry->offset, "the permutation names a source Gaussian twice");
  }
  return {};
}

}  // namespace

Status validate(const FileView& view) {
  for (const SectionEntry& s : view.sections()) {
    const std::uint64_t hash = xxh3(view.stored(s));
    if (hash != s.xxh3) {
      return fail(Errc::checksum_mismatch, s.offset, "a section's checksum does not match", s.xxh3, hash);
    }
  }
  for (std::uint64_t i = 0; i < view.header().n_scale_sets; ++i) {
    if (const auto set = view.scale_set(i); !set) return tl::unexpected(set.error());
  }
  EncodeCounts counts;
  Box full;
  for (std::uint64_t i = 0; i < view.header().n_chunks; ++i) {
    if (const Status s = check_chunk(view, i, counts); !s) return s;
    const Box box = view.chunk(i)->means;
    for (std::size_t k = 0; k < 3; ++k) {
      full.min[k] = i == 0 ? box.min[k] : std::min(full.min[k], box.min[k]);
      full.max[k] = i == 0 ? box.max[k] : std::max(full.max[k], box.max[k]);
    }
  }
  const Declarations& d = view.declarations();
  const std::uint64_t at = view.find(SectionType::declarations)->offset;
  if (d.full.min != full.min || d.full.max != full.max) {
    return fail(Errc::bad_value, at + 44, "the declared full box is not that of the means");
  }
  for (std::size_t k = 0; k < 3; ++k) {
    if (d.robust.min[k] < full.min[k] || d.robust.max[k] > full.max[k]) {
      return fail(Errc::bad_value, at + 68, "the declared robust box reaches beyond the full box");
    }
  }
  const std::uint64_t found[4] = {counts.scale_subnormal, counts.scale_zero, counts.opacity_zero, counts.opacity_one};
  const std::uint64_t declared[4] = {d.n_scale_subnormal, d.n_scale_zero, d.n_opacity_zero, d.n_opacity_one};
  for (std::size_t i = 0; i < 4; ++i) {
    if (declared[i] != found[i]) {
      return fail(Errc::bad_value, at + 120 + 8 * i, "a declared count is not what the file holds", declared[i],
                  found[i]);
    }
  }
  return check_permutation(view);
}

}  // namespace rgs
