// ply_header.hpp - the text header of a PLY file, and the layout of a Gaussian in a vertex row.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"
#include "stated_scene.hpp"

namespace rgs::detail {

enum class PlyEncoding : std::uint8_t { ascii, little_endian, big_endian };
enum class PlyType : std::uint8_t { int8, uint8, int16, uint16, int32, uint32, float32, float64 };

constexpr std::uint32_t ply_type_bytes(PlyType type) {
  constexpr std::array<std::uint32_t, 8> kBytes{1, 1, 2, 2, 4, 4, 4, 8};
  return kBytes[static_cast<std::size_t>(type)];
}

struct PlyProperty {
  std::string_view name;
  PlyType type = PlyType::float32;  ///< of the value, or of each list item
  bool is_list = false;
  PlyType count_type = PlyType::uint8;  ///< of the list length; an integer type
  std::uint64_t line = 0;               ///< byte offset of the header line
};

struct PlyElement {
  std::string_view name;
  std::uint64_t count = 0;
  std::vector<PlyProperty> properties;
  std::uint64_t line = 0;
  bool has_lists = false;
  std::uint32_t min_row_bytes = 0;  ///< of a binary row whose lists are empty; exact if !has_lists
};

/// Names point into the parsed bytes.
struct PlyHeader {
  PlyEncoding encoding = PlyEncoding::ascii;
  std::vector<PlyElement> elements;
  std::uint64_t bytes = 0;  ///< of the header: the data's offset
  StatedScene stated;       ///< from comments
};

inline constexpr std::uint64_t kMaxPlyHeaderBytes = std::uint64_t{1} << 20;

/// Lines may end in LF or CR LF. Errors carry the offending line's byte offset: bad_magic, unsupported_version,
/// bad_syntax, bad_value (a comment rgs_KEY, see read_comment()), limit_exceeded (header above 1 MiB), truncated (no
/// end_header).
Result<PlyHeader> parse_ply_header(std::span<const std::byte> bytes);

/// The beginning of a Splat as 59 floats: mean 0..2, log_scale 3..5, rotation 6..9, opacity_logit 10, sh 11..58.
inline constexpr int kSplatFloats = 59;
static_assert(offsetof(Splat, mean_rest) == kSplatFloats * sizeof(float));
static_assert(offsetof(Splat, log_scale) == 3 * sizeof(float) && offsetof(Splat, rotation) == 6 * sizeof(float));
static_assert(offsetof(Splat, opacity_logit) == 10 * sizeof(float) && offsetof(Splat, sh) == 11 * sizeof(float));

/// Floats of a Splat that a scene of this degree uses.
constexpr int splat_floats(int sh_degree) {
  return 11 + 3 * sh_coefficients(sh_degree);
}

struct SplatProperties {
  std::size_t element = 0;  ///< index of the vertex element
  int sh_degree = 0;
  std::vector<std::int16_t> splat_float;  ///< per vertex property: its index among the 59 floats, or -1
};

/// Finds the 3DGS properties by name. Errors: not_gaussian_splats (no vertices, a property missing or a list, 2DGS:
/// expected 3 found 2, gaps in f_rest), unsupported_feature (packed PLY; f_rest count in Error::found).
Result<SplatProperties> find_splat_properties(const PlyHeader& header);

}  // namespace rgs::detail
