// archive_draco_reject_cases.hpp - archives of Codec::archive_draco with one defect each, and the error that each must
// cause.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <limits>

#include "archive_edits.hpp"
#include "reject_maker.hpp"

namespace rgs::test::detail {

inline void reject_draco_parameters(RejectMaker& m) {
  using enum Errc;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kInfinity = std::numeric_limits<float>::infinity();
  const std::uint64_t arch = m.section("ARCH"), first = arch + 128;
  const std::uint64_t tables = first + 36 * std::uint64_t{get<std::uint32_t>(m.file(), arch + 8)};
  m.change("arch_short", size_mismatch, arch, [](Bytes& b) { end_parameters(b, 127); });
  m.change("arch_short_classes", size_mismatch, arch, [&](Bytes& b) { end_parameters(b, tables - arch - 1); });
  m.flip("arch_checksum", checksum_mismatch, arch, arch + 5);
  m.set("arch_mean_cells", bad_value, arch, 3u);
  m.set("arch_mean_bits", bad_value, arch + 4, 29u);
  m.set("arch_classes_none", bad_value, arch + 8, 0u);
  m.set("arch_classes_33", bad_value, arch + 8, 33u);
  m.set("arch_opacity_levels", bad_value, arch + 12, 4097u);
  m.set("arch_distributions", bad_value, arch + 16, 256u);
  m.set("arch_reserved", reserved_bits, arch + 20, 1u);
  m.set("arch_centre", bad_value, arch + 32, std::numeric_limits<double>::quiet_NaN());
  m.set("arch_half_width", bad_value, arch + 64, 0.0);
  m.set("arch_knob", bad_value, arch + 72 + 12, -1.f);
  m.set("arch_bound_mean", bad_value, arch + 96, kInfinity);
  m.set("arch_bound_opacity", bad_value, arch + 100, kNaN);
  m.set("arch_reserved_last", reserved_bits, arch + 104, arch + 127, std::uint8_t{1});
  m.set("class_rotation_step", bad_value, first, 2.5f);
  m.set("class_scale_step", bad_value, first + 4, 0u);
  m.set("class_scale_base", bad_value, first + 8, (1 << 23) + 1);
  m.set("class_dc_step", bad_value, first + 12, (1u << 26) + 1);
  m.set("class_sh_step", bad_value, first + 16, kNaN);
  m.set("class_bound", bad_value, first + 32, -1.f);

  m.set("tables_magic", corrupt_data, tables, std::uint8_t{0x29});
  m.set("tables_size", corrupt_data, tables, arch + 16, get<std::uint32_t>(m.file(), arch + 16) + 1);
  m.change("tables_behind", corrupt_data, tables, [&](Bytes& b) { end_parameters(b, b.size() - arch + 1); });
  const auto content = [&](const char* name, auto change) {
    m.change(name, bad_value, tables, [&](Bytes& b) { change_tables(b, tables, change); });
  };
  content("tables_centre", [&](Bytes& t) { put(t, 4, kInfinity); });
  content("tables_map", [](Bytes& t) { put(t, 12 + 4 * 9 + 18 + 12 + 2 * 81, std::uint8_t{255}); });
  content("tables_frequencies", [](Bytes& t) { put(t, t.size() - 2, std::uint16_t{4096}); });
}

/// `m` has a file of degree 1 with one frame, whose last section is ARCH and whose other sections end with zeros.
inline void reject_draco_archive(RejectMaker& m) {
  using enum Errc;
  constexpr std::uint32_t kUnknown = 0x5A5A5A5Au;  // ZZZZ
  const std::uint64_t entry = m.entry("ARCH"), arch = m.section("ARCH");
  m.set("archive_in_1_1", unsupported_codec, m.entry("MEAN") + 8, 10, std::uint16_t{1});
  m.set("archive_in_part", unsupported_codec, m.entry("GEOM") + 8, 1u);
  m.change("archive_without_parameters", missing_section, 128, [&](Bytes& b) {
    put(b, entry, kUnknown);
    put(b, entry + 4, 0u);
  });
  m.change("archive_parameters_alone", bad_section, entry, [&](Bytes& b) {
    for (const char* type : {"MEAN", "GEOM", "SHI8"}) put(b, m.entry(type) + 8, 1u);
  });
  m.set("archive_frame_rows", bad_value, m.section("GEOM"), get<std::uint32_t>(m.file(), m.section("GEOM")) / 2);
  reject_draco_parameters(m);

  const std::uint64_t mean = m.section("MEAN") + kFrameTable, geometry = m.section("GEOM") + kFrameTable,
                      sh = m.section("SHI8") + kFrameTable;
  m.set("draco_version", corrupt_data, mean, mean + 6, std::uint8_t{2});
  m.set("draco_points", corrupt_data, mean, mean + 11, ~0u);
  m.set("draco_attribute", corrupt_data, mean, mean + 18, std::uint8_t{9});
  m.set("draco_bits", corrupt_data, mean, mean + 23, get<std::uint32_t>(m.file(), arch + 4) + 1);
  m.set("draco_tree_points", corrupt_data, mean, mean + 27, 1u);
  m.set("draco_state", corrupt_data, mean, mean + 31 + 2, std::uint8_t{0xFF});
  m.change("draco_behind", corrupt_data, mean, [&](Bytes& b) { grow_frame(b, m.entry("MEAN"), 1); });
  m.set("stream_state", corrupt_data, geometry, geometry + 3, std::uint8_t{0x5A});
  m.change("stream_odd", corrupt_data, geometry, [&](Bytes& b) { grow_frame(b, m.entry("GEOM"), 1); });
  m.change("stream_late", corrupt_data, sh, [&](Bytes& b) { grow_frame(b, m.entry("SHI8"), 2); });
  m.change(
      "stream_checksum", checksum_mismatch, sh, [&](Bytes& b) { b[sh + 40] ^= std::byte{1}; }, Hashes::but_frames);
}

}  // namespace rgs::test::detail
