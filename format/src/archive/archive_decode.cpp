// archive_decode.cpp - codes of Codec::archive to the rows that a GPU reads, the same on every machine.
//
// Whatever could differ between compilers is avoided: transforms and predictions are integers, the exponential of scales
// is a polynomial evaluated in a fixed order, the rest are IEEE operations rounded one by one.
// SPDX-License-Identifier: Apache-2.0
#include <cassert>
#include <cmath>
#include <cstring>
#include <limits>

#include "archive/archive_codec.hpp"
#include "file/layout_io.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

constexpr std::int64_t kOctave = 65536;
constexpr std::int64_t kMaxOctaves = std::int64_t{1} << 23;
constexpr std::int64_t kMaxDc = std::int64_t{1} << 30;

constexpr std::int64_t floor_divide(std::int64_t a, std::int64_t b) {  // b > 0
  return a / b - (a % b < 0 ? 1 : 0);
}

}  // namespace

void FrameCodes::resize(std::size_t n_rows, std::size_t n_sh) {
  n = n_rows;
  classes.resize(n);
  largest.resize(n);
  opacity.resize(n);
  rotation.resize(3 * n);
  scale.resize(3 * n);
  dc.resize(3 * n);
  sh.resize(n_sh * n);
}

void CodeSizes::reset(std::size_t n) {
  history_.assign(n, 0);
  sizes_.assign(n, 0);
}

// In 16 bits, so that it becomes vectors: (13 h + 128 m) div 16 is h - (3 h + 15) div 16 + 8 m, and h at most 10880.
void CodeSizes::note(const std::int16_t* codes) {
  constexpr std::array<std::int16_t, 7> kLimits{3, 7, 12, 22, 37, 60, 98};
  std::uint16_t* history = history_.data();
  std::uint16_t* sizes = sizes_.data();
  for (std::size_t i = 0; i < sizes_.size(); ++i) {
    const std::int16_t code = std::clamp<std::int16_t>(codes[i], -255, 255);
    const auto magnitude = static_cast<std::uint16_t>(code < 0 ? -code : code);
    const auto decay = static_cast<std::uint16_t>(static_cast<std::uint16_t>(3 * history[i] + 15) >> 4);
    const auto h = static_cast<std::int16_t>(history[i] - decay + 8 * magnitude);
    history[i] = static_cast<std::uint16_t>(h);
    std::int16_t size = 0;
    for (const std::int16_t limit : kLimits) size = static_cast<std::int16_t>(size + (h >= limit));
    sizes[i] = static_cast<std::uint16_t>(size);
  }
}

float grid_mean(const ArchiveParameters& p, std::size_t axis, std::uint32_t coordinate) {
  const auto q = static_cast<std::int64_t>(coordinate) - (std::int64_t{1} << (p.mean_bits - 1));
  const std::int64_t n = q >= 0 ? q : -1 - q, cells = std::int64_t{1} << p.mean_cells;
  double t = (static_cast<double>(n % cells) + 0.5) / static_cast<double>(cells);
  if (n >= cells) t = std::ldexp(1 + t, static_cast<int>(n / cells) - 1);
  const double x = p.centre[axis] + p.half_width[axis] * (q >= 0 ? t : -t);
  constexpr double kMax = std::numeric_limits<float>::max();
  return static_cast<float>(std::clamp(x, -kMax, kMax)) + 0.f;
}

std::int32_t scale_octaves(const ArchiveClass& c, std::int16_t code) {
  const std::int64_t octaves = c.scale_base + std::int64_t{code} * c.scale_step;
  return static_cast<std::int32_t>(std::clamp(octaves, -kMaxOctaves, kMaxOctaves));
}

OctaveScale scale_of_octaves(std::int32_t octaves) {
  const std::int64_t whole = floor_divide(octaves, kOctave);
  const double y = static_cast<double>(octaves - whole * kOctave) / static_cast<double>(kOctave);
  const double p =
      ((((0.001893754059 * y + 0.008949590422) * y + 0.05586033708) * y + 0.2401418182) * y + 0.6931544897) * y +
      0.9999998984;
  return {static_cast<float>(p), static_cast<int>(whole)};
}

