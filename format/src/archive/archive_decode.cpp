// archive_decode.cpp - decodes codes of Codec::archive to rows, identically on every machine.
//
// Avoids whatever could differ between compilers: transforms and predictions are integers, the exponential of scales is
// a polynomial evaluated in a fixed order, the rest are IEEE operations rounded one by one. archive_formulas.hpp has
// the formulas, archive_kernels.cpp the loops.
// SPDX-License-Identifier: Apache-2.0
#include <cassert>
#include <cmath>
#include <cstring>
#include <limits>

#include "archive/archive_codec.hpp"
#include "file/layout_io.hpp"
#include "rgs/archive_formulas.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

constexpr std::int64_t kMaxDc = std::int64_t{1} << 30;

constexpr std::int64_t floor_divide(std::int64_t a, std::int64_t b) {  // b > 0
  return a / b - (a % b < 0 ? 1 : 0);
}

}  // namespace

void ColourCodes::resize(std::size_t n_rows, std::size_t n_sh) {
  n = n_rows;
  classes.resize(n);
  dc.resize(3 * n);
  sh.resize(n_sh * n);
}

void GeometryCodes::resize(std::size_t n_rows) {
  n = n_rows;
  classes.resize(n);
  largest.resize(n);
  opacity.resize(n);
  rotation.resize(3 * n);
  scale.resize(3 * n);
}

void CodeSizes::reset(std::size_t n) {
  history_.assign(n, 0);
  sizes_.assign(n, 0);
}

void CodeSizes::note(const std::int16_t* codes) {
  archive_kernels().note(codes, sizes_.size(), history_.data(), sizes_.data());
}

std::int64_t expected_dc(const std::int16_t weights[2], std::int64_t before, std::int64_t before_that,
                         std::int64_t step) {
  const std::int64_t guess = (weights[0] * before + weights[1] * before_that) >> 8;
  return floor_divide(2 * guess + step, 2 * step);
}

void smooth_sh(const ArchiveTables& t, ColourCodes& f) {
  if (t.n_sh == 0) return;
  std::int32_t state[kShMaxCodes] = {}, steps[kShLanes];
  for (std::size_t first = 0; first < f.n; first += kShLanes) {
    const std::size_t count = std::min<std::size_t>(kShLanes, f.n - first);
    for (std::size_t i = 0; i < count; ++i) {
      steps[i] = static_cast<std::int32_t>(t.parameters.classes[f.classes[first + i]].sh_units);
    }
    archive_kernels().smooth(f.sh.data() + first, f.n, static_cast<int>(t.n_sh), steps, static_cast<int>(count),
                             t.sh_smoothing.recent, t.sh_smoothing.kept, state);
  }
}

void dc_values(const ArchiveTables& t, const ColourCodes& f, std::vector<std::int32_t>& values) {
  values.resize(3 * f.n);
  std::int64_t before[3] = {}, before_that[3] = {};
  const bool shaped = t.parameters.codec == Codec::archive;
  for (std::size_t i = 0; i < f.n; ++i) {
    const std::int64_t step = t.parameters.classes[f.classes[i]].dc_step;
    for (std::size_t m = 0; m < 3; ++m) {  // the three divisions overlap
      std::int64_t value = 0;
      if (shaped) {
        value = smoothed_dc_value(f.dc[m * f.n + i], step, before[m]);
        before[m] = smoothed_dc_state(value, before[m], t.dc_smoothing.recent, t.dc_smoothing.kept);
      } else {
        const std::int64_t expected = expected_dc(&t.dc_weights[2 * m], before[m], before_that[m], step);
        value = std::clamp((f.dc[m * f.n + i] + expected) * step, -kMaxDc, kMaxDc);
        before_that[m] = before[m];
        before[m] = value;
      }
      values[m * f.n + i] = static_cast<std::int32_t>(value);
    }
  }
}

