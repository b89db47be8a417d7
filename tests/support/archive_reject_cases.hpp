// archive_reject_cases.hpp - archives of Codec::archive with one defect each, and the error that each must cause.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <limits>
#include <span>
#include <string_view>

#include "archive_edits.hpp"
#include "reject_maker.hpp"

namespace rgs::test::detail {

/// Where arrays start in the content of the tables of an archive of degree 1 with these opacity_levels.
struct ArchiveContent {
  explicit ArchiveContent(std::uint64_t levels) : map(opacity + 2 * (levels + 1)) {}
  static constexpr std::uint64_t kSh = 9, sh_centre = 12, sh_unit = sh_centre + 4 * kSh + 18, smoothing = sh_unit + 4;
  static constexpr std::uint64_t opacity = smoothing + 4 + 2 * kSh * kSh;
  std::uint64_t map;
};
/// Contexts: of a cell of n points, n at least 16; of opacities.
constexpr std::uint64_t context_of_cell(std::uint32_t n) {
  return 11 + static_cast<std::uint64_t>(std::bit_width(n));
}
constexpr std::uint64_t kOpacityContext = 28;

inline void reject_parameters(RejectMaker& m) {
  using enum Errc;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kInfinity = std::numeric_limits<float>::infinity();
  constexpr int kMostOctaves = 1 << 24;
  const std::uint64_t arch = m.section("ARCH"), first = arch + 128;
  const auto levels = get<std::uint32_t>(m.file(), arch + 12);
  const std::uint64_t tables = first + 24 * std::uint64_t{get<std::uint32_t>(m.file(), arch + 8)};
  m.change("arch3_short", size_mismatch, arch, [](Bytes& b) { end_parameters(b, 127); });
  m.change("arch3_short_classes", size_mismatch, arch, [&](Bytes& b) { end_parameters(b, tables - arch - 1); });
  m.flip("arch3_checksum", checksum_mismatch, arch, arch + 5);
  m.set("arch3_mean_cells", bad_value, arch, 21u);
  m.set("arch3_mean_bits", bad_value, arch + 4, get<std::uint32_t>(m.file(), arch) + 10);
  m.set("arch3_classes", bad_value, arch + 8, 0u);
  m.set("arch3_opacity_levels", bad_value, arch + 12, 0u);
  m.set("arch3_distributions", bad_value, arch + 16, 0u);
  m.set("arch3_slope", bad_value, arch + 20, (1u << 16) + 1);
  m.set("arch3_centre", bad_value, arch + 40, -0x1p129);
  m.set("arch3_half_width", bad_value, arch + 48, std::numeric_limits<double>::infinity());
  m.set("arch3_nearest", bad_value, arch + 72, 0.0);
  m.set("arch3_nearest_large", bad_value, arch + 72, 0x1p301);
  m.set("arch3_blur", bad_value, arch + 80, -(1 << 22) - 1);
  m.set("arch3_coarse_step", bad_value, arch + 84, 0u);
  m.set("arch3_fine_step", bad_value, arch + 88, kMostOctaves + 1);
  m.set("arch3_turn_step", bad_value, arch + 92, -kMostOctaves - 1);
  m.set("arch3_mean_step", bad_value, arch + 96, std::numeric_limits<int>::min());
  m.set("arch3_middle", bad_value, arch + 100, kMostOctaves + 1);
  m.set("arch3_step", bad_value, arch + 104, kInfinity);
  m.set("arch3_bound_opacity", bad_value, arch + 108, kNaN);
  m.set("arch3_reserved", reserved_bits, arch + 112, std::uint8_t{1});
  m.set("arch3_reserved_last", reserved_bits, arch + 112, arch + 127, std::uint8_t{1});
  m.set("class3_dc_step", bad_value, first, 0u);
  m.set("class3_sh_step", bad_value, first + 4, 0u);
  m.set("class3_sh_step_large", bad_value, first + 4, (1u << 15) + 1);
  m.set("class3_bound_mean", bad_value, first + 8, -1.f);
  m.set("class3_bound_covariance", bad_value, first + 12, kInfinity);
  m.set("class3_bound_dc", bad_value, first + 16, kNaN);
  m.set("class3_bound_sh", bad_value, first + 20, -1.f);

  const ArchiveContent at(levels);
  m.set("tables3_size", corrupt_data, tables, arch + 12, levels + 1);
  const auto content = [&](const char* name, auto change) {
    m.change(name, bad_value, tables, [&](Bytes& b) { change_tables(b, tables, change); });
  };
  content("tables3_centre", [&](Bytes& t) { put(t, at.sh_centre, kNaN); });
  content("tables3_sh_unit", [&](Bytes& t) { put(t, at.sh_unit, 0x1p-61f); });
  content("tables3_dc_smoothing", [&](Bytes& t) { put(t, at.smoothing, std::uint16_t{0x80 << 8 | 0x80}); });
  content("tables3_sh_smoothing", [&](Bytes& t) { put(t, at.smoothing + 2, std::uint16_t{0xFF << 8 | 0x01}); });
  content("tables3_opacity_0", [&](Bytes& t) { put(t, at.opacity, std::uint16_t{0}); });
  content("tables3_opacity_above_1", [&](Bytes& t) { put(t, at.map - 2, std::uint16_t{0x3C01}); });
  content("tables3_map", [&](Bytes& t) { put(t, at.map, std::uint8_t{255}); });
  content("tables3_frequencies", [](Bytes& t) { put(t, t.size() - 2, std::uint16_t{4096}); });
}

/// `m` has a file of degree 1 with one frame of n Gaussians, whose last section is ARCH.
inline void reject_archive(RejectMaker& m, std::uint32_t n) {
  using enum Errc;
  const std::uint64_t arch = m.section("ARCH");
  m.set("archive3_in_1_4", unsupported_codec, m.entry("MEAN") + 8, 10, std::uint16_t{4});
  m.set("archive3_in_part", unsupported_codec, m.entry("SHI8") + 8, 2u);
  m.set("archive3_frame_rows", bad_value, m.section("SHI8"), get<std::uint32_t>(m.file(), m.section("SHI8")) / 2);
  m.set("archive3_frame_rows_large", bad_value, m.section("GEOM"), (1u << 15) + get<std::uint32_t>(m.file(), 48));
  reject_parameters(m);

  const std::uint64_t mean = m.section("MEAN") + kFrameTable, geometry = m.section("GEOM") + kFrameTable,
                      sh = m.section("SHI8") + kFrameTable;
  m.set("points3_bits", corrupt_data, mean, mean + 1,
        static_cast<std::uint8_t>(get<std::uint32_t>(m.file(), arch + 4) + 1));
  m.set("points3_fourth_byte", corrupt_data, mean, mean + 3, std::uint8_t{1});
  const Bytes points = frame_of(m.file(), "MEAN"), shapes = frame_of(m.file(), "GEOM");
  const auto cut = [&](const char* name, std::string_view type, std::span<const std::byte> frame) {
    m.change(name, corrupt_data, m.section(type) + kFrameTable, [&](Bytes& b) { set_frame(b, type, frame); });
  };
  cut("points3_without_stream", "MEAN", std::span(points).first(3));
  cut("points3_short", "MEAN", std::span(points).first(4 + 30));
  cut("points3_early", "MEAN", std::span(points).first(points.size() - 2));
  // Numbers of these contexts are 57344 or more.
  const auto large = [&](const char* name, std::uint64_t offset, std::uint64_t context) {
    m.change(name, corrupt_data, offset, [&](Bytes& b) {
      const auto n_distributions = get<std::uint32_t>(b, arch + 16);
      const std::uint64_t tables = arch + 128 + 24 * std::uint64_t{get<std::uint32_t>(b, arch + 8)};
      put(b, arch + 16, n_distributions + 1);
      change_tables(b, tables, [&](Bytes& t) {
        put(t, ArchiveContent(get<std::uint32_t>(b, arch + 12)).map + context,
            static_cast<std::uint8_t>(n_distributions));
        t.resize(t.size() + 2 * 76);
        put(t, t.size() - 2, std::uint16_t{4096});
      });
    });
  };
  large("points3_many", mean, context_of_cell(n));
  large("opacity3_large", geometry, kOpacityContext);
  m.set("stream3_state", corrupt_data, geometry, geometry + 3, std::uint8_t{0x5A});
  m.change("stream3_odd", corrupt_data, geometry, [&](Bytes& b) { grow_frame(b, m.entry("GEOM"), 1); });
  m.change("stream3_none", corrupt_data, geometry, [&](Bytes& b) {
    set_frame(b, "SHI8", {});
    set_frame(b, "GEOM", {});
  });
  cut("stream3_short", "GEOM", std::span(shapes).first(30));
  cut("stream3_early", "GEOM", std::span(shapes).first(shapes.size() - 2));
  m.change("stream3_late", corrupt_data, sh, [&](Bytes& b) { grow_frame(b, m.entry("SHI8"), 2); });
  m.change(
      "stream3_checksum", checksum_mismatch, mean, [&](Bytes& b) { b[mean + 40] ^= std::byte{1}; }, Hashes::but_frames);
}

/// `m` has a file with one frame of fewer Gaussians than a stream has states, so that the last is not used.
inline void reject_last_state(RejectMaker& m) {
  const std::uint64_t geometry = m.section("GEOM") + kFrameTable;
  m.set("stream3_last_state", Errc::corrupt_data, geometry, geometry + 28, (1u << 16) + 1);
}

}  // namespace rgs::test::detail