void geometry_row(const ArchiveParameters& p, const FrameCodes& f, std::size_t i, int scale_exponent,
                  std::uint16_t row[8]) {
  const ArchiveClass& c = p.classes[f.classes[i]];
  double r[3];
  for (std::size_t j = 0; j < 3; ++j) {
    r[j] = static_cast<double>(f.rotation[j * f.n + i]) * static_cast<double>(c.rotation_step);
  }
  const double s = (r[0] * r[0] + r[1] * r[1]) + r[2] * r[2];
  const double w = s < 1 ? std::sqrt(1 - s) : 0, length = std::sqrt(s + w * w);
  double q[4];
  for (std::size_t k = 0, j = 0; k < 4; ++k) q[k] = (k == f.largest[i] ? w : r[j++]) / length;
  const double sign = q[0] < 0 ? -1 : 1;
  for (std::size_t k = 0; k < 4; ++k) row[k] = half_from_float(static_cast<float>(sign * q[k]));
  row[0] = static_cast<std::uint16_t>(row[0] & 0x7FFFu);
  for (std::size_t j = 0; j < 3; ++j) {
    const OctaveScale scale = scale_of_octaves(scale_octaves(c, f.scale[j * f.n + i]));
    const double stored = std::ldexp(static_cast<double>(scale.significand), scale.exponent + scale_exponent);
    row[4 + j] = std::min<std::uint16_t>(half_from_float(static_cast<float>(stored)), 0x7BFF);
  }
  const float level = f.opacity[i] == 0 ? 0.25f : static_cast<float>(f.opacity[i]);
  row[7] = half_from_float(level / static_cast<float>(p.opacity_levels));
}

std::int64_t expected_dc(const std::int16_t weights[2], std::int64_t before, std::int64_t before_that,
                         std::int64_t step) {
  const std::int64_t guess = (weights[0] * before + weights[1] * before_that) >> 8;
  return floor_divide(2 * guess + step, 2 * step);
}

void dc_values(const ArchiveTables& t, const FrameCodes& f, std::vector<std::int32_t>& values) {
  values.resize(3 * f.n);
  for (std::size_t m = 0; m < 3; ++m) {
    std::int64_t before = 0, before_that = 0;
    for (std::size_t i = 0; i < f.n; ++i) {
      const std::int64_t step = t.parameters.classes[f.classes[i]].dc_step;
      const std::int64_t code = f.dc[m * f.n + i] + expected_dc(&t.dc_weights[2 * m], before, before_that, step);
      before_that = before;
      before = std::clamp(code * step, -kMaxDc, kMaxDc);
      values[m * f.n + i] = static_cast<std::int32_t>(before);
    }
  }
}

std::vector<std::int16_t> paired_matrix(const ArchiveTables& t) {
  const std::size_t width = (t.n_sh + 1) / 2 * 2;
  std::vector<std::int16_t> matrix(t.n_sh * width);
  for (std::size_t q = 0; q < t.n_sh; ++q) std::copy_n(&t.sh_matrix[q * t.n_sh], t.n_sh, &matrix[q * width]);
  return matrix;
}

void sh_block(const ArchiveTables& t, std::span<const std::int16_t> matrix, const FrameCodes& f,
              std::span<const std::int32_t> dc, std::size_t first, std::size_t count, ShBlock& block) {
  for (std::size_t j = 0; j < 3; ++j) {
    for (std::size_t i = 0; i < count; ++i) {
      std::int64_t sum = 0;
      for (std::size_t m = 0; m < 3; ++m) sum += std::int64_t{t.dc_matrix[3 * j + m]} * dc[m * f.n + first + i];
      block.value[j][i] = static_cast<float>(static_cast<double>(sum) * 0x1p-30 + static_cast<double>(t.dc_centre[j]));
    }
  }
  const std::size_t n_pairs = (t.n_sh + 1) / 2;
  for (std::size_t p = 0; p < n_pairs; ++p) {
    std::int16_t* to = block.pairs + 2 * kShLanes * p;
    const std::int16_t* even = &f.sh[2 * p * f.n + first];
    const std::int16_t* odd = 2 * p + 1 < t.n_sh ? even + f.n : nullptr;
    for (std::size_t i = 0; i < count; ++i) {
      to[2 * i] = even[i];
      to[2 * i + 1] = odd != nullptr ? odd[i] : std::int16_t{0};
    }
  }
  codec_kernels().mix(block.pairs, matrix.data(), static_cast<int>(n_pairs), static_cast<int>(t.n_sh), block.sums[0]);
  float factor[kShLanes];
  for (std::size_t i = 0; i < count; ++i) factor[i] = t.parameters.classes[f.classes[first + i]].sh_step * 0x1p-14f;
  for (std::size_t q = 0; q < t.n_sh; ++q) {
    for (std::size_t i = 0; i < count; ++i) {
      block.value[3 + q][i] = static_cast<float>(block.sums[q][i]) * factor[i] + t.sh_centre[q];
    }
  }
}

// ---- frames --------------------------------------------------------------------------------------------------------

