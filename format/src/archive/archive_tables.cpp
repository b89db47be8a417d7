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

// Decoded bytes of the frame of tables.
std::size_t content_bytes(std::size_t n_classes, std::size_t n_sh, std::size_t n_distributions) {
  return 4 * (3 + n_sh) + 2 * (9 + 6 + n_sh * n_sh) + ArchiveContexts(n_classes, n_sh).count +
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

ArchiveClass parse_class(Fields& in) {
  ArchiveClass c;
  c.rotation_step = in.number(0x1p-20f, 2.f, "a rotation step in ARCH is not between 2^-20 and 2");
  c.scale_step = in.integer(1, 1u << 22, "a scale step in ARCH is not between 1 and 2^22");
  c.scale_base = in.signed_integer(1 << 23, "the base of scales in ARCH is beyond 2^23");
  c.dc_step = in.integer(1, 1u << 26, "a DC step in ARCH is not between 1 and 2^26");
  c.sh_step = in.number(0x1p-40f, 0x1p40f, "an SH step in ARCH is not between 2^-40 and 2^40");
  c.bound_rotation = in.bound();
  c.bound_scale = in.bound();
  c.bound_dc = in.bound();
  c.bound_sh = in.bound();
  return c;
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
  std::ranges::generate(t.dc_weights, integer);
  t.sh_matrix.resize(t.n_sh * t.n_sh);
  std::ranges::generate(t.sh_matrix, integer);
  t.map.resize(t.contexts().count);
  std::ranges::generate(t.map, [&] { return in.u8(); });
  t.frequencies.resize(n_distributions * kRansTokens);
  std::ranges::generate(t.frequencies, [&] { return in.u16(); });
  if (!legal) return make_error(Errc::bad_value, offset, "a centre of SH in ARCH is not finite or too large");
  if (std::ranges::any_of(t.map, [&](std::uint8_t d) { return d >= n_distributions; })) {
    return make_error(Errc::bad_value, offset, "a context in ARCH has a distribution that does not exist");
  }
  if (!t.rans.assign(t.frequencies)) {
    return make_error(Errc::bad_value, offset, "the frequencies of a distribution in ARCH do not sum to 4096");
  }
  return {};
}

}  // namespace

Result<ArchiveTables> parse_archive_tables(std::span<const std::byte> bytes, std::uint64_t offset, int sh_degree) {
  const auto too_short = [&] { return make_error(Errc::size_mismatch, offset, "section ARCH ends before its tables"); };
  if (bytes.size() < kArchiveFixedBytes) return too_short();
  ByteReader reader(bytes, offset);
  Fields in(reader);
  ArchiveTables t;
  t.n_sh = archive_sh_count(sh_degree);
  ArchiveParameters& p = t.parameters;
  p.mean_cells = in.integer(4, 20, "mean_cells is not between 4 and 20");
  p.mean_bits = in.integer(1, std::min(p.mean_cells + 9, 28u), "mean_bits is not between 1 and mean_cells + 9");
  const std::uint32_t n_classes = in.integer(1, kMaxArchiveClasses, "the number of classes is not between 1 and 32");
  p.opacity_levels = in.integer(1, 4096, "opacity_levels is not between 1 and 4096");
  const std::uint32_t n_distributions = in.integer(1, 255, "the number of distributions is not between 1 and 255");
  in.reserved(4);
  for (double& value : p.centre) value = in.wide_number(-0x1p128, 0x1p128, "the grid's centre is beyond 2^128");
  for (double& value : p.half_width) {
    value = in.wide_number(0x1p-1074, 0x1p128, "the grid's half width is not above 0 and at most 2^128");
  }
  constexpr const char* kKnob = "a knob in ARCH is negative or not finite";
  for (float* knob : {&p.sh_step, &p.dc_step, &p.rotation_step, &p.scale_step, &p.slope, &p.class_octaves}) {
    *knob = in.number(0, 3.4028235e38f, kKnob);
  }
  p.bound_mean = in.bound();
  p.bound_opacity = in.bound();
  in.reserved(24);
  if (!in.status()) return tl::unexpected(in.status().error());
  const std::size_t fixed = kArchiveFixedBytes + kArchiveClassBytes * std::size_t{n_classes};
  if (bytes.size() < fixed) return too_short();
  p.classes.resize(n_classes);
  std::ranges::generate(p.classes, [&] { return parse_class(in); });
  if (!in.status()) return tl::unexpected(in.status().error());

  const std::uint64_t at = offset + fixed;
  const auto frame = bytes.subspan(fixed);
  std::vector<std::byte> content(content_bytes(p.classes.size(), t.n_sh, n_distributions));
  if (const Status s = Inflater().inflate(frame, at, content); !s) return tl::unexpected(s.error());
  if (const Status s = parse_content(content, at, n_distributions, t); !s) return tl::unexpected(s.error());
  return t;
}

std::uint64_t memory_bytes(const ArchiveTables& t) {
  const auto held = [](const auto& vector) { return vector.capacity() * sizeof(vector.front()); };
  return sizeof t + held(t.parameters.classes) + held(t.sh_centre) + held(t.sh_matrix) + held(t.map) +
         held(t.frequencies) + t.rans.memory_bytes();
}

}  // namespace rgs::detail