std::vector<std::int16_t> paired_matrix(const ArchiveTables& t) {
  const std::size_t width = (t.n_sh + 1) / 2 * 2;
  std::vector<std::int16_t> matrix(t.n_sh * width);
  for (std::size_t q = 0; q < t.n_sh; ++q) std::copy_n(&t.sh_matrix[q * t.n_sh], t.n_sh, &matrix[q * width]);
  return matrix;
}

void sh_block(const ArchiveTables& t, std::span<const std::int16_t> matrix, const ColourCodes& f,
              std::span<const std::int32_t> dc, std::size_t first, std::size_t count, ShBlock& block) {
  const ArchiveKernels& kernels = archive_kernels();
  const int n_lanes = static_cast<int>(count);
  for (std::size_t j = 0; j < 3; ++j) {
    kernels.dc(&t.dc_matrix[3 * j], &dc[first], f.n, t.dc_centre[j], n_lanes, block.value[j]);
  }
  const std::size_t n_pairs = (t.n_sh + 1) / 2;
  for (std::size_t p = 0; p < n_pairs; ++p) {
    const std::int16_t* even = &f.sh[2 * p * f.n + first];
    kernels.pair(even, 2 * p + 1 < t.n_sh ? even + f.n : nullptr, n_lanes, block.pairs + 2 * kShLanes * p);
  }
  codec_kernels().mix(block.pairs, matrix.data(), static_cast<int>(n_pairs), static_cast<int>(t.n_sh), block.sums[0]);
  const bool shaped = t.parameters.codec == Codec::archive;
  for (std::size_t i = 0; i < count; ++i) {
    block.factor[i] = (shaped ? t.sh_unit : t.parameters.classes[f.classes[first + i]].sh_step) * 0x1p-14f;
  }
  kernels.sh(block.sums[0], block.factor, t.sh_centre.data(), static_cast<int>(t.n_sh), block.value[3]);
}

// ---- frames --------------------------------------------------------------------------------------------------------

namespace {

Status begin(RansReader& reader, const FrameStreams::Stream& stream) {
  if (!reader.begin(stream.bytes)) return make_error(Errc::corrupt_data, stream.offset, "a stream is incomplete");
  return {};
}

Status end(const RansReader& reader, std::uint64_t offset) {
  if (!reader.ok() || !reader.finished()) return make_error(Errc::corrupt_data, offset, "a stream does not decode");
  return {};
}

// Of cells relative to a corner.
Status move_to(const GridPoint& corner, std::uint32_t bits, std::uint64_t offset, std::span<GridPoint> points) {
  std::uint32_t beyond = 0;
  for (GridPoint& point : points) {
    for (std::size_t k = 0; k < 3; ++k) {
      point[k] += corner[k];  // both are below 2^28
      beyond |= point[k] >> bits;
    }
  }
  if (beyond != 0) return make_error(Errc::corrupt_data, offset, "a mean lies outside the archive's grid");
  return {};
}

}  // namespace

Status ArchiveDecoder::codes(const FrameStreams& streams, std::size_t n, int level, const GridPoint& corner) {
  const ArchiveParameters& p = tables_.parameters;
  const bool shaped = p.codec == Codec::archive;
  const bool one = streams.one;
  const std::uint64_t offset = streams.means.offset;
  RansReader reader(tables_.rans, tables_.map);
  colours_.resize(n, tables_.n_sh);
  shapes_.points.resize(n);
  if (shaped) {
    shapes_.resize(n, level);
    if (Status s = tree_codes(streams.means, reader); !s) return s;
    if (Status s = one ? Status{} : end(reader, offset); !s) return s;
  } else {
    if (Status s = decode_points(streams.means.bytes, offset, p.mean_bits, shapes_.points); !s) return s;
    geometry_.resize(n);
  }
  if (Status s = move_to(corner, p.mean_bits, offset, shapes_.points); !s) return s;

  if (Status s = one ? Status{} : begin(reader, streams.geometry); !s) return s;
  if (shaped) {
    shapes_.find_distances(p);
    walk_shapes(shapes_, tables_, reader);
  } else {
    walk_geometry(geometry_, tables_, reader);
  }
  colours_.classes = shaped ? shapes_.classes : geometry_.classes;
  if (Status s = one ? Status{} : end(reader, streams.geometry.offset); !s) return s;

  if (Status s = one ? Status{} : begin(reader, streams.sh); !s) return s;
  walk_sh(colours_, tables_, sizes_, reader);
  if (shaped) smooth_sh(tables_, colours_);
  return end(reader, one ? offset : streams.sh.offset);
}

