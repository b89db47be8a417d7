// archive_tables.cpp - parses section ARCH.
// SPDX-License-Identifier: Apache-2.0
#include "archive/archive_tables.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "file/byte_reader.hpp"
#include "packed/inflater.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint16_t kHalfOne = 0x3C00;  // FP16

// Decoded bytes of the frame of tables.
std::size_t content_bytes(const ArchiveTables& t, std::size_t n_distributions) {
  const std::size_t n_opacities = t.parameters.codec == Codec::archive ? t.parameters.opacity_levels + 1 : 0;
  const std::size_t prediction = t.parameters.codec == Codec::archive ? 4 + 4 : 2 * 6;
  return 4 * (3 + t.n_sh) + 2 * (9 + t.n_sh * t.n_sh) + prediction + 2 * n_opacities + t.contexts().count +
         2 * kRansTokens * n_distributions;
}

// Reads field after field; keeps the first failure.
class Fields {
 public:
  explicit Fields(ByteReader& in) : in_(in) {}
  std::uint32_t integer(std::uint32_t low, std::uint32_t high, const char* what) {
    const std::uint32_t value = in_.u32();
    check(value >= low && value <= high, 4, what);
    return value;
  }
  std::int32_t signed_integer(std::int32_t limit, const char* what) {
    const auto value = static_cast<std::int32_t>(in_.u32());
    check(value >= -limit && value <= limit, 4, what);
    return value;
  }
  float number(float low, float high, const char* what) {
    const float value = in_.f32();
    check(value >= low && value <= high, 4, what);
    return value;
  }
  double wide_number(double low, double high, const char* what) {
    const double value = in_.f64();
    check(value >= low && value <= high, 8, what);
    return value;
  }
  float bound() { return number(0, 3.4028235e38f, "a bound in ARCH is negative or not finite"); }
  void reserved(std::uint64_t bytes) {
    const std::uint64_t at = in_.offset();
    if (!in_.zeros(bytes) && status_) status_ = make_error(Errc::reserved_bits, at, "a reserved field of ARCH is set");
  }
  const Status& status() const { return status_; }

 private:
  void check(bool legal, std::uint64_t bytes, const char* what) {
    if (!legal && status_) status_ = make_error(Errc::bad_value, in_.offset() - bytes, what);
  }
  ByteReader& in_;
  Status status_;
};

ArchiveClass parse_class(Fields& in, Codec codec) {
  ArchiveClass c;
  const auto colours = [&] { c.dc_step = in.integer(1, 1u << 26, "a DC step in ARCH is not between 1 and 2^26"); };
  if (codec == Codec::archive) {
    colours();
    c.sh_units = in.integer(1, 1u << 15, "an SH step in ARCH is not between 1 and 2^15");
    for (float* bound : {&c.bound_mean, &c.bound_covariance, &c.bound_dc, &c.bound_sh}) *bound = in.bound();
    return c;
  }
  c.rotation_step = in.number(0x1p-20f, 2.f, "a rotation step in ARCH is not between 2^-20 and 2");
  c.scale_step = in.integer(1, 1u << 22, "a scale step in ARCH is not between 1 and 2^22");
  c.scale_base = in.signed_integer(1 << 23, "the base of scales in ARCH is beyond 2^23");
  colours();
  c.sh_step = in.number(0x1p-40f, 0x1p40f, "an SH step in ARCH is not between 2^-40 and 2^40");
  for (float* bound : {&c.bound_rotation, &c.bound_scale, &c.bound_dc, &c.bound_sh}) *bound = in.bound();
  return c;
}

void parse_shape(Fields& in, ShapeParameters& s) {
  constexpr std::int32_t kMost = 1 << 22;
  s.nearest = in.wide_number(0x1p-1000, 0x1p300, "the least distance in ARCH is not between 2^-1000 and 2^300");
  s.blur = in.signed_integer(kMost, "the blur in ARCH is beyond 2^22");
  s.coarse_step = static_cast<std::int32_t>(in.integer(1, 1u << 20, "a scale step in ARCH is not between 1 and 2^20"));
  for (std::int32_t* step : {&s.fine_step, &s.turn_step, &s.mean_step, &s.middle}) {
    *step = in.signed_integer(kMost << 2, "a step or the middle importance in ARCH is beyond 2^24");
  }
}

