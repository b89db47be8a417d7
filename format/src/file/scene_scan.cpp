// scene_scan.cpp - finds damaged Gaussians, and the encoder's first pass.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/scene_scan.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>

#include "file/byte_reader.hpp"
#include "file/byte_writer.hpp"
#include "rgs/quantize.hpp"

namespace rgs {
namespace {

constexpr std::size_t kBins = 65536;
constexpr float kInfinity = std::numeric_limits<float>::infinity();

constexpr std::uint32_t bit(Defect defect) {
  return 1u << static_cast<unsigned>(defect);
}

// Maps floats, but not NaN, to integers of the same order.
std::uint32_t ordered_bits(float value) {
  const std::uint32_t bits = detail::bits_of(value);
  return (bits & 0x80000000u) != 0 ? ~bits : bits | 0x80000000u;
}

float from_ordered_bits(std::uint32_t ordered) {
  return detail::float_of((ordered & 0x80000000u) != 0 ? ordered & 0x7FFFFFFFu : ~ordered);
}

}  // namespace

void ShMagnitudes::add(const float* sh, int sh_degree) {
  const auto floats = static_cast<std::size_t>(3 * sh_coefficients(sh_degree));
  for (std::size_t i = 0; i < floats; ++i) bits_[i] = std::max(bits_[i], detail::magnitude_bits(sh[i]));
}

void ShMagnitudes::merge(const ShMagnitudes& other) {
  for (std::size_t i = 0; i < bits_.size(); ++i) bits_[i] = std::max(bits_[i], other.bits_[i]);
}

ShStepSet ShMagnitudes::max_abs() const {
  ShStepSet set;
  for (std::size_t i = 0; i < bits_.size(); ++i) {
    float& value = set.step[sh_degree_of(static_cast<int>(i / 3))][i % 3];
    value = std::max(value, detail::float_of(static_cast<std::uint32_t>(bits_[i])));
  }
  return set;
}

ShStepSet ShMagnitudes::steps() const {
  ShStepSet set = max_abs();
  for (auto& degree : set.step) {
    for (float& step : degree) step = sh_step(step);
  }
  return set;
}

const char* defect_name(Defect defect) {
  switch (defect) {
    case Defect::mean: return "mean";
    case Defect::scale: return "scale";
    case Defect::rotation_nan: return "rotation_nan";
    case Defect::rotation_zero: return "rotation_zero";
    case Defect::opacity_nan: return "opacity_nan";
    case Defect::sh: return "sh";
  }
  return "unknown";
}

std::uint32_t find_defects(const Splat& s, int sh_degree) {
  std::uint32_t defects = 0;
  if (!std::isfinite(s.mean[0]) || !std::isfinite(s.mean[1]) || !std::isfinite(s.mean[2])) defects |= bit(Defect::mean);
  for (const float value : s.log_scale) {
    if (!(value <= kMaxLogScale)) defects |= bit(Defect::scale);
  }
  double squared = 0;
  for (const float value : s.rotation) squared += static_cast<double>(value) * static_cast<double>(value);
  if (!std::isfinite(squared)) {  // FP32 squares cannot overflow FP64
    defects |= bit(Defect::rotation_nan);
  } else if (squared < 0x1p-120) {
    defects |= bit(Defect::rotation_zero);
  }
  if (std::isnan(s.opacity_logit)) defects |= bit(Defect::opacity_nan);
  const int floats = 3 * sh_coefficients(sh_degree);
  std::int32_t largest = 0;
  for (int i = 0; i < floats; ++i) largest = std::max(largest, detail::magnitude_bits(s.sh[i]));
  if (largest > detail::magnitude_bits(kShLimit)) defects |= bit(Defect::sh);
  return defects;
}

bool repair(Splat& s, std::uint32_t defects) {
  if ((defects & (bit(Defect::mean) | bit(Defect::scale) | bit(Defect::opacity_nan))) != 0) return false;
  if ((defects & (bit(Defect::rotation_nan) | bit(Defect::rotation_zero))) != 0) {
    std::ranges::copy(Splat().rotation, s.rotation);
  }
  if ((defects & bit(Defect::sh)) != 0) {
    for (float& value : s.sh) {
      if (!(std::abs(value) <= kShLimit)) value = 0;
    }
  }
  return true;
}

SceneScan::SceneScan(int sh_degree, BadPolicy on_bad, bool samples_view)
    : sh_degree_(std::clamp(sh_degree, 0, kMaxShDegree)),
      on_bad_(on_bad),
      min_log_scale_(kInfinity),
      max_log_scale_(-kInfinity),
      min_opacity_logit_(kInfinity),
      max_opacity_logit_(-kInfinity),
      samples_view_(samples_view),
      histogram_(3 * kBins) {
  full_.min.fill(kInfinity);
  full_.max.fill(-kInfinity);
}

bool SceneScan::add(Splat& s) {
  ++n_source_;
  if (const std::uint32_t defects = find_defects(s, sh_degree_); defects != 0) {
    for (std::size_t i = 0; i < kDefectKinds; ++i) defects_[i] += defects >> i & 1;
    if (on_bad_ != BadPolicy::repair || !repair(s, defects)) return false;
    ++n_repaired_;
  }
  ++n_kept_;
  for (std::size_t i = 0; i < 3; ++i) {
    const float mean = s.mean[i] + 0.f;  // -0 becomes 0: the minimum must not depend on the order
    full_.min[i] = std::min(full_.min[i], mean);
    full_.max[i] = std::max(full_.max[i], mean);
    ++histogram_[i * kBins + (ordered_bits(mean) >> 16)];
    min_log_scale_ = std::min(min_log_scale_, s.log_scale[i]);
    max_log_scale_ = std::max(max_log_scale_, s.log_scale[i]);
  }
  min_opacity_logit_ = std::min(min_opacity_logit_, s.opacity_logit);
  max_opacity_logit_ = std::max(max_opacity_logit_, s.opacity_logit);
  sh_magnitudes_.add(s.sh, sh_degree_);
  if (samples_view_) view_sample_.add(s);
  return true;
}

SceneScan SceneScan::of_kept() const {
  SceneScan kept = *this;
  kept.n_source_ = n_kept_;
  kept.n_repaired_ = 0;
  kept.defects_ = {};
  return kept;
}

void SceneScan::merge(const SceneScan& other) {
  assert(sh_degree_ == other.sh_degree_ && on_bad_ == other.on_bad_);
  n_source_ += other.n_source_;
  n_kept_ += other.n_kept_;
  n_repaired_ += other.n_repaired_;
  for (std::size_t i = 0; i < kDefectKinds; ++i) defects_[i] += other.defects_[i];
  for (std::size_t i = 0; i < 3; ++i) {
    full_.min[i] = std::min(full_.min[i], other.full_.min[i]);
    full_.max[i] = std::max(full_.max[i], other.full_.max[i]);
  }
  min_log_scale_ = std::min(min_log_scale_, other.min_log_scale_);
  max_log_scale_ = std::max(max_log_scale_, other.max_log_scale_);
  min_opacity_logit_ = std::min(min_opacity_logit_, other.min_opacity_logit_);
  max_opacity_logit_ = std::max(max_opacity_logit_, other.max_opacity_logit_);
  sh_magnitudes_.merge(other.sh_magnitudes_);
  view_sample_.merge(other.view_sample_);
  for (std::size_t i = 0; i < histogram_.size(); ++i) histogram_[i] += other.histogram_[i];
}

std::vector<std::byte> SceneScan::to_bytes() const {
  detail::ByteWriter out;
  out.u32(static_cast<std::uint32_t>(sh_degree_));
  out.u32(static_cast<std::uint32_t>(on_bad_));
  for (const std::uint64_t count : {n_source_, n_kept_, n_repaired_}) out.u64(count);
  for (const std::uint64_t count : defects_) out.u64(count);
  for (const auto& corner : {full_.min, full_.max}) {
    for (const float x : corner) out.f32(x);
  }
  for (const float x : {min_log_scale_, max_log_scale_, min_opacity_logit_, max_opacity_logit_}) out.f32(x);
  for (const std::int32_t bits : sh_magnitudes_.bits_) out.u32(static_cast<std::uint32_t>(bits));
  // Few bins are used.
  out.u64(static_cast<std::uint64_t>(std::ranges::count_if(histogram_, [](std::uint64_t n) { return n != 0; })));
  for (std::size_t i = 0; i < histogram_.size(); ++i) {
    if (histogram_[i] == 0) continue;
    out.u32(static_cast<std::uint32_t>(i));
    out.u64(histogram_[i]);
  }
  const std::vector<FirstViewSample::Row> rows = view_sample_.rows();
  out.u64(view_sample_.n());
  out.u64(rows.size());
  for (const FirstViewSample::Row& row : rows) {
    for (const float x : row.mean) out.f32(x);
    for (const float x : row.scale) out.f32(x);
    for (const float x : row.rotation) out.f32(x);
    out.f32(row.opacity);
  }
  return out.take();
}

Result<SceneScan> SceneScan::from_bytes(std::span<const std::byte> bytes) {
  detail::ByteReader in(bytes);
  const std::uint32_t sh_degree = in.u32(), on_bad = in.u32();
  if (sh_degree > kMaxShDegree || on_bad > static_cast<std::uint32_t>(BadPolicy::repair)) {
    return make_error(Errc::bad_value, 0, "these bytes are not a scan of a scene");
  }
  SceneScan scan(static_cast<int>(sh_degree), static_cast<BadPolicy>(on_bad));
  for (std::uint64_t* count : {&scan.n_source_, &scan.n_kept_, &scan.n_repaired_}) *count = in.u64();
  for (std::uint64_t& count : scan.defects_) count = in.u64();
  for (auto* corner : {&scan.full_.min, &scan.full_.max}) {
    for (float& x : *corner) x = in.f32();
  }
  for (float* x : {&scan.min_log_scale_, &scan.max_log_scale_, &scan.min_opacity_logit_, &scan.max_opacity_logit_}) {
    *x = in.f32();
  }
  for (std::int32_t& bits : scan.sh_magnitudes_.bits_) bits = static_cast<std::int32_t>(in.u32());
  std::array<std::uint64_t, 3> on_axis{};
  for (std::uint64_t left = in.u64(); left > 0 && in.ok(); --left) {
    const std::uint64_t at = in.offset();
    const std::uint32_t i = in.u32();
    const std::uint64_t n = in.u64();
    if (!in.ok()) break;
    if (i >= scan.histogram_.size() || n > scan.n_kept_) {
      return make_error(Errc::bad_value, at, "these bytes are not a scan of a scene");
    }
    scan.histogram_[i] = n;
    on_axis[i / kBins] += n;
  }
  const std::uint64_t sampled = in.offset(), n_sampled = in.u64(), n_rows = in.u64();
  if (n_sampled > scan.n_kept_ || n_rows > std::min<std::uint64_t>(n_sampled, FirstViewSample::kMost))
    return make_error(Errc::bad_value, sampled, "these bytes are not a scan of a scene");
  for (std::uint64_t i = 0; i < n_rows && in.ok(); ++i) {
    std::array<float, 11> row;
    for (float& x : row) x = in.f32();
    scan.view_sample_.add(&row[0], &row[3], &row[6], row[10]);
  }
  scan.view_sample_.count(n_sampled - n_rows);
  if (!in.ok()) return make_error(Errc::truncated, bytes.size(), "the scan of a scene ends too early");
  if (in.remaining() != 0) return make_error(Errc::trailing_bytes, in.offset(), "bytes after the scan of a scene");
  // The search for the robust box relies on it.
  if (on_axis != std::array{scan.n_kept_, scan.n_kept_, scan.n_kept_}) {
    return make_error(Errc::bad_value, 0, "the counts of a scan contradict each other");
  }
  return scan;
}

Box SceneScan::robust() const {
  if (n_kept_ == 0) return {};
  const std::uint64_t outside = n_kept_ / 200;  // 0.5 % at each end
  Box box;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const std::uint64_t* bins = &histogram_[axis * kBins];
    std::uint32_t low = 0, high = kBins - 1;
    for (std::uint64_t below = bins[low]; below <= outside; below += bins[low]) ++low;
    for (std::uint64_t above = bins[high]; above <= outside; above += bins[high]) --high;
    box.min[axis] = std::max(full_.min[axis], from_ordered_bits(low << 16));
    box.max[axis] = std::min(full_.max[axis], from_ordered_bits(high << 16 | 0xFFFFu));
  }
  return box;
}

}  // namespace rgs
