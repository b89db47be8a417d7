// archive_tables_write.cpp - serialises section ARCH.
// SPDX-License-Identifier: Apache-2.0
#include <zstd.h>

#include <cstring>
#include <new>

#include "archive/archive_tables.hpp"
#include "file/byte_writer.hpp"

namespace rgs::detail {
namespace {

std::uint64_t bits_of_double(double value) {
  std::uint64_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  return bits;
}

std::vector<std::byte> write_content(const ArchiveTables& t) {
  ByteWriter out;
  for (const float value : t.dc_centre) out.f32(value);
  for (const float value : t.sh_centre) out.f32(value);
  for (const std::int16_t value : t.dc_matrix) out.i16(value);
  for (const std::int16_t value : t.dc_weights) out.i16(value);
  for (const std::int16_t value : t.sh_matrix) out.i16(value);
  for (const std::uint8_t value : t.map) out.u8(value);
  for (const std::uint16_t value : t.frequencies) out.u16(value);
  return out.take();
}

}  // namespace

std::vector<std::byte> write_archive_tables(const ArchiveTables& t) {
  const ArchiveParameters& p = t.parameters;
  ByteWriter out;
  for (const std::uint32_t value : {p.mean_cells, p.mean_bits, static_cast<std::uint32_t>(p.classes.size()),
                                    p.opacity_levels, static_cast<std::uint32_t>(t.n_distributions()), 0u}) {
    out.u32(value);
  }
  for (const double value : p.centre) out.u64(bits_of_double(value));
  for (const double value : p.half_width) out.u64(bits_of_double(value));
  for (const float value :
       {p.sh_step, p.dc_step, p.rotation_step, p.scale_step, p.slope, p.class_octaves, p.bound_mean, p.bound_opacity}) {
    out.f32(value);
  }
  out.pad_to(kArchiveFixedBytes);
  for (const ArchiveClass& c : p.classes) {
    out.f32(c.rotation_step);
    out.u32(c.scale_step);
    out.u32(static_cast<std::uint32_t>(c.scale_base));
    out.u32(c.dc_step);
    out.f32(c.sh_step);
    for (const float bound : {c.bound_rotation, c.bound_scale, c.bound_dc, c.bound_sh}) out.f32(bound);
  }
  std::vector<std::byte> bytes = out.take();
  const std::vector<std::byte> content = write_content(t);
  const std::size_t fixed = bytes.size();
  bytes.resize(fixed + ZSTD_compressBound(content.size()));
  constexpr int kLevel = 19;  // a few KB, once a file
  const std::size_t size =
      ZSTD_compress(bytes.data() + fixed, bytes.size() - fixed, content.data(), content.size(), kLevel);
  // the only possible failure: the output has room for the worst case
  if (ZSTD_isError(size) != 0) throw std::bad_alloc();
  bytes.resize(fixed + size);
  return bytes;
}

}  // namespace rgs::detail
