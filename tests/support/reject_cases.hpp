// reject_cases.hpp - files with one defect each, and the error that each must cause.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <limits>

#include "archive_draco_reject_cases.hpp"
#include "archive_reject_cases.hpp"
#include "golden_scenes.hpp"
#include "levels_reject_cases.hpp"
#include "reject_maker.hpp"

namespace rgs::test {

namespace detail {

inline Bytes sound(const SplatCloud& cloud, const EncodeOptions& options) {
  return encode(cloud.view(), options).value();
}

inline void reject_header(RejectMaker& m) {
  using enum Errc;
  const std::uint64_t size = m.file().size();
  m.set("magic_first", bad_magic, 0, std::uint8_t{0x88});
  m.set("magic_newline", bad_magic, 4, std::uint8_t{0x0A});
  m.set("version_major_0", unsupported_version, 8, std::uint16_t{0});
  m.set("version_major_2", unsupported_version, 8, std::uint16_t{2});
  m.set("header_flags", reserved_bits, 12, 0x80000000u);
  m.set("header_reserved_first", reserved_bits, 60, std::uint8_t{1});
  m.set("header_reserved_last", reserved_bits, 60, 127, std::uint8_t{1});
  m.set("file_bytes_more", truncated, size, 16, size + 1);
  m.set("file_bytes_fewer", trailing_bytes, size - 1, 16, size - 1);
  m.set("file_bytes_huge", limit_exceeded, 16, ~std::uint64_t{0});
  m.change("gaussians_2_32", size_mismatch, m.entry("CHNK") + 32, [](Bytes& b) {
    put(b, 24, std::uint64_t{1} << 32);
    put(b, 32, std::uint64_t{1} << 24);
  });
  m.change("gaussians_2_64", limit_exceeded, 24, [](Bytes& b) {
    put(b, 24, ~std::uint64_t{0});
    put(b, 32, std::uint64_t{1} << 56);
  });
  m.set("chunks_more", bad_header, 32, std::uint64_t{2});
  m.set("chunks_none", bad_header, 32, std::uint64_t{0});
  m.set("scale_sets_none", bad_header, 40, std::uint64_t{0});
  m.set("scale_sets_more_than_chunks", bad_header, 40, std::uint64_t{2});
  m.set("chunk_size_0", bad_header, 48, 0u);
  m.set("chunk_size_16", bad_header, 48, 16u);
  m.set("chunk_size_48", bad_header, 48, 48u);
  m.set("chunk_size_above_2_16", bad_header, 48, 65568u);
  m.set("sections_none", bad_header, 52, 0u);
  m.set("sections_1025", bad_header, 52, 1025u);
  m.set("sections_beyond_file", bad_header, 52, 1024u);
  m.set("sh_degree_4", bad_header, 56, std::uint8_t{4});
  m.set("sh_bytes", bad_header, 57, std::uint8_t{3});
  m.set("scale_exponent_high", bad_header, 58, std::int16_t{111});
  m.set("scale_exponent_low", bad_header, 58, std::int16_t{-111});

  const auto cut = [&](const std::string& name, std::uint64_t bytes) {
    m.change(name, truncated, bytes, [&](Bytes& b) { b.resize(bytes); });
  };
  cut("cut_to_nothing", 0);
  cut("cut_in_magic", 5);
  cut("cut_in_header", 127);
  cut("cut_in_table", 300);
  cut("cut_last_byte", size - 1);
  m.change("extra_byte", trailing_bytes, size, [](Bytes& b) { b.emplace_back(); });
  m.change("extra_byte_counted", section_gap, size, [&](Bytes& b) {
    b.emplace_back();
    put(b, 16, size + 1);
  });
  m.flip("head_checksum", checksum_mismatch, entry_at(8), entry_at(8) + 3);
  m.flip("table_checksum", checksum_mismatch, entry_at(8), entry_at(2) + 24);
}

inline void reject_table(RejectMaker& m) {
  using enum Errc;
  const std::uint64_t perm = m.entry("PERM"), prov = m.entry("PROV"), size = m.file().size();
  constexpr std::uint32_t kUnknown = 0x5A5A5A5Au;  // ZZZZ
  m.set("section_flags", reserved_bits, perm + 4, 2u);
  m.set("section_reserved_word", reserved_bits, perm + 12, 1u);
  m.set("section_reserved_first", reserved_bits, perm + 48, std::uint8_t{1});
  m.set("section_reserved_last", reserved_bits, perm + 48, perm + 63, std::uint8_t{1});
  m.change("unknown_must_understand", unknown_required, perm, [&](Bytes& b) {
    put(b, perm, kUnknown);
    put(b, perm + 4, 1u);
  });
  m.set("codec", unsupported_codec, perm + 8, 1u);
  m.set("decoded_not_stored", size_mismatch, perm + 32, std::uint64_t{25});
  m.set("duplicate", duplicate_section, prov, get<std::uint32_t>(m.file(), perm));
  for (const char* type : {"DECL", "SHSC", "CHNK", "MEAN", "GEOM", "SHI8"}) {
    m.change(std::string("missing_") + type, missing_section, 128, [&](Bytes& b) {
      put(b, m.entry(type), kUnknown);
      put(b, m.entry(type) + 4, 0u);
    });
  }
  m.set("section_unaligned", bad_section, perm + 16, m.section("PERM") + 16);
  m.set("section_overlap", section_overlap, perm + 16, m.section("SHI8"));
  m.set("section_in_head", section_overlap, m.entry("DECL") + 16, std::uint64_t{512});
  m.change("sections_swapped", section_gap, perm + 16, [&](Bytes& b) {
    put(b, perm + 16, m.section("PROV"));
    put(b, prov + 16, m.section("PERM"));
  });
  m.change("section_gap", section_gap, prov + 16, [&](Bytes& b) {
    b.insert(b.begin() + static_cast<std::ptrdiff_t>(m.section("PROV")), 256, std::byte{0});
    put(b, 16, size + 256);
    put(b, prov + 16, m.section("PROV") + 256);
  });
  m.set("section_offset_2_64", section_gap, prov + 16, ~std::uint64_t{255});
  m.change("section_beyond_file", bad_section, prov + 24, [&](Bytes& b) {
    put(b, prov + 24, size - m.section("PROV") + 1);
    put(b, prov + 32, size - m.section("PROV") + 1);
  });
  m.change("section_size_2_64", bad_section, perm + 24, [&](Bytes& b) {
    put(b, perm + 24, ~std::uint64_t{0});
    put(b, perm + 32, ~std::uint64_t{0});
  });
  m.change("section_ends_early", section_gap, size - 1, [&](Bytes& b) {
    put(b, prov + 24, size - m.section("PROV") - 1);
    put(b, prov + 32, size - m.section("PROV") - 1);
  });
  m.set("padding_after_head", section_gap, entry_at(8) + 8, std::uint8_t{1});
  m.set("padding_between", section_gap, m.section("GEOM") - 1, std::uint8_t{1});
  m.resize("size_DECL", "DECL", 252);
  m.resize("size_SHSC", "SHSC", 96);
  m.resize("size_CHNK", "CHNK", 96);
  m.resize("size_MEAN", "MEAN", 84);
  m.resize("size_GEOM", "GEOM", 112);
  m.resize("size_SHI8", "SHI8", 28);
  m.resize("size_PERM", "PERM", 28);
  m.change("size_PERM_wide", size_mismatch, perm + 32, [&](Bytes& b) {
    put(b, m.section("DECL") + 96, (std::uint64_t{1} << 32) + 6);
    put(b, m.section("DECL") + 104, std::uint64_t{1} << 32);
  });
  for (const char* type : {"DECL", "SHSC", "CHNK", "MEAN", "GEOM", "SHI8", "PERM", "PROV"}) {
    m.flip(std::string("checksum_") + type, checksum_mismatch, m.section(type), m.section(type) + 5);
  }
}

inline void reject_declarations(RejectMaker& m) {
  using enum Errc;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kInfinity = std::numeric_limits<float>::infinity();
  const std::uint64_t d = m.section("DECL");
  m.set("axis_7", bad_value, d + 1, std::uint8_t{7});
  m.set("axis_undeclared", bad_value, d, d + 2, std::uint8_t{0});
  m.set("axes_flat", bad_value, d, d + 1, std::uint8_t{6});
  m.set("colour_space", bad_value, d + 3, std::uint8_t{3});
  m.set("sh_basis", bad_value, d + 4, std::uint8_t{0});
  m.set("kernel", bad_value, d + 5, std::uint8_t{2});
  m.set("aa_mode", bad_value, d + 6, std::uint8_t{3});
  m.set("sort_metric", bad_value, d + 7, std::uint8_t{0});
  m.set("depth_mapping", bad_value, d + 8, std::uint8_t{0});
  m.set("depth_source", bad_value, d + 9, std::uint8_t{4});
  m.set("order", bad_value, d + 10, std::uint8_t{0});
  m.set("declaration_byte", reserved_bits, d + 11, std::uint8_t{1});
  m.set("depth_near_0", bad_value, d + 12, 0.f);
  m.set("depth_near_far", bad_value, d + 12, d + 16, 0.125f);
  m.set("depth_far_infinite", bad_value, d + 16, kInfinity);
  m.set("metres_per_unit", bad_value, d + 20, -1.f);
  m.set("cutoff_sigma", bad_value, d + 24, kNaN);
  m.set("alpha_threshold", bad_value, d + 28, -1.f);
  m.set("alpha_max", bad_value, d + 32, kInfinity);
  m.set("low_pass", bad_value, d + 36, kNaN);
  m.set("transmittance", bad_value, d + 40, -1.f);
  m.set("full_box_nan", bad_value, d + 44, kNaN);
  m.set("full_box_inverted", bad_value, d + 44, d + 64, -1000.f);
  m.set("full_box_larger", bad_value, d + 44, d + 48, -1000.f);
  m.set("robust_box_infinite", bad_value, d + 68, d + 88, kInfinity);
  m.set("robust_box_outside", bad_value, d + 68, d + 88, 1000.f);
  m.set("robust_fraction", bad_value, d + 92, 1.5f);
  m.set("source_count", bad_value, d + 96, std::uint64_t{7});
  m.set("dropped_count", bad_value, d + 96, d + 104, ~std::uint64_t{0});
  m.set("count_scale_subnormal", bad_value, d + 120, std::uint64_t{1});
  m.set("count_scale_zero", bad_value, d + 128, std::uint64_t{1});
  m.set("count_opacity_zero", bad_value, d + 136, std::uint64_t{1});
  m.set("count_opacity_one", bad_value, d + 144, ~std::uint64_t{0});
  m.set("declaration_reserved_first", reserved_bits, d + 152, std::uint8_t{1});
  m.set("declaration_reserved_last", reserved_bits, d + 152, d + 255, std::uint8_t{1});
}

// `m` has a file with an origin.
inline void reject_origin(RejectMaker& m) {
  using enum Errc;
  const std::uint64_t origin = m.section("DECL") + 152;
  m.set("origin_in_1_2", reserved_bits, origin, 10, std::uint16_t{2});
  m.set("origin_nan", bad_value, origin, std::numeric_limits<double>::quiet_NaN());
  m.set("origin_infinite", bad_value, origin + 8, -std::numeric_limits<double>::infinity());
  m.set("origin_beyond_10_12", bad_value, origin + 16, -1.0000001e12);
  m.set("origin_reserved", reserved_bits, origin + 24, std::uint8_t{1});
}

// `m` has a file with a first view.
inline void reject_first_view(RejectMaker& m) {
  using enum Errc;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kInfinity = std::numeric_limits<float>::infinity();
  const std::uint64_t d = m.section("DECL"), position = d + 176, pivot = d + 188, up = d + 200, width = d + 212;
  m.set("view_in_1_4", reserved_bits, d + 11, 10, std::uint16_t{4});
  m.set("view_kind", bad_value, d + 11, std::uint8_t{3});
  m.set("view_none", reserved_bits, position, d + 11, std::uint8_t{0});
  m.set("view_position_nan", bad_value, position, kNaN);
  m.set("view_position_beyond", bad_value, position + 8, 1.1e12F);
  m.set("view_pivot_infinite", bad_value, pivot + 4, -kInfinity);
  m.change("view_pivot_same", bad_value, position, [&](Bytes& b) {
    for (std::uint64_t i = 0; i < 12; i += 4) put(b, pivot + i, get<float>(b, position + i));
  });
  m.set("view_up_nan", bad_value, up, up + 8, kNaN);
  m.set("view_up_short", bad_value, up, up + 4, 0.F);
  m.set("view_width_0", bad_value, width, 0.F);
  m.set("view_width_180", bad_value, width, 180.F);
  m.set("view_width_nan", bad_value, width, kNaN);
  m.set("view_reserved", reserved_bits, width + 4, std::uint8_t{1});
}

// `m` has a file with a CRS of ten bytes or more.
inline void reject_crs(RejectMaker& m) {
  using enum Errc;
  const std::uint64_t crs = m.section("CREF"), text = crs + 4;
  const auto resized = [&](const char* name, std::uint64_t bytes) {
    m.change(name, size_mismatch, m.entry("CREF") + 32, [&](Bytes& b) {
      b.resize(crs + bytes, std::byte{'x'});
      put(b, 16, crs + bytes);
      put(b, m.entry("CREF") + 24, bytes);
      put(b, m.entry("CREF") + 32, bytes);
    });
  };
  resized("crs_empty", 4);
  resized("crs_long", 4 + (1u << 14) + 1);
  m.flip("crs_checksum", checksum_mismatch, crs, text);
  m.set("crs_coded", unsupported_codec, m.entry("CREF") + 8, 1u);
  m.change("crs_required_in_1_4", unknown_required, m.entry("CREF"), [&](Bytes& b) {
    put(b, 10, std::uint16_t{4});
    put(b, m.entry("CREF") + 4, 1u);
  });
  m.set("crs_axis", bad_value, crs, std::uint8_t{7});
  m.set("crs_axes_twice", bad_value, crs, crs + 1, std::uint8_t{1});
  m.set("crs_axes_one", bad_value, crs, crs + 2, std::uint8_t{0});
  m.set("crs_axes_alone", bad_value, crs, m.section("DECL"), std::array<std::uint8_t, 3>{});
  m.set("crs_reserved", reserved_bits, crs + 3, std::uint8_t{1});
  m.set("crs_control", bad_value, text + 1, std::uint8_t{'\n'});
  m.set("crs_delete", bad_value, text + 2, std::uint8_t{0x7F});
  m.set("crs_c1", bad_value, text + 2, std::array<std::uint8_t, 2>{0xC2, 0x9B});
  m.set("crs_overlong", bad_value, text + 2, std::array<std::uint8_t, 3>{0xE0, 0x81, 0x81});
  m.set("crs_surrogate", bad_value, text + 2, std::array<std::uint8_t, 3>{0xED, 0xA0, 0x80});
  m.set("crs_beyond_unicode", bad_value, text + 2, std::array<std::uint8_t, 4>{0xF4, 0x90, 0x80, 0x80});
  m.set("crs_cut_character", bad_value, m.file().size() - 1, std::uint8_t{0xC3});
}

inline void reject_payload(RejectMaker& m) {
  using enum Errc;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kInfinity = std::numeric_limits<float>::infinity();
  const std::uint64_t steps = m.section("SHSC"), chunk = m.section("CHNK"), mean = m.section("MEAN"),
                      geom = m.section("GEOM"), sh = m.section("SHI8"), perm = m.section("PERM"),
                      prov = m.section("PROV");
  const auto green = get<std::uint32_t>(m.file(), steps + 4);
  m.set("step_18_bits", bad_value, steps + 4, green + 0x40u);
  m.set("step_minus_0", bad_value, steps + 4, -0.f);
  m.set("step_negative", bad_value, steps + 4, green | 0x80000000u);
  m.set("step_nan", bad_value, steps + 8, kNaN);
  m.set("step_small", bad_value, steps + 8, 0x1.8p-108f);
  m.set("step_large", bad_value, steps + 8, 0x1p94f);
  m.set("step_absent_degree", bad_value, steps + 12, 1.f);
  m.set("step_0_code_not", bad_value, sh + 1, steps + 4, 0.f);
  m.set("chunk_box_smaller", bad_value, chunk, chunk, get<float>(m.file(), chunk) + 1);
  m.set("chunk_box_nan", bad_value, chunk, chunk + 20, kNaN);
  m.set("chunk_box_inverted", bad_value, chunk, chunk + 24, -1000.f);
  m.set("chunk_radius", bad_value, chunk + 12, get<float>(m.file(), chunk + 12) * 2);
  m.set("chunk_radius_negative", bad_value, chunk + 12, -1.f);
  m.set("chunk_radius_infinite", bad_value, chunk + 12, kInfinity);
  m.set("chunk_opacity", bad_value, chunk + 28, 1.f);
  m.set("chunk_opacity_2", bad_value, chunk + 28, 2.f);
  m.set("chunk_scale_set", bad_value, chunk + 32, std::uint64_t{1});
  m.set("chunk_count", bad_value, chunk + 40, 5u);
  m.set("chunk_reserved", reserved_bits, chunk + 44, 1u);
  m.set("mean_nan", bad_value, mean + 4, kNaN);
  m.set("mean_infinite", bad_value, mean + 5 * 12 + 8, -kInfinity);
  m.set("rotation_short", bad_value, geom + 16, geom + 16, std::uint64_t{0});
  m.set("rotation_long", bad_value, geom, geom + 2, std::uint16_t{0x3E00});
  m.set("rotation_nan", bad_value, geom, geom + 4, std::uint16_t{0x7E00});
  m.set("rotation_w_negative", bad_value, geom + 32, geom + 32,
        static_cast<std::uint16_t>(get<std::uint16_t>(m.file(), geom + 32) | 0x8000u));
  m.set("scale_infinite", bad_value, geom + 8, std::uint16_t{0x7C00});
  m.set("scale_nan", bad_value, geom + 26, std::uint16_t{0x7C01});
  m.set("scale_minus_0", bad_value, geom + 12, std::uint16_t{0x8000});
  m.set("opacity_above_1", bad_value, geom + 14, std::uint16_t{0x3C01});
  m.set("opacity_minus_0", bad_value, geom + 5 * 16 + 14, std::uint16_t{0x8000});
  m.set("sh_minus_128", bad_value, sh + 4 + 2, std::int8_t{-128});
  m.set("sh_padding", reserved_bits, sh + 3, std::uint8_t{1});
  m.set("permutation_twice", bad_value, perm, perm + 4, get<std::uint32_t>(m.file(), perm));
  m.set("permutation_beyond", bad_value, perm + 8, 6u);
  m.set("provenance_name_long", limit_exceeded, prov + 16, 4097u);
  m.set("provenance_tool_long", limit_exceeded, prov + 20, ~0u);
  m.set("provenance_lengths", size_mismatch, prov, prov + 16, 11u);
  m.change("provenance_short", size_mismatch, prov, [&](Bytes& b) {
    b.resize(prov + 23);
    put(b, 16, prov + 23);
    put(b, m.entry("PROV") + 24, std::uint64_t{23});
    put(b, m.entry("PROV") + 32, std::uint64_t{23});
  });
}

// `m` has a packed file.
inline void reject_coded(RejectMaker& m) {
  using enum Errc;
  const std::uint64_t mean = m.section("MEAN"), sh = m.section("SHI8"), steps = m.section("SHSC");
  const auto first_frame = [&m](std::uint64_t section) {
    return section + 16 + 16 * std::uint64_t{get<std::uint32_t>(m.file(), section + 4)};
  };
  const auto frame_bytes = get<std::uint32_t>(m.file(), mean + 16);
  m.set("coded_in_1_0", unsupported_codec, m.entry("SHSC") + 8, 10, std::uint16_t{0});
  m.set("coded_permutation", unsupported_codec, m.entry("PERM") + 8, 1u);
  m.set("coded_codec_2", unsupported_codec, m.entry("GEOM") + 8, 2u);
  m.set("coded_size", size_mismatch, m.entry("MEAN") + 32, m.entry("MEAN") + 32, std::uint64_t{24});
  m.set("frame_rows_0", bad_value, mean, 0u);
  m.set("frame_rows_part_of_chunk", bad_value, sh, 16u);
  m.set("frame_rows_large", bad_value, steps, 65537u);
  m.set("frame_count", bad_value, mean + 4, 2u);
  m.set("frame_reserved", reserved_bits, mean + 20, 1u);
  m.set("frame_longer", size_mismatch, mean + 16, frame_bytes + 1);
  m.set("frame_shorter", size_mismatch, first_frame(mean) + frame_bytes - 1, mean + 16, frame_bytes - 1);
  m.set("frame_magic", corrupt_data, first_frame(mean), std::uint8_t{0x29});
  m.set("frame_skippable", corrupt_data, first_frame(sh), 0x184D2A50u);
  m.set("frame_table_corrupt", corrupt_data, first_frame(steps), first_frame(steps) + 4, std::uint8_t{0xFF});
  m.change("frame_empty", corrupt_data, first_frame(sh), [&](Bytes& b) {
    // An empty last block right after the Zstandard frame's header: 2 + 4 bytes and those of its size.
    const std::uint64_t at = first_frame(sh) + 4;
    const auto descriptor = get<std::uint8_t>(b, at);
    const std::uint64_t sizes[4] = {(descriptor & 0x20) != 0 ? 1u : 0u, 2, 4, 8};
    put(b, at + 1 + ((descriptor & 0x20) != 0 ? 0 : 1) + sizes[descriptor >> 6], std::uint8_t{1});
  });
  m.change(
      "frame_checksum", checksum_mismatch, first_frame(sh), [&](Bytes& b) { b[first_frame(sh) + 9] ^= std::byte{4}; },
      Hashes::but_frames);
  m.change(
      "frame_table_checksum", checksum_mismatch, first_frame(mean) - 8,
      [&](Bytes& b) { b[first_frame(mean) - 8] ^= std::byte{1}; }, Hashes::but_frames);
}

}  // namespace detail

/// `golden`: the folder of golden files, which has those that earlier versions wrote and the defects are made in.
inline std::vector<RejectCase> reject_cases(const std::filesystem::path& golden) {
  std::vector<RejectCase> cases;
  // Six Gaussians of degree 0 with every section; no scale is subnormal, no opacity 0 or 1.
  EncodeOptions options = golden_options();
  options.depth = DepthRange{0.25f, 64.f, DepthSource::by_hand};
  options.keep_permutation = true;
  options.provenance = Provenance{1234, 0x0123456789ABCDEFu, "garden.ply", "golden 1"};
  detail::RejectMaker all(cases, detail::sound(golden_cloud(6, 0, 15), options));
  detail::reject_header(all);
  detail::reject_table(all);
  detail::reject_declarations(all);
  detail::reject_payload(all);

  detail::RejectMaker empty(cases, detail::sound(golden_cloud(0, 0, 0), golden_options()));
  empty.set("empty_scale_sets", Errc::bad_header, 40, std::uint64_t{1});
  empty.set("empty_full_box", Errc::bad_value, empty.section("DECL") + 44, empty.section("DECL") + 56, 1.f);
  empty.set("empty_robust_box", Errc::bad_value, empty.section("DECL") + 68, empty.section("DECL") + 80, 1.f);

  options.provenance.reset();
  options.chunk_size = 32;
  detail::RejectMaker two(cases, detail::sound(golden_cloud(33, 0, 17), options));
  two.set("second_chunk_count", Errc::bad_value, two.section("CHNK") + 48 + 40, 32u);
  two.set("second_chunk_step", Errc::bad_value, two.section("SHSC") + 48 + 36, 1.f);
  two.set("second_chunk_code", Errc::bad_value, two.section("SHI8") + 32 * 4, std::int8_t{-128});

  EncodeOptions far = golden_options();
  far.origin = {4e6, 1e5, -0.1};
  detail::RejectMaker origin(cases, detail::sound(golden_cloud(6, 0, 15), far));
  detail::reject_origin(origin);

  far.crs = {"LOCAL:house", {Axis::right, Axis::forward, Axis::up}};
  detail::RejectMaker crs(cases, detail::sound(golden_cloud(6, 0, 15), far));
  detail::reject_crs(crs);

  EncodeOptions seen = golden_options();
  seen.first_view = {ViewKind::outside, {0, -12, -24}, {0, 0, 0.5F}, {0, -1, 0}, 60};
  detail::RejectMaker view(cases, detail::sound(golden_cloud(6, 0, 15), seen));
  detail::reject_first_view(view);

  options.profile = Profile::packed;
  detail::RejectMaker coded(cases, detail::sound(golden_cloud(200, 0, 17), options));
  detail::reject_coded(coded);

  detail::RejectMaker draco(cases, read_bytes(golden / "archive_base.rgs"));
  detail::reject_draco_archive(draco);
  options.profile = Profile::archive;
  options.archive.step = 0.7f;
  options.keep_permutation = false;
  options.chunk_size = 64;
  detail::RejectMaker archive(cases, detail::sound(golden_cloud(150, 1, 20), options));
  detail::reject_archive(archive, 150);
  detail::RejectMaker few(cases, detail::sound(golden_cloud(5, 0, 21), options));
  detail::reject_last_state(few);
  detail::reject_levels(cases, golden);
  return cases;
}

}  // namespace rgs::test