Status parse_content(std::span<const std::byte> content, std::uint64_t offset, std::size_t n_distributions,
                     ArchiveTables& t) {
  ByteReader in(content);
  bool legal = true;
  const auto centre = [&] {
    const float value = in.f32();
    legal = legal && value >= -0x1p40f && value <= 0x1p40f;
    return value;
  };
  std::ranges::generate(t.dc_centre, centre);
  t.sh_centre.resize(t.n_sh);
  std::ranges::generate(t.sh_centre, centre);
  const auto integer = [&] { return in.i16(); };
  std::ranges::generate(t.dc_matrix, integer);
  const bool shaped = t.parameters.codec == Codec::archive;
  bool predicts = true;
  if (shaped) {
    t.sh_unit = in.f32();
    for (ArchiveTables::Smoothing* s : {&t.dc_smoothing, &t.sh_smoothing}) {
      s->recent = in.u8(), s->kept = in.u8();
      predicts = predicts && s->recent + s->kept < 256;
    }
  } else {
    std::ranges::generate(t.dc_weights, integer);
  }
  t.sh_matrix.resize(t.n_sh * t.n_sh);
  std::ranges::generate(t.sh_matrix, integer);
  if (shaped) {
    t.opacity.resize(t.parameters.opacity_levels + 1);
    std::ranges::generate(t.opacity, [&] { return in.u16(); });
    const auto is_opacity = [](std::uint16_t half) { return half > 0 && half <= kHalfOne; };
    if (!std::ranges::all_of(t.opacity, is_opacity)) {
      return make_error(Errc::bad_value, offset, "an opacity in ARCH is not above 0 and at most 1");
    }
  }
  t.map.resize(t.contexts().count);
  std::ranges::generate(t.map, [&] { return in.u8(); });
  t.frequencies.resize(n_distributions * kRansTokens);
  std::ranges::generate(t.frequencies, [&] { return in.u16(); });
  if (!legal) return make_error(Errc::bad_value, offset, "a centre of SH in ARCH is not finite or too large");
  if (!(t.sh_unit >= 0x1p-60f && t.sh_unit <= 0x1p40f) || !predicts) {
    return make_error(Errc::bad_value, offset, "the unit of SH in ARCH, or what predicts it, is out of range");
  }
  if (std::ranges::any_of(t.map, [&](std::uint8_t d) { return d >= n_distributions; })) {
    return make_error(Errc::bad_value, offset, "a context in ARCH has a distribution that does not exist");
  }
  if (!t.rans.assign(t.frequencies)) {
    return make_error(Errc::bad_value, offset, "the frequencies of a distribution in ARCH do not sum to 4096");
  }
  return {};
}

}  // namespace

Result<ArchiveTables> parse_archive_tables(std::span<const std::byte> bytes, std::uint64_t offset, Codec codec,
                                           int sh_degree) {
  const auto too_short = [&] { return make_error(Errc::size_mismatch, offset, "section ARCH ends before its tables"); };
  if (bytes.size() < kArchiveFixedBytes) return too_short();
  ByteReader reader(bytes, offset);
  Fields in(reader);
  ArchiveTables t;
  t.n_sh = archive_sh_count(sh_degree);
  ArchiveParameters& p = t.parameters;
  p.codec = codec;
  const bool shaped = codec == Codec::archive;
  p.mean_cells = in.integer(4, 20, "mean_cells is not between 4 and 20");
  p.mean_bits = in.integer(1, std::min(p.mean_cells + 9, 28u), "mean_bits is not between 1 and mean_cells + 9");
  const std::uint32_t n_classes = in.integer(1, kMaxArchiveClasses, "the number of classes is not between 1 and 32");
  p.opacity_levels = in.integer(1, 4096, "opacity_levels is not between 1 and 4096");
  const std::uint32_t n_distributions = in.integer(1, 255, "the number of distributions is not between 1 and 255");
  if (shaped) {
    p.shape.slope = static_cast<std::int32_t>(in.integer(0, 1u << 16, "the slope is not between 0 and 2^16"));
  } else {
    in.reserved(4);
  }
  for (double& value : p.centre) value = in.wide_number(-0x1p128, 0x1p128, "the grid's centre is beyond 2^128");
  for (double& value : p.half_width) {
    value = in.wide_number(0x1p-1074, 0x1p128, "the grid's half width is not above 0 and at most 2^128");
  }
  constexpr const char* kKnob = "a knob in ARCH is negative or not finite";
  if (shaped) {
    parse_shape(in, p.shape);
    p.step = in.number(0, 3.4028235e38f, kKnob);
    p.bound_opacity = in.bound();
    in.reserved(16);
  } else {
    for (float* knob : {&p.sh_step, &p.dc_step, &p.rotation_step, &p.scale_step, &p.slope, &p.class_octaves}) {
      *knob = in.number(0, 3.4028235e38f, kKnob);
    }
    p.bound_mean = in.bound();
    p.bound_opacity = in.bound();
    in.reserved(24);
  }
  if (!in.status()) return tl::unexpected(in.status().error());
  const std::size_t fixed = kArchiveFixedBytes + archive_class_bytes(codec) * std::size_t{n_classes};
  if (bytes.size() < fixed) return too_short();
  p.classes.resize(n_classes);
  std::ranges::generate(p.classes, [&] { return parse_class(in, codec); });
  if (!in.status()) return tl::unexpected(in.status().error());

  const std::uint64_t at = offset + fixed;
  const auto frame = bytes.subspan(fixed);
  std::vector<std::byte> content(content_bytes(t, n_distributions));
  if (const Status s = Inflater().inflate(frame, at, content); !s) return tl::unexpected(s.error());
  if (const Status s = parse_content(content, at, n_distributions, t); !s) return tl::unexpected(s.error());
  if (shaped) {
    for (ArchiveClass& c : p.classes) c.sh_step = static_cast<float>(c.sh_units) * t.sh_unit;
  }
  return t;
}

std::uint64_t memory_bytes(const ArchiveTables& t) {
  const auto held = [](const auto& vector) { return vector.capacity() * sizeof(vector.front()); };
  return sizeof t + held(t.parameters.classes) + held(t.sh_centre) + held(t.sh_matrix) + held(t.opacity) + held(t.map) +
         held(t.frequencies) + t.rans.memory_bytes();
}

}  // namespace rgs::detail
