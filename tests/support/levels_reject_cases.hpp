// levels_reject_cases.hpp - files with levels of detail and one defect each, and the error that each must cause.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <limits>

#include "golden_levels.hpp"
#include "reject_maker.hpp"

namespace rgs::test::detail {

/// A file's section LODS and its page records.
struct LevelsAt {
  explicit LevelsAt(const RejectMaker& m)
      : section(m.section("LODS")), n_pages(get<std::uint32_t>(m.file(), section)), bytes(m.file()) {}
  std::uint64_t record(std::uint64_t page) const { return section + 64 + 112 * page; }
  std::uint64_t page(std::uint64_t page) const { return get<std::uint64_t>(bytes, record(page)); }
  std::uint64_t section, n_pages;
  const Bytes& bytes;
};

inline void reject_levels_sections(RejectMaker& m) {
  using enum Errc;
  constexpr std::uint32_t kUnknown = 0x5A5A5A5Au;  // ZZZZ
  const std::uint64_t lods = m.entry("LODS"), page = m.entry("PAGE");
  const auto type = [&m](std::uint64_t entry) { return get<std::uint32_t>(m.file(), entry); };
  m.set("levels_in_1_3", unknown_required, lods, 10, std::uint16_t{3});
  const auto rename = [&](const char* name, std::uint64_t entry) {
    m.change(name, missing_section, 128, [&](Bytes& b) {
      put(b, entry, kUnknown);
      put(b, entry + 4, 0u);
    });
  };
  rename("levels_missing", lods);
  rename("pages_missing", page);
  m.change("levels_beside_means", bad_section, m.entry("PROV"),
           [&](Bytes& b) { put(b, m.entry("PROV"), 0x4E41454Du); });  // MEAN
  m.change("levels_behind_pages", bad_section, page, [&](Bytes& b) {
    put(b, lods, type(page));
    put(b, page, type(lods));
  });
  m.set("levels_coded", unsupported_codec, lods + 8, 1u);
  m.set("pages_codec_3", unsupported_codec, page + 8, 3u);
  m.change("levels_cut", truncated, m.section("LODS") + 200, [&](Bytes& b) { b.resize(m.section("LODS") + 200); });
  const LevelsAt at(m);
  const auto cut = [&m](const char* name, std::uint64_t size) {
    m.change(name, Errc::pages_missing, size, [&](Bytes& b) { b.resize(size); });
  };
  cut("levels_page_missing", at.page(at.n_pages - 1) + 10);
  cut("levels_positions_missing", m.section("PERM") + 10);
}

inline void reject_levels_head(RejectMaker& m) {
  using enum Errc;
  const LevelsAt at(m);
  const std::uint64_t l = at.section;
  m.flip("levels_checksum", checksum_mismatch, l, l + 64 + 41);
  m.set("levels_pages_more", size_mismatch, m.entry("LODS") + 32, l, static_cast<std::uint32_t>(at.n_pages + 1));
  m.set("levels_none", bad_value, l + 4, 0u);
  m.set("levels_65", bad_value, l + 4, 65u);
  m.set("levels_more", bad_value, l + 4, get<std::uint32_t>(m.file(), l + 4) + 1);
  m.set("levels_page_chunks_0", bad_value, l + 8, 0u);
  m.set("levels_page_chunks_1025", bad_value, l + 8, 1025u);
  m.set("levels_reserved", reserved_bits, l + 12, 1u);
  m.set("levels_reserved_last", reserved_bits, l + 28, l + 63, std::uint8_t{1});
  m.set("levels_stored", bad_value, l + 16, get<std::uint64_t>(m.file(), l + 16) + 1);
  m.set("levels_stored_2_64", limit_exceeded, l + 16, ~std::uint64_t{0});
  m.set("levels_quality", bad_value, l + 24, std::numeric_limits<float>::quiet_NaN());
}

inline void reject_records(RejectMaker& m) {
  using enum Errc;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kInfinity = std::numeric_limits<float>::infinity();
  const LevelsAt at(m);
  const std::uint64_t root = at.record(0), inner = at.record(1), second = at.record(2),
                      last = at.record(at.n_pages - 1);
  m.set("page_overlap", section_overlap, second, at.page(2) - 256);
  m.set("page_gap", section_gap, second, at.page(2) + 256);
  m.set("page_stored_bytes", size_mismatch, inner + 16, get<std::uint32_t>(m.file(), inner + 16) + 16);
  m.set("page_count", size_mismatch, inner + 16, inner + 20, get<std::uint32_t>(m.file(), inner + 20) - 4);
  m.set("page_count_2_32", bad_value, last + 20, ~0u);
  m.set("page_root_has_parent", bad_value, root + 24, 1u);
  m.set("page_own_parent", bad_value, root + 28, inner + 24, 1u);
  m.set("page_second_root", bad_value, root + 28, inner + 24, ~0u);
  m.set("page_other_parent", bad_value, second + 28, last + 24, 1u);
  m.set("page_first_child_root", bad_value, inner + 28, 0u);
  m.set("page_first_child", bad_value, inner + 28, get<std::uint32_t>(m.file(), inner + 28) + 1);
  m.set("page_children_fewer", bad_value, second + 24, root + 33, std::uint8_t{1});
  m.set("page_children_more", bad_value, root + 28, root + 33, std::uint8_t{3});
  m.set("page_children_none", bad_value, inner + 28, inner + 33, std::uint8_t{0});
  m.set("page_leaf_has_child", bad_value, last + 28, last + 33, std::uint8_t{1});
  m.set("page_level_high", bad_value, inner + 32, std::uint8_t{64});
  m.set("page_level_up", bad_value, last + 32, std::uint8_t{1});
  m.set("page_exponent", bad_value, root + 34, std::int16_t{111});
  m.set("page_leaf_exponent", bad_value, last + 34,
        static_cast<std::int16_t>(get<std::int16_t>(m.file(), last + 34) + 1));
  m.set("page_error_same", bad_value, inner + 36, get<float>(m.file(), root + 36));
  m.set("page_error_shrinks", bad_value, inner + 36, root + 36, get<float>(m.file(), inner + 36) / 2);
  m.set("page_error_negative", bad_value, inner + 36, -1.f);
  m.set("page_error_nan", bad_value, root + 36, kNaN);
  m.set("page_error_infinite", bad_value, root + 36, kInfinity);
  m.set("page_leaf_error", bad_value, last + 36, 1e-6f);
  m.set("page_leaf_error_minus_0", bad_value, last + 36, -0.f);
  m.set("page_box_nan", bad_value, inner + 40, inner + 44, kNaN);
  m.set("page_box_inverted", bad_value, inner + 40, inner + 52, -1000.f);
  m.set("page_box_outside", bad_value, last + 40, last + 60, 1000.f);
  m.set("page_corner", bad_value, inner + 68, 1u);
  m.set("page_step_sets", bad_value, root + 76, 3u);
  m.set("page_core_infinite", bad_value, root + 80, root + 84, -kInfinity);
  m.set("page_core_inverted", bad_value, last + 80, last + 92, get<float>(m.file(), last + 40));
  m.set("page_core_beyond_box", bad_value, root + 80, root + 100, get<float>(m.file(), root + 60) + 1);
  m.set("page_core_beyond_parent", bad_value, inner + 80, inner + 92, get<float>(m.file(), inner + 52));
  m.set("page_reserved", reserved_bits, root + 106, root + 111, std::uint8_t{1});
  m.set("page_origins_in_1_4", bad_value, root + 104, std::uint16_t{1});
}

/// `m` has a file of degree 1 with uncoded pages of one chunk each.
inline void reject_pages(RejectMaker& m) {
  using enum Errc;
  const LevelsAt at(m);
  const std::uint64_t n = get<std::uint32_t>(m.file(), at.record(0) + 20), page = at.page(0), steps = page + 48,
                      means = steps + 48, geometry = means + (12 * n + 15) / 16 * 16, sh = geometry + 16 * n;
  m.change(
      "page_checksum", checksum_mismatch, at.page(2), [&](Bytes& b) { b[at.page(2) + 60] ^= std::byte{1}; },
      Hashes::but_frames);
  m.set("page_padding", section_gap, at.page(1) - 1, std::uint8_t{1});
  m.set("page_chunk_count", bad_value, page + 40, static_cast<std::uint32_t>(n - 1));
  m.set("page_chunk_step_set", bad_value, page + 32, std::uint64_t{1});
  m.set("page_step", bad_value, steps + 4, -1.f);
  m.set("page_mean_nan", bad_value, means + 12 + 4, std::numeric_limits<float>::quiet_NaN());
  m.set("page_rotation", bad_value, geometry + 32, geometry + 32, std::uint64_t{0});
  m.set("page_sh_code", bad_value, sh + 5, std::int8_t{-128});
  m.change("page_box_small", bad_value, at.page(at.n_pages - 1) + 96, [&](Bytes& b) {
    const std::uint64_t last = at.record(at.n_pages - 1);
    for (std::uint64_t k = 0; k < 3; ++k) {
      for (const std::uint64_t corner : {40U, 52U, 92U}) {
        put(b, last + corner + 4 * k, get<float>(b, last + 80 + 4 * k));
      }
    }
  });
}

/// `m` has a file of two pages or more, the last of which has origins.
inline void reject_origins(RejectMaker& m, const std::string& codec) {
  using enum Errc;
  const LevelsAt at(m);
  const std::uint64_t last = at.n_pages - 1, page = at.page(last), record = at.record(last);
  m.set("origins_first_" + codec, corrupt_data, page, 1u);
  m.set("origins_order_" + codec, corrupt_data, page + 16, 0u);
  m.set("origins_beyond_" + codec, corrupt_data, page + 16, get<std::uint32_t>(m.file(), record + 20));
  m.set("origins_nan_" + codec, corrupt_data, page + 16, page + 24, std::numeric_limits<float>::quiet_NaN());
  m.set("origins_many_" + codec, bad_value, record + 104, std::uint16_t{65});
}

/// `m` has a packed file without positions.
inline void reject_packed_pages(RejectMaker& m) {
  using enum Errc;
  const LevelsAt at(m);
  m.set("page_decoded_bytes", size_mismatch, m.entry("PAGE") + 32,
        get<std::uint64_t>(m.file(), m.entry("PAGE") + 32) + 16);
  m.set("page_frame_magic", corrupt_data, at.page(1), std::uint8_t{0x29});
  m.change("levels_leaves", bad_value, at.section + 16, [&](Bytes& b) {
    put(b, 24, get<std::uint64_t>(b, 24) - 1);
    put(b, m.section("DECL") + 96, get<std::uint64_t>(b, m.section("DECL") + 96) - 1);
  });
  m.set("page_ends_early", section_gap, at.record(at.n_pages - 1), at.record(at.n_pages - 2) + 16,
        get<std::uint32_t>(m.file(), at.record(at.n_pages - 2) + 16) - 1);
  m.set("page_last_ends_early", size_mismatch, m.file().size() - 1, at.record(at.n_pages - 1) + 16,
        get<std::uint32_t>(m.file(), at.record(at.n_pages - 1) + 16) - 1);
}

/// `m` has an archive of Codec::archive_draco.
inline void reject_draco_pages(RejectMaker& m) {
  using enum Errc;
  const LevelsAt at(m);
  m.set("page_corner_2_28", bad_value, at.record(1) + 64, 1u << 28);
  m.set("page_corner_beyond", corrupt_data, at.page(1), at.record(1) + 64,
        (1u << get<std::uint32_t>(m.file(), m.section("ARCH") + 4)) - 1);
  m.set("page_streams", corrupt_data, at.page(2), ~0u);
}

/// `m` has an archive of Codec::archive with 140 Gaussians.
inline void reject_archive_pages(RejectMaker& m) {
  using enum Errc;
  const LevelsAt at(m);
  const auto bits = get<std::uint32_t>(m.file(), m.section("ARCH") + 4);
  m.set("pages3_in_1_4", unsupported_codec, m.entry("PAGE") + 8, 10, std::uint16_t{4});
  m.change("page3_rows", bad_value, at.record(0) + 20, [&](Bytes& b) {  // with larger chunks pages may be so large
    put(b, 32, std::uint64_t{3});
    put(b, 40, std::uint64_t{3});
    put(b, 48, 64u);
    put(b, at.section + 8, 1024u);
    put(b, at.record(0) + 20, (1u << 15) + 1);
  });
  m.set("page3_corner_2_28", bad_value, at.record(2) + 68, 1u << 28);
  m.set("page3_corner_beyond", corrupt_data, at.page(1), at.record(1) + 72, (1u << bits) - 1);
  m.set("page3_bits", corrupt_data, at.page(0), static_cast<std::uint8_t>(bits + 1));
  m.set("page3_fourth_byte", corrupt_data, at.page(2), at.page(2) + 3, std::uint8_t{128});
  m.set("page3_state", corrupt_data, at.page(1), at.page(1) + 4 + 3, std::uint8_t{0x5A});
}

/// `golden`: the folder of golden files.
inline void reject_levels(std::vector<RejectCase>& cases, const std::filesystem::path& golden) {
  const GoldenLevels scene = golden_levels("", Profile::direct, 140, 1, 35, 1);
  RejectMaker direct(cases, encode_levels(scene));
  reject_levels_sections(direct);
  reject_levels_head(direct);
  reject_records(direct);
  reject_pages(direct);
  GoldenLevels stated = scene;
  stated.options.crs = {"EPSG:4978", {}};
  RejectMaker crs(cases, encode_levels(stated));
  crs.change("levels_crs_behind_pages", Errc::bad_section, crs.entry("LODS"), [&](Bytes& b) {
    put(b, crs.entry("CREF"), get<std::uint32_t>(b, crs.entry("PAGE")));
    put(b, crs.entry("PAGE"), four_cc("CREF"));
  });
  crs.change("levels_crs_cut", Errc::truncated, crs.section("CREF") + 5,
             [&](Bytes& b) { b.resize(crs.section("CREF") + 5); });
  GoldenLevels coded = scene;
  coded.options.profile = Profile::packed;
  coded.options.keep_permutation = false;
  coded.options.provenance.reset();
  RejectMaker packed(cases, encode_levels(coded));
  reject_packed_pages(packed);
  RejectMaker direct_origins(cases, encode_levels(golden_origins("", Profile::direct, 140, 37)));
  reject_origins(direct_origins, "direct");
  RejectMaker packed_origins(cases, encode_levels(golden_origins("", Profile::packed, 140, 38)));
  reject_origins(packed_origins, "packed");
  RejectMaker draco(cases, read_bytes(golden / "levels_archive_base.rgs"));
  reject_draco_pages(draco);
  coded.options.profile = Profile::archive;
  coded.options.order = Order::morton;
  RejectMaker archive(cases, encode_levels(coded));
  reject_archive_pages(archive);
}

}  // namespace rgs::test::detail