Status ArchiveDecoder::tree_codes(FrameStreams::Stream means, RansReader& reader) {
  std::array<std::uint8_t, 3> bits{};
  if (means.bytes.size() < 4) {
    return make_error(Errc::corrupt_data, means.offset, "a frame of means has no bit lengths");
  }
  std::memcpy(bits.data(), means.bytes.data(), bits.size());
  if (std::ranges::max(bits) > tables_.parameters.mean_bits || means.bytes[3] != std::byte{0}) {
    return make_error(Errc::corrupt_data, means.offset,
                      "the bit lengths of a frame of means are not those of its grid");
  }
  means.bytes = means.bytes.subspan(4);
  if (Status s = begin(reader, means); !s) return s;
  if (!tree_.walk(shapes_.points, bits, reader)) {
    return make_error(Errc::corrupt_data, means.offset, "a frame of means has a cell of more points than there are");
  }
  return {};
}

void ArchiveDecoder::rows(int scale_exponent, std::span<std::byte> means, std::span<std::byte> geometry) {
  const ArchiveParameters& p = tables_.parameters;
  const std::size_t n = colours_.n;
  means_.resize(3 * n);
  if (p.codec == Codec::archive) {
    geometry_rows_.resize(8 * n);
    shapes_.write_rows(tables_, scale_exponent, means_.data(), geometry_rows_.data());
    std::memcpy(geometry.data(), geometry_rows_.data(), n * kGeometryBytes);
  } else {
    for (std::size_t k = 0; k < 3; ++k) {
      archive_kernels().means({p.mean_bits, p.mean_cells, p.centre[k], p.half_width[k]}, shapes_.points[0].data() + k,
                              n, 3, means_.data() + k);
    }
    draco_geometry(scale_exponent, geometry);
  }
  std::memcpy(means.data(), means_.data(), n * kMeanBytes);
}

void ArchiveDecoder::draco_geometry(int scale_exponent, std::span<std::byte> out) {
  const GeometryCodes& f = geometry_;
  const ArchiveParameters& p = tables_.parameters;
  std::uint16_t rows[kShLanes][8];
  for (std::size_t first = 0; first < f.n; first += kShLanes) {
    const std::size_t count = std::min<std::size_t>(kShLanes, f.n - first);
    for (std::size_t j = 0; j < 3; ++j) {
      std::copy_n(&f.rotation[j * f.n + first], count, lanes_.rotation[j]);
      std::copy_n(&f.scale[j * f.n + first], count, lanes_.scale[j]);
    }
    std::copy_n(&f.opacity[first], count, lanes_.opacity);
    std::copy_n(&f.largest[first], count, lanes_.largest);
    for (std::size_t i = 0; i < count; ++i) {
      const ArchiveClass& c = p.classes[f.classes[first + i]];
      lanes_.scale_base[i] = c.scale_base, lanes_.scale_step[i] = c.scale_step;
      lanes_.rotation_step[i] = c.rotation_step;
    }
    archive_kernels().geometry(lanes_, p.opacity_levels, scale_exponent, rows[0]);
    std::memcpy(out.data() + first * kGeometryBytes, rows, count * kGeometryBytes);
  }
}