Status ArchiveDecoder::means(std::span<const std::byte> stored, std::uint64_t offset, std::size_t n,
                             std::span<std::byte> out, const GridPoint& corner) {
  points_.resize(n);
  if (Status s = decode_points(stored, offset, tables_.parameters.mean_bits, points_); !s) return s;
  for (std::size_t i = 0; i < n; ++i) {
    float mean[3];
    for (std::size_t k = 0; k < 3; ++k) {
      const std::uint32_t coordinate = points_[i][k] + corner[k];  // both are below 2^28
      if (coordinate >> tables_.parameters.mean_bits != 0) {
        return make_error(Errc::corrupt_data, offset, "a mean lies outside the archive's grid");
      }
      mean[k] = grid_mean(tables_.parameters, k, coordinate);
    }
    std::memcpy(out.data() + i * kMeanBytes, mean, sizeof mean);
  }
  return {};
}

Status ArchiveDecoder::geometry_codes(std::span<const std::byte> stored, std::uint64_t offset, std::size_t n) {
  codes_.resize(n, tables_.n_sh);
  RansReader reader(tables_.rans, tables_.map);
  if (!reader.begin(stored)) return make_error(Errc::corrupt_data, offset, "a frame of geometry has no whole stream");
  walk_geometry(codes_, tables_, reader);
  if (!reader.ok() || !reader.finished())
    return make_error(Errc::corrupt_data, offset, "a frame of geometry does not decode");
  return {};
}

void ArchiveDecoder::geometry(int scale_exponent, std::span<std::byte> out) const {
  for (std::size_t i = 0; i < codes_.n; ++i) {
    std::uint16_t row[8];
    geometry_row(tables_.parameters, codes_, i, scale_exponent, row);
    std::memcpy(out.data() + i * kGeometryBytes, row, sizeof row);
  }
}

Status ArchiveDecoder::sh_codes(std::span<const std::byte> stored, std::uint64_t offset) {
  RansReader reader(tables_.rans, tables_.map);
  if (!reader.begin(stored)) return make_error(Errc::corrupt_data, offset, "a frame of SH has no whole stream");
  walk_sh(codes_, tables_, sizes_, reader);
  if (!reader.ok() || !reader.finished())
    return make_error(Errc::corrupt_data, offset, "a frame of SH does not decode");
  return {};
}

void ArchiveDecoder::sh(int sh_degree, std::uint32_t chunk_rows, std::span<const ShStepSet> chunk_steps,
                        std::span<std::byte> out) {
  constexpr std::size_t kPart = kMinChunkSize;  // of one chunk: chunks begin at its multiples
  static_assert(kShLanes % kPart == 0);
  const std::size_t stride = sh_bytes(sh_degree), n_values = 3 + tables_.n_sh;
  if (stride != n_values) std::memset(out.data(), 0, out.size());
  dc_values(tables_, codes_, dc_);
  for (std::size_t first = 0; first < codes_.n; first += kShLanes) {
    const std::size_t count = std::min<std::size_t>(kShLanes, codes_.n - first);
    sh_block(tables_, matrix_, codes_, dc_, first, count, block_);
    for (std::size_t part = 0; part < count; part += kPart) {
      const ShStepSet& set = chunk_steps[(first + part) / chunk_rows];
      for (std::size_t k = 0; k < n_values; ++k) {
        const float step = set.of_value(static_cast<int>(k));
        for (std::size_t i = part; i < part + kPart; ++i) {
          block_.lanes.codes[k][i] = quantize_sh(block_.value[k][i], step);
        }
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
  dc_values(tables_, codes_, dc_);
  ByteWriter sets;
  for (std::size_t chunk = 0; chunk < codes_.n; chunk += chunk_rows) {
    const std::size_t end = std::min(codes_.n, chunk + chunk_rows);
    float largest[4][3] = {};
    values_.clear();
    for (std::size_t first = chunk; first < end; first += kShLanes) {
      const std::size_t count = std::min<std::size_t>(kShLanes, end - first);
      sh_block(tables_, matrix_, codes_, dc_, first, count, block_);
      for (std::size_t k = 0; k < n_values; ++k) {
        float& most = largest[sh_degree_of(static_cast<int>(k / 3))][k % 3];
        for (std::size_t i = 0; i < count; ++i) most = std::max(most, std::fabs(block_.value[k][i]));
        values_.insert(values_.end(), block_.value[k], block_.value[k] + kShLanes);
      }
    }
    ShStepSet set;
    for (std::size_t d = 0; d < 4; ++d) {
      for (std::size_t c = 0; c < 3; ++c) set.step[d][c] = sh_step(largest[d][c]);
    }
    write_step_set(sets, set);
    const float* value = values_.data();
    for (std::size_t first = chunk; first < end; first += kShLanes) {
      for (std::size_t k = 0; k < n_values; ++k, value += kShLanes) {
        const float step = set.of_value(static_cast<int>(k));
        for (std::size_t i = 0; i < kShLanes; ++i) block_.lanes.codes[k][i] = quantize_sh(value[i], step);
      }
      store_block(first, std::min<std::size_t>(kShLanes, end - first), stride, out);
    }
  }
  std::ranges::copy(sets.bytes(), steps.begin());
}

}  // namespace rgs::detail
