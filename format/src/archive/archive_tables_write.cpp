// archive_tables_write.cpp - serialises section ARCH.
// SPDX-License-Identifier: Apache-2.0
#include <zstd.h>

#include <bit>

#include "archive/archive_tables.hpp"
#include "file/byte_writer.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs::detail {
namespace {

std::vector<std::byte> write_content(const ArchiveTables& t) {
  ByteWriter out;
  for (const float value : t.dc_centre) out.f32(value);
  for (const float value : t.sh_centre) out.f32(value);
  for (const std::int16_t value : t.dc_matrix) out.i16(value);
  out.f32(t.sh_unit);
  for (const auto& s : {t.dc_smoothing, t.sh_smoothing}) out.u8(s.recent), out.u8(s.kept);
  for (const std::int16_t value : t.sh_matrix) out.i16(value);
  for (const std::uint16_t value : t.opacity) out.u16(value);
  for (const std::uint8_t value : t.map) out.u8(value);
  for (const std::uint16_t value : t.frequencies) out.u16(value);
  return out.take();
}

}  // namespace

std::vector<std::byte> write_archive_tables(const ArchiveTables& t) {
  const ArchiveParameters& p = t.parameters;
  const ShapeParameters& shape = p.shape;
  ByteWriter out;
  const auto integer = [&out](auto value) { out.u32(static_cast<std::uint32_t>(value)); };
  for (const std::uint32_t value : {p.mean_cells, p.mean_bits}) integer(value);
  integer(p.classes.size());
  integer(p.opacity_levels);
  integer(t.n_distributions());
  integer(shape.slope);
  for (const double value : p.centre) out.u64(std::bit_cast<std::uint64_t>(value));
  for (const double value : p.half_width) out.u64(std::bit_cast<std::uint64_t>(value));
  out.u64(std::bit_cast<std::uint64_t>(shape.nearest));
  for (const std::int32_t value :
       {shape.blur, shape.coarse_step, shape.fine_step, shape.turn_step, shape.mean_step, shape.middle}) {
    integer(value);
  }
  out.f32(p.step);
  out.f32(p.bound_opacity);
  out.pad_to(kArchiveFixedBytes);
  for (const ArchiveClass& c : p.classes) {
    out.u32(c.dc_step);
    out.u32(c.sh_units);
    for (const float value : {c.bound_mean, c.bound_covariance, c.bound_dc, c.bound_sh}) out.f32(value);
  }
  std::vector<std::byte> bytes = out.take();
  const std::vector<std::byte> content = write_content(t);
  const std::size_t fixed = bytes.size();
  bytes.resize(fixed + ZSTD_compressBound(content.size()));
  constexpr int kLevel = 19;  // a few KB, once a file
  const std::size_t size =
      ZSTD_compress(bytes.data() + fixed, bytes.size() - fixed, content.data(), content.size(), kLevel);
  // the only possible failure: the output has room for the worst case
  if (ZSTD_isError(size) != 0) fail_allocation();
  bytes.resize(fixed + size);
  return bytes;
}

}  // namespace rgs::detail