void ArchiveDecoder::sh(int sh_degree, std::uint32_t chunk_rows, std::span<const ShStepSet> chunk_steps,
                        std::span<std::byte> out) {
  constexpr std::size_t kPart = kMinChunkSize;  // of one chunk: chunks start at its multiples
  static_assert(kShLanes % kPart == 0);
  const std::size_t stride = sh_bytes(sh_degree), n_values = 3 + tables_.n_sh;
  std::array<float, kShMaxCodes> steps{};
  if (stride != n_values) std::memset(out.data(), 0, out.size());
  dc_values(tables_, colours_, dc_);
  for (std::size_t first = 0; first < colours_.n; first += kShLanes) {
    const std::size_t count = std::min<std::size_t>(kShLanes, colours_.n - first);
    sh_block(tables_, matrix_, colours_, dc_, first, count, block_);
    const std::size_t chunk = first / chunk_rows, last = (first + count - 1) / chunk_rows;
    for (std::size_t k = 0; k < n_values; ++k) steps[k] = chunk_steps[chunk].of_value(static_cast<int>(k));
    archive_kernels().quantize(block_.value[0], steps.data(), static_cast<int>(n_values), block_.lanes.codes[0]);
    for (std::size_t i = kPart; last != chunk && i < count; ++i) {  // in chunks of 32 a block has two
      const ShStepSet& set = chunk_steps[(first + i) / chunk_rows];
      for (std::size_t k = 0; k < n_values; ++k) {
        block_.lanes.codes[k][i] = quantize_sh(block_.value[k][i], set.of_value(static_cast<int>(k)));
      }
    }
    store_block(first, count, stride, out);
  }
}

void ArchiveDecoder::store_block(std::size_t first, std::size_t count, std::size_t stride, std::span<std::byte> out) {
  codec_kernels().store(block_.lanes, static_cast<int>(3 + tables_.n_sh), static_cast<int>(count),
                        reinterpret_cast<std::int8_t*>(out.data()) + first * stride, stride);
}

void ArchiveDecoder::sh_and_steps(int sh_degree, std::uint32_t chunk_rows, std::span<std::byte> steps,
                                  std::span<std::byte> out) {
  const std::size_t stride = sh_bytes(sh_degree), n_values = 3 + tables_.n_sh;
  if (stride != n_values) std::memset(out.data(), 0, out.size());
  dc_values(tables_, colours_, dc_);
  const ArchiveKernels& kernels = archive_kernels();
  ByteWriter sets;
  for (std::size_t chunk = 0; chunk < colours_.n; chunk += chunk_rows) {
    const std::size_t end = std::min(colours_.n, chunk + chunk_rows);
    std::array<float, kShMaxCodes> most{};
    values_.clear();
    for (std::size_t first = chunk; first < end; first += kShLanes) {
      const std::size_t count = std::min<std::size_t>(kShLanes, end - first);
      sh_block(tables_, matrix_, colours_, dc_, first, count, block_);
      kernels.largest(block_.value[0], static_cast<int>(n_values), static_cast<int>(count), most.data());
      values_.insert(values_.end(), block_.value[0], block_.value[n_values]);
    }
    float largest[4][3] = {};
    for (std::size_t k = 0; k < n_values; ++k) {
      float& of_set = largest[sh_degree_of(static_cast<int>(k / 3))][k % 3];
      of_set = std::max(of_set, most[k]);
    }
    ShStepSet set;
    for (std::size_t d = 0; d < 4; ++d) {
      for (std::size_t c = 0; c < 3; ++c) set.step[d][c] = sh_step(largest[d][c]);
    }
    write_step_set(sets, set);
    std::array<float, kShMaxCodes> steps_of;
    for (std::size_t k = 0; k < n_values; ++k) steps_of[k] = set.of_value(static_cast<int>(k));
    const float* value = values_.data();
    for (std::size_t first = chunk; first < end; first += kShLanes) {
      kernels.quantize(value, steps_of.data(), static_cast<int>(n_values), block_.lanes.codes[0]);
      value += n_values * kShLanes;
      store_block(first, std::min<std::size_t>(kShLanes, end - first), stride, out);
    }
  }
  std::ranges::copy(sets.bytes(), steps.begin());
}

}  // namespace rgs::detail
